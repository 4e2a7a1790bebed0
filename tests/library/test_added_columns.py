"""A migration that adds columns to every logged table of a database with rows: their history goes on."""

import shutil
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import Column, Integer, MetaData, String, inspect, text, update
from sqlalchemy.exc import DatabaseError

from skills.db import Base, now
from skills.db import revisions as revisions_module
from skills.db.leaves import LEAVES, latest_leaves
from skills.db.logged_rows import ADDED, Logged, logged
from skills.db.revisions import revisions, upgrade
from skills.db.session import Database
from skills.library.operation.backup import back_up, restore
from skills.library.operation.erasure_list import NOTHING
from skills.library.operation.history import newest_checkpoint, sign_history
from skills.library.operation.proofs import head_over, served_at
from tests import backends
from tests.db.test_tables import FROZEN, WITHDRAWABLE, fill
from tests.independent_history import check_disclosed
from tests.library import cases
from tests.library.attacks import found, tampering
from tests.library.test_history import wrong_in

BEFORE = {"remark": None, "count": 7}  # the new columns, with their value in the rows that there were
MIGRATION = """
import sqlalchemy as sa
from alembic import op
from skills.db.logged_rows import logged
from skills.migrations.noting import note_changes

revision, down_revision = "9999", {after!r}

def upgrade():
    for name, about in logged().items():
        op.add_column(name, sa.Column("remark", sa.String(), nullable=True))
        op.add_column(name, sa.Column("count", sa.Integer(), nullable=False, server_default="7"))
        if name not in {frozen!r}:
            changing = " ".join(about.columns)
            note_changes(name, about.keys, changing, changing if name == "jobs" else "")
    for name in {withdrawable!r} if op.get_bind().dialect.name == "sqlite" else ():
        guarded = ", ".join(one for one in logged()[name].columns if one != "withdrawn_at")
        op.execute(f"DROP TRIGGER {{name}}_append_only")
        op.execute(f"CREATE TRIGGER {{name}}_append_only BEFORE UPDATE OF {{guarded}} ON {{name}} "
                   f"BEGIN SELECT RAISE(ABORT, '{{name}} is append-only'); END")
"""


def _forget() -> None:
    for cached in (logged, revisions):
        cached.cache_clear()


@pytest.fixture
def widening(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[pytest.MonkeyPatch]:
    """Yield what undoes the next version of the tables."""
    yield monkeypatch
    monkeypatch.undo()
    _forget()


def widen(patch: pytest.MonkeyPatch, folder: Path) -> None:
    """Replace the tables and the migrations by those of a next version with two more columns in each logged table."""
    tables = MetaData()
    for table in Base.metadata.sorted_tables:
        copied = table.to_metadata(tables)
        if table.name in logged():
            copied.append_column(Column("remark", String))
            copied.append_column(Column("count", Integer, nullable=False, server_default="7"))
            patch.setitem(ADDED, table.name, BEFORE)
    patch.setattr(Base, "metadata", tables)
    shutil.copytree(revisions_module.MIGRATIONS, folder / "migrations", ignore=shutil.ignore_patterns("__pycache__"))
    script = MIGRATION.format(after=revisions()[0], frozen=FROZEN, withdrawable=WITHDRAWABLE)
    (folder / "migrations" / "versions" / "9999_every_table.py").write_text(script)
    patch.setattr(revisions_module, "MIGRATIONS", folder / "migrations")
    _forget()


@pytest.fixture(params=backends.BACKENDS)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """Yield a signed database of this version with rows in every logged table."""
    with backends.opened(backends.copy_of("filled", _fill, request.param, tmp_path)) as database:
        yield database


def _fill(url: str) -> None:
    with closing(Database(url)) as database:
        database.migrate()
        fill(database)
        sign_history(database)


def first_key(database: Database, about: Logged) -> str:
    with database.reading() as session:
        return about.key_of(session.execute(about.in_order).first())


def test_columns_added_to_every_logged_table_keep_every_history(
    database: Database, widening: pytest.MonkeyPatch, tmp_path: Path
):
    back_up(database, tmp_path / "before.zip")
    widen(widening, tmp_path)
    database.migrate()
    assert wrong_in(database) == []
    for name, about in logged().items():  # single rows, as for a signature
        if name not in ("key_surgeons", "recording_uploads"):
            assert head_over(database, [(name, first_key(database, about))])
    _change_each_table(database)
    assert wrong_in(database) == []
    cases.train(database, seed=5, release=True)
    sign_history(database)
    _prove(database)
    _edits_past_the_service_are_found(database)
    restored = Database(backends.blank(database.engine.dialect.name, tmp_path))
    restore(restored, tmp_path / "before.zip", NOTHING)
    assert wrong_in(restored) == []
    restored.close()
    backends.drop(restored.url)


def _change_each_table(database: Database) -> None:
    """Change one new column through the service: the new leaf has both; where nothing may change, it is refused."""
    for name, about in logged().items():
        change = text(f"UPDATE {name} SET remark = 'new'")
        if name in (*FROZEN, *WITHDRAWABLE):
            with pytest.raises(DatabaseError, match=f"{name} is append-only"), database.writing() as session:
                session.execute(change)
            continue
        with database.writing() as session:
            session.execute(change)
        with database.reading() as session:
            key = first_key(database, about)
            leaf = latest_leaves(session.connection(), name, [key])[key]
        assert {*BEFORE} <= {*leaf.digests} == {*about.columns}, name


def _prove(database: Database) -> None:
    with database.reading() as session:
        note = newest_checkpoint(session.connection()) or ""
        verifier = database.history.key.verifier(note.partition("\n")[0])
        said = served_at(session, database.history, "kestrel", cases.SUTURE, now())
    values = [check_disclosed(proof.model_dump(), note, verifier) for proof in said.proofs]
    assert values[1]["sha256"] == said.policy


def _edits_past_the_service_are_found(database: Database) -> None:
    for name, about in logged().items():
        key = first_key(database, about)
        for column, value in (("remark", "'past'"), ("count", "8")):
            with tampering(database) as connection:
                connection.exec_driver_sql(f"UPDATE {name} SET {column} = {value}")
                findings = dict(found(connection, database.history))
            assert findings.get(f"{name} {key}") == f"not as the history has it: {column}", name


def test_a_digest_taken_out_of_a_leaf_is_found(database: Database, widening: pytest.MonkeyPatch, tmp_path: Path):
    widen(widening, tmp_path)
    database.migrate()
    with database.writing() as session:
        session.execute(text("UPDATE surgeons SET remark = 'said'"))
    with tampering(database) as connection:
        leaf = latest_leaves(connection, "surgeons", ["1"])["1"]
        left = {name: digest for name, digest in leaf.digests.items() if name != "remark"}
        connection.execute(update(LEAVES).where(LEAVES.c.row == leaf.row).values(digests=left))
        connection.exec_driver_sql("UPDATE surgeons SET remark = NULL WHERE row = 1")
        findings = dict(found(connection, database.history))
    assert findings == {"surgeons 1": f"the digests of its leaf {leaf.row} are not those that were logged"}


def test_a_column_that_no_migration_declares_is_named(database: Database, widening: pytest.MonkeyPatch, tmp_path: Path):
    widen(widening, tmp_path)
    widening.delitem(ADDED, "releases")
    database.migrate()
    assert wrong_in(database) == [("releases 1", "not as the history has it: count, remark")]


def test_every_column_that_a_migration_added_is_declared(tmp_path: Path):
    with closing(Database(backends.blank("sqlite", tmp_path))) as database:
        with database.engine.execution_options(writes=True).begin() as connection:
            upgrade(connection, revisions()[-1])
        before = columns_of(database)
        database.migrate()
        now = columns_of(database)
    assert {name: now[name] - before[name] for name in before if now[name] != before[name]} == {
        name: {*columns} for name, columns in ADDED.items()
    }


def columns_of(database: Database) -> dict[str, set[str]]:
    """Return the columns of each logged table that there is."""
    look = inspect(database.engine)
    there = [name for name in look.get_table_names() if name in logged()]
    return {name: {column["name"] for column in look.get_columns(name)} for name in there}
