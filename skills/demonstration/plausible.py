"""Whether times and positions of a motion are possible for a PSM, or in another unit than they were read in.

    stamps_ns (T,), tip_mm (T, 3) --pace_of--> MotionPace: samples per second, and the speed of the tip

The *pace* speed is that of the path, not of the time: half of the path is travelled faster, so rests do not count, and
neither do a few samples with a late stamp. In all hand-offs and trials that we have it is 9 to 90 mm/s. It is
impossible above `TIP_MM_S`, which the joints of a PSM allow at full reach: hypot(r sqrt(2) 90 deg/s, 200 mm/s) + 9.1 mm
1080 deg/s = 832 mm/s with r = 283.5 mm, the speeds being those of the dVRK's own trajectories (sawIntuitiveResearchKit,
PSM.json and PSM_Si.json), rounded up. All other limits are ours.
"""

from typing import NamedTuple

import numpy as np

from skills.arrays import Floats, Ints
from skills.errors import ImplausibleMotion

TIP_MM_S = 1000.0
LATE_MM = 5.0  # a stamp that is late by 50 ms at 100 mm/s: what `DROPPED_GAP_NS` allows as well
LEAST_HZ = 5.0  # a tip at 100 mm/s moves by 20 mm between two samples
MOST_HZ = 100_000.0
USUAL_MM_S = (7.0, 120.0)
USUAL_HZ = 250.0  # of columns that record a motion above USUAL_MM_S: pictures have at most 60 Hz, the dVRK has 100
WINDOW_NS = 50_000_000
FURTHEST_NS = 10**18  # 31 years: no window is longer, so that a stamp and a window together are an int64
WINDOWS = 1000  # evenly spaced, however long the recording is


class MotionPace(NamedTuple):
    """Samples per second, from the median step, and the speed above which half of the path is travelled, in mm/s."""

    rate_hz: float
    speed_mm_s: float

    @property
    def is_usual(self) -> bool:
        """Whether a hand-off may have this pace."""
        least, most = USUAL_MM_S
        return LEAST_HZ <= self.rate_hz <= MOST_HZ and (self.speed_mm_s == 0.0 or least <= self.speed_mm_s <= most)

    def __str__(self) -> str:
        """Return it in words."""
        rate, speed = (f"{one:.3g}" if one < 1000 else f"{one:.0f}" for one in self)
        return f"{rate} poses per second, and half of the path at more than {speed} mm/s"


def pace_of(stamps_ns: Ints, tip_mm: Floats, factor: float = 1.0) -> MotionPace:
    """Measure the pace of a motion in windows of `WINDOW_NS`.

    Args:
        stamps_ns: Integer nanoseconds, shape (T,), strictly increasing, T at least 2.
        tip_mm: Positions, shape (T, 3).
        factor: By which the times are multiplied.
    """
    first = np.arange(0, len(stamps_ns) - 1, 1 + len(stamps_ns) // WINDOWS)
    after_ns = stamps_ns[first] + min(round(WINDOW_NS / factor), FURTHEST_NS)
    last = np.searchsorted(stamps_ns, after_ns).clip(first + 1, len(stamps_ns) - 1)
    moved = tip_mm[last] - tip_mm[first]
    way_mm = np.sqrt(np.einsum("ij,ij->i", moved, moved))
    lasted_s = (stamps_ns[last] - stamps_ns[first]) * (factor / 1e9)
    speed = way_mm / lasted_s
    order = np.argsort(speed)
    possible_mm = np.minimum(way_mm, TIP_MM_S * lasted_s + LATE_MM)  # so that no jump outweighs the rest
    travelled = np.cumsum(possible_mm[order])
    middle = order[np.searchsorted(travelled, travelled[-1] / 2)]
    step_ns = float(np.median(stamps_ns[first + 1] - stamps_ns[first]))
    return MotionPace(1e9 / (factor * step_ns), float(speed[middle]))


def check_steps(topic: str, stamps_s: Floats, tip_mm: Floats) -> None:
    """Refuse a motion with a step that no PSM makes in its time.

    Args:
        topic: The topic, for the message.
        stamps_s: Seconds since the recording's origin, shape (T,), strictly increasing.
        tip_mm: Positions, shape (T, 3).

    Raises:
        ImplausibleMotion: Between two samples the tip moves further than at `TIP_MM_S`, and by `LATE_MM` more.
    """
    steps_s, moved = np.diff(stamps_s), np.diff(tip_mm, axis=0)
    allowed_mm = TIP_MM_S * steps_s + LATE_MM
    over = np.einsum("ij,ij->i", moved, moved) > allowed_mm * allowed_mm
    if not over.any():
        return
    first = int(np.argmax(over))
    step_mm = float(np.linalg.norm(moved[first]))
    raise ImplausibleMotion(
        f"{topic}: the tip jumps by {step_mm:.3g} mm within {1e3 * steps_s[first]:.3g} ms at {stamps_s[first]:.3f} s, "
        f"at {step_mm / steps_s[first]:.0f} mm/s; a PSM moves its tip by at most {TIP_MM_S:.0f} mm/s. "
        f"{int(over.sum())} of {len(over)} steps are such jumps: the frame was reset, samples are lost, or two sources "
        "write to one topic. Cut the recording there.",
        at_s=float(stamps_s[first]),
        step_mm=step_mm,
    )
