"""Read what surgeons recorded: a dVRK's MCAP, a folder with its bag, other bags through rosbags, JIGSAWS, or a table.

    bytes --read_recording--> Recording

The format is told by the content, never by a name. A file is read whole or refused whole.
"""

import codecs
from collections.abc import Callable
from typing import BinaryIO

from skills.errors import BadSettings, MixedFrames, UnknownFormat, UnreadableRecording
from skills.recordings import archive, extract, jigsaws, ros
from skills.recordings.bag import read_one, read_zip
from skills.recordings.mcap import MAGIC
from skills.recordings.table import DEFAULT_FRAME, read_table
from skills.recordings.writer import write_bag, write_mcap
from skills.style.recording import Recording

__all__ = ["MEDIA_TYPES", "media_type_of", "read_recording", "write_bag", "write_mcap"]

MCAP, ZIP, TABLE, TEXT = "application/vnd.mcap", "application/zip", "text/csv", "text/plain"
ROSBAG1, SQLITE = "application/x-rosbag", "application/vnd.sqlite3"
MEDIA_TYPES = {
    MCAP: "an MCAP file",
    ZIP: "a bag folder or a trial of JIGSAWS, zipped",
    TABLE: "a table",
    TEXT: "JIGSAWS kinematics",
    ROSBAG1: "a ROS 1 bag",
    SQLITE: "a .db3 bag",
}

_HEAD_BYTES = 65536
_MAGIC = ((MAGIC, MCAP), (archive.MAGIC, ZIP), (ros.ROS1_MAGIC, ROSBAG1), (ros.DB3_MAGIC, SQLITE))
_OTHERS = (
    (b"PK\x05\x06", "an empty zip archive"),
    (b"\x1f\x8b", "gzip; unpack it first"),
    (
        b"\x28\xb5\x2f\xfd",
        "zstd (a bag compressed as a file); unpack it with `zstd -d`, or send the bag folder as a zip",
    ),
    (b"\x89HDF", "HDF5; export a table"),
)
_READ = "MCAP, zipped bag folders, ROS 1 and .db3 bags, CSV and JIGSAWS kinematics are read."


def read_recording(file: BinaryIO, *, rate_hz: float | None = None, frame: str | None = None) -> Recording:
    """Read a recording of any known format.

    Args:
        file: Seekable, read from its beginning, left open.
        rate_hz: Samples per second, for a table without times.
        frame: The frame of a table's positions, by default "PSM_base". Any other recording names its own; one that has
            no motion in the given frame is refused.

    Raises:
        UnknownFormat: The content is of no format that is read here.
        BadRecording: It is of one and cannot be used; `skills.errors` names the kinds.
        BadSettings: `rate_hz` is not a rate, or was given for a recording with stamps of its own.
    """
    kind = media_type_of(file)
    if kind == TABLE and not _is_extract(file):
        return read_table(file, rate_hz=rate_hz, frame=DEFAULT_FRAME if frame is None else frame)
    if rate_hz is not None:
        raise BadSettings(f"This is {MEDIA_TYPES[kind]}, which has stamps or a rate of its own; leave rate_hz out.")
    return _in_frame(_READERS[kind](file), frame)


def media_type_of(file: BinaryIO) -> str:
    """Tell the format by the content; the file is left at its beginning.

    Raises:
        UnknownFormat: It is none that is read here.
        UnreadableRecording: The file is empty.
    """
    file.seek(0)
    head = file.read(_HEAD_BYTES)
    file.seek(0)
    if not head:
        raise UnreadableRecording("The file is empty; the transfer was cut or nothing was recorded.")
    for magic, kind in _MAGIC:
        if head.startswith(magic) or magic.startswith(head):
            return kind
    for magic, name in _OTHERS:
        if head.startswith(magic):
            raise UnknownFormat(f"This is {name}. {_READ}")
    return _kind_of_text(head)


def _kind_of_text(head: bytes) -> str:
    try:
        text = codecs.getincrementaldecoder("utf-8-sig")().decode(head)
    except UnicodeDecodeError:
        raise UnknownFormat(f"The content is neither a recording nor UTF-8 text. {_READ}") from None
    first_line = text.split("\n", 1)[0]
    if first_line.startswith(extract.FIRST):
        return TABLE
    if "\0" not in text and jigsaws.looks_like_kinematics(first_line):
        return TEXT
    if "\0" in text or text.lstrip()[:1] in ("<", "{", "[") or "," not in first_line:
        raise UnknownFormat(f"The content is neither a table with a header of comma-separated names nor other. {_READ}")
    return TABLE


def _is_extract(file: BinaryIO) -> bool:
    first = file.read(len(extract.FIRST))
    file.seek(0)
    return first == extract.FIRST.encode()


_READERS: dict[str, Callable[[BinaryIO], Recording]] = {
    MCAP: read_one,
    ZIP: read_zip,
    TABLE: extract.read_extract,
    TEXT: jigsaws.read_jigsaws,
    ROSBAG1: lambda file: ros.read_rosbag([file], ".bag"),
    SQLITE: lambda file: ros.read_rosbag([file], ".db3"),
}


def _in_frame(recording: Recording, frame: str | None) -> Recording:
    frames = sorted({motion.frame for motion in recording.motions})
    if frame is not None and frame not in frames:
        raise MixedFrames(f"No motion is in the frame {frame!r}; there is {', '.join(frames)}.", frames=frames)
    return recording
