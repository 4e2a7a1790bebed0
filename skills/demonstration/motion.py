"""The motion of an arm, its joints and signals as values: samples over time, checked once.

    Motion   the tip of one arm, one per pose topic: stamps_ns (T,), tip_mm (T, 3), rotation_xyzw (T, 4)
    Joints   the joints of one arm: stamps_ns (T,), positions (T, J)
    Signal   one number over time, a jaw's angle or a pedal: stamps_ns (T,), values (T,)

They are checked in their constructors: numbers are finite, time does not run backwards, coordinates are plausible for
an arm, quaternions have length one. Data that fail are refused with topic and time; nothing is repaired, sorted or
rescaled. A few samples whose stamps go back or repeat are dropped and counted (`forward_samples`). The readers in
`skills.formats` convert metres to millimetres before they construct these values.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from skills.arrays import Flags, Floats, Ints, frozen
from skills.errors import (
    BackwardStamps,
    ImplausibleMotion,
    NotAQuaternion,
    NotFinite,
    NotMetres,
    NoUsableTopic,
    RepeatedStamps,
)

COORDINATE_LIMIT_MM = 1000.0  # ours: a PSM reaches 0.3 m; far beyond it millimetres were taken for metres
JAW_RAD = np.pi  # ours: instruments open by 1.4 rad and close to -0.7, JIGSAWS has -1.9 to 0.6; degrees exceed it
QUATERNION_TOLERANCE = 1e-3  # ours: three printed decimals pass, an unnormalised quaternion does not
UNSET_NS, SET_NS = 10**15, 10**17  # 11 days and 3 years after 1970: of a clock that was not set, and of one that was
DROPPED_SHARE_LIMIT = 0.01  # ours: a real bag loses 1 of 3300; with more, the stamps are not the times of the samples
LATE_EVENT_NS = 100_000_000  # ours: nobody presses a pedal twice in that time
DROPPED_GAP_NS = 50_000_000  # ours: a tip at 100 mm/s moves by 5 mm in it, one cell of the paper's grid


def check_tips(topic: str, stamps_ns: Ints, tip_mm: Floats) -> None:
    """Refuse positions that cannot be those of an arm's tip.

    Args:
        topic: The topic, for the message.
        stamps_ns: Time stamps, shape (T,), for the message.
        tip_mm: Positions, shape (T, 3).

    Raises:
        NotFinite: A number is NaN or infinite.
        NotMetres: A coordinate is beyond 1 m.
    """
    check_finite(topic, stamps_ns, tip_mm)
    if tip_mm.size and not max(tip_mm.max(), -tip_mm.min()) <= COORDINATE_LIMIT_MM:
        first = int(np.argmax((np.abs(tip_mm) > COORDINATE_LIMIT_MM).any(axis=1)))
        metres = float(np.abs(tip_mm[first]).max() / 1000.0)
        raise NotMetres(
            f"{topic}: a coordinate of {metres:g} m {_at(stamps_ns, first)}; the tip of a PSM stays within 1 m. "
            "Give the positions in metres (or, in a table, name the columns x_mm, y_mm, z_mm, or the unit mm).",
            topic=topic,
            sample=first,
            metres=metres,
        )


def check_rotations(topic: str, stamps_ns: Ints, rotation_xyzw: Floats) -> None:
    """Refuse quaternions that are not finite or do not have length one.

    Args:
        topic: The topic, for the message.
        stamps_ns: Time stamps, shape (T,), for the message.
        rotation_xyzw: Quaternions, shape (T, 4).

    Raises:
        NotFinite: A number is NaN or infinite.
        NotAQuaternion: A length differs from 1 by more than `QUATERNION_TOLERANCE`.
    """
    check_finite(topic, stamps_ns, rotation_xyzw)
    length = np.sqrt(np.einsum("ij,ij->i", rotation_xyzw, rotation_xyzw))
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


def check_finite(topic: str, stamps_ns: Ints, values: Floats) -> None:
    """Refuse NaN and infinity.

    Args:
        topic: The topic, for the message.
        stamps_ns: Time stamps, shape (T,), for the message.
        values: Numbers, shape (T,) or (T, K).

    Raises:
        NotFinite: A number is NaN or infinite.
    """
    finite = np.isfinite(values)
    if not finite.all():
        first = int(np.argmin(finite.reshape(len(values), -1).all(axis=1)))
        raise NotFinite(
            f"{topic}: NaN or infinity {_at(stamps_ns, first)}; cut the recording before it or record again.",
            topic=topic,
            sample=first,
        )


def check_forwards(topic: str, stamps_ns: Ints) -> None:
    """Refuse time stamps that run backwards, and those before a clock was set; equal stamps pass.

    Args:
        topic: The topic, for the message.
        stamps_ns: Time stamps, shape (T,).

    Raises:
        BackwardStamps: A stamp is earlier than the one before it.
        ImplausibleMotion: The first are days after 1970 and later ones years.
    """
    back = stamps_ns[1:] < stamps_ns[:-1]
    if back.any():
        first = int(np.argmax(back)) + 1
        step_s = float(stamps_ns[first - 1] - stamps_ns[first]) / 1e9
        raise BackwardStamps(
            f"{topic}: the stamps decrease by {step_s:g} s {_at(stamps_ns, first - 1)} (sample {first}); the "
            "recorder's clock was set or two recordings were joined. Send each part separately.",
            topic=topic,
            sample=first,
            step_s=step_s,
        )
    if len(stamps_ns) and stamps_ns[0] < UNSET_NS and stamps_ns[-1] > SET_NS:
        first = int(np.searchsorted(stamps_ns, UNSET_NS))
        raise ImplausibleMotion(
            f"{topic}: the clock was not set in {first} sample{'s' * (first > 1)} at the start: the stamp is "
            f"{stamps_ns[first - 1] / 1e9:g} s, and the next one {stamps_ns[first] / 1e9:.9g} s. Cut the recording "
            f"before sample {first}.",
            topic=topic,
            sample=first,
        )


def _at(stamps_ns: Ints, index: int) -> str:
    """Return the time of a sample since the first one, in words."""
    return f"at {(int(stamps_ns[index]) - int(stamps_ns[0])) / 1e9:.3f} s"


@dataclass(frozen=True, eq=False)
class Motion:
    """The tip of one arm over time, from one topic.

    Attributes:
        arm: The arm's name, such as "PSM2".
        topic: The source: the topic, or "table".
        frame: The frame of the poses, such as "PSM2_base".
        stamps_ns: Time of each measurement, integer nanoseconds, shape (T,), strictly increasing.
        tip_mm: Positions of the tip in `frame`, shape (T, 3).
        rotation_xyzw: Orientations of the tip in `frame` as unit quaternions, shape (T, 4); None if not recorded.
        duplicate_stamps: Number of samples that were dropped because they had the stamp of the sample before.
        backward_stamps: Number of samples that were dropped because their stamp was earlier than one before.
        from_joints: The poses were computed from the recorded joints, so these identify neither arm nor instrument.
    """

    arm: str
    topic: str
    frame: str
    stamps_ns: Ints
    tip_mm: Floats
    rotation_xyzw: Floats | None = None
    duplicate_stamps: int = 0
    backward_stamps: int = 0
    from_joints: bool = False

    def __post_init__(self) -> None:
        count = len(self.stamps_ns)
        _set(self, "stamps_ns", frozen(self.stamps_ns, np.int64, (None,), f"stamps of {self.topic}"))
        if count == 0:
            raise NoUsableTopic(f"{self.topic} has no samples; record it again or choose another topic.")
        check_forwards(self.topic, self.stamps_ns)
        if (np.diff(self.stamps_ns) == 0).any():
            raise RepeatedStamps(
                f"{self.topic} has samples with equal stamps; use recorded_motion, which drops and counts them."
            )
        if np.shape(self.tip_mm) == (count, 3):  # any other shape is refused below
            check_tips(self.topic, self.stamps_ns, np.asarray(self.tip_mm))
        _set(self, "tip_mm", frozen(self.tip_mm, np.float64, (count, 3), f"tip of {self.topic}"))
        if self.rotation_xyzw is not None:
            if np.shape(self.rotation_xyzw) == (count, 4):
                check_rotations(self.topic, self.stamps_ns, np.asarray(self.rotation_xyzw))
            rotation = frozen(self.rotation_xyzw, np.float64, (count, 4), f"orientation of {self.topic}")
            _set(self, "rotation_xyzw", rotation)

    @property
    def is_local(self) -> bool:
        """Whether the poses are relative to the arm's own remote centre. The topic decides: frame names differ."""
        return "/local/" in self.topic or self.topic.endswith("/position_cartesian_local_current")  # of dVRK 1.x

    @property
    def states_base(self) -> bool:
        """Whether topic or frame state that the poses are relative to the arm's own remote centre."""
        return self.is_local or self.frame.casefold() == f"{self.arm}_base".casefold()


@dataclass(frozen=True, eq=False)
class Signal:
    """One number over time. Between two stamps the value of a clutch is constant, that of a jaw is interpolated.

    Attributes:
        stamps_ns: Integer nanoseconds, shape (T,), never decreasing.
        values: Shape (T,): a jaw's angle in rad; or the state of a clutch, 0 released, 1 pressed, 2 a quick tap.
        topic: The source.
        backward_stamps: Number of samples that were dropped because their stamp was earlier than one before.
    """

    stamps_ns: Ints
    values: Floats
    topic: str = "signal"
    backward_stamps: int = 0

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
        topic: The source.
        stamps_ns: Integer nanoseconds, shape (T,), never decreasing.
        positions: Shape (T, J), in rad; the third joint of a PSM, its insertion, in mm.
        backward_stamps: Number of samples that were dropped because their stamp was earlier than one before.
    """

    arm: str
    topic: str
    stamps_ns: Ints
    positions: Floats
    backward_stamps: int = 0

    def __post_init__(self) -> None:
        _set(self, "stamps_ns", frozen(self.stamps_ns, np.int64, (None,), f"stamps of {self.topic}"))
        check_forwards(self.topic, self.stamps_ns)
        if np.shape(self.positions)[:1] == self.stamps_ns.shape:
            check_finite(self.topic, self.stamps_ns, np.asarray(self.positions, dtype=np.float64))
        shape = (len(self.stamps_ns), None)
        _set(self, "positions", frozen(self.positions, np.float64, shape, f"positions of {self.topic}"))


class Forward(NamedTuple):
    """The samples that remain when those with stamps that go back or repeat are dropped.

    Attributes:
        kept: Which samples remain, shape (T,); None if all do.
        repeated: Number of dropped samples with the stamp of the sample before.
        backward: Number of dropped samples with an earlier stamp than one before.
    """

    kept: Flags | None
    repeated: int
    backward: int


def forward_samples(topic: str, stamps_ns: Ints, values: Floats, *, equal_stamps: bool = False) -> Forward:
    """Drop samples whose stamp is not later than all stamps before, and count them; too many are refused.

    A sample that repeats stamp and values of the one before is a message that was recorded twice: nothing is lost with
    it. All others that are dropped may be up to `DROPPED_SHARE_LIMIT` of the samples, go back by `DROPPED_GAP_NS`, and
    leave a gap of `DROPPED_GAP_NS` in the stamps. Nothing is sorted: the order of the recording remains.

    Args:
        topic: The topic, for messages.
        stamps_ns: Integer nanoseconds, shape (T,), in the order of the recording.
        values: Values of the samples, shape (T,) or (T, K).
        equal_stamps: Keep samples with equal stamps, as signals may have.

    Raises:
        BackwardStamps: Stamps go back, more often or by more than that, or leave a longer gap.
        RepeatedStamps: Only repeated stamps are the cause.
    """
    if ((stamps_ns[1:] >= stamps_ns[:-1]) if equal_stamps else (stamps_ns[1:] > stamps_ns[:-1])).all():
        return Forward(None, 0, 0)
    latest_ns = np.maximum.accumulate(stamps_ns)
    later = stamps_ns[1:] >= latest_ns[:-1] if equal_stamps else stamps_ns[1:] > latest_ns[:-1]
    kept = np.concatenate([[True], later])
    dropped = np.flatnonzero(~kept)
    before = np.maximum.accumulate(np.where(kept, np.arange(len(kept)), 0))[dropped]  # the sample kept last
    backward = stamps_ns[dropped] < stamps_ns[before]
    rows = values.reshape(len(values), -1)
    lost = backward | (rows[dropped] != rows[before]).any(axis=1)
    if lost.any():
        _refuse_lost(topic, stamps_ns, kept, dropped[lost], before[lost])
    return Forward(kept, int((~backward).sum()), int(backward.sum()))


def _refuse_lost(topic: str, stamps_ns: Ints, kept: Flags, lost: Ints, before: Ints) -> None:
    """Refuse the recording if the samples to drop, the indices `lost`, are more than the limits allow.

    Raises:
        BackwardStamps: Stamps go back, too often or too far, or the gap is too long.
        RepeatedStamps: Only repeated stamps are the cause.
    """
    remaining = np.flatnonzero(kept)
    after = np.append(remaining, remaining[-1])[np.searchsorted(remaining, lost)]  # the last one, if none follows
    back_ns = _apart_ns(stamps_ns[before], stamps_ns[lost])
    gap_ns = _apart_ns(stamps_ns[after], stamps_ns[before])
    many = len(lost) > DROPPED_SHARE_LIMIT * len(stamps_ns)
    if not many and max(back_ns.max(), gap_ns.max()) <= DROPPED_GAP_NS:
        return
    limits = (
        f"up to {DROPPED_SHARE_LIMIT:.0%} of the samples are dropped for such stamps, with gaps of at most "
        f"{DROPPED_GAP_NS / 1e6:g} ms"
    )
    if (back_ns == 0).all():
        raise RepeatedStamps(
            f"{topic}: {len(lost)} of {len(stamps_ns)} samples repeat the stamp of the previous sample; {limits}. The "
            "recorder's clock stood still, so record again.",
            topic=topic,
            duplicates=len(lost),
            samples=len(stamps_ns),
        )
    first = int(np.argmax(back_ns > 0))
    sample, step_s = int(lost[first]), float(back_ns[first]) / 1e9
    raise BackwardStamps(
        f"{topic}: the stamps decrease by {step_s:g} s {_at(stamps_ns, int(before[first]))} (sample {sample}), and "
        f"{len(lost)} of {len(stamps_ns)} samples are out of order, by up to {float(back_ns.max()) / 1e6:g} ms, with "
        f"gaps of up to {float(gap_ns.max()) / 1e6:g} ms; {limits}. The recorder's clock was set, or two recordings "
        "were joined. Send each part separately.",
        topic=topic,
        sample=sample,
        step_s=step_s,
        dropped=len(lost),
        samples=len(stamps_ns),
    )


def _apart_ns(later_ns: Ints, earlier_ns: Ints) -> Floats:
    """Return differences that are not negative; exact also where they exceed an int64."""
    return (later_ns - earlier_ns).view(np.uint64).astype(np.float64)


def recorded_motion(
    *, arm: str, topic: str, frame: str, stamps_ns: Ints, tip_mm: Floats, rotation_xyzw: Floats | None
) -> Motion:
    """Make a motion from samples as recorded; those whose stamps go back or repeat are dropped and counted.

    Args:
        arm: The arm's name.
        topic: The source: the topic, or "table".
        frame: The frame of the poses.
        stamps_ns: Integer nanoseconds, shape (T,).
        tip_mm: Positions of the tip in `frame`, shape (T, 3).
        rotation_xyzw: Unit quaternions in `frame`, shape (T, 4), or None.

    Returns:
        The motion, with the numbers of dropped samples in `duplicate_stamps` and `backward_stamps`.

    Raises:
        BackwardStamps, RepeatedStamps: As in `forward_samples`.
        NotFinite, NotMetres, NotAQuaternion: As for `Motion`.
    """
    stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
    if (stamps_ns[1:] > stamps_ns[:-1]).all():
        return Motion(arm, topic, frame, stamps_ns, tip_mm, rotation_xyzw)
    check_tips(topic, stamps_ns, tip_mm)  # before dropping, so that nothing wrong hides in a dropped sample
    if rotation_xyzw is not None:
        check_rotations(topic, stamps_ns, rotation_xyzw)
    poses = tip_mm if rotation_xyzw is None else np.hstack([tip_mm, rotation_xyzw])
    kept, repeated, backward = forward_samples(topic, stamps_ns, poses)
    assert kept is not None
    rotation = None if rotation_xyzw is None else rotation_xyzw[kept]
    return Motion(arm, topic, frame, stamps_ns[kept], tip_mm[kept], rotation, repeated, backward)


def recorded_signal(stamps_ns: Ints, values: Floats, topic: str) -> Signal:
    """Make a signal of a continuous value, such as a jaw's angle; samples whose stamps go back are dropped and counted.

    Args:
        stamps_ns: Integer nanoseconds, shape (T,), in the order of the recording.
        values: Values, shape (T,); the angle of a jaw in rad.
        topic: The source: the topic, or a table and its column.

    Returns:
        The signal, with the number of dropped samples in `backward_stamps`; samples with equal stamps are kept.

    Raises:
        BackwardStamps: As in `forward_samples`.
        NotFinite: A value is NaN or infinite.
        NotMetres: An angle is beyond `JAW_RAD`.
    """
    if len(values) and max(values.max(), -values.min()) > JAW_RAD and np.isfinite(values).all():
        first = int(np.argmax(np.abs(values) > JAW_RAD))
        raise NotMetres(
            f"{topic}: a jaw's angle of {values[first]:g} rad {_at(stamps_ns, first)}; a jaw opens by less than "
            f"{JAW_RAD:.4g} rad. Is it in degrees? Give radians, or name the unit of the column, as in jaw_deg."
        )
    kept, _, backward = forward_samples(topic, stamps_ns, values, equal_stamps=True)
    if kept is None:
        return Signal(stamps_ns, values, topic)
    check_finite(topic, stamps_ns, values)
    return Signal(stamps_ns[kept], values[kept], topic, backward)


def recorded_events(stamps_ns: Ints, values: Floats, topic: str) -> Signal:
    """Make a signal of events, such as the presses of a pedal: in order of time, without those recorded again later.

    A recorder repeats the last message of such a topic at the start of each part of a bag, with its first stamp. Events
    that were received out of order, by up to `LATE_EVENT_NS`, are put in the order of their stamps: none is lost.

    Args:
        stamps_ns: Integer nanoseconds, shape (T,), in the order of the recording.
        values: The states after the events, shape (T,).
        topic: The source.

    Returns:
        The signal, with the number of dropped messages in `backward_stamps`.

    Raises:
        BackwardStamps: A stamp goes back further, to one at which there was no such event.
        NotFinite: A value is NaN or infinite.
    """
    if (stamps_ns[1:] > stamps_ns[:-1]).all():
        return Signal(stamps_ns, values, topic)
    seen, kept = set[tuple[int, float]](), list[bool]()
    for event in zip(stamps_ns.tolist(), values.tolist(), strict=True):
        kept.append(event not in seen)
        seen.add(event)
    stamps_ns, values = stamps_ns[kept], values[kept]
    if (np.maximum.accumulate(stamps_ns) - stamps_ns <= LATE_EVENT_NS).all():
        order = np.argsort(stamps_ns, kind="stable")
        stamps_ns, values = stamps_ns[order], values[order]
    return Signal(stamps_ns, values, topic, kept.count(False))


def recorded_joints(arm: str, topic: str, stamps_ns: Ints, positions: Floats) -> Joints:
    """Make joints from samples as recorded; those whose stamps go back are dropped and counted.

    Args:
        arm: The arm's name.
        topic: The source: the topic, or "table" with what it holds.
        stamps_ns: Integer nanoseconds, shape (T,), in the order of the recording.
        positions: Shape (T, J), in rad; the third joint of a PSM, its insertion, in mm.

    Returns:
        The joints, with the number of dropped samples in `backward_stamps`; samples with equal stamps are kept.

    Raises:
        BackwardStamps: As in `forward_samples`.
        NotFinite: A position is NaN or infinite.
    """
    kept, _, backward = forward_samples(topic, stamps_ns, positions, equal_stamps=True)
    if kept is None:
        return Joints(arm, topic, stamps_ns, positions)
    check_finite(topic, stamps_ns, positions)
    return Joints(arm, topic, stamps_ns[kept], positions[kept], backward)


def equal_samples(tip_mm: Floats, rotation_xyzw: Floats | None) -> int:
    """Count the samples that repeat the pose of the sample before to the last bit.

    A measured pose has noise: an arm that only rests repeats none. Many such samples mean that the recorder was faster
    than the source.

    Args:
        tip_mm: Positions, shape (T, 3).
        rotation_xyzw: Quaternions, shape (T, 4), or None.
    """
    same = (tip_mm[1:] == tip_mm[:-1]).all(axis=1)
    if rotation_xyzw is not None:
        same &= (rotation_xyzw[1:] == rotation_xyzw[:-1]).all(axis=1)
    return int(same.sum())


def _set(value: object, name: str, array: Any) -> None:
    object.__setattr__(value, name, array)
