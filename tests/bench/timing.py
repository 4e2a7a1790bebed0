"""Timing: the best of some rounds, and comparisons in turn, so that all see the same machine."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

Work = Callable[[], object]


def in_turn(*works: Work, rounds: int, clock: Callable[[], float] = time.thread_time) -> list[float]:
    """Return the best of some rounds of each, in seconds: of this thread's processor time, or by another clock."""
    best = [float("inf")] * len(works)
    for _ in range(rounds):
        for k, work in enumerate(works):
            began = clock()
            work()
            best[k] = min(best[k], clock() - began)
    return best


def best_s(work: Work, rounds: int = 5) -> float:
    """Return the best of some rounds, after one warm-up round."""
    work()
    return in_turn(work, rounds=rounds)[0]


def gain(work: Work, times: int, rounds: int) -> float:
    """Return the best gain of two threads over one: the same work several times on each, in turn, by wall time."""
    took: dict[int, list[float]] = {1: [], 2: []}
    for threads in (1, 2) * rounds:
        began = time.perf_counter()
        with ThreadPoolExecutor(threads) as pool:
            for done in [pool.submit(work) for _ in range(times)]:
                done.result()
        took[threads].append(time.perf_counter() - began)
    return min(took[1]) / min(took[2])
