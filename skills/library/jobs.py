"""Jobs: work that was asked for, deduplicated by what was asked."""

import secrets
from collections.abc import Sequence
from typing import Any

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from skills.db.base import now
from skills.db.books import Job
from skills.db.models import Surgeon
from skills.db.seen import EVERYBODYS
from skills.errors import Conflict, NotFound, TooMany
from skills.library.batches import BATCH, PART, cancel_parts
from skills.library.events import record
from skills.packing import canonical, sha256

LIVE = ("queued", "running", "succeeded")
ACTIVE = ("queued", "running")
JOBS_WAIT_S = 10.0  # some trainings later


def ask(session: Session, kind: str, request: dict[str, Any], surgeon: Surgeon | None, actor: str) -> tuple[Job, bool]:
    """Ask for work, resolved in all its inputs: the job, and whether it is a new one.

    An equal request that is waiting, running or done gives the same job; a failed or cancelled one gives a new one.
    """
    identity = identity_of(kind, request)
    alike = select(Job).where(Job.identity == identity, Job.state.in_(LIVE))
    known = session.scalar(alike.execution_options(**EVERYBODYS))
    if known is not None:
        return known, False
    job = Job(
        id=secrets.token_hex(8),
        kind=kind,
        identity=identity,
        request=request,
        surgeon_row=surgeon.row if surgeon else None,
        asked_by=actor,
    )
    session.add(job)
    session.flush()
    record(session, actor, "ask", f"job-{kind}", job.id, surgeon)
    return job, True


def refuse_too_many(session: Session, actor: str, most: int) -> None:
    """Refuse more work for somebody who has so much waiting or running already; a batch counts as one.

    Raises:
        TooMany: They have.
    """
    mine = select(func.count()).where(Job.asked_by == actor, Job.state.in_(ACTIVE), Job.kind != PART)
    waiting = session.scalar(mine.select_from(Job)) or 0
    if waiting >= most:
        raise TooMany(
            f"You have {waiting} jobs waiting or running; wait for some of them, or cancel them.", JOBS_WAIT_S
        )


def identity_of(kind: str, request: dict[str, Any]) -> str:
    """Compute what a request is known by: the digest of its kind and of all its inputs."""
    return sha256(canonical([kind, request]))


def newest(session: Session, kind: str, request: dict[str, Any]) -> Job | None:
    """Find the newest job of those that were asked for in exactly this way, whatever became of it."""
    mine = select(Job).where(Job.identity == identity_of(kind, request))
    return session.scalar(mine.order_by(Job.row.desc()).limit(1))


def find_job(session: Session, job_id: str) -> Job:
    """Find a job by its id."""
    job = session.scalar(select(Job).where(Job.id == job_id, Job.kind != PART))
    if job is None:
        raise NotFound("There is no such job; GET /jobs lists them.")
    return job


def list_jobs(
    session: Session, limit: int, before: int | None, state: str | None, kind: str | None = None
) -> Sequence[Job]:
    """List jobs, the newest first: all, or those in a state, or of a kind."""
    query = select(Job).where(Job.kind != PART).order_by(Job.row.desc()).limit(limit)
    if before is not None:
        query = query.where(Job.row < before)
    if state is not None:
        query = query.where(Job.state == state)
    if kind is not None:
        query = query.where(Job.kind == kind)
    return session.scalars(query).all()


def cancel(session: Session, job_id: str, actor: str) -> Job:
    """Cancel a job that is waiting or running: no result of it will be kept.

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
    record(session, actor, "cancel", f"job-{job.kind}", job.id)
    return job
