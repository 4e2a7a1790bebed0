"""Training of one part of a batch: its styles one after another, each with a result of its own.

A style that cannot be learnt fails with its reason, and the others continue. If a worker is killed, the next one
continues its part at the first style without a result; styles that were already started are then trained last, one by
one, because one of them may have killed the worker.

Slow styles are committed alone. Quick styles are committed a few together, and stored with common statements: a commit
waits for the disk while it holds its locks (on SQLite the only one of all writers), so with a commit for each style
several workers would leave no room for others.
"""

import logging
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from threading import RLock
from time import monotonic
from typing import Any, cast

from sqlalchemy import Table, bindparam, select, union_all, update
from sqlalchemy.orm import Session

from skills.comparison.combining import Combining
from skills.db import now
from skills.db.models import Demonstration, PolicyDemonstration, PolicyVersion, Release, Surgeon
from skills.db.packed import unpack_as
from skills.db.service_tables import LONGEST_REASON, Job, StyleToRetrain
from skills.db.session import Database
from skills.errors import Busy, Conflict, SkillsError
from skills.learning.policy import Policy
from skills.library.operation import integrity, jobs, locks
from skills.library.operation.jobs import PartRequest, RetrainingRequest, Store, TrainingRequest
from skills.library.people.consent import refusal
from skills.library.policies import releases
from skills.library.policies.combined import refuse_unlike
from skills.library.policies.fit import compare_paths, format_mm, not_worse, policy_path, reference_paths
from skills.library.policies.learning import (
    Learnt,
    Lesson,
    Stored,
    combined_lesson,
    learn_style,
    lessons,
    store_styles,
    with_partners,
)
from skills.library.policies.served_settings import ServedSettings, learner_for, settings_of_served
from skills.library.recordings.demos import newest_demos
from skills.library.recordings.recordings import Parser, confined_reader
from skills.schemas.policies import PolicyManifest
from skills.schemas.training import FitOnTheSame, PolicyFigures, StoredComparison
from skills.settings import Settings

TOGETHER = 25  # styles
TOGETHER_S = 0.5  # the longest time that a result waits for the next one, and that a cancelled batch continues
NEARLY_ONE = 1 - 1e-9  # the sum of all progress steps, below 1 so that rounding cannot exceed 1

# Statements executed for every style, built once: building one takes as long as executing it.
_STYLES, _JOBS, _DEMOS, _VERSIONS, _SURGEONS, _OTHERS = (
    cast(Table, one.__table__)
    for one in (StyleToRetrain, Job, Demonstration, PolicyVersion, Surgeon, PolicyDemonstration)
)
CONSENT = (
    select(_DEMOS.c.row, _SURGEONS.c.slug, _SURGEONS.c.consent)
    .join_from(_DEMOS, _SURGEONS, _SURGEONS.c.row == _DEMOS.c.surgeon_row)
    .where(_DEMOS.c.row.in_(bindparam("demonstrations", expanding=True)))
)
RESTS_ON = union_all(
    select(_VERSIONS.c.row, _VERSIONS.c.demonstration_row).where(
        _VERSIONS.c.row.in_(bindparam("policies", expanding=True))
    ),
    select(_OTHERS.c.policy_row, _OTHERS.c.demonstration_row).where(
        _OTHERS.c.policy_row.in_(bindparam("policies", expanding=True))
    ),
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
        comparison=bindparam("compared", type_=_STYLES.c.comparison.type),
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
    select(_DEMOS.c.row, _NEWEST.label("policy"), _VERSIONS.c.version, _VERSIONS.c.sha256, _VERSIONS.c.manifest)
    .select_from(_DEMOS.join(_VERSIONS, _VERSIONS.c.row == _NEWEST))
    .where(_DEMOS.c.row.in_(bindparam("demonstrations", expanding=True)))
)

log = logging.getLogger(__name__)


# One part at a time: in one interpreter two threads are no faster than one and take a fifth more processor time; there
# is a worker for each core. The engine dispatches a second part meanwhile, so that no part waits for the engine.
AT_WORK = RLock()


@dataclass(frozen=True, eq=False)
class _Style:
    """A queued style of a part: its lesson, and the number of times that it was started.

    `served` are the settings of the policy that it serves, which the new one keeps; None: it serves none.
    """

    row: int
    tries: int
    lesson: Lesson
    served: ServedSettings | None


_Group = Sequence[_Style]  # started in one transaction, trained one after another


@dataclass(frozen=True)
class _Batch:
    """The request that all styles of a batch share, the part of it that is trained, and the reader of recordings."""

    row: int
    part: int
    request: RetrainingRequest
    requested_by: str
    settings: Settings
    parse: Parser

    def training_of(self, style: _Style, demos: Sequence[str], how: Combining | None = None) -> TrainingRequest:
        """Return the request for one style as `request_training` writes it, so that an equal training is recognised."""
        shared, lesson = self.request, style.lesson
        request: TrainingRequest = {
            "surgeon": lesson.surgeon.slug,
            "suture": lesson.suture,
            "demos": [*demos],
            "learner": learner_for(shared, style.served),
            "learner_version": shared["learner_version"],
            "gate": shared["gate"],
            "poses": shared["poses"],
            "near": shared["near"],
            "seed": shared["seed"],
            "release": shared["release"],
        }
        if style.served is not None and style.served.surroundings is not None:
            request |= {"surroundings": style.served.surroundings.as_json(), "odds": shared["odds"]}
        if how is not None:
            request["combine"] = {"kind": how}
        return request


def retrain_part(database: Database, request: PartRequest, settings: Settings) -> Store:
    """Train the styles of a part that are still queued.

    A style that is refused has failed; a style at which the service itself fails stays queued for the next attempt at
    this part.
    """
    reader = confined_reader(settings)
    with database.reading() as session:
        job = session.get_one(Job, request["retraining"])
        shared = cast(RetrainingRequest, job.request)
        batch = _Batch(job.row, request["part"], shared, job.requested_by, settings, reader.parse)
    with AT_WORK, closing(reader.server):  # it starts only if a recording is not cached
        _train_all(database, batch)

    def store(session: Session, _actor: str) -> dict[str, Any]:
        jobs.settle(session, batch.row)
        return {}

    return store


def _train_all(database: Database, batch: _Batch) -> None:
    """Train the remaining styles of a part; once only failing ones remain, raise the error of the first."""
    broken: dict[int, Exception] = {}
    while waiting := [style for style in _waiting(database, batch.part) if style.row not in broken]:
        groups = _groups(waiting)
        with database.writing([locks.job(batch.row)]) as session:
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
            break  # cancelled, erased, ended by another worker, or failed: read the remaining styles again
    if broken:
        raise next(iter(broken.values()))


def _waiting(database: Database, part: int) -> list[_Style]:
    """Return the queued styles of a part, those with the fewest starts first."""
    of = StyleToRetrain
    left = select(of.demonstration_row, of.row, of.tries).where(of.part_row == part, of.state == "queued")
    with database.reading() as session:
        rows = session.execute(left.order_by(of.tries, of.row)).all()
        read = {lesson.row: lesson for lesson in lessons(session, [demonstration for demonstration, *_ in rows])}
        surgeons = {lesson.surgeon.row for lesson in read.values()}
        served = settings_of_served(session, surgeons)
    found = [(row, tries, read[demonstration]) for demonstration, row, tries in rows]
    return [_Style(row, tries, one, served.get((one.surgeon.row, one.suture))) for row, tries, one in found]


def _groups(styles: Sequence[_Style]) -> list[_Group]:
    """Group new styles by `TOGETHER`; each style that was already started is a group by itself."""
    new, begun = [s for s in styles if s.tries == 0], [[s] for s in styles if s.tries > 0]
    return [*(new[first : first + TOGETHER] for first in range(0, len(new), TOGETHER)), *begun]


def _train(database: Database, batch: _Batch, group: _Group, then: _Group) -> bool:
    """Learn a group of styles and commit the results; return whether all of them were still queued.

    The group `then` is marked as started in the last commit.
    """
    ended: list[tuple[_Style, Learnt | SkillsError]] = []
    since_s = monotonic()
    refused = _refused(database, group)
    for style in group:
        ended.append((style, refused.get(style.lesson.row) or _learn(database, batch, style)))
        if style is not group[-1] and monotonic() - since_s > TOGETHER_S:
            if not _commit(database, batch, ended, ()):
                return False
            ended, since_s = [], monotonic()
    return _commit(database, batch, ended, then)


def _refused(database: Database, group: _Group) -> dict[int, SkillsError]:
    """Return, by demonstration, the errors that forbid learning: consent is read now, not taken from the lessons."""
    with database.reading() as session:
        found = session.execute(CONSENT, {"demonstrations": [style.lesson.row for style in group]}).all()
    return {one.row: why for one in found if (why := refusal(one, "training")) is not None}


def _learn(database: Database, batch: _Batch, style: _Style) -> Learnt | SkillsError:
    lesson, served = style.lesson, style.served
    try:
        found, combining = [lesson], None if served is None else served.combining
        if served is not None and combining is not None:
            with database.reading() as session:
                newest = newest_demos(session, lesson.surgeon.row, lesson.suture, served.demos)
                refuse_unlike(newest)
                found = lessons(session, [one.row for one in newest])
        if not found:
            return Conflict("All demonstrations of the style were withdrawn or marked since the batch was requested.")
        found = with_partners(database, found, batch.parse)
        if len(found) == 1:  # also if the others were withdrawn since, and the served policy with them
            combining = None
        asked = batch.training_of(style, [one.sha256 for one in found], combining)
        return learn_style(found[0] if combining is None else combined_lesson(found, combining), asked, batch.settings)
    except Busy:  # the database or a reader, for now: the part is tried again
        raise
    except SkillsError as refused:
        return refused


def _commit(
    database: Database, batch: _Batch, ended: Sequence[tuple[_Style, Learnt | SkillsError]], then: _Group
) -> bool:
    """End styles, each with its own result, and mark the next group as started; return whether all were queued."""
    with database.reading() as session:  # measured before the locks are taken, which others wait for
        measured = _measured(session, [learnt for _, learnt in ended if isinstance(learnt, Learnt)])
    surgeons = {locks.surgeon(style.lesson.surgeon.slug) for style, _ in ended}
    with database.writing([locks.job(batch.row), *surgeons]) as session:
        queued = set(session.scalars(QUEUED, {"styles": [style.row for style, _ in ended]}))
        wanted = [(style, learnt) for style, learnt in ended if style.row in queued]
        if wanted:
            session.execute(OUTCOME, list(_outcomes(session, batch, wanted, measured)))
            session.execute(FURTHER, {"batch": batch.row, "step": len(wanted) * NEARLY_ONE / batch.request["styles"]})
        if len(wanted) == len(ended) and then:
            _begin(session, batch, then)
        return len(wanted) == len(ended)


def _begin(session: Session, batch: _Batch, group: _Group) -> None:
    """Count a start of each style before it is trained, so that a style that kills its worker can be recognised."""
    session.execute(BEGIN, [{"style": style.row} for style in group])
    session.execute(RUNNING, {"batch": batch.row, "now": now()})


def _outcomes(
    session: Session,
    batch: _Batch,
    ended: Sequence[tuple[_Style, Learnt | SkillsError]],
    measured: "dict[str, _Measured]",
) -> Iterator[dict[str, Any]]:
    """Store the learnt policies, each independently, and yield the values to store for each style."""
    learnt = [one for _, one in ended if isinstance(one, Learnt)]
    released = _released(session, learnt)
    changed = [
        one for one in learnt if one.sha256 in released and not _still(measured.get(one.sha256), released[one.sha256])
    ]
    measured = measured | _measured(session, changed)  # another version was released since they were measured
    stored = iter(store_styles(session, learnt))
    for style, one in ended:
        at = next(stored) if isinstance(one, Learnt) else one
        ending = {"style": style.row, "now": now(), "policy": None, "compared": None, "why": None}
        if isinstance(one, Learnt) and isinstance(at, Stored):
            compared = measured[one.sha256] if one.sha256 in released else None
            comparison = _compared(session, batch, one, at, compared)
            yield {**ending, "became": "done", "policy": at.row, "compared": comparison}
        else:
            yield {**ending, "became": "failed", "why": str(at)[:LONGEST_REASON]}


# ---- release -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Served:
    """The policy version that a style serves: its row and its manifest."""

    policy: int
    version: int
    sha256: str
    manifest: PolicyManifest


@dataclass(frozen=True, eq=False)
class _Measured:
    """The version that a style serves, and the distances of it and of the learnt one from the same demonstrations."""

    served: _Served
    fit: FitOnTheSame


def _released(session: Session, learnt: Sequence[Learnt]) -> dict[str, _Served]:
    """Return, by the digest of each learnt policy, the version that its style serves; others are left out."""
    rows = {one.lesson.row: one.sha256 for one in learnt}
    found = session.execute(SERVED, {"demonstrations": [*rows]})
    return {rows[row]: _Served(*about) for row, *about in found}


def _measured(session: Session, learnt: Sequence[Learnt]) -> dict[str, _Measured]:
    """Measure each learnt policy and the version that its style serves against the same demonstrations.

    Returns:
        By the digest of the learnt policy; styles that serve nothing are left out.
    """
    served = _released(session, learnt)
    if not served:
        return {}
    rests_on = {one.sha256: {one.lesson.row, *one.lesson.others} for one in learnt}
    by_policy = {one.policy: sha256 for sha256, one in served.items()}
    for policy, demonstration in session.execute(RESTS_ON, {"policies": [*by_policy]}):
        rests_on[by_policy[policy]].add(demonstration)
    demos = reference_paths(session, set().union(*(rests_on[sha256] for sha256 in served)))
    measured = {}
    for one in learnt:
        if (before := served.get(one.sha256)) is not None:
            released = policy_path(before.manifest, partial(_policy, session, before.policy))
            trained = policy_path(one.manifest, partial(unpack_as, Policy, one.policy))
            same = [demo for row, demo in demos.items() if row in rests_on[one.sha256]]
            measured[one.sha256] = _Measured(before, compare_paths(released, trained, same))
    return measured


def _policy(session: Session, row: int) -> Policy:
    return integrity.learnt(session.get_one(PolicyVersion, row))


def _still(measured: _Measured | None, served: _Served) -> bool:
    return measured is not None and measured.served.policy == served.policy


def _compared(
    session: Session, batch: _Batch, learnt: Learnt, stored: Stored, measured: _Measured | None
) -> StoredComparison:
    """Return the comparison of a stored version with the released one; release it if requested and it is not worse."""
    trained = figures(stored.version, learnt.sha256, learnt.manifest)
    if measured is None:
        comparison = compare(None, trained, None)
    else:
        served = measured.served
        comparison = compare(figures(served.version, served.sha256, served.manifest), trained, measured.fit)
    if batch.request["release"]:
        comparison = _release(session, stored.row, comparison, batch.requested_by)
    return comparison


def figures(version: int, sha256: str, manifest: PolicyManifest) -> PolicyFigures:
    """Return the figures of a version that are compared; shares are of the path's states and of all states."""
    metrics, coverage = manifest.metrics, manifest.coverage
    return PolicyFigures(
        version=version,
        sha256=sha256,
        demos=tuple(manifest.demos),
        rests_on=len(manifest.demos),
        dtw_total_mm=metrics.dtw_total_mm,
        exact_share=metrics.exact_states / metrics.path_states,
        reaching_share=coverage.starts_reaching_goal / coverage.n_states,
        mean_share=coverage.mean_share,
    )


def compare(released: PolicyFigures | None, trained: PolicyFigures, fit: FitOnTheSame | None) -> StoredComparison:
    """Compare a new policy version with the released one, on the same demonstrations; NaN counts as worse."""
    return StoredComparison(
        released=released,
        trained=trained,
        same_demonstration=None if released is None else released.demos == trained.demos,
        on_the_same=fit,
        worse_because=() if released is None or fit is None else tuple(_worse(released, trained, fit)),
        now_released=False,
        not_released_because=None,
        remedy=None,
    )


def _worse(released: PolicyFigures, trained: PolicyFigures, fit: FitOnTheSame) -> Iterator[str]:
    """Yield the figures in which a new version is worse than the released one."""
    if not not_worse(fit):
        on = f"on the same {len(fit.demos)} demonstrations" if len(fit.demos) != 1 else "on the same demonstration"
        yield f"DTW {format_mm(fit.trained_mm)} mm against {format_mm(fit.released_mm)} {on}"
    if not trained.rests_on >= released.rests_on:
        yield f"it was learnt from {trained.rests_on} of them, the released one from {released.rests_on}"
    if not trained.exact_share >= released.exact_share:
        yield f"{trained.exact_share:.1%} of the path exact against {released.exact_share:.1%}"
    if not trained.reaching_share >= released.reaching_share:
        yield f"{trained.reaching_share:.1%} of starts reach the goal against {released.reaching_share:.1%}"
    # Beside another demonstration a share of another path says nothing.
    before, after = released.mean_share, trained.mean_share
    if released.demos == trained.demos and not after >= before:
        yield f"a start follows {after:.1%} of the demonstration on average against {before:.1%}"


def _release(session: Session, policy: int, comparison: StoredComparison, actor: str) -> StoredComparison:
    if comparison.worse_because:
        because = f"It is worse than the released version: {'; '.join(comparison.worse_because)}."
        advice = "Release it by its number if it is to replace the released version anyway."
        return replace(comparison, not_released_because=because, remedy=advice)
    made = releases.try_release(session, session.get_one(PolicyVersion, policy), actor)
    return replace(
        comparison,
        now_released=made.released,
        not_released_because=made.not_released_because,
        remedy=made.remedy,
    )
