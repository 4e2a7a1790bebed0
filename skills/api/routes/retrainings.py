"""Retrainings: batches of styles."""

from typing import Any, Literal

from fastapi import APIRouter, Response

from skills.api.deps import Actor, Db, Jobs, Limit, RowCursor, page
from skills.api.routes.trainings import JobId, accepted
from skills.api.schemas import RetrainingIn, job_out, retrained_out
from skills.library.batches import PART, count, to_tell
from skills.library.retraining import find_retraining, list_styles, request_retraining
from skills.settings import MEBIBYTE

router = APIRouter(tags=["jobs"], max_body_size=MEBIBYTE)


@router.post("/retrainings", status_code=202, responses={200: {}})
def retrain(body: RetrainingIn, db: Db, jobs: Jobs, actor: Actor, response: Response) -> dict[str, Any]:
    """Ask for styles to be trained again; an equal request for the same styles gives the same job."""
    with db.writing() as session:
        job, new = request_retraining(
            session,
            actor,
            surgeon=body.surgeon,
            suture=body.suture,
            only_stale=body.only_stale,
            learner=body.chosen,
            release=body.release,
        )
        told = to_tell(session, job) if new else []
    for row, attempt in told:
        jobs.tell(row, attempt, PART)
    return accepted(job, response)


@router.get("/retrainings/{job}")
def get_retraining(
    job: JobId,
    db: Db,
    state: Literal["queued", "done", "failed", "cancelled"] | None = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> dict[str, Any]:
    """Look a batch up: its job, how many of its styles are in which state, and the styles, all or of one state."""
    with db.reading() as session:
        found = find_retraining(session, job)
        styles = list_styles(session, found, limit, cursor, state)
        items = page([retrained_out(style) for style in styles], limit, styles[-1].row if styles else None)
        return job_out(found) | {"styles": count(session, found.row)} | items
