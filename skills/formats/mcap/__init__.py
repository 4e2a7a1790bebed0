"""The reader of a dVRK's ROS 2 recordings in MCAP files; a file is read completely or refused.

    file --Walker--> parts of the file --Decoder--> columns, by topic --read_mcap--> Recording

The file is read once, sequentially, and every checksum is verified; see `reader`. The integrity of a recording is
    full      a checksum covers every message: that of its chunk, or that of the whole data section
    partial   some chunks have a checksum, others do not
    none      no checksum (0 means "not available" in MCAP; rosbags writes 0): a flipped bit would not be detected

Messages are taken in order of their log time, as every MCAP reader does; samples have the stamp of their header. Few
poses, joints and jaw angles with stamps that decrease in that order are dropped and counted; events such as pedals are
not, because each one counts. Messages without a header have their log time as stamp.

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
from skills.errors import MixedFrames, NoUsableTopic, SkillsError, UnreadableRecording
from skills.formats import topics
from skills.formats.mcap.cdr import WANTED_POSE, Columns, Decoder, Field, Wanted, fields_of
from skills.formats.mcap.reader import MAGIC, Channel, MessageSchema, Part, Walker
from skills.formats.mcap.records import RECOVER
from skills.formats.topics import Meaning, TopicKind
from skills.kinematics import INSERTION

__all__ = ["MAGIC", "NeedsRosbags", "read_mcap"]

TOOL_LIMIT = 200  # characters of an instrument's name
MeaningOf = Callable[[str, str], Meaning | None]  # of a topic and its message type

_POSITION = Wanted(("position",), first=True)
_ANGLES = (TopicKind.JAW, TopicKind.GRIPPER, TopicKind.JAW_SETPOINT)  # continuous values, the first of a joint state
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


def read_mcap(file: BinaryIO, meaning: MeaningOf = topics.meaning) -> recording.Recording:
    """Read the used topics of a dVRK recording.

    Args:
        file: The MCAP file, at its beginning.
        meaning: Returns what a topic of a message type means; a topic without a meaning is not read.

    Returns:
        The recording, in millimetres.

    Raises:
        UnreadableRecording: Truncated, corrupt, over a size limit, or in an unsupported encoding.
        NeedsRosbags: The file is valid, but a used topic is defined in another language, such as IDL.
        NoUsableTopic: No topic has the pose of a PSM.
        MixedFrames, BackwardStamps, RepeatedStamps, NotFinite, NotMetres, NotAQuaternion: See `skills.errors`.
    """
    try:
        return _recording(_read_log(file, meaning))
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

    @property
    def is_needed(self) -> bool:
        """True if a demonstration needs the topic."""
        return self.meaning.kind in (TopicKind.MOTION, TopicKind.JAW) or self.name in topics.CLUTCH_TOPICS


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

    def take(self, part: Part) -> None:
        """Decode the messages of a part whose topics are used, and store them."""
        for number in part.numbers:
            channel = self.walker.channels[number]
            if (decoder := self._decoder_of(channel)) is None:
                continue
            topic = self.topics[channel.topic]
            try:
                topic.columns.append(decoder.decode(part.data, *part.of(number)))
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
    log = _Log(Walker(file), meaning)
    for part in log.walker.parts():
        log.take(part)
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
    found: dict[TopicKind, list[tuple[str, Any]]] = {kind: [] for kind in TopicKind}  # owners and their values
    for topic in sorted(log.topics.values(), key=lambda topic: topic.name):
        kind, owner = topic.meaning.kind, topic.meaning.owner
        try:
            if topic.columns:
                found[kind].append((owner, _MAKERS.get(kind, _signal)(topic)))
        except SkillsError as error:
            log.leave_out(topic, error)
    values = {kind: tuple(value for _, value in of_kind) for kind, of_kind in found.items()}
    signals = {kind: tuple(dict(of_kind).items()) for kind, of_kind in found.items()}  # the last one of each owner
    pedals = dict(signals[TopicKind.PEDAL])
    counts: Counter[tuple[str, str]] = Counter()
    for number, channel in log.walker.channels.items():
        counts[channel.topic, log.type_of(channel)] += log.walker.counts[number]
    return recording.Recording(
        format="mcap",
        integrity=log.walker.integrity,
        motions=values[TopicKind.MOTION],
        jaws=signals[TopicKind.JAW],
        clutch=next((pedals[name] for name in topics.CLUTCH_TOPICS if name in pedals), None),
        topics=topics.counted(counts),
        joints=values[TopicKind.JOINTS],
        masters=values[TopicKind.MASTER],
        grippers=signals[TopicKind.GRIPPER],
        pedals=signals[TopicKind.PEDAL],
        following=signals[TopicKind.FOLLOWING],
        scales=signals[TopicKind.SCALE],
        tools=tuple(found[TopicKind.TOOL]),
        notes=tuple(sorted(log.walker.notes.items())),
        left_out=tuple(sorted(log.left_out.items())),
        setpoints=values[TopicKind.SETPOINT],
        jaw_setpoints=signals[TopicKind.JAW_SETPOINT],
    )


# ---- from columns to values -------------------------------------------------------------------------------------


def _motion(topic: _Topic) -> recording.Motion:
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
    stamps_ns, positions = _in_order(topic)
    if topic.meaning.owner.upper().startswith("PSM"):
        if positions.shape[1] <= INSERTION:
            raise NoUsableTopic(f"{topic.name} has {positions.shape[1]} joints; a PSM has 6.", topic=topic.name)
        with np.errstate(over="ignore"):  # infinite values are refused below
            positions[:, INSERTION] *= 1000.0  # ROS messages are in metres
    return recording.recorded_joints(topic.meaning.owner, topic.name, stamps_ns, positions)


def _signal(topic: _Topic) -> recording.Signal:
    stamps_ns, values = _in_order(topic)
    if values.shape[1] == 0:
        raise NoUsableTopic(
            f"{topic.name} has messages without a value; remove the topic from the recording.", topic=topic.name
        )
    make = recording.recorded_signal if topic.meaning.kind in _ANGLES else recording.Signal
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
    stamps_ns = _concatenated(list(_stamps(topic)))
    values = _concatenated([columns.values for columns in topic.columns])
    if (log_ns[1:] >= log_ns[:-1]).all():
        return stamps_ns, values
    order = np.argsort(log_ns, kind="stable")  # messages of the same log time stay in the file's order
    return stamps_ns[order], values[order]


def _concatenated(arrays: list[NDArray[Any]]) -> NDArray[Any]:
    """Concatenate arrays; without a copy where there is only one, as usual."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _stamps(topic: _Topic) -> Iterable[Ints]:
    for columns in topic.columns:
        if columns.stamps_ns is not None:
            yield columns.stamps_ns
        elif columns.log_ns.max() < 2**63:
            yield columns.log_ns.astype(np.int64)
        else:
            raise UnreadableRecording(f"{topic.name} was logged after the year 2262.", topic=topic.name)
