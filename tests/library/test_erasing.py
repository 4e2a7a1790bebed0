"""Erasure: concurrent measurements, recordings without a demonstration, and surgeons with very many jobs."""

import secrets
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event, insert, select, text

from skills import db
from skills.db import leaves, logged_rows
from skills.db.models import Demonstration, MeasuredShape, PolicyVersion, RecordingChunk, StoredRecording, Surgeon
from skills.db.service_tables import Job
from skills.db.session import Database
from skills.errors import Conflict, NotAllowed, NotFound
from skills.library.comparison import measuring
from skills.library.comparison.atlas import atlas_of
from skills.library.comparison.neighbours import nearest_to
from skills.library.operation import sweep
from skills.library.operation.backup import back_up, restore
from skills.library.operation.erasure_list import erasures_of, keep_up_erasures, read_erasures
from skills.library.operation.sweep import sweep_erased
from skills.library.people.erasure import delete_recording, erase_demo, erase_surgeon
from skills.library.people.surgeons import put_surgeon
from skills.library.recordings.demos import add_demo, withdraw_demo
from skills.library.recordings.recordings import store_recording
from skills.schemas.demos import DemoIn
from skills.schemas.people import SurgeonIn
from tests import backends
from tests.comparison.cohort import cohort
from tests.db.test_query_plans import noted, plan_of
from tests.library import cases, cohorts
from tests.library.styles import ask_retraining, parts_of


def test_cached_distances_to_erased_demos_outside_the_atlas_are_deleted(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    """A cached row also has distances from demonstrations outside of the atlas, such as those without consent now."""

    def agrees(surgeon: int, to: list[str]) -> None:
        with database.writing() as session:
            put_surgeon(
                session,
                cohorts.name(surgeon),
                SurgeonIn.model_validate({"consent": {"uses": to, "until": None}}),
                "test",
            )

    cohorts.add_cohort(database, cohort(1, surgeons=3, sessions=1))
    agrees(1, [])
    atlas_of(database, cases.SUTURE)  # the first now has a distance from the third
    agrees(1, ["atlas"])
    agrees(2, [])
    really = measuring.distances_of

    def erase_first(shapes, pairs):
        with database.writing() as session:
            if session.scalar(select(Surgeon).where(Surgeon.slug == cohorts.name(2))):
                erase_surgeon(session, cohorts.name(2), "test")
        return really(shapes, pairs)

    monkeypatch.setattr(measuring, "distances_of", erase_first)
    atlas_of(database, cases.SUTURE)
    with database.reading() as session:
        there = set(session.scalars(select(Demonstration.row)))
        kept = session.scalars(select(MeasuredShape)).all()
    assert {row for one in kept for row in one.measured.others.tolist()} <= there
    monkeypatch.setattr(measuring, "distances_of", really)
    atlas_of(database, cases.SUTURE)
    with database.reading() as session:
        assert len(session.scalars(select(MeasuredShape)).all()) == 2


def test_an_erasure_deletes_no_shape_of_another_that_has_no_distances(database: Database):
    cohorts.add_cohort(database, cohort(1, surgeons=3, sessions=1))
    with database.reading() as session:
        demos = {one.surgeon.slug: (one.row, one.sha256) for one in session.scalars(select(Demonstration))}
    nearest_to(database, demos[cohorts.name(0)][1], 1)

    def cached() -> set[int]:
        with database.reading() as session:
            return {*session.scalars(select(MeasuredShape.demonstration_row))}

    assert cached() == {row for row, _ in demos.values()}
    cases.committed(database, erase_surgeon, cohorts.name(0), "test")
    assert cached() == {demos[cohorts.name(k)][0] for k in (1, 2)}
    atlas_of(database, cases.SUTURE)  # now one of them has a distance from the other
    cases.committed(database, erase_surgeon, cohorts.name(1), "test")
    assert cached() <= {demos[cohorts.name(2)][0]}
    with database.reading() as session:
        assert all(len(one.measured.others) == 0 for one in session.scalars(select(MeasuredShape)))


# ---- recordings without a demonstration ----------------------------------------------------------------------------


def stored(database: Database, shift: float = 0.0, actor: str = "anna", surgeon: str | None = None) -> str:
    return store_recording(database, cases.upload(cases.hand_off((shift, 0.0, 0.0))), actor, surgeon=surgeon)[0].sha256


def recordings(database: Database) -> list[str]:
    with database.reading() as session:
        found = list(session.scalars(select(StoredRecording.sha256).order_by(StoredRecording.row)))
        assert (len(session.scalars(select(RecordingChunk.recording)).all()) > 0) == bool(found)
    return found


def test_a_recording_is_deleted_by_whoever_sent_it_or_by_an_admin(database: Database):
    mine, others = stored(database), stored(database, 2.5, "bert")
    with database.writing() as session:
        with pytest.raises(NotAllowed, match="Another user"):
            delete_recording(session, others, "anna", as_admin=False)
        delete_recording(session, mine, "anna", as_admin=False)
        with pytest.raises(NotFound):
            delete_recording(session, mine, "anna", as_admin=False)
    assert recordings(database) == [others]
    cases.committed(database, delete_recording, others, "local", as_admin=True)
    assert recordings(database) == []
    assert set(erasures_of(database).ended["recordings"]) == {mine, others}


def test_a_recording_that_somebody_else_sent_as_well_stays_theirs(database: Database):
    sent = stored(database, actor="anna")
    assert stored(database, actor="bert") == sent
    cases.committed(database, delete_recording, sent, "anna", as_admin=False)
    assert recordings(database) == [sent]
    with database.writing() as session, pytest.raises(NotAllowed):
        delete_recording(session, sent, "anna", as_admin=False)
    cases.committed(database, delete_recording, sent, "bert", as_admin=False)
    assert recordings(database) == []


def test_a_recording_with_demos_is_kept_until_its_last_demo_is_erased(database: Database):
    sent = stored(database)
    cuts = [DemoIn(surgeon="kestrel", suture=cases.SUTURE, end_s=end) for end in (0.9, 1.0)]
    demos = [add_demo(database, sent, cut, "anna")[0].sha256 for cut in cuts]
    with database.writing() as session:
        withdraw_demo(session, demos[0], "test")
        with pytest.raises(Conflict, match="depend on this recording"):
            delete_recording(session, sent, "anna", as_admin=True)
        erase_demo(session, demos[0], "test")
    assert recordings(database) == [sent]
    cases.committed(database, erase_demo, demos[1], "test")
    assert recordings(database) == []


def test_erasing_a_surgeon_removes_recordings_uploaded_for_them_alone(database: Database):
    cases.add_surgeon(database, "plover")
    stored(database, surgeon="kestrel")
    both = stored(database, 2.5, surgeon="kestrel")
    assert stored(database, 2.5, surgeon="plover") == both
    cut = stored(database, 5.0, surgeon="kestrel")
    add_demo(database, cut, DemoIn(surgeon="plover", suture=cases.SUTURE), "anna")
    nobodys = stored(database, 7.5)
    cases.committed(database, erase_surgeon, "kestrel", "test")
    assert recordings(database) == [both, cut, nobodys]
    cases.committed(database, erase_surgeon, "plover", "test")
    assert recordings(database) == [nobodys]
    with pytest.raises(NotFound, match="nobody"):
        stored(database, 9.0, surgeon="nobody")


def test_erasing_anothers_demo_keeps_the_recording_of_its_stated_owner(database: Database):
    cases.add_surgeon(database, "plover")
    sent = stored(database, surgeon="plover")
    demo = add_demo(database, sent, DemoIn(surgeon="kestrel", suture=cases.SUTURE), "anna")[0].sha256
    cases.committed(database, erase_demo, demo, "test")
    assert recordings(database) == [sent]


def test_a_deleted_recording_does_not_come_back_with_a_backup(database: Database, tmp_path):
    gone, kept = stored(database), stored(database, 2.5)
    back_up(database, tmp_path / "b.zip")
    cases.committed(database, delete_recording, gone, "anna", as_admin=False)
    restored = Database(backends.blank("sqlite", tmp_path))
    assert restore(restored, tmp_path / "b.zip", erasures_of(database)).recordings_deleted == 1
    assert recordings(restored) == [kept]
    restored.close()


# ---- version numbers -----------------------------------------------------------------------------------------------


def numbered(database: Database, demo: str, seed: int = 0) -> tuple[int, str]:
    version = cases.train(database, demos=[demo], seed=seed, release=True)
    return version.version, version.sha256


def test_the_number_of_an_erased_version_is_never_used_again(database: Database):
    first, second = (cases.add_demo(database, cases.hand_off((x, 0.0, 0.0))).sha256 for x in (0.0, 2.5))
    assert numbered(database, first)[0] == 1
    _, before = numbered(database, second)
    cases.committed(database, erase_demo, second, "test")
    assert numbered(database, first, seed=1)[0] == 3
    third = cases.add_demo(database, cases.hand_off((5.0, 0.0, 0.0))).sha256
    number, after = numbered(database, third)
    assert number == 4 and after != before
    with database.writing() as session:
        for demo in (first, third):
            erase_demo(session, demo, "test")
    assert numbered(database, cases.add_demo(database).sha256)[0] == 5


def test_a_batch_uses_no_number_again_either(database: Database):
    demo = cases.add_demo(database).sha256
    other = cases.add_demo(database, cases.hand_off((2.5, 0.0, 0.0))).sha256
    assert numbered(database, other)[0] == 1
    cases.committed(database, erase_demo, other, "test")
    (part,) = parts_of(database, ask_retraining(database))
    cases.work(database, part)
    with database.reading() as session:
        (version,) = session.scalars(select(PolicyVersion)).all()
    assert (version.version, version.manifest.demos) == (2, [demo])


@pytest.mark.parametrize("erased", [False, True])
def test_a_restored_backup_uses_no_number_again(database: Database, tmp_path: Path, erased: bool):
    first, second = (cases.add_demo(database, cases.hand_off((x, 0.0, 0.0))).sha256 for x in (0.0, 2.5))
    assert numbered(database, first)[0] == 1
    back_up(database, tmp_path / "b.zip")
    known = keep_up_erasures(database, tmp_path / "erasures.json")
    assert numbered(database, second)[0] == 2
    if erased:
        cases.committed(database, erase_demo, second, "test")
    keep_up_erasures(database, tmp_path / "erasures.json", known)
    with closing(Database(backends.blank("sqlite", tmp_path))) as restored:
        restore(restored, tmp_path / "b.zip", read_erasures(str(tmp_path / "erasures.json")))
        assert numbered(restored, first, seed=1)[0] == 3
        assert numbered(restored, first, seed=2)[0] == 4


# ---- very many rows ------------------------------------------------------------------------------------------------


def many_jobs(database: Database, count: int) -> None:
    """Add jobs of kestrel, one of them running."""
    at = db.now()
    with database.writing() as session:
        row = session.scalars(select(Surgeon.row).where(Surgeon.slug == "kestrel")).one()
        jobs = [
            {"id": secrets.token_hex(16), "kind": "training", "identity": secrets.token_hex(32), "state": state}
            | {
                "request": {},
                "surgeon_row": row,
                "progress": 0.0,
                "attempt": 1,
                "requested_by": "t",
                "created_at": at,
            }
            for state in ("running", *["failed"] * (count - 1))
        ]
        session.execute(insert(Job), jobs)


def test_erasing_binds_no_more_parameters_for_more_rows(database: Database, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(db, "PARAMETERS", 7)
    for module in (leaves, logged_rows):
        monkeypatch.setattr(module, "ROWS_AT_ONCE", 7)
    most: list[int] = []

    def count(_connection: Any, _cursor: Any, _statement: str, parameters: Any, _context: Any, many: bool) -> None:
        most.append(0 if many else len(parameters))

    demos = [cases.add_demo(database, cases.hand_off((0.5 * n, 0.0, 0.0))).sha256 for n in range(12)]
    many_jobs(database, 60)
    with database.writing() as session:
        for job in session.scalars(select(Job)):
            job.request = {"demos": demos[:1]}
    event.listen(database.engine, "before_cursor_execute", count)
    with database.writing() as session:
        assert len(erase_demo(session, demos[0], "test")) == 1
        assert len(session.scalars(select(Job)).all()) == 0
    many_jobs(database, 60)
    with database.writing() as session:
        assert len(erase_surgeon(session, "kestrel", "test")) == 1
    event.remove(database.engine, "before_cursor_execute", count)
    assert 3 < max(most) <= 16
    with database.reading() as session:
        assert [session.scalars(select(kind)).all() for kind in (Job, Demonstration, StoredRecording)] == [[], [], []]


def test_steps_take_fewer_jobs_while_they_take_longer_than_others_may_wait(database: Database, monkeypatch):
    """A step seems to take 0.1 s, the next one 0.2 s, and then none any time."""
    cases.add_surgeon(database)
    many_jobs(database, 1000)
    cases.committed(database, erase_surgeon, "kestrel", "test")
    clock = iter([0.0, 0.1, 0.1, 0.3, *[0.3] * 20])
    monkeypatch.setattr(sweep, "monotonic", lambda: next(clock))
    steps = []

    def note(_conn: object, _cursor: object, statement: str, values: Any, *_: object) -> None:
        if statement.startswith("DELETE FROM jobs"):
            steps.append(len(values))

    event.listen(database.engine, "before_cursor_execute", note)
    sweep_erased(database)
    assert steps == [75, 37, 20, 40, 80, 160, 300, 287]


def test_an_erasure_does_not_walk_along_the_jobs_that_have_ended(database: Database):
    cases.add_surgeon(database)
    many_jobs(database, 1000)
    with database.engine.execution_options(isolation_level="AUTOCOMMIT").connect() as connection:
        connection.execute(text("ANALYZE"))
    with noted(database) as asked, database.writing() as session:
        erase_surgeon(session, "kestrel", "test")
    (found,) = [one for one in asked if "attempt" in one[0] and "surgeon_row" in one[0]]
    with database.reading() as session:
        assert "ix_jobs_state" in str(plan_of(session, *found))


@pytest.mark.nightly
@pytest.mark.parametrize("count", [20_000, 70_000])
def test_a_surgeon_with_very_many_jobs_is_erased(database: Database, count: int):
    many_jobs(database, count)
    began_s, worked_s = time.perf_counter(), time.process_time()
    with database.writing() as session:
        assert len(erase_surgeon(session, "kestrel", "test")) == 1
    took_s, worked_s = time.perf_counter() - began_s, time.process_time() - worked_s
    print(f"{database.engine.dialect.name}, {count} jobs: {took_s:.2f} s, {worked_s:.2f} s of this process")
    assert worked_s < 20
