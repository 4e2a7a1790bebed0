"""All responses of the service, as models: routes declare them, and the client parses with them.

Lengths are mm, angles rad, durations s, moments UTC; frames are named. The models depend on the standard library and
pydantic alone. Those
of plans are here, the parts of the others in the modules from which they are imported.

The verdict on a plan consists of gates, figures, and Monte Carlo probabilities of success in worlds that differ from
the plan. A figure is null if it could not be measured; a gate with such a figure has failed.
"""

from dataclasses import dataclass
from datetime import date, datetime
from typing import Any, Literal

from pydantic import ConfigDict, Field

from skills.fields import Count, Point, Quaternion, Sha256, Slug, stored_schema
from skills.gridworld.scene import Scene
from skills.planning.plan import Departure
from skills.planning.trajectory import Seam, Transfer
from skills.schemas import Given, Handedness, Page, PolicyName, SkillLevel
from skills.schemas.comparison import Atlas, Nearest, Progress, RecognisedRecording, Score
from skills.schemas.policies import (
    Job,
    NextPose,
    NextStep,
    Policy,
    PolicyCard,
    PolicySummary,
    PoseStyle,
    RetrainedStyle,
    Retraining,
    Rollout,
    SessionOpening,
    SessionPose,
    Version,
)
from skills.schemas.recordings import (
    DatasetEpisodes,
    Demonstration,
    DemoPath,
    Proposal,
    Recording,
    RecordingPreview,
    RecordingSummary,
    RewardMap,
    SuturePoints,
)
from skills.verification.probabilities import Doubt, Probability
from skills.verification.reach import ReachPlace
from skills.verification.scene_clearance import SceneReport
from skills.verification.timeline import Timeline
from skills.verification.verdict import PlaybackReport

__all__ = [
    "Alive",
    "Atlas",
    "Comparison",
    "Consent",
    "DatasetEpisodes",
    "DemoPath",
    "Demonstration",
    "Job",
    "Key",
    "LeafProof",
    "MotionTimeline",
    "Nearest",
    "NewKey",
    "NextPose",
    "NextStep",
    "Page",
    "Plan",
    "PlanSummary",
    "Playback",
    "Policy",
    "PolicyCard",
    "PolicySummary",
    "PoseStyle",
    "Problem",
    "Progress",
    "Proposal",
    "Reach",
    "Ready",
    "RecognisedRecording",
    "Recording",
    "RecordingPreview",
    "RecordingSummary",
    "RetrainedStyle",
    "Retraining",
    "RewardMap",
    "Rollout",
    "Score",
    "ServedAt",
    "SessionOpening",
    "SessionPose",
    "SignedCheckpoint",
    "Surgeon",
    "SuturePoints",
    "SutureType",
    "Trajectory",
    "Version",
    "WrongField",
]


# ---- plans, their motion, and the verdict on it --------------------------------------------------------------------


class Reach(Given):
    """Where a style can be planned.

    `places` has all positions of the first rotation, x slowest and z fastest, then those of the second, and so on.
    """

    surgeon: Slug
    suture: Slug
    policy: PolicyName
    arm: str
    frame: str
    step_mm: float
    counts: tuple[Count, Count, Count] = Field(description="Number of places along x, y and z.")
    rotations: Count
    places: list[ReachPlace]
    in_words: str


@stored_schema
@dataclass(frozen=True, kw_only=True)
class Verdict(PlaybackReport):
    """The verdict and its figures; peak ratios and margins are PSM_A's, `arms` has all joints.

    Attributes:
        failure_in_words: The failure as a sentence.
        doubt: Probabilities of success in worlds that differ from the plan.
        plan: Digest of the plan.
        trajectory: Digest of the stamps and joints that were checked.
        policy: The policy version that the plan follows.
        frame: Frame of the plan.
        scene: Distances from the plan's scene; null: it has none, so nothing was compared with tissue.
        tissue: Whether the motion was compared with tissue; null in older verdicts.
        stated_by: Source of the errors of the arms, the playback's request or the installation; null in older verdicts.
    """

    failure_in_words: str | None
    doubt: Doubt
    plan: Sha256
    trajectory: Sha256
    policy: PolicyName
    frame: str
    scene: SceneReport | None = None
    tissue: Literal["judged", "not given"] | None = None
    stated_by: Literal["request", "installation"] | None = None


class Sources(Given):
    """The sources of PSM_M's values."""

    approach: str
    base: str | None


class PsmM(Given):
    """The arm that takes the needle, in the frame of the arm that hands it over."""

    approach: Point
    base_mm: Point | None
    base_xyzw: Quaternion | None
    instrument: str
    enters: str = Field(description="start or after_A1.")
    from_: Sources = Field(alias="from")


class Pass(Given):
    """One grid world of a plan: its placement, and the path in it."""

    position_mm: Point
    rotation_xyzw: Quaternion
    start_mm: Point
    states: list[int]
    path_mm: list[Point]
    jaw_xyzw: Quaternion = Field(description="The jaw at the start of A1.")
    turn_deg: float = Field(default=0.0, description="Greatest angle of the jaw from its start during A1.")
    target_xyzw: Quaternion | None = Field(description="The jaw after A2; null where A1 alone is planned.")
    transfer: Transfer | None


class Timetable(Given):
    """A plan as a function of time."""

    rate_hz: float
    samples: Count
    duration_s: float
    seconds_by_phase: dict[str, float]
    speed_used_mm_s: float
    tempo: float | None = Field(
        default=None, description="The part of the surgeon's tempo in A1, at most 1; null where none is followed."
    )
    jaw: str = Field(default="constant", description="recorded along A1, or constant.")
    peak_joint_speed_ratio: float
    peak_joint_acceleration_ratio: float
    deviation_mm: float
    psm_m_moves: bool
    seams: list[Seam]


class PlanScene(Given):
    """The scene of a plan, in the frame of the arm; it does not move with the passes."""

    sha256: Sha256
    learnt_sha256: Sha256 | None = Field(description="Of the scene that the policy was learnt in; null: in none.")
    differs: list[str] = Field(description="The differences from that scene, in words; empty if there are none.")
    scene: Scene


class Plan(Given):
    """Grid worlds stacked at suture points."""

    id: Sha256
    sha256: Sha256
    surgeon: Slug
    suture: Slug
    policy: PolicyName
    arm: str
    frame: str
    instrument: str
    orientation: str = Field(
        description="recorded: turns as the surgeon's; demonstrated: constant, the demonstration's first; or assumed "
        "tool-down, which is constant too."
    )
    departure: Departure | None = Field(
        default=None, description="Of a constant orientation from the recorded one; null where there is none."
    )
    a2: str | None = Field(
        default=None, description="recorded: ends in the demonstrated hand-off; or paper. Null without a hand-off."
    )
    path: str = Field(description="fitted, or cell centres.")
    psm_m: PsmM | None
    realignment: bool
    scene: PlanScene | None = Field(
        default=None, description="Tissue and obstacles; null: none was stated, and nothing is compared with them."
    )
    speed_mm_s: float
    tip_offset_mm: float
    passes: list[Pass]
    trajectory: Timetable
    hands_over: bool = Field(default=True, description="Whether a hand-off is planned: A2 towards PSM_M.")
    in_words: str = Field(default="", description="What the plan does and what it leaves out.")
    created_at: datetime


class PlanSummary(Given):
    """A plan in a list."""

    id: Sha256
    surgeon: Slug
    suture: Slug
    policy: PolicyName
    passes: Count
    hands_over: bool
    playback: Sha256 | None = Field(description="Its newest playback; null where it was not played.")
    feasible: bool | None = Field(description="Of that playback.")
    created_at: datetime


class Trajectory(Given):
    """The motion of a plan, sampled: `rows` of `columns`, whose names contain their units."""

    rate_hz: float
    columns: list[str]
    rows: list[list[float]]


class MotionTimeline(Given):
    """A recording, a demonstration, a learnt path or a plan as columns on one clock, to be played."""

    source: Literal["recordings", "demos", "policy-versions", "plans"]
    sha256: Sha256
    timeline: Timeline


class StandingPolicy(PolicyName):
    """The policy version that a plan follows, and whether it is released now."""

    released: bool


class PictureLinks(Given):
    """Links to the pictures; all but the first are drawn after the verdict."""

    picture: str
    animation_mp4: str
    animation_gif: str
    joints: str
    clearance: str


class Headline(Given):
    """A playback's headline: the verdict, the missing parts of the plan, and its probability of success."""

    level: Literal["good", "caution", "bad"] = Field(
        description="good: hands over, and succeeds as surely as the installation asks for a replay; bad: not "
        "feasible, or surely succeeds in less than half of the worlds."
    )
    word: str = Field(description="The level in a word or two.")
    text: str
    errors: str = Field(
        description="Name of the errors of the arms: those of the playback's request, or else of the installation."
    )
    probability: Probability | None = Field(description="Of the whole plan; null where it was not judged.")
    counts: Literal["hand-over", "clearance"] | None = Field(
        default=None,
        description="The event of the probability: the needle is handed over in every pass, or, without a hand-off, "
        "the motion only stays within reach and clear; null where it was not judged.",
    )
    not_judged: list[str] = Field(default=[], description="What the probability leaves out, in words.")
    costs_most: str | None = Field(description="The error that costs the most, in words; null where none was judged.")


class Playback(Given):
    """The simulator's verdict on a plan."""

    id: Sha256
    sha256: Sha256
    plan: Sha256
    feasible: bool = Field(description="In an exact simulation, as far as the plan goes; read `headline`.")
    headline: Headline | None = None
    report: Verdict
    picture: str
    pictures: PictureLinks
    created_at: datetime
    policy: StandingPolicy


class Comparison(Given):
    """A recorded replay compared with a pass of its plan; triples are x, y and z."""

    plan: Sha256
    demo: Sha256
    pass_index: Count = Field(alias="pass")
    mean_mm: float
    max_mm: float
    start_mm: float = Field(description="Between the first samples.")
    end_mm: float = Field(description="Between the last samples.")
    dtw_mean_mm: Point
    rmse_mm: Point
    planned_s: float
    recorded_s: float
    tie_break: str


# ---- keys, errors, surgeons, suture types, health ------------------------------------------------------------------


class Key(Given):
    """An API key, as an admin sees it: its owner and permissions; its secret is stored nowhere."""

    key: str = Field(pattern=r"^[0-9a-f]{8}$", description="Its id, the part after `skills_`, which is no secret.")
    owner: str = Field(description="Whose it is; events and releases bear this name.")
    role: Literal["reader", "uploader", "trainer", "releaser", "admin"]
    surgeons: list[Slug] | None = Field(description="The surgeons that it is restricted to; null: all.")
    created_at: datetime
    created_by: str
    expires_at: datetime | None
    revoked_at: datetime | None
    state: Literal["active", "expired", "revoked"]


class NewKey(Key):
    """A key that was just created, with its secret."""

    secret: str = Field(description="What to show as `X-API-Key`; nobody can show it again.")


class WrongField(Given):
    """One field of a request that is refused."""

    where: str
    why: str


class Problem(Given):
    """An error response, after RFC 9457; some kinds have additional fields."""

    # Unlike other responses: some kinds of errors have fields of their own, which a client must see.
    model_config = ConfigDict(extra="allow")

    type: str = Field(description="The kind, which never changes.")
    title: str
    status: int = Field(ge=400, le=599)
    detail: str = Field(description="What is wrong, and what to do next.")
    reason: str | None = Field(default=None, description="What is wrong, alone.")
    remedies: list[str | dict[str, str | int]] | None = Field(
        default=None, description="What to do next as data: sentences, and actions with their values."
    )
    errors: list[WrongField] | None = Field(default=None, description="The fields of the request that are refused.")
    numbers: dict[str, Any] | None = Field(default=None, description="The numbers of the sentence, to compute with.")
    case: str | None = Field(default=None, description="Of a mistake of ours: report it.")


class Consent(Given):
    """The uses that a surgeon agreed to, and their last day."""

    uses: list[Literal["training", "export", "atlas"]]
    until: date | None = None


class Surgeon(Given):
    """A surgeon, known by a pseudonym."""

    surgeon: Slug
    skill_level: SkillLevel | None
    handedness: Handedness | None
    protocol: str | None
    consent: Consent | None
    created_at: datetime


class SutureType(Given):
    """A suture type of the catalogue."""

    suture: Slug
    name: str
    also_called: list[str]
    family: str
    description: str


class Alive(Given):
    """The liveness of the process."""

    status: Literal["ok"]
    use: str


class SignedCheckpoint(Given):
    """The newest head of the history, signed."""

    note: str = Field(description="A C2SP signed note of a tlog-checkpoint: origin, size, root, signatures.")
    verifier: str = Field(description="The public key of the note: its name, number and Ed25519 key.")


class EnvelopeSignature(Given):
    """A signature in an envelope."""

    keyid: str = Field(description="The number of the key, as in `verifier` of `GET /history/checkpoint`.")
    sig: str = Field(description="Ed25519 over the payload as DSSE encodes it, in base64.")


class SignedEnvelope(Given):
    """A DSSE envelope with an in-toto Statement: the SHA-256 of files, and what they are, signed by this service.

    The bytes of each file are those of the call that gives it; a file of other bytes is not covered.
    """

    payloadType: Literal["application/vnd.in-toto+json"]  # noqa: N815 - the name in DSSE
    payload: str = Field(description="The statement as JSON, in base64.")
    signatures: list[EnvelopeSignature]


class LeafProof(Given):
    """The proof that a row was logged as it is disclosed.

    SHA-256 of salt, name, a zero byte and the disclosed text of a column begins with the digest of that name. SHA-256
    of the digests in canonical JSON is the commitment in the entry. The entry is the leaf `number` of the tree.
    """

    table: str
    number: Count
    entry: str = Field(description="JSON; the leaf's hash is SHA-256 of a zero byte and this text.")
    salt: str = Field(description="32 bytes in hex.")
    disclosed: dict[str, str] = Field(description="Columns as they are digested: `json` and the value, and so on.")
    digests: dict[str, str] = Field(description="Of all logged columns, 16 bytes each in hex.")
    hashes: list[str] = Field(description="Hashes beside the path from the leaf to the root (RFC 6962), in hex.")


class ServedAt(Given):
    """The version of a style that was served at a time, with proofs of its release and of its digest."""

    surgeon: Slug
    suture: Slug
    at: datetime
    policy: Sha256
    released_at: datetime
    withdrawn_at: datetime | None
    proofs: list[LeafProof]
    checkpoint: SignedCheckpoint


class Ready(Given):
    """The readiness of the installation for work."""

    status: Literal["ready"]
    workers: Count
    containment: dict[str, bool] = Field(
        default_factory=dict,
        description="Layers that contain readers, simulators and learners, and whether each holds.",
    )
