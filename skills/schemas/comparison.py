"""Atlases of suture types, nearest neighbours, and recognition of surgeons: answers."""

from pydantic import Field

from skills.fields import Count, Fraction, Sha256, Slug
from skills.schemas import Given

Thirds = list[tuple[float, float, float]]


class Place(Given):
    """A demonstration in an atlas: its surgeon, its cluster and its position on the chart.

    Attributes:
        cluster: Counted from 1.
        at: Its position on the chart, in `unit`.
    """

    id: Sha256
    surgeon: Slug
    session: str | None
    cluster: int = Field(ge=1)
    at: tuple[float, float]


class LeftOutOfAtlas(Given):
    """Active demonstrations of the suture type that are not compared.

    Attributes:
        without_consent: Number of those whose surgeon's consent does not cover an atlas.
        without_direction: Those that end where they began.
        overlapped: Cuts that share at least half of the shorter one's time with a newer cut of the recording.
        not_sampled: Of more demonstrations than an atlas shows, those not drawn.
    """

    without_consent: Count
    without_direction: list[Sha256]
    overlapped: list[Sha256]
    not_sampled: Count
    because: list[str]


class Merge(Given):
    """A merge in the dendrogram: a number below N is a demonstration, N + k is the result of the k-th merge.

    Attributes:
        distance: Between the two, averaged over their demonstrations, in `unit`.
    """

    one: Count
    other: Count
    distance: float
    demos: Count


class SurgeonCount(Given):
    """The number of a surgeon's demonstrations in a cluster."""

    surgeon: Slug
    demos: Count


class Cluster(Given):
    """A cluster of demonstrations.

    Attributes:
        cluster: Its number, from 1.
        medoid: The demonstration that is nearest to all others in the cluster.
        spread: Mean distance of the others to the medoid; null for a single one.
        surgeons: In decreasing order of `demos`.
    """

    cluster: int = Field(ge=1)
    demos: Count
    medoid: Sha256
    spread: float | None
    surgeons: list[SurgeonCount]


class Consistency(Given):
    """The similarity of a surgeon's demonstrations to each other.

    Attributes:
        recordings: That the demonstrations were cut from; cuts of one are not independent.
        spread: Mean distance of the others to the medoid; null for a single one.
        mean_share: Mean share of the demonstration that the starts of the served policy follow; null where none is
            served.
    """

    surgeon: Slug
    demos: Count
    recordings: Count
    sessions: Count
    medoid: Sha256
    spread: float | None
    mean_share: Fraction | None = None


class SurgeonDifference(Given):
    """The difference between the medoids of two surgeons, by thirds of the path and axes of a shape's own frame.

    Attributes:
        part: first third, middle third or last third: the part with the largest share of the distance.
        axis: along the way, sideways or upwards: the axis with the largest share.
        share: Of the distance, in this part along this axis.
        offset: Mean signed offset of `one` there, in `unit`: along, to the left or upwards.
        size: The same without signs: over twice the offset if the two paths cross.
    """

    one: Slug
    other: Slug
    distance: float
    part: str
    axis: str
    share: Fraction
    offset: float
    size: float
    sentence: str
    shares: Thirds
    offsets: Thirds


class CalibrationBin(Given):
    """One group of a calibration curve: tested demonstrations with similar probability of the guessed surgeon.

    Attributes:
        predicted: Mean probability of the guess.
        right: Share of right guesses: equal to `predicted` if the probabilities hold.
    """

    demos: Count
    predicted: Fraction
    right: Fraction


class Recognition(Given):
    """The accuracy of recognising the surgeon of one arm's demonstrations, measured on sessions that were left out.

    Attributes:
        arm: Demonstrations are only compared with those of the same arm.
        compared: Families of numbers that sessions left out of the fit chose: shape, tempo, jaw, turning, orientation.
            The place of the hand-off is not compared.
        tested: Number of demonstrations whose surgeon has another session.
        interval: Of the accuracy at 95 % (Wilson), if demonstrations were independent.
        log_loss: Mean of -log p of the true surgeon, in nat.
        sureness: Mean probability of the guesses: equal to the accuracy if the probabilities are right.
        curve: In increasing order of `predicted`.
        stranger_if_known: Mean probability of `none_of_these` where the surgeon is known.
        stranger_if_left_out: The same with the surgeon's demonstrations left out.
    """

    arm: str
    compared: list[str]
    surgeons: Count
    tested: Count
    right: Count
    accuracy: Fraction
    interval: tuple[float, float]
    chance: Fraction
    log_loss: float
    log_loss_of_guessing: float
    sureness: Fraction
    curve: list[CalibrationBin]
    stranger_if_known: Fraction
    stranger_if_left_out: Fraction


class Votes(Given):
    """The accuracy of the votes of recordings: all tested demonstrations of one recording, of all arms, together.

    Attributes:
        interval: Of the accuracy at 95 % (Wilson).
    """

    recordings: Count
    right: Count
    accuracy: Fraction
    interval: tuple[float, float]
    chance: Fraction


class Likely(Given):
    """A surgeon, and the probability that a demonstration is theirs."""

    surgeon: Slug
    probability: Fraction


class RecognisedDemo(Given):
    """The recognised surgeons of one demonstration.

    Attributes:
        surgeon: The surgeon that it was stored under.
        likely: In decreasing order of probability; they sum to 1 and hold if it is one of these surgeons.
        none_of_these: Probability that the recording is of another surgeon, if that is as likely as any one of these.
        voted: The surgeon for whom the recording's demonstrations of all arms vote; null if none was tested.
        voters: Their number.
    """

    demo: Sha256
    arm: str
    surgeon: Slug
    likely: list[Likely]
    none_of_these: Fraction
    voted: Slug | None
    voters: Count


class RecognisedRecording(Given):
    """The surgeon of a whole recording, recognised by the votes of all its movements.

    Attributes:
        surgeon: The surgeon that its demonstrations were stored under.
        voted: The surgeon for whom its movements vote. A vote has no probability.
        voters: Number of the movements that were tested, without the recording's session.
        votes: Of the recordings that it was compared with, and its own.
        recognition: Of single movements, by arm.
        no_recognition_because: For the arms without.
    """

    recording: Sha256
    suture: Slug
    surgeon: Slug
    voted: Slug
    voters: Count
    votes: Votes
    recognition: list[Recognition]
    no_recognition_because: str | None = None
    notes: list[str]


class Atlas(Given):
    """The demonstrations of a suture type, compared. Distances are in `unit`, about the mean difference per state.

    Attributes:
        unit: mm, or lengths of start to goal where size does not count.
        demos: The oldest first.
        recordings: That the demonstrations were cut from; cuts of one are not independent.
        distances: Those of demonstration k from the ones before it in `demos`, at index k.
        merges: The dendrogram, in increasing order of distance.
        order: Indices of the demonstrations, in an order in which no two merges cross.
        clusters_chosen: The rule by which their number was chosen.
        silhouette: The mean over the demonstrations, -1 to 1; null for a single cluster.
        chart_shows: 1 minus the mean error of distances on the chart, divided by the mean distance.
        differences: Of all pairs of the 40 surgeons with the most demonstrations.
        recognition: By arm; an arm without recognition is not listed.
        no_recognition_because: For the arms without; null if all have recognition.
        votes: null without recognition.
        recognised: Of the demonstration `demo` of the request; null without one, or without recognition.
        notes: Explanations of the numbers and their limits.
    """

    suture: Slug
    scaled: bool
    unit: str
    demos: list[Place]
    recordings: Count
    left_out: LeftOutOfAtlas
    distances: list[list[float]]
    merges: list[Merge]
    order: list[Count]
    clusters: list[Cluster]
    clusters_chosen: str
    silhouette: float | None
    chart_shows: float
    surgeons: list[Consistency]
    differences: list[SurgeonDifference]
    recognition: list[Recognition]
    no_recognition_because: str | None = None
    votes: Votes | None
    recognised: RecognisedDemo | None
    notes: list[str]


class Neighbour(Given):
    """A demonstration, and its distance from another.

    Attributes:
        distance: In `unit`, about the mean difference per state.
    """

    demo: Sha256
    surgeon: Slug
    session: str | None
    arm: str
    distance: float


class Nearest(Given):
    """The demonstrations of the same suture type that are nearest to one, among all of them and exactly.

    Attributes:
        unit: mm, or lengths of start to goal where size does not count.
        searched: Number of demonstrations that it was compared with.
        nearest: In increasing order of distance.
    """

    demo: Sha256
    suture: Slug
    scaled: bool
    unit: str
    searched: Count
    nearest: list[Neighbour]
    notes: list[str]
