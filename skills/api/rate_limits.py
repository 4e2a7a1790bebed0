"""Rate limits: token buckets of keys, and of addresses that send wrong keys.

Each limit is a token bucket: it holds the amount that may be used at once and is refilled at a constant rate. The
buckets are in memory: they are full again after a restart, and several processes behind one address would each allow
the full rate; `skills serve` is one process. Jobs are counted in the database, for all processes together
(`skills.library.operation.jobs.refuse_too_many`).
"""

import time
from collections.abc import Callable

from skills.db.weighted_cache import WeightedCache
from skills.errors import TooMany
from skills.settings import Settings

BURST_S = 2.0  # a web page sends all of its requests at once
DAY_S = 86_400.0

# Unknown keys and cookies that are looked up at once, per address and in all: 256 bits cannot be guessed, but the
# look-ups load the database. Further ones are looked up in batches, not refused: an address may be a hospital's.
BAD_AT_ONCE, BAD_PER_S = 20, 20 / 60
BAD_OF_ALL_AT_ONCE, BAD_OF_ALL_PER_S = 200, 10.0
# keys and addresses with a bucket; the least recently used bucket is dropped, and is full when it is created anew
MOST = 4096


class Bucket:
    """A token bucket of capacity `most`, refilled by `per_s` each second."""

    def __init__(self, most: float, per_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._most, self._per_s, self._clock = most, per_s, clock
        self._left, self._at = most, clock()

    def take(self, amount: float) -> float:
        """Take an amount and return 0; if there is not enough, take nothing and return the seconds until there is."""
        at = self._clock()
        self._left = min(self._most, self._left + (at - self._at) * self._per_s)
        self._at = at
        if amount <= self._left:
            self._left -= amount
            return 0.0
        return (amount - self._left) / self._per_s


class RateLimits:
    """The token buckets of all keys, and of addresses that send wrong keys."""

    def __init__(self, settings: Settings, clock: Callable[[], float] = time.monotonic) -> None:
        per_s, per_day = settings.key_requests_per_s, settings.key_upload_bytes_per_day
        self._requests = _Buckets(lambda: Bucket(max(1.0, per_s * BURST_S), per_s, clock))
        self._bytes = _Buckets(lambda: Bucket(per_day, per_day / DAY_S, clock))
        self._wrong = _Buckets(lambda: Bucket(BAD_AT_ONCE, BAD_PER_S, clock))
        self._wrong_of_all = Bucket(BAD_OF_ALL_AT_ONCE, BAD_OF_ALL_PER_S, clock)

    def request(self, key: str) -> None:
        """Count a request.

        Raises:
            TooMany: The key exceeds its requests per second.
        """
        self._refuse(
            self._requests.of(key).take(1), "This key sends too many requests; wait, and send fewer per second."
        )

    def upload(self, key: str, size: int) -> None:
        """Count bytes of an upload.

        Raises:
            TooMany: The key exceeds its upload bytes per day.
        """
        self._refuse(
            self._bytes.of(key).take(size), "This key has used up its upload allowance of a day; continue later."
        )

    def stranger(self, address: str) -> float:
        """Count an unknown key or cookie before its look-up; return 0, or the seconds until the next is allowed.

        If the result is not 0, nothing is counted; if the look-up succeeds, `acquainted` returns the token.
        """
        wait_s = self._wrong.of(address).take(1)
        if wait_s == 0 and (wait_s := self._wrong_of_all.take(1)) > 0:
            self._wrong.of(address).take(-1)
        return wait_s

    def acquainted(self, address: str) -> None:
        """Return the token that `stranger` took, for a key that proved to be valid."""
        self._wrong.of(address).take(-1)
        self._wrong_of_all.take(-1)

    @staticmethod
    def _refuse(wait_s: float, why: str) -> None:
        if wait_s > 0:
            raise TooMany(why, wait_s)


class _Buckets:
    """A bucket for each name, created at its first use."""

    def __init__(self, new: Callable[[], Bucket]) -> None:
        self._new = new
        self._kept: WeightedCache[str, Bucket] = WeightedCache(MOST)

    def of(self, name: str) -> Bucket:
        bucket = self._kept.get(name)
        if bucket is None:
            bucket = self._new()
            self._kept.put(name, bucket)
        return bucket
