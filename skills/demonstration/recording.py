"""Recordings as values: the motion of the arms, its time stamps and its frames.

    Recording
    ├── Motion      the tip of one arm, one per pose topic: stamps_ns (T,), tip_mm (T, 3), rotation_xyzw (T, 4)
    ├── Joints      the measured joints of one arm: stamps_ns (T,), positions (T, J)
    ├── Signal      one number over time, a jaw's angle or a pedal: stamps_ns (T,), values (T,)
    ├── Column      a column of a table, and what it was read as
    ├── Label       a named interval: a stage of the session, a gesture
    └── Topic       a topic of the file, used or not
    --base_frames--> BaseFrame   the pose of an arm's base in the frame of another of its topics
    --identifications--> ArmIdentification   arm, instrument and base that joints and poses of an arm show together

Motions, joints and signals are checked here, once, in their constructors: numbers are finite, time does not run
backwards, coordinates are plausible for an arm, quaternions have length one. Data that fail are refused with topic and
time; nothing is repaired, sorted or rescaled. A few samples whose stamps go back or repeat are dropped and counted
(`forward_samples`). The readers in `skills.formats` convert metres to millimetres before they construct these values.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, Literal, NamedTuple

import numpy as np

from skills.arrays import Flags, Floats, Ints, frozen
from skills.demonstration.identification import (
    MOST_SAMPLES,
    ArmIdentification,
    Identification,
    identify,
    stated_instrument,
)
from skills.errors import (
    BackwardStamps,
    NotAQuaternion,
    NotFinite,
    NotMetres,
    NoUsableTopic,
    RepeatedStamps,
    UnreadableRecording,
)
from skills.fields import Count, Point, Quaternion, schema
from skills.kinematics import matrix_of, quaternion_of
from skills.remedies import did_you_mean

COORDINATE_LIMIT_MM = 1000.0  # ours: a PSM reaches 0.3 m; far beyond it millimetres were taken for metres
QUATERNION_TOLERANCE = 1e-3  # ours: three printed decimals pass, an unnormalised quaternion does not


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
    """Refuse time stamps that run backwards; equal stamps pass.

    Args:
        topic: The topic, for the message.
        stamps_ns: Time stamps, shape (T,).

    Raises:
        BackwardStamps: A stamp is earlier than the one before it.
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


def _at(stamps_ns: Ints, index: int) -> str:
    return f"at {(int(stamps_ns[index]) - int(stamps_ns[0])) / 1e9:.3f} s"


ARMS_LIMIT, MOTIONS_LIMIT = 16, 200  # ours: a da Vinci has three PSMs; every pair of arms and of motions is compared
DROPPED_SHARE_LIMIT = 0.01  # ours: a real bag loses 1 of 3300; with more, the stamps are not the times of the samples
DROPPED_GAP_NS = 50_000_000  # ours: a tip at 100 mm/s moves by 5 mm in it, one cell of the paper's grid
BASES_LIMIT = 64  # ours: pairs of motions of one arm in two frames; a dVRK's recording has one or two per arm
PAIR_NS = 2_000_000  # ours: between two poses so near in time a tip at 100 mm/s moves by 0.2 mm
PAIRS_LEAST = 10  # ours: from fewer pairs it cannot be concluded that a base stood still
IDENTIFIED_LIMIT = 16  # ours: pairs of joints and poses that are compared, each for 0.1 s; a dVRK has two per arm
JOINT_GAP_NS = 50_000_000  # ours: joints further apart in time are not interpolated
WIDE_MM = 2.0  # ours: a rotation cannot be fitted to tips that move less than this in a second direction

_INVERSE = np.array([-1.0, -1.0, -1.0, 1.0])  # a unit quaternion x, y, z, w times this is its inverse

Format = Literal["mcap", "csv", "jigsaws", "rosbag2", "rosbag1", "lerobot"]
Integrity = Literal["full", "partial", "none"]


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
        return "/local/" in self.topic

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


@dataclass(frozen=True)
class Label:
    """A named interval, both ends included, in the recording's own nanoseconds.

    `kind` is "stage" (of a session, from a recorder's tags) or "gesture" (of JIGSAWS, such as "G6").
    """

    name: str
    kind: Literal["stage", "gesture"]
    start_ns: int
    end_ns: int


@schema
@dataclass(frozen=True)
class Topic:
    """One topic of a file: its name, its message type and its number of messages."""

    name: str
    type: str
    messages: Count


@schema
@dataclass(frozen=True)
class Column:
    """A column of a table, and what it was read as.

    Attributes:
        name: Its name in the header.
        quantity: Such as "x", "q3" or "PSM1 qw"; "" for a column that is not used.
        unit: Its unit; "" where it has none.
    """

    name: str
    quantity: str
    unit: str


@dataclass(frozen=True, eq=False)
class Recording:
    """The content of one file, as far as this package uses it.

    Attributes:
        format: The format of the file.
        integrity: Whether checksums cover every pose ("full"), some ("partial") or none ("none").
        motions: One per pose topic of a PSM, at least one.
        jaws: Arm and its jaw's angle in rad.
        clutch: The console's clutch pedal.
        topics: All topics of the file, used or not.
        joints: Measured joints of PSMs and MTMs.
        masters: Motions of the tips of MTMs; nothing is learnt from them.
        grippers: MTM and its gripper's angle in rad.
        pedals: Topic and state of every pedal, the clutch included: 0 released, 1 pressed, 2 a quick tap.
        following: Teleoperation, such as "MTMR_PSM1", and whether it drove its PSM: 0 or 1.
        scales: Teleoperation and its motion scale.
        tools: Arm and its instrument as the console names it, such as "LARGE_NEEDLE_DRIVER:400006".
        labels: Named intervals, in order of time.
        notes: Metadata of the file, name and value, such as the digest of the file that it was made from.
        left_out: Topics that were not usable, and the fault of each; no demonstration depends on any of them.
        columns: The columns of a table.
    """

    format: Format
    integrity: Integrity
    motions: tuple[Motion, ...]
    jaws: tuple[tuple[str, Signal], ...] = ()
    clutch: Signal | None = None
    topics: tuple[Topic, ...] = ()
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
    columns: tuple[Column, ...] = ()

    def __post_init__(self) -> None:
        if not self.motions:
            raise NoUsableTopic(f"No topic has the pose of a PSM.{_listed(self.topics)}")
        if len(self.motions) > MOTIONS_LIMIT or len(self.arms) > ARMS_LIMIT:
            raise UnreadableRecording(
                f"The recording has {len(self.motions)} motions of {len(self.arms)} arms; at most {MOTIONS_LIMIT} of "
                f"{ARMS_LIMIT} are read. Keep the topics of the arms that hand the needle over.",
                motions=len(self.motions),
                arms=len(self.arms),
            )

    @property
    def is_timed(self) -> bool:
        """Whether the file itself has times: a table may have none."""
        return not self.columns or any(column.quantity == "t" for column in self.columns)

    @property
    def origin_ns(self) -> int:
        """The earliest stamp of the motions: second 0 of every segment."""
        return min(int(motion.stamps_ns[0]) for motion in self.motions)

    @property
    def duration_s(self) -> float:
        """Time from the earliest stamp of the motions to the latest."""
        return (max(int(motion.stamps_ns[-1]) for motion in self.motions) - self.origin_ns) / 1e9

    @cached_property
    def bases(self) -> tuple["BaseFrame", ...]:
        """The poses of the arms' bases, see `base_frames`; computed once."""
        paired = _base_frames(self.motions)
        known = {(base.arm, base.frame) for base in paired}
        return *paired, *(base for base in _bases_of(self) if (base.arm, base.frame) not in known)

    @cached_property
    def identifications(self) -> tuple["ArmIdentification", ...]:
        """The arms and instruments that joints and poses show together; computed once."""
        return tuple(_identifications(self))

    def identification_of(self, motion: "Motion") -> Identification | None:
        """Return what the joints show of a motion; None if they were not recorded beside it."""
        return next((one.found for one in self.identifications if one.is_of(motion.arm, motion.topic)), None)

    def base_under(self, motion: "Motion") -> "BaseFrame | None":
        """Return the base of a motion's arm in the frame of the motion, if joints show it and it is another frame."""
        found = self.identification_of(motion)
        if motion.states_base or found is None or found.verdict != "identified":
            return None
        return next((base for base in _bases_of(self) if base.is_of(motion)), None)

    def instrument_on(self, arm: str) -> str | None:
        """Return the instrument of an arm: the one that its joints show, or else the one that the recording states.

        Returns:
            Its number in the dVRK's files, such as "400006", of which constants may not be known; None if it is neither
            shown nor stated.
        """
        shown = [one.found for one in self.identifications if one.arm == arm and one.found.verdict == "identified"]
        if shown:
            return min(shown, key=lambda found: found.residual_mm).instrument
        return stated_instrument(dict(self.tools).get(arm, ""))

    @property
    def arms(self) -> tuple[str, ...]:
        """The names of the arms that have a motion, sorted."""
        return tuple(sorted({motion.arm for motion in self.motions}))

    def jaw_of(self, arm: str) -> Signal | None:
        """Return the jaw signal of an arm, or None if it was not recorded."""
        return dict(self.jaws).get(arm)

    def motion_of(self, *, arm: str | None = None, topic: str | None = None) -> Motion:
        """Choose a motion by its topic, or else the arm's `local/measured_cp`, then `measured_cp`, then any other.

        Raises:
            NoUsableTopic: There is no such arm or topic, or there are several arms and none is named.
        """
        fitting = [m for m in self.motions if arm in (None, m.arm) and topic in (None, m.topic)]
        if not fitting:
            here = ", ".join(f"{m.topic} of {m.arm}" for m in self.motions)
            asked = " and ".join(x for x in (arm and f"arm {arm}", topic and f"topic {topic}") if x)
            near = did_you_mean(arm, self.arms) if arm is not None and arm not in self.arms else []
            near = near or did_you_mean(topic or "", [m.topic for m in self.motions])
            raise NoUsableTopic(
                f"The recording has no pose for {asked}. It has poses for {here}.", *near, arm=arm, topic=topic
            )
        arms = sorted({m.arm for m in fitting})
        if len(arms) > 1:
            raise NoUsableTopic(f"The recording has several arms: {', '.join(arms)}. Name one.", arms=arms)
        return min(fitting, key=_preference)

    def seconds(self, stamps_ns: Ints) -> Floats:
        """Convert stamps to seconds since `origin_ns`; integers are subtracted first, so that no nanosecond is lost."""
        return (stamps_ns - self.origin_ns) / 1e9


@schema
@dataclass(frozen=True)
class BaseFrame:
    """The pose of an arm's base: a point p of `local_frame` is at `position_mm` + R p in `frame`.

    Attributes:
        arm: The arm's name.
        frame: Frame of the arm's other pose, such as "ECM".
        local_frame: The arm's base, the frame of its `local/measured_cp`.
        position_mm: Position of the base in `frame`.
        rotation_xyzw: Its rotation R as a unit quaternion.
        spread_mm: Greatest distance from `position_mm` among the positions that single pairs of poses give. A large
            value means that the base moved, because the camera or the set-up joints did.
        spread_rad: Greatest angle from R among the rotations that single pairs give.
    """

    arm: str
    frame: str
    local_frame: str
    position_mm: Point
    rotation_xyzw: Quaternion
    spread_mm: float
    spread_rad: float

    def is_of(self, motion: Motion) -> bool:
        """Return whether it is the base of a motion's arm in the frame of that motion."""
        return (self.arm, self.frame) == (motion.arm, motion.frame)

    def seen_from(self, position_mm: Floats, rotation_xyzw: Floats) -> tuple[Floats, Floats]:
        """Transform poses from `frame` into the base's own frame.

        Args:
            position_mm: Positions in `frame`, shape (T, 3).
            rotation_xyzw: Unit quaternions in `frame`, shape (T, 4).

        Returns:
            The same in `local_frame`.
        """
        turn = matrix_of(np.array([self.rotation_xyzw]))[0]
        rotation = quaternion_of(turn.T @ matrix_of(rotation_xyzw))
        return (position_mm - np.asarray(self.position_mm)) @ turn, rotation


def _identifications(recording: Recording) -> Iterator[ArmIdentification]:
    stated = dict(recording.tools)
    measured = [motion for motion in recording.motions if not motion.from_joints]
    pairs = ((joints, motion) for joints in recording.joints for motion in measured if joints.arm == motion.arm)
    # Limited, because each pair costs some hypotheses for some thousand samples.
    for joints, motion in islice(pairs, IDENTIFIED_LIMIT):
        at, values, speeds = _joints_at(joints, motion.stamps_ns)
        if len(at) == 0:
            continue
        rotation = None if motion.rotation_xyzw is None else matrix_of(motion.rotation_xyzw[at])
        tool = stated.get(motion.arm)
        found = identify(
            values,
            motion.tip_mm[at],
            rotation,
            speeds=speeds if recording.is_timed else None,
            in_base=motion.states_base,
            stated=tool,
        )
        if found is not None:
            yield ArmIdentification(motion.arm, joints.topic, motion.topic, motion.frame, found)


def _joints_at(joints: Joints, stamps_ns: Ints) -> tuple[Ints, Floats, Floats]:
    """Return indices of stamps, at most `MOST_SAMPLES`, between two samples of the joints; joints and speeds there."""
    at = np.linspace(0, len(stamps_ns) - 1, min(len(stamps_ns), MOST_SAMPLES)).round().astype(np.int64)
    if len(joints.stamps_ns) < 2:
        return at[:0], joints.positions[:0], joints.positions[:0]
    wanted_ns, known_ns = stamps_ns[at], joints.stamps_ns
    after = np.clip(np.searchsorted(known_ns, wanted_ns), 1, len(known_ns) - 1)
    before = after - 1
    gap_ns = known_ns[after] - known_ns[before]
    same = (wanted_ns == known_ns[before]) | (wanted_ns == known_ns[after])  # nothing is interpolated
    near = (wanted_ns >= known_ns[before]) & (wanted_ns <= known_ns[after]) & (same | (gap_ns <= JOINT_GAP_NS))
    at, after, before, wanted_ns, gap_ns = at[near], after[near], before[near], wanted_ns[near], gap_ns[near]
    share = ((wanted_ns - known_ns[before]) / np.maximum(1, gap_ns))[:, None]
    # Speeds over some samples, because the difference of two is mostly the noise of the encoders.
    first, last = np.maximum(before - 2, 0), np.minimum(after + 2, len(known_ns) - 1)
    seconds = np.maximum(1, known_ns[last] - known_ns[first])[:, None] / 1e9
    speeds = (joints.positions[last] - joints.positions[first]) / seconds
    return at, (1.0 - share) * joints.positions[before] + share * joints.positions[after], speeds


def _bases_of(recording: Recording) -> Iterator[BaseFrame]:
    """Yield the bases that joints show in the frame of poses which are not stated to be in the base."""
    stated = {(motion.arm, motion.topic) for motion in recording.motions if motion.states_base}
    for one in recording.identifications:
        if one.found.verdict == "identified" and (one.arm, one.topic) not in stated:
            yield BaseFrame(
                arm=one.arm,
                frame=one.frame,
                local_frame=f"{one.arm}_base",
                position_mm=one.found.position_mm,
                rotation_xyzw=one.found.rotation_xyzw,
                spread_mm=one.found.greatest_mm,
                spread_rad=one.found.residual_rad or 0.0,
            )


def base_frames(recording: Recording) -> tuple[BaseFrame, ...]:
    """Find the poses of the bases of arms whose pose was recorded both in the base's frame and in another.

    A base is the pose in the other frame times the inverse of the pose in its own, from samples of equal stamps or the
    nearest within `PAIR_NS`. The result is the median over all pairs of samples, component by component. If the
    orientations do not agree with the tips, the rotation is fitted to the tips, and `spread_rad` is the deviation of
    the orientations from it. Of more than `BASES_LIMIT` pairs of motions only the first are compared.

    Args:
        recording: The recording.

    Returns:
        One frame for each pair of motions of an arm, in mm; none for pairs with fewer than `PAIRS_LEAST` common
        samples.
    """
    return recording.bases


def _base_frames(motions: Sequence[Motion]) -> tuple[BaseFrame, ...]:
    whole = [motion for motion in motions if motion.rotation_xyzw is not None]
    pairs = (
        (local, other)
        for local in whole
        if local.is_local
        for other in whole
        if not other.is_local and local.arm == other.arm and local.frame != other.frame
    )
    # Limited, because each pair of motions costs a pass over its samples.
    found = [_base_frame(local, other) for local, other in islice(pairs, BASES_LIMIT)]
    return tuple(base for base in found if base is not None)


def _base_frame(local: Motion, other: Motion) -> BaseFrame | None:
    """Compute the pose of a base; None if too few samples of the two motions have a counterpart in time."""
    here, there = _pairs(local.stamps_ns, other.stamps_ns)
    if len(here) < PAIRS_LEAST:
        return None
    assert local.rotation_xyzw is not None and other.rotation_xyzw is not None
    turns = _unit(_product(other.rotation_xyzw[there], local.rotation_xyzw[here] * _INVERSE))
    turns *= np.where(turns @ turns[0] < 0, -1.0, 1.0)[:, None]  # q and -q are the same turn
    # The smaller misfit of the tips decides, because recorded orientations may disagree with the tips.
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
    """Yield candidates for the rotation, each with its misfit in mm: the median of the turns, and a fit to the tips.

    The fit (Kabsch) is determined only if the tips move in more than one direction.
    """
    found = [_unit(np.median(turns, axis=0))]
    one, other = here_mm - here_mm.mean(axis=0), there_mm - there_mm.mean(axis=0)
    left, size, right = np.linalg.svd(other.T @ one)
    if size[1] > len(one) * WIDE_MM**2:
        # The last sign makes it a rotation: the best fit of flat or noisy points may be a reflection.
        proper = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
        found.append(quaternion_of((left @ proper @ right)[None])[0])
    for turn in found:
        places = there_mm - _turned(turn, here_mm)
        yield float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1))), turn


def _pairs(stamps_ns: Ints, others_ns: Ints) -> tuple[Ints, Ints]:
    """Return the indices of samples that belong together: each with the nearest of the others, if near enough."""
    after = np.clip(np.searchsorted(others_ns, stamps_ns), 1, max(1, len(others_ns) - 1))
    before = after - 1
    after = np.minimum(after, len(others_ns) - 1)
    nearer = np.where(stamps_ns - others_ns[before] <= others_ns[after] - stamps_ns, before, after)
    near = np.flatnonzero(np.abs(others_ns[nearer] - stamps_ns) <= PAIR_NS)
    return near, nearer[near]


def _product(one: Floats, other: Floats) -> Floats:
    """Multiply quaternions x, y, z, w."""
    v, w = one[..., :3], one[..., 3:]
    u, t = other[..., :3], other[..., 3:]
    vector = w * u + t * v + np.cross(v, u)
    return np.concatenate([vector, w * t - (v * u).sum(axis=-1, keepdims=True)], axis=-1)


def _turned(turn: Floats, points_mm: Floats) -> Floats:
    """Rotate points, shape (N, 3), by one unit quaternion."""
    across = 2.0 * np.cross(turn[:3], points_mm)
    turned: Floats = points_mm + turn[3] * across + np.cross(turn[:3], across)
    return turned


def _unit(quaternions: Floats) -> Floats:
    unit: Floats = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return unit


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

    Raises:
        BackwardStamps: As in `forward_samples`.
        NotFinite: A value is NaN or infinite.
    """
    kept, _, backward = forward_samples(topic, stamps_ns, values, equal_stamps=True)
    if kept is None:
        return Signal(stamps_ns, values, topic)
    check_finite(topic, stamps_ns, values)
    return Signal(stamps_ns[kept], values[kept], topic, backward)


def recorded_joints(arm: str, topic: str, stamps_ns: Ints, positions: Floats) -> Joints:
    """Make joints from samples as recorded; those whose stamps go back are dropped and counted.

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


def _preference(motion: Motion) -> tuple[int, str]:
    """Prefer the pose relative to the arm's own remote centre: camera and set-up joints do not move it."""
    known = [f"/{motion.arm}/local/measured_cp", f"/{motion.arm}/measured_cp"]
    return (known.index(motion.topic) if motion.topic in known else len(known), motion.topic)


def _listed(topics: tuple[Topic, ...]) -> str:
    if not topics:
        return ""
    return " It has " + ", ".join(f"{topic.name} ({topic.type})" for topic in topics[:20]) + "."


def _set(value: object, name: str, array: Any) -> None:
    object.__setattr__(value, name, array)
