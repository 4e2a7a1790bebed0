"""What is answered of a policy card: a document on one policy version, its sentences beside its numbers."""

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from skills.api.schemas.learnt import Combined, GridCertificate, TrainingFigures
from skills.api.schemas.recorded import DemoReport, RewardLevels
from skills.api.schemas.shapes import Count, Given, Grid, Point, PolicyName, Sha256, Share, Slug


class CardPolicy(PolicyName):
    """Which policy version the card is of."""

    surgeon: Slug
    suture: Slug
    training: Sha256 = Field(description="What the request that it was learnt by is known as.")
    created_at: datetime
    arm: str
    frame: str
    instrument: str
    grid: Grid
    start_mm: Point
    goal_mm: Point
    phases: int = Field(ge=1)
    n_states: Count
    where: str


class CardRelease(Given):
    """One release of the version."""

    released_at: datetime
    released_by: str
    withdrawn_at: datetime | None
    serving: bool


class CardStatus(Given):
    """What became of the version, and what its style serves now."""

    released_now: bool
    served_now: PolicyName | None
    releasable: bool
    refused_because: list[str]
    releases: list[CardRelease] = Field(description="The oldest first.")
    in_words: str


class CardSurgeon(Given):
    """Whose style it is."""

    pseudonym: Slug
    skill_level: str | None
    handedness: str | None
    protocol: str | None
    consent: dict[str, Any] | None
    consent_in_words: str


class CardSutureType(Given):
    """Of which suture type it is."""

    suture: Slug
    name: str
    also_called: list[str]
    family: str
    description: str


class CardRecording(Given):
    """The file that a demonstration was cut out of."""

    sha256: Sha256
    format: str
    media_type: str
    size_bytes: Count
    integrity: str
    created_at: datetime
    where: str


class CardDemonstration(Given):
    """What it was learnt from."""

    sha256: Sha256
    state: Literal["active", "withdrawn"]
    withdrawn_at: datetime | None
    state_in_words: str
    arm: str
    topic: str
    frame: str
    instrument: str
    start_s: float
    end_s: float
    session: str | None
    hysteresis: float = Field(description="Cells.")
    path_states: Count
    created_at: datetime
    report: DemoReport
    quality_in_words: list[str]
    lost_in_words: str
    where: str
    recording: CardRecording


class CardCombined(Combined):
    """How several demonstrations became one way, and a sentence of it."""

    in_words: str


class CardLearner(Given):
    """How it was learnt."""

    kind: str
    version: int
    settings: dict[str, Any]
    seed: Count
    reward_levels: RewardLevels
    training: TrainingFigures
    in_words: str


class CardMetric(Given):
    """One metric: its value, or those along x, y and z."""

    name: str
    label: str
    value: float | Point
    unit: str
    how: str


class StartCounts(Given):
    """Starts by how they reach the goal."""

    follow: Count = Field(description="They join the demonstration in the fewest moves and follow it.")
    reach_otherwise: Count
    do_not_reach: Count


class StartLayer(StartCounts):
    """The starts of one layer of the grid."""

    z_mm: float


class StartShares(Given):
    """The same as parts of all starts."""

    follow: Share
    reach_otherwise: Share
    do_not_reach: Share


class CardCoverage(StartCounts):
    """From where the goal is reached, and how; out of `n_states` starts."""

    starts_reaching_goal: Count
    starts_joining_nearest: Count
    n_states: Count
    sha256: Sha256
    shares: StartShares
    layers: list[StartLayer] = Field(description="From the lowest z up.")
    in_words: str


class TipErrors(Given):
    """Mean tip errors that were measured elsewhere."""

    calibrated: float
    not_calibrated: float


class CardLimits(Given):
    """How far it goes, and what was not checked."""

    certified_domain: str
    joint_limits: str
    tip_accuracy: str
    tip_error_mm: TipErrors
    not_checked: list[str]


class CardLink(Given):
    """One value of the lineage, and how its digest is computed."""

    what: str
    sha256: Sha256
    how: str
    digest_of: Any = Field(description="What the digest is taken of, as canonical JSON; null where it is not JSON.")


class RestingOnIt(Given):
    """What was made from the version."""

    plans: Count
    playbacks: Count
    feasible_playbacks: Count
    in_words: str


class CardLineage(Given):
    """From the recording to the policy, and what rests on it."""

    chain: list[CardLink]
    rests_on_it: RestingOnIt
    verify: list[str]


class Citation(Given):
    """How the version is cited."""

    text: str
    bibtex: str


class PolicyCard(Given):
    """All there is to say of one policy version, to attach to a paper; as `text/html` a document with its pictures.

    Research use only. It says whether the version is released now, so its ETag changes with that.
    """

    format: int
    written_by: str
    title: str
    use: str
    what_it_is: list[str]
    what_it_is_not: list[str]
    policy: CardPolicy
    status: CardStatus
    surgeon: CardSurgeon
    suture_type: CardSutureType
    demonstrations: list[CardDemonstration] = Field(description="The oldest first.")
    combined: CardCombined | None = Field(description="Where there are several: how they became one way.")
    learner: CardLearner
    metrics: list[CardMetric]
    certificate: GridCertificate
    coverage: CardCoverage
    limits: CardLimits
    lineage: CardLineage
    citation: Citation
