"""Overviews for pages and metrics: styles as a matrix, data for 3-D views, and the figures of an installation.

- The figures of an installation at this moment: its jobs, its workers, its database. They contain no names.
- The data of a 3-D view, as plain numbers for JSON: a demonstration, the policy learnt from it, and a recording's
  signals over time.
- The data of pages about many items: the styles as a matrix, one style in full, and the newest items of each kind.

A *style* is a surgeon's way of sewing one suture type. It is `stored` if it has an active demonstration, `trained` if
it has a policy version, `released` if a version is served.
"""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import JSON, ColumnElement, Select, case, exists, func, select, text, type_coerce
from sqlalchemy.orm import Session

from skills.db import now
from skills.db.models import (
    Demonstration,
    Plan,
    PolicyDemonstration,
    PolicyVersion,
    Release,
    StoredPictures,
    StoredPlayback,
    StoredRecording,
    StoredRewardMap,
    Surgeon,
    SutureType,
)
from skills.db.service_tables import Event, Executor, Job
from skills.db.session import Database
from skills.demonstration.demonstration import Demo, Recording
from skills.demonstration.movement import press_times, smoothed_speed
from skills.gridworld.grid import GridPath
from skills.gridworld.reward import RewardMap, sparse_reward
from skills.learning.policy import Policy
from skills.library.operation.integrity import covered, learnt
from skills.library.people.catalogue import find_surgeon, find_suture_type
from skills.library.people.recorded import shown_recording
from skills.library.plans.playback_pictures import job_of_pictures
from skills.library.policies.combined import learnt_from
from skills.library.policies.releases import is_served, served
from skills.library.recordings.recordings import Teller

RECENT = 500  # jobs in the quantiles of durations: enough for a meaningful 99th percentile
QUANTILES = (0.5, 0.95, 1.0)


@dataclass(frozen=True)
class Condition:
    """The figures of an installation; `seconds` are quantiles over the jobs that ended last, by kind.

    `verified_at` is when a worker last verified the history, and `found` the number of faults.
    """

    seconds: dict[str, dict[float, float]]
    oldest_queued_s: float
    workers: int
    database_bytes: int
    last_event_at: datetime | None
    verified_at: datetime | None
    found: int | None


def count_jobs(session: Session) -> dict[tuple[str, str], int]:
    """Return the number of jobs by kind and state; of a million jobs that takes a tenth of a second."""
    counted = session.execute(select(Job.kind, Job.state, func.count()).group_by(Job.kind, Job.state))
    return {(kind, state): count for kind, state, count in counted}


def condition_of(session: Session, lease_s: float) -> Condition:
    """Return the figures of an installation.

    Args:
        session: A transaction that sees all rows.
        lease_s: A worker counts if its last heartbeat is at most so old, in s.
    """
    at, beats = now(), select(Executor.beat_at)
    ended = select(Executor.verified_at, Executor.found).where(Executor.verified_at.is_not(None))
    verified_at, found = session.execute(ended.order_by(Executor.verified_at.desc()).limit(1)).first() or (None, None)
    oldest = session.scalar(select(func.min(Job.created_at)).where(Job.state == "queued"))
    return Condition(
        seconds=_seconds(session),
        oldest_queued_s=0.0 if oldest is None else max(0.0, (at - oldest).total_seconds()),
        workers=sum(abs(at - beat_at) <= timedelta(seconds=lease_s) for beat_at in session.scalars(beats)),
        database_bytes=_size(session),
        last_event_at=session.scalar(select(Event.at).order_by(Event.row.desc()).limit(1)),
        verified_at=verified_at,
        found=found,
    )


def _seconds(session: Session) -> dict[str, dict[float, float]]:
    ended = select(Job.kind, Job.started_at, Job.ended_at).where(Job.started_at.is_not(None), Job.ended_at.is_not(None))
    took: dict[str, list[float]] = defaultdict(list)
    for kind, started_at, ended_at in session.execute(ended.order_by(Job.row.desc()).limit(RECENT)):
        assert started_at is not None and ended_at is not None
        took[kind].append((ended_at - started_at).total_seconds())
    return {
        kind: {q: sorted(seconds)[round(q * (len(seconds) - 1))] for q in QUANTILES} for kind, seconds in took.items()
    }


def _size(session: Session) -> int:
    """Return the size of the database in bytes; on SQLite that of its file and its write-ahead log."""
    connection = session.connection()
    if connection.dialect.name != "sqlite":
        return session.scalar(text("SELECT pg_database_size(current_database())")) or 0
    file = Path(connection.engine.url.database or "")
    beside = (file, file.with_name(f"{file.name}-wal"))
    return sum(one.stat().st_size for one in beside if one.is_file())


MOST_STARTS = 20_000  # drawn smoothly by a browser: of a larger grid every second, third, ... cell is returned
MOST_SAMPLES = 1500  # of a line on a screen: more are not visible


def view_of_demo(session: Session, demo: Demonstration) -> dict[str, Any]:
    """Return a demonstration as it was recorded, as its path in the grid, and as the rewards of Algorithm 1."""
    stored = session.scalars(select(StoredRewardMap).where(StoredRewardMap.demonstration_row == demo.row)).one()
    return _view(demo.demo, demo.path, stored.map)


def _view(recorded: Demo, path: GridPath, reward: RewardMap) -> dict[str, Any]:
    rewards, levels, grid = reward.rewards, reward.levels, path.grid
    special = np.flatnonzero(rewards != levels.other)
    every = max(1, len(recorded.tip_mm) // MOST_SAMPLES)
    return {
        "frame": recorded.frame,
        "arm": recorded.arm,
        "grid": {"origin_mm": list(grid.origin_mm), "cell_mm": grid.cell_mm, "shape": list(grid.shape)},
        "recorded_mm": _mm(recorded.tip_mm[::every]),
        "path_mm": _mm(path.tip_mm),
        "rewards": {"at_mm": _mm(grid.centres_mm(special)), "of": rewards[special].tolist(), "goal": levels.goal},
    }


def view_of_version(version: PolicyVersion) -> dict[str, Any]:
    """Return the demonstration that a version was learnt from, and for every cell the rollout that starts there."""
    policy, coverage = learnt(version), covered(version)
    grid = policy.path.grid
    shown = np.arange(grid.n_states)
    every = 1
    # Thin along all three axes until the starts fit.
    while len(shown) > MOST_STARTS:
        every += 1
        shown = np.flatnonzero((grid.cells_of(np.arange(grid.n_states)) % every == 0).all(axis=1))
    moves = moves_to_goal(policy, coverage.reaches)
    return _view(learnt_from(version), policy.path, sparse_reward(policy.path, policy.levels)) | {
        "version": version.version,
        "starts": {
            "every": every,
            "at_mm": _mm(grid.centres_mm(shown)),
            "reaches": coverage.reaches[shown].tolist(),
            "nearest": coverage.joins_nearest[shown].tolist(),
            "moves": moves[shown].tolist(),
            "share": _rounded(coverage.share[shown]),
        },
    }


def moves_to_goal(policy: Policy, reaches: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the number of moves from every start to the goal, shape (n_states,); -1 if the goal is not reached.

    Args:
        policy: The policy.
        reaches: The starts that reach the goal, shape (n_states,).
    """
    moves, at = policy.moves, policy.domain.start_rows
    counted = np.where(reaches, 0, -1)
    walking = reaches & (at >= 0) & (policy.greedy[at] >= 0)
    while walking.any():
        counted += walking
        finished = moves.finishes[at]
        at = np.where(walking, moves.row[at], at)
        walking &= ~finished & (at >= 0) & (policy.greedy[at] >= 0)
    return counted


def traces_of(database: Database, recording_sha256: str, tell: Teller) -> dict[str, Any]:
    """Return the signals of a stored recording's arms, jaws and clutch over time."""
    recording = shown_recording(database, recording_sha256, tell).recording
    return {"duration_s": recording.duration_s, "arms": [_arm(recording, arm) for arm in recording.arms]}


def _arm(recording: Recording, arm: str) -> dict[str, Any]:
    motion = recording.motion_of(arm=arm)
    seconds, speed = smoothed_speed(recording.seconds(motion.stamps_ns), motion.tip_mm)
    every = max(1, len(seconds) // MOST_SAMPLES)
    jaw = recording.jaw_of(arm)
    told: dict[str, Any] = {
        "arm": arm,
        "topic": motion.topic,
        "speed": {"t_s": _rounded(seconds[::every]), "mm_s": _rounded(speed[::every])},
        "jaw": None,
        "clutch_s": _pressed(recording),
    }
    if jaw is not None:
        every = max(1, len(jaw.values) // MOST_SAMPLES)
        told["jaw"] = {
            "t_s": _rounded(recording.seconds(jaw.stamps_ns[::every])),
            "rad": _rounded(jaw.values[::every]),
        }
    return told


def _pressed(recording: Recording) -> list[list[float]]:
    """Return the intervals in which the clutch was down, in s, to the end of the recording if it never went up."""
    presses = [] if recording.clutch is None else press_times(recording.clutch)
    last_ns = recording.origin_ns + round(recording.duration_s * 1e9)
    spans_ns = np.array([(down, last_ns if up is None else up) for down, up in presses], np.int64).reshape(-1, 2)
    return _rounded(recording.seconds(spans_ns))


def _mm(points: NDArray[Any]) -> list[Any]:
    """Return points rounded to a thousandth of a millimetre, finer than a screen can show."""
    return _rounded(np.asarray(points, float))


def _rounded(values: NDArray[Any]) -> list[Any]:
    rounded: list[Any] = np.round(values, 3).tolist()
    return rounded


State = Literal["released", "trained", "stored", "empty"]
STATES: tuple[State, ...] = ("released", "trained", "stored", "empty")
MOST = 50  # rows of a list on a page
MOST_LISTED = 200  # of a style's versions and demonstrations, or in a selection, where of more nobody chooses by eye
MOST_COUNTED = 1000  # of a kind, for the figures of the first page

_Row = tuple[int, str]  # a style: the surgeon's row and the suture type's slug


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
    is newer than those of the shown version.
    """

    suture: str
    state: State
    demos: int = 0
    versions: int = 0
    released: int | None = None
    shown: Shown | None = None
    waiting: bool = False


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

    demos, newest_demo = Counter[_Row](), dict[_Row, int]()
    of = Demonstration
    newest_of = func.max(case((of.learnable, of.row), else_=0))
    active = select(of.surgeon_row, of.suture, func.count(), newest_of).where(of.withdrawn_at.is_(None))
    for who, what, count, newest in session.execute(active.where(*mine(of)).group_by(of.surgeon_row, of.suture)):
        demos[who, what], newest_demo[who, what] = count, newest
    versions, newest_version = Counter[_Row](), dict[_Row, int]()
    by = PolicyVersion
    learnt = select(by.surgeon_row, by.suture, func.count(), func.max(by.row)).where(*mine(by))
    for who, what, count, newest in session.execute(learnt.group_by(by.surgeon_row, by.suture)):
        versions[who, what], newest_version[who, what] = count, newest
    served = select(Release.surgeon_row, Release.suture, Release.policy_row).where(*mine(Release), is_served())
    released = {(who, what): policy for who, what, policy in session.execute(served)}
    wanted = {**newest_version, **released}
    # Columns and not entities, of which a page has hundreds; and of manifests the part that is shown.
    shown = [("grid", "shape"), ("waypoints",), ("coverage", "mean_share"), ("metrics", "dtw_total_mm")]
    manifest = [type_coerce(by.manifest, JSON)[names] for names in shown]
    others = select(func.max(PolicyDemonstration.demonstration_row)).where(PolicyDemonstration.policy_row == by.row)
    about = select(by.row, by.version, by.demonstration_row, others.scalar_subquery(), *manifest)
    told = {row: rest for row, *rest in session.execute(about.where(by.row.in_(wanted.values())))}
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
    style: _Row, demos: int, versions: int, told: list[Any] | None, newest_demo: int, released: bool
) -> StyleState:
    if told is None:
        return StyleState(style[1], "stored", demos)
    version, demonstration_row, other, shape, *shown = told
    return StyleState(
        suture=style[1],
        state="released" if released else "trained",
        demos=demos,
        versions=versions,
        released=version if released else None,
        shown=Shown(tuple(shape), *shown),
        waiting=newest_demo > max(demonstration_row, other or 0),
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

    def newest(of: Any) -> Any:
        mine = select(of).where(of.surgeon_row == who.row, of.suture == what.slug)
        return session.scalars(mine.order_by(of.row.desc()).limit(MOST_LISTED)).all()

    releases: Sequence[Release] = newest(Release)
    style = _styles(session, [who.row], what.slug).get((who.row, what.slug), StyleState(what.slug, "empty"))
    return WholeStyle(
        surgeon=who,
        suture=what,
        style=style,
        demos=newest(Demonstration),
        versions=newest(PolicyVersion),
        releases=releases,
        served=served(session, who, what.slug),
    )


def surgeons_to_choose(session: Session) -> Sequence[Surgeon] | None:
    """List the surgeons, for a selection in a form; None where they are too many, so that the pseudonym is typed."""
    found = session.scalars(select(Surgeon).order_by(Surgeon.slug).limit(MOST_LISTED + 1)).all()
    return found if len(found) <= MOST_LISTED else None


def all_suture_types(session: Session) -> Sequence[SutureType]:
    """List the suture types."""
    return session.scalars(select(SutureType).order_by(SutureType.slug)).all()


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
    """List the demonstrations cut out of a recording, in the order of their start times."""
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
    job = None if drawn else job_of_pictures(session, playback)
    return Played(playback, drawn is not None, job)


def newest_job(session: Session, kind: str, plan: str) -> Job | None:
    """Return the newest job of a kind for a plan, or for a playback of it."""
    mine = select(Job).where(Job.plan == plan, Job.kind == kind)
    return session.scalar(mine.order_by(Job.row.desc()).limit(1))
