"""An open WebSocket of the asynchronous client; `skills.client.blocking.socket` has that of the blocking one."""

import asyncio
from typing import Any, Self

from websockets.asyncio.client import ClientConnection, connect


class _Connect(connect):
    """A connection that does not follow redirects, as those of all other calls."""

    def process_redirect(self, exc: Exception) -> Exception | str:
        return exc


class Socket:
    """A WebSocket on an event loop."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection

    @classmethod
    async def open(cls, url: str, **options: Any) -> Self:
        """Open a WebSocket; options are those of `websockets`."""
        return cls(await _Connect(url, **options))

    async def exchange(self, text: str | None, timeout_s: float) -> str | bytes:
        """Send a message, if there is one, and return the next one of the service."""
        async with asyncio.timeout(timeout_s):
            if text is not None:
                await self._connection.send(text)
            return await self._connection.recv()

    async def close(self) -> None:
        """Close it."""
        await self._connection.close()
