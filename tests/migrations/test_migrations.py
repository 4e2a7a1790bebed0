"""Migrations up, down, and up again, on both back ends."""

from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Thread

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import inspect, text
from sqlalchemy.exc import DatabaseError

from skills.db import Base
from skills.db.session import Database, alembic_config, revisions
from skills.errors import Conflict
from skills.library.demos import find_demo, mark_demo, withdraw_demo
from skills.library.erasure import erase_demo
from skills.library.integrity import learnt, planned
from skills.library.plans import find_plan
from skills.library.policies import find_by_digest
from tests import backends
from tests.library import cases, exports
from tests.library.styles import ask_retraining, retrain

NOTES = {"history_notes"}  # no model: only triggers write to it, and only on SQLite it is a table of the schema
NOT_OURS = "jobs_of_the_engine"


@pytest.fixture(params=backends.BACKENDS)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """Yield a database without any table."""
    url = backends.blank(request.param, tmp_path)
    database = Database(url)
    yield database
    database.close()
    backends.drop(url)


def go(database: Database, how: Callable[[Config, str], None], where: str) -> None:
    with database.engine.execution_options(writes=True).connect() as connection:
        config = alembic_config()
        config.attributes["connection"] = connection
        how(config, where)
        connection.commit()


def tables(database: Database) -> set[str]:
    return set(inspect(database.engine).get_table_names())


def shape(database: Database) -> object:
    """Return the database's schema: columns, keys, indexes, triggers."""
    look = inspect(database.engine)
    kind = database.engine.dialect.name
    query = {
        "sqlite": "SELECT name, tbl_name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite_%' ORDER BY name",
        "postgresql": "SELECT tgname, pg_get_triggerdef(oid) FROM pg_trigger WHERE NOT tgisinternal ORDER BY tgname",
    }[kind]
    with database.reading() as session:
        said = [tuple(row) for row in session.execute(text(query))]
    columns = {t: [(c["name"], str(c["type"]), c["nullable"]) for c in look.get_columns(t)] for t in tables(database)}
    keys = {t: sorted(str(k["name"]) for k in look.get_indexes(t) + look.get_unique_constraints(t)) for t in columns}
    return said, columns, keys


def test_up_makes_exactly_the_tables_of_the_models(database: Database):
    database.migrate()
    assert tables(database) - NOTES == {*Base.metadata.tables, "alembic_version"}
    with database.engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"include_name": lambda name, *_: name not in NOTES})
        assert compare_metadata(context, Base.metadata) == []


def test_up_down_and_up_again_is_up(database: Database):
    database.migrate()
    once = shape(database)
    go(database, command.downgrade, "base")
    assert tables(database) == {"alembic_version"}
    database.migrate()
    assert shape(database) == once


def test_every_revision_goes_down_and_up_on_tables_with_rows_in_them(database: Database):
    database.migrate()
    cases.add_surgeon(database)
    cases.add_demo(database)
    cases.train(database, release=True)
    cases.add_plan(database)
    retrain(database)
    for script in ScriptDirectory.from_config(alembic_config()).walk_revisions():
        go(database, command.downgrade, script.down_revision or "base")
    assert tables(database) == {"alembic_version"}
    database.migrate()


def test_migration_file_names_list_the_revisions_in_order():
    known = [script.revision for script in ScriptDirectory.from_config(alembic_config()).walk_revisions()]
    assert list(revisions()) == known


def test_what_the_first_version_stored_is_kept_whole_and_still_guarded(database: Database):
    go(database, command.upgrade, "0001")
    first = shape(database)
    database.migrate()
    cases.add_surgeon(database)
    demo, version = cases.add_demo(database), cases.train(database, release=True)
    plan = cases.add_plan(database)
    go(database, command.downgrade, "0001")  # this is now a database of the first version
    assert shape(database) == first
    for column in ("arm", "sha256", "path"):
        assert_guarded(database, column)
    before = rows(database, "demonstrations")
    database.migrate()
    assert rows(database, "demonstrations") == [row | {"hysteresis": 0.0} for row in before]
    for column in ("arm", "sha256", "path", "hysteresis"):
        assert_guarded(database, column)
    with database.reading() as session:
        assert find_demo(session, demo.sha256).path.hysteresis == 0
        assert learnt(find_by_digest(session, version.sha256)).path.hysteresis == 0
        assert planned(find_plan(session, plan.sha256)).arm == demo.arm
    assert cases.add_demo(database).sha256 == demo.sha256
    assert cases.add_demo(database, hysteresis=0.25).sha256 != demo.sha256
    with database.writing() as session:
        withdraw_demo(session, demo.sha256, "test")
    assert_guarded(database, "withdrawn_at", "NULL")


@pytest.mark.nightly  # of a migration that never changes again; by day every one goes down and up
def test_a_policy_of_several_demos_cannot_be_downgraded_to_one_demo(database: Database):
    database.migrate()
    cases.add_surgeon(database)
    demos = [cases.add_demo(database, cases.hand_off((shift, 0.0, 0.0))).sha256 for shift in (0.0, 1.0)]
    cases.train(database, demos=demos)
    with pytest.raises(RuntimeError, match="several demonstrations"):
        go(database, command.downgrade, "0008")
    with database.reading() as session:
        assert session.scalar(text("SELECT count(*) FROM policy_demonstrations")) == 1


@pytest.mark.nightly  # of a migration that never changes again; by day every one goes down and up
def test_failures_block_the_downgrade_that_would_learn_from_them(database: Database):
    database.migrate()
    cases.add_surgeon(database)
    demo = cases.add_demo(database)
    with database.writing() as session:
        mark_demo(session, demo.sha256, "failure", "the needle fell", "test")
    with pytest.raises(RuntimeError, match="marked recovery or failure"):
        go(database, command.downgrade, "0010")
    with database.reading() as session:
        assert session.scalar(text("SELECT count(*) FROM demonstration_outcomes")) == 1
    with database.writing() as session:
        erase_demo(session, demo.sha256, "test")
    go(database, command.downgrade, "0010")


@pytest.mark.nightly  # of a migration that never changes again; by day every one goes down and up
def test_a_downgrade_forgets_datasets_with_their_jobs(database: Database, monkeypatch: pytest.MonkeyPatch):
    database.migrate()
    cases.add_surgeon(database)
    exports.in_this_process(monkeypatch)
    exports.add(database, exports.session_of())
    exports.export(database)
    go(database, command.downgrade, "0011")
    with database.reading() as session:
        assert session.scalar(text("SELECT count(*) FROM jobs")) == 0
    database.migrate()
    exports.export(database)


@pytest.mark.nightly  # of a migration that never changes again; by day every one goes down and up
def test_a_downgrade_drops_batches_and_cancels_the_unfinished_ones(database: Database):
    database.migrate()
    cases.add_surgeon(database)
    cases.add_demo(database)
    version = cases.train(database)
    before = shape(database)
    done, waiting = retrain(database), ask_retraining(database, release=True)
    go(database, command.downgrade, "0003")
    states = {job["kind"]: job["state"] for job in rows(database, "jobs") if job["row"] >= waiting.row}
    assert states == {"retraining": "cancelled", "retraining-part": "cancelled"}
    assert [job["state"] for job in rows(database, "jobs") if job["row"] == done.row] == ["succeeded"]
    database.migrate()
    assert shape(database) == before
    with database.reading() as session:
        assert learnt(find_by_digest(session, version.sha256)).path.hysteresis == 0
    assert retrain(database, release=True).state == "succeeded"


def rows(database: Database, table: str) -> list[dict[str, object]]:
    with database.reading() as session:
        return [dict(row) for row in session.execute(text(f"SELECT * FROM {table} ORDER BY row")).mappings()]


def assert_guarded(database: Database, column: str, new: str | None = None) -> None:
    """Assert that the column cannot be changed; on PostgreSQL an equal value would be no change."""
    other = {"path": "'\\x00'", "hysteresis": "0.25"}.get(column, "'other'")
    with pytest.raises(DatabaseError, match="demonstrations is append-only"), database.writing() as session:
        session.execute(text(f"UPDATE demonstrations SET {column} = {new or other}"))


@pytest.mark.nightly  # of a migration that never changes again; by day every one goes down and up
def test_a_demo_with_hysteresis_blocks_the_downgrade_without_changes(database: Database):
    database.migrate()
    cases.add_surgeon(database)
    demo = cases.add_demo(database, hysteresis=0.25)
    before = shape(database), rows(database, "demonstrations")
    with pytest.raises(Conflict, match="cannot read demonstrations with hysteresis; erase them first"):
        go(database, command.downgrade, "0001")
    assert (shape(database), rows(database, "demonstrations")) == before
    with database.writing() as session:
        erase_demo(session, demo.sha256, "test")
    go(database, command.downgrade, "0001")


def test_migrating_again_changes_nothing(database: Database):
    database.migrate()
    cases.add_surgeon(database)
    before = shape(database)
    database.migrate()
    assert shape(database) == before
    with database.reading() as session:
        assert session.scalar(text("SELECT count(*) FROM surgeons")) == 1


def test_a_database_of_a_newer_version_is_refused_and_left_as_it_was(database: Database):
    database.migrate()
    cases.add_surgeon(database)
    with database.writing() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    before = shape(database)
    with pytest.raises(Conflict, match="newer version of suture-skills; nothing was changed"):
        database.migrate()
    assert shape(database) == before
    with database.reading() as session:
        assert session.scalar(text("SELECT version_num FROM alembic_version")) == "9999"
        assert session.scalar(text("SELECT count(*) FROM surgeons")) == 1


def test_a_migration_that_fails_half_way_leaves_nothing(database: Database):
    with database.writing() as session:
        session.execute(text("CREATE TABLE playbacks (row INTEGER)"))  # the last of the first migration's tables
    with pytest.raises(Exception, match="already exists"):
        database.migrate()
    assert tables(database) - {"alembic_version"} == {"playbacks"}
    with database.writing() as session:
        session.execute(text("DROP TABLE playbacks"))
    database.migrate()


def test_tables_that_are_not_ours_are_left_alone(database: Database):
    with database.writing() as session:
        session.execute(text(f"CREATE TABLE {NOT_OURS} (id INTEGER)"))
    database.migrate()
    go(database, command.downgrade, "base")
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
