"""The asynchronous client of the service: all calls, and how it connects."""

import time
from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import httpx2 as httpx

from skills.client.address import is_loopback, key_headers, service_url
from skills.client.comparison import Comparisons
from skills.client.connection import as_json, given
from skills.client.demos import Demos
from skills.client.operation import Operation
from skills.client.people import People
from skills.client.plans import Plans
from skills.client.policies import Policies
from skills.client.recordings import Recordings
from skills.client.retrying import Retrying
from skills.client.waiting import sleep as sleep_s

if TYPE_CHECKING:
    from skills.client.sessions import AsyncSession

TIMEOUT_S = 60.0  # ours: the service reads a large recording in at most 30 s, and the request may be queued before
ANSWER_S = 1.0  # ours: an answer takes milliseconds, and an arm must not go on for long without one
RETRYING = Retrying()


class AsyncClient(People, Recordings, Demos, Policies, Plans, Comparisons, Operation):
    """The asynchronous client of the service.

        async with AsyncClient("http://127.0.0.1:8000") as client:
            policy = await client.policy("kestrel", "simple-running")

    Args:
        server: The service's address; or an `httpx.AsyncClient`, for example one with proxies or certificates of its
            own.
        api_key: The API key; default: SKILLS_API_KEY of the settings if the server is an address. "" sends none.
        plain_http: Send the key over plain HTTP, where others on the way can read it.
        timeout_s: Longest silence of the service before a request fails.
        retrying: How often, and for how long, a request is retried where that is safe.
        clock: Returns seconds, for deadlines.
        sleep: Sleeps for a number of seconds.

    Raises:
        BadSettings: The server is not an http or https address.
        UnprotectedKey: The key would be sent over plain HTTP to another machine.
    """

    def __init__(
        self,
        server: str | httpx.AsyncClient,
        *,
        api_key: str | None = None,
        plain_http: bool = False,
        timeout_s: float = TIMEOUT_S,
        retrying: Retrying = RETRYING,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], Awaitable[None]] = sleep_s,
    ) -> None:
        named = isinstance(server, str)
        if isinstance(server, str):
            url = service_url(server)
            server = httpx.AsyncClient(base_url=url, trust_env=not is_loopback(url), timeout=timeout_s)
        self.http = server
        self._headers = key_headers(server.base_url, api_key, plain_http=plain_http, named=named)
        self._timeout_s, self._retrying, self._clock, self._sleep = timeout_s, retrying, clock, sleep
        self._streams = named

    def __repr__(self) -> str:
        """Return the class and the service's address, never the key."""
        with_key = ", with a key" if self._headers else ""
        return f"<{type(self).__name__} of {self.http.base_url}{with_key}>"

    async def __aenter__(self) -> Self:
        """Return the client."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connections."""
        await self.aclose()

    def session(self, surgeon: str, suture: str, *, timeout_s: float = ANSWER_S) -> "AsyncSession":
        """Return a session of the released pose style, to be entered with `with`.

        Args:
            surgeon: The surgeon's pseudonym.
            suture: The suture type.
            timeout_s: Longest wait for an answer; then the session is closed.
        """
        from skills.client.sessions import AsyncSession  # here, because of websockets

        return AsyncSession(self, surgeon, suture, timeout_s)

    async def aclose(self) -> None:
        """Close the connections."""
        await self.http.aclose()

    async def send(self, /, method: str, path: str, **options: Any) -> httpx.Response:
        """Send any request, and raise `Problem` for an error response; options are those of `httpx.Client.request`.

        Only a GET is retried after a lost connection; other methods only if the service certainly did nothing.
        """
        return await self._send(method, path, idempotent=method == "GET", **options)

    async def get_json(self, /, path: str, **query: Any) -> Any:
        """Return a response as the plain JSON that the service sent."""
        return as_json(await self._send("GET", path, params=given(query)))
