"""Opening the database: SQLite in one file, or PostgreSQL by its URL; the same sessions on both.

`reading()` and `writing()` give a session that is one transaction; `writing()` commits when its block ends well. A
writing transaction takes the one write lock at once (BEGIN IMMEDIATE; an advisory lock on PostgreSQL), so that two of
them wait for each other instead of failing half way or overwriting what the other has just written; a reading one sees
one state from its beginning to its end.

Nothing is tried again here but connecting, before anything was asked of the database: whoever loses it in the middle
is told `Busy`, and does not know whether what he wrote was kept. What is uploaded, asked for and released is known by
what it is, so he may send it again: it is found, or kept then, and never kept twice.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from sqlalchemy import URL, Connection, Dialect, Engine, create_engine, event
from sqlalchemy.engine import make_url
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.exc import OperationalError, TimeoutError
from sqlalchemy.orm import Session, sessionmaker

from skills.db.schema import upgrade
from skills.db.seen import ONLY, Only
from skills.errors import Busy, Conflict

BUSY_TIMEOUT_MS = 10_000
WRITE_LOCK = 0x5C111  # ours: the number of the advisory lock, any that nobody else uses
WAL_LIMIT_BYTES = 64 << 20  # the write-ahead log would stay as large as the largest upload
KEPT_OPEN, AT_ONCE = 10, 40  # connections; so many threads answer requests (Starlette's default), and each needs one
RESTART_S = 3.0  # for how long a server that does not take connections may be restarting; most are back in one
AGAIN_S = 0.1


class Database:
    """Sessions on one database."""

    def __init__(self, url: str, *, patience_ms: int | None = None) -> None:
        """Open a database; it connects when it is first used.

        Args:
            url: SQLAlchemy's, of a SQLite file or a PostgreSQL database.
            patience_ms: How long to wait for locks and for connections; `BUSY_TIMEOUT_MS` unless it is given.
        """
        self.url = url
        self.engine = _open(url, patience_ms or BUSY_TIMEOUT_MS)
        self._readers = sessionmaker(self.engine, expire_on_commit=False)
        self._writers = sessionmaker(self.engine.execution_options(writes=True), expire_on_commit=False)

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """Open a session that reads one consistent state."""
        with _in_words(), self._readers() as session:
            yield session

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """Open a session whose block is one transaction, committed if it ends well."""
        with _in_words(), self._writers.begin() as session:
            yield session

    def seen_by(self, only: Only | None) -> "Database":
        """Open sessions that find nothing but what somebody may see; None: all of it."""
        if only is None:
            return self
        narrowed = copy(self)
        narrowed._readers = sessionmaker(self.engine, expire_on_commit=False, info={ONLY: only})
        writes = self.engine.execution_options(writes=True)
        narrowed._writers = sessionmaker(writes, expire_on_commit=False, info={ONLY: only})
        return narrowed

    def migrate(self) -> None:
        """Bring the tables to this version, from an empty database or any older one.

        Raises:
            Conflict: The database was written by a newer version of the code.
            Busy: It cannot be reached or written.
        """
        with _in_words(), self.engine.execution_options(writes=True).connect() as connection:
            upgrade(connection)
            connection.commit()

    def forget(self) -> None:
        """Leave nothing of what was deleted in SQLite's write-ahead log; call it after the commit.

        While a reader holds on to the log it waits, up to the busy timeout; then the log keeps it until it is reused.
        """
        if self.engine.dialect.name != "sqlite":
            return  # the server's own vacuum does it
        with self.engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()


@contextmanager
def _in_words() -> Iterator[None]:
    """Say what a database that cannot be used right now means."""
    try:
        yield
    except TimeoutError as error:
        raise Busy("The database has too much to do; try again in a moment.") from error
    except OperationalError as error:
        if "no such table" in str(error.orig):
            raise Conflict("The database has no tables of this version yet; run `skills migrate`.") from error
        if getattr(error.orig, "sqlite_errorcode", None) == sqlite3.SQLITE_ERROR:
            raise  # a statement that is wrong, and will be wrong in a moment too
        raise Busy("The database cannot take this now; try again in a moment.") from error


def _open(url: str, patience_ms: int) -> Engine:
    parsed = make_url(url)
    if parsed.drivername == "postgresql":
        parsed = parsed.set(drivername="postgresql+psycopg")
    if parsed.get_backend_name() != "sqlite":
        return _open_postgresql(parsed, patience_ms)
    if parsed.database:
        Path(parsed.database).parent.mkdir(parents=True, exist_ok=True)
    engine = create_engine(parsed, connect_args={"check_same_thread": False}, **_pool(patience_ms))

    @event.listens_for(engine, "connect")
    def _prepare(connection: Any, _record: object) -> None:
        connection.isolation_level = None  # the driver would begin transactions by its own rules
        for pragma in (
            f"busy_timeout={patience_ms}",
            "synchronous=FULL",
            "foreign_keys=ON",
            "secure_delete=ON",
            f"journal_size_limit={WAL_LIMIT_BYTES}",
        ):
            connection.execute(f"PRAGMA {pragma}")
        _write_ahead(connection, patience_ms)

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        connection.exec_driver_sql("BEGIN IMMEDIATE" if connection.get_execution_options().get("writes") else "BEGIN")

    return engine


def _pool(patience_ms: int) -> dict[str, Any]:
    """Say how many connections there may be, and how long to wait for one of them."""
    return {"pool_size": KEPT_OPEN, "max_overflow": AT_ONCE - KEPT_OPEN, "pool_timeout": patience_ms / 1000}


class Returning:
    """A server that may be restarting: whoever connects waits for it, but no longer than a restart takes.

    The time runs from the first refusal, for all threads together. So when the server stays away, nobody waits any
    more: threads that wait for what is down would be missed where something else could be answered.
    """

    def __init__(self, patience_s: float) -> None:
        self._patience_s = patience_s
        self._away_since_s: float | None = None

    def connect(self, dialect: Dialect, _record: object, args: tuple[Any, ...], how: dict[str, Any]) -> DBAPIConnection:
        """Connect, as an engine's `do_connect`.

        Raises:
            OperationalError: The driver's; the server has been away for too long.
        """
        while True:
            try:
                connection = dialect.connect(*args, **how)
            except dialect.loaded_dbapi.OperationalError:
                since_s = self._away_since_s = self._away_since_s or monotonic()
                if monotonic() - since_s >= self._patience_s:
                    raise
                sleep(AGAIN_S)
            else:
                self._away_since_s = None
                return connection


def _write_ahead(connection: sqlite3.Connection, patience_ms: int) -> None:
    """Switch a file to its write-ahead log; others that open the same new file now are waited for.

    SQLite does not wait by its busy timeout for this one change: both would hold a lock that the other needs.
    """
    deadline = monotonic() + patience_ms / 1000
    while True:
        try:
            connection.execute("PRAGMA journal_mode=WAL")
            return
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY or monotonic() > deadline:
                raise
            sleep(0.01)


def _open_postgresql(url: URL, patience_ms: int) -> Engine:
    waits = {"options": f"-c lock_timeout={patience_ms}", "connect_timeout": max(2, patience_ms // 1000)}
    engine = create_engine(url, pool_pre_ping=True, connect_args=waits, **_pool(patience_ms))
    event.listen(engine, "do_connect", Returning(min(RESTART_S, patience_ms / 1000)).connect)

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        if connection.get_execution_options().get("writes"):
            connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({WRITE_LOCK})")
        else:
            connection.exec_driver_sql("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")

    return engine
