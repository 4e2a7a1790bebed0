"""Read a ROS 2 recording of a dVRK from MCAP, whole or not at all.

The file is read once from front to back with every checksum verified. An index is never trusted: the library's seeking
reader drops the checksums where the index is missing, and flipped bits in it go unnoticed. A file that ends early, has
bytes after its end, lacks its footer, or holds another number of messages than its own statistics say is refused.

What "integrity" means:
    full      a checksum covers every message: of its chunk, or of the whole data section
    partial   some chunks have one, others do not
    none      no checksum (0 means "not available" in MCAP; rosbags writes so): a flipped bit would go unnoticed

Messages are taken in the order of their log time, as every MCAP reader does; samples carry the stamp of their header,
and those may not run backwards in that order.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, BinaryIO, TypeVar

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.records import Channel, Chunk, DataEnd, Header, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray

from skills.errors import MixedFrames, NoUsableTopic, SkillsError, UnreadableRecording
from skills.recordings import topics
from skills.style.recording import Integrity, Motion, Recording, Signal, TopicInfo, recorded_motion

MAGIC = b"\x89MCAP0\r\n"
CHUNK_LIMIT_BYTES = 64 * 2**20  # recorders write chunks of 1 to 4 MiB
RECORD_LIMIT_BYTES = 256 * 2**20  # attachments may be larger than chunks
TOTAL_LIMIT_BYTES = 4 * 2**30
RECOVER = "`mcap recover FILE -o NEW` writes what can be saved into a new file."

_NANO = 1_000_000_000
_Named = TypeVar("_Named", Schema, Channel)


def read_mcap(file: BinaryIO) -> Recording:
    """Read the motions, jaws and clutch of a dVRK recording.

    Args:
        file: The MCAP file, at its beginning.

    Raises:
        UnreadableRecording: Truncated, corrupt, over the limits of size, or of an encoding that is not read here.
        NoUsableTopic: No topic has the pose of a PSM.
        MixedFrames, BackwardStamps, RepeatedStamps, NotFinite, NotMetres, NotAQuaternion: See `skills.errors`.
    """
    try:
        return _recording(_read_log(file))
    except SkillsError:
        raise
    except Exception as error:  # a damaged file makes the parser raise anything, struct.error and KeyError among it
        raise UnreadableRecording(
            f"The MCAP file is truncated or corrupt ({type(error).__name__}: {error}). {RECOVER}"
        ) from error


@dataclass
class _Log:
    """What one pass over the file found; of messages only those that are used are kept."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    messages: dict[str, list[Message]] = field(default_factory=dict)
    with_checksum: int = 0
    chunks: int = 0
    uncompressed_bytes: int = 0
    data_checksum: int | None = None

    def take(self, record: McapRecord, *, checksum: bool) -> None:
        """Keep a schema, a channel or a used message."""
        if isinstance(record, Schema):
            _define(self.schemas, record.id, record)
        elif isinstance(record, Channel):
            _define(self.channels, record.id, record)
        elif isinstance(record, Message):
            self.counts[record.channel_id] += 1
            self.with_checksum += checksum
            channel = self.channels[record.channel_id]
            if _is_used(channel.topic, self.type_of(channel)):
                self.messages.setdefault(channel.topic, []).append(record)

    def type_of(self, channel: Channel) -> str:
        """Return the message type of a channel; a channel without schema has none."""
        return "" if channel.schema_id == 0 else self.schemas[channel.schema_id].name

    @property
    def integrity(self) -> Integrity:
        """Say how much of the messages a checksum covers."""
        if self.data_checksum or self.with_checksum == self.counts.total():
            return "full"
        return "partial" if self.with_checksum else "none"


def _read_log(file: BinaryIO) -> _Log:
    log = _Log()
    reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=RECORD_LIMIT_BYTES)
    for position, record in enumerate(reader.records):
        if (position == 0) != isinstance(record, Header):
            raise UnreadableRecording(f"An MCAP file begins with one header; this one does not. {RECOVER}")
        if log.data_checksum is not None:
            _check_summary(log, record)
        elif isinstance(record, DataEnd):
            log.data_checksum = record.data_section_crc
        elif isinstance(record, Chunk):
            _read_chunk(log, record)
        else:
            log.take(record, checksum=False)
    if log.data_checksum is None:
        raise UnreadableRecording(f"The MCAP file has no end of its data section. {RECOVER}")
    if file.read(1):
        raise UnreadableRecording("Bytes follow the end of the MCAP file; give one file, not several joined.")
    return log


def _read_chunk(log: _Log, chunk: Chunk) -> None:
    log.chunks += 1
    log.uncompressed_bytes += chunk.uncompressed_size
    if chunk.uncompressed_size > CHUNK_LIMIT_BYTES or log.uncompressed_bytes > TOTAL_LIMIT_BYTES:
        raise UnreadableRecording(
            f"Chunk {log.chunks} unpacks to {chunk.uncompressed_size} bytes, {log.uncompressed_bytes} in all; "
            f"the limits are {CHUNK_LIMIT_BYTES} and {TOTAL_LIMIT_BYTES}. Record with smaller chunks.",
            chunk_bytes=chunk.uncompressed_size,
            total_bytes=log.uncompressed_bytes,
        )
    plain = replace(chunk, compression="", data=_unpacked(chunk))
    for record in breakup_chunk(plain, validate_crc=True):
        log.take(record, checksum=chunk.uncompressed_crc != 0)


def _unpacked(chunk: Chunk) -> bytes:
    """Unpack a chunk into no more memory than it claims; the library trusts the frame's own size, which may be any."""
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise UnreadableRecording(f"A chunk is compressed with {chunk.compression!r}; zstd, lz4 and none are read.")
    if len(data) != size:
        raise UnreadableRecording(f"A chunk does not unpack to the {size} bytes that it claims. {RECOVER}", bytes=size)
    return data


def _check_summary(log: _Log, record: McapRecord) -> None:
    """Compare what was read with the file's own statistics: a chunk that was skipped over shows here."""
    if isinstance(record, Message | Chunk):
        raise UnreadableRecording(f"Messages follow the end of the data section. {RECOVER}")
    if not isinstance(record, Statistics):
        return
    if (record.message_count, record.chunk_count) != (log.counts.total(), log.chunks):
        raise UnreadableRecording(
            f"The MCAP file says {record.message_count} messages in {record.chunk_count} chunks, but holds "
            f"{log.counts.total()} in {log.chunks}. {RECOVER}",
            said=record.message_count,
            found=log.counts.total(),
        )


def _define(known: dict[int, _Named], number: int, record: _Named) -> None:
    if known.setdefault(number, record) != record:
        raise UnreadableRecording(f"Two {type(record).__name__.lower()}s have the number {number}. {RECOVER}")


def _is_used(topic: str, message_type: str) -> bool:
    return (
        topics.arm_of_pose(topic, message_type) is not None
        or topics.arm_of_jaw(topic, message_type) is not None
        or topics.is_clutch(topic, message_type)
    )


def _recording(log: _Log) -> Recording:
    decode = _decoder(log)
    motions, jaws, clutches = [], {}, {}
    for topic, messages in sorted(log.messages.items()):
        message_type = log.type_of(log.channels[messages[0].channel_id])
        decoded = [decode(message) for message in sorted(messages, key=lambda message: message.log_time)]
        if arm := topics.arm_of_pose(topic, message_type):
            motions.append(_motion(arm, topic, decoded))
        elif arm := topics.arm_of_jaw(topic, message_type):
            jaws[arm] = _signal(topic, decoded, "position")
        else:
            clutches[topic] = _signal(topic, decoded, "buttons")
    return Recording(
        format="mcap",
        integrity=log.integrity,
        motions=tuple(motions),
        jaws=tuple(jaws.items()),
        clutch=next((clutches[topic] for topic in topics.CLUTCH_TOPICS if topic in clutches), None),
        topics=_topics(log),
    )


def _topics(log: _Log) -> tuple[TopicInfo, ...]:
    counts: Counter[tuple[str, str]] = Counter()
    for number, channel in log.channels.items():
        counts[channel.topic, log.type_of(channel)] += log.counts[number]
    return tuple(TopicInfo(name, message_type, count) for (name, message_type), count in sorted(counts.items()))


def _decoder(log: _Log) -> Callable[[Message], Any]:
    """Return the function that decodes a message by the schema of its channel."""
    factory = DecoderFactory()
    decoders: dict[int, Callable[[bytes], Any]] = {}

    def decode(message: Message) -> Any:
        decoder = decoders.get(message.channel_id)
        if decoder is None:
            decoder = decoders[message.channel_id] = _channel_decoder(log, factory, log.channels[message.channel_id])
        return decoder(message.data)

    return decode


def _channel_decoder(log: _Log, factory: DecoderFactory, channel: Channel) -> Callable[[bytes], Any]:
    schema = log.schemas[channel.schema_id]
    decoder: Callable[[bytes], Any] | None = factory.decoder_for(channel.message_encoding, schema)
    if decoder is None:
        raise UnreadableRecording(
            f"{channel.topic} is encoded as {channel.message_encoding!r} with a {schema.encoding!r} schema; 'cdr' with "
            "'ros2msg' is read. Record where the .msg files of the packages are installed, or convert the bag.",
            topic=channel.topic,
        )
    return decoder


def _motion(arm: str, topic: str, decoded: list[Any]) -> Motion:
    poses = np.array([_pose(message) for message in decoded], dtype=np.float64)
    return recorded_motion(
        arm=arm,
        topic=topic,
        frame=_one_frame(topic, decoded),
        stamps_ns=_stamps_ns(decoded),
        tip_mm=1000.0 * poses[:, :3],  # the recording speaks metres
        rotation_xyzw=poses[:, 3:],
    )


def _pose(message: Any) -> tuple[float, ...]:
    """Return x, y, z in metres and the quaternion x, y, z, w of a PoseStamped or a TransformStamped."""
    if hasattr(message, "pose"):
        place, turn = message.pose.position, message.pose.orientation
    else:
        place, turn = message.transform.translation, message.transform.rotation
    return (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)


def _one_frame(topic: str, decoded: list[Any]) -> str:
    frames = list(dict.fromkeys(str(message.header.frame_id) for message in decoded))
    if len(frames) > 1:
        raise MixedFrames(
            f"{topic} gives poses in {len(frames)} frames, {frames[0]!r} and {frames[1]!r}; record them apart.",
            topic=topic,
            frames=frames[:20],
        )
    return frames[0]


def _signal(topic: str, decoded: list[Any], name: str) -> Signal:
    values = [getattr(message, name) for message in decoded]
    if not all(values):
        raise NoUsableTopic(f"{topic} has messages without {name}; leave the topic out of the recording.", topic=topic)
    return Signal(_stamps_ns(decoded), np.array([value[0] for value in values], dtype=np.float64), topic)


def _stamps_ns(decoded: list[Any]) -> NDArray[np.int64]:
    stamps = (message.header.stamp for message in decoded)
    return np.array([stamp.sec * _NANO + stamp.nanosec for stamp in stamps], dtype=np.int64)
