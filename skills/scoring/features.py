"""Figures with their units: of a motion, next to those of a reference, and of a whole trial of both hands.

    Demo --measure--> Numbers;   Numbers, Numbers --compare--> ScoreFigures

The figures of a motion come from `skills.demonstration.quality`, except the size. They describe one hand-off of one
arm, and none depends on its place.

    Recording --measure_trial--> TrialFigures

The figures of a whole trial say how two instruments, and the two masters that drive them, move from its start to its
end. A model of skill uses these.

A trial is a recording of both hands, pauses and failures included. The instruments are one side, the masters the
other. Each figure is that of one arm, averaged over the two arms of a side, so it does not matter which arm is the
right one. A figure with a long tail is modelled by its logarithm, and its mean over the arms is then a geometric one
(`TrialKind.log`). A model of skill is a sum of these figures (`skills.scoring.calibration`).

Positions and orientations are smoothed by a window of 0.5 s on a grid of 10 ms (`skills.demonstration.movement`), so
the figures do not depend on the rate of the recording, 30 Hz or 200 Hz. Thresholds are ours.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from skills.arrays import Floats, Ints, freeze
from skills.demonstration.demonstration import Demo
from skills.demonstration.motion import Motion, Signal
from skills.demonstration.movement import MOVING_MM_S, SMOOTHING_S, Movement, movement_of, smoothed_tip
from skills.demonstration.quality import describe
from skills.demonstration.recording import Recording, preference
from skills.errors import BadInput
from skills.fields import Figure, schema

Numbers = Mapping[str, float | None]


@dataclass(frozen=True)
class FigureKind:
    """A kind of figure: its name in reports, its unit, its label and its meaning."""

    name: str
    unit: str
    label: str
    meaning: str


KINDS = (
    FigureKind("duration_s", "s", "Duration", "from the first sample to the last, pauses included"),
    FigureKind(
        "path_length_mm", "mm", "Path length", "the tip's path from sample to sample, tremor included, pauses not"
    ),
    FigureKind("size_mm", "mm", "Start to goal", "the distance in a straight line: the size of the hand-off"),
    FigureKind("spectral_arc_length", "", "Smoothness of speed", "spectral arc length: closer to 0 is smoother"),
    FigureKind("log_dimensionless_jerk", "", "Smoothness of path", "log dimensionless jerk: closer to 0 is smoother"),
    FigureKind("clutch_presses", "", "Clutch", "number of presses of the pedal"),
    FigureKind("idle_share", "", "Idle", "share of the driven time slower than 1 mm/s and without a turn"),
    FigureKind("orientation_change_rad", "rad", "Orientation drift", "largest angle from the first orientation"),
)


@schema
@dataclass(frozen=True)
class ScoreFigure(FigureKind):
    """One figure of a motion with that of the reference; null if it was not recorded.

    Attributes:
        unit: Empty for a number without a unit.
        ratio: Value divided by the reference's; null if that is 0 or one is missing.
    """

    value: Figure
    reference: Figure
    ratio: Figure


def measure(demo: Demo) -> Numbers:
    """Return the value of each of `KINDS` for a motion.

    Args:
        demo: The motion.
    """
    report = describe(demo)
    size_mm = float(np.linalg.norm(demo.tip_mm[-1] - demo.tip_mm[0]))
    return {kind.name: size_mm if kind.name == "size_mm" else getattr(report, kind.name) for kind in KINDS}


def compare(measured: Numbers, reference: Numbers) -> tuple[ScoreFigure, ...]:
    """Combine the figures of a motion with those of a reference.

    Args:
        measured: The motion's, as `measure` returns them.
        reference: The reference's.
    """
    figures = []
    for kind in KINDS:
        value, other = measured[kind.name], reference[kind.name]
        ratio = value / other if value is not None and other else None
        figures.append(ScoreFigure(**vars(kind), value=value, reference=other, ratio=ratio))
    return tuple(figures)


LEAST_S = 3.0  # each third is then longer than the smoothing window
TOGETHER_MM_S = 5.0  # both arms of a side are in use above this
FAST = 0.95  # quantile of the speed
STILL_MM_S, STILL_MM_S3, STILL_RAD_S = 0.1, 1.0, 1e-3  # below the noise of a recording: an arm at rest has these
JAW_RANGE = (0.05, 0.95)  # quantiles of the jaw's angle that count as closed and open
JAW_DEAD_BAND = 0.15  # of the range, on both sides of its middle: an angle in between changes nothing
JAW_LEAST_RAD = 0.05  # a jaw that turns by less does not grip
THIRDS = 3


@dataclass(frozen=True)
class TrialKind(FigureKind):
    """A figure of a whole trial.

    Attributes:
        log: Whether it is modelled by its logarithm.
        plus: Added before the logarithm, so that a count may be 0.
    """

    log: bool = False
    plus: float = 0.0

    def modelled(self, value: float) -> float:
        """Return the number that is modelled."""
        return float(np.log(value + self.plus)) if self.log else value

    def readable(self, modelled: float) -> float:
        """Return the value in the figure's unit."""
        return float(np.exp(modelled) - self.plus) if self.log else modelled


TRIAL_KINDS = (
    TrialKind("duration_s", "s", "Duration", "from the first sample of both arms to the last", log=True),
    TrialKind("path_length_mm", "mm", "Path length", "of the smoothed tip", log=True),
    TrialKind("speed_mm_s", "mm/s", "Mean speed", "of the smoothed tip", log=True),
    TrialKind("fast_speed_mm_s", "mm/s", "Fast speed", "exceeded in 5 % of the time", log=True),
    TrialKind("speed_variation", "", "Variation of speed", "standard deviation divided by the mean"),
    TrialKind("idle_share", "", "Idle", f"share of the time slower than {MOVING_MM_S:g} mm/s"),
    TrialKind("stops", "", "Stops", f"times at which the speed falls below {MOVING_MM_S:g} mm/s", log=True, plus=1.0),
    TrialKind("speed_peaks", "", "Peaks of speed", "local maxima above the mean speed", log=True, plus=1.0),
    TrialKind("speed_peaks_per_s", "1/s", "Peaks per second", "the same, divided by the duration"),
    TrialKind("log_dimensionless_jerk", "", "Smoothness of path", "log dimensionless jerk: closer to 0 is smoother"),
    TrialKind("jerk_per_speed", "1/s^2", "Jerk per speed", "root mean square jerk, per mean speed", log=True),
    TrialKind("turn_rad", "rad", "Turn", "of the wrist, all of it added up", log=True, plus=0.1),
    TrialKind("turn_per_mm", "rad/mm", "Turn per path", "the turn, divided by the path length", log=True),
    TrialKind("volume_mm3", "mm^3", "Space used", "product of the deviations along its axes", log=True, plus=1e-3),
    TrialKind("grips", "", "Grips", "times at which the jaw opens or closes", log=True, plus=1.0),
    TrialKind("together_share", "", "Both together", f"share of the time with both above {TOGETHER_MM_S:g} mm/s"),
    TrialKind("speeds_correlation", "", "Coordination", "correlation of the speeds of both arms"),
)
TRIAL_NAMES = tuple(kind.name for kind in TRIAL_KINDS)
TRIAL_KIND_OF = {kind.name: kind for kind in TRIAL_KINDS}
SIDES = ("instruments", "masters")


@dataclass(frozen=True, eq=False)
class TrialFigures:
    """The figures of a trial in the order of `TRIAL_KINDS`, as they are modelled.

    Attributes:
        values: Of the instruments, and of the masters if two were recorded; shape (S, F), S of 1 or 2 `SIDES`.
        thirds: The same for each third of the trial's time, shape (S, 3, F).
    """

    values: Floats
    thirds: Floats

    def __post_init__(self) -> None:
        sides = len(self.values)
        freeze(self, values=(sides, len(TRIAL_KINDS)), thirds=(sides, THIRDS, len(TRIAL_KINDS)))


def measure_trial(recording: Recording) -> TrialFigures:
    """Measure a whole recording as one trial.

    Args:
        recording: The recording; masters count if it has two, with the angles of their grippers.

    Raises:
        BadInput: It does not have two instruments with orientation and jaw for `LEAST_S` at one time.
    """
    instruments = _sides(recording.motions, dict(recording.jaws))
    if len(instruments) != 2:
        complete = ", ".join(motion.arm for motion, _ in instruments) or "none"
        raise BadInput(
            "A trial has two instruments, each with pose, orientation and jaw; this recording has "
            f"{len(instruments)} ({complete}). Record both arms and their jaws, and no third one."
        )
    sides = [_measured(instruments)]
    masters = _sides(recording.masters, dict(recording.grippers))
    if len(masters) == 2:
        sides.append(_measured(masters))
    return TrialFigures(np.stack([values for values, _ in sides]), np.stack([thirds for _, thirds in sides]))


def _sides(motions: tuple[Motion, ...], angles: Mapping[str, Signal]) -> list[tuple[Motion, Signal]]:
    """Return the motion of each arm that has an orientation and a jaw, with its jaw."""
    found = {}
    for motion in sorted(motions, key=preference, reverse=True):  # the preferred one is last, and stays
        if motion.rotation_xyzw is not None and motion.arm in angles:
            found[motion.arm] = (motion, angles[motion.arm])
    return [found[arm] for arm in sorted(found)]


@dataclass(frozen=True, eq=False)
class _Arm:
    """One arm on the grid: speeds, turns, squared jerk (NaN at both ends, shape (N,)), and jaw, 1 open and 0 closed."""

    movement: Movement
    jerk_squared: Floats
    open: Ints


def _measured(side: list[tuple[Motion, Signal]]) -> tuple[Floats, Floats]:
    """Return the figures of a side, (F,), and of its thirds, (3, F)."""
    start_ns = max(int(motion.stamps_ns[0]) for motion, _ in side)
    end_ns = min(int(motion.stamps_ns[-1]) for motion, _ in side)
    if (end_ns - start_ns) / 1e9 < LEAST_S:
        raise BadInput(
            f"Both arms were recorded together for {max(0.0, (end_ns - start_ns) / 1e9):.1f} s; a trial has at least "
            f"{LEAST_S:g} s. Record the whole trial."
        )
    arms = [_arm(motion, jaw, start_ns, end_ns) for motion, jaw in side]
    whole = _figures(arms, 0.0, 1.0)
    return whole, np.stack([_figures(arms, part / THIRDS, (part + 1) / THIRDS) for part in range(THIRDS)])


def _arm(motion: Motion, jaw: Signal, start_ns: int, end_ns: int) -> _Arm:
    """Return one arm between two stamps, on the grid."""
    inside = (motion.stamps_ns >= start_ns) & (motion.stamps_ns <= end_ns)
    assert motion.rotation_xyzw is not None
    seconds = (motion.stamps_ns[inside] - start_ns) / 1e9
    movement = movement_of(seconds, motion.tip_mm[inside], motion.rotation_xyzw[inside])
    step_s = float(movement.seconds[-1] - movement.seconds[0]) / (len(movement.seconds) - 1)
    jerk = movement.tip_mm
    for _ in range(3):
        jerk = np.gradient(jerk, step_s, axis=0)
    squared = (jerk**2).sum(axis=1)
    edge = round(SMOOTHING_S / 2 / step_s) + 3  # where the window has too few samples, and three quotients more
    squared[:edge] = squared[-edge:] = np.nan
    return _Arm(movement, squared, _opened(jaw, start_ns, movement.seconds))


def _opened(jaw: Signal, start_ns: int, seconds: Floats) -> Ints:
    """Return whether a jaw is open (1) or closed (0) at each time; it stays as it is in the dead band."""
    grid_s, smooth = smoothed_tip((jaw.stamps_ns - start_ns) / 1e9, jaw.values[:, None], SMOOTHING_S)
    angle = np.interp(seconds, grid_s, smooth[:, 0])
    closed, opened = np.quantile(angle, JAW_RANGE)
    if not opened - closed >= JAW_LEAST_RAD:
        return np.zeros(len(angle), np.int64)
    relative = (angle - closed) / (opened - closed) - 0.5
    decided = np.flatnonzero(np.abs(relative) > JAW_DEAD_BAND)
    latest = np.searchsorted(decided, np.arange(len(angle)), side="right").clip(1) - 1
    return np.asarray(relative[decided[latest]] > 0, np.int64)


def _figures(arms: list[_Arm], first: float, last: float) -> Floats:
    """Return the figures between two shares of the time, averaged over the arms: shape (F,)."""
    shared = list(_of_both(arms, first, last))
    each = [(*_of_arm(arm, first, last), *shared) for arm in arms]
    modelled = [[kind.modelled(one) for kind, one in zip(TRIAL_KINDS, values, strict=True)] for values in each]
    return np.asarray(np.mean(modelled, axis=0))


def _part(count: int, first: float, last: float) -> slice:
    return slice(round(first * count), round(last * count))


def _of_arm(arm: _Arm, first: float, last: float) -> Iterator[float]:
    """Yield the figures of one arm, the first ones of `TRIAL_KINDS` in their order."""
    movement = arm.movement
    part = _part(len(movement.seconds), first, last)
    speed, turning = movement.speed_mm_s[part], movement.turning_rad_s[part]
    duration_s = float(movement.seconds[part][-1] - movement.seconds[part][0])
    mean, peak = (max(STILL_MM_S, float(one)) for one in (speed.mean(), speed.max()))
    squared = max(STILL_MM_S3**2, float(np.nanmean(arm.jerk_squared[part])))
    middle, before, after = speed[1:-1], speed[:-2], speed[2:]
    peaks = int(((middle > before) & (middle >= after) & (middle > mean)).sum())
    turn_rad = max(STILL_RAD_S, float(turning.mean())) * duration_s
    yield duration_s
    yield mean * duration_s
    yield mean
    yield max(STILL_MM_S, float(np.quantile(speed, FAST)))
    yield float(speed.std() / mean)
    yield float((speed < MOVING_MM_S).mean())
    yield int(((speed[1:] < MOVING_MM_S) & (speed[:-1] >= MOVING_MM_S)).sum())
    yield peaks
    yield peaks / duration_s
    yield float(-np.log(squared * duration_s**4 / peak**2))
    yield np.sqrt(squared) / mean
    yield turn_rad
    yield turn_rad / (mean * duration_s)
    yield float(np.sqrt(np.linalg.det(np.cov(movement.tip_mm[part].T)).clip(0.0)))
    yield int((np.diff(arm.open[part]) != 0).sum())


def _of_both(arms: list[_Arm], first: float, last: float) -> Iterator[float]:
    """Yield the figures of both arms of a side together, the last ones of `TRIAL_KINDS` in their order."""
    one, other = (arm.movement for arm in arms)
    part = _part(len(one.seconds), first, last)
    speeds = np.stack([one.speed_mm_s, np.interp(one.seconds, other.seconds, other.speed_mm_s)])[:, part]
    yield float((speeds > TOGETHER_MM_S).all(axis=0).mean())
    varies = (np.ptp(speeds, axis=1) > STILL_MM_S).all()
    yield float(np.corrcoef(speeds)[0, 1]) if varies else 0.0
