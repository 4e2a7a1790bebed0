"""Allowances of a key: requests in a second, bytes in a day. They are counted in this process and begin anew with it.

A token bucket: it holds what may be used at once and is refilled evenly. Several processes behind one address would
each allow as much; `skills serve` is one. Jobs are counted in the database, for all processes together
(`skills.library.jobs.refuse_too_many`).
"""

import time
from collections.abc import Callable

from skills.errors import TooMany
from skills.library.kept import Kept
from skills.settings import Settings

BURST_S = 2.0  # a page asks for all it shows at once
DAY_S = 86_400.0
# Wrong keys of an address: 256 bits cannot be guessed, but the database can be kept busy.
BAD_AT_ONCE, BAD_PER_S = 20, 20 / 60
MOST = 4096  # keys and addresses that are counted; whoever was not seen for longest begins anew


class Bucket:
    """An allowance: so much at once, refilled by so much in a second."""

    def __init__(self, most: float, per_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._most, self._per_s, self._clock = most, per_s, clock
        self._left, self._at = most, clock()

    def take(self, amount: float) -> float:
        """Take an amount: 0 if it was there, else the seconds until it will be, and nothing is taken."""
        at = self._clock()
        self._left = min(self._most, self._left + (at - self._at) * self._per_s)
        self._at = at
        if amount <= self._left:
            self._left -= amount
            return 0.0
        return (amount - self._left) / self._per_s


class Limits:
    """The allowances of all keys, and of addresses that show wrong ones."""

    def __init__(self, settings: Settings, clock: Callable[[], float] = time.monotonic) -> None:
        per_s, per_day = settings.key_requests_per_s, settings.key_upload_bytes_per_day
        self._requests = _Buckets(lambda: Bucket(max(1.0, per_s * BURST_S), per_s, clock))
        self._bytes = _Buckets(lambda: Bucket(per_day, per_day / DAY_S, clock))
        self._wrong = _Buckets(lambda: Bucket(BAD_AT_ONCE, BAD_PER_S, clock))

    def request(self, key: str) -> None:
        """Count a request.

        Raises:
            TooMany: The key asks faster than it may.
        """
        self._refuse(self._requests.of(key).take(1), "This key asks too often; wait, and ask less often.")

    def upload(self, key: str, size: int) -> None:
        """Count bytes on their way in.

        Raises:
            TooMany: The key has sent as much as it may for now.
        """
        self._refuse(self._bytes.of(key).take(size), "This key has sent as many bytes as it may in a day; go on later.")

    def wrong_key(self, address: str) -> None:
        """Count a key that has not been seen before, ere it is looked up; give it back with `right_key` if it counts.

        Raises:
            TooMany: Too many of this address were wrong.
        """
        self._refuse(self._wrong.of(address).take(1), "Too many wrong keys came from this address; wait.")

    def right_key(self, address: str) -> None:
        """Give back what `wrong_key` took."""
        self._wrong.of(address).take(-1)

    @staticmethod
    def _refuse(wait_s: float, why: str) -> None:
        if wait_s > 0:
            raise TooMany(why, wait_s)


class _Buckets:
    """A bucket for each name."""

    def __init__(self, new: Callable[[], Bucket]) -> None:
        self._new = new
        self._kept: Kept[str, Bucket] = Kept(MOST)

    def of(self, name: str) -> Bucket:
        bucket = self._kept.get(name)
        if bucket is None:
            bucket = self._new()
            self._kept.put(name, bucket)
        return bucket
