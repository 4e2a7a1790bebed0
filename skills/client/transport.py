"""How a request travels: at once or awaited. Nothing else differs between the two clients.

Every call is written once, as a coroutine over a `Transport`. `Awaited` awaits; `Blocking` never does, so a coroutine
over it runs to its end in one step, and `finished` takes that step without an event loop.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, AsyncIterable, Awaitable, Callable, Coroutine, Iterable, Iterator
from typing import Any, TypeVar

import httpx2 as httpx

T = TypeVar("T")

PIECE_BYTES = 1 << 20


class Transport(ABC):
    """What a call needs from the outside."""

    http: httpx.Client | httpx.AsyncClient

    @abstractmethod
    async def send(self, request: httpx.Request) -> httpx.Response:
        """Send a request; the answer's body is still to be read."""

    @abstractmethod
    async def read(self, answer: httpx.Response) -> None:
        """Read the whole body."""

    @abstractmethod
    def pieces(self, answer: httpx.Response) -> AsyncGenerator[bytes, None]:
        """Read the body piece by piece."""

    @abstractmethod
    def lines(self, answer: httpx.Response) -> AsyncGenerator[str, None]:
        """Read the body line by line, as the lines come."""

    @abstractmethod
    async def close(self, answer: httpx.Response) -> None:
        """Be done with an answer, read or not."""

    @abstractmethod
    async def sleep(self, seconds: float) -> None:
        """Wait."""

    @abstractmethod
    async def aside(self, work: Callable[[], T]) -> T:
        """Do what reads or writes a file, so that nothing else waits for it."""

    @abstractmethod
    def body(self, pieces: Iterator[bytes], sent: Callable[[bytes], None]) -> Iterable[bytes] | AsyncIterable[bytes]:
        """Make the body of a request from the pieces of a file, and tell of each that has gone out."""


class Blocking(Transport):
    """Over a plain `httpx.Client`."""

    def __init__(self, http: httpx.Client, sleep: Callable[[float], None] | None) -> None:
        self.http: httpx.Client = http
        self._sleep = sleep or time.sleep

    async def send(self, request: httpx.Request) -> httpx.Response:
        """Send a request; the answer's body is still to be read."""
        return self.http.send(request, stream=True)

    async def read(self, answer: httpx.Response) -> None:
        """Read the whole body."""
        answer.read()

    async def pieces(self, answer: httpx.Response) -> AsyncGenerator[bytes, None]:
        """Read the body piece by piece."""
        for piece in answer.iter_bytes(PIECE_BYTES):
            yield piece

    async def lines(self, answer: httpx.Response) -> AsyncGenerator[str, None]:
        """Read the body line by line, as the lines come."""
        for line in answer.iter_lines():
            yield line

    async def close(self, answer: httpx.Response) -> None:
        """Be done with an answer, read or not."""
        answer.close()

    async def sleep(self, seconds: float) -> None:
        """Wait."""
        self._sleep(seconds)

    async def aside(self, work: Callable[[], T]) -> T:
        """Do what reads or writes a file, so that nothing else waits for it."""
        return work()

    def body(self, pieces: Iterator[bytes], sent: Callable[[bytes], None]) -> Iterable[bytes]:
        """Make the body of a request from the pieces of a file, and tell of each that has gone out."""
        for piece in pieces:
            yield piece
            sent(piece)


class Awaited(Transport):
    """Over an `httpx.AsyncClient`."""

    def __init__(self, http: httpx.AsyncClient, sleep: Callable[[float], Awaitable[None]] | None) -> None:
        import anyio

        self.http: httpx.AsyncClient = http
        self._sleep = sleep or anyio.sleep

    async def send(self, request: httpx.Request) -> httpx.Response:
        """Send a request; the answer's body is still to be read."""
        return await self.http.send(request, stream=True)

    async def read(self, answer: httpx.Response) -> None:
        """Read the whole body."""
        await answer.aread()

    async def pieces(self, answer: httpx.Response) -> AsyncGenerator[bytes, None]:
        """Read the body piece by piece."""
        async for piece in answer.aiter_bytes(PIECE_BYTES):
            yield piece

    async def lines(self, answer: httpx.Response) -> AsyncGenerator[str, None]:
        """Read the body line by line, as the lines come."""
        async for line in answer.aiter_lines():
            yield line

    async def close(self, answer: httpx.Response) -> None:
        """Be done with an answer, read or not."""
        await answer.aclose()

    async def sleep(self, seconds: float) -> None:
        """Wait."""
        await self._sleep(seconds)

    async def aside(self, work: Callable[[], T]) -> T:
        """Do what reads or writes a file, so that nothing else waits for it."""
        from anyio import to_thread

        return await to_thread.run_sync(work)

    async def body(self, pieces: Iterator[bytes], sent: Callable[[bytes], None]) -> AsyncGenerator[bytes, None]:
        """Make the body of a request from the pieces of a file, and tell of each that has gone out."""
        while piece := await self.aside(lambda: next(pieces, b"")):
            yield piece
            sent(piece)


def finished(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine that never waits to its end."""
    try:
        coroutine.send(None)
    except StopIteration as ended:
        result: T = ended.value
        return result
    coroutine.close()
    raise AssertionError("A call over a blocking transport waited for something.")
