"""`skills serve` with constant responses for comparison, from the same server inside and outside of the application.

`python -m tests.bench.beside BYTES ...` answers `/constant/BYTES` with the least steps that the protocol needs, and
`/fastapi/BYTES` by a minimal FastAPI route. 0 gives an empty 304.
"""

import sys
from collections.abc import Awaitable, Callable
from typing import Any

from fastapi import FastAPI, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from skills import serving
from skills.api.app import create_app
from skills.settings import settings


def constants(sizes: list[int]) -> dict[str, tuple[dict[str, Any], dict[str, Any]]]:
    """Build the ASGI messages of the constant responses."""
    kept = {}
    for size in sizes:
        headers = [(b"content-length", str(size).encode()), (b"content-type", b"application/json")] if size else []
        start = {"type": "http.response.start", "status": 200 if size else 304, "headers": headers}
        kept[f"/constant/{size}"] = start, {"type": "http.response.body", "body": b"x" * size}
    return kept


def routes(sizes: list[int]) -> FastAPI:
    """Build an application of constant routes."""
    app = FastAPI(openapi_url=None)
    for size in sizes:
        app.get(f"/fastapi/{size}")(route(size))
    return app


def route(size: int) -> Callable[[], Awaitable[Response]]:
    content = b"x" * size

    async def constant() -> Response:
        return Response(content, 200 if content else 304, media_type="application/json")

    return constant


class Beside:
    """An ASGI application that answers the constant paths itself and passes on all others."""

    def __init__(self, app: Any, sizes: list[int]) -> None:
        self.app, self.state = app, app.state
        self.kept, self.routes = constants(sizes), routes(sizes)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope.get("path", "")
        if path in self.kept:
            for message in self.kept[path]:
                await send(message)
            return
        app: ASGIApp = self.routes if path.startswith("/fastapi/") else self.app
        await app(scope, receive, send)


if __name__ == "__main__":
    sizes = [int(one) for one in sys.argv[1:]]
    vars(serving)["create_app"] = lambda given: Beside(create_app(given), sizes)
    serving.serve(settings())
