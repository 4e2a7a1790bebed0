"""Scores of motions, and the progress of a surgeon: answers and requests.

A score compares motions; it says nothing about a surgical result and is not a credential.
"""

from datetime import datetime
from typing import Annotated, Self

from pydantic import Field, model_validator

from skills.fields import Count, Fraction, Sha256, Slug
from skills.schemas import Given
from skills.schemas.requests import DigestField, Name, Schema, SlugField, shown
from skills.scoring.calibration import Level
from skills.scoring.deviation import Deviation, Differences
from skills.scoring.features import ScoreFigure
from skills.scoring.rating import Skill


class ScoreIn(Schema):
    """A score: a demonstration, or a part of a recording, and the style that it is compared with."""

    model_config = shown(
        {"surgeon": "kestrel", "suture": "simple-running", "demo": "0123456789abcdef" * 4},
        {"surgeon": "kestrel", "suture": "simple-running", "recording": "0123456789abcdef" * 4, "end_s": 1.1},
    )

    surgeon: SlugField
    suture: SlugField
    demo: DigestField | None = Field(default=None, description="The demonstration to score, by its digest.")
    recording: DigestField | None = Field(
        default=None, description="The recording of which a part is scored, by its digest."
    )
    arm: Name | None = Field(default=None, description="The arm in the recording.")
    topic: Name | None = Field(default=None, description="The topic in the recording.")
    start_s: Annotated[float, Field(ge=0, le=1e9)] | None = Field(
        default=None, description="Start of the part in the recording."
    )
    end_s: Annotated[float, Field(ge=0, le=1e9)] | None = Field(
        default=None, description="End of the part in the recording."
    )
    reference: DigestField | None = Field(
        default=None,
        description="The demonstration of the style to compare with. Left out, the one that its released policy was "
        "learnt from, else its newest.",
    )
    task: Name | None = Field(
        default=None,
        description="The task of the whole recording, as the calibration names it, for the rating. Left out, the only "
        "one of the calibration.",
    )

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        part = (self.arm, self.topic, self.start_s, self.end_s)
        # Either both or neither of them is given.
        if (self.demo is None) == (self.recording is None):
            raise ValueError("give either demo or recording")
        if self.demo is not None and any(one is not None for one in part):
            raise ValueError("arm, topic, start_s and end_s belong to a recording; a demonstration has its own")
        return self


class ScoredStyle(Given):
    """The style with which a motion is compared."""

    surgeon: Slug
    suture: Slug


class Reference(Given):
    """The demonstration that represents the style."""

    demo: Sha256
    because: str = Field(description="The reason for this choice.")
    is_itself: bool = Field(description="Whether it is the scored demonstration.")


class Percentiles(Given):
    """The percentiles of the figures among the demonstrations of the surgeons of one skill level."""

    level: Level
    demos: Count
    surgeons: Count
    reason: str | None = Field(description="Why there are none; null if there are.")
    below: dict[str, Fraction | None] | None = Field(
        description="For each figure, and `distance_mm`: share of them with a smaller value; equal values count half."
    )


class CurvePoint(Given):
    """One demonstration of the scored surgeon, compared with the same reference."""

    demo: Sha256
    session: Slug | None
    stored_at: datetime = Field(description="Of its recording.")
    distance_mm: float
    duration_s: float | None
    log_dimensionless_jerk: float | None


class SessionFigures(Given):
    """The demonstrations of one session, compared with the same reference: their medians."""

    session: Slug | None = Field(description="null if the recording has no session name; it is then one of its own.")
    stored_at: datetime = Field(description="Of its first recording.")
    demos: Count
    distance_mm: float
    duration_s: float | None
    log_dimensionless_jerk: float | None


class Progress(Given):
    """A surgeon's demonstrations of a suture type, session by session, compared with a style's reference."""

    surgeon: Slug
    style: ScoredStyle
    reference: Reference
    sessions: list[SessionFigures] = Field(description="In order of recording.")
    demos: list[CurvePoint] = Field(description="The same demonstrations one by one.")
    use: str


class Score(Given):
    """A motion compared with a style's reference. Nothing of it is stored."""

    demo: Sha256 | None = Field(description="null if a part of a recording was scored.")
    recording: Sha256
    arm: str
    start_s: float
    end_s: float
    surgeon: Slug | None = Field(description="null if a part of a recording was scored.")
    style: ScoredStyle
    reference: Reference
    figures: tuple[ScoreFigure, ...]
    deviation: Deviation = Field(
        description="Moved, turned and scaled onto the reference: x along its way, y to the left, z upwards, in its mm."
    )
    as_recorded: Deviation | None = Field(
        description="Where both were recorded, in the arm's frame; null if arm or frame differ."
    )
    differences: Differences | None = Field(
        description="From all motions of the reference's surgeon with its arm; null if there is no other than this one."
    )
    tie_break: str
    percentiles: list[Percentiles]
    curve: list[CurvePoint] = Field(description="The surgeon's demonstrations up to this one, in order of recording.")
    sessions: list[SessionFigures] = Field(description="The same by sessions.")
    skill: Skill = Field(description="The rating of the whole recording, not of the motion alone.")
    use: str
