"""An erasure leaves exactly the rows that were there before the erased data came: no more, and no fewer."""

from typing import Any

import pytest
from sqlalchemy import select, text
from sqlalchemy.orm import Session

from skills.db.models import Base, Erasure, Plan, StoredPictures, Surgeon
from skills.db.service_tables import Event, Job
from skills.db.session import Database
from skills.learning.max_ent_irl import MaxEntIRL
from skills.library.operation import sweep
from skills.library.operation.sweep import sweep_erased
from skills.library.people import erasure
from skills.library.people.erasure import erase_demo, erase_surgeon
from skills.library.plans.plans import planned, trajectory_of
from skills.library.policies.training import request_training
from skills.library.recordings.demos import mark_demo
from skills.library.recordings.proposals import decide
from skills.library.recordings.recordings import store_recording
from skills.schemas.training import TrainingIn
from skills.verification.playback import Pictures
from tests.library import cases, exports
from tests.library.styles import ask_retraining, finish
from tests.library.test_pictures import store_playback
from tests.planning.motions import ideal_playback

# Tables that are not of one surgeon, or empty in the tests below.
ALIKE = {"suture_types", "measured_shapes", "calibrations", "loose_chunks", "erased_surgeons", "executors"} | {
    *("keys", "key_surgeons", "sign_ins", "erased_intervals", "used_numbers"),
}
LOGS = {"events", "erasures", "history", "history_checkpoints", "history_tiles"}  # every change adds to them


def rows(database: Database) -> dict[str, list[tuple[Any, ...]]]:
    """Return every row of every table but the logs, without regard to what may be seen."""
    found = {}
    with database.engine.connect() as connection:
        for table in Base.metadata.sorted_tables:
            if table.name not in LOGS:
                every = connection.execute(text(f"SELECT * FROM {table.name}"))
                found[table.name] = sorted((tuple(row) for row in every), key=repr)
    return found


def learn(database: Database, surgeon: str, demo: str, other: str | None, seed: int, **asked: Any) -> None:
    """Learn from a demonstration, and from two; plan, play and draw it; and leave a job that has not ended."""
    version = cases.train(database, surgeon, demos=[demo], seed=seed, **asked)
    cases.train(database, surgeon, demos=[demo], seed=seed, learner=MaxEntIRL(iterations=2))
    if other is not None:
        cases.train(database, surgeon, demos=[demo, other], combine="medoid", seed=seed)
    plan = cases.add_plan(database, surgeon, version=version.version)
    with database.writing() as session:
        measured = ideal_playback(trajectory_of(planned(session.get_one(Plan, plan.row))))
        playback = store_playback(session, plan, f"{seed:064x}", measured)
        session.add(StoredPictures(playback_row=playback.row, drawn=Pictures(b"mp4", b"gif", b"png", b"png")))
        mark_demo(session, demo, "success", None, "test")
    with database.writing() as session:
        request_training(session, TrainingIn(surgeon=surgeon, suture=cases.SUTURE, demos=[demo], seed=seed + 1), "test")


def whole(database: Database, surgeon: str, shift: float, seed: int) -> list[str]:
    """Store all that there can be of a surgeon, and return the demonstrations."""
    demos = [exports.add(database, exports.session_of((shift + more, 0.0, 0.0)), surgeon) for more in (0.0, 0.5)]
    sent = cases.upload(cases.hand_off((shift + 1, 0, 0)))
    uncut, _ = store_recording(database, sent, "test", surgeon=surgeon)
    cases.committed(database, decide, uncut.sha256, 1, "rejected", "idle", "test")
    learn(database, surgeon, *demos, seed, release=True)
    job = ask_retraining(database, surgeon=surgeon)
    finish(database, job)
    exports.export(database, demos=demos[:1])
    return demos


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    exports.in_this_process(monkeypatch)


@pytest.mark.parametrize("in_steps", [False, pytest.param(True, marks=pytest.mark.nightly)])
def test_erasing_leaves_what_was_there_before_and_nothing_else(database: Database, in_steps: bool, monkeypatch):
    (first, _) = whole(database, "kestrel", 0.0, 1)
    before = rows(database)
    cases.add_surgeon(database, "osprey")
    whole(database, "osprey", 2.0, 11)
    with_osprey = rows(database)
    assert {name for name in before if with_osprey[name] == before[name]} == ALIKE
    demo = exports.add(database, exports.session_of((4.0, 0.0, 0.0)))
    learn(database, "kestrel", demo, first, 21)
    if in_steps:
        monkeypatch.setattr(sweep, "JOBS_AT_ONCE", 1)
        monkeypatch.setattr(erasure, "AT_ONCE_BYTES", 1)

    with database.writing() as session:
        assert queued_of(session, "kestrel") == 4
        assert len(erase_demo(session, demo[:12], "test")) == 2
        assert queued_of(session, "kestrel") == 2
    sweep_erased(database)
    left = rows(database)
    assert [numbers[1:] for numbers in left["used_numbers"]] == [(1, cases.SUTURE, 7)]
    with_osprey["used_numbers"] = before["used_numbers"] = left["used_numbers"]  # no version is a seventh again
    assert left == with_osprey

    with database.writing() as session:
        subject = session.query(Surgeon).filter_by(slug="osprey").one().subject
        theirs = queued_of(session, "osprey")
        assert len(erase_surgeon(session, "osprey", "test")) == theirs == 2
    assert (rows(database) != before) == in_steps
    sweep_erased(database)
    assert rows(database) == before
    with database.reading() as session:
        said = session.query(Event).filter_by(action="erase").order_by(Event.row)
        assert [(one.object_kind, one.object_id) for one in said] == [("demonstration", demo), ("surgeon", subject)]
        assert session.query(Erasure).count() == 1


def queued_of(session: Session, surgeon: str) -> int:
    """Count the jobs of a surgeon that have not ended."""
    theirs = select(Surgeon.row).where(Surgeon.slug == surgeon).scalar_subquery()
    return session.query(Job).filter(Job.surgeon_row == theirs, Job.state == "queued").count()
