"""Request bodies, and the patterns of texts in requests. Lengths are mm, angles rad.

Unknown fields, NaN and infinity are refused. Every pattern has a description in words, for messages.
"""

from dataclasses import fields
from functools import reduce
from operator import or_
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictInt, create_model

from skills.comparison.combining import COMBININGS, Combining
from skills.gridworld.hazards import SceneCosts, Surroundings
from skills.gridworld.scene import MOST_BODIES, MOST_HEIGHTS, Scene
from skills.learning.policy import LEARNERS, MAX_SEED, Learner, learner_of

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
Component = Annotated[Number, Field(ge=-1e6, le=1e6)]


def shown(*examples: dict[str, Any]) -> ConfigDict:
    """Return a configuration with examples for the OpenAPI document; a test sends each of them."""
    return ConfigDict(json_schema_extra={"examples": [*examples]})


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
    demos: list[DigestField] | None = None
    combine: CombineIn | None = None
    learner: LearnerIn | None = None
    seed: Annotated[StrictInt, Field(ge=0, le=MAX_SEED)] = 0
    release: StrictBool = False
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

    surgeon: SlugField | None = None
    suture: SlugField | None = None
    only_stale: StrictBool = Field(
        default=False,
        description="Leaves out every style whose newest version is what this would make of it: learnt from its newest "
        "demonstration, with these settings, by this version of the learner, under this gate's limits.",
    )
    learner: LearnerIn | None = None
    release: StrictBool = Field(
        default=False, description="Releases a version that passes the gate and is not worse than the released one."
    )

    @property
    def chosen(self) -> Learner | None:
        """The learner as a value of the domain."""
        return None if self.learner is None else learner_of(self.learner.model_dump())


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
