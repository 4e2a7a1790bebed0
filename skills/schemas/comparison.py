"""Atlases of suture types, nearest neighbours, and recognition of surgeons: answers."""

from pydantic import Field

from skills.fields import Count, Fraction, Sha256, Slug
from skills.schemas import Given

Thirds = list[tuple[float, float, float]]


class Place(Given):
    """A demonstration in an atlas: its surgeon, its cluster and its position on the chart."""

    id: Sha256
    surgeon: Slug
    session: str | None
    cluster: int = Field(ge=1, description="Counted from 1.")
    at: tuple[float, float] = Field(description="Its position on the chart, in `unit`.")


class LeftOutOfAtlas(Given):
    """Active demonstrations of the suture type that are not compared."""

    without_consent: Count = Field(description="Number of those whose surgeon's consent does not cover an atlas.")
    without_direction: list[Sha256] = Field(description="Those that end where they began.")
    overlapped: list[Sha256] = Field(
        description="Cuts that share at least half of the shorter one's time with a newer cut of the recording."
    )
    not_sampled: Count = Field(description="Of more demonstrations than an atlas shows, those not drawn.")
    because: list[str]


class Merge(Given):
    """A merge in the dendrogram: a number below N is a demonstration, N + k is the result of the k-th merge."""

    one: Count
    other: Count
    distance: float = Field(description="Between the two, averaged over their demonstrations, in `unit`.")
    demos: Count


class SurgeonCount(Given):
    """The number of a surgeon's demonstrations in a cluster."""

    surgeon: Slug
    demos: Count


class Cluster(Given):
    """A cluster of demonstrations."""

    cluster: int = Field(ge=1, description="Its number, from 1.")
    demos: Count
    medoid: Sha256 = Field(description="The demonstration that is nearest to all others in the cluster.")
    spread: float | None = Field(description="Mean distance of the others to the medoid; null for a single one.")
    surgeons: list[SurgeonCount] = Field(description="In decreasing order of `demos`.")


class Consistency(Given):
    """The similarity of a surgeon's demonstrations to each other."""

    surgeon: Slug
    demos: Count
    recordings: Count = Field(description="That the demonstrations were cut from; cuts of one are not independent.")
    sessions: Count
    medoid: Sha256
    spread: float | None = Field(description="Mean distance of the others to the medoid; null for a single one.")
    mean_share: Fraction | None = Field(
        default=None,
        description="Mean share of the demonstration that the starts of the served policy follow; null where none is "
        "served.",
    )


class SurgeonDifference(Given):
    """The difference between the medoids of two surgeons, by thirds of the path and axes of a shape's own frame."""

    one: Slug
    other: Slug
    distance: float
    part: str = Field(
        description="first third, middle third or last third: the part with the largest share of the distance."
    )
    axis: str = Field(description="along the way, sideways or upwards: the axis with the largest share.")
    share: Fraction = Field(description="Of the distance, in this part along this axis.")
    offset: float = Field(description="Mean signed offset of `one` there, in `unit`: along, to the left or upwards.")
    size: float = Field(description="The same without signs: over twice the offset if the two paths cross.")
    sentence: str
    shares: Thirds
    offsets: Thirds


class CalibrationBin(Given):
    """One group of a calibration curve: tested demonstrations with similar probability of the guessed surgeon."""

    demos: Count
    predicted: Fraction = Field(description="Mean probability of the guess.")
    right: Fraction = Field(description="Share of right guesses: equal to `predicted` if the probabilities hold.")


class Recognition(Given):
    """The accuracy of recognising the surgeon of one arm's demonstrations, measured on sessions that were left out."""

    arm: str = Field(description="Demonstrations are only compared with those of the same arm.")
    compared: list[str] = Field(
        description="Families of numbers that sessions left out of the fit chose: shape, tempo, jaw, turning, "
        "orientation. The place of the hand-off is not compared."
    )
    surgeons: Count
    tested: Count = Field(description="Number of demonstrations whose surgeon has another session.")
    right: Count
    accuracy: Fraction
    interval: tuple[float, float] = Field(
        description="Of the accuracy at 95 % (Wilson), if demonstrations were independent."
    )
    chance: Fraction
    log_loss: float = Field(description="Mean of -log p of the true surgeon, in nat.")
    log_loss_of_guessing: float
    sureness: Fraction = Field(
        description="Mean probability of the guesses: equal to the accuracy if the probabilities are right."
    )
    curve: list[CalibrationBin] = Field(description="In increasing order of `predicted`.")
    stranger_if_known: Fraction = Field(description="Mean probability of `none_of_these` where the surgeon is known.")
    stranger_if_left_out: Fraction = Field(description="The same with the surgeon's demonstrations left out.")


class Votes(Given):
    """The accuracy of the votes of recordings: all tested demonstrations of one recording, of all arms, together."""

    recordings: Count
    right: Count
    accuracy: Fraction
    interval: tuple[float, float] = Field(description="Of the accuracy at 95 % (Wilson).")
    chance: Fraction


class Likely(Given):
    """A surgeon, and the probability that a demonstration is theirs."""

    surgeon: Slug
    probability: Fraction


class RecognisedDemo(Given):
    """The recognised surgeons of one demonstration."""

    demo: Sha256
    arm: str
    surgeon: Slug = Field(description="The surgeon that it was stored under.")
    likely: list[Likely] = Field(
        description="In decreasing order of probability; they sum to 1 and hold if it is one of these surgeons."
    )
    none_of_these: Fraction = Field(
        description="Probability that the recording is of another surgeon, if that is as likely as any one of these."
    )
    voted: Slug | None = Field(
        description="The surgeon for whom the recording's demonstrations of all arms vote; null if none was tested."
    )
    voters: Count = Field(description="Their number.")


class RecognisedRecording(Given):
    """The surgeon of a whole recording, recognised by the votes of all its movements."""

    recording: Sha256
    suture: Slug
    surgeon: Slug = Field(description="The surgeon that its demonstrations were stored under.")
    voted: Slug = Field(description="The surgeon for whom its movements vote. A vote has no probability.")
    voters: Count = Field(description="Number of the movements that were tested, without the recording's session.")
    votes: Votes = Field(description="Of the recordings that it was compared with, and its own.")
    recognition: list[Recognition] = Field(description="Of single movements, by arm.")
    no_recognition_because: str | None = Field(default=None, description="For the arms without.")
    notes: list[str]


class Atlas(Given):
    """The demonstrations of a suture type, compared. Distances are in `unit`, about the mean difference per state."""

    suture: Slug
    scaled: bool
    unit: str = Field(description="mm, or lengths of start to goal where size does not count.")
    demos: list[Place] = Field(description="The oldest first.")
    recordings: Count = Field(description="That the demonstrations were cut from; cuts of one are not independent.")
    left_out: LeftOutOfAtlas
    distances: list[list[float]] = Field(
        description="Those of demonstration k from the ones before it in `demos`, at index k."
    )
    merges: list[Merge] = Field(description="The dendrogram, in increasing order of distance.")
    order: list[Count] = Field(description="Indices of the demonstrations, in an order in which no two merges cross.")
    clusters: list[Cluster]
    clusters_chosen: str = Field(description="The rule by which their number was chosen.")
    silhouette: float | None = Field(
        description="The mean over the demonstrations, -1 to 1; null for a single cluster."
    )
    chart_shows: float = Field(
        description="1 minus the mean error of distances on the chart, divided by the mean distance."
    )
    surgeons: list[Consistency]
    differences: list[SurgeonDifference] = Field(
        description="Of all pairs of the 40 surgeons with the most demonstrations."
    )
    recognition: list[Recognition] = Field(description="By arm; an arm without recognition is not listed.")
    no_recognition_because: str | None = Field(
        default=None, description="For the arms without; null if all have recognition."
    )
    votes: Votes | None = Field(description="null without recognition.")
    recognised: RecognisedDemo | None = Field(
        description="Of the demonstration `demo` of the request; null without one, or without recognition."
    )
    notes: list[str] = Field(description="Explanations of the numbers and their limits.")


class Neighbour(Given):
    """A demonstration, and its distance from another."""

    demo: Sha256
    surgeon: Slug
    session: str | None
    arm: str
    distance: float = Field(description="In `unit`, about the mean difference per state.")


class Nearest(Given):
    """The demonstrations of the same suture type that are nearest to one, among all of them and exactly."""

    demo: Sha256
    suture: Slug
    scaled: bool
    unit: str = Field(description="mm, or lengths of start to goal where size does not count.")
    searched: Count = Field(description="Number of demonstrations that it was compared with.")
    nearest: list[Neighbour] = Field(description="In increasing order of distance.")
    notes: list[str]
