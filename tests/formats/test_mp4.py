"""The header of an MP4 file: what ffmpeg writes is read, what hides pictures is refused, and a hostile one ends."""

import io
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import UnreadableRecording
from skills.formats import mp4
from skills.formats.mp4 import Mp4, read_mp4
from tests.formats.videos import again, box, edit, encoded, header

SOUND = ("-f", "lavfi", "-i", "anullsrc=r=8000:cl=mono", "-shortest", "-c:v", "copy", "-c:a", "aac")


def read(data: bytes) -> Mp4:
    return read_mp4(io.BytesIO(data), "x.mp4")


@pytest.mark.parametrize(
    ("how", "codec"),
    [
        ((), "h264"),
        (("-c:v", "libx264", "-bf", "0"), "h264"),
        (("-c:v", "libx264", "-bf", "3", "-g", "5", "-video_track_timescale", "90000"), "h264"),
        (("-c:v", "mpeg4"), "mpeg4"),
        (("-c:v", "libx265", "-x265-params", "log-level=none"), "hevc"),
    ],
)
def test_the_frames_of_encoders_have_their_times(how, codec):
    found = read(encoded(0, 40, *how))
    assert (found.codec, found.width, found.height, found.frames) == (codec, 64, 48, 40)
    np.testing.assert_allclose(found.times_s, np.arange(40) / 30, atol=1e-9)


def test_a_header_by_hand_is_read():
    found = read(header())
    assert found.format == ("h264", 64, 48)
    np.testing.assert_allclose(found.times_s, [0.0, 0.04, 0.08, 0.12, 0.16])


def test_shifted_frames_are_ordered_by_the_time_at_which_they_are_shown():
    """Decoded at 0, 4, 8, 12, 16 and shown at 8, 20, 12, 16, 24, of which the edit list begins at 8."""
    ctts = box(b"ctts", bytes(4), struct.pack(">I8I", 4, 1, 8, 1, 16, 2, 4, 1, 8))
    found = read(header({"ctts": ctts, "edts": edit(200, 8)}))
    np.testing.assert_allclose(found.times_s, [0.0, 0.04, 0.08, 0.12, 0.16])


FAULTS = {
    "two tracks": (header(tracks=2), "2 tracks"),
    "only sound": (header({"hdlr": box(b"hdlr", bytes(8), b"soun", bytes(12))}), "1 tracks, where one of pictures"),
    "an edit that hides the first frame": (header({"edts": edit(160, 4)}), "edit list"),
    "an edit that hides the last frame": (header({"edts": edit(160, 0)}), "edit list"),
    "a delay": (header({"edts": edit(200, -1)}), "edit list"),
    "two edits": (header({"edts": edit(200, 0, count=2)}), "edit list"),
    "slow motion": (header({"edts": edit(200, 0, rate=1 << 15)}), "edit list"),
    "endless frames": (header({"stts": box(b"stts", bytes(4), struct.pack(">III", 1, 2**32 - 1, 4))}), "more than"),
    "more runs than there are": (header({"stts": box(b"stts", bytes(4), struct.pack(">III", 9, 5, 4))}), "length"),
    "no frames": (header({"stts": box(b"stts", bytes(4), struct.pack(">I", 0))}), "no frames"),
    "another number of sizes": (header({"stsz": box(b"stsz", bytes(4), struct.pack(">II", 100, 6))}), "6 frames"),
    "two codecs": (header({"stsd": box(b"stsd", bytes(4), struct.pack(">I", 2))}), "codec changes"),
    "an unknown codec": (
        header({"stsd": box(b"stsd", bytes(4), struct.pack(">I", 1), box(b"text", bytes(28)))}),
        "codec is none of",
    ),
    "no size": (header({"stsd": box(b"stsd", bytes(4), struct.pack(">I", 1), box(b"avc1", bytes(28)))}), "0 x 0"),
    "no table of sizes": (header({"stsz": b""}), "0 parts stsz"),
    "a part longer than its whole": (header({"stsz": struct.pack(">I4s", 2**31, b"stsz")}), "longer than"),
    "a part without an end": (header({"stsz": struct.pack(">I4s", 0, b"stsz")}), "longer than"),
    "fragments": (header() + box(b"moof"), "fragments"),
    "two headers": (header() + header(), "two headers"),
    "no header": (box(b"mdat", bytes(100)), "no header"),
    "nothing": (b"", "no header"),
    "a box of 2^62 bytes": (struct.pack(">I4sQ", 1, b"moov", 2**62), "cut, or no MP4"),
    "text": (b"the quick brown fox jumps over it", "cut, or no MP4"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_file_that_is_not_plain_pictures_is_refused(name):
    data, fault = FAULTS[name]
    with pytest.raises(UnreadableRecording, match=fault):
        read(data)


def test_a_video_with_sound_is_refused_and_without_it_read():
    sounding = again(encoded(0, 40), *SOUND)
    with pytest.raises(UnreadableRecording, match="without sound"):
        read(sounding)
    assert read(again(sounding, "-map", "0:v:0", "-c", "copy")).frames == 40


def test_a_large_header_is_not_read(monkeypatch):
    monkeypatch.setattr(mp4, "HEADER_BYTES", 100)
    with pytest.raises(UnreadableRecording, match="above 100 bytes"):
        read(header())


def test_a_cut_file_is_refused_wherever_it_was_cut():
    for data in (header(), encoded(0, 40)):
        for end in range(0, len(data), 1 if len(data) < 2000 else 37):
            with pytest.raises(UnreadableRecording):
                read(data[:end])


@given(st.lists(st.tuples(st.floats(0, 0.999), st.integers(0, 255)), min_size=1, max_size=8))
def test_a_damaged_header_is_read_or_refused(changes):
    data = bytearray(header({"edts": edit(200, 0)}))
    for where, value in changes:
        data[int(where * (len(data) - 500))] = value
    try:
        found = read(bytes(data))
    except UnreadableRecording:
        return
    assert 0 < found.frames <= mp4.FRAMES
    assert np.isfinite(found.times_s).all()
