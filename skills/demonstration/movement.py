"""Movement and rest of a tip: speeds without tremor, onset and offset, smoothness, and pauses of the drive.

A held hand trembles at 8 to 12 Hz and drifts by about a millimetre per second, so speeds are computed from positions
averaged by a Hann window. A movement starts and stops too slowly for a threshold above that drift to detect its ends.
Near its ends the speed of a minimum-jerk movement grows with the square of time (Flash and Hogan, 1985), so the square
root of the speed is extrapolated linearly to zero (`onset`, `offset`). The thresholds are ours; the paper cut by hand.

Smoothness is the spectral arc length of the speed profile v:

    SPARC = - integral from 0 to w_c of sqrt( (1 / w_c)^2 + (dV/dw)^2 ) dw,   V(w) = |FFT(v)| / |FFT(v)(0)|

after Balasubramanian, Melendez-Calderon, Roby-Brami and Burdet, "On the analysis of movement smoothness", Journal of
NeuroEngineering and Rehabilitation 12:112 (2015); the code is ours, the three parameters are theirs. A movement that
starts and stops has more ripples in its spectrum, so a longer arc and a lower value. One minimum-jerk stroke has -1.41.
SPARC has no unit, does not depend on the distance or the speed of the movement, and, unlike jerk, depends little on
noise.

A *pause* is an interval of a recording in which an arm was not driven.

    Recording --undriven--> pauses and their causes, in the recording's own nanoseconds, both ends included

The arm is not driven while the clutch is pressed or teleoperation does not follow. With the clutch down the surgeon
repositions the masters while the PSM stands still or is pushed a little: its motion then was not demonstrated. A quick
tap of the pedal is a command to the console and no pause.
"""

from bisect import bisect_left
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import pi
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skills.arithmetic import cos
from skills.arrays import Flags, Floats, Ints
from skills.demonstration.recording import Recording, Signal
from skills.quaternions import INVERSE, angle_of, multiplied

MOVING_MM_S = 2.0  # above the drift of a held hand, far below the 20-90 mm/s of a hand-off
TURNING_RAD_S = 0.15  # 9 degrees/s: above an unsteady wrist, below the 45 degrees/s of an intended turn
SMOOTHING_S = 0.5  # a Hann window this wide takes 8-12 Hz tremor out
GRID_STEP_S = 0.01
GRID_LIMIT = 1_000_000  # samples, so that a stamp that is years off does not exhaust memory
LOOK_S = 1.5  # the onset is fitted to the first 1.5 s of a movement
FURTHEST_S = 0.5  # longest extrapolation: a longer one would follow drift and tremor
LOW, HIGH = 0.1, 0.5  # of the peak speed within LOOK_S: the line is fitted between these two
_LOOK = round(LOOK_S / GRID_STEP_S)

Span = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Movement:
    """The motion of one arm over time, without tremor.

    Attributes:
        seconds: Evenly spaced times, shape (N,).
        tip_mm: Smoothed positions, shape (N, 3).
        speed_mm_s: Speed of the smoothed tip, shape (N,).
        rotation_xyzw: Smoothed orientations, unit quaternions, shape (N, 4); None if not recorded.
        turning_rad_s: Angular speed, shape (N,); 0 if no orientation was recorded.
        moving_mm_s: Speed above which the tip counts as moving: `MOVING_MM_S`, or more if even the rests are faster.
    """

    seconds: Floats
    tip_mm: Floats
    speed_mm_s: Floats
    rotation_xyzw: Floats | None
    turning_rad_s: Floats
    moving_mm_s: float

    def index(self, second: float) -> int:
        """Return the index of the sample nearest to a time in s."""
        after = min(max(bisect_left(self.seconds, second), 1), len(self.seconds) - 1)
        before = after - 1
        return before if second - self.seconds[before] <= self.seconds[after] - second else after

    def turn_rad(self, start_s: float, end_s: float) -> float:
        """Return the angle between the orientations at two times in s; 0 if no orientation was recorded."""
        if self.rotation_xyzw is None:
            return 0.0
        first, last = (self.rotation_xyzw[self.index(second)] for second in (start_s, end_s))
        return float(angle_of(multiplied(first * INVERSE, last)))

    def extent_mm(self, start_s: float, end_s: float) -> float:
        """Return the longest side of the box around the path between two times in s."""
        return float(np.ptp(self.tip_mm[self.index(start_s) : self.index(end_s) + 1], axis=0).max())


def movement_of(seconds: Floats, tip_mm: Floats, rotation_xyzw: Floats | None) -> Movement:
    """Smooth a motion and compute its speeds.

    Args:
        seconds: Time stamps from any origin, shape (T,), strictly increasing, T at least 1.
        tip_mm: Positions of the tip in one frame, shape (T, 3).
        rotation_xyzw: Unit quaternions in the same frame, shape (T, 4), or None.

    Returns:
        The smoothed motion on evenly spaced times.
    """
    grid_s, tip_mm = smoothed_tip(seconds, tip_mm, SMOOTHING_S)
    speed = _rate(grid_s, tip_mm)
    calm, fast = np.quantile(speed, (0.1, 0.95)).tolist()
    # A hand that never rests raises the threshold, but to no more than a tenth of its fast movements.
    moving_mm_s = max(MOVING_MM_S, min(3.0 * calm, 0.1 * fast))
    if rotation_xyzw is None:
        return Movement(grid_s, tip_mm, speed, None, np.zeros(len(grid_s)), moving_mm_s)
    rotation = smoothed_tip(seconds, same_signs(rotation_xyzw), SMOOTHING_S)[1]
    # The mean of unit quaternions is shorter than 1.
    rotation = rotation / np.linalg.norm(rotation, axis=1, keepdims=True).clip(1e-12)
    return Movement(grid_s, tip_mm, speed, rotation, 2.0 * _rate(grid_s, rotation), moving_mm_s)


def smoothed_speed(seconds: Floats, tip_mm: Floats) -> tuple[Floats, Floats]:
    """Return the tip's speed without tremor at evenly spaced times.

    Args:
        seconds: Time stamps, shape (T,), strictly increasing, T at least 1.
        tip_mm: Positions of the tip, shape (T, 3).

    Returns:
        Times in s and speeds in mm/s, both of shape (N,).
    """
    grid_s, smooth = smoothed_tip(seconds, tip_mm, SMOOTHING_S)
    return grid_s, _rate(grid_s, smooth)


def smoothed_tip(seconds: Floats, tip_mm: Floats, window_s: float) -> tuple[Floats, Floats]:
    """Return the tip averaged by a Hann window at evenly spaced times.

    Args:
        seconds: Time stamps, shape (T,), strictly increasing, T at least 1.
        tip_mm: Positions of the tip, shape (T, 3), or values with any other number of columns.
        window_s: Full width of the window; of a movement faster than 2 / `window_s`, in Hz, little is left.

    Returns:
        Times in s, shape (N,), and positions in mm, shape (N, 3).
    """
    duration = float(seconds[-1] - seconds[0])
    count = int(min(duration / GRID_STEP_S, GRID_LIMIT)) + 2
    grid_s = np.linspace(seconds[0], seconds[-1], count)
    step_s = duration / (count - 1)
    # The bound in grid steps keeps the window small: with samples nanoseconds apart it would take gigabytes.
    half = 0 if duration == 0 else int(min(window_s / step_s / 2, window_s / GRID_STEP_S))
    window = 0.5 - 0.5 * cos(np.arange(1, 2 * half + 2) * (pi / (half + 1)))
    even = [np.interp(grid_s, seconds, axis) for axis in tip_mm.T]
    rested = np.pad(np.stack(even, axis=1), ((half, half), (0, 0)), mode="edge")
    window = window / window.sum()
    smooth = sum(weight * rested[at : at + count] for at, weight in enumerate(window.tolist()))
    return grid_s, np.asarray(smooth)


def lengths_along(points: Floats) -> Floats:
    """Return the length of a path from its first point to each of its points.

    Args:
        points: The path, shape (T, 3), in any unit.

    Returns:
        Lengths in that unit, shape (T,), from 0.
    """
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))


def spans_of(seconds: Floats, on: Flags) -> list[Span]:
    """Return the intervals in which a condition holds, each from its first sample to its last.

    Args:
        seconds: Times, shape (N,), increasing.
        on: The condition at each time, shape (N,).

    Returns:
        Start and end of each interval in s, in order of time.
    """
    return [(float(seconds[first]), float(seconds[end - 1])) for first, end in runs(on)]


def runs(on: Flags) -> list[tuple[int, int]]:
    """Return the runs of samples in which a condition holds.

    Args:
        on: The condition at each sample, shape (N,).

    Returns:
        First index and end, exclusive, of each run, in order.
    """
    edges = np.flatnonzero(np.diff(np.concatenate(([False], on, [False])).astype(np.int8)))
    return [(first, end) for first, end in edges.reshape(-1, 2).tolist()]


def bridged(spans: list[Span], pause_s: float, also: Callable[[float, float], bool] | None = None) -> list[Span]:
    """Join neighbours whose gap is shorter than a pause.

    Args:
        spans: Start and end of each interval in s, in order of the starts.
        pause_s: The shortest gap that divides.
        also: Return of a longer gap, from its start and its end, whether its neighbours are joined too.
    """
    joined: list[Span] = []
    for start, end in spans:
        if joined and (start - joined[-1][1] < pause_s or (also and also(joined[-1][1], start))):
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((start, end))
    return joined


def inside(times: NDArray[Any], spans: Iterable[tuple[float, float]]) -> Flags:
    """Return for each time whether it lies in one of the intervals, both ends included.

    Args:
        times: In s or ns, shape (N,), increasing.
        spans: Start and end of each interval in the same unit; one without a sample, or that ends before, is empty.

    Returns:
        Flags of shape (N,).
    """
    # The shape and the type are given because the list may be empty, and floats of nanoseconds are not exact.
    bounds, count = np.array(list(spans), times.dtype).reshape(-1, 2), len(times)
    firsts, ends = np.searchsorted(times, bounds[:, 0]), np.searchsorted(times, bounds[:, 1], "right")
    some = firsts < ends
    steps = np.bincount(firsts[some], minlength=count + 1) - np.bincount(ends[some], minlength=count + 1)
    return np.asarray(np.cumsum(steps)[:count] > 0)


def onset(seconds: Floats, speed: Floats, seen: int, least: float) -> float:
    """Estimate the time at which a movement begins, which is before its speed first exceeds a threshold.

    Args:
        seconds: Evenly spaced times, shape (N,).
        speed: Speed in any unit, shape (N,).
        seen: Index of the first sample above the threshold.
        least: The threshold, in the unit of `speed`.

    Returns:
        The time in s. The extrapolation goes back by at most `FURTHEST_S` from the first sample of the fit.
    """
    ahead = speed[seen : seen + _LOOK]
    ahead = ahead[: int(np.argmax(ahead < least)) or None]  # without the next movement, whose peak may be higher
    low, high = max(least, LOW * float(ahead.max())), HIGH * float(ahead.max())
    if high <= low:
        return float(seconds[seen])
    first, second = int(np.argmax(ahead >= low)), int(np.argmax(ahead >= high))
    root_low, root_high = np.sqrt(ahead[[first, second]])
    if second == first or root_high <= root_low:
        return float(seconds[seen + first])
    at, later = float(seconds[seen + first]), float(seconds[seen + second])
    return at - min(FURTHEST_S, (later - at) * float(root_low / (root_high - root_low)))


def offset(seconds: Floats, speed: Floats, seen: int, least: float) -> float:
    """Estimate the time at which a movement ends: `onset` with time reversed.

    Args:
        seconds: Evenly spaced times, shape (N,).
        speed: Speed in any unit, shape (N,).
        seen: Index of the last sample above the threshold.
        least: The threshold, in the unit of `speed`.

    Returns:
        The time in s.
    """
    before = slice(max(0, seen + 1 - _LOOK), seen + 1)
    return -onset(-seconds[before][::-1], speed[before][::-1], 0, least)


def same_signs(rotation_xyzw: Floats) -> Floats:
    """Choose the signs of quaternions so that neighbours agree; q and -q are the same orientation.

    Args:
        rotation_xyzw: Unit quaternions in order of time, shape (T, 4).

    Returns:
        The same orientations, shape (T, 4), neighbours with a dot product that is not negative.
    """
    flips = np.where((rotation_xyzw[1:] * rotation_xyzw[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return np.asarray(rotation_xyzw * np.append(1.0, np.cumprod(flips))[:, None])


def _rate(grid_s: Floats, values: Floats) -> Floats:
    """Return the norm of the time derivative of rows, (N, K): shape (N,)."""
    if grid_s[-1] == grid_s[0]:
        return np.zeros(len(grid_s))
    step_s = float(grid_s[-1] - grid_s[0]) / (len(grid_s) - 1)
    return np.asarray(np.linalg.norm(np.gradient(values, step_s, axis=0), axis=1))


CUT_OFF_HZ = 10.0  # the highest frequency that is considered
LEAST_AMPLITUDE = 0.05  # w_c is the highest frequency at which V is at least this
PADDING = 4  # zero-padded to 2^4 times its length (rounded up to a power of 2), so that the arc is sampled finely


def spectral_arc_length(speed: ArrayLike, step_s: float) -> float | None:
    """Return the smoothness of a speed profile: negative, and the nearer to 0 the smoother.

    Args:
        speed: Speed at evenly spaced times, in any unit, shape (N,).
        step_s: The time between two samples.

    Returns:
        The spectral arc length, without unit; None if nothing moved or the profile is too short to have a spectrum.
    """
    profile = np.asarray(speed, float)
    if len(profile) < 2 or not step_s > 0 or not profile.sum() > 0:
        return None
    padded = 2 ** (int(np.ceil(np.log2(len(profile)))) + PADDING)
    amplitude = np.abs(np.fft.rfft(profile, padded))
    hertz = np.fft.rfftfreq(padded, step_s)
    seen = hertz <= CUT_OFF_HZ
    shape, hertz = amplitude[seen] / amplitude[0], hertz[seen]
    last = int(np.flatnonzero(shape >= LEAST_AMPLITUDE)[-1])
    if last == 0:
        return None
    along = np.diff(hertz[: last + 1]) / hertz[last]
    return float(-np.hypot(along, np.diff(shape[: last + 1])).sum())


Cause = Literal["clutch", "not following"]
Nanoseconds = tuple[int, int]
FOREVER_NS = int(np.iinfo(np.int64).max)


@dataclass(frozen=True)
class Pause:
    """An interval in which the arm was not driven, in seconds from a demonstration's first sample, and its cause."""

    start_s: float
    end_s: float
    cause: Cause


def press_times(clutch: Signal) -> list[tuple[int, int | None]]:
    """Return the presses of a pedal, without quick taps (2).

    Args:
        clutch: State of the pedal over time: 0 released, 1 pressed, 2 a quick tap.

    Returns:
        The times in ns at which the pedal went down and up again; None for the second if it never went up.
    """
    presses: list[tuple[int, int | None]] = []
    down_ns: int | None = None
    for stamp_ns, value in zip(clutch.stamps_ns.tolist(), clutch.values.tolist(), strict=True):
        if value == 1 and down_ns is None:
            down_ns = stamp_ns
        elif value == 0 and down_ns is not None:
            presses.append((down_ns, stamp_ns))
            down_ns = None
    if down_ns is not None:
        presses.append((down_ns, None))
    return presses


def clutched(recording: Recording) -> list[Nanoseconds]:
    """Return the intervals in which the clutch was down, in ns; the end is `FOREVER_NS` if it never went up again.

    Args:
        recording: The recording; without a clutch there is no interval.
    """
    if recording.clutch is None:
        return []
    return [(down_ns, FOREVER_NS if up_ns is None else up_ns) for down_ns, up_ns in press_times(recording.clutch)]


def not_following(recording: Recording, arm: str) -> list[Nanoseconds]:
    """Return the intervals in which no teleoperation drove the arm.

    If no teleoperation ever reports that it follows, nothing is known, because another program may have driven the arm:
    there are no intervals then. Before its first message a teleoperation is assumed to have followed.

    Args:
        recording: The recording.
        arm: Name of the arm, such as "PSM2".

    Returns:
        Start and end of each interval in ns; the end is `FOREVER_NS` if the arm was not driven again.
    """
    signals = [signal for name, signal in recording.following if name.rsplit("_", 1)[-1] == arm and len(signal.values)]
    if not any((signal.values == 1).any() for signal in signals):
        return []
    stamps_ns = np.unique(np.concatenate([signal.stamps_ns for signal in signals]))
    stopped = np.all([_not_following_at(signal, stamps_ns) for signal in signals], axis=0)
    until_ns = np.append(stamps_ns, FOREVER_NS)
    return [(int(stamps_ns[first]), int(until_ns[end])) for first, end in runs(stopped)]


def undriven(recording: Recording, arm: str) -> list[tuple[int, int, Cause]]:
    """Return the intervals in which the arm was not driven, disjoint and in order of time.

    Args:
        recording: The recording.
        arm: Name of the arm, such as "PSM2".

    Returns:
        Start and end of each interval in ns, and its cause: "clutch" if the pedal was pressed in any part of it.
    """
    clutch: list[tuple[int, int, Cause]] = [(a, b, "clutch") for a, b in clutched(recording)]
    stopped: list[tuple[int, int, Cause]] = [(a, b, "not following") for a, b in not_following(recording, arm)]
    joined: list[tuple[int, int, Cause]] = []
    for start, end, cause in sorted(clutch + stopped):
        if joined and start <= joined[-1][1]:
            before = joined.pop()
            both: Cause = "clutch" if "clutch" in (cause, before[2]) else "not following"
            joined.append((before[0], max(end, before[1]), both))
        else:
            joined.append((start, end, cause))
    return joined


def is_driven(stamps_ns: Ints, pauses: list[tuple[int, int, Cause]]) -> Flags:
    """Return for each sample whether the arm was driven.

    Args:
        stamps_ns: Time of each sample, shape (T,), increasing.
        pauses: Intervals in which the arm was not driven, as `undriven` returns them.

    Returns:
        Flags of shape (T,).
    """
    return ~inside(stamps_ns, ((start, end) for start, end, _ in pauses))


def _not_following_at(following: Signal, stamps_ns: Ints) -> Flags:
    """Return for each stamp, (T,), whether the last message of a teleoperation was that it does not follow."""
    last = np.searchsorted(following.stamps_ns, stamps_ns, side="right") - 1
    return np.asarray((last >= 0) & (following.values[last] != 1))
