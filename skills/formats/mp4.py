"""The header of an MP4 file (ISO/IEC 14496-12): its codec, its picture's size, and the time of every frame.

Boxes have a length, a type of four letters, and contents, of some other boxes:

    moov                        the header; the frames themselves are in `mdat`, and are not read
      mvhd                      the time scale of the edit list
      trak                      one, of pictures: sound, subtitles or timed notes beside them are refused
        edts/elst               the edit list: which part is shown, from its beginning
        mdia/mdhd               the time scale of the frames
        mdia/hdlr               the kind of the track
        mdia/minf/stbl
          stsd                  the codec, width and height
          stts, ctts            the durations of the frames in decoding order, and the shifts to their times
          stsz                  the number of frames, again, and their lengths in `mdat`

The file is not trusted: each length is checked against the box around it, each number of entries against the length of
its table, and the frames are limited before they are expanded.
"""

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from skills.arrays import Floats, Ints
from skills.errors import UnreadableRecording

CODECS = {
    **{b"avc1": "h264", b"avc3": "h264", b"hvc1": "hevc", b"hev1": "hevc"},
    **{b"av01": "av1", b"vp09": "vp9", b"mp4v": "mpeg4"},
}
HEADER_BYTES = 64 << 20  # of moov: a million frames have 20 MB
FRAMES = 2_000_000  # 18 hours at 30 Hz
BOXES = 10_000  # at the top of a file, or in one box
SIDE = 16_384  # the greatest width or height

_COPY = "Copy it again, or write it again without encoding, as by `ffmpeg -i IN -map 0:v:0 -c copy OUT.mp4`."


@dataclass(frozen=True, eq=False)
class Mp4:
    """The pictures of a file.

    Attributes:
        codec: As LeRobot names it, such as "av1".
        width: In pixels.
        height: In pixels.
        times_s: The time of each frame, in the order in which they are shown, shape (T,).
    """

    codec: str
    width: int
    height: int
    times_s: Floats

    @property
    def frames(self) -> int:
        """The number of frames T."""
        return len(self.times_s)

    @property
    def format(self) -> tuple[str, int, int]:
        """Codec, width and height."""
        return self.codec, self.width, self.height


class _NotMp4(Exception):
    """The fault of a file, in words."""


def read_mp4(file: BinaryIO, name: str) -> Mp4:
    """Read the header of an MP4 file.

    Args:
        file: The file, seekable.
        name: What it is called in a message.

    Raises:
        UnreadableRecording: It is no MP4 file, damaged or cut; or it has another track than its one of pictures, an
            unknown codec, fragments, or an edit list that hides frames.
    """
    try:
        return _pictures(*_header(file))
    except (_NotMp4, struct.error) as error:
        fault = str(error) if isinstance(error, _NotMp4) else "a part of its header is too short"
        raise UnreadableRecording(f"The video {name} is not usable: {fault}. {_COPY}") from error


def _header(file: BinaryIO) -> tuple[memoryview, int]:
    """Return the contents of `moov` and the length of all `mdat`, if every box at the top lies in the file."""
    size, at, found, media = file.seek(0, os.SEEK_END), 0, None, 0
    for _ in range(BOXES):
        if at == size:
            break
        file.seek(at)
        head = file.read(16)
        length, kind = struct.unpack(">I4s", head[:8])
        start = 8
        if length == 1:
            (length,), start = struct.unpack(">Q", head[8:]), 16
        length = length or size - at
        if not start <= length <= size - at:
            raise _NotMp4("it is cut, or no MP4 file")
        if kind == b"moof":
            raise _NotMp4("it is written in fragments")
        if kind == b"moov":
            if found is not None or length > HEADER_BYTES:
                raise _NotMp4(f"it has two headers, or one above {HEADER_BYTES} bytes")
            file.seek(at + start)
            found = memoryview(file.read(length - start))
        media += length - start if kind == b"mdat" else 0
        at += length
    if at != size or found is None:
        raise _NotMp4("it has no header, or too many parts")
    return found, media


def _boxes(data: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Yield the type and the contents of each box in another one."""
    at, count = 0, 0
    while at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        count += 1
        if not 8 <= length <= len(data) - at or count > BOXES:
            raise _NotMp4("a part of its header is longer than what contains it")
        yield kind, data[at + 8 : at + length]
        at += length


def _all(data: memoryview, kind: bytes) -> list[memoryview]:
    """Return the contents of all boxes of a type in another one."""
    return [content for found, content in _boxes(data) if found == kind]


def _one(data: memoryview, *path: bytes) -> memoryview:
    """Return the contents of the only box of each type along a path."""
    for kind in path:
        found = _all(data, kind)
        if len(found) != 1:
            raise _NotMp4(f"its header has {len(found)} parts {kind.decode()} where one belongs")
        data = found[0]
    return data


def _pictures(moov: memoryview, media_bytes: int) -> Mp4:
    """Return the pictures of a file from its header."""
    if _all(moov, b"mvex"):
        raise _NotMp4("it is written in fragments")
    tracks = _all(moov, b"trak")
    kinds = [bytes(_one(track, b"mdia", b"hdlr")[8:12]) for track in tracks]
    if kinds != [b"vide"]:
        raise _NotMp4(f"it has {len(kinds)} tracks, where one of pictures belongs, without sound or notes beside it")
    track = tracks[0]
    table = _one(track, b"mdia", b"minf", b"stbl")
    codec, width, height = _format(_one(table, b"stsd"))
    times, scale = _times(table), _scale(_one(track, b"mdia", b"mdhd"))
    _check_sizes(_one(table, b"stsz"), len(times), media_bytes)
    first = _first_shown(moov, track, times, scale)
    return Mp4(codec, width, height, (times - first) / scale)


def _check_sizes(stsz: memoryview, frames: int, media_bytes: int) -> None:
    """Compare the number of frames and their lengths with the times and with the file."""
    each, count = struct.unpack_from(">II", stsz, 4)
    if count != frames:
        raise _NotMp4(f"it has {count} frames, and times of {frames}")
    if len(stsz) != 12 + (0 if each else 4 * count):
        raise _NotMp4("a table of its frames is of another length than it says")
    if (each * count if each else int(np.frombuffer(stsz[12:], ">u4").sum(dtype=np.int64))) > media_bytes:
        raise _NotMp4("it is cut: its frames are longer than the file")


def _format(stsd: memoryview) -> tuple[str, int, int]:
    """Return the codec, the width and the height."""
    (count,) = struct.unpack_from(">I", stsd, 4)
    entries = list(_boxes(stsd[8:]))
    if count != 1 or len(entries) != 1:
        raise _NotMp4("its codec changes")
    kind, entry = entries[0]
    width, height = struct.unpack_from(">HH", entry, 24)
    if kind not in CODECS:
        known = ", ".join(sorted(set(CODECS.values())))
        raise _NotMp4(f"its codec is none of {known}")
    if not (0 < width <= SIDE and 0 < height <= SIDE):
        raise _NotMp4(f"its pictures have {width} x {height} pixels")
    return CODECS[kind], width, height


def _scale(head: memoryview) -> int:
    """Return the units per second of `mvhd` or `mdhd`, after two moments of 4 bytes each, in version 1 of 8."""
    (scale,) = struct.unpack_from(">I", head, 20 if bytes(head[:1]) == b"\1" else 12)
    if not scale:
        raise _NotMp4("its time scale is 0")
    return int(scale)


def _runs(table: memoryview, second: str) -> tuple[Ints, Ints]:
    """Return the runs of a table of frames: the number of frames in each, and what they share."""
    (count,) = struct.unpack_from(">I", table, 4)
    if len(table) != 8 + 8 * count:
        raise _NotMp4("a table of its frames is of another length than it says")
    runs = np.frombuffer(table[8:], np.dtype([("frames", ">u4"), ("value", second)]))
    if runs["frames"].sum(dtype=np.int64) > FRAMES:
        raise _NotMp4(f"it has more than {FRAMES} frames")
    return runs["frames"].astype(np.int64), runs["value"].astype(np.int64)


def _times(table: memoryview) -> Ints:
    """Return the times of the frames in units of the track, sorted, shape (T,)."""
    frames, durations = _runs(_one(table, b"stts"), ">u4")
    each = np.repeat(durations, frames)
    if not len(each):
        raise _NotMp4("it has no frames")
    times = np.cumsum(each) - each
    if _all(table, b"ctts"):
        frames, shifts = _runs(_one(table, b"ctts"), ">i4")  # of version 0 without sign, but never that large
        if frames.sum() != len(times):
            raise _NotMp4("it has another number of frames than of their times")
        times = np.sort(times + np.repeat(shifts, frames))
    return times


def _first_shown(moov: memoryview, track: memoryview, times: Ints, scale: int) -> int:
    """Return the time that is shown at 0 s, after a check that the edit list leaves out no frame."""
    edits = [_one(edit, b"elst") for edit in _all(track, b"edts")]
    if not edits:
        return 0
    version = bytes(edits[0][:1])
    (count,) = struct.unpack_from(">I", edits[0], 4)
    if count == 0:
        return 0
    length, first, rate = struct.unpack_from(">QqI" if version == b"\1" else ">IiI", edits[0], 8)
    shown_s = length / _scale(_one(moov, b"mvhd"))
    whole = not length or shown_s > (times[-1] - first) / scale
    if len(edits) != 1 or count != 1 or rate != 1 << 16 or first < 0 or first > times[0] or not whole:
        raise _NotMp4("its edit list repeats, delays or leaves out frames")
    return int(first)
