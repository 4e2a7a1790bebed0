"""Results of jobs by kind, and the values of refusals, as a client reads them.

`Job.result` is plain JSON, because its form depends on the kind of the job; each class here is that of one kind. That
of a training is in `training`.
"""

from collections.abc import Mapping
from typing import Self

from skills.fields import Sha256
from skills.schemas import Given
from skills.schemas.operation import Job, JobResult
from skills.schemas.tries import TryStep


class PlaybackResult(JobResult):
    """The playback of a plan."""

    playback: Sha256
    feasible: bool


class PicturesResult(JobResult):
    """The pictures of a playback."""

    playback: Sha256


class DatasetResult(JobResult):
    """An exported dataset."""

    dataset: Sha256
    size_bytes: int
    episodes: int
    frames: int


class TryResult(JobResult):
    """The steps of a try, also of one that runs or failed."""

    steps: tuple[TryStep, ...] = ()

    @classmethod
    def of(cls, job: Job) -> Self:
        """Return the steps of a try so far."""
        return cls.model_validate(job.result or {})


class NumberedSegment(Given):
    """A proposed hand-off, and the number that names it as `segment`."""

    segment: int
    arm: str
    start_s: float
    end_s: float
    reason: str


class ProposedSegments(Given):
    """The numbers of a refusal of kind "segment-not-named"."""

    segments: tuple[NumberedSegment, ...]

    @classmethod
    def of(cls, numbers: Mapping[str, object]) -> Self:
        """Return the proposals that the numbers of a refusal list."""
        return cls.model_validate(numbers)
