"""The reader of a dVRK's ROS 2 recordings in MCAP files; a file is read completely or refused.

    file --Walker--> parts of the file --Decoder--> columns, by topic --read_mcap--> Recording

The file is read once, sequentially, and every checksum is verified; see `reader`. The integrity of a recording is
    full      a checksum covers every message: that of its chunk, or that of the whole data section
    partial   some chunks have a checksum, others do not
    none      no checksum (0 means "not available" in MCAP; rosbags writes 0): a flipped bit would not be detected

Messages are taken in order of their log time, as every MCAP reader does; samples have the stamp of their header. Few
poses, joints and jaw angles with stamps that decrease in that order are dropped and counted; of events such as pedals,
each of which counts, only repeated messages are. Messages without a header have their log time as stamp, and so have
all of a topic whose headers have the stamp 0. The parts of a split recording are read as one file.

A demonstration needs the motions, the jaws and the clutch: an error in one of them refuses the file. All other topics,
setpoints among them, are optional: one that cannot be used is omitted, and `left_out` has the reason.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from skills.arrays import Floats, Ints
from skills.demonstration import recording
from skills.errors import ImplausibleMotion, MixedFrames, MixedSources, NoUsableTopic, SkillsError, UnreadableRecording
from skills.formats import topics
from skills.formats.columns import check_joints
from skills.formats.mcap.cdr import WANTED_POSE, Columns, Decoder, Field, Wanted, fields_of
from skills.formats.mcap.reader import MAGIC, Channel, MessageSchema, Part, Walker
from skills.formats.mcap.records import RECOVER
from skills.formats.topics import Meaning, TopicKind
from skills.kinematics import INSERTION

__all__ = ["MAGIC", "NeedsRosbags", "read_mcap"]

OVERLAP_NS = 1_000_000_000  # ours: parts of a bag overlap by some messages, a restarted node not at all
CLOCK_S = 2.0  # ours: shorter recordings are not compared with the time of their reception
DECADE = 0.003  # ours, as a logarithm: 0.7 %, more than the delays of reception in such a time
NOTE_LIMIT = 500
TOOL_LIMIT = 200  # characters of an instrument's name
MeaningOf = Callable[[str, str], Meaning | None]  # of a topic and its message type

_POSITION = Wanted(("position",), first=True)
_ANGLES = (TopicKind.JAW, TopicKind.GRIPPER, TopicKind.JAW_SETPOINT)  # continuous values, the first of a joint state
_MOVING = (TopicKind.MOTION, TopicKind.MASTER, TopicKind.SETPOINT, TopicKind.JOINTS, *_ANGLES)
_WANTED = {
    topics.POSE: WANTED_POSE,
    topics.TRANSFORM: Wanted(
        tuple(f"transform.translation.{axis}" for axis in "xyz")
        + tuple(f"transform.rotation.{axis}" for axis in "xyzw"),
        WANTED_POSE.text,  # both messages begin with a header
    ),
    topics.JOINT_STATE: Wanted(("position",)),
    topics.JOY: Wanted(("buttons",), first=True),
    topics.BOOL: Wanted(("data",)),
    topics.FLOAT64: Wanted(("data",)),
    topics.STRING: Wanted((), "data"),
}


class NeedsRosbags(UnreadableRecording):
    """A valid file with message types that only rosbags can read; `numbers["integrity"]` is the file's integrity."""


def read_mcap(
    file: BinaryIO, meaning: MeaningOf = topics.meaning, others: Iterable[BinaryIO] = ()
) -> recording.Recording:
    """Read the used topics of a dVRK recording.

    Args:
        file: The MCAP file, at its beginning.
        meaning: Returns what a topic of a message type means; a topic without a meaning is not read.
        others: The other parts of a recording that was split, in any order, each read before the next is taken. Their
            messages are merged by log time.

    Returns:
        The recording, in millimetres.

    Raises:
        UnreadableRecording: Truncated, corrupt, over a size limit, or in an unsupported encoding.
        NeedsRosbags: The file is valid, but a used topic is defined in another language, such as IDL.
        NoUsableTopic: No topic has the pose of a PSM.
        MixedFrames, BackwardStamps, RepeatedStamps, NotFinite, NotMetres, NotAQuaternion: See `skills.errors`.
    """
    try:
        log = _read_log(file, meaning)
        for other in others:
            log.merge(_read_log(other, meaning))
        return _recording(log)
    except (SkillsError, MemoryError):
        raise
    except Exception as error:  # on a damaged file a parser may raise anything
        raise UnreadableRecording(f"The MCAP file is truncated or corrupt ({error}). {RECOVER}") from error


@dataclass
class _Topic:
    """The messages of one topic, in the order of the file."""

    name: str
    meaning: Meaning
    columns: list[Columns] = field(default_factory=list)
    channels: list[Channel] = field(default_factory=list)  # of each of the columns

    @property
    def is_needed(self) -> bool:
        """True if a demonstration needs the topic."""
        return self.meaning.kind in (TopicKind.MOTION, TopicKind.JAW) or self.name in topics.CLUTCH_TOPICS

    @property
    def is_unset(self) -> bool:
        """True if the stamps of all headers are 0, which in ROS means that the driver sets none."""
        # the last stamp first, because it decides in nearly every recording
        return bool(self.columns) and not any(
            one.stamps_ns is None or one.stamps_ns[-1] or one.stamps_ns.any() for one in self.columns
        )


@dataclass
class _Log:
    """The contents of a file, decoded part by part; only messages of used topics are stored."""

    walker: Walker
    meaning_of: MeaningOf
    topics: dict[str, _Topic] = field(default_factory=dict)
    decoders: dict[int, Decoder | None] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    foreign: list[Channel] = field(default_factory=list)
    fields: dict[int, tuple[Field, ...]] = field(default_factory=dict)
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)  # of messages, by topic and type
    notes: dict[str, str] = field(default_factory=dict)
    integrities: set[recording.Integrity] = field(default_factory=set)

    def take(self, part: Part) -> None:
        """Decode the messages of a part whose topics are used, and store them."""
        for number in part.numbers:
            channel = self.walker.channels[number]
            if (decoder := self._decoder_of(channel)) is None:
                continue
            topic = self.topics[channel.topic]
            try:
                topic.columns.append(decoder.decode(part.data, *part.of(number)))
                topic.channels.append(channel)
            except SkillsError as error:
                self.leave_out(topic, error)

    def _decoder_of(self, channel: Channel) -> Decoder | None:
        """Return the cached decoder of a channel; None if the channel is not used."""
        if channel.number not in self.decoders:
            self.decoders[channel.number] = self._decoder(channel)
        return None if channel.topic in self.left_out else self.decoders[channel.number]

    def leave_out(self, topic: _Topic, error: SkillsError) -> None:
        """Omit a topic that cannot be used; raise the error if a demonstration needs the topic."""
        if topic.is_needed:
            raise error
        self.left_out[topic.name] = str(error)
        topic.columns.clear()
        topic.channels.clear()

    def merge(self, other: "_Log") -> None:
        """Add the contents of another part of the same recording."""
        for name, topic in other.topics.items():
            mine = self.topics.setdefault(name, topic)
            if mine is not topic:
                mine.columns += topic.columns
                mine.channels += topic.channels
        self.left_out |= other.left_out
        self.notes |= other.notes
        self.counts += other.counts
        self.integrities |= other.integrities

    def close(self) -> None:
        """Note what the whole file says, after its last part was taken."""
        walker = self.walker
        self.notes, self.integrities = dict(walker.notes), {walker.integrity}
        for number, channel in walker.channels.items():
            self.counts[channel.topic, self.type_of(channel)] += walker.counts[number]

    def type_of(self, channel: Channel) -> str:
        """Return the message type of a channel; "" for a channel without schema."""
        return "" if channel.schema == 0 else self.walker.schemas[channel.schema].name

    def _decoder(self, channel: Channel) -> Decoder | None:
        """Create the decoder of a channel; None if the channel is not used, or its types are in IDL."""
        message_type = _ros2_name(self.type_of(channel))
        meaning = self.meaning_of(channel.topic, message_type)
        if meaning is None:
            return None
        schema = self.walker.schemas[channel.schema]
        topic = self.topics.setdefault(channel.topic, _Topic(channel.topic, meaning))
        if schema.encoding == "ros2idl" and not topics.is_setpoint(channel.topic, message_type):
            self.foreign.append(channel)
            return None
        wanted = _POSITION if meaning.kind in _ANGLES else _WANTED[message_type]
        try:
            _check_encoding(channel, schema)
            if channel.schema not in self.fields:
                self.fields[channel.schema] = fields_of(schema.name, _text(schema))
            return Decoder(channel.topic, self.fields[channel.schema], wanted)
        except SkillsError as error:
            self.leave_out(topic, error)
            return None


def _read_log(file: BinaryIO, meaning: MeaningOf) -> _Log:
    """Read a file, and decode the messages of its used topics.

    Raises:
        NeedsRosbags: One of them is defined in another language.
    """
    log = _Log(Walker(file), meaning)
    for part in log.walker.parts():
        log.take(part)
    log.close()
    if log.foreign:
        channel, integrity = log.foreign[0], log.walker.integrity
        schema = log.walker.schemas[channel.schema]
        raise NeedsRosbags(
            f"{channel.topic} has a type that is defined in {schema.encoding!r}; only 'ros2msg' is supported. "
            "Record where the .msg files of the packages are installed, or convert the bag.",
            topic=channel.topic,
            integrity=integrity,
        )
    return log


def _text(schema: MessageSchema) -> str:
    try:
        return schema.definition.decode()
    except UnicodeDecodeError:
        raise UnreadableRecording(f"The definition of {schema.name} is not UTF-8. {RECOVER}") from None


def _check_encoding(channel: Channel, schema: MessageSchema) -> None:
    """Refuse messages in another encoding than CDR with ros2msg definitions."""
    if channel.encoding == "ros1":
        raise UnreadableRecording(
            f"The MCAP file has the messages of a ROS 1 bag ({channel.topic}), which are not read from MCAP. Send the "
            ".bag from which it was converted."
        )
    if (channel.encoding, schema.encoding) != ("cdr", "ros2msg"):
        raise UnreadableRecording(
            f"{channel.topic} is encoded as {channel.encoding!r} with a {schema.encoding!r} schema; only 'cdr' "
            "with 'ros2msg' is supported. Convert the bag with `ros2 bag convert` or `rosbags-convert`.",
            topic=channel.topic,
        )


def _ros2_name(name: str) -> str:
    """Convert a ROS 1 type name such as "std_msgs/Bool" to the form "std_msgs/msg/Bool"."""
    return name.replace("/", "/msg/") if name.count("/") == 1 else name


def _recording(log: _Log) -> recording.Recording:
    """Return the recording of decoded messages; raises as `read_mcap`."""
    found: dict[TopicKind, list[tuple[str, Any]]] = {kind: [] for kind in TopicKind}  # owners and their values
    for topic in sorted(log.topics.values(), key=lambda topic: topic.name):
        kind, owner = topic.meaning.kind, topic.meaning.owner
        try:
            if topic.columns and topic.name not in log.left_out:
                found[kind].append((owner, _MAKERS.get(kind, _signal)(topic)))
        except SkillsError as error:
            log.leave_out(topic, error)
    values = {kind: tuple(value for _, value in of_kind) for kind, of_kind in found.items()}
    signals = {kind: tuple(dict(of_kind).items()) for kind, of_kind in found.items()}  # the last one of each owner
    pedals = dict(signals[TopicKind.PEDAL])
    (integrity, *others) = log.integrities
    listed = topics.counted(log.counts)
    return recording.Recording(
        format="mcap",
        integrity="partial" if others else integrity,
        motions=values[TopicKind.MOTION],
        jaws=signals[TopicKind.JAW],
        clutch=next((pedals[name] for name in topics.CLUTCH_TOPICS if name in pedals), None),
        topics=listed,
        joints=values[TopicKind.JOINTS],
        masters=values[TopicKind.MASTER],
        grippers=signals[TopicKind.GRIPPER],
        pedals=signals[TopicKind.PEDAL],
        following=signals[TopicKind.FOLLOWING],
        scales=signals[TopicKind.SCALE],
        tools=tuple(found[TopicKind.TOOL]),
        notes=(*sorted(log.notes.items()), *_reception(log)),
        left_out=tuple(sorted((dict(topics.not_understood(listed)) | log.left_out).items())),
        setpoints=values[TopicKind.SETPOINT],
        jaw_setpoints=signals[TopicKind.JAW_SETPOINT],
    )


# ---- from columns to values -------------------------------------------------------------------------------------


def _motion(topic: _Topic) -> recording.Motion:
    """Return the motion of a topic of poses, in mm."""
    stamps_ns, poses = _in_order(topic)
    with np.errstate(over="ignore"):  # infinite values are refused below
        tip_mm = 1000.0 * poses[:, :3]  # ROS messages are in metres
    return recording.recorded_motion(
        arm=topic.meaning.owner,
        topic=topic.name,
        frame=_one_frame(topic),
        stamps_ns=stamps_ns,
        tip_mm=tip_mm,
        rotation_xyzw=poses[:, 3:],
    )


def _one_frame(topic: _Topic) -> str:
    """Return the frame of all poses of a topic; raises `MixedFrames` if there are several."""
    frames = list(dict.fromkeys(frame for columns in topic.columns for frame in columns.labels_in_order))
    if len(frames) > 1:
        raise MixedFrames(
            f"{topic.name} has poses in {len(frames)} frames, {frames[0]!r} and {frames[1]!r}; record each frame "
            "on a separate topic.",
            topic=topic.name,
            frames=frames[:20],
        )
    return frames[0]


def _joints(topic: _Topic) -> recording.Joints:
    """Return the joints of a topic, the insertion of a PSM in mm."""
    stamps_ns, positions = _in_order(topic)
    if topic.meaning.owner.upper().startswith("PSM"):
        if positions.shape[1] <= INSERTION:
            raise NoUsableTopic(f"{topic.name} has {positions.shape[1]} joints; a PSM has 6.", topic=topic.name)
        with np.errstate(over="ignore"):  # infinite values are refused below
            positions[:, INSERTION] *= 1000.0  # ROS messages are in metres
        check_joints(topic.name, positions)
    return recording.recorded_joints(topic.meaning.owner, topic.name, stamps_ns, positions)


def _signal(topic: _Topic) -> recording.Signal:
    """Return the first value of each message of a topic as a signal."""
    stamps_ns, values = _in_order(topic)
    if values.shape[1] == 0:
        raise NoUsableTopic(
            f"{topic.name} has messages without a value; remove the topic from the recording.", topic=topic.name
        )
    make = recording.recorded_signal if topic.meaning.kind in _ANGLES else recording.recorded_events
    return make(stamps_ns, values[:, 0], topic.name)


def _tool(topic: _Topic) -> str:
    """Return the last instrument by log time."""
    log_ns = np.concatenate([columns.log_ns for columns in topic.columns])
    said = [columns.labels[k] for columns in topic.columns for k in columns.label_of.tolist()]
    last: str = said[len(said) - 1 - int(np.argmax(log_ns[::-1]))]
    if len(last) > TOOL_LIMIT or not last.isprintable():
        raise NoUsableTopic(f"{topic.name} names no instrument; remove the topic from the recording.", topic=topic.name)
    return last


_MAKERS: dict[TopicKind, Callable[[_Topic], Any]] = {  # of all other kinds `_signal`
    **dict.fromkeys((TopicKind.MOTION, TopicKind.MASTER, TopicKind.SETPOINT), _motion),
    TopicKind.JOINTS: _joints,
    TopicKind.TOOL: _tool,
}


def _in_order(topic: _Topic) -> tuple[Ints, Floats]:
    """Return stamps, shape (T,), and values, shape (T, K), in order of log time."""
    log_ns = np.concatenate([columns.log_ns for columns in topic.columns])
    widths = sorted({columns.values.shape[1] for columns in topic.columns})
    if len(widths) > 1:
        raise NoUsableTopic(
            f"{topic.name} has messages with {widths[0]} and {widths[1]} values; record them on separate topics.",
            topic=topic.name,
        )
    _check_one_source(topic)
    stamps_ns = _concatenated(list(_stamps(topic)))
    if topic.meaning.kind in _MOVING:  # a pedal's last state may be far older than its reception
        _check_clocks(topic.name, stamps_ns, log_ns)
    values = _concatenated([columns.values for columns in topic.columns])
    if (log_ns[1:] >= log_ns[:-1]).all():
        return stamps_ns, values
    order = np.argsort(log_ns, kind="stable")  # messages of the same log time stay in the file's order
    return stamps_ns[order], values[order]


def _check_one_source(topic: _Topic) -> None:
    """Refuse a topic on which two publishers write at the same time: their poses would be woven into one motion.

    Raises:
        MixedSources: Two channels overlap in time by more than `OVERLAP_NS`, and do not repeat the same messages.
    """
    found: dict[int, list[Columns]] = {}
    for channel, columns in zip(topic.channels, topic.columns, strict=True):
        found.setdefault(channel.number, []).append(columns)
    if len(found) == 1 or topic.meaning.kind not in _MOVING:
        return
    spans = ((np.concatenate([c.log_ns for c in some]), number) for number, some in found.items())
    (_, end, one), *later = sorted((int(log_ns.min()), int(log_ns.max()), number) for log_ns, number in spans)
    for start, other_end, other in later:
        if min(end, other_end) - start > OVERLAP_NS and not _repeats(found[one], found[other]):
            named = {channel.number: f"{channel.number} {channel.publisher}".strip() for channel in topic.channels}
            raise MixedSources(
                f"{topic.name} has two publishers at the same time, on the channels {named[one]} and {named[other]}; "
                "their poses are not one motion. Stop one of them, or keep one channel of the recording.",
                channels=[one, other],
            )
        end, one = max((end, one), (other_end, other))


def _repeats(some: list[Columns], others: list[Columns]) -> bool:
    """Return whether the messages of one of two channels are all on the other one too, by their stamps and values."""
    one, other = (
        {(at, row.tobytes()) for c in channel for at, row in zip(c.known_ns.tolist(), c.values, strict=True)}
        for channel in (some, others)
    )
    return one <= other or other <= one


def _check_clocks(topic: str, stamps_ns: Ints, log_ns: NDArray[np.uint64]) -> None:
    """Refuse stamps in another unit than their seconds: beside them is the time of reception.

    Raises:
        ImplausibleMotion: The stamps last a power of ten as long as the reception.
    """
    logged_s = abs(int(log_ns[-1]) - int(log_ns[0])) / 1e9
    stamped_s = abs(int(stamps_ns[-1]) - int(stamps_ns[0])) / 1e9
    if min(logged_s, stamped_s) <= 0 or max(logged_s, stamped_s) < CLOCK_S:
        return
    decades = np.log10(stamped_s / logged_s)
    if abs(decades) > 0.5 and abs(decades - round(decades)) < DECADE:
        raise ImplausibleMotion(
            f"{topic}: its stamps last {stamped_s:.6g} s, and its messages were received within {logged_s:.6g} s: "
            "the stamps are in another unit. Correct them, or the node that sets them."
        )


def _reception(log: _Log) -> list[tuple[str, str]]:
    """Return the note that names the topics without stamps."""
    unset = sorted(topic.name for topic in log.topics.values() if topic.is_unset)
    words = f"the time of reception, since the stamps of all headers are 0: {', '.join(unset)}"
    return [("stamps", words[:NOTE_LIMIT])] if unset else []


def _concatenated(arrays: list[NDArray[Any]]) -> NDArray[Any]:
    """Concatenate arrays; without a copy where there is only one, as usual."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _stamps(topic: _Topic) -> Iterable[Ints]:
    """Yield the stamps of a topic part by part: those of the headers, or else of the reception."""
    is_unset = topic.is_unset
    for columns in topic.columns:
        if columns.stamps_ns is not None and not is_unset:
            yield columns.stamps_ns
        elif columns.log_ns.max() < 2**63:
            yield columns.log_ns.astype(np.int64)
        else:
            raise UnreadableRecording(f"{topic.name} was logged after the year 2262.", topic=topic.name)
