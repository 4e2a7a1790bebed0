"""The values used lately, by their digest."""

from collections import OrderedDict
from collections.abc import Callable, Iterable
from threading import Lock
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class Kept(Generic[K, V]):
    """A mapping that forgets what was not used for longest; for any number of threads."""

    def __init__(self, most: int, weight: Callable[[V], int] = lambda _: 1) -> None:
        """Keep nothing yet.

        Args:
            most: What is kept weighs at most this together; a value that is heavier alone is not kept.
            weight: Of a value; each counts as one, unless it is given.
        """
        self._most = most
        self._weight = weight
        self._weighs = 0
        self._values: OrderedDict[K, V] = OrderedDict()
        self._lock = Lock()

    def get(self, key: K) -> V | None:
        """Find a value, if it is still here."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
            return self._values.get(key)

    def put(self, key: K, value: V) -> None:
        """Keep a value."""
        with self._lock:
            self._drop(key)
            if self._weight(value) > self._most:
                return
            self._values[key] = value
            self._weighs += self._weight(value)
            while self._weighs > self._most:
                self._drop(next(iter(self._values)))

    def items(self) -> list[tuple[K, V]]:
        """List what is here."""
        with self._lock:
            return list(self._values.items())

    def forget(self, keys: Iterable[K]) -> None:
        """Keep these no longer."""
        with self._lock:
            for key in keys:
                self._drop(key)

    def _drop(self, key: K) -> None:
        value = self._values.pop(key, None)
        if value is not None:
            self._weighs -= self._weight(value)
