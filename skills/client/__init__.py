"""The typed client of the service, blocking (`Client`) and asynchronous (`AsyncClient`); every call is a method.

    with Client("http://127.0.0.1:8000") as client:
        client.add_demo(Path("hand-off.mcap"), surgeon="kestrel", suture="simple-running")
        client.wait(client.train("kestrel", "simple-running", release=True))
        policy = client.policy("kestrel", "simple-running")

Responses are the models of `skills.schemas.given`; unknown fields are ignored, and `client.get_json` returns a response
as plain JSON. An error that the service returns is raised as `Problem`.
"""

import time
from collections.abc import Awaitable, Callable, Sequence
from datetime import datetime
from ipaddress import ip_address
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

import httpx2 as httpx

from skills.client.connection import (
    Connection,
    JobFailed,
    JobTakesLonger,
    Later,
    NotReached,
    NotUnderstood,
    Now,
    Problem,
    SessionClosed,
    UnprotectedKey,
    at,
    call,
    given,
)
from skills.client.plans import Plans
from skills.client.policies import Atlases, Jobs, Policies, Scores, steps_of
from skills.client.recordings import Catalogue, Datasets, Recordings
from skills.client.transport import Awaited, Blocking, Progress, Retrying, Transport
from skills.errors import BadSettings
from skills.remedies import Action, Remedy
from skills.schemas.given import Ready, ServedAt, SignedCheckpoint
from skills.schemas.people import Key, NewKey

if TYPE_CHECKING:
    from skills.client.sessions import AsyncSession, Session

__all__ = [
    "AsyncClient",
    "Client",
    "JobFailed",
    "JobTakesLonger",
    "NotReached",
    "NotUnderstood",
    "Problem",
    "Progress",
    "Retrying",
    "SessionClosed",
    "UnprotectedKey",
    "steps_of",
]


class Keys(Connection):
    """Calls about API keys, and the readiness check."""

    @call
    async def keys(self) -> list[Key]:
        """List all keys, including those that were revoked or have expired."""
        return await self._all(Key, at("keys"))

    @call
    async def make_key(
        self,
        owner: str,
        role: Literal["reader", "uploader", "trainer", "releaser", "admin"] = "reader",
        *,
        expires_at: datetime | None = None,
        surgeons: Sequence[str] | None = None,
    ) -> NewKey:
        """Create a key; its `secret` is in this response only.

        The request is not retried after a lost connection, because that could create two keys.

        Args:
            owner: The owner's name.
            role: The role; each may do everything that those before it may.
            expires_at: When the key expires, with a time zone; default: never.
            surgeons: Pseudonyms of the surgeons to whose data the key is restricted; default: no restriction.
        """
        until = None if expires_at is None else expires_at.isoformat()
        body = {"owner": owner, "role": role, "expires_at": until, "surgeons": surgeons}
        return await self._ask(NewKey, "POST", at("keys"), given(body), harmless=False)

    @call
    async def revoke_key(self, key: str) -> Key:
        """Revoke a key permanently; `key` is its id, the eight characters after "skills_"."""
        return await self._ask(Key, "DELETE", at("keys", key))

    @call
    async def ready(self) -> Ready:
        """Check whether the service can work; while it starts, the request is retried as for every busy response."""
        return await self._get(Ready, at("readyz"))


class History(Connection):
    """Calls about the signed history."""

    @call
    async def served_at(self, surgeon: str, suture: str, moment: datetime) -> ServedAt:
        """Return the version of a style that was served at a moment, with proofs that need no trust in the service.

        Args:
            surgeon: The surgeon.
            suture: The suture type.
            moment: The moment, with a time zone.
        """
        return await self._get(ServedAt, at("history"), surgeon=surgeon, suture=suture, at=moment.isoformat())

    @call
    async def checkpoint(self) -> SignedCheckpoint:
        """Return the newest signed checkpoint of the history, to be kept elsewhere."""
        return await self._get(SignedCheckpoint, at("history", "checkpoint"))


TIMEOUT_S = 60.0  # ours: the service reads a large recording in at most 30 s, and the request may be queued before
ANSWER_S = 1.0  # ours: an answer takes milliseconds, and an arm must not go on for long without one
AGAIN = Retrying()


class Calls(Atlases, Catalogue, Recordings, Datasets, Jobs, Policies, Plans, Keys, Scores, History):
    """All calls, and the state that they share."""

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
        """Return the class and the service's address, never the key."""
        signed = ", with a key" if self._headers else ""
        return f"<{type(self).__name__} of {self._transport.http.base_url}{signed}>"

    @call
    async def send(self, /, method: str, path: str, **how: Any) -> httpx.Response:
        """Send any request, and raise `Problem` for an error response; `how` is as in `httpx.Client.request`.

        Only a GET is retried after a lost connection; other methods only if the service certainly did nothing.
        """
        return await self._send(method, path, harmless=method == "GET", **how)

    @call
    async def get_json(self, /, path: str, **query: Any) -> Any:
        """Return a response as the plain JSON that the service sent."""
        return await self._json("GET", path, params=given(query))


class Client(Calls, Now):
    """The blocking client of the service.

        with Client("http://127.0.0.1:8000") as client:
            client.policy("kestrel", "simple-running").goal_mm

    Args:
        server: The service's address; or an `httpx.Client`, for example one with proxies or certificates of its own.
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
        self.http = httpx.Client(**_of(server), timeout=timeout_s) if isinstance(server, str) else server
        key = _own_key() if named and api_key is None else api_key
        self._connect(Blocking(self.http, sleep), key, plain_http, timeout_s, retrying, clock, streams=named)

    def __enter__(self) -> Self:
        """Return the client."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connections."""
        self.close()

    def session(self, surgeon: str, suture: str, *, timeout_s: float = ANSWER_S) -> "Session":
        """Return a session of the released pose style, to be entered with `with`; see `skills.client.sessions`.

        Args:
            surgeon: The surgeon's pseudonym.
            suture: The suture type.
            timeout_s: Longest wait for an answer; then the session is closed.
        """
        from skills.client.sessions import Session  # here, because of websockets

        return Session(self, surgeon, suture, timeout_s)

    def close(self) -> None:
        """Close the connections."""
        self.http.close()


class AsyncClient(Calls, Later):
    """The asynchronous client of the service; its arguments and errors are those of `Client`.

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
        self.http = httpx.AsyncClient(**_of(server), timeout=timeout_s) if isinstance(server, str) else server
        key = _own_key() if named and api_key is None else api_key
        self._connect(Awaited(self.http, sleep), key, plain_http, timeout_s, retrying, clock, streams=named)

    async def __aenter__(self) -> Self:
        """Return the client."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connections."""
        await self.aclose()

    def session(self, surgeon: str, suture: str, *, timeout_s: float = ANSWER_S) -> "AsyncSession":
        """Return a session of the released pose style, to be entered with `async with`; otherwise as of `Client`."""
        from skills.client.sessions import AsyncSession

        return AsyncSession(self, surgeon, suture, timeout_s)

    async def aclose(self) -> None:
        """Close the connections."""
        await self.http.aclose()


def _of(server: str) -> dict[str, Any]:
    """Return the `httpx` options for an address; loopback addresses bypass the proxies of the environment.

    Raises:
        BadSettings: It is not an http or https address.
    """
    try:
        url = httpx.URL(server)
    except httpx.InvalidURL:
        url = httpx.URL()
    if url.scheme not in ("http", "https") or not url.host:
        raise BadSettings(
            "The address of the service begins with neither http:// nor https://, or names no host.",
            "Write it as http://127.0.0.1:8000, or https:// and its name.",
        )
    return {"base_url": url, "trust_env": not _on_this_machine(url)}


def _own_key() -> str | None:
    """Return the API key of the settings, or None."""
    from skills.settings import settings

    key = settings().api_key
    return None if key is None else key.get_secret_value()


def _protect(url: httpx.URL) -> None:
    """Check that the key is not sent where others can read it.

    Raises:
        UnprotectedKey: It would be sent over plain HTTP to another machine.
    """
    if url.scheme != "https" and not _on_this_machine(url):
        raise UnprotectedKey(
            f"The key would be sent to {url.host} over plain HTTP, where others can read it.",
            Remedy(Action.PROTECT_KEY),
        )


def _on_this_machine(url: httpx.URL) -> bool:
    try:
        return url.host == "localhost" or ip_address(url.host).is_loopback
    except ValueError:
        return False
