"""What is answered of an atlas: the demonstrations of a suture type, compared with each other."""

from typing import Any

from pydantic import ConfigDict, Field

from skills.api.schemas.shapes import Count, Given, Sha256, Share, Slug

IDS = ["1a" * 32, "2b" * 32, "3c" * 32, "4d" * 32]
EXAMPLE: dict[str, Any] = {
    "suture": "simple-running",
    "scaled": False,
    "unit": "mm",
    "demos": [
        {"id": IDS[0], "surgeon": "heron", "session": "monday", "cluster": 1, "at": [-3.1, 0.4]},
        {"id": IDS[1], "surgeon": "heron", "session": "friday", "cluster": 1, "at": [-2.7, -0.4]},
        {"id": IDS[2], "surgeon": "kestrel", "session": "monday", "cluster": 2, "at": [2.8, 0.5]},
        {"id": IDS[3], "surgeon": "kestrel", "session": "friday", "cluster": 2, "at": [3.0, -0.5]},
    ],
    "left_out": {"without_consent": 1, "without_direction": [], "because": ["Left out: 1 demonstration, ..."]},
    "distances": [[], [0.9], [6.0, 5.6], [6.2, 5.7, 1.0]],
    "merges": [
        {"one": 0, "other": 1, "distance": 0.9, "demos": 2},
        {"one": 2, "other": 3, "distance": 1.0, "demos": 2},
        {"one": 4, "other": 5, "distance": 5.875, "demos": 4},
    ],
    "order": [0, 1, 2, 3],
    "clusters": [
        {"cluster": 1, "demos": 2, "medoid": IDS[0], "spread": 0.9, "surgeons": [{"surgeon": "heron", "demos": 2}]},
        {"cluster": 2, "demos": 2, "medoid": IDS[2], "spread": 1.0, "surgeons": [{"surgeon": "kestrel", "demos": 2}]},
    ],
    "clusters_chosen": "as asked",
    "silhouette": 0.84,
    "chart_shows": 0.97,
    "surgeons": [
        {"surgeon": "heron", "demos": 2, "sessions": 2, "medoid": IDS[0], "spread": 0.9},
        {"surgeon": "kestrel", "demos": 2, "sessions": 2, "medoid": IDS[2], "spread": 1.0},
    ],
    "differences": [
        {
            "one": "heron",
            "other": "kestrel",
            "distance": 6.0,
            "part": "middle third",
            "axis": "upwards",
            "share": 0.5,
            "offset": -8.9,
            "size": 9.0,
            "said": "In the middle third, heron lies 8.9 mm lower than kestrel; ...",
            "shares": [[0.05, 0.05, 0.1], [0.05, 0.05, 0.5], [0.05, 0.05, 0.1]],
            "offsets": [[0.1, 0.1, -1.6], [0.2, 0.3, -8.9], [0.1, 0.1, -1.7]],
        }
    ],
    "recognition": {
        "surgeons": 2,
        "tested": 4,
        "right": 4,
        "accuracy": 1.0,
        "interval": [0.51, 1.0],
        "chance": 0.5,
        "log_loss": 0.02,
        "log_loss_of_guessing": 0.693,
        "sureness": 0.98,
    },
    "no_recognition_because": None,
    "whose": {
        "demo": IDS[3],
        "surgeon": "kestrel",
        "likely": [{"surgeon": "kestrel", "probability": 0.98}, {"surgeon": "heron", "probability": 0.02}],
    },
    "notes": ["A distance is ...", "Set-up and day go with the surgeon: ..."],
}

Thirds = list[tuple[float, float, float]]


class Place(Given):
    """A demonstration in an atlas."""

    id: Sha256
    surgeon: Slug
    session: str | None
    cluster: int = Field(ge=1)
    at: tuple[float, float] = Field(description="Its place on the chart, in `unit`.")


class LeftOut(Given):
    """Active demonstrations of the suture type that are not compared."""

    without_consent: Count = Field(description="Whose surgeon's consent does not cover an atlas.")
    without_direction: list[Sha256] = Field(description="That end where they began.")
    because: list[str]


class Merge(Given):
    """Two that join in the dendrogram: below N a demonstration, N + k what the k-th merge made."""

    one: Count
    other: Count
    distance: float = Field(description="On average over their demonstrations, in `unit`.")
    demos: Count


class OfSurgeon(Given):
    """How many demonstrations of a cluster are a surgeon's."""

    surgeon: Slug
    demos: Count


class Cluster(Given):
    """What belongs together."""

    cluster: int = Field(ge=1)
    demos: Count
    medoid: Sha256 = Field(description="The demonstration that is nearest to all others of it.")
    spread: float | None = Field(description="Mean distance to the medoid of the others; null of one alone.")
    surgeons: list[OfSurgeon] = Field(description="Who has most of it first.")


class Consistency(Given):
    """How alike a surgeon's demonstrations are."""

    surgeon: Slug
    demos: Count
    sessions: Count
    medoid: Sha256
    spread: float | None = Field(description="Mean distance to the medoid of the others; null of one alone.")


class Apartness(Given):
    """What sets two surgeons apart: their medoids, by thirds of the way and axes: along the way, sideways, upwards."""

    one: Slug
    other: Slug
    distance: float
    part: str = Field(description="first third, middle third or last third: where most of the distance is.")
    axis: str = Field(description="along the way, sideways or upwards.")
    share: Share = Field(description="Of the distance that is there.")
    offset: float = Field(description="By how much the one lies further there, in `unit`: along, to the left, upwards.")
    size: float = Field(description="The same without signs; twice the offset and more where they cross.")
    said: str
    shares: Thirds
    offsets: Thirds


class Recognition(Given):
    """How well "whose style is this?" is answered about sessions that were left out."""

    surgeons: Count
    tested: Count = Field(description="Demonstrations whose surgeon has another session.")
    right: Count
    accuracy: Share
    interval: tuple[float, float] = Field(description="Of the accuracy at 95 % (Wilson), if each stood for itself.")
    chance: Share
    log_loss: float = Field(description="Mean of -log p of the truth, in nat.")
    log_loss_of_guessing: float
    sureness: Share = Field(
        description="What it gives its guesses on average: the accuracy, where they are calibrated."
    )


class Likely(Given):
    """A surgeon, and how probable it is that a demonstration is theirs."""

    surgeon: Slug
    probability: Share


class Whose(Given):
    """Whose style one demonstration is."""

    demo: Sha256
    surgeon: Slug = Field(description="Whose it was stored as; that of its own session says nothing.")
    likely: list[Likely] = Field(description="The likeliest first.")


class Atlas(Given):
    """The demonstrations of a suture type, compared. Distances are in `unit`, and are about mm a place."""

    model_config = ConfigDict(json_schema_extra={"examples": [EXAMPLE]})

    suture: Slug
    scaled: bool
    unit: str = Field(description="mm, or lengths of start to goal where size does not count.")
    demos: list[Place] = Field(description="The oldest first.")
    left_out: LeftOut
    distances: list[list[float]] = Field(description="Of each demonstration from those before it.")
    merges: list[Merge] = Field(description="The dendrogram, the nearest first.")
    order: list[Count] = Field(description="The demonstrations side by side, so that no two merges cross.")
    clusters: list[Cluster]
    clusters_chosen: str = Field(description="How their number was chosen.")
    silhouette: float | None = Field(description="Mean, -1 to 1; null of one cluster.")
    chart_shows: float = Field(description="The share of the distances that is right on the chart.")
    surgeons: list[Consistency]
    differences: list[Apartness] = Field(description="Of all pairs of the 40 surgeons with most demonstrations.")
    recognition: Recognition | None
    no_recognition_because: str | None = None
    whose: Whose | None = Field(description="Of the `demo` that was asked about, where there is recognition.")
    notes: list[str] = Field(description="What this means, and what it does not.")
