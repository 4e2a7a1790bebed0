"""Sessions of pose styles over a WebSocket, of an `AsyncClient`.

    async with client.session("kestrel", "simple-running") as session:
        step = await session.next(position_mm, rotation_xyzw)

A session is pinned to the version that is released when it opens. The service closes it when that must not be followed
any more, and `next` raises `SessionClosed` with the cause. A session also closes itself where an answer might be
another pose's: after a timeout, and if a call was cancelled before its answer. Stop the arm in all of these cases.

A session needs `websockets`, which is imported with this module, at the first session.
"""

import json
from collections.abc import Sequence
from types import TracebackType
from typing import Self

import httpx2 as httpx
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from skills.client.connection import Connection, fill, given
from skills.client.problems import NotUnderstood, SessionClosed, problem_of
from skills.client.socket import Socket
from skills.errors import BadInput, BadSettings
from skills.schemas.pose_styles import SessionOpening, SessionPose

CLOSE_S = 1.0  # for the service to take leave
LOST = 1006  # of RFC 6455: the connection ended without a reason
PATH = "/policies/{surgeon}/{suture}/session"


class AsyncSession:
    """A session of an `AsyncClient`; one task, or thread, uses it.

    Attributes:
        opening: What the session is pinned to, the tube, and the limits; from when it is open.
    """

    opening: SessionOpening

    def __init__(self, client: Connection, surgeon: str, suture: str, timeout_s: float) -> None:
        self._client, self._timeout_s = client, timeout_s
        self._path, _ = fill(PATH, {"surgeon": surgeon, "suture": suture})
        self._socket: Socket | None = None
        self._unread = False  # an answer is still to come

    async def next(
        self, position_mm: Sequence[float], rotation_xyzw: Sequence[float], phase: int | None = None
    ) -> SessionPose:
        """Return the next pose for the one that the hand has reached; drive there within `tick_s` of the opening.

        Args:
            position_mm: Position of the tip in the frame of `opening`.
            rotation_xyzw: Its orientation, a unit quaternion.
            phase: Another phase than the session's, which is that of its last answer, and at first by the joining rule
                of the version.

        Raises:
            SessionClosed: The service closed the session, the connection was lost, or no answer came in time: stop.
            BadInput: That is no pose; the session stays open, and at its phase.
        """
        try:
            position, rotation = [float(one) for one in position_mm], [float(one) for one in rotation_xyzw]
            pose = {"position_mm": position, "rotation_xyzw": rotation, "phase": phase}
            text = json.dumps(given(pose), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise BadInput("A pose is a position of 3 finite numbers and a quaternion of 4.") from error
        answer = await self._exchange(text)
        if "error" in answer:
            raise BadInput(str(answer["error"]))
        return self._client._read(SessionPose, answer)

    async def _exchange(self, text: str | None) -> dict[str, object]:
        """Send a message, if there is one, and return the service's answer."""
        if self._socket is None:
            raise SessionClosed(None, "The session is not open; enter it with `with`.")
        if self._unread:
            await self._close()
            raise SessionClosed(None, "The answer to an earlier pose was not read, so the session was closed.")
        self._unread = True
        try:
            message = await self._socket.exchange(text, self._timeout_s)
        except ConnectionClosed as closed:
            self._unread = False
            code, reason = (LOST, "") if closed.rcvd is None else (closed.rcvd.code, closed.rcvd.reason)
            raise SessionClosed(code, reason or "The connection was lost.") from None
        except TimeoutError:
            await self._close()
            raise SessionClosed(None, f"No answer within {self._timeout_s:g} s, so the session was closed.") from None
        self._unread = False
        try:
            answer = json.loads(message)
        except ValueError:
            answer = None
        if not isinstance(answer, dict):
            raise NotUnderstood(
                "The service's message is no JSON object; check the address and the proxies in between."
            )
        return answer

    async def __aenter__(self) -> Self:
        """Open the session, with retries while the service is busy.

        Raises:
            BadSettings: The client was made from an `httpx` client.
            Problem: The service refuses it.
            NotReached: There was no response.
        """
        if not self._client._streams:
            raise BadSettings("A session makes its own connection.", "Make the client from the address of the service.")
        try:
            self._socket = await self._client._attempts(self._connect, idempotent=True)
            self.opening = self._client._read(SessionOpening, await self._exchange(None))
        except BaseException:
            await self._close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the session."""
        await self._close()

    async def _connect(self) -> Socket:
        """Open the WebSocket; loopback addresses bypass the proxies of the environment."""
        client = self._client
        request = client.http.build_request("GET", self._path)
        url = request.url.copy_with(scheme="wss" if request.url.scheme == "https" else "ws")
        proxy = True if client.http.trust_env else None
        try:
            return await Socket.open(
                str(url),
                additional_headers=client._headers,
                proxy=proxy,
                compression=None,
                open_timeout=client._timeout_s,
                close_timeout=CLOSE_S,
            )
        except InvalidStatus as refused:
            answer, body = refused.response, bytes(refused.response.body or b"")
            headers = list(answer.headers.raw_items())
            raise problem_of(
                httpx.Response(answer.status_code, headers=headers, content=body, request=request)
            ) from None
        except (OSError, InvalidHandshake) as error:  # a timeout is an OSError
            raise httpx.ConnectError(str(error), request=request) from error

    async def _close(self) -> None:
        """Close the session."""
        socket, self._socket = self._socket, None
        if socket is not None:
            await socket.close()
