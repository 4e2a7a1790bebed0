"""One description of a call, two ways to make it.

    @call
    async def surgeon(self, surgeon: str) -> Surgeon: ...

is `client.surgeon("kestrel")` of a `Client`, and `await client.surgeon("kestrel")` of an `AsyncClient`. Editors and
type checkers see the parameters, the answer and the docstring of both.
"""

from collections.abc import Callable, Coroutine
from functools import update_wrapper, wraps
from types import MethodType
from typing import Any, Concatenate, Generic, ParamSpec, Self, TypeVar, cast, overload
from urllib.parse import quote

from skills.client.transport import finished

P = ParamSpec("P")
T = TypeVar("T")


class Now:
    """A client whose calls give the answer."""


class Later:
    """A client whose calls are awaited."""


class call(Generic[P, T]):  # noqa: N801 - it is used as a decorator, as `property` is
    """A method of both clients."""

    def __init__(self, method: Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]) -> None:
        self.method = method
        update_wrapper(cast(Any, self), method)

    @overload
    def __get__(self, client: None, owner: type) -> Self: ...
    @overload
    def __get__(self, client: Now, owner: type) -> Callable[P, T]: ...
    @overload
    def __get__(self, client: Later, owner: type) -> Callable[P, Coroutine[Any, Any, T]]: ...
    def __get__(self, client: Now | Later | None, owner: type) -> Any:
        """Bind it to a client."""
        if client is None:
            return self
        later: Callable[P, Coroutine[Any, Any, T]] = MethodType(self.method, client)
        if isinstance(client, Later):
            return later

        @wraps(later)
        def now(*args: P.args, **kwargs: P.kwargs) -> T:
            return finished(later(*args, **kwargs))

        return now


def at(*parts: str | int) -> str:
    """Write the path of a call; what a caller gives is never read as more than one part of it."""
    return "".join(f"/{quote(str(part), safe='')}" for part in parts)
