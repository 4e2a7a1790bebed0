"""Pauses: the intervals of a recording in which an arm was not driven.

    Recording --undriven--> intervals and their causes, in the recording's own nanoseconds, both ends included

The arm is not driven while the clutch is pressed or teleoperation does not follow. With the clutch down the surgeon
repositions the masters while the PSM stands still or is pushed a little: its motion then was not demonstrated. A quick
tap of the pedal is a command to the console and no pause.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from skills.arrays import Flags, Ints
from skills.demonstration.movement import covered
from skills.demonstration.recording import Recording, Signal

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
    """Return the intervals in which the clutch was down, in ns; the end is `FOREVER_NS` if it never went up again."""
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
    # The shape is given because without pauses the list is empty.
    bounds_ns = np.array([(start, end) for start, end, _ in pauses], dtype=np.int64).reshape(-1, 2)
    firsts, ends = np.searchsorted(stamps_ns, bounds_ns[:, 0]), np.searchsorted(stamps_ns, bounds_ns[:, 1], "right")
    return ~covered(len(stamps_ns), firsts, ends)


def _says_no(following: Signal, stamps_ns: Ints) -> Flags:
    """Return for each stamp, (T,), whether the last message of a teleoperation was that it does not follow."""
    last = np.searchsorted(following.stamps_ns, stamps_ns, side="right") - 1
    return np.asarray((last >= 0) & (following.values[last] != 1))
