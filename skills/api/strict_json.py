"""Strict JSON: a repeated name in an object is refused, and so are NaN and infinity; -0 is read as 0.

A component that parses the request before this service, such as a proxy, may use the first of two values where Python
uses the last.
"""

import json
from collections.abc import Callable, Coroutine
from typing import Any, NoReturn

from fastapi import Request, Response
from fastapi.routing import APIRoute


class Strict(APIRoute):
    """A route whose JSON body is parsed strictly."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return a handler that replaces the request by one with strict JSON parsing."""
        handle = super().get_route_handler()

        async def strictly(request: Request) -> Response:
            return await handle(_Strictly(request.scope, request.receive))

        return strictly


class _Strictly(Request):
    async def json(self) -> Any:
        """Return the parsed body.

        Raises:
            JSONDecodeError: It is not JSON, an object repeats a name, or a number is not finite.
        """
        return strictly_read(await self.body())


def strictly_read(text: str | bytes) -> Any:
    """Return parsed JSON.

    Raises:
        JSONDecodeError: It is not JSON, an object repeats a name, or a number is not finite.
    """
    # -0 is 0: equal requests have equal digests
    return json.loads(text, object_pairs_hook=_once, parse_float=lambda x: float(x) + 0.0, parse_constant=_refuse)


def _once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    made = dict(pairs)
    if len(made) < len(pairs):
        raise json.JSONDecodeError("An object has the same name twice", "", 0)
    return made


def _refuse(_constant: str) -> NoReturn:
    raise json.JSONDecodeError("A number is not finite", "", 0)
