"""Find the hand-offs of a recording by what the tip and the jaw do.

A stretch counts as moving while the smoothed speed is above `MOVING_MM_S`. Short pauses, and pauses in which the clutch
is pressed, belong to the motion around them. Where a jaw was recorded and really closes, only what is moved with the
jaw closed is kept: between two passes the jaw is open. All of it is ours; the paper cut by hand.
"""

from dataclasses import dataclass

import numpy as np

from skills.style._arrays import Floats
from skills.style.recording import Motion, Recording, Signal

MOVING_MM_S = 2.0  # above the drift of a held hand, far below the 20-90 mm/s of a hand-off
SMOOTHING_S = 0.5  # a Hann window this wide takes 8-12 Hz tremor out
PAUSE_S = 1.5  # a shorter rest is hesitation, not the end of a pass
LEAD_S = 0.25  # added at both ends: a movement starts and stops more slowly than the threshold sees
REGRIP_S = 0.3  # a shorter opening of the jaw is a new grip, not a release
SHORTEST_S = 0.5
SHORTEST_MM = 3.0
JAW_RANGE_RAD = 0.2  # a jaw that moves less never let go
GRID_STEP_S = 0.01
GRID_LIMIT = 1_000_000  # samples, so that a stamp years away costs no memory

Span = tuple[float, float]


@dataclass(frozen=True)
class Segment:
    """A part of a recording, in seconds since its `origin_ns`, and why it is proposed."""

    start_s: float
    end_s: float
    reason: str


def propose_segments(recording: Recording, arm: str | None = None) -> tuple[Segment, ...]:
    """Propose the hand-offs of one arm, in order of time.

    Raises:
        NoUsableTopic: There is no such arm, or several and none named.
    """
    motion = recording.motion_of(arm=arm)
    seconds = recording.seconds(motion.stamps_ns)
    grid_s, speed_mm_s = smoothed_speed(seconds, motion.tip_mm)
    bursts, clutched = _spans(grid_s, speed_mm_s > MOVING_MM_S), _clutched(recording)
    holding = _holding(recording, motion.arm)
    what = "the tip moves" if holding is None else "the tip moves with the jaw closed"
    return tuple(
        Segment(round(start, 6), round(end, 6), what + _pauses(bursts, start, end))
        for held in holding or [(float(seconds[0]), float(seconds[-1]))]
        for start, end in _widened(_bridged(_within(bursts, held), PAUSE_S, clutched), held)
        if _is_a_pass(motion, seconds, start, end)
    )


def smoothed_speed(seconds: Floats, tip_mm: Floats) -> tuple[Floats, Floats]:
    """Return the tip's speed without tremor on an even grid of times.

    Args:
        seconds: Shape (T,), strictly increasing, T at least 1.
        tip_mm: Shape (T, 3).

    Returns:
        Times in s and speeds in mm/s, both of shape (N,).
    """
    grid_s, smooth = smoothed_tip(seconds, tip_mm, SMOOTHING_S)
    if grid_s[-1] == grid_s[0]:
        return grid_s, np.zeros(len(grid_s))
    step_s = float(grid_s[-1] - grid_s[0]) / (len(grid_s) - 1)
    return grid_s, np.linalg.norm(np.gradient(smooth, step_s, axis=0), axis=1)


def smoothed_tip(seconds: Floats, tip_mm: Floats, window_s: float) -> tuple[Floats, Floats]:
    """Return the tip averaged by a Hann window of this width on an even grid of times.

    Args:
        seconds: Shape (T,), strictly increasing, T at least 1.
        tip_mm: Shape (T, 3).
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


def press_times(clutch: Signal) -> list[tuple[int, int | None]]:
    """Return when the pedal went down and up again, in ns; None where it never did. Quick taps (2) are passed over."""
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


def _clutched(recording: Recording) -> list[Span]:
    if recording.clutch is None:
        return []
    origin_ns, forever = recording.origin_ns, float("inf")
    return [
        ((down - origin_ns) / 1e9, forever if up is None else (up - origin_ns) / 1e9)
        for down, up in press_times(recording.clutch)
    ]


def _holding(recording: Recording, arm: str) -> list[Span] | None:
    """Return when the jaw is closed: below the middle of its range; None where that cannot be told."""
    jaw = recording.jaw_of(arm)
    if jaw is None or len(jaw.values) == 0 or np.ptp(jaw.values) < JAW_RANGE_RAD:
        return None
    middle = (float(jaw.values.min()) + float(jaw.values.max())) / 2.0
    return _bridged(_spans(recording.seconds(jaw.stamps_ns), jaw.values < middle), REGRIP_S, [])


def _spans(seconds: Floats, on: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> list[Span]:
    """Return the stretches of time in which `on` holds, each from its first sample to its last."""
    edges = np.diff(np.concatenate(([False], on, [False])).astype(np.int8))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return [(float(seconds[a]), float(seconds[b])) for a, b in zip(starts, ends, strict=True)]


def _bridged(spans: list[Span], pause_s: float, clutched: list[Span]) -> list[Span]:
    """Join neighbours whose gap is shorter than `pause_s` or has the clutch pressed in it."""
    joined: list[Span] = []
    for start, end in spans:
        if joined and (start - joined[-1][1] < pause_s or _meets(clutched, joined[-1][1], start)):
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((start, end))
    return joined


def _within(spans: list[Span], limits: Span) -> list[Span]:
    cut = [(max(start, limits[0]), min(end, limits[1])) for start, end in spans]
    return [(start, end) for start, end in cut if start < end]


def _widened(spans: list[Span], limits: Span) -> list[Span]:
    return [(max(limits[0], start - LEAD_S), min(limits[1], end + LEAD_S)) for start, end in spans]


def _meets(spans: list[Span], start: float, end: float) -> bool:
    return any(a < end and b > start for a, b in spans)


def _is_a_pass(motion: Motion, seconds: Floats, start: float, end: float) -> bool:
    tips = motion.tip_mm[(seconds >= start) & (seconds <= end)]
    return end - start >= SHORTEST_S and len(tips) > 1 and bool(np.ptp(tips, axis=0).max() >= SHORTEST_MM)


def _pauses(bursts: list[Span], start: float, end: float) -> str:
    inside = sum(a < end and b > start for a, b in bursts) - 1
    if inside < 1:
        return ""
    return f"; {inside} short or clutched pause{'s' if inside > 1 else ''} belong{'' if inside > 1 else 's'} to it"
