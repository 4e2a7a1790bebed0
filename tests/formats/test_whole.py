"""Recordings of which a part is elsewhere are read whole or refused: databases with logs, cuts of datasets."""

import io
import shutil
import sqlite3
from pathlib import Path

import pytest

from skills.demonstration.recording import Recording
from skills.errors import UnreadableRecording
from skills.formats import read_recording
from skills.formats.bag_writer import messages_of
from skills.formats.lerobot.cut import choose_episodes, cut_episode, find_dataset
from skills.formats.reader_process import ConfinedReader
from skills.formats.upload import find_bag, prepare_upload
from tests.formats import confined, lerobots, others
from tests.formats.bags import recording
from tests.formats.others import zipped

COUNT, EARLY = 40, 25


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A bag folder of COUNT poses, of which those after EARLY are only in its write-ahead log."""
    made = others.db3(messages_of(recording(COUNT)), tmp_path / "made")
    path = next(made.glob("*.db3"))
    connection = sqlite3.connect(path)
    late = connection.execute("SELECT * FROM messages ORDER BY timestamp LIMIT -1 OFFSET ?", (2 * EARLY,)).fetchall()
    connection.execute("DELETE FROM messages WHERE id >= ?", (min(row[0] for row in late),))
    connection.commit()
    connection.execute("PRAGMA journal_mode=WAL")
    connection.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", late)
    connection.commit()
    copy = tmp_path / "copy"
    shutil.copytree(made, copy)  # while the log is there: the last connection that closes removes it
    connection.close()
    assert len(list(copy.glob("*-wal"))) == 1
    (copy / "metadata.yaml").unlink()
    for shared in copy.glob("*-shm"):
        shared.unlink()
    return copy


def read(members: dict[str, bytes]) -> Recording:
    return read_recording(io.BytesIO(zipped(members)))


def poses(got: Recording) -> int:
    return len(got.motion_of().stamps_ns)


def test_a_database_is_read_with_the_log_beside_it(folder: Path):
    members = others.folder_members(folder, "s/")
    assert (poses(read(members)), read(members).integrity) == (COUNT, "full")
    for path in (folder, next(folder.glob("*.db3"))):
        with prepare_upload(find_bag(path)) as file, file.open("rb") as content:
            assert poses(read_recording(content)) == COUNT
    assert len(list(folder.glob("*-wal"))) == 1  # the user's own files are as they were


def test_a_confined_process_reads_the_log_too(folder: Path, reader: ConfinedReader):
    assert poses(confined.read(reader, zipped(others.folder_members(folder, "s/")))) == COUNT


def test_a_database_whose_log_is_missing_is_refused_by_name(folder: Path):
    path = next(folder.glob("*.db3"))
    next(folder.glob("*-wal")).unlink()
    for data in (path.read_bytes(), zipped(others.folder_members(folder, "s/"))):
        with pytest.raises(UnreadableRecording, match=r"WAL mode.*suffix -wal.*journal_mode=DELETE"):
            read_recording(io.BytesIO(data))
    with prepare_upload(find_bag(folder)) as file, file.open("rb") as content, pytest.raises(UnreadableRecording):
        read_recording(content)


def test_a_closed_database_in_wal_mode_is_whole_if_it_is_counted(tmp_path: Path):
    made = others.db3(messages_of(recording(COUNT)), tmp_path / "closed")
    path = next(made.glob("*.db3"))
    sqlite3.connect(path).execute("PRAGMA journal_mode=WAL").connection.close()
    assert poses(read(others.folder_members(made, "s/"))) == COUNT
    with prepare_upload(find_bag(made)) as file, file.open("rb") as content:
        assert poses(read_recording(content)) == COUNT
    sqlite3.connect(path).execute("PRAGMA journal_mode=DELETE").connection.close()  # as the refusal advises
    assert poses(read_recording(io.BytesIO(path.read_bytes()))) == COUNT


def test_a_damaged_log_or_one_of_another_database_is_refused(folder: Path):
    log = next(folder.glob("*-wal"))
    for data in (b"not a log" * 1000, bytes(16) + log.read_bytes()[16:]):
        log.write_bytes(data)
        with pytest.raises(UnreadableRecording, match="-wal"):
            read(others.folder_members(folder, "s/"))


# ---- cuts by our own client ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("claim", ["info", "line"])
def test_a_cut_keeps_no_claim_from_the_service(claim: str, tmp_path: Path):
    files = lerobots.episode(total_frames=55 if claim == "info" else 40)
    if claim == "line":
        files["meta/episodes.jsonl"] = b'{"episode_index": 0, "length": 55}\n'
    with pytest.raises(UnreadableRecording, match="claims 55 frames, and the episode has 40"):
        read_recording(io.BytesIO(zipped(files)), frame="ECM")
    with find_dataset(lerobots.write(files, tmp_path)) as dataset:
        assert dataset is not None
        (episode,) = choose_episodes(dataset, None)
        with pytest.raises(UnreadableRecording, match="claims 55 frames, and the episode has 40"):
            cut_episode(dataset, episode, io.BytesIO())
