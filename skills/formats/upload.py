"""Preparing the user's own recordings for upload: finding a bag on disk, and making it small, complete and one file.

    path --find_bag--> Bag --prepare_upload--> the path of the file to send

    a file          unchanged; with pictures, a copy without them
    a bag folder    with one file, like that file; with several, joined
    with tags       (the recorders' JSON, anywhere in the session's folder) a zip of the bag and its stages

A bag is rewritten only to drop pictures or to join parts, as MCAP with notes about its original files (the metadata
record `suture-skills`). Topics with pictures, point clouds and their calibrations are left out, and so are attachments,
which reduces a session's gigabytes; every other message is copied unchanged, with its stamps, schema and channel.
Checksums of the original are verified while copying, and the copy has its own.
"""

import json
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Channel, Message, Schema
from mcap.writer import Writer

from skills.demonstration.recording import Label, Topic
from skills.errors import BadInput, SkillsError, UnreadableRecording
from skills.formats import bag_folder, rosbag
from skills.formats.archive import HEAD_BYTES, check_pointer, pack
from skills.formats.checksums import digest_of
from skills.formats.jigsaws import trials
from skills.formats.lerobot import INFO
from skills.formats.mcap import MAGIC
from skills.formats.mcap.reader import NOTES
from skills.formats.mcap.records import RECOVER
from skills.formats.tags import TAGS_BYTES, read_labels
from skills.formats.topics import counted
from skills.remedies import Action, Remedy, did_you_mean

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
_RECORD_BYTES = 4 << 30  # generous, because the user's own file is trusted
_NAME = "bag"  # the original file names may identify a person

Progress = Callable[[int], None]  # called with the number of bytes processed since the last call


def ignore(_: int) -> None:
    """Ignore progress: the default callback."""


@dataclass(frozen=True)
class Bag:
    """A bag on this machine: its files in order, its metadata.yaml, its stages, and JSON beside it that is not read."""

    files: tuple[Path, ...]
    metadata: bag_folder.Metadata | None = None
    labels: tuple[Label, ...] = ()
    left_aside: tuple[str, ...] = ()

    @property
    def size_bytes(self) -> int:
        """The total size of its files."""
        return sum(file.stat().st_size for file in self.files)


def find_bag(path: Path) -> Bag:
    """Find the recording at a path: a file, or the only bag in a folder.

    Raises:
        BadInput: There is no bag, or more than one.
        UnreadableRecording: Its metadata.yaml or its tags are unreadable, or name other files than those present.
    """
    if path.is_file():
        return Bag((path,))
    if not path.is_dir():
        beside = [one.name for one in path.parent.iterdir()] if path.parent.is_dir() else []
        raise BadInput(
            f"{path} is neither a file nor a folder.",
            *did_you_mean(path.name, beside),
            "Check its spelling and the current folder.",
        )
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and bag_folder.suffix_of(file.name)]
    homes = sorted({file.parent for file in files})
    if not homes and (path / INFO).is_file():
        raise BadInput(f"{path} is a LeRobot dataset.", Remedy(Action.CUT_EPISODE))
    if not homes and next(trials(path), None) is not None:
        raise BadInput(f"{path} is a folder with trials of JIGSAWS.", Remedy(Action.ADD_JIGSAWS, folder=str(path)))
    if not homes:
        raise BadInput(f"{path} has no .mcap, .db3 or .bag file.", "Name a recording's file, or the folder of a bag.")
    if len(homes) != 1:
        listed = "".join(f"\n  {home}" for home in homes[:20])
        raise BadInput(f"{path} has {len(homes)} folders with bags; name one of them:{listed}.")
    if len({bag_folder.suffix_of(file.name) for file in files}) > 1:
        raise BadInput(f"{homes[0]} has bags of several formats; name one of the files.")
    metadata = homes[0] / bag_folder.METADATA
    known = bag_folder.read_metadata(metadata.read_text(errors="replace")) if metadata.is_file() else None
    names = {file.name: file for file in files}
    ordered = bag_folder.in_order(sorted(names, key=_by_number), known) if known else sorted(names, key=_by_number)
    labels, left_aside = _labels_in(path)
    return Bag(tuple(names[name] for name in ordered), known, labels, tuple(left_aside))


@contextmanager
def prepare_upload(bag: Bag, progress: Progress = ignore) -> Iterator[Path]:
    """Prepare a bag for upload, and yield the path of the file to send.

    If the bag has to be rewritten, the file is in a temporary folder that is removed after the block.

    Args:
        bag: The bag, from `find_bag`.
        progress: Callback, called with the numbers of bytes of the original as they are read, each byte once or twice.

    Raises:
        UnreadableRecording: It is truncated or corrupt, or its messages differ from its metadata.yaml.
    """
    with TemporaryDirectory() as folder:
        path = _one_file(bag, Path(folder), progress)
        if not bag.labels:
            yield path
            return
        packed = Path(folder) / "session.zip"
        stages = Path(folder) / "session_tags.json"
        stages.write_bytes(_stages(bag.labels))
        with path.open("rb") as file, stages.open("rb") as said, packed.open("wb") as out:
            pack({f"{_NAME}/{_NAME}{bag_folder.suffix_of(path.name)}": file, "session_tags.json": said}, out)
        yield packed


def _one_file(bag: Bag, folder: Path, progress: Progress) -> Path:
    """Return the bag as one file without pictures; the original file if it is one already."""
    if len(bag.files) == 1 and not _can_be_rewritten(bag.files[0]):
        return bag.files[0]
    files = [_plain_file(file, folder, counted=bag.metadata is not None) for file in bag.files]
    if len(files) == 1 and files[0] == bag.files[0]:
        topics = topics_of(files[0]) if files[0].suffix == ".mcap" else rosbag.topics_in(files)
        if not any(topic.type in PICTURES for topic in topics):
            _check(bag, topics)
            return files[0]
    digests = [_digest(file, progress) for file in bag.files]
    out = folder / f"{_NAME}.mcap"
    with out.open("wb") as file:
        if files[0].suffix == ".mcap":
            notes = notes_of_original(digests, (topic for path in files for topic in topics_of(path)))
            topics = copy_without_pictures(files, file, notes, progress)
        else:
            topics = rosbag.convert(files, file, notes_of_original(digests, rosbag.topics_in(files)))
    _check(bag, topics)
    return out


def _can_be_rewritten(file: Path) -> bool:
    """Return whether a file is a bag by both content and name.

    Others are sent unchanged, so that the service reports the error.
    """
    with file.open("rb") as content:
        head = content.read(16)
    kinds = {".mcap": MAGIC, ".bag": rosbag.ROS1_MAGIC, ".db3": rosbag.DB3_MAGIC, ".zstd": b"\x28\xb5\x2f\xfd"}
    suffix = file.suffix.lower()
    return suffix in kinds and head.startswith(kinds[suffix])


def _check(bag: Bag, topics: Sequence[Topic]) -> None:
    if bag.metadata is not None:
        bag_folder.check_counts(bag.metadata, topics)


def _plain_file(file: Path, folder: Path, *, counted: bool) -> Path:
    """Return a file as rosbags and MCAP's library read it, or such a copy in the folder.

    One that rosbag2 compressed is decompressed, a database is merged with its log, a suffix is in small letters. A
    database in WAL mode without its log remains as it is, so that the service refuses it, unless its messages are
    counted.
    """
    suffix = file.suffix.lower()
    with file.open("rb") as content:
        check_pointer(content.read(HEAD_BYTES))
    if suffix != ".zstd":
        logs = [log for log in (Path(f"{file}{beside}") for beside in bag_folder.LOGS) if log.is_file()]
        with file.open("rb") as content:
            is_merged = suffix == ".db3" and (bool(logs) or (counted and rosbag.is_in_wal_mode(content)))
        if not is_merged and suffix == file.suffix:
            return file
        plain = folder / f"{file.stem}{suffix}"
        for one in (file, *logs):
            shutil.copyfile(one, f"{plain}{one.name.removeprefix(file.name)}")
        if is_merged:
            rosbag.merge_log(plain)
        return plain
    plain = folder / file.stem.lower()
    with file.open("rb") as packed, plain.open("wb") as out:
        bag_folder.unzstd(packed, out)
    return plain


def _labels_in(folder: Path) -> tuple[tuple[Label, ...], dict[str, str]]:
    """Read the stages, and the files left aside, from the JSON files in a session's folder.

    A file over `TAGS_BYTES` has the frames of a long video, and is skipped.
    """
    texts = {}
    for file in sorted(folder.rglob("*.json")):
        if file.is_file() and file.stat().st_size <= TAGS_BYTES:
            texts[file.relative_to(folder).as_posix()] = file.read_text(encoding="utf-8-sig", errors="replace")
    return read_labels(texts)


def _stages(labels: Sequence[Label]) -> bytes:
    """Serialise stages in the recorders' format, with their times and no other data of the session."""
    stages = [
        {"name": label.name, "start": {"cpu_ts": label.start_ns}, "end": {"cpu_ts": label.end_ns}} for label in labels
    ]
    return json.dumps({"stages": stages}, indent=1, ensure_ascii=False).encode()


def _by_number(name: str) -> tuple[int, str]:
    """Sort key for rosbag2's parts: `_2` before `_10`."""
    digits = name.split(".", 1)[0].rpartition("_")[2]
    return (int(digits) if digits.isdecimal() else 0, name)


# ---- copies without pictures -----------------------------------------------------------------------------------------


def _digest(path: Path, progress: Progress) -> str:
    with path.open("rb") as file:
        return digest_of(file, lambda data: progress(len(data)))


def notes_of_original(digests: Sequence[str], topics: Iterable[Topic]) -> dict[str, str]:
    """Return the notes about a copy's original: the SHA-256 of each file, and the topics that were left out."""
    names = ["sha256"] if len(digests) == 1 else [f"sha256 of part {number + 1}" for number in range(len(digests))]
    dropped = dict.fromkeys(f"{topic.name} ({topic.type})" for topic in topics if topic.type in PICTURES)
    notes = {f"original {name}": digest for name, digest in zip(names, digests, strict=True)}
    return notes | ({"left out": ", ".join(dropped)[:10_000]} if dropped else {})


def topics_of(path: Path) -> tuple[Topic, ...]:
    """Return the topics of an MCAP file from its summary; a file without one is read completely.

    Raises:
        UnreadableRecording: It is truncated or corrupt.
    """
    try:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
            if summary is not None and summary.statistics is not None:
                counts, schemas = summary.statistics.channel_message_counts, summary.schemas
                return tuple(
                    Topic(one.topic, _type(schemas.get(one.schema_id)), counts.get(one.id, 0))
                    for one in summary.channels.values()
                )
            file.seek(0)
            return counted(Counter((channel.topic, _type(schema)) for schema, channel, _ in _messages(file, ignore)))
    except Exception as error:
        raise _unreadable(path, error) from error


def copy_without_pictures(
    paths: Sequence[Path], out: IO[bytes], notes: Mapping[str, str], progress: Progress = ignore
) -> tuple[Topic, ...]:
    """Copy MCAP files, one after the other, into one file without pictures.

    Args:
        paths: The files, in order of time.
        out: The copy.
        notes: For the copy's metadata record, from `notes_of_original`.
        progress: Callback, called with numbers of bytes as they are read.

    Returns:
        The topics of the originals, including pictures.

    Raises:
        UnreadableRecording: One of them is truncated or corrupt.
    """
    writer = Writer(out)
    writer.start(profile="ros2", library="suture-skills")
    writer.add_metadata(NOTES, dict(notes))
    counts: Counter[tuple[str, str]] = Counter()
    numbers: dict[
        tuple[object, ...], int
    ] = {}  # in the copy; equal schemas, and equal channels, of two files share one
    for path in paths:
        try:
            with path.open("rb") as file:
                counts.update({(topic.name, topic.type): 0 for topic in topics_of(path)})  # also without messages
                for schema, channel, message in _messages(file, progress):
                    kind = _type(schema)
                    counts[channel.topic, kind] += 1
                    if kind not in PICTURES:
                        number = _place(writer, numbers, schema, channel)
                        writer.add_message(
                            number, message.log_time, message.data, message.publish_time, message.sequence
                        )
        except SkillsError:
            raise
        except Exception as error:
            raise _unreadable(path, error) from error
    writer.finish()  # type: ignore[no-untyped-call]
    return counted(counts)


def _place(writer: Writer, numbers: dict[tuple[object, ...], int], schema: Schema | None, channel: Channel) -> int:
    """Return the number of a channel in the copy, where it is registered first if it is not yet."""
    schema_number = 0
    if schema is not None:
        known = (schema.name, schema.encoding, schema.data)
        schema_number = numbers.get(known) or numbers.setdefault(known, writer.register_schema(*known))
    same = (channel.topic, channel.message_encoding, schema_number, tuple(sorted(channel.metadata.items())))
    if same not in numbers:
        numbers[same] = writer.register_channel(
            channel.topic, channel.message_encoding, schema_number, channel.metadata
        )
    return numbers[same]


def _messages(file: IO[bytes], progress: Progress) -> Iterator[tuple[Schema | None, Channel, Message]]:
    """Yield the messages of a file, and check that it is complete."""
    at, found = 0, 0
    reader = NonSeekingReader(file, validate_crcs=True, record_size_limit=_RECORD_BYTES)
    for one in reader.iter_messages(log_time_order=False):
        progress(file.tell() - at)
        at, found = file.tell(), found + 1
        yield one
    progress(file.tell() - at)
    file.seek(0)
    summary = make_reader(file).get_summary()
    declared = None if summary is None or summary.statistics is None else summary.statistics.message_count
    if declared not in (None, found):
        raise UnreadableRecording(f"it declares {declared} messages, but has {found}")


def _type(schema: Schema | None) -> str:
    return "" if schema is None else schema.name


def _unreadable(path: Path, error: Exception) -> UnreadableRecording:
    return UnreadableRecording(f"{path.name} is truncated or corrupt ({error}). {RECOVER}")
