"""Datasets unpacked from a zip: only what an export writes, verified, and into nothing but a new folder."""

import io
import zipfile
from pathlib import Path

import pytest

from skills.errors import BadInput, Corrupt, UnreadableRecording
from skills.formats.checksums import SUMS
from skills.formats.lerobot.manifest import check_dataset, unpack_dataset
from skills.formats.lerobot.writer import dataset_files
from tests.formats.test_lerobot_writer import ABOUT, episodes


def files() -> dict[str, bytes]:
    return {name: file.read() for name, file in dataset_files(episodes(), ABOUT)}


def zip_of(content: dict[str, bytes], **how: int) -> io.BytesIO:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", **how) as archive:
        for name, data in content.items():
            archive.writestr(zipfile.ZipInfo(name), data, archive.compression)
    return out


def test_a_dataset_is_unpacked_as_it_was_written(tmp_path: Path):
    names = unpack_dataset(zip_of(files()), tmp_path / "dataset")
    assert names == sorted(files()) == check_dataset(zip_of(files()))
    for name, data in files().items():
        assert (tmp_path / "dataset" / name).read_bytes() == data
    assert [one.name for one in tmp_path.iterdir()] == ["dataset"]


def test_nothing_is_overwritten(tmp_path: Path):
    (tmp_path / "dataset").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for name in ("dataset", "link"):
        with pytest.raises(BadInput, match="exists already"):
            unpack_dataset(zip_of(files()), tmp_path / name)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["dataset", "link"]


def with_line(name: str) -> dict[str, bytes]:
    """Return a dataset with another file, which its manifest names."""
    content = files() | {name: b""}
    empty = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    return content | {SUMS: content[SUMS] + f"{empty}  {name}\n".encode()}


@pytest.mark.parametrize("name", ["../out", "/out", "data/../../out", "a\\b", "C:/x", "..", "data/.", "a//b", "é"])
def test_a_name_that_leaves_the_folder_is_refused(tmp_path: Path, name: str):
    with pytest.raises((Corrupt, UnreadableRecording)):
        unpack_dataset(zip_of(with_line(name)), tmp_path / "dataset")
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_changed_missing_or_added_is_refused(tmp_path: Path):
    changed = files() | {"meta/info.json": b"{}"}
    missing = {name: data for name, data in files().items() if name != "meta/info.json"}
    unnamed = {name: data for name, data in files().items() if name != SUMS}
    for content in (changed, missing, unnamed, files() | {"more": b""}, {}):
        with pytest.raises(Corrupt):
            unpack_dataset(zip_of(content), tmp_path / "dataset")
        with pytest.raises(Corrupt):
            check_dataset(zip_of(content))
    assert list(tmp_path.iterdir()) == []


def test_a_zip_that_is_compressed_cut_or_none_is_refused(tmp_path: Path):
    data = zip_of(files()).getvalue()
    with pytest.raises(Corrupt, match="no export writes"):
        unpack_dataset(zip_of(files(), compression=zipfile.ZIP_DEFLATED), tmp_path / "dataset")
    for content in (data[:-30], data[: len(data) // 2], b"", b"PK\3\4"):
        with pytest.raises(UnreadableRecording, match="truncated or corrupt"):
            unpack_dataset(io.BytesIO(content), tmp_path / "dataset")
    flipped = bytearray(data)
    flipped[100] ^= 1
    with pytest.raises((Corrupt, UnreadableRecording)):
        unpack_dataset(io.BytesIO(flipped), tmp_path / "dataset")
    assert list(tmp_path.iterdir()) == []
