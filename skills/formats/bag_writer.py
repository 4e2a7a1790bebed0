"""Writing MCAP files and bag folders: recordings as a dVRK's recorder does, and timelines for viewers.

    Recording --messages_of--> Message ... --write_messages--> MCAP file --write_bag--> bag folder, zipped

Files have profile ros2, CDR messages with ros2msg schemas, and zstd chunks with checksums. Positions are written in
metres, angles in radians, stamps in whole nanoseconds; the log time of a message is its stamp. The same messages give
the same bytes with the same version of the mcap library. `metadata.yaml` is of version 5, the newest that ROS 2 Humble
reads; Jazzy, which writes version 9, reads it too.

A CDR message is a header of four bytes (little-endian), then every number aligned to its own size, counted from the end
of that header; a string is its length including the terminating zero, then its bytes (OMG CDR; ROS 2 design,
"Serialization").

Timelines are written for viewers such as Foxglove; a robot has no topic of them.

    Timeline --timeline_mcap--> MCAP file

Topics are `/shown/arm_ARM/pose`, `joints`, `jaw` and `speed` of each arm, `/shown/clutch`, `/shown/stage`, and one for
each trace. Positions are in metres, as in every bag; speeds in mm/s, distances in mm. The first row is at time 0. No
controller listens to them, and `read_recording` uses none of them: such a motion was not checked, or not as it
is written here. The metadata of the file say so.
"""

import io
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import IO, Self

import numpy as np
from jinja2 import Template
from mcap.writer import Writer
from numpy.typing import NDArray

from skills.arrays import Ints
from skills.demonstration.recording import NS_PER_S, Motion, Recording, Signal
from skills.errors import BadRecording
from skills.formats import topics
from skills.formats.archive import pack
from skills.formats.columns import in_metres
from skills.formats.mcap.reader import NOTES
from skills.formats.topics import BOOL, FLOAT64, JOINT_STATE, JOY, POSE, STRING
from skills.verification.timeline import ArmTrack, Timeline

_MESSAGES = files("skills.formats") / "messages"  # ROS's own definitions, with those of nested messages
DEFINITIONS = {
    kind: (_MESSAGES / f"{kind.rpartition('/')[2]}.msg").read_text()
    for kind in (POSE, JOINT_STATE, JOY, BOOL, FLOAT64, STRING)
}


@dataclass(frozen=True, slots=True)
class Message:
    """One serialised message: log time, topic, type and bytes, and the name of its publisher, if it is known."""

    log_ns: int
    topic: str
    type: str
    data: bytes
    publisher: str = ""


def pose(topic: str, stamp_ns: int, frame: str, place_m: Sequence[float], turn_xyzw: Sequence[float]) -> Message:
    """Return a PoseStamped message.

    Args:
        topic: The topic.
        stamp_ns: Stamp of the header, and log time; the same for the functions below.
        frame: Frame of the header.
        place_m: Position, 3 numbers.
        turn_xyzw: Unit quaternion, 4 numbers.
    """
    body = _Body().header(stamp_ns, frame).put("7d", *place_m, *turn_xyzw)
    return Message(stamp_ns, topic, POSE, bytes(body.data))


def joint_state(
    topic: str,
    stamp_ns: int,
    positions: Sequence[float],
    names: Sequence[str] = (),
    *,
    velocities: Sequence[float] = (),
    efforts: Sequence[float] = (),
    frame: str = "",
) -> Message:
    """Return a JointState message with positions in rad or m, and optional velocities and efforts."""
    body = _Body().header(stamp_ns, frame).put("I", len(names))
    for name in names:
        body.text(name)
    body.numbers("d", positions).numbers("d", velocities).numbers("d", efforts)
    return Message(stamp_ns, topic, JOINT_STATE, bytes(body.data))


def joy(topic: str, stamp_ns: int, buttons: Sequence[int], *, frame: str = "") -> Message:
    """Return a Joy message with a pedal's state: `buttons[0]` is 0 released, 1 pressed, 2 a quick tap."""
    body = _Body().header(stamp_ns, frame).numbers("f", ()).numbers("i", buttons)
    return Message(stamp_ns, topic, JOY, bytes(body.data))


def boolean(topic: str, log_ns: int, value: bool) -> Message:
    """Return a Bool message, which has no stamp."""
    return Message(log_ns, topic, BOOL, bytes(_Body().put("?", value).data))


def number(topic: str, log_ns: int, value: float) -> Message:
    """Return a Float64 message, which has no stamp."""
    return Message(log_ns, topic, FLOAT64, bytes(_Body().put("d", value).data))


def text(topic: str, log_ns: int, value: str) -> Message:
    """Return a String message, which has no stamp."""
    return Message(log_ns, topic, STRING, bytes(_Body().text(value).data))


class _Body:
    """A builder of a message's bytes; each method appends, and returns the builder."""

    def __init__(self) -> None:
        self.data = bytearray(b"\x00\x01\x00\x00")  # plain CDR, little-endian

    def put(self, code: str, *values: float) -> Self:
        """Append numbers of one size, aligned to it."""
        size = struct.calcsize(code[-1])
        self.data.extend(bytes(-(len(self.data) - 4) % size))  # aligned from the end of the header
        self.data += struct.pack("<" + code, *values)
        return self

    def text(self, value: str) -> Self:
        """Append a string."""
        data = value.encode() + b"\0"
        self.put("I", len(data)).data.extend(data)
        return self

    def numbers(self, code: str, values: Sequence[float]) -> Self:
        """Append a sequence: its length, then its elements."""
        self.put("I", len(values))
        return self.put(f"{len(values)}{code}", *values) if values else self

    def header(self, stamp_ns: int, frame: str) -> Self:
        """Append a std_msgs/Header."""
        return self.put("i", stamp_ns // NS_PER_S).put("I", stamp_ns % NS_PER_S).text(frame)


@dataclass
class Written:
    """Statistics of a written file: messages by topic, and the log times of the first and the last message."""

    counts: dict[tuple[str, str], int] = field(default_factory=dict)
    first_ns: int | None = None
    last_ns: int = 0

    def count(self, message: Message) -> int:
        """Count a message, and return the number of earlier messages on its topic."""
        before = self.counts.get((message.topic, message.type), 0)
        self.counts[message.topic, message.type] = before + 1
        self.first_ns = message.log_ns if self.first_ns is None else min(self.first_ns, message.log_ns)
        self.last_ns = max(self.last_ns, message.log_ns)
        return before


def write_mcap(recording: Recording) -> bytes:
    """Return the recording as the bytes of an MCAP file.

    Args:
        recording: Every motion needs an orientation, because a PoseStamped has one; stamps count from 1970.

    Raises:
        BadRecording: A motion without orientation, or a stamp before 1970.
    """
    file = io.BytesIO()
    write_messages(messages_of(recording), file, dict(recording.notes))
    return file.getvalue()


def write_messages(
    said: Iterable[Message],
    file: IO[bytes],
    notes: Mapping[str, str] | None = None,
    definitions: Mapping[str, str] = DEFINITIONS,
) -> Written:
    """Write messages as an MCAP file.

    Args:
        said: The messages, in the order of writing.
        file: The file.
        notes: Stored in a metadata record of the file.
        definitions: The ros2msg definition of each message type.
    """
    writer, written = Writer(file), Written()
    writer.start(profile="ros2", library="suture-skills")
    schemas: dict[str, int] = {}
    channels: dict[tuple[str, str, str], int] = {}
    if notes:
        writer.add_metadata(NOTES, dict(notes))
    for message in said:
        key = (message.topic, message.type, message.publisher)
        if message.type not in schemas:
            definition = definitions[message.type].encode()
            schemas[message.type] = writer.register_schema(message.type, "ros2msg", definition)
        if key not in channels:
            about = {"offered_qos_profiles": "[]"} | ({"callerid": message.publisher} if message.publisher else {})
            channels[key] = writer.register_channel(message.topic, "cdr", schemas[message.type], about)
        writer.add_message(channels[key], message.log_ns, message.data, message.log_ns, written.count(message))
    writer.finish()  # type: ignore[no-untyped-call]
    return written


def write_bag(said: Iterable[Message], name: str = "bag", notes: Mapping[str, str] | None = None) -> bytes:
    """Return messages as a zipped bag folder, which `ros2 bag` can open when unpacked."""
    out = io.BytesIO()
    pack({member: io.BytesIO(data) for member, data in bag_folder(said, name, notes).items()}, out)
    return out.getvalue()


def bag_folder(said: Iterable[Message], name: str, notes: Mapping[str, str] | None = None) -> dict[str, bytes]:
    """Return messages as the files of a bag folder: `NAME/metadata.yaml` and `NAME/NAME.mcap`."""
    file = io.BytesIO()
    written = write_messages(said, file, notes)
    return {f"{name}/metadata.yaml": metadata_of(written, f"{name}.mcap"), f"{name}/{name}.mcap": file.getvalue()}


def messages_of(recording: Recording) -> list[Message]:
    """Return the complete contents of a recording as messages, in order of time.

    Raises:
        BadRecording: As `write_mcap`.
    """
    if recording.origin_ns < 0:
        raise BadRecording("A message needs a stamp after 1970; set one before writing.")
    # By topic too, so that messages of the same time have a defined order.
    return sorted(_messages(recording), key=lambda message: (message.log_ns, message.topic))


def _messages(recording: Recording) -> Iterator[Message]:
    """Yield the messages of a recording, stream after stream."""
    for motion in recording.motions:
        yield from _poses(motion, "local/measured_cp")
    for motion in recording.masters:
        yield from _poses(motion, "measured_cp")
    for joints in recording.joints:
        topic = _named(joints.topic, f"/{joints.arm}/measured_js")
        positions = in_metres(joints.positions) if joints.arm.upper().startswith("PSM") else joints.positions
        for stamp_ns, row in zip(joints.stamps_ns.tolist(), positions.tolist(), strict=True):
            yield joint_state(topic, stamp_ns, row)
    for motion in recording.setpoints:
        yield from _poses(motion, "setpoint_cp")
    angles = (
        *(("jaw/measured_js", arm, signal) for arm, signal in recording.jaws),
        *(("gripper/measured_js", arm, signal) for arm, signal in recording.grippers),
        *(("jaw/setpoint_js", arm, signal) for arm, signal in recording.jaw_setpoints),
    )
    for topic, arm, signal in angles:
        for stamp_ns, value in _samples(signal):
            yield joint_state(f"/{arm}/{topic}", stamp_ns, [value], [topic.split("/")[0]])
    for topic, pedal in _pedals(recording):
        for stamp_ns, value in _samples(pedal):
            yield joy(topic, stamp_ns, [int(value)])
    for name, signal in recording.following:
        for stamp_ns, value in _samples(signal):
            yield boolean(f"/{name}/following", stamp_ns, bool(value))
    for name, signal in recording.scales:
        for stamp_ns, value in _samples(signal):
            yield number(f"/{name}/scale", stamp_ns, value)
    for arm, tool in recording.tools:
        yield text(f"/{arm}/tool_type", recording.origin_ns, tool)


def _poses(motion: Motion, topic: str) -> Iterator[Message]:
    """Yield the poses of a motion, on its own topic or on that of its arm."""
    if motion.rotation_xyzw is None:
        raise BadRecording(f"{motion.topic} has no orientation, and a pose message needs one; add it before writing.")
    topic = _named(motion.topic, f"/{motion.arm}/{topic}")
    places = (motion.tip_mm / 1000.0).tolist()  # ROS messages are in metres
    for stamp_ns, place_m, turn in zip(motion.stamps_ns.tolist(), places, motion.rotation_xyzw.tolist(), strict=True):
        yield pose(topic, stamp_ns, motion.frame, place_m, turn)


def _pedals(recording: Recording) -> Iterator[tuple[str, Signal]]:
    """Yield the topics and states of the pedals, the clutch among them."""
    yield from recording.pedals
    clutch = recording.clutch
    if clutch is not None:
        topic = _named(clutch.topic, topics.CLUTCH_TOPICS[0])
        if topic not in dict(recording.pedals):  # an MCAP file's clutch is one of its pedals, a table's is not
            yield topic, clutch


def _named(topic: str, otherwise: str) -> str:
    """Return a name that is a topic, or else another topic."""
    return topic if topic.startswith("/") else otherwise


def _samples(signal: Signal) -> Iterator[tuple[int, float]]:
    return zip(signal.stamps_ns.tolist(), signal.values.tolist(), strict=True)


def metadata_of(written: Written, file: str) -> bytes:
    """Return the metadata.yaml of a bag with one file, as ROS 2 Humble writes it (version 5).

    In versions 4 to 8 the profiles are a text that has YAML in it, and Humble refuses the list of version 9.
    """
    start_ns = written.first_ns or 0
    template = Template((_MESSAGES / "metadata.yaml").read_text(), keep_trailing_newline=True, autoescape=False)
    text: str = template.render(
        file=file,
        start_ns=start_ns,
        duration_ns=written.last_ns - start_ns,
        count=sum(written.counts.values()),
        topics=[(topic, kind, count) for (topic, kind), count in written.counts.items()],
    )
    return text.encode()


PREFIX = "/shown"
USE = "to look at; not for execution"
MOST_HZ = 100.0  # ours: a viewer draws no more, and each message takes 10 us to write


def timeline_mcap(timeline: Timeline, source: str) -> bytes:
    """Return the MCAP file of a timeline; the same timeline gives the same bytes.

    Args:
        timeline: The timeline.
        source: Path of the resource from which it was made, for the metadata.
    """
    file = io.BytesIO()
    said = sorted(_shown(timeline), key=lambda message: message.log_ns)  # stable: topics keep their order
    write_messages(said, file, {"use": USE, "kind": timeline.kind, "source": source})
    return file.getvalue()


def _shown(timeline: Timeline) -> Iterator[Message]:
    """Yield the messages of a timeline, stream after stream."""
    rows = np.arange(0, timeline.rows, max(1, int(timeline.rate_hz / MOST_HZ)))
    stamps_ns = np.round(rows / timeline.rate_hz * 1e9).astype(np.int64).tolist()
    for arm in timeline.arms:
        yield from _of_arm(arm, rows, stamps_ns)
    for trace in timeline.traces:
        yield from _numbers(_topic(trace.name), stamps_ns, trace.values[rows])
    for begin_s, end_s in timeline.clutch_s:
        for second, down in ((begin_s, True), (end_s, False)):
            yield boolean(f"{PREFIX}/clutch", _ns(timeline, second), down)
    for stage in timeline.stages:
        yield text(f"{PREFIX}/stage", _ns(timeline, stage.start_s), stage.name)


def _of_arm(arm: ArmTrack, rows: Ints, stamps_ns: list[int]) -> Iterator[Message]:
    """Yield the messages of an arm at some rows of its columns; those without a recorded number are left out."""
    topic = _topic(f"arm {arm.arm}")
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(rows), 1)) if arm.rotation_xyzw is None else arm.rotation_xyzw[rows]
    poses = np.hstack([arm.tip_mm[rows] / 1000.0, turns])
    for stamp_ns, row in zip(stamps_ns, poses.tolist(), strict=True):
        if row[0] == row[0]:  # not NaN: the arm was recorded
            yield pose(f"{topic}/pose", stamp_ns, arm.frame, row[:3], row[3:])
    if arm.joints is not None:
        for stamp_ns, row in zip(stamps_ns, in_metres(arm.joints[rows]).tolist(), strict=True):
            if row[0] == row[0]:
                yield joint_state(f"{topic}/joints", stamp_ns, row)
    for name, column in (("jaw", arm.jaw_rad), ("speed", arm.speed_mm_s)):
        if column is not None:
            yield from _numbers(f"{topic}/{name}", stamps_ns, column[rows])


def _numbers(topic: str, stamps_ns: list[int], values: NDArray[np.float32]) -> Iterator[Message]:
    """Yield the numbers that are not NaN."""
    for stamp_ns, value in zip(stamps_ns, values.tolist(), strict=True):
        if value == value:
            yield number(topic, stamp_ns, value)


def _ns(timeline: Timeline, second: float) -> int:
    """Return the nanoseconds since the first row; 0 for earlier times."""
    return max(0, round((second - timeline.start_s) * 1e9))


def _topic(name: str) -> str:
    """Return the topic of a trace or an arm."""
    return f"{PREFIX}/{re.sub(r'[^A-Za-z0-9]+', '_', name).strip('_')}"
