"""Training of one part of a batch: its styles one after another, each with a result of its own.

A style that cannot be learnt fails with its reason, and the others continue. If a worker is killed, the next one
continues its part at the first style without a result; styles that were already started are then trained last, one by
one, because one of them may have killed the worker.

Slow styles are committed alone. Quick styles are committed some together, stored and released with common statements: a
commit waits for the disk while it holds its locks (on SQLite the only one of all writers), so with a commit for each
style several workers would leave no room for others.
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from threading import RLock
from time import monotonic
from typing import Any

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from skills.db import now
from skills.db.models import PolicyDemonstration, PolicyVersion, Surgeon
from skills.db.packed import unpack_as
from skills.db.service_tables import LONGEST_REASON, Job, StyleToRetrain
from skills.db.session import Database
from skills.errors import Busy, Conflict, SkillsError
from skills.learning.policy import Policy
from skills.library.operation import integrity, jobs, locks
from skills.library.operation.jobs import UNSYNCHRONISED, PartRequest, Store
from skills.library.people.consent import refusal
from skills.library.policies import learning, releases
from skills.library.policies.combined import refuse_unlike
from skills.library.policies.fit import compare_paths, format_mm, not_worse, policy_path, reference_paths
from skills.library.policies.learning import Learnt, Lesson, Stored, combined_lesson, learn_style, lessons
from skills.library.policies.requests import RetrainingRequest, TrainingRequest, requests_of_served
from skills.library.recordings.demos import newest_demos
from skills.library.recordings.recordings import Parser, confined_reader
from skills.schemas.operation import JobResult
from skills.schemas.policies import PolicyManifest
from skills.schemas.training import FitOnTheSame, PolicyFigures, StoredComparison
from skills.settings import Settings

TOGETHER = 25  # styles
TOGETHER_S = 1.0  # the longest time that a result waits for the next one, and that a cancelled batch continues
NEARLY_ONE = 1 - 1e-9  # the sum of all progress steps, below 1 so that rounding cannot exceed 1

log = logging.getLogger(__name__)


# One part at a time: in one interpreter two threads are no faster than one and take a fifth more processor time; there
# is a worker for each core. The engine dispatches a second part meanwhile, so that no part waits for the engine.
AT_WORK = RLock()


@dataclass(frozen=True, eq=False)
class _Style:
    """A queued style of a part: its lesson, and the number of times that it was started.

    `served` is the request of the policy that it serves, whose settings the new one keeps; None: it serves none.
    """

    row: int
    tries: int
    lesson: Lesson
    served: TrainingRequest | None


_Group = Sequence[_Style]  # started in one transaction, trained one after another
_Ended = tuple[_Style, Learnt | SkillsError]


@dataclass(frozen=True)
class _Batch:
    """The request that all styles of a batch share, the part of it that is trained, and the reader of recordings."""

    row: int
    part: int
    request: RetrainingRequest
    requested_by: str
    settings: Settings
    parse: Parser


def retrain_part(database: Database, request: PartRequest, settings: Settings) -> Store[JobResult]:
    """Train the styles of a part that are still queued.

    A style that is refused has failed; a style at which the service itself fails stays queued for the next attempt at
    this part.
    """
    reader = confined_reader(settings)
    with database.reading() as session:
        job = session.get_one(Job, request.retraining)
        shared = RetrainingRequest.model_validate(job.request)
        batch = _Batch(job.row, request.part, shared, job.requested_by, settings, reader.parse)
    with AT_WORK, closing(reader.server):  # it starts only if a recording is not cached
        _train_all(database, batch)

    def store(session: Session, _actor: str) -> JobResult:
        jobs.settle(session, batch.row)
        return JobResult()

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
        served = requests_of_served(session, {lesson.surgeon.row for lesson in read.values()})
    found = [(row, tries, read[demonstration]) for demonstration, row, tries in rows]
    return [_Style(row, tries, one, served.get(one.style)) for row, tries, one in found]


def _groups(styles: Sequence[_Style]) -> list[_Group]:
    """Group new styles by `TOGETHER`; each style that was already started is a group by itself."""
    new, begun = [s for s in styles if s.tries == 0], [[s] for s in styles if s.tries > 0]
    return [*(new[first : first + TOGETHER] for first in range(0, len(new), TOGETHER)), *begun]


def _train(database: Database, batch: _Batch, group: _Group, then: _Group) -> bool:
    """Learn a group of styles and commit the results; return whether all of them were still queued.

    The group `then` is marked as started in the last commit.
    """
    ended: list[_Ended] = []
    since_s = monotonic()
    refused = _refused(database, group)
    for style in group:
        ended.append((style, refused.get(style.lesson.surgeon.row) or _learn(database, batch, style)))
        if style is not group[-1] and monotonic() - since_s > TOGETHER_S:
            if not _commit(database, batch, ended, ()):
                return False
            ended, since_s = [], monotonic()
    return _commit(database, batch, ended, then)


def _refused(database: Database, group: _Group) -> dict[int, SkillsError]:
    """Return, by surgeon, the errors that forbid learning: consent is read now, not taken from the lessons."""
    with database.reading() as session:
        asked = Surgeon.row.in_({style.lesson.surgeon.row for style in group})
        surgeons = session.scalars(select(Surgeon).where(asked)).all()
        return {one.row: why for one in surgeons if (why := refusal(one, "training")) is not None}


def _learn(database: Database, batch: _Batch, style: _Style) -> Learnt | SkillsError:
    lesson, served = style.lesson, style.served
    try:
        found = [lesson]
        if served is not None and served.combine is not None:
            with database.reading() as session:
                newest = newest_demos(session, lesson.surgeon.row, lesson.suture, len(served.demos))
                refuse_unlike(newest)
                found = lessons(session, [one.row for one in newest])
        if not found:
            return Conflict("All demonstrations of the style were withdrawn or marked since the batch was requested.")
        found = learning.with_partners(database, found, batch.parse)
        # A single one is not combined, also if the others were withdrawn since, and the served policy with them.
        demos = [one.sha256 for one in found]
        request = batch.request.training_of((lesson.surgeon.slug, lesson.suture), demos, served)
        return learn_style(combined_lesson(found, request.combine), request, batch.settings)
    except Busy:  # the database or a reader, for now: the part is tried again
        raise
    except SkillsError as refused:
        return refused


def _commit(database: Database, batch: _Batch, ended: Sequence[_Ended], then: _Group) -> bool:
    """End styles, each with its own result, and mark the next group as started; return whether all were queued."""
    with database.reading() as session:  # measured before the locks are taken, which others wait for
        measured = _measured(session, [learnt for _, learnt in ended if isinstance(learnt, Learnt)], {})
    surgeons = {locks.surgeon(style.lesson.surgeon.slug) for style, _ in ended}
    with database.writing([locks.job(batch.row), *surgeons]) as session:
        of = StyleToRetrain
        rows = select(of.row).where(of.row.in_([style.row for style, _ in ended]), of.state == "queued")
        queued = set(session.scalars(rows))
        wanted = [(style, learnt) for style, learnt in ended if style.row in queued]
        if wanted:
            session.execute(update(of), list(_outcomes(session, batch, wanted, measured)))
            step = len(wanted) * NEARLY_ONE / batch.request.styles
            further = update(Job).where(Job.row == batch.row).values(progress=Job.progress + step)
            session.execute(further, **UNSYNCHRONISED)
        if len(wanted) == len(ended) and then:
            _begin(session, batch, then)
        return len(wanted) == len(ended)


def _begin(session: Session, batch: _Batch, group: _Group) -> None:
    """Count a start of each style before it is trained, so that a style that kills its worker can be recognised."""
    of = StyleToRetrain
    started = update(of).where(of.row.in_([style.row for style in group])).values(tries=of.tries + 1)
    session.execute(started, **UNSYNCHRONISED)
    first = update(Job).where(Job.row == batch.row, Job.state == "queued")
    session.execute(first.values(state="running", started_at=now()), **UNSYNCHRONISED)


def _outcomes(
    session: Session, batch: _Batch, ended: Sequence[_Ended], measured: "dict[str, _Measured]"
) -> Iterator[dict[str, Any]]:
    """Store the learnt policies, each independently, and yield the new values of each style's row."""
    learnt = [one for _, one in ended if isinstance(one, Learnt)]
    measured = _measured(session, learnt, measured)  # again where another version was released since
    of_learnt = dict(zip(learnt, learning.store_styles(session, learnt), strict=True))
    stored = {one: at for one, at in of_learnt.items() if isinstance(at, Stored)}
    compared = {one: _compared(one, at, measured.get(one.sha256)) for one, at in stored.items()}
    if batch.request.release:
        compared = dict(_release(session, batch, stored, compared, measured))
    for style, one in ended:
        ending = {"row": style.row, "ended_at": now(), "policy_row": None, "comparison": None, "reason": None}
        if isinstance(one, Learnt) and one in stored:
            yield {**ending, "state": "done", "policy_row": stored[one].row, "comparison": compared[one]}
        else:
            reason = of_learnt[one] if isinstance(one, Learnt) else one
            yield {**ending, "state": "failed", "reason": str(reason)[:LONGEST_REASON]}


# ---- release -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Measured:
    """The version that a style serves, and the distances of it and of the learnt one from the same demonstrations."""

    served: PolicyVersion
    fit: FitOnTheSame


def _measured(session: Session, learnt: Sequence[Learnt], before: Mapping[str, _Measured]) -> dict[str, _Measured]:
    """Measure each learnt policy and the version that its style serves against the same demonstrations.

    Args:
        session: The caller's transaction.
        learnt: The policies, each of another style.
        before: Results of an earlier call, which still hold for the styles that serve the same version.

    Returns:
        By the digest of the learnt policy; styles that serve nothing are left out.
    """
    released = releases.served_versions(session, {one.lesson.style for one in learnt})
    pairs = [(one, released[one.lesson.style]) for one in learnt if one.lesson.style in released]
    known = {one.sha256: before.get(one.sha256) for one, _ in pairs}
    found = {one.sha256: m for one, served in pairs if (m := known[one.sha256]) and m.served.row == served.row}
    pairs = [(one, served) for one, served in pairs if one.sha256 not in found]
    rests_on = {served.row: {one.lesson.row, *one.lesson.others, served.demonstration_row} for one, served in pairs}
    others = select(PolicyDemonstration).where(PolicyDemonstration.policy_row.in_(rests_on))
    for other in session.scalars(others):
        rests_on[other.policy_row].add(other.demonstration_row)
    references = reference_paths(session, set().union(*rests_on.values()))
    for one, served in pairs:
        paths = (
            policy_path(served.sha256, served.manifest, partial(integrity.learnt, served)),
            policy_path(one.sha256, one.manifest, partial(unpack_as, Policy, one.policy)),
        )
        same = [path for row, path in references.items() if row in rests_on[served.row]]
        found[one.sha256] = _Measured(served, compare_paths(*paths, same))
    return found


def _compared(learnt: Learnt, stored: Stored, measured: _Measured | None) -> StoredComparison:
    """Return the comparison of a stored version with the released one."""
    trained = figures(stored.version, learnt.sha256, learnt.manifest)
    if measured is None:
        return compare(None, trained, None)
    served = measured.served
    return compare(figures(served.version, served.sha256, served.manifest), trained, measured.fit)


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


def _release(
    session: Session,
    batch: _Batch,
    stored: Mapping[Learnt, Stored],
    compared: Mapping[Learnt, StoredComparison],
    measured: Mapping[str, _Measured],
) -> Iterator[tuple[Learnt, StoredComparison]]:
    """Release the versions that are not worse than the released ones; yield the comparisons with the outcome."""
    by, turn_deg = batch.requested_by, batch.settings.constant_turn_deg
    better = {one: at for one, at in stored.items() if at.new and not compared[one].worse_because}
    served = {at.row: m.served if (m := measured.get(one.sha256)) else None for one, at in better.items()}
    made = releases.release_new(session, served, by, turn_deg)
    for one, comparison in compared.items():
        row = stored[one].row
        if comparison.worse_because:
            because = f"It is worse than the released version: {'; '.join(comparison.worse_because)}."
            advice = "Release it by its number if it is to replace the released version anyway."
            yield one, replace(comparison, not_released_because=because, remedy=advice)
            continue
        # a version that was stored before is verified
        at = made.get(row) or releases.try_release(session, session.get_one(PolicyVersion, row), by, turn_deg)
        why, remedy = at.not_released_because, at.remedy
        yield one, replace(comparison, now_released=at.released, not_released_because=why, remedy=remedy)
