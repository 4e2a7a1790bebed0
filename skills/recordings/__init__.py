"""Read what surgeons recorded: a dVRK's MCAP, or a table.

    bytes --read_recording--> Recording

The format is told by the content, never by a name. A file is read whole or refused whole.
"""

import codecs
from typing import BinaryIO

from skills.errors import BadSettings, MixedFrames, UnknownFormat, UnreadableRecording
from skills.recordings.mcap import MAGIC, read_mcap
from skills.recordings.table import DEFAULT_FRAME, read_table
from skills.recordings.writer import write_mcap
from skills.style.recording import Recording

__all__ = ["read_recording", "write_mcap"]

_HEAD_BYTES = 65536
_OTHERS = (
    (b"PK\x03\x04", "a zip archive; send the .mcap file inside it"),
    (b"\x1f\x8b", "gzip; unpack it first"),
    (b"\x28\xb5\x2f\xfd", "zstd (a bag compressed as a file); unpack it with `zstd -d` first"),
    (b"SQLite format 3", "SQLite (a .db3 bag); convert it with `ros2 bag convert` to MCAP"),
    (b"#ROSBAG", "a ROS 1 bag; convert it with `rosbags-convert` to MCAP"),
    (b"\x89HDF", "HDF5; export a table"),
)


def read_recording(file: BinaryIO, *, rate_hz: float | None = None, frame: str | None = None) -> Recording:
    """Read a recording of any known format.

    Args:
        file: Seekable, read from its beginning, left open.
        rate_hz: Samples per second, for a table without times.
        frame: The frame of a table's positions, by default "PSM_base". An MCAP file names its own; one that has no
            motion in the given frame is refused.

    Raises:
        UnknownFormat: The content is neither MCAP nor a table.
        BadRecording: It is one of them and cannot be used; `skills.errors` names the kinds.
        BadSettings: `rate_hz` is not a rate, or was given for a recording with stamps of its own.
    """
    file.seek(0)
    head = file.read(_HEAD_BYTES)
    file.seek(0)
    if not head:
        raise UnreadableRecording("The file is empty; the transfer was cut or nothing was recorded.")
    if head.startswith(MAGIC) or MAGIC.startswith(head):
        return _checked_mcap(read_mcap(file), rate_hz, frame)
    _check_text(head)
    return read_table(file, rate_hz=rate_hz, frame=DEFAULT_FRAME if frame is None else frame)


def _checked_mcap(recording: Recording, rate_hz: float | None, frame: str | None) -> Recording:
    if rate_hz is not None:
        raise BadSettings("An MCAP recording has stamps of its own; leave rate_hz out.", rate_hz=rate_hz)
    frames = sorted({motion.frame for motion in recording.motions})
    if frame is not None and frame not in frames:
        raise MixedFrames(f"No motion is in the frame {frame!r}; there is {', '.join(frames)}.", frames=frames)
    return recording


def _check_text(head: bytes) -> None:
    """Refuse what cannot be a table: other formats by their first bytes, and text without a comma in its first line."""
    for magic, name in _OTHERS:
        if head.startswith(magic):
            raise UnknownFormat(f"This is {name}. MCAP and CSV are read.")
    try:
        text = codecs.getincrementaldecoder("utf-8-sig")().decode(head)
    except UnicodeDecodeError:
        raise UnknownFormat("The content is neither MCAP nor UTF-8 text. MCAP and CSV are read.") from None
    first_line = text.split("\n", 1)[0]
    if "\0" in text or text.lstrip()[:1] in ("<", "{", "[") or "," not in first_line:
        raise UnknownFormat("The content is neither MCAP nor a table with a header of comma-separated column names.")
