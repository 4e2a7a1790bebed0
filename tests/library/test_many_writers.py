"""Concurrent writers on PostgreSQL: what must wait does, in an order that the test forces, and all else does not."""

from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy import func, select, text
from sqlalchemy.orm import Session

from skills.db.models import Demonstration, PolicyVersion, Release, StoredRecording, Surgeon
from skills.db.service_tables import Event, Job, StyleToRetrain, record_event
from skills.db.session import Database
from skills.errors import Conflict, Erased, NotFound
from skills.library.operation import jobs, locks
from skills.library.operation.erasure_list import keep_up_erasures, read_erasures
from skills.library.people.erasure import delete_recording, erase_surgeon
from skills.library.people.surgeons import put_surgeon
from skills.library.perform import perform_job
from skills.library.policies.releases import in_force, release
from skills.library.policies.requests import TrainingRequest
from skills.library.policies.training import request_training, train_style
from skills.library.policies.versions import find_version
from skills.library.recordings.demos import add_demo
from skills.library.recordings.recordings import store_recording
from skills.schemas.demos import DemoIn
from skills.schemas.people import SurgeonIn
from skills.schemas.training import TrainingIn
from skills.settings import Settings
from tests import backends
from tests.library import cases
from tests.library.styles import ask_retraining, parts_of
from tests.waiting import until

KESTREL = [locks.surgeon("kestrel")]
FORBIDDEN = {"consent": {"uses": [], "until": None}}
WAITING = text("SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND wait_event_type = 'Lock'")


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    with backends.opened(backends.fresh("postgresql", tmp_path)) as database:
        cases.add_surgeon(database)
        yield database


def in_turn(
    database: Database, names: Collection[str] | None, first: Callable[[Session], Any], second: Callable[[], Any]
) -> Any:
    """Do the first in a transaction, and commit when the second, in a thread, waits for it; return its result."""
    with ThreadPoolExecutor(1) as pool:
        with database.writing(names) as session:
            session.connection()  # takes the locks
            first(session)
            session.flush()
            doing = pool.submit(second)
            until(lambda: waits(database) or doing.done())
            assert not doing.done(), "it did not wait"
        return doing.result()


def waits(database: Database) -> bool:
    with database.reading() as session:
        return bool(session.scalar(WAITING))


def learnt(database: Database, job: Job) -> jobs.Store:
    """Carry out a training up to the transaction that stores its result."""
    with database.writing([locks.job(job.row)]) as session:
        session.get_one(Job, job.row).state = "running"
    return train_style(database, TrainingRequest.model_validate(job.request), Settings(database_url=database.url))


def perform(database: Database, job: Job) -> None:
    """Carry out a job as a worker does, which names the locks itself."""
    with database.writing([locks.job(job.row)]) as session:
        session.get_one(Job, job.row).state = "running"
    perform_job(database, job.row, job.attempt, Settings(database_url=database.url))


def put(database: Database, slug: str, **about: Any) -> bool:
    with database.writing([locks.surgeon(slug)]) as session:
        return put_surgeon(session, slug, SurgeonIn.model_validate(about), "test")[1]


def erase(database: Database) -> None:
    cases.committed(database, erase_surgeon, "kestrel", "test")


def served(database: Database) -> list[int]:
    """Return the versions of kestrel's releases that stand, the served one first."""
    with database.reading() as session:
        row = session.scalars(select(Surgeon.row).where(Surgeon.slug == "kestrel")).one()
        return [one.policy.version for one in in_force(session, row, cases.SUTURE)]


def counts(database: Database, *tables: type) -> list[int]:
    with database.reading() as session:
        return [session.scalar(select(func.count()).select_from(one)) or 0 for one in tables]


def test_a_training_that_waits_for_a_withdrawn_consent_stores_nothing(database: Database):
    cases.add_demo(database)
    job = cases.ask_training(database, release=True)
    with pytest.raises(Conflict, match="does not cover training"):
        in_turn(
            database,
            KESTREL,
            lambda session: put_surgeon(session, "kestrel", SurgeonIn.model_validate(FORBIDDEN), "test"),
            lambda: perform(database, job),
        )
    assert counts(database, PolicyVersion, Release) == [0, 0]


def test_a_consent_withdrawn_while_a_training_stores_withdraws_it(database: Database):
    cases.add_demo(database)
    store = learnt(database, cases.ask_training(database, release=True))
    in_turn(database, KESTREL, lambda session: store(session, "test"), lambda: put(database, "kestrel", **FORBIDDEN))
    assert counts(database, PolicyVersion, Release) == [1, 1]
    assert served(database) == []


def test_two_releases_at_once_are_one_above_the_other(database: Database):
    cases.add_demo(database)
    for seed in (1, 2):
        cases.train(database, seed=seed)

    def put_in_force(session: Session, version: int) -> None:
        release(session, find_version(session, "kestrel", cases.SUTURE, version), "test")

    def second() -> None:
        with database.writing(KESTREL) as session:
            put_in_force(session, 1)

    in_turn(database, KESTREL, lambda session: put_in_force(session, 2), second)
    assert served(database) == [1, 2]


def test_two_trainings_at_once_get_two_version_numbers(database: Database):
    cases.add_demo(database)
    first, second = (cases.ask_training(database, seed=seed) for seed in (1, 2))
    store = learnt(database, first)
    in_turn(database, KESTREL, lambda session: store(session, "test"), lambda: perform(database, second))
    with database.reading() as session:
        assert session.scalars(select(PolicyVersion.version).order_by(PolicyVersion.row)).all() == [1, 2]


def test_a_training_that_waits_for_an_erasure_stores_nothing(database: Database):
    cases.add_demo(database)
    store = learnt(database, cases.ask_training(database, release=True))

    def end() -> None:
        with database.writing(KESTREL) as session:
            store(session, "test")

    with pytest.raises(NotFound, match="was erased"):
        in_turn(database, None, lambda session: erase_surgeon(session, "kestrel", "test"), end)
    assert counts(database, PolicyVersion, Release, Demonstration, Job, Surgeon) == [0] * 5


def test_an_erasure_that_waits_for_a_training_erases_it_too(database: Database):
    cases.add_demo(database)
    store = learnt(database, cases.ask_training(database, release=True))
    in_turn(database, KESTREL, lambda session: store(session, "test"), lambda: erase(database))
    assert counts(database, PolicyVersion, Release, Demonstration, Job, Surgeon) == [0] * 5


def test_an_equal_request_at_once_gets_the_job_of_the_first(database: Database):
    cases.add_demo(database)
    asked = TrainingIn(surgeon="kestrel", suture=cases.SUTURE)

    def second() -> bool:
        with database.writing(KESTREL) as session:
            return request_training(session, asked, "test").new

    assert in_turn(database, KESTREL, lambda session: request_training(session, asked, "test"), second) is False
    assert counts(database, Job) == [1]


def test_an_equal_batch_at_once_gets_the_job_of_the_first(database: Database):
    cases.add_demo(database)
    first = ask_retraining(database)
    again = in_turn(database, [locks.BATCHES], lambda _: None, lambda: ask_retraining(database))
    assert again.row == first.row
    assert counts(database, StyleToRetrain) == [1]


def test_a_pseudonym_added_twice_at_once_is_one_surgeon(database: Database):
    osprey = [locks.surgeon("osprey")]
    assert not in_turn(
        database,
        osprey,
        lambda session: put_surgeon(session, "osprey", SurgeonIn(), "test"),
        lambda: put(database, "osprey"),
    )
    assert counts(database, Surgeon) == [2]


def test_a_pseudonym_is_not_added_again_beside_its_erasure(database: Database):
    with pytest.raises(Erased):
        in_turn(
            database,
            None,
            lambda session: erase_surgeon(session, "kestrel", "test"),
            lambda: put(database, "kestrel"),
        )


def test_a_demonstration_is_not_cut_from_a_recording_being_deleted(database: Database):
    sent = cases.upload(cases.hand_off())
    stored, _ = store_recording(database, sent, "test")
    cut = DemoIn(surgeon="kestrel", suture=cases.SUTURE)
    with pytest.raises(NotFound, match="recording"):
        in_turn(
            database,
            [locks.recording(sent.sha256)],
            lambda session: delete_recording(session, sent.sha256, "test", as_admin=True),
            lambda: add_demo(database, sent.sha256, cut, "test"),
        )
    assert counts(database, StoredRecording, Demonstration) == [0, 0]
    assert cases.add_demo(database).recording_row > stored.row


def test_a_cancelled_job_stores_nothing_that_waited_for_it(database: Database):
    cases.add_demo(database)
    job = cases.ask_training(database)
    in_turn(
        database,
        [locks.job(job.row)],
        lambda session: jobs.cancel(session, job.id, "test"),
        lambda: cases.work(database, job),
    )
    assert counts(database, PolicyVersion) == [0]


def test_the_last_two_parts_of_a_batch_end_it_once(database: Database, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("skills.library.policies.retraining.MOST_IN_A_PART", 1)
    cases.add_surgeon(database, "osprey")
    for slug in ("kestrel", "osprey"):
        cases.add_demo(database, surgeon=slug)
    batch = ask_retraining(database)
    first, second = parts_of(database, batch)

    def end(part: Job, session: Session) -> None:
        jobs.end_part(session, batch.row, part.row, "failed", "test")

    def later() -> None:
        with database.writing([locks.job(batch.row)]) as session:
            end(second, session)

    in_turn(database, [locks.job(batch.row)], lambda session: end(first, session), later)
    with database.reading() as session:
        assert session.get_one(Job, batch.row).state == "failed"
        finished = select(Event).where(Event.action == "finish", Event.object_id == batch.id)
        assert len(session.scalars(finished).all()) == 1


def test_writers_for_other_surgeons_do_not_wait(database: Database):
    cases.add_surgeon(database, "osprey")
    with ThreadPoolExecutor(1) as pool, database.writing(KESTREL) as session:
        put_surgeon(session, "kestrel", SurgeonIn.model_validate({"skill_level": "expert"}), "test")
        session.flush()
        stored = pool.submit(cases.add_demo, database, surgeon="osprey").result()  # committed while this is open
    assert stored.surgeon.slug == "osprey"


def test_a_late_event_of_an_earlier_row_reaches_the_list(database: Database, tmp_path: Path):
    """The lower row is committed after the higher one, which the keeper of the list has seen."""
    target = tmp_path / "erasures.json"
    known = keep_up_erasures(database, target)

    def two_events(session: Session) -> None:
        record_event(session, "test", "withdraw", "demonstration", "a" * 64)
        with database.writing([locks.surgeon("osprey")]) as other:
            record_event(other, "test", "withdraw", "demonstration", "b" * 64)

    newest = in_turn(database, KESTREL, two_events, lambda: keep_up_erasures(database, target, known))
    assert set(read_erasures(str(target)).ended["withdrawn"]) == {"a" * 64, "b" * 64}
    with database.reading() as session:
        assert newest == session.scalar(select(func.max(Event.row)))


def test_writers_with_any_names_lose_nothing_and_never_deadlock(database: Database):
    names = [f"counter {number}" for number in range(4)]
    with database.writing() as session:
        session.execute(text("CREATE TABLE counters (name text PRIMARY KEY, value int NOT NULL)"))
        for name in names:
            session.execute(text("INSERT INTO counters VALUES (:name, 0)"), {"name": name})

    def count(picked: list[str] | None) -> None:
        with database.writing(picked) as session:
            for name in picked or names:
                value = session.scalar(text("SELECT value FROM counters WHERE name = :name"), {"name": name})
                changed = {"name": name, "value": value + 1}
                session.execute(text("UPDATE counters SET value = :value WHERE name = :name"), changed)

    @settings(max_examples=6, deadline=None)
    @given(st.lists(st.none() | st.lists(st.sampled_from(names), unique=True, min_size=1), min_size=8, max_size=16))
    def counted(work: list[list[str] | None]) -> None:
        with database.writing() as session:
            session.execute(text("UPDATE counters SET value = 0"))
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(count, work))
        with database.reading() as session:
            found = dict(map(tuple, session.execute(text("SELECT name, value FROM counters"))))
        assert found == {name: sum(picked is None or name in picked for picked in work) for name in names}

    counted()
