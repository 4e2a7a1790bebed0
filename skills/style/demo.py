"""Cut one hand-off out of a recording, and say what kind of demonstration it is.

    Recording --cut_demo--> Demo --describe--> DemoReport

The paper (Sec. III-A) learns from one segment: the hand-off of the needle, from the moment the arm moves off with it
(A1) to the moment the other arm takes it (A2). `propose_segments` finds such stretches by motion and jaw; the surgeon
decides. Seconds of a segment count from the recording's `origin_ns`; a demonstration's own `stamps_s` count from its
first sample. Thresholds are ours: the paper cut by hand.
"""

from dataclasses import dataclass, replace

import numpy as np

from skills.errors import BadSegment, NotMetres
from skills.style._arrays import Floats, frozen
from skills.style.recording import (
    Format,
    Integrity,
    Motion,
    Recording,
    Signal,
    TopicInfo,
    recorded_motion,
)
from skills.style.segments import Segment, press_times, propose_segments, smoothed_speed

__all__ = [
    "Demo",
    "DemoReport",
    "Format",
    "Integrity",
    "Motion",
    "Recording",
    "Segment",
    "Signal",
    "TopicInfo",
    "cut_demo",
    "describe",
    "propose_segments",
    "recorded_motion",
]

CLASSIC_LARGE_NEEDLE_DRIVER = "400006"  # the dVRK's tool number; recordings rarely say another
EXTENT_LIMITS_MM = (1.0, 300.0)  # below it millimetres were declared for metres; above it no PSM reaches
EDGE_NS = 1000  # a segment may miss the recording's edge by a rounding of its seconds
IDLE_MM_S = 1.0


@dataclass(frozen=True, eq=False)
class Demo:
    """One demonstrated hand-off of one arm.

    Attributes:
        arm: The arm's name, such as "PSM2".
        topic: Where the motion comes from.
        frame: The frame of `tip_mm` and `rotation_xyzw`.
        start_s: Time of the first sample in the recording.
        end_s: Time of the last sample in the recording.
        stamps_s: Time of each sample from the first, shape (T,), strictly increasing from 0.
        tip_mm: The tip's position in `frame`, shape (T, 3).
        rotation_xyzw: Unit quaternions in `frame`, shape (T, 4); None where not recorded.
        jaw_rad: The jaw's angle at each stamp, shape (T,), interpolated, held beyond its ends; or None.
        clutch_presses: How often the clutch pedal went down; quick taps do not count.
        instrument: The tool's number in the dVRK's files.
    """

    arm: str
    topic: str
    frame: str
    start_s: float
    end_s: float
    stamps_s: Floats
    tip_mm: Floats
    rotation_xyzw: Floats | None = None
    jaw_rad: Floats | None = None
    clutch_presses: int = 0
    instrument: str = CLASSIC_LARGE_NEEDLE_DRIVER

    def __post_init__(self) -> None:
        count = len(self.stamps_s)
        if count < 2:
            raise BadSegment(f"A demonstration needs at least 2 samples, this one has {count}.", samples=count)
        shapes: dict[str, tuple[int, ...]] = {
            "stamps_s": (count,),
            "tip_mm": (count, 3),
            "rotation_xyzw": (count, 4),
            "jaw_rad": (count,),
        }
        for name, shape in shapes.items():
            if getattr(self, name) is not None:
                object.__setattr__(self, name, frozen(getattr(self, name), np.float64, shape, name))
        if self.stamps_s[0] != 0 or (np.diff(self.stamps_s) <= 0).any():
            raise BadSegment("The stamps of a demonstration start at 0 and increase strictly.")
        _check_extent(self.topic, self.tip_mm)


@dataclass(frozen=True)
class DemoReport:
    """What kind of demonstration it is, in plain numbers, with advice in words.

    Attributes:
        duration_s: From the first sample to the last.
        samples: How many.
        rate_hz: Samples per second, from the median step between stamps.
        longest_gap_s: The longest time without a sample.
        path_length_mm: The tip's way from sample to sample, tremor included.
        extent_mm: Size of the box around the path along x, y, z.
        speed_median_mm_s: Median of the smoothed speed over time.
        speed_peak_mm_s: Greatest smoothed speed.
        clutch_presses: How often the clutch pedal went down.
        idle_share: Share of the time slower than 1 mm/s, 0 to 1.
        orientation_change_rad: Largest angle from the first orientation; None where not recorded.
        advice: Sentences to the surgeon; empty where nothing stands out.
    """

    duration_s: float
    samples: int
    rate_hz: float
    longest_gap_s: float
    path_length_mm: float
    extent_mm: tuple[float, float, float]
    speed_median_mm_s: float
    speed_peak_mm_s: float
    clutch_presses: int
    idle_share: float
    orientation_change_rad: float | None
    advice: tuple[str, ...]


def cut_demo(
    recording: Recording,
    *,
    arm: str | None = None,
    topic: str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
) -> Demo:
    """Cut one arm's motion between two moments out of a recording, both ends included.

    Args:
        recording: What `read_recording` gave.
        arm: The arm; may be left out where the recording has one.
        topic: The pose topic; by default the arm's `local/measured_cp`, then `measured_cp`, then any other.
        start_s: Seconds since the recording's `origin_ns`; by default the motion's first sample.
        end_s: By default the motion's last sample.

    Raises:
        NoUsableTopic: There is no such arm or topic, or several arms and none named.
        BadSegment: Not in the recording, empty, turned round, or with fewer than 2 samples.
        NotMetres: The path's extent is below 1 mm or above 300 mm.
    """
    motion = recording.motion_of(arm=arm, topic=topic)
    first_ns, last_ns = _segment_ns(recording, motion, start_s, end_s)
    inside = (motion.stamps_ns >= first_ns) & (motion.stamps_ns <= last_ns)
    if inside.sum() < 2:
        raise BadSegment(
            f"The segment holds {inside.sum()} samples of {motion.topic}; at least 2 are needed. Widen it.",
            samples=int(inside.sum()),
        )
    seconds = recording.seconds(motion.stamps_ns[inside])
    stamps_ns = motion.stamps_ns[inside]
    return Demo(
        arm=motion.arm,
        topic=motion.topic,
        frame=motion.frame,
        start_s=float(seconds[0]),
        end_s=float(seconds[-1]),
        stamps_s=(stamps_ns - stamps_ns[0]) / 1e9,
        tip_mm=motion.tip_mm[inside],
        rotation_xyzw=None if motion.rotation_xyzw is None else motion.rotation_xyzw[inside],
        jaw_rad=_jaw_at(recording, motion.arm, seconds),
        clutch_presses=_presses_between(recording, first_ns, last_ns),
    )


def describe(demo: Demo) -> DemoReport:
    """Measure a demonstration and advise on what would make it a better teacher."""
    steps_s = np.diff(demo.stamps_s)
    duration_s = float(demo.stamps_s[-1])
    _, speed_mm_s = smoothed_speed(demo.stamps_s, demo.tip_mm)
    extent = np.ptp(demo.tip_mm, axis=0)
    numbers = DemoReport(
        duration_s=duration_s,
        samples=len(demo.stamps_s),
        rate_hz=float(1.0 / np.median(steps_s)),
        longest_gap_s=float(steps_s.max()),
        path_length_mm=float(np.linalg.norm(np.diff(demo.tip_mm, axis=0), axis=1).sum()),
        extent_mm=(float(extent[0]), float(extent[1]), float(extent[2])),
        speed_median_mm_s=float(np.median(speed_mm_s)),
        speed_peak_mm_s=float(speed_mm_s.max()),
        clutch_presses=demo.clutch_presses,
        idle_share=float((speed_mm_s < IDLE_MM_S).mean()),
        orientation_change_rad=_orientation_change(demo.rotation_xyzw),
        advice=(),
    )
    return replace(numbers, advice=_advice(numbers, has_jaw=demo.jaw_rad is not None))


def _segment_ns(recording: Recording, motion: Motion, start_s: float | None, end_s: float | None) -> tuple[int, int]:
    for name, value in (("start_s", start_s), ("end_s", end_s)):
        if value is not None and not np.isfinite(value):
            raise BadSegment(f"{name} is {value}; give seconds from the recording's start.")
    whole = recording.seconds(motion.stamps_ns[[0, -1]])
    begin = float(whole[0]) if start_s is None else start_s
    end = float(whole[1]) if end_s is None else end_s
    numbers = {"start_s": begin, "end_s": end, "duration_s": recording.duration_s}
    if end <= begin:
        raise BadSegment(f"The segment ends at {end:g} s, before it starts at {begin:g} s.", **numbers)
    if begin < -EDGE_NS / 1e9 or end > recording.duration_s + EDGE_NS / 1e9:
        raise BadSegment(
            f"The segment {begin:g} s to {end:g} s is outside the recording, which lasts from 0 s to "
            f"{recording.duration_s:g} s.",
            **numbers,
        )
    return recording.origin_ns + round(begin * 1e9), recording.origin_ns + round(end * 1e9)


def _check_extent(topic: str, tip_mm: Floats) -> None:
    extent_mm = float(np.ptp(tip_mm, axis=0).max())
    least, most = EXTENT_LIMITS_MM
    if least <= extent_mm <= most:
        return
    hint = (
        "the arm stood still, or the unit is not metres"
        if extent_mm < least
        else "no hand-off is so wide, so the unit is not metres or the segment holds more than one"
    )
    raise NotMetres(
        f"{topic}: the path is {extent_mm:g} mm wide; a hand-off is between {least:g} and {most:g} mm: {hint}.",
        extent_mm=extent_mm,
    )


def _jaw_at(recording: Recording, arm: str, seconds: Floats) -> Floats | None:
    jaw = recording.jaw_of(arm)
    if jaw is None or len(jaw.values) == 0:
        return None
    return np.interp(seconds, recording.seconds(jaw.stamps_ns), jaw.values)


def _presses_between(recording: Recording, first_ns: int, last_ns: int) -> int:
    if recording.clutch is None:
        return 0
    return sum(first_ns <= down_ns <= last_ns for down_ns, _ in press_times(recording.clutch))


def _orientation_change(rotation_xyzw: Floats | None) -> float | None:
    """Return the largest angle between the first orientation and any other; q and -q are the same orientation."""
    if rotation_xyzw is None:
        return None
    unit = rotation_xyzw / np.linalg.norm(rotation_xyzw, axis=1, keepdims=True)
    cosine = np.abs(unit @ unit[0]).min()
    return float(2.0 * np.arccos(min(1.0, cosine)))


def _advice(report: DemoReport, *, has_jaw: bool) -> tuple[str, ...]:
    said = []
    if report.idle_share > 0.25:
        said.append(f"The needle rests for {report.idle_share:.0%} of the time: cut the idle start and end away.")
    if report.clutch_presses > 0:
        times = "once" if report.clutch_presses == 1 else f"{report.clutch_presses} times"
        said.append(f"You clutched {times}: set up the masters so that the hand-off fits into one sweep.")
    if report.longest_gap_s > max(0.1, 5.0 / report.rate_hz):
        said.append(f"The recorder lost {report.longest_gap_s:.2f} s: the path is guessed there, so record again.")
    if report.rate_hz < 20.0:
        said.append(f"Only {report.rate_hz:.0f} poses per second: quick turns are lost; record at 100 or more.")
    if report.orientation_change_rad is None:
        said.append("The wrist was not recorded: the path can be learnt, the turn of the needle cannot be checked.")
    if not has_jaw:
        said.append("The jaw was not recorded: grasp and release are not known.")
    return tuple(said)
