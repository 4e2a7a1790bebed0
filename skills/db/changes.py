"""Detection of changes to served policies, checked at every request without reading a table.

`Changes.version()` is a number: as long as it stays the same, no commit has changed the served policies. Callers read
it before they read the tables, never after. None means that changes cannot be detected now, so the tables must be read.
An instance belongs to one event loop and is used on its thread only.

On SQLite it is `PRAGMA data_version` of a connection that never writes, outside any transaction. Every commit changes
it, including a worker's heartbeat, and it includes every commit that finished before the call.

On PostgreSQL it counts the notifications that have arrived at a listening connection, and the commits of this process.
A commit of another process is noticed shortly after it, and never later than `BOUND_S`, even if the connection fails:
the listener sends itself a heartbeat, which returns in order with the notifications; if the last one that returned was
sent longer ago than that, the version is None. While nobody asks for the version there are no heartbeats.
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
BEAT_S = 0.5  # interval of heartbeats; each is a transaction of the server
BOUND_S = 1.5  # two heartbeats may be late; after that the tables are read at every request
GIVEN_UP_S = 5  # a connection without heartbeats for this long is replaced
AGAIN_S = 0.5  # between two attempts to connect
APPLICATION = "suture-skills listening"  # its name in pg_stat_activity
log = logging.getLogger(__name__)


def announce(session: Session) -> None:
    """Notify all services that served policies have changed, when the caller's transaction commits.

    Every function that releases, withdraws or erases calls this. SQLite needs no notification, since `PRAGMA
    data_version` shows every commit.
    """
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text(f"NOTIFY {CHANNEL}"))


class Unasked(Exception):
    """The query was not run, because the event loop would have to wait for its result."""


class Changes:
    """The interface of change detection; this base class detects nothing, so the tables are always read."""

    every_commit = False  # whether the version changes at every commit, and not only where served policies may change

    async def open(self) -> None:
        """Start watching, on this event loop."""

    async def close(self) -> None:
        """Stop watching."""

    def version(self) -> int | None:
        """Return the version of the served policies; None where it is unknown."""
        return None

    def first(self, _question: Select[*tuple[Any, ...]], _values: dict[str, object]) -> tuple[Any, ...] | None:
        """Query one row by an index on the event loop, where that takes microseconds.

        Raises:
            Unasked: It may take longer; run the query in a thread.
        """
        raise Unasked


def changes_of(database: Database) -> Changes:
    """Return the change detection for a database."""
    return InFile(database.engine) if database.engine.dialect.name == "sqlite" else Notified(database.engine)


class InFile(Changes):
    """Change detection for a SQLite file, by a dedicated read-only connection."""

    every_commit = True

    def __init__(self, engine: Engine) -> None:
        self._file = Path(engine.url.database or "")
        self._connection: sqlite3.Connection | None = None
        self._cursor: sqlite3.Cursor | None = None

    async def open(self) -> None:
        """Open the connection."""
        address = f"{self._file.resolve().as_uri()}?mode=rw"  # mode=rw does not create a missing file
        self._connection = sqlite3.connect(address, uri=True, isolation_level=None, timeout=0)
        self._cursor = self._connection.execute("PRAGMA query_only=ON")

    async def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            self._connection.close()
            self._connection = self._cursor = None

    def version(self) -> int | None:
        """Return SQLite's data version, which changes with each commit of another connection."""
        try:
            ((version,),) = self._ask("PRAGMA data_version")
        except Unasked:
            return None
        return int(version)

    def first(self, question: Select[*tuple[Any, ...]], values: dict[str, object]) -> tuple[Any, ...] | None:
        """Run the query at once: in WAL mode a reader never waits for a writer."""
        statement, given = _in_sqlite(question)
        return next(iter(self._ask(statement, given | values)), None)

    def _ask(self, statement: str, values: dict[str, object] | tuple[()] = ()) -> list[tuple[Any, ...]]:
        if self._cursor is None:
            raise Unasked
        try:
            return self._cursor.execute(statement, values).fetchall()  # fetching all rows ends its read transaction
        except sqlite3.OperationalError as error:
            raise Unasked from error


@cache
def _in_sqlite(question: Select[*tuple[Any, ...]]) -> tuple[str, dict[str, object]]:
    """Compile a query for SQLite, and return it with its bound values."""
    from sqlalchemy.dialects import sqlite

    compiled = question.compile(dialect=sqlite.dialect(paramstyle="named"))
    return str(compiled), dict(compiled.params)


class Notified(Changes):
    """Change detection on PostgreSQL, by notifications, and by a hook for the commits of this process."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._broken = engine.dialect.loaded_dbapi.Error
        self._own = f"skills_beat_{secrets.token_hex(8)}"  # the channel of the heartbeats
        self._counter = count(1)  # its steps are atomic between threads
        self._version = 0
        self._line: PGconn | None = None
        self._beat_s = self._known_s = 0.0  # when the last heartbeat was sent, and the last one that returned
        self._asked = asyncio.Event()
        self._listening: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Start listening in the background; it reconnects whenever the connection is lost."""
        event.listen(Session, "after_commit", self._committed)
        self._listening = asyncio.create_task(self._listen())

    async def close(self) -> None:
        """Stop listening and disconnect."""
        if self._listening is None:
            return
        event.remove(Session, "after_commit", self._committed)
        self._listening.cancel()
        with suppress(asyncio.CancelledError):
            await self._listening
        self._listening = None

    def version(self) -> int | None:
        """Return the number of changes seen.

        It includes all notifications that arrived before the event loop started the request.
        """
        self._asked.set()
        return None if self._line is None or monotonic() - self._known_s >= BOUND_S else self._version

    def _committed(self, session: Session) -> None:
        """Count a commit of this process, in the thread that made it, before the commit is acknowledged."""
        if session.bind is not None and session.bind.engine.pool is self._engine.pool:
            self._version = next(self._counter)

    async def _listen(self) -> None:
        """Listen, and reconnect after errors, until cancelled."""
        from psycopg import AsyncConnection  # imported here: it is slow, and not needed with SQLite

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
                log.info("Cannot listen for change notifications of PostgreSQL.", exc_info=True)
            await asyncio.sleep(AGAIN_S)

    async def _hold(self, line: "PGconn", began_s: float) -> None:
        """Use a listening connection for as long as its heartbeats return."""
        loop = asyncio.get_running_loop()
        self._version = next(self._counter)  # changes before LISTEN were not notified, so count one
        self._beat_s = self._known_s = began_s
        self._line = line
        loop.add_reader(line.socket, self._take_in, line, line.socket)
        try:
            while self._line is line and (self._known_s == self._beat_s or monotonic() - self._beat_s < GIVEN_UP_S):
                if self._known_s == self._beat_s and not line.is_busy():
                    await self._asked.wait()
                    self._asked.clear()
                    self._beat_s = monotonic()
                    line.send_query(f"NOTIFY {self._own}".encode())
                    line.flush()
                await asyncio.sleep(BEAT_S)
        finally:
            if self._line is line:
                self._drop(line.socket)
        log.warning(
            "The change notifications of PostgreSQL stopped; until they return, every request queries for changes."
        )

    def _take_in(self, line: "PGconn", socket: int) -> None:
        """Process the notifications that have arrived."""
        try:
            line.consume_input()
        except self._broken:
            self._drop(socket)
            return
        while (notified := line.notifies()) is not None:
            if notified.relname == self._own.encode():
                self._known_s = self._beat_s
            else:
                self._version = next(self._counter)
        while not line.is_busy() and line.get_result() is not None:
            pass  # the result of NOTIFY; the heartbeat counts only when it returns

    def _drop(self, socket: int) -> None:
        """Stop watching the connection's socket at once: the system may soon give its number to another socket."""
        asyncio.get_running_loop().remove_reader(socket)
        self._line = None
