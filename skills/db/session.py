"""Sessions on the database, a SQLite file or PostgreSQL, by URL.

`reading()` and `writing()` yield a session that is one transaction; `writing()` commits if its block ends without an
exception. A reading one sees one consistent state from beginning to end.

A writing transaction takes all its locks at its beginning, so that concurrent writers wait for each other instead of
failing midway or overwriting each other's changes. On SQLite that is the file's single write lock (BEGIN IMMEDIATE). On
PostgreSQL there are locks of two granularities, as Gray et al. ("Granularity of locks in a shared data base", VLDB
1975) describe them: `writing()` locks the whole database, alone; `writing(names)` shares the database with others of
its kind, and locks the named things, in an order that is the same for all. So two transactions wait for each other if
they name the same thing, or if one of them names nothing; and none of them can deadlock with another over these locks.
A transaction that names things may only rely on what is under these names (`skills.library.operation.locks`), and must
be short, because one that locks everything waits for it, and later ones wait for that.

Nothing is retried here except connecting, before any statement was sent. A caller that loses the database during a
transaction gets `DatabaseBusy`, and does not know whether its changes were committed. It may repeat the request:
uploads, jobs and releases are identified by their content, so a repeated one is found or stored, and never stored
twice.
"""

import logging
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from copy import copy
from pathlib import Path
from typing import Self

from sqlalchemy import URL, event, inspect, text
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.exc import DatabaseError, DBAPIError, OperationalError, TimeoutError
from sqlalchemy.orm import Session, sessionmaker
from sqlalchemy.pool import ConnectionPoolEntry

from skills.db.disk import POSTGRESQL_FAILED, Reserve, is_full
from skills.db.engines import BUSY_TIMEOUT_MS, SPELLING, UNUSABLE, lock_number, open_engine, open_for_statements
from skills.db.history import HISTORY, History
from skills.db.leaves import CHECKPOINTS
from skills.db.revisions import refuse_unknown, revision_of, revisions, upgrade
from skills.db.row_visibility import ONLY, Only
from skills.db.tiles import fill_tiles
from skills.errors import Conflict, Corrupt, DatabaseBusy, DatabaseUnusable, SkillsError, StorageFull
from skills.remedies import Action, Remedy
from skills.settings import Settings, settings

# With wal_level=minimal PostgreSQL does not log what a transaction does to a sequence that it makes, nor the next 32
# numbers: after a crash they would be given again. Setting a sequence to where it stands is always logged.
LOG_SEQUENCES = (
    "SELECT setval(format('%I.%I', schemaname, sequencename)::regclass, last_value) FROM pg_sequences "
    "WHERE schemaname = current_schema() AND last_value IS NOT NULL"
)
STARTED = "Start it, or correct SKILLS_DATABASE_URL."

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
            checkpoints: The file of its saved heads, by default of `SKILLS_CHECKPOINTS`, or else beside the key.

        Raises:
            BadSettings: The URL is not one of these, or the folder of the file cannot be created.
            DatabaseUnusable: The file cannot be opened or created, or is not a SQLite database.
        """
        self.url = url
        self.engine = open_engine(url, patience_ms or BUSY_TIMEOUT_MS)
        self.statements = open_for_statements(url)
        self.history = History(
            self.engine, signing_key or settings().signing_key, checkpoints or settings().checkpoints
        )
        self._sessions = sessionmaker(self.engine, expire_on_commit=False, info={HISTORY: self.history})
        file = self.engine.url.database if self.engine.dialect.name == "sqlite" else None
        self._reserve = None if file is None else Reserve(Path(file))
        self._condition: tuple[Callable[[Session], None], Sequence[str]] = (lambda _: None), ()

    @classmethod
    def of(cls, settings: Settings, *, patience_ms: int | None = None) -> Self:
        """Open the database of an installation."""
        files = {"signing_key": settings.signing_key, "checkpoints": settings.checkpoints}
        return cls(settings.database_url, patience_ms=patience_ms, **files)

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """Open a session that reads one consistent state."""
        with translating_errors(self.engine.url), self._sessions() as session:
            yield session

    @contextmanager
    def ending(self, names: Iterable[str] | None = None) -> Iterator[Session]:
        """Open a session as `writing` does, to withdraw, revoke or erase: on SQLite it succeeds on a full disk too."""
        with ExitStack() as after, self.writing(names) as session:
            session.connection()  # takes the write lock
            if self._reserve is not None:
                after.enter_context(self._reserve.released())  # and allocated again after the commit
            yield session

    @contextmanager
    def writing(self, names: Iterable[str] | None = None) -> Iterator[Session]:
        """Open a session whose block is one transaction, committed if it ends without an exception.

        What it has changed is added to the history at its end.

        Args:
            names: What it changes or relies on, see `skills.library.operation.locks`: transactions with a common name
                run one after the other. None: everything. No names: changes that are decided by one statement each.
        """
        check, further = self._condition
        locks = True if names is None else tuple(sorted({lock_number(name) for name in (*names, *further)}))
        bind = self.engine.execution_options(writes=locks)
        with translating_errors(self.engine.url), self._sessions(bind=bind) as session, session.begin():
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
        """Compare the database with its signing key and its saved head; see `History.compare`.

        Raises:
            NotReady: It is not the database that was signed last.
        """
        saved = self.history.saved_head()
        with self.reading() as session:
            self.history.compare(session.connection(), saved)

    def on_condition(self, check: Callable[[Session], None], names: Sequence[str]) -> "Database":
        """Return this database with a check at the beginning of each writing transaction, which may refuse it.

        Args:
            check: It raises an error where the transaction must not take place.
            names: What the check relies on, in addition to the names of each transaction.
        """
        checked = copy(self)
        checked._condition = check, names
        return checked

    def migrate(self) -> bool:
        """Migrate the tables to this version, from an empty database or any older version since 0.3.0.

        Returns:
            Whether that changed anything.

        Raises:
            NotReady: They would be changed, and it is not the database that was signed last.
            Conflict: The database was made by a newer version of the code, or by another commit before a release.
            DatabaseBusy: It cannot be reached or written.
            BadSettings: The signing key of its history is missing, or cannot be made.
        """
        with translating_errors(self.engine.url), self.engine.execution_options(writes=True).connect() as connection:
            before = revision_of(connection)
            refuse_unknown(before)
            if before != revisions()[0] and inspect(connection).has_table(CHECKPOINTS.name):
                self.history.compare(connection, self.history.saved_head())
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
        self.reserve_space()
        return before != revisions()[0]

    def reserve_space(self) -> None:
        """Allocate the space that `ending` uses on a full disk; on PostgreSQL the operator provides it."""
        if self._reserve is not None:
            self._reserve.allocate()

    def forget(self) -> None:
        """Remove deleted data from SQLite's write-ahead log; call it after the commit.

        It waits for readers of the log, up to the busy timeout; after that the data stay in the log until it is reused.
        """
        if self._reserve is None:
            return  # PostgreSQL's vacuum does it
        engine = self.engine.execution_options(isolation_level="AUTOCOMMIT")
        with translating_errors(self.engine.url), engine.connect() as connection, self._reserve.released():
            connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")

    def close(self) -> None:
        """Close all connections; one that a thread still uses is closed when the thread returns it."""
        event.listen(self.engine.pool, "checkin", _close_returned)  # to a pool that nobody disposes of any more
        self.engine.dispose()
        self.statements.dispose()


def _close_returned(_connection: DBAPIConnection | None, entry: ConnectionPoolEntry) -> None:
    entry.close()


@contextmanager
def translating_errors(url: URL) -> Iterator[None]:
    """Translate SQLAlchemy's exceptions for an unusable database into `SkillsError`s with a remedy."""
    try:
        yield
    except TimeoutError as error:
        raise DatabaseBusy("The database is overloaded; try again in a moment.") from error
    except OperationalError as error:
        if is_full(error):
            log.error("The database's disk is full: %s", str(error.orig).strip())
            raise StorageFull(
                "The disk of the database is full, so nothing was stored; free some space on it."
            ) from error
        if getattr(error.orig, "sqlstate", None) == POSTGRESQL_FAILED:
            log.critical("The disk of the PostgreSQL server failed: %s", str(error.orig).strip())
            raise DatabaseBusy(
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
        raise DatabaseBusy("The database cannot be used now; try again in a moment.") from error
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
