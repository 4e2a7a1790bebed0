"""What an atlas says, as plain values that are named as a client reads them (`skills.api.schemas.atlas`)."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Place:
    """A demonstration in the atlas: whose, in which cluster, counted from 1, and where on the chart."""

    id: str
    surgeon: str
    session: str | None
    cluster: int
    at: tuple[float, float]


@dataclass(frozen=True)
class Merge:
    """Two that join: below N the number of a demonstration, N + k what the k-th merge made."""

    one: int
    other: int
    distance: float
    demos: int


@dataclass(frozen=True)
class OfSurgeon:
    """How many demonstrations of a cluster are a surgeon's."""

    surgeon: str
    demos: int


@dataclass(frozen=True)
class Cluster:
    """What belongs together; `spread` is the mean distance to the medoid of the others, None of one alone."""

    cluster: int
    demos: int
    medoid: str
    spread: float | None
    surgeons: list[OfSurgeon]


@dataclass(frozen=True)
class Consistency:
    """How alike a surgeon's demonstrations are: the mean distance to their medoid of the others; None of one alone."""

    surgeon: str
    demos: int
    sessions: int
    medoid: str
    spread: float | None


@dataclass(frozen=True)
class Apartness:
    """What sets two surgeons apart: their medoids, by thirds of the way and axes of a shape's own frame."""

    one: str
    other: str
    distance: float
    part: str
    axis: str
    share: float
    offset: float
    size: float
    said: str
    shares: list[list[float]]
    offsets: list[list[float]]


@dataclass(frozen=True)
class Recognition:
    """How well "whose style is this?" is answered about sessions that were left out."""

    surgeons: int
    tested: int
    right: int
    accuracy: float
    interval: tuple[float, float]
    chance: float
    log_loss: float
    log_loss_of_guessing: float
    sureness: float


@dataclass(frozen=True)
class Likely:
    """A surgeon, and how probable it is that a demonstration is theirs."""

    surgeon: str
    probability: float


@dataclass(frozen=True)
class Whose:
    """Whose style one demonstration is, the likeliest first; `surgeon` is whose it was stored as."""

    demo: str
    surgeon: str
    likely: list[Likely]


@dataclass(frozen=True)
class LeftOut:
    """What is active and not in the atlas: how many for want of consent, and which for want of a direction."""

    without_consent: int
    without_direction: list[str]
    because: list[str]


@dataclass(frozen=True)
class Atlas:
    """The whole of it; `distances` are those of each demonstration from those before it in `demos`."""

    suture: str
    scaled: bool
    unit: str
    demos: list[Place]
    left_out: LeftOut
    distances: list[list[float]]
    merges: list[Merge]
    order: list[int]
    clusters: list[Cluster]
    clusters_chosen: str
    silhouette: float | None
    chart_shows: float
    surgeons: list[Consistency]
    differences: list[Apartness]
    recognition: Recognition | None
    no_recognition_because: str | None
    whose: Whose | None
    notes: list[str]
