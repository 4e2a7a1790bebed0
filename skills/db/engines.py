"""Engines on a SQLite file or a PostgreSQL database, as our transactions need them.

A writing transaction takes its locks at its beginning (`skills.db.session` says which).
"""

import hashlib
import sqlite3
from contextlib import closing, suppress
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Literal

from sqlalchemy import URL, Connection, Dialect, Engine, create_engine, event
from sqlalchemy.engine import make_url
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.exc import ArgumentError, OperationalError
from sqlalchemy.pool import ConnectionPoolEntry

from skills.db.change_notes import FORGET_NOTES, NOTING, NOTING_CONNECTION
from skills.db.disk import make_private
from skills.errors import BadSettings, DatabaseUnusable

BUSY_TIMEOUT_MS = 10_000
WRITE_LOCK = 0x5C111  # ours: the number of the advisory lock of everything, an arbitrary unused one
WAL_LIMIT_BYTES = 64 << 20  # without a limit the write-ahead log stays as large as the largest upload
KEPT_OPEN, AT_ONCE = 10, 40  # connections; 40 threads handle requests (Starlette's default), and each needs one
RESTART_S = 3.0  # timeout for a server that refuses connections, as while restarting; most are back within 1 s
AGAIN_S = 0.1  # between two attempts to connect
SPELLING = (
    "Write SKILLS_DATABASE_URL as sqlite:////folder/skills.sqlite or postgresql://user:password@host:5432/database."
)
UNUSABLE = {  # by SQLite's result code: the message and the remedy
    sqlite3.SQLITE_CANTOPEN: (
        "cannot be opened",
        "Check that it is a file in a folder that this user may write to, or name another in SKILLS_DATABASE_URL.",
    ),
    sqlite3.SQLITE_READONLY: (
        "cannot be written to",
        "Give this user the right to write to the file and its folder, or name another in SKILLS_DATABASE_URL.",
    ),
    sqlite3.SQLITE_NOTADB: (
        "is not an SQLite database",
        "Name another file in SKILLS_DATABASE_URL; a missing file is created.",
    ),
}


def parse_url(url: str) -> URL:
    """Parse the URL of a database.

    Raises:
        BadSettings: It is not a URL, or of a database other than SQLite or PostgreSQL. The message does not repeat it,
            because it may contain a password.
    """
    try:
        parsed = make_url(url)
    except (ArgumentError, ValueError):
        raise BadSettings("The URL of the database cannot be read.", SPELLING) from None
    if parsed.drivername in ("postgres", "postgresql"):
        return parsed.set(drivername="postgresql+psycopg")
    if parsed.drivername not in ("sqlite", "sqlite+pysqlite", "postgresql+psycopg"):
        raise BadSettings(
            f"The URL of the database begins with {parsed.drivername}://, which is not supported.", SPELLING
        )
    if parsed.drivername.startswith("sqlite") and parsed.database in (None, "", ":memory:"):
        raise BadSettings("The URL of the database names no file.", SPELLING)
    return parsed


def open_engine(url: str, patience_ms: int) -> Engine:
    """Open a database; it connects on first use.

    Args:
        url: SQLAlchemy URL of a SQLite file or a PostgreSQL database.
        patience_ms: Timeout for locks and for connections.

    Raises:
        BadSettings: The URL is not one of these, or the folder of the file cannot be created.
        DatabaseUnusable: The file cannot be opened or created, or is not a SQLite database.
    """
    parsed = parse_url(url)
    if parsed.get_backend_name() != "sqlite":
        return _open_postgresql(parsed, patience_ms)
    if parsed.database:
        _make_file(Path(parsed.database))
    engine = create_engine(parsed, connect_args={"check_same_thread": False}, **_pool(patience_ms))

    @event.listens_for(engine, "connect")
    def _prepare(connection: Any, _record: object) -> None:
        connection.isolation_level = None  # otherwise the driver begins transactions by its own rules
        for pragma in (
            f"busy_timeout={patience_ms}",
            "synchronous=FULL",  # a commit is durable; in WAL mode NORMAL may lose the last ones
            "foreign_keys=ON",
            "secure_delete=ON",  # erased data must not remain in the file
            f"journal_size_limit={WAL_LIMIT_BYTES}",
        ):
            connection.execute(f"PRAGMA {pragma}")
        write_ahead(connection, patience_ms)

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        writes = "writes" in connection.get_execution_options()
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
        if writes:  # notes of somebody who wrote past the service are not ours to log
            connection.info[NOTING] = _forgotten(connection)

    return engine


def open_for_statements(url: str) -> Engine:
    """Open a database for statements without a transaction around them, which must cost little, such as heartbeats.

    On SQLite the last ones may be lost when the machine fails.
    """
    engine = create_engine(parse_url(url), isolation_level="AUTOCOMMIT", **_pool(BUSY_TIMEOUT_MS))
    if engine.dialect.name == "sqlite":

        @event.listens_for(engine, "connect")
        def _prepare(connection: Any, _record: object) -> None:
            connection.execute(f"PRAGMA busy_timeout={BUSY_TIMEOUT_MS}")
            connection.execute("PRAGMA synchronous=NORMAL")

    return engine


def _forgotten(connection: Connection) -> bool:
    """Delete the notes for the history that others have left; return whether there is a history."""
    try:  # by the driver: SQLAlchemy would end the transaction that has just begun, in which a migration is to be whole
        connection.connection.cursor().execute(FORGET_NOTES)
    except sqlite3.OperationalError as error:
        if "no such table" not in str(error):
            raise OperationalError(FORGET_NOTES, None, error) from error
        return False
    return True


def _make_file(file: Path) -> None:
    """Create a private SQLite file, or restrict the permissions of an existing one.

    Raises:
        DatabaseUnusable: It is a folder or a file of another kind, whose permissions are not changed, or it cannot be
            created.
        BadSettings: Its folder cannot be created.
    """
    if file.is_dir():
        raise DatabaseUnusable(f"The database {file} cannot be opened.", UNUSABLE[sqlite3.SQLITE_CANTOPEN][1])
    if _is_anothers(file):  # another program's file: its permissions must not change
        reason, advice = UNUSABLE[sqlite3.SQLITE_NOTADB]
        raise DatabaseUnusable(f"The database {file} {reason}.", advice)
    try:
        make_private(file)
    except OSError as error:
        if file.parent.is_dir():
            advice = UNUSABLE[sqlite3.SQLITE_CANTOPEN][1]
            raise DatabaseUnusable(f"The database {file} cannot be created: {error.strerror}.", advice) from error
        why = "is a file" if isinstance(error, FileExistsError | NotADirectoryError) else "cannot be created"
        raise BadSettings(
            f"The folder {file.parent} of the database {why}: {error.strerror}.", "Name another in SKILLS_DATABASE_URL."
        ) from error


def _is_anothers(file: Path) -> bool:
    """Return whether a file exists and is not SQLite's.

    Only SQLite may read it: closing a descriptor of our own would drop all locks of this process on the file (POSIX,
    `fcntl`). Another process that closes the file would then take itself for the last one and delete the write-ahead
    log, to which this process goes on committing.
    """
    with suppress(sqlite3.OperationalError):  # missing, busy or unreadable: opening it reports that
        address = f"{file.absolute().as_uri()}?mode=ro"
        with closing(sqlite3.connect(address, uri=True, timeout=0)) as connection:
            try:
                connection.execute("PRAGMA schema_version")
            except sqlite3.DatabaseError as error:
                return error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_NOTADB
    return False


def _pool(patience_ms: int) -> dict[str, float]:
    """Return the engine's options for the size of the connection pool and the timeout for a connection."""
    return {"pool_size": KEPT_OPEN, "max_overflow": AT_ONCE - KEPT_OPEN, "pool_timeout": patience_ms / 1000}


class Returning:
    """Connecting to a server that may be restarting: retries, but no longer than a restart takes.

    A server that this engine has never reached is not waited for: its address is more likely wrong.

    The timeout runs from the first refusal, for all threads together. So while the server stays unavailable, no thread
    waits: threads that wait for it could not process requests that do not need the database.
    """

    def __init__(self, patience_s: float) -> None:
        self._patience_s = patience_s
        self._away_since_s: float | None = None
        self._was_there = False

    def connect(self, dialect: Dialect, _record: object, args: tuple[Any, ...], how: dict[str, Any]) -> DBAPIConnection:
        """Connect, as an engine's `do_connect` callback.

        Raises:
            OperationalError: The driver's; the server has been unavailable for too long.
        """
        while True:
            try:
                connection = dialect.connect(*args, **how)
            except dialect.loaded_dbapi.OperationalError:
                since_s = self._away_since_s = self._away_since_s or monotonic()
                if not self._was_there or monotonic() - since_s >= self._patience_s:
                    raise
                sleep(AGAIN_S)
            else:
                self._away_since_s = None
                self._was_there = True
                return connection


def write_ahead(connection: sqlite3.Connection, patience_ms: int = BUSY_TIMEOUT_MS) -> None:
    """Switch a file to WAL mode, retrying while other processes that open the same new file do the same.

    SQLite does not apply its busy timeout to this change, because both processes would hold a lock that the other
    needs.

    Raises:
        sqlite3.OperationalError: The file is locked for longer than the timeout, or cannot be used.
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
    waits = {
        "options": f"-c lock_timeout={patience_ms} {NOTING_CONNECTION}",
        "connect_timeout": max(2, patience_ms // 1000),
    }
    engine = create_engine(url, pool_pre_ping=True, connect_args=waits, **_pool(patience_ms))
    # A restart of the server must not fail the requests that connect during it.
    event.listen(engine, "do_connect", Returning(min(RESTART_S, patience_ms / 1000)).connect)

    @event.listens_for(engine, "connect")
    def _note(_connection: Any, record: ConnectionPoolEntry) -> None:
        record.info[NOTING] = True

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        locks = connection.get_execution_options().get("writes")
        if locks is None:
            connection.exec_driver_sql("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")
        else:
            connection.exec_driver_sql(_taking(locks))

    return engine


def _taking(locks: Literal[True] | tuple[int, ...]) -> str:
    """Return the statements, sent together, that take the locks of a writing transaction, the one of everything first.

    The transaction is of the level READ COMMITTED, so its later statements see all that was committed before it got
    its last lock.
    """
    if locks is True:
        return f"SELECT pg_advisory_xact_lock({WRITE_LOCK})"
    each = [f"SELECT pg_advisory_xact_lock({number})" for number in locks]
    return "; ".join([f"SELECT pg_advisory_xact_lock_shared({WRITE_LOCK})", *each])


def lock_number(name: str) -> int:
    """Return the number of the lock of a name: 63 bits of its digest, never one of a lock of another use."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") >> 1 | 1 << 62
