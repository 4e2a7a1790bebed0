"""When the surgeon's hand did not drive the arm: the clutch was pressed, or teleoperation did not follow.

With the clutch down the masters are put elsewhere while the PSM stands still, or is pushed a little: what it does then
was not demonstrated. A quick tap of the pedal is a command to the console and no pause. All in the recording's own
nanoseconds; a pause holds both its ends.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from skills.style._arrays import Ints
from skills.style.movement import Flags
from skills.style.recording import Recording, Signal

Cause = Literal["clutch", "not following"]
Nanoseconds = tuple[int, int]
FOREVER_NS = int(np.iinfo(np.int64).max)


@dataclass(frozen=True)
class Pause:
    """A stretch in which the arm was not driven, in seconds from a demonstration's first sample, and why."""

    start_s: float
    end_s: float
    cause: Cause


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


def clutched(recording: Recording) -> list[Nanoseconds]:
    """Return when the clutch was down; without end where it never went up again."""
    if recording.clutch is None:
        return []
    return [(down_ns, FOREVER_NS if up_ns is None else up_ns) for down_ns, up_ns in press_times(recording.clutch)]


def not_following(recording: Recording, arm: str) -> list[Nanoseconds]:
    """Return when no teleoperation drove the arm.

    Where none ever says that it does, nothing is known: the arm may have been driven by another program. Before the
    first word of a teleoperation it may have followed.
    """
    told = [signal for name, signal in recording.following if name.rsplit("_", 1)[-1] == arm and len(signal.values)]
    if not any((signal.values == 1).any() for signal in told):
        return []
    stamps_ns = np.unique(np.concatenate([signal.stamps_ns for signal in told]))
    stopped = np.all([_says_no(signal, stamps_ns) for signal in told], axis=0)
    edges = np.diff(np.concatenate(([False], stopped, [False])).astype(np.int8))
    until_ns = np.append(stamps_ns, FOREVER_NS)
    spans = zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True)
    return [(int(stamps_ns[a]), int(until_ns[b])) for a, b in spans]


def undriven(recording: Recording, arm: str) -> list[tuple[int, int, Cause]]:
    """Return when the arm was not driven, in order and apart from each other; a pause with a press is a clutch's."""
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
    """Tell for each stamp, shape (T,), whether the arm was driven then."""
    driven = np.ones(len(stamps_ns), dtype=bool)
    for start, end, _ in pauses:
        driven[np.searchsorted(stamps_ns, start) : np.searchsorted(stamps_ns, end, side="right")] = False
    return driven


def _says_no(following: Signal, stamps_ns: Ints) -> Flags:
    """Tell for each stamp, (T,), whether a teleoperation has last said that it does not follow."""
    last = np.searchsorted(following.stamps_ns, stamps_ns, side="right") - 1
    return np.asarray((last >= 0) & (following.values[last] != 1))
