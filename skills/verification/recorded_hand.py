"""The recorded hand, moment by moment: its mean over a short time, and its samples' spread about a steady motion.

    Demo --RecordedHand.of--> RecordedHand

A motion that repeats a hand may average it over a quarter of a second, to leave out its tremor. So it is compared not
with a sample but with those of half of that before and after. An even average of a steady motion is its middle; so what
an average can be off their mean is how far they lie from a straight and steady motion through it. That is the spread,
and the way of one step: the nearest moment is up to half a step away. All of this is ours; planning uses none of it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from skills.arrays import Flags, Floats, Ints, interpolated
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import runs, same_signs
from skills.kinematics import angle_between, instrument_of, matrix_of

# Ours: planning averages a hand over a quarter of a second, and its tip twice.
HALF_S = 0.25
AVERAGED_S = 0.125  # to either side
REST_S = 0.125  # a hand rests for so long before its first sample and after its last
SLOW = 0.1  # of the hand's greatest speed: where it was slower, an arm may stand
MOMENTS = 240  # at most so many of an interval are compared
_STEP_S = 0.02


@dataclass(frozen=True, eq=False)
class RecordedHand:
    """A recorded hand at even times, N of them: means over `AVERAGED_S` to either side, and their spread.

    Attributes:
        seconds: The times, from before its first sample to after its last.
        tip_mm: Mean of the tip, shape (N, 3).
        tip_spread_mm: Greatest distance from a steady motion, shape (N,).
        turned: Mean rotation, shape (N, 3, 3), and `turned_spread_deg`; None if not recorded.
        opened: Mean angle of the jaw, shape (N,), and `opened_spread`; None if it was not recorded or has another zero.
        slow_s: Seconds for which the tip was slow, without a break, around each time, shape (N,).
        calm_s: The same of tip and jaw.
    """

    seconds: Floats
    tip_mm: Floats
    tip_spread_mm: Floats
    turned: Floats | None
    turned_spread_deg: Floats
    opened: Floats | None
    opened_spread: Floats
    slow_s: Floats
    calm_s: Floats

    @classmethod
    def of(cls, demo: Demo) -> "RecordedHand":
        """Return the moments of a demonstration."""
        half, before = round(AVERAGED_S / _STEP_S), np.ceil((HALF_S + 2 * REST_S) / _STEP_S)
        count = int(np.ceil(demo.stamps_s[-1] / _STEP_S) + 2 * before + 1)
        fine_s = (np.arange(count) - before) * _STEP_S
        seconds = fine_s[half:-half]
        tip, tip_spread = _spread(interpolated(fine_s, demo.stamps_s, demo.tip_mm), half)
        speed = np.linalg.norm(np.gradient(tip, axis=0), axis=1)
        slow = speed <= SLOW * speed.max()
        calm, turned, turned_spread = slow, None, np.zeros(len(seconds))
        if demo.rotation_xyzw is not None:
            near = interpolated(fine_s, demo.stamps_s, same_signs(demo.rotation_xyzw))
            mean, apart = _spread(near / np.linalg.norm(near, axis=1, keepdims=True), half)
            turned = matrix_of(mean / np.linalg.norm(mean, axis=1, keepdims=True))
            turned_spread = np.degrees(2 * apart)  # a unit quaternion moves by half of the angle
            rate = np.append(0.0, angle_between(turned[:-1], turned[1:]))
            calm = slow & (rate <= SLOW * rate.max())
        low, high = instrument_of(demo.instrument).jaw_rad
        opened, opened_spread = None, np.zeros(len(seconds))
        if demo.jaw_rad is not None and low <= float(np.median(demo.jaw_rad)) <= high:
            opened, opened_spread = _spread(
                np.interp(fine_s, demo.stamps_s, demo.jaw_rad.clip(low, high))[:, None], half
            )
            opened = opened[:, 0]
        return cls(
            seconds, tip, tip_spread, turned, turned_spread, opened, opened_spread, _unbroken_s(slow), _unbroken_s(calm)
        )

    def index(self, seconds: Floats) -> Ints:
        """Return the nearest moments, shape (T,); NaN and times beyond the ends give an end."""
        steps = (seconds - self.seconds[0]) / _STEP_S
        return np.asarray(np.nan_to_num(np.rint(steps)).clip(0, len(self.seconds) - 1), np.int64)

    def off_mm(self, tip_mm: Floats, at: Ints) -> Floats:
        """Return how far places, (T, 3), are beyond the spread of the nearest of the moments around some, (T,)."""
        half = round(AVERAGED_S / _STEP_S)
        near = (at[:, None] + np.arange(-half, half + 1)).clip(0, len(self.seconds) - 1)
        apart = np.linalg.norm(tip_mm[:, None] - self.tip_mm[near], axis=2) - self.tip_spread_mm[near]
        return np.asarray(apart.min(axis=1))

    def between(self, begin_s: float, end_s: float) -> Ints:
        """Return moments from one time to another and `HALF_S` around them, 1 to `MOMENTS`."""
        edges = np.array([begin_s - HALF_S, end_s + HALF_S]).clip(self.seconds[0], self.seconds[-1])
        first, last = self.index(edges).tolist()
        return np.linspace(first, last, min(last - first + 1, MOMENTS)).astype(np.int64)


def _spread(values: Floats, half: int) -> tuple[Floats, Floats]:
    """Return the mean of rows, (N, D), over a window, and their spread within the window; see the module."""
    windows, steps = sliding_window_view(values, 2 * half + 1, axis=0), np.arange(-half, half + 1)
    mean, rate = windows.mean(axis=2), windows @ steps / (steps @ steps)
    off = windows - mean[:, :, None] - rate[:, :, None] * steps
    return mean, np.linalg.norm(off, axis=1).max(axis=1) + np.linalg.norm(rate, axis=1)


def _unbroken_s(slow: Flags) -> Floats:
    """Return the length of the run of slow moments around each, within `HALF_S` of it, shape (N,)."""
    lasting = np.zeros(len(slow))
    for begin, end in runs(slow):
        lasting[begin:end] = (end - begin) * _STEP_S
    half = 2 * round(HALF_S / _STEP_S)
    return np.asarray(sliding_window_view(np.pad(lasting, half), 2 * half + 1).max(axis=1))
