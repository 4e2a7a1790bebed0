"""Write recordings and motions as a dVRK's recorder would have written them: an MCAP file, or a bag folder around one.

    Recording --messages_of--> Message ... --write_messages--> MCAP file --write_bag--> bag folder, zipped

Profile ros2, CDR messages with ros2msg schemas, zstd chunks with checksums. Positions go out in metres, stamps in whole
nanoseconds; the log time of a message is its stamp. The same messages give the same bytes with the same version of the
mcap library. `metadata.yaml` is of version 9, which ROS 2 Jazzy writes and reads.
"""

import io
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import IO

from mcap.writer import Writer

from skills.errors import BadRecording
from skills.recordings import messages, topics
from skills.recordings.archive import pack
from skills.recordings.messages import DEFINITIONS, HASHES, Message
from skills.recordings.walker import NOTES
from skills.style._arrays import Floats
from skills.style.recording import Joints, Motion, Recording, Signal

__all__ = [
    *("DEFINITIONS", "Written", "bag_folder", "messages_of", "metadata_of"),
    *("write_bag", "write_mcap", "write_messages"),
]

_LIBRARY = "suture-skills"
_QOS = "offered_qos_profiles"
_INSERTION = 2  # the one PSM joint that slides


@dataclass
class Written:
    """What went into a file: messages by topic, and the log times of the first and the last."""

    counts: dict[tuple[str, str], int] = field(default_factory=dict)
    first_ns: int | None = None
    last_ns: int = 0

    def count(self, message: Message) -> int:
        """Count a message: how many there were before on its topic."""
        before = self.counts.get((message.topic, message.type), 0)
        self.counts[message.topic, message.type] = before + 1
        self.first_ns = message.log_ns if self.first_ns is None else min(self.first_ns, message.log_ns)
        self.last_ns = max(self.last_ns, message.log_ns)
        return before


def write_mcap(recording: Recording) -> bytes:
    """Return the recording as the bytes of an MCAP file.

    Args:
        recording: Every motion needs an orientation, as a PoseStamped has one; stamps count from 1970.

    Raises:
        BadRecording: A motion without orientation, or a stamp before 1970.
    """
    file = io.BytesIO()
    write_messages(messages_of(recording), file, dict(recording.notes))
    return file.getvalue()


def write_messages(said: Iterable[Message], file: IO[bytes], notes: Mapping[str, str] | None = None) -> Written:
    """Write messages, in the order given, as an MCAP file; `notes` go into a metadata record of it."""
    writer, written = Writer(file), Written()
    writer.start(profile="ros2", library=_LIBRARY)
    schemas: dict[str, int] = {}
    channels: dict[tuple[str, str], int] = {}
    if notes:
        writer.add_metadata(NOTES, dict(notes))
    for message in said:
        key = (message.topic, message.type)
        if message.type not in schemas:
            definition = DEFINITIONS[message.type].encode()
            schemas[message.type] = writer.register_schema(message.type, "ros2msg", definition)
        if key not in channels:
            channels[key] = writer.register_channel(message.topic, "cdr", schemas[message.type], {_QOS: "[]"})
        writer.add_message(channels[key], message.log_ns, message.data, message.log_ns, written.count(message))
    writer.finish()  # type: ignore[no-untyped-call]
    return written


def write_bag(said: Iterable[Message], name: str = "bag", notes: Mapping[str, str] | None = None) -> bytes:
    """Return messages as a zipped bag folder, as `ros2 bag` opens it."""
    out = io.BytesIO()
    pack({member: io.BytesIO(data) for member, data in bag_folder(said, name, notes).items()}, out)
    return out.getvalue()


def bag_folder(said: Iterable[Message], name: str, notes: Mapping[str, str] | None = None) -> dict[str, bytes]:
    """Return messages as the files of a bag folder: `NAME/metadata.yaml` and `NAME/NAME.mcap`."""
    file = io.BytesIO()
    written = write_messages(said, file, notes)
    return {f"{name}/metadata.yaml": metadata_of(written, f"{name}.mcap"), f"{name}/{name}.mcap": file.getvalue()}


def messages_of(recording: Recording) -> list[Message]:
    """Return everything of a recording as messages, in order of time.

    Raises:
        BadRecording: As `write_mcap`.
    """
    if recording.origin_ns < 0:
        raise BadRecording("A message needs a stamp after 1970; give the recording one before writing.")
    return sorted(_messages(recording), key=lambda message: (message.log_ns, message.topic))


def _messages(recording: Recording) -> Iterator[Message]:
    for motion in recording.motions:
        yield from _poses(motion, "local/measured_cp")
    for motion in recording.masters:
        yield from _poses(motion, "measured_cp")
    for joints in recording.joints:
        topic = _named(joints.topic, f"/{joints.arm}/measured_js")
        for stamp_ns, row in zip(joints.stamps_ns.tolist(), _metric(joints).tolist(), strict=True):
            yield messages.joint_state(topic, stamp_ns, row)
    for kind, signals in (("jaw", recording.jaws), ("gripper", recording.grippers)):
        for arm, signal in signals:
            for stamp_ns, value in _samples(signal):
                yield messages.joint_state(f"/{arm}/{kind}/measured_js", stamp_ns, [value], [kind])
    for topic, pedal in _pedals(recording):
        for stamp_ns, value in _samples(pedal):
            yield messages.joy(topic, stamp_ns, [int(value)])
    for name, signal in recording.following:
        for stamp_ns, value in _samples(signal):
            yield messages.boolean(f"/{name}/following", stamp_ns, bool(value))
    for name, signal in recording.scales:
        for stamp_ns, value in _samples(signal):
            yield messages.number(f"/{name}/scale", stamp_ns, value)
    for arm, tool in recording.tools:
        yield messages.text(f"/{arm}/tool_type", recording.origin_ns, tool)


def _poses(motion: Motion, topic: str) -> Iterator[Message]:
    if motion.rotation_xyzw is None:
        raise BadRecording(f"{motion.topic} has no orientation, and a pose message needs one; add it before writing.")
    topic = _named(motion.topic, f"/{motion.arm}/{topic}")
    places = (motion.tip_mm / 1000.0).tolist()  # the recording speaks metres
    for stamp_ns, place_m, turn in zip(motion.stamps_ns.tolist(), places, motion.rotation_xyzw.tolist(), strict=True):
        yield messages.pose(topic, stamp_ns, motion.frame, place_m, turn)


def _metric(joints: Joints) -> Floats:
    """Return the positions as a message has them: what slides in metres."""
    positions = joints.positions.copy()
    if joints.arm.upper().startswith("PSM"):
        positions[:, _INSERTION : _INSERTION + 1] /= 1000.0
    return positions


def _pedals(recording: Recording) -> Iterator[tuple[str, Signal]]:
    yield from recording.pedals
    clutch = recording.clutch
    if clutch is not None:
        topic = _named(clutch.topic, topics.CLUTCH_TOPICS[0])
        if topic not in dict(recording.pedals):
            yield topic, clutch


def _named(topic: str, otherwise: str) -> str:
    return topic if topic.startswith("/") else otherwise


def _samples(signal: Signal) -> Iterator[tuple[int, float]]:
    return zip(signal.stamps_ns.tolist(), signal.values.tolist(), strict=True)


def metadata_of(written: Written, file: str) -> bytes:
    """Return metadata.yaml as ROS 2 Jazzy writes it, which is its version 9."""
    start_ns, count = written.first_ns or 0, sum(written.counts.values())
    duration_ns = written.last_ns - start_ns
    topics_with_count = "".join(
        f"""
    - topic_metadata:
        name: {topic}
        type: {kind}
        serialization_format: cdr
        {_QOS}: []
        type_description_hash: {HASHES[kind]}
      message_count: {messages_on}"""
        for (topic, kind), messages_on in written.counts.items()
    )
    return f"""rosbag2_bagfile_information:
  version: 9
  storage_identifier: mcap
  duration:
    nanoseconds: {duration_ns}
  starting_time:
    nanoseconds_since_epoch: {start_ns}
  message_count: {count}
  topics_with_message_count:{topics_with_count or " []"}
  compression_format: ""
  compression_mode: ""
  relative_file_paths:
    - {file}
  files:
    - path: {file}
      starting_time:
        nanoseconds_since_epoch: {start_ns}
      duration:
        nanoseconds: {duration_ns}
      message_count: {count}
  custom_data: ~
  ros_distro: jazzy
""".encode()
