"""A fair, bounded queue for the calls of a few workers.

`Turns` limits the number of concurrent calls. With N workers one key holds at most N - 1 of them, so that one is free
for other keys; a single worker is shared in time. Waiting callers are served round-robin by key, and in order of
arrival within a key. The queue as a whole and the share of each key are bounded: beyond that a request is refused at
once.
"""

from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from threading import Event, Lock

from skills.errors import Busy


class Turns:
    """A fair, bounded queue for `at_once` workers; thread-safe."""

    def __init__(self, at_once: int, *, waiting: int, waiting_of_one: int) -> None:
        """Create the queue.

        Args:
            at_once: Number of turns held concurrently.
            waiting: Maximum number of callers that wait or hold a turn, over all keys.
            waiting_of_one: The same for one key.
        """
        self._at_once = at_once
        self._of_one = max(1, at_once - 1)
        self._most, self._most_of_one = waiting, waiting_of_one
        self._working: Counter[str] = Counter()
        self._queues: dict[str, deque[Event]] = {}  # only keys with waiting callers
        self._served: dict[str, int] = {}  # by key, the sequence number of its newest turn
        self._turns = count(1)
        self._lock = Lock()

    @property
    def asked(self) -> int:
        """The number of callers that wait or hold a turn."""
        with self._lock:
            return self._asked()

    @contextmanager
    def turn(self, key: str) -> Iterator[None]:
        """Wait for a turn, and hold it for the duration of the block.

        Raises:
            Busy: Too many callers are waiting already, in total or of this key.
        """
        begin = Event()
        with self._lock:
            of_key = len(self._queues.get(key, ())) + self._working[key]
            if self._asked() >= self._most or of_key >= self._most_of_one:
                raise Busy("Too many recordings are being read just now; try again in a moment.")
            self._queues.setdefault(key, deque()).append(begin)
            self._give()
        begin.wait()
        try:
            yield
        finally:
            with self._lock:
                self._working[key] -= 1
                self._give()

    def _asked(self) -> int:
        return sum(map(len, self._queues.values())) + self._working.total()

    def _give(self) -> None:
        """Grant free turns to the next callers, round-robin by key; the caller holds the lock."""
        while self._working.total() < self._at_once:
            keys = [key for key in self._queues if self._working[key] < self._of_one]
            if not keys:
                return
            key = min(keys, key=lambda key: self._served.get(key, 0))
            self._served[key] = next(self._turns)
            self._working[key] += 1
            self._queues[key].popleft().set()
            if not self._queues[key]:
                del self._queues[key]
