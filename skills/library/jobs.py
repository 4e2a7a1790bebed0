"""Jobs: work that was asked for, deduplicated by what was asked."""

import secrets
from collections.abc import Sequence
from typing import Any

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from skills.db.base import now
from skills.db.models import Job, Surgeon
from skills.errors import Conflict, NotFound
from skills.library.batches import BATCH, PART, cancel_parts
from skills.library.events import record
from skills.packing import canonical, sha256

LIVE = ("queued", "running", "succeeded")
ACTIVE = ("queued", "running")


def ask(session: Session, kind: str, request: dict[str, Any], surgeon: Surgeon | None, actor: str) -> tuple[Job, bool]:
    """Ask for work, resolved in all its inputs: the job, and whether it is a new one.

    An equal request that is waiting, running or done gives the same job; a failed or cancelled one gives a new one.
    """
    identity = identity_of(kind, request)
    known = session.scalar(select(Job).where(Job.identity == identity, Job.state.in_(LIVE)))
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


def list_jobs(session: Session, limit: int, before: int | None, state: str | None) -> Sequence[Job]:
    """List jobs, the newest first."""
    query = select(Job).where(Job.kind != PART).order_by(Job.row.desc()).limit(limit)
    if before is not None:
        query = query.where(Job.row < before)
    if state is not None:
        query = query.where(Job.state == state)
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
