"""Distances of a planned motion from a scene: both arms with their outer bodies, and the needle, in closed form.

    Trajectory, Scene --clearance_of--> SceneReport, and the least distances at every sample

The tools are the capsules of `skills.verification.clearance.links_of`, the arms' outer bodies those of
`skills.verification.bodies`, the scene is that of `skills.gridworld.scene`: a capsule's distance from a box or another
capsule is exact, that from a height map a lower bound. The distances are computed at samples between which nothing
moves further than `LOOK_MM`, or `LOOK_BODIES_MM`, where something is near, and further apart elsewhere; from one to the
next, no distance is less than the mean of both minus half of that way, and this bound is what is judged. So nothing is
missed in between.

The margin of a scene stands for the tool's size in the grid world, where the tip is a point. Here it is a distance that
must be kept, if it is larger than `SceneReport.limit_mm` would be without it. A scene's capsules are the other arm, so
they are not compared with PSM_M. Tissue has no edge, so it is compared with the parts that are above it alone: tools,
cannula and its mount, insertion axis and carriage.

**Needle.** From boxes, and from the arm that does not hold it, the needle keeps the distances of a tool, wherever it is
held; fingers that come to take it do not count. While PSM_A holds it, in A1 and A2, no part of it may be inside the
tissue. It enters and leaves by the surgeon's hand, before A1 and after A2 (M1, M2): so at the beginning of A1 it may be
inside, until it is out for the first time. In a transfer to a further pass it is the surgeon's as far as tissue goes,
and altogether if PSM_M's place is not known.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import nan

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Flags, Floats, Ints, xyz
from skills.fields import Count, Figure, Point, schema
from skills.gridworld.scene import Scene, Tissue
from skills.planning.handoff import HOLDING_RAD, OPEN_RAD
from skills.planning.motion_laws import A1, A2
from skills.planning.trajectory import PSM_A, PSM_M, STANDS, PlannedArm, SampleMoment, Trajectory
from skills.verification import clearance
from skills.verification.bodies import ABOVE_TISSUE, TOOL, moved_mm, names_of, placed, radii_of
from skills.verification.clearance import way_mm
from skills.verification.playback import CLEARANCE_SEEN_MM, LINKS

LEAST_MM = 1.0  # ours, as of the pad: the error of a calibrated arm (0.65 mm) and half as much again
LOOK_MM = 0.25  # ours: a distance that is judged is at most half of this too small, for that reason
LOOK_BODIES_MM = 2.0  # ours: the same for the outer bodies, whose own margin is larger
COARSER = 16  # ours: distances are computed this much further apart where nothing is near
NEEDLE, ARC, TISSUE = "needle", "arc", "tissue"
# PSM_M's jaw comes open and closes on the needle, at times that a trajectory does not state: its fingers, 2.2 mm thick,
# move by 1.1 mm at their tips from one opening to the next, so nothing passes between two of them.
JAWS_RAD = np.linspace(HOLDING_RAD, OPEN_RAD, 5).tolist()


@schema
@dataclass(frozen=True, kw_only=True)
class NearestToScene(SampleMoment):
    """The least distance of an arm's tool from a part of the scene, and the sample of it.

    Attributes:
        body: The arm, or "needle".
        link: Its link, by its name in the URDF, or its outer body.
        part: tissue, or box or capsule with its index, such as "box 0".
        least_mm: The distance; negative inside.
        tip_mm: Position of the arm's tip there, in the frame of the plan.
    """

    body: str
    link: str
    part: str
    least_mm: Figure
    tip_mm: Point

    def __str__(self) -> str:
        """Return it as part of a sentence."""
        apart = "nan" if self.least_mm is None else f"{self.least_mm:.2f}"
        return (
            f"{self.body} {self.link} is {apart} mm from {self.part}, in pass {self.pass_index}, {self.phase}, at "
            f"{self.stamp_s:.2f} s"
        )


@schema
@dataclass(frozen=True)
class SceneReport:
    """The comparison of a motion with a scene.

    Attributes:
        limit_mm: The distance that must be kept: 1 mm, or the margin of the scene if that is larger.
        at_least_mm: Lower bound on the distance of both arms from the scene along the whole motion; null if none came
            within `seen_within_mm`.
        seen_within_mm: Greater distances are not distinguished.
        looks: Number of samples at which distances were computed.
        nearest: The least distance of each arm from each part within `seen_within_mm`, the least first.
        bodies: Whether the arms' outer bodies were compared too.
        needle_at_least_mm: Lower bound on the needle's distance from the tissue where it is judged, negative inside;
            null if there is no tissue, or it never came within `seen_within_mm`.
    """

    limit_mm: float
    at_least_mm: Figure
    seen_within_mm: float
    looks: Count
    nearest: tuple[NearestToScene, ...]
    bodies: bool
    needle_at_least_mm: Figure


@dataclass(frozen=True, eq=False)
class SceneClearance:
    """The report, and lower bounds on the distances from each sample until the next look, of both arms and the needle.

    Both are of shape (T,). The needle's is infinite where it is not judged.
    """

    report: SceneReport
    at_least_mm: Floats
    needle_mm: Floats


def clearance_of(trajectory: Trajectory, scene: Scene) -> SceneClearance:
    """Compare a motion with a scene.

    Args:
        trajectory: The motion of PSM_A, and of PSM_M if it moves.
        scene: The scene, in the frame of PSM_A's base.

    Returns:
        The distances.
    """
    at_least, looked = np.full(len(trajectory), np.inf), np.zeros(len(trajectory), bool)
    limit_mm = limit_of(scene)
    nearest: list[tuple[float, NearestToScene]] = []
    for arm, group in groups_of(trajectory):
        distances = partial(from_parts, group, scene, arm.name)
        looks, of_parts = _looked_at(distances, group.way_mm, group.look_mm, limit_mm)
        bounds = [_until_next(apart, group.way_mm[looks]) for apart in of_parts.values()]
        at_least[looks] = np.min([at_least[looks], *bounds], axis=0)
        looked[looks] = True
        nearest += [_nearest(trajectory, arm.name, group.names, part, looks, apart) for part, apart in of_parts.items()]
    needle, (way, ends) = np.full(len(trajectory), np.inf), _needle_way(trajectory)
    judged = ~clearance.by_psm_m(trajectory) if trajectory.psm_m is None else np.ones(len(trajectory), bool)
    distances = partial(needle_from_parts, trajectory, scene)
    looks, seen = _looked_at(distances, way, LOOK_MM, limit_mm, ends)
    for part, apart in seen.items():
        bound = _until_next(apart, way[looks])
        if part == TISSUE:
            needle[looks] = bound
        else:
            at_least[looks] = np.minimum(at_least[looks], np.where(judged[looks], bound, np.inf))
            apart = np.where(judged[looks, None], apart, np.inf)
        nearest.append(_nearest(trajectory, NEEDLE, (ARC,), part, looks, apart))
    needle[_by_hand(trajectory, needle)] = np.inf
    nearest.sort(key=lambda pair: float(np.nan_to_num(pair[0], nan=-np.inf)))
    least, least_needle = float(at_least.min()), float(needle.min())
    return SceneClearance(
        SceneReport(
            limit_mm=limit_mm,
            at_least_mm=None if least >= CLEARANCE_SEEN_MM else least,
            seen_within_mm=CLEARANCE_SEEN_MM,
            looks=int(np.count_nonzero(looked)),
            nearest=tuple(one for apart, one in nearest if not apart >= CLEARANCE_SEEN_MM),
            bodies=True,
            needle_at_least_mm=None if least_needle >= CLEARANCE_SEEN_MM else least_needle,
        ),
        at_least,
        needle,
    )


def limit_of(scene: Scene) -> float:
    """Return the distance, mm, that both arms must keep from a scene.

    Args:
        scene: The scene, whose margin counts if it is larger than `LEAST_MM`.
    """
    return max(LEAST_MM, scene.margin_mm)


@dataclass(frozen=True, eq=False)
class Group:
    """Capsules of an arm that are compared together: the tool, with each opening of its jaw, or the outer bodies.

    Attributes:
        names: Their names.
        radii_mm: Their radii, shape (L,).
        way_mm: Greatest distance that each can have moved since the first sample, shape (T, L).
        look_mm: The distances are computed at samples between which none moves further.
        axes: Return their axes at some samples, one or more times, each of shape (C, L, 3).
        above_tissue: Which of them are compared with tissue, shape (L,).
    """

    names: tuple[str, ...]
    radii_mm: Floats
    way_mm: Floats
    look_mm: float
    axes: Callable[[Ints], tuple[clearance.Links, ...]]
    above_tissue: Flags


def groups_of(trajectory: Trajectory) -> list[tuple[PlannedArm, Group]]:
    """Return each arm of a motion with its tool, and with its outer bodies.

    Args:
        trajectory: The motion of PSM_A, and of PSM_M if it moves.
    """
    return [(arm, group(arm)) for arm in trajectory.arms for group in (_tool, _bodies)]


def _tool(arm: PlannedArm) -> Group:
    """Return the capsules of an arm's tool."""
    steps = clearance.travel_mm(arm.joints, arm.instrument)
    if arm.name == PSM_A:
        steps[:, clearance.FINGERS] += clearance.FINGER_REACH_MM * np.abs(np.diff(clearance.openings(arm)))[:, None]
    return Group(LINKS, clearance.RADII_MM, way_mm(steps), LOOK_MM, partial(links_at, arm), np.ones(len(LINKS), bool))


def _bodies(arm: PlannedArm) -> Group:
    """Return the capsules of an arm's outer bodies, without its shaft and hand."""
    names = names_of(arm.instrument)[: -len(TOOL)]
    way = way_mm(moved_mm(arm.joints[:-1], arm.joints[1:], arm.instrument)[:, : len(names)])

    def axes(at: Ints) -> tuple[clearance.Links, ...]:
        """Return the axes of the bodies at some samples."""
        parts = placed(arm, arm.joints[at])
        return (clearance.Links(parts.begin_mm[:, : len(names)], parts.end_mm[:, : len(names)]),)

    radii, above = radii_of(arm.instrument)[: len(names)], np.isin(names, ABOVE_TISSUE)
    return Group(names, radii, way, LOOK_BODIES_MM, axes, above)


def links_at(arm: PlannedArm, at: Ints) -> tuple[clearance.Links, ...]:
    """Return an arm's links at some samples, in the frame of PSM_A's base; PSM_M's with each opening of its jaw.

    Args:
        arm: The motion of the arm.
        at: The samples, shape (C,).

    Returns:
        The links in C poses, once for PSM_A, and for each of `JAWS_RAD` for PSM_M.
    """
    jaws: list[ArrayLike] = [clearance.openings(arm)[at]] if arm.name == PSM_A else [*JAWS_RAD]
    return tuple(
        clearance.links_of(arm.joints[at], arm.instrument, jaw).seen_from(arm.base, arm.base_mm) for jaw in jaws
    )


def _looks(way_mm: Floats, look_mm: float) -> Ints:
    """Return the samples to look at: the first and the last, and as few as keep every way below `look_mm`.

    Where a single step is longer, both of its samples are looked at.
    """
    looks, last = [0], len(way_mm) - 1
    # Within any such number of samples every way ends beyond `look_mm`, so no more of them are compared at once.
    while looks[-1] < last:
        begin, reach = looks[-1], 64
        while True:
            beyond = ~((way_mm[begin + 1 : begin + reach + 1] - way_mm[begin]).max(axis=1) <= look_mm)
            if beyond.any() or begin + reach >= last:
                break
            reach *= 2
        looks.append(max(begin + int(np.argmax(beyond)), begin + 1) if beyond.any() else last)
    return np.array(looks)


def _looked_at(
    distances: Callable[[Ints], dict[str, Floats]],
    way_mm: Floats,
    look_mm: float,
    limit_mm: float,
    also: Ints | None = None,
) -> tuple[Ints, dict[str, Floats]]:
    """Return the samples to look at, (C,), and there the distances from each part of a scene, (C, L).

    The first ones are `COARSER` times as far apart as `look_mm`. Then those between two of them are added wherever a
    part could be nearer than the limit, or than it is anywhere else.

    Args:
        distances: Return the distances from each part at some samples.
        way_mm: Greatest distance that each of L things can have moved since the first sample, (T, L).
        look_mm: Where something is near, the samples are no further apart.
        limit_mm: The distance that must be kept.
        also: Samples to look at in any case.
    """
    looks = _looks(way_mm, COARSER * look_mm)
    looks = looks if also is None else np.unique(np.concatenate([looks, also]))
    of_parts = distances(looks)
    while of_parts:
        way = way_mm[looks]
        wide = (np.diff(looks) > 1) & ~(np.diff(way, axis=0).max(axis=1) <= look_mm)
        near = np.zeros_like(wide)
        for apart in of_parts.values():
            known = min(CLEARANCE_SEEN_MM, max(limit_mm, float(np.nan_to_num(apart, nan=-np.inf).min())))
            near |= wide & ~(_until_next(apart, way)[:-1] >= known)
        gaps = np.flatnonzero(near)
        if not len(gaps):
            break
        more = (looks[gaps] + looks[gaps + 1]) // 2
        at = np.searchsorted(looks, more)
        looks, new = np.insert(looks, at, more), distances(more)
        of_parts = {part: np.insert(apart, at, new[part], axis=0) for part, apart in of_parts.items()}
    return looks, of_parts


def _until_next(seen_mm: Floats, way_mm: Floats) -> Floats:
    """Return lower bounds on the distances, (C, L), from each look until the next, of their least, (C,)."""
    ahead = np.diff(way_mm, axis=0, append=way_mm[-1:])
    after = np.concatenate([seen_mm[1:], seen_mm[-1:]])
    return np.asarray(np.minimum(seen_mm, (seen_mm + after - ahead) / 2).min(axis=1))


def from_parts(group: Group, scene: Scene, body: str, at: Ints) -> dict[str, Floats]:
    """Return the distances of an arm's capsules from each part of a scene, by its name, at some samples.

    Args:
        group: The arm's L capsules.
        scene: The scene, in the frame of PSM_A's base; its margin is not taken off.
        body: `PSM_A` or `PSM_M`, which is not compared with the scene's capsules.
        at: The samples, shape (C,).

    Returns:
        Distances in mm, negative where they overlap, shape (C, L); the least of all openings of the jaw. Those from a
        height map are lower bounds; those of capsules that are not compared with tissue are infinite.
    """
    axes, found = group.axes(at), {}
    parts: list[tuple[str, Callable[[Floats, Floats], Floats]]] = []
    if scene.tissue is not None:
        within_mm = CLEARANCE_SEEN_MM + group.radii_mm.max()
        parts.append((TISSUE, partial(scene.tissue.from_lines_mm, within_mm=within_mm)))
    parts += [(f"box {k}", box.from_lines_mm) for k, box in enumerate(scene.boxes)]
    if body == PSM_A:
        parts += [(f"capsule {k}", capsule.from_lines_mm) for k, capsule in enumerate(scene.capsules)]
    for part, from_lines_mm in parts:
        some = group.above_tissue if part == TISSUE else np.ones(len(group.names), bool)
        apart = np.full((len(at), len(group.names)), np.inf)
        apart[:, some] = np.min([from_lines_mm(a.begin_mm[:, some], a.end_mm[:, some]) for a in axes], axis=0)
        found[part] = apart - group.radii_mm
    return found


def _needle_way(trajectory: Trajectory) -> tuple[Floats, Ints]:
    """Return how far the needle can have moved since the first sample, (T, 1), and both sides of changes of phase."""
    begins = np.flatnonzero(np.diff(trajectory.phase) | np.diff(trajectory.pass_index)) + 1
    return way_mm(clearance.needle_travel_mm(trajectory)[:, None]), np.concatenate([begins - 1, begins])


def needle_from_parts(trajectory: Trajectory, scene: Scene, at: Ints) -> dict[str, Floats]:
    """Return lower bounds on the distances of the needle from each part of a scene, by its name, at some samples.

    Args:
        trajectory: The motion.
        scene: The scene, in the frame of PSM_A's base; its margin is not taken off.
        at: The samples, shape (C,).

    Returns:
        Bounds in mm, negative inside, shape (C, 1); infinite from the scene's other arm while that holds the needle.
    """
    arc = clearance.needle_arc_mm(trajectory, at)
    begin, end = arc[:, :-1], arc[:, 1:]
    found, by_psm_m = {}, clearance.by_psm_m(trajectory)[at]
    if scene.tissue is not None:
        within_mm = CLEARANCE_SEEN_MM + clearance.NEEDLE_REACH_MM
        found[TISSUE] = scene.tissue.from_lines_mm(begin, end, within_mm=within_mm)
    found |= {f"box {k}": box.from_lines_mm(begin, end) for k, box in enumerate(scene.boxes)}
    for k, capsule in enumerate(scene.capsules):
        found[f"capsule {k}"] = np.where(by_psm_m[:, None], np.inf, capsule.from_lines_mm(begin, end))
    return {part: apart.min(axis=1)[:, None] - clearance.NEEDLE_REACH_MM for part, apart in found.items()}


def needle_from_arm(trajectory: Trajectory, limit_mm: float) -> Floats:
    """Return lower bounds on the needle's distance from the arm that does not hold it, until the next look, (T,).

    That arm's fingers do not count from A2 on, and where PSM_M waits with its jaws around the needle: they come to take
    it. Without PSM_M, and between two looks, the bound is infinite.

    Args:
        trajectory: The motion of PSM_A, and of PSM_M if it moves.
        limit_mm: The distance that must be kept.
    """
    apart, m = np.full(len(trajectory), np.inf), trajectory.psm_m
    if m is None:
        return apart
    taking = trajectory.last_samples[trajectory.pass_index]
    comes = (trajectory.phase != A1) | (np.abs(m.joints - m.joints[taking]) <= STANDS).all(axis=1)

    def distances(at: Ints) -> dict[str, Floats]:
        """Return the least distances at some samples, (C, 1)."""
        arc, by_psm_m = clearance.needle_arc_mm(trajectory, at), clearance.by_psm_m(trajectory)[at]
        found = np.full((len(at), 1), np.inf)
        for arm, other in zip(trajectory.arms, (by_psm_m, ~by_psm_m), strict=True):
            near = np.min([clearance.lines_apart(arc[other], one) for one in links_at(arm, at[other])], 0)
            near[comes[at[other]], clearance.FINGERS] = np.inf
            found[other, 0] = near.min(axis=1) - clearance.NEEDLE_REACH_MM
        return {NEEDLE: found}

    way, ends = _needle_way(trajectory)
    for arm in trajectory.arms:
        way = way + way_mm(clearance.travel_mm(arm.joints, arm.instrument).max(axis=1)[:, None])
    looks, seen = _looked_at(distances, way, LOOK_MM, limit_mm, ends)
    apart[looks] = _until_next(seen[NEEDLE], way[looks])
    return apart


def _by_hand(trajectory: Trajectory, needle_mm: Floats) -> Flags:
    """Mark the samples, (T,), at which the needle may be in tissue: see the head of this file."""
    may = clearance.by_psm_m(trajectory)
    for number in range(trajectory.passes):
        coming = np.flatnonzero((trajectory.pass_index == number) & (trajectory.phase != A2) & ~may)
        looked = needle_mm[coming]
        out = np.isnan(looked) | ((looked >= 0) & (looked < np.inf))  # NaN is judged
        may[coming[: int(np.argmax(out)) if out.any() else len(coming)]] = True
    return np.asarray(may)


def flat_tissue(trajectory: Trajectory, report: SceneReport, tissue: Tissue) -> tuple[float, Point]:
    """Return flat tissue, above which the estimate of success varies a motion: its height and its normal, of length 1.

    Of a height map it is as far below the lowest place of both tools, along the map's normal, as the map is from them.

    Args:
        trajectory: The motion of PSM_A, and of PSM_M if it moves.
        report: The comparison of that motion with the scene of the tissue.
        tissue: The tissue, in the frame of PSM_A's base.

    Returns:
        The height in mm along the normal, from the origin of PSM_A's base, and the normal. The height is NaN where a
        distance of a tool from the tissue is not known.
    """
    up = np.array(tissue.normal) / np.linalg.norm(tissue.normal)
    if tissue.flat:
        return float(up @ tissue.at_mm) + tissue.heights_mm[0][0], xyz(up)
    every = np.arange(len(trajectory))
    lowest = min(
        float((np.minimum(one.begin_mm @ up, one.end_mm @ up) - clearance.RADII_MM).min())
        for arm in trajectory.arms
        for one in links_at(arm, every)
    )
    apart = [one.least_mm for one in report.nearest if one.part == TISSUE and one.link in LINKS]
    least = np.min([nan if one is None else one for one in apart], initial=CLEARANCE_SEEN_MM)  # NaN stays NaN
    return lowest - float(least), xyz(up)


def _nearest(
    trajectory: Trajectory, body: str, names: tuple[str, ...], part: str, looks: Ints, apart_mm: Floats
) -> tuple[float, NearestToScene]:
    """Return the least distance of an arm or the needle from a part, NaN before all, and where it is."""
    look, link = np.unravel_index(int(np.nan_to_num(apart_mm, nan=-np.inf).argmin()), apart_mm.shape)
    sample, least = int(looks[look]), float(apart_mm[look, link])
    tip = (
        clearance.psm_m_poses(trajectory, looks[look : look + 1])[0][0] if body == PSM_M else trajectory.tip_mm[sample]
    )
    moment = vars(trajectory.moment(sample))
    return least, NearestToScene(body=body, link=names[link], part=part, least_mm=least, tip_mm=xyz(tip), **moment)
