"""Every request, named, counted and told in one line: by its route, never by its path."""

import logging
import re
from collections.abc import Callable
from random import Random
from time import perf_counter

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skills.logs import request_id, told

METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH"})
PROBES = frozenset({"/healthz", "/readyz", "/metrics"})  # asked every few seconds, by machines
NO_ROUTE, NO_METHOD, NO_ANSWER = "none", "other", 0
# A trace's or a UUID's: anything freer could be somebody's name, and it is logged.
GIVEN = re.compile(rb"[0-9a-f]{8}[0-9a-f-]{0,56}")

log = logging.getLogger("skills.api.request")


class Observed:
    """Around the application: it gives a request its id, and tells `seen` of its method, route, status and seconds."""

    def __init__(self, app: ASGIApp, seen: Callable[[str, str, int, float], None]) -> None:
        self.app = app
        self.seen = seen
        self._drawn = Random().getrandbits  # an id is no secret: 64 bits, without asking the system for them each time

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and tell of it when it is answered."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        status = NO_ANSWER

        async def noted(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        token = request_id.set(_given(scope) or f"{self._drawn(64):016x}")
        began = perf_counter()
        try:
            await self.app(scope, receive, noted)
        finally:
            seconds = perf_counter() - began
            method = scope["method"] if scope["method"] in METHODS else NO_METHOD
            route = getattr(scope.get("route"), "path", NO_ROUTE)
            self.seen(method, route, status, seconds)
            level = logging.DEBUG if route in PROBES else logging.INFO
            if log.isEnabledFor(level):
                told(log, "request", level, method=method, route=route, status=status, ms=round(seconds * 1000, 2))
            request_id.reset(token)


def _given(scope: Scope) -> str | None:
    """Take the id that a caller has for the request, if it can be nothing but an id."""
    for name, value in scope["headers"]:
        if name == b"x-request-id" and GIVEN.fullmatch(value):
            return str(value, "ascii")
    return None
