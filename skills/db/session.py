"""Sessions on the database, its disk, and the revision of its tables: a SQLite file or PostgreSQL, by URL.

`reading()` and `writing()` yield a session that is one transaction; `writing()` commits if its block ends without an
exception. A reading one sees one consistent state from beginning to end.

A writing transaction takes all its locks at its beginning, so that concurrent writers wait for each other instead of
failing midway or overwriting each other's changes. On SQLite that is the file's single write lock (BEGIN IMMEDIATE). On
PostgreSQL there are locks of two granularities, as Gray et al. ("Granularity of locks in a shared data base", VLDB
1975) describe them: `writing()` locks the whole database, alone; `writing(names)` shares the database with others of
its kind, and locks the named things, in an order that is the same for all. So two transactions wait for each other if
they name the same thing, or if one of them names nothing; and none of them can deadlock with another over these locks.
A transaction that names things may only rely on what is under these names (`skills.library.locks`), and must be short,
because one that locks everything waits for it, and later ones wait for that.

Nothing is retried here except connecting, before any statement was sent. A caller that loses the database during a
transaction gets `Busy`, and does not know whether its changes were committed. It may repeat the request: uploads, jobs
and releases are identified by their content, so a repeated one is found or stored, and never stored twice.

A full disk is reported as such (`StorageFull`); earlier data stay valid, and requests succeed again once there is
space. A write or fsync that fails is different: the operating system may have dropped data that SQLite and this process
assume to be stored, and a second fsync would report success. So the process exits, with `EXIT_CODE`, and the next
process reads what is really stored (Rebello et al., "Can Applications Recover from fsync Failures?", USENIX ATC 2020).

Alembic runs the migrations of the tables and is imported only for them: to check that tables are up to date, as every
start does, does not need it. A migration is in a file named after its revision, "0001_what_it_does.py"; revisions are
ordered by number.
"""

import hashlib
import logging
import os
import sqlite3
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from copy import copy
from functools import cache
from importlib import resources
from pathlib import Path
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any, Literal, NoReturn, Self

from sqlalchemy import URL, Connection, Dialect, Engine, create_engine, event, inspect, text
from sqlalchemy.engine import ExceptionContext, make_url
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.exc import ArgumentError, DatabaseError, DBAPIError, OperationalError, TimeoutError
from sqlalchemy.orm import Session, sessionmaker
from sqlalchemy.pool import ConnectionPoolEntry

from skills.db.history import CHECKPOINTS, FORGET_NOTES, HISTORY, NOTING, NOTING_CONNECTION, History
from skills.db.row_visibility import ONLY, Only
from skills.db.tiles import fill_tiles
from skills.errors import BadSettings, Busy, Conflict, Corrupt, DatabaseUnusable, SkillsError, StorageFull
from skills.remedies import Action, Remedy
from skills.settings import Settings, settings

if TYPE_CHECKING:
    from alembic.config import Config

BUSY_TIMEOUT_MS = 10_000
# With wal_level=minimal PostgreSQL does not log what a transaction does to a sequence that it makes, nor the next 32
# numbers: after a crash they would be given again. Setting a sequence to where it stands is always logged.
LOG_SEQUENCES = (
    "SELECT setval(format('%I.%I', schemaname, sequencename)::regclass, last_value) FROM pg_sequences "
    "WHERE schemaname = current_schema() AND last_value IS NOT NULL"
)
WRITE_LOCK = 0x5C111  # ours: the number of the advisory lock of everything, an arbitrary unused one
WAL_LIMIT_BYTES = 64 << 20  # without a limit the write-ahead log stays as large as the largest upload
KEPT_OPEN, AT_ONCE = 10, 40  # connections; 40 threads handle requests (Starlette's default), and each needs one
RESTART_S = 3.0  # timeout for a server that refuses connections, as while restarting; most are back within 1 s
AGAIN_S = 0.1  # between two attempts to connect
SPELLING = (
    "Write SKILLS_DATABASE_URL as sqlite:////folder/skills.sqlite or postgresql://user:password@host:5432/database."
)
STARTED = "Start it, or correct SKILLS_DATABASE_URL."
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
MIGRATIONS = resources.files("skills") / "migrations"
AT = "alembic_version"  # Alembic's own table of one row
EXIT_CODE = 74  # EX_IOERR of sysexits.h
POSTGRESQL_FULL, POSTGRESQL_FAILED = "53100", "58030"  # disk_full, io_error
# SQLite's codes for a full disk; the index of the write-ahead log cannot grow on one either.
_FULL = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_SHMSIZE)
# I/O errors that leave the stored data unchanged: reading, memory, locks.
_HARMLESS = (
    *(sqlite3.SQLITE_IOERR_READ, sqlite3.SQLITE_IOERR_SHORT_READ, sqlite3.SQLITE_IOERR_NOMEM),
    *(sqlite3.SQLITE_IOERR_BLOCKED, sqlite3.SQLITE_IOERR_LOCK, sqlite3.SQLITE_IOERR_RDLOCK),
    *(sqlite3.SQLITE_IOERR_CHECKRESERVEDLOCK, sqlite3.SQLITE_IOERR_ACCESS, sqlite3.SQLITE_IOERR_GETTEMPPATH),
)

log = logging.getLogger(__name__)


class Database:
    """Sessions on one database; thread-safe."""

    def __init__(
        self,
        url: str,
        *,
        patience_ms: int | None = None,
        signing_key: Path | None = None,
        checkpoints: Path | None = None,
    ) -> None:
        """Open a database; it connects on first use.

        Args:
            url: SQLAlchemy URL of a SQLite file or a PostgreSQL database.
            patience_ms: Timeout for locks and for connections, `BUSY_TIMEOUT_MS` by default.
            signing_key: The file of the key that its history is written with, by default of `SKILLS_SIGNING_KEY`.
            checkpoints: The file of its kept heads, by default of `SKILLS_CHECKPOINTS`, or else beside the key.

        Raises:
            BadSettings: The URL is not one of these, or the folder of the file cannot be created.
            DatabaseUnusable: The file cannot be opened or created, or is not a SQLite database.
        """
        self.url = url
        self.engine = _open(url, patience_ms or BUSY_TIMEOUT_MS)
        self.history = History(
            self.engine, signing_key or settings().signing_key, checkpoints or settings().checkpoints
        )
        self._sessions = sessionmaker(self.engine, expire_on_commit=False, info={HISTORY: self.history})
        self._condition: tuple[Callable[[Session], None], Sequence[str]] = (lambda _: None), ()

    @classmethod
    def of(cls, settings: Settings, *, patience_ms: int | None = None) -> Self:
        """Open the database of an installation."""
        files = {"signing_key": settings.signing_key, "checkpoints": settings.checkpoints}
        return cls(settings.database_url, patience_ms=patience_ms, **files)

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """Open a session that reads one consistent state."""
        with self._in_words(), self._sessions() as session:
            yield session

    @contextmanager
    def writing(self, names: Iterable[str] | None = None) -> Iterator[Session]:
        """Open a session whose block is one transaction, committed if it ends without an exception.

        What it has changed is added to the history at its end.

        Args:
            names: What it changes or relies on, see `skills.library.locks`: transactions with a common name run one
                after the other. None: everything. No names: changes that are decided by a single statement each.
        """
        check, further = self._condition
        locks = True if names is None else tuple(sorted({_number(name) for name in (*names, *further)}))
        bind = self.engine.execution_options(writes=locks)
        with self._in_words(), self._sessions(bind=bind) as session, session.begin():
            check(session)
            yield session
            if session.in_transaction():  # otherwise the block has undone its changes
                session.flush()
                self.history.settle(session.connection())

    def seen_by(self, only: Only | None) -> "Database":
        """Return this database restricted to the rows that a caller may see; None: without restriction."""
        if only is None:
            return self
        narrowed = copy(self)
        narrowed._sessions = sessionmaker(self.engine, expire_on_commit=False, info={HISTORY: self.history, ONLY: only})
        return narrowed

    def compare_history(self) -> None:
        """Compare the database with its signing key and its kept head; see `History.compare`.

        Raises:
            NotReady: It is not the database that was signed last.
        """
        kept = self.history.kept_head()
        with self.reading() as session:
            self.history.compare(session.connection(), kept)

    def on_condition(self, check: Callable[[Session], None], names: Sequence[str]) -> "Database":
        """Return this database with a check at the beginning of each writing transaction, which may refuse it.

        Args:
            check: It raises an error where the transaction must not take place.
            names: What the check relies on, in addition to the names of each transaction.
        """
        checked = copy(self)
        checked._condition = check, names
        return checked

    def migrate(self) -> None:
        """Migrate the tables to this version, from an empty database or any older version.

        Raises:
            NotReady: They would be changed, and it is not the database that was signed last.
            Conflict: The database was written by a newer version of the code.
            Busy: It cannot be reached or written.
            BadSettings: The signing key of its history is missing, or cannot be made.
        """
        with self._in_words(), self.engine.execution_options(writes=True).connect() as connection:
            before = revision_of(connection)
            if before != revisions()[0] and inspect(connection).has_table(CHECKPOINTS.name):
                self.history.compare(connection, self.history.kept_head())
            upgrade(connection)
            self.history.begin(connection)
            if before != revisions()[0]:
                self.history.settle(connection)
                self.history.log_schema(connection)
                fill_tiles(connection)
            connection.commit()
        if before != revisions()[0] and self.engine.dialect.name == "postgresql":
            with self.writing() as session:
                session.execute(text(LOG_SEQUENCES))

    def forget(self) -> None:
        """Remove deleted data from SQLite's write-ahead log; call it after the commit.

        It waits for readers of the log, up to the busy timeout; after that the data stay in the log until it is reused.
        """
        if self.engine.dialect.name != "sqlite":
            return  # PostgreSQL's vacuum does it
        with self._in_words(), self.engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")

    def close(self) -> None:
        """Close all connections; one that a thread still uses is closed when the thread returns it."""
        event.listen(self.engine.pool, "checkin", _close_returned)  # to a pool that nobody disposes of any more
        self.engine.dispose()

    def _in_words(self) -> AbstractContextManager[None]:
        return _in_words(self.engine.url)


def _close_returned(_connection: DBAPIConnection | None, entry: ConnectionPoolEntry) -> None:
    entry.close()


@contextmanager
def _in_words(url: URL) -> Iterator[None]:
    """Translate SQLAlchemy's exceptions for an unusable database into `SkillsError`s with a remedy."""
    try:
        yield
    except TimeoutError as error:
        raise Busy("The database is overloaded; try again in a moment.") from error
    except OperationalError as error:
        if is_full(error):
            log.error("The database's disk is full: %s", str(error.orig).strip())
            raise StorageFull(
                "The disk of the database is full, so nothing was stored; free some space on it."
            ) from error
        if getattr(error.orig, "sqlstate", None) == POSTGRESQL_FAILED:
            log.critical("The disk of the PostgreSQL server failed: %s", str(error.orig).strip())
            raise Busy(
                "The disk of the database failed, so it is unknown whether this was stored.",
                "Ask the operator of the service to check the disk and its log, then look before you try again.",
            ) from error
        if "no such table" in str(error.orig):
            raise Conflict("The database has no tables of this version yet.", Remedy(Action.MIGRATE)) from error
        if (unusable := _unusable(url, error)) is not None:
            raise unusable from error
        if getattr(error.orig, "sqlite_errorcode", None) == sqlite3.SQLITE_ERROR:
            raise  # a wrong statement, which would fail again: a bug
        log.warning("The database could not be used: %s", str(error.orig).strip())
        raise Busy("The database cannot be used now; try again in a moment.") from error
    except DatabaseError as error:
        if (unusable := _unusable(url, error)) is not None:
            raise unusable from error
        raise


def _unusable(url: URL, error: DBAPIError) -> SkillsError | None:
    """Return the error for a database that cannot be used at all, without its password.

    Returns:
        None where the database was reached and is only busy.
    """
    code = getattr(error.orig, "sqlite_errorcode", None)
    if code is not None:
        if code & 0xFF == sqlite3.SQLITE_CORRUPT:
            return Corrupt("The file of the database is damaged.", "Restore a backup into another file.")
        reason = UNUSABLE.get(code & 0xFF)
        return None if reason is None else DatabaseUnusable(f"The database {url.database} {reason[0]}.", reason[1])
    if url.get_backend_name() == "sqlite" or error.statement is not None or error.connection_invalidated:
        return None
    said = str(error.orig)
    at = url.query.get("host") or f"{url.host or 'localhost'}:{url.port or 5432}"  # a folder with a socket, or a host
    if "password" in said or "authentication" in said:
        return DatabaseUnusable(f"The PostgreSQL server at {at} does not let the user '{url.username}' in.", SPELLING)
    if f'database "{url.database}" does not exist' in said:
        return DatabaseUnusable(
            f"The PostgreSQL server at {at} has no database '{url.database}'.", "Create it with createdb."
        )
    if "starting up" in said or "shutting down" in said or "too many" in said:
        return None
    return DatabaseUnusable(f"The database cannot be reached: no PostgreSQL server answers at {at}.", STARTED, SPELLING)


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


def _open(url: str, patience_ms: int) -> Engine:
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


def _forgotten(connection: Connection) -> bool:
    """Delete the notes for the history that others have left; return whether there is a history."""
    try:
        connection.connection.cursor().execute(FORGET_NOTES)
    except sqlite3.OperationalError as error:
        if "no such table" not in str(error):
            raise
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


def _pool(patience_ms: int) -> dict[str, Any]:
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


def _number(name: str) -> int:
    """Return the number of the lock of a name: 63 bits of its digest, never one of a lock of another use."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") >> 1 | 1 << 62


# ---- the disk --------------------------------------------------------------------------------------------------------


def make_private(database: Path) -> None:
    """Create a SQLite file that only this user can read, or restrict the permissions of an existing one.

    A new file has mode 0600, and a new folder 0700; SQLite gives its auxiliary files the permissions of the database.
    Wider permissions of an existing file are restricted, which is logged; an existing folder is left alone, because it
    may hold other files.
    """
    database.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    for path in (database, *(Path(f"{database}{ending}") for ending in ("-wal", "-shm"))):
        try:
            mode = stat.S_IMODE(path.stat().st_mode)
        except FileNotFoundError:
            continue
        if mode & 0o077:
            try:
                path.chmod(0o600)
                log.warning("%s could be read by others; its permissions are 0600 now.", path.name)
            except PermissionError:
                log.warning("%s can be read by others and belongs to another user; run chmod 600 on it.", path.name)
    with suppress(FileExistsError):  # never opened where it exists: see `_is_anothers`
        os.close(os.open(database, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600))


def is_full(error: DBAPIError) -> bool:
    """Return whether a statement failed because the database's disk is full."""
    code = getattr(error.orig, "sqlite_errorcode", None)
    return code in _FULL or getattr(error.orig, "sqlstate", None) == POSTGRESQL_FULL


def is_failed(error: BaseException | None) -> bool:
    """Return whether SQLite failed to write, or does not know whether it has written.

    No cached state of this process can be trusted then.
    """
    code = getattr(error, "sqlite_errorcode", None)
    if code is None or code & 0xFF != sqlite3.SQLITE_IOERR:
        return False
    return code not in _FULL and code not in _HARMLESS


def end_process(error: BaseException) -> NoReturn:
    """Exit this process at once, without rollbacks, flushing of caches or exit handlers."""
    name = getattr(error, "sqlite_errorname", "")
    log.critical(
        "The database's disk failed (%s, %s). The last writes may be lost, so this process ends; check the disk, "
        "run `skills verify`, and start again.",
        name,
        error,
    )
    logging.shutdown()
    os._exit(EXIT_CODE)


@event.listens_for(Engine, "handle_error")
def _end_on_failure(context: ExceptionContext) -> None:
    """Check the errors of every engine in this process, including the job engine's."""
    if is_failed(context.original_exception):
        end_process(context.original_exception)


# ---- the revision of the tables --------------------------------------------------------------------------------------


def alembic_config() -> "Config":
    """Return an Alembic configuration that points to our migrations."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    return config


@cache
def revisions() -> tuple[str, ...]:
    """Return the revisions that this version knows, newest first."""
    files = (file.name for file in (MIGRATIONS / "versions").iterdir() if file.name.endswith(".py"))
    return tuple(sorted((name.partition("_")[0] for name in files), reverse=True))


def revision_of(connection: Connection) -> str | None:
    """Return the revision of the tables; None where there are none."""
    if not inspect(connection).has_table(AT):
        return None
    revision: str | None = connection.scalar(text(f"SELECT version_num FROM {AT}"))  # noqa: S608 - a name of ours
    return revision


def refuse_other_tables(connection: Connection) -> None:
    """Refuse a database whose tables are not of this version.

    Raises:
        Conflict: They are older, newer, or missing.
    """
    current = revision_of(connection)
    _refuse_newer(current)
    if current != revisions()[0]:
        raise Conflict("The database has no tables of this version yet.", Remedy(Action.MIGRATE))


def upgrade(connection: Connection, to: str = "head") -> None:
    """Migrate the tables to a revision, within the caller's transaction.

    Raises:
        Conflict: They are of a newer version of the code.
    """
    current = revision_of(connection)
    _refuse_newer(current)
    if to == "head" and current == revisions()[0]:
        return
    from alembic import command  # imported here: it is slow, and rarely needed

    config = alembic_config()
    config.attributes["connection"] = connection
    command.upgrade(config, to)


def _refuse_newer(current: str | None) -> None:
    if current is not None and current not in revisions():
        raise Conflict(
            "This database was written by a newer version of suture-skills; nothing was changed.",
            "Update the code, or name another database in SKILLS_DATABASE_URL.",
        )
