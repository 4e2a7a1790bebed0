"""A recording as a value: what the arms did, when, and in which frame.

    Recording
    ├── Motion      where one arm's tip was, one per pose topic: stamps_ns (T,), tip_mm (T, 3), rotation_xyzw (T, 4)
    ├── Joints      what one arm's joints measured: stamps_ns (T,), positions (T, J)
    ├── Signal      one number over time, a jaw's angle or a pedal: stamps_ns (T,), values (T,)
    ├── Label       a stretch of time that somebody named: a stage of the session, a gesture
    └── TopicInfo   what else is in the file

Everything is checked here, once: numbers are finite, time runs forwards, coordinates can be metres of an arm,
quaternions have length one. What fails is refused with the topic and the time; nothing is repaired, sorted or
rescaled. The readers in `skills.recordings` turn metres into millimetres before they come here.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from skills.errors import BackwardStamps, NotAQuaternion, NotFinite, NotMetres, NoUsableTopic, RepeatedStamps
from skills.style._arrays import Floats, Ints, frozen

COORDINATE_LIMIT_MM = 1000.0  # ours: a PSM reaches 0.3 m; ten times that is millimetres taken for metres
DUPLICATE_SHARE_LIMIT = 0.5  # ours: beyond it the stamps say nothing about when the samples were taken
QUATERNION_TOLERANCE = 1e-3  # ours: three printed decimals pass, an unnormalised quaternion does not

Format = Literal["mcap", "csv", "jigsaws", "rosbag2", "rosbag1"]
Integrity = Literal["full", "partial", "none"]


@dataclass(frozen=True, eq=False)
class Motion:
    """The tip of one arm over time, as one topic tells it.

    Attributes:
        arm: The arm's name, such as "PSM2".
        topic: Where it comes from: the topic, or "table".
        frame: The frame in which the poses are given, such as "PSM2_base".
        stamps_ns: When each pose was measured, integer nanoseconds, shape (T,), strictly increasing.
        tip_mm: The tip's position in `frame`, shape (T, 3).
        rotation_xyzw: The tip's orientation in `frame` as unit quaternions, shape (T, 4); None where not recorded.
        duplicate_stamps: Samples that were dropped because they carried the stamp of the sample before.
    """

    arm: str
    topic: str
    frame: str
    stamps_ns: Ints
    tip_mm: Floats
    rotation_xyzw: Floats | None = None
    duplicate_stamps: int = 0

    def __post_init__(self) -> None:
        count = len(self.stamps_ns)
        _set(self, "stamps_ns", frozen(self.stamps_ns, np.int64, (None,), f"stamps of {self.topic}"))
        if count == 0:
            raise NoUsableTopic(f"{self.topic} has no samples; record it again or choose another topic.")
        _check_forwards(self.topic, self.stamps_ns)
        if (np.diff(self.stamps_ns) == 0).any():
            raise RepeatedStamps(f"{self.topic} has samples with equal stamps; use recorded_motion, which counts them.")
        if np.shape(self.tip_mm) == (count, 3):  # any other shape is refused below
            check_tips(self.topic, self.stamps_ns, np.asarray(self.tip_mm))
        _set(self, "tip_mm", frozen(self.tip_mm, np.float64, (count, 3), f"tip of {self.topic}"))
        if self.rotation_xyzw is not None:
            if np.shape(self.rotation_xyzw) == (count, 4):
                _check_rotations(self.topic, self.stamps_ns, np.asarray(self.rotation_xyzw))
            rotation = frozen(self.rotation_xyzw, np.float64, (count, 4), f"orientation of {self.topic}")
            _set(self, "rotation_xyzw", rotation)


@dataclass(frozen=True, eq=False)
class Signal:
    """One number over time; between two stamps of a clutch it holds, of a jaw it is interpolated.

    Attributes:
        stamps_ns: Integer nanoseconds, shape (T,), never decreasing.
        values: Jaw angle in rad; or clutch, 0 released, 1 pressed, 2 a quick tap; shape (T,).
        topic: Where it comes from.
    """

    stamps_ns: Ints
    values: Floats
    topic: str = "signal"

    def __post_init__(self) -> None:
        _set(self, "stamps_ns", frozen(self.stamps_ns, np.int64, (None,), f"stamps of {self.topic}"))
        _check_forwards(self.topic, self.stamps_ns)
        if np.shape(self.values) == self.stamps_ns.shape:
            _check_finite(self.topic, self.stamps_ns, np.asarray(self.values, dtype=np.float64))
        _set(self, "values", frozen(self.values, np.float64, self.stamps_ns.shape, f"values of {self.topic}"))


@dataclass(frozen=True, eq=False)
class Joints:
    """The joints of one arm over time.

    Attributes:
        arm: The arm's name, such as "PSM2".
        topic: Where they come from.
        stamps_ns: Integer nanoseconds, shape (T,), never decreasing.
        positions: Shape (T, J): rad, but of a PSM the third, its insertion, in mm.
    """

    arm: str
    topic: str
    stamps_ns: Ints
    positions: Floats

    def __post_init__(self) -> None:
        _set(self, "stamps_ns", frozen(self.stamps_ns, np.int64, (None,), f"stamps of {self.topic}"))
        _check_forwards(self.topic, self.stamps_ns)
        if np.shape(self.positions)[:1] == self.stamps_ns.shape:
            _check_finite(self.topic, self.stamps_ns, np.asarray(self.positions, dtype=np.float64))
        shape = (len(self.stamps_ns), None)
        _set(self, "positions", frozen(self.positions, np.float64, shape, f"positions of {self.topic}"))


@dataclass(frozen=True)
class Label:
    """A stretch of time that somebody named, both ends included, in the recording's own nanoseconds.

    `kind` is "stage" (of a session, from a recorder's tags) or "gesture" (of JIGSAWS, such as "G6").
    """

    name: str
    kind: Literal["stage", "gesture"]
    start_ns: int
    end_ns: int


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a file: its name, its message type, how many messages."""

    name: str
    type: str
    messages: int


@dataclass(frozen=True, eq=False)
class Recording:
    """Everything of one file that is used here.

    Attributes:
        format: What the file was.
        integrity: Whether checksums cover every pose ("full"), some ("partial") or none ("none").
        motions: One per pose topic of a PSM, at least one.
        jaws: Arm and its jaw's angle in rad.
        clutch: The console's clutch pedal.
        topics: Everything that the file holds, used or not.
        joints: What the joints of PSMs and MTMs measured.
        masters: Where the tips of MTMs were; they teach nothing.
        grippers: MTM and its gripper's angle in rad.
        pedals: Topic and state of every pedal, the clutch included: 0 released, 1 pressed, 2 a quick tap.
        following: Teleoperation, such as "MTMR_PSM1", and whether it drove its PSM: 0 or 1.
        scales: Teleoperation and its motion scale.
        tools: Arm and its instrument as the console names it, such as "LARGE_NEEDLE_DRIVER:400006".
        labels: What somebody named, in order of time.
    """

    format: Format
    integrity: Integrity
    motions: tuple[Motion, ...]
    jaws: tuple[tuple[str, Signal], ...] = ()
    clutch: Signal | None = None
    topics: tuple[TopicInfo, ...] = ()
    joints: tuple[Joints, ...] = ()
    masters: tuple[Motion, ...] = ()
    grippers: tuple[tuple[str, Signal], ...] = ()
    pedals: tuple[tuple[str, Signal], ...] = ()
    following: tuple[tuple[str, Signal], ...] = ()
    scales: tuple[tuple[str, Signal], ...] = ()
    tools: tuple[tuple[str, str], ...] = ()
    labels: tuple[Label, ...] = ()

    def __post_init__(self) -> None:
        if not self.motions:
            raise NoUsableTopic(f"No topic has the pose of a PSM.{_listed(self.topics)}")

    @property
    def origin_ns(self) -> int:
        """The earliest stamp of the motions: second 0 of every segment."""
        return min(int(motion.stamps_ns[0]) for motion in self.motions)

    @property
    def duration_s(self) -> float:
        """From the earliest stamp of the motions to the latest."""
        return (max(int(motion.stamps_ns[-1]) for motion in self.motions) - self.origin_ns) / 1e9

    @property
    def arms(self) -> tuple[str, ...]:
        """The arms whose motion is here, by name."""
        return tuple(sorted({motion.arm for motion in self.motions}))

    def jaw_of(self, arm: str) -> Signal | None:
        """Return the jaw of an arm, None where it was not recorded."""
        return dict(self.jaws).get(arm)

    def motion_of(self, *, arm: str | None = None, topic: str | None = None) -> Motion:
        """Choose a motion: by its topic, else the arm's `local/measured_cp`, then `measured_cp`, then any other.

        Raises:
            NoUsableTopic: There is no such arm or topic, or several arms and none named.
        """
        fitting = [m for m in self.motions if arm in (None, m.arm) and topic in (None, m.topic)]
        if not fitting:
            here = ", ".join(f"{m.topic} of {m.arm}" for m in self.motions)
            asked = " and ".join(x for x in (arm and f"arm {arm}", topic and f"topic {topic}") if x)
            raise NoUsableTopic(f"The recording has no pose for {asked}. It has {here}.", arm=arm, topic=topic)
        arms = sorted({m.arm for m in fitting})
        if len(arms) > 1:
            raise NoUsableTopic(f"The recording has several arms: {', '.join(arms)}. Name one.", arms=arms)
        return min(fitting, key=_preference)

    def seconds(self, stamps_ns: Ints) -> Floats:
        """Turn stamps into seconds since `origin_ns`: integers are subtracted first, so no nanosecond is lost."""
        return (stamps_ns - self.origin_ns) / 1e9


def recorded_motion(
    *, arm: str, topic: str, frame: str, stamps_ns: Ints, tip_mm: Floats, rotation_xyzw: Floats | None
) -> Motion:
    """Make a motion from samples as recorded: of samples with equal stamps the first is kept, the rest counted.

    Raises:
        BackwardStamps: A stamp is earlier than the one before it.
        RepeatedStamps: More than half of the samples carry the stamp before.
        NotFinite, NotMetres, NotAQuaternion: As for `Motion`.
    """
    stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
    _check_forwards(topic, stamps_ns)
    check_tips(topic, stamps_ns, tip_mm)  # before dropping, so that nothing wrong hides in a dropped sample
    if rotation_xyzw is not None:
        _check_rotations(topic, stamps_ns, rotation_xyzw)
    first = np.ones(len(stamps_ns), dtype=bool)
    first[1:] = np.diff(stamps_ns) > 0
    duplicates = int((~first).sum())
    if duplicates > DUPLICATE_SHARE_LIMIT * len(stamps_ns):
        raise RepeatedStamps(
            f"{topic}: {duplicates} of {len(stamps_ns)} samples carry the stamp of the sample before; "
            "the recorder's clock stood still, so record again.",
            topic=topic,
            duplicates=duplicates,
            samples=len(stamps_ns),
        )
    rotation = None if rotation_xyzw is None else rotation_xyzw[first]
    return Motion(arm, topic, frame, stamps_ns[first], tip_mm[first], rotation, duplicates)


def check_tips(topic: str, stamps_ns: Ints, tip_mm: Floats) -> None:
    """Refuse positions that cannot be an arm's tip.

    Args:
        topic: Named in the refusal.
        stamps_ns: Shape (T,), to name the time.
        tip_mm: Shape (T, 3).

    Raises:
        NotFinite: NaN or infinity.
        NotMetres: A coordinate beyond 1 m.
    """
    _check_finite(topic, stamps_ns, tip_mm)
    far = (np.abs(tip_mm) > COORDINATE_LIMIT_MM).any(axis=1)
    if far.any():
        first = int(np.argmax(far))
        metres = float(np.abs(tip_mm[first]).max() / 1000.0)
        raise NotMetres(
            f"{topic}: a coordinate of {metres:g} m {_at(stamps_ns, first)}; a PSM's tip stays within 1 m. "
            "Give the positions in metres (or, in a table, name the columns x_mm, y_mm, z_mm).",
            topic=topic,
            sample=first,
            metres=metres,
        )


def _preference(motion: Motion) -> tuple[int, str]:
    """Prefer the tip relative to the arm's own remote centre: it does not move with the camera or the set-up joints."""
    known = [f"/{motion.arm}/local/measured_cp", f"/{motion.arm}/measured_cp"]
    return (known.index(motion.topic) if motion.topic in known else len(known), motion.topic)


def _check_rotations(topic: str, stamps_ns: Ints, rotation_xyzw: Floats) -> None:
    _check_finite(topic, stamps_ns, rotation_xyzw)
    length = np.linalg.norm(rotation_xyzw, axis=1)
    off = np.abs(length - 1.0) > QUATERNION_TOLERANCE
    if off.any():
        first = int(np.argmax(off))
        raise NotAQuaternion(
            f"{topic}: the quaternion {_at(stamps_ns, first)} has length {length[first]:g}; "
            "give unit quaternions x, y, z, w, or leave the orientation out.",
            topic=topic,
            sample=first,
            length=float(length[first]),
        )


def _check_finite(topic: str, stamps_ns: Ints, values: Floats) -> None:
    wrong = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    if wrong.any():
        first = int(np.argmax(wrong))
        raise NotFinite(
            f"{topic}: NaN or infinity {_at(stamps_ns, first)}; cut the recording before it or record again.",
            topic=topic,
            sample=first,
        )


def _check_forwards(topic: str, stamps_ns: Ints) -> None:
    back = np.diff(stamps_ns) < 0
    if back.any():
        first = int(np.argmax(back)) + 1
        step_s = float(stamps_ns[first - 1] - stamps_ns[first]) / 1e9
        raise BackwardStamps(
            f"{topic}: time runs backwards by {step_s:g} s {_at(stamps_ns, first - 1)} (sample {first}); "
            "the recorder's clock was set or two recordings were joined. Give each part on its own.",
            topic=topic,
            sample=first,
            step_s=step_s,
        )


def _at(stamps_ns: Ints, index: int) -> str:
    return f"at {(int(stamps_ns[index]) - int(stamps_ns[0])) / 1e9:.3f} s"


def _listed(topics: tuple[TopicInfo, ...]) -> str:
    if not topics:
        return ""
    return " It has " + ", ".join(f"{topic.name} ({topic.type})" for topic in topics[:20]) + "."


def _set(value: object, name: str, array: Any) -> None:
    object.__setattr__(value, name, array)
