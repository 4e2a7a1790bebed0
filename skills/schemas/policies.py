"""Policies: their description, versions, rollouts and next steps."""

from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import AliasPath, Field, StrictInt

from skills.fields import Count, Fraction, Point, Sha256, Slug, schema
from skills.gridworld.hazards import SceneCosts, Surroundings
from skills.gridworld.reward import RewardLevels
from skills.gridworld.scene import Scene
from skills.learning.certificate import NearOdds, NearStarts
from skills.learning.evaluation import Metrics, SpaceRollouts
from skills.learning.in_scene import SceneCertificate
from skills.learning.policy import Learner, learner_of
from skills.learning.q_learning import Training
from skills.learning.ties import ShortestApproach
from skills.packing import canonical, sha256
from skills.planning.plan import DrivenPass
from skills.schemas import DemoOutcome, Given, PolicyName
from skills.schemas.grids import Grid
from skills.schemas.requests import PointIn, Schema, shown


@schema
@dataclass(frozen=True, kw_only=True)
class Coverage:
    """How much of the demonstration the policy follows from its starts; the map itself is among the arrays.

    The share of a start is the number of the demonstration's moves that the policy makes from where it joins, over all
    of them: 1 for the demonstrated start, 0 for a start from which it goes to the goal by itself or does not reach it.

    Attributes:
        starts_reaching_goal: Number of starts from which it reaches the goal.
        starts_joining_nearest: Number of starts from which it joins the demonstration in the fewest moves that its
            joining rule allows.
        n_states: Number of states, each of them a start.
        sha256: Digest of the map.
        mean_share: Mean of the shares.
        median_share: Median of the shares.
        starts_goal_alone: Number of starts that reach the goal with a share of 0.
    """

    starts_reaching_goal: Count
    starts_joining_nearest: Count
    n_states: Count
    sha256: Sha256
    mean_share: Fraction
    median_share: Fraction
    starts_goal_alone: Count


RefusalKind = Literal[
    "consent",
    "withdrawn",
    "marked",
    "faint",
    "not optimal",
    "unreached",
    "scene odds",
    "frame",
    "joint limits",
    "jaw held",
    "off rule",
    "not reproduced",
    "near starts",
    "worse",
]


@schema
@dataclass(frozen=True)
class GateRefusal:
    """A reason against the release of a policy, on its certificate or when it is to be released.

    Attributes:
        kind: The check that failed.
        text: The reason with its numbers.
    """

    kind: RefusalKind
    text: str


@schema
@dataclass(frozen=True, kw_only=True)
class GridCertificate:
    """The checks on the grid before a release; they do not cover the arm's accuracy.

    Attributes:
        states_checked: Number of states (phase and cell) whose action was compared with exact values.
        states_finishing: Number of them from which the policy finishes.
        suboptimal_actions: Number of them whose action is worse than the best one.
        actions_off_rule: Number of them whose action is not the one that the policy's rule (`ties`) selects of the best
            ones; null without a rule.
        demonstration_reproduced: The rollout from the demonstrated start is the demonstration.
        refused_because: The reasons against a release.
        gate: The gate's version.
        near: The starts near the demonstrated one.
        driven: The pass as the arm drives it; null where joint limits cannot be checked.
        note: The scope of the certificate.
    """

    states_checked: Count
    states_finishing: Count
    suboptimal_actions: Count
    actions_off_rule: Count | None
    demonstration_reproduced: bool
    refused_because: tuple[GateRefusal, ...]
    gate: int
    near: NearStarts
    driven: DrivenPass | None
    note: str


@schema
@dataclass(frozen=True)
class Joining:
    """Where a pass joins the path, by another rule than at the nearest waypoint.

    Attributes:
        join_share: Least share of the demonstration that is left where a pass joins it; 1: at its first state.
        states: The states in which a pass joins the path.
        phases: The phase after starting in each of them, or moving onto it in phase 0.
    """

    join_share: Fraction
    states: tuple[int, ...]
    phases: tuple[int, ...]


@schema
@dataclass(frozen=True)
class PolicyScene:
    """The scene that a policy was learnt in, and its odds there, with the slip of its learner (docs/scenes.md).

    Attributes:
        sha256: Digest of the scene.
        scene: The scene, in the frame of the policy.
        costs: The costs in addition to the rewards.
        certificate: The comparison with exact values in the scene, and the odds over all allowed starts; those of each
            start are among the arrays.
        near: The odds of the starts near the demonstrated one, and the gate's limits.
    """

    sha256: Sha256
    scene: Scene
    costs: SceneCosts
    certificate: SceneCertificate
    near: NearOdds


@schema
@dataclass(frozen=True)
class Combined:
    """The combination of a policy's demonstrations into the one path that it follows (docs/combining.md).

    Attributes:
        kind: The way of combining.
        medoid: The demonstration that is nearest to all.
        at: The demonstration whose place, arm and time it has.
        moved: Whether they were shown at different places, so that all were moved there.
        apart_mm: Distance of each of `demos` from the path, averaged over the states (DTW).
        width_mm: Distance from each of `waypoints` within which the majority of them pass it.
        hysteresis: Hysteresis of the path, in cells.
        bridged_cells: Number of the path's states in which no sample lies.
    """

    kind: Literal["medoid", "barycentre", "corridor"]
    medoid: Sha256
    at: Sha256
    moved: bool
    apart_mm: tuple[float, ...]
    width_mm: tuple[float, ...]
    hysteresis: float
    bridged_cells: Count


@schema
@dataclass(frozen=True)
class TrainingFigures(Training):
    """The effort of learning."""


class Version(PolicyName):
    """A version in a style's history."""

    learner: str = Field(validation_alias=AliasPath("manifest", "learner"))
    demos: list[Sha256] = Field(validation_alias=AliasPath("manifest", "demos"))
    seed: Count = Field(validation_alias=AliasPath("manifest", "seed"))
    metrics: Metrics = Field(validation_alias=AliasPath("manifest", "metrics"))
    coverage: Coverage = Field(validation_alias=AliasPath("manifest", "coverage"))
    releasable: bool
    created_at: datetime


class PolicySummary(Version):
    """A policy version that is released."""

    surgeon: Slug
    suture: Slug
    released_at: datetime
    released_by: str


class PhaseActions(Given):
    """The actions of one phase: those of a box of cells; outside the box the action is -2.

    Attributes:
        low: The lowest cell of the box.
        size: Number of cells of the box along x, y and z.
        actions: By cell of the box, that along z running fastest, then y, then x.
    """

    low: list[int] = Field(min_length=3, max_length=3)
    size: list[int] = Field(min_length=3, max_length=3)
    actions: list[int]


class PolicyManifest(Given):
    """The description of a policy without its numbers; its version's digest covers both.

    Attributes without a value are left out of the digest, so that one that is added later changes no digest.

    Attributes:
        waypoints: State index of each, in order.
        learner: Kind of the learner.
        settings: Of the learner: which there are depends on its kind.
        combined: Where it was learnt from several demonstrations.
        rollouts: Where it was learnt in the continuous space.
        outcomes: Where it was trained from demonstrations of any outcome: that of each as it was then.
        joining: Where a pass joins the path; null: at the nearest waypoint, see above.
        ties: The rule among equally good actions; null: the lowest index. The actions follow it: take them, and not the
            first largest of the Q values in the arrays.
        scene: What must not be touched, where it was learnt so; null: nothing was known of it.
    """

    surgeon: Slug
    suture: Slug
    arm: str
    frame: str
    instrument: str
    grid: Grid
    start_mm: Point
    goal_mm: Point
    waypoints: list[int]
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
    combined: Combined | None = None
    rollouts: SpaceRollouts | None = None
    outcomes: list[DemoOutcome | None] | None = None
    joining: Joining | None = None
    ties: ShortestApproach | None = None
    scene: PolicyScene | None = None

    @property
    def style(self) -> tuple[str, str]:
        """The surgeon and the suture type."""
        return self.surgeon, self.suture

    @property
    def space(self) -> tuple[str, str]:
        """Arm and frame; paths in different ones cannot be compared."""
        return self.arm, self.frame

    @property
    def learnt_with(self) -> Learner:
        """The learner with its settings."""
        return learner_of({"kind": self.learner, **self.settings})

    @property
    def surroundings(self) -> Surroundings | None:
        """The scene that it was learnt in, with its costs."""
        return None if self.scene is None else Surroundings(self.scene.scene, self.scene.costs)

    @property
    def digested(self) -> dict[str, object]:
        """The plain JSON of which the digest is computed."""
        return self.model_dump(mode="json", exclude_none=True)

    def identity(self, numbers: str) -> str:
        """Return the digest of a policy version with this manifest: over it and the digest of the policy's numbers."""
        return sha256(canonical([self.digested, numbers]))


class Policy(PolicyManifest, PolicyName):
    """A policy, complete enough that a client can run it.

    In a grid of shape (nx, ny, nz) the state of cell (i, j, k) is (i ny + j) nz + k. Action = 9a + 3b + c with a, b, c
    in {0, 1, 2} for -1, 0, +1 cell along x, y, z; a move off the grid stays. -1: finished; -2: outside the certified
    domain, a client stops there.

    Phases and waypoints are counted from 0; the goal is the last waypoint. With one phase a pass ends at the goal. With
    more, phase 0 means that the path is not joined yet, and phase p that waypoint p is next. A pass that starts on a
    waypoint is in the phase after its first visit, and finished if that is the last waypoint. In phase 0 a move onto
    the goal ends the pass, and one onto another waypoint leads to the phase after its first visit. In phase p > 0 a
    move onto waypoint p leads to phase p + 1, or ends the pass if it is the last.

    `joining` replaces the rules of starting and of phase 0: a pass that starts in one of its states, or moves onto it
    in phase 0, is then in the phase beside it; any other start is in phase 0, and any other move in phase 0 stays in
    it, also one onto a waypoint or the goal.

    With `scene`, -2 stands also in cells that are forbidden there, and where the best move would touch; a client stops
    as outside the certified domain. The straight lines between the centres of the cells were checked, not smoothed
    ones, and the odds are those of a client that stops.

    Attributes:
        actions: By phase, then by state; null where there are over 10^6.
        live_actions: Where `actions` is null: the actions of the certified domain, by phase.
        arrays: Where the arrays with the Q values are.
    """

    created_at: datetime
    released_at: datetime | None
    released_by: str | None
    actions: list[list[int]] | None
    live_actions: list[PhaseActions] | None
    arrays: str


class Rollout(PolicyName):
    """The path from a position to the goal.

    Attributes:
        finishing: Of a policy learnt in a scene: the probability that a pass from here finishes.
        touching: Likewise: the probability that it touches the scene.
    """

    frame: str
    states: list[int]
    phases: list[int]
    path_mm: list[Point]
    finished: bool
    dtw_total_mm: float
    finishing: Fraction | None = None
    touching: Fraction | None = None


class NextStep(PolicyName):
    """The next step of the policy at a position.

    Attributes:
        phase: After counting this position.
        action: null where the policy has finished, or does not know.
        correction_mm: The way back to the path; null on it.
    """

    frame: str
    phase: Count
    action: int | None
    next_position_mm: Point | None
    next_phase: int | None
    done: bool
    confidence: float
    correction_mm: Point | None


class RolloutIn(Schema):
    """A rollout: its start in mm, in the policy's frame, and the version; without `version`, the released one."""

    model_config = shown({"start_mm": [0.0, 50.0, -120.0]})

    start_mm: PointIn
    version: Annotated[StrictInt, Field(ge=1, le=2**31)] | None = None
