"""Job events: server-sent events with the state of a job at every change.

One polling task queries the database for all watchers, however many there are. On SQLite it queries only when `PRAGMA
data_version` shows a commit; on PostgreSQL, whose notifications cover other changes only, five times a second while
there are watchers.
"""

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from time import monotonic

from anyio import to_thread
from sqlalchemy.exc import SQLAlchemyError

from skills.api.places import Places
from skills.api.responses import json_of
from skills.db.changes import Changes
from skills.db.session import Database
from skills.errors import SkillsError, TooMany
from skills.library.operation.jobs import ACTIVE, find_job, find_jobs
from skills.library.policies.outcomes import describe_job, describe_jobs
from skills.schemas.operation import Job
from skills.settings import Settings

WATCH_S = 0.2
ASKED_AGAIN_S = 1.0  # interval of the authorisation check: a stream ends within this and `authentication.REMEMBERED_S`
AGAIN_S = 10.0


class Watcher:
    """One stream: the last state of its job, None if it was erased, and the event that wakes the stream at a change."""

    def __init__(self, job: str) -> None:
        self.job = job
        self.now: Job | None = None
        self.changed = asyncio.Event()


class Watching:
    """All event streams of this process, on one event loop."""

    def __init__(self, database: Database, changes: Changes, settings: Settings) -> None:
        self._database, self._changes = database, changes
        self._heartbeat_s = settings.heartbeat_s
        self._watchers: set[Watcher] = set()
        full = f"This key watches {settings.key_watchers} jobs already; close one of its streams, or poll the job."
        self._places = Places(settings.key_watchers, TooMany(full, AGAIN_S))
        self._looking: asyncio.Task[None] | None = None
        self._version: int | None = None  # of the database at the last query

    async def events(
        self, database: Database, job: str, key: str | None, may_still: Callable[[], Awaitable[object]]
    ) -> AsyncGenerator[bytes, None]:
        """Yield the state of a job at every change until it has ended, with comments as a heartbeat in between.

        Args:
            database: The database, restricted to the rows that the caller may see.
            job: The job's id.
            key: The identity that concurrent streams are counted by; None: no limit.
            may_still: Authorises the caller again; the stream ends when it raises.

        Raises:
            TooMany: The key has as many streams open as it may.
            NotFound: There is no such job.
        """
        with self._places.place(key), self._watched(job) as watcher:
            watcher.now = await to_thread.run_sync(_look, database, job)
            self._version = None  # a commit may have come in between: poll again
            sent, sent_s = None, monotonic()
            while watcher.now is not None:
                if watcher.now != sent:
                    sent, sent_s = watcher.now, monotonic()
                    yield b"event: job\ndata: " + json_of(sent) + b"\n\n"
                    if sent.state not in ACTIVE:
                        return
                elif monotonic() - sent_s >= self._heartbeat_s:
                    sent_s = monotonic()
                    yield b": the job goes on\n\n"
                with suppress(TimeoutError):
                    await asyncio.wait_for(watcher.changed.wait(), min(ASKED_AGAIN_S, self._heartbeat_s))
                watcher.changed.clear()
                try:
                    await may_still()
                except SkillsError:
                    return

    @contextmanager
    def _watched(self, job: str) -> Iterator[Watcher]:
        watcher = Watcher(job)
        self._watchers.add(watcher)
        if self._looking is None:
            self._looking = asyncio.create_task(self._look_on())
        try:
            yield watcher
        finally:
            self._watchers.discard(watcher)
            if not self._watchers and self._looking is not None:
                self._looking.cancel()
                self._looking = None

    async def _look_on(self) -> None:
        """Poll for changes while there are watchers, and wake those whose job changed."""
        while True:
            await asyncio.sleep(WATCH_S)
            # read before the tables, so that a commit in between is not missed
            version = self._changes.version() if self._changes.every_commit else None
            if version is not None and version == self._version:
                continue
            wanted = {watcher.job for watcher in self._watchers if watcher.now is not None}
            with suppress(SkillsError, SQLAlchemyError):  # the database may be readable again at the next poll
                found = await to_thread.run_sync(_look_at_all, self._database, wanted)
                self._version = version
                for watcher in self._watchers:
                    if watcher.job in wanted and watcher.now is not None and found.get(watcher.job) != watcher.now:
                        watcher.now = found.get(watcher.job)
                        watcher.changed.set()


def _look(database: Database, job: str) -> Job:
    with database.reading() as session:
        found = find_job(session, job)
        return describe_job(session, found)


def _look_at_all(database: Database, jobs: set[str]) -> dict[str, Job]:
    with database.reading() as session:
        return {job.id: job for job in describe_jobs(session, find_jobs(session, jobs))}
