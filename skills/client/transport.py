"""Transports of requests, blocking and asynchronous, the retry policy, and the files that they send and save.

Files are sent and saved in chunks, with their digest; a download appears only when it is complete.

Every call is written once, as a coroutine over a `Transport`. `Awaited` awaits; `Blocking` never suspends, so a
coroutine over it runs to its end in one step, and `finished` takes that step without an event loop.

A failed request is in one of two cases. *Nothing was done*: no connection was made, or the service answered 429, or 503
with Retry-After; then any request may be sent again. *Unknown*: the connection was lost before the response arrived;
then only an idempotent call may be sent again. Nearly all of our calls are idempotent, POST included, because resources
are identified by their content. The exceptions are release, withdrawal and a training with `release`, because somebody
may have decided otherwise in between, and the creation of a key.
"""

import base64
import hashlib
import io
import os
import re
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, AsyncIterable, Awaitable, Callable, Coroutine, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Self, TypeVar

import httpx2 as httpx

from skills.errors import Corrupt

Progress = Callable[[int, int], None]  # called with the bytes transferred so far and the total

ETAG = re.compile(r'(?:W/)?"([0-9a-f]{64})"')  # a proxy that compresses makes it weak; the decoded bytes are the same


NEVER_SENT = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout, httpx.ProxyError)
MAY_PASS = (*NEVER_SENT, httpx.NetworkError, httpx.TimeoutException, httpx.RemoteProtocolError)
T = TypeVar("T")
PIECE_BYTES = 1 << 20


@dataclass(frozen=True)
class FileUpload:
    """A file to upload: path or bytes, size, media type, and SHA-256 in base64."""

    content: Path | bytes
    size_bytes: int
    media_type: str
    digest: str

    @classmethod
    def of(cls, content: Path | bytes, media_type: str | None) -> Self:
        """Read a file once for its size and digest; without `media_type`, its content determines it.

        Raises:
            UnknownFormat: The service does not read such a file.
            UnreadableRecording: It is empty.
        """
        from skills.formats import media_type_of  # slow to import

        seen, size = hashlib.sha256(), 0
        with _opened(content) as file:
            kind = media_type or media_type_of(file)
            file.seek(0)
            while data := file.read(PIECE_BYTES):
                seen.update(data)
                size += len(data)
        return cls(content, size, kind, base64.b64encode(seen.digest()).decode())

    @property
    def headers(self) -> dict[str, str]:
        """Return the headers that describe the body."""
        return {
            "Content-Type": self.media_type,
            "Content-Length": str(self.size_bytes),
            "Content-Digest": f"sha-256=:{self.digest}:",
        }

    def pieces(self) -> Iterator[bytes]:
        """Yield the file in chunks from its start."""
        with _opened(self.content) as file:
            while data := file.read(PIECE_BYTES):
                yield data

    def told(self, progress: Progress | None) -> Callable[[bytes], None]:
        """Return a callback that counts sent chunks from 0 and reports them to `progress`."""
        went = 0

        def tell(data: bytes) -> None:
            nonlocal went
            went += len(data)
            if progress is not None:
                progress(went, self.size_bytes)

        return tell


def _opened(content: Path | bytes) -> BinaryIO:
    return io.BytesIO(content) if isinstance(content, bytes) else content.open("rb")


class Arriving:
    """A file being downloaded to a temporary name; it gets its own name when it is complete and has its digest."""

    def __init__(self, to: Path, sha256: str) -> None:
        self.to, self.sha256 = to, sha256
        self.size_bytes = 0
        self._seen = hashlib.sha256()
        try:
            handle, name = tempfile.mkstemp(prefix=f".{to.name}.", dir=to.parent)
        except OSError as error:
            error.filename = str(to)  # not the temporary name, which means nothing to the user
            raise
        self._part, self._file = Path(name), os.fdopen(handle, "wb")

    def write(self, data: bytes) -> None:
        """Write the next chunk."""
        self._seen.update(data)
        self._file.write(data)
        self.size_bytes += len(data)

    def finish(self) -> None:
        """Check the digest, and move the file to its name.

        Raises:
            Corrupt: The digest differs; a file that had the name before is unchanged.
        """
        self._file.close()
        check(self._seen.hexdigest(), self.sha256)
        self._part.chmod(0o666 & ~_umask())
        self._part.replace(self.to)

    def forget(self) -> None:
        """Close and delete the temporary file; after `finish` there is none."""
        self._file.close()
        self._part.unlink(missing_ok=True)


def keep(data: bytes, to: Path) -> None:
    """Write bytes to a file atomically."""
    file = Arriving(to, hashlib.sha256(data).hexdigest())
    try:
        file.write(data)
        file.finish()
    finally:
        file.forget()


def check(found: str, named: str) -> None:
    """Compare two digests.

    Raises:
        Corrupt: They differ.
    """
    if found != named:
        raise Corrupt(
            "The received data does not match the digest in the response (SHA-256). Nothing was stored; fetch it again."
        )


def named_by(etag: str) -> str:
    """Return the SHA-256 in an ETag of the service.

    Raises:
        Corrupt: It does not contain one.
    """
    said = ETAG.fullmatch(etag)
    if said is None:
        raise Corrupt(
            "The response has no ETag with a digest, so its content cannot be verified; check the proxies in between."
        )
    return said[1]


def _umask() -> int:
    """Return the process's umask, which `mkstemp` does not apply."""
    # the umask can only be read by setting it
    mask = os.umask(0)
    os.umask(mask)
    return mask


@dataclass(frozen=True)
class Retrying:
    """The retry policy. The defaults are ours, for a service that restarts within seconds.

    Attributes:
        attempts: Largest number of attempts; 1 never retries.
        first_s: The first pause. Each further one is twice as long, and half of it is random, so that many clients do
            not
            retry at the same moment.
        longest_s: The longest pause, unless the service requests a longer one with Retry-After.
        deadline_s: Time from the first attempt after which no further one begins.
    """

    attempts: int = 5
    first_s: float = 0.2
    longest_s: float = 5.0
    deadline_s: float = 60.0

    def pause_s(self, failed: int, chance: float) -> float:
        """Return the pause after a number of failures; `chance` is a random number from 0 to 1."""
        # exponential backoff with jitter
        full = min(self.longest_s, self.first_s * 2.0 ** (failed - 1))
        return full * (0.5 + 0.5 * chance)


def may_repeat(error: httpx.TransportError, *, harmless: bool) -> bool:
    """Return whether a request that failed in transport may be sent again."""
    return isinstance(error, MAY_PASS if harmless else NEVER_SENT)


class Transport(ABC):
    """The operations that a call needs: HTTP, sleeping, and file access."""

    http: httpx.Client | httpx.AsyncClient

    @abstractmethod
    async def send(self, request: httpx.Request) -> httpx.Response:
        """Send a request, and return the response before its body is read."""

    @abstractmethod
    async def read(self, answer: httpx.Response) -> None:
        """Read the complete body."""

    @abstractmethod
    def pieces(self, answer: httpx.Response) -> AsyncGenerator[bytes, None]:
        """Yield the body in chunks."""

    @abstractmethod
    def lines(self, answer: httpx.Response) -> AsyncGenerator[str, None]:
        """Yield the lines of the body as they arrive."""

    @abstractmethod
    async def close(self, answer: httpx.Response) -> None:
        """Close a response, whether its body was read or not."""

    @abstractmethod
    async def sleep(self, seconds: float) -> None:
        """Sleep for a number of seconds."""

    @abstractmethod
    async def aside(self, work: Callable[[], T]) -> T:
        """Run a function that reads or writes a file without blocking other coroutines."""

    @abstractmethod
    def body(self, pieces: Iterator[bytes], sent: Callable[[bytes], None]) -> Iterable[bytes] | AsyncIterable[bytes]:
        """Return a request's body from the chunks of a file; `sent` is called with each chunk after it was sent."""


class Blocking(Transport):
    """Transport over an `httpx.Client`."""

    def __init__(self, http: httpx.Client, sleep: Callable[[float], None] | None) -> None:
        self.http: httpx.Client = http
        self._sleep = sleep or time.sleep

    async def send(self, request: httpx.Request) -> httpx.Response:
        """Send a request, and return the response before its body is read."""
        return self.http.send(request, stream=True)

    async def read(self, answer: httpx.Response) -> None:
        """Read the complete body."""
        answer.read()

    async def pieces(self, answer: httpx.Response) -> AsyncGenerator[bytes, None]:
        """Yield the body in chunks."""
        for piece in answer.iter_bytes(PIECE_BYTES):
            yield piece

    async def lines(self, answer: httpx.Response) -> AsyncGenerator[str, None]:
        """Yield the lines of the body as they arrive."""
        for line in answer.iter_lines():
            yield line

    async def close(self, answer: httpx.Response) -> None:
        """Close a response, whether its body was read or not."""
        answer.close()

    async def sleep(self, seconds: float) -> None:
        """Sleep for a number of seconds."""
        self._sleep(seconds)

    async def aside(self, work: Callable[[], T]) -> T:
        """Run a function that reads or writes a file, in this thread."""
        return work()

    def body(self, pieces: Iterator[bytes], sent: Callable[[bytes], None]) -> Iterable[bytes]:
        """Yield the chunks of a request's body; `sent` is called with each chunk after it was sent."""
        for piece in pieces:
            yield piece
            sent(piece)


class Awaited(Transport):
    """Transport over an `httpx.AsyncClient`."""

    def __init__(self, http: httpx.AsyncClient, sleep: Callable[[float], Awaitable[None]] | None) -> None:
        import anyio

        self.http: httpx.AsyncClient = http
        self._sleep = sleep or anyio.sleep

    async def send(self, request: httpx.Request) -> httpx.Response:
        """Send a request, and return the response before its body is read."""
        return await self.http.send(request, stream=True)

    async def read(self, answer: httpx.Response) -> None:
        """Read the complete body."""
        await answer.aread()

    async def pieces(self, answer: httpx.Response) -> AsyncGenerator[bytes, None]:
        """Yield the body in chunks."""
        async for piece in answer.aiter_bytes(PIECE_BYTES):
            yield piece

    async def lines(self, answer: httpx.Response) -> AsyncGenerator[str, None]:
        """Yield the lines of the body as they arrive."""
        async for line in answer.aiter_lines():
            yield line

    async def close(self, answer: httpx.Response) -> None:
        """Close a response, whether its body was read or not."""
        await answer.aclose()

    async def sleep(self, seconds: float) -> None:
        """Sleep for a number of seconds."""
        await self._sleep(seconds)

    async def aside(self, work: Callable[[], T]) -> T:
        """Run a function that reads or writes a file, in a thread."""
        from anyio import to_thread

        return await to_thread.run_sync(work)

    async def body(self, pieces: Iterator[bytes], sent: Callable[[bytes], None]) -> AsyncGenerator[bytes, None]:
        """Yield the chunks of a request's body; `sent` is called with each chunk after it was sent."""
        while piece := await self.aside(lambda: next(pieces, b"")):
            yield piece
            sent(piece)


def finished(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine that never suspends, and return its result."""
    try:
        coroutine.send(None)
    except StopIteration as ended:
        result: T = ended.value
        return result
    coroutine.close()
    raise AssertionError("A call over a blocking transport was suspended.")
