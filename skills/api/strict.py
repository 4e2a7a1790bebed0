"""JSON that can be read in one way only: a name that comes twice in an object is refused, and so are NaN and infinity.

What reads a request before us, such as a proxy, might take the first of two where Python takes the last.
"""

import json
from collections.abc import Callable, Coroutine
from typing import Any, NoReturn

from fastapi import Request, Response
from fastapi.routing import APIRoute


class Strict(APIRoute):
    """A route whose body is read so."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Handle the request with its body read strictly."""
        handle = super().get_route_handler()

        async def strictly(request: Request) -> Response:
            return await handle(_Strictly(request.scope, request.receive))

        return strictly


class _Strictly(Request):
    async def json(self) -> Any:
        """Read the body.

        Raises:
            JSONDecodeError: It is no JSON, or could be read in two ways.
        """
        return json.loads(await self.body(), object_pairs_hook=_once, parse_constant=_refuse)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        raise json.JSONDecodeError("A name comes twice in an object", "", 0)
    return made


def _refuse(_constant: str) -> NoReturn:
    raise json.JSONDecodeError("A number is not finite", "", 0)
