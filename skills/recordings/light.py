"""Copy MCAP files without their pictures, as one file: what a session's gigabytes come down to before they are sent.

Topics with pictures, point clouds and their calibrations are left out, and so are attachments; every other message goes
over as it is, with its stamps, its schema and its channel. Checksums of the original are verified on the way, and the
copy has its own. What the copy was made from is noted in it (the metadata record `suture-skills`).
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from mcap.reader import make_reader
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer

from skills.errors import UnreadableRecording
from skills.recordings.source import RECOVER
from skills.recordings.walker import NOTES
from skills.style.recording import TopicInfo

PICTURES = frozenset(
    {
        "sensor_msgs/msg/Image",
        "sensor_msgs/msg/CompressedImage",
        "sensor_msgs/msg/CameraInfo",
        "sensor_msgs/msg/PointCloud",
        "sensor_msgs/msg/PointCloud2",
        "stereo_msgs/msg/DisparityImage",
        "theora_image_transport/msg/Packet",
        "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
        "foxglove_msgs/msg/CompressedImage",
        "foxglove_msgs/msg/CompressedVideo",
        "audio_common_msgs/msg/AudioData",
    }
)
_RECORD_BYTES = 4 << 30  # the file is the caller's own
_PIECE = 1 << 20

Progress = Callable[[int], None]  # is told of bytes as they are done


def ignore(_: int) -> None:
    """Tell nobody."""


def digest_of(path: Path, progress: Progress = ignore) -> str:
    """Return the SHA-256 of a file, in hex."""
    seen = hashlib.sha256()
    with path.open("rb") as file:
        while data := file.read(_PIECE):
            seen.update(data)
            progress(len(data))
    return seen.hexdigest()


def origin(digests: Sequence[str], topics: Iterable[TopicInfo]) -> dict[str, str]:
    """Say what a copy was made from: the SHA-256 of each file, and the topics that were left out."""
    names = ["sha256"] if len(digests) == 1 else [f"sha256 of part {number + 1}" for number in range(len(digests))]
    dropped = dict.fromkeys(f"{topic.name} ({topic.type})" for topic in topics if topic.type in PICTURES)
    notes = {f"original {name}": digest for name, digest in zip(names, digests, strict=True)}
    return notes | ({"left out": ", ".join(dropped)[:10_000]} if dropped else {})


def topics_of(path: Path) -> tuple[TopicInfo, ...]:
    """Say what an MCAP file holds, by its summary; a file without one is read through.

    Raises:
        UnreadableRecording: It is truncated or corrupt.
    """
    try:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
            if summary is not None and summary.statistics is not None:
                counts, schemas = summary.statistics.channel_message_counts, summary.schemas
                return tuple(
                    TopicInfo(one.topic, _type(schemas, one), counts.get(one.id, 0))
                    for one in summary.channels.values()
                )
            file.seek(0)
            copy = _Copy(None)
            for record in _records(file, ignore):
                copy.take(record)
            return copy.topics
    except Exception as error:
        raise _unreadable(path, error) from error


def lighten(
    paths: Sequence[Path], out: IO[bytes], notes: Mapping[str, str], progress: Progress = ignore
) -> tuple[TopicInfo, ...]:
    """Copy MCAP files, one after the other, into one without pictures, and say what they held, pictures included.

    Raises:
        UnreadableRecording: One of them is truncated or corrupt.
    """
    writer = Writer(out)
    writer.start(profile="ros2", library="suture-skills")
    writer.add_metadata(NOTES, dict(notes))
    copy = _Copy(writer)
    for path in paths:
        copy.start_file()
        try:
            with path.open("rb") as file:
                for record in _records(file, progress):
                    copy.take(record)
        except Exception as error:
            raise _unreadable(path, error) from error
    writer.finish()  # type: ignore[no-untyped-call]
    return copy.topics


@dataclass
class _Copy:
    """Schemas and channels of the files so far, and where they are in the copy; None writes nothing."""

    writer: Writer | None
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    _placed: dict[int, int] = field(default_factory=dict)  # of this file: channel there and here
    _known_schemas: dict[tuple[str, str, bytes], int] = field(default_factory=dict)
    _known_channels: dict[tuple[object, ...], int] = field(default_factory=dict)

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """What the files held."""
        return tuple(TopicInfo(name, kind, count) for (name, kind), count in sorted(self.counts.items()))

    def start_file(self) -> None:
        """Forget the numbers of the file before."""
        self.schemas, self.channels, self._placed = {}, {}, {}

    def take(self, record: McapRecord) -> None:
        """Copy a record, if it is one that is copied."""
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record
            self.counts[record.topic, _type(self.schemas, record)] += 0
        elif isinstance(record, Message):
            channel = self.channels[record.channel_id]
            kind = _type(self.schemas, channel)
            self.counts[channel.topic, kind] += 1
            if self.writer is not None and kind not in PICTURES:
                number = self._placed.get(channel.id) or self._place(self.writer, channel)
                self.writer.add_message(number, record.log_time, record.data, record.publish_time, record.sequence)

    def _place(self, writer: Writer, channel: Channel) -> int:
        """Give a channel its place in the copy; the same channel of two files is one."""
        schema_number = 0
        if channel.schema_id:
            schema = self.schemas[channel.schema_id]
            known = (schema.name, schema.encoding, schema.data)
            if known not in self._known_schemas:
                self._known_schemas[known] = writer.register_schema(*known)
            schema_number = self._known_schemas[known]
        same = (channel.topic, channel.message_encoding, schema_number, tuple(sorted(channel.metadata.items())))
        if same not in self._known_channels:
            number = writer.register_channel(channel.topic, channel.message_encoding, schema_number, channel.metadata)
            self._known_channels[same] = number
        self._placed[channel.id] = self._known_channels[same]
        return self._placed[channel.id]


def _records(file: IO[bytes], progress: Progress) -> Iterator[McapRecord]:
    """Give the records of a file, those in its chunks included, and make sure that it is whole."""
    ended, at, found = False, 0, 0
    reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=_RECORD_BYTES)
    for record in reader.records:
        progress(file.tell() - at)
        at = file.tell()
        ended = ended or isinstance(record, DataEnd)
        if isinstance(record, Statistics) and record.message_count != found:
            raise UnreadableRecording(f"It says {record.message_count} messages, but holds {found}.")
        for one in breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]:
            found += isinstance(one, Message)
            if not ended:  # what follows repeats what was said
                yield one
    if not ended:
        raise UnreadableRecording("It has no end of its data section.")


def _type(schemas: Mapping[int, Schema], channel: Channel) -> str:
    return schemas[channel.schema_id].name if channel.schema_id else ""


def _unreadable(path: Path, error: Exception) -> UnreadableRecording:
    return UnreadableRecording(f"{path.name} is truncated or corrupt ({type(error).__name__}: {error}). {RECOVER}")
