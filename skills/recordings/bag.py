"""Read a zipped folder: a bag with what its recorder wrote beside it, or one trial of JIGSAWS.

    session/
        rosbag_1/metadata.yaml     which files belong to the bag, in which order, with how many messages
        rosbag_1/rosbag_1_0.mcap   one file or several; also .mcap.zstd, .db3, or .bag of ROS 1
        *.json                     the tags of the recorders (see `tags`)
        *.mp4 and all else         not looked at

The bag is in one folder, wherever that is. A bag in several files is joined topic by topic, in order of time. Where
there is a `metadata.yaml`, it has to name just these files and to count just these messages.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from tempfile import TemporaryFile
from typing import IO, Any, BinaryIO

import zstandard

from skills.errors import NoUsableTopic, UnknownFormat, UnreadableRecording
from skills.recordings import jigsaws
from skills.recordings.archive import Archive, shown
from skills.recordings.joining import in_time, join
from skills.recordings.mcap import NeedsRosbags, read_mcap
from skills.recordings.refusing import refusing
from skills.recordings.ros import Suffix, read_rosbag
from skills.recordings.tags import read_labels
from skills.style.recording import Format, Recording, TopicInfo

FILES = 1000
METADATA = "metadata.yaml"
METADATA_CHARACTERS = 1 << 20  # of 60 topics with their QoS it has 60,000
TAGS_BYTES = 32 << 20  # of one JSON file: the frames of a day of video
TEXTS = 10  # beside one trial's kinematics: a transcription, the meta files, a README
UNZSTD_BYTES = 4 << 30
SUFFIXES = (".mcap", ".mcap.zstd", ".db3", ".bag")

_OWN_INDENT = "  "  # of the bag's own keys
_KEY = re.compile(r"(?P<indent> *)(?P<dash>- +)?(?P<name>\w+):(?: +(?P<value>\S.*))?")
_ITEM = re.compile(r" *- +(\S.*)")


@dataclass(frozen=True)
class Metadata:
    """What matters of a metadata.yaml: the names of the bag's files in order, and messages by topic."""

    files: tuple[str, ...]
    counts: dict[str, int]


def read_zip(file: BinaryIO) -> Recording:
    """Read the bag, or the trial of JIGSAWS, in a zip archive.

    Raises:
        UnknownFormat: There is neither in it.
        UnreadableRecording: The archive is damaged or dangerous, the bag incomplete, or a part of it unreadable.
        NoUsableTopic: No topic of the bag, or of a part of it, has the pose of a PSM.
        BadRecording: As for the files in it.
    """
    archive = Archive(file)
    names = [name for name in archive.names if not _is_shadow(name)]
    if bag := [name for name in names if suffix_of(name)]:
        return _read_bag(archive, names, bag)
    texts = [name for name in names if name.lower().endswith(".txt")]
    if texts:
        return _read_trial(archive, texts)
    raise UnknownFormat("The archive has no bag (.mcap, .mcap.zstd, .db3 or .bag) and no JIGSAWS kinematics (.txt).")


def suffix_of(name: str) -> str:
    """Return the ending by which a file is part of a bag, "" where it is none."""
    return next((suffix for suffix in sorted(SUFFIXES, key=len, reverse=True) if name.endswith(suffix)), "")


def read_metadata(text: str) -> Metadata:
    """Read what matters of a metadata.yaml, in the block style in which rosbag2 writes it.

    Raises:
        UnreadableRecording: It is not that of a bag.
    """
    if len(text) > METADATA_CHARACTERS:
        raise UnreadableRecording(f"{METADATA} has more than {METADATA_CHARACTERS} characters. Leave it out.")
    section, item_indent = "", ""
    files: list[str] = []
    items: list[dict[str, str]] = []
    for line in map(str.rstrip, text.splitlines()):
        key = _KEY.fullmatch(line)
        if key and key["indent"] == _OWN_INDENT and not key["dash"]:
            section, item_indent = key["name"], ""
        elif section == "relative_file_paths" and (listed := _ITEM.fullmatch(line)):
            files.append(PurePosixPath(listed[1].strip("\"'")).name)
        elif section == "topics_with_message_count" and key:
            if key["dash"] and key["indent"] == (item_indent or key["indent"]):
                item_indent = key["indent"]
                items.append({})
            if items and key["name"] in ("name", "message_count"):
                items[-1].setdefault(key["name"], (key["value"] or "").strip("\"'"))
    whole = all(item.get("name") and item.get("message_count", "").isdecimal() for item in items)
    if not files or not whole:
        raise UnreadableRecording(f"{METADATA} is not a bag's. Leave it out, or write it with `ros2 bag reindex`.")
    counts: Counter[str] = Counter()
    for item in items:
        counts[item["name"]] += int(item["message_count"][:18])
    return Metadata(tuple(files), dict(counts))


def in_order(files: Sequence[str], metadata: Metadata | None) -> list[str]:
    """Put the names of a bag's files in the order in which they were recorded, as far as it is known.

    Raises:
        UnreadableRecording: The metadata name other files.
    """
    if metadata is None:
        return sorted(files)
    by_name = {PurePosixPath(name).name: name for name in files}
    missing = [name for name in metadata.files if name not in by_name]
    unknown = [name for name in by_name if name not in metadata.files]
    if missing or unknown:
        what = f"{shown(missing[0])}, which is not there" if missing else f"not {shown(unknown[0])}, which is there"
        raise UnreadableRecording(f"{METADATA} names {what}. Send the whole bag, or leave {METADATA} out.")
    return [by_name[name] for name in metadata.files]


def check_counts(metadata: Metadata, topics: Iterable[TopicInfo]) -> None:
    """Compare the messages that were found with those of the metadata.

    Raises:
        UnreadableRecording: There are more or fewer on a topic.
    """
    found: Counter[str] = Counter()
    for topic in topics:
        found[topic.name] += topic.messages
    for name in sorted({*found, *metadata.counts}):
        if found[name] != metadata.counts.get(name, 0):
            said = metadata.counts.get(name, 0)
            raise UnreadableRecording(
                f"{METADATA} says {said} messages of {name[:200]}, the bag has {found[name]}: it is incomplete. Copy "
                "it again, or rewrite the metadata with `ros2 bag reindex`.",
                said=said,
                found=found[name],
            )


def unzstd(file: BinaryIO, out: IO[bytes]) -> None:
    """Unpack a file that rosbag2 compressed as a whole.

    Raises:
        UnreadableRecording: Damaged, or it unpacks to more than 4 GiB.
    """
    size, unpacker = 0, zstandard.ZstdDecompressor(max_window_size=1 << 27)
    with refusing("A .zstd file of the bag", "Copy it again."), unpacker.stream_reader(file) as reader:
        while data := reader.read(1 << 20):
            size += len(data)
            if size > UNZSTD_BYTES:
                raise UnreadableRecording(f"A file of the bag unpacks to more than {UNZSTD_BYTES} bytes. Split it.")
            out.write(data)


def read_one(file: BinaryIO) -> Recording:
    """Read one MCAP file, through rosbags where its types are given in IDL."""
    try:
        return read_mcap(file)
    except NeedsRosbags as needs:
        integrity: Any = needs.numbers.get("integrity", "none")
        return read_rosbag([file], ".mcap", integrity)


def _read_bag(archive: Archive, names: list[str], bag: list[str]) -> Recording:
    folders = sorted({str(PurePosixPath(name).parent) for name in bag})
    suffixes = sorted({suffix_of(name) for name in bag})
    if len(folders) > 1 or len(suffixes) > 1 or len(bag) > FILES:
        raise UnreadableRecording(
            f"The archive has {len(bag)} files of bags in {len(folders)} folders, as {', '.join(suffixes)}; send one "
            "bag at a time."
        )
    described = str(PurePosixPath(folders[0]) / METADATA)
    metadata = read_metadata(archive.text(described)) if described in names else None
    ordered = in_order(bag, metadata)
    recording = _READERS[suffixes[0]](archive, ordered)
    if metadata is not None:
        check_counts(metadata, recording.topics)
    labels = read_labels(dict(_tags(archive, names)))
    kind: Format = "rosbag1" if suffixes[0] == ".bag" else "rosbag2"
    # "full", because the archive has a checksum of every file in it
    return replace(recording, format=kind, integrity="full", labels=in_time((*recording.labels, *labels)))


def _read_mcaps(archive: Archive, names: list[str]) -> Recording:
    """Read the parts one after the other, so that one of them is unpacked at a time."""
    parts = []
    for name in names:
        with _plain(archive, name) as file:
            try:
                parts.append(read_one(file))
            except NoUsableTopic as error:
                if len(names) == 1:
                    raise
                raise NoUsableTopic(
                    f"{shown(name)}, a part of the bag: {error} `skills recording add FOLDER` joins the parts first."
                ) from error
    return join(sorted(parts, key=lambda part: part.origin_ns))


def _through_rosbags(suffix: Suffix) -> Callable[[Archive, list[str]], Recording]:
    def read(archive: Archive, names: list[str]) -> Recording:
        with ExitStack() as files:
            return read_rosbag([files.enter_context(archive.unpacked(name)) for name in names], suffix)

    return read


_READERS: dict[str, Callable[[Archive, list[str]], Recording]] = {
    ".mcap": _read_mcaps,
    ".mcap.zstd": _read_mcaps,
    ".db3": _through_rosbags(".db3"),
    ".bag": _through_rosbags(".bag"),
}


@contextmanager
def _plain(archive: Archive, name: str) -> Iterator[BinaryIO]:
    with archive.unpacked(name) as file:
        if not name.endswith(".zstd"):
            yield file
            return
        with TemporaryFile() as out:
            unzstd(file, out)
            out.seek(0)
            yield out


def _tags(archive: Archive, names: list[str]) -> Iterator[tuple[str, str]]:
    """Give the JSON files; a longer one than any of tags can be has the frames of a video, which need no reading."""
    left = 2 * TAGS_BYTES
    for name in names:
        if name.lower().endswith(".json") and archive.size(name) <= TAGS_BYTES and archive.size(name) <= left:
            left -= archive.size(name)
            yield name, archive.text(name)


def _read_trial(archive: Archive, names: list[str]) -> Recording:
    if len(names) > TEXTS:
        raise UnreadableRecording(
            f"The archive has {len(names)} text files; send one trial with its transcription at a time. "
            "`skills jigsaws add FOLDER` sends a whole folder."
        )
    texts = {name: archive.text(name) for name in names}
    kinematics = [name for name, text in texts.items() if jigsaws.looks_like_kinematics(text.split("\n", 1)[0])]
    transcriptions = [name for name, text in texts.items() if jigsaws.is_transcription(text)]
    if len(kinematics) != 1 or len(transcriptions) > 1:
        raise UnreadableRecording(
            f"The archive has {len(kinematics)} texts with JIGSAWS kinematics and {len(transcriptions)} "
            "transcriptions; send one trial with its transcription at a time.",
            kinematics=len(kinematics),
        )
    trial = PurePosixPath(kinematics[0]).stem
    rated = next((found for text in texts.values() if (found := jigsaws.read_meta(text).get(trial))), None)
    with archive.unpacked(kinematics[0]) as file:
        return jigsaws.read_jigsaws(file, "".join(texts[name] for name in transcriptions), rated)


def _is_shadow(name: str) -> bool:
    """Say whether a member only tells a Mac how to show another one."""
    path = PurePosixPath(name)
    return path.name.startswith("._") or "__MACOSX" in path.parts
