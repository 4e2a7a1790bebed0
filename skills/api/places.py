"""Places for what stays open: the streams of jobs and the sessions of this process, limited for each key."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from math import inf

from skills.errors import TooMany


class Places:
    """Counts what is open of each key; used on one event loop."""

    def __init__(self, most_of_key: int, refusal: TooMany, most: float = inf) -> None:
        """Limit what is open.

        Args:
            most_of_key: The most of one key; a local caller, who has none, is counted and has no limit.
            refusal: The error where a limit is reached.
            most: The most of all together.
        """
        self._most_of_key, self._most, self._refusal = most_of_key, most, refusal
        self._open: Counter[str | None] = Counter()

    @property
    def count(self) -> int:
        """The number of all that are open."""
        return self._open.total()

    @contextmanager
    def place(self, key: str | None) -> Iterator[None]:
        """Count one more for the duration of the block.

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
