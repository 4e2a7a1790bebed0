"""Trajectories: a plan sampled in time, with the joints of both arms at every tick, and its timetable.

    passes, PsmM --time_parametrise--> Trajectory --seconds_by_phase, transfers, seams--> its timetable

A pass is a transfer, A1 (the tip along its polyline with the jaw held) and A2 (the jaw turning with the tip held); see
`skills.planning.passes`. Between passes the surgeon performs M1 and M2 by hand: time passes, and the next pass
continues from the pose in which the previous one ended. So nothing jumps within a trajectory, except the stamps between
passes.

The law of motion is ours; the paper only asks for no jerky movements:

* A1 along a recorded hand has the hand's own profile of speeds and turns (`skills.planning.path_fit`), all of it slowed
  by one factor, the *tempo*: a part of the surgeon's, so that the tip is nowhere faster than asked. Slower in one place
  only would be another profile. The tip is near the polyline, as the hand states it.
* A1 without a hand is a cubic spline through the polyline's points, at rest at both ends and slower in bends. Each
  point is passed exactly, on a tick. Between points it leaves the straight move by at most 1.25 mm, because moves are
  divided until it does not (`skills.planning.motion_laws`). Stopping at every point would not leave it at all, but
  takes longer.
* Transfers, A2 and all motion of PSM_M are minimum-jerk moves from rest to rest (`skills.planning.motion_laws`).
* With PSM_M the needle changes hands at the end of A2, while both arms stand: PSM_M's jaw, open until then, closes, and
  then PSM_A's opens. So they stay through the transfer to a further pass. At its end, where A1 begins, the surgeon
  brings the needle from PSM_M through the tissue to PSM_A (M1, M2): PSM_A's jaw closes and then PSM_M's opens. In A1
  and until then PSM_A's jaw is as recorded, or closed where it was not. Without PSM_M it is as recorded, changes
  evenly over a transfer, and stays as it is during A2.
* If a joint of either arm would exceed its speed or acceleration limit, that phase of all passes is slowed until no
  joint does.

The timetable (seconds of each phase, transfers, seams) is measured on the samples, not taken from the plan. A seam is
the place where one pass ends and the next begins: time passes there, and nothing may move.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from math import ceil, isfinite, radians, sqrt

import numpy as np
from numpy.typing import ArrayLike

from skills.arithmetic import product
from skills.arrays import Bytes, Floats, Ints, freeze
from skills.errors import BadPlan, BadSpeed, NoMotion
from skills.fields import Count, schema
from skills.kinematics import DEFAULT_INSTRUMENT, angle_between, forward, instrument_of, matrix_of, quaternion_of
from skills.planning import motion_laws
from skills.planning.handoff import JAW_CLOSED_RAD, JAW_OPEN_RAD, OtherArm, PsmM
from skills.planning.motion_laws import A1, A2, TRANSFER
from skills.planning.passes import PassPath, Route, Ticks, lay_out, other_arm, solve

__all__ = ["A1", "A2", "MAX_SPEED_MM_S", "TRANSFER", "PassPath", "Trajectory", "joint_ratios", "time_parametrise"]

MAX_SPEED_MM_S = 100.0  # ours: the joints allow 139 mm/s in the paper's grid, but no needle is handed over that fast
RATE_HZ = (10.0, 2000.0)
PEAK_TURN_RAD_S = radians(45)
_HEADROOM = 0.98  # each slow-down aims this far below the limits, so that a second one is rarely needed
_ATTEMPTS = 20

Paces = tuple[motion_laws.Pace, motion_laws.Pace, motion_laws.Pace]  # of each phase


STANDS = 1e-6  # ours, rad and mm: joints that differ by no more are those of one pose
PSM_A, PSM_M = "PSM_A", "PSM_M"  # the names of the two arms: the one that hands over, and the one that takes


@dataclass(frozen=True, eq=False)
class PlannedArm:
    """One arm of a trajectory, with its base.

    Attributes:
        name: `PSM_A` or `PSM_M`.
        instrument: Number of its instrument.
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6).
        jaw_rad: Angle of its jaw, shape (T,); None: not planned.
        base: Rotation of its base in PSM_A's base frame, shape (3, 3).
        base_mm: Its remote centre there, shape (3,).
    """

    name: str
    instrument: str
    joints: Floats
    jaw_rad: Floats | None
    base: Floats
    base_mm: Floats

    def poses(self, at: Ints | slice = slice(None)) -> motion_laws.Poses:
        """Return the arm's poses at some samples in PSM_A's base frame, by the forward kinematics."""
        tip_mm, rotation = forward(self.joints[at], self.instrument)
        return motion_laws.Poses(product(tip_mm, self.base.T) + self.base_mm, product(self.base, rotation))


@schema
@dataclass(frozen=True, kw_only=True)
class SampleMoment:
    """A sample of a trajectory.

    Attributes:
        sample: The sample.
        pass_index: Its pass.
        phase: The name of its phase.
        stamp_s: Its time.
    """

    sample: Count
    pass_index: Count
    phase: str
    stamp_s: float


@dataclass(frozen=True, eq=False)
class Trajectory:
    """All passes of a plan, sampled; the pose never jumps from one sample to the next, even where the stamps do.

    Attributes:
        rate_hz: Samples per second within a pass.
        instrument: Number of the instrument.
        stamps_s: Time of each sample, shape (T,); it jumps between passes.
        tip_mm: Tip in the PSM base frame, shape (T, 3).
        rotation_xyzw: The jaw's rotation there, unit quaternions, shape (T, 4).
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6).
        pass_index: Number of the pass, from 0, shape (T,).
        phase: `TRANSFER` (to where A1 begins), `A1` or `A2`, shape (T,).
        speed_mm_s: Speed along A1 where its path is straight, or greatest speed of a hand, after any slow-down.
        turn_rad_s: Peak rate of A2 after any slow-down; if PSM_M needs longer to come in, A2 turns slower still.
        speed_ratio: Greatest joint speed, of either arm, as a part of its limit.
        acceleration_ratio: Greatest joint acceleration, of either arm, as a part of its limit.
        deviation_mm: Greatest distance of A1 from its straight moves.
        psm_m: Simultaneous motion of PSM_M; None if its place is not known.
        tempo: The part of the surgeon's tempo at which A1 follows a recorded hand, at most 1; None without one.
        jaw_rad: Angle of PSM_A's jaw, shape (T,); None without PSM_M if it was not recorded, and so is constant.
        taking: The recorded poses in which PSM_M takes the needle, one for each pass, in the PSM base frame; None where
            they follow from the jaw, as in the paper.
    """

    rate_hz: float
    instrument: str
    stamps_s: Floats
    tip_mm: Floats
    rotation_xyzw: Floats
    joints: Floats
    pass_index: Ints
    phase: Bytes
    speed_mm_s: float
    turn_rad_s: float
    speed_ratio: float
    acceleration_ratio: float
    deviation_mm: float
    psm_m: OtherArm | None = None
    tempo: float | None = None
    jaw_rad: Floats | None = None
    taking: motion_laws.Poses | None = None

    def __post_init__(self) -> None:
        instrument_of(self.instrument)
        _check_rate(self.rate_hz)
        count = len(self.stamps_s)
        freeze(
            self, stamps_s=(count,), tip_mm=(count, 3), rotation_xyzw=(count, 4), joints=(count, 6), jaw_rad=(count,)
        )
        freeze(self, np.int64, pass_index=(count,))
        freeze(self, np.int8, phase=(count,))
        if not count:
            raise NoMotion("A trajectory needs at least one sample.")
        if not (np.diff(self.stamps_s) > 0).all() or not np.isin(np.diff(self.pass_index), (0, 1)).all():
            raise BadPlan("The stamps and the pass numbers of a trajectory must increase.")
        if self.pass_index[0] != 0 or not np.isin(self.phase, (TRANSFER, A1, A2)).all():
            raise BadPlan(
                "The passes of a trajectory must be numbered from 0, and its phases must be 0 (transfer), 1 (A1) and "
                "2 (A2)."
            )
        if self.psm_m is not None and len(self.psm_m.joints) != count:
            raise BadPlan(f"PSM_M has {len(self.psm_m.joints)} samples and PSM_A has {count}; give equal numbers.")

    def __len__(self) -> int:
        """The number of samples."""
        return len(self.stamps_s)

    @property
    def passes(self) -> int:
        """The number of passes."""
        return int(self.pass_index[-1]) + 1

    @property
    def duration_s(self) -> float:
        """Seconds from the first sample to the last, pauses included."""
        return float(self.stamps_s[-1] - self.stamps_s[0])

    @cached_property
    def arms(self) -> tuple[PlannedArm, ...]:
        """PSM_A, and PSM_M if it moves."""
        psm_a = PlannedArm(PSM_A, self.instrument, self.joints, self.jaw_rad, np.eye(3), np.zeros(3))
        m = self.psm_m
        if m is None:
            return (psm_a,)
        return psm_a, PlannedArm(PSM_M, m.instrument, m.joints, m.jaw_rad, matrix_of(m.base_xyzw[None])[0], m.base_mm)

    def moment(self, sample: int) -> SampleMoment:
        """Return a sample with its pass, phase and time."""
        return SampleMoment(
            sample=int(sample),
            pass_index=int(self.pass_index[sample]),
            phase=motion_laws.PHASES[self.phase[sample]],
            stamp_s=float(self.stamps_s[sample]),
        )

    @property
    def last_samples(self) -> Ints:
        """Index of the last sample of each pass, shape (passes,)."""
        return np.append(np.flatnonzero(np.diff(self.pass_index)), len(self) - 1).astype(np.int64)


def time_parametrise(
    passes: Sequence[PassPath],
    *,
    speed_mm_s: float = 20.0,
    rate_hz: float = 240.0,
    instrument: str = DEFAULT_INSTRUMENT,
    pause_s: float = 1.0,
    psm_m: PsmM | None = None,
) -> Trajectory:
    """Return the trajectory of passes: smooth, through every point, within the arms' limits.

    The same passes give the same bytes.

    Args:
        passes: The passes in order.
        speed_mm_s: Speed along A1 where its path is straight, and greatest speed of a recorded hand, of a transfer and
            of PSM_M; lower in bends, and lower if the joints' limits require it.
        rate_hz: Samples per second.
        instrument: Number of the instrument.
        pause_s: Seconds between passes, for M1 and M2 by hand; rounded to full ticks, at least two.
        psm_m: The other arm; if its base is known it moves too.

    Returns:
        The samples of all passes, with the speeds after any slow-down.

    Raises:
        BadSpeed: Speed, rate or pause is NaN, not positive, or over its limit; the motion has too many samples; or no
            speed keeps it within the joints' limits.
        NoMotion: There is no pass, or one in which nothing moves.
        BadPlan: PSM_M would take the needle in a pass without A2, or only some of the passes follow a recorded hand.
        Unreachable: The first sample that an arm cannot reach; `numbers` has pass, phase, joint, value and limit.
    """
    if not (isfinite(speed_mm_s) and 0 < speed_mm_s <= MAX_SPEED_MM_S):
        raise BadSpeed(f"Speed must be above 0 and at most {MAX_SPEED_MM_S:g} mm/s.", speed_mm_s=speed_mm_s)
    _check_rate(rate_hz)
    if not (isfinite(pause_s) and 0 <= pause_s <= 3600):
        raise BadSpeed("The pause between passes must be 0 to 3600 s.", pause_s=pause_s)
    pause = round(pause_s * rate_hz)
    if len(passes) > 1 and pause < 2:
        raise BadSpeed(
            f"A pause of {pause_s:g} s between passes is shorter than two samples at {rate_hz:g} Hz: nobody inserts "
            "and grasps the needle in it. The usual one is 1 s.",
            pause_s=pause_s,
        )
    routes = lay_out(passes, psm_m)
    peak_mm_s = _peak_mm_s(routes)
    tempo = 1.0 if peak_mm_s <= speed_mm_s else speed_mm_s / peak_mm_s
    paces = (motion_laws.Pace(speed_mm_s, PEAK_TURN_RAD_S, rate_hz, tempo),) * 3
    for _ in range(_ATTEMPTS):
        motion = _solved([_sample(one, paces) for one in routes], instrument, psm_m)
        speed, acceleration = _ratios(motion, rate_hz, instrument)
        slower = _slowed(paces, motion.ticks.phase, speed, acceleration)
        if slower == paces:
            break
        paces = slower
    else:
        raise BadSpeed("No speed keeps this plan within the joints' limits; move it away from the limits of the wrist.")
    ticks = motion.ticks
    handed = routes[0].hand is not None
    return Trajectory(
        rate_hz=rate_hz,
        instrument=instrument,
        stamps_s=(np.arange(len(motion.joints)) + ticks.pass_index * (pause - 1)) / rate_hz,
        tip_mm=motion.poses.tip_mm,
        rotation_xyzw=quaternion_of(motion.poses.rotation),
        joints=motion.joints,
        pass_index=ticks.pass_index,
        phase=ticks.phase,
        speed_mm_s=peak_mm_s * paces[A1].tempo if handed else paces[A1].speed_mm_s,
        turn_rad_s=paces[A2].turn_rad_s,
        speed_ratio=float(speed.max()),
        acceleration_ratio=float(acceleration.max()),
        deviation_mm=motion.deviation_mm,
        psm_m=motion.psm_m,
        tempo=paces[A1].tempo if handed else None,
        jaw_rad=motion.jaw_rad,
        taking=_taking(passes),
    )


def _peak_mm_s(routes: Sequence[Route]) -> float:
    """Return the greatest speed of the recorded hands, 0 if there are none.

    Raises:
        BadPlan: Only some of the passes have one.
    """
    hands = [one.hand for one in routes if one.hand is not None]
    if hands and len(hands) < len(routes):
        raise BadPlan("Either all passes of a plan follow a recorded hand, or none does.")
    return max((hand.peak_mm_s for hand in hands), default=0.0)


def _taking(passes: Sequence[PassPath]) -> motion_laws.Poses | None:
    """Return the recorded poses of PSM_M at the hand-offs; None if a pass has none."""
    recorded = [one.taking for one in passes if one.taking is not None]
    if len(recorded) < len(passes):
        return None
    return motion_laws.Poses(
        np.stack([pose.tip_mm for pose in recorded]), np.stack([pose.rotation for pose in recorded])
    )


def joint_ratios(
    joints: ArrayLike, pass_index: ArrayLike, rate_hz: float, instrument: str = DEFAULT_INSTRUMENT
) -> tuple[Floats, Floats]:
    """Return the speed and the acceleration of each joint at each sample as parts of their limits.

    They are differences of neighbouring samples; every pass begins and ends at rest. NaN stays NaN.

    Args:
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6).
        pass_index: Number of the pass of each sample, shape (T,).
        rate_hz: Samples per second.
        instrument: Number of the instrument, whose limits count.

    Returns:
        Speed ratios and acceleration ratios, both of shape (T, 6).
    """
    q = np.asarray(joints, dtype=np.float64)
    number = np.asarray(pass_index)
    tool = instrument_of(instrument)
    same = (np.diff(number) == 0)[:, None]
    velocity = np.where(same, np.diff(q, axis=0) * rate_hz, 0.0)
    before = np.concatenate([np.zeros((1, 6)), velocity])
    after = np.concatenate([velocity, np.zeros((1, 6))])
    speed = np.maximum(np.abs(before), np.abs(after)) / tool.speed
    return speed, np.abs(after - before) * rate_hz / tool.acceleration


def _check_rate(rate_hz: float) -> None:
    low, high = RATE_HZ
    if not (isfinite(rate_hz) and low <= rate_hz <= high):
        raise BadSpeed(f"The rate must be {low:g} to {high:g} Hz.", rate_hz=rate_hz)


# ---- one pass --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Sampled:
    """One pass in ticks: the poses of each arm, the number of ticks of each phase, and the recorded jaw, if any."""

    poses: tuple[motion_laws.Poses, ...]
    counts: tuple[int, int, int]
    deviation_mm: float
    jaw_rad: Floats | None
    other_jaw_rad: Floats | None = None


def _sample(one: Route, paces: Paces) -> _Sampled:
    """Sample one pass; the end of a phase and the beginning of the next are one tick, at rest."""
    hands = len(one.transfer[-1]) == 2 and one.handed is not None
    legs = [motion_laws.move(start, end, paces[TRANSFER]) for start, end in pairwise(one.transfer)]
    parts = [tuple(poses[:-1] for poses in leg) for leg in legs]  # a leg's last pose is the first of the next part
    begin = one.transfer[-1]
    along, deviation_mm, jaw = _brought(one, paces[A1])
    parts.append((along, *(motion_laws.held(pose, len(along)) for pose in begin[1:])))
    before = sum(len(leg[0]) for leg in parts[:-1])
    turning = 0
    if one.handed is not None:
        turned = motion_laws.move(one.brought, one.handed, paces[A2], least_ticks=1)
        parts.append(tuple(poses[1:] for poses in turned))
        turning = len(turned[0]) - 1
    other_jaw = None
    if hands and one.handed is not None:
        rate_hz = paces[A2].rate_hz
        jaw = np.full(len(along), JAW_CLOSED_RAD) if jaw is None else jaw
        given = motion_laws.Jaws.between((JAW_OPEN_RAD, JAW_CLOSED_RAD), (jaw[-1], _let_go(jaw)), rate_hz)
        parts.append(tuple(motion_laws.held(pose, len(given)) for pose in one.handed))
        first, first_other = np.full(before, jaw[0]), np.full(before, JAW_OPEN_RAD)
        if one.further:
            taken = motion_laws.Jaws.between((_let_go(jaw), jaw[0]), (JAW_CLOSED_RAD, JAW_OPEN_RAD), rate_hz)
            parts.insert(len(legs), tuple(motion_laws.held(pose, len(taken)) for pose in begin))
            # the last angles are those of A1's first tick
            first = np.concatenate((np.full(before + 1, _let_go(jaw)), taken.takes_rad[:-1]))
            first_other = np.concatenate((np.full(before + 1, JAW_CLOSED_RAD), taken.gives_rad[:-1]))
        before = len(first)
        jaw, other_jaw = (
            np.concatenate((first, jaw, np.full(turning, jaw[-1]), given.gives_rad)),
            np.concatenate((first_other, np.full(len(along) + turning, JAW_OPEN_RAD), given.takes_rad)),
        )
        turning += len(given)
    elif jaw is not None:
        jaw = np.concatenate((np.full(before, jaw[0]), jaw, np.full(turning, jaw[-1])))
    poses = tuple(motion_laws.joined(of_arm) for of_arm in zip(*parts, strict=True))
    return _Sampled(poses, (before, len(along), turning), deviation_mm, jaw, other_jaw)


def _let_go(jaw_rad: Floats) -> float:
    """Return the angle at which PSM_A's jaw lets the needle go: open, and no less than at its recorded end."""
    return max(JAW_OPEN_RAD, float(jaw_rad[-1]))


@dataclass(frozen=True, eq=False)
class PassPoses:
    """One pass as poses of each arm in PSM_A's base, S of them, whatever joints they need.

    Attributes:
        arms: The poses of PSM_A, and of PSM_M if it is in the scene.
        phase: `TRANSFER`, `A1` or `A2` of each pose, shape (S,).
        jaw_rad: Angle of PSM_A's jaw, shape (S,); None if it was not recorded.
    """

    arms: tuple[motion_laws.Poses, ...]
    phase: Bytes
    jaw_rad: Floats | None


def poses_along(one: PassPath, psm_m: PsmM | None, step_mm: float) -> PassPoses:
    """Return the poses of one pass by itself, evenly along the ways of all tips; a turn of 2 degrees counts as 1 mm.

    Args:
        one: The pass.
        psm_m: The other arm; None, or one without a base, leaves it out.
        step_mm: The tips together move about so far from one pose to the next, or jaws turn instead.

    Raises:
        NoMotion: Nothing moves.
        BadPlan: It has no A2, but PSM_M would take the needle there.
    """
    (way,) = lay_out([one], psm_m)
    fine = _sample(way, (motion_laws.Pace(20.0, PEAK_TURN_RAD_S, RATE_HZ[1] / 10),) * 3)
    phase = np.repeat(np.array([TRANSFER, A1, A2], np.int8), fine.counts)
    gone = np.zeros(len(phase) - 1)
    for poses in fine.poses:
        gone += np.linalg.norm(np.diff(poses.tip_mm, axis=0), axis=1)
        gone += np.degrees(angle_between(poses.rotation[:-1], poses.rotation[1:])) / 2
    along = np.append(0.0, np.cumsum(gone))
    wanted = np.linspace(0.0, along[-1], max(2, ceil(along[-1] / step_mm) + 1))
    ends = np.append(np.flatnonzero(np.diff(phase)), len(phase) - 1)
    at = np.union1d(np.searchsorted(along, wanted - 1e-9).clip(0, len(along) - 1), ends)
    jaw = None if fine.jaw_rad is None else fine.jaw_rad[at]
    return PassPoses(tuple(motion_laws.Poses(arm.tip_mm[at], arm.rotation[at]) for arm in fine.poses), phase[at], jaw)


def _brought(one: Route, pace: motion_laws.Pace) -> tuple[motion_laws.Poses, float, Floats | None]:
    """Return the poses of A1, its greatest distance from its straight moves, and the recorded angles of the jaw."""
    first = one.transfer[-1][0].rotation
    if one.hand is None:
        tip, deviation_mm = motion_laws.followed(one.line, pace.speed_mm_s / pace.rate_hz)
        return motion_laws.Poses(tip, np.tile(first, (len(tip), 1, 1))), deviation_mm, None
    ticks = ceil(one.hand.duration_s / pace.tempo * pace.rate_hz)
    motion_laws.check_length(ticks)
    tip, turned, jaw = one.hand.at(ticks + 1)
    rotation = np.tile(first, (len(tip), 1, 1)) if turned is None else turned
    # without round-off, because transfer and A2 begin and end exactly there
    tip[0], tip[-1] = one.line[0], one.line[-1]
    rotation[0], rotation[-1] = first, one.brought[0].rotation
    return motion_laws.Poses(tip, rotation), one.hand.deviation_mm, jaw


# ---- all passes ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Motion:
    """All passes in ticks, with their joints solved."""

    poses: motion_laws.Poses
    ticks: Ticks
    joints: Floats
    psm_m: OtherArm | None
    deviation_mm: float
    jaw_rad: Floats | None


def _solved(sampled: Sequence[_Sampled], instrument: str, psm_m: PsmM | None) -> _Motion:
    """Concatenate the passes and solve the joints of both arms."""
    counts = np.array([one.counts for one in sampled])
    motion_laws.check_length(int(counts.sum()))
    phase = np.repeat(np.tile(np.array([TRANSFER, A1, A2], np.int8), len(counts)), counts.ravel())
    ticks = Ticks(np.repeat(np.arange(len(counts)), counts.sum(axis=1)), phase)
    poses = [motion_laws.joined(of_arm) for of_arm in zip(*(one.poses for one in sampled), strict=True)]
    joints = solve(poses[0], ticks, instrument)
    other = None
    if psm_m is not None and len(poses) == 2:
        jaws = [one.other_jaw_rad for one in sampled if one.other_jaw_rad is not None]
        other = replace(other_arm(poses[1], ticks, psm_m), jaw_rad=np.concatenate(jaws))
    deviation_mm = max(one.deviation_mm for one in sampled)
    return _Motion(poses[0], ticks, joints, other, deviation_mm, _jaw(sampled))


def _jaw(sampled: Sequence[_Sampled]) -> Floats | None:
    """Concatenate the angles of the jaw; alone, over a transfer it goes evenly from the pass before to its own."""
    angles = [one.jaw_rad for one in sampled if one.jaw_rad is not None]
    if len(angles) < len(sampled):
        return None
    alone = all(one.other_jaw_rad is None for one in sampled)
    for before, after, one in zip(angles, angles[1:], sampled[1:] if alone else (), strict=False):
        transfer = one.counts[0]
        after[:transfer] = np.linspace(before[-1], after[transfer], transfer + 1)[:-1]
    return np.concatenate(angles)


def _ratios(motion: _Motion, rate_hz: float, instrument: str) -> tuple[Floats, Floats]:
    """Return the greatest speed and acceleration of any joint of either arm, as parts of their limits, both (T,)."""
    moving = [(motion.joints, instrument)]
    if motion.psm_m is not None:
        moving.append((motion.psm_m.joints, motion.psm_m.instrument))
    ratios = [joint_ratios(q, motion.ticks.pass_index, rate_hz, tool) for q, tool in moving]
    speed, acceleration = (np.max([one[i].max(axis=1) for one in ratios], axis=0) for i in (0, 1))
    return speed, acceleration


def _slowed(paces: Paces, phase: Bytes, speed: Floats, acceleration: Floats) -> Paces:
    """Slow down each phase in which a joint exceeds a limit; return equal paces if none does.

    Speed grows with the pace, acceleration with its square.
    """
    transfer, a1, a2 = (
        _HEADROOM / worst if worst > 1.0 else 1.0
        for worst in (
            max(float(speed[phase == one].max(initial=0)), sqrt(float(acceleration[phase == one].max(initial=0))))
            for one in (TRANSFER, A1, A2)
        )
    )
    return paces[TRANSFER].slowed(transfer), paces[A1].slowed(a1), paces[A2].slowed(a2)


@schema
@dataclass(frozen=True)
class Transfer:
    """The motion of PSM_A to where A1 begins: length of its tip's path, and the duration, which PSM_M shares."""

    length_mm: float
    duration_s: float


@schema
@dataclass(frozen=True)
class Seam:
    """The change between the last sample of a pass and the first of the next.

    `joint_leap` is the greatest change of a joint of either arm, as a part of the change that its speed limit allows in
    one tick.
    """

    after_pass: Count
    pause_s: float
    leap_mm: float
    leap_deg: float
    joint_leap: float


def rows_of_pass(trajectory: Trajectory, pass_index: int | None) -> Ints:
    """Return the indices of the samples of one pass, or of all samples.

    Raises:
        BadPlan: There is no such pass.
    """
    if pass_index is None:
        return np.arange(len(trajectory))
    if not 0 <= pass_index < trajectory.passes:
        raise BadPlan(f"The plan's passes are 0 to {trajectory.passes - 1}.", **{"pass": pass_index})
    return np.flatnonzero(trajectory.pass_index == pass_index)


def stands_from(trajectory: Trajectory, end: int) -> int:
    """Return the first of the samples up to an end at which both arms stand as they do there.

    Args:
        trajectory: The motion.
        end: The index of a sample.
    """
    first = end
    while first > 0:
        begin = max(2 * first - end - 64, 0)  # stands are short: look back twice as far each time
        still = [(np.abs(arm.joints[begin:first] - arm.joints[end]) <= STANDS).all(axis=1) for arm in trajectory.arms]
        moved = np.flatnonzero(~np.logical_and.reduce(still))
        if len(moved):
            return begin + int(moved[-1]) + 1
        first = begin
    return first


def seconds_by_phase(trajectory: Trajectory) -> dict[str, float]:
    """Return the seconds of each phase over all passes, without pauses.

    Args:
        trajectory: The trajectory.

    Returns:
        Seconds by the names of `PHASES`.
    """
    return {
        name: float(np.count_nonzero(trajectory.phase == phase) / trajectory.rate_hz)
        for phase, name in enumerate(motion_laws.PHASES)
    }


def transfers(trajectory: Trajectory) -> list[Transfer | None]:
    """Return the transfer of each pass; None where A1 begins at once.

    Args:
        trajectory: The trajectory, whose samples are measured.
    """
    steps = np.linalg.norm(np.diff(trajectory.tip_mm, axis=0), axis=1)
    found: list[Transfer | None] = []
    for number in range(trajectory.passes):
        # The step after a transfer's last sample leads to A1's first one.
        at = np.flatnonzero((trajectory.pass_index == number) & (trajectory.phase == TRANSFER))
        found.append(Transfer(float(steps[at].sum()), len(at) / trajectory.rate_hz) if len(at) else None)
    return found


def seams(trajectory: Trajectory) -> list[Seam]:
    """Return the seams between passes, one fewer than there are passes.

    Args:
        trajectory: The trajectory, whose samples are measured.
    """
    before = trajectory.last_samples[:-1]
    after = before + 1
    rotation = matrix_of(trajectory.rotation_xyzw)
    turned = np.degrees(angle_between(rotation[before], rotation[after]))
    leaps = [
        np.abs(arm.joints[after] - arm.joints[before]) / instrument_of(arm.instrument).speed * trajectory.rate_hz
        for arm in trajectory.arms
    ]
    return [
        Seam(
            after_pass=number,
            pause_s=float(trajectory.stamps_s[after[number]] - trajectory.stamps_s[last]),
            leap_mm=float(np.linalg.norm(trajectory.tip_mm[after[number]] - trajectory.tip_mm[last], axis=-1)),
            leap_deg=float(turned[number]),
            joint_leap=max(float(leap[number].max()) for leap in leaps),
        )
        for number, last in enumerate(before.tolist())
    ]
