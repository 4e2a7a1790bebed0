"""Streamed responses: recordings as files, and the events of jobs.

A stream waits for its client between two chunks, perhaps for long, and is abandoned there when the client disconnects.
Its generator therefore holds no session, file or lock across a `yield` (`tests/test_architecture.py` checks sessions).
A recording is read in one transaction per chunk.

Job events are server-sent events. One polling task queries the database for all watchers, however many there are. On
SQLite it queries only when `PRAGMA data_version` shows a commit; on PostgreSQL, whose notifications cover other changes
only, five times a second while there are watchers.
"""

import asyncio
import hashlib
from collections import Counter
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator
from contextlib import aclosing, contextmanager, suppress
from time import monotonic
from typing import Any, Never

import orjson
from anyio import CapacityLimiter, to_thread
from fastapi.responses import StreamingResponse
from starlette.types import Send

from skills.db.changes import Changes
from skills.db.session import Database
from skills.errors import SkillsError, TooMany
from skills.library.demos import exported_chunk, exported_recording
from skills.library.jobs import ACTIVE, find_job, find_jobs, job_json
from skills.library.recordings import damaged
from skills.library.releases import outcomes_of
from skills.settings import Settings

PIECE_BYTES = 64 << 10  # written at once; at most two of them are buffered for a slow client
DOWNLOADS_READ = 4  # chunks read at once for all downloads: limits threads, and thereby database connections


class Stream(StreamingResponse):
    """A streamed response that sends its status with the first chunk: an error before that becomes a problem document.

    A later error aborts the connection, so a response that ends regularly is complete. The generator is closed at the
    end in every case, and not when the garbage collector finds it.
    """

    def __init__(self, pieces: AsyncGenerator[bytes, None], media_type: str, headers: dict[str, str]) -> None:
        super().__init__(pieces, headers=headers, media_type=media_type)
        self._pieces = pieces

    async def stream_response(self, send: Send) -> None:
        """Send the status with the first chunk, then the rest."""
        try:
            piece = await anext(self._pieces, None)
            await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
            while piece is not None:
                await send({"type": "http.response.body", "body": piece, "more_body": True})
                piece = await anext(self._pieces, None)
            await send({"type": "http.response.body", "body": b"", "more_body": False})
        finally:
            await self._pieces.aclose()


async def recording_pieces(
    database: Database, demo: str, sha256: str, limiter: CapacityLimiter
) -> AsyncGenerator[bytes, None]:
    """Yield the bytes of a demonstration's recording, after all of them were compared with its digest.

    Every chunk is read in a transaction of its own, so the recording is read twice: to check it before the first byte
    is sent, and to send it. The second pass is checked as well, and withholds its last chunk until the digest agrees.

    Args:
        database: The database, restricted to the rows that the caller may see.
        demo: The demonstration's digest.
        sha256: The recording's digest.
        limiter: Limit on reading threads, shared by the application; see `DOWNLOADS_READ`.

    Raises:
        Corrupt: The bytes do not match the digest.
        NotFound: The demonstration was erased meanwhile.
        Conflict: A chunk is missing, and the consent to export was withdrawn meanwhile.
    """
    async for _ in _chunks(database, demo, sha256, limiter):
        pass
    async with aclosing(_chunks(database, demo, sha256, limiter)) as chunks:
        async for chunk in chunks:
            for at in range(0, len(chunk), PIECE_BYTES):
                yield chunk[at : at + PIECE_BYTES]


async def _chunks(database: Database, demo: str, sha256: str, limiter: CapacityLimiter) -> AsyncGenerator[bytes, None]:
    """Yield the chunks of a recording; the last one only if all of them together match the digest."""
    seen, held, number = hashlib.sha256(), b"", 0

    def read() -> bytes | None:
        chunk = exported_chunk(database, demo, number)
        if isinstance(chunk, str):  # SQLite does not enforce the column's type
            raise damaged()
        if chunk is not None:
            seen.update(chunk)
        return chunk

    def refuse() -> Never:
        with database.reading() as session:
            exported_recording(session, demo)  # raises if it was erased, or may no longer be exported
        raise damaged()

    while (chunk := await to_thread.run_sync(read, limiter=limiter)) is not None:
        if held:
            yield held
        held, number = chunk, number + 1
    if seen.hexdigest() != sha256:
        await to_thread.run_sync(refuse)
    yield held


WATCH_S = 0.2
ASKED_AGAIN_S = 1.0  # interval of the authorisation check: a stream ends within this and `authentication.REMEMBERED_S`
AGAIN_S = 10.0

State = dict[str, Any]


class Watcher:
    """One stream: the last state of its job, None if it was erased, and the event that wakes the stream at a change."""

    def __init__(self, job: str) -> None:
        self.job = job
        self.now: State | None = None
        self.changed = asyncio.Event()


class Watching:
    """All event streams of this process, on one event loop."""

    def __init__(self, database: Database, changes: Changes, settings: Settings) -> None:
        self._database, self._changes = database, changes
        self._heartbeat_s, self._most = settings.heartbeat_s, settings.key_watchers
        self._watchers: set[Watcher] = set()
        self._of_key: Counter[str] = Counter()
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
        with self._place(job, key) as watcher:
            watcher.now = await to_thread.run_sync(_look, database, job)
            self._version = None  # a commit may have come in between: poll again
            told, told_s = None, monotonic()
            while watcher.now is not None:
                if watcher.now != told:
                    told, told_s = watcher.now, monotonic()
                    yield b"event: job\ndata: " + orjson.dumps(told) + b"\n\n"
                    if told["state"] not in ACTIVE:
                        return
                elif monotonic() - told_s >= self._heartbeat_s:
                    told_s = monotonic()
                    yield b": the job goes on\n\n"
                with suppress(TimeoutError):
                    await asyncio.wait_for(watcher.changed.wait(), min(ASKED_AGAIN_S, self._heartbeat_s))
                watcher.changed.clear()
                try:
                    await may_still()
                except SkillsError:
                    return

    @contextmanager
    def _place(self, job: str, key: str | None) -> Iterator[Watcher]:
        if key is not None and self._of_key[key] >= self._most:
            raise TooMany(
                f"This key watches {self._most} jobs already; close one of its streams, or poll the job.", AGAIN_S
            )
        watcher = Watcher(job)
        self._watchers.add(watcher)
        self._of_key.update([] if key is None else [key])
        if self._looking is None:
            self._looking = asyncio.create_task(self._look_on())
        try:
            yield watcher
        finally:
            self._watchers.discard(watcher)
            self._of_key.subtract([] if key is None else [key])
            if key is not None and not self._of_key[key]:
                del self._of_key[key]
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
            with suppress(SkillsError):  # the database may be readable again at the next poll
                found = await to_thread.run_sync(_look_at_all, self._database, wanted)
                self._version = version
                for watcher in self._watchers:
                    if watcher.job in wanted and watcher.now is not None and found.get(watcher.job) != watcher.now:
                        watcher.now = found.get(watcher.job)
                        watcher.changed.set()


def _look(database: Database, job: str) -> State:
    with database.reading() as session:
        found = find_job(session, job)
        return job_json(found, outcomes_of(session, [found])[found.row])


def _look_at_all(database: Database, jobs: set[str]) -> dict[str, State]:
    with database.reading() as session:
        found = find_jobs(session, jobs)
        came_of = outcomes_of(session, found)
        return {job.id: job_json(job, came_of[job.row]) for job in found}
