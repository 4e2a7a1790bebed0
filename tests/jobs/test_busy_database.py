"""A database that cannot be used for now takes none of a job's attempts: the job waits for it, while it stands."""

import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from skills.db.service_tables import Job
from skills.db.session import Database
from skills.errors import BadInput, Busy, DatabaseBusy, DatabaseUnusable
from skills.jobs import attempts, watch
from skills.jobs.attempts import Work
from skills.jobs.watch import Leases, Watch
from skills.jobs.worker import MISSED_ROUNDS, _go_round
from skills.library.operation import jobs
from skills.library.plans import tries
from skills.library.plans.tries import try_recording
from skills.schemas.tries import TryIn
from skills.settings import Settings
from tests.jobs.house import House

PAUSES = 7  # more than a job has attempts


class Installation:
    """A job in a database whose write lock somebody holds for `PAUSES` pauses of the job."""

    def __init__(self, file: Path) -> None:
        self.settings = Settings(database_url=f"sqlite:///{file}")
        self.database = Database(self.settings.database_url)
        self.database.migrate()
        self.impatient = Database(self.settings.database_url, patience_ms=20)
        self.other = sqlite3.connect(file, isolation_level=None)
        with self.database.writing() as session:
            job = Job(id="one", kind="quick", identity="0" * 64, request={})
            session.add(job)
        self.row, self.performed, self.pauses = job.row, 0, 0
        self.meanwhile: Callable[[], object] = lambda: None

    def lock(self) -> None:
        self.other.execute("BEGIN IMMEDIATE")

    def pause(self, _seconds: float) -> None:
        self.pauses += 1
        if self.pauses == PAUSES:
            self.meanwhile()
            self.other.execute("COMMIT")

    def perform(self, database: Database, row: int, attempt: int, settings: Settings) -> None:
        self.performed += 1
        if self.performed == 1:
            self.lock()  # before the last write of the job
        with database.writing() as session:
            session.get_one(Job, row).state = "succeeded"

    def try_once(self, perform: attempts.Perform | None = None) -> bool:
        return Work(self.impatient, self.settings, perform or self.perform).try_once(self.row, 1, 0)

    def job(self) -> Job:
        with self.database.reading() as session:
            return session.get_one(Job, self.row)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Installation]:
    place = Installation(tmp_path / "skills.sqlite")
    monkeypatch.setattr(attempts.time, "sleep", lambda seconds: place.pause(seconds) if seconds else None)
    yield place
    place.other.close()
    place.impatient.close()
    place.database.close()


def test_a_locked_database_takes_no_attempt_at_the_start_of_a_job(place: Installation):
    place.lock()
    place.performed = 1  # it locks nothing itself
    assert place.try_once()
    assert (place.job().state, place.pauses, place.performed) == ("succeeded", PAUSES, 2)


def test_a_locked_database_takes_no_attempt_at_the_end_of_a_job(place: Installation):
    assert place.try_once()
    assert (place.job().state, place.pauses) == ("succeeded", PAUSES)


def test_a_job_that_was_stopped_while_it_waited_ends(place: Installation):
    place.meanwhile = lambda: place.other.execute("UPDATE jobs SET state = 'cancelled'")
    place.lock()
    assert place.try_once()
    assert (place.job().state, place.performed) == ("cancelled", 0)


def test_a_job_that_was_taken_over_while_it_waited_ends(place: Installation):
    place.meanwhile = lambda: place.other.execute("UPDATE jobs SET attempt = 2")
    place.lock()
    assert place.try_once()
    assert (place.job().state, place.job().attempt, place.performed) == ("queued", 2, 0)


def test_the_reason_of_a_failure_is_written_once_the_database_can(place: Installation):
    def refuse(*_: object) -> None:
        place.lock()
        raise BadInput("The goal lies outside the grid.")

    assert place.try_once(refuse)
    assert (place.job().state, place.job().error) == ("failed", "The goal lies outside the grid.")
    assert place.pauses == PAUSES


def test_giving_up_is_written_once_the_database_can(place: Installation):
    place.lock()
    assert Work(place.impatient, place.settings, place.perform).give_up(place.row, 1)
    assert place.job().state == "failed"


def test_a_process_that_ends_repeatedly_takes_an_attempt(place: Installation):
    def end(*_: object) -> None:
        raise Busy("The reader ends repeatedly; try again in a moment.")

    assert not place.try_once(end)
    assert (place.job().state, place.pauses) == ("running", 0)


def test_a_server_that_is_away_takes_no_attempt(place: Installation):
    left = [DatabaseUnusable("No server answers."), DatabaseBusy("The database is overloaded.")] * 3

    def perform(database: Database, row: int, attempt: int, settings: Settings) -> None:
        if left:
            raise left.pop()
        place.performed = 1
        place.perform(database, row, attempt, settings)

    assert place.try_once(perform)
    assert (place.job().state, left) == ("succeeded", [])


def test_progress_that_cannot_be_stored_does_not_end_the_work(place: Installation):
    class OfThis(jobs.JobRequest):
        @property
        def identity(self) -> str:
            return "0" * 64

    with place.database.writing() as session:
        session.get_one(Job, place.row).state = "running"
    tell = jobs.progress_callback(place.impatient, OfThis())
    place.lock()
    tell(0.5)
    place.other.execute("COMMIT")
    tell(0.75)
    assert place.job().progress == 0.75


@pytest.mark.parametrize("away", [DatabaseBusy, DatabaseUnusable])
def test_a_busy_database_is_no_refused_step_of_a_try(
    place: Installation, monkeypatch: pytest.MonkeyPatch, away: type[Busy]
):
    def read(*_: object) -> None:
        raise away("The database cannot be used now.")

    monkeypatch.setattr(tries, "stored_recording", read)
    asked = TryIn(recording="0" * 64, surgeon="kestrel", suture="simple-running")
    steps = try_recording(place.impatient, asked, "test", place.settings, read)
    with pytest.raises(away):
        next(steps)


class Gone(Exception):
    """The process has ended."""


def test_a_worker_that_restarts_for_the_database_takes_no_attempt(empty_house: House, monkeypatch: pytest.MonkeyPatch):
    """The engine counts how often a job was recovered from a dead worker, and fails it after three."""
    row = empty_house.ask(state="running")
    given_back: list[str] = []
    unused = Leases(1.0)
    of_worker = Watch(empty_house.database, None, "mine", unused, recover=lambda dead: None)
    missed = iter([False] * MISSED_ROUNDS + [True] * 2)

    def step() -> None:
        if not next(missed):
            raise DatabaseBusy("The database cannot be used now.")

    monkeypatch.setattr(of_worker, "round", step)
    monkeypatch.setattr(of_worker, "beat", step)
    monkeypatch.setattr(of_worker, "_pending", lambda *_: [type("Held", (), {"workflow_id": f"{row}-1"})])
    monkeypatch.setattr(watch, "cancel", lambda _client, *which: given_back.append(which))

    def leave(_code: int) -> None:
        raise Gone

    monkeypatch.setattr("skills.jobs.worker.os._exit", leave)
    monkeypatch.setattr("skills.jobs.worker.logging.shutdown", lambda: None)
    with pytest.raises(Gone):
        _go_round(of_worker, lambda: None, lambda _seconds: False)
    assert given_back == [(row, 1)]
    assert (empty_house.job(row).state, empty_house.job(row).attempt) == ("queued", 2)
