"""Opening the database: SQLite in one file, or PostgreSQL by its URL; the same sessions on both.

`reading()` and `writing()` give a session that is one transaction; `writing()` commits when its block ends well. A
writing transaction takes the one write lock at once (BEGIN IMMEDIATE; an advisory lock on PostgreSQL), so that two of
them wait for each other instead of failing half way or overwriting what the other has just written; a reading one sees
one state from its beginning to its end.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from sqlalchemy import URL, Connection, Engine, create_engine, event
from sqlalchemy.engine import make_url
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session, sessionmaker

from skills.db.schema import upgrade
from skills.errors import Busy, Conflict

BUSY_TIMEOUT_MS = 10_000
WRITE_LOCK = 0x5C111  # ours: the number of the advisory lock, any that nobody else uses
WAL_LIMIT_BYTES = 64 << 20  # the write-ahead log would stay as large as the largest upload


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

    def migrate(self) -> None:
        """Bring the tables to this version, from an empty database or any older one.

        Raises:
            Conflict: The database was written by a newer version of the code.
        """
        with self.engine.execution_options(writes=True).connect() as connection:
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
    except OperationalError as error:
        if "no such table" in str(error.orig):
            raise Conflict("The database has no tables of this version yet; run `skills migrate`.") from error
        raise Busy("The database cannot take this now; try again in a moment.") from error


def _open(url: str, patience_ms: int) -> Engine:
    parsed = make_url(url)
    if parsed.drivername == "postgresql":
        parsed = parsed.set(drivername="postgresql+psycopg")
    if parsed.get_backend_name() != "sqlite":
        return _open_postgresql(parsed, patience_ms)
    if parsed.database:
        Path(parsed.database).parent.mkdir(parents=True, exist_ok=True)
    engine = create_engine(parsed, connect_args={"check_same_thread": False})

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
    engine = create_engine(url, pool_pre_ping=True, connect_args=waits)

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        if connection.get_execution_options().get("writes"):
            connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({WRITE_LOCK})")
        else:
            connection.exec_driver_sql("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")

    return engine
