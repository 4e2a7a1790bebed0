"""A database of a newer version: every command and the running service say so, and change nothing."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import text
from typer.testing import CliRunner

from skills.cli import app
from skills.db import Base
from skills.db.session import Database
from skills.settings import settings
from tests import backends
from tests.api.service import assert_problem, serving
from tests.library import cases
from tests.migrations.test_migrations import tables
from tests.waiting import END_S

REFUSED = "This database was made by another version of suture-skills"


@pytest.fixture(params=backends.BACKENDS)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """Yield a database with a released policy."""
    with backends.opened(backends.fresh(request.param, tmp_path)) as database:
        cases.add_surgeon(database)
        cases.add_demo(database)
        cases.train(database, release=True)
        yield database


@pytest.mark.parametrize("commands", [1, pytest.param(4, marks=pytest.mark.nightly)])
def test_code_that_is_older_than_the_tables_says_so_everywhere(database: Database, tmp_path: Path, commands: int):
    with serving(database.url) as service:
        become_newer(database)  # as a newer version does while this one runs
        said = assert_problem(service.http.get("/readyz"), 503, "not-ready")["detail"]
        assert said == "The database is of another version; use the code that made it, or name another database."
    before = rows(database)
    place = {"SKILLS_DATABASE_URL": database.url, "SKILLS_PORT": "0"}
    told = (
        (["serve"], REFUSED),
        (["train", "kestrel", "simple-running"], REFUSED),
        (["backup", str(tmp_path / "backup.zip")], "The tables are of another version"),
        (["verify"], "schema: it is at 9999"),
    )
    for words, said in told[:commands]:  # each takes seconds
        code, errors = run(words, place)
        assert code == 1, words
        assert said in errors, (words, errors)
        assert "Traceback" not in errors, (words, errors)
    assert rows(database) == before


@pytest.mark.nightly  # by day the service is refused
def test_a_worker_that_is_older_than_the_tables_says_so(database: Database):
    become_newer(database)
    code, errors = run(["worker"], {"SKILLS_DATABASE_URL": database.url})
    assert (code, REFUSED in errors, "Traceback" in errors) == (1, True, False), errors


def become_newer(database: Database) -> None:
    with database.writing() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))


def run(words: list[str], environment: dict[str, str]) -> tuple[int, str]:
    """Run a command, and return its exit code and its errors; only what would serve needs a process of its own."""
    if words[0] in ("serve", "worker"):
        command = [sys.executable, "-m", "skills", *words]
        process = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=END_S)
        return process.returncode, process.stderr
    settings.cache_clear()
    result = CliRunner().invoke(app, words, env={"SKILLS_SERVER": None, **environment})
    settings.cache_clear()
    return result.exit_code, result.stderr


def rows(database: Database) -> dict[str, list[str]]:
    """Read every row of every table of ours, as text."""
    with database.reading() as session:
        return {
            table: sorted(repr(row) for row in session.execute(text(f"SELECT * FROM {table}")))
            for table in sorted(tables(database) & set(Base.metadata.tables))
        }
