"""Clearance: distances between surfaces in closed form and bounds on them; and the needle, its pose and its catch.

    joints --links_of--> Links --clearance_to_pad--> mm per link
    two of them --clearance_between--> mm per pair of links
    joints --travel_mm--> mm per link and step
    distances at some samples, travel --Bounds--> least distances at every sample
    Trajectory --needle_poses--> pose of the needle --needle_to_pad_mm--> mm
    HandOff, errors --catch--> between the fingers or not, angle to their hinge

The surfaces of the links are those that collide in `urdf/psm.urdf`: one capsule each, which is the set of points within
a radius of a straight axis. So distances are exact, as the simulator's are, and at a microsecond per pose fast enough
for thousands of variations of a plan.

Between samples distances are bounded. No point of a link moves further than the sum, over the joints before it, of the
joint's turn times the link's greatest distance from that joint's axis. And between two measurements no two surfaces
come nearer than the measured distance minus the distance that both have moved since, or will move until the next one.
Both are bounds, so nothing is missed between the measurements.

**Needle.** PSM_A holds the needle from the first sample to the hand-off. If PSM_M's place is known, it holds the needle
from there until PSM_A is where the next pass begins. M1 and M2, where the needle goes through tissue, are done by hand
by a surgeon. So the needle's distance from the simulator's pad is reported but is not a gate of any verdict; that from
stated tissue is one while PSM_A holds it (`skills.verification.scene_clearance`).

The catch is computed in closed form and for many slightly wrong hand-offs at once. Symbols: the needle is an arc of
radius r that leaves PSM_A's grip in direction u and bends towards t, so after the angle phi it is at r (t (1 - cos phi)
+ u sin phi) from the grip, where it runs along t sin phi + u cos phi. In the frame of PSM_M's jaws x lies along their
hinge n, y from finger to finger, z along the approach. The fingers close in the plane x = 0; the arc crosses it at the
phi with

    t_x cos phi - u_x sin phi = t_x + g_x / r     with the grip at g.

When the fingers close they sweep a sector of that plane about the hinge and bring everything within it to its middle.
All of this is ours.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, pi, radians, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Flags, Floats, Ints
from skills.kinematics import DEFAULT_INSTRUMENT, INSERTION, JAW_TIP_MM, WRIST_MM, axes_of, instrument_of, matrix_of
from skills.planning.handoff import HELD_MM, HOLDING_RAD, NEEDLE_FREE_RAD, NEEDLE_RADIUS_MM
from skills.planning.trajectory import PSM_A, TRANSFER, PlannedArm, Trajectory
from skills.verification.playback import FINGERS as FINGER_LINKS
from skills.verification.playback import LINKS, PAD_SIZE_MM, LinkPair, pad_scale

# The reach of the surfaces in `urdf/psm.urdf` from the wrist's pitch axis and from the hinge, mm.
SHAFT_RADIUS_MM = 4.0
WRIST_REACH_MM = WRIST_MM + 3.6
FINGER_REACH_MM = 10.3  # the tip's cap is 10.22 from the hinge
RADIUS_MM = 0.33  # of the needle's wire, as in `urdf/needle.urdf`
# The arc from the place where it is held, two thirds from the tip: x along the needle, y towards the arc's centre.
_TURN = np.linspace(-pi / 3, 2 * pi / 3, 49)
ARC_BULGE_MM = NEEDLE_RADIUS_MM * (1 - cos((_TURN[1] - _TURN[0]) / 2))  # of the wire beyond the chord of two points
ARC_MM: Floats = NEEDLE_RADIUS_MM * np.stack([np.sin(_TURN), 1 - np.cos(_TURN), np.zeros_like(_TURN)], axis=1)


def travel_mm(joints: Floats, instrument: str) -> Floats:
    """Return upper bounds on the distance that any point of a link's surface moves from each sample to the next.

    Args:
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6).
        instrument: Number of the instrument.

    Returns:
        Millimetres for each of `playback.LINKS`, shape (T - 1, 4).
    """
    tool = instrument_of(instrument)
    moved = np.abs(np.diff(joints, axis=0))
    # The wrist's depth beyond the remote centre, about which yaw and pitch turn.
    wrist = joints[:, INSERTION] - tool.wrist_offset_mm
    deep = np.maximum(np.abs(wrist[1:]), np.abs(wrist[:-1]))
    behind = tool.shaft_mm - np.minimum(wrist[1:], wrist[:-1])  # the shaft's other end
    finger = WRIST_MM + FINGER_REACH_MM
    swung, slid, rolled, pitched, yawed = moved[:, 0] + moved[:, 1], moved[:, 2], moved[:, 3], moved[:, 4], moved[:, 5]
    shaft = swung * (np.maximum(deep, behind) + SHAFT_RADIUS_MM) + slid  # rolling does not move its surface
    wrists = swung * (deep + WRIST_REACH_MM) + slid + (rolled + pitched) * WRIST_REACH_MM
    fingers = swung * (deep + finger) + slid + (rolled + pitched) * finger + yawed * FINGER_REACH_MM
    return np.stack([shaft, wrists, fingers, fingers], axis=1)


def way_mm(steps_mm: Floats) -> Floats:
    """Return the distances moved since the first sample, shape (T, L).

    Args:
        steps_mm: Those from each sample to the next, shape (T - 1, L).
    """
    return np.concatenate([np.zeros((1, steps_mm.shape[1])), np.cumsum(steps_mm, axis=0)])


def openings(arm: PlannedArm, unplanned_rad: float = HOLDING_RAD) -> Floats:
    """Return the opening of each of an arm's fingers, rad, shape (T,): at least that of jaws that hold a needle.

    Args:
        arm: The motion of the arm.
        unplanned_rad: The opening where the motion states no angle of the jaw.
    """
    if arm.jaw_rad is None:
        return np.full(len(arm.joints), unplanned_rad)
    return np.maximum(arm.jaw_rad / 2, HOLDING_RAD)


@dataclass(frozen=True, eq=False)
class Bounds:
    """Lower bounds on the distances of pairs of links at every sample, from distances measured at some samples.

    Attributes:
        pairs: The pairs of links, P of them.
        looked_at: The samples of the measurements, ascending, with the first and the last of all, shape (C,).
        seen_mm: The distances measured there, shape (C, P).
        ways_mm: Greatest distance that each body's links can have moved since the first sample, shape (T, 4); a body
            that is missing here does not move.
        opened_mm: Greatest distance of PSM_A's fingers from where they were measured, because the jaw is open further,
            shape (T,); None: as measured.
    """

    pairs: tuple[LinkPair, ...]
    looked_at: Ints
    seen_mm: Floats
    ways_mm: Mapping[str, Floats]
    opened_mm: Floats | None = None

    @classmethod
    def of(
        cls, moving: Mapping[str, tuple[Floats, str]], pairs: Sequence[LinkPair], looked_at: Ints, seen_mm: Floats
    ) -> "Bounds":
        """Return the bounds for moving arms.

        Args:
            moving: Joints, shape (T, 6), and instrument of each arm that moves, by its name.
            pairs: The pairs of links, P of them.
            looked_at: The samples of the measurements, ascending, with the first and the last of all, shape (C,).
            seen_mm: The distances measured there, shape (C, P).
        """
        ways = {name: way_mm(travel_mm(joints, tool)) for name, (joints, tool) in moving.items()}
        return cls(tuple(pairs), looked_at, seen_mm, ways)

    def at_least_mm(self, column: int) -> Floats:
        """Return a lower bound on one pair's distance, shape (T,): exact where it was measured, NaN next to a NaN.

        Where the jaw is open further than when it was measured, the bound allows for that.
        """
        way, looked_at, seen = self._way_mm(column), self.looked_at, self.seen_mm[:, column]
        sample = np.arange(len(way))
        before = np.searchsorted(looked_at, sample, side="right") - 1
        after = np.searchsorted(looked_at, sample, side="left")
        since = seen[before] - (way - way[looked_at[before]])
        until = seen[after] - (way[looked_at[after]] - way)
        least, pair = np.maximum(since, until), self.pairs[column]
        if self.opened_mm is not None and pair.body == PSM_A and pair.link in FINGER_LINKS:
            least = least - self.opened_mm
        return np.asarray(least)

    def moved_mm(self) -> float:
        """Return the greatest distance by which any pair can have approached between two measurements."""
        steps = (np.diff(self._way_mm(column)[self.looked_at]) for column in range(len(self.pairs)))
        return max(float(step.max(initial=0.0)) for step in steps)

    def _way_mm(self, column: int) -> Floats:
        """Return the distance that both links of a pair together can have moved, shape (T,)."""
        pair = self.pairs[column]
        links = ((pair.body, pair.link), (pair.other, pair.other_link))
        ways = [self.ways_mm[body][:, LINKS.index(link)] for body, link in links if body in self.ways_mm]
        return np.asarray(np.sum(ways, axis=0))


# The capsules of urdf/psm.urdf, in mm: shaft, wrist (from its pitch axis to the hinge) and the two fingers.
FINGERS = slice(2, 4)
WRIST_RADIUS_MM, FINGER_RADIUS_MM = 3.6, 1.1
RADII_MM = np.array([SHAFT_RADIUS_MM, WRIST_RADIUS_MM, FINGER_RADIUS_MM, FINGER_RADIUS_MM])
FINGER_MM = JAW_TIP_MM - FINGER_RADIUS_MM  # a finger's axis, from the hinge on; its round end is the finger's tip
ASIDE_MM = 0.6  # a finger's axis from the plane in which the two meet

_PARALLEL = 1e-12  # part of the product of two squared lengths: segments are then parallel, and any start works


@dataclass(frozen=True, eq=False)
class Links:
    """Links of an arm, or other parts of it, in T poses: both ends of their L axes, mm in any one frame, (T, L, 3)."""

    begin_mm: Floats
    end_mm: Floats

    def moved(self, by_mm: Floats) -> "Links":
        """Return the links with each pose moved by an offset, shape (T, 3)."""
        return Links(self.begin_mm + by_mm[:, None], self.end_mm + by_mm[:, None])

    def seen_from(self, base: Floats, base_mm: Floats) -> "Links":
        """Return the links in a frame where their own frame is at `base_mm`, shape (3,), turned by `base`, (3, 3)."""
        return Links(self.begin_mm @ base.T + base_mm, self.end_mm @ base.T + base_mm)


def links_of(joints: ArrayLike, instrument: str = DEFAULT_INSTRUMENT, opening_rad: ArrayLike = HOLDING_RAD) -> Links:
    """Return the links of an arm with these joints, in its base frame.

    Args:
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6). Limits are not checked; NaN stays NaN.
        instrument: Number of the instrument.
        opening_rad: Opening of each finger, of all poses or of each, shape (T,).
    """
    tool = instrument_of(instrument)
    q = np.asarray(joints, dtype=np.float64)
    shaft, along, rotation = axes_of(q)
    o, a = rotation[:, :, 1], rotation[:, :, 2]
    wrist = (q[:, 2:3] - tool.wrist_offset_mm) * shaft
    hinge = wrist + WRIST_MM * along
    axes = [(wrist - tool.shaft_mm * shaft, wrist), (wrist, hinge)]
    opening = np.broadcast_to(np.asarray(opening_rad, dtype=np.float64), (len(q),))[:, None]
    cosine, sine = np.cos(opening), np.sin(opening)
    for side in (1.0, -1.0):
        outwards = side * cosine * o - sine * a
        begin = hinge + ASIDE_MM * outwards
        axes.append((begin, begin + FINGER_MM * (cosine * a + side * sine * o)))
    begins, ends = zip(*axes, strict=True)
    return Links(np.stack(begins, axis=1), np.stack(ends, axis=1))


def clearance_to_pad(arm: Links, pad_top_mm: ArrayLike, normal: ArrayLike = (0.0, 0.0, 1.0)) -> Floats:
    """Return the height of each link above everything that is no higher than the pad's top; negative is below.

    Args:
        arm: The arm.
        pad_top_mm: Height of the pad's top along its normal, one for all poses, or one for each, shape (T,).
        normal: The unit direction out of the pad, shape (3,).

    Returns:
        Distances in mm, shape (T, 4); the columns are `LINKS`.
    """
    up = np.asarray(normal, np.float64)
    lowest = np.minimum(arm.begin_mm @ up, arm.end_mm @ up) - RADII_MM
    return np.asarray(lowest - np.asarray(pad_top_mm, np.float64).reshape(-1, 1))


def clearance_between(arm: Links, other: Links) -> Floats:
    """Return the distances between the links of two arms.

    Args:
        arm: One arm in T poses.
        other: The other arm, in the same frame and in as many poses.

    Returns:
        Distances in mm, negative where they overlap, shape (T, 4, 4); rows and columns are `LINKS`.
    """
    p, u = arm.begin_mm, arm.end_mm - arm.begin_mm
    q, v = other.begin_mm, other.end_mm - other.begin_mm
    return np.asarray(_between(p, u, q, v) - (RADII_MM[:, None] + RADII_MM))


def lines_apart(points_mm: Floats, arm: Links) -> Floats:
    """Return the least distances of a polyline in each pose from the links of an arm, shape (T, 4).

    Args:
        points_mm: Its points, shape (T, P, 3).
        arm: The arm in T poses, in the same frame.
    """
    apart = _between(points_mm[:, :-1], np.diff(points_mm, axis=1), arm.begin_mm, arm.end_mm - arm.begin_mm)
    return np.asarray(apart.min(axis=1) - RADII_MM)


def _between(p: Floats, u: Floats, q: Floats, v: Floats) -> Floats:
    """Return the distance of every segment p + s u from every segment q + t v, s and t in 0..1, shape (T, P, Q).

    It takes the s that is best for the lines, the t that is best for that s, and the s that is best for that t; then
    the squared distance as a polynomial in both.
    """
    uu, vv = _dot(u, u)[:, :, None], _dot(v, v)[:, None, :]
    qs, vs = np.swapaxes(q, 1, 2), np.swapaxes(v, 1, 2)
    uv = u @ vs
    ur = _dot(u, p)[:, :, None] - u @ qs
    vr = p @ vs - _dot(v, q)[:, None, :]
    rr = _dot(p, p)[:, :, None] + _dot(q, q)[:, None, :] - 2 * (p @ qs)
    slant = np.maximum(uu * vv - uv * uv, _PARALLEL * uu * vv)
    s = np.clip((uv * vr - ur * vv) / slant, 0.0, 1.0)
    t = np.clip((uv * s + vr) / vv, 0.0, 1.0)
    s = np.clip((uv * t - ur) / uu, 0.0, 1.0)
    squared = rr + uu * s * s + vv * t * t + 2 * (ur * s - vr * t - uv * s * t)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))  # round-off where they touch


def _dot(u: Floats, v: Floats) -> Floats:
    return np.asarray(np.einsum("tki,tki->tk", u, v))


# ---- the needle ----------------------------------------------------------------------------------------------------


def needle_poses(trajectory: Trajectory, at: Ints) -> tuple[Floats, Floats]:
    """Return the poses of the needle at some samples.

    Args:
        trajectory: The trajectory.
        at: The samples, shape (F,).

    Returns:
        The place where it is held, mm in the PSM_A base frame, shape (F, 3), and the rotation of its frame, shape (F,
        3, 3).
    """
    place, rotation = needle_in_psm_a(trajectory, at)
    away = by_psm_m(trajectory)[at]
    if trajectory.psm_m is None or not away.any():
        return place, rotation
    taken = trajectory.last_samples[trajectory.pass_index[at[away]] - 1]
    (tip, jaws), (tip_then, jaws_then) = psm_m_poses(trajectory, at[away]), psm_m_poses(trajectory, taken)
    place_then, rotation_then = needle_in_psm_a(trajectory, taken)
    turned = jaws @ np.swapaxes(jaws_then, 1, 2)
    place[away] = tip + np.einsum("fij,fj->fi", turned, place_then - tip_then)
    rotation[away] = turned @ rotation_then
    return place, rotation


def by_psm_m(trajectory: Trajectory) -> Flags:
    """Mark the samples, (T,), at which PSM_M holds the needle, or the surgeon: transfers to a further pass."""
    return np.asarray((trajectory.phase == TRANSFER) & (trajectory.pass_index > 0))


def needle_arc_mm(trajectory: Trajectory, at: Ints) -> Floats:
    """Return points along the needle's wire at some samples; it is at most `NEEDLE_REACH_MM` from their chords.

    Args:
        trajectory: The trajectory.
        at: The samples, shape (F,).

    Returns:
        Points in mm in the PSM_A base frame, shape (F, 49, 3).
    """
    place, rotation = needle_poses(trajectory, at)
    return np.asarray(place[:, None] + np.einsum("fij,kj->fki", rotation, ARC_MM))


def needle_travel_mm(trajectory: Trajectory) -> Floats:
    """Return upper bounds on the distance that any point of the needle moves to the next sample.

    Args:
        trajectory: The trajectory, of T samples.

    Returns:
        Millimetres, shape (T - 1,).
    """
    reach = float(np.hypot(HELD_MM, np.linalg.norm(ARC_MM, axis=1).max()) + RADIUS_MM)
    travels = []
    for arm in trajectory.arms:
        moved = np.abs(np.diff(arm.joints, axis=0))
        wrist = np.abs(arm.joints[:, INSERTION] - instrument_of(arm.instrument).wrist_offset_mm)
        deep = np.maximum(wrist[1:], wrist[:-1]) + WRIST_MM + reach
        turned = (moved[:, 0] + moved[:, 1]) * deep + (moved[:, 3] + moved[:, 4]) * (WRIST_MM + reach)
        travels.append(turned + moved[:, 2] + moved[:, 5] * reach)
    return np.asarray(np.where(by_psm_m(trajectory)[1:], travels[-1], travels[0]))


def needle_to_pad_mm(trajectory: Trajectory, at: Ints, pad_mm: Floats) -> Floats:
    """Return the distance of the needle from the pad at some samples, negative inside, shape (F,).

    Args:
        trajectory: The trajectory.
        at: The samples, shape (F,).
        pad_mm: The middle of the pad's top in the PSM_A base frame, shape (3,).
    """
    arc, half = needle_arc_mm(trajectory, at), pad_scale(trajectory.tip_mm) * np.array(PAD_SIZE_MM) / 2
    beyond = np.abs(arc - pad_mm + [0.0, 0.0, half[2]]) - half  # signed distance from each pair of the pad's faces
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=2)
    inside = np.minimum(beyond.max(axis=2), 0.0)
    return np.asarray((outside + inside).min(axis=1) - RADIUS_MM)


def psm_m_poses(trajectory: Trajectory, at: Ints) -> tuple[Floats, Floats]:
    """Return the poses of PSM_M at some samples, in the PSM_A base frame.

    Args:
        trajectory: A trajectory with PSM_M.
        at: The samples, shape (F,).

    Returns:
        PSM_M's tip, mm, shape (F, 3), and its rotation [n o a], shape (F, 3, 3).
    """
    poses = trajectory.arms[1].poses(at)
    return poses.tip_mm, poses.rotation


def needle_in_psm_a(trajectory: Trajectory, at: Ints) -> tuple[Floats, Floats]:
    """Return the needle's pose along the hinge of PSM_A's jaws, its free end on PSM_M's side, as in `hand_off`."""
    jaws = matrix_of(trajectory.rotation_xyzw[at])
    place = trajectory.tip_mm[at] + HELD_MM * jaws[:, :, 2]
    if trajectory.psm_m is not None:
        ends = trajectory.last_samples[trajectory.pass_index[at]]
        n_a = matrix_of(trajectory.rotation_xyzw[ends])[:, :, 0]
        a_m = psm_m_poses(trajectory, ends)[1][:, :, 2]
        # Half a turn about the approach, so that the free end points to PSM_M.
        jaws[np.einsum("fi,fi->f", n_a, a_m) > 0] *= [-1.0, -1.0, 1.0]
    return place, jaws


NEEDLE_THICK_MM = 2 * RADIUS_MM
NEEDLE_REACH_MM = RADIUS_MM + ARC_BULGE_MM
_HALF_WIDTH_RAD = FINGER_RADIUS_MM / NEEDLE_RADIUS_MM  # of the arc, from the middle of the fingers to their side


@dataclass(frozen=True, eq=False)
class HandOff:
    """Both arms as planned at the end of A2, in one frame: tips in mm, shape (3,), and jaws [n o a], shape (3, 3)."""

    tip_a: Floats
    jaw_a: Floats
    tip_m: Floats
    jaw_m: Floats


class Crossing(NamedTuple):
    """Where the needle crosses the plane in which PSM_M's fingers close, each of shape (N,); NaN where it does not.

    Attributes:
        beside_mm: From the middle of the jaws towards a finger.
        deep_mm: From their hinge along the approach.
        along_rad: Along the needle from PSM_A's grip to the crossing.
        askew_rad: Angle between the needle's tangent there and the hinge.
    """

    beside_mm: Floats
    deep_mm: Floats
    along_rad: Floats
    askew_rad: Floats


def crossing(planned: HandOff, turned: Floats, apart_mm: Floats) -> Crossing:
    """Compute the place and the direction of the needle in PSM_M's open jaws.

    Args:
        planned: The hand-off. The needle stands across PSM_A's jaws, its free end against PSM_M's approach.
        turned: Rotation of the needle about the grip, in the same frame, shape (N, 3, 3).
        apart_mm: Error of PSM_A's position relative to PSM_M's, in the same frame, shape (N, 3).
    """
    n, a = planned.jaw_a[:, 0], planned.jaw_a[:, 2]
    free = n if n @ planned.jaw_m[:, 2] < 0 else -n
    inwards = np.cross(a, free)
    # The jaws are symmetric about their approach, so take the one of n and -n along which the needle runs.
    n_m, o_m, a_m = planned.jaw_m.T
    jaws = np.stack([n_m, o_m, a_m] if n_m @ inwards >= 0 else [-n_m, -o_m, a_m], axis=1)
    grip = (planned.tip_a + HELD_MM * a - planned.tip_m + apart_mm) @ jaws
    t, u = turned @ inwards @ jaws, turned @ free @ jaws
    amplitude = np.hypot(t[:, 0], u[:, 0])
    level = (t[:, 0] + grip[:, 0] / NEEDLE_RADIUS_MM) / np.maximum(amplitude, 1e-12)
    crosses = np.abs(level) <= 1.0  # NaN does not
    phi = np.where(crosses, np.arccos(np.where(crosses, level, 0.0)), np.nan) - np.arctan2(u[:, 0], t[:, 0])
    sine, cosine = np.sin(phi)[:, None], np.cos(phi)[:, None]
    at, along = grip + NEEDLE_RADIUS_MM * (t * (1 - cosine) + u * sine), t * sine + u * cosine
    return Crossing(at[:, 1], at[:, 2], phi, np.arccos(np.clip(np.abs(along[:, 0]), 0.0, 1.0)))


@dataclass(frozen=True)
class Grasp:
    """What a needle that crosses the jaws' plane needs to be taken; NaN never is.

    Attributes:
        spare_rad: Arc to spare on either side of the crossing; below 0 the crossing may be beyond an end.
        least_mm: Least distance of its middle from the hinge.
        most_mm: Greatest distance of its middle from the hinge.
        opening_rad: Half of the sector that the fingers sweep; all of the needle's thickness lies within.
        askew_rad: Greatest angle to the hinge.
    """

    spare_rad: float
    least_mm: float
    most_mm: float
    opening_rad: float
    askew_rad: float = pi / 2

    def takes(self, at: Crossing) -> Flags:
        """Return whether each needle is taken, shape (N,)."""
        to_spare = (at.along_rad >= self.spare_rad) & (at.along_rad <= NEEDLE_FREE_RAD - self.spare_rad)
        depth = np.hypot(at.beside_mm, at.deep_mm)
        within = (depth >= self.least_mm) & (depth <= self.most_mm) & (at.askew_rad <= self.askew_rad)
        sine, cosine = sin(self.opening_rad), cos(self.opening_rad)
        swept = np.abs(at.beside_mm) * cosine + NEEDLE_THICK_MM / 2 <= at.deep_mm * sine
        return np.asarray(to_spare & within & swept)


def caught(opening_rad: float) -> Grasp:
    """Return the grasp of a needle whole between fingers of an opening, with needle to spare on both sides."""
    half = NEEDLE_THICK_MM / 2
    return Grasp(_HALF_WIDTH_RAD, WRIST_RADIUS_MM + half, JAW_TIP_MM - half, opening_rad)


# By friction, in `docs/contact.md`: whatever the fingers touch is taken, between the hinge and their ends and on all of
# their width. The three angles are fitted there, and tested on other plans. None of this is a gate.
_TOUCHED = (-_HALF_WIDTH_RAD, 0.0, JAW_TIP_MM + NEEDLE_THICK_MM / 2, radians(45.0))
GRASPS = {"held": Grasp(*_TOUCHED, radians(40.0)), "straight": Grasp(*_TOUCHED, radians(16.0))}
