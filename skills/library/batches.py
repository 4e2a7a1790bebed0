"""The bookkeeping of a batch: a job whose styles are rows of their own, handed to the engine in parts.

    a job `retraining`             what was asked for; never told to the engine
      jobs `retraining-part`       what the engine is told of, a few styles each; users do not see them
        styles                     queued, and then done, failed or cancelled, each for itself

Whoever ends a style's wait changes it from `queued`, in one transaction with what came of it: so a style ends once,
whoever else is at work on it. The batch ends in the transaction in which its last part does.
"""

from collections.abc import Sequence

from sqlalchemy import delete, func, select, update
from sqlalchemy.orm import Session

from skills.db.base import now
from skills.db.books import Job, StyleToRetrain
from skills.library.events import record

BATCH, PART = "retraining", "retraining-part"
ACTIVE = ("queued", "running")


def to_tell(session: Session, job: Job) -> list[tuple[int, int]]:
    """List what the engine is told of a job, as rows and attempts: the job, or the parts of a batch."""
    if job.kind != BATCH:
        return [(job.row, job.attempt)]
    parts = select(StyleToRetrain.part_row).where(StyleToRetrain.job_row == job.row)
    mine = select(Job.row, Job.attempt).where(Job.row.in_(parts)).order_by(Job.row)
    return [(row, attempt) for row, attempt in session.execute(mine)]


def count(session: Session, batch: int) -> dict[str, int]:
    """Count a batch's styles by their state."""
    states = dict.fromkeys(("queued", "done", "failed", "cancelled"), 0)
    mine = select(StyleToRetrain.state, func.count().label("styles")).where(StyleToRetrain.job_row == batch)
    return states | {found.state: found.styles for found in session.execute(mine.group_by(StyleToRetrain.state))}


def cancel_parts(session: Session, batch: int) -> None:
    """Cancel all of a batch that has not ended."""
    parts = select(StyleToRetrain.part_row).where(StyleToRetrain.job_row == batch)
    ended = {"state": "cancelled", "ended_at": now()}
    session.execute(update(Job).where(Job.row.in_(parts), Job.state.in_(ACTIVE)).values(**ended), **_UNSEEN)
    mine = (StyleToRetrain.job_row == batch, StyleToRetrain.state == "queued")
    session.execute(update(StyleToRetrain).where(*mine).values(**ended), **_UNSEEN)


def end_part(session: Session, batch: int, part: int, state: str, reason: str) -> None:
    """End the styles that a part has left, as it ended without them, and the batch where that was all."""
    left = (StyleToRetrain.part_row == part, StyleToRetrain.state == "queued")
    ended = {"state": state, "reason": reason, "ended_at": now()}
    session.execute(update(StyleToRetrain).where(*left).values(**ended), **_UNSEEN)
    settle(session, batch)


def settle(session: Session, batch: int) -> None:
    """End a batch if none of its styles is queued any more; a style that failed makes it failed."""
    counted = count(session, batch)
    if counted["queued"]:
        return
    state = "failed" if counted["failed"] else "cancelled" if counted["cancelled"] else "succeeded"
    ended = {"state": state, "progress": 1.0, "result": counted, "error": _why(counted), "ended_at": now()}
    mine = (Job.row == batch, Job.state.in_(ACTIVE))
    job = session.scalar(update(Job).where(*mine).values(**ended).returning(Job.id))
    if job is not None:
        record(session, "worker", "finish", f"job-{BATCH}", job)


def forget_styles(session: Session, demonstrations: Sequence[int], batches: Sequence[int]) -> None:
    """Take demonstrations that are erased out of all batches, and all styles out of batches that are.

    Their parts go on without them, and end the batch.
    """
    for column, rows in ((StyleToRetrain.demonstration_row, demonstrations), (StyleToRetrain.job_row, batches)):
        session.execute(delete(StyleToRetrain).where(column.in_(rows)), **_UNSEEN)


def _why(counted: dict[str, int]) -> str | None:
    styles = sum(counted.values())
    if counted["failed"]:
        return f"{counted['failed']} of {styles} styles failed; GET /retrainings names them. The others are done."
    return f"{counted['cancelled']} of {styles} styles were cancelled." if counted["cancelled"] else None


_UNSEEN = {"execution_options": {"synchronize_session": False}}
