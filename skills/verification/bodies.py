"""The arms' outer bodies: what of two arms may run into each other outside of the patient, in closed form.

    joints --parts_of--> Links: the axes of every body of an arm
    two of them --between--> mm per pair
    Trajectory --bodies_clearance--> BodiesReport, and the least distance at every sample
    two arms as planned, variations --too_near--> which variations are

Each body is enclosed by a capsule: the points within a radius of a straight axis, with distances at a microsecond per
pose and arm. Where two capsules are near, a body with a published mesh counts as the smaller outline of that
(`skills.verification.hulls`): of two lower bounds the greater one is taken. Beside the bodies of the arm stand its
shaft and its *hand*: wrist and fingers, whatever their opening. Two tools alone are compared with each other by the
simulator and by `skills.verification.clearance`.

A remote-centre arm is a chain of few parts. Its *base* stands still. The *yaw link* turns about the base's y axis, by
-yaw. The parallelogram turns within the yaw link: its levers, and the insertion axis parallel to them, by -pitch about
the x axis; the bars between them keep their direction. The *carriage* slides with the insertion. So an end of an axis
is

    Y(yaw) (at + X(pitch) (turning - insertion * up))        or just `at`, on the base

and between two poses it moves no further than its greatest distances from both axes times the turns, plus the slide.

**Sources, in mm.** Axes: the joints' origins in the URDF of jhu-dvrk/dvrk_model, urdf/Classic/PSM_base.urdf.xacro and
urdf/Si/PSM_base.urdf.xacro, from which the frames below are computed; remote centre and insertion as in
`skills.kinematics`. Capsules with an outline are the smallest around it; those of the Classic's levers and the Si's
cannula are around the meshes, with `OUTLINE_MM` to spare. Setup joint's end and arm, the Si's carriage, the Classic's
cannula and mount have no mesh there: ours, generous. Nothing is known of cables and drapes beyond `MARGIN_MM`: a
laboratory with more adds it to the distance between the bases. `tests/verification/test_meshes.py` compares all bodies
with the meshes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import hypot
from typing import Any

import numpy as np

from skills.arrays import Flags, Floats, Ints
from skills.fields import Count, Figure, schema
from skills.gridworld.scene import segments_apart
from skills.kinematics import CLASSIC, INSERTION, SI, WRIST_MM, axes_of, instrument_of
from skills.planning.trajectory import PSM_A, PSM_M, PlannedArm, SampleMoment, Trajectory
from skills.verification.clearance import FINGER_REACH_MM, SHAFT_RADIUS_MM, Links, way_mm
from skills.verification.error_draws import Displaced
from skills.verification.hulls import CLASSIC_OUTLINES, MARGIN_MM, OUTLINE_MM, SI_OUTLINES, hulls_apart
from skills.verification.playback import CLEARANCE_SEEN_MM

LOOK_MM = 10.0  # ours: distances are computed at samples between which no two bodies approach by more
_CHUNK = 2000  # poses computed at once
Row = tuple[float, float, float]
STILL: Row = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ArmCapsule:
    """One capsule of an arm, at zero joints: x to the side, y away from the base, z up, from the remote centre, in mm.

    Attributes:
        name: Its name.
        radius_mm: Its radius.
        begin_mm: Beginning of its axis in the yaw link.
        end_mm: End of its axis there.
        turning_mm: What is added to the beginning, turning with the pitch.
        end_turning_mm: What is added to the end, turning with the pitch.
        yaws: Whether it turns with the yaw; otherwise it stands still.
        slides: Whether it moves down with the insertion.

    One whose ends turn alike is carried along without turning, unless it begins in the remote centre; another turns
    about its beginning in the yaw link.
    """

    name: str
    radius_mm: float
    begin_mm: Row = STILL
    end_mm: Row = STILL
    turning_mm: Row = STILL
    end_turning_mm: Row = STILL
    yaws: bool = True
    slides: bool = False


BODIES: Mapping[str, tuple[ArmCapsule, ...]] = {
    CLASSIC.name: (
        ArmCapsule("setup joint end", 90.0, (0, -910, -49.8), (0, -800, -49.8), yaws=False),
        ArmCapsule("base", 102.0, (0, -709, -144), (0, -726, -2), yaws=False),
        ArmCapsule("base plate", 72.0, (-40, -628, -131), (43, -629, -128), yaws=False),
        ArmCapsule("base front", 68.0, (0, -531, -178), (0, -363, -45), yaws=False),
        ArmCapsule("yaw link", 114.0, (1, -612, -39), (0, -446, -34)),
        ArmCapsule("back lever", 20.0, (-29.5, -518.5, 0), (-29.5, -518.5, 0), (-6.5, -4.5, 0), (-5.5, -45.5, 188)),
        ArmCapsule("front lever", 22.0, (-29.5, -428.5, 0), (-29.5, -428.5, 0), (0.5, 0.5, -1), (0.5, -41.5, 151)),
        ArmCapsule("rear bar", 42.0, (2, -194.2, 17.9), (2, -512.2, 19.9), (0, -41.8, 150.1), (0, -41.8, 150.1)),
        ArmCapsule("lower bar", 55.0, (2, -152.2, 0.9), (2, 0.8, 0.9), (0, -41.8, 150.1), (0, -41.8, 150.1)),
        ArmCapsule("upper bar", 17.0, (3, -527.9, 0), (3, -205.9, 0), (0, -42.1, 187), (0, -42.1, 187)),
        ArmCapsule("upper plate", 52.0, (3, -2.9, -1), (3, -164.9, -1), (0, -42.1, 187), (0, -42.1, 187)),
        ArmCapsule("insertion axis", 50.0, turning_mm=(3, -41, 142), end_turning_mm=(4, -46, 552)),
        ArmCapsule("carriage", 43.0, turning_mm=(0, -5, 354), end_turning_mm=(0, -8, 426), slides=True),
        ArmCapsule("cannula mount", 51.0, turning_mm=(0, -17, 98), end_turning_mm=(3, -41, 134)),
        ArmCapsule("cannula", 12.0, turning_mm=(0, 0, 90), end_turning_mm=(0, 0, -10)),
    ),
    SI.name: (
        ArmCapsule("setup joint end", 90.0, (0, -1090, 0), (0, -1000, 0), yaws=False),
        ArmCapsule("setup joint arm", 79.0, (0, -1001, 0), (0, -843, 0), yaws=False),
        ArmCapsule("base", 70.0, (0, -703, 0), (0, -843, -1), yaws=False),
        ArmCapsule("yaw link", 60.0, (-116, -630, 0), (-2, -658, 0)),
        ArmCapsule("yaw arm", 61.0, (-109, -568, 0), (-98, -386, -71)),
        ArmCapsule("lever", 108.0, (0, -386.5, -71.2), (0, -386.5, -71.2), (-3, -30.5, -5.8), (0, -120.5, 125.2)),
        ArmCapsule("rear bar", 55.0, (0, -321.4, 78.2), (0, -385.4, -71.8), (0, -114.6, 167.8), (0, -114.6, 167.8)),
        ArmCapsule("bars", 65.0, (0, -13.4, 1.2), (0, -310.4, 63.2), (0, -114.6, 167.8), (0, -114.6, 167.8)),
        ArmCapsule("insertion axis", 47.0, turning_mm=(0, -94, 147), end_turning_mm=(0, -77, 563)),
        ArmCapsule("carriage", 55.0, turning_mm=(0, -18.5, 532.6), end_turning_mm=(0, -18.5, 372.6), slides=True),
        ArmCapsule("cannula mount", 52.0, turning_mm=(-1, -37, 92), end_turning_mm=(0, -77, 116)),
        ArmCapsule("cannula", 18.0, turning_mm=(0, -8, 69), end_turning_mm=(0, -8, -5)),
    ),
}
OUTLINES = {CLASSIC.name: CLASSIC_OUTLINES, SI.name: SI_OUTLINES}
TOOL = ("shaft", "hand")  # of every arm, after its bodies
# Parts over the tissue. The others hang beside the table: tissue is a plane without an edge, and they may be below it.
ABOVE_TISSUE = ("insertion axis", "carriage", "cannula mount", "cannula")


def names_of(instrument: str) -> tuple[str, ...]:
    """Return the names of an arm's parts: its bodies, then its shaft and hand.

    Args:
        instrument: Number of the instrument.
    """
    return _names(instrument_of(instrument).arm.name)


def _names(arm: str) -> tuple[str, ...]:
    return tuple(body.name for body in BODIES[arm]) + TOOL


def radii_of(instrument: str) -> Floats:
    """Return the radii of an arm's parts in mm, shape (B,).

    Args:
        instrument: Number of the instrument.

    Returns:
        The radii, in the order of `names_of`.
    """
    return np.array([body.radius_mm for body in _of(instrument)] + [SHAFT_RADIUS_MM, FINGER_REACH_MM])


def _of(instrument: str) -> tuple[ArmCapsule, ...]:
    """Return the outer bodies of the arm that an instrument is on."""
    return BODIES[instrument_of(instrument).arm.name]


@dataclass(frozen=True, eq=False)
class _Moving:
    """What moves of the B bodies of an arm: places (B, K, 3) in the yaw link, and (B, K, 3) turning with the pitch."""

    at_mm: Floats
    turning_mm: Floats
    yaws: Flags
    slides: Flags

    def of(self, parts: Ints | slice, joints: Floats) -> Floats:
        """Return points of parts in an arm's base frame, (T, B, K, 3), or (T, K, 3) with one part for each row.

        Args:
            parts: A slice, for all of these in each pose; or a part for each pose, shape (T,).
            joints: The joints, shape (T, 6).
        """
        each = (slice(None), None) if isinstance(parts, slice) else (slice(None),)
        yaw, pitch, slid = (joints[:, k][(*each, None)] for k in range(3))
        fixed, swung = self.at_mm[parts], self.turning_mm[parts]
        yaws, slides = self.yaws[parts, None], self.slides[parts, None]
        (s1, s2), (c1, c2) = ((f(yaw), f(pitch)) for f in (np.sin, np.cos))
        up = swung[..., 2] - np.where(slides, slid, 0.0)
        y = fixed[..., 1] + c2 * swung[..., 1] + s2 * up
        z = fixed[..., 2] - s2 * swung[..., 1] + c2 * up
        x = fixed[..., 0] + swung[..., 0] + np.zeros_like(y)
        turned = np.stack([c1 * x - s1 * z, y, s1 * x + c1 * z], axis=-1)
        return np.where(yaws[..., None], turned, np.broadcast_to(fixed, turned.shape))


@cache
def _ends_of(arm: str) -> _Moving:
    """Return both ends of the axes of an arm's bodies."""
    names = (("begin_mm", "end_mm"), ("turning_mm", "end_turning_mm"), ("yaws",), ("slides",))
    ends = [np.array([[getattr(body, name) for name in some] for body in BODIES[arm]]) for some in names]
    return _Moving(ends[0].astype(float), ends[1].astype(float), ends[2][:, 0], ends[3][:, 0])


@cache
def _outlines_of(arm: str) -> tuple[_Moving, Flags]:
    """Return the corners of the outlines of an arm's bodies, and which bodies have one."""
    ends, found = _ends_of(arm), OUTLINES[arm]
    longest = max(len(corners) for corners in found.values())
    at, turning = (np.zeros((len(BODIES[arm]), longest, 3)) for _ in range(2))
    for number, body in enumerate(BODIES[arm]):
        if body.name in found:
            corners = found[body.name][np.arange(longest) % len(found[body.name])]
            hinged = body.turning_mm != body.end_turning_mm
            at[number] = ends.at_mm[number, 0] if hinged else corners - ends.turning_mm[number, 0]
            turning[number] = corners - at[number]
    return _Moving(at, turning, ends.yaws, ends.slides), np.array([one in found for one in _names(arm)])


@dataclass(frozen=True, eq=False)
class Parts(Links):
    """The axes of an arm's parts in T poses, with what is needed for the corners of their outlines.

    Attributes:
        joints: The joints, shape (T, 6).
        instrument: Number of the instrument.
        base: Rotation of the arm's base in the frame of the axes, shape (3, 3).
        base_mm: Position of its remote centre there, shape (3,).
    """

    joints: Floats
    instrument: str
    base: Floats
    base_mm: Floats

    def seen_from(self, base: Floats, base_mm: Floats) -> "Parts":
        """Return the parts in a frame where their own frame is at `base_mm`, shape (3,), turned by `base`, (3, 3)."""
        links = super().seen_from(base, base_mm)
        whole = base @ self.base, self.base_mm @ base.T + base_mm
        return Parts(links.begin_mm, links.end_mm, self.joints, self.instrument, *whole)

    def corners(self, rows: Ints, parts: Ints) -> tuple[Floats, Floats]:
        """Return corners of N parts, (N, K, 3): of the outline, or the ends of the axis; and their radii, (N,)."""
        moving, known = _outlines_of(instrument_of(self.instrument).arm.name)
        ends = np.stack([self.begin_mm[rows, parts], self.end_mm[rows, parts]], axis=1)
        corners = ends[:, np.arange(moving.at_mm.shape[1]) % 2]
        has = known[parts]
        corners[has] = moving.of(parts[has], self.joints[rows[has]]) @ self.base.T + self.base_mm
        return corners, np.where(has, OUTLINE_MM, radii_of(self.instrument)[parts])


def parts_of(joints: Floats, instrument: str) -> Parts:
    """Return the parts of an arm with these joints, in its base frame.

    Args:
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6). Limits are not checked; NaN stays NaN.
        instrument: Number of the instrument.
    """
    tool = instrument_of(instrument)
    ends = _ends_of(tool.arm.name).of(slice(None), joints)
    shaft, hand, _ = axes_of(joints)
    wrist = (joints[:, INSERTION, None] - tool.wrist_offset_mm) * shaft
    begin = np.concatenate([ends[:, :, 0], np.stack([wrist - tool.shaft_mm * shaft, wrist], axis=1)], axis=1)
    end = np.concatenate([ends[:, :, 1], np.stack([wrist, wrist + WRIST_MM * hand], axis=1)], axis=1)
    return Parts(begin, end, joints, instrument, np.eye(3), np.zeros(3))


def placed(arm: PlannedArm, joints: Floats) -> Parts:
    """Return the parts of an arm of a trajectory with these joints, in PSM_A's base frame.

    Args:
        arm: The arm, for its instrument and its base.
        joints: As for `parts_of`.
    """
    return parts_of(joints, arm.instrument).seen_from(arm.base, arm.base_mm)


def moved_mm(joints: Floats, to: Floats, instrument: str) -> Floats:
    """Return upper bounds on the distance that any point of each part moves between two poses.

    Args:
        joints: The first poses, shape (..., 6).
        to: The second poses, shape (..., 6).
        instrument: Number of the instrument.

    Returns:
        Millimetres, shape (..., B).
    """
    bodies, tool = _of(instrument), instrument_of(instrument)
    turns = np.abs(to - joints)
    reach = np.array([_reach(body, tool.arm.upper[INSERTION]) for body in bodies])
    outer = turns[..., :3] @ reach.T
    wrist = np.maximum(np.abs(joints[..., INSERTION]), np.abs(to[..., INSERTION])) + abs(tool.wrist_offset_mm)
    swung, slid, bent = turns[..., 0] + turns[..., 1], turns[..., INSERTION], turns[..., 3] + turns[..., 4]
    shaft = swung * (np.maximum(wrist, tool.shaft_mm + abs(tool.wrist_offset_mm)) + SHAFT_RADIUS_MM) + slid
    reach_of_hand = WRIST_MM + FINGER_REACH_MM
    hand = swung * (wrist + reach_of_hand) + slid + bent * reach_of_hand
    return np.concatenate([outer, shaft[..., None], hand[..., None]], axis=-1)


def _reach(body: ArmCapsule, insertion_mm: float) -> Row:
    """Return the greatest movement of a body's points for one radian of yaw and of pitch, and for 1 mm of insertion."""
    if not body.yaws:
        return STILL
    slide, pairs = insertion_mm * body.slides, ((body.begin_mm, body.turning_mm), (body.end_mm, body.end_turning_mm))
    swung = max(hypot(turning[1], abs(turning[2]) + slide) for _, turning in pairs)
    wide = max(hypot(at[0] + turning[0], at[2]) for at, turning in pairs) + swung + body.radius_mm
    parallel = body.turning_mm == body.end_turning_mm  # a bar keeps its direction, so its surface turns no further
    return wide, 0.0 if swung == 0 else swung + (0.0 if parallel else body.radius_mm), float(body.slides)


def between(arm: Parts, other: Parts, within_mm: float = LOOK_MM) -> Floats:
    """Return lower bounds on the distances of all parts of one arm from all of another in as many poses, in one frame.

    They are those of the capsules, or below `within_mm` those of the outlines if they are greater.

    Args:
        arm: The parts of one arm, B in T poses.
        other: The parts of the other arm, C in T poses, in the same frame.
        within_mm: Where capsules are further apart, nothing else is computed.

    Returns:
        Distances in mm, negative where they overlap, shape (T, B, C); infinite between the two tools.
    """
    apart = segments_apart(
        arm.begin_mm[:, :, None],
        (arm.end_mm - arm.begin_mm)[:, :, None],
        other.begin_mm[:, None],
        (other.end_mm - other.begin_mm)[:, None],
    )
    apart -= radii_of(arm.instrument)[:, None] + radii_of(other.instrument)
    apart[:, -len(TOOL) :, -len(TOOL) :] = np.inf
    row, part, its = np.nonzero(apart < within_mm)
    for some in np.array_split(np.arange(len(row)), 1 + len(row) // _CHUNK):
        at = row[some], part[some], its[some]
        apart[at] = np.maximum(apart[at], _outlines_apart(arm.corners(*at[:2]), other.corners(at[0], at[2]), within_mm))
    return apart


def _outlines_apart(corners: tuple[Floats, Floats], others: tuple[Floats, Floats], within_mm: float) -> Floats:
    """Return lower bounds on the distances of N parts from N others, both with their corners and radii, as `Parts`."""
    radii = corners[1] + others[1]
    return hulls_apart(corners[0], others[0], within_mm + float(radii.max(initial=0.0))) - radii


# ---- along a motion ------------------------------------------------------------------------------------------------


@schema
@dataclass(frozen=True, kw_only=True)
class NearestBodies(SampleMoment):
    """The least distance between a part of PSM_A and one of PSM_M, and the sample of it.

    Attributes:
        part: The part of PSM_A.
        other: The part of PSM_M.
        least_mm: The distance; negative where they overlap.
    """

    part: str
    other: str
    least_mm: Figure

    def __str__(self) -> str:
        """Return the names of both."""
        return f"{PSM_A}'s {self.part} and {PSM_M}'s {self.other}"


@schema
@dataclass(frozen=True)
class BodiesReport:
    """The comparison of the arms' outer bodies.

    Attributes:
        arms: The arms in the scene, such as "PSM Classic"; one alone is compared with nothing.
        limit_mm: The distance that must be kept.
        at_least_mm: Lower bound on the distance along the whole motion; null if there is one arm.
        seen_within_mm: Pairs that are further apart throughout are not listed.
        looks: Number of samples at which distances were computed.
        nearest: The least distance of each pair of parts, the least first.
        margin_mm: What the bodies are larger than the manufacturer's meshes, at least.
        compared_with_meshes: Whether they were compared with those.
    """

    arms: tuple[str, ...]
    limit_mm: float
    at_least_mm: Figure
    seen_within_mm: float
    looks: Count
    nearest: tuple[NearestBodies, ...]
    margin_mm: float = MARGIN_MM
    compared_with_meshes: bool = True


@dataclass(frozen=True, eq=False)
class BodiesClearance:
    """The report; the lower bound from each sample until the next look, (T,); and the first pair that is too near."""

    report: BodiesReport
    at_least_mm: Floats
    first: NearestBodies | None


def bodies_clearance(trajectory: Trajectory, limit_mm: float) -> BodiesClearance:
    """Compare the outer bodies of two arms along a motion, including the times at which one of them waits.

    Args:
        trajectory: The motion of PSM_A, and of PSM_M if it is in the scene.
        limit_mm: The distance that must be kept.

    Returns:
        The distances. From one look to the next none is less than the mean of both minus half of the greatest approach,
        so nothing is missed between them; where that falls below the limit, all samples are looked at, up to the first
        at which it is broken.
    """
    arms, count = trajectory.arms, len(trajectory)
    names = tuple(instrument_of(arm.instrument).arm.name for arm in arms)
    if len(arms) == 1:
        alone = BodiesReport(names, limit_mm, None, CLEARANCE_SEEN_MM, 0, ())
        return BodiesClearance(alone, np.full(count, np.inf), None)
    ways = [way_mm(moved_mm(arm.joints[:-1], arm.joints[1:], arm.instrument)) for arm in arms]
    looks = _looks(ways)
    within_mm = limit_mm + LOOK_MM
    seen = distances_at(trajectory, looks, within_mm)
    while True:
        bound = _until_next(seen, [way[looks] for way in ways])
        # Up to the first look that is too near, every gap in which the bound is broken is halved.
        near = ~(seen.min(axis=(1, 2)) >= limit_mm)
        upto = int(np.argmax(near)) if near.any() else len(looks)
        gaps = np.flatnonzero(~(bound >= limit_mm)[:-1] & (np.diff(looks) > 1))
        gaps = gaps[gaps < upto]
        if not len(gaps):
            break
        more = (looks[gaps] + looks[gaps + 1]) // 2
        at = np.searchsorted(looks, more)
        looks, seen = np.insert(looks, at, more), np.insert(seen, at, distances_at(trajectory, more, within_mm), axis=0)
    at_least = np.full(count, np.inf)
    at_least[looks] = bound
    broken = ~(bound >= limit_mm)
    first = None
    if broken.any():
        look = int(np.argmax(broken))
        here = seen[look] if not seen[look].min() >= limit_mm else np.minimum(seen[look], seen[look + 1])
        first = _nearest(trajectory, looks[look], here)
    report = BodiesReport(
        arms=names,
        limit_mm=limit_mm,
        at_least_mm=float(bound.min()),
        seen_within_mm=CLEARANCE_SEEN_MM,
        looks=len(looks),
        nearest=_all_nearest(trajectory, looks, seen),
    )
    return BodiesClearance(report, at_least, first)


def _looks(ways: list[Floats]) -> Ints:
    """Return the samples to look at first: the first, the last, and some that no two parts approach by `LOOK_MM`."""
    gone = np.sum([np.append(0.0, np.cumsum(np.diff(way, axis=0).max(axis=1))) for way in ways], axis=0)
    steps = np.floor(np.nan_to_num(gone) / LOOK_MM)
    return np.unique(np.concatenate([[0], np.flatnonzero(np.diff(steps) > 0), [len(gone) - 1]]))


def distances_at(trajectory: Trajectory, at: Ints, within_mm: float = LOOK_MM) -> Floats:
    """Return the distances of all parts of one arm from all of the other at some samples.

    Args:
        trajectory: A motion of both arms.
        at: The samples, shape (C,).
        within_mm: As for `between`.

    Returns:
        Distances in mm, as of `between`, shape (C, B, B').
    """
    arms, found = trajectory.arms, []
    for some in np.array_split(at, 1 + len(at) // _CHUNK):
        arm, other = (placed(one, one.joints[some]) for one in arms)
        found.append(between(arm, other, within_mm))
    return np.concatenate(found)


def _until_next(seen: Floats, ways: list[Floats]) -> Floats:
    """Return lower bounds on the distances from each look until the next, (C,)."""
    ahead = np.diff(ways[0], axis=0)[:, :, None] + np.diff(ways[1], axis=0)[:, None]
    gaps = np.minimum(seen[:-1], (seen[:-1] + seen[1:] - ahead) / 2).min(axis=(1, 2))
    return np.asarray(np.append(gaps, seen[-1].min()))


def _nearest(trajectory: Trajectory, sample: int, apart: Floats) -> NearestBodies:
    """Return the pair with the least of some distances, (B, B'); NaN is the least of all."""
    part, other = np.unravel_index(int(np.nan_to_num(apart, nan=-np.inf).argmin()), apart.shape)
    return _named(trajectory, sample, int(part), int(other), float(apart[part, other]))


def _named(trajectory: Trajectory, sample: int, part: int, other: int, least_mm: float) -> NearestBodies:
    names = [names_of(arm.instrument) for arm in trajectory.arms]
    moment = vars(trajectory.moment(sample))
    return NearestBodies(part=names[0][part], other=names[1][other], least_mm=least_mm, **moment)


def _all_nearest(trajectory: Trajectory, looks: Ints, seen: Floats) -> tuple[NearestBodies, ...]:
    """Return the least distance of each pair of parts that came within `CLEARANCE_SEEN_MM`, the least first."""
    known = np.nan_to_num(seen, nan=-np.inf, posinf=np.inf, neginf=-np.inf)
    least, at = known.min(axis=0), known.argmin(axis=0)
    pairs = [(int(i), int(j)) for i, j in np.argwhere(least < CLEARANCE_SEEN_MM)]
    pairs.sort(key=lambda pair: float(least[pair]))
    return tuple(_named(trajectory, int(looks[at[i, j]]), i, j, float(seen[at[i, j], i, j])) for i, j in pairs)


# ---- in many inexact worlds ----------------------------------------------------------------------------------------


def too_near(
    arms: Sequence[PlannedArm],
    joints: list[Floats],
    displaced: Sequence[Displaced],
    limit_mm: float,
    wanted: Flags,
) -> Flags:
    """Return in which variations of a pass outer bodies come nearer to each other than a limit; NaN is too near.

    Only pairs that the planned distance and the greatest possible movement leave in doubt are computed. The jaws'
    rotation about their hinge is left out: at 3 degrees it moves a hand's end by half a millimetre.

    Args:
        arms: Both arms as planned in S samples.
        joints: Their joints in N variations, each of shape (N * S, 6), the samples of a variation together.
        displaced: The E displacements of the arms in the N variations.
        limit_mm: The distance that must be kept.
        wanted: The variations to judge, shape (E, N); the others are not too near.

    Returns:
        Flags of shape (E, N).
    """
    samples, count = len(arms[0].joints), wanted.shape[1]
    radii, centre = [radii_of(arm.instrument) for arm in arms], arms[1].base_mm
    planned = [placed(arm, arm.joints) for arm in arms]
    apart = between(planned[0], planned[1], limit_mm)
    shapes = [one.reshape(count, samples, 6) for one in joints]
    moves = [moved_mm(arm.joints, q, arm.instrument) for arm, q in zip(arms, shapes, strict=True)]
    way = moves[0][..., :, None] + moves[1][..., None, :]
    ends = np.stack([planned[1].begin_mm, planned[1].end_mm])
    lever = (np.linalg.norm(ends - centre, axis=3).max(axis=0) + moves[1]).max(axis=2)  # from PSM_M's remote centre
    least, most = (apart - way).min(axis=(2, 3)), (apart + way).min(axis=(2, 3))
    wrong = np.zeros((len(displaced), count), dtype=bool)
    for number, errors in enumerate(displaced):
        offset = np.linalg.norm(errors.tip_mm[0] - errors.tip_mm[1], axis=2)
        offset = offset + np.linalg.norm(errors.base_mm, axis=1)[:, None] + errors.base_rad[:, None] * lever
        surely = (most + offset < limit_mm).any(axis=1) & wanted[number]
        wrong[number] = surely
        # negated, so that NaN is in doubt
        variations, at = np.nonzero(~(least - offset >= limit_mm) & (wanted[number] & ~surely)[:, None])
        doubtful = ~(apart[at] - way[variations, at] - offset[variations, at, None, None] >= limit_mm)
        which, part, other = np.nonzero(doubtful)
        if len(which):
            variation, sample = variations[which], at[which]
            used, row = np.unique(variation * samples + sample, return_inverse=True)
            two = [placed(arm, q[used]) for arm, q in zip(arms, joints, strict=True)]
            aside = (
                errors.base_mm[variation] + errors.tip_mm[1, variation, sample] - errors.tip_mm[0, variation, sample]
            )

            def moved(
                q: Floats, some: Any = ..., aside: Floats = aside, turn: Floats = errors.base_turn[variation]
            ) -> Floats:
                """Return points of PSM_M, (N, K, 3), as it is displaced from PSM_A in its variation."""
                return np.asarray(np.einsum("kij,klj->kli", turn[some], q - centre) + centre + aside[some][:, None])

            p, u = two[0].begin_mm[row, part], two[0].end_mm[row, part]
            q, v = np.moveaxis(moved(np.stack([two[1].begin_mm[row, other], two[1].end_mm[row, other]], axis=1)), 1, 0)
            found = segments_apart(p, u - p, q, v - q) - radii[0][part] - radii[1][other]
            close = np.flatnonzero(found < limit_mm)
            mine, (others, theirs) = (
                one.corners(row[close], number[close]) for one, number in zip(two, (part, other), strict=True)
            )
            found[close] = np.maximum(found[close], _outlines_apart(mine, (moved(others, close), theirs), limit_mm))
            wrong[number] |= np.bincount(variation[~(found >= limit_mm)], minlength=count) > 0
    return wrong
