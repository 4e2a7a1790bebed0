"""Queues: interactive requests overtake batches, and pictures are drawn one at a time without delaying other jobs."""

from itertools import pairwise

from skills.jobs import JOBS, QUEUES
from skills.library.jobs import PART
from tests.jobs.house import House
from tests.waiting import until

GRACE_S = 5.0


def test_a_person_who_waits_comes_before_a_batch_that_was_there_first(house: House):
    parts = [house.ask(PART, seconds=3.0) for _ in range(3)]
    house.begun(parts[0])
    waited_for = [house.ask() for _ in range(2 * QUEUES[JOBS])]
    for row in waited_for:
        assert house.ended(row, 5.0).state == "succeeded"
    assert house.job(parts[-1]).state == "queued"
    assert all(house.ended(row).state == "succeeded" for row in parts)


def test_pictures_are_drawn_one_after_the_other_and_hold_up_nothing(house: House):
    pictures = [house.ask("pictures", seconds=1.5) for _ in range(3)]
    house.begun(pictures[0])
    waited_for = [house.ask() for _ in range(QUEUES[JOBS] + 1)]
    for row in waited_for:
        assert house.ended(row, 5.0).state == "succeeded"
    assert house.job(pictures[-1]).state == "queued"
    assert not house.noted("begins", pictures[-1])
    jobs = [house.ended(row) for row in pictures]
    assert all(job.state == "succeeded" for job in jobs)
    assert all((after.started_at - before.started_at).total_seconds() >= 1.5 for before, after in pairwise(jobs))
    assert [len(house.noted("begins", row)) for row in pictures] == [1, 1, 1]


def test_pictures_of_a_worker_that_died_are_drawn_by_another(empty_house: House):
    house = empty_house
    with house.workers(2) as workers:
        row = house.ask("pictures", seconds=0.6)
        first = house.begun(row)
        workers[first].kill()
        until(lambda: house.job(row).state == "succeeded", house.settings.lease_s + GRACE_S)
        assert house.noted("wrote", row) == [house.job(row).result["by"]] != [first]


def test_a_worker_that_is_told_to_go_does_not_stay_for_pictures(empty_house: House):
    house = empty_house
    with house.workers(1) as workers:
        row = house.ask("pictures", seconds=30.0)
        worker = workers[house.begun(row)]
        worker.terminate()
        took_s = until(lambda: worker.poll() is not None, GRACE_S)
        print(f"told to go, to gone: {took_s:.2f} s")
    assert house.job(row).state == "running"  # and taken over, as from any dead worker
