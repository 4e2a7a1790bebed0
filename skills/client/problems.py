"""What a client raises, beside what is wrong with a file that it was to send."""

import email.utils
import time
from typing import Any

import httpx2 as httpx

from skills.api.schemas.given import Job
from skills.errors import SkillsError

TOO_MANY, UNAVAILABLE = 429, 503


class Problem(SkillsError):
    """What the service refused.

    Attributes:
        status: The status code.
        kind: What is wrong, such as "not-found"; it does not change from one version to the next.
        body: All that the service said, as JSON (RFC 9457).
        retry_after_s: When the service would like to be asked again; None where it did not say.
    """

    def __init__(self, status: int, body: dict[str, Any], retry_after_s: float | None = None) -> None:
        why = "; ".join(f"{one['where']}: {one['why']}" for one in body.get("errors", ()))
        super().__init__(f"{body.get('detail', 'The service refused.')} {why}".strip(), **body)
        self.status = status
        self.body = body
        self.kind = str(body.get("type", "")).rpartition(":")[2]
        self.retry_after_s = retry_after_s

    @property
    def passes(self) -> bool:
        """Whether nothing was done and the same request may succeed soon: it was one of too many, or all were busy."""
        return self.status == TOO_MANY or (self.status == UNAVAILABLE and self.retry_after_s is not None)


class NotReached(SkillsError):
    """The service gave no answer; the message says what was tried."""


class NotUnderstood(SkillsError):
    """What answered is not this service, or one of another version."""


class UnprotectedKey(SkillsError):
    """A key would travel where others can read it."""


class JobFailed(SkillsError):
    """A job that was waited for did not succeed; `job` is what became of it."""

    def __init__(self, job: Job, message: str | None = None) -> None:
        super().__init__(message or f"The {job.kind} {job.state}: {job.error or 'no reason was given'}")
        self.job = job


class JobTakesLonger(JobFailed):
    """A job that was waited for had not ended in time; it goes on, and can be waited for again."""

    def __init__(self, job: Job, timeout_s: float) -> None:
        super().__init__(job, f"The {job.kind} {job.id} is still {job.state} after {timeout_s:g} s; wait again.")


def problem_of(answer: httpx.Response) -> Problem:
    """Make the error of an answer that refuses, its body read."""
    is_problem = answer.headers.get("content-type", "").startswith("application/problem+json")
    said = answer.json() if is_problem else {"detail": f"The service answered {answer.status_code}."}
    return Problem(answer.status_code, {"status": answer.status_code, **said}, _retry_after_s(answer))


def _retry_after_s(answer: httpx.Response) -> float | None:
    """Read Retry-After: seconds, or a date."""
    said = answer.headers.get("retry-after", "").strip()
    if said.isdigit():
        return float(said)
    try:
        return max(0.0, email.utils.parsedate_to_datetime(said).timestamp() - time.time())
    except ValueError:
        return None
