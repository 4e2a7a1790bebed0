"""Transactions on both back ends: atomic, and serialised if two write; and the disk under the database."""

import errno
import logging
import os
import sqlite3
import stat
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from sqlalchemy import Pool, event, text
from starlette.testclient import TestClient

from skills import serving
from skills.api.app import create_app
from skills.db import engines
from skills.db import session as sessions
from skills.db.disk import EXIT_CODE, RESERVE_BYTES, RESERVE_STEP_BYTES, Reserve, make_private
from skills.db.models import SutureType
from skills.db.service_tables import Executor
from skills.db.session import Database
from skills.errors import BadSettings, Busy, DatabaseUnusable, StorageFull
from skills.jobs import prepare
from skills.settings import Settings
from tests import backends
from tests.waiting import END_S, crowded

THREADS, TIMES = 6, 20


def add_counter(database: Database) -> None:
    with database.writing() as session:
        session.add(SutureType(slug="counter", name="0", also_called=[], family="-", description=""))


def count(database: Database) -> int:
    with database.reading() as session:
        return int(session.get_one(SutureType, "counter").name)


def test_120_read_then_write_transactions_lose_nothing_and_never_fail(database: Database):
    add_counter(database)

    def work(_: int) -> None:
        for _ in range(TIMES):
            with database.writing() as session:
                counter = session.get_one(SutureType, "counter")
                counter.name = str(int(counter.name) + 1)

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(work, range(THREADS)))
    assert count(database) == THREADS * TIMES


def test_a_connection_in_use_at_close_does_not_stay_open(database: Database):
    """Otherwise it stays open until it is collected as garbage, and with SQLite the write-ahead log is not merged."""
    with database.reading() as session:
        used = session.connection().connection.dbapi_connection
        database.close()
        assert session.scalar(text("SELECT 1")) == 1
    with pytest.raises(database.engine.dialect.loaded_dbapi.Error, match="closed"):
        used.execute("SELECT 1")


def test_a_block_that_raises_leaves_nothing(database: Database):
    add_counter(database)

    def fail_half_way() -> None:
        with database.writing() as session:
            session.get_one(SutureType, "counter").name = "7"
            session.flush()
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert count(database) == 0


def test_a_reader_sees_one_state_while_another_writes(database: Database):
    add_counter(database)
    with database.reading() as reading:
        before = reading.scalar(text("SELECT name FROM suture_types"))
        with database.writing() as session:
            session.get_one(SutureType, "counter").name = "1"
        assert reading.scalar(text("SELECT name FROM suture_types")) == before == "0"
    assert count(database) == 1


def test_a_database_locked_for_too_long_is_busy_and_nothing_is_kept(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    """The wait is shortened from 10 s to a tenth; the test shows that it ends, and with which error."""
    monkeypatch.setattr(sessions, "BUSY_TIMEOUT_MS", 100)
    impatient = Database(database.url)
    add_counter(database)
    with database.writing() as first:
        first.get_one(SutureType, "counter").name = "1"
        first.flush()
        began = time.monotonic()
        with pytest.raises(Busy, match="try again"), impatient.writing() as second:
            second.execute(text("UPDATE suture_types SET name = '2'"))
        assert time.monotonic() - began < 5 * crowded()
    impatient.close()
    assert count(database) == 1


def test_a_waiting_writer_goes_on_when_the_first_one_is_done(database: Database):
    add_counter(database)
    holding = threading.Event()

    def first() -> None:
        with database.writing() as session:
            session.get_one(SutureType, "counter").name = "1"
            session.flush()
            holding.set()
            time.sleep(0.2)

    thread = threading.Thread(target=first)
    thread.start()
    assert holding.wait(END_S)
    with database.writing() as session:
        assert session.get_one(SutureType, "counter").name == "1"
    thread.join()


def test_a_file_that_is_no_database_is_refused_and_left_alone(tmp_path: Path):
    file = tmp_path / "skills.sqlite"
    file.write_bytes(b"this is not a database " * 100)
    with pytest.raises(DatabaseUnusable, match="is not an SQLite database"):
        Database(f"sqlite:///{file}")
    assert file.read_bytes() == b"this is not a database " * 100


def test_sqlite_is_opened_as_its_promises_need(tmp_path: Path):
    database = Database(backends.fresh("sqlite", tmp_path))
    wanted = {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "secure_delete": 1, "busy_timeout": 10_000}
    with database.reading() as session:
        assert {name: session.scalar(text(f"PRAGMA {name}")) for name in wanted} == wanted
    database.close()
    with sqlite3.connect(tmp_path / next(tmp_path.glob("*.sqlite"))) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    connection.close()


def test_a_new_file_that_somebody_else_is_just_opening_is_waited_for(tmp_path: Path):
    """SQLite does not wait by itself here: switching to the write-ahead log beside a writer fails at once."""
    file = tmp_path / "skills.sqlite"
    writer = sqlite3.connect(file, isolation_level=None, check_same_thread=False)
    writer.execute("BEGIN IMMEDIATE")
    done = threading.Timer(0.2, writer.execute, ["COMMIT"])
    done.start()
    database = Database(f"sqlite:///{file}")
    with database.reading() as session:
        assert session.scalar(text("PRAGMA journal_mode")) == "wal"
    done.join()
    writer.close()
    database.close()


def test_a_new_file_that_stays_locked_is_busy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sessions, "BUSY_TIMEOUT_MS", 100)
    file = tmp_path / "skills.sqlite"
    writer = sqlite3.connect(file, isolation_level=None)
    writer.execute("BEGIN IMMEDIATE")
    database = Database(f"sqlite:///{file}")
    with pytest.raises(Busy), database.reading() as session:
        session.execute(text("SELECT 1"))
    writer.close()
    database.close()


def test_the_folder_of_a_new_database_is_made(tmp_path: Path):
    database = Database(f"sqlite:///{tmp_path / 'a' / 'b' / 'skills.sqlite'}")
    database.migrate()
    database.close()
    assert (tmp_path / "a" / "b" / "skills.sqlite").is_file()


def test_more_transactions_than_connections_wait_and_then_raise_busy(database: Database):
    crowded = Database(database.url, patience_ms=200)
    try:
        with ExitStack() as at_once:
            for _ in range(engines.AT_ONCE):
                at_once.enter_context(crowded.reading()).execute(text("SELECT 1"))
            with pytest.raises(Busy, match="is overloaded"), crowded.reading() as session:
                session.execute(text("SELECT 1"))
        with crowded.reading() as session:
            assert session.scalar(text("SELECT 1")) == 1
    finally:
        crowded.close()


# ---- a full or failing disk under the database, and the permissions of its files -------------------------------------


WRITE_ON = """
import logging, resource, sys
from pathlib import Path
from tests.failing_disk import fail_syncs
from skills.db.models import SutureType
from skills.db.session import Database

logging.basicConfig(level="INFO")
database, wal = Database(sys.argv[1]), Path(sys.argv[2])
with database.writing() as session:
    session.add(SutureType(slug="first", name="0", also_called=[], family="-", description=""))
if sys.argv[3] == "write":
    resource.setrlimit(resource.RLIMIT_FSIZE, (wal.stat().st_size + 100,) * 2)
else:
    fail_syncs()
try:
    with database.writing() as session:
        session.add(SutureType(slug="second", name="0", also_called=[], family="-", description="." * 100_000))
except Exception as error:
    print("went on after", error)
"""


def mode(path: Path | str) -> int:
    return stat.S_IMODE(Path(path).stat().st_mode)


def fill(database: Database) -> None:
    """Prevent a SQLite database from growing; on PostgreSQL, fail as the server does on a full disk."""

    @event.listens_for(database.engine, "connect")
    def _limit(connection: Any, _record: object) -> None:
        connection.execute("PRAGMA max_page_count=1")  # SQLite raises this to the current number of pages

    database.engine.dispose()


def test_a_full_disk_is_told_and_logged_and_nothing_is_kept(
    url: str, database: Database, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(logging.getLogger("skills.db.session"), "disabled", False)
    full = "DO $$ BEGIN RAISE EXCEPTION 'could not extend file' USING ERRCODE = '53100'; END $$"
    if url.startswith("sqlite"):
        fill(database)
    with pytest.raises(StorageFull, match="disk of the database is full"), database.writing() as session:  # noqa: PT012
        for k in range(50):
            session.add(SutureType(slug=f"large-{k}", name="0", also_called=[], family="-", description="." * 2000))
        session.flush()
        session.execute(text(full))
    assert "disk is full" in caplog.text
    assert "database or disk is full" in caplog.text or "could not extend file" in caplog.text
    with database.reading() as session:
        assert session.get(SutureType, "large-0") is None


@pytest.mark.parametrize("url", ["postgresql"], indirect=True)
def test_a_failed_disk_of_postgresql_is_told_and_logged(
    database: Database, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(logging.getLogger("skills.db.session"), "disabled", False)
    failed = "DO $$ BEGIN RAISE EXCEPTION 'could not fdatasync file' USING ERRCODE = '58030'; END $$"
    with pytest.raises(Busy, match="unknown whether this was stored"), database.writing() as session:
        session.execute(text(failed))
    assert "The disk of the PostgreSQL server failed" in caplog.text and "could not fdatasync file" in caplog.text


@pytest.mark.parametrize("failing", ["write", "fsync"])
def test_a_write_or_a_sync_that_fails_ends_the_process(failing: str, tmp_path: Path):
    url = backends.fresh("sqlite", tmp_path)
    wal = Path(url.removeprefix("sqlite:///") + "-wal")
    ran = subprocess.run([sys.executable, "-c", WRITE_ON, url, str(wal), failing], capture_output=True, text=True)
    assert ran.returncode == EXIT_CODE, ran.stderr
    assert f"The database's disk failed (SQLITE_IOERR_{failing.upper()}" in ran.stderr
    assert "went on" not in ran.stdout
    again = Database(url)
    with again.reading() as session:
        assert session.get(SutureType, "first") is not None
        if failing == "write":  # a commit that was written and not synced may be there or not: it was not acknowledged
            assert session.get(SutureType, "second") is None
    again.close()


def test_files_of_a_database_are_its_users_alone(tmp_path: Path):
    settings = Settings(database_url=f"sqlite:///{tmp_path / 'made' / 'skills.sqlite'}")
    database = Database(settings.database_url)
    database.migrate()
    prepare(settings)
    with database.reading() as session:
        session.execute(text("SELECT 1"))
        files = sorted((tmp_path / "made").iterdir())
        assert {path.name for path in files} >= {"skills.sqlite", "skills.sqlite-wal", "skills.jobs.sqlite"}
        assert {path.name: mode(path) for path in files} == {path.name: 0o600 for path in files}
    assert mode(tmp_path / "made") == 0o700
    database.close()


@pytest.mark.parametrize("backend", backends.BACKENDS)
def test_a_service_that_cannot_make_its_key_leaves_no_connection_open(backend: str, tmp_path: Path):
    (tmp_path / "a file").touch()
    settings = Settings(database_url=backends.blank(backend, tmp_path), signing_key=tmp_path / "a file" / "key")
    left: list[object] = []
    opened, closed = (lambda connection, _: left.append(connection)), (lambda connection, _: left.remove(connection))
    event.listen(Pool, "connect", opened)
    event.listen(Pool, "close", closed)
    try:
        with pytest.raises(BadSettings, match="The signing key"):
            serving.prepare(settings)
        with pytest.raises(BadSettings, match="The signing key"), TestClient(create_app(settings)):
            pass
        assert left == []
    finally:
        event.remove(Pool, "connect", opened)
        event.remove(Pool, "close", closed)
        backends.drop(settings.database_url)


def test_the_engines_file_waits_for_another_process_that_opens_it(tmp_path: Path):
    """SQLite refuses the change to WAL mode at once while another connection writes, or makes the same change."""
    settings = Settings(database_url=f"sqlite:///{tmp_path / 'skills.sqlite'}")
    file = settings.engine_url.removeprefix("sqlite:///")
    with closing(sqlite3.connect(file, isolation_level=None, check_same_thread=False)) as other:
        other.execute("BEGIN IMMEDIATE")
        ends = threading.Timer(0.2, other.execute, ["COMMIT"])
        ends.start()
        prepare(settings)
        ends.join()
        assert other.execute("PRAGMA journal_mode").fetchone() == ("wal",)


def test_a_file_that_others_could_read_is_tightened_and_the_log_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(logging.getLogger("skills.db.session"), "disabled", False)
    tmp_path.chmod(0o755)
    database, log = tmp_path / "skills.sqlite", tmp_path / "skills.sqlite-wal"
    for path in (database, log):
        path.touch(0o644)
    make_private(database)
    assert (mode(database), mode(log), mode(tmp_path)) == (0o600, 0o600, 0o755)
    assert "skills.sqlite could be read by others" in caplog.text
    caplog.clear()
    make_private(database)
    assert not caplog.text


READ = "import sqlite3, sys; c = sqlite3.connect(sys.argv[1]); print(c.execute(sys.argv[2]).fetchone()[0]); c.close()"


@pytest.mark.parametrize("anothers", [False, True])
def test_opening_a_file_once_more_gives_up_no_lock_on_it(tmp_path: Path, anothers: bool, monkeypatch):
    """Closing any descriptor of a file drops this process's locks on it, as POSIX demands.

    Without them the next process that ends takes itself for the last one and deletes the write-ahead log, and what is
    committed here afterwards is in a file without a name.
    """
    file = tmp_path / "skills.sqlite"

    def count_elsewhere() -> str:
        command = [sys.executable, "-c", READ, str(file), "SELECT count(*) FROM executors"]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    def refuse(*_: object) -> None:
        raise PermissionError

    with closing(Database(f"sqlite:///{file}")) as one:
        one.migrate()
        with one.writing() as session:
            session.add(Executor(id="first"))
        if anothers:  # a file of another user, which everybody may read
            file.chmod(0o644)
            monkeypatch.setattr(Path, "chmod", refuse)
        with closing(Database(f"sqlite:///{file}")) as again, again.reading() as session:
            assert session.get(Executor, "first") is not None
        assert count_elsewhere() == "1"
        with one.writing() as session:
            session.add(Executor(id="second"))
        assert count_elsewhere() == "2"


def test_a_file_without_write_permission_is_said_so_in_words(tmp_path: Path):
    url = backends.fresh("sqlite", tmp_path)
    with closing(Database(url)) as database:
        event.listen(database.engine, "connect", lambda connection, _: connection.execute("PRAGMA query_only = ON"))
        for change in (database.writing, lambda: database.writing(())):
            with pytest.raises(DatabaseUnusable, match="cannot be written to"), change():
                pass
        with pytest.raises(DatabaseUnusable, match="cannot be written to"):
            database.migrate()
        with database.reading() as session:
            assert session.get(Executor, "first") is None


def test_the_reserve_is_free_during_a_transaction_that_ends_something(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    url = backends.fresh("sqlite", tmp_path)
    reserve = Path(f"{url.removeprefix('sqlite:///')}.reserve")
    full = SimpleNamespace(f_bavail=0, f_frsize=4096)
    with closing(Database(url)) as database, closing(Database(url)) as other:
        database.migrate()
        assert (reserve.stat().st_size, mode(reserve)) == (RESERVE_BYTES, 0o600)
        assert reserve.stat().st_blocks * 512 >= RESERVE_BYTES, "it is allocated, not sparse"
        with database.ending():
            assert reserve.stat().st_size == RESERVE_BYTES, "the disk has space"
        monkeypatch.setattr(os, "fstatvfs", lambda _: full)
        with database.writing():
            assert reserve.stat().st_size == RESERVE_BYTES, "it is not for everybody"
        for fails in (False, True):
            with suppress(ZeroDivisionError), database.ending() as session:
                assert reserve.stat().st_size == 0
                other.reserve_space()
                assert reserve.stat().st_size == 0, "another process leaves it to this one"
                session.add(SutureType(slug=f"new-{fails}", name="0", also_called=[], family="-", description=""))
                assert 1 / (not fails)
            assert reserve.stat().st_size == RESERVE_BYTES
        database.forget()
        assert reserve.stat().st_size == RESERVE_BYTES


def test_a_disk_gives_the_reserve_as_far_as_it_has_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    allocate, left = os.posix_fallocate, [5, 100]

    def some(handle: int, at: int, size: int) -> None:
        if not left[0]:
            raise OSError(errno.ENOSPC, "full")
        left[0] -= 1
        allocate(handle, at, size)

    monkeypatch.setattr(os, "posix_fallocate", some)
    reserve = Reserve(tmp_path / "skills.sqlite")
    reserve.allocate()
    assert (tmp_path / "skills.sqlite.reserve").stat().st_size == 5 * RESERVE_STEP_BYTES
    left.pop(0)
    reserve.allocate()
    assert (tmp_path / "skills.sqlite.reserve").stat().st_size == RESERVE_BYTES
