"""Jobs in the process of one command, without a worker and without the engine."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from skills.db.service_tables import Executor, Job
from skills.db.session import Database
from skills.jobs.in_process import InProcess
from skills.library.operation.jobs import PART, PICTURES
from skills.settings import Settings
from tests.jobs.house import House
from tests.waiting import until


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Perform jobs by writing down their rows; return the list."""
    rows: list[int] = []

    def perform(database: Database, row: int, attempt: int, settings: Settings) -> None:
        with database.writing() as session:
            session.get_one(Job, row).state = "succeeded"
        rows.append(row)

    monkeypatch.setattr("skills.library.perform.perform_job", perform)
    return rows


@pytest.fixture
def alone(empty_house: House, done: list[int]) -> Iterator[InProcess]:
    with closing(InProcess(empty_house.settings)) as engine:
        yield engine


def test_a_job_is_performed_and_what_waits_for_workers_is_left(empty_house: House, alone: InProcess, done: list[int]):
    left = [empty_house.ask(PART), empty_house.ask(PICTURES), empty_house.ask(state="failed")]
    older, newer = empty_house.ask(state="running"), empty_house.ask()  # one was left by a process that died
    alone.submit(newer, 1, "quick")
    assert empty_house.ended(older).state == empty_house.ended(newer).state == "succeeded"
    assert sorted(done) == [older, newer]
    assert [empty_house.job(row).state for row in left] == ["queued", "queued", "failed"]


def test_pictures_that_the_command_asks_for_are_drawn(empty_house: House, alone: InProcess):
    others, asked = empty_house.ask(PICTURES), empty_house.ask(PICTURES)
    alone.submit(asked, 1, PICTURES)
    assert empty_house.ended(asked).state == "succeeded"
    assert empty_house.job(others).state == "queued"


def test_where_a_worker_is_alive_its_jobs_are_left_to_it(empty_house: House, alone: InProcess, done: list[int]):
    alone._settings = alone._settings.model_copy(update={"lease_s": 600.0})
    with empty_house.database.writing() as session:
        session.add(Executor(id="alive"))
    row = empty_house.ask()
    looked = []
    until(lambda: looked.append(alone._newest(empty_house.database)) or len(looked) > 2)
    assert looked == [None] * 3
    with empty_house.database.writing() as session:
        session.delete(session.get_one(Executor, "alive"))
    assert empty_house.ended(row).state == "succeeded"


def test_a_database_that_is_migrated_later_does_not_end_it(tmp_path: Path, done: list[int]):
    (tmp_path / "skills.sqlite").touch()
    settings = Settings(database_url=f"sqlite:///{tmp_path / 'skills.sqlite'}")
    with closing(InProcess(settings)) as engine:
        engine.submit(1, 1, "quick")
        until(engine._calls.empty)
        house = House(settings.database_url, tmp_path)
        assert house.ended(house.ask()).state == "succeeded"
        house.close()
