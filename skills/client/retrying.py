"""When a request that failed is sent again.

Two things may have happened to it. *Nothing was done*: no connection came about, or the service answered 429, or 503
with Retry-After; then any request may be sent again. *Nobody knows*: the line broke before the answer was there; then
only a call that is harmless when repeated is. All of ours are, POST included: what they make is known by its content,
so the same thing twice is one thing; but not release and withdrawal, for somebody may have decided otherwise between
the two, nor the making of a key.
"""

from dataclasses import dataclass

import httpx2 as httpx

NEVER_SENT = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout, httpx.ProxyError)
MAY_PASS = (*NEVER_SENT, httpx.NetworkError, httpx.TimeoutException, httpx.RemoteProtocolError)


@dataclass(frozen=True)
class Retrying:
    """How often and for how long a request is sent again; ours, for a service that restarts within seconds.

    Attributes:
        attempts: How often in all; 1 never repeats.
        first_s: The first pause. Each further one is twice as long, and half of it is left to chance, so that many
            clients do not come back together.
        longest_s: No pause is longer, unless the service asks for it with Retry-After.
        deadline_s: From the first attempt; none begins later.
    """

    attempts: int = 5
    first_s: float = 0.2
    longest_s: float = 5.0
    deadline_s: float = 60.0

    def pause_s(self, failed: int, chance: float) -> float:
        """Say how long to wait after so many failures; `chance` is between 0 and 1."""
        full = min(self.longest_s, self.first_s * 2.0 ** (failed - 1))
        return full * (0.5 + 0.5 * chance)


def may_repeat(error: httpx.TransportError, *, harmless: bool) -> bool:
    """Tell whether a request that failed on its way may be sent again."""
    return isinstance(error, MAY_PASS if harmless else NEVER_SENT)
