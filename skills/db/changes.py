"""Whether what is served may have changed, told at every request without reading a table.

`Changes.version()` is a number: for as long as it stays the same, no commit has changed what is served. It is taken
before the tables are read, never after. None means that it cannot be told now, so that the tables must be read. One
object belongs to one event loop and is used on its thread only.

On SQLite it is `PRAGMA data_version` of a connection that never writes, outside any transaction. Every commit changes
it, a worker's heartbeat too, and whatever was committed before the question is in the answer.

On PostgreSQL it counts the notifications that have arrived at a listening connection, and the commits of this process.
The commit of another process is told a moment after it, and never later than `BOUND_S`, whatever becomes of the line:
the listener sends itself a beat, which comes back in order with the notifications; where the last one that came back
was sent longer ago than that, nothing is told.
"""

import asyncio
import logging
import secrets
import sqlite3
from contextlib import suppress
from functools import cache
from itertools import count
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

from sqlalchemy import Engine, Select, event, text
from sqlalchemy.orm import Session

from skills.db.session import Database

if TYPE_CHECKING:
    from psycopg.pq.abc import PGconn

CHANNEL = "skills_served"
BEAT_S = 0.5  # each is a transaction of the server's
BOUND_S = 1.5  # two beats may be late; later, the tables are read at every request
GIVEN_UP_S = 5  # a line that was silent for so long is dropped, and another one opened
AGAIN_S = 0.5  # between two attempts at that
APPLICATION = "suture-skills listening"  # as the server's list of its connections names it

log = logging.getLogger(__name__)


def announce(session: Session) -> None:
    """Tell all services that what is served has changed, as soon as the caller's transaction is committed.

    Whatever releases, withdraws or erases calls this. SQLite tells of every commit by itself.
    """
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text(f"NOTIFY {CHANNEL}"))


class Unasked(Exception):
    """The question was not asked: its answer would have to be waited for."""


class Changes:
    """Those of a database of which nothing is known, so that the tables are always read."""

    async def open(self) -> None:
        """Begin to look, on this event loop."""

    async def close(self) -> None:
        """Look no more."""

    def version(self) -> int | None:
        """Tell the version of what is served; None where it cannot be told."""
        return None

    def first(self, _question: Select[*tuple[Any, ...]], _values: dict[str, Any]) -> tuple[Any, ...] | None:
        """Ask for one row, by an index, where that takes microseconds.

        Raises:
            Unasked: It may take longer; ask the database, in a thread.
        """
        raise Unasked


def changes_of(database: Database) -> Changes:
    """Choose how the changes of a database are seen."""
    return InFile(database.engine) if database.engine.dialect.name == "sqlite" else Told(database.engine)


class InFile(Changes):
    """Those of SQLite's file, seen by a connection that does nothing else."""

    def __init__(self, engine: Engine) -> None:
        self._file = Path(engine.url.database or "")
        self._connection: sqlite3.Connection | None = None
        self._cursor: sqlite3.Cursor | None = None

    async def open(self) -> None:
        """Open the connection."""
        address = f"{self._file.resolve().as_uri()}?mode=rw"  # so that a file that is missing is not made
        self._connection = sqlite3.connect(address, uri=True, isolation_level=None, timeout=0)
        self._cursor = self._connection.execute("PRAGMA query_only=ON")

    async def close(self) -> None:
        """Close it."""
        if self._connection is not None:
            self._connection.close()
            self._connection = self._cursor = None

    def version(self) -> int | None:
        """Tell what SQLite counts: changes that others have committed."""
        try:
            ((version,),) = self._ask("PRAGMA data_version")
        except Unasked:
            return None
        return int(version)

    def first(self, question: Select[*tuple[Any, ...]], values: dict[str, Any]) -> tuple[Any, ...] | None:
        """Ask here and now: beside a write-ahead log, a reader waits for nobody."""
        statement, given = _in_sqlite(question)
        return next(iter(self._ask(statement, given | values)), None)

    def _ask(self, statement: str, values: dict[str, Any] | tuple[()] = ()) -> list[tuple[Any, ...]]:
        if self._cursor is None:
            raise Unasked
        try:
            return self._cursor.execute(statement, values).fetchall()  # all, which ends its transaction
        except sqlite3.OperationalError as error:
            raise Unasked from error


@cache
def _in_sqlite(question: Select[*tuple[Any, ...]]) -> tuple[str, dict[str, Any]]:
    """Write a question in SQLite's words, with the values that are its own."""
    from sqlalchemy.dialects import sqlite

    compiled = question.compile(dialect=sqlite.dialect(paramstyle="named"))
    return str(compiled), dict(compiled.params)


class Told(Changes):
    """Those that PostgreSQL notifies of, and those of this process, which need no telling."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._broken = engine.dialect.loaded_dbapi.Error
        self._own = f"skills_beat_{secrets.token_hex(8)}"  # the channel of the beats
        self._counter = count(1)  # between whose steps no thread can come
        self._version = 0
        self._line: PGconn | None = None
        self._beat_s = self._known_s = 0.0  # when the last beat was sent, and the last of those that came back
        self._listening: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Listen, in the background, and again whenever the line is lost."""
        event.listen(Session, "after_commit", self._committed)
        self._listening = asyncio.create_task(self._listen())

    async def close(self) -> None:
        """Hang up."""
        if self._listening is None:
            return
        event.remove(Session, "after_commit", self._committed)
        self._listening.cancel()
        with suppress(asyncio.CancelledError):
            await self._listening
        self._listening = None

    def version(self) -> int | None:
        """Count the changes that have arrived: whatever came before the loop took up a request is among them."""
        return None if self._line is None or monotonic() - self._known_s >= BOUND_S else self._version

    def _committed(self, session: Session) -> None:
        """Count a commit of this process, in the thread that made it, before anybody is told of it."""
        if session.bind is not None and session.bind.engine.pool is self._engine.pool:
            self._version = next(self._counter)

    async def _listen(self) -> None:
        """Keep a line, without an end."""
        from psycopg import AsyncConnection  # SQLite's users need not wait for it

        _, how = self._engine.dialect.create_connect_args(self._engine.url)
        how = {**how, "autocommit": True, "connect_timeout": GIVEN_UP_S, "application_name": APPLICATION}
        while True:
            try:
                connection = await AsyncConnection.connect(**how)
                try:
                    began_s = monotonic()
                    await connection.execute(f"LISTEN {CHANNEL}")
                    await connection.execute(f"LISTEN {self._own}")
                    await self._hold(connection.pgconn, began_s)
                finally:
                    await connection.close()
            except (self._broken, OSError):
                log.info("PostgreSQL cannot be asked to tell of changes.", exc_info=True)
            await asyncio.sleep(AGAIN_S)

    async def _hold(self, line: "PGconn", began_s: float) -> None:
        """Use a line that listens since a moment, for as long as its beats come back."""
        loop = asyncio.get_running_loop()
        self._version = next(self._counter)  # of what was before, it has told nothing
        self._beat_s = self._known_s = began_s
        self._line = line
        loop.add_reader(line.socket, self._take_in, line, line.socket)
        try:
            while self._line is line and monotonic() - self._known_s < GIVEN_UP_S:
                if self._known_s == self._beat_s and not line.is_busy():
                    self._beat_s = monotonic()
                    line.send_query(f"NOTIFY {self._own}".encode())
                    line.flush()
                await asyncio.sleep(BEAT_S)
        finally:
            if self._line is line:
                self._drop(line.socket)
        log.warning("PostgreSQL no longer tells of changes; until it does, every request looks for them.")

    def _take_in(self, line: "PGconn", socket: int) -> None:
        """Read what has arrived."""
        try:
            line.consume_input()
        except self._broken:
            self._drop(socket)
            return
        while (told := line.notifies()) is not None:
            if told.relname == self._own.encode():
                self._known_s = self._beat_s
            else:
                self._version = next(self._counter)
        while not line.is_busy() and line.get_result() is not None:
            pass  # that a beat was sent; it counts when it comes back

    def _drop(self, socket: int) -> None:
        """Look at the line no more, at once: another's socket may soon have the same number."""
        asyncio.get_running_loop().remove_reader(socket)
        self._line = None
