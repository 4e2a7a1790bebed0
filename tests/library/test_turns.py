"""Who learns next in a worker that has begun several parts of batches."""

from threading import Thread
from time import monotonic, sleep

import pytest

from skills.library.batch_work import _Turns


def test_one_learns_at_a_time_and_the_oldest_part_that_waits_is_next():
    turns, had, at_once = _Turns(), [], []

    def learn(part: int) -> None:
        with turns.of(part):
            at_once.append(part)
            had.append(part)
            sleep(0.002)
            assert at_once == [part]
            at_once.clear()

    waiting = [Thread(target=learn, args=(part,)) for part in (9, 7, 8, 6)]
    with turns.of(5):
        for thread in waiting:
            thread.start()
        deadline = monotonic() + 60
        while len(turns._waiting) < len(waiting) and monotonic() < deadline:
            sleep(0.001)
    for thread in waiting:
        thread.join()
    assert had == [6, 7, 8, 9]


def test_a_part_that_fails_leaves_its_turn():
    turns = _Turns()
    with pytest.raises(ZeroDivisionError), turns.of(1):
        raise ZeroDivisionError
    later = Thread(target=lambda: turns.of(2).__enter__(), daemon=True)
    later.start()
    later.join(60)
    assert not later.is_alive()
