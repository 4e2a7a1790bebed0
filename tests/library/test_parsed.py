"""The cache of parsed recordings: never another value than that of the bytes, and never a reason to fail."""

import io
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

import numpy as np
import pytest
from sqlalchemy import delete, func, select, text, update
from sqlalchemy.orm import Session

from skills.db.models import ParsedChunk, ParsedRecording, RecordingChunk, StoredRecording
from skills.db.row_visibility import Only
from skills.db.session import Database
from skills.errors import Busy, Corrupt, NotFound
from skills.formats import media_type_of
from skills.formats.lerobot.cut import cut_episode, episodes_of, find_dataset
from skills.formats.parsed import ParsedContent, parse, parse_recording
from skills.library.comparison import scores
from skills.library.operation import views
from skills.library.operation.backup import back_up, restore
from skills.library.people.erasure import erase_surgeon
from skills.library.recordings import content_cache, recordings
from skills.library.recordings.content_cache import alike, entry_of, put_entry
from skills.library.recordings.demos import add_demo
from skills.library.recordings.recordings import store_recording, stored_recording
from skills.schemas.demos import DemoIn
from skills.schemas.recordings import TableIn
from skills.schemas.scores import ScoreIn
from skills.seeds.recordings import sample_recordings
from tests import backends
from tests.by_day import some
from tests.formats import bags, lerobots, trials
from tests.formats.test_confined import same
from tests.library import cases
from tests.library.cases import fetch, wrong

TABLE = cases.hand_off()
CUT = DemoIn(surgeon="kestrel", suture=cases.SUTURE, start_s=0.1, end_s=1.0)


def never(file: BinaryIO, **how: Any) -> ParsedContent:
    """A reader that must not be called."""
    raise AssertionError("the bytes were decoded again")


def counting(into: list[ParsedContent]) -> Callable[..., ParsedContent]:
    """Return a reader that notes what it reads."""

    def read(file: BinaryIO, **how: Any) -> ParsedContent:
        into.append(parse_recording(file, **how))
        return into[-1]

    return read


def add(database: Database, data: bytes = TABLE, **reading: Any) -> str:
    upload = cases.upload(data, media_type_of(io.BytesIO(data)), vouched=True)
    return store_recording(database, upload.read_as(TableIn(**reading)), "test")[0].sha256


def forget(database: Database) -> None:
    """Delete the cache, as an operator may at any time."""
    with database.writing() as session:
        session.execute(delete(ParsedRecording))


def counted(database: Database) -> tuple[int, int]:
    with database.reading() as session:
        return tuple(session.scalar(select(func.count()).select_from(one)) for one in (ParsedRecording, ParsedChunk))


# ---- use -------------------------------------------------------------------------------------------------------------


def test_cutting_scoring_and_the_page_do_not_decode_a_stored_recording(database: Database):
    cases.committed(database, cases.agree, {"uses": ["atlas"], "until": None})
    sha256 = add(database)
    asked = ScoreIn(surgeon="kestrel", suture=cases.SUTURE, recording=sha256, start_s=0.0, end_s=0.9)

    def results(read: Callable[..., ParsedContent]) -> list[Any]:
        demo = add_demo(database, sha256, CUT, "test", read).row.sha256
        score = scores.score(database, asked, read).model_dump() | {"curve": None}
        return [demo, score, views.traces_of(database, sha256, read)]

    kept = results(never)
    forget(database)
    decoded: list[ParsedContent] = []
    assert results(counting(decoded)) == kept
    assert len(decoded) == 1  # the first use fills the cache again


def kinds() -> dict[str, tuple[bytes, dict[str, Any]]]:
    return {
        "bag": (bags.pose_bag(bags.straight(40)), {}),
        "sample": (sample_recordings()[0].data, {}),
        "table": (TABLE, {}),
        "table without times": (b"x_mm,y_mm,z_mm\n" + b"1,2,-100.5\n2,2,-100.5\n" * 20, {"rate_hz": 50.0}),
        "jigsaws": (trials.text(trials.kinematics()), {}),
        "lerobot": (lerobots.packed(lerobots.episode(count=200)).getvalue(), {"frame": "base"}),
    }


@pytest.mark.parametrize("kind", kinds())
def test_the_cached_content_is_the_decoded_one_to_the_last_bit(database: Database, kind: str):
    data, reading = kinds()[kind]
    sha256 = add(database, data, **reading)
    stored = fetch(database, recordings.find_recording, sha256)
    decoded = parse_recording(io.BytesIO(data), **stored.reading.options)
    assert same(decoded, stored_recording(database, sha256, never))
    assert recordings.describe_recording(stored).format == stored.format == decoded.recording.format


def test_a_recording_of_an_older_version_is_cached_at_its_first_use(database: Database):
    sha256, decoded = add(database), []
    forget(database)
    assert counted(database) == (0, 0)
    for _ in range(3):
        assert same(stored_recording(database, sha256, counting(decoded)), decoded[0])
    assert len(decoded) == 1 and counted(database) == (1, 1)
    forget(database)
    add(database)  # sent again: it was read anyway
    assert stored_recording(database, sha256, never)


def test_a_large_content_is_stored_in_chunks(database: Database, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(content_cache, "CHUNK_BYTES", 1000)
    data = sample_recordings()[0].data
    sha256 = add(database, data)
    assert counted(database)[1] > 50
    assert same(parse_recording(io.BytesIO(data)), stored_recording(database, sha256, never))
    with database.writing() as session:  # replaced whole
        stored = recordings.find_recording(session, sha256)
        put_entry(session, stored.row, entry_of(cases.upload(data), parse_recording(io.BytesIO(data))))
    assert same(parse_recording(io.BytesIO(data)), stored_recording(database, sha256, never))


# ---- entries that may not be used ------------------------------------------------------------------------------------


def damage_chunk(session: Session) -> None:
    chunk = session.scalars(select(ParsedChunk)).one()
    data = bytearray(chunk.data)
    data[len(data) // 2] ^= 1
    session.execute(update(ParsedChunk).values(data=bytes(data)))


DAMAGES: dict[str, Callable[[Session], Any]] = {
    "a byte": damage_chunk,
    "a missing chunk": lambda session: session.execute(delete(ParsedChunk)),
    "an empty chunk": lambda session: session.execute(update(ParsedChunk).values(data=b"")),
    "another digest": lambda session: session.execute(update(ParsedRecording).values(sha256="0" * 64)),
    "other parameters": lambda session: session.execute(update(ParsedRecording).values(reading="0" * 64)),
    "another version": lambda session: session.execute(update(ParsedRecording).values(version=0)),
}


@pytest.mark.parametrize("damage", some(DAMAGES, 3))
def test_a_changed_entry_is_never_used_and_is_replaced(database: Database, damage: str):
    sha256, decoded = add(database), []
    with database.writing() as session:
        DAMAGES[damage](session)
    told = stored_recording(database, sha256, counting(decoded))
    assert len(decoded) == 1 and same(told, decoded[0])
    assert same(told, stored_recording(database, sha256, never))
    assert wrong(database) == []


@pytest.mark.parametrize("damage", ["an empty chunk", "another version"])
def test_a_damaged_entry_of_several_transactions_is_replaced(
    database: Database, monkeypatch: pytest.MonkeyPatch, damage: str
):
    monkeypatch.setattr(content_cache, "CHUNK_BYTES", 1000)
    monkeypatch.setattr(content_cache, "AT_ONCE_BYTES", 4000)
    sha256, decoded = add(database, sample_recordings()[0].data), []
    assert stored_recording(database, sha256, never)
    with database.writing() as session:
        DAMAGES[damage](session)
    told = stored_recording(database, sha256, counting(decoded))
    assert len(decoded) == 1 and same(told, stored_recording(database, sha256, never))
    assert wrong(database) == []


def test_chunks_without_an_entry_are_replaced(tmp_path: Path):
    """The sqlite3 program does not enforce references, so that a deletion there leaves them."""
    with backends.opened(backends.fresh("sqlite", tmp_path)) as database:
        cases.add_surgeon(database)
        sha256, decoded = add(database), []
        with sqlite3.connect(database.url.removeprefix("sqlite:///")) as program:
            program.execute("DELETE FROM parsed_recordings")
            program.execute("UPDATE parsed_chunks SET data = x'00'")
        program.close()
        assert counted(database) == (0, 1)
        assert add_demo(database, sha256, CUT, "test", counting(decoded)).new
        assert len(decoded) == 1 and same(decoded[0], stored_recording(database, sha256, never))
        assert wrong(database) == []


def test_a_damaged_entry_is_logged_and_found_by_verify(database: Database, caplog: pytest.LogCaptureFixture):
    sha256 = add(database)
    cases.committed(database, damage_chunk)
    ((where, why),) = wrong(database)
    assert where == "parsed_recordings 1" and why.startswith("The entry does not match its digest")
    caplog.clear()
    content_cache.log.disabled = False  # import-linter, in another test, disables all loggers
    stored_recording(database, sha256)
    assert [
        record.getMessage().split(":")[0] for record in caplog.records if record.name == content_cache.log.name
    ] == ["parsed_recordings 1"]
    assert sha256 not in caplog.text


def test_nothing_is_cut_from_a_recording_whose_bytes_are_damaged(database: Database):
    """Its content is cached, but a demonstration of it could not be exported, verified or read by a later version."""
    sha256 = add(database)
    cases.add_surgeon(database)
    on_table = "" if database.engine.dialect.name == "sqlite" else " ON recording_chunks"
    with database.writing() as session:
        session.execute(text(f"DROP TRIGGER recording_chunks_append_only{on_table}"))
        session.execute(update(RecordingChunk).values(data=TABLE.replace(b"1", b"2", 1)))
    with pytest.raises(Corrupt, match="restore it from a backup"):
        add_demo(database, sha256, CUT, "test", never)


def test_an_entry_of_another_recording_is_not_used(database: Database):
    mine, other = add(database), add(database, cases.hand_off((2.5, 0.0, 0.0)))
    with database.writing() as session:  # exchanged, with their digests
        for table, column in (("parsed_recordings", "sha256"), ("parsed_chunks", "data")):
            one, two = session.scalars(text(f"SELECT {column} FROM {table} ORDER BY recording_row")).all()
            for row, value in ((2, one), (1, two)):
                changed = text(f"UPDATE {table} SET {column} = :value WHERE recording_row = :row")
                session.execute(changed, {"value": value, "row": row})
    for sha256 in (mine, other):
        decoded: list[ParsedContent] = []
        assert same(stored_recording(database, sha256, counting(decoded)), decoded[0])


def test_a_content_that_no_recording_can_have_is_not_used(database: Database):
    """Its digest is correct, but the constructors check every number again."""
    sha256 = add(database)
    told = stored_recording(database, sha256, never)
    motion = told.recording.motions[0]
    object.__setattr__(motion, "tip_mm", np.full(motion.tip_mm.shape, np.nan))
    replace_entry(database, sha256, told)
    decoded: list[ParsedContent] = []
    assert same(stored_recording(database, sha256, counting(decoded)), decoded[0])


def replace_entry(database: Database, sha256: str, told: ParsedContent) -> None:
    """Store a content with its correct digest, as somebody with write access who knows the format would."""
    with database.writing() as session:
        stored = recordings.find_recording(session, sha256)
        source = SimpleNamespace(sha256=stored.sha256, size_bytes=1 << 20, reading=stored.reading)
        put_entry(session, stored.row, entry_of(source, told))


def test_verify_compares_the_newest_content_or_all_with_the_bytes(database: Database):
    first, second = add(database), add(database, cases.hand_off((2.5, 0.0, 0.0)))
    assert wrong(database, decode_all=True) == []
    false = parse(parse_recording(io.BytesIO(cases.hand_off((0.0, 2.5, 0.0)))).recording)
    replace_entry(database, first, false)
    assert wrong(database) == []
    assert wrong(database, decode_all=True) == [
        (
            "recordings 1",
            "its cached content differs from its bytes; delete its rows of parsed_chunks and parsed_recordings, which "
            "are written again",
        )
    ]
    replace_entry(database, second, false)
    assert [where for where, _ in wrong(database)] == ["recordings 2"]


def test_contents_are_alike_within_rounding_and_in_nothing_else():
    one = parse_recording(io.BytesIO(TABLE)).recording
    shifted = parse_recording(io.BytesIO(cases.hand_off((1e-9, 0.0, 0.0)))).recording
    other = parse_recording(io.BytesIO(cases.hand_off((1e-5, 0.0, 0.0)))).recording
    assert alike(one, one) and alike(one, shifted) and not alike(one, other)
    assert not alike(one, parse_recording(io.BytesIO(cases.bag())).recording)
    assert not alike((1.0,), (1.0, 1.0)) and not alike(1, 1.0) and not alike(float("nan"), float("nan"))


# ---- never a reason to fail ------------------------------------------------------------------------------------------


def test_a_content_much_larger_than_its_file_is_not_kept(database: Database, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(content_cache, "LEAST_BYTES", 0)
    monkeypatch.setattr(content_cache, "MOST_SHARE", 0.1)
    sha256, decoded = add(database), []
    for _ in range(2):
        stored_recording(database, sha256, counting(decoded))
    assert len(decoded) == 2 and counted(database) == (0, 0)


def test_a_recording_is_read_although_it_cannot_be_cached(database: Database, monkeypatch: pytest.MonkeyPatch):
    sha256 = add(database)
    forget(database)

    @contextmanager
    def busy(self: Database, names: Iterable[str] | None = None) -> Iterator[Session]:
        raise Busy("The database is busy.")
        yield

    with monkeypatch.context() as patched:
        patched.setattr(Database, "writing", busy)
        assert stored_recording(database, sha256).proposed is not None
    assert counted(database) == (0, 0)


def test_a_recording_that_is_erased_while_it_is_read_is_not_cached(database: Database):
    sha256 = add(database)
    forget(database)

    def erased_meanwhile(file: BinaryIO, **how: Any) -> ParsedContent:
        with database.writing() as session:
            recordings_of = session.scalars(select(StoredRecording)).all()
            session.execute(text("DELETE FROM recording_chunks"))
            for one in recordings_of:
                session.delete(one)
        return parse_recording(file, **how)

    assert stored_recording(database, sha256, erased_meanwhile)
    assert counted(database) == (0, 0)
    with pytest.raises(NotFound):
        stored_recording(database, sha256)


def test_concurrent_first_uses_leave_one_entry(database: Database):
    sha256 = add(database)
    forget(database)
    with ThreadPoolExecutor(4) as threads:
        told = list(threads.map(lambda _: stored_recording(database, sha256), range(4)))
    assert all(same(told[0], one) for one in told) and counted(database) == (1, 1)
    assert same(told[0], stored_recording(database, sha256, never))


def test_a_restricted_caller_reaches_only_what_it_may_see(database: Database):
    sha256 = add(database)
    with pytest.raises(NotFound):
        stored_recording(database.seen_by(Only("somebody", frozenset())), sha256)
    sender = database.seen_by(Only("test", frozenset()))
    assert stored_recording(sender, sha256, never)
    forget(database)
    assert stored_recording(sender, sha256) and stored_recording(sender, sha256, never)


# ---- erasure and backups ---------------------------------------------------------------------------------------------


def test_a_backup_has_no_cache_and_a_restored_recording_fills_it(database: Database, tmp_path: Path):
    sha256 = add(database)
    back_up(database, tmp_path / "b.zip")
    restored = Database(f"sqlite:///{tmp_path / 'r.sqlite'}")
    restore(restored, tmp_path / "b.zip")
    assert counted(restored) == (0, 0)
    decoded: list[ParsedContent] = []
    assert same(stored_recording(restored, sha256, counting(decoded)), stored_recording(database, sha256, never))
    assert len(decoded) == 1 and counted(restored) == (1, 1)
    restored.close()


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_erasing_a_surgeon_keeps_anothers_episode_of_one_dataset(database: Database, tmp_path: Path, version: str):
    """Each episode of a dataset is a recording of its own, with no frame of another episode."""
    cases.add_surgeon(database, "heron")
    episodes = {}
    with find_dataset(lerobots.write(lerobots.dataset(version), tmp_path)) as dataset:
        assert dataset is not None
        for surgeon, number in (("kestrel", 0), ("heron", 1)):
            out = io.BytesIO()
            cut_episode(dataset, episodes_of(dataset)[number], out)
            upload = cases.upload(out.getvalue(), media_type_of(out)).read_as(TableIn(frame="base"))
            episodes[surgeon] = store_recording(database, upload, "test", surgeon=surgeon)[0].sha256
            cut = DemoIn(surgeon=surgeon, suture=cases.SUTURE, segment="whole", arm="PSM1", grid="fit")
            add_demo(database, episodes[surgeon], cut, "test", never)
    told = {surgeon: stored_recording(database, sha256, never) for surgeon, sha256 in episodes.items()}
    assert [len(one.recording.motions[0].stamps_ns) for one in told.values()] == list(lerobots.COUNTS[:2])
    cases.committed(database, erase_surgeon, "kestrel", "test")
    with pytest.raises(NotFound):
        stored_recording(database, episodes["kestrel"])
    assert same(told["heron"], stored_recording(database, episodes["heron"], never))
    with database.reading() as session:
        (left,) = session.scalars(select(StoredRecording))
        assert b"".join(recordings.recording_bytes(session, left))
    assert counted(database) == (1, 1)
    assert wrong(database) == []
