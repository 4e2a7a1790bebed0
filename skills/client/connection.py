"""The base of both clients: errors, one definition of a call for blocking and asynchronous use, and sending requests.

    @call
    async def surgeon(self, surgeon: str) -> Surgeon: ...

is `client.surgeon("kestrel")` of a `Client`, and `await client.surgeon("kestrel")` of an `AsyncClient`. Editors and
type checkers see the parameters, the return type and the docstring of both.

`Connection` has the operations of which all calls are made: one request, a list with all of its pages, an upload, and a
download. Errors about a file that was to be sent are those of `skills.errors`; the others are defined here.
"""

import email.utils
import hashlib
import random
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping, Sequence
from contextlib import aclosing, asynccontextmanager
from dataclasses import dataclass
from functools import partial, update_wrapper, wraps
from inspect import signature
from pathlib import Path
from types import MethodType
from typing import Any, Concatenate, Generic, ParamSpec, Self, TypeVar, cast, overload
from urllib.parse import quote

import httpx2 as httpx
from pydantic import BaseModel, ValidationError

from skills.client.transport import (
    Arriving,
    FileUpload,
    Progress,
    Retrying,
    Transport,
    check,
    finished,
    may_repeat,
    named_by,
)
from skills.errors import SkillsError
from skills.remedies import did_you_mean, read_remedies
from skills.schemas.operation import Job

TOO_MANY, UNAVAILABLE = 429, 503
LONGEST_SHOWN = 60  # longest value that a message repeats, in characters
P = ParamSpec("P")
T = TypeVar("T")


@dataclass
class Refused:
    """An argument that the service refused: its path in the request, the reason, and the given value if it is known."""

    path: tuple[str, ...]
    why: str
    given: Any = None

    @classmethod
    def of(cls, said: Mapping[str, Any]) -> Self:
        """Return it from an entry of a problem's `errors`, whose path begins with the part of the request."""
        part, *path = str(said.get("where", "")).split(".")
        return cls(tuple(path if part in ("body", "query", "path", "header") else [part, *path]), str(said.get("why")))

    def sentence(self, name: str | None = None) -> str:
        """Return a sentence with the argument, the reason and the given value; `name` replaces the argument's name."""
        called = name or ".".join(self.path) or ("The request" if self.why.startswith("has ") else "")
        why = self.why[:1].upper() + self.why[1:] if not called else f"{called} {self.why}"
        shown = isinstance(self.given, str) and len(self.given) <= LONGEST_SHOWN and "was given" not in why
        return f"{why}; {self.given!r} was given" if shown else why


class Problem(SkillsError):
    """An error response of the service.

    Attributes:
        status: The HTTP status code.
        kind: The kind of error, such as "not-found"; stable across versions.
        refused: The refused arguments, if the error is about arguments.
        body: The complete problem document (RFC 9457).
        retry_after_s: Seconds after which the service asks for a retry; None if it does not.
    """

    def __init__(self, status: int, body: dict[str, Any], retry_after_s: float | None = None) -> None:
        reason = body.get("reason") or body.get("detail") or "The service refused."  # an older service sends no reason
        super().__init__(str(reason), *read_remedies(body.get("remedies")), **body)
        self.refused = [Refused.of(one) for one in body.get("errors") or ()]
        if self.refused:
            self.message = "\n".join(one.sentence() for one in self.refused)
        self.status = status
        self.body = body
        self.kind = str(body.get("type", "")).rpartition(":")[2]
        self.retry_after_s = retry_after_s

    def told(self, arguments: Mapping[str, Any]) -> None:
        """Add the given values from the arguments of the call: the service does not repeat text that was sent."""
        for one in self.refused:
            one.given = _value(arguments, one.path)
        if self.refused:
            self.message = "\n".join(one.sentence() for one in self.refused)

    @property
    def passes(self) -> bool:
        """Return whether nothing was done and a retry may succeed: after a rate limit, or a busy response."""
        return self.status == TOO_MANY or (self.status == UNAVAILABLE and self.retry_after_s is not None)


class NotReached(SkillsError):
    """The service sent no response; the message says how often and for how long it was tried."""


class NotUnderstood(SkillsError):
    """The response is not of this service, or of another version of it."""


class UnprotectedKey(SkillsError):
    """The API key would be sent where others can read it."""


class SessionClosed(SkillsError):
    """A session of a pose style is closed; the arm that follows it must stop.

    Attributes:
        code: The code with which the service closed it (docs/pose-styles.md), 1006 if the connection was lost, and
            None if the client closed it.
    """

    def __init__(self, code: int | None, reason: str) -> None:
        super().__init__(reason, "Stop the arm; open another session to follow what is released now.", code=code)
        self.code = code


class JobFailed(SkillsError):
    """A job did not succeed; `job` is its last state."""

    def __init__(self, job: Job, message: str | None = None) -> None:
        super().__init__(message or f"The {job.kind} {job.state}: {job.error or 'no reason was given'}")
        self.job = job


class JobTakesLonger(JobFailed):
    """A job has not ended within the timeout; it goes on, and can be waited for again."""

    def __init__(self, job: Job, timeout_s: float) -> None:
        super().__init__(job, f"The {job.kind} {job.id} is still {job.state} after {timeout_s:g} s; wait again.")


def _value(arguments: Any, path: Sequence[str]) -> Any:
    """Return the value at a path in the arguments; None if there is none."""
    found = arguments
    for part in path:
        if isinstance(found, Mapping):
            found = found.get(part)
        elif isinstance(found, list | tuple) and part.isdigit() and int(part) < len(found):
            found = found[int(part)]
        else:
            return None
    return found


def problem_of(answer: httpx.Response) -> Problem:
    """Return the error of an error response whose body was read."""
    is_problem = answer.headers.get("content-type", "").startswith("application/problem+json")
    said = answer.json() if is_problem else _of_a_stranger(answer)
    return Problem(answer.status_code, {"status": answer.status_code, **said}, _retry_after_s(answer))


def _of_a_stranger(answer: httpx.Response) -> dict[str, Any]:
    """Return a problem for an error response that is not a problem document, such as a proxy's."""
    reason = f"{answer.request.url.netloc.decode()} answered {answer.status_code}, but not as suture-skills does."
    advice = "Check that the address is the service's, and the proxies in front of it."
    return {"detail": f"{reason} {advice}", "reason": reason, "remedies": [advice]}


def _retry_after_s(answer: httpx.Response) -> float | None:
    """Return the seconds of a Retry-After header, which has seconds or a date; None without one."""
    said = answer.headers.get("retry-after", "").strip()
    if said.isdigit():
        return float(said)
    try:
        return max(0.0, email.utils.parsedate_to_datetime(said).timestamp() - time.time())
    except ValueError:
        return None


# ---- calls ---------------------------------------------------------------------------------------------------------


class Now:
    """Marker base class of a client whose calls block and return the result."""


class Later:
    """Marker base class of a client whose calls return coroutines."""


class call(Generic[P, T]):  # noqa: N801 - lower case, because it is used as a decorator, like `property`
    """Descriptor that makes a coroutine function a method of both clients."""

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
        """Bind the method to a client: blocking for `Now`, a coroutine function for `Later`."""
        if client is None:
            return self
        bound: Callable[P, Coroutine[Any, Any, T]] = MethodType(self.method, client)

        @wraps(bound)
        async def later(*args: P.args, **kwargs: P.kwargs) -> T:
            return await self._told(client, *args, **kwargs)

        if isinstance(client, Later):
            return later

        @wraps(bound)
        def now(*args: P.args, **kwargs: P.kwargs) -> T:
            return finished(later(*args, **kwargs))

        return now

    async def _told(self, client: Any, *args: P.args, **kwargs: P.kwargs) -> T:
        """Run the call; a `Problem` is completed with the argument names and values of this call.

        Raises:
            TypeError: An argument is missing, or unknown; then the most similar name is suggested.
        """
        takes = signature(self.method)
        any_name = any(one.kind is one.VAR_KEYWORD for one in takes.parameters.values())
        if unknown := [name for name in kwargs if not any_name and name not in takes.parameters]:
            near = did_you_mean(unknown[0], takes.parameters)
            raise TypeError(" ".join([f"{self.method.__name__}() takes no argument {unknown[0]!r}.", *near]))
        try:
            return await self.method(client, *args, **kwargs)
        except Problem as problem:
            problem.told(takes.bind(client, *args, **kwargs).arguments)
            raise


def at(*parts: str | int) -> str:
    """Return the path of a call from its parts; each part is quoted, so that it stays one segment of the path."""
    return "".join(f"/{quote(str(part), safe='')}" for part in parts)


M = TypeVar("M", bound=BaseModel)

PAGE = 200  # the largest page that the service returns


class Connection:
    """A connection to the service over a transport."""

    _transport: Transport
    _headers: Mapping[str, str]
    _timeout_s: float
    _retrying: Retrying
    _clock: Callable[[], float]
    _streams: bool  # whether responses arrive while they are produced; not so with an in-process application

    # ---- answers

    def _read(self, kind: type[M], said: Any) -> M:
        """Return a response as its model; unknown fields are ignored.

        Raises:
            NotUnderstood: The response does not fit the model.
        """
        try:
            return kind.model_validate(said)
        except ValidationError as error:
            where = ", ".join(".".join(str(part) for part in one["loc"]) for one in error.errors()[:5])
            raise NotUnderstood(
                f"The response is not a {kind.__name__} of this client's version ({where}); update the client or "
                "the service, or read the raw JSON with `get_json`."
            ) from error

    async def _get(self, kind: type[M], path: str, /, **query: Any) -> M:
        return self._read(kind, await self._json("GET", path, params=given(query)))

    async def _ask(self, kind: type[M], method: str, path: str, body: Any = None, **how: Any) -> M:
        return self._read(kind, await self._json(method, path, json=body, **how))

    async def _json(self, method: str, path: str, **how: Any) -> Any:
        return _as_json(await self._send(method, path, **how))

    async def _bytes(self, path: str, accept: str | None = None, **query: Any) -> bytes:
        """Return the bytes of a response, after they were compared with its ETag."""
        headers = {} if accept is None else {"Accept": accept}
        answer = await self._send("GET", path, headers=headers, params=given(query))
        check(hashlib.sha256(answer.content).hexdigest(), named_by(answer.headers.get("etag", "")))
        return answer.content

    async def _all(self, kind: type[M], path: str, /, **query: Any) -> list[M]:
        """Return all items of a paged list."""
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
        """Send a request, with retries where they are safe, and return the response with its body.

        Raises:
            Problem: The service returned an error.
            NotReached: There was no response.
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
        """Send a file as the request body; each attempt reads it again from the start."""
        upload = await self._transport.aside(lambda: FileUpload.of(content, media_type))

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
        """Download a file; `to` appears only once it is complete and has the digest: `sha256`, else its ETag's."""
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
        """Send a request once, and yield the response before its body is read.

        Raises:
            Problem: The service returned an error.
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
        """Run an attempt, and retry it after pauses while that is safe, may help, and is within `Retrying`."""
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
                    f"{self._transport.http.base_url} gave no answer in {failed_s:.1f} s and {failed + 1} "
                    "attempts; check that the service runs there."
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
            f"{answer.request.url.host} answered, but not as suture-skills does; check the address and the "
            "proxies in between."
        ) from error


def given(query: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries that are not None."""
    return {name: value for name, value in query.items() if value is not None}
