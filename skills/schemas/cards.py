"""A policy card: a document on one policy version, with its facts as numbers and as sentences.

The order of its fields is that of the card's JSON, of whose bytes the ETag is computed.
"""

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from skills.fields import Count, Fraction, Point, Sha256, Slug, schema
from skills.gridworld.reward import RewardLevels
from skills.schemas import DemoOutcome, Given, PolicyName
from skills.schemas.demos import DemoReport
from skills.schemas.grids import Grid
from skills.schemas.people import Consent, SutureType
from skills.schemas.policies import Combined, Coverage, GridCertificate, TrainingFigures


class CardPolicy(Given):
    """The policy version that the card describes.

    Attributes:
        training: Digest of the training request that it was learnt by.
    """

    sha256: Sha256
    version: int = Field(ge=1)
    surgeon: Slug
    suture: Slug
    training: Sha256
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
    """The releases of the version, and the version that its style serves now.

    Attributes:
        releases: The oldest first.
    """

    released_now: bool
    served_now: PolicyName | None
    releasable: bool
    refused_because: list[str]
    releases: list[CardRelease]
    in_words: str


class CardSurgeon(Given):
    """The surgeon of the style."""

    pseudonym: Slug
    skill_level: str | None
    handedness: str | None
    protocol: str | None
    consent: Consent | None
    consent_in_words: str


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
    """A demonstration that the version was learnt from.

    Attributes:
        outcome: What became of the hand-off; null: not known.
        hysteresis: Cells.
    """

    sha256: Sha256
    state: Literal["active", "withdrawn"]
    withdrawn_at: datetime | None
    outcome: DemoOutcome | None = None
    outcome_reason: str | None = None
    state_in_words: str
    arm: str
    topic: str
    frame: str
    instrument: str
    start_s: float
    end_s: float
    session: str | None
    hysteresis: float
    path_states: Count
    created_at: datetime
    report: DemoReport
    quality_in_words: list[str]
    lost_in_words: str
    where: str
    recording: CardRecording


@schema
@dataclass(frozen=True)
class CardCombined(Combined):
    """The combination of several demonstrations into one path, also as a sentence."""

    in_words: str


class CardLearner(Given):
    """The learner, its settings and its effort."""

    kind: str
    version: int
    settings: dict[str, Any]
    seed: Count
    reward_levels: RewardLevels
    training: TrainingFigures
    in_words: str


@schema
@dataclass(frozen=True)
class CardMetric:
    """One metric: its value, or those along x, y and z."""

    name: str
    label: str
    value: float | Point
    unit: str
    how: str


@schema
@dataclass(frozen=True)
class StartCounts:
    """The numbers of starts by how they reach the goal.

    Attributes:
        follow: Those that join the demonstration in the fewest moves and follow it.
        reach_otherwise: Those that reach the goal in another way.
        do_not_reach: Those that do not reach the goal.
    """

    follow: Count
    reach_otherwise: Count
    do_not_reach: Count


# No subclass of `StartCounts`: `z_mm` comes first in the card's JSON, of whose bytes the ETag is computed.
@schema
@dataclass(frozen=True)
class StartLayer:
    """The starts of one layer of the grid.

    Attributes:
        z_mm: Height of the centres of its cells.
        follow: Those that join the demonstration in the fewest moves and follow it.
        reach_otherwise: Those that reach the goal in another way.
        do_not_reach: Those that do not reach the goal.
    """

    z_mm: float
    follow: Count
    reach_otherwise: Count
    do_not_reach: Count


class StartShares(Given):
    """The numbers of starts as shares of all starts."""

    follow: Fraction
    reach_otherwise: Fraction
    do_not_reach: Fraction


@schema
@dataclass(frozen=True, kw_only=True)
class CardCoverage(StartCounts, Coverage):
    """The starts from which the goal is reached, out of `n_states`.

    Attributes:
        layers: From the lowest z up.
    """

    shares: StartShares
    layers: tuple[StartLayer, ...]
    in_words: str


class TipErrors(Given):
    """Mean tip errors in mm, as measured elsewhere and not on this arm."""

    calibrated: float
    not_calibrated: float


class CardLimits(Given):
    """The limits of the version: its certified domain, and the properties that were not checked."""

    certified_domain: str
    joint_limits: str
    tip_accuracy: str
    tip_error_mm: TipErrors
    not_checked: list[str]


class CardLink(Given):
    """One value of the lineage, and the way its digest is computed.

    Attributes:
        digest_of: The input of the digest, as canonical JSON; null if it is not JSON.
    """

    what: str
    sha256: Sha256
    how: str
    digest_of: Any


class RestingOnIt(Given):
    """The plans and playbacks made from the version."""

    plans: Count
    playbacks: Count
    feasible_playbacks: Count
    in_words: str


class CardLineage(Given):
    """The chain from the recording to the policy, and the plans and playbacks made from it."""

    chain: list[CardLink]
    rests_on_it: RestingOnIt
    verify: list[str]


class Citation(Given):
    """The citation of the version."""

    text: str
    bibtex: str


class CardHistory(Given):
    """The first signed checkpoint of the history that covers the version; its root proves the version.

    Attributes:
        origin: The name of the log.
        size: The number of its leaves.
        root: The root of their tree.
        note: The checkpoint as a C2SP signed note.
    """

    origin: str
    size: Count
    root: Sha256
    note: str


class PolicyCard(Given):
    """The policy card of one policy version, to attach to a paper; as `text/html` a document with its pictures.

    Research use only. It says whether the version is released now, so its ETag changes with that.

    Attributes:
        demonstrations: The oldest first.
        combined: How several demonstrations were combined into one path; null for one.
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
    suture_type: SutureType
    demonstrations: list[CardDemonstration]
    combined: CardCombined | None
    learner: CardLearner
    metrics: list[CardMetric]
    certificate: GridCertificate
    coverage: CardCoverage
    limits: CardLimits
    lineage: CardLineage
    citation: Citation
    history: CardHistory
