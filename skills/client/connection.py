"""A connection of the asynchronous client: one request, a list with all of its pages, an upload, and a download."""

import hashlib
import random
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from pathlib import Path
from string import Formatter
from typing import Any, TypeVar
from urllib.parse import quote

import httpx2 as httpx
from pydantic import BaseModel, ValidationError
from pydantic_core import to_jsonable_python

from skills.client.files import CHUNK_BYTES, Download, FileUpload, Progress, check_digest, digest_of_etag
from skills.client.problems import NotReached, NotUnderstood, Problem, problem_of, showing_given
from skills.client.retrying import Retrying, may_repeat
from skills.client.waiting import in_thread, upload_body
from skills.errors import refuse_not_finite
from skills.schemas import Page

PAGE_LENGTH = 200  # the longest page that the service returns
M = TypeVar("M", bound=BaseModel)
T = TypeVar("T")


class Connection:
    """The connection that all calls of a client share.

    `named` arguments of its methods are the fields of the path, such as `{surgeon}`, and else the query of a request.
    """

    http: httpx.AsyncClient
    _headers: Mapping[str, str]
    _timeout_s: float
    _retrying: Retrying
    _clock: Callable[[], float]
    _sleep: Callable[[float], Awaitable[None]]
    _streams: bool  # whether responses arrive while they are produced; not so with an in-process application

    # ---- one call

    async def _get(self, kind: type[M], path: str, /, **named: Any) -> M:
        return self._read(kind, as_json(await self._request("GET", path, named)))

    async def _ask(
        self, kind: type[M], method: str, path: str, body: Any = None, /, *, idempotent: bool = True, **named: Any
    ) -> M:
        """Send a request with a JSON body, of which entries that are None are left out."""
        return self._read(kind, as_json(await self._request(method, path, named, body, idempotent=idempotent)))

    async def _bytes(self, path: str, /, accept: str = "*/*", **named: Any) -> bytes:
        """Return the bytes of a response, after they were compared with its ETag."""
        answer = await self._request("GET", path, named, accept=accept)
        check_digest(hashlib.sha256(answer.content).hexdigest(), digest_of_etag(answer.headers.get("etag", "")))
        return answer.content

    async def _all(self, kind: type[M], path: str, /, **named: Any) -> list[M]:
        """Return all items of a paged list."""
        items: list[M] = []
        cursor: int | str | None = None
        while True:
            answer = as_json(await self._request("GET", path, {"limit": PAGE_LENGTH, "cursor": cursor, **named}))
            page = _parse(Page[Any], answer)
            items += [self._read(kind, one) for one in page.items]
            cursor = page.next
            if cursor is None:
                return items

    async def _request(
        self,
        method: str,
        path: str,
        named: Mapping[str, Any],
        body: Any = None,
        *,
        accept: str = "*/*",
        idempotent: bool = True,
    ) -> httpx.Response:
        content = None if body is None else to_jsonable_python(given(body), fallback=_plain)
        target, query = fill(path, named)
        refuse_not_finite({**query, **(content or {})})
        with showing_given({**named, **(content or {})}):
            return await self._send(
                method, target, idempotent=idempotent, params=query, json=content, headers={"Accept": accept}
            )

    def _read(self, kind: type[M], answer: Any) -> M:
        """Return a response as its model; unknown fields are ignored."""
        return _parse(kind, answer)

    # ---- files

    async def _upload(
        self,
        kind: type[M],
        path: str,
        content: Path | bytes,
        media_type: str | None = None,
        progress: Progress | None = None,
        /,
        **named: Any,
    ) -> M:
        """Send a file as the request body; each attempt reads it again from the start."""
        upload = await in_thread(lambda: FileUpload.of(content, media_type))
        target, query = fill(path, named)

        async def attempt() -> M:
            body = upload_body(upload, progress)
            async with self._opened("POST", target, content=body, headers=upload.headers, params=query) as answer:
                await answer.aread()
                return self._read(kind, as_json(answer))

        with showing_given(named):
            return await self._attempts(attempt, idempotent=True)

    async def _save(
        self,
        path: str,
        to: Path,
        progress: Progress | None = None,
        /,
        *,
        sha256: str | None = None,
        accept: str = "*/*",
        **named: Any,
    ) -> Path:
        """Download a file; `to` appears only once it is complete and has the digest: `sha256`, else its ETag's."""
        target, query = fill(path, named)

        async def attempt() -> Path:
            async with self._opened("GET", target, headers={"Accept": accept}, params=query) as answer:
                digest = sha256 or digest_of_etag(answer.headers.get("etag", ""))
                length = answer.headers.get("content-length", "")
                total = int(length) if length.isdecimal() else 0
                file = await in_thread(lambda: Download(to, digest))
                try:
                    async for chunk in answer.aiter_bytes(CHUNK_BYTES):
                        await in_thread(partial(file.write, chunk))
                        if progress is not None:
                            progress(file.size_bytes, max(total, file.size_bytes))
                    await in_thread(file.finish)
                finally:
                    file.discard()
            return to

        with showing_given(named):
            return await self._attempts(attempt, idempotent=True)

    # ---- requests

    async def _send(self, method: str, path: str, *, idempotent: bool = True, **options: Any) -> httpx.Response:
        """Send a request, with retries where they are safe, and return the response with its body.

        Raises:
            Problem: The service returned an error.
            NotReached: There was no response.
        """

        async def attempt() -> httpx.Response:
            async with self._opened(method, path, **options) as answer:
                await answer.aread()
                return answer

        return await self._attempts(attempt, idempotent=idempotent)

    @asynccontextmanager
    async def _opened(
        self,
        method: str,
        path: str,
        *,
        headers: Mapping[str, str] | None = None,
        timeout_s: float | None = None,
        **options: Any,
    ) -> AsyncIterator[httpx.Response]:
        """Send a request once, and yield the response before its body is read.

        Raises:
            Problem: The service returned an error.
        """
        request = self.http.build_request(
            method, path, headers={**self._headers, **(headers or {})}, timeout=timeout_s or self._timeout_s, **options
        )
        answer = await self.http.send(request, stream=True)
        try:
            if not answer.is_success and answer.status_code != httpx.codes.NOT_MODIFIED:
                await answer.aread()
                raise problem_of(answer)
            yield answer
        finally:
            await answer.aclose()

    async def _attempts(self, attempt: Callable[[], Awaitable[T]], *, idempotent: bool) -> T:
        """Run an attempt, and retry it after pauses while that is safe, may help, and is within `Retrying`."""
        began, failed = self._clock(), 0
        while True:
            try:
                return await attempt()
            except Problem as problem:
                failure: Problem | NotReached = problem
                is_temporary, asked_s = problem.is_temporary, problem.retry_after_s or 0.0
            except httpx.TransportError as error:
                tried = f"{self._clock() - began:.1f} s and {failed + 1} attempt{'s' if failed else ''}"
                cause = f" ({error})" if str(error) else ""
                failure = NotReached(
                    f"{self.http.base_url} gave no answer in {tried}{cause}; check that the service runs there."
                )
                failure.__cause__ = error
                is_temporary, asked_s = may_repeat(error, idempotent=idempotent), 0.0
            failed += 1
            pause_s = max(asked_s, self._retrying.pause_s(failed, random.random()))
            late = self._clock() - began + pause_s > self._retrying.deadline_s
            if not is_temporary or late or failed >= self._retrying.attempts:
                raise failure
            await self._sleep(pause_s)


def fill(path: str, named: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]]:
    """Return a path with the values of its fields, each quoted so that it stays one segment, and the other values."""
    fields = {name for _, name, _, _ in Formatter().parse(path) if name}
    quoted = {name: quote(str(named[name]), safe="") for name in fields}
    return path.format(**quoted), given({name: value for name, value in named.items() if name not in fields})


def given(values: Mapping[str, T]) -> dict[str, T]:
    """Return the entries that are not None."""
    return {name: value for name, value in values.items() if value is not None}


def as_json(answer: httpx.Response) -> Any:
    """Return the JSON of a response.

    Raises:
        NotUnderstood: It has none.
    """
    try:
        return answer.json()
    except ValueError as error:
        raise NotUnderstood(
            f"{answer.request.url.host} answered, but not as suture-skills does; check the address and the "
            "proxies in between."
        ) from error


def _plain(value: Any) -> Any:
    """Return an array or a number of numpy as plain Python."""
    return value.tolist()


def _parse(kind: type[M], answer: Any) -> M:
    """Return a response as its model.

    Raises:
        NotUnderstood: The response does not fit the model.
    """
    with _fitting(kind):
        return kind.model_validate(answer)


def parse_text(kind: type[M], text: str | bytes) -> M:
    """Return the JSON of a response, or of an event in one, as its model; raises as `_parse` does."""
    with _fitting(kind):
        return kind.model_validate_json(text)


@contextmanager
def _fitting(kind: type[BaseModel]) -> Iterator[None]:
    try:
        yield
    except ValidationError as error:
        where = ", ".join(".".join(str(part) for part in one["loc"]) for one in error.errors()[:5])
        raise NotUnderstood(
            f"The response is not a {kind.__name__} of this client's version ({where}); update the client or "
            "the service, or read the raw JSON with `get_json`."
        ) from error
