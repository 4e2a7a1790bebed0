"""What a page shows of many things at once: the styles as a matrix, one style whole, and the newest of each kind.

A *style* is a surgeon's way with one suture type. It is stored where there is an active demonstration, trained where
there is a policy version, released where one is served.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from skills.db.books import Job
from skills.db.models import (
    Demonstration,
    Plan,
    PolicyVersion,
    Release,
    StoredPictures,
    StoredPlayback,
    StoredRecording,
    Surgeon,
    SutureType,
)
from skills.library import pictures
from skills.library.catalogue import find_surgeon, find_suture_type

State = Literal["released", "trained", "stored", "empty"]
STATES: tuple[State, ...] = ("released", "trained", "stored", "empty")
MOST = 50  # rows of a list on a page
MOST_VERSIONS = 200

_Row = tuple[int, str]  # a style: its surgeon's row and its suture type's name


@dataclass(frozen=True)
class Style:
    """What there is of one style: active demonstrations, versions, the served one and the one that is told of.

    `shown` is what is told of the served version or, without one, of the newest; `waiting` says that the newest
    demonstration is newer than the one that is served.
    """

    suture: str
    state: State
    demos: int = 0
    versions: int = 0
    released: int | None = None
    shown: dict[str, Any] | None = None
    waiting: bool = False


@dataclass(frozen=True)
class Matrix:
    """Surgeons with their styles in the order of the suture types, and the surgeon after whom the next part begins."""

    sutures: Sequence[SutureType]
    rows: Sequence[tuple[Surgeon, Sequence[Style]]]
    next: str | None
    counts: dict[str, int]  # surgeons, suture types, demonstrations, releases; of all, whatever is asked for
    unused: Sequence[SutureType] = ()  # suture types left out, for nothing that is shown has them


def matrix(
    session: Session,
    words: str = "",
    state: State | None = None,
    skill: str | None = None,
    after: str | None = None,
    limit: int = MOST,
) -> Matrix:
    """Search the styles.

    A word that a suture type has in its name, family or other names chooses suture types; any other must be in the
    surgeon's pseudonym.
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
        query = query.where(Surgeon.row.in_(_having(state)))
    surgeons = session.scalars(query.order_by(Surgeon.slug).limit(limit)).all()
    found = _styles(session, [one.row for one in surgeons])
    used = {suture for (_, suture), style in found.items() if state in (None, style.state)}
    shown = [one for one in chosen if one.slug in used or state == "empty"]
    rows = []
    for surgeon in surgeons:
        styles = [found.get((surgeon.row, one.slug), Style(one.slug, "empty")) for one in shown]
        if state is None or any(style.state == state for style in styles):
            rows.append((surgeon, styles))
    more = surgeons[-1].slug if len(surgeons) == limit else None
    return Matrix(shown, rows, more, _counts(session), [one for one in chosen if one not in shown])


def _said(suture: SutureType) -> str:
    return " ".join([suture.slug, suture.name, suture.family, *suture.also_called]).lower()


def _having(state: State) -> Any:
    """Select the surgeons of whom there is anything in this state, or on the way to it."""
    if state == "released":
        return select(Release.surgeon_row).where(Release.withdrawn_at.is_(None))
    if state == "trained":
        return select(PolicyVersion.surgeon_row)
    return select(Demonstration.surgeon_row).where(Demonstration.withdrawn_at.is_(None))


def _counts(session: Session) -> dict[str, int]:
    served = select(Release.surgeon_row, Release.suture).where(Release.withdrawn_at.is_(None)).distinct().subquery()
    active = Demonstration.withdrawn_at.is_(None)
    queries = {
        "surgeons": select(func.count()).select_from(Surgeon),
        "suture types": select(func.count()).select_from(SutureType),
        "demonstrations": select(func.count()).select_from(Demonstration).where(active),
        "released styles": select(func.count()).select_from(served),
    }
    return {name: session.scalar(query) or 0 for name, query in queries.items()}


def _styles(session: Session, surgeons: Sequence[int], suture: str | None = None) -> dict[_Row, Style]:
    """Sum up all styles of some surgeons that there is anything of."""

    def mine(of: Any) -> list[ColumnElement[bool]]:
        return [of.surgeon_row.in_(surgeons), *([] if suture is None else [of.suture == suture])]

    demos, newest_demo = Counter[_Row](), dict[_Row, int]()
    of = Demonstration
    active = select(of.surgeon_row, of.suture, func.count(), func.max(of.row)).where(of.withdrawn_at.is_(None))
    for who, what, count, newest in session.execute(active.where(*mine(of)).group_by(of.surgeon_row, of.suture)):
        demos[who, what], newest_demo[who, what] = count, newest
    versions, newest_version = Counter[_Row](), dict[_Row, int]()
    by = PolicyVersion
    learnt = select(by.surgeon_row, by.suture, func.count(), func.max(by.row)).where(*mine(by))
    for who, what, count, newest in session.execute(learnt.group_by(by.surgeon_row, by.suture)):
        versions[who, what], newest_version[who, what] = count, newest
    standing = select(func.max(Release.row)).where(Release.withdrawn_at.is_(None), *mine(Release))
    served = select(Release.surgeon_row, Release.suture, Release.policy_row).where(
        Release.row.in_(standing.group_by(Release.surgeon_row, Release.suture))
    )
    released = {(who, what): policy for who, what, policy in session.execute(served)}
    wanted = {**newest_version, **released}
    told = {one.row: one for one in session.scalars(select(by).where(by.row.in_(wanted.values())))}
    return {
        style: _sum_up(
            style,
            demos[style],
            versions[style],
            told.get(wanted.get(style, 0)),
            newest_demo.get(style, 0),
            style in released,
        )
        for style in demos.keys() | versions.keys()
    }


def _sum_up(
    style: _Row, demos: int, versions: int, shown: PolicyVersion | None, newest_demo: int, released: bool
) -> Style:
    if shown is None:
        return Style(style[1], "stored", demos)
    return Style(
        suture=style[1],
        state="released" if released else "trained",
        demos=demos,
        versions=versions,
        released=shown.version if released else None,
        shown=shown.manifest,
        waiting=newest_demo > shown.newest_demonstration_row,
    )


@dataclass(frozen=True)
class WholeStyle:
    """One style with its demonstrations, versions and releases, the newest first; `served` is what stands."""

    surgeon: Surgeon
    suture: SutureType
    style: Style
    demos: Sequence[Demonstration]
    versions: Sequence[PolicyVersion]
    releases: Sequence[Release]
    served: Release | None


def whole_style(session: Session, surgeon: str, suture: str) -> WholeStyle:
    """Look one style up with all that there is of it.

    Raises:
        NotFound: The surgeon or the suture type is unknown.
        Erased: The surgeon was erased.
    """
    who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)

    def newest(of: Any) -> Any:
        mine = select(of).where(of.surgeon_row == who.row, of.suture == what.slug)
        return session.scalars(mine.order_by(of.row.desc()).limit(MOST_VERSIONS)).all()

    releases: Sequence[Release] = newest(Release)
    style = _styles(session, [who.row], what.slug).get((who.row, what.slug), Style(what.slug, "empty"))
    return WholeStyle(
        surgeon=who,
        suture=what,
        style=style,
        demos=newest(Demonstration),
        versions=newest(PolicyVersion),
        releases=releases,
        served=next((one for one in releases if one.withdrawn_at is None), None),
    )


def all_surgeons(session: Session, limit: int = 1000) -> Sequence[Surgeon]:
    """List surgeons to choose from."""
    return session.scalars(select(Surgeon).order_by(Surgeon.slug).limit(limit)).all()


def all_suture_types(session: Session, limit: int = 1000) -> Sequence[SutureType]:
    """List suture types to choose from."""
    return session.scalars(select(SutureType).order_by(SutureType.slug).limit(limit)).all()


def released_styles(session: Session, limit: int = 1000) -> Sequence[Release]:
    """List what is served, by surgeon and suture type, to choose from."""
    standing = select(func.max(Release.row)).where(Release.withdrawn_at.is_(None))
    served = select(Release).where(Release.row.in_(standing.group_by(Release.surgeon_row, Release.suture)))
    by_name = served.join(Surgeon, Surgeon.row == Release.surgeon_row).order_by(Surgeon.slug, Release.suture)
    return session.scalars(by_name.limit(limit)).all()


def newest_recordings(
    session: Session, before: int | None = None, limit: int = MOST
) -> list[tuple[StoredRecording, int]]:
    """List recordings, the newest first, each with the number of its active demonstrations."""
    query = select(StoredRecording).order_by(StoredRecording.row.desc()).limit(limit)
    if before is not None:
        query = query.where(StoredRecording.row < before)
    found = session.scalars(query).all()
    of = Demonstration
    active = (of.withdrawn_at.is_(None), of.recording_row.in_([one.row for one in found]))
    cut = select(of.recording_row, func.count().label("demos")).where(*active).group_by(of.recording_row)
    counts = {one.recording_row: one.demos for one in session.execute(cut)}
    return [(one, counts.get(one.row, 0)) for one in found]


def demos_of_recording(session: Session, recording: StoredRecording) -> Sequence[Demonstration]:
    """List what was cut out of a recording, in order of time."""
    of = Demonstration
    return session.scalars(select(of).where(of.recording_row == recording.row).order_by(of.start_s)).all()


def newest_plans(
    session: Session, before: int | None = None, limit: int = MOST
) -> list[tuple[Plan, StoredPlayback | None]]:
    """List plans, the newest first, each with its newest playback."""
    query = select(Plan).order_by(Plan.row.desc()).limit(limit)
    if before is not None:
        query = query.where(Plan.row < before)
    found = session.scalars(query).all()
    last = select(func.max(StoredPlayback.row)).where(StoredPlayback.plan_row.in_([one.row for one in found]))
    played = session.scalars(
        select(StoredPlayback).where(StoredPlayback.row.in_(last.group_by(StoredPlayback.plan_row)))
    )
    newest = {one.plan_row: one for one in played}
    return [(one, newest.get(one.row)) for one in found]


@dataclass(frozen=True)
class Played:
    """A playback, whether its film and plots are drawn, and the job that draws them or failed to."""

    playback: StoredPlayback
    drawn: bool
    job: Job | None


def playbacks_of(session: Session, plan: Plan) -> list[Played]:
    """List a plan's playbacks, the newest first."""
    query = select(StoredPlayback).where(StoredPlayback.plan_row == plan.row).order_by(StoredPlayback.row.desc())
    return [_played(session, one) for one in session.scalars(query)]


def _played(session: Session, playback: StoredPlayback) -> Played:
    drawn = session.scalar(select(StoredPictures.row).where(StoredPictures.playback_row == playback.row))
    job = None if drawn else newest_job(session, pictures.KIND, playback=playback.sha256)
    return Played(playback, drawn is not None, job)


def newest_job(session: Session, kind: str, **asked: str) -> Job | None:
    """Find the newest job of a kind that was asked for with these values."""
    mine = [Job.kind == kind, *(Job.request[name].as_string() == value for name, value in asked.items())]
    return session.scalar(select(Job).where(*mine).order_by(Job.row.desc()).limit(1))
