"""What all calls are made with: one request, a list page by page, a file out, a file in."""

import hashlib
import random
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import aclosing, asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import httpx2 as httpx
from pydantic import BaseModel, ValidationError

from skills.client.files import Arriving, Progress, Upload, check, named_by
from skills.client.problems import NotReached, NotUnderstood, Problem, problem_of
from skills.client.retrying import Retrying, may_repeat
from skills.client.transport import Transport

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)

PAGE = 200  # the largest that the service gives


class Connection:
    """A service, behind a transport."""

    _transport: Transport
    _headers: Mapping[str, str]
    _timeout_s: float
    _retrying: Retrying
    _clock: Callable[[], float]
    _streams: bool  # whether answers come while they are made; within one process they may not

    # ---- answers

    def _read(self, kind: type[M], said: Any) -> M:
        """Make the model of an answer; fields that it does not know are passed over."""
        try:
            return kind.model_validate(said)
        except ValidationError as error:
            where = ", ".join(".".join(str(part) for part in one["loc"]) for one in error.errors()[:5])
            raise NotUnderstood(
                f"The answer is no {kind.__name__} as this client knows it ({where}); bring service and client to one "
                "version, or take it as it is with `get_json`."
            ) from error

    async def _get(self, kind: type[M], path: str, /, **query: Any) -> M:
        return self._read(kind, await self._json("GET", path, params=given(query)))

    async def _ask(self, kind: type[M], method: str, path: str, body: Any = None, **how: Any) -> M:
        return self._read(kind, await self._json(method, path, json=body, **how))

    async def _json(self, method: str, path: str, **how: Any) -> Any:
        return _as_json(await self._send(method, path, **how))

    async def _bytes(self, path: str, accept: str | None = None, **query: Any) -> bytes:
        """Get bytes that are what their ETag says."""
        headers = {} if accept is None else {"Accept": accept}
        answer = await self._send("GET", path, headers=headers, params=given(query))
        check(hashlib.sha256(answer.content).hexdigest(), named_by(answer.headers.get("etag", "")))
        return answer.content

    async def _all(self, kind: type[M], path: str, /, **query: Any) -> list[M]:
        """Get a list, all pages of it."""
        items: list[M] = []
        cursor: Any = None
        while True:
            page = await self._json("GET", path, params=given({"limit": PAGE, "cursor": cursor, **query}))
            items += [self._read(kind, one) for one in page["items"]]
            cursor = page["next"]
            if cursor is None:
                return items

    # ---- requests

    async def _send(self, method: str, path: str, *, harmless: bool = True, **how: Any) -> httpx.Response:
        """Send a request, again where that may help, and read the answer.

        Raises:
            Problem: The service refused.
            NotReached: It gave no answer.
        """

        async def attempt() -> httpx.Response:
            async with self._opened(method, path, **how) as answer:
                await self._transport.read(answer)
                return answer

        return await self._attempts(attempt, harmless=harmless)

    async def _upload(
        self,
        kind: type[M],
        path: str,
        content: Path | bytes,
        media_type: str | None,
        progress: Progress | None,
        query: Any,
    ) -> M:
        """Send a file as the body, read anew for each attempt."""
        upload = await self._transport.aside(lambda: Upload.of(content, media_type))

        async def attempt() -> M:
            body = self._transport.body(upload.pieces(), upload.told(progress))
            async with self._opened("POST", path, content=body, headers=upload.headers, params=given(query)) as answer:
                await self._transport.read(answer)
                return self._read(kind, _as_json(answer))

        return await self._attempts(attempt, harmless=True)

    async def _save(
        self,
        path: str,
        to: Path,
        progress: Progress | None,
        *,
        sha256: str | None = None,
        accept: str | None = None,
        query: Mapping[str, Any] | None = None,
    ) -> Path:
        """Fetch a file piece by piece; it stands at `to` only when it is whole and has its digest, else its ETag's."""
        headers = {} if accept is None else {"Accept": accept}
        aside = self._transport.aside

        async def attempt() -> Path:
            async with self._opened("GET", path, headers=headers, params=given(query or {})) as answer:
                named = sha256 or named_by(answer.headers.get("etag", ""))
                total = int(answer.headers.get("content-length", 0))
                file = await aside(lambda: Arriving(to, named))
                try:
                    async with aclosing(self._transport.pieces(answer)) as pieces:
                        async for data in pieces:
                            await aside(partial(file.write, data))
                            if progress is not None:
                                progress(file.size_bytes, max(total, file.size_bytes))
                    await aside(file.finish)
                finally:
                    file.forget()
            return to

        return await self._attempts(attempt, harmless=True)

    @asynccontextmanager
    async def _opened(
        self,
        method: str,
        path: str,
        *,
        headers: Mapping[str, str] | None = None,
        timeout_s: float | None = None,
        **how: Any,
    ) -> AsyncIterator[httpx.Response]:
        """Send a request once; the answer's body is still to be read.

        Raises:
            Problem: The service refused.
        """
        request = self._transport.http.build_request(
            method, path, headers={**self._headers, **(headers or {})}, timeout=timeout_s or self._timeout_s, **how
        )
        answer = await self._transport.send(request)
        try:
            if not answer.is_success and answer.status_code != httpx.codes.NOT_MODIFIED:
                await self._transport.read(answer)
                raise problem_of(answer)
            yield answer
        finally:
            await self._transport.close(answer)

    async def _attempts(self, attempt: Callable[[], Awaitable[T]], *, harmless: bool) -> T:
        """Try, and try again after a pause, for as long as that is harmless and may help (`skills.client.retrying`)."""
        began, failed = self._clock(), 0
        while True:
            try:
                return await attempt()
            except Problem as problem:
                failure: Problem | NotReached = problem
                passes, asked_s = problem.passes, problem.retry_after_s or 0.0
            except httpx.TransportError as error:
                failed_s = self._clock() - began
                failure = NotReached(
                    f"{self._transport.http.base_url} gave no answer in {failed_s:.1f} s and {failed + 1} attempts "
                    f"({type(error).__name__}); see that the service runs there."
                )
                failure.__cause__ = error
                passes, asked_s = may_repeat(error, harmless=harmless), 0.0
            failed += 1
            pause_s = max(asked_s, self._retrying.pause_s(failed, random.random()))
            late = self._clock() - began + pause_s > self._retrying.deadline_s
            if not passes or late or failed >= self._retrying.attempts:
                raise failure
            await self._transport.sleep(pause_s)


def _as_json(answer: httpx.Response) -> Any:
    try:
        return answer.json()
    except ValueError as error:
        raise NotUnderstood(
            f"{answer.request.url.host} answers, and not as this service does; see what stands between."
        ) from error


def given(query: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out what was not given."""
    return {name: value for name, value in query.items() if value is not None}
