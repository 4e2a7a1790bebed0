"""Detection of changes without reading a table: immediate, and better no answer than a wrong one."""

import asyncio
import os
import signal
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from time import monotonic

import pytest
from sqlalchemy import text

from skills.db import now
from skills.db.changes import APPLICATION, BOUND_S, Changes, Unasked, announce, changes_of
from skills.db.service_tables import Executor, record_event
from skills.db.session import Database
from skills.library.policies.releases import NEWEST_RELEASE
from tests import backends
from tests.waiting import END_S, crowded

Story = Callable[[Changes, Database], Awaitable[None]]
NOBODY = {"surgeon": "nobody", "suture": "simple-running"}


def told(backend: str, folder: Path, story: Story) -> None:
    """Run a scenario on a service's event loop, with a second connection pool in place of another process."""
    url = backends.fresh(backend, folder)
    mine, another = Database(url), Database(url)

    async def run() -> None:
        changes = changes_of(mine)
        assert changes.version() is None
        await changes.open()
        try:
            await until(lambda: changes.version() is not None)
            await story(changes, another)
        finally:
            await changes.close()
        assert changes.version() is None

    asyncio.run(run())
    mine.close()
    another.close()
    backends.drop(url)


async def until(what: Callable[[], object]) -> float:
    began = monotonic()
    while not what():
        assert monotonic() - began < END_S
        await asyncio.sleep(0.001)
    return monotonic() - began


def change(database: Database) -> None:
    with database.writing() as session:
        record_event(session, "test", "change", "surgeon", "nobody")
        announce(session)


def beat(database: Database) -> None:
    with database.writing() as session:
        session.merge(Executor(id="a worker", beat_at=now()))


async def unchanged_by(changes: Changes, work: Callable[[], object]) -> None:
    """Assert that work leaves the version as it is.

    On PostgreSQL a heartbeat of the line that is sent after the work returns after its notification. On a busy machine
    the line may fall silent and be replaced, which counts a change; then the work is done again.
    """
    while True:
        await until(lambda: changes.version() is not None)
        before, line = changes.version(), getattr(changes, "_line", None)
        await asyncio.to_thread(work)
        await until(partial(is_told_since, changes, monotonic()))
        if getattr(changes, "_line", None) is line:
            assert changes.version() == before
            return


def is_told_since(changes: Changes, moment_s: float) -> bool:
    """Return whether a heartbeat has returned that was sent after a moment; SQLite needs none."""
    return changes.version() is not None and getattr(changes, "_known_s", moment_s) >= moment_s


def listeners(database: Database) -> list[int]:
    with database.reading() as session:
        named = text("SELECT pid FROM pg_stat_activity WHERE application_name = :name AND datname = current_database()")
        return list(session.scalars(named, {"name": APPLICATION}))


@contextmanager
def stopped(pid: int) -> Iterator[None]:
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


@pytest.mark.parametrize("backend", backends.BACKENDS)
def test_the_version_stays_until_another_process_has_changed_something(backend: str, tmp_path: Path):
    async def story(changes: Changes, another: Database) -> None:
        versions = [changes.version()]
        for _ in range(3):
            await unchanged_by(changes, lambda: None)
            versions[-1] = changes.version()
            await asyncio.to_thread(change, another)
            await until(lambda: changes.version() != versions[-1])
            versions.append(changes.version())
        assert len(set(versions)) == 4

    told(backend, tmp_path, story)


def test_sqlite_reports_every_commit_at_once_including_heartbeats(tmp_path: Path):
    async def story(changes: Changes, another: Database) -> None:
        for work in (change, beat) * 20:
            before = changes.version()
            assert changes.first(NEWEST_RELEASE, NOBODY) is None
            assert changes.version() == before
            work(another)
            assert changes.version() != before

    told("sqlite", tmp_path, story)


def test_a_commit_that_is_not_finished_is_not_seen(tmp_path: Path):
    async def story(changes: Changes, another: Database) -> None:
        before = changes.version()
        with another.writing() as session:
            record_event(session, "test", "change", "surgeon", "nobody")
            assert changes.version() == before
        assert changes.version() != before

    told("sqlite", tmp_path, story)


def test_postgresql_reports_own_commits_at_once_and_no_heartbeats(tmp_path: Path):
    async def story(changes: Changes, another: Database) -> None:
        await unchanged_by(changes, lambda: beat(another))
        with pytest.raises(Unasked):
            changes.first(NEWEST_RELEASE, NOBODY)

    told("postgresql", tmp_path, story)

    async def run() -> None:
        url = backends.fresh("postgresql", tmp_path)
        database = Database(url)
        changes = changes_of(database)
        await changes.open()
        for _ in range(20):
            await until(lambda: changes.version() is not None)
            before = changes.version()
            change(database)
            assert changes.version() != before
        await changes.close()
        database.close()
        backends.drop(url)

    asyncio.run(run())


def test_a_line_that_is_cut_tells_nothing_until_there_is_another(tmp_path: Path):
    async def story(changes: Changes, another: Database) -> None:
        before = changes.version()
        (pid,) = listeners(another)
        with another.writing() as session:
            session.execute(text("SELECT pg_terminate_backend(:pid)"), {"pid": pid})
        await until(lambda: changes.version() is None)
        await asyncio.to_thread(change, another)
        await until(lambda: changes.version() is not None)
        assert changes.version() != before
        before = changes.version()
        await asyncio.to_thread(change, another)
        await until(lambda: changes.version() != before)

    told("postgresql", tmp_path, story)


def test_a_line_that_falls_silent_tells_nothing_after_the_bound(tmp_path: Path):
    async def story(changes: Changes, another: Database) -> None:
        before, late_s = changes.version(), 0.5 * crowded()
        (pid,) = listeners(another)
        with stopped(pid):
            await asyncio.to_thread(change, another)
            began = monotonic()
            while (version := changes.version()) is not None:
                assert version == before
                assert monotonic() - began < BOUND_S + late_s, "the loop was held up itself"
                await asyncio.sleep(0.01)
        await until(lambda: changes.version() is not None)
        await until(lambda: changes.version() != before)

    told("postgresql", tmp_path, story)
