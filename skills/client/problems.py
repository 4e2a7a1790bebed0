"""Errors that the client raises, in addition to those about a file that it was to send."""

import email.utils
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import httpx2 as httpx

from skills.errors import SkillsError
from skills.remedies import read_remedies
from skills.schemas.given import Job

TOO_MANY, UNAVAILABLE = 429, 503
LONGEST_SHOWN = 60  # longest value that a message repeats, in characters


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
        called = name or ".".join(self.path)
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
