"""Jobs: requests for work, deduplicated by their identity, and the bookkeeping of batches.

A job's identity is the digest of its kind and inputs; an equal request returns the same job.

A batch is a job whose styles have rows of their own and are handed to the engine in parts:

    a job `retraining`             the request; never submitted to the engine
      jobs `retraining-part`       submitted to the engine, a few styles each; users do not see them
        styles                     queued, then done, failed or cancelled, each independently

A style is ended by changing its state from `queued` in the transaction that stores its result: so it ends once,
even if several workers train it. The batch ends in the same transaction as its last part.
"""

import secrets
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from typing import Any, ClassVar, NamedTuple, TypeVar, cast

from pydantic import BaseModel, ConfigDict
from sqlalchemy import ColumnElement, ScalarSelect, Select, Table, delete, exists, func, select, update
from sqlalchemy.orm import Session, aliased

from skills.db import now
from skills.db.models import Demonstration, PolicyVersion, Release, Surgeon
from skills.db.row_visibility import ALL_ROWS
from skills.db.service_tables import ErasedSurgeon, Job, StyleToRetrain, record_event
from skills.db.session import Database
from skills.errors import Conflict, DatabaseBusy, NotFound, TooMany
from skills.library.operation import locks
from skills.library.people.consent import require
from skills.library.policies.releases import is_served
from skills.packing import canonical, sha256
from skills.remedies import Action, Remedy
from skills.schemas.operation import JobResult
from skills.schemas.training import StoredComparison

TRAINING, BATCH, PART = "training", "retraining", "retraining-part"
EXPORT, PICTURES = "dataset", "pictures"
ACTIVE = ("queued", "running")
Result = TypeVar("Result", bound=JobResult)
Store = Callable[[Session, str], Result]  # stores a result in a transaction, on behalf of this actor
# For statements that change many rows: no object of the session has to follow, so none is searched for.
UNSYNCHRONISED: Any = {"execution_options": {"synchronize_session": False}}
Rows = Sequence[int] | Select[int]  # at most as many as a statement may have parameters, or a query


def attempts_to_submit(session: Session, job: Job) -> list[tuple[int, int]]:
    """List the rows and attempts to submit to the engine for a job: its own, or those of a batch's parts."""
    if job.kind != BATCH:
        return [(job.row, job.attempt)]
    parts = select(StyleToRetrain.part_row).where(StyleToRetrain.job_row == job.row)
    mine = select(Job.row, Job.attempt).where(Job.row.in_(parts)).order_by(Job.row)
    return [(row, attempt) for row, attempt in session.execute(mine)]


def count(session: Session, batch: int) -> dict[str, int]:
    """Return the number of a batch's styles in each state."""
    states = dict.fromkeys(("queued", "done", "failed", "cancelled"), 0)
    mine = select(StyleToRetrain.state, func.count().label("styles")).where(StyleToRetrain.job_row == batch)
    return states | {found.state: found.styles for found in session.execute(mine.group_by(StyleToRetrain.state))}


def changed_since(session: Session, batch: int) -> set[int]:
    """Return the demonstrations of the styles of a batch that now serve another version than when the batch ended them.

    For a style that the batch released: another version than the released one, or none. For a style that it did not
    release: another version than the one it was compared with.
    """
    of, by = StyleToRetrain, Demonstration
    done = select(by.row, of.comparison, served_now()).join(by, by.row == of.demonstration_row)
    mine = of.job_row == batch, of.state == "done", ~_serving()
    return {row for row, compared, now in session.execute(done.where(*mine)) if now != served_then(compared)}


def served_now() -> ScalarSelect[str]:
    """Return the digest of the version that the style of a `Demonstration` serves, as a subquery."""
    by = Demonstration
    served = select(PolicyVersion.sha256).join(Release, Release.policy_row == PolicyVersion.row)
    mine = (Release.surgeon_row == by.surgeon_row, Release.suture == by.suture, is_served())
    return served.where(*mine).correlate(by).scalar_subquery()


def served_then(comparison: StoredComparison | None) -> str | None:
    """Return the digest of the version that a style served when a batch ended it, of one that is done."""
    assert comparison is not None
    served = comparison.trained if comparison.now_released else comparison.released
    return None if served is None else served.sha256


def count_serving(session: Session, batch: int) -> tuple[int, int]:
    """Return the number of a batch's styles that serve its version now, and the number of those that are done."""
    done = select(func.count()).where(StyleToRetrain.job_row == batch, StyleToRetrain.state == "done")
    return session.scalar(done.where(_serving())) or 0, session.scalar(done) or 0


def _serving() -> ColumnElement[bool]:
    """Return a condition on `StyleToRetrain`: its version is the one that its style serves."""
    return exists().where(Release.policy_row == StyleToRetrain.policy_row, is_served()).correlate(StyleToRetrain)


def cancel_parts(session: Session, batch: int) -> None:
    """Cancel all parts and styles of a batch that have not ended."""
    parts = select(StyleToRetrain.part_row).where(StyleToRetrain.job_row == batch)
    ended = {"state": "cancelled", "ended_at": now()}
    session.execute(update(Job).where(Job.row.in_(parts), Job.state.in_(ACTIVE)).values(**ended), **UNSYNCHRONISED)
    mine = (StyleToRetrain.job_row == batch, StyleToRetrain.state == "queued")
    session.execute(update(StyleToRetrain).where(*mine).values(**ended), **UNSYNCHRONISED)


def end_part(session: Session, batch: int, part: int, state: str, reason: str) -> None:
    """End the remaining styles of a part that ended without them, and the batch if that was its last part."""
    left = (StyleToRetrain.part_row == part, StyleToRetrain.state == "queued")
    ended = {"state": state, "reason": reason, "ended_at": now()}
    session.execute(update(StyleToRetrain).where(*left).values(**ended), **UNSYNCHRONISED)
    settle(session, batch)


def settle(session: Session, batch: int) -> None:
    """End a batch if none of its styles is queued any more; it has failed if a style has failed."""
    counted = count(session, batch)
    if counted["queued"]:
        return
    # A batch to whose styles others are still added has not ended.
    complete = Job.submitted_at.is_not(None)
    state = "failed" if counted["failed"] else "cancelled" if counted["cancelled"] else "succeeded"
    ended = {"state": state, "progress": 1.0, "result": counted, "error": _why(counted), "ended_at": now()}
    # Only the transaction that changes the state records the event.
    mine = (Job.row == batch, Job.state.in_(ACTIVE), complete)
    job = session.scalar(update(Job).where(*mine).values(**ended).returning(Job.id))
    if job is not None:
        record_event(session, "worker", "finish", f"job-{BATCH}", job)


def forget_styles(session: Session, demonstrations: Rows | None, batches: Rows | None) -> None:
    """Delete the styles of erased demonstrations from all batches, and all styles of erased batches.

    Their parts continue without them, and end the batch.
    """
    for column, rows in ((StyleToRetrain.demonstration_row, demonstrations), (StyleToRetrain.job_row, batches)):
        if rows is not None:
            session.execute(delete(StyleToRetrain).where(column.in_(rows)), **UNSYNCHRONISED)


def _why(counted: dict[str, int]) -> str | None:
    styles = sum(counted.values())
    if counted["failed"]:
        return f"{counted['failed']} of {styles} styles failed; the batch names them. The others are done."
    return f"{counted['cancelled']} of {styles} styles were cancelled." if counted["cancelled"] else None


JOBS_WAIT_S = 10.0  # the `Retry-After` of `TooMany`: some trainings later


class JobRequest(BaseModel):
    """The request of a job, all defaults resolved: the base class of those of each kind.

    Fields that are None are not stored, so that one which is added later changes no identity.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)
    kind: ClassVar[str]

    @property
    def stored(self) -> dict[str, Any]:
        """The plain JSON in the job's row."""
        return self.model_dump(mode="json", exclude_none=True)

    @property
    def identity(self) -> str:
        """The digest of the kind and of all inputs."""
        return identity_of(self.kind, self.stored)


class PartRequest(JobRequest):
    """The request of a part of a batch: the rows of both jobs, no personal data."""

    kind: ClassVar[str] = PART

    retraining: int
    part: int


class RequestedJob(NamedTuple):
    """A requested job, whether it is new, and the effect of the request, in words."""

    job: Job
    new: bool
    did: str


def ask(session: Session, request: JobRequest, surgeon: Surgeon | None, actor: str) -> RequestedJob:
    """Queue work whose inputs are all resolved.

    An equal request that is queued, running or done returns the same job; after a failed or cancelled one a new job is
    queued.
    """
    stored = request.stored
    identity = identity_of(request.kind, stored)
    known = _live(session, identity)
    if known is not None:
        return RequestedJob(known, False, did_nothing(known))
    job = Job(
        id=secrets.token_hex(8),
        kind=request.kind,
        identity=identity,
        request=stored,
        plan=stored.get("plan"),
        surgeon_row=surgeon.row if surgeon else None,
        requested_by=actor,
    )
    session.add(job)
    session.flush()
    record_event(session, actor, "ask", f"job-{job.kind}", job.id, surgeon)
    return RequestedJob(job, True, "A new job is queued.")


def find_live(session: Session, request: JobRequest) -> Job | None:
    """Return the job of an equal request that is queued, running or done, even if the caller may not see it."""
    return _live(session, request.identity)


def _live(session: Session, identity: str) -> Job | None:
    alike = select(Job).where(Job.identity == identity, Job.state.in_(("queued", "running", "succeeded")))
    # All rows, not only the caller's: an equal job must not be queued twice.
    return session.scalar(alike.execution_options(**ALL_ROWS))


def while_running(database: Database, row: int, attempt: int) -> Database:
    """Return a database that a job writes to: each transaction is refused once the job does not run at this attempt.

    Erasing deletes the jobs whose result would bring back what was erased, so they end here too. All work on one
    surgeon's motion is training: it is refused once the consent does not cover that.
    """
    mine = (Job.row == row, Job.attempt == attempt, Job.state == "running")

    def check(session: Session) -> None:
        if (job := session.scalar(select(Job).where(*mine))) is None:
            raise Conflict("The job was cancelled while it ran, or something that it uses was erased.")
        if (surgeon := session.get(Surgeon, job.surgeon_row or 0)) is not None:
            require(surgeon, "training")

    with database.reading() as session:
        names = names_of(session, row)
        check(session)
    return database.on_condition(check, [locks.job(row)] if names is None else names)


def progress_callback(database: Database, request: JobRequest) -> Callable[[float], None]:
    """Return a callback that stores the progress of a running job, in the database of `while_running`."""
    mine = (Job.identity == request.identity, Job.state == "running")

    def tell(share: float) -> None:
        with suppress(DatabaseBusy), database.writing(()) as session:  # the next one is stored; the work is not lost
            session.execute(update(Job).where(*mine).values(progress=share), **UNSYNCHRONISED)

    return tell


def did_nothing(job: Job) -> str:
    """Return the sentence that a request had no effect because an equal job exists."""
    return f"Nothing: an equal job {'has succeeded' if job.state == 'succeeded' else f'is {job.state}'} already."


def refuse_too_many(session: Session, actor: str, most: int) -> None:
    """Refuse more work for an actor who already has `most` jobs queued or running; a batch counts as one.

    Raises:
        TooMany: The limit is reached.
    """
    # Parts are left out, because their batch counts as one.
    mine = select(func.count()).where(Job.requested_by == actor, Job.state.in_(ACTIVE), Job.kind != PART)
    waiting = session.scalar(mine.select_from(Job)) or 0
    if waiting >= most:
        raise TooMany(
            f"You have {waiting} jobs waiting or running; wait for some of them, or cancel them.", JOBS_WAIT_S
        )


def identity_of(kind: str, request: Mapping[str, object]) -> str:
    """Return the identity of a request as it is stored: the digest of its kind and of all its inputs."""
    return sha256(canonical([kind, request]))


def shown() -> list[ColumnElement[bool]]:
    """Return the conditions on the jobs that users see: no parts of batches, and no jobs of erased surgeons."""
    erased = cast(Table, ErasedSurgeon.__table__).c.surgeon_row
    # A scalar and not `exists`, which PostgreSQL may turn into a join, for which it reads and sorts all jobs.
    of_job = select(erased).where(erased == Job.surgeon_row).correlate(Job).scalar_subquery()
    return [Job.kind != PART, of_job.is_(None)]


def requested_again() -> ColumnElement[bool]:
    """Return a condition on `Job`: there is a later job with the same request."""
    later = aliased(Job)
    return exists().where(later.identity == Job.identity, later.row > Job.row).correlate(Job)


def newest(session: Session, request: JobRequest) -> Job | None:
    """Return the newest job with exactly this request, in any state."""
    mine = select(Job).where(Job.identity == request.identity)
    return session.scalar(mine.order_by(Job.row.desc()).limit(1))


def find_job(session: Session, job_id: str) -> Job:
    """Return a job by its id."""
    job = session.scalar(select(Job).where(Job.id == job_id, *shown()))
    if job is None:
        raise NotFound("There is no job with this id.", Remedy(Action.LIST_JOBS))
    return job


def find_jobs(session: Session, job_ids: Collection[str]) -> Sequence[Job]:
    """Return jobs by their ids, with one query; unknown ids are left out."""
    return session.scalars(select(Job).where(Job.id.in_(job_ids), *shown())).all()


def list_jobs(
    session: Session, limit: int, before: int | None, state: str | None, kind: str | None = None
) -> Sequence[Job]:
    """List jobs, the newest first: all, or those in one state or of one kind."""
    query = select(Job).where(*shown()).order_by(Job.row.desc()).limit(limit)
    if before is not None:
        query = query.where(Job.row < before)
    asked = {"state": state, "kind": kind}
    return session.scalars(query.filter_by(**{name: one for name, one in asked.items() if one is not None})).all()


def names_of(session: Session, row: int) -> list[str] | None:
    """Return the names under which the end of a job is stored (`skills.library.operation.locks`): its own, its batch's,
    its surgeon's; None for an export, which asks for the consent of many surgeons.
    """
    query = select(Job.kind, Job.request, Surgeon.slug).outerjoin(Surgeon, Surgeon.row == Job.surgeon_row)
    found = session.execute(query.where(Job.row == row)).first()
    if found is None:
        return [locks.job(row)]
    if found.kind == EXPORT:
        return None
    of_batch = [locks.job(found.request["retraining"])] if found.kind == PART else []
    return [locks.job(row), *of_batch, *([] if found.slug is None else [locks.surgeon(found.slug)])]


def cancel(session: Session, job_id: str, actor: str) -> Job:
    """Cancel a job that is queued or running: its result will not be stored.

    The caller's transaction holds the name of the job.

    Raises:
        Conflict: It has ended.
    """
    job = find_job(session, job_id)
    ended = {"state": "cancelled", "ended_at": now()}
    done = session.execute(
        update(Job).where(Job.row == job.row, Job.state.in_(ACTIVE)).values(**ended).returning(Job.row)
    )
    if done.first() is None and job.state != "cancelled":
        raise Conflict(f"The job has ended already: it {job.state}.")
    if job.kind == BATCH:
        cancel_parts(session, job.row)
    session.refresh(job)
    record_event(session, actor, "cancel", f"job-{job.kind}", job.id)
    return job
