"""Jobs: requests for work, their state and their result."""

from datetime import datetime
from typing import Any, Literal, Self

from pydantic import Field

from skills.fields import Fraction
from skills.schemas import Given, PolicyName

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]


class ServedNow(PolicyName):
    """The policy version that a style serves."""

    released_at: datetime


class Job(Given):
    """A job: work that was requested, its state and its result.

    Attributes:
        kind: training, retraining, playback, pictures, dataset or try.
        request: What was asked for, all defaults resolved.
        result: What came of it. Of a training, `released` says whether its version is what the style serves now,
            `was_released` whether the job released it, and where a release was asked for, `not_released_because` and
            `remedy` say why not and what to do. Of a try, `steps` are those so far, also while it runs.
        served: Of a training: what its style serves now; null where that is nothing.
        did: Of a POST: what the request did, in words.
    """

    id: str = Field(pattern="^[0-9a-f]{16}$")
    kind: str
    state: JobState
    progress: Fraction
    request: dict[str, Any]
    result: dict[str, Any] | None
    served: ServedNow | None = None
    did: str | None = None
    error: str | None
    created_at: datetime
    started_at: datetime | None
    ended_at: datetime | None


class JobResult(Given):
    """The base class of results."""

    @classmethod
    def of(cls, job: Job) -> Self:
        """Return the result of a job of this kind that succeeded."""
        assert job.result is not None, job
        return cls.model_validate(job.result)
