"""Passes before they are timed: the stations and paths of both arms, and an arm's joints over all samples.

    PassPath, PsmM --lay_out--> Route: transfer, A1 and A2 of each pass
    Poses, Ticks --solve--> joints of every tick
    base of PSM_M, its poses at every tick --other_arm--> OtherArm

A pass has three phases:

    transfer   from the end of the previous pass to where A1 begins; ours, so that a plan is one motion
    A1         PSM_A's tip moves along its polyline, the jaw held or turning as the surgeon's (`path_fit`)
    A2         PSM_A's jaw turns with the tip held, and PSM_M comes in

A transfer goes through *stations*, at rest in each. Between passes PSM_M goes back, then PSM_A moves to its start while
its jaw turns back and PSM_M moves to its next stand-off. PSM_A waits until PSM_M has left, because the needle leaves
from between its jaws. If a pass starts outside its grid world, its start is one more station.

PSM_M waits at a stand-off, straight back along its approach, and comes in while PSM_A turns its jaw (A2). With
`PsmM.enters` "start" it waits at the hand-off itself. The paper has PSM_M waiting; the way it comes in is ours. It
takes the needle in the pose that was recorded, moved with the pass, or else in the one that follows from the paper's
A2.

PSM_M's jaws are symmetric about their approach, so of a pose and the same pose with the hinge reversed it takes the one
that needs less roll; all other joints are the same, except for the signs of the wrist's joints.

**Joints.** Within the joint limits a pose leaves one choice free: the roll may differ by a full turn, because its range
is 520 degrees. `skills.kinematics.inverse` chooses pose by pose, so after many turns in one direction it would have to
jump back by a full turn. Here the choice is made once for all samples: the turn that keeps the roll nearest to the
middle of its range. The first pose out of reach is named in the error.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import numpy as np

from skills.arithmetic import product
from skills.arrays import Bytes, Floats, Ints, freeze
from skills.errors import BadPlan, NoMotion, Unreachable
from skills.kinematics import JOINTS, ROLL, check_rotation, instrument_of, inverse, matrix_of
from skills.planning.handoff import OtherArm, PsmM, hand_off
from skills.planning.motion_laws import PHASES, SAME_POINT_MM, Arms, Pose, Poses
from skills.planning.path_fit import Hand
from skills.quaternions import unit

STAND_OFF_MM = 30.0  # ours: the needle's circle, 16.6 mm across, plus a finger of 10.2 mm, plus a little more
HINGE_REVERSED = np.diag([-1.0, -1.0, 1.0])  # times a rotation [n o a]: jaws are symmetric about their approach


@dataclass(frozen=True, eq=False)
class Ticks:
    """The pass, from 0, and the phase of each tick of a motion, both of shape (T,)."""

    pass_index: Ints
    phase: Bytes


def solve(poses: Poses, ticks: Ticks, instrument: str, arm: str = "") -> Floats:
    """Solve the joints of an arm for a complete motion.

    Args:
        poses: The tip in the arm's base frame, T ticks; between neighbouring ticks the jaw rolls by less than half a
            turn.
        ticks: The pass and the phase of each pose.
        instrument: Number of the instrument.
        arm: Name of the arm for error messages; the planned arm itself needs none.

    Returns:
        Joints, rad and mm, shape (T, 6).

    Raises:
        Unreachable: The first pose out of reach; `numbers` has the pass, phase, sample in the pass, joint, value and
            limit.
    """
    ends = np.append(np.flatnonzero(np.diff(ticks.pass_index)) + 1, len(poses))
    first, solved = 0, []
    for end in ends.tolist():
        try:
            solved.append(inverse(poses.tip_mm[first:end], poses.rotation[first:end], instrument))
        except Unreachable as error:
            raise _named(error, first, ticks, arm) from None
        first = end
    try:
        return _wound(np.concatenate(solved), instrument)
    except Unreachable as error:
        raise _named(error, 0, ticks, arm) from None


def _wound(joints: Floats, instrument: str) -> Floats:
    """Choose the turns of the roll so that it never jumps, and return the joints, shape (T, 6).

    Raises:
        Unreachable: The jaw turns by more than the roll's range.
    """
    tool = instrument_of(instrument)
    lower, upper = float(tool.lower[ROLL]), float(tool.upper[ROLL])
    unwound = np.unwrap(joints[:, ROLL])
    roll = unwound - 2 * pi * np.round((unwound.max() + unwound.min()) / (4 * pi))
    # No choice of the turn fits: report the one that gets furthest before it exceeds a limit.
    if _first_beyond(roll, lower, upper) < len(roll):
        turns = np.round(unwound[0] / (2 * pi)) + np.array([0, 1, -1])
        roll = max((unwound - 2 * pi * turn for turn in turns), key=lambda r: _first_beyond(r, lower, upper))
        sample = _first_beyond(roll, lower, upper)
        value, limit = float(roll[sample]), upper if roll[sample] > upper else lower
        raise Unreachable(
            f"the jaw winds up to roll {value:.5g} rad, beyond the limit {limit:.4g} of the {tool.arm.name}; turn the "
            "suture points less, or make two plans.",
            sample=sample,
            joint=JOINTS[ROLL],
            value=value,
            limit=limit,
        )
    return np.concatenate([joints[:, :ROLL], roll[:, None], joints[:, ROLL + 1 :]], axis=1)


def _first_beyond(roll: Floats, lower: float, upper: float) -> int:
    """Return the index of the first sample beyond the limits, or the number of samples if there is none."""
    inside = (roll >= lower - 1e-9) & (roll <= upper + 1e-9)
    return len(roll) if inside.all() else int(np.argmin(inside))


def _named(error: Unreachable, first: int, ticks: Ticks, arm: str) -> Unreachable:
    """Return the error with its pass and phase added; `first` is the tick from which its sample was counted."""
    at = first + int(str(error.numbers["sample"]))
    number, phase = int(ticks.pass_index[at]), int(ticks.phase[at])
    numbers = {**error.numbers, "sample": at - int(np.argmax(ticks.pass_index == number))}
    where = f"Pass {number}, {PHASES[phase]}{arm and ', ' + arm}"
    named = {"pass": number, "phase": phase, **({"arm": arm} if arm else {}), **numbers}
    return Unreachable(f"{where}: {error.message}", *error.remedies, **named)


# ---- stations and paths --------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Meeting:
    """The poses of PSM_M around one hand-off, in the PSM_A base frame.

    Attributes:
        stand_off: Clear of PSM_A.
        taking: Holding the needle.
        waiting: The one of these two in which PSM_M is during A1.
    """

    stand_off: Pose
    taking: Pose
    waiting: Pose


def meeting(handed: Pose, psm_m: PsmM, taking: Pose | None = None) -> Meeting:
    """Return the poses of PSM_M around a hand-off.

    Args:
        handed: PSM_A's pose after A2, in its base frame.
        psm_m: PSM_M's approach, and the phase in which it enters.
        taking: PSM_M's recorded pose as it takes the needle, in the same frame; None: that of the paper's A2.

    Raises:
        BadPlan: PSM_A's jaw is not turned for the hand-off.
    """
    if taking is None:
        tip_mm, rotation = hand_off(handed.tip_mm[None], handed.rotation[None], psm_m.approach)
        taking = Pose(tip_mm[0], rotation[0])
    stand_off = Pose(taking.tip_mm - STAND_OFF_MM * taking.rotation[:, 2], taking.rotation)
    return Meeting(stand_off, taking, taking if psm_m.enters == "start" else stand_off)


def other_arm(poses: Poses, ticks: Ticks, psm_m: PsmM) -> OtherArm:
    """Solve the joints of PSM_M for a complete motion.

    Args:
        poses: PSM_M's tip in the PSM_A base frame, T ticks.
        ticks: The pass and the phase of each pose.
        psm_m: The arm, with its base.

    Returns:
        PSM_M's base, and its joints at every tick.

    Raises:
        Unreachable: The first sample that it cannot reach; `numbers` has PSM_M, pass, phase, joint, value and limit.
    """
    assert psm_m.base_mm is not None and psm_m.base_xyzw is not None
    base_mm, base_xyzw = np.array(psm_m.base_mm), np.array(psm_m.base_xyzw)
    base = matrix_of(base_xyzw[None])[0]
    seen = Poses(product(poses.tip_mm - base_mm, base), product(base.T, poses.rotation))
    reversed_ = Poses(seen.tip_mm, product(seen.rotation, HINGE_REVERSED))
    # Both are solved over the complete motion, because the jaws must not change sides on the way.
    either = [solve(one, ticks, psm_m.instrument, "PSM_M") for one in (seen, reversed_)]
    joints = min(either, key=lambda joints: float(np.abs(joints[:, ROLL]).max()))
    return OtherArm(base_mm, unit(base_xyzw), psm_m.instrument, joints)


FAR_MM = 1e4  # ten metres: further than any PSM reaches, and the squares do not overflow


@dataclass(frozen=True, eq=False)
class PassPath:
    """One pass before it is timed.

    Attributes:
        tip_mm: Points of A1 in the PSM base frame, shape (K, 3), K >= 1; a single point means that A1 has no motion.
        rotation: The jaw's [n o a] at the start of A1, shape (3, 3); held, unless the hand turns it.
        target_rotation: Target of the turn in A2, shape (3, 3), or None for a pass without A2.
        start_mm: Start of the pass, shape (3,), if that is not A1's first point; a transfer leads from there.
        hand: Orientation, jaw and tempo of A1; None: the jaw held, and the tempo of `skills.planning.motion_laws`.
        taking: The recorded pose in which PSM_M takes the needle; None: that of the paper's A2.
    """

    tip_mm: Floats
    rotation: Floats
    target_rotation: Floats | None = None
    start_mm: Floats | None = None
    hand: Hand | None = None
    taking: Pose | None = None

    @property
    def last_rotation(self) -> Floats:
        """The jaw's [n o a] at the end of A1, shape (3, 3)."""
        if self.hand is None or self.hand.rotation_xyzw is None:
            return self.rotation
        return np.asarray(matrix_of(self.hand.rotation_xyzw[-1:])[0])

    def __post_init__(self) -> None:
        freeze(self, tip_mm=(None, 3), rotation=(3, 3), target_rotation=(3, 3), start_mm=(3,))
        for rotation in (self.rotation, self.target_rotation):
            if rotation is not None:
                check_rotation(rotation[None])
        if any((np.abs(points) > FAR_MM).any() for points in (self.tip_mm, self.start_mm) if points is not None):
            raise BadPlan("A point is more than ten metres away; give millimetres in the PSM base frame.")


@dataclass(frozen=True, eq=False)
class Route:
    """The path of the arms in one pass.

    Attributes:
        transfer: Stations before A1; the last is where A1 begins.
        line: Points of A1, no two neighbours equal, shape (K, 3).
        brought: Poses at the end of A1.
        handed: Poses at the end of A2; None for a pass without it.
        hand: Orientation, jaw and tempo of A1; None: held, at an even tempo.
        further: Whether another pass comes before it.
    """

    transfer: tuple[Arms, ...]
    line: Floats
    brought: Arms
    handed: Arms | None
    hand: Hand | None = None
    further: bool = False

    @property
    def last(self) -> Arms:
        """The poses at the end of the pass."""
        return self.handed or self.brought


def lay_out(passes: Sequence[PassPath], psm_m: PsmM | None) -> list[Route]:
    """Lay out every pass, with PSM_M if its base is known.

    Args:
        passes: The passes in order.
        psm_m: The other arm; None, or one without a base, leaves it out.

    Returns:
        One entry per pass, the poses in the PSM_A base frame.

    Raises:
        NoMotion: There is no pass, or one in which nothing moves.
        BadPlan: A pass has no A2, but PSM_M would take the needle there.
    """
    if not passes:
        raise NoMotion("A plan needs at least one pass.")
    beside = psm_m if psm_m is not None and psm_m.base_mm is not None else None
    found: list[Route] = []
    before: Meeting | None = None
    for number, one in enumerate(passes):
        line = _polyline(one, number)
        meets = None if beside is None else _meeting(one, number, beside)
        stations = _stations(one, line, meets, before, found[-1].last if found else None)
        handed = None
        if one.target_rotation is not None:
            handed = _arms(Pose(line[-1], one.target_rotation), None if meets is None else meets.taking)
        brought = (Pose(line[-1], one.last_rotation), *stations[-1][1:])
        found.append(Route(stations, line, brought, handed, one.hand, number > 0))
        before = meets
    return found


def _stations(
    one: PassPath, line: Floats, meets: Meeting | None, before: Meeting | None, last: Arms | None
) -> tuple[Arms, ...]:
    """List the stations of a transfer; neighbours may be equal."""
    first = Pose(line[0], one.rotation)
    start = first if one.start_mm is None else Pose(one.start_mm, one.rotation)
    waits = None if meets is None else meets.waiting
    if last is None:
        return _arms(start, waits), _arms(first, waits)
    away = None if before is None else before.stand_off
    off = None if meets is None else meets.stand_off
    return last, _arms(last[0], away), _arms(start, off), _arms(first, off), _arms(first, waits)


def _arms(psm_a: Pose, psm_m: Pose | None) -> Arms:
    return (psm_a,) if psm_m is None else (psm_a, psm_m)


def _meeting(one: PassPath, number: int, psm_m: PsmM) -> Meeting:
    """Return the poses of PSM_M around the hand-off of a pass; raises `BadPlan` for a pass without A2."""
    if one.target_rotation is None:
        raise BadPlan(f"Pass {number} has no A2, so PSM_M cannot take the needle.", **{"pass": number})
    return meeting(Pose(one.tip_mm[-1], one.target_rotation), psm_m, one.taking)


def _polyline(one: PassPath, number: int) -> Floats:
    """Return the points of A1 without repetitions, shape (K, 3).

    Raises:
        NoMotion: Nothing moves in this pass.
    """
    points = one.tip_mm
    if not len(points):
        raise NoMotion(f"Pass {number} has no points.", **{"pass": number})
    moves = np.linalg.norm(np.diff(points, axis=0), axis=1) > SAME_POINT_MM
    # Of equal points the last remains, so that the pass ends exactly at its last point.
    kept: Floats = points[np.append(moves, True)]
    if len(kept) < 2 and one.target_rotation is None and one.hand is None:
        raise NoMotion(f"Pass {number} neither moves nor turns; give it two points or a target.", **{"pass": number})
    return kept
