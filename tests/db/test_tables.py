"""Refusals by the database itself, on both back ends: changes of append-only rows, and missing references."""

from collections.abc import Iterator

import numpy as np
import pytest
from sqlalchemy import inspect, text
from sqlalchemy.exc import DatabaseError, IntegrityError

from skills.comparison.distances import STATES, Measured
from skills.db import Base, models, now, service_tables
from skills.db.session import Database
from skills.library.people.keys import create_key
from skills.library.people.sign_ins import SignInLifetime, sign_in
from skills.verification.playback import Pictures
from tests import backends
from tests.db.test_packed import PLAYBACK
from tests.library import cases
from tests.library.styles import retrain
from tests.library.test_scores import calibration
from tests.library.verdicts import verdict_on
from tests.planning.motions import ideal_playback, small_trajectory

FROZEN = (
    "recordings",
    "recording_chunks",
    "proposal_marks",
    "erased_intervals",
    "used_numbers",
    "reward_maps",
    "policy_versions",
    "policy_demonstrations",
    "pose_styles",
    "plans",
    "playbacks",
    "playback_pictures",
    "calibrations",
    "demonstration_outcomes",
    "dataset_demonstrations",
    "datasets",
    "dataset_chunks",
    "events",
    "erasures",
)
# Who uploaded it, for which surgeon, and the cache of its content.
GONE_WITH_ITS_RECORDING = {"recording_uploads", "recording_surgeons", "parsed_recordings", "parsed_chunks"}
WITHDRAWABLE = ("demonstrations", "releases")
FREE = {
    "surgeons", "suture_types", "jobs", "retraining_styles", "executors", "keys", "key_surgeons", "sign_ins",
    "measured_shapes", "loose_chunks", "erased_surgeons",
}  # fmt: skip
THE_HISTORY = {"history", "history_checkpoints", "history_tiles"}  # see `test_history.py`


@pytest.fixture(scope="module", params=backends.BACKENDS)
def full(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Database]:
    """Yield a database with at least one row in every append-only table."""
    with backends.opened(backends.fresh(request.param, tmp_path_factory.mktemp("full"))) as database:
        fill(database)
        yield database


def fill(database: Database) -> None:
    """Add at least one row to every append-only table, and keys."""
    cases.add_surgeon(database)
    demo, other = (cases.add_demo(database, cases.hand_off((shift, 0.0, 0.0))) for shift in (0.0, 1.0))
    cases.train(database, demos=[demo.sha256, other.sha256])
    cases.train(database, release=True)
    posed = cases.store(database, cases.upload(cases.bag(), "application/vnd.mcap"))
    cases.train(database, demos=[posed.sha256])
    plan = cases.add_plan(database)
    retrain(database)
    with database.writing() as session:
        motion = small_trajectory(1)
        verdict = verdict_on(plan.sha256, motion, ideal_playback(motion))
        played = models.StoredPlayback(
            sha256="0" * 64, plan_row=plan.row, feasible=True, report=verdict, measured=PLAYBACK
        )
        session.add(played)
        session.flush()
        session.add(models.StoredPictures(playback_row=played.row, drawn=Pictures(b"mp4", b"gif", b"png", b"png")))
        session.add(models.StoredCalibration(sha256="0" * 64, about=calibration("Suturing")))
        session.add(
            models.DemonstrationOutcome(demonstration_row=demo.row, outcome="failure", reason="fell", actor="ada")
        )
        session.add(models.ProposalMark(recording_row=demo.recording_row, number=1, state="rejected", actor="ada"))
        job = service_tables.Job(id="0" * 16, kind="dataset", identity="0" * 64, request={})
        session.add(job)
        session.flush()
        exported = {"demonstration_row": demo.row, "split": "train", "whole": False}
        session.add(service_tables.DatasetDemonstration(job_row=job.row, **exported))
        dataset = service_tables.StoredDataset(sha256="0" * 64, job_row=job.row, size_bytes=1)
        session.add(dataset)
        session.flush()
        session.add(service_tables.DatasetChunk(dataset_row=dataset.row, number=0, data=b"0"))
        session.add(models.Erasure(salt="0" * 64, digest="0" * 64))
        session.add(models.ErasedInterval(recording_row=demo.recording_row, surgeon_row=demo.surgeon_row))
        session.add(models.LastUsed(surgeon_row=demo.surgeon_row, suture=cases.SUTURE, last=7))
        session.add(models.RecordingSurgeon(recording_row=demo.recording_row, surgeon_row=demo.surgeon_row))
        shape = Measured(np.zeros((STATES, 3)), np.array([1]), np.array([0.0]), np.array([0.0]), np.ones(3))
        session.add(models.MeasuredShape(demonstration_row=demo.row, version=1, measured=shape))
        key, _ = create_key(session, "ada", "reader", "test", surgeons=["kestrel"])
        sign_in(session, key.id, SignInLifetime(60.0, 600.0))


COLUMNS = [(table, column.name) for table in FROZEN for column in Base.metadata.tables[table].columns]
KEPT = [(t, c.name) for t in WITHDRAWABLE for c in Base.metadata.tables[t].columns if c.name != "withdrawn_at"]


def test_every_table_is_either_append_only_or_known_to_change():
    assert {*FROZEN, *WITHDRAWABLE} | FREE | GONE_WITH_ITS_RECORDING | THE_HISTORY == set(Base.metadata.tables)


def test_no_column_of_an_append_only_table_can_be_updated(full: Database):
    for table, column in COLUMNS + KEPT:
        with full.reading() as session:
            assert session.execute(text(f"SELECT count(*) FROM {table}")).scalar() > 0, table
        new = "row + 1000" if column == "row" else f"(SELECT {column} FROM {table} LIMIT 1)"
        if full.engine.dialect.name == "postgresql" and table in WITHDRAWABLE:
            new = changed(column)
        with pytest.raises(DatabaseError, match=f"{table} is append-only"), full.writing() as session:
            session.execute(text(f"UPDATE {table} SET {column} = {new}"))


def changed(column: str) -> str:
    """Return SQL for a different value of a column; in tables with withdrawal, an equal value is not a change."""
    if column.endswith("row"):
        return "row + 1000"
    if column in ("start_s", "end_s", "hysteresis"):
        return f"{column} + 0.25"
    if column.endswith("_at"):
        return f"{column} + interval '1 second'"
    return {"demo": "'\\x00'", "path": "'\\x00'", "report": "'{}'", "segment": "'{}'"}.get(column, "'other'")


@pytest.mark.parametrize("table", WITHDRAWABLE)
def test_it_is_withdrawn_once_and_for_good(full: Database, table: str):
    with full.writing() as session:
        session.execute(text(f"UPDATE {table} SET withdrawn_at = :now"), {"now": now()})
    for again in (":now", "NULL"):
        with pytest.raises(DatabaseError, match=f"{table} is append-only"), full.writing() as session:
            session.execute(text(f"UPDATE {table} SET withdrawn_at = {again}"), {"now": now()} if ":" in again else {})


def test_every_reference_to_another_table_is_enforced(full: Database):
    with full.reading() as session:
        references = [
            (table, key["constrained_columns"][0])
            for table in Base.metadata.tables
            for key in inspect(session.connection()).get_foreign_keys(table)
        ]
    assert len(references) == sum(len(table.foreign_keys) for table in Base.metadata.tables.values())
    for table, column in references:
        copied = [c.name for c in Base.metadata.tables[table].columns if c.name != "row"]
        nowhere = {"suture": "'nowhere'"}
        unique = {"sha256": "'x'", "version": "9", "id": "'x'", "identity": "'x'", "number": "9", "digest": "'x'"}
        values = ", ".join(nowhere.get(c, "987654") if c == column else unique.get(c, c) for c in copied)
        if table == "reward_maps" or (table, column) == ("recording_chunks", "recording"):
            values = values.replace("demonstration_row", "987654")
        copy = f"INSERT INTO {table} ({', '.join(copied)}) SELECT {values} FROM {table} LIMIT 1"
        with pytest.raises(IntegrityError), full.writing() as session:
            session.execute(text(copy))


def test_what_something_rests_on_cannot_be_deleted(full: Database):
    for table in ("recordings", "surgeons", "demonstrations", "policy_versions", "plans", "playbacks"):
        with pytest.raises(IntegrityError), full.writing() as session:
            session.execute(text(f"DELETE FROM {table}"))


def test_row_numbers_are_never_used_twice(database: Database):
    """The engine identifies a job by its row: an erased row number must not return as another job's."""
    numbers = []
    for name in ("one", "two"):
        with database.writing() as session:
            job = service_tables.Job(id=name, kind="training", identity=name, request={})
            session.add(job)
            session.flush()
            numbers.append(job.row)
            session.execute(text("DELETE FROM jobs"))
    assert numbers[1] > numbers[0]


def test_one_identity_has_one_live_job_and_any_number_of_ended_ones(database: Database):
    def add(name: str, state: str) -> None:
        with database.writing() as session:
            session.add(service_tables.Job(id=name, kind="training", identity="0" * 64, request={}, state=state))

    for name, state in (("1", "failed"), ("2", "cancelled"), ("3", "failed"), ("4", "queued")):
        add(name, state)
    for state in ("queued", "running", "succeeded"):
        with pytest.raises(IntegrityError):
            add("5", state)
    with pytest.raises(IntegrityError):
        add("6", "unheard")


def test_every_constraint_has_a_name():
    for table in Base.metadata.tables.values():
        for constraint in table.constraints:
            assert constraint.name, table.name
