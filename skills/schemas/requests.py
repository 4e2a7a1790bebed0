"""Request bodies, and the patterns of texts in requests. Lengths are mm, angles rad.

Unknown fields, NaN and infinity are refused. Every pattern has a description in words, for messages.
"""

from dataclasses import fields
from datetime import date
from functools import reduce
from operator import or_
from typing import Annotated, Any, Literal, Self

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, StrictBool, StrictInt, create_model, model_validator

from skills.comparison.combining import COMBININGS, Combining
from skills.gridworld.grid import MAX_HYSTERESIS, GridMode
from skills.gridworld.scene import MOST_BODIES, MOST_HEIGHTS, Scene, SceneCosts, Surroundings
from skills.kinematics import INSTRUMENTS
from skills.learning.policy import LEARNERS, MAX_SEED, Learner, learner_of
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

    skill_level: SkillLevel | None = Field(default=None, description="The surgeon's experience.")
    handedness: Handedness | None = Field(default=None, description="The hand that the surgeon prefers.")
    protocol: Name | None = Field(default=None, description="The study's protocol, such as an ethics number.")
    consent: ConsentIn | None = Field(default=None, description="The uses that the surgeon agreed to.")


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

    surgeon: SlugField = Field(description="The surgeon's pseudonym.")
    suture: SlugField = Field(description="The suture type, such as simple-running.")
    arm: Name | None = Field(default=None, description="Needed if several arms moved.")
    topic: Name | None = Field(default=None, description="Needed if an arm was recorded on several topics.")
    start_s: Annotated[float, Field(ge=0, le=1e9)] | None = Field(
        default=None, description="Start of the hand-off in the recording."
    )
    end_s: Annotated[float, Field(ge=0, le=1e9)] | None = Field(
        default=None, description="End of the hand-off in the recording."
    )
    segment: Literal["whole"] | Annotated[int, Field(ge=1, le=1_000_000)] | None = Field(
        default=None,
        description="A proposed hand-off, counted from 1, or whole. Without it and without times the only proposal is "
        "taken; of several one must be named; where there is none, the whole recording is taken. The answer says which "
        "part it was.",
    )
    grid: GridMode = Field(
        default="auto", description="auto takes the paper's grid if the path lies in it, and fits one otherwise."
    )
    cell_mm: Annotated[float, Field(ge=0.25, le=50)] | None = Field(
        default=None, description="Length of a cell's edge in a fitted grid; 5 by default."
    )
    hysteresis: Hysteresis = 0.0
    session: SlugField | None = Field(
        default=None, description="A name for recordings that were made together, such as 2026-11-23-a."
    )
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
        description="The frame of the poses in a table or a LeRobot dataset; base, the default for a table of one arm: "
        "the arm's base.",
    )

    @property
    def said(self) -> dict[str, Any]:
        """The reader's arguments: rate and frame, and of the others those that were given, as they are stored."""
        given = self.model_dump(include=READING, exclude_none=True)
        return {"rate_hz": self.rate_hz, "frame": self.frame, **given}


class TableIn(Reading):
    """Statements about a table (docs/tables.md)."""

    column: Annotated[list[Annotated[str, Field(max_length=200, pattern=LINE)]], Field(max_length=30)] | None = Field(
        default=None,
        description="A column under another name, of a table as x_mm=NAME, or as x=NAME with a unit (docs/tables.md).",
    )
    unit: Annotated[list[Literal["m", "mm", "rad", "deg", "s", "ms", "us", "ns"]], Field(max_length=3)] | None = Field(
        default=None, description="The unit of columns that name none, of lengths, angles or times."
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


def _settings(of: type[Learner] | type[SceneCosts], name: str, **more: Any) -> Any:
    """Return a schema with the numbers of a settings class; the class itself checks their values."""
    settings: dict[str, Any] = {f.name: (Whole if f.type is int else Number, f.default) for f in fields(of)}
    return create_model(name, __base__=Schema, __doc__=of.__doc__, **settings, **more)


def _learner(learner: type[Learner]) -> Any:
    # `kind` is the discriminator of `LearnerIn`, without a default.
    return _settings(learner, learner.__name__, kind=(Literal[learner.kind], ...))


LearnerIn: Any = Annotated[reduce(or_, map(_learner, LEARNERS.values())), Field(discriminator="kind")]


SceneCostsIn: Any = _settings(SceneCosts, "SceneCostsIn")


class BoxIn(Schema):
    """A box that must not be entered, along the axes of the frame."""

    low_mm: PointIn
    high_mm: PointIn


class CapsuleIn(Schema):
    """A cylinder with round ends, such as a link of the other arm."""

    a_mm: PointIn
    b_mm: PointIn
    radius_mm: Annotated[Number, Field(gt=0, le=10_000)]


class TissueIn(Schema):
    """Heights above a plane, bilinear between the points of a regular map; [[0]] is the plane itself (docs/scenes.md).

    `normal` points out of the tissue, `along` is the direction of the map's rows.
    """

    at_mm: PointIn
    normal: PointIn
    along: PointIn
    step_mm: Annotated[Number, Field(gt=0, le=10_000)] = 1.0
    heights_mm: Annotated[
        list[Annotated[list[Coordinate], Field(min_length=1, max_length=MOST_HEIGHTS)]],
        Field(min_length=1, max_length=MOST_HEIGHTS),
    ] = [[0.0]]


class SceneIn(Schema):
    """What must not be touched, in the frame of the demonstration, as `Scene.as_json` writes it (docs/scenes.md)."""

    frame: Annotated[str, Field(pattern=FRAME)]
    boxes: Annotated[list[BoxIn], Field(max_length=MOST_BODIES)] = []
    capsules: Annotated[list[CapsuleIn], Field(max_length=MOST_BODIES)] = []
    tissue: TissueIn | None = None
    margin_mm: Annotated[Number, Field(ge=0, le=10_000)] = 0.0

    @property
    def value(self) -> Scene:
        """The scene as a value of the domain."""
        return Scene.of_json(self.model_dump())


class CombineIn(Schema):
    """The way several demonstrations are combined into one path (docs/combining.md)."""

    kind: Literal["medoid", "barycentre", "corridor"]


class TrainingIn(Schema):
    """A training. Defaults: the newest active demonstration, the phase learner, seed 0, no release.

    Several demonstrations are combined: as a corridor, if `combine` is left out.
    """

    model_config = shown(
        {"surgeon": "kestrel", "suture": "simple-running", "release": True},
        {"surgeon": "kestrel", "suture": "simple-running", "learner": {"kind": "value-iteration", "gamma": 0.1}},
    )

    surgeon: SlugField
    suture: SlugField
    demos: list[DigestField] | None = Field(
        default=None,
        description="The demonstrations to learn from; by default the newest one that is active and not marked "
        "recovery or failure.",
    )
    combine: CombineIn | None = None
    learner: LearnerIn | None = Field(
        default=None, description="Its kind and settings; by default Q-learning in the phase state."
    )
    seed: Annotated[StrictInt, Field(ge=0, le=MAX_SEED)] = Field(
        default=0, description="Seed of the random numbers; the phase learner's result is independent of it."
    )
    release: StrictBool = Field(
        default=False,
        description="Release the version if it passes the gate; also if an equal training is done already and its "
        "version is not the one that the style serves now.",
    )
    outcomes: Literal["success", "any"] = Field(
        default="success",
        description="success refuses demonstrations that are marked recovery or failure; any learns from them too.",
    )
    depth_along: PointIn | None = Field(
        default=None,
        description="Direction in which depth increases, of a demonstration whose frame is not the base of its arm: of "
        "equally short ways the policy takes the shallower one. In a base frame depth is the distance from the origin.",
    )
    scene: SceneIn | None = Field(
        default=None,
        description="What must not be touched; phase-q-learning and value-iteration learn in it, with their `slip`. "
        "Use a gamma near 1, such as 0.95.",
    )
    scene_costs: SceneCostsIn | None = Field(
        default=None, description="Costs of the scene, in addition to the rewards of Algorithm 1."
    )

    @property
    def chosen(self) -> Learner | None:
        """The learner as a value of the domain."""
        return None if self.learner is None else learner_of(self.learner.model_dump())

    @property
    def surroundings(self) -> Surroundings | None:
        """The scene and its costs as values of the domain."""
        if self.scene is None:
            return None
        costs = SceneCosts() if self.scene_costs is None else SceneCosts(**self.scene_costs.model_dump())
        return Surroundings(self.scene.value, costs)

    @property
    def combining(self) -> Combining | None:
        """The way of combining as a value of the domain."""
        return None if self.combine is None else COMBININGS[self.combine.kind]()


class RetrainingIn(Schema):
    """A batch of trainings. Defaults: all styles, the phase learner, no release."""

    model_config = shown({}, {"surgeon": "kestrel", "only_stale": True, "release": True})

    surgeon: SlugField | None = Field(default=None, description="Only of this surgeon.")
    suture: SlugField | None = Field(default=None, description="Only of this suture type.")
    only_stale: StrictBool = Field(
        default=False,
        description="Leaves out every style whose newest version is what this would make of it: learnt from its newest "
        "demonstration, with these settings, by this version of the learner, under this gate's limits.",
    )
    learner: LearnerIn | None = Field(
        default=None, description="Its kind and settings; by default Q-learning in the phase state."
    )
    release: StrictBool = Field(
        default=False, description="Releases a version that passes the gate and is not worse than the released one."
    )

    @property
    def chosen(self) -> Learner | None:
        """The learner as a value of the domain."""
        return None if self.learner is None else learner_of(self.learner.model_dump())


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


class RolloutIn(Schema):
    """A rollout: its start in mm, in the policy's frame, and the version; without `version`, the released one."""

    model_config = shown({"start_mm": [0.0, 50.0, -120.0]})

    start_mm: PointIn
    version: Annotated[StrictInt, Field(ge=1, le=2**31)] | None = None


class NextIn(Schema):
    """A position in mm, in the policy's frame, and the phase in which it was reached; null: the start of a pass.

    With an orientation it is a pose, and the pose style answers; the phases are then those of the pose style.
    """

    model_config = shown(
        {"position_mm": [-10.0, 55.0, -135.0]},
        {"position_mm": [-15.0, 55.0, -130.0], "phase": 1},
    )

    position_mm: PointIn
    rotation_xyzw: tuple[Component, Component, Component, Component] | None = None
    phase: Annotated[StrictInt, Field(ge=0, le=10**6)] | None = None


class PoseIn(Schema):
    """A message of a session: a pose that was reached, and its phase; null: that of the answer before."""

    position_mm: PointIn
    rotation_xyzw: tuple[Component, Component, Component, Component]
    phase: Annotated[StrictInt, Field(ge=0, le=10**6)] | None = None


class DatasetIn(Schema):
    """A dataset to export: the demonstrations, the part of their recordings, and the contents of its README.

    Without `demos`, all demonstrations are meant that fit the filters and the outcomes.
    """

    model_config = shown(
        {"surgeons": ["kestrel"], "licence": "CC-BY-4.0", "name": "Running sutures"},
        {"demos": ["0123456789abcdef" * 4], "whole": True, "version": "v3.0", "fps": 50, "split": "session"},
    )

    demos: Annotated[list[DigestField], Field(min_length=1, max_length=1000)] | None = Field(
        default=None, description="These demonstrations, by their digests; by default all that fit the filters."
    )
    surgeons: Annotated[list[SlugField], Field(min_length=1, max_length=1000)] | None = Field(
        default=None, description="Only of these surgeons."
    )
    sutures: Annotated[list[SlugField], Field(min_length=1, max_length=1000)] | None = Field(
        default=None, description="Only of these suture types."
    )
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
    version: Literal["v2.1", "v3.0"] = Field(default="v2.1", description="The version of LeRobot's format.")
    fps: Annotated[StrictInt, Field(ge=1, le=1000)] = Field(
        default=30, description="Frames per second, at most the rate of the recordings."
    )
    split: Literal["surgeon", "session"] = Field(
        default="surgeon", description="What is in one split only: all of a surgeon, or all of a recording."
    )
    arms: Annotated[list[Annotated[str, Field(pattern=ARM)]], Field(min_length=1, max_length=10)] | None = Field(
        default=None, description="The arms of every episode; left out, those that all of the recordings have."
    )
    name: Name = Field(default="Needle hand-offs", description="The dataset's title.")
    licence: Name = Field(default="unknown", description="Its licence, such as CC-BY-4.0.")
    description: Text = Field(default="Not stated.", description="What it contains, for its README.")
    procedure: Text = Field(default="Not stated.", description="How it was collected, for its README.")

    @model_validator(mode="after")
    def _named_or_filtered(self) -> Self:
        if self.demos is not None and (self.surgeons is not None or self.sutures is not None):
            raise ValueError("name demonstrations in demos, or filter them by surgeons and sutures, but not both")
        if self.arms is not None and len({arm.lower() for arm in self.arms}) < len(self.arms):
            raise ValueError("name each arm once")
        return self
