"""Workers at rest do nothing but beat; the bell wakes them, and one that is then killed or stopped is relieved."""

import signal
from contextlib import closing
from pathlib import Path
from threading import Thread

import pytest

from skills.db.service_tables import Executor
from skills.jobs import connect
from skills.jobs.bell import Turn, ring, strokes
from skills.jobs.worker import REST_S
from tests.backends import BACKENDS, blank, drop
from tests.jobs.house import House
from tests.waiting import until

BEATS = 3


def wakes(pid: int) -> dict[str, int]:
    """Return how often each thread of a process has waited for something."""
    counted = {}
    for thread in Path(f"/proc/{pid}/task").iterdir():
        said = dict(line.split(":", 1) for line in (thread / "status").read_text().splitlines())
        counted[thread.name] = int(said["voluntary_ctxt_switches"])
    return counted


def rests(house: House, pid: int) -> bool:
    """Return whether no thread of a worker but the main one woke during some of its heartbeats."""

    def beat_at() -> object:
        with house.database.reading() as session:
            return {row.id: row.beat_at for row in session.query(Executor)}

    before = wakes(pid)
    for _ in range(BEATS):
        last = beat_at()
        until(lambda last=last: beat_at() != last)
    return {thread for thread, number in wakes(pid).items() if number != before.get(thread)} <= {str(pid)}


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("ended_by", [signal.SIGSTOP, pytest.param(signal.SIGKILL, marks=pytest.mark.nightly)])
def test_workers_rest_are_woken_and_relieve_one_that_died(backend: str, ended_by: signal.Signals, tmp_path: Path):
    house = House(blank(backend, tmp_path), tmp_path)
    with closing(house), house.workers(2) as workers:
        until(lambda: all(rests(house, pid) for pid in workers))
        held = tmp_path / "held"
        held.touch()
        row = house.ask("slow", held_by=str(held))
        house.engine.submit(row, 1, "training")
        first = house.begun(row)
        workers[first].send_signal(ended_by)
        until(lambda: len(house.noted("begins", row)) == 2)
        held.unlink()
        job = house.ended(row)
        assert (job.state, job.result["by"]) == ("succeeded", house.noted("begins", row)[1])
        assert job.result["by"] in workers.keys() - {first}
    drop(house.settings.database_url)


@pytest.mark.parametrize("backend", BACKENDS)
def test_whoever_listens_hears_each_stroke_of_the_bell(backend: str, tmp_path: Path):
    house = House(blank(backend, tmp_path), tmp_path)
    with closing(house), closing(strokes(house.settings)) as heard:
        client = connect(house.settings)
        next(heard)  # one may have been missed
        for _ in range(2):
            ring(client)
            next(heard)
        client.destroy()
    drop(house.settings.database_url)


def test_a_queue_is_polled_in_its_turn_alone_and_no_turn_is_lost():
    turn, ended = Turn(), []
    waiting = Thread(target=lambda: ended.append(turn.wait(timeout=0.01)))
    waiting.start()
    waiting.join(0.2)  # time for the event that must not happen
    assert waiting.is_alive()
    turn.come()
    waiting.join()
    assert ended == [False]
    turn.come()
    assert turn.wait() is False
    turn.set()
    assert turn.wait() is turn.is_set() is True


def test_a_worker_at_rest_beats_well_within_its_lease(empty_house: House):
    assert 0.75 * empty_house.settings.lease_s >= REST_S
