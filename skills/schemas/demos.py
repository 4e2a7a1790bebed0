"""Demonstrations and proposed hand-offs: answers and requests."""

from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Literal, Self

from pydantic import AliasChoices, AliasPath, Field, model_validator

from skills.demonstration.partner import Partner
from skills.demonstration.quality import MotionReport
from skills.fields import Count, Fraction, Point, Sha256, Slug, schema
from skills.gridworld.grid import MAX_HYSTERESIS, GridMode, PathReport
from skills.gridworld.reward import RewardLevels
from skills.schemas import DemoOutcome, Given, ProposalDecision, ProposalState
from skills.schemas.grids import ChosenGrid
from skills.schemas.requests import Name, Schema, SlugField, shown

Hysteresis = Annotated[
    float,
    Field(
        ge=0,
        le=MAX_HYSTERESIS,
        description="Cells by which a sample must be beyond a face of its cell to leave it; 0.25 keeps a tremor from "
        "crossing a face again and again, and the report says what is lost in mm.",
    ),
]


@schema
@dataclass(frozen=True, kw_only=True)
class DemoReport(PathReport, MotionReport):
    """Measurements of a demonstration, and advice.

    Attributes:
        duplicate_stamps: Samples of the entire recorded motion that carried the stamp of the sample before.
        backward_stamps: Samples of the entire recorded motion that were dropped because their stamp went back.
        equal_samples: Samples of the demonstration that repeat the pose of the sample before to the last bit.
        grid: The grid world of its path.
        partner: The arm that takes the needle; null if it was not recorded.
        advice: Sentences to the surgeon.
    """

    duplicate_stamps: Count
    backward_stamps: Count
    equal_samples: Count
    grid: ChosenGrid
    partner: Partner | None


@schema
@dataclass(frozen=True)
class ChosenSegment:
    """The part of a recording that a demonstration was cut from, and the reason for this choice.

    Attributes:
        taken: Such as `proposal 1 of 1`, `the whole recording` or `the given times`.
        start_s: Its start, in seconds since the recording's `origin_ns`.
        end_s: Its end.
        because: The reason in words.
    """

    taken: str
    start_s: float
    end_s: float
    because: str


class Demonstration(Given):
    """One hand-off cut out of a recording, with its measurements.

    Attributes:
        segment: The part of the recording that was cut.
        hysteresis: Cells.
        outcome: Of the hand-off; null: not known.
        outcome_reason: Why, in the words of whoever marked it.
    """

    id: Sha256 = Field(validation_alias=AliasChoices("id", "sha256"))
    sha256: Sha256
    recording: Sha256 = Field(validation_alias=AliasChoices(AliasPath("recording", "sha256"), "recording"))
    surgeon: Slug = Field(validation_alias=AliasChoices(AliasPath("surgeon", "slug"), "surgeon"))
    suture: Slug
    arm: str
    topic: str
    frame: str
    instrument: str
    start_s: float
    end_s: float
    segment: ChosenSegment
    session: Slug | None
    hysteresis: float
    state: Literal["active", "withdrawn"]
    outcome: DemoOutcome | None = None
    outcome_reason: str | None = None
    report: DemoReport
    created_at: datetime
    withdrawn_at: datetime | None


class DemoPath(Given):
    """A demonstration as its states in the grid, and as it was recorded.

    Attributes:
        path_mm: The centres of the states.
    """

    demo: Sha256
    frame: str
    grid: ChosenGrid
    hysteresis: float
    states: list[int]
    path_mm: list[Point]
    stamps_s: list[float]
    recorded_mm: list[Point]


class RewardMap(Given):
    """The rewards of a demonstration other than `other`: `rewards[k]` is that of `states[k]`."""

    demo: Sha256
    sha256: Sha256
    grid: ChosenGrid
    levels: RewardLevels
    states: list[int]
    rewards: list[float]


class DemoIn(Schema):
    """A demonstration to cut out of a recording: the surgeon, the part, and the grid.

    Attributes:
        surgeon: The surgeon's pseudonym.
        suture: The suture type, such as simple-running.
        arm: Needed if several arms moved.
        topic: Needed if an arm was recorded on several topics.
        start_s: Start of the hand-off in the recording.
        end_s: End of the hand-off in the recording.
        segment: A proposed hand-off, counted from 1, or whole. Without it and without times the only proposal is taken;
            of several one must be named; where there is none, the whole recording is taken. The answer says which part
            it was.
        grid: auto takes the paper's grid if the path lies in it, and fits one otherwise.
        cell_mm: Length of a cell's edge in a fitted grid; 5 by default.
        session: A name for recordings that were made together, such as 2026-11-23-a.
        outcome: Of the hand-off, where it is known.
        outcome_reason: Why; needed for a recovery or a failure.
    """

    model_config = shown(
        {"surgeon": "kestrel", "suture": "simple-running"},
        {"surgeon": "kestrel", "suture": "simple-running", "end_s": 1.1, "grid": "fit", "cell_mm": 4.0},
    )

    surgeon: SlugField
    suture: SlugField
    arm: Name | None = None
    topic: Name | None = None
    start_s: Annotated[float, Field(ge=0, le=1e9)] | None = None
    end_s: Annotated[float, Field(ge=0, le=1e9)] | None = None
    segment: Literal["whole"] | Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    grid: GridMode = "auto"
    cell_mm: Annotated[float, Field(ge=0.25, le=50)] | None = None
    hysteresis: Hysteresis = 0.0
    session: SlugField | None = None
    outcome: DemoOutcome | None = None
    outcome_reason: Name | None = None

    @model_validator(mode="after")
    def _reason_with_outcome(self) -> Self:
        if self.outcome is None and self.outcome_reason is not None:
            raise ValueError("a reason needs an outcome")
        _require_reason(self.outcome, self.outcome_reason)
        return self


class OutcomeIn(Schema):
    """The outcome of a demonstration's hand-off, and its reason.

    Attributes:
        reason: Needed for a recovery or a failure.
    """

    model_config = shown({"outcome": "failure", "reason": "The needle fell."}, {"outcome": "success"})

    outcome: DemoOutcome
    reason: Name | None = None

    @model_validator(mode="after")
    def _why(self) -> Self:
        _require_reason(self.outcome, self.reason)
        return self


def _require_reason(outcome: DemoOutcome | None, reason: str | None) -> None:
    if outcome in ("recovery", "failure") and reason is None:
        raise ValueError(f"a {outcome} needs a reason")


class Proposal(Given):
    """A proposed hand-off of a recording, and what was decided on it.

    Attributes:
        number: Its number in the recording, counted from 1.
        state: accepted: a demonstration was cut there, which shares at least half of the longer of the two.
        start_s: Seconds since the recording's `origin_ns`.
        handover_s: Transition from A1 to A2.
        found_by: The source: stage, gesture, transfer, jaw or motion.
        confidence: Probability that the needle was given to another arm; null unless found by a transfer.
        surgeon: Of its demonstration, else the only one that the recording was uploaded for.
        suture: Of its demonstration; null if there is none.
        demo: The demonstration, active or withdrawn.
        outcome: Of the demonstration.
        note: Why it was rejected, or the reason of the outcome.
        created_at: Of the recording.
    """

    recording: Sha256
    number: int
    state: ProposalState
    arm: str
    start_s: float
    end_s: float
    handover_s: float
    found_by: str
    reasons: list[str]
    confidence: Fraction | None
    surgeon: Slug | None
    suture: Slug | None
    demo: Sha256 | None
    outcome: DemoOutcome | None
    note: str | None
    created_at: datetime


class ProposalIn(Schema):
    """The decision on a proposed hand-off. To accept it, cut a demonstration there."""

    model_config = shown({"state": "rejected", "note": "The needle was only regrasped."}, {"state": "open"})

    state: ProposalDecision
    note: Name | None = None
