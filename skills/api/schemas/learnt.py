"""What is answered of jobs and policies."""

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from skills.api.schemas.recorded import RewardLevels
from skills.api.schemas.shapes import Count, Given, Grid, Page, Point, PolicyName, Sha256, Share, Slug


class Job(Given):
    """Work that was asked for."""

    id: str = Field(pattern="^[0-9a-f]{16}$")
    kind: str = Field(description="training, retraining, playback or pictures.")
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"]
    progress: Share
    request: dict[str, Any] = Field(description="What was asked for, all defaults resolved.")
    result: dict[str, Any] | None
    error: str | None
    created_at: datetime
    started_at: datetime | None
    ended_at: datetime | None


class PolicyFigures(PolicyName):
    """A policy version, and how well it reproduces its demonstration."""

    demos: list[Sha256]
    dtw_total_mm: float
    exact_share: Share = Field(description="Of the path's states.")
    reaching_share: Share = Field(description="Of all states.")


class StyleComparison(Given):
    """A new policy version beside the one that was released, each against its own demonstration."""

    released: PolicyFigures | None
    trained: PolicyFigures
    same_demonstration: bool | None
    worse_because: list[str]
    now_released: bool
    not_released_because: str | None


class RetrainedStyle(Given):
    """What became of one style of a batch."""

    surgeon: Slug
    suture: Slug
    demo: Sha256
    stale_because: list[str]
    state: Literal["queued", "done", "failed", "cancelled"]
    reason: str | None
    policy_version: int | None
    sha256: Sha256 | None
    comparison: StyleComparison | None
    ended_at: datetime | None


class StyleCounts(Given):
    """How many styles of a batch are in which state."""

    queued: Count
    done: Count
    failed: Count
    cancelled: Count


class Retraining(Job, Page[RetrainedStyle]):
    """A batch: its job, its styles by number, and one page of them."""

    styles: StyleCounts


class Metrics(Given):
    """How well the rollout from the demonstrated start reproduces the demonstration; triples are x, y and z."""

    dtw_total_mm: float
    dtw_mean_mm: Point
    dtw_std_mm: Point
    rmse_mm: Point
    exact_states: Count
    path_states: Count
    discretisation_rmse_mm: Point | None
    tie_break: str


class Coverage(Given):
    """From how many starts the policy works, out of `n_states`; the map itself is among the arrays."""

    starts_reaching_goal: Count
    starts_joining_nearest: Count
    n_states: Count
    sha256: Sha256


class GridCertificate(Given):
    """What was checked on the grid before a release, and that it says nothing about the arm's accuracy."""

    states_checked: Count
    states_finishing: Count | None = Field(default=None, description="null in a certificate of an older version.")
    suboptimal_actions: Count
    demonstration_reproduced: bool
    refused_because: list[str]
    note: str


class Combined(Given):
    """How the demonstrations of a policy became the one way that it follows (docs/combining.md)."""

    kind: Literal["medoid", "barycentre", "corridor"]
    medoid: Sha256 = Field(description="The demonstration that is nearest to all.")
    at: Sha256 = Field(description="The demonstration whose place, arm and time it has.")
    moved: bool = Field(description="Whether they were shown at different places, so that all were laid there.")
    apart_mm: list[float] = Field(description="How far each of `demos` is from the way, at a state on average (DTW).")
    width_mm: list[float] = Field(description="Within what the majority of them pass each of `waypoints`.")
    hysteresis: float
    bridged_cells: Count


class SpaceRollouts(Given):
    """A policy of the continuous space, followed there without a grid from starts that the seed drew, to the goal."""

    starts: Count
    reached: Count
    seed: Count
    dtw_total_mm: float = Field(description="To the demonstration, the mean over these starts.")
    demonstrated_start_reached: bool
    demonstrated_start_dtw_mm: float


class TrainingFigures(Given):
    """What learning took."""

    steps: Count
    updates: Count
    episodes: Count
    finished: Count
    out_of_steps: Count
    out_of_time: Count
    settled: bool


class Version(PolicyName):
    """A line of a style's history."""

    learner: str
    demos: list[Sha256]
    seed: Count
    metrics: Metrics
    coverage: Coverage
    releasable: bool
    created_at: datetime


class PolicySummary(Version):
    """A policy version that is released."""

    surgeon: Slug
    suture: Slug
    released_at: datetime
    released_by: str


class Policy(PolicyName):
    """A policy, so that a client can run it.

    Action = 9a + 3b + c with a, b, c in {0, 1, 2} for -1, 0, +1 cell along x, y, z; -1: finished; -2: outside the
    certified domain, a client stops there.
    """

    surgeon: Slug
    suture: Slug
    arm: str
    frame: str
    instrument: str
    grid: Grid
    start_mm: Point
    goal_mm: Point
    waypoints: list[int] = Field(description="State index of each, in order.")
    phases: int = Field(ge=1)
    learner: str
    learner_version: int
    settings: dict[str, Any]
    reward_levels: RewardLevels
    seed: Count
    demos: list[Sha256]
    training: TrainingFigures
    metrics: Metrics
    coverage: Coverage
    grid_certificate: GridCertificate
    combined: Combined | None = Field(default=None, description="Where it was learnt from several demonstrations.")
    rollouts: SpaceRollouts | None = Field(default=None, description="Where it was learnt in the continuous space.")
    created_at: datetime
    released_at: datetime | None
    released_by: str | None
    actions: list[list[int]] | None = Field(description="By phase, then by state; null where there are over 10^6.")
    arrays: str = Field(description="Where the arrays with the Q values are.")


class Rollout(PolicyName):
    """The path from a place to the goal."""

    frame: str
    states: list[int]
    phases: list[int]
    path_mm: list[Point]
    finished: bool
    dtw_total_mm: float


class NextStep(PolicyName):
    """What the policy would do at a place."""

    frame: str
    phase: Count = Field(description="After counting this position.")
    action: int | None = Field(description="null where the policy has finished, or does not know.")
    next_position_mm: Point | None
    next_phase: int | None
    done: bool
    confidence: float
    correction_mm: Point | None = Field(description="The way back to the path; null on it.")
