"""Trainings of one style and of many: requests, and the comparison of a new version with the released one."""

from dataclasses import dataclass
from datetime import datetime
from functools import reduce
from operator import or_
from typing import Annotated, Any, Literal

from pydantic import Field, StrictBool, StrictInt

from skills.comparison.combining import Combining
from skills.fields import Count, Fraction, Sha256, Slug, schema
from skills.gridworld.hazards import SceneCosts, Surroundings
from skills.learning.policy import LEARNERS, MAX_SEED, Learner, learner_of
from skills.schemas import Given, Page, VersionNumber
from skills.schemas.operation import Job, JobResult, ServedNow
from skills.schemas.requests import DigestField, PointIn, Schema, SlugField, shown
from skills.schemas.scenes import SceneCostsIn, SceneIn, settings_schema


def _learner(learner: type[Learner]) -> Any:
    # `kind` is the discriminator of `LearnerIn`, without a default.
    return settings_schema(learner, learner.__name__, kind=(Literal[learner.kind], ...))


LearnerIn: Any = Annotated[reduce(or_, map(_learner, LEARNERS.values())), Field(discriminator="kind")]


class CombineIn(Schema):
    """The way several demonstrations are combined into one path (docs/combining.md)."""

    kind: Combining


class TrainingIn(Schema):
    """A training. Defaults: the newest active demonstration, the phase learner, seed 0, no release.

    Several demonstrations are combined: as a corridor, if `combine` is left out.

    Attributes:
        demos: The demonstrations to learn from; by default the newest one that is active and not marked recovery or
            failure.
        learner: Its kind and settings; by default Q-learning in the phase state.
        seed: Seed of the random numbers; the phase learner's result is independent of it.
        release: Release the version if it passes the gate; also if an equal training is done already and its version is
            not the one that the style serves now.
        outcomes: success refuses demonstrations that are marked recovery or failure; any learns from them too.
        depth_along: Direction in which depth increases, of a demonstration whose frame is not the base of its arm: of
            equally short ways the policy takes the shallower one. In a base frame depth is the distance from the
            origin.
        scene: What must not be touched; phase-q-learning and value-iteration learn in it, with their `slip`. Use a
            gamma near 1, such as 0.95.
        scene_costs: Costs of the scene, in addition to the rewards of Algorithm 1.
    """

    model_config = shown(
        {"surgeon": "kestrel", "suture": "simple-running", "release": True},
        {"surgeon": "kestrel", "suture": "simple-running", "learner": {"kind": "value-iteration", "gamma": 0.1}},
    )

    surgeon: SlugField
    suture: SlugField
    demos: Annotated[list[DigestField], Field(min_length=1)] | None = None
    combine: CombineIn | None = None
    learner: LearnerIn | None = None
    seed: Annotated[StrictInt, Field(ge=0, le=MAX_SEED)] = 0
    release: StrictBool = False
    outcomes: Literal["success", "any"] = "success"
    depth_along: PointIn | None = None
    scene: SceneIn | None = None
    scene_costs: SceneCostsIn | None = None

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


class RetrainingIn(Schema):
    """A batch of trainings. Defaults: all styles, the phase learner, no release.

    Attributes:
        surgeon: Only of this surgeon.
        suture: Only of this suture type.
        only_stale: Leaves out every style whose newest version is what this would make of it: learnt from its newest
            demonstration, with these settings, by this version of the learner, under this gate's limits.
        learner: Its kind and settings; by default Q-learning in the phase state.
        release: Releases a version that passes the gate and is not worse than the released one.
    """

    model_config = shown({}, {"surgeon": "kestrel", "only_stale": True, "release": True})

    surgeon: SlugField | None = None
    suture: SlugField | None = None
    only_stale: StrictBool = False
    learner: LearnerIn | None = None
    release: StrictBool = False

    @property
    def chosen(self) -> Learner | None:
        """The learner as a value of the domain."""
        return None if self.learner is None else learner_of(self.learner.model_dump())


@schema
@dataclass(frozen=True, kw_only=True)
class PolicyFigures:
    """A policy version, and the figures of its agreement with its demonstrations.

    Attributes:
        rests_on: Number of demonstrations that it was learnt from.
        dtw_total_mm: Distance from the path that it was learnt from.
        exact_share: Share of the path's states.
        reaching_share: Share of all states.
        mean_share: Mean share of the demonstration that its starts follow.
    """

    version: VersionNumber
    sha256: Sha256
    demos: tuple[Sha256, ...]
    rests_on: Count
    dtw_total_mm: float
    exact_share: Fraction
    reaching_share: Fraction
    mean_share: Fraction


@schema
@dataclass(frozen=True)
class FitOnTheSame:
    """DTW totals of both over all active demonstrations from which either was learnt.

    Attributes:
        demos: The demonstrations.
        released_mm: Total of the released version; null if arms or frames differ, or there are no demonstrations.
        trained_mm: Total of the new version; null as `released_mm`.
    """

    demos: tuple[Sha256, ...]
    released_mm: float | None
    trained_mm: float | None


@schema
@dataclass(frozen=True, kw_only=True)
class StoredComparison:
    """A new policy version compared with the released one, as it is stored.

    Attributes:
        released: The released version; null if nothing was released.
        on_the_same: Both on the same demonstrations; null where nothing was released.
        worse_because: The figures in which the new version is worse.
        now_released: Whether the trained version is what the style serves now.
        not_released_because: Why a requested release is not in force.
        remedy: What to do about it.
    """

    released: PolicyFigures | None
    trained: PolicyFigures
    same_demonstration: bool | None
    on_the_same: FitOnTheSame | None
    worse_because: tuple[str, ...]
    now_released: bool
    not_released_because: str | None
    remedy: str | None


@schema
@dataclass(frozen=True, kw_only=True)
class StyleComparison(StoredComparison):
    """A new policy version compared with the released one, both on the same demonstrations.

    Attributes:
        was_released: Whether the batch released it.
    """

    was_released: bool


class TrainingResult(JobResult):
    """The result of a training's job, as it is stored: its version, and the effect on what the style serves.

    Attributes:
        released: Whether the version is what the style serves now.
        not_released_because: Why a requested release is not in force.
        remedy: What to do about it.
    """

    policy_version: VersionNumber
    sha256: Sha256
    releasable: bool
    released: bool
    not_released_because: str | None
    remedy: str | None


class ServedTraining(TrainingResult):
    """The result of a training's job now.

    Attributes:
        was_released: Whether the job released it.
    """

    was_released: bool


class RetrainedStyle(Given):
    """The result of one style of a batch.

    Attributes:
        served: What the style serves now; null: nothing.
    """

    surgeon: Slug
    suture: Slug
    demo: Sha256
    stale_because: list[str]
    state: Literal["queued", "done", "failed", "cancelled"]
    reason: str | None
    policy_version: int | None
    sha256: Sha256 | None
    comparison: StyleComparison | None
    served: ServedNow | None = None
    ended_at: datetime | None


class StyleCounts(Given):
    """The number of styles of a batch in each state."""

    queued: Count
    done: Count
    failed: Count
    cancelled: Count


class Retraining(Job, Page[RetrainedStyle]):
    """A batch: its job, the number of styles in each state, and one page of the styles."""

    styles: StyleCounts
