"""Zips of a recording with several files.

`read_zip` reads a zipped folder: a bag with the files that its recorder wrote next to it, one episode of a LeRobot
dataset (see `lerobot`), or one JIGSAWS trial.

    session/
        rosbag_1/metadata.yaml     the bag's files in order, and their numbers of messages
        rosbag_1/rosbag_1_0.mcap   one file or several; also .mcap.zstd, .db3 (with its -wal), or .bag of ROS 1
        *.json                     the tags of the recorders (see `tags`)
        *.mp4 and others           ignored

The bag is in one folder, anywhere in the archive. The messages of a bag in several files are merged by their log time.
If there is a `metadata.yaml`, it must name exactly these files and count exactly these messages.
"""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from tempfile import TemporaryFile
from typing import IO, Any, BinaryIO

import yaml
import zstandard

from skills.demonstration.recording import Format, Recording, Topic
from skills.errors import UnknownFormat, UnreadableRecording
from skills.formats import jigsaws
from skills.formats.archive import Archive, refusing, shown
from skills.formats.lerobot import is_shadow, root_of
from skills.formats.lerobot.episode import read_episode
from skills.formats.mcap import NeedsRosbags, read_mcap
from skills.formats.mcap.cdr import UNPACK
from skills.formats.rosbag import Suffix, read_rosbag
from skills.formats.tags import TAGS_BYTES, in_time, read_labels
from skills.remedies import Action, Remedy

FILES = 1000
METADATA = "metadata.yaml"
METADATA_CHARACTERS = 1 << 20  # that of 60 topics with their QoS has 60,000
METADATA_PARTS, METADATA_DEPTH = 100_000, 20  # events of the parser; of 60 topics at most 6000, in a depth of 9
TEXTS = 10  # for one trial: its kinematics, a transcription, its motion primitives, the meta files, a README
UNZSTD_BYTES = 4 << 30
SUFFIXES = (".mcap", ".mcap.zstd", ".db3", ".bag")
LOGS = ("-wal", "-journal")  # of a database that was not closed, beside it

_DIRECTIVE = re.compile("(?:^|[\r\n\x85\u2028\u2029])%")


@dataclass(frozen=True)
class Metadata:
    """The used contents of a metadata.yaml: the names of the bag's files in order, and numbers of messages by topic."""

    files: tuple[str, ...]
    counts: dict[str, int]


def read_zip(file: BinaryIO, frame: str | None = None) -> Recording:
    """Read the bag, the episode of a LeRobot dataset, or the JIGSAWS trial in a zip archive.

    Args:
        file: The archive, seekable.
        frame: The frame of an episode's poses; the others name their own.

    Returns:
        The recording, in millimetres.

    Raises:
        UnknownFormat: It contains none of them.
        UnreadableRecording: The archive is damaged or dangerous, the bag incomplete, or a part of it unreadable.
        NoUsableTopic: No topic of the bag has the pose of a PSM.
        BadRecording: As for the files in it.
    """
    archive = Archive(file)
    names = [name for name in archive.names if not is_shadow(name)]
    if bag := [name for name in names if suffix_of(name)]:
        return _read_bag(archive, names, bag)
    if (root := root_of(names)) is not None:
        return read_episode(archive, root, frame)
    tables = [name for name in names if name.lower().endswith(".csv")]
    named = [name for name in tables if archive.text(name, errors="replace").startswith(jigsaws.HEADER)]
    texts = named + [name for name in names if name.lower().endswith(".txt")]
    if texts:
        return _read_trial(archive, texts)
    raise UnknownFormat(
        "The archive has no bag (.mcap, .mcap.zstd, .db3 or .bag), no LeRobot dataset (meta/info.json) and no JIGSAWS "
        "kinematics (.txt, or .csv below a line of names)."
    )


def suffix_of(name: str) -> str:
    """Return the suffix that marks a file as part of a bag; "" if it is not."""
    lower = name.lower()
    return next((suffix for suffix in sorted(SUFFIXES, key=len, reverse=True) if lower.endswith(suffix)), "")


def read_metadata(text: str) -> Metadata:
    """Parse the used parts of a metadata.yaml.

    Raises:
        UnreadableRecording: It is not that of a bag.
    """
    if len(text) > METADATA_CHARACTERS:
        raise UnreadableRecording(f"{METADATA} has more than {METADATA_CHARACTERS} characters. Move it away.")
    counts: Counter[str] = Counter()
    try:
        bag = _plain_yaml(text)["rosbag2_bagfile_information"]
        files = tuple(PurePosixPath(name).name for name in bag["relative_file_paths"])
        for topic in bag["topics_with_message_count"]:
            name, messages = topic["topic_metadata"]["name"], topic["message_count"]
            if not (name and messages.isdecimal() and len(messages) <= 18):  # as many digits as 64 bits hold
                raise ValueError(messages)
            counts[name] += int(messages)
        if not files:
            raise ValueError("no files")
        mode = bag.get("compression_mode", "")
    except (yaml.YAMLError, LookupError, TypeError, AttributeError, ValueError) as error:
        raise UnreadableRecording(
            f"{METADATA} is not the metadata of a bag. Move it away, or write it with `ros2 bag reindex`."
        ) from error
    if str(mode).upper() == "MESSAGE":
        raise UnreadableRecording(f"The messages of the bag are compressed one by one (compression_mode). {UNPACK}")
    return Metadata(files, dict(counts))


def _plain_yaml(text: str) -> Any:
    """Return a YAML document as texts, lists and mappings of texts.

    All scalars stay texts: the numbers of `yaml.SafeLoader` may be keys with one hash, or cost time in the square of
    their length (base 60).

    Raises:
        yaml.YAMLError: It is no YAML, or has aliases or directives, more parts or a greater depth than a bag's.
    """
    depth = 0
    if _DIRECTIVE.search(text):  # libyaml's time grows with the square of their number
        raise yaml.YAMLError("a directive")
    for number, event in enumerate(yaml.parse(text, yaml.CBaseLoader)):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent) or depth > METADATA_DEPTH or number > METADATA_PARTS:
            raise yaml.YAMLError(str(event))
    return yaml.load(text, yaml.CBaseLoader)  # noqa: S506 - a part of the safe loader: it constructs texts only


def in_order(files: Sequence[str], metadata: Metadata | None) -> list[str]:
    """Return the names of a bag's files in order of recording: that of the metadata, or else sorted.

    Raises:
        UnreadableRecording: The metadata names other files.
    """
    if metadata is None:
        return sorted(files)
    by_name = {PurePosixPath(name).name: name for name in files}
    missing = [name for name in metadata.files if name not in by_name]
    unknown = [name for name in by_name if name not in metadata.files]
    if missing or unknown:
        what = (
            f"{shown(missing[0])}, which is missing" if missing else f"no file {shown(unknown[0])}, which is in the bag"
        )
        raise UnreadableRecording(f"{METADATA} names {what}. Send the complete bag, or move {METADATA} away.")
    return [by_name[name] for name in metadata.files]


def check_counts(metadata: Metadata, topics: Iterable[Topic]) -> None:
    """Compare the numbers of messages found with those in the metadata.

    Raises:
        UnreadableRecording: A topic has more or fewer.
    """
    found: Counter[str] = Counter()
    for topic in topics:
        found[topic.name] += topic.messages
    for name in sorted({*found, *metadata.counts}):
        if found[name] != metadata.counts.get(name, 0):
            said = metadata.counts.get(name, 0)
            raise UnreadableRecording(
                f"{METADATA} lists {said} messages of {name[:200]}, the bag has {found[name]}: one of them is "
                "incomplete. Copy it again, or rewrite the metadata with `ros2 bag reindex`.",
                said=said,
                found=found[name],
            )


def unzstd(file: BinaryIO, out: IO[bytes]) -> None:
    """Decompress a file that rosbag2 compressed as one zstd stream.

    Raises:
        UnreadableRecording: Damaged, or it decompresses to more than 4 GiB.
    """
    # The window is limited because the decompressor allocates as much as the file demands.
    size, unpacker = 0, zstandard.ZstdDecompressor(max_window_size=1 << 27)
    with refusing("A .zstd file of the bag", "Copy it again."), unpacker.stream_reader(file) as reader:
        while data := reader.read(1 << 20):
            size += len(data)
            if size > UNZSTD_BYTES:
                raise UnreadableRecording(f"A file of the bag unpacks to more than {UNZSTD_BYTES} bytes. Split it.")
            out.write(data)


def read_one(file: BinaryIO) -> Recording:
    """Read one MCAP file, through rosbags if its types are defined in IDL."""
    try:
        return read_mcap(file)
    except NeedsRosbags as needs:
        integrity: Any = needs.numbers.get("integrity", "none")
        return read_rosbag([file], ".mcap", integrity)


def _read_bag(archive: Archive, names: list[str], bag: list[str]) -> Recording:
    """Read the files of the one bag in an archive, with the tags beside them; raises as `read_zip`."""
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
    suffix: Suffix = ".bag" if suffixes == [".bag"] else ".db3"
    with ExitStack() as files:
        if suffixes[0].startswith(".mcap"):
            recording = _read_mcaps(archive, ordered)
        else:
            unpacked = [files.enter_context(archive.unpacked(name)) for name in ordered]
            logs = {
                number: (beside, files.enter_context(archive.unpacked(name + beside)))
                for number, name in enumerate(ordered)
                for beside in LOGS
                if name + beside in names and archive.size(name + beside)
            }
            recording = read_rosbag(unpacked, suffix, logs=logs, counted=metadata is not None)
    if metadata is not None:
        check_counts(metadata, recording.topics)
    labels, left_aside = read_labels(dict(_tags(archive, names)))
    kind: Format = "rosbag1" if suffix == ".bag" else "rosbag2"
    # "full", because a zip archive has a checksum (CRC-32) of every file in it
    return replace(
        recording,
        format=kind,
        integrity="full",
        labels=in_time((*recording.labels, *labels)),
        left_out=(*recording.left_out, *left_aside.items()),
    )


def _read_mcaps(archive: Archive, names: list[str]) -> Recording:
    """Read the parts one after the other, so that only one at a time is unpacked, unless rosbags needs them all."""
    first, *others = names
    with _plain(archive, first) as file:
        try:
            return read_mcap(file, others=_each(archive, others))
        except NeedsRosbags:
            with ExitStack() as files:
                return read_rosbag([files.enter_context(_plain(archive, name)) for name in names], ".mcap")


def _each(archive: Archive, names: Iterable[str]) -> Iterator[BinaryIO]:
    """Yield the files one after the other, each unpacked while it is used."""
    for name in names:
        with _plain(archive, name) as file:
            yield file


@contextmanager
def _plain(archive: Archive, name: str) -> Iterator[BinaryIO]:
    """Unpack a file, and decompress it if rosbag2 compressed it as a whole."""
    with archive.unpacked(name) as file:
        if not suffix_of(name).endswith(".zstd"):
            yield file
            return
        with TemporaryFile() as out:
            unzstd(file, out)
            out.seek(0)
            yield out


def _tags(archive: Archive, names: list[str]) -> Iterator[tuple[str, str]]:
    """Yield the JSON files by name and contents.

    A file larger than any tags has the frames of a video, and is skipped; so are files beyond twice that size in total.
    """
    left = 2 * TAGS_BYTES
    for name in names:
        if name.lower().endswith(".json") and archive.size(name) <= TAGS_BYTES and archive.size(name) <= left:
            left -= archive.size(name)
            yield name, archive.text(name, errors="replace")


def _read_trial(archive: Archive, names: list[str]) -> Recording:
    """Read the one JIGSAWS trial among texts, with its transcription and ratings; raises as `read_zip`."""
    if len(names) > TEXTS:
        raise UnreadableRecording(
            f"The archive has {len(names)} text files; send one trial with its transcription at a time.",
            Remedy(Action.ADD_JIGSAWS, folder="FOLDER"),
        )
    texts = {name: archive.text(name) for name in names}
    kinematics = [name for name, text in texts.items() if jigsaws.looks_like_kinematics(text.split("\n", 1)[0])]
    transcriptions = [name for name, text in texts.items() if jigsaws.is_transcription(text)]
    primitives = [name for name, text in texts.items() if jigsaws.is_primitives(text)]
    if len(kinematics) != 1 or len(transcriptions) > 1 or len(primitives) > 1:
        raise UnreadableRecording(
            f"The archive has {len(kinematics)} texts with JIGSAWS kinematics, {len(transcriptions)} transcriptions "
            f"and {len(primitives)} with motion primitives; send one trial with its transcription at a time.",
            kinematics=len(kinematics),
        )
    trial = PurePosixPath(kinematics[0]).stem
    rated = next((found for text in texts.values() if (found := jigsaws.read_meta(text).get(trial))), None)
    with archive.unpacked(kinematics[0]) as file:
        return jigsaws.read_jigsaws(file, *(texts[name] for name in transcriptions + primitives), rated=rated)
