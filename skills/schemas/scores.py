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
    """A score: a demonstration, or a part of a recording, and the style that it is compared with.

    Attributes:
        demo: The demonstration to score, by its digest.
        recording: The recording of which a part is scored, by its digest.
        arm: The arm in the recording.
        topic: The topic in the recording.
        start_s: Start of the part in the recording.
        end_s: End of the part in the recording.
        reference: The demonstration of the style to compare with. Left out, the one that its released policy was learnt
            from, else its newest.
        task: The task of the whole recording, as the calibration names it, for the rating. Left out, the only one of
            the calibration.
    """

    model_config = shown(
        {"surgeon": "kestrel", "suture": "simple-running", "demo": "0123456789abcdef" * 4},
        {"surgeon": "kestrel", "suture": "simple-running", "recording": "0123456789abcdef" * 4, "end_s": 1.1},
    )

    surgeon: SlugField
    suture: SlugField
    demo: DigestField | None = None
    recording: DigestField | None = None
    arm: Name | None = None
    topic: Name | None = None
    start_s: Annotated[float, Field(ge=0, le=1e9)] | None = None
    end_s: Annotated[float, Field(ge=0, le=1e9)] | None = None
    reference: DigestField | None = None
    task: Name | None = None

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
    """The demonstration that represents the style.

    Attributes:
        because: The reason for this choice.
        is_itself: Whether it is the scored demonstration.
    """

    demo: Sha256
    because: str
    is_itself: bool


class Percentiles(Given):
    """The percentiles of the figures among the demonstrations of the surgeons of one skill level.

    Attributes:
        reason: Why there are none; null if there are.
        below: For each figure, and `distance_mm`: share of them with a smaller value; equal values count half.
    """

    level: Level
    demos: Count
    surgeons: Count
    reason: str | None
    below: dict[str, Fraction | None] | None


class CurvePoint(Given):
    """One demonstration of the scored surgeon, compared with the same reference.

    Attributes:
        stored_at: Of its recording.
    """

    demo: Sha256
    session: Slug | None
    stored_at: datetime
    distance_mm: float
    duration_s: float | None
    log_dimensionless_jerk: float | None


class SessionFigures(Given):
    """The demonstrations of one session, compared with the same reference: their medians.

    Attributes:
        session: null if the recording has no session name; it is then one of its own.
        stored_at: Of its first recording.
    """

    session: Slug | None
    stored_at: datetime
    demos: Count
    distance_mm: float
    duration_s: float | None
    log_dimensionless_jerk: float | None


class Progress(Given):
    """A surgeon's demonstrations of a suture type, session by session, compared with a style's reference.

    Attributes:
        sessions: In order of recording.
        demos: The same demonstrations one by one.
    """

    surgeon: Slug
    style: ScoredStyle
    reference: Reference
    sessions: list[SessionFigures]
    demos: list[CurvePoint]
    use: str


class Score(Given):
    """A motion compared with a style's reference. Nothing of it is stored.

    Attributes:
        demo: null if a part of a recording was scored.
        surgeon: null if a part of a recording was scored.
        deviation: Moved, turned and scaled onto the reference: x along its way, y to the left, z upwards, in its mm.
        as_recorded: Where both were recorded, in the arm's frame; null if arm or frame differ.
        differences: From all motions of the reference's surgeon with its arm; null if there is no other than this one.
        curve: The surgeon's demonstrations up to this one, in order of recording.
        sessions: The same by sessions.
        skill: The rating of the whole recording, not of the motion alone.
    """

    demo: Sha256 | None
    recording: Sha256
    arm: str
    start_s: float
    end_s: float
    surgeon: Slug | None
    style: ScoredStyle
    reference: Reference
    figures: tuple[ScoreFigure, ...]
    deviation: Deviation
    as_recorded: Deviation | None
    differences: Differences | None
    tie_break: str
    percentiles: list[Percentiles]
    curve: list[CurvePoint]
    sessions: list[SessionFigures]
    skill: Skill
    use: str
