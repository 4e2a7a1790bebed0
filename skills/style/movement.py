"""When a tip moves and when it rests: speeds without tremor, and the moments at which a movement begins and ends.

A held hand trembles at 8 to 12 Hz and drifts by a millimetre a second, so speeds are taken of positions averaged by a
Hann window. A movement starts and stops more slowly than any threshold above that drift can see. Near its ends a
minimum-jerk movement's speed grows with the square of time (Flash and Hogan, 1985), so the square root of the speed is
continued in a straight line to where it is zero. The thresholds are ours; the paper cut by hand.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skills.style._arrays import Floats

MOVING_MM_S = 2.0  # above the drift of a held hand, far below the 20-90 mm/s of a hand-off
TURNING_RAD_S = 0.15  # 9 degrees a second: above an unsteady wrist, below the 45 of a jaw that is turned
SMOOTHING_S = 0.5  # a Hann window this wide takes 8-12 Hz tremor out
GRID_STEP_S = 0.01
GRID_LIMIT = 1_000_000  # samples, so that a stamp years away costs no memory
LOOK_S = 1.5  # how much of a movement says how it begins
FURTHEST_S = 0.5  # a movement is continued back by no more: further off, drift and tremor are drawn as well
LOW, HIGH = 0.1, 0.5  # of the greatest speed in that time: between these the square root is drawn
_LOOK = round(LOOK_S / GRID_STEP_S)

Span = tuple[float, float]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Movement:
    """How one arm moves over time, without tremor.

    Attributes:
        seconds: An even grid of times, shape (N,).
        tip_mm: Smoothed positions, shape (N, 3).
        speed_mm_s: Shape (N,).
        rotation_xyzw: Smoothed orientations, unit quaternions, shape (N, 4); None where not recorded.
        turning_rad_s: Angular speed, shape (N,); 0 where no orientation was recorded.
        moving_mm_s: The speed above which the tip moves: `MOVING_MM_S`, or more where even its rests are faster.
    """

    seconds: Floats
    tip_mm: Floats
    speed_mm_s: Floats
    rotation_xyzw: Floats | None
    turning_rad_s: Floats
    moving_mm_s: float

    def index(self, second: float) -> int:
        """Find the grid's sample nearest to a time."""
        after = int(np.searchsorted(self.seconds, second).clip(1, len(self.seconds) - 1))
        before = after - 1
        return before if second - self.seconds[before] <= self.seconds[after] - second else after

    def turn_rad(self, start_s: float, end_s: float) -> float:
        """Measure the angle between the orientations at two times; 0 where none was recorded."""
        if self.rotation_xyzw is None:
            return 0.0
        return angle_between(self.rotation_xyzw[self.index(start_s)], self.rotation_xyzw[self.index(end_s)])

    def extent_mm(self, start_s: float, end_s: float) -> float:
        """Measure the longest side of the box around the path between two times."""
        return float(np.ptp(self.tip_mm[self.index(start_s) : self.index(end_s) + 1], axis=0).max())


def movement_of(seconds: Floats, tip_mm: Floats, rotation_xyzw: Floats | None) -> Movement:
    """Smooth a motion and measure its speeds.

    Args:
        seconds: Its stamps from any zero, shape (T,), strictly increasing, T at least 1.
        tip_mm: Shape (T, 3).
        rotation_xyzw: Unit quaternions, shape (T, 4), or None.
    """
    grid_s, tip_mm = smoothed_tip(seconds, tip_mm, SMOOTHING_S)
    speed = _rate(grid_s, tip_mm)
    calm, fast = np.quantile(speed, (0.1, 0.95)).tolist()
    moving_mm_s = max(MOVING_MM_S, min(3.0 * calm, 0.1 * fast))
    if rotation_xyzw is None:
        return Movement(grid_s, tip_mm, speed, None, np.zeros(len(grid_s)), moving_mm_s)
    rotation = smoothed_tip(seconds, same_signs(rotation_xyzw), SMOOTHING_S)[1]
    rotation = rotation / np.linalg.norm(rotation, axis=1, keepdims=True).clip(1e-12)
    return Movement(grid_s, tip_mm, speed, rotation, 2.0 * _rate(grid_s, rotation), moving_mm_s)


def smoothed_speed(seconds: Floats, tip_mm: Floats) -> tuple[Floats, Floats]:
    """Return the tip's speed without tremor on an even grid of times.

    Args:
        seconds: Shape (T,), strictly increasing, T at least 1.
        tip_mm: Shape (T, 3).

    Returns:
        Times in s and speeds in mm/s, both of shape (N,).
    """
    grid_s, smooth = smoothed_tip(seconds, tip_mm, SMOOTHING_S)
    return grid_s, _rate(grid_s, smooth)


def smoothed_tip(seconds: Floats, tip_mm: Floats, window_s: float) -> tuple[Floats, Floats]:
    """Return the tip averaged by a Hann window of this width on an even grid of times.

    Args:
        seconds: Shape (T,), strictly increasing, T at least 1.
        tip_mm: Shape (T, 3), or of any other columns.
        window_s: The window's full width; of a movement faster than 2 / width, in Hz, little is left.

    Returns:
        Times in s, shape (N,), and positions in mm, shape (N, 3).
    """
    duration = float(seconds[-1] - seconds[0])
    count = int(min(duration / GRID_STEP_S, GRID_LIMIT)) + 2
    grid_s = np.linspace(seconds[0], seconds[-1], count)
    step_s = duration / (count - 1)
    # Samples nanoseconds apart would ask for a window of gigabytes.
    half = 0 if duration == 0 else int(min(window_s / step_s / 2, window_s / GRID_STEP_S))
    window = np.hanning(2 * half + 3)[1:-1]
    even = [np.interp(grid_s, seconds, axis) for axis in tip_mm.T]
    smooth = [np.convolve(np.pad(axis, half, mode="edge"), window / window.sum(), mode="valid") for axis in even]
    return grid_s, np.stack(smooth, axis=1)


def spans_of(seconds: Floats, on: Flags) -> list[Span]:
    """Return the stretches of time in which `on`, shape (N,), holds, each from its first sample to its last."""
    edges = np.diff(np.concatenate(([False], on, [False])).astype(np.int8))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return [(float(seconds[a]), float(seconds[b])) for a, b in zip(starts, ends, strict=True)]


def inside(seconds: Floats, spans: list[Span]) -> Flags:
    """Tell for each time, shape (N,), whether it lies in one of the spans, both ends included."""
    within = np.zeros(len(seconds), dtype=bool)
    for start, end in spans:
        within[np.searchsorted(seconds, start) : np.searchsorted(seconds, end, side="right")] = True
    return within


def onset(seconds: Floats, speed: Floats, seen: int, least: float) -> float:
    """Find when a movement begins that is first seen above a threshold.

    Args:
        seconds: An even grid of times, shape (N,).
        speed: In any unit, shape (N,).
        seen: The first sample above the threshold.
        least: The threshold.
    """
    ahead = speed[seen : seen + _LOOK]
    ahead = ahead[: int(np.argmax(ahead < least)) or None]  # this movement, not the next
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
    """Find when a movement ends that is last seen above a threshold: `onset`, with time turned round."""
    before = slice(max(0, seen + 1 - _LOOK), seen + 1)
    return -onset(-seconds[before][::-1], speed[before][::-1], 0, least)


def same_signs(rotation_xyzw: Floats) -> Floats:
    """Choose the sign of each quaternion, (T, 4), so that neighbours are alike; q and -q are the same orientation."""
    flips = np.where((rotation_xyzw[1:] * rotation_xyzw[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return np.asarray(rotation_xyzw * np.append(1.0, np.cumprod(flips))[:, None])


def angle_between(one_xyzw: Floats, other_xyzw: Floats) -> float:
    """Measure the angle, 0 to pi, between two orientations, unit quaternions of shape (4,)."""
    return float(2.0 * np.arccos(min(1.0, abs(float(one_xyzw @ other_xyzw)))))


def _rate(grid_s: Floats, values: Floats) -> Floats:
    """Measure how fast rows, (N, K), change with time: (N,)."""
    if grid_s[-1] == grid_s[0]:
        return np.zeros(len(grid_s))
    step_s = float(grid_s[-1] - grid_s[0]) / (len(grid_s) - 1)
    return np.asarray(np.linalg.norm(np.gradient(values, step_s, axis=0), axis=1))
