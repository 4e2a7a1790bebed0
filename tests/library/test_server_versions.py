"""A database that `pg_dump` has moved to another major version of PostgreSQL: whole, and guarded as before."""

import subprocess
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import pytest
from sqlalchemy import Connection, create_engine, text

from skills.db.session import Database
from skills.library.operation.history import Verified, sign_history, verify_history
from tests import backends
from tests.by_day import some
from tests.db.test_tables import fill
from tests.library.test_history import wrong_in

OLDER, NEWER = 16, 18  # of the servers that the tests' package carries
# What a change of the tables means, and the object that is then named.
CHANGES = [
    ("ALTER TABLE jobs ALTER COLUMN kind DROP NOT NULL", "schema table jobs"),
    ("ALTER TABLE calibrations ALTER COLUMN sha256 TYPE varchar(65)", "schema table calibrations"),
    ("ALTER TABLE jobs ALTER COLUMN kind SET DEFAULT 'training'", "schema table jobs"),
    ("ALTER TABLE jobs ADD COLUMN extra text", "schema table jobs"),
    ("ALTER TABLE jobs DROP CONSTRAINT ck_jobs_state, ADD CONSTRAINT ck_jobs_state CHECK "
     "(state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled', 'gone'))",
     "schema constraint jobs ck_jobs_state"),
    ("ALTER TABLE releases DISABLE TRIGGER releases_append_only", "schema trigger releases releases_append_only"),
    ("DROP INDEX uq_jobs_identity_live", "schema index uq_jobs_identity_live"),
    ("CREATE OR REPLACE FUNCTION skills_append_only() RETURNS trigger LANGUAGE plpgsql AS "
     "$$ BEGIN RETURN NEW; END $$", "schema function skills_append_only"),
]  # fmt: skip


@pytest.fixture(scope="module")
def servers() -> Iterator[dict[int, Any]]:
    servers = {major: backends.new_server(postgres_version=major) for major in (OLDER, NEWER)}
    yield servers
    for one in servers.values():
        one.cleanup()


def blank(server: Any, name: str) -> None:
    engine = create_engine(server.get_uri(database="postgres", driver="psycopg"), isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name}"))
    engine.dispose()


@contextmanager
def database_on(server: Any, name: str) -> Iterator[Database]:
    with closing(Database(server.get_uri(database=name, driver="psycopg"))) as database:
        yield database


def move(name: str, here: Any, there: Any, newest: Any) -> None:
    """Move a database to another server by the tools of the newest version, as PostgreSQL's manual advises."""
    dump = [newest.bin_path / "pg_dump", "--no-owner", here.get_uri(database=name)]
    copied = subprocess.run(dump, check=True, capture_output=True).stdout
    lines = [line for line in copied.splitlines(keepends=True) if not line.startswith(b"SET transaction_timeout")]
    blank(there, name)
    load = [newest.bin_path / "psql", "-q", "-v", "ON_ERROR_STOP=1", there.get_uri(database=name)]
    subprocess.run(load, check=True, capture_output=True, input=b"".join(lines))


@pytest.mark.needs("postgresql")
@pytest.mark.parametrize("majors", some([((OLDER, NEWER),), ((NEWER, OLDER),)], 2))
def test_a_database_moved_to_another_major_is_whole_and_guarded(servers: dict[int, Any], majors: tuple[int, int]):
    here, there = (servers[major] for major in majors)
    name = f"from{majors[0]}"
    blank(here, name)
    with database_on(here, name) as database:
        database.migrate()
        fill(database)
        sign_history(database)
        assert wrong_in(database) == []
    move(name, here, there, servers[NEWER])
    with database_on(there, name) as database:
        assert wrong_in(database) == []
        with database.engine.connect() as connection:
            assert found_after_each(connection, database) == [named for _, named in CHANGES]
    with database_on(there, name) as database:
        database.migrate()
        assert wrong_in(database) == []


def found_after_each(connection: Connection, database: Database) -> list[str]:
    """Return the object that is named after each change, which is undone."""
    names = []
    for statement, _ in CHANGES:
        connection.exec_driver_sql(statement)
        names += [name for name, _ in verify_history(connection, database.history, (), Verified())]
        connection.rollback()
    return names
