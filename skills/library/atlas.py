"""The atlas of a suture type: how far its demonstrations are apart, what belongs together, and whose is whose.

It is made of all active demonstrations whose surgeon's consent covers it.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import log

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from skills.db.models import Demonstration, Surgeon, SutureType
from skills.db.session import Database
from skills.errors import BadInput, BadPath, Conflict, NotFound
from skills.library.apart import far_apart
from skills.library.atlas_parts import (
    Apartness,
    Atlas,
    Cluster,
    Consistency,
    LeftOut,
    Likely,
    Merge,
    OfSurgeon,
    Place,
    Recognition,
    Whose,
)
from skills.library.catalogue import check_consent, find_suture_type
from skills.library.demos import find_demo
from skills.style._arrays import Floats, Ints
from skills.style.comparing.chart import chart
from skills.style.comparing.clusters import WORTH, Dendrogram, dendrogram, how_many, silhouette
from skills.style.comparing.differences import Difference, difference
from skills.style.comparing.distances import medoid, spread
from skills.style.comparing.recognition import Validated, recognise, validate
from skills.style.comparing.shapes import LEAST_MM, STATES, in_lengths

MOST = 2000  # demonstrations: a minute of measuring on two cores, once, and an answer of 16 MB
MOST_COMPARED = 40  # surgeons of whom all pairs are compared, in half a second
DIGITS = 4  # of what is told: a tenth of a micrometre, far below what a recorder can tell
UNITS = {False: "mm", True: "lengths of start to goal"}

AS_ASKED = "as asked"
BY_SILHOUETTE = f"that with the best mean silhouette, and one where even that is below {WORTH:g}"

NO_DIRECTION = f"It ends within {LEAST_MM:g} mm of where it began, so it has no direction to be compared along."
DISTANCE = (
    f"A distance is the total of dynamic time warping (Manhattan) of two shapes of {STATES} states, divided by "
    f"{STATES}: about by how much two motions differ at a place. Shapes begin at one point and go in one direction."
)
CONFOUNDED = (
    "Set-up and day go with the surgeon: who is recognised may be known by the room, the arm's place or the day's task "
    "and not by style. So a demonstration is only ever compared with those of other sessions, and even then surgeons "
    "who always work in a set-up of their own cannot be told from it."
)
SESSIONS = (
    "Demonstrations with the same session name were recorded together, whoever made them; those without one count as "
    "one session for each recording."
)


@dataclass(frozen=True)
class _Member:
    row: int
    sha256: str
    surgeon: str
    session: str | None
    recording_row: int


def atlas_of(
    database: Database, suture: str, *, scaled: bool = False, clusters: int | None = None, demo: str | None = None
) -> Atlas:
    """Compare all demonstrations of a suture type.

    Args:
        database: As far as the caller may see it.
        suture: The suture type.
        scaled: Whether to lay start and goal of all on each other, so that size says nothing.
        clusters: How many; left out, as many as `skills.style.comparing.clusters` finds.
        demo: The digest of one that is in the atlas, to be told whose style it is.

    Raises:
        NotFound: There is no such suture type, or nothing to compare, or no such demonstration in the atlas.
        Conflict: There are more than `MOST`; or the demonstration was withdrawn, or consent does not cover it.
        BadInput: There are not so many demonstrations as clusters are asked for.
        BadPath: The demonstration that is asked about has no direction.
    """
    with database.reading() as session:
        found, without_consent = _members(session, find_suture_type(session, suture).slug)
        asked = None if demo is None else _asked(session, demo, suture)
    if len(found) > MOST:
        raise Conflict(
            f"There are {len(found)} demonstrations of '{suture}', and an atlas has at most {MOST}; withdraw those "
            "that nobody learns from.",
            demos=len(found),
        )
    apart = far_apart(database, [one.row for one in found])
    there = {*apart.rows.tolist()}
    members = [one for one in found if one.row in there]
    without_direction = [one.sha256 for one in found if one.row not in there]
    if asked in without_direction:
        raise BadPath(f"{NO_DIRECTION} Cut the hand-off from its start to where the needle is taken.")
    left_out = LeftOut(without_consent, without_direction, _because(without_consent, len(without_direction)))
    if not members:
        raise NotFound(" ".join([f"There is no demonstration of '{suture}' to compare.", *left_out.because]))
    if scaled:
        shapes, far = np.array([in_lengths(shape) for shape in apart.shapes_mm]), apart.apart_scaled
    else:
        shapes, far = apart.shapes_mm, apart.apart_mm
    return _told(suture, _compare(members, shapes, far / STATES, scaled), left_out, clusters, asked)


def atlases(session: Session) -> list[tuple[SutureType, int, int]]:
    """List the suture types that there are active demonstrations of: how many, and of how many surgeons."""
    of = Demonstration
    counted = select(of.suture, func.count(), func.count(of.surgeon_row.distinct())).where(of.withdrawn_at.is_(None))
    found = session.execute(counted.group_by(of.suture).order_by(of.suture)).all()
    return [(find_suture_type(session, suture), demos, surgeons) for suture, demos, surgeons in found]


def _members(session: Session, suture: str) -> tuple[list[_Member], int]:
    """List the active demonstrations that may be compared, the oldest first, and count those that may not."""
    of = Demonstration
    query = select(of.row, of.sha256, Surgeon, of.session, of.recording_row).join(
        Surgeon, of.surgeon_row == Surgeon.row
    )
    rows = session.execute(query.where(of.suture == suture, of.withdrawn_at.is_(None)).order_by(of.row)).all()
    covered = {surgeon.slug: _covered(surgeon) for _, _, surgeon, _, _ in rows}
    members = [
        _Member(row, sha256, surgeon.slug, recorded, recording)
        for row, sha256, surgeon, recorded, recording in rows
        if covered[surgeon.slug]
    ]
    return members, len(rows) - len(members)


def _covered(surgeon: Surgeon) -> bool:
    try:
        check_consent(surgeon, "atlas")
    except Conflict:
        return False
    return True


def _asked(session: Session, demo: str, suture: str) -> str:
    """Find the demonstration that is asked about, and refuse one that is not in this atlas."""
    found = find_demo(session, demo)
    if found.suture != suture:
        raise NotFound(f"This demonstration is of '{found.suture}'; ask for that atlas.")
    if found.withdrawn_at is not None:
        raise Conflict("This demonstration was withdrawn, so it is not in the atlas.")
    check_consent(found.surgeon, "atlas")
    return found.sha256


def _because(without_consent: int, without_direction: int) -> list[str]:
    said = []
    if without_consent:
        said.append(f"Left out: {_count(without_consent)}, for the surgeon's consent does not cover an atlas.")
    if without_direction:
        said.append(f"Left out: {_count(without_direction)}. {NO_DIRECTION}")
    return said


def _count(demos: int) -> str:
    return f"{demos} demonstration{'' if demos == 1 else 's'}"


# ---- what is computed --------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Compared:
    """Members with the distances between all, and whose and of which session each is, as numbers."""

    members: Sequence[_Member]
    shapes: Floats
    far: Floats
    scaled: bool
    surgeons: list[str]
    whose: Ints
    sessions: Ints

    def of(self, surgeon: int) -> Ints:
        """Number a surgeon's demonstrations."""
        return np.flatnonzero(self.whose == surgeon)

    def name(self, one: int) -> str:
        """Give the digest of a demonstration."""
        return self.members[one].sha256


def _compare(members: Sequence[_Member], shapes: Floats, far: Floats, scaled: bool) -> _Compared:
    slugs, whose = np.unique([one.surgeon for one in members], return_inverse=True)
    numbers: dict[object, int] = {}
    sessions = [numbers.setdefault(one.session or one.recording_row, len(numbers)) for one in members]
    return _Compared(members, shapes, far, scaled, slugs.tolist(), whose, np.array(sessions))


def _told(suture: str, compared: _Compared, left_out: LeftOut, clusters: int | None, asked: str | None) -> Atlas:
    far, members = compared.far, compared.members
    tree = dendrogram(far)
    number = clusters or how_many(far, tree)
    in_cluster = tree.cut(number)
    places, shows = chart(far)
    validated, why_not = _validated(compared)
    return Atlas(
        suture=suture,
        scaled=compared.scaled,
        unit=UNITS[compared.scaled],
        demos=[
            Place(one.sha256, one.surgeon, one.session, cluster + 1, (x, y))
            for one, cluster, (x, y) in zip(members, in_cluster.tolist(), places.round(DIGITS).tolist(), strict=True)
        ],
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
        recognition=None if validated is None else _recognition(validated),
        no_recognition_because=why_not,
        whose=None if asked is None or validated is None else _whose(compared, validated, asked),
        notes=[DISTANCE, CONFOUNDED, SESSIONS, *left_out.because],
    )


def _merges(tree: Dendrogram) -> list[Merge]:
    sizes = [1] * len(tree.order)
    merges = []
    for (one, other), height in zip(tree.joined.tolist(), tree.heights.round(DIGITS).tolist(), strict=True):
        sizes.append(sizes[one] + sizes[other])
        merges.append(Merge(one, other, height, sizes[-1]))
    return merges


def _cluster(compared: _Compared, cluster: int, members: Ints) -> Cluster:
    counts = Counter(compared.members[one].surgeon for one in members.tolist())
    return Cluster(
        cluster + 1,
        len(members),
        compared.name(medoid(compared.far, members)),
        _spread(compared.far, members),
        [OfSurgeon(surgeon, demos) for surgeon, demos in counts.most_common()],
    )


def _consistency(compared: _Compared, surgeon: int) -> Consistency:
    mine = compared.of(surgeon)
    return Consistency(
        compared.surgeons[surgeon],
        len(mine),
        len(np.unique(compared.sessions[mine])),
        compared.name(medoid(compared.far, mine)),
        _spread(compared.far, mine),
    )


def _spread(far: Floats, members: Ints) -> float | None:
    return round(spread(far, members), DIGITS) if len(members) > 1 else None


def _differences(compared: _Compared) -> list[Apartness]:
    """Tell what sets the surgeons with the most demonstrations apart, pair by pair."""
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
        *names,
        distance=distance,
        part=part,
        axis=axis,
        share=round(share, DIGITS),
        offset=round(net, DIGITS),
        size=round(size, DIGITS),
        said=_said(found, names, compared.scaled) if distance > 0 else f"Nothing sets {names[0]} and {names[1]} apart.",
        shares=found.shares.round(DIGITS).tolist(),
        offsets=found.nets.round(DIGITS).tolist(),
    )


def _said(found: Difference, names: tuple[str, str], scaled: bool) -> str:
    """Say where most of a difference is."""
    (part, axis), (share, net, size) = found.where, found.most
    there = f"{share:.0%} of what sets them apart is there, {axis}."
    if found.direction is None:
        by = _length(size, scaled)
        return f"In the {part}, {names[0]} and {names[1]} lie {by} apart, to and fro; {there}"
    return f"In the {part}, {names[0]} lies {_length(abs(net), scaled)} {found.direction} than {names[1]}; {there}"


def _length(length: float, scaled: bool) -> str:
    return f"{100 * length:.1f} % of the way" if scaled else f"{length:.1f} mm"


def _validated(compared: _Compared) -> tuple[Validated | None, str | None]:
    """Validate recognition, or say why that cannot be done."""
    try:
        return validate(compared.far, compared.whose, compared.sessions), None
    except BadInput as error:
        return None, str(error)


def _recognition(validated: Validated) -> Recognition:
    return Recognition(
        surgeons=len(validated.surgeons),
        tested=len(validated.tested),
        right=validated.right,
        accuracy=validated.accuracy,
        interval=validated.interval,
        chance=validated.chance,
        log_loss=validated.log_loss,
        log_loss_of_guessing=log(len(validated.surgeons)),
        sureness=validated.sureness,
    )


def _whose(compared: _Compared, validated: Validated, asked: str) -> Whose:
    one = [member.sha256 for member in compared.members].index(asked)
    probability = recognise(compared.far, compared.whose, compared.sessions, one, validated)
    likely = sorted(zip(probability.tolist(), compared.surgeons, strict=True), reverse=True)
    return Whose(asked, compared.members[one].surgeon, [Likely(surgeon, p) for p, surgeon in likely])
