"""Malicious zip archives: each is refused with a message, quickly, and in little memory."""

import io
import struct
import time
import tracemalloc
import zipfile

import pytest

from skills.errors import SkillsError, UnknownFormat, UnreadableRecording
from skills.formats import read_recording, write_mcap
from skills.formats.archive import Archive, pack
from tests.formats import trials
from tests.formats.bags import assert_same, recording
from tests.formats.others import damaged, zipped

MCAP = write_mcap(recording())


def read(data):
    return read_recording(io.BytesIO(data))


def claiming(name: str, size: int, data: bytes) -> bytes:
    """Return an archive in which a deflated member states another size, in both of its headers."""
    archive = bytearray(zipped({name: data}))
    struct.pack_into("<L", archive, 22, size)
    struct.pack_into("<L", archive, archive.index(b"PK\x01\x02") + 24, size)
    return bytes(archive)


def encrypted() -> bytes:
    archive = bytearray(zipped({"bag.mcap": MCAP}))
    archive[6] |= 1
    archive[archive.index(b"PK\x01\x02") + 8] |= 1
    return bytes(archive)


def twice() -> bytes:
    archive = zipped({"bag.mcap": MCAP, "bag.mcaq": MCAP}, zipfile.ZIP_STORED)
    return archive.replace(b"bag.mcaq", b"bag.mcap")


def zeros() -> bytes:
    return zipped({"bag.mcap": bytes(64 << 20)})


HOSTILE = {
    "64 MiB of zeros in 64 kB": zeros,
    "a claim of 4 GiB": lambda: claiming("bag.mcap", 0xFFFFFFF0, MCAP),
    "a claim of less than there is": lambda: claiming("bag.mcap", 1000, MCAP),
    "a claim of more than there is": lambda: claiming("bag.mcap", len(MCAP) + 1, MCAP),
    "an archive in the archive": lambda: zipped({"bag.mcap": MCAP, "more.zip": zeros()}),
    "a password": encrypted,
    "two members of one name": twice,
    "another compression": lambda: zipped({"bag.mcap": MCAP}, zipfile.ZIP_LZMA),
    "3000 members": lambda: zipped({f"{k}.txt": b"" for k in range(3000)} | {"bag.mcap": MCAP}, zipfile.ZIP_STORED),
    "a comment": lambda: zipped({"bag.mcap": MCAP})[:-2] + b"\x05\x00hello",
    "bytes after its end": lambda: zipped({"bag.mcap": MCAP}) + b"PK",
    "a list of members that is not there": lambda: b"PK\x03\x04" + bytes(1000) + zipped({"bag.mcap": MCAP})[-40:],
    "two bags": lambda: zipped({"one/a.mcap": MCAP, "two/a.mcap": MCAP}),
    "two formats": lambda: zipped({"bag/a.mcap": MCAP, "bag/a.bag": b"#ROSBAG V2.0\n"}),
    "an MCAP that is none": lambda: zipped({"bag.mcap": b"hello"}),
    "metadata that are none": lambda: zipped({"bag.mcap": MCAP, "metadata.yaml": b"[" * 100_000}),
    "metadata with a billion laughs": lambda: zipped(
        {"bag.mcap": MCAP, "metadata.yaml": b"a: &a [0, 0]\nb: &b [*a, *a]\nc: [*b, *b]\n"}
    ),
    "metadata of a megabyte": lambda: zipped({"bag.mcap": MCAP, "metadata.yaml": b"a: 1\n" * 250_000}),
    "tags that are none": lambda: zipped({"bag.mcap": MCAP, "tags.json": b"[" * 100_000}),
    "a bag packed as a whole that is none": lambda: zipped({"bag.mcap.zstd": MCAP}),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_it_is_refused_in_words_soon_and_in_little_memory(name):
    archive = HOSTILE[name]()
    tracemalloc.start()
    began = time.process_time()
    with pytest.raises(UnreadableRecording) as refused:
        read(archive)
    took, (_, peak) = time.process_time() - began, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert took < 5.0
    assert peak < 64 << 20
    assert len(str(refused.value)) < 500


def test_an_archive_without_a_recording_is_of_an_unknown_format():
    for data in (zipped({"video.mp4": b"", "notes.md": b""}), zipped({})):
        with pytest.raises(UnknownFormat):
            read(data)


def test_a_damaged_archive_is_refused_or_says_the_same():
    data, refused = zipped({"s/bag.mcap": MCAP}), 0
    for what, bad in damaged(data, 300, seed=5):
        try:
            assert_same(read(bad), recording(), tolerance_mm=1e-12)
        except SkillsError:
            refused += 1
        else:
            assert what.startswith("bit")
    assert refused > 250


def test_a_member_that_lost_its_name_in_one_place_is_refused():
    data = zipped({"a.txt": trials.text(trials.kinematics(3)), "transcriptions/a.txt": b"1 2 G1\n"})
    assert read(data).labels
    with pytest.raises(UnreadableRecording, match="truncated or corrupt"):
        read(b"transcriptions/a.tyt".join(data.rsplit(b"transcriptions/a.txt", 1)))


def test_a_name_that_leads_out_of_the_folder_leads_nowhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_same(read(zipped({"../../bag.mcap": MCAP, "/etc/passwd": b"x"})), recording(), tolerance_mm=1e-12)
    assert list(tmp_path.iterdir()) == []


def test_what_a_mac_adds_is_no_second_bag():
    data = zipped({"s/bag.mcap": MCAP, "__MACOSX/s/._bag.mcap": b"\x00\x05\x16\x07", ".DS_Store": b"\x00"})
    assert_same(read(data), recording(), tolerance_mm=1e-12)


def test_the_same_members_make_the_same_bytes():
    one, other = io.BytesIO(), io.BytesIO()
    for out in (one, other):
        pack({"a": io.BytesIO(b"1"), "b": io.BytesIO(b"2")}, out)
    assert one.getvalue() == other.getvalue()
    assert Archive(one).text("b") == "2"
