"""The scene around a demonstration: what an arm must not touch, in the grid world; all of this is ours.

    Scene, GridPath --hazards_of--> Hazards: the moves that touch, and the cost of entering each cell

A policy keeps the scene that it was learnt in, with its costs, as `Surroundings`.

A *scene* has keep-out boxes, capsules (the links of another arm) and tissue, in the frame of the demonstration, in mm.
Each is grown by `margin_mm`. A *cell* is forbidden if its centre touches something, because centres are what a policy
commands; a *move* touches if the straight line between the two centres does, so no move passes through a thin box. The
distance of the tip from the centre of its cell, and the size of the tool, belong into the margin.

Tissue is a plane or a height map above a plane, also that of a mesh: it is nowhere below the mesh, so that what keeps
off the map keeps off the tissue.

    points, triangles --tissue_of_mesh--> Tissue

The highest place of a mesh in a square of the map is at a point of the mesh, where an edge crosses the square's border,
or at the square's corner. A corner of the map gets the highest of these within one step of it, along each axis. Each
square has four such corners, so the surface between them, which is bilinear, is nowhere below the mesh.
"""

from collections.abc import Mapping
from dataclasses import asdict, astuple, dataclass
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from skills.arithmetic import product
from skills.arrays import Flags, Floats, Ints, xyz
from skills.errors import BadSettings
from skills.fields import Point, schema
from skills.gridworld.grid import MOVES, GridPath, GridWorld
from skills.quaternions import unit

STAY = 13  # the action that stays: (0, 0, 0), the middle one of the moves
SAMPLES_A_STEP = 4  # a move is compared with tissue at points at most a quarter of the map's step apart
MOST_BODIES = 64  # ours, boxes or capsules: two arms have twenty links, and each body is compared with every move
MOST_HEIGHTS = 10_000  # ours, of a height map: 100 mm by 100 mm at 1 mm, some 200 kB of JSON
LEAST_STEP_MM = 0.1  # ours, of a height map: a move of 5 mm is compared with tissue at 4 points a step
LINE_STEP_MM = 0.25  # ours: a distance from a height map is at most half of this too small, for that reason
FAR_MM = 100.0  # ours: five times the widest tube that is served
SQUARE = 1e-9  # greatest cosine of the angle between two directions that count as perpendicular


@schema
@dataclass(frozen=True)
class Box:
    """A box that must not be entered, along the axes of the frame, from its lowest to its highest corner in mm."""

    low_mm: Point
    high_mm: Point

    def __post_init__(self) -> None:
        _check_finite("A box", self.low_mm, self.high_mm)
        if not all(low < high for low, high in zip(self.low_mm, self.high_mm, strict=True)):
            raise BadSettings("low_mm of a box must be below high_mm along each axis.", box=astuple(self))

    def grown(self, by_mm: float) -> "Box":
        """Return the box with each face further out by a distance."""
        return Box(xyz(np.array(self.low_mm) - by_mm), xyz(np.array(self.high_mm) + by_mm))

    def from_lines_mm(self, a_mm: Floats, b_mm: Floats) -> Floats:
        """Return the distances of straight lines between points, (..., 3), from the box, (...,); 0 where they touch.

        The square of the distance along a line is a parabola between the places where the line crosses the planes of
        the faces, so each piece has its least distance at its vertex or at an end.
        """
        low, high, way = np.array(self.low_mm), np.array(self.high_mm), b_mm - a_mm
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            crossings = np.concatenate([(low - a_mm) / way, (high - a_mm) / way], axis=-1)
        crossings = np.nan_to_num(crossings, nan=0.0, posinf=1.0, neginf=0.0).clip(0, 1)
        ends = np.zeros_like(crossings[..., :1])
        shares = np.sort(np.concatenate([ends, crossings, ends + 1], axis=-1), axis=-1)
        nearest = np.full(way.shape[:-1], np.inf)
        for piece in range(shares.shape[-1] - 1):
            first, last = shares[..., piece, None], shares[..., piece + 1, None]
            middle = a_mm + (first + last) / 2 * way
            beside = (middle < low) | (middle > high)
            face = np.where(middle < low, low, high)
            slope = np.where(beside, way * way, 0.0).sum(axis=-1, keepdims=True)
            rise = np.where(beside, way * (face - a_mm), 0.0).sum(axis=-1, keepdims=True)
            at = a_mm + np.clip(rise / np.where(slope > 0, slope, 1.0), first, last) * way
            apart = np.linalg.norm(np.maximum(np.maximum(low - at, at - high), 0.0), axis=-1)
            nearest = np.minimum(nearest, apart)  # NaN stays NaN
        return np.asarray(nearest)


@schema
@dataclass(frozen=True)
class Capsule:
    """A cylinder with round ends, such as a link of the other arm: its axis from a to b, and its radius, in mm."""

    a_mm: Point
    b_mm: Point
    radius_mm: float

    def __post_init__(self) -> None:
        _check_finite("A capsule", self.a_mm, self.b_mm, (self.radius_mm,))
        if not self.radius_mm > 0:
            raise BadSettings("radius_mm of a capsule must be positive.", radius_mm=self.radius_mm)

    def from_lines_mm(self, a_mm: Floats, b_mm: Floats) -> Floats:
        """Return the distances of straight lines between points, (..., 3), from the capsule, (...,); < 0 inside."""
        apart = _between_segments_mm(a_mm, b_mm, np.array(self.a_mm), np.array(self.b_mm))
        # where a coordinate is NaN, the nearest ends may be finite
        known = np.isfinite(a_mm).all(axis=-1) & np.isfinite(b_mm).all(axis=-1)
        return np.asarray(np.where(known, apart - self.radius_mm, np.nan))


@schema
@dataclass(frozen=True)
class Tissue:
    """A surface that must not be entered: heights above a plane, bilinear between the points of a regular map.

    Attributes:
        at_mm: The point of the plane at which the map begins.
        normal: Direction out of the tissue; any length.
        along: Direction of the rows of the map, perpendicular to the normal; any length.
        step_mm: Distance of the map's points.
        heights_mm: Height of the surface above the plane at i steps along `along` and j steps along normal x along, as
            rows of equal length. Beyond its edges the map continues with the height at the edge.
    """

    at_mm: Point
    normal: Point
    along: Point
    step_mm: float = 1.0
    heights_mm: tuple[tuple[float, ...], ...] = ((0.0,),)

    def __post_init__(self) -> None:
        object.__setattr__(self, "heights_mm", tuple(tuple(map(float, row)) for row in self.heights_mm))
        _check_finite("Tissue", self.at_mm, self.normal, self.along, (self.step_mm,), *self.heights_mm)
        if not self.heights_mm or len({len(row) for row in self.heights_mm} | {0}) != 2:
            raise BadSettings("A height map needs rows of one number or more, equally long.")
        if not self.step_mm >= LEAST_STEP_MM:
            raise BadSettings(f"step_mm of a height map must be {LEAST_STEP_MM:g} or more.", step_mm=self.step_mm)
        if (count := len(self.heights_mm) * len(self.heights_mm[0])) > MOST_HEIGHTS:
            raise BadSettings(
                f"A height map may have {MOST_HEIGHTS} heights, this one has {count}; use a larger step_mm, or the "
                "part of the tissue that is near the path.",
                heights=count,
            )
        normal, along = np.array(self.normal), np.array(self.along)
        lengths = np.linalg.norm([normal, along], axis=1).prod()
        if not (lengths > 0 and abs(product(normal, along)) <= SQUARE * lengths):
            raise BadSettings("`normal` and `along` of tissue must be perpendicular directions, neither of length 0.")

    @classmethod
    def plane(cls, at_mm: Point, normal: Point) -> "Tissue":
        """Return flat tissue below a point, with a direction out of it."""
        least = np.eye(3)[int(np.abs(normal).argmin())]
        x, y, z = np.cross(normal, least).tolist()
        return cls(at_mm, normal, (x, y, z))

    def above_mm(self, points_mm: ArrayLike) -> Floats:
        """Return the height of points, (..., 3), above the surface along the normal, (...,); negative inside."""
        normal, along = unit(np.array([self.normal, self.along]))
        apart = np.asarray(points_mm, float) - self.at_mm
        heights = np.array(self.heights_mm)
        row, u = _between(product(apart, along) / self.step_mm, heights.shape[0])
        column, v = _between(product(apart, np.cross(normal, along)) / self.step_mm, heights.shape[1])
        next_row, next_column = (np.minimum(i + 1, n - 1) for i, n in zip((row, column), heights.shape, strict=True))
        near = (1 - v) * heights[row, column] + v * heights[row, next_column]
        far = (1 - v) * heights[next_row, column] + v * heights[next_row, next_column]
        return np.asarray(product(apart, normal) - ((1 - u) * near + u * far))

    @property
    def flat(self) -> bool:
        """Whether it is a plane."""
        return len(self.heights_mm) == len(self.heights_mm[0]) == 1

    @property
    def steep(self) -> float:
        """The most by which a height above the surface can exceed the distance from it, 1 for a plane."""
        slopes = [np.abs(np.diff(self.heights_mm, axis=axis)).max(initial=0.0) / self.step_mm for axis in (0, 1)]
        return float(np.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2))

    def from_lines_mm(self, a_mm: Floats, b_mm: Floats, within_mm: float) -> Floats:
        """Return lower bounds on the distances of straight lines between points, (..., 3), from the tissue, (...,).

        Of a plane the distances are exact. Of a height map with slopes of at most L, a point that is h above the
        surface is at least h / sqrt(1 + L^2) away from it; lines are compared at points at most `LINE_STEP_MM` apart,
        and half of that is subtracted. Inside they are negative.

        Args:
            a_mm: Beginnings of the lines.
            b_mm: Their ends.
            within_mm: Distances from a height map beyond this one are returned as this one.
        """
        if self.flat:
            return np.asarray(np.minimum(self.above_mm(a_mm), self.above_mm(b_mm)))
        heights, normal = np.array(self.heights_mm), unit(np.array(self.normal))
        steep = self.steep
        # Only the part of a line that is not far above the highest point of the tissue can be near it.
        top, up_a, up_b = (
            heights.max() + within_mm * steep,
            *(product(end - self.at_mm, normal) for end in (a_mm, b_mm)),
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = np.clip((top - up_a) / (up_b - up_a), 0, 1)
        first, last = np.where(up_a > top, crossing, 0.0), np.where(up_b > top, crossing, 1.0)
        near = ~((up_a > top) & (up_b > top))  # NaN counts as near, and stays NaN
        way = b_mm - a_mm
        longest = float(np.nanmax((last - first) * np.linalg.norm(way, axis=-1) * near, initial=0.0))
        pieces = 1 + int(longest / LINE_STEP_MM)
        least = np.full(up_a.shape, np.inf)
        for share in np.linspace(0.0, 1.0, pieces + 1):
            least = np.minimum(least, self.above_mm(a_mm + (first + share * (last - first))[..., None] * way))
        apart = np.where(least > 0, least / steep, least) - longest / pieces / 2
        return np.asarray(np.minimum(np.where(near, apart, within_mm), within_mm))


@schema
@dataclass(frozen=True)
class Scene:
    """What an arm must not touch.

    Attributes:
        frame: The frame, that of the demonstration.
        boxes: Keep-out boxes.
        capsules: The other arm.
        tissue: The tissue, or None.
        margin_mm: Distance by which everything is grown.
    """

    frame: str
    boxes: tuple[Box, ...] = ()
    capsules: tuple[Capsule, ...] = ()
    tissue: Tissue | None = None
    margin_mm: float = 0.0

    def __post_init__(self) -> None:
        if not self.frame:
            raise BadSettings("A scene needs the name of its frame.")
        if not (isfinite(self.margin_mm) and self.margin_mm >= 0):
            raise BadSettings("margin_mm of a scene must be 0 or more.", margin_mm=self.margin_mm)
        if len(self.boxes) + len(self.capsules) > MOST_BODIES:
            raise BadSettings(
                f"A scene may have {MOST_BODIES} boxes and capsules, this one has "
                f"{len(self.boxes) + len(self.capsules)}; leave out those that are far from the path."
            )

    def as_json(self) -> dict[str, Any]:
        """Return the scene as plain JSON, of which `skills.packing` computes a digest."""
        return {name: _lists(value) for name, value in asdict(self).items()}

    @classmethod
    def of_json(cls, described: Mapping[str, Any]) -> "Scene":
        """Return a scene from its JSON.

        Raises:
            BadSettings: A part is missing, unknown or impossible.
        """
        try:
            tissue = described.get("tissue")
            return cls(
                **dict(described)
                | {
                    "boxes": tuple(Box(**_tuples(one)) for one in described.get("boxes", ())),
                    "capsules": tuple(Capsule(**_tuples(one)) for one in described.get("capsules", ())),
                    "tissue": None if tissue is None else Tissue(**_tuples(tissue)),
                }
            )
        except (TypeError, ValueError, AttributeError) as error:
            raise BadSettings("This is no scene: give the fields that `Scene.as_json` writes.") from error

    def clearance_mm(self, points_mm: ArrayLike) -> Floats:
        """Return the distance of points, (..., 3), from the nearest part, margin included, (...,); 0 inside.

        The distance from tissue is measured along its normal. Without parts it is infinite.
        """
        points = np.asarray(points_mm, float)
        nearest = np.full(points.shape[:-1], np.inf)
        for box in self.boxes:
            outside = np.maximum(np.maximum(box.low_mm - points, points - box.high_mm), 0.0)
            nearest = np.minimum(nearest, np.linalg.norm(outside, axis=-1))
        for capsule in self.capsules:
            apart = _between_segments_mm(points, points, np.array(capsule.a_mm), np.array(capsule.b_mm))
            nearest = np.minimum(nearest, apart - capsule.radius_mm)
        if self.tissue is not None:
            nearest = np.minimum(nearest, self.tissue.above_mm(points))
        return np.maximum(nearest - self.margin_mm, 0.0)

    def from_lines_mm(self, a_mm: Floats, b_mm: Floats) -> dict[str, Floats]:
        """Return the distances of straight lines between points, (..., 3), from each part by its name, (...,).

        The margin is taken off: boxes grow by it along each axis, as in `touches`. Of a height map they are lower
        bounds. A distance of more than `FAR_MM` from a height map is returned as that.
        """
        found = {f"box {k}": box.grown(self.margin_mm).from_lines_mm(a_mm, b_mm) for k, box in enumerate(self.boxes)}
        for k, capsule in enumerate(self.capsules):
            found[f"capsule {k}"] = capsule.from_lines_mm(a_mm, b_mm) - self.margin_mm
        if self.tissue is not None:
            found["tissue"] = self.tissue.from_lines_mm(a_mm, b_mm, within_mm=FAR_MM) - self.margin_mm
        return found

    def touches(self, from_mm: ArrayLike, to_mm: ArrayLike) -> Flags:
        """Return for each straight line between two points, (..., 3), whether it touches a part, (...,).

        Boxes grow by the margin along each axis, so their edges stay sharp. Tissue is compared at points at most a
        quarter of its map's step apart, which for a plane is exact; they depend on the line alone, so a line is judged
        the same together with others. Written so that NaN touches.
        """
        a, b = np.broadcast_arrays(np.asarray(from_mm, float), np.asarray(to_mm, float))
        touched = np.zeros(a.shape[:-1], bool)
        for box in self.boxes:
            touched |= _crosses(a, b, np.array(box.low_mm) - self.margin_mm, np.array(box.high_mm) + self.margin_mm)
        for capsule in self.capsules:
            apart = _between_segments_mm(a, b, np.array(capsule.a_mm), np.array(capsule.b_mm))
            touched |= ~(apart > capsule.radius_mm + self.margin_mm)
        if self.tissue is not None:
            steps = 0.0 if self.tissue.flat else SAMPLES_A_STEP / self.tissue.step_mm
            pieces = 1 + np.floor(steps * np.linalg.norm(b - a, axis=-1))
            for piece in range(1 + int(pieces.max(initial=1.0, where=np.isfinite(pieces)))):
                share = np.minimum(piece / pieces, 1.0)[..., None]
                touched |= ~(self.tissue.above_mm((1 - share) * a + share * b) > self.margin_mm)
        return touched


@schema
@dataclass(frozen=True)
class SceneCosts:
    """Costs in addition to the rewards of Algorithm 1; the paper has none.

    Attributes:
        touch: Of touching, which ends the pass. More than a path of 90 states can earn, so no style is worth a touch.
        close: Of entering a cell whose centre touches, less with its clearance, down to 0 at `close_mm`.
        close_mm: Clearance from which on a cell costs nothing.
        deeper_per_mm: Of entering a cell, for each mm that it is deeper than all states of the demonstration, along
            the normal of the tissue.
    """

    touch: float = 100.0
    close: float = 0.1
    close_mm: float = 5.0
    deeper_per_mm: float = 0.01

    def __post_init__(self) -> None:
        costs = astuple(self)
        if not (all(map(isfinite, costs)) and min(costs) >= 0 and self.touch > 0 and self.close_mm > 0):
            raise BadSettings("Costs must be finite and 0 or more; `touch` and `close_mm` positive.", costs=costs)


@dataclass(frozen=True)
class Surroundings:
    """A scene, and the costs with which a policy is learnt in it."""

    scene: Scene
    costs: SceneCosts = SceneCosts()

    def as_json(self) -> dict[str, Any]:
        """Return both as plain JSON."""
        return {"scene": self.scene.as_json(), "costs": _lists(asdict(self.costs))}

    @classmethod
    def of_json(cls, described: Mapping[str, Any]) -> "Surroundings":
        """Return both from their JSON.

        Raises:
            BadSettings: As for `Scene.of_json`; or a cost is out of range.
        """
        return cls(Scene.of_json(described["scene"]), SceneCosts(**described["costs"]))


@dataclass(frozen=True, eq=False)
class Hazards:
    """A scene on a grid.

    Attributes:
        touches: Whether the move by each action from each state touches, (n_states, 27); off the grid it stays.
        cost: Cost of entering each state, (n_states,).
        surroundings: The scene, and its costs.
    """

    touches: Flags
    cost: Floats
    surroundings: Surroundings

    @property
    def touch(self) -> float:
        """The cost of touching."""
        return self.surroundings.costs.touch

    @property
    def forbidden(self) -> Flags:
        """Whether the centre of each state's cell touches, (n_states,)."""
        return np.asarray(self.touches[:, STAY])


def hazards_of(scene: Scene, path: GridPath, frame: str, costs: SceneCosts | None = None) -> Hazards:
    """Return which moves of a path's grid touch a scene, and the cost of each state.

    Args:
        scene: The scene, in the frame of the path.
        path: The demonstrated path.
        frame: The frame of the path.
        costs: The costs; None for the defaults.

    Returns:
        The hazards.

    Raises:
        BadSettings: The scene is in another frame; or the demonstration itself touches it, and cannot be followed.
    """
    refuse_unfit(scene, path, frame)
    costs, grid = costs or SceneCosts(), path.grid
    states = np.arange(grid.n_states)
    centres = grid.centres_mm(states)
    touches = np.stack([touching(scene, grid, states, np.full(len(states), a)) for a in range(len(MOVES))], axis=1)
    cost = costs.close * (1 - scene.clearance_mm(centres) / costs.close_mm).clip(0)
    if scene.tissue is not None:
        below_mm = scene.tissue.above_mm(path.tip_mm).min() - scene.tissue.above_mm(centres)
        cost = cost + costs.deeper_per_mm * below_mm.clip(0)
    return Hazards(touches, np.asarray(cost), Surroundings(scene, costs))


def refuse_unfit(scene: Scene, path: GridPath, frame: str) -> None:
    """Refuse a scene in which a demonstration cannot be followed.

    Args:
        scene: The scene.
        path: The demonstrated path.
        frame: The frame of the path.

    Raises:
        BadSettings: The scene is in another frame, or the demonstration itself touches it.
    """
    if scene.frame != frame:
        raise BadSettings(
            f"The scene is in the frame '{scene.frame}', the demonstration in '{frame}'; give the scene in that frame."
        )
    bad = np.flatnonzero(scene.touches(path.tip_mm[:-1], path.tip_mm[1:]))
    if len(bad):
        x, y, z = path.tip_mm[bad[0]]
        raise BadSettings(
            f"The demonstration itself touches the scene in {len(bad)} of {len(path.states) - 1} moves, first from "
            f"({x:.1f}, {y:.1f}, {z:.1f}) mm; check the scene's frame and margin, or record the hand-off further away.",
            moves=len(bad),
        )


def touching(scene: Scene, grid: GridWorld, states: Ints, actions: Ints) -> Flags:
    """Return for each state and action whether the move touches a scene; off the grid it stays.

    Args:
        scene: The scene, in the frame of the grid.
        grid: The grid world.
        states: States, shape (N,).
        actions: The action in each, 0 to 26, shape (N,).

    Returns:
        Whether the straight line between the centres of the two cells comes within the scene's margin, shape (N,).
    """
    cells = grid.cells_of(states)
    after = cells + MOVES[actions]
    after = np.where(grid.holds(after)[:, None], after, cells)
    return scene.touches(grid.centres_of(cells), grid.centres_of(after))


def _check_finite(name: str, *rows: tuple[float, ...]) -> None:
    if not all(isfinite(number) for row in rows for number in row):
        raise BadSettings(f"{name} has a number that is not finite.")


def _lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _lists(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_lists(part) for part in value]
    return float(value) if isinstance(value, int) else value  # so that 5 and 5.0 have the same digest


def _tuples(described: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _tuple(value) for name, value in described.items()}


def _tuple(value: Any) -> Any:
    return tuple(map(_tuple, value)) if isinstance(value, list | tuple) else value


def _between(places: Floats, n: int) -> tuple[np.ndarray[Any, Any], Floats]:
    """Return the index of the map's point at or before each place, and the share of the way to the next one."""
    inside = places.clip(0, n - 1)
    index = np.floor(np.nan_to_num(inside)).astype(np.int64)  # the share of NaN stays NaN
    return index, inside - index


def _crosses(a: Floats, b: Floats, low: Floats, high: Floats) -> Flags:
    """Return whether lines from a to b, (..., 3), touch a box: the parts within each axis' bounds overlap."""
    way = b - a
    still = way == 0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        to_low, to_high = (low - a) / way, (high - a) / way
    within = (a >= low) & (a <= high)
    enters = np.where(still, np.where(within, -np.inf, np.inf), np.minimum(to_low, to_high)).max(axis=-1)
    leaves = np.where(still, np.where(within, np.inf, -np.inf), np.maximum(to_low, to_high)).min(axis=-1)
    return np.asarray(~(np.maximum(enters, 0.0) > np.minimum(leaves, 1.0)))


def _between_segments_mm(a: Floats, b: Floats, c: Floats, d: Floats) -> Floats:
    """Return the distance between lines from a to b, (..., 3), and the line from c to d, (3,).

    The nearest points are inside both, or one is an end.
    """
    u, v, w = b - a, d - c, a - c
    uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
    uw, vw = (u * w).sum(-1), (w * v).sum(-1)
    det = uu * vv - uv * uv
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        s, t = (uv * vw - vv * uw) / det, (uu * vw - uv * uw) / det
    inside = (det > 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    s, t = np.where(inside, s, 0.0), np.where(inside, t, 0.0)
    middle = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    ends = [_to_segment(a, c, d), _to_segment(b, c, d), _to_segment(c, a, b), _to_segment(d, a, b)]
    return np.asarray(np.minimum(np.where(inside, middle, np.inf), np.min(np.broadcast_arrays(*ends), axis=0)))


def _to_segment(point: Floats, a: Floats, b: Floats) -> Floats:
    """Return the distance of points from lines from a to b; shapes broadcast to (..., 3)."""
    way = b - a
    length = (way * way).sum(-1)
    share = ((point - a) * way).sum(-1) / np.where(length > 0, length, 1.0)
    return np.asarray(np.linalg.norm(point - a - share.clip(0, 1)[..., None] * way, axis=-1))


ROUNDING = 1e-9  # steps; points this near a line of the map count to both of its sides


def tissue_of_mesh(
    points_mm: ArrayLike, triangles: ArrayLike, normal: Point, *, step_mm: float = 1.0, beyond_mm: float | None = None
) -> Tissue:
    """Return the height map of a mesh of triangles.

    Only what is visible from above counts: below its highest place along the normal all is tissue. With slopes of at
    most L the map is at most 2 sqrt(2) L step_mm too high.

    Args:
        points_mm: Points of the mesh in the frame of the scene, (n, 3).
        triangles: Indices of the three points of each triangle, in any order, (m, 3).
        normal: Direction out of the tissue; any length.
        step_mm: Distance of the map's points; half of the smallest shape that matters, or less.
        beyond_mm: Height of the tissue along the normal where the map has a point and the mesh has nothing, measured
            from the origin of the frame; None refuses such a mesh. Holes between the map's points are not seen.

    Raises:
        BadSettings: Arrays have other shapes or contain numbers that are not finite or indices of no point; the map
            would have too many points or none; or the mesh has a hole.
    """
    points, corners = np.asarray(points_mm, float), np.asarray(triangles)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise BadSettings("The points of a mesh must be finite, of shape (n, 3).", shape=str(points.shape))
    if corners.ndim != 2 or corners.shape[1] != 3 or not len(corners) or corners.dtype.kind not in "iu":
        raise BadSettings("The triangles of a mesh must be integers of shape (m, 3).", shape=str(corners.shape))
    if not (corners.min() >= 0 and corners.max() < len(points)):
        raise BadSettings(f"A triangle of a mesh names a point that is not among its {len(points)}.")
    if not (np.isfinite(step_mm) and step_mm >= LEAST_STEP_MM):
        raise BadSettings(f"step_mm of a height map must be {LEAST_STEP_MM:g} or more.", step_mm=step_mm)
    plane = Tissue.plane((0.0, 0.0, 0.0), normal)
    up, along = unit(np.array([normal, plane.along]))
    axes = np.stack([along, np.cross(up, along)])
    places = np.column_stack([product(points, axes.T) / step_mm, product(points, up)])[
        corners
    ]  # (m, 3, 3): steps, steps, mm
    flat = places.reshape(-1, 3)
    first = np.ceil(flat[:, :2].min(axis=0) - ROUNDING)
    shape = np.floor(flat[:, :2].max(axis=0) + ROUNDING) - first + 1
    if not shape.min() >= 1:
        raise BadSettings("The mesh is smaller than step_mm; use a smaller step_mm.", step_mm=step_mm)
    if not shape.prod() <= MOST_HEIGHTS:
        raise BadSettings(
            f"The height map of this mesh would have {shape.prod():.0f} points, and {MOST_HEIGHTS} are the most; use a "
            "larger step_mm, or the part of the mesh that is near the path.",
            step_mm=step_mm,
        )
    places[..., :2] -= first
    heights = np.full(shape.astype(int), -np.inf)
    inside = _inside(places, heights.shape)
    covered = np.zeros(heights.shape, bool)
    covered[tuple(inside[:, :2].astype(int).T)] = True
    for some in (places.reshape(-1, 3), _crossings(places, 0), _crossings(places, 1), inside):
        _raise_around(heights, some)
    if not covered.all():
        if beyond_mm is None:
            missing = int((~covered).sum())
            raise BadSettings(
                f"The mesh covers {covered.size - missing} of the {covered.size} points of its height map. Cut a "
                "rectangle out of it, or state beyond_mm, the height of the tissue where the mesh has nothing.",
                missing=missing,
            )
        heights = np.where(covered, heights, np.maximum(heights, beyond_mm))
    x, y, z = product(first * step_mm, axes).tolist()
    rows = tuple(tuple(row) for row in heights.tolist())
    return Tissue((x, y, z), normal, plane.along, step_mm, rows)


def _inside(places: Floats, shape: tuple[int, ...]) -> Floats:
    """Return the points of the map that are below or above a triangle, with its height there, (n, 3)."""
    found = [np.empty((0, 3))]
    for (a, b, c), low, high in zip(places, places.min(axis=1), places.max(axis=1), strict=True):
        (u, v), w = (b - a)[:2], (c - a)[:2]
        twice_area = u * w[1] - v * w[0]
        if abs(twice_area) < ROUNDING:
            continue  # upright: its edges have its highest places
        rows, columns = (
            np.arange(max(np.ceil(low[k] - ROUNDING), 0), min(np.floor(high[k] + ROUNDING), shape[k] - 1) + 1)
            for k in (0, 1)
        )
        at = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
        x, y = (at - a[:2]).T
        to_b, to_c = (x * w[1] - y * w[0]) / twice_area, (y * u - x * v) / twice_area
        held = (to_b >= -ROUNDING) & (to_c >= -ROUNDING) & (to_b + to_c <= 1 + ROUNDING)
        rises = a[2] + to_b * (b - a)[2] + to_c * (c - a)[2]
        found.append(np.column_stack([at, rises])[held])
    return np.concatenate(found)


def _crossings(places: Floats, axis: int) -> Floats:
    """Return the points where edges cross the map's lines at whole steps along an axis, (n, 3)."""
    a, b = (np.concatenate([places[:, k] for k in order]) for order in ((0, 1, 2), (1, 2, 0)))
    low, high = np.ceil(np.minimum(a, b)[:, axis]), np.floor(np.maximum(a, b)[:, axis])
    counts: Ints = np.where(a[:, axis] == b[:, axis], 0, np.maximum(high - low + 1, 0)).astype(np.int64)
    edge = np.repeat(np.arange(len(a)), counts)
    line = low[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (line - a[edge, axis]) / (b[edge, axis] - a[edge, axis])
    return np.asarray(a[edge] + share[:, None] * (b[edge] - a[edge]))


def _raise_around(heights: Floats, places: Floats) -> None:
    """Raise the map's points within one step of each place, along each axis, to its height."""
    nearest = np.ceil(places[:, :2] - 1 - ROUNDING).astype(np.int64)
    for row in range(3):
        for column in range(3):
            at = nearest + np.array([row, column])
            near = (at <= places[:, :2] + 1 + ROUNDING) & (at >= 0) & (at < heights.shape)
            known = near.all(axis=1)
            np.maximum.at(heights, tuple(at[known].T), places[known, 2])
