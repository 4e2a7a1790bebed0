"""The retry policy of the client.

A failed request is in one of two cases. *Nothing was done*: no connection was made, or the service answered 429, or 503
with Retry-After; then any request may be sent again. *Unknown*: the connection was lost before the response arrived;
then only an idempotent call may be sent again. Nearly all of our calls are idempotent, POST included, because resources
are identified by their content. The exceptions are release, withdrawal and a training with `release`, because somebody
may have decided otherwise in between, and the creation of a key.
"""

from dataclasses import dataclass

import httpx2 as httpx

NEVER_SENT = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout, httpx.ProxyError)
TEMPORARY = (*NEVER_SENT, httpx.NetworkError, httpx.TimeoutException, httpx.RemoteProtocolError)


@dataclass(frozen=True)
class Retrying:
    """The retry policy. The defaults are ours, for a service that restarts within seconds.

    Attributes:
        attempts: Largest number of attempts; 1 never retries.
        first_s: The first pause. Each further one is twice as long, and half of it is random, so that many clients do
            not retry at the same moment.
        longest_s: The longest pause, unless the service requests a longer one with Retry-After.
        deadline_s: Time from the first attempt after which no further one begins.
    """

    attempts: int = 5
    first_s: float = 0.2
    longest_s: float = 5.0
    deadline_s: float = 60.0

    def pause_s(self, failed: int, chance: float) -> float:
        """Return the pause after a number of failures; `chance` is a random number from 0 to 1."""
        # exponential backoff with jitter
        full = min(self.longest_s, self.first_s * 2.0 ** (failed - 1))
        return full * (0.5 + 0.5 * chance)


def may_repeat(error: httpx.TransportError, *, idempotent: bool) -> bool:
    """Return whether a request that failed in transport may be sent again."""
    return isinstance(error, TEMPORARY if idempotent else NEVER_SENT)
