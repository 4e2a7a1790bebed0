"""Sessions of pose styles over a WebSocket, blocking (`Session`) and asynchronous (`AsyncSession`).

    with client.session("kestrel", "simple-running") as session:
        step = session.next(position_mm, rotation_xyzw)

A session is pinned to the version that is released when it opens. The service closes it when that must not be followed
any more, and `next` raises `SessionClosed` with the cause. A session also closes itself where an answer might be
another pose's: after a timeout, and if a call was cancelled before its answer. Stop the arm in all of these cases.

A session needs `websockets`, which is imported with this module, at the first session.
"""

import asyncio
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Self

import httpx2 as httpx
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import reconnect

from skills.client.connection import Connection, Later, NotUnderstood, Now, SessionClosed, at, call, given, problem_of
from skills.client.transport import finished
from skills.errors import BadInput, BadSettings
from skills.schemas.pose_styles import SessionOpening, SessionPose

CLOSE_S = 1.0  # for the service to take leave
LOST = 1006  # of RFC 6455: the connection ended without a reason


class _Blocking(reconnect):
    """A connection that does not follow redirects, as those of all other calls."""

    def process_redirect(self, exc: Exception) -> Exception | str:
        return exc


class _Awaited(connect):
    """The same, asynchronous."""

    def process_redirect(self, exc: Exception) -> Exception | str:
        return exc


class Wire(ABC):
    """An open WebSocket: text out, text in."""

    @abstractmethod
    async def exchange(self, text: str | None, timeout_s: float) -> str | bytes:
        """Send a message, if there is one, and return the next one of the service."""

    @abstractmethod
    async def close(self) -> None:
        """Close it."""


class BlockingWire(Wire):
    """A WebSocket whose calls block."""

    def __init__(self, connecting: _Blocking) -> None:
        self._stack = ExitStack()
        self._connection = self._stack.enter_context(connecting)

    async def exchange(self, text: str | None, timeout_s: float) -> str | bytes:
        """Send a message, if there is one, and return the next one of the service."""
        if text is not None:
            self._connection.send(text)
        return self._connection.recv(timeout_s)

    async def close(self) -> None:
        """Close it."""
        self._stack.close()


class AwaitedWire(Wire):
    """A WebSocket on an event loop."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection

    async def exchange(self, text: str | None, timeout_s: float) -> str | bytes:
        """Send a message, if there is one, and return the next one of the service."""
        async with asyncio.timeout(timeout_s):
            if text is not None:
                await self._connection.send(text)
            return await self._connection.recv()

    async def close(self) -> None:
        """Close it."""
        await self._connection.close()


class PoseSession(ABC):
    """What both sessions share.

    Attributes:
        opening: What the session is pinned to, the tube, and the limits; from when it is open.
    """

    opening: SessionOpening

    def __init__(self, client: Connection, surgeon: str, suture: str, timeout_s: float) -> None:
        self._client, self._path, self._timeout_s = client, at("policies", surgeon, suture, "session"), timeout_s
        self._wire: Wire | None = None
        self._unread = False  # an answer is still to come

    @call
    async def next(
        self, position_mm: Sequence[float], rotation_xyzw: Sequence[float], phase: int | None = None
    ) -> SessionPose:
        """Return the next pose for the one that the hand has reached; drive there within `tick_s` of the opening.

        Args:
            position_mm: Position of the tip in the frame of `opening`.
            rotation_xyzw: Its orientation, a unit quaternion.
            phase: Another phase than the session's, which is that of its last answer, and at first that of the
                nearest pose.

        Raises:
            SessionClosed: The service closed the session, the connection was lost, or no answer came in time: stop.
            BadInput: That is no pose; the session stays open, and at its phase.
        """
        try:
            pose = {"position_mm": _numbers(position_mm), "rotation_xyzw": _numbers(rotation_xyzw), "phase": phase}
            text = json.dumps(given(pose), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise BadInput("A pose is a position of 3 finite numbers and a quaternion of 4.") from error
        said = await self._exchange(text)
        if "error" in said:
            raise BadInput(str(said["error"]))
        return self._client._read(SessionPose, said)

    async def _exchange(self, text: str | None) -> dict[str, Any]:
        """Send a message, if there is one, and return the service's answer."""
        if self._wire is None:
            raise SessionClosed(None, "The session is not open; enter it with `with`.")
        if self._unread:
            await self._close()
            raise SessionClosed(None, "The answer to an earlier pose was not read, so the session was closed.")
        self._unread = True
        try:
            said = await self._wire.exchange(text, self._timeout_s)
        except ConnectionClosed as closed:
            self._unread = False
            code, reason = (LOST, "") if closed.rcvd is None else (closed.rcvd.code, closed.rcvd.reason)
            raise SessionClosed(code, reason or "The connection was lost.") from None
        except TimeoutError:
            await self._close()
            raise SessionClosed(None, f"No answer within {self._timeout_s:g} s, so the session was closed.") from None
        self._unread = False
        try:
            found = json.loads(said)
        except ValueError:
            found = None
        if not isinstance(found, dict):
            raise NotUnderstood(
                "The service's message is no JSON object; check the address and the proxies in between."
            )
        return found

    @abstractmethod
    async def _connected(self, url: str, headers: Mapping[str, str]) -> Wire:
        """Open the WebSocket."""

    async def _open(self) -> None:
        """Open the session, with retries while the service is busy.

        Raises:
            BadSettings: The client was made from an `httpx` client.
            Problem: The service refuses it.
            NotReached: There was no response.
        """
        if not self._client._streams:
            raise BadSettings("A session makes its own connection.", "Make the client from the address of the service.")

        async def attempt() -> Wire:
            request = self._client._transport.http.build_request("GET", self._path)
            url = request.url.copy_with(scheme="wss" if request.url.scheme == "https" else "ws")
            try:
                return await self._connected(str(url), self._client._headers)
            except InvalidStatus as refused:
                said, body = refused.response, bytes(refused.response.body or b"")
                headers = list(said.headers.raw_items())
                raise problem_of(
                    httpx.Response(said.status_code, headers=headers, content=body, request=request)
                ) from None
            except (OSError, InvalidHandshake) as error:  # a timeout is an OSError
                raise httpx.ConnectError(str(error), request=request) from error

        self._wire = await self._client._attempts(attempt, harmless=True)
        self.opening = self._client._read(SessionOpening, await self._exchange(None))

    async def _close(self) -> None:
        """Close the session."""
        wire, self._wire = self._wire, None
        if wire is not None:
            await wire.close()

    def _how(self) -> dict[str, Any]:
        """Return the options of a connection; loopback addresses bypass the proxies of the environment."""
        proxy = True if self._client._transport.http.trust_env else None
        return {"proxy": proxy, "compression": None, "open_timeout": self._client._timeout_s, "close_timeout": CLOSE_S}


class Session(PoseSession, Now):
    """A session of a `Client`; one thread uses it."""

    async def _connected(self, url: str, headers: Mapping[str, str]) -> Wire:
        return BlockingWire(_Blocking(url, additional_headers=headers, **self._how()))

    def __enter__(self) -> Self:
        """Open the session."""
        try:
            finished(self._open())
        except BaseException:
            finished(self._close())
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the session."""
        finished(self._close())


class AsyncSession(PoseSession, Later):
    """A session of an `AsyncClient`; one task uses it."""

    async def _connected(self, url: str, headers: Mapping[str, str]) -> Wire:
        return AwaitedWire(await _Awaited(url, additional_headers=headers, **self._how()))

    async def __aenter__(self) -> Self:
        """Open the session."""
        try:
            await self._open()
        except BaseException:
            await self._close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the session."""
        await self._close()


def _numbers(values: Sequence[float]) -> list[float]:
    return [float(one) for one in values]
