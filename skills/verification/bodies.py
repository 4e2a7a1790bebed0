"""The arms' outer bodies: what of two arms may run into each other outside of the patient, in closed form.

    joints --parts_of--> Links: the axes of every body of an arm
    two of them --between--> mm per pair
    Trajectory --bodies_clearance--> BodiesReport, and the least distance at every sample
    two arms as planned, variations --too_near--> which variations are

Each body is a capsule: the points within a radius of a straight axis, so distances are exact and cost a microsecond per
pose and arm. A link with a flat or an angular section is enclosed by the circle around it. Beside the bodies of the arm
stand its shaft and its *hand*: wrist and fingers, whatever their opening. Two tools alone are compared with each other
by the simulator and by `skills.verification.clearance`.

A remote-centre arm is a chain of few parts. Its *base* stands still. The *yaw link* turns about the base's y axis, by
-yaw. The parallelogram turns within the yaw link: its levers, and the insertion axis parallel to them, by -pitch about
the x axis; the bars between them keep their direction. The *carriage* slides with the insertion. So an end of an axis
is

    Y(yaw) (at + X(pitch) (turning - insertion * up))        or just `at`, on the base

and between two poses it moves no further than its greatest distances from both axes times the turns, plus the slide.

**Sources, in mm.** Axes: the joints' origins in the URDF of jhu-dvrk/dvrk_model, urdf/Classic/PSM_base.urdf.xacro,
urdf/Classic/SUJ.urdf.xacro and urdf/Si/PSM_base.urdf.xacro, from which the frames below are computed; remote centre and
insertion as in `skills.kinematics`. Middles of the Classic's base, yaw link and insertion axis: the inertial offsets in
WPI-AIM/ambf, blender-psm.yaml (572, 529 and 29 behind the remote centre; 43 and 61 below and 251 above it). Radii of
the Si: half of the diagonal of the box that has the link's published moments of inertia, and `MARGIN_MM`. Radii of the
Classic, and how far its base and yaw link reach: ours. The yaw link's radius is such that two arms whose axes are
parallel, one turned by 35 degrees, are free at a distance of 261 and not at 241 (measured once on the manufacturer's
bodies: free by 11 there, and overlapping). Setup joint's end, carriage, cannula and its mount: ours, generous. **None
of them was compared with the manufacturer's meshes**: an arm may stand out of its bodies where neither a joint nor a
moment of inertia shows it, such as with cables and drapes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import hypot

import numpy as np

from skills.arrays import Flags, Floats, Ints
from skills.fields import Count, Figure, schema
from skills.gridworld.scene import segments_apart
from skills.kinematics import CLASSIC, INSERTION, SI, WRIST_MM, axes_of, instrument_of
from skills.planning.trajectory import PSM_A, PSM_M, PlannedArm, SampleMoment, Trajectory
from skills.verification.clearance import FINGER_REACH_MM, SHAFT_RADIUS_MM, Links, way_mm
from skills.verification.error_draws import Displaced
from skills.verification.playback import CLEARANCE_SEEN_MM

MARGIN_MM = 10.0  # ours: what each radius below is larger than the outline that it stands for, where one is known
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
    """

    name: str
    radius_mm: float
    begin_mm: Row = STILL
    end_mm: Row = STILL
    turning_mm: Row = STILL
    end_turning_mm: Row = STILL
    yaws: bool = True
    slides: bool = False


def _tool_side(adaptor_mm: float, behind_mm: float) -> tuple[ArmCapsule, ...]:
    """Return what is alike on both arms; the column is `behind_mm` behind the tool."""
    return (
        ArmCapsule(
            "carriage",
            55.0,
            turning_mm=(0, behind_mm / 4, adaptor_mm + 50),
            end_turning_mm=(0, behind_mm / 4, adaptor_mm - 110),
            slides=True,
        ),
        ArmCapsule("cannula mount", 30.0, turning_mm=(0, behind_mm, 70), end_turning_mm=(0, 0, 70)),
        ArmCapsule("cannula", 12.0, turning_mm=(0, 0, 90), end_turning_mm=(0, 0, -10)),
    )


BODIES: Mapping[str, tuple[ArmCapsule, ...]] = {
    CLASSIC.name: (
        ArmCapsule("setup joint end", 90.0, (0, -910, -49.8), (0, -800, -49.8), yaws=False),
        ArmCapsule("base", 85.0, (0, -780, -43), (0, -400, -43), yaws=False),
        ArmCapsule("yaw link", 112.0, (0, -750, -60.7), (0, -400, -60.7)),
        ArmCapsule("back lever", 50.0, (-29.5, -518.5, 0), (-29.5, -518.5, 0), end_turning_mm=(24.1, -42.1, 187)),
        ArmCapsule("front lever", 50.0, (-29.5, -428.5, 0), (-29.5, -428.5, 0), end_turning_mm=(24.1, -42.1, 187)),
        ArmCapsule("bars", 60.0, (-10, -518.5, 0), (-10, 1.5, 0), (0, -41.9, 168.5), (0, -41.9, 168.5)),
        ArmCapsule("insertion axis", 60.0, turning_mm=(0, -40, 10), end_turning_mm=(0, -40, 500)),
        *_tool_side(CLASSIC.remote_centre_mm, -40),
    ),
    SI.name: (
        ArmCapsule("setup joint end", 90.0, (0, -1090, 0), (0, -1000, 0), yaws=False),
        ArmCapsule("base", 79.0, (0, -1001, 0), (0, -760, 0), yaws=False),
        ArmCapsule("yaw link", 81.0, (-51.7, -712.8, 21.2), (-129.1, -365.3, -71.1)),
        ArmCapsule("lever", 107.0, (0, -386.5, -71.2), (0, -386.5, -71.2), (0, -3.4, -47), (0, -138.4, 154)),
        ArmCapsule("bars", 93.0, (0, -438.1, 7), (0, -46.2, 49.3), (0, -115.2, 171.6), (0, -115.2, 171.6)),
        ArmCapsule("insertion axis", 49.0, turning_mm=(0, -66.7, 37.3), end_turning_mm=(0, -81.3, 578.9)),
        *_tool_side(SI.remote_centre_mm, -74),
    ),
}
TOOL = ("shaft", "hand")  # of every arm, after its bodies
# Parts over the tissue. The others hang beside the table: tissue is a plane without an edge, and they may be below it.
ABOVE_TISSUE = ("insertion axis", "carriage", "cannula mount", "cannula")


def names_of(instrument: str) -> tuple[str, ...]:
    """Return the names of an arm's parts: its bodies, then its shaft and hand.

    Args:
        instrument: Number of the instrument.
    """
    return tuple(body.name for body in _of(instrument)) + TOOL


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


def parts_of(joints: Floats, instrument: str) -> Links:
    """Return the parts of an arm with these joints, in its base frame.

    Args:
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6). Limits are not checked; NaN stays NaN.
        instrument: Number of the instrument.
    """
    bodies, tool = _of(instrument), instrument_of(instrument)
    yaw, pitch, slid = (joints[:, k, None] for k in range(3))
    (s1, s2), (c1, c2) = ((f(yaw), f(pitch)) for f in (np.sin, np.cos))
    yaws, slides = (np.array([getattr(body, name) for body in bodies]) for name in ("yaws", "slides"))
    ends = []
    for at, turning in (("begin_mm", "turning_mm"), ("end_mm", "end_turning_mm")):
        fixed, swung = (np.array([getattr(body, name) for body in bodies], float) for name in (at, turning))
        up = swung[:, 2] - np.where(slides, slid, 0.0)
        y = fixed[:, 1] + c2 * swung[:, 1] + s2 * up
        z = fixed[:, 2] - s2 * swung[:, 1] + c2 * up
        x = fixed[:, 0] + swung[:, 0] + np.zeros_like(y)
        turned = np.stack([c1 * x - s1 * z, y, s1 * x + c1 * z], axis=2)
        ends.append(np.where(yaws[:, None], turned, np.broadcast_to(fixed, turned.shape)))
    shaft, hand, _ = axes_of(joints)
    wrist = (slid - tool.wrist_offset_mm) * shaft
    begin = np.concatenate([ends[0], np.stack([wrist - tool.shaft_mm * shaft, wrist], axis=1)], axis=1)
    return Links(begin, np.concatenate([ends[1], np.stack([wrist, wrist + WRIST_MM * hand], axis=1)], axis=1))


def placed(arm: PlannedArm, joints: Floats) -> Links:
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


def between(arm: Links, radii: Floats, other: Links, other_radii: Floats) -> Floats:
    """Return the distances of all parts of one arm from all of another in as many poses, in one frame.

    Args:
        arm: The parts of one arm, B in T poses.
        radii: Their radii in mm, shape (B,).
        other: The parts of the other arm, C in T poses, in the same frame.
        other_radii: Their radii in mm, shape (C,).

    Returns:
        Distances in mm, negative where they overlap, shape (T, B, C); infinite between the two tools.
    """
    apart = segments_apart(
        arm.begin_mm[:, :, None],
        (arm.end_mm - arm.begin_mm)[:, :, None],
        other.begin_mm[:, None],
        (other.end_mm - other.begin_mm)[:, None],
    )
    apart -= radii[:, None] + other_radii
    apart[:, -len(TOOL) :, -len(TOOL) :] = np.inf
    return apart


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
        margin_mm: What the bodies are larger than the outlines that they stand for, where those are known.
        compared_with_meshes: Whether they were compared with the manufacturer's meshes.
    """

    arms: tuple[str, ...]
    limit_mm: float
    at_least_mm: Figure
    seen_within_mm: float
    looks: Count
    nearest: tuple[NearestBodies, ...]
    margin_mm: float = MARGIN_MM
    compared_with_meshes: bool = False


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
    seen = distances_at(trajectory, looks)
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
        looks, seen = np.insert(looks, at, more), np.insert(seen, at, distances_at(trajectory, more), axis=0)
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


def distances_at(trajectory: Trajectory, at: Ints) -> Floats:
    """Return the distances of all parts of one arm from all of the other at some samples.

    Args:
        trajectory: A motion of both arms.
        at: The samples, shape (C,).

    Returns:
        Distances in mm, as of `between`, shape (C, B, B').
    """
    arms, found = trajectory.arms, []
    radii = [radii_of(arm.instrument) for arm in arms]
    for some in np.array_split(at, 1 + len(at) // _CHUNK):
        arm, other = (placed(one, one.joints[some]) for one in arms)
        found.append(between(arm, radii[0], other, radii[1]))
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
    apart = between(planned[0], radii[0], planned[1], radii[1])
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
            row, turn = variation * samples + sample, errors.base_turn[variation]
            p, u = _axes(arms[0], joints[0], row, part)
            q, v = _axes(arms[1], joints[1], row, other)
            q, v = (np.einsum("kij,kj->ki", turn, one) for one in (q - centre, v))
            q = q + centre + errors.base_mm[variation] + errors.tip_mm[1, variation, sample]
            p = p + errors.tip_mm[0, variation, sample]
            found = segments_apart(p, u, q, v) - radii[0][part] - radii[1][other]
            wrong[number] |= np.bincount(variation[~(found >= limit_mm)], minlength=count) > 0
    return wrong


def _axes(arm: PlannedArm, joints: Floats, rows: Ints, parts: Ints) -> tuple[Floats, Floats]:
    """Return beginning and direction of some parts in some poses, both of shape (K, 3)."""
    used, index = np.unique(rows, return_inverse=True)
    of_arm = placed(arm, joints[used])
    begin = of_arm.begin_mm[index, parts]
    return begin, of_arm.end_mm[index, parts] - begin
