"""The atlas of a suture type: distances, clusters and recognition of its demonstrations.

    Database --atlas_of--> Atlas

An atlas compares all active demonstrations of the suture type whose surgeon's consent covers it; of more than `MOST`, a
sample. Of overlapping cuts of one motion the newest counts.

A pair is measured at the first request that contains both demonstrations, so a new demonstration costs one row of
distances. The results are stored in one row for each demonstration (`MeasuredShape`), in short transactions during the
measuring, so that an interruption loses little work. Both kinds of distances are stored, in mm and scaled: an atlas
uses one or the other.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, delete, func, insert, select
from sqlalchemy.orm import Session

from skills.arrays import Floats, Ints
from skills.comparison.distances import (
    LEAST_MM,
    STATES,
    VERSION,
    WORTH,
    Dendrogram,
    Difference,
    Measured,
    chart,
    dendrogram,
    difference,
    distances_of,
    how_many,
    in_lengths,
    medoid,
    shape_of,
    silhouette,
    spread,
)
from skills.comparison.recognition import NUMBERS, signature_of
from skills.db import in_parts
from skills.db.models import Demonstration, MeasuredShape, SutureType
from skills.db.packed import pack
from skills.db.row_visibility import ALL_ROWS
from skills.db.session import Database
from skills.demonstration.demonstration import Demo
from skills.errors import BadPath, Busy, Conflict, NotFound
from skills.library.comparison.members import Member, members_of, sessions_of, without_overlaps
from skills.library.comparison.recognition import recognise_arms, recognitions, votes, whose
from skills.library.operation import locks
from skills.library.people.catalogue import find_suture_type
from skills.library.people.consent import require
from skills.library.policies.releases import shares_served
from skills.library.recordings.demos import find_demo
from skills.schemas.comparison import Apartness, Atlas, Cluster, Consistency, LeftOutOfAtlas, Merge, OfSurgeon, Place

DEMOS_AT_ONCE = 100  # recorded motions in memory; each has some thousand samples
PAIRS_AT_ONCE = 20_000  # measured between two transactions: about a second
PATIENCE_S = 30.0  # timeout of the wait for another thread's measuring; 1000 demonstrations take about as long

_measuring = Lock()  # two requests at once would measure the same pairs twice

Kept = dict[int, Measured]  # by the demonstration's row
MOST = 2000  # demonstrations shown: a minute of measuring on two cores, once, and a response of 16 MB
MOST_COMPARED = 40  # surgeons; all pairs of them are compared, in half a second
DIGITS = 4  # of the rounded results: a tenth of a micrometre, far below the resolution of a recorder
UNITS = {False: "mm", True: "lengths of start to goal"}

AS_ASKED = "as asked"
BY_SILHOUETTE = f"that with the best mean silhouette, and one where even that is below {WORTH:g}"

OVERLAPPED = (
    "A newer cut of the same motion counts: it shares at least half of the shorter one's time, in the same recording."
)
NO_DIRECTION = f"It ends within {LEAST_MM:g} mm of where it began, so it has no direction and cannot be compared."
DISTANCE = (
    f"A distance is the total of dynamic time warping (Manhattan) of two shapes of {STATES} states, divided by "
    f"{STATES}: about the mean difference of two motions at one place. All shapes have the same start and "
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


@dataclass(frozen=True, eq=False)
class Apart:
    """Shapes, and the distances between all of them.

    Attributes:
        rows: Rows of the demonstrations that have a shape, increasing, shape (N,).
        shapes_mm: Shape (N, STATES, 3).
        apart_mm: DTW totals in mm, shape (N, N); NaN for pairs that were not measured yet.
        apart_scaled: The same for scaled shapes, in lengths of start to goal.
        signatures: Shape (N, NUMBERS).
    """

    rows: Ints
    shapes_mm: Floats
    apart_mm: Floats
    apart_scaled: Floats
    signatures: Floats


def far_apart(database: Database, rows: Sequence[int]) -> Apart:
    """Return the distances between demonstrations, given by their rows; those without a direction are left out.

    Missing distances are measured and stored.

    Raises:
        Busy: Another thread has been measuring for more than `PATIENCE_S`.
    """
    wanted = sorted({*rows})
    kept = kept_shapes(database, wanted)
    apart = _laid_out(kept)
    if len(kept) == len(wanted) and not np.isnan(apart.apart_mm).any():
        return apart
    with _one_at_a_time():
        known = apart.rows[~np.isnan(apart.apart_mm).any(axis=1)]
        kept |= kept_shapes(database, sorted({*wanted} - {*known.tolist()}))  # measured by another thread
        new = shapes_of(database, [row for row in wanted if row not in kept])
        keep_shapes(database, new)
        kept |= new
        for measured in _measure(kept):
            keep_shapes(database, measured)
            kept |= measured
    return _laid_out(kept)


@contextmanager
def _one_at_a_time() -> Iterator[None]:
    if not _measuring.acquire(timeout=PATIENCE_S):
        raise Busy("The distances between demonstrations are being measured; request them again in a moment.")
    try:
        yield
    finally:
        _measuring.release()


# ---- measuring ---------------------------------------------------------------------------------------------------


def shapes_of(database: Database, rows: Sequence[int]) -> Kept:
    """Compute the shapes of recorded demonstrations, `DEMOS_AT_ONCE` at a time."""
    made: Kept = {}
    for at in range(0, len(rows), DEMOS_AT_ONCE):
        some = Demonstration.row.in_(rows[at : at + DEMOS_AT_ONCE])
        with database.reading() as session:
            recorded = session.execute(select(Demonstration.row, Demonstration.demo).where(some)).all()
        made |= {row: Measured(_shape(demo), *_NOTHING, signature_of(demo)) for row, demo in recorded}
    return made


def _shape(demo: Demo) -> Floats | None:
    try:
        return shape_of(demo)
    except BadPath:  # it has no direction; the atlas lists it as left out
        return None


_NOTHING = np.empty(0, np.int64), np.empty(0), np.empty(0)


def _measure(kept: Mapping[int, Measured]) -> Iterator[Kept]:
    """Measure the missing distances; yield the rows that have grown after every block of pairs."""
    apart = _laid_out(kept)
    scaled = np.array([in_lengths(shape) for shape in apart.shapes_mm]).reshape(apart.shapes_mm.shape)
    for block in _blocks(np.isnan(apart.apart_mm)):
        pairs = np.array([(one, other) for one, others in block for other in others.tolist()])
        totals = np.stack([distances_of(apart.shapes_mm, pairs), distances_of(scaled, pairs)])
        parts = np.split(totals, np.cumsum([len(others) for _, others in block])[:-1], axis=1)
        grown: Kept = {}
        for (one, others), (mm, lengths) in zip(block, parts, strict=True):
            row = int(apart.rows[one])
            known = kept[row]
            grown[row] = Measured(
                known.shape_mm,
                np.append(known.others, apart.rows[others]),
                np.append(known.apart_mm, mm),
                np.append(known.apart_scaled, lengths),
                known.signature,
            )
        yield grown


def _blocks(missing: NDArray[np.bool_]) -> Iterator[list[tuple[int, Ints]]]:
    """Divide the missing pairs, (N, N), among rows, the row with most missing pairs first.

    Each pair is measured in one row only. So a new demonstration takes all its pairs into its own row, and the stored
    rows of the others need not be written again.
    """
    missing = missing.copy()
    counts = missing.sum(axis=1)
    block: list[tuple[int, Ints]] = []
    pairs = 0
    while counts.any():
        one = int(counts.argmax())
        others = np.flatnonzero(missing[one])
        missing[one], missing[:, one] = False, False
        counts[others] -= 1
        counts[one] = 0
        block.append((one, others))
        pairs += len(others)
        if pairs >= PAIRS_AT_ONCE:
            yield block
            block, pairs = [], 0
    if block:
        yield block


def _laid_out(kept: Mapping[int, Measured]) -> Apart:
    """Return the known distances as full matrices."""
    shapes = {row: kept[row].shape_mm for row in sorted(kept)}
    rows = np.array([row for row, shape in shapes.items() if shape is not None], np.int64)
    apart_mm, apart_scaled = (np.full((len(rows), len(rows)), np.nan) for _ in range(2))
    for at, row in enumerate(rows.tolist()):
        known = kept[row]
        places = np.searchsorted(rows, known.others).clip(max=len(rows) - 1)
        there = rows[places] == known.others
        for matrix, totals in ((apart_mm, known.apart_mm), (apart_scaled, known.apart_scaled)):
            matrix[at, at] = 0.0
            matrix[at, places[there]] = matrix[places[there], at] = totals[there]
    whole = np.array([shape for shape in shapes.values() if shape is not None])
    signatures = np.array([kept[row].signature for row in rows.tolist()]).reshape(-1, NUMBERS)
    return Apart(rows, whole, apart_mm, apart_scaled, signatures)


# ---- storage -----------------------------------------------------------------------------------------------------


def is_current() -> ColumnElement[bool]:
    """Return the condition of the stored rows of this version: of shapes alone, and of shapes with distances."""
    return MeasuredShape.version.in_((VERSION, -VERSION))


def kept_shapes(database: Database, rows: Sequence[int]) -> Kept:
    """Return the stored measurements of demonstrations, given by their rows, of those that have any."""
    query = select(MeasuredShape.demonstration_row, MeasuredShape.measured)
    mine = is_current(), MeasuredShape.demonstration_row.in_(rows)
    with database.reading() as session:
        return {row: measured for row, measured in session.execute(query.where(*mine)).all()}  # noqa: C416 - mypy


def keep_shapes(database: Database, measured: Mapping[int, Measured]) -> None:
    """Replace the stored rows of some demonstrations by new measurements.

    Nothing is stored if a demonstration in a row, on either side of a distance, was erased since: its distance would
    remain.
    """
    packed = [
        {"demonstration_row": row, "version": VERSION if len(one.others) else -VERSION, "measured": pack(one)}
        for row, one in measured.items()
    ]  # packed before the transaction, which others wait for
    if not packed:
        return
    named = sorted({*measured}.union(*(one.others.tolist() for one in measured.values())))
    with database.writing([locks.DISTANCES]) as session:
        for some in in_parts(named):  # also of surgeons that this caller may not see
            there = select(func.count()).select_from(Demonstration).where(Demonstration.row.in_(some))
            if session.scalar(there, execution_options=ALL_ROWS) != len(some):
                return
        session.execute(delete(MeasuredShape).where(MeasuredShape.demonstration_row.in_(measured)))
        session.execute(insert(MeasuredShape), packed)


# ---- the atlas -----------------------------------------------------------------------------------------------------


def atlas_of(
    database: Database, suture: str, *, scaled: bool = False, clusters: int | None = None, demo: str | None = None
) -> Atlas:
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
        shapes, far = np.array([in_lengths(shape) for shape in apart.shapes_mm]), apart.apart_scaled
    else:
        shapes, far = apart.shapes_mm, apart.apart_mm
    compared = _compare(members, shapes, far / STATES, scaled, apart.signatures, found.shares)
    return _told(suture, compared, left_out, clusters, found.asked)


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
    found = find_demo(session, demo)
    if found.suture != suture:
        raise NotFound(f"This demonstration is of '{found.suture}'; request that atlas.")
    if found.withdrawn_at is not None:
        raise Conflict("This demonstration was withdrawn, so it is not in the atlas.")
    require(found.surgeon, "atlas")
    return found.sha256


def _left_out(found: _Found, without_direction: list[str]) -> LeftOutOfAtlas:
    said = []
    if found.without_consent:
        said.append(
            f"Left out: {_count(found.without_consent)}, because the surgeon's consent does not cover an atlas."
        )
    if without_direction:
        said.append(f"Left out: {_count(len(without_direction))}. {NO_DIRECTION}")
    if found.overlapped:
        said.append(f"Left out: {_count(len(found.overlapped))}. {OVERLAPPED}")
    if found.not_sampled:
        said.append(
            f"Left out: {_count(found.not_sampled)}. An atlas shows {MOST} at the most, drawn at random by their "
            "digests; the nearest neighbours of a demonstration are searched among all."
        )
    return LeftOutOfAtlas(
        without_consent=found.without_consent,
        without_direction=without_direction,
        overlapped=[one.sha256 for one in found.overlapped],
        not_sampled=found.not_sampled,
        because=said,
    )


def _count(demos: int) -> str:
    return f"{demos} demonstration{'' if demos == 1 else 's'}"


# ---- computation -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Compared:
    """Members with the distances between all of them, and the surgeon and session of each as numbers."""

    members: Sequence[Member]
    shapes: Floats
    far: Floats
    scaled: bool
    surgeons: list[str]
    whose: Ints
    sessions: Ints
    signatures: Floats
    shares: Mapping[str, float]

    def of(self, surgeon: int) -> Ints:
        """Return the indices of a surgeon's demonstrations."""
        return np.flatnonzero(self.whose == surgeon)

    def name(self, one: int) -> str:
        """Return the digest of a demonstration."""
        return self.members[one].sha256


def _compare(
    members: Sequence[Member],
    shapes: Floats,
    far: Floats,
    scaled: bool,
    signatures: Floats,
    shares: Mapping[str, float],
) -> _Compared:
    slugs, surgeons = np.unique([one.surgeon for one in members], return_inverse=True)
    return _Compared(members, shapes, far, scaled, slugs.tolist(), surgeons, sessions_of(members), signatures, shares)


def _told(suture: str, compared: _Compared, left_out: LeftOutOfAtlas, clusters: int | None, asked: str | None) -> Atlas:
    far, members = compared.far, compared.members
    tree = dendrogram(far)
    number = clusters or how_many(far, tree)
    in_cluster = tree.cut(number)
    places, shows = chart(far)
    recognised = recognise_arms(members, compared.signatures)
    of_asked = next((one for one in members if one.sha256 == asked), None)
    return Atlas(
        suture=suture,
        scaled=compared.scaled,
        unit=UNITS[compared.scaled],
        demos=[
            Place(id=one.sha256, surgeon=one.surgeon, session=one.session, cluster=cluster + 1, at=at)
            for one, cluster, at in zip(members, in_cluster.tolist(), places.round(DIGITS).tolist(), strict=True)
        ],
        recordings=len({one.recording_row for one in members}),
        left_out=left_out,
        distances=[far[at, :at].round(DIGITS).tolist() for at in range(len(members))],
        merges=_merges(tree),
        order=tree.order.tolist(),
        clusters=[_cluster(compared, one, np.flatnonzero(in_cluster == one)) for one in range(number)],
        clusters_chosen=AS_ASKED if clusters else BY_SILHOUETTE,
        silhouette=round(silhouette(far, in_cluster), DIGITS) if number > 1 else None,
        chart_shows=round(shows, DIGITS),
        surgeons=[_consistency(compared, one) for one in range(len(compared.surgeons))],
        differences=_differences(compared),
        recognition=recognitions(recognised),
        no_recognition_because=" ".join(recognised.because) or None,
        votes=votes(recognised),
        whose=None if of_asked is None else whose(recognised, of_asked),
        notes=[DISTANCE, CONFOUNDED, SESSIONS, *left_out.because],
    )


def _merges(tree: Dendrogram) -> list[Merge]:
    sizes = [1] * len(tree.order)
    merges = []
    for (one, other), height in zip(tree.joined.tolist(), tree.heights.round(DIGITS).tolist(), strict=True):
        sizes.append(sizes[one] + sizes[other])
        merges.append(Merge(one=one, other=other, distance=height, demos=sizes[-1]))
    return merges


def _cluster(compared: _Compared, cluster: int, members: Ints) -> Cluster:
    counts = Counter(compared.members[one].surgeon for one in members.tolist())
    return Cluster(
        cluster=cluster + 1,
        demos=len(members),
        medoid=compared.name(medoid(compared.far, members)),
        spread=_spread(compared.far, members),
        surgeons=[OfSurgeon(surgeon=surgeon, demos=demos) for surgeon, demos in counts.most_common()],
    )


def _consistency(compared: _Compared, surgeon: int) -> Consistency:
    mine = compared.of(surgeon)
    share = compared.shares.get(compared.surgeons[surgeon])
    return Consistency(
        surgeon=compared.surgeons[surgeon],
        demos=len(mine),
        recordings=len({compared.members[one].recording_row for one in mine.tolist()}),
        sessions=len(np.unique(compared.sessions[mine])),
        medoid=compared.name(medoid(compared.far, mine)),
        spread=_spread(compared.far, mine),
        mean_share=None if share is None else round(share, DIGITS),
    )


def _spread(far: Floats, members: Ints) -> float | None:
    return round(spread(far, members), DIGITS) if len(members) > 1 else None


def _differences(compared: _Compared) -> list[Apartness]:
    """Compare the surgeons with the most demonstrations, pair by pair."""
    counts = np.bincount(compared.whose)
    most = sorted(np.argsort(-counts, kind="stable")[:MOST_COMPARED].tolist())
    medoids = {one: medoid(compared.far, compared.of(one)) for one in most}
    return [_apart(compared, one, other, medoids[one], medoids[other]) for one, other in combinations(most, 2)]


def _apart(compared: _Compared, one: int, other: int, of_one: int, of_other: int) -> Apartness:
    found = difference(compared.shapes[of_one], compared.shapes[of_other])
    names = compared.surgeons[one], compared.surgeons[other]
    (part, axis), (share, net, size) = found.where, found.most
    distance = round(found.total / STATES, DIGITS)
    return Apartness(
        one=names[0],
        other=names[1],
        distance=distance,
        part=part,
        axis=axis,
        share=round(share, DIGITS),
        offset=round(net, DIGITS),
        size=round(size, DIGITS),
        said=_said(found, names, compared.scaled)
        if distance > 0
        else f"There is no difference between {names[0]} and {names[1]}.",
        shares=found.shares.round(DIGITS).tolist(),
        offsets=found.nets.round(DIGITS).tolist(),
    )


def _said(found: Difference, names: tuple[str, str], scaled: bool) -> str:
    """Return the sentence on the part of the path and the axis with the largest difference."""
    (part, axis), (share, net, size) = found.where, found.most
    there = f"{share:.0%} of their difference is there, {axis}."
    if found.direction is None:
        by = _length(size, scaled)
        return f"In the {part}, the paths of {names[0]} and {names[1]} are {by} apart, in both directions; {there}"
    return (
        f"In the {part}, the path of {names[0]} is {_length(abs(net), scaled)} {found.direction} than that of "
        f"{names[1]}; {there}"
    )


def _length(length: float, scaled: bool) -> str:
    return f"{100 * length:.1f} % of the length" if scaled else f"{length:.1f} mm"
