"""Readers of recordings: MCAP, zipped bag folders, other bags (through rosbags), LeRobot episodes, JIGSAWS, tables.

    bytes --read_recording--> Recording

The format is detected from the content, never from a name. A file is either read completely or refused.
"""

import codecs
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import BinaryIO

from skills.demonstration.recording import Recording
from skills.errors import BadSettings, MixedFrames, UnknownFormat, UnreadableRecording
from skills.formats import archive, ee_csv, jigsaws, rosbag, tables
from skills.formats.bag_folder import read_one, read_zip
from skills.formats.bag_writer import write_bag, write_mcap
from skills.formats.cells import SEPARATORS, Decimals, header_of, open_text
from skills.formats.columns import BASE
from skills.formats.mcap import MAGIC
from skills.formats.tables import TableReading, read_table
from skills.remedies import Action, Remedy

__all__ = ["BYTES", "MEDIA_TYPES", "READABLE", "SUFFIXES", "media_type_of", "read_recording", "write_bag", "write_mcap"]

MCAP, ZIP, TABLE, TEXT = "application/vnd.mcap", "application/zip", "text/csv", "text/plain"
ROSBAG1, SQLITE = "application/x-rosbag", "application/vnd.sqlite3"
BYTES = "application/octet-stream"  # any of them: the format is detected from the content
MEDIA_TYPES = {
    MCAP: "an MCAP file",
    ZIP: "a bag folder, an episode of LeRobot or a trial of JIGSAWS, zipped",
    TABLE: "a table",
    TEXT: "JIGSAWS kinematics",
    ROSBAG1: "a ROS 1 bag",
    SQLITE: "a .db3 bag",
}
READABLE = "; ".join(MEDIA_TYPES.values())  # for messages and pages
SUFFIXES = {MCAP: ".mcap", ZIP: ".zip", TABLE: ".csv", TEXT: ".txt", ROSBAG1: ".bag", SQLITE: ".db3"}  # for dialogs

_HEAD_BYTES = 65536
_MAGIC = ((MAGIC, MCAP), (archive.MAGIC, ZIP), (rosbag.ROS1_MAGIC, ROSBAG1), (rosbag.DB3_MAGIC, SQLITE))
_PARQUET = b"PAR1"
_OTHERS = (
    (b"PK\x05\x06", "an empty zip archive"),
    (b"\x1f\x8b", "gzip; unpack it first"),
    (
        b"\x28\xb5\x2f\xfd",
        "zstd (a bag compressed as a file); unpack it with `zstd -d`, or send the bag folder as a zip",
    ),
    (b"\x89HDF", "HDF5; export a table"),
    (_PARQUET, "Parquet, a part of a LeRobot dataset; send an episode with its meta/info.json, as a zip"),
)
_READ = f"Send one of these: {READABLE}."


def read_recording(
    file: BinaryIO,
    *,
    rate_hz: float | None = None,
    frame: str | None = None,
    column: Sequence[str] = (),
    unit: Sequence[str] = (),
    decimal: Decimals = "point",
    table_arm: str | None = None,
    instrument: str | None = None,
    untimed: bool = False,
) -> Recording:
    """Read a recording of any supported format.

    Args:
        file: Seekable; read from its beginning and left open.
        rate_hz: Samples per second, for a table without times.
        frame: The frame of a table's positions, by default the base of its arm; an ee_csv and a LeRobot
            episode need it. Any other recording names its own frames; it is refused if none of its motions is in the
            given frame.
        column: The columns of a table, each as `x_mm=PosX` or `x=PosX`; see `skills.formats.tables`.
        unit: The units of columns without a unit, such as "mm".
        decimal: The decimal mark of a table.
        table_arm: The arm of a table, by default "PSM".
        instrument: The number of the instrument, with which a table's joints become poses.
        untimed: Count the samples of a table without times, instead of refusing it: for a preview.

    Returns:
        The recording, in millimetres.

    Raises:
        UnknownFormat: The content is of no supported format.
        BadRecording: It is of a supported format and cannot be used; `skills.errors` has the subclasses.
        BadSettings: An argument is impossible, or was given for a recording that says itself what it states.
    """
    kind = media_type_of(file)
    said = TableReading(rate_hz, frame, tuple(column), tuple(unit), decimal, table_arm, instrument, untimed)
    if kind == TABLE and not _is_extract(file):
        if not column and ee_csv.is_header(_names(file)):
            return ee_csv.read_ee_csv(file, said)
        return read_table(file, said)
    for field in fields(said):
        if field.name not in ("frame", "untimed") and getattr(said, field.name) != field.default:
            raise BadSettings(
                f"This is {MEDIA_TYPES[kind]}, which has its own stamps, columns and arms; omit {field.name}."
            )
    recording = read_zip(file, frame) if kind == ZIP else _READERS[kind](file)
    own_bases = recording.format == "lerobot" and frame == BASE  # of each arm: PSM1_base, PSM2_base
    return recording if own_bases else _in_frame(recording, frame)


def _names(file: BinaryIO) -> list[str]:
    """Return the names of a table's columns; the position is at the beginning afterwards."""
    with open_text(file) as text:
        names, _ = header_of(text)
    file.seek(0)
    return names


def media_type_of(file: BinaryIO) -> str:
    """Return the media type of a file, detected from its content; the position is at the beginning afterwards.

    Raises:
        UnknownFormat: It is of no supported format.
        UnreadableRecording: The file is empty.
    """
    file.seek(0)
    head = file.read(_HEAD_BYTES)
    file.seek(0)
    if not head:
        raise UnreadableRecording("The file is empty; the transfer was interrupted or nothing was recorded.")
    for magic, kind in _MAGIC:
        if head.startswith(magic) or magic.startswith(head):  # the latter: truncated, reported by its reader
            return kind
    for magic, name in _OTHERS:
        if head.startswith(magic):
            remedies = [Remedy(Action.CUT_EPISODE)] if magic == _PARQUET else []
            raise UnknownFormat(f"This is {name}. {_READ}", *remedies)
    return _kind_of_text(head)


def _kind_of_text(head: bytes) -> str:
    try:
        text = codecs.getincrementaldecoder("utf-8-sig")().decode(head)
    except UnicodeDecodeError:
        raise UnknownFormat(f"The content is neither a recording nor UTF-8 text. {_READ}") from None
    first_line = text.split("\n", 1)[0]
    if first_line.startswith(tables.FIRST):
        return TABLE
    if "\0" not in text and jigsaws.looks_like_kinematics(first_line):
        return TEXT
    # Markup, JSON and binary data are refused here: the table reader would only complain about columns.
    if "\0" in text or text.lstrip()[:1] in ("<", "{", "[") or not any(one in first_line for one in SEPARATORS):
        raise UnknownFormat(
            "The content is neither a table with a header of names, separated by commas, semicolons or tabs, nor "
            f"another known format. {_READ}"
        )
    return TABLE


def _is_extract(file: BinaryIO) -> bool:
    first = file.read(len(tables.FIRST))
    file.seek(0)
    return first == tables.FIRST.encode()


_READERS: dict[str, Callable[[BinaryIO], Recording]] = {
    MCAP: read_one,
    TABLE: tables.read_extract,
    TEXT: jigsaws.read_jigsaws,
    ROSBAG1: lambda file: rosbag.read_rosbag([file], ".bag"),
    SQLITE: lambda file: rosbag.read_rosbag([file], ".db3"),
}


def _in_frame(recording: Recording, frame: str | None) -> Recording:
    frames = sorted({motion.frame for motion in recording.motions})
    if frame is not None and frame not in frames:
        raise MixedFrames(f"No motion is in the frame {frame!r}; the frames are {', '.join(frames)}.", frames=frames)
    return recording
