"""The scene around a demonstration: what an arm must not touch; all of this is ours.

A *scene* has keep-out boxes, capsules (the links of another arm) and tissue, in the frame of the demonstration, in mm.
Each is grown by `margin_mm`. Tissue is a plane or a height map above a plane (`skills.gridworld.mesh`: of a mesh).
`skills.gridworld.hazards` puts a scene into the grid world.
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
from skills.quaternions import unit

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
        begin = np.array(self.a_mm)
        return segments_apart(a_mm, b_mm - a_mm, begin, self.b_mm - begin) - self.radius_mm


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
        top = heights.max() + within_mm * steep
        up_a, up_b = (product(end - self.at_mm, normal) for end in (a_mm, b_mm))
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
        return {name: plain_json(value) for name, value in asdict(self).items()}

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
            nearest = np.minimum(nearest, capsule.from_lines_mm(points, points))
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
            touched |= ~(capsule.from_lines_mm(a, b) > self.margin_mm)
        if self.tissue is not None:
            steps = 0.0 if self.tissue.flat else SAMPLES_A_STEP / self.tissue.step_mm
            pieces = 1 + np.floor(steps * np.linalg.norm(b - a, axis=-1))
            for piece in range(1 + int(pieces.max(initial=1.0, where=np.isfinite(pieces)))):
                share = np.minimum(piece / pieces, 1.0)[..., None]
                touched |= ~(self.tissue.above_mm((1 - share) * a + share * b) > self.margin_mm)
        return touched


def _check_finite(name: str, *rows: tuple[float, ...]) -> None:
    if not all(isfinite(number) for row in rows for number in row):
        raise BadSettings(f"{name} has a number that is not finite.")


def plain_json(value: Any) -> Any:
    """Return a value as plain JSON, of which equal values have equal digests.

    Args:
        value: Dicts, lists and tuples of texts and numbers.
    """
    if isinstance(value, dict):
        return {name: plain_json(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain_json(part) for part in value]
    return float(value) if isinstance(value, int) else value  # so that 5 and 5.0 have the same digest


def _tuples(described: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _tuple(value) for name, value in described.items()}


def _tuple(value: Any) -> Any:
    return tuple(map(_tuple, value)) if isinstance(value, list | tuple) else value


def _between(places: Floats, n: int) -> tuple[Ints, Floats]:
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


def segments_apart(p: Floats, u: Floats, q: Floats, v: Floats) -> Floats:
    """Return the distances of segments p + s u from segments q + t v, with s and t in 0..1.

    The least distance is between the lines if they are nearest within both segments, and otherwise at an end of one of
    them: the s that is best for the lines is brought within the segment, then the t that is best for it, then s again.
    Where the segments are nearly parallel this is exact too, because every s is then nearly as good. NaN stays NaN.

    Args:
        p: Beginnings of the first segments, shape (..., 3).
        u: From their beginnings to their ends, same unit, shape (..., 3).
        q: Beginnings of the other segments, same frame, shape (..., 3).
        v: From their beginnings to their ends, shape (..., 3).

    Returns:
        Distances of the axes in the same unit, shape (...,); shapes are broadcast.
    """
    r = p - q
    uu, vv, uv, ur, vr = ((a * b).sum(axis=-1) for a, b in ((u, u), (v, v), (u, v), (u, r), (v, r)))
    uu, vv = np.maximum(uu, 1e-12), np.maximum(vv, 1e-12)  # an axis without length is a point
    s = np.clip((uv * vr - ur * vv) / np.maximum(uu * vv - uv * uv, 1e-12 * uu * vv), 0.0, 1.0)
    t = np.clip((uv * s + vr) / vv, 0.0, 1.0)
    s = np.clip((uv * t - ur) / uu, 0.0, 1.0)
    return np.asarray(np.sqrt(np.square(r + s[..., None] * u - t[..., None] * v).sum(axis=-1)))
