"""Workers shared by key: one is reserved for other keys, and waiting callers are served round-robin."""

from contextlib import ExitStack
from threading import Event, Thread

import pytest

from skills.errors import Busy
from skills.sandbox.turns import Turns
from tests.waiting import END_S, until


class Work:
    """Callers in separate threads, each of which holds its turn until the test ends it."""

    def __init__(self, turns: Turns) -> None:
        self.turns = turns
        self.begun: list[str] = []
        self.ends: dict[str, Event] = {}
        self.threads: list[Thread] = []

    def ask(self, key: str, name: str) -> None:
        """Request a turn, and return when the request is queued or running."""
        self.ends[name] = Event()

        def work() -> None:
            with self.turns.turn(key):
                self.begun.append(name)
                self.ends[name].wait(END_S)

        before = self.turns.asked
        self.threads.append(Thread(target=work, daemon=True))
        self.threads[-1].start()
        until(lambda: self.turns.asked == before + 1)

    def end(self, name: str) -> None:
        before = self.turns.asked
        self.ends[name].set()
        until(lambda: self.turns.asked == before - 1)

    def has_begun(self, *names: str) -> None:
        until(lambda: len(self.begun) >= len(names))
        assert self.begun == [*names]


def test_one_key_leaves_a_worker_to_the_others():
    work = Work(Turns(3, waiting=20, waiting_of_one=20))
    for k in range(5):
        work.ask("greedy", f"greedy {k}")
    work.has_begun("greedy 0", "greedy 1")
    work.ask("other", "other 0")
    work.has_begun("greedy 0", "greedy 1", "other 0")
    work.end("other 0")  # nobody but the greedy key is waiting, and still it gets no more
    work.ask("third", "third 0")
    work.has_begun("greedy 0", "greedy 1", "other 0", "third 0")


def test_a_single_worker_is_shared_round_robin():
    work = Work(Turns(1, waiting=20, waiting_of_one=20))
    for name in ("a 0", "a 1", "a 2", "b 0", "b 1", "c 0"):
        work.ask(name[0], name)
    order = ["a 0", "b 0", "c 0", "a 1", "b 1", "a 2"]
    # "a 1" was queued before b and c, but a had just had its turn when they were served
    for k, name in enumerate(order):
        work.has_begun(*order[: k + 1])
        work.end(name)


def test_a_key_fills_its_own_part_of_the_queue_only():
    turns = Turns(2, waiting=4, waiting_of_one=3)
    work = Work(turns)
    for k in range(3):
        work.ask("greedy", f"greedy {k}")
    with pytest.raises(Busy), turns.turn("greedy"):
        pass
    work.ask("other", "other 0")
    with pytest.raises(Busy), turns.turn("third"):
        pass
    work.end("greedy 0")
    work.end("other 0")
    with turns.turn("third"):
        pass


def test_a_turn_is_given_back_when_its_work_fails():
    turns = Turns(1, waiting=2, waiting_of_one=2)
    for _ in range(5):
        with pytest.raises(ValueError, match="broken"), turns.turn("a"):
            raise ValueError("broken")
    with ExitStack() as stack:
        stack.enter_context(turns.turn("b"))
        assert turns.asked == 1
    assert turns.asked == 0
