"""An open WebSocket of the blocking client; `skills.client.socket` has that of the asynchronous one."""

from contextlib import ExitStack
from typing import Any, Self

from websockets.sync.client import reconnect


class _Connect(reconnect):
    """A connection that does not follow redirects, as those of all other calls."""

    def process_redirect(self, exc: Exception) -> Exception | str:
        return exc


class Socket:
    """A WebSocket whose calls block."""

    def __init__(self, connecting: _Connect) -> None:
        self._stack = ExitStack()
        self._connection = self._stack.enter_context(connecting)

    @classmethod
    def open(cls, url: str, **options: Any) -> Self:
        """Open a WebSocket; options are those of `websockets`."""
        return cls(_Connect(url, **options))

    def exchange(self, text: str | None, timeout_s: float) -> str | bytes:
        """Send a message, if there is one, and return the next one of the service."""
        if text is not None:
            self._connection.send(text)
        return self._connection.recv(timeout_s)

    def close(self) -> None:
        """Close it."""
        self._stack.close()
