"""The styles as a matrix of surgeons and suture types, and one style in full.

A *style* is a surgeon's way of sewing one suture type. It is `stored` if it has an active demonstration, `trained` if
it has a policy version, `released` if a version is served.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from sqlalchemy import JSON, ColumnElement, Select, case, exists, func, select, type_coerce
from sqlalchemy.orm import Session

from skills.db import newest
from skills.db.models import Demonstration, PolicyDemonstration, PolicyVersion, Release, Surgeon, SutureType
from skills.db.service_tables import Job
from skills.library.operation.jobs import ACTIVE, TRAINING, requested_again
from skills.library.operation.overview import MOST, MOST_LISTED
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.library.policies.releases import is_served, served

State = Literal["released", "trained", "stored", "empty"]
STATES: tuple[State, ...] = ("released", "trained", "stored", "empty")
MOST_COUNTED = 1000  # of a kind, for the figures of the first page
_Row = tuple[int, str]  # a style: the surgeon's row and the suture type's slug
_Counts = dict[_Row, tuple[int, int]]  # of each style the number of its demonstrations or versions, and the newest row


@dataclass(frozen=True)
class Shown:
    """The part of a version's manifest that a tile shows."""

    grid_shape: tuple[int, int, int]
    waypoints: Sequence[int]
    mean_share: float
    dtw_total_mm: float


@dataclass(frozen=True)
class StyleState:
    """The state of one style: the numbers of active demonstrations and versions, the served version and the shown one.

    `shown` is of the served version or, if none is served, of the newest; `waiting` is true if the newest demonstration
    is newer than those of the shown version; `job` is the newest training that has not ended, or that failed
    and left the style without a version.
    """

    suture: str
    state: State
    demos: int = 0
    versions: int = 0
    released: int | None = None
    shown: Shown | None = None
    waiting: bool = False
    job: Job | None = None


@dataclass(frozen=True)
class Matrix:
    """A page of surgeons with their styles in the order of the suture types; `next` is the cursor of the next page."""

    sutures: Sequence[SutureType]
    rows: Sequence[tuple[Surgeon, Sequence[StyleState]]]
    next: str | None
    counts: dict[str, int]  # surgeons, suture types, demonstrations, releases: independent of the search
    unused: Sequence[SutureType] = ()  # suture types that are left out because no shown style has them


def matrix(
    session: Session,
    words: str = "",
    state: State | None = None,
    skill: str | None = None,
    after: str | None = None,
    limit: int = MOST,
) -> Matrix:
    """Search the styles.

    A word that occurs in a suture type's name, family or other names selects suture types; any other word must occur in
    the surgeon's pseudonym.

    Args:
        session: The caller's transaction.
        words: The words, separated by spaces.
        state: Return only surgeons with a style in this state.
        skill: Return only surgeons of this skill level.
        after: The last pseudonym of the page before.
        limit: The most surgeons on a page.
    """
    known = session.scalars(select(SutureType).order_by(SutureType.slug)).all()
    asked = words.lower().split()
    of_sutures = {word: [one for one in known if word in _said(one)] for word in asked}
    chosen = [one for one in known if all(one in found for found in of_sutures.values() if found)]
    query = select(Surgeon).where(Surgeon.slug > (after or ""))
    for word in (word for word, found in of_sutures.items() if not found):
        query = query.where(Surgeon.slug.contains(word, autoescape=True))
    if skill is not None:
        query = query.where(Surgeon.skill_level == skill)
    if state in ("released", "trained", "stored"):
        query = query.where(_having(state))
    surgeons = session.scalars(query.order_by(Surgeon.slug).limit(limit)).all()
    found = _styles(session, [one.row for one in surgeons])
    used = {suture for (_, suture), style in found.items() if state in (None, style.state)}
    shown = [one for one in chosen if one.slug in used or state == "empty"]
    rows = []
    for surgeon in surgeons:
        styles = [found.get((surgeon.row, one.slug), StyleState(one.slug, "empty")) for one in shown]
        if state is None or any(style.state == state for style in styles):
            rows.append((surgeon, styles))
    more = surgeons[-1].slug if len(surgeons) == limit else None
    return Matrix(shown, rows, more, _counts(session), [one for one in chosen if one not in shown])


def _said(suture: SutureType) -> str:
    return " ".join([suture.slug, suture.name, suture.family, *suture.also_called]).lower()


def _having(state: State) -> ColumnElement[bool]:
    """Return a condition on `Surgeon`: with a style in this state or beyond it, asked surgeon by surgeon."""
    if state == "released":
        found = exists().where(Release.surgeon_row == Surgeon.row, is_served())
    elif state == "trained":
        found = exists().where(PolicyVersion.surgeon_row == Surgeon.row)
    else:
        found = exists().where(Demonstration.surgeon_row == Surgeon.row, Demonstration.withdrawn_at.is_(None))
    return found.correlate(Surgeon)


def _counts(session: Session) -> dict[str, int]:
    active = Demonstration.withdrawn_at.is_(None)
    queries: dict[str, Select[Any]] = {
        "surgeons": select(Surgeon.row),
        "suture types": select(SutureType.slug),
        "demonstrations": select(Demonstration.row).where(active),
        "released styles": select(Release.row).where(is_served()),
    }
    # Counted no further than this, so that the page takes as long in a large installation as in a small one.
    few = {name: query.limit(MOST_COUNTED).subquery() for name, query in queries.items()}
    return {name: session.scalar(select(func.count()).select_from(rows)) or 0 for name, rows in few.items()}


def _styles(session: Session, surgeons: Sequence[int], suture: str | None = None) -> dict[_Row, StyleState]:
    """Return the styles of some surgeons, by style; empty ones are left out."""

    def mine(of: Any) -> list[ColumnElement[bool]]:
        return [of.surgeon_row.in_(surgeons), *([] if suture is None else [of.suture == suture])]

    def counted(of: Any, newest: Any, *which: ColumnElement[bool]) -> _Counts:
        """Return the number of rows of each style, and the newest of them."""
        query = select(of.surgeon_row, of.suture, func.count(), newest).where(*mine(of), *which)
        found = session.execute(query.group_by(of.surgeon_row, of.suture))
        return {(who, what): (count, last) for who, what, count, last in found}

    of, by = Demonstration, PolicyVersion
    demos = counted(of, func.max(case((of.learnable, of.row), else_=0)), of.withdrawn_at.is_(None))
    versions = counted(by, func.max(by.row))
    served = select(Release.surgeon_row, Release.suture, Release.policy_row).where(*mine(Release), is_served())
    released = {(who, what): policy for who, what, policy in session.execute(served)}
    wanted = {style: newest for style, (_, newest) in versions.items()} | released
    # Columns and not entities, of which a page has hundreds; and of manifests the part that is shown.
    shown = [("grid", "shape"), ("waypoints",), ("coverage", "mean_share"), ("metrics", "dtw_total_mm")]
    manifest = [type_coerce(by.manifest, JSON)[names] for names in shown]
    others = select(func.max(PolicyDemonstration.demonstration_row)).where(PolicyDemonstration.policy_row == by.row)
    about = select(by.row, by.version, by.demonstration_row, others.scalar_subquery(), *manifest)
    told = {row: rest for row, *rest in session.execute(about.where(by.row.in_(wanted.values())))}
    asked = select(Job).where(Job.surgeon_row.in_(surgeons), Job.kind == TRAINING, Job.state.in_((*ACTIVE, "failed")))
    asked = asked.where(~requested_again()).order_by(Job.row)
    jobs = {(job.surgeon_row, job.request["suture"]): job for job in session.scalars(asked)}
    return {
        style: _sum_up(style, demos, versions, told.get(wanted.get(style, 0)), style in released, jobs.get(style))
        for style in demos.keys() | versions.keys()
    }


def _sum_up(
    style: _Row, demos: _Counts, versions: _Counts, told: list[Any] | None, released: bool, job: Job | None
) -> StyleState:
    count, newest = demos.get(style, (0, 0))
    if told is None:
        return StyleState(style[1], "stored", count, job=job)
    version, demonstration_row, other, shape, *shown = told
    return StyleState(
        suture=style[1],
        state="released" if released else "trained",
        demos=count,
        versions=versions[style][0],
        released=version if released else None,
        shown=Shown(tuple(shape), *shown),
        waiting=newest > max(demonstration_row, other or 0),
        job=None if job is None or job.state == "failed" else job,
    )


def styles_of(session: Session, surgeon: Surgeon) -> list[StyleState]:
    """List the styles of a surgeon that have anything, by suture type."""
    return [style for _, style in sorted(_styles(session, [surgeon.row]).items())]


@dataclass(frozen=True)
class WholeStyle:
    """One style with its demonstrations, versions and releases, the newest first; `served` is the served release."""

    surgeon: Surgeon
    suture: SutureType
    style: StyleState
    demos: Sequence[Demonstration]
    versions: Sequence[PolicyVersion]
    releases: Sequence[Release]
    served: Release | None


def whole_style(session: Session, surgeon: str, suture: str) -> WholeStyle:
    """Return one style with its newest demonstrations, versions and releases, `MOST_LISTED` of each.

    Raises:
        NotFound: The surgeon or the suture type is unknown.
        Erased: The surgeon was erased.
    """
    who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)

    def newest_of(of: Any) -> Any:
        return session.scalars(newest(of, of.surgeon_row == who.row, of.suture == what.slug, limit=MOST_LISTED)).all()

    style = _styles(session, [who.row], what.slug).get((who.row, what.slug), StyleState(what.slug, "empty"))
    return WholeStyle(
        surgeon=who,
        suture=what,
        style=style,
        demos=newest_of(Demonstration),
        versions=newest_of(PolicyVersion),
        releases=newest_of(Release),
        served=served(session, who, what.slug),
    )


class ReleasedStyle(NamedTuple):
    """A style and the version that it serves, for a selection."""

    surgeon: str
    suture: str
    version: int
    policy_row: int


def released_styles(session: Session, limit: int = MOST_LISTED) -> list[ReleasedStyle]:
    """List the first styles that serve a version, by surgeon and suture type, for a selection in a form."""
    by = PolicyVersion
    found = select(Surgeon.slug, Release.suture, by.version, by.row).join(Release, Release.surgeon_row == Surgeon.row)
    found = found.join(by, by.row == Release.policy_row).where(is_served()).order_by(Surgeon.slug, Release.suture)
    return [ReleasedStyle(*one) for one in session.execute(found.limit(limit))]
