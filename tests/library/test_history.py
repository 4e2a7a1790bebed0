"""The history: every change adds a leaf, and every change that bypasses the service is found and named."""

import os
import random
import re
import resource
import shutil
from collections.abc import Iterator
from contextlib import closing, suppress
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import Connection, func, insert, null, select, text, update
from sqlalchemy.orm import Session

from skills.db import Base, now
from skills.db.change_notes import take_notes
from skills.db.leaves import CHECKPOINTS, LEAVES, latest_leaves, newest_checkpoint
from skills.db.logged_rows import COLUMNS_NOT_LOGGED, NOT_LOGGED, digests_of, logged
from skills.db.models import Release, Surgeon
from skills.db.saved_heads import last_head, save_head
from skills.db.service_tables import Job
from skills.db.session import Database
from skills.db.tiles import TILES, stored_tiles
from skills.errors import BadSettings, Corrupt, NotReady
from skills.library.operation import history, locks, sweep
from skills.library.operation.backup import back_up, restore
from skills.library.operation.history import Verified, edited_rows, sign_history, verify_history
from skills.library.operation.inspection import inspect_installation
from skills.library.operation.proofs import first_head, served_at
from skills.library.people import erasure
from skills.library.people.erasure import erase_surgeon
from skills.library.people.surgeons import find_surgeon, put_surgeon
from skills.library.policies.releases import withdraw
from skills.library.policies.versions import served_release
from skills.library.recordings import content_cache, recordings
from skills.library.recordings.recordings import stored_recording
from skills.schemas.people import SurgeonIn
from skills.settings import Settings
from skills.transparency.merkle import Checkpoint, Tree, inclusion_proof, leaf_hash, node_from
from skills.transparency.notes import Note, read_notes
from skills.transparency.signing_keys import SigningKey
from tests import backends
from tests.db.test_tables import FROZEN, WITHDRAWABLE, fill
from tests.independent_history import check_disclosed, check_inclusion
from tests.library import cases
from tests.library.attacks import cover_up, found, random_edit, sign_again, tampering
from tests.library.cases import fetch

SURGEONS = logged()["surgeons"].raw


@pytest.fixture(scope="module", params=backends.BACKENDS)
def full(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Database]:
    """Yield a signed database with rows in every logged table; its tests undo their changes."""
    with backends.opened(backends.fresh(request.param, tmp_path_factory.mktemp("full"))) as database:
        sign_history(database)
        fill(database)
        sign_history(database)
        yield database


def wrong_in(database: Database) -> list[tuple[str, str]]:
    with database.reading() as session:
        return found(session.connection(), database.history)


# ---- what is logged


def test_every_column_is_logged_or_named_as_not_logged_with_a_reason():
    assert {*logged(), *NOT_LOGGED} == {*Base.metadata.tables}
    for name, about in logged().items():
        here = {column.name for column in Base.metadata.tables[name].columns}
        assert here - {*about.columns} == {column for table, column in COLUMNS_NOT_LOGGED if table == name}


def test_the_triggers_note_every_logged_table(full: Database):
    query = {
        "sqlite": "SELECT name FROM sqlite_master WHERE type = 'trigger' AND name LIKE '%_noted_%'",
        "postgresql": "SELECT tgname FROM pg_trigger WHERE tgname LIKE '%_noted_%'",
    }[full.engine.dialect.name]
    with full.reading() as session:
        names = {*session.scalars(text(query))}
    assert names == {f"{table}_noted_{change}" for table in logged() for change in ("add", "change", "remove")}


def test_what_is_signed_while_it_is_verified_is_no_fault(full: Database, monkeypatch: pytest.MonkeyPatch):
    read = history._checkpoints

    def read_and_sign(connection: Connection) -> Iterator[tuple[int, int, Note | None]]:
        yield from read(connection)
        with full.writing() as session:
            put_surgeon(session, f"late-{full.engine.dialect.name}", SurgeonIn(), "test")
        assert sign_history(full) is not None

    monkeypatch.setattr(history, "_checkpoints", read_and_sign)
    with full.reading() as session:
        assert list(verify_history(session.connection(), full.history, None, Verified())) == []


def test_what_the_service_wrote_is_whole_and_signed(full: Database):
    assert wrong_in(full) == []
    with full.reading() as session:
        tables = {*session.scalars(select(LEAVES.c.table_name))}
        assert {*logged()} <= tables
        assert session.scalar(select(LEAVES.c.row).where(LEAVES.c.number.is_(None))) is None


def test_an_update_of_any_logged_column_of_a_job_is_noted(full: Database):
    """The trigger of jobs names columns, because their progress is not logged."""
    with full.engine.execution_options(writes=True).connect() as connection:
        for column in logged()["jobs"].columns:
            connection.exec_driver_sql(f'UPDATE jobs SET "{column}" = "{column}" WHERE row = 1')
            assert [tuple(note[:3]) for note in take_notes(connection)] == [("jobs", "change", "1")], column
        connection.rollback()


def test_a_transaction_that_fails_leaves_no_leaf(full: Database):
    with full.reading() as session:
        before = session.scalars(select(LEAVES.c.row)).all()
    with suppress(RuntimeError), full.writing() as session:
        put_surgeon(session, "heron", SurgeonIn(), "test")
        raise RuntimeError
    with full.reading() as session:
        assert session.scalars(select(LEAVES.c.row)).all() == before


# ---- deliberate edits

BLOB = {"sqlite": "x'00'", "postgresql": "'\\x00'::bytea"}
# The statement, the row that it changes, and how.
EDITS = [
    ("UPDATE policy_versions SET learnt = {blob} WHERE row = 1", "policy_versions 1", "learnt"),
    ("UPDATE policy_versions SET covered = {blob} WHERE row = 1", "policy_versions 1", "covered"),
    ("UPDATE policy_versions SET manifest = '{{}}' WHERE row = 1", "policy_versions 1", "manifest"),
    ("UPDATE policy_versions SET sha256 = 'f' WHERE row = 1", "policy_versions 1", "sha256"),
    ("UPDATE policy_versions SET releasable = NOT releasable WHERE row = 2", "policy_versions 2", "releasable"),
    ("INSERT INTO releases (row, policy_row, surgeon_row, suture, released_at, released_by) SELECT 99, policy_row, "
     "surgeon_row, suture, released_at, released_by FROM releases WHERE row = 1", "releases 99", "add"),
    ("DELETE FROM releases WHERE row = 1", "releases 1", "remove"),
    ("UPDATE releases SET withdrawn_at = released_at WHERE row = 1", "releases 1", "withdrawn_at"),
    ("UPDATE releases SET released_at = '2020-01-01 00:00:00.000000+00:00'", "releases 1", "released_at"),
    ("UPDATE releases SET policy_row = 1 WHERE row = 1", "releases 1", "policy_row"),
    ("UPDATE releases SET released_by = 'ada' WHERE row = 1", "releases 1", "released_by"),
    ("DELETE FROM events WHERE row = 2", "events 2", "remove"),
    ("UPDATE events SET actor = 'ada' WHERE row = 2", "events 2", "actor"),
    ("UPDATE events SET object_id = 'ada' WHERE row = 2", "events 2", "object_id"),
    ("UPDATE surgeons SET consent = '{{}}' WHERE row = 1", "surgeons 1", "consent"),
    ("UPDATE surgeons SET slug = 'heron' WHERE row = 1", "surgeons 1", "slug"),
    ("UPDATE keys SET role = 'admin' WHERE row = 1", "keys 1", "role"),
    ("UPDATE keys SET digest = 'f' WHERE row = 1", "keys 1", "digest"),
    ("UPDATE keys SET restricted = NOT restricted WHERE row = 1", "keys 1", "restricted"),
    ("DELETE FROM key_surgeons", "key_surgeons 1/1", "remove"),
    ("INSERT INTO recording_uploads VALUES (1, 'mallory')", "recording_uploads 1/mallory", "add"),
    ("UPDATE recordings SET reading = '{{}}' WHERE row = 1", "recordings 1", "reading"),
    ("UPDATE demonstrations SET path = {blob} WHERE row = 1", "demonstrations 1", "path"),
    ("UPDATE demonstrations SET withdrawn_at = created_at WHERE row = 1", "demonstrations 1", "withdrawn_at"),
    ("DELETE FROM demonstration_outcomes WHERE row = 1", "demonstration_outcomes 1", "remove"),
    ("UPDATE demonstration_outcomes SET outcome = 'success' WHERE row = 1", "demonstration_outcomes 1", "outcome"),
    ("UPDATE reward_maps SET map = {blob} WHERE row = 1", "reward_maps 1", "map"),
    ("UPDATE pose_styles SET poses = {blob} WHERE row = 1", "pose_styles 1", "poses"),
    ("UPDATE plans SET about = '{{}}' WHERE row = 1", "plans 1", "about"),
    ("UPDATE playbacks SET feasible = NOT feasible WHERE row = 1", "playbacks 1", "feasible"),
    ("UPDATE playbacks SET measured = {blob} WHERE row = 1", "playbacks 1", "measured"),
    ("UPDATE playback_pictures SET drawn = {blob} WHERE row = 1", "playback_pictures 1", "drawn"),
    ("UPDATE proposal_marks SET state = 'open' WHERE row = 1", "proposal_marks 1", "state"),
    ("DELETE FROM erasures WHERE row = 1", "erasures 1", "remove"),
    ("UPDATE datasets SET sha256 = 'f' WHERE row = 1", "datasets 1", "sha256"),
    ("UPDATE jobs SET result = '{{}}' WHERE row = 1", "jobs 1", "result"),
    ("UPDATE calibrations SET about = '{{\"a\": 1}}' WHERE row = 1", "calibrations 1", "about"),
    ("UPDATE suture_types SET name = 'other' WHERE slug = 'simple-running'", "suture_types simple-running", "name"),
]  # fmt: skip


def test_every_deliberate_edit_is_found_and_named(full: Database):
    assert len(EDITS) >= 30
    _deliberate_edits(full, 0, of=3)


@pytest.mark.nightly
@pytest.mark.parametrize("turn", [0, 1])
def test_every_deliberate_edit_is_found_covered_up_or_not(full: Database, turn: int):
    _deliberate_edits(full, turn)


def _deliberate_edits(full: Database, turn: int, of: int = 1) -> None:
    """Make every `of`-th edit, every second one with digests, tree and checkpoints computed again."""
    for number, (statement, name, kind) in [*enumerate(EDITS)][::of]:
        covered = (number + turn) % 2 == 1
        with tampering(full) as connection:
            done = connection.exec_driver_sql(statement.format(blob=BLOB[connection.dialect.name]))
            assert done.rowcount >= 1, statement
            if covered:
                table, _, key = name.partition(" ")
                cover_up(connection, table, key, kind if kind in ("add", "remove") else "change")
            findings = dict(found(connection, full.history))
        assert name in findings or (kind == "remove" and covered and _names_table(findings, name)), statement
        if kind not in ("add", "remove") and not covered:
            assert kind in findings[name], statement


def _names_table(findings: dict[str, str], name: str) -> bool:
    """Return whether the removal of a row is named by its table: its forged leaf has no key."""
    return f"{name.partition(' ')[0]} (erased)" in findings


def _edits_at_random(full: Database, seed: int, count: int) -> None:
    rng = random.Random(seed)
    for number in range(count):
        with tampering(full) as connection:
            name, kind = random_edit(connection, rng)
            covered = rng.random() < 0.5
            if covered:
                cover_up(connection, *name.split(" ", 1), kind)
            findings = dict(found(connection, full.history))
            assert name in findings or (kind == "remove" and covered and _names_table(findings, name)), (number, name)


def test_random_edits_are_found_and_named(full: Database):
    _edits_at_random(full, 7, 5 if full.engine.dialect.name == "sqlite" else 4)


@pytest.mark.nightly
def test_a_thousand_random_edits_are_found_and_named(full: Database):
    _edits_at_random(full, 8, 1000)


# ---- edits of the history itself, and of the schema

HISTORY_EDITS = [
    "DELETE FROM history WHERE number = {n}",
    "UPDATE history SET number = CASE number WHEN {n} THEN -1 ELSE {n} END WHERE number IN ({n}, {next})",
    "UPDATE history SET entry = replace(entry, '2026', '2025') WHERE number = {n}",
    "UPDATE history SET entry = replace(entry, '\"add\"', '\"found\"') WHERE table_name = 'policy_versions'",
    "UPDATE history SET salt = NULL, digests = NULL, key = NULL WHERE table_name = 'releases'",
    "UPDATE history SET key = '77' WHERE table_name = 'releases'",
    "UPDATE history_checkpoints SET note = replace(note, 'suture-skills', 'suture-others')",
    "DELETE FROM history_checkpoints",
    "UPDATE history_checkpoints SET subtrees = {blob}",
    "UPDATE history SET seal = {blob} WHERE number = {n}",
]


@pytest.mark.parametrize("of", [2, pytest.param(1, marks=pytest.mark.nightly)])
def test_every_edit_of_the_history_itself_is_found(full: Database, of: int):
    with full.reading() as session:
        first = session.scalar(select(func.min(LEAVES.c.number)).where(LEAVES.c.table_name == "events"))
    for number, statement in enumerate(HISTORY_EDITS):
        for again in (False, True)[number % of :: of]:  # by day one of both
            with tampering(full) as connection:
                edit = statement.format(blob=BLOB[connection.dialect.name], n=first, next=first + 1)
                assert connection.exec_driver_sql(edit).rowcount >= 1
                if again and "checkpoints" not in statement and "-1" not in statement:
                    sign_again(connection)
                assert found(connection, full.history), statement


def test_a_trigger_or_an_index_that_is_gone_is_named(full: Database):
    on = {"sqlite": "", "postgresql": " ON releases"}[full.engine.dialect.name]
    said = {
        "sqlite": "schema trigger releases_append_only",
        "postgresql": "schema trigger releases releases_append_only",
    }
    with full.engine.execution_options(writes=True).connect() as connection:
        connection.exec_driver_sql(f"DROP TRIGGER releases_append_only{on}")
        connection.exec_driver_sql("DROP INDEX uq_jobs_identity_live")
        names = {one[0] for one in _all_found(connection, full)}
        connection.rollback()
    assert names == {said[full.engine.dialect.name], "schema index uq_jobs_identity_live"}


def _all_found(connection: Connection, database: Database) -> list[tuple[str, str]]:
    return list(verify_history(connection, database.history, (), Verified()))


def test_a_head_kept_elsewhere_finds_an_older_state_put_back(tmp_path: Path):
    database = Database(backends.fresh("sqlite", tmp_path), checkpoints=tmp_path / "heads")
    cases.add_surgeon(database)
    sign_history(database)
    database.close()
    older, file = tmp_path / "older.sqlite", Path(database.url.removeprefix("sqlite:///"))
    with closing(Database(database.url, checkpoints=tmp_path / "heads")) as database:
        database.forget()
        shutil.copy(file, older)
        cases.add_surgeon(database, "heron")
        sign_history(database)
        heads = tuple(read_notes((tmp_path / "heads").read_text()))
        assert len(heads) == 2
        with database.reading() as session:
            assert found(session.connection(), database.history, heads) == []
    with closing(Database(f"sqlite:///{older}")) as put_back, put_back.reading() as session:
        assert found(session.connection(), put_back.history) == []
        ((name, why),) = found(session.connection(), put_back.history, heads)
    assert name == f"head of {heads[1].checkpoint.size} leaves"
    assert "the history was cut" in why


def test_a_missing_folder_of_the_saved_heads_is_refused_with_its_path(tmp_path: Path):
    with pytest.raises(BadSettings, match=f"The folder {tmp_path / 'gone'} of SKILLS_CHECKPOINTS does not exist"):
        Database(backends.fresh("sqlite", tmp_path), checkpoints=tmp_path / "gone" / "heads")


def test_a_row_written_past_the_service_is_not_logged_for_its_author(database: Database):
    sign_history(database)
    with database.engine.connect() as connection:  # with triggers, without the service's `writing`
        connection.exec_driver_sql("UPDATE surgeons SET skill_level = 'expert'")
        connection.commit()
    cases.add_surgeon(database, "heron")  # a transaction of the service after it
    sign_history(database)
    assert wrong_in(database) == [("surgeons 1", "not as the history has it: skill_level")]


CHANGED = [  # by somebody, then by the service, in the same row
    ("surgeons", "skill_level = 'expert'", "handedness = 'left'"),
    ("surgeons", "consent = '{\"training\": true}'", "skill_level = 'novice'"),
    ("suture_types", "name = 'another'", "description = 'longer'"),
    ("keys", "role = 'admin'", "revoked_at = created_at"),
    ("keys", "digest = 'f'", "restricted = NOT restricted"),
    ("jobs", "result = '{\"sha256\": 1}'", "error = 'none'"),
    ("jobs", "request = '{}'", "state = 'cancelled', ended_at = created_at"),
]


def test_a_change_by_the_service_does_not_cover_another_column_of_the_row(full: Database):
    for table, by_somebody, by_service in CHANGED:
        with full.engine.execution_options(writes=True).connect() as connection:
            connection.exec_driver_sql(f"UPDATE {table} SET {by_somebody}")
            take_notes(connection)
            before = {name for name, _ in found(connection, full.history)}
            connection.exec_driver_sql(f"UPDATE {table} SET {by_service}")
            full.history.settle(connection)
            findings = dict(found(connection, full.history))
            connection.rollback()
        assert {*findings} == before
        column = by_somebody.partition(" ")[0]
        assert {*findings.values()} == {f"not as the history has it: {column}"}, by_service


def _digest_again(connection: Connection, table: str, key: str) -> None:
    """Put the digests of a row into its newest leaf, and leave the entry that was signed."""
    about, leaf = logged()[table], latest_leaves(connection, table, [key])[key]
    (row,) = about.rows_of(connection, [key])
    digests = digests_of(about.columns, row, leaf.salt)
    connection.execute(update(LEAVES).where(LEAVES.c.row == leaf.row).values(digests=digests))


def test_digests_that_are_not_the_logged_ones_are_no_ground_to_sign(full: Database):
    with tampering(full) as connection:
        connection.exec_driver_sql("UPDATE policy_versions SET sha256 = 'f' WHERE row = 1")
        _digest_again(connection, "policy_versions", "1")
        with pytest.raises(Corrupt, match="not as the history has it"):
            first_head(connection, full.history, [("policy_versions", 1)])


def test_digests_changed_for_a_while_get_into_no_later_leaf(full: Database):
    for table, by_somebody, by_service in CHANGED:
        with full.engine.execution_options(writes=True).connect() as connection:
            key = logged()[table].key_of(connection.execute(logged()[table].in_order).first())
            kept = latest_leaves(connection, table, [key])[key]
            connection.exec_driver_sql(f"UPDATE {table} SET {by_somebody}")
            take_notes(connection)
            _digest_again(connection, table, key)
            connection.exec_driver_sql(f"UPDATE {table} SET {by_service}")
            full.history.settle(connection)
            back = update(LEAVES).where(LEAVES.c.row == kept.row).values(digests=dict(kept.digests))
            connection.execute(back)
            findings = dict(found(connection, full.history))
            connection.rollback()
        column = by_somebody.partition(" ")[0]
        assert column in findings[f"{table} {key}"], by_service


def test_a_row_whose_leaf_was_emptied_can_be_changed_and_is_named(full: Database):
    with full.engine.execution_options(writes=True).connect() as connection:
        connection.execute(update(LEAVES).where(LEAVES.c.table_name == "surgeons").values(digests=null()))
        connection.exec_driver_sql("UPDATE surgeons SET handedness = 'left'")
        full.history.settle(connection)
        findings = dict(found(connection, full.history))
        connection.rollback()
    assert "its digests were removed from the history" in findings["surgeons 1"]


def test_the_notes_name_every_logged_column_that_may_change(full: Database):
    """The others are of rows that only somebody past the service can change, which no leaf covers."""
    query = {
        "sqlite": "SELECT tbl_name, sql FROM sqlite_master WHERE name LIKE '%_noted_change'",
        "postgresql": "SELECT c.relname, pg_get_functiondef(t.tgfoid) FROM pg_trigger t "
        "JOIN pg_class c ON c.oid = t.tgrelid WHERE tgname LIKE '%_noted_change'",
    }[full.engine.dialect.name]
    with full.reading() as session:
        noted = {table: re.findall(r"'(\w+) '", sql) for table, sql in session.execute(text(query))}
    assert noted == {
        table: ["withdrawn_at"] if table in WITHDRAWABLE else [] if table in FROZEN else [*about.columns]
        for table, about in logged().items()
    }


def test_a_row_that_is_removed_and_added_again_is_logged_whole(database: Database):
    cases.add_demo(database)
    stored = logged()["recording_uploads"].raw
    with database.writing() as session:
        session.execute(stored.delete())
        session.execute(stored.insert().values(recording_row=1, actor="test"))
    with database.writing() as session:
        session.execute(text("UPDATE parsed_recordings SET version = 0"))
    with database.reading() as session:
        before = session.scalar(select(func.count()).select_from(LEAVES))
    for values in ("3", "3", "version"):  # changed, equal, and equal by itself
        with database.writing() as session:
            session.execute(text(f"UPDATE parsed_recordings SET version = {values}"))
    with database.writing() as session:
        row = session.execute(text("SELECT * FROM parsed_recordings")).one()._mapping
        session.execute(text("DELETE FROM parsed_recordings"))
        session.execute(logged()["parsed_recordings"].raw.insert(), [{**row, "version": 4}])
    with database.reading() as session:
        assert session.scalar(select(func.count()).select_from(LEAVES)) == before + 2
    assert wrong_in(database) == []


def test_a_transaction_that_changes_many_rows_one_by_one_is_logged_whole(database: Database):
    """On PostgreSQL its notes fill several settings, and some are undone by a savepoint."""
    with database.writing() as session:
        connection = session.connection()
        for number in range(1200):
            connection.execute(SURGEONS.insert(), [surgeon_row(f"many-{number}")])
        with suppress(RuntimeError), session.begin_nested():
            connection.execute(SURGEONS.insert(), [surgeon_row("undone")])
            raise RuntimeError
        connection.execute(text("UPDATE surgeons SET skill_level = 'expert' WHERE slug = 'many-1199'"))
    with database.reading() as session:
        of_surgeons = select(LEAVES.c.entry).where(LEAVES.c.table_name == "surgeons")
        assert sum('"add"' in entry for entry in session.scalars(of_surgeons)) >= 1200
    assert wrong_in(database) == []


def surgeon_row(slug: str) -> dict[str, object]:
    return {"slug": slug, "subject": slug, "consent": {}, "created_at": now()}


def test_a_row_that_was_erased_and_is_put_back_with_its_old_leaf_is_found(database: Database):
    cases.add_surgeon(database, "heron")
    leaf = select(LEAVES).where(LEAVES.c.table_name == "surgeons", LEAVES.c.key == "2")
    with database.reading() as session:
        row = session.execute(select(SURGEONS).where(SURGEONS.c.row == 2)).one()._mapping
        old = session.execute(leaf).one()._mapping
    cases.committed(database, erase_surgeon, "heron", "test")
    sign_history(database)
    with tampering(database) as connection:
        connection.execute(SURGEONS.insert(), [dict(row)])
        connection.execute(LEAVES.insert(), [{**old, "row": old["row"] + 1000, "number": None}])
        assert database.history.sign(connection) is not None  # its seal is right
        copied = f"its leaf {old['row'] + 1000} is a copy of an earlier one"
        assert found(connection, database.history) == [("surgeons 2", copied)]


# ---- pieces, caches, steps


def test_changed_bytes_and_forged_deletions_are_found_beside_the_history(database: Database):
    cases.add_demo(database)
    with tampering(database) as connection:
        blob = BLOB[connection.dialect.name]
        connection.exec_driver_sql(f"UPDATE recording_chunks SET data = {blob}")
        connection.exec_driver_sql(f"UPDATE parsed_chunks SET data = {blob}")
        connection.exec_driver_sql("INSERT INTO loose_chunks VALUES (1, '2020-01-01 00:00:00.000000+00:00')")
        connection.exec_driver_sql("INSERT INTO erased_surgeons VALUES (1)")
        connection.commit()
    wrong = {name for part in inspect_installation(database) for name, _ in part.wrong}
    assert {"recordings 1", "parsed_recordings 1", "loose_chunks 1", "erased_surgeons 1"} <= wrong


def test_a_cache_may_be_emptied_by_hand_and_is_logged_again(database: Database):
    demo = cases.add_demo(database)
    for turn in range(2):
        with database.engine.connect() as connection:
            connection.exec_driver_sql("DELETE FROM parsed_chunks")
            connection.exec_driver_sql("DELETE FROM parsed_recordings")
            connection.commit()
        assert wrong_in(database) == []
        stored_recording(database, demo.recording.sha256)
        assert wrong_in(database) == []
        with database.reading() as session:
            leaves = session.scalars(select(LEAVES.c.row).where(LEAVES.c.table_name == "parsed_recordings")).all()
        assert len(leaves) == turn + 2
    cases.committed(database, erase_surgeon, "kestrel", "test")
    assert wrong_in(database) == []


def test_uploads_erasures_and_retentions_in_steps_keep_the_history_whole(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    for room in (recordings, content_cache, sweep, erasure):
        monkeypatch.setattr(room, "AT_ONCE_BYTES", 1024)
    for room in (recordings, content_cache, sweep):
        monkeypatch.setattr(room, "CHUNK_BYTES", 1024)
    monkeypatch.setattr(sweep, "JOBS_AT_ONCE", 2)
    cases.add_demo(database)
    for seed in range(3):
        cases.train(database, seed=seed)
    cases.add_surgeon(database, "heron")
    cases.add_demo(database, cases.hand_off((1.0, 0.0, 0.0)), "heron")
    cases.train(database, "heron")
    assert wrong_in(database) == []
    cases.committed(database, erase_surgeon, "kestrel", "test")
    assert wrong_in(database) == []  # what is left to the sweep is logged still
    sweep.sweep_erased(database)
    assert wrong_in(database) == []
    with database.writing() as session:
        session.execute(update(Job).values(ended_at=now() - timedelta(days=2)))
    sweep.sweep(database, Settings(database_url=database.url, keep_jobs_days=1))
    assert wrong_in(database) == []
    with database.reading() as session:
        jobs = session.execute(select(LEAVES.c.key, LEAVES.c.entry).where(LEAVES.c.table_name == "jobs")).all()
        assert session.scalar(select(func.count()).select_from(Job)) == 0
    assert {key for key, _ in jobs} == {None}
    assert sum('"remove"' in entry for _, entry in jobs) == 4


def test_signing_and_writing_do_not_wait_for_each_other(database: Database):
    """On PostgreSQL; a leaf that is committed after a later one gets a later number."""
    if database.engine.dialect.name == "sqlite":
        return
    impatient = Database(database.url, patience_ms=200)
    with closing(impatient), database.writing([locks.surgeon("heron")]) as session:
        put_surgeon(session, "heron", SurgeonIn(), "test")
        session.flush()
        database.history.settle(session.connection())  # its leaves have their rows
        with impatient.writing([locks.surgeon("egret")]) as other:
            put_surgeon(other, "egret", SurgeonIn(), "test")
        assert sign_history(impatient) is not None
    signing = database.engine.execution_options(writes=()).connect()
    with closing(impatient), closing(signing):
        assert database.history.sign(signing) is not None  # and not committed yet
        with impatient.writing([locks.surgeon("swift")]) as other:
            put_surgeon(other, "swift", SurgeonIn(), "test")
        signing.commit()
    sign_history(database)
    with database.reading() as session:
        of_surgeons = select(LEAVES.c.number, LEAVES.c.row).where(LEAVES.c.table_name == "surgeons")
        numbers = session.execute(of_surgeons.order_by(LEAVES.c.row)).all()
    assert [number for number, _ in numbers] != sorted(number for number, _ in numbers)
    assert wrong_in(database) == []


# ---- proofs, erasure, keys


def test_proofs_are_checked_offline_and_stay_valid_after_an_erasure(database: Database):
    cases.add_demo(database)
    cases.train(database, release=True)
    sign_history(database)
    with database.reading() as session:
        connection = session.connection()
        note = newest_checkpoint(connection) or ""
        leaves = connection.execute(select(LEAVES.c.number, LEAVES.c.entry).order_by(LEAVES.c.number)).all()
        node = node_from(stored_tiles(connection))
        proofs = {number: inclusion_proof(len(leaves), number, node) for number, _ in leaves}
        verifier = database.history.key.verifier(note.partition("\n")[0])
    cases.committed(database, erase_surgeon, "kestrel", "test")
    sign_history(database)
    with database.reading() as session:
        after = dict(session.execute(select(LEAVES.c.number, LEAVES.c.entry)).all())
        of_erased = LEAVES.c.table_name.in_(("demonstrations", "surgeons", "releases"))
        left = LEAVES.c.key.is_not(None) | LEAVES.c.salt.is_not(None) | LEAVES.c.digests.is_not(None)
        assert session.scalars(select(LEAVES.c.row).where(of_erased, left)).all() == []
    for number, proof in proofs.items():
        check_inclusion(after[number], number, proof, note, verifier)
    assert wrong_in(database) == []


# ---- tiles

TILE_EDITS = [
    "UPDATE history_tiles SET root = {blob} WHERE number = 1",
    "UPDATE history_tiles SET hashes = {blob} WHERE number = 1",
    "DELETE FROM history_tiles WHERE number = 1",
    "UPDATE history_tiles SET number = 7 WHERE number = 1",
    "INSERT INTO history_tiles SELECT 1, 0, root, hashes FROM history_tiles WHERE number = 0",
]
TILES_IN_ORDER = select(TILES).order_by(TILES.c.level, TILES.c.number)


def add_cranes(database: Database, count: int, name: str = "crane") -> None:
    with database.writing(()) as session:
        session.execute(
            insert(Surgeon), [{"slug": f"{name}-{number}", "subject": f"{name}-{number}"} for number in range(count)]
        )


def test_tiles_are_written_as_they_fill_and_every_change_of_one_is_found(database: Database):
    for name in ("crane", "egret", "swift"):
        add_cranes(database, 300, name)
        sign_history(database)
        with database.reading() as session:
            tiles = session.execute(TILES_IN_ORDER).all()
            leaves = session.scalars(select(LEAVES.c.entry).order_by(LEAVES.c.number)).all()
        assert [(tile.level, tile.number) for tile in tiles] == [(0, number) for number in range(len(leaves) // 256)]
        hashes = [leaf_hash(entry.encode()) for entry in leaves[: len(tiles) * 256]]
        assert b"".join(tile.hashes for tile in tiles) == b"".join(hashes)
    assert wrong_in(database) == []
    for statement in TILE_EDITS:
        with tampering(database) as connection:
            edit = statement.format(blob=BLOB[connection.dialect.name])
            assert connection.exec_driver_sql(edit).rowcount == 1
            names = [name for name, _ in found(connection, database.history)]
        assert names and all(name.startswith("history_tiles ") for name in names), statement


def test_no_proof_is_given_from_tiles_or_leaves_that_were_changed(database: Database):
    cases.add_demo(database)
    add_cranes(database, 330)  # the newest leaves stand behind the last whole tile
    cases.train(database, release=True)
    sign_history(database)
    asked = ("kestrel", cases.SUTURE, now())
    given = fetch(database, served_at, database.history, *asked)
    for proof in given.proofs:
        check_disclosed(proof.model_dump(), given.checkpoint.note, given.checkpoint.verifier)
    for edit in (
        "UPDATE history_tiles SET root = {blob}, hashes = {blob}",
        "DELETE FROM history_tiles",
        "DELETE FROM history WHERE number = (SELECT max(number) FROM history WHERE table_name = 'jobs')",
    ):
        with tampering(database) as connection, Session(connection) as session:
            connection.exec_driver_sql(edit.format(blob=BLOB[connection.dialect.name]))
            with pytest.raises(Corrupt, match="proves nothing"):
                served_at(session, database.history, *asked)


def test_changes_of_a_row_follow_each_other_in_the_history(database: Database):
    cases.add_demo(database)
    version = cases.train(database, release=True)
    with database.writing() as session:
        withdraw(session, find_surgeon(session, "kestrel"), version.suture, "test")
    with database.reading() as session:
        of_release = (LEAVES.c.table_name == "releases", LEAVES.c.key == str(session.scalar(select(Release.row))))
        entries = session.scalars(select(LEAVES.c.entry).where(*of_release).order_by(LEAVES.c.row)).all()
    assert len(entries) == 2
    assert leaf_hash(entries[0].encode()).hex() in entries[1]
    assert wrong_in(database) == []


def test_without_its_key_the_history_is_neither_written_nor_verified(tmp_path: Path):
    url, key = backends.blank("sqlite", tmp_path), tmp_path / "state" / "key"
    (tmp_path / "data").mkdir()
    url = url.replace(str(tmp_path), str(tmp_path / "data"))
    with closing(Database(url, signing_key=key)) as database:
        database.migrate()
        assert key.stat().st_mode & 0o777 == 0o600
        cases.add_surgeon(database)
    key.rename(tmp_path / "away")
    with closing(Database(url, signing_key=key)) as database:
        database.migrate()
        with pytest.raises(NotReady, match="is missing"), database.writing() as session:
            put_surgeon(session, "heron", SurgeonIn(), "test")
        assert "is missing" in wrong_in(database)[0][1]
    key.write_text(str(SigningKey(b"another" * 4 + b"key!")))
    with closing(Database(url, signing_key=key)) as database:
        assert any("not signed with the key" in why or "seal is wrong" in why for _, why in wrong_in(database))


def test_a_key_beside_the_database_is_refused(tmp_path: Path):
    database = Database(backends.blank("sqlite", tmp_path), signing_key=tmp_path / "keys" / "key")
    with closing(database), pytest.raises(BadSettings, match="in the folder of the database"):
        database.migrate()


def test_a_database_in_the_home_folder_may_have_its_key_below_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    url = backends.blank("sqlite", tmp_path)
    with closing(Database(url, signing_key=tmp_path / ".local" / "state" / "key")) as database:
        database.migrate()
    with (
        closing(Database(backends.blank("sqlite", tmp_path), signing_key=tmp_path / "key")) as database,
        pytest.raises(BadSettings, match="in the folder of the database"),
    ):
        database.migrate()


def test_a_tree_that_was_changed_is_not_signed_on(full: Database):
    with full.engine.execution_options(writes=True).connect() as connection:
        connection.exec_driver_sql("UPDATE surgeons SET skill_level = 'expert'")
        full.history.settle(connection)
        on = {"sqlite": "", "postgresql": " ON history_checkpoints"}[connection.dialect.name]
        connection.exec_driver_sql(f"DROP TRIGGER history_checkpoints_append_only{on}")
        connection.execute(CHECKPOINTS.update().values(subtrees=b"0" * 32))
        with pytest.raises(Corrupt, match="nothing is signed on top"):
            full.history.sign(connection)
        connection.rollback()


def test_a_head_that_a_full_disk_cuts_off_leaves_the_last_one(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    file, key = tmp_path / "heads", SigningKey(b"k" * 32)
    first, second, third = (key.sign(Checkpoint("suture-skills/0", size, bytes(32))) for size in (1, 2, 3))
    save_head(file, first)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    for beyond in range(0, len(second), 7):  # a disk takes a part of a write, where a block ends
        resource.setrlimit(resource.RLIMIT_FSIZE, (file.stat().st_size + beyond, limits[1]))
        try:
            save_head(file, second)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert last_head(file) == read_notes(first)[0]
    assert "could not be appended" in caplog.text
    save_head(file, third)
    assert last_head(file) == read_notes(third)[0]
    assert len(read_notes(file.read_text())) == 2


def test_a_head_that_cannot_be_kept_is_no_reason_to_stop(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    note = SigningKey(b"k" * 32).sign(Checkpoint("suture-skills/0", 0, Tree().root))
    save_head(tmp_path / "none" / "heads", note)
    assert "could not be appended" in caplog.text
    assert "SKILLS_CHECKPOINTS" in caplog.text
    assert os.listdir(tmp_path) == []


def test_what_another_installation_sealed_is_served_once_it_is_signed(database: Database, tmp_path: Path):
    """A backup brings leaves that the key of another installation sealed; they are signed when they are adopted."""
    cases.add_demo(database)
    policy = cases.train(database, release=True).sha256
    back_up(database, tmp_path / "b.zip")
    (place := tmp_path / "other").mkdir()
    with closing(Database(backends.blank("sqlite", place), signing_key=tmp_path / "other.key")) as other:
        restore(other, tmp_path / "b.zip")
        with other.reading() as session:
            assert served_release(session, "kestrel", cases.SUTURE).policy.sha256 == policy
            keys = list(latest_leaves(session.connection(), "releases", ["1"]))
            assert edited_rows(session.connection(), other.history, "releases", keys) == []
        with tampering(other) as connection:
            connection.execute(update(Release).values(released_by="somebody else"))
            assert edited_rows(connection, other.history, "releases", keys) == keys == ["1"]
