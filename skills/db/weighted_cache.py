"""A least-recently-used cache, bounded by the total weight of its values, for several threads."""

from collections.abc import Callable, Iterable
from copy import copy
from threading import Lock
from typing import Generic, TypeVar

from cachetools import LRUCache

K = TypeVar("K")
V = TypeVar("V")


class WeightedCache(Generic[K, V]):
    """A least-recently-used cache, bounded by the total weight of its values, under a lock: cachetools has none."""

    def __init__(self, most: int, weight: Callable[[V], int] | None = None) -> None:
        """Create an empty cache.

        Args:
            most: The upper bound of the total weight; a value that is heavier alone is not stored.
            weight: Returns the weight of a value; by default each counts as one.
        """
        self._values: LRUCache[K, V] = LRUCache(most, weight)
        self._lock = Lock()

    def get(self, key: K) -> V | None:
        """Return the value of a key, None if it is not cached, and mark it as most recently used."""
        with self._lock:
            try:
                return self._values[key]
            except KeyError:  # not `get`, which looks a key up twice, at every request
                return None

    def put(self, key: K, value: V) -> None:
        """Store a value; the least recently used values are evicted as soon as the total weight exceeds the bound."""
        with self._lock:
            self._values.pop(key, None)  # first, because an older value must not outlive one that is too heavy
            if self._values.getsizeof(value) <= self._values.maxsize:
                self._values[key] = value

    def items(self) -> list[tuple[K, V]]:
        """Return a list of the cached keys and values, without marking any as used."""
        with self._lock:
            return list(copy(self._values).items())  # of a copy, because every look-up moves a key to the end

    def forget(self, keys: Iterable[K]) -> None:
        """Remove keys from the cache."""
        with self._lock:
            for key in keys:
                self._values.pop(key, None)
