"""The baseline migration, and databases of other sources, on both back ends."""

from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import CheckConstraint, inspect, text

from skills.db import Base, revisions
from skills.db.session import Database
from skills.errors import Conflict
from tests import backends
from tests.library import cases

NOTES = {"history_notes"}  # no model: only triggers write to it, and only on SQLite it is a table of the schema
NOT_OURS = "jobs_of_the_engine"


@pytest.fixture(params=backends.BACKENDS)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """Yield a database without any table."""
    with backends.opened(backends.blank(request.param, tmp_path)) as database:
        yield database


def tables(database: Database) -> set[str]:
    return set(inspect(database.engine).get_table_names())


def contents(database: Database) -> object:
    """Return the database's schema, with its triggers, and all rows of ours."""
    look = inspect(database.engine)
    query = {
        "sqlite": "SELECT name, tbl_name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite_%' ORDER BY name",
        "postgresql": "SELECT tgname, pg_get_triggerdef(oid) FROM pg_trigger WHERE NOT tgisinternal ORDER BY tgname",
    }[database.engine.dialect.name]
    names = sorted(tables(database))
    with database.reading() as session:
        schema = [tuple(row) for row in session.execute(text(query))]
        rows = {name: sorted(map(repr, session.execute(text(f"SELECT * FROM {name}")))) for name in names}
    columns = {name: [(c["name"], str(c["type"]), c["nullable"]) for c in look.get_columns(name)] for name in names}
    return schema, columns, rows


def test_the_migration_makes_exactly_the_tables_of_the_models(database: Database):
    database.migrate()
    assert tables(database) - NOTES == {*Base.metadata.tables, "alembic_version"}
    with database.engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"include_name": lambda name, *_: name not in NOTES})
        assert compare_metadata(context, Base.metadata) == []
    constraints = {one for table in Base.metadata.tables.values() for one in table.constraints}
    declared = {str(one.name) for one in constraints if isinstance(one, CheckConstraint)}
    made = {
        one["name"] for name in Base.metadata.tables for one in inspect(database.engine).get_check_constraints(name)
    }
    assert made == declared


def test_migration_files_are_the_revisions_in_order():
    known = [script.revision for script in ScriptDirectory.from_config(revisions.alembic_config()).walk_revisions()]
    assert list(revisions.revisions()) == known


def test_migrating_again_changes_nothing(database: Database):
    database.migrate()
    cases.add_surgeon(database)
    before = contents(database)
    database.migrate()
    assert contents(database) == before


@pytest.mark.parametrize("revision", ["9999", "0020", "0001", "0001.0123456789ab"])
def test_a_database_of_other_sources_is_refused_and_left_as_it_was(database: Database, revision: str):
    database.migrate()
    cases.add_surgeon(database)
    with database.writing() as session:
        session.execute(text("UPDATE alembic_version SET version_num = :other"), {"other": revision})
    before = contents(database)
    with pytest.raises(Conflict, match="made by another version of suture-skills"):
        database.migrate()
    assert contents(database) == before


def test_the_baseline_differs_with_any_source_until_the_release(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def found() -> str:
        revisions.baseline.cache_clear()
        return revisions.baseline()

    here = found()
    (tmp_path / "skills").mkdir()
    (tmp_path / "skills" / "one.py").write_text("A = 1\n")
    try:
        monkeypatch.setattr(revisions, "PACKAGE", tmp_path / "skills")
        one = found()
        (tmp_path / "skills" / "one.py").write_text("A = 2\n")
        other = found()
        assert len({here, one, other}) == 3
        assert {name.partition(".")[0] for name in (here, one, other)} == {"0001"}
        monkeypatch.setattr(revisions, "__version__", "0.3.0")
        assert found() == "0001"
    finally:
        monkeypatch.undo()
        revisions.baseline.cache_clear()


def test_a_migration_that_fails_half_way_leaves_nothing(database: Database):
    with database.writing() as session:
        session.execute(text("CREATE TABLE retraining_styles (row INTEGER)"))  # the last one that the migration makes
    with pytest.raises(Exception, match="already exists"):
        database.migrate()
    assert tables(database) - {"alembic_version"} == {"retraining_styles"}
    with database.writing() as session:
        session.execute(text("DROP TABLE retraining_styles"))
    database.migrate()


def test_tables_that_are_not_ours_are_left_alone(database: Database):
    with database.writing() as session:
        session.execute(text(f"CREATE TABLE {NOT_OURS} (id INTEGER)"))
    database.migrate()
    assert NOT_OURS in tables(database)


def test_two_services_that_start_together_migrate_once(database: Database):
    others = [Database(database.url) for _ in range(3)]
    errors: list[Exception] = []

    def migrate(one: Database) -> None:
        try:
            one.migrate()
        except Exception as error:
            errors.append(error)

    threads = [Thread(target=migrate, args=(one,)) for one in others]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for one in others:
        one.close()
    assert errors == []
    assert set(Base.metadata.tables) < tables(database)
