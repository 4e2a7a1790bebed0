"""Limits on the streams of jobs and the sessions that are open at once in this process, by key and in total."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from math import inf

from skills.errors import TooMany


class Places:
    """A counter of the open streams or sessions of each key, with limits; used on one event loop."""

    def __init__(self, most_of_key: int, refusal: TooMany, most: float = inf) -> None:
        """Set the limits.

        Args:
            most_of_key: The most that one key may have open; a local caller, who has no key, is counted without it.
            refusal: The error that is raised, as a new one each time, where a limit is reached.
            most: The most that all callers together may have open.
        """
        self._most_of_key, self._most, self._refusal = most_of_key, most, refusal
        self._open: Counter[str | None] = Counter()

    @property
    def count(self) -> int:
        """The number of all that are open."""
        return self._open.total()

    @contextmanager
    def place(self, key: str | None) -> Iterator[None]:
        """Count one more stream or session of a key for the duration of the block.

        Raises:
            TooMany: The key, or all together, have reached their limit.
        """
        if self.count >= self._most or (key is not None and self._open[key] >= self._most_of_key):
            raise TooMany(self._refusal.message, self._refusal.wait_s)
        self._open[key] += 1
        try:
            yield
        finally:
            self._open[key] -= 1
            if not self._open[key]:
                del self._open[key]
