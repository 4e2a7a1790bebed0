"""Carrying out a part of a batch: its styles one after another, each for itself.

A style that cannot be learnt ends with its reason, and the others go on. A worker that is killed leaves its part to the
next one, which goes on where it stopped; what it had begun comes last then, one by one, for it may be what killed it.

What takes long is committed alone. Quick styles are committed a few together, and written together: on SQLite a commit
waits for the disk and holds the one write lock meanwhile, so that with one for each style several workers leave no room
for anybody else's.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from threading import RLock
from time import monotonic
from typing import Any, cast

from sqlalchemy import JSON, Table, bindparam, select, update
from sqlalchemy.orm import Session

from skills.db.base import now
from skills.db.books import Job, StyleToRetrain
from skills.db.models import Demonstration, PolicyVersion, Release
from skills.db.session import Database
from skills.errors import Busy, Conflict, SkillsError
from skills.library import batches, releases
from skills.library.training import Learnt, Lesson, Stored, learn_style, lessons, store_styles
from skills.settings import Settings

TOGETHER = 25  # styles
TOGETHER_S = 0.5  # so long at most does a result wait for the next one, and a cancelled batch go on
LONGEST_REASON = 2000  # characters, as the column has it
NEARLY_ONE = 1 - 1e-9  # what progress adds up to before the end, so that no rounding brings it above 1

# Statements that every style goes through, built once: to build one takes as long as to run it.
_STYLES, _JOBS, _DEMOS, _VERSIONS = (
    cast(Table, one.__table__) for one in (StyleToRetrain, Job, Demonstration, PolicyVersion)
)
QUEUED = select(_STYLES.c.row).where(
    _STYLES.c.row.in_(bindparam("styles", expanding=True)), _STYLES.c.state == "queued"
)
BEGIN = update(_STYLES).where(_STYLES.c.row == bindparam("style")).values(tries=_STYLES.c.tries + 1)
OUTCOME = (
    update(_STYLES)
    .where(_STYLES.c.row == bindparam("style"))
    .values(
        state=bindparam("became"),
        policy_row=bindparam("policy"),
        reason=bindparam("why"),
        comparison=bindparam("compared", type_=JSON(none_as_null=True)),
        ended_at=bindparam("now"),
    )
)
RUNNING = (
    update(_JOBS)
    .where(_JOBS.c.row == bindparam("batch"), _JOBS.c.state == "queued")
    .values(state="running", started_at=bindparam("now"))
)
FURTHER = update(_JOBS).where(_JOBS.c.row == bindparam("batch")).values(progress=_JOBS.c.progress + bindparam("step"))
_NEWEST = (
    select(Release.policy_row)
    .where(Release.surgeon_row == _DEMOS.c.surgeon_row, Release.suture == _DEMOS.c.suture)
    .where(Release.withdrawn_at.is_(None))
    .order_by(Release.row.desc())
    .limit(1)
    .scalar_subquery()
)
SERVED = (
    select(_DEMOS.c.row, _VERSIONS.c.version, _VERSIONS.c.sha256, _VERSIONS.c.manifest)
    .select_from(_DEMOS.join(_VERSIONS, _VERSIONS.c.row == _NEWEST))
    .where(_DEMOS.c.row.in_(bindparam("demonstrations", expanding=True)))
)

log = logging.getLogger(__name__)


# One part at a time: in one interpreter two threads are no faster than one, and take a fifth more of the processor for
# it; there is a worker for each core. The engine hands a second part on meanwhile, so that nobody waits for the engine.
AT_WORK = RLock()
Store = Callable[[Session, str], dict[str, Any]]


@dataclass(frozen=True, eq=False)
class _Style:
    """One style of a part that waits: what it is learnt from, and how often somebody has begun with it."""

    row: int
    tries: int
    lesson: Lesson


_Group = Sequence[_Style]  # begun with in one transaction, one after another


@dataclass(frozen=True)
class _Batch:
    """What is asked for of every style of a batch, and which part of it is carried out."""

    row: int
    part: int
    request: dict[str, Any]
    asked_by: str
    settings: Settings

    def training_of(self, lesson: Lesson) -> dict[str, Any]:
        """Ask for one style as `request_training` does: an equal training gives the same version."""
        same = {name: self.request[name] for name in ("learner", "learner_version", "seed", "release")}
        return {"surgeon": lesson.surgeon.slug, "suture": lesson.suture, "demos": [lesson.sha256], **same}


def retrain_part(database: Database, request: dict[str, Any], settings: Settings) -> Store:
    """Train the styles of a part that are still queued.

    A style that is refused has failed; one at which the service fails stays queued, for the next try at this part.
    """
    with database.reading() as session:
        job = session.get_one(Job, request["retraining"])
        batch = _Batch(job.row, request["part"], job.request, job.asked_by, settings)
    with AT_WORK:
        _train_all(database, batch)

    def store(session: Session, _actor: str) -> dict[str, Any]:
        batches.settle(session, batch.row)
        return {}

    return store


def _train_all(database: Database, batch: _Batch) -> None:
    """Train what a part has left, and raise why a style could not be trained once nothing else is left."""
    broken: dict[int, Exception] = {}
    while waiting := [style for style in _waiting(database, batch.part) if style.row not in broken]:
        groups = _groups(waiting)
        with database.writing() as session:
            _begin(session, batch, groups[0])
        for group, then in zip_longest(groups, groups[1:], fillvalue=()):
            try:
                if _train(database, batch, group, then):
                    continue
            except Busy:
                raise
            except Exception as error:
                log.exception("A style of retraining %d cannot be trained now.", batch.row)
                if len(group) == 1:
                    broken[group[0].row] = error
            break  # cancelled, erased, ended by another worker, or broken: see what is left
    if broken:
        raise next(iter(broken.values()))


def _waiting(database: Database, part: int) -> list[_Style]:
    """Read what a part has left, what was begun with least often first."""
    of = StyleToRetrain
    left = select(of.demonstration_row, of.row, of.tries).where(of.part_row == part, of.state == "queued")
    with database.reading() as session:
        rows = session.execute(left.order_by(of.tries, of.row)).all()
        read = {lesson.row: lesson for lesson in lessons(session, [demonstration for demonstration, *_ in rows])}
    return [_Style(row, tries, read[demonstration]) for demonstration, row, tries in rows]


def _groups(styles: Sequence[_Style]) -> list[_Group]:
    """Take styles together, but those alone that somebody has begun with before."""
    new, begun = [s for s in styles if s.tries == 0], [[s] for s in styles if s.tries > 0]
    return [*(new[first : first + TOGETHER] for first in range(0, len(new), TOGETHER)), *begun]


def _train(database: Database, batch: _Batch, group: _Group, then: _Group) -> bool:
    """Learn some styles and commit what came of each; tell whether all were still waited for."""
    ended: list[tuple[_Style, Learnt | SkillsError]] = []
    since_s = monotonic()
    for style in group:
        ended.append((style, _learn(batch, style)))
        if style is not group[-1] and monotonic() - since_s > TOGETHER_S:
            if not _commit(database, batch, ended, ()):
                return False
            ended, since_s = [], monotonic()
    return _commit(database, batch, ended, then)


def _learn(batch: _Batch, style: _Style) -> Learnt | SkillsError:
    try:
        return learn_style(style.lesson, batch.training_of(style.lesson), batch.settings)
    except SkillsError as refused:
        return refused


def _commit(
    database: Database, batch: _Batch, ended: Sequence[tuple[_Style, Learnt | SkillsError]], then: _Group
) -> bool:
    """End styles, each for itself, and begin with the next ones; tell whether all were still waited for."""
    with database.writing() as session:
        queued = set(session.scalars(QUEUED, {"styles": [style.row for style, _ in ended]}))
        wanted = [(style, learnt) for style, learnt in ended if style.row in queued]
        if wanted:
            session.execute(OUTCOME, list(_outcomes(session, batch, wanted)))
            session.execute(FURTHER, {"batch": batch.row, "step": len(wanted) * NEARLY_ONE / batch.request["styles"]})
        if len(wanted) == len(ended) and then:
            _begin(session, batch, then)
        return len(wanted) == len(ended)


def _begin(session: Session, batch: _Batch, group: _Group) -> None:
    """Note which styles are begun with, before anything is."""
    session.execute(BEGIN, [{"style": style.row} for style in group])
    session.execute(RUNNING, {"batch": batch.row, "now": now()})


def _outcomes(
    session: Session, batch: _Batch, ended: Sequence[tuple[_Style, Learnt | SkillsError]]
) -> Iterator[dict[str, Any]]:
    """Store what was learnt, each for itself, and say what became of each style."""
    learnt = [one for _, one in ended if isinstance(one, Learnt)]
    released = _released(session, [one.lesson.row for one in learnt])
    stored = iter(store_styles(session, learnt))
    for style, one in ended:
        at = next(stored) if isinstance(one, Learnt) else one
        ending = {"style": style.row, "now": now(), "policy": None, "compared": None, "why": None}
        if isinstance(one, Learnt) and isinstance(at, Stored):
            comparison = _kept(session, batch, one, at, released.get(one.lesson.row))
            yield {**ending, "became": "done", "policy": at.row, "compared": comparison}
        else:
            yield {**ending, "became": "failed", "why": str(at)[:LONGEST_REASON]}


# ---- what is released --------------------------------------------------------------------------------------------


def _kept(
    session: Session, batch: _Batch, learnt: Learnt, stored: Stored, released: dict[str, Any] | None
) -> dict[str, Any]:
    """Compare what was stored with what is released, and release it if that was asked and it is not worse."""
    trained = {"version": stored.version, "sha256": learnt.sha256, **figures(learnt.manifest)}
    comparison = compare(released, trained)
    if batch.request["release"]:
        comparison |= _release(session, stored.row, comparison["worse_because"], batch.asked_by)
    return comparison


def _released(session: Session, demonstrations: Sequence[int]) -> dict[int, dict[str, Any]]:
    """Read what the styles of some demonstrations serve, those that serve nothing left out."""
    found = session.execute(SERVED, {"demonstrations": demonstrations})
    return {row: {"version": version, "sha256": sha, **figures(manifest)} for row, version, sha, manifest in found}


def figures(manifest: dict[str, Any]) -> dict[str, Any]:
    """Take from what is said of a policy by what it is compared; shares are of the path's and of all states."""
    metrics, coverage = manifest["metrics"], manifest["coverage"]
    return {
        "demos": manifest["demos"],
        "dtw_total_mm": metrics["dtw_total_mm"],
        "exact_share": metrics["exact_states"] / metrics["path_states"],
        "reaching_share": coverage["starts_reaching_goal"] / coverage["n_states"],
    }


def compare(released: dict[str, Any] | None, trained: dict[str, Any]) -> dict[str, Any]:
    """Set a new policy version beside the released one, each measured against its own demonstration; NaN is worse."""
    worse = []
    if released is not None:
        if not trained["dtw_total_mm"] <= released["dtw_total_mm"]:
            worse.append(f"DTW {trained['dtw_total_mm']:g} mm against {released['dtw_total_mm']:g}")
        if not trained["exact_share"] >= released["exact_share"]:
            worse.append(f"{trained['exact_share']:.1%} of the path exact against {released['exact_share']:.1%}")
        if not trained["reaching_share"] >= released["reaching_share"]:
            worse.append(f"{trained['reaching_share']:.1%} of starts arrive against {released['reaching_share']:.1%}")
    return {
        "released": released,
        "trained": trained,
        "same_demonstration": None if released is None else released["demos"] == trained["demos"],
        "worse_because": worse,
        "now_released": False,
        "not_released_because": None,
    }


def _release(session: Session, policy: int, worse: list[str], actor: str) -> dict[str, Any]:
    if worse:
        return {"not_released_because": f"It is worse than the released version: {'; '.join(worse)}."}
    try:
        releases.release(session, session.get_one(PolicyVersion, policy), actor)
    except Conflict as refused:
        return {"not_released_because": str(refused)}
    return {"now_released": True}
