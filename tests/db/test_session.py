"""Transactions, on both back ends: whole or not at all, and one after another where two write."""

import sqlite3
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest
from sqlalchemy import text

from skills.db import session as sessions
from skills.db.models import SutureType
from skills.db.session import Database
from skills.errors import Busy
from tests import backends

THREADS, TIMES = 6, 50


def add_counter(database: Database) -> None:
    with database.writing() as session:
        session.add(SutureType(slug="counter", name="0", also_called=[], family="-", description=""))


def count(database: Database) -> int:
    with database.reading() as session:
        return int(session.get_one(SutureType, "counter").name)


def test_300_transactions_that_read_and_then_write_lose_nothing_and_never_fail(database: Database):
    add_counter(database)

    def work(_: int) -> None:
        for _ in range(TIMES):
            with database.writing() as session:
                counter = session.get_one(SutureType, "counter")
                counter.name = str(int(counter.name) + 1)

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(work, range(THREADS)))
    assert count(database) == THREADS * TIMES


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
    """The wait is cut from 10 s to a tenth; what is shown is that it ends, and how."""
    monkeypatch.setattr(sessions, "BUSY_TIMEOUT_MS", 100)
    impatient = Database(database.url)
    add_counter(database)
    with database.writing() as first:
        first.get_one(SutureType, "counter").name = "1"
        first.flush()
        began = time.monotonic()
        with pytest.raises(Busy, match="try again"), impatient.writing() as second:
            second.execute(text("UPDATE suture_types SET name = '2'"))
        assert time.monotonic() - began < 5
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
    assert holding.wait(5)
    with database.writing() as session:
        assert session.get_one(SutureType, "counter").name == "1"
    thread.join()


def test_a_file_that_is_no_database_is_refused_and_left_alone(tmp_path: Path):
    file = tmp_path / "skills.sqlite"
    file.write_bytes(b"this is not a database " * 100)
    database = Database(f"sqlite:///{file}")
    with pytest.raises(Exception, match="not a database"):
        database.migrate()
    database.close()
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
    """SQLite does not wait by itself here: a change to the write-ahead log beside a writer fails at once."""
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


def test_more_at_once_than_there_are_connections_wait_and_are_told_that_it_is_busy(database: Database):
    crowded = Database(database.url, patience_ms=200)
    try:
        with ExitStack() as at_once:
            for _ in range(sessions.AT_ONCE):
                at_once.enter_context(crowded.reading()).execute(text("SELECT 1"))
            with pytest.raises(Busy, match="too much to do"), crowded.reading() as session:
                session.execute(text("SELECT 1"))
        with crowded.reading() as session:
            assert session.scalar(text("SELECT 1")) == 1
    finally:
        crowded.close()
