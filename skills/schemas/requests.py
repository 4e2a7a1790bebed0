"""Request bodies, and the patterns of texts in requests. Lengths are mm, angles rad.

Unknown fields, NaN and infinity are refused. Every pattern has a description in words, for messages.
"""

from datetime import date
from typing import Annotated, Any, Literal, Self

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, StrictBool, StrictInt, model_validator

from skills.gridworld.grid import MAX_HYSTERESIS, GridMode
from skills.kinematics import INSTRUMENTS
from skills.schemas import DemoOutcome, Handedness, ProposalDecision, SkillLevel
from skills.settings import Role

SLUG = r"^[a-z0-9][a-z0-9_-]{0,63}$"
DIGEST = r"^[0-9a-f]{8,64}$"  # in full, or a prefix that no other digest has
JOB = r"^[0-9a-f]{16}$"
KEY = r"^[0-9a-f]{8}$"
OWNER = r"^[A-Za-z0-9][A-Za-z0-9 ._@-]{0,63}$"
FRAME = r"^[A-Za-z0-9_./-]{1,64}$"
ARM = r"^[A-Za-z][A-Za-z0-9_]{0,31}$"
LINE = r"^[^\x00-\x1f\x7f]+$"
LINES = r"^[^\x00-\x08\x0b-\x1f\x7f]*$"
COUNT = r"^\d{0,4}$"

_IN_WORDS = {
    SLUG: "must be 1 to 64 lower-case letters, digits, - and _, and begin with a letter or a digit",
    DIGEST: "must be a digest: 64 of the characters 0-9 and a-f, or at least the first 8 of them",
    JOB: "must be a job's id: 16 of the characters 0-9 and a-f",
    KEY: "must be a key's id: the 8 characters after skills_",
    FRAME: "must be 1 to 64 letters, digits, or _ . / -",
    ARM: "must be 1 to 32 letters, digits or _, and begin with a letter",
    OWNER: "must be 1 to 64 letters, digits, spaces or . _ @ -, and begin with a letter or a digit",
    LINE: "must be one line of text",
    LINES: "must be text without control characters",
    COUNT: "must be a whole number of at most 4 digits",
}


def in_words(pattern: str) -> str:
    """Return the description of a pattern in words; every pattern of a request has one."""
    return _IN_WORDS[pattern]


class Schema(BaseModel):
    """The base class of request bodies: immutable; unknown fields, NaN and infinity are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


SlugField = Annotated[str, Field(pattern=SLUG)]
DigestField = Annotated[str, Field(pattern=DIGEST)]
Name = Annotated[str, Field(min_length=1, max_length=200, pattern=LINE)]
Text = Annotated[str, Field(max_length=2000, pattern=LINES)]
Whole = Annotated[StrictInt, Field(ge=0, le=2**31)]
Number = Annotated[float, Field(strict=True)]  # strict, so that true is not accepted as a number
Size = Annotated[Number, Field(ge=0, le=1000)]
Source = Annotated[str, Field(min_length=1, max_length=600, pattern=LINE)]
Coordinate = Annotated[Number, Field(ge=-10_000, le=10_000)]
PointIn = tuple[Coordinate, Coordinate, Coordinate]
Hysteresis = Annotated[
    float,
    Field(
        ge=0,
        le=MAX_HYSTERESIS,
        description="Cells by which a sample must be beyond a face of its cell to leave it; 0.25 keeps a tremor from "
        "crossing a face again and again, and the report says what is lost in mm.",
    ),
]
Component = Annotated[Number, Field(ge=-1e6, le=1e6)]


def shown(*examples: dict[str, Any]) -> ConfigDict:
    """Return a configuration with examples for the OpenAPI document; a test sends each of them."""
    return ConfigDict(json_schema_extra={"examples": [*examples]})


class ConsentIn(Schema):
    """The uses that a surgeon agreed to, and their last day."""

    uses: list[Literal["training", "export", "atlas"]]
    until: date | None = None


class KeyIn(Schema):
    """An API key to create."""

    model_config = shown({"owner": "a.laboratory", "role": "reader", "surgeons": ["kestrel"]})

    owner: Annotated[str, Field(pattern=OWNER, description="Whose it is; events and releases bear this name.")]
    role: Role
    expires_at: AwareDatetime | None = None
    surgeons: Annotated[list[SlugField], Field(min_length=1, max_length=1000)] | None = None


class SurgeonIn(Schema):
    """A surgeon, by pseudonym; never a name."""

    model_config = shown(
        {
            "skill_level": "expert",
            "handedness": "right",
            "consent": {"uses": ["training", "export"], "until": "2099-12-31"},
        },
        {},
    )

    skill_level: SkillLevel | None = None
    handedness: Handedness | None = None
    protocol: Name | None = None
    consent: ConsentIn | None = None


class SutureTypeIn(Schema):
    """A suture type of the catalogue."""

    model_config = shown(
        {"name": "Simple running", "also_called": ["continuous"], "family": "running", "description": "One thread."}
    )

    name: Name
    also_called: list[Name] = Field(default_factory=list, max_length=20)
    family: Name
    description: Text = ""


class DemoIn(Schema):
    """A demonstration to cut out of a recording: the surgeon, the part, and the grid."""

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
    segment: Literal["whole"] | Annotated[int, Field(ge=1, le=1_000_000)] | None = Field(
        default=None,
        description="A proposed hand-off, counted from 1, or the whole recording. Left out, as are start_s and end_s: "
        "the only proposal is taken; of several one must be named; where there is none, the whole recording is taken. "
        "The answer says which part it was.",
    )
    grid: GridMode = "auto"
    cell_mm: Annotated[float, Field(ge=0.25, le=50)] | None = None
    hysteresis: Hysteresis = 0.0
    session: SlugField | None = None
    outcome: DemoOutcome | None = Field(default=None, description="What became of the hand-off, where it is known.")
    outcome_reason: Name | None = Field(default=None, description="Why; needed for a recovery or a failure.")

    @model_validator(mode="after")
    def _reason_with_outcome(self) -> Self:
        if self.outcome is None and self.outcome_reason is not None:
            raise ValueError("a reason needs an outcome")
        _require_reason(self.outcome, self.outcome_reason)
        return self


class OutcomeIn(Schema):
    """The outcome of a demonstration's hand-off, and its reason."""

    model_config = shown({"outcome": "failure", "reason": "The needle fell."}, {"outcome": "success"})

    outcome: DemoOutcome
    reason: Name | None = Field(default=None, description="Needed for a recovery or a failure.")

    @model_validator(mode="after")
    def _why(self) -> Self:
        _require_reason(self.outcome, self.reason)
        return self


def _require_reason(outcome: DemoOutcome | None, reason: str | None) -> None:
    if outcome in ("recovery", "failure") and reason is None:
        raise ValueError(f"a {outcome} needs a reason")


class ProposalIn(Schema):
    """The decision on a proposed hand-off. To accept it, cut a demonstration there."""

    model_config = shown({"state": "rejected", "note": "The needle was only regrasped."}, {"state": "open"})

    state: ProposalDecision
    note: Name | None = None


class Reading(Schema):
    """Statements about a recording that the recording itself does not make."""

    rate_hz: Annotated[float, Field(gt=0, le=10_000)] | None = Field(
        default=None, description="Samples per second, of a table without times."
    )
    frame: Annotated[str, Field(pattern=FRAME)] | None = Field(
        default=None,
        description="The frame of a table's positions; base: the base of each arm, which is the default where a table "
        "is of one arm.",
    )

    @property
    def said(self) -> dict[str, Any]:
        """The reader's arguments: rate and frame, and of the others those that were given, as they are stored."""
        given = self.model_dump(include=READING, exclude_none=True)
        return {"rate_hz": self.rate_hz, "frame": self.frame, **given}


class TableIn(Reading):
    """Statements about a table (docs/tables.md)."""

    column: Annotated[list[Annotated[str, Field(max_length=200, pattern=LINE)]], Field(max_length=30)] | None = Field(
        default=None, description="A table's columns under other names, each as x_mm=NAME, or x=NAME with a unit."
    )
    unit: Annotated[list[Literal["m", "mm", "rad", "deg", "s", "ms", "us", "ns"]], Field(max_length=3)] | None = Field(
        default=None, description="Units of the columns that name none: of lengths, angles and times."
    )
    decimal: Literal["point", "comma"] | None = Field(default=None, description="The decimal mark; point by default.")
    table_arm: Annotated[str, Field(pattern=ARM)] | None = Field(
        default=None, description="The arm of a table; PSM by default."
    )
    instrument: Annotated[str, Field(pattern=f"^({'|'.join(INSTRUMENTS)})$")] | None = Field(
        default=None, description="The instrument with which a table's joints become poses."
    )


class StatedIn(TableIn):
    """What a folder's owner states about recordings for `skills recording table` (docs/recordings.md)."""

    source: Text = ""
    episode: Name | None = None
    tool: list[Name] | None = None


READING = {"column", "unit", "decimal", "table_arm", "instrument"}


class ScoreIn(Schema):
    """A score: a demonstration, or a part of a recording, and the style that it is compared with."""

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


class DatasetIn(Schema):
    """A dataset to export: the demonstrations, the part of their recordings, and the contents of its README.

    Without `demos`, all demonstrations are meant that fit the filters and the outcomes.
    """

    model_config = shown(
        {"surgeons": ["kestrel"], "licence": "CC-BY-4.0", "name": "Running sutures"},
        {"demos": ["0123456789abcdef" * 4], "whole": True, "version": "v3.0", "fps": 50, "split": "session"},
    )

    demos: Annotated[list[DigestField], Field(min_length=1, max_length=1000)] | None = None
    surgeons: Annotated[list[SlugField], Field(min_length=1, max_length=1000)] | None = None
    sutures: Annotated[list[SlugField], Field(min_length=1, max_length=1000)] | None = None
    outcomes: Literal["success", "any"] = Field(
        default="success",
        description="success leaves out demonstrations that are marked recovery or failure; any exports them in the "
        "splits recovery and failure.",
    )
    whole: StrictBool = Field(
        default=False,
        description="Exports whole recordings, where all surgeons in them consent; otherwise an episode is the "
        "interval of one hand-off.",
    )
    version: Literal["v2.1", "v3.0"] = "v2.1"
    fps: Annotated[StrictInt, Field(ge=1, le=1000)] = 30
    split: Literal["surgeon", "session"] = Field(
        default="surgeon", description="What is in one split only: all of a surgeon, or all of a recording."
    )
    arms: Annotated[list[Annotated[str, Field(pattern=ARM)]], Field(min_length=1, max_length=10)] | None = Field(
        default=None, description="The arms of every episode; left out, those that all of the recordings have."
    )
    name: Name = "Needle hand-offs"
    licence: Name = "unknown"
    description: Text = "Not stated."
    procedure: Text = "Not stated."

    @model_validator(mode="after")
    def _named_or_filtered(self) -> Self:
        if self.demos is not None and (self.surgeons is not None or self.sutures is not None):
            raise ValueError("name demonstrations in demos, or filter them by surgeons and sutures, but not both")
        if self.arms is not None and len({arm.lower() for arm in self.arms}) < len(self.arms):
            raise ValueError("name each arm once")
        return self
