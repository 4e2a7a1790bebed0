"""The use cases on both back ends: concurrent requests give one result, and withdrawn inputs none."""

import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from sqlalchemy import delete, func, select, text
from sqlalchemy.orm import Session

from skills.db import Base
from skills.db.models import ParsedRecording, PolicyVersion, StoredRecording
from skills.db.service_tables import Event, Job
from skills.db.session import Database
from skills.demonstration import segments
from skills.errors import Conflict, Corrupt, Erased
from skills.gridworld.grid import PAPER_GRID, discretisation_rmse, discretize
from skills.learning.dynamic_programming import ValueIteration
from skills.learning.max_ent_irl import MaxEntIRL
from skills.library import perform as library
from skills.library.operation import jobs, styles
from skills.library.operation.integrity import learnt
from skills.library.people.erasure import erase_surgeon
from skills.library.people.surgeons import find_surgeon, put_surgeon
from skills.library.people.suture_types import seed_suture_types
from skills.library.policies import releases
from skills.library.policies.requests import TrainingRequest
from skills.library.policies.versions import served_release
from skills.library.recordings.demos import add_demo, find_demo, withdraw_demo
from skills.library.recordings.recordings import recording_bytes, store_recording
from skills.schemas.demos import DemoIn
from skills.schemas.people import SurgeonIn
from skills.settings import Settings
from tests import backends
from tests.library import cases

AT_ONCE = 8
SHAKE = np.random.default_rng(5).normal(0, 0.4, (150, 3)).clip(-1, 1)  # mm, less than a quarter of a cell
TREMBLING = cases.table(cases.points_mm(samples=50) + SHAKE)


def at_once(what: Callable[[int], Any]) -> list[Any]:
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return list(pool.map(what, range(AT_ONCE)))


def counts(database: Database) -> dict[str, int]:
    with database.reading() as session:
        found = {
            t: session.scalar(select(func.count()).select_from(Base.metadata.tables[t]))
            for t in Base.metadata.tables
            if not t.startswith("history")
        }
        return {table: rows for table, rows in found.items() if rows}


def test_the_catalogue_is_seeded_once(database: Database):
    assert cases.committed(database, seed_suture_types) == 0
    assert counts(database)["suture_types"] == 11


def test_a_recording_is_looked_at_before_the_transaction_that_stores_it(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    begun: list[int] = []
    looked: list[bool] = []
    writing, look = Database.writing, segments._analyse

    @contextmanager
    def watched(self: Database, names: Iterable[str] | None = None) -> Iterator[Session]:
        with writing(self, names) as session:
            begun.append(1)
            try:
                yield session
            finally:
                begun.pop()

    def seen(*given: Any) -> Any:
        looked.append(bool(begun))
        return look(*given)

    monkeypatch.setattr(Database, "writing", watched)
    monkeypatch.setattr(segments, "_analyse", seen)
    demo = cases.add_demo(database, cases.hand_off((7.5, 0.0, 0.0)))
    with writing(database) as session:
        session.execute(delete(ParsedRecording))
    add_demo(database, demo.recording.sha256, DemoIn(surgeon="kestrel", suture=cases.SUTURE, segment="whole"), "test")
    store_recording(database, cases.upload(cases.hand_off((7.5, 2.5, 0.0))), "test")
    assert looked == [False] * 3


def test_the_same_upload_eight_times_at_once_is_one_demonstration(database: Database):
    rows = at_once(lambda _: cases.add_demo(database).sha256)
    assert len(set(rows)) == 1
    found = counts(database)
    assert (found["recordings"], found["demonstrations"], found["reward_maps"]) == (1, 1, 1)


def test_a_demo_with_hysteresis_is_another_one(database: Database):
    without = cases.add_demo(database).sha256
    assert cases.add_demo(database, hysteresis=0.0).sha256 == without
    assert cases.add_demo(database, hysteresis=0.25).sha256 != without
    assert counts(database)["demonstrations"] == 2


def test_hysteresis_is_kept_with_the_path_and_learnt_and_planned_with(database: Database):
    demo = cases.add_demo(database, TREMBLING, hysteresis=0.25)
    plain = cases.add_demo(database, TREMBLING)
    with database.reading() as session:
        kept = find_demo(session, demo.sha256)
        assert (kept.hysteresis, kept.path.hysteresis) == (0.25, 0.25)
        path, tip_mm = kept.path, kept.demo.tip_mm
    assert path.states.tolist() == discretize(tip_mm, PAPER_GRID, 0.25).states.tolist()
    assert (demo.report.path_states, demo.report.revisits) == (len(path.states), 0)
    assert plain.report.revisits > 0
    lost_mm = tuple(discretisation_rmse(tip_mm, PAPER_GRID, 0.25))
    assert demo.report.discretisation_rmse_mm == lost_mm != plain.report.discretisation_rmse_mm
    version = cases.train(database, demos=[demo.sha256], release=True)
    assert version.manifest.metrics.discretisation_rmse_mm == tuple(lost_mm)
    assert version.manifest.metrics.exact_states == len(path.states)
    assert cases.add_plan(database).about.path == "fitted"


def test_a_hysteresis_that_cannot_be_meant_leaves_no_row(database: Database):
    before = counts(database)
    for hysteresis in (-0.1, 0.6, math.nan):
        with pytest.raises(ValidationError):
            cases.add_demo(database, hysteresis=hysteresis)
    assert counts(database) == before


def test_the_same_surgeon_eight_times_at_once_is_one_surgeon(database: Database):
    def put(_: int) -> None:
        cases.committed(database, put_surgeon, "heron", SurgeonIn(), "test")

    at_once(put)
    assert counts(database)["surgeons"] == 2


def test_the_same_training_eight_times_at_once_is_one_job(database: Database):
    cases.add_demo(database)
    assert len({job.id for job in at_once(lambda _: cases.ask_training(database))}) == 1
    assert counts(database)["jobs"] == 1


def test_a_job_performed_twice_makes_one_version(database: Database):
    cases.add_demo(database)
    job = cases.work(database, cases.ask_training(database, release=True))
    first = job.result
    library.perform_job(database, job.row, job.attempt, Settings(database_url=database.url))
    assert cases.work(database, job).result == first
    assert counts(database)["policy_versions"] == counts(database)["releases"] == 1


def test_the_same_training_gives_the_same_digest_in_any_database(database: Database, tmp_path: Path):
    other = Database(backends.fresh("sqlite", tmp_path))
    cases.add_surgeon(other)
    for one in (database, other):
        cases.add_demo(one)
    assert cases.train(database).sha256 == cases.train(other).sha256
    other.close()


def interrupted(monkeypatch: pytest.MonkeyPatch, meanwhile: Callable[[], None]) -> None:
    """Run a callback after the learning and before its result is stored."""
    train = library.PERFORMERS[TrainingRequest]

    def make(*asked: Any) -> Any:
        store = train(*asked)
        meanwhile()
        return store

    monkeypatch.setitem(library.PERFORMERS, TrainingRequest, make)


def test_a_job_cancelled_while_it_learns_leaves_no_policy(database: Database, monkeypatch: pytest.MonkeyPatch):
    cases.add_demo(database)
    job = cases.ask_training(database, release=True)

    def cancel() -> None:
        cases.committed(database, jobs.cancel, job.id, "test")

    interrupted(monkeypatch, cancel)
    assert cases.work(database, job).state == "cancelled"
    assert {"policy_versions", "releases"}.isdisjoint(counts(database))


def test_a_demonstration_withdrawn_while_it_is_learnt_leaves_no_policy(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    demo = cases.add_demo(database)

    def withdraw() -> None:
        cases.committed(database, withdraw_demo, demo.sha256, "test")

    interrupted(monkeypatch, withdraw)
    job = cases.work(database, cases.ask_training(database, release=True))
    assert (job.state, job.error) == ("failed", "A demonstration was withdrawn while the training used it.")
    assert {"policy_versions", "releases"}.isdisjoint(counts(database))


def test_a_surgeon_erased_while_the_style_is_learnt_leaves_nothing(database: Database, monkeypatch: pytest.MonkeyPatch):
    cases.add_demo(database)
    job = cases.ask_training(database)

    def erase() -> None:
        cases.committed(database, erase_surgeon, "kestrel", "test")

    interrupted(monkeypatch, erase)
    with database.writing() as session:
        session.get_one(Job, job.row).state = "running"
    with pytest.raises(Conflict, match="was erased"):
        library.perform_job(database, job.row, job.attempt, Settings(database_url=database.url))
    assert set(counts(database)) == {"suture_types", "events", "erasures"}


def test_erasure_leaves_no_row_and_events_without_a_name(database: Database):
    cases.trained(database, release=True)
    cases.add_plan(database)
    with database.writing() as session:
        subject = find_surgeon(session, "kestrel").subject
        erase_surgeon(session, "kestrel", "test")
    assert set(counts(database)) == {"suture_types", "events", "erasures"}
    with database.reading() as session:
        events = session.scalars(select(Event)).all()
        assert not any("kestrel" in str(vars(event)) for event in events)
        assert events[-1].action == "erase"
        assert events[-1].subject == subject
        with pytest.raises(Erased, match="another pseudonym"):
            find_surgeon(session, "kestrel")


def test_a_recording_whose_chunk_was_changed_is_not_given_back_whole(database: Database):
    cases.add_demo(database)
    with database.writing() as session:
        drop = {"sqlite": "DROP TRIGGER recording_chunks_append_only"}
        on_server = "DROP TRIGGER recording_chunks_append_only ON recording_chunks"
        session.execute(text(drop.get(database.engine.dialect.name, on_server)))
        session.execute(text("UPDATE recording_chunks SET data = :data"), {"data": b"other bytes"})
    with database.reading() as session, pytest.raises(Corrupt, match="does not match its digest"):
        list(recording_bytes(session, session.scalars(select(StoredRecording)).one()))


def test_what_was_released_is_what_was_learnt(database: Database):
    demo = cases.add_demo(database)
    version = cases.train(database, release=True)
    with database.reading() as session:
        served = served_release(session, "kestrel", cases.SUTURE)
        assert served.policy.sha256 == version.sha256
        assert learnt(served.policy).path.states.tolist() == find_demo(session, demo.sha256).path.states.tolist()


def test_the_first_page_shows_what_the_manifest_states(database: Database):
    cases.trained(database)
    with database.reading() as session:
        manifest = session.scalars(select(PolicyVersion.manifest)).one()
        assert tile(session) == (manifest.waypoints, pytest.approx(manifest.coverage.mean_share))


def tile(session: Session) -> tuple[list[int], float]:
    ((_, listed),) = styles.matrix(session).rows
    shown = next(style.shown for style in listed if style.shown is not None)
    manifest = session.scalars(select(PolicyVersion.manifest)).one()
    assert shown.grid_shape == manifest.grid.shape
    assert shown.dtw_total_mm == pytest.approx(manifest.metrics.dtw_total_mm)
    return shown.waypoints, shown.mean_share


def test_what_value_iteration_finds_may_be_released(database: Database):
    version = cases.trained(database, learner=ValueIteration())
    assert version.releasable
    assert version.manifest.learner == "value-iteration"
    assert version.manifest.metrics.dtw_total_mm == 0
    with database.writing() as session:
        releases.release(session, session.get_one(PolicyVersion, version.row), "test")
    with database.reading() as session:
        assert served_release(session, "kestrel", cases.SUTURE).policy.row == version.row


def test_what_stands_still_on_a_recovered_reward_is_kept_and_refused(database: Database):
    version = cases.trained(database, learner=MaxEntIRL(iterations=30))
    with database.writing() as session:
        kept = session.get_one(PolicyVersion, version.row)
        assert learnt(kept).learner == MaxEntIRL(iterations=30)
        with pytest.raises(Conflict, match="actions are not optimal") as refused:
            releases.release(session, kept, "test")
    assert "starts do not reach the goal" in str(refused.value)


def test_a_failing_version_is_not_released_whatever_its_row_says(database: Database):
    version = cases.trained(database, learner=cases.PUBLISHED)
    with database.writing() as session, pytest.raises(Conflict, match="do not reach the goal"):
        releases.release(session, session.get_one(PolicyVersion, version.row), "test")
    assert "releases" not in counts(database)
