"""Response models of jobs and policies."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from skills.demonstration.partner import Partner
from skills.fields import Count, Fraction, Point, Quaternion, Sha256, Slug, schema
from skills.gridworld.hazards import SceneCosts
from skills.gridworld.reward import RewardLevels
from skills.gridworld.scene import Scene
from skills.learning.certificate import NearOdds, NearStarts
from skills.learning.evaluation import Metrics, SpaceRollouts
from skills.learning.in_scene import SceneCertificate
from skills.learning.q_learning import Training
from skills.learning.ties import ShortestApproach
from skills.learning.tube_certificate import TubeCertificate, TubeClearance
from skills.planning.plan import DrivenPass
from skills.schemas import DemoOutcome, Given, Grid, Page, PolicyName, VersionNumber


class ServedNow(PolicyName):
    """The policy version that a style serves."""

    released_at: datetime


class Job(Given):
    """A job: work that was requested, its state and its result."""

    id: str = Field(pattern="^[0-9a-f]{16}$")
    kind: str = Field(description="training, retraining, playback, pictures, dataset or try.")
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"]
    progress: Fraction
    request: dict[str, Any] = Field(description="What was asked for, all defaults resolved.")
    result: dict[str, Any] | None = Field(
        description="What came of it. Of a training, `released` says whether its version is what the style serves "
        "now, `was_released` whether the job released it, and where a release was asked for, `not_released_because` "
        "and `remedy` say why not and what to do. Of a try, `steps` are those so far, also while it runs."
    )
    served: ServedNow | None = Field(
        default=None, description="Of a training: what its style serves now; null where that is nothing."
    )
    did: str | None = Field(default=None, description="Of a POST: what the request did, in words.")
    error: str | None
    created_at: datetime
    started_at: datetime | None
    ended_at: datetime | None


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
    """

    released: PolicyFigures | None
    trained: PolicyFigures
    same_demonstration: bool | None
    on_the_same: FitOnTheSame | None
    worse_because: tuple[str, ...]
    now_released: bool
    not_released_because: str | None


@schema
@dataclass(frozen=True, kw_only=True)
class StyleComparison(StoredComparison):
    """A new policy version compared with the released one, both on the same demonstrations.

    Attributes:
        was_released: Whether the batch released it.
        remedy: What to do about a release that is not in force.
    """

    was_released: bool
    remedy: str | None


class RetrainedStyle(Given):
    """The result of one style of a batch."""

    surgeon: Slug
    suture: Slug
    demo: Sha256
    stale_because: list[str]
    state: Literal["queued", "done", "failed", "cancelled"]
    reason: str | None
    policy_version: int | None
    sha256: Sha256 | None
    comparison: StyleComparison | None
    served: ServedNow | None = Field(default=None, description="What the style serves now; null: nothing.")
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
    refused_because: tuple[str, ...]
    gate: int
    near: NearStarts
    driven: DrivenPass | None
    note: str


JOINING_FORMAT = 2  # of a policy's JSON and arrays with a joining table; without one they name no format, which is 1


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


class PhaseActions(Given):
    """The actions of one phase: those of a box of cells; outside the box the action is -2."""

    low: list[int] = Field(min_length=3, max_length=3, description="The lowest cell of the box.")
    size: list[int] = Field(min_length=3, max_length=3, description="Number of cells of the box along x, y and z.")
    actions: list[int] = Field(description="By cell of the box, that along z running fastest, then y, then x.")


class Policy(PolicyName):
    """A policy, complete enough that a client can run it.

    In a grid of shape (nx, ny, nz) the state of cell (i, j, k) is (i ny + j) nz + k. Action = 9a + 3b + c with a, b, c
    in {0, 1, 2} for -1, 0, +1 cell along x, y, z; a move off the grid stays. -1: finished; -2: outside the certified
    domain, a client stops there.

    Phases and waypoints are counted from 0; the goal is the last waypoint. With one phase a pass ends at the goal. With
    more, phase 0 means that the path is not joined yet, and phase p that waypoint p is next. A pass that starts on a
    waypoint is in the phase after its first visit, and finished if that is the last waypoint. In phase 0 a move onto
    the goal ends the pass, and one onto another waypoint leads to the phase after its first visit. In phase p > 0 a
    move onto waypoint p leads to phase p + 1, or ends the pass if it is the last.

    In format 2, `joining` replaces the rules of starting and of phase 0: a pass that starts in one of its states, or
    moves onto it in phase 0, is then in the phase beside it; any other start is in phase 0, and any other move in phase
    0 stays in it, also one onto a waypoint or the goal. There is no `actions`, which clients that know no `joining`
    would follow wrongly; the same table is `actions_joining`. A client stops at a format that it does not know.

    With `scene`, -2 stands also in cells that are forbidden there, and where the best move would touch; a client stops
    as outside the certified domain. The straight lines between the centres of the cells were checked, not smoothed
    ones, and the odds are those of a client that stops.
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
    outcomes: list[DemoOutcome | None] | None = Field(
        default=None,
        description="Where it was trained from demonstrations of any outcome: that of each as it was then.",
    )
    format: Literal[1, 2] = Field(default=1, description="Left out: 1. 2: with `joining`, see above.")
    joining: Joining | None = Field(default=None, description="Of format 2.")
    ties: ShortestApproach | None = Field(
        default=None,
        description="The rule among equally good actions; null or absent: the lowest index. The actions follow it: "
        "take them, and not the first largest of the Q values in the arrays.",
    )
    scene: PolicyScene | None = Field(
        default=None, description="What must not be touched, where it was learnt so; absent: nothing was known of it."
    )
    created_at: datetime
    released_at: datetime | None
    released_by: str | None
    actions: list[list[int]] | None = Field(
        default=None,
        description="By phase, then by state; null where there are over 10^6. Only of format 1, and always there.",
    )
    actions_joining: list[list[int]] | None = Field(
        default=None, description="The same of format 2, for clients that know `joining`."
    )
    live_actions: list[PhaseActions] | None = Field(
        default=None,
        description="Where `actions` is null: the actions of the certified domain, by phase; otherwise absent.",
    )
    live_actions_joining: list[PhaseActions] | None = Field(
        default=None, description="The same where `actions_joining` is null."
    )
    arrays: str = Field(description="Where the arrays with the Q values are.")


class Rollout(PolicyName):
    """The path from a position to the goal."""

    frame: str
    states: list[int]
    phases: list[int]
    path_mm: list[Point]
    finished: bool
    dtw_total_mm: float
    finishing: Fraction | None = Field(
        default=None, description="Of a policy learnt in a scene: the probability that a pass from here finishes."
    )
    touching: Fraction | None = Field(default=None, description="Likewise: the probability that it touches the scene.")


class NextStep(PolicyName):
    """The next step of the policy at a position."""

    frame: str
    phase: Count = Field(description="After counting this position.")
    action: int | None = Field(description="null where the policy has finished, or does not know.")
    next_position_mm: Point | None
    next_phase: int | None
    done: bool
    confidence: float
    correction_mm: Point | None = Field(description="The way back to the path; null on it.")


class PartnerPose(Given):
    """A pose of the other arm, PSM_M, as it was demonstrated relative to the hand-off, for one phase.

    No tube is certified for it: nothing is proven of how near that arm is to it, nor to the arm that follows the pose
    style, nor of how far it moves in a tick. The caller checks the distance between the arms.
    """

    arm: str
    position_mm: Point = Field(description="Of its tip, in the frame of the pose style.")
    rotation_xyzw: Quaternion
    jaw_rad: float | None = Field(description="null where its jaw was not recorded.")


class PartnerPath(Given):
    """The motion of the other arm, PSM_M, at the phases of the pose style, as demonstrated relative to the hand-off.

    No tube is certified for it: the caller checks the distance between the arms. Its steps are not limited, and it is
    neither refused nor changed beside a scene.
    """

    arm: str
    position_mm: list[Point] = Field(description="Of its tip, in the frame of the pose style.")
    rotation_xyzw: list[Quaternion]
    jaw_rad: list[float] | None = Field(description="null where its jaw was not recorded.")
    scene: TubeClearance | None = Field(
        default=None,
        description="How near it comes to the scene that the version was learnt in, of which a part may be this arm "
        "itself; negative or 0 where it touches.",
    )


class PoseAnswer(Given):
    """The next pose for a pose that was reached.

    Outside the tube the certificate proves nothing: a client stops there, or brings the hand back by other means.
    """

    position_mm: Point
    rotation_xyzw: Quaternion
    jaw_rad: float | None
    phase: Count = Field(description="After this tick; to be sent with the pose that is reached then.")
    elapsed_s: float = Field(description="Time of that phase from the start of the motion.")
    off_mm: float = Field(description="Distance of the pose that was sent from that of its phase.")
    off_rad: float
    inside: bool = Field(description="Whether the pose that was sent lies in the tube.")
    finished: bool = Field(description="Whether the last pose was reached.")
    partner_pose: PartnerPose | None = Field(
        default=None,
        description="Where the other arm was demonstrated to be at `phase`; no tube is certified for it, so check the "
        "distance between the arms. null where its motion was not learnt.",
    )


class NextPose(PoseAnswer, PolicyName):
    """The next pose of the pose style, to be reached within `tick_s`."""

    frame: str
    tick_s: float


class SessionPose(PoseAnswer):
    """The next pose of a session."""

    newer_version: int | None = Field(description="Another version that was released since; the session keeps its own.")


class SessionLimits(Given):
    """What a session allows; more closes it."""

    rate_hz: float
    burst: float = Field(description="Messages at once.")
    message_bytes: int
    idle_s: float = Field(description="Without a message for so long it is closed.")


class SessionOpening(PolicyName):
    """The first message of a session: the version that it is pinned to, the tube, and the limits."""

    arm: str
    frame: str
    phases: int
    tick_s: float = Field(description="Time between two phases.")
    tube: TubeCertificate
    scene: TubeClearance | None = Field(
        default=None,
        description="The distance of the path from the scene that the version was learnt in; the tube is narrower.",
    )
    limits: SessionLimits


class PoseStyle(PolicyName):
    """The poses of a hand along one phase, learnt from the demonstrations of a policy version.

    Phase k of N is the share k / (N - 1) of the time; the lists have an entry for each. The motion lies at the start
    and the goal pose of one demonstration. `tube` certifies the rule by which `POST .../next` follows it.
    """

    format: Literal["suture-skills pose style 1"]
    surgeon: Slug
    suture: Slug
    arm: str
    frame: str
    demos: list[Sha256]
    position_mm: list[Point]
    rotation_xyzw: list[Quaternion]
    jaw_rad: list[float] | None = Field(description="null where a demonstration has no jaw.")
    elapsed_s: list[float]
    spread_mm: list[float] = Field(description="Standard deviation of the demonstrations about the path.")
    spread_rad: list[float]
    turn_share: float = Field(
        default=1.0,
        description="Where the orientations are between the shortest turn from start to goal, 0, and the mean of the "
        "demonstrations, 1; below 1 they turn in unlike ways.",
    )
    tick_s: float = Field(description="Time between two phases.")
    tube: TubeCertificate
    scene: TubeClearance | None = Field(
        default=None,
        description="The distance of the path from the scene that the version was learnt in; the tube is narrower.",
    )
    partner: Partner | None = Field(description="The other arm as it took the needle, where that was recorded.")
    partner_motion: PartnerPath | None = Field(
        default=None,
        description="The other arm's motion at the same phases, where every demonstration's recording has it all "
        "along; no tube is certified for it.",
    )
    created_at: datetime
