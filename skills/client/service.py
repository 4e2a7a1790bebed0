"""The two clients: the same calls, made at once or awaited."""

import time
from collections.abc import Awaitable, Callable
from ipaddress import ip_address
from types import TracebackType
from typing import Any, Self

import httpx2 as httpx

from skills.client.atlas import Atlases
from skills.client.calls import Later, Now, call
from skills.client.catalogue import Catalogue
from skills.client.connection import given
from skills.client.jobs import Jobs
from skills.client.keys import Keys
from skills.client.plans import Plans
from skills.client.policies import Policies
from skills.client.problems import UnprotectedKey
from skills.client.recordings import Recordings
from skills.client.retrying import Retrying
from skills.client.scores import Scores
from skills.client.transport import Awaited, Blocking, Transport
from skills.errors import BadSettings

TIMEOUT_S = 60.0  # ours: reading a large recording takes the service 30 s at most, and it may be queued
AGAIN = Retrying()


class Calls(Atlases, Catalogue, Recordings, Jobs, Policies, Plans, Keys, Scores):
    """All calls, and what they are made with."""

    def _connect(
        self,
        transport: Transport,
        api_key: str | None,
        plain_http: bool,
        timeout_s: float,
        retrying: Retrying,
        clock: Callable[[], float],
        streams: bool,
    ) -> None:
        if api_key and not plain_http:
            _protect(transport.http.base_url)
        self._transport, self._streams = transport, streams
        self._headers = {"Authorization": f"Bearer {api_key}"} if api_key else {}
        self._timeout_s, self._retrying, self._clock = timeout_s, retrying, clock

    def __repr__(self) -> str:
        """Say where the service is, and never the key."""
        signed = ", with a key" if self._headers else ""
        return f"<{type(self).__name__} of {self._transport.http.base_url}{signed}>"

    @call
    async def send(self, /, method: str, path: str, **how: Any) -> httpx.Response:
        """Send any request, and raise what is refused; `how` is as in `httpx.Client.request`.

        It is sent again only where nothing was done, unless it is a GET.
        """
        return await self._send(method, path, harmless=method == "GET", **how)

    @call
    async def get_json(self, /, path: str, **query: Any) -> Any:
        """Get an answer as the plain JSON that the service sent."""
        return await self._json("GET", path, params=given(query))


class Client(Calls, Now):
    """The service, each call answered at once.

    with Client("http://127.0.0.1:8000") as client:
        client.policy("kestrel", "simple-running").goal_mm

    Args:
        server: Its address; or an `httpx.Client`, such as one that has proxies or certificates of its own.
        api_key: Left out, that of the settings, SKILLS_API_KEY, where the server is an address. "" is none.
        plain_http: Send the key although others on the way can read it.
        timeout_s: For how long the service may be silent.
        retrying: How often and how long a request is sent again where that is harmless.
        clock: Seconds, for deadlines.
        sleep: Waits so many seconds.

    Raises:
        BadSettings: The server is no address.
        UnprotectedKey: A key would travel over plain HTTP, beyond this machine.
    """

    def __init__(
        self,
        server: str | httpx.Client,
        *,
        api_key: str | None = None,
        plain_http: bool = False,
        timeout_s: float = TIMEOUT_S,
        retrying: Retrying = AGAIN,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] | None = None,
    ) -> None:
        named = isinstance(server, str)
        self.http = httpx.Client(**_of(server)) if isinstance(server, str) else server
        key = _own_key() if named and api_key is None else api_key
        self._connect(Blocking(self.http, sleep), key, plain_http, timeout_s, retrying, clock, streams=named)

    def __enter__(self) -> Self:
        """Use it in a with block."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connections."""
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self.http.close()


class AsyncClient(Calls, Later):
    """The service, each call awaited; otherwise it is a `Client`.

    async with AsyncClient("http://127.0.0.1:8000") as client:
        (await client.policy("kestrel", "simple-running")).goal_mm
    """

    def __init__(
        self,
        server: str | httpx.AsyncClient,
        *,
        api_key: str | None = None,
        plain_http: bool = False,
        timeout_s: float = TIMEOUT_S,
        retrying: Retrying = AGAIN,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], Awaitable[None]] | None = None,
    ) -> None:
        named = isinstance(server, str)
        self.http = httpx.AsyncClient(**_of(server)) if isinstance(server, str) else server
        key = _own_key() if named and api_key is None else api_key
        self._connect(Awaited(self.http, sleep), key, plain_http, timeout_s, retrying, clock, streams=named)

    async def __aenter__(self) -> Self:
        """Use it in an async with block."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connections."""
        await self.aclose()

    async def aclose(self) -> None:
        """Close the connections."""
        await self.http.aclose()


def _of(server: str) -> dict[str, Any]:
    """Say how an address is reached: what is on this machine, past any proxy.

    Raises:
        BadSettings: It is no address.
    """
    try:
        url = httpx.URL(server)
    except httpx.InvalidURL:
        url = httpx.URL()
    if url.scheme not in ("http", "https") or not url.host:
        raise BadSettings("Write the address of the service as http://127.0.0.1:8000, or https:// and its name.")
    return {"base_url": url, "trust_env": not _on_this_machine(url)}


def _own_key() -> str | None:
    """Read the key of the settings."""
    from skills.settings import settings

    key = settings().api_key
    return None if key is None else key.get_secret_value()


def _protect(url: httpx.URL) -> None:
    """Refuse to send a key where others can read it.

    Raises:
        UnprotectedKey: It would go over plain HTTP, beyond this machine.
    """
    if url.scheme != "https" and not _on_this_machine(url):
        raise UnprotectedKey(
            f"The key would travel to {url.host} over plain HTTP, where others can read it. Use https://, or a tunnel "
            "to this machine; where the network itself is protected, plain_http=True sends it."
        )


def _on_this_machine(url: httpx.URL) -> bool:
    try:
        return url.host == "localhost" or ip_address(url.host).is_loopback
    except ValueError:
        return False
