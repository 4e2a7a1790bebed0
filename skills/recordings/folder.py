"""Find the recording in a folder of the user's own, and make it ready to be sent: small, whole, and in one file.

    a file          goes as it is; one with pictures without them
    a bag folder    of one file goes as that file; of several, joined
    with tags       (the JSON of the recorders, anywhere in the session's folder) as a zip of the bag and its stages

A bag is rewritten only where pictures are dropped or parts are joined, then as MCAP that says what it was made from.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from skills.errors import BadInput, UnreadableRecording
from skills.recordings import ros
from skills.recordings.archive import pack
from skills.recordings.bag import METADATA, TAGS_BYTES, check_counts, in_order, read_metadata, suffix_of, unzstd
from skills.recordings.jigsaws import trials
from skills.recordings.light import PICTURES, Progress, digest_of, ignore, lighten, origin, topics_of
from skills.recordings.mcap import MAGIC
from skills.recordings.tags import read_labels
from skills.style.recording import Label, TopicInfo

_NAME = "bag"  # the names of a session's own files may tell whose it is


@dataclass(frozen=True)
class Bag:
    """A bag on this machine: its files in order, and what is written beside it."""

    files: tuple[Path, ...]
    metadata: Path | None = None
    labels: tuple[Label, ...] = ()

    @property
    def size_bytes(self) -> int:
        """How large its files are."""
        return sum(file.stat().st_size for file in self.files)


def find_bag(path: Path) -> Bag:
    """Find the one recording that a path means: a file, or the only bag in a folder.

    Raises:
        BadInput: There is none, or more than one.
        UnreadableRecording: Its metadata.yaml or tags are not readable, or name other files than there are.
    """
    if path.is_file():
        return Bag((path,))
    if not path.is_dir():
        raise BadInput(f"{path} is neither a file nor a folder.")
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and suffix_of(file.name)]
    homes = sorted({file.parent for file in files})
    if not homes and next(trials(path), None) is not None:
        raise BadInput(f"{path} has trials of JIGSAWS; `skills jigsaws add {path}` stores them.")
    if len(homes) != 1:
        listed = "".join(f"\n  {home}" for home in homes[:20])
        what = f"{len(homes)} folders with bags; name one of them:{listed}" if homes else "no .mcap, .db3 or .bag file"
        raise BadInput(f"{path} has {what}.")
    if len({suffix_of(file.name) for file in files}) > 1:
        raise BadInput(f"{homes[0]} has bags of several formats; name the file that you mean.")
    metadata = homes[0] / METADATA
    known = read_metadata(metadata.read_text(errors="replace")) if metadata.is_file() else None
    names = {file.name: file for file in files}
    ordered = in_order(sorted(names, key=_by_number), known) if known else sorted(names, key=_by_number)
    return Bag(
        files=tuple(names[name] for name in ordered),
        metadata=metadata if known else None,
        labels=_labels_in(path),
    )


@contextmanager
def ready_to_send(bag: Bag, progress: Progress = ignore) -> Iterator[Path]:
    """Make a bag ready to be sent, in a temporary folder where it has to be rewritten: the path of what to send.

    Args:
        bag: What `find_bag` found.
        progress: Is told of bytes of the original as they are read, each of them once or twice.

    Raises:
        UnreadableRecording: It is truncated or corrupt, or has other messages than its metadata.yaml says.
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
            pack({f"{_NAME}/{_NAME}{suffix_of(path.name)}": file, "session_tags.json": said}, out)
        yield packed


def _one_file(bag: Bag, folder: Path, progress: Progress) -> Path:
    """Return the bag as one file without pictures: its own where that is so already."""
    if len(bag.files) == 1 and not _can_be_rewritten(bag.files[0]):
        return bag.files[0]
    files = [_plain(file, folder) for file in bag.files]
    if len(files) == 1 and files[0] == bag.files[0]:
        topics = _topics_in(files)
        if not any(topic.type in PICTURES for topic in topics):
            _check(bag, topics)
            return files[0]
    digests = [digest_of(file, progress) for file in bag.files]
    out = folder / f"{_NAME}.mcap"
    with out.open("wb") as file:
        if files[0].suffix == ".mcap":
            notes = origin(digests, (topic for path in files for topic in topics_of(path)))
            topics = lighten(files, file, notes, progress)
        else:
            topics = ros.convert(files, file, origin(digests, ros.topics_in(files)))
    _check(bag, topics)
    return out


def _can_be_rewritten(file: Path) -> bool:
    """Say whether a file is a bag by its content and by its name: others go as they are, and the service judges."""
    with file.open("rb") as content:
        head = content.read(16)
    kinds = {".mcap": MAGIC, ".bag": ros.ROS1_MAGIC, ".db3": ros.DB3_MAGIC, ".zstd": b"\x28\xb5\x2f\xfd"}
    return file.suffix in kinds and head.startswith(kinds[file.suffix])


def _topics_in(files: Sequence[Path]) -> tuple[TopicInfo, ...]:
    return topics_of(files[0]) if files[0].suffix == ".mcap" else ros.topics_in(files)


def _check(bag: Bag, topics: Sequence[TopicInfo]) -> None:
    if bag.metadata is not None:
        check_counts(read_metadata(bag.metadata.read_text(errors="replace")), topics)


def _plain(file: Path, folder: Path) -> Path:
    """Unpack a file that rosbag2 compressed as a whole."""
    if file.suffix != ".zstd":
        return file
    plain = folder / file.stem
    with file.open("rb") as packed, plain.open("wb") as out:
        unzstd(packed, out)
    return plain


def _labels_in(folder: Path) -> tuple[Label, ...]:
    """Read the stages in a session's folder: in its JSON files, of which those with the frames of a long video may be
    too large to be of use.
    """
    texts = {}
    for file in sorted(folder.rglob("*.json")):
        if file.is_file() and file.stat().st_size <= TAGS_BYTES:
            texts[file.relative_to(folder).as_posix()] = _text(file)
    return read_labels(texts)


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise UnreadableRecording(f"{file.name} is no UTF-8 text; take it out of the folder.") from error


def _stages(labels: Sequence[Label]) -> bytes:
    """Write stages as the recorders do, with their moments and nothing else of the session."""
    stages = [
        {"name": label.name, "start": {"cpu_ts": label.start_ns}, "end": {"cpu_ts": label.end_ns}} for label in labels
    ]
    return json.dumps({"stages": stages}, indent=1, ensure_ascii=False).encode()


def _by_number(name: str) -> tuple[int, str]:
    """Order rosbag2's parts, `_2` before `_10`."""
    digits = name.split(".", 1)[0].rpartition("_")[2]
    return (int(digits) if digits.isdecimal() else 0, name)
