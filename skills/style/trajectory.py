"""A plan in time: where the tip, the jaw and the joints of PSM_A are at every tick of the controller.

A pass is A1, the tip along its polyline with the jaw held, and then A2, the jaw turning with the tip held. Between
passes the surgeon performs M1 and M2 by hand: time goes by, no samples are ours, and the arm's pose may jump.

The law of motion is ours, the paper only asks for no jerky movements:

* A1 is a cubic spline through the polyline's points, at rest at both ends and slower in bends. Each point is passed
  exactly, on a tick. Between points it leaves the straight move by at most 1.25 mm, because moves are divided until it
  does not (`_spline`). Stopping at every point would not leave it at all, but takes longer.
* A2 turns about one axis as a minimum-jerk law, whose peak rate is 1.875 times its mean.
* Where a joint would exceed its speed or acceleration limit, A1 or A2 of all passes is slowed until none does.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, isfinite, radians, sqrt

import numpy as np
from numpy.typing import ArrayLike

from skills.errors import BadPlan, BadSpeed, NoMotion, Unreachable
from skills.style._arrays import Bytes, Floats, Ints, frozen
from skills.style._spline import check_length, followed
from skills.style.handoff import OtherArm
from skills.style.kinematics import (
    DEFAULT_INSTRUMENT,
    angle_between,
    check_rotation,
    instrument_of,
    inverse,
    quaternion_of,
)
from skills.style.realign import turn

TRANSFER, A1, A2 = 0, 1, 2

MAX_SPEED_MM_S = 100.0  # ours: the joints allow 139 mm/s in the paper's grid, and nobody hands a needle on that fast
RATE_HZ = (10.0, 2000.0)
PEAK_TURN_RAD_S = radians(45)
SAME_POINT_MM = 1e-6
FAR_MM = 1e4  # ten metres: no point of a PSM's, but one whose squares do not overflow
_HEADROOM = 0.98  # each slow-down aims this far below the limits, so that it rarely needs another
_ATTEMPTS = 20


@dataclass(frozen=True, eq=False)
class PassPath:
    """One pass before it has a time.

    Attributes:
        tip_mm: Points of A1 in the PSM base frame, shape (K, 3), K >= 1; one point alone means that A1 is nothing.
        rotation: The jaw's [n o a] held during A1, shape (3, 3).
        target_rotation: Where A2 turns it, shape (3, 3), or None for a pass without A2.
    """

    tip_mm: Floats
    rotation: Floats
    target_rotation: Floats | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "tip_mm", frozen(self.tip_mm, np.float64, (None, 3), "tip_mm"))
        object.__setattr__(self, "rotation", frozen(self.rotation, np.float64, (3, 3), "rotation"))
        check_rotation(self.rotation[None])
        if (np.abs(self.tip_mm) > FAR_MM).any():
            raise BadPlan("A point is more than ten metres away; give millimetres in the PSM base frame.")
        if self.target_rotation is not None:
            target = frozen(self.target_rotation, np.float64, (3, 3), "target_rotation")
            check_rotation(target[None])
            object.__setattr__(self, "target_rotation", target)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """All passes of a plan, sampled.

    Attributes:
        rate_hz: Samples per second within a pass.
        instrument: Number of the instrument.
        stamps_s: Time of each sample, shape (T,); it leaps between passes.
        tip_mm: Tip in the PSM base frame, shape (T, 3).
        rotation_xyzw: The jaw's rotation there, unit quaternions, shape (T, 4).
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6).
        pass_index: Number of the pass, from 0, shape (T,).
        phase: `TRANSFER` (to where A1 begins), `A1` or `A2`, shape (T,).
        speed_mm_s: Speed along A1 where its way is straight, after any slow-down.
        turn_rad_s: Peak rate of A2 after any slow-down.
        speed_ratio: Greatest joint speed as a part of its limit.
        acceleration_ratio: Greatest joint acceleration as a part of its limit.
        deviation_mm: How far A1 leaves its straight moves at most.
        psm_m: PSM_M's motion beside it; None where its place is not known.
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

    def __post_init__(self) -> None:
        instrument_of(self.instrument)
        _check_rate(self.rate_hz)
        count = len(self.stamps_s)
        for name, dtype, shape in (
            ("stamps_s", np.float64, (count,)),
            ("tip_mm", np.float64, (count, 3)),
            ("rotation_xyzw", np.float64, (count, 4)),
            ("joints", np.float64, (count, 6)),
            ("pass_index", np.int64, (count,)),
            ("phase", np.int8, (count,)),
        ):
            object.__setattr__(self, name, frozen(getattr(self, name), dtype, shape, name))
        if not count:
            raise NoMotion("A trajectory needs at least one sample.")
        if not (np.diff(self.stamps_s) > 0).all() or not np.isin(np.diff(self.pass_index), (0, 1)).all():
            raise BadPlan("A trajectory's stamps must grow and its passes follow one another.")
        if self.pass_index[0] != 0 or not np.isin(self.phase, (TRANSFER, A1, A2)).all():
            raise BadPlan("A trajectory's passes count from 0 and its phases are 0 (transfer), 1 (A1) and 2 (A2).")
        if self.psm_m is not None and len(self.psm_m.joints) != count:
            raise BadPlan(f"PSM_M has {len(self.psm_m.joints)} samples beside {count}; give one for each.")

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
) -> Trajectory:
    """Give passes a time: smooth, through every point, within the arm's limits. The same passes give the same bytes.

    Args:
        passes: The passes in order.
        speed_mm_s: Speed along A1 where its way is straight; lower in bends, and lower where the joints' limits ask.
        rate_hz: Samples per second.
        instrument: Number of the instrument.
        pause_s: Seconds between passes, for M1 and M2 by hand; rounded to whole ticks, at least one.

    Raises:
        BadSpeed: Speed, rate or pause is NaN, not positive, or over its limit.
        NoMotion: There is no pass, or one in which nothing moves.
        Unreachable: The first pass and sample that the arm cannot take; `numbers` has both, joint, value and limit.
    """
    if not (isfinite(speed_mm_s) and 0 < speed_mm_s <= MAX_SPEED_MM_S):
        raise BadSpeed(f"Speed must be above 0 and at most {MAX_SPEED_MM_S:g} mm/s.", speed_mm_s=speed_mm_s)
    _check_rate(rate_hz)
    if not (isfinite(pause_s) and 0 <= pause_s <= 3600):
        raise BadSpeed("The pause between passes must be 0 to 3600 s.", pause_s=pause_s)
    if not passes:
        raise NoMotion("A plan needs at least one pass.")
    clock = _Clock(speed_mm_s, PEAK_TURN_RAD_S, rate_hz)
    polylines = [_polyline(one, number) for number, one in enumerate(passes)]
    for _ in range(_ATTEMPTS):
        sampled = [_sample(one, line, clock) for one, line in zip(passes, polylines, strict=True)]
        joints = [_solve(one, number, instrument) for number, one in enumerate(sampled)]
        slower = _slow_down(sampled, joints, clock, instrument)
        if slower == clock:
            return _assemble(sampled, joints, clock, instrument, pause_s)
        clock = slower
    raise BadSpeed("No speed keeps this plan within the joints' limits; move it away from the limits of the wrist.")


def joint_ratios(
    joints: ArrayLike, pass_index: ArrayLike, rate_hz: float, instrument: str = DEFAULT_INSTRUMENT
) -> tuple[Floats, Floats]:
    """Measure speed and acceleration of each joint at each sample as parts of their limits, both of shape (T, 6).

    By differences of neighbouring samples; every pass begins and ends at rest. NaN stays NaN.
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


# ---- one pass --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Clock:
    """How fast A1 runs, how fast A2 turns at its peak, and how often we look."""

    speed_mm_s: float
    turn_rad_s: float
    rate_hz: float


@dataclass(frozen=True, eq=False)
class _Sampled:
    """One pass in ticks from its own beginning."""

    tip_mm: Floats
    rotation: Floats
    phase: Bytes
    deviation_mm: float


def _check_rate(rate_hz: float) -> None:
    low, high = RATE_HZ
    if not (isfinite(rate_hz) and low <= rate_hz <= high):
        raise BadSpeed(f"The rate must be {low:g} to {high:g} Hz.", rate_hz=rate_hz)


def _polyline(one: PassPath, number: int) -> Floats:
    """Drop repeated points, shape (K, 3).

    Raises:
        NoMotion: Nothing moves in this pass.
    """
    points = one.tip_mm
    if not len(points):
        raise NoMotion(f"Pass {number} has no points.", **{"pass": number})
    moves = np.linalg.norm(np.diff(points, axis=0), axis=1) > SAME_POINT_MM
    # The last of equal points is kept, so that the pass ends exactly on its last one.
    kept: Floats = points[np.append(moves, True)]
    if len(kept) < 2 and one.target_rotation is None:
        raise NoMotion(f"Pass {number} neither moves nor turns; give it two points or a target.", **{"pass": number})
    return kept


def _sample(one: PassPath, line: Floats, clock: _Clock) -> _Sampled:
    """Run through one pass by the clock: A1, then A2 from the next tick on."""
    tip, deviation_mm = followed(line, clock.speed_mm_s / clock.rate_hz)
    turned = _turned(one, clock)
    rotation = np.concatenate([np.broadcast_to(one.rotation, (len(tip), 3, 3)), turned])
    phase = np.repeat(np.array([A1, A2], np.int8), [len(tip), len(turned)])
    return _Sampled(np.concatenate([tip, np.repeat(tip[-1:], len(turned), axis=0)]), rotation, phase, deviation_mm)


def _turned(one: PassPath, clock: _Clock) -> Floats:
    """Sample A2 as a minimum-jerk turn, shape (T, 3, 3), without its first moment, which is the end of A1."""
    if one.target_rotation is None:
        return np.empty((0, 3, 3))
    angle = float(angle_between(one.rotation[None], one.target_rotation[None])[0])
    ticks = max(1, ceil(1.875 * angle / clock.turn_rad_s * clock.rate_hz))
    check_length(ticks)
    u = np.arange(1, ticks + 1) / ticks
    turned = turn(one.rotation, one.target_rotation, u**3 * (10 - 15 * u + 6 * u * u))
    turned[-1] = one.target_rotation
    return turned


def _solve(one: _Sampled, number: int, instrument: str) -> Floats:
    """Solve the joints of one pass; an unreachable sample is named with its pass."""
    try:
        return inverse(one.tip_mm, one.rotation, instrument)
    except Unreachable as error:
        phase = int(one.phase[int(str(error.numbers["sample"]))])
        raise Unreachable(
            f"Pass {number}, A{phase}: {error}", **{"pass": number, "phase": phase, **error.numbers}
        ) from None


# ---- all passes ------------------------------------------------------------------------------------------------


def _slow_down(sampled: Sequence[_Sampled], joints: Sequence[Floats], clock: _Clock, instrument: str) -> _Clock:
    """Slow A1 or A2 down where a joint exceeds a limit; the same clock comes back where none does.

    Speed grows with the clock, acceleration with its square.
    """
    factor = {A1: 1.0, A2: 1.0}
    for one, q in zip(sampled, joints, strict=True):
        speed, acceleration = joint_ratios(q, np.zeros(len(q), np.int64), clock.rate_hz, instrument)
        for phase in factor:
            of_phase = one.phase == phase
            if of_phase.any():
                worst = max(float(speed[of_phase].max()), sqrt(float(acceleration[of_phase].max())))
                factor[phase] = max(factor[phase], worst)
    slower = [1.0 if factor[phase] <= 1.0 else _HEADROOM / factor[phase] for phase in (A1, A2)]
    return _Clock(clock.speed_mm_s * slower[0], clock.turn_rad_s * slower[1], clock.rate_hz)


def _assemble(
    sampled: Sequence[_Sampled],
    joints: Sequence[Floats],
    clock: _Clock,
    instrument: str,
    pause_s: float,
) -> Trajectory:
    """Put the passes one after another."""
    counts = [len(q) for q in joints]
    check_length(sum(counts))
    pause = max(1, round(pause_s * clock.rate_hz))
    number = np.repeat(np.arange(len(counts)), counts)
    tick = np.arange(sum(counts)) + number * (pause - 1)
    q = np.concatenate(joints)
    speed, acceleration = joint_ratios(q, number, clock.rate_hz, instrument)
    return Trajectory(
        rate_hz=clock.rate_hz,
        instrument=instrument,
        stamps_s=tick / clock.rate_hz,
        tip_mm=np.concatenate([one.tip_mm for one in sampled]),
        rotation_xyzw=np.concatenate([quaternion_of(one.rotation) for one in sampled]),
        joints=q,
        pass_index=number,
        phase=np.concatenate([one.phase for one in sampled]),
        speed_mm_s=clock.speed_mm_s,
        turn_rad_s=clock.turn_rad_s,
        speed_ratio=float(speed.max()),
        acceleration_ratio=float(acceleration.max()),
        deviation_mm=max(one.deviation_mm for one in sampled),
    )
