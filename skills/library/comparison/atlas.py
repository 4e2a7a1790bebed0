"""The atlas of a suture type: distances, clusters and recognition of its demonstrations.

    Database --atlas_of--> Atlas

An atlas compares all active demonstrations of the suture type whose surgeon's consent covers it; of more than `MOST`, a
sample. Of overlapping cuts of one motion the newest counts. It uses distances in mm, or scaled ones.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from skills.arrays import Floats, Ints
from skills.comparison import distances
from skills.db.models import Demonstration, SutureType
from skills.db.session import Database
from skills.errors import BadPath, Conflict, NotFound
from skills.fields import percent
from skills.library.comparison.measuring import far_apart
from skills.library.comparison.members import Member, comparable_demo, members_of, sessions_of, without_overlaps
from skills.library.comparison.recognition import Recognised, recognise_arms, recognise_demo, recognitions, votes
from skills.library.people.suture_types import find_suture_type
from skills.library.policies.releases import shares_served
from skills.schemas import comparison as described

MOST = 2000  # demonstrations shown: a minute of measuring on two cores, once, and a response of 16 MB
MOST_COMPARED = 40  # surgeons; all pairs of them are compared, in half a second
DIGITS = 4  # of the rounded results: a tenth of a micrometre, far below the resolution of a recorder
UNITS = {False: "mm", True: "lengths of start to goal"}

AS_ASKED = "as asked"
BY_SILHOUETTE = f"that with the best mean silhouette, and one where even that is below {distances.WORTH:g}"

OVERLAPPED = (
    "A newer cut of the same motion counts: it shares at least half of the shorter one's time, in the same recording."
)
NO_DIRECTION = (
    f"It ends within {distances.LEAST_MM:g} mm of where it began, so it has no direction and cannot be compared."
)
DISTANCE = (
    f"A distance is the total of dynamic time warping (Manhattan) of two shapes of {distances.STATES} states, divided "
    f"by {distances.STATES}: about the mean difference of two motions at one place. All shapes have the same start and "
    "direction."
)
CONFOUNDED = (
    "Set-up and day are confounded with the surgeon: a surgeon may be recognised by the room, the arm's position "
    "or the day's task instead of the style. Therefore a demonstration is only compared with those of other "
    "sessions, and even then a surgeon who always works in the same set-up cannot be distinguished from it."
)
SESSIONS = (
    "Demonstrations with the same session name, and cuts of one recording, count as recorded together, by any "
    "surgeon; each recording without a session name counts as a session. Cuts of one recording are not "
    "independent."
)


def atlas_of(
    database: Database, suture: str, *, scaled: bool = False, clusters: int | None = None, demo: str | None = None
) -> described.Atlas:
    """Compare all demonstrations of a suture type.

    Args:
        database: The database, restricted to the rows that the caller may see.
        suture: The suture type.
        scaled: Scale all shapes so that start and goal coincide; sizes are then ignored.
        clusters: The number of clusters; None: as many as `skills.comparison.distances` finds.
        demo: The digest of a demonstration in the atlas whose surgeon is to be recognised.

    Raises:
        NotFound: There is no such suture type, or nothing to compare, or no such demonstration in the atlas.
        Conflict: The demonstration was withdrawn, consent does not cover it, or a newer cut overlaps it.
        BadInput: More clusters are requested than there are demonstrations.
        BadPath: The demonstration `demo` has no direction.
    """
    found = _found(database, suture, demo)
    chosen = found.members
    # Measuring may take a minute, outside any transaction; repeat until no member was withdrawn during it.
    while True:
        apart = far_apart(database, [one.row for one in chosen])
        found = _found(database, suture, demo)
        if {*chosen} <= {*found.members}:  # demonstrations added since are left to the next atlas
            break
        chosen = [one for one in chosen if one in found.members]
    there = {*apart.rows.tolist()}
    members = [one for one in chosen if one.row in there]
    without_direction = [one.sha256 for one in chosen if one.row not in there]
    if found.asked in without_direction:
        raise BadPath(f"{NO_DIRECTION} Cut the hand-off from its start to the point where the needle is taken.")
    left_out = _left_out(found, without_direction)
    if not members:
        raise NotFound(" ".join([f"There is no demonstration of '{suture}' to compare.", *left_out.because]))
    if scaled:
        shapes, far = np.array([distances.in_lengths(shape) for shape in apart.shapes_mm]), apart.apart_scaled
    else:
        shapes, far = apart.shapes_mm, apart.apart_mm
    compared = _Compared(members, shapes, far / distances.STATES, scaled, found.shares)
    return _atlas(suture, compared, recognise_arms(members, apart.signatures), left_out, clusters, found.asked)


@dataclass(frozen=True)
class _Found:
    """The members of an atlas, what is left out of it, and the digest of the demonstration to be recognised."""

    members: list[Member]
    without_consent: int
    overlapped: list[Member]
    not_sampled: int
    asked: str | None
    shares: dict[str, float]  # of the demonstration that a start of the served policy follows, by surgeon


def _found(database: Database, suture: str, demo: str | None) -> _Found:
    """List the members of an atlas and what is left out, and check the requested demonstration.

    Of more than `MOST`, those with the smallest digests are a random sample that hardly changes as others are added.
    """
    with database.reading() as session:
        agreed, without_consent = members_of(session, find_suture_type(session, suture).slug)
        asked = None if demo is None else _asked(session, demo, suture)
        shares = shares_served(session, suture)
    members, overlapped = without_overlaps(agreed)
    if asked in {one.sha256 for one in overlapped}:
        raise Conflict(f"{OVERLAPPED} Request a newer cut of the recording, or withdraw that one.")
    sample = {one.row for one in sorted(members, key=lambda one: (one.sha256 != asked, one.sha256))[:MOST]}
    sampled = [one for one in members if one.row in sample]
    return _Found(sampled, without_consent, overlapped, len(members) - len(sampled), asked, shares)


def atlases(session: Session) -> list[tuple[SutureType, int, int]]:
    """List the suture types with active demonstrations: the type, and the numbers of demonstrations and surgeons."""
    of = Demonstration
    counted = select(of.suture, func.count(), func.count(of.surgeon_row.distinct())).where(of.withdrawn_at.is_(None))
    found = session.execute(counted.group_by(of.suture).order_by(of.suture)).all()
    return [(find_suture_type(session, suture), demos, surgeons) for suture, demos, surgeons in found]


def _asked(session: Session, demo: str, suture: str) -> str:
    """Return the digest of the demonstration to be recognised; refuse one that is not in this atlas."""
    found = comparable_demo(session, demo)
    if found.suture != suture:
        raise NotFound(f"This demonstration is of '{found.suture}'; request that atlas.")
    return found.sha256


def _left_out(found: _Found, without_direction: list[str]) -> described.LeftOutOfAtlas:
    sampled = (
        f". An atlas shows {MOST} at the most, drawn at random by their digests; the nearest neighbours of a "
        "demonstration are searched among all."
    )
    reasons = (
        (found.without_consent, ", because the surgeon's consent does not cover an atlas."),
        (len(without_direction), f". {NO_DIRECTION}"),
        (len(found.overlapped), f". {OVERLAPPED}"),
        (found.not_sampled, sampled),
    )
    return described.LeftOutOfAtlas(
        without_consent=found.without_consent,
        without_direction=without_direction,
        overlapped=[one.sha256 for one in found.overlapped],
        not_sampled=found.not_sampled,
        because=[f"Left out: {_count(demos)}{why}" for demos, why in reasons if demos],
    )


def _count(demos: int) -> str:
    return f"{demos} demonstration{'' if demos == 1 else 's'}"


@dataclass(frozen=True, eq=False)
class _Compared:
    """Members with the distances between all of them, and the surgeon and session of each as numbers."""

    members: Sequence[Member]
    shapes: Floats
    far: Floats
    scaled: bool
    shares: Mapping[str, float]

    @cached_property
    def surgeons(self) -> list[str]:
        """The surgeons, sorted."""
        return sorted({one.surgeon for one in self.members})

    @cached_property
    def surgeon_of(self) -> Ints:
        """The surgeon of each as a number."""
        return np.searchsorted(self.surgeons, [one.surgeon for one in self.members])

    @cached_property
    def sessions(self) -> Ints:
        """The session of each as a number."""
        return sessions_of(self.members)

    def of(self, surgeon: int) -> Ints:
        """Return the indices of a surgeon's demonstrations."""
        return np.flatnonzero(self.surgeon_of == surgeon)

    def name(self, one: int) -> str:
        """Return the digest of a demonstration."""
        return self.members[one].sha256


def _atlas(
    suture: str,
    compared: _Compared,
    recognised: Recognised,
    left_out: described.LeftOutOfAtlas,
    clusters: int | None,
    asked: str | None,
) -> described.Atlas:
    far, members = compared.far, compared.members
    tree = distances.dendrogram(far)
    number = clusters or distances.how_many(far, tree)
    in_cluster = tree.cut(number)
    places, shows = distances.chart(far)
    of_asked = next((one for one in members if one.sha256 == asked), None)
    return described.Atlas(
        suture=suture,
        scaled=compared.scaled,
        unit=UNITS[compared.scaled],
        demos=[
            described.Place(id=one.sha256, surgeon=one.surgeon, session=one.session, cluster=cluster + 1, at=at)
            for one, cluster, at in zip(members, in_cluster.tolist(), places.round(DIGITS).tolist(), strict=True)
        ],
        recordings=len({one.recording_row for one in members}),
        left_out=left_out,
        distances=[far[at, :at].round(DIGITS).tolist() for at in range(len(members))],
        merges=_merges(tree),
        order=tree.order.tolist(),
        clusters=[_cluster(compared, one, np.flatnonzero(in_cluster == one)) for one in range(number)],
        clusters_chosen=AS_ASKED if clusters else BY_SILHOUETTE,
        silhouette=round(distances.silhouette(far, in_cluster), DIGITS) if number > 1 else None,
        chart_shows=round(shows, DIGITS),
        surgeons=[_consistency(compared, one) for one in range(len(compared.surgeons))],
        differences=_differences(compared),
        recognition=recognitions(recognised),
        no_recognition_because=" ".join(recognised.because) or None,
        votes=votes(recognised),
        recognised=None if of_asked is None else recognise_demo(recognised, of_asked),
        notes=[DISTANCE, CONFOUNDED, SESSIONS, *left_out.because],
    )


def _merges(tree: distances.Dendrogram) -> list[described.Merge]:
    sizes = [1] * len(tree.order)
    merges = []
    for (one, other), height in zip(tree.joined.tolist(), tree.heights.round(DIGITS).tolist(), strict=True):
        sizes.append(sizes[one] + sizes[other])
        merges.append(described.Merge(one=one, other=other, distance=height, demos=sizes[-1]))
    return merges


def _cluster(compared: _Compared, cluster: int, members: Ints) -> described.Cluster:
    counts = Counter(compared.members[one].surgeon for one in members.tolist())
    return described.Cluster(
        cluster=cluster + 1,
        demos=len(members),
        medoid=compared.name(distances.medoid(compared.far, members)),
        spread=_spread(compared.far, members),
        surgeons=[described.SurgeonCount(surgeon=surgeon, demos=demos) for surgeon, demos in counts.most_common()],
    )


def _consistency(compared: _Compared, surgeon: int) -> described.Consistency:
    mine = compared.of(surgeon)
    share = compared.shares.get(compared.surgeons[surgeon])
    return described.Consistency(
        surgeon=compared.surgeons[surgeon],
        demos=len(mine),
        recordings=len({compared.members[one].recording_row for one in mine.tolist()}),
        sessions=len(np.unique(compared.sessions[mine])),
        medoid=compared.name(distances.medoid(compared.far, mine)),
        spread=_spread(compared.far, mine),
        mean_share=None if share is None else round(share, DIGITS),
    )


def _spread(far: Floats, members: Ints) -> float | None:
    return round(distances.spread(far, members), DIGITS) if len(members) > 1 else None


def _differences(compared: _Compared) -> list[described.SurgeonDifference]:
    """Compare the surgeons with the most demonstrations, pair by pair."""
    counts = np.bincount(compared.surgeon_of)
    most = sorted(np.argsort(-counts, kind="stable")[:MOST_COMPARED].tolist())
    medoids = {one: distances.medoid(compared.far, compared.of(one)) for one in most}
    return [_apart(compared, one, other, medoids[one], medoids[other]) for one, other in combinations(most, 2)]


def _apart(compared: _Compared, one: int, other: int, of_one: int, of_other: int) -> described.SurgeonDifference:
    found = distances.difference(compared.shapes[of_one], compared.shapes[of_other])
    names = compared.surgeons[one], compared.surgeons[other]
    (part, axis), (share, net, size) = found.where, found.most
    distance = round(found.total / distances.STATES, DIGITS)
    return described.SurgeonDifference(
        one=names[0],
        other=names[1],
        distance=distance,
        part=part,
        axis=axis,
        share=round(share, DIGITS),
        offset=round(net, DIGITS),
        size=round(size, DIGITS),
        sentence=_sentence(found, names, compared.scaled)
        if distance > 0
        else f"There is no difference between {names[0]} and {names[1]}.",
        shares=found.shares.round(DIGITS).tolist(),
        offsets=found.nets.round(DIGITS).tolist(),
    )


def _sentence(found: distances.Difference, names: tuple[str, str], scaled: bool) -> str:
    """Return the sentence on the part of the path and the axis with the largest difference."""
    (part, axis), (share, net, size) = found.where, found.most
    there = f"{percent(share)}% of their difference is there, {axis}."
    if found.direction is None:
        by = _length(size, scaled)
        return f"In the {part}, the paths of {names[0]} and {names[1]} are {by} apart, in both directions; {there}"
    return (
        f"In the {part}, the path of {names[0]} is {_length(abs(net), scaled)} {found.direction} than that of "
        f"{names[1]}; {there}"
    )


def _length(length: float, scaled: bool) -> str:
    return f"{100 * length:.1f} % of the length" if scaled else f"{length:.1f} mm"
