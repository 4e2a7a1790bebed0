"""The server's connections, which wait for no client for ever.

uvicorn drops a connection that is idle between two requests, and no other. Here the head of a request must be there in
time, too, and what is left of a body when its answer is out.
"""

from asyncio import TimerHandle, Transport

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

HEAD_S = 10.0


class PunctualConnection(HttpToolsProtocol):
    """A connection that is closed `HEAD_S` after it waits for a head or for the rest of an answered request."""

    _due: TimerHandle | None = None

    def connection_made(self, transport: Transport) -> None:  # type: ignore[override]
        """Wait for the first request."""
        super().connection_made(transport)
        self._expect()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for nothing."""
        self._have()
        super().connection_lost(exc)

    def on_message_begin(self) -> None:
        """Wait for the rest of the head."""
        self._expect()
        super().on_message_begin()

    def on_headers_complete(self) -> None:
        """Leave the body to whoever reads it."""
        self._have()
        super().on_headers_complete()

    def on_response_complete(self) -> None:
        """Wait for a body that nobody reads."""
        if self.cycle.more_body:
            self._expect()
        super().on_response_complete()

    def on_message_complete(self) -> None:
        """Be done with a request."""
        self._have()
        super().on_message_complete()

    def _expect(self) -> None:
        self._have()
        self._due = self.loop.call_later(HEAD_S, self._close)

    def _have(self) -> None:
        if self._due is not None:
            self._due.cancel()
            self._due = None

    def _close(self) -> None:
        if not self.transport.is_closing():
            self.transport.close()
