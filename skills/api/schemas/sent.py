"""What comes in. Lengths are mm, angles rad; unknown fields, NaN and infinity are refused."""

from dataclasses import fields
from datetime import date
from typing import Annotated, Any, Literal, Self

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, StrictBool, StrictInt, create_model, model_validator

from skills.api.deps import DIGEST, SLUG
from skills.library.demos import Cut
from skills.library.keys import OWNER
from skills.library.plans import Beside, PlanRequest
from skills.library.scores import Asked
from skills.library.training import learner_of
from skills.settings import Role
from skills.style.combining import COMBININGS, Combining
from skills.style.grid import MAX_HYSTERESIS, GridMode
from skills.style.handoff import Enters
from skills.style.kinematics import INSTRUMENTS, JAW_TIP_MM
from skills.style.learning.beyond import DDPG, DQN, TRPO
from skills.style.learning.irl import MaxEntIRL
from skills.style.learning.learners import MAX_SEED, Learner
from skills.style.learning.q_learning import CellQLearning, PhaseQLearning
from skills.style.learning.value_iteration import ValueIteration
from skills.style.plan import MAX_OUTSIDE_MM, MAX_PASSES, MAX_TIP_OFFSET_MM, RATE_HZ, SuturePoint


class Schema(BaseModel):
    """What all have in common."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


SlugField = Annotated[str, Field(pattern=SLUG)]
DigestField = Annotated[str, Field(pattern=DIGEST)]
Name = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]+$")]
Text = Annotated[str, Field(max_length=2000, pattern=r"^[^\x00-\x08\x0b-\x1f\x7f]*$")]
Whole = Annotated[StrictInt, Field(ge=0, le=2**31)]
Number = Annotated[float, Field(strict=True)]  # true is no length
Coordinate = Annotated[Number, Field(ge=-10_000, le=10_000)]
Point = tuple[Coordinate, Coordinate, Coordinate]
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
    """Show examples in the OpenAPI document; a test sends each of them."""
    return ConfigDict(json_schema_extra={"examples": [*examples]})


class ConsentIn(Schema):
    """What a surgeon agreed to, and until when."""

    uses: list[Literal["training", "export", "atlas"]]
    until: date | None = None


class KeyIn(Schema):
    """A key to be made."""

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

    skill_level: Literal["novice", "intermediate", "expert"] | None = None
    handedness: Literal["right", "left", "ambidextrous"] | None = None
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
    """Which part of a recording is a demonstration, whose, and in which grid."""

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
    grid: GridMode = "auto"
    cell_mm: Annotated[float, Field(ge=0.25, le=50)] | None = None
    hysteresis: Hysteresis = 0.0
    session: SlugField | None = None


def _learner(learner: type[Learner]) -> Any:
    """Make the schema of a learner from its settings; the learner itself checks their values."""
    settings: dict[str, Any] = {f.name: (Whole if f.type is int else Number, f.default) for f in fields(learner)}
    settings["kind"] = (Literal[learner.kind], ...)
    return create_model(learner.__name__, __base__=Schema, __doc__=learner.__doc__, **settings)


LearnerIn: Any = Annotated[
    _learner(PhaseQLearning)
    | _learner(CellQLearning)
    | _learner(ValueIteration)
    | _learner(MaxEntIRL)
    | _learner(DQN)
    | _learner(DDPG)
    | _learner(TRPO),
    Field(discriminator="kind"),
]


class CombineIn(Schema):
    """How several demonstrations become one way to follow (docs/combining.md)."""

    kind: Literal["medoid", "barycentre", "corridor"]


class TrainingIn(Schema):
    """What is to be learnt. Left out: the newest active demonstration, the phase learner, seed 0, no release.

    Several demonstrations are combined: as a corridor, if `combine` is left out.
    """

    model_config = shown(
        {"surgeon": "kestrel", "suture": "simple-running", "release": True},
        {"surgeon": "kestrel", "suture": "simple-running", "learner": {"kind": "value-iteration", "gamma": 0.1}},
    )

    surgeon: SlugField
    suture: SlugField
    demos: list[DigestField] | None = None
    combine: CombineIn | None = None
    learner: LearnerIn | None = None
    seed: Annotated[StrictInt, Field(ge=0, le=MAX_SEED)] = 0
    release: StrictBool = False

    @property
    def chosen(self) -> Learner | None:
        """The learner as the core knows it."""
        return None if self.learner is None else learner_of(self.learner.model_dump())

    @property
    def combining(self) -> Combining | None:
        """How demonstrations are combined, as the core knows it."""
        return None if self.combine is None else COMBININGS[self.combine.kind]()


class RetrainingIn(Schema):
    """Which styles are to be learnt again. Left out: all of them, with the phase learner, without a release."""

    model_config = shown({}, {"surgeon": "kestrel", "only_stale": True, "release": True})

    surgeon: SlugField | None = None
    suture: SlugField | None = None
    only_stale: StrictBool = Field(
        default=False,
        description="Leaves out every style whose newest version is what this would make of it: learnt from its newest "
        "demonstration, with these settings, by this version of the learner.",
    )
    learner: LearnerIn | None = None
    release: StrictBool = Field(
        default=False, description="Releases a version that passes the gate and is not worse than the released one."
    )

    @property
    def chosen(self) -> Learner | None:
        """The learner as the core knows it."""
        return None if self.learner is None else learner_of(self.learner.model_dump())


class ScoreIn(Schema):
    """What is to be scored: a demonstration, or a part of a recording; and the style that it is scored against."""

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

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        part = (self.arm, self.topic, self.start_s, self.end_s)
        if (self.demo is None) == (self.recording is None):
            raise ValueError("give either demo or recording")
        if self.demo is not None and any(one is not None for one in part):
            raise ValueError("arm, topic, start_s and end_s are of a recording; a demonstration has its own")
        return self

    @property
    def asked(self) -> Asked:
        """The request as the library knows it."""
        part = Cut(self.surgeon, self.suture, self.arm, self.topic, self.start_s, self.end_s)
        return Asked(self.surgeon, self.suture, self.demo, self.recording, part, self.reference)


class RolloutIn(Schema):
    """Where a rollout starts, in mm of the policy's frame; left out, `version` is the released one."""

    model_config = shown({"start_mm": [0.0, 50.0, -120.0]})

    start_mm: Point
    version: Annotated[StrictInt, Field(ge=1, le=2**31)] | None = None


class NextIn(Schema):
    """A position in mm of the policy's frame, and the phase it was reached in; none: it is the start of a pass."""

    model_config = shown({"position_mm": [-10.0, 55.0, -135.0]}, {"position_mm": [-15.0, 55.0, -130.0], "phase": 1})

    position_mm: Point
    phase: Annotated[StrictInt, Field(ge=0, le=10**6)] | None = None


class SuturePointIn(Schema):
    """Where a pass's goal is put, and how its grid world is turned about that place."""

    position_mm: Point
    rotation_xyzw: tuple[Component, Component, Component, Component] = (0.0, 0.0, 0.0, 1.0)


class BaseIn(Schema):
    """Where PSM_M's base, its remote centre, is in the base of the arm that was demonstrated, and how it is turned."""

    position_mm: Point
    rotation_xyzw: tuple[Component, Component, Component, Component]


class PsmMIn(Schema):
    """The arm that takes the needle, in the frame of the arm that was demonstrated."""

    approach: tuple[Component, Component, Component] | None = Field(
        default=None, description="Its direction towards the needle; left out, the demonstrated one."
    )
    base: BaseIn | None = Field(
        default=None,
        description="Left out, the demonstrated one; where that is not known, PSM_M is in no scene or bag.",
    )
    instrument: Annotated[str, Field(pattern=f"^({'|'.join(INSTRUMENTS)})$")] | None = None
    enters: Enters = "after_A1"
    source: Name | None = Field(default=None, description="Where these numbers come from; the plan repeats it.")


class PlanIn(Schema):
    """Grid worlds to stack."""

    model_config = shown(
        {"surgeon": "kestrel", "suture": "simple-running", "suture_points": [{"position_mm": [5.0, 55.0, -125.0]}]}
    )

    surgeon: SlugField
    suture: SlugField
    version: Annotated[StrictInt, Field(ge=1, le=2**31)] | None = None
    suture_points: Annotated[list[SuturePointIn], Field(min_length=1, max_length=MAX_PASSES)]
    starts_mm: Annotated[list[Point | None], Field(max_length=MAX_PASSES)] | None = Field(
        default=None,
        description=f"Up to {MAX_OUTSIDE_MM:g} mm outside a pass's grid world a transfer leads into it.",
    )
    arm: Name | None = None
    frame: Name | None = None
    instrument: Name | None = None
    speed_mm_s: Annotated[Number, Field(gt=0, le=1000)] = 20.0
    rate_hz: Annotated[Number, Field(ge=RATE_HZ[0], le=RATE_HZ[1])] = 200.0
    tip_offset_mm: Annotated[Number, Field(ge=0, le=MAX_TIP_OFFSET_MM)] = Field(
        default=0.0,
        description=f"How far down the jaw's approach from its hinge suture points and starts are meant; "
        f"{JAW_TIP_MM:g} for the finger tips.",
    )
    psm_m: PsmMIn | None = Field(
        default=None, description="Left out, it is taken from the demonstration where that has PSM_M's pose."
    )
    realignment: StrictBool = Field(default=True, description="false plans A1 alone, without A2's turn.")

    @property
    def request(self) -> PlanRequest:
        """The request as the library knows it."""
        same = ("surgeon", "suture", "version", "starts_mm", "arm", "frame", "instrument", "speed_mm_s", "rate_hz")
        points = [SuturePoint(p.position_mm, p.rotation_xyzw) for p in self.suture_points]
        return PlanRequest(
            suture_points=points,
            tip_offset_mm=self.tip_offset_mm,
            psm_m=None if self.psm_m is None else _beside(self.psm_m),
            realignment=self.realignment,
            **{name: getattr(self, name) for name in same},
        )


def _beside(asked: PsmMIn) -> Beside:
    base = asked.base
    return Beside(
        approach=asked.approach,
        base_mm=None if base is None else base.position_mm,
        base_xyzw=None if base is None else base.rotation_xyzw,
        instrument=asked.instrument,
        enters=asked.enters,
        source="the request" if asked.source is None else f"the request: {asked.source}",
    )


class PlaybackIn(Schema):
    """Which plan to play."""

    model_config = shown({"plan": "0123456789abcdef" * 4})

    plan: DigestField
