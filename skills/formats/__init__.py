"""Readers of recordings: MCAP, zipped bag folders, other bags (through rosbags), LeRobot episodes, JIGSAWS, tables.

    bytes --read_recording--> Recording

The format is detected from the content, never from a name. A file is either read completely or refused.
"""

import codecs
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import BinaryIO

from skills.demonstration.recording import Recording
from skills.errors import BadSettings, MixedFrames, UnknownFormat, UnreadableRecording
from skills.formats import archive
from skills.formats.archive import check_pointer
from skills.formats.bag_folder import read_one, read_zip
from skills.formats.bag_writer import write_bag, write_mcap
from skills.formats.cells import Decimals, has_separator, header_of, open_text
from skills.formats.columns import BASE
from skills.formats.dialects import UTF16, plain_table
from skills.formats.ee_csv import is_header, read_ee_csv
from skills.formats.extract import is_extract, read_extract
from skills.formats.jigsaws import looks_like_kinematics, read_jigsaws
from skills.formats.mcap import MAGIC
from skills.formats.pace import check_pace
from skills.formats.rosbag import DB3_MAGIC, ROS1_MAGIC, read_rosbag
from skills.formats.tables import ReadingOptions, read_table
from skills.remedies import Action, Remedy

__all__ = ["BYTES", "MEDIA_TYPES", "READABLE", "SUFFIXES", "media_type_of", "read_recording", "write_bag", "write_mcap"]

MCAP, ZIP, TABLE, TEXT = "application/vnd.mcap", "application/zip", "text/csv", "text/plain"
ROSBAG1, SQLITE = "application/x-rosbag", "application/vnd.sqlite3"
BYTES = "application/octet-stream"  # any of them: the format is detected from the content

_HEAD_BYTES = 65536
_PARQUET = b"PAR1"
_OTHERS = (
    (b"PK\x05\x06", "an empty zip archive"),
    (b"\x1f\x8b", "gzip; unpack it first"),
    (
        b"\x28\xb5\x2f\xfd",
        "zstd (a bag compressed as a file); unpack it with `zstd -d`, or send the bag folder as a zip",
    ),
    (b"\x89HDF", "HDF5; export a table"),
    (b"\x93NUMPY", "an array of NumPy; write a table, with numpy.savetxt and a header of names"),
    (b"Format Version,", "an export of OptiTrack's Motive; delete the lines above Frame, and name each column"),
    (_PARQUET, "Parquet, a part of a LeRobot dataset; send an episode with its meta/info.json, as a zip"),
)


@dataclass(frozen=True)
class FileFormat:
    """A kind of file that can be a recording.

    Attributes:
        media_type: Its media type.
        suffix: The suffix of its files, for dialogs.
        name: Its name with an article, for messages and pages.
        read: Its reader, of a file at its beginning.
        magic: Its first bytes; empty for text.
        is_text: Whether text with this first line may be of the format.
        is_stated: Whether the caller may state more about it than a frame: it has none of it itself.
    """

    media_type: str
    suffix: str
    name: str
    read: Callable[[BinaryIO, ReadingOptions], Recording]
    magic: bytes = b""
    is_text: Callable[[str], bool] = lambda _: False
    is_stated: bool = False

    def begins(self, head: bytes) -> bool:
        """Return whether a file with this head has the format's first bytes, or was cut within them."""
        return bool(self.magic) and (head.startswith(self.magic) or self.magic.startswith(head))


def _read_columns(file: BinaryIO, options: ReadingOptions) -> Recording:
    """Read a table with a header of names: an ee_csv, unless the caller maps its columns, or of one arm."""
    with plain_table(file) as plain:
        with open_text(plain) as text:
            names, _ = header_of(text)
        plain.seek(0)
        read = read_ee_csv if not options.column and is_header(names) else read_table
        return read(plain, options)


# A new format is one more entry here; the first that fits is taken.
FORMATS = (
    FileFormat(MCAP, ".mcap", "an MCAP file", lambda file, _: read_one(file), MAGIC),
    FileFormat(
        ZIP,
        ".zip",
        "a bag folder, an episode of LeRobot or a trial of JIGSAWS, zipped",
        lambda file, options: read_zip(file, options.frame),
        archive.MAGIC,
    ),
    FileFormat(TABLE, ".csv", "a table", lambda file, _: read_extract(file), is_text=is_extract),
    FileFormat(TEXT, ".txt", "JIGSAWS kinematics", lambda file, _: read_jigsaws(file), is_text=looks_like_kinematics),
    FileFormat(ROSBAG1, ".bag", "a ROS 1 bag", lambda file, _: read_rosbag([file], ".bag"), ROS1_MAGIC),
    FileFormat(SQLITE, ".db3", "a .db3 bag", lambda file, _: read_rosbag([file], ".db3"), DB3_MAGIC),
    FileFormat(TABLE, ".csv", "a table", _read_columns, is_text=has_separator, is_stated=True),
)
MEDIA_TYPES = {one.media_type: one.name for one in FORMATS}
SUFFIXES = {one.media_type: one.suffix for one in FORMATS}
READABLE = "; ".join(MEDIA_TYPES.values())  # for messages and pages
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
    options = ReadingOptions(rate_hz, frame, tuple(column), tuple(unit), decimal, table_arm, instrument, untimed)
    found = format_of(file)
    for field in fields(options) if not found.is_stated else ():
        if field.name not in ("frame", "untimed") and getattr(options, field.name) != field.default:
            raise BadSettings(f"This is {found.name}, which has its own stamps, columns and arms; omit {field.name}.")
    recording = found.read(file, options)
    check_pace(recording, options)
    own_bases = recording.format == "lerobot" and frame == BASE  # of each arm: PSM1_base, PSM2_base
    return recording if found.is_stated or own_bases else _in_frame(recording, frame)


def media_type_of(file: BinaryIO) -> str:
    """Return the media type of a file; errors are those of `format_of`."""
    return format_of(file).media_type


def format_of(file: BinaryIO) -> FileFormat:
    """Return the format of a file, detected from its content; the position is at the beginning afterwards.

    Raises:
        UnknownFormat: It is of no supported format.
        UnreadableRecording: The file is empty.
    """
    file.seek(0)
    head = file.read(_HEAD_BYTES)
    file.seek(0)
    if not head:
        raise UnreadableRecording("The file is empty; the transfer was interrupted or nothing was recorded.")
    binary = next((one for one in FORMATS if one.begins(head)), None)
    return binary or _format_of_text(head)


def _format_of_text(head: bytes) -> FileFormat:
    """Return the format of a file with this head that has the first bytes of none.

    Raises:
        UnknownFormat: It is no text of a known format.
        UnreadableRecording: It is a pointer of Git LFS.
    """
    for magic, name in _OTHERS:
        if head.startswith(magic):
            remedies = [Remedy(Action.CUT_EPISODE)] if magic == _PARQUET else []
            raise UnknownFormat(f"This is {name}. {_READ}", *remedies)
    check_pointer(head)
    try:
        text = codecs.getincrementaldecoder("utf-16" if head.startswith(UTF16) else "utf-8-sig")().decode(head)
    except UnicodeDecodeError:
        if b"\0" not in head and has_separator(head.split(b"\n", 1)[0].decode("latin-1")):
            raise UnknownFormat(
                "The table is text, and not in UTF-8: spreadsheets write Windows-1252 as well. Save it as UTF-8, or "
                "convert it (iconv -f WINDOWS-1252 -t UTF-8 TABLE.csv > UTF8.csv)."
            ) from None
        raise UnknownFormat(f"The content is neither a recording nor UTF-8 text. {_READ}") from None
    # Markup, JSON and binary data are refused here: the table reader would only complain about columns.
    is_plain = "\0" not in text and text.lstrip()[:1] not in ("<", "{", "[")
    first_line = text.split("\n", 1)[0]
    found = next((one for one in FORMATS if one.is_text(first_line)), None) if is_plain else None
    if found is None:
        raise UnknownFormat(
            "The content is neither a table with a header of names, separated by commas, semicolons or tabs, nor "
            f"another known format. {_READ}"
        )
    return found


def _in_frame(recording: Recording, frame: str | None) -> Recording:
    """Return a recording unless the caller names a frame in which none of its motions is."""
    frames = sorted({motion.frame for motion in recording.motions})
    if frame is not None and frame not in frames:
        raise MixedFrames(f"No motion is in the frame {frame!r}; the frames are {', '.join(frames)}.", frames=frames)
    return recording
