"""A recording as a value: what the arms did, when, and in which frame.

    Recording
    ├── Motion      where one arm's tip was, one per pose topic: stamps_ns (T,), tip_mm (T, 3), rotation_xyzw (T, 4)
    ├── Joints      what one arm's joints measured: stamps_ns (T,), positions (T, J)
    ├── Signal      one number over time, a jaw's angle or a pedal: stamps_ns (T,), values (T,)
    ├── Label       a stretch of time that somebody named: a stage of the session, a gesture
    └── TopicInfo   what else is in the file
    --base_frames--> BaseFrame   where an arm's base stands in the frame of another of its topics

Everything is checked here, once: numbers are finite, time runs forwards, coordinates can be metres of an arm,
quaternions have length one. What fails is refused with the topic and the time; nothing is repaired, sorted or
rescaled. The readers in `skills.recordings` turn metres into millimetres before they come here.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from skills.errors import NoUsableTopic, RepeatedStamps
from skills.style._arrays import Floats, Ints, frozen
from skills.style._checks import check_finite, check_forwards, check_rotations, check_tips
from skills.style.kinematics import quaternion_of

DUPLICATE_SHARE_LIMIT = 0.5  # ours: beyond it the stamps say nothing about when the samples were taken
PAIR_NS = 2_000_000  # ours: of poses so near in time a tip at 100 mm/s differs by 0.2 mm
PAIRS_LEAST = 10  # ours: fewer say nothing about whether a base stood still
WIDE_MM = 2.0  # ours: tips that go less to and fro do not tell a turn

_INVERSE = np.array([-1.0, -1.0, -1.0, 1.0])  # of a unit quaternion x, y, z, w, when multiplied with it

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
        check_forwards(self.topic, self.stamps_ns)
        if (np.diff(self.stamps_ns) == 0).any():
            raise RepeatedStamps(f"{self.topic} has samples with equal stamps; use recorded_motion, which counts them.")
        if np.shape(self.tip_mm) == (count, 3):  # any other shape is refused below
            check_tips(self.topic, self.stamps_ns, np.asarray(self.tip_mm))
        _set(self, "tip_mm", frozen(self.tip_mm, np.float64, (count, 3), f"tip of {self.topic}"))
        if self.rotation_xyzw is not None:
            if np.shape(self.rotation_xyzw) == (count, 4):
                check_rotations(self.topic, self.stamps_ns, np.asarray(self.rotation_xyzw))
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
        check_forwards(self.topic, self.stamps_ns)
        if np.shape(self.values) == self.stamps_ns.shape:
            check_finite(self.topic, self.stamps_ns, np.asarray(self.values, dtype=np.float64))
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
        check_forwards(self.topic, self.stamps_ns)
        if np.shape(self.positions)[:1] == self.stamps_ns.shape:
            check_finite(self.topic, self.stamps_ns, np.asarray(self.positions, dtype=np.float64))
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
        notes: What the file says of its own making, name and value, such as the digest of what it was made from.
        left_out: Topics that could have been used, and what is wrong with each; none that a demonstration rests on.
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
    notes: tuple[tuple[str, str], ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()

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


@dataclass(frozen=True)
class BaseFrame:
    """Where the base of an arm stands: a point p of `local_frame` is at `position_mm` + R p in `frame`.

    Attributes:
        arm: The arm's name.
        frame: In which its other pose is given, such as "ECM".
        local_frame: Its base, the frame of its `local/measured_cp`.
        position_mm: The base's place in `frame`.
        rotation_xyzw: Its turn R as a unit quaternion.
        spread_mm: The furthest that any pair of poses puts the base from there; much of it says that the base moved,
            since the camera or the set-up joints did.
        spread_rad: The widest that any pair turns it otherwise.
    """

    arm: str
    frame: str
    local_frame: str
    position_mm: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]
    spread_mm: float
    spread_rad: float


def base_frames(recording: Recording) -> tuple[BaseFrame, ...]:
    """Find where the bases stand, of arms whose pose was recorded both in the base's frame and in another.

    A base is the pose in the other frame times the inverse of the pose in its own, of samples of equal stamps or of
    the nearest within `PAIR_NS`; the middle one of all, number by number, is told. Where the orientations do not fit
    the tips, the tips decide, and `spread_rad` says how far the orientations are off.
    """
    whole = [motion for motion in recording.motions if motion.rotation_xyzw is not None]
    found = [
        _base_frame(local, other)
        for local in whole
        for other in whole
        if _is_local(local) and not _is_local(other) and local.arm == other.arm and local.frame != other.frame
    ]
    return tuple(base for base in found if base is not None)


def _base_frame(local: Motion, other: Motion) -> BaseFrame | None:
    """Find a base; None where too few poses have a partner in time."""
    here, there = _pairs(local.stamps_ns, other.stamps_ns)
    if len(here) < PAIRS_LEAST:
        return None
    assert local.rotation_xyzw is not None and other.rotation_xyzw is not None
    turns = _unit(_product(other.rotation_xyzw[there], local.rotation_xyzw[here] * _INVERSE))
    turns *= np.where(turns @ turns[0] < 0, -1.0, 1.0)[:, None]  # q and -q are the same turn
    turn = min(_candidates(turns, local.tip_mm[here], other.tip_mm[there]), key=lambda one: one[0])[1]
    places = other.tip_mm[there] - _turned(turn, local.tip_mm[here])
    place = np.median(places, axis=0)
    sine = np.linalg.norm(_product(turns, turn * _INVERSE)[:, :3], axis=1).max()
    x, y, z = place.tolist()
    qx, qy, qz, qw = turn.tolist()
    return BaseFrame(
        arm=local.arm,
        frame=other.frame,
        local_frame=local.frame,
        position_mm=(x, y, z),
        rotation_xyzw=(qx, qy, qz, qw),
        spread_mm=float(np.linalg.norm(places - place, axis=1).max()),
        spread_rad=float(2.0 * np.arcsin(min(1.0, sine))),
    )


def _candidates(turns: Floats, here_mm: Floats, there_mm: Floats) -> Iterator[tuple[float, Floats]]:
    """Give the middle of the turns, and the turn that brings the tips over best, with how badly each fits in mm.

    The tips alone tell the turn (Kabsch) where they go to and fro in more than one direction.
    """
    found = [_unit(np.median(turns, axis=0))]
    one, other = here_mm - here_mm.mean(axis=0), there_mm - there_mm.mean(axis=0)
    left, size, right = np.linalg.svd(other.T @ one)
    if size[1] > len(one) * WIDE_MM**2:
        proper = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
        found.append(quaternion_of((left @ proper @ right)[None])[0])
    for turn in found:
        places = there_mm - _turned(turn, here_mm)
        yield float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1))), turn


def _pairs(stamps_ns: Ints, others_ns: Ints) -> tuple[Ints, Ints]:
    """Return which samples belong together: each with the nearest of the others, if that is near enough."""
    after = np.clip(np.searchsorted(others_ns, stamps_ns), 1, max(1, len(others_ns) - 1))
    before = after - 1
    after = np.minimum(after, len(others_ns) - 1)
    nearer = np.where(stamps_ns - others_ns[before] <= others_ns[after] - stamps_ns, before, after)
    near = np.flatnonzero(np.abs(others_ns[nearer] - stamps_ns) <= PAIR_NS)
    return near, nearer[near]


def _is_local(motion: Motion) -> bool:
    return motion.topic.endswith("/local/measured_cp")


def _product(one: Floats, other: Floats) -> Floats:
    """Multiply quaternions x, y, z, w."""
    v, w = one[..., :3], one[..., 3:]
    u, t = other[..., :3], other[..., 3:]
    vector = w * u + t * v + np.cross(v, u)
    return np.concatenate([vector, w * t - (v * u).sum(axis=-1, keepdims=True)], axis=-1)


def _turned(turn: Floats, points_mm: Floats) -> Floats:
    """Turn points, shape (N, 3), by one unit quaternion."""
    across = 2.0 * np.cross(turn[:3], points_mm)
    turned: Floats = points_mm + turn[3] * across + np.cross(turn[:3], across)
    return turned


def _unit(quaternions: Floats) -> Floats:
    unit: Floats = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return unit


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
    later = stamps_ns[1:] > stamps_ns[:-1]
    if later.all():
        return Motion(arm, topic, frame, stamps_ns, tip_mm, rotation_xyzw)
    check_forwards(topic, stamps_ns)
    check_tips(topic, stamps_ns, tip_mm)  # before dropping, so that nothing wrong hides in a dropped sample
    if rotation_xyzw is not None:
        check_rotations(topic, stamps_ns, rotation_xyzw)
    first = np.concatenate([[True], later])
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


def _preference(motion: Motion) -> tuple[int, str]:
    """Prefer the tip relative to the arm's own remote centre: it does not move with the camera or the set-up joints."""
    known = [f"/{motion.arm}/local/measured_cp", f"/{motion.arm}/measured_cp"]
    return (known.index(motion.topic) if motion.topic in known else len(known), motion.topic)


def _listed(topics: tuple[TopicInfo, ...]) -> str:
    if not topics:
        return ""
    return " It has " + ", ".join(f"{topic.name} ({topic.type})" for topic in topics[:20]) + "."


def _set(value: object, name: str, array: Any) -> None:
    object.__setattr__(value, name, array)
