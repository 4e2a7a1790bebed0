"""Queues: interactive requests overtake batches, and pictures are drawn one at a time without delaying other jobs."""

from pathlib import Path

import pytest

from skills.jobs import JOBS, QUEUES
from skills.library.operation.jobs import PART
from tests.jobs.house import House
from tests.waiting import crowded, until

GRACE_S = 5.0


@pytest.fixture
def held(tmp_path: Path) -> Path:
    """Return a file that holds up the jobs that name it, until it is removed."""
    file = tmp_path / "held"
    file.touch()
    return file


@pytest.mark.nightly  # slow if it fails, not wrong
def test_a_person_who_waits_comes_before_a_batch_that_was_there_first(house: House, held: Path):
    parts = [house.ask(PART, held_by=str(held)) for _ in range(3)]
    house.begun(parts[0])
    waited_for = [house.ask() for _ in range(2 * QUEUES[JOBS])]
    for row in waited_for:
        assert house.ended(row).state == "succeeded"
    assert house.job(parts[-1]).state == "queued"
    held.unlink()
    assert all(house.ended(row).state == "succeeded" for row in parts)


@pytest.mark.nightly  # slow if it fails, not wrong
def test_pictures_are_drawn_one_after_the_other_and_hold_up_nothing(house: House, held: Path):
    pictures = [house.ask("pictures", held_by=str(held)) for _ in range(3)]
    house.begun(pictures[0])
    waited_for = [house.ask() for _ in range(QUEUES[JOBS] + 1)]
    for row in waited_for:
        assert house.ended(row).state == "succeeded"
    assert [len(house.noted("begins", row)) for row in pictures] == [1, 0, 0]
    assert house.job(pictures[-1]).state == "queued"
    held.unlink()
    assert all(house.ended(row).state == "succeeded" for row in pictures)
    until(lambda: house.noted("wrote", pictures[-1]))  # the line follows the commit
    lines = [line.split()[:2] for line in house.journal.read_text().splitlines()]
    drawn = [(word, int(row)) for word, row in lines if int(row) in pictures]
    assert drawn == [(word, row) for row in pictures for word in ("begins", "wrote")]


@pytest.mark.nightly  # by day `test_batches` kills a worker
def test_pictures_of_a_worker_that_died_are_drawn_by_another(empty_house: House):
    house = empty_house
    with house.workers(2) as workers:
        row = house.ask("pictures", seconds=0.6)
        first = house.begun(row)
        workers[first].kill()
        until(lambda: house.noted("wrote", row))
        assert house.noted("wrote", row) == [house.job(row).result["by"]] != [first]


@pytest.mark.nightly  # 4 s of processor time; by day pictures hold nothing up
def test_a_worker_that_is_told_to_go_does_not_stay_for_pictures(empty_house: House, held: Path):
    house = empty_house
    with house.workers(1) as workers:
        row = house.ask("pictures", held_by=str(held))
        worker = workers[house.begun(row)]
        worker.terminate()
        took_s = until(lambda: worker.poll() is not None, GRACE_S * crowded())
        print(f"told to go, to gone: {took_s:.2f} s")
    assert house.job(row).state == "running"  # and taken over, as from any dead worker
