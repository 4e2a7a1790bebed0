"""What is answered of a score. It compares motions, says nothing about a result, and is not a credential."""

from datetime import datetime
from typing import Literal

from pydantic import Field

from skills.api.schemas.shapes import Count, Given, Point, Sha256, Share, Slug

Thirds = tuple[Point, Point, Point]


class ScoredStyle(Given):
    """The style that is scored against."""

    surgeon: Slug
    suture: Slug


class Reference(Given):
    """The demonstration that stands for the style."""

    demo: Sha256
    because: str = Field(description="Why it is this one.")
    is_itself: bool = Field(description="Whether it is what is scored.")


class ScoreFigure(Given):
    """One figure beside the reference's; null where it was not recorded."""

    name: str
    unit: str = Field(description="Empty where it has none.")
    label: str
    meaning: str
    value: float | None
    reference: float | None
    ratio: float | None = Field(description="Value by reference; null where the reference's is 0.")


class Deviation(Given):
    """How far the motion lies from the reference, by dynamic time warping, and where. Both have 100 states."""

    total_mm: float = Field(description="Manhattan distance over all pairs: exact.")
    distance_mm: float = Field(description="The total for each state of the reference.")
    dtw_mean_mm: Point = Field(description="Mean absolute difference along each axis; the tie-break is stated.")
    dtw_std_mm: Point
    shares: Thirds = Field(description="Of the total, for each third of the way and each axis.")
    offsets_mm: Thirds = Field(description="By how much it lies further along each axis, in each third of the way.")
    words: list[str]
    path_mm: list[Point]
    reference_mm: list[Point]
    apart_mm: list[float] = Field(description="How far each state of `path_mm` is from those it is paired with.")


class Percentiles(Given):
    """Where the figures are among the demonstrations of the surgeons of one skill level."""

    level: Literal["novice", "intermediate", "expert"]
    demos: Count
    surgeons: Count
    reason: str | None = Field(description="Why there are none.")
    below: dict[str, Share | None] | None = Field(
        description="Of each figure, and of `distance_mm`: the share of them that has a smaller value; equal ones half."
    )


class CurvePoint(Given):
    """One demonstration of the scored surgeon, against the same reference."""

    demo: Sha256
    session: Slug | None
    stored_at: datetime = Field(description="When its recording was.")
    distance_mm: float
    duration_s: float | None
    log_dimensionless_jerk: float | None


class Skill(Given):
    """What the laboratory's calibrated model makes of the figures; without one, or a figure, null and why."""

    calibrated: bool
    calibration: Sha256 | None
    words: list[str] = Field(description="On what it was calibrated, how good it is there, and what it says.")
    rating: float | None = Field(description="Global rating score, 6 to 30.")
    interval: tuple[float, float] | None = Field(description="90 %, for motions like those of the calibration.")
    levels: dict[str, Share] | None = Field(description="How likely each skill level is.")
    terms: dict[str, float] | None = Field(description="By how many points each figure moves the rating.")
    outside: list[str] = Field(description="What lies outside of what the model has seen; it is then not reliable.")


class Score(Given):
    """A motion beside a style's reference. Nothing of it is stored."""

    demo: Sha256 | None = Field(description="null where a part of a recording was scored.")
    recording: Sha256
    arm: str
    start_s: float
    end_s: float
    surgeon: Slug | None = Field(description="null where a part of a recording was scored.")
    style: ScoredStyle
    reference: Reference
    figures: list[ScoreFigure]
    deviation: Deviation = Field(
        description="Moved, turned and scaled onto the reference: x along its way, y to the left, z upwards, in its mm."
    )
    as_recorded: Deviation | None = Field(
        description="Where both were recorded, in the arm's frame; null where arm or frame differ."
    )
    tie_break: str
    percentiles: list[Percentiles]
    curve: list[CurvePoint] = Field(description="The surgeon's demonstrations up to this one, in order of recording.")
    skill: Skill
    use: str
