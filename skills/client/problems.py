"""Errors of the client: a refusal of the service, no response, a response that is not understood, a failed job.

Errors about a file that is sent or received are those of `skills.errors`.
"""

from __future__ import annotations

import email.utils
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import httpx2 as httpx
from pydantic import ValidationError

from skills import schemas
from skills.errors import SkillsError
from skills.remedies import read_remedies

if TYPE_CHECKING:
    from skills.schemas.operation import Job
    from skills.schemas.responses import WrongField

TOO_MANY, UNAVAILABLE = 429, 503
PARTS_OF_A_REQUEST = ("body", "query", "path", "header")
LONGEST_SHOWN = 60  # longest value that a message repeats, in characters


@dataclass
class RefusedArgument:
    """An argument that the service refused: its path in the request, the reason, and the given value if it is known."""

    path: tuple[str, ...]
    why: str
    given: object = None

    @classmethod
    def of(cls, field: WrongField) -> RefusedArgument:
        """Return it from an entry of a problem's `errors`, whose path begins with the part of the request."""
        part, *path = field.where.split(".")
        return cls(tuple(path if part in PARTS_OF_A_REQUEST else [part, *path]), field.why)

    def sentence(self, name: str | None = None) -> str:
        """Return a sentence with the argument, the reason and the given value; `name` replaces the argument's name."""
        called = name or ".".join(self.path) or ("The request" if self.why.startswith("has ") else "")
        why = f"{called} {self.why}" if called else self.why[:1].upper() + self.why[1:]
        shown = isinstance(self.given, str) and len(self.given) <= LONGEST_SHOWN and "was given" not in why
        return f"{why}; {self.given!r} was given" if shown else why


class Problem(SkillsError):
    """A refusal of the service.

    Attributes:
        status: The HTTP status code.
        kind: The kind of refusal, such as "not-found"; stable across versions.
        refused: The refused arguments, if the refusal is about arguments.
        document: The problem document (RFC 9457) as it was sent.
        retry_after_s: Seconds after which the service asks for a retry; None if it does not.
    """

    def __init__(self, document: schemas.responses.Problem, retry_after_s: float | None = None) -> None:
        super().__init__(
            document.reason or document.detail, *read_remedies(document.remedies or ()), **(document.numbers or {})
        )
        self.document = document
        self.status = document.status
        self.kind = document.type.removeprefix("urn:suture-skills:")
        self.refused = [RefusedArgument.of(one) for one in document.errors or ()]
        self.show_given({})
        self.retry_after_s = retry_after_s

    @property
    def is_temporary(self) -> bool:
        """Return whether nothing was done and a retry may succeed: after a rate limit, or a busy response."""
        return self.status == TOO_MANY or (self.status == UNAVAILABLE and self.retry_after_s is not None)

    def show_given(self, arguments: Mapping[str, Any]) -> None:
        """Add the given values to the message: the service does not repeat text that was sent.

        Args:
            arguments: The values as they were sent, by their names in the request.
        """
        for one in self.refused:
            one.given = _value_at(arguments, one.path)
        if self.refused:
            self.message = "\n".join(one.sentence() for one in self.refused).strip() or self.message


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
        ended = "was cancelled" if job.state == "cancelled" else job.state
        super().__init__(message or f"The {job.kind} {ended}: {job.error or 'no reason was given.'}")
        self.job = job


class JobTakesLonger(JobFailed):
    """A job has not ended within the timeout; it goes on, and can be waited for again."""

    def __init__(self, job: Job, timeout_s: float) -> None:
        super().__init__(job, f"The {job.kind} {job.id} is still {job.state} after {timeout_s:g} s; wait again.")


@contextmanager
def showing_given(arguments: Mapping[str, Any]) -> Iterator[None]:
    """Add the given values to a `Problem` that is raised in the block, see `Problem.show_given`."""
    try:
        yield
    except Problem as problem:
        problem.show_given(arguments)
        raise


def _value_at(arguments: object, path: Sequence[str]) -> object:
    """Return the value at a path in the arguments; None if there is none."""
    found = arguments
    for part in path:
        if isinstance(found, Mapping):
            found = found.get(part)
        elif isinstance(found, list) and part.isdigit() and int(part) < len(found):
            found = found[int(part)]
        else:
            return None
    return found


def problem_of(answer: httpx.Response) -> Problem:
    """Return the error of an error response whose body was read."""
    if answer.headers.get("content-type", "").startswith("application/problem+json"):
        try:
            return Problem(schemas.responses.Problem.model_validate_json(answer.content), _retry_after_s(answer))
        except ValidationError:
            pass  # from a program in between, with a document of its own
    reason = f"{answer.request.url.netloc.decode()} answered {answer.status_code}, but not as suture-skills does."
    advice = "Check that the address is the service's, and the proxies in front of it."
    stranger = schemas.responses.Problem.model_construct(
        type="",
        title="Refused",
        status=answer.status_code,
        detail=f"{reason} {advice}",
        reason=reason,
        remedies=[advice],
    )
    return Problem(stranger, _retry_after_s(answer))


def _retry_after_s(answer: httpx.Response) -> float | None:
    """Return the seconds of a Retry-After header, which has seconds or a date; None without one."""
    said = answer.headers.get("retry-after", "").strip()
    try:
        seconds = (
            float(said) if said[:1].isdigit() else email.utils.parsedate_to_datetime(said).timestamp() - time.time()
        )
    except (ValueError, OverflowError):
        return None
    return max(0.0, seconds)
