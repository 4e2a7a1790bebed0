"""Retrainings: batches of styles."""

from typing import Literal

from fastapi import APIRouter, Response

from skills.api.access import Asking, needs, refuse_release
from skills.api.deps import Actor, Db, Jobs, Limit, RowCursor, room_for_a_job
from skills.api.documented import gives_page, starts_job
from skills.api.replies import Giving, accepted
from skills.api.routes.trainings import JobId
from skills.api.schemas.given import Retraining
from skills.api.schemas.sent import RetrainingIn
from skills.api.schemas.written import job_out, retrained_out
from skills.api.strict import Strict
from skills.library.batches import PART, count, to_tell
from skills.library.retraining import find_retraining, list_styles, request_retraining
from skills.settings import MEBIBYTE

router = APIRouter(route_class=Strict, tags=["jobs"], max_body_size=MEBIBYTE)


@router.post("/retrainings", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409, 410))
def retrain(body: RetrainingIn, db: Db, jobs: Jobs, actor: Actor, caller: Asking) -> Response:
    """Ask for styles to be trained again; an equal request for the same styles gives the same job."""
    refuse_release(caller, body.release)
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
    return accepted(job)


@router.get("/retrainings/{job}", dependencies=[needs("reader")], **gives_page(Retraining, 404))
def get_retraining(
    job: JobId,
    db: Db,
    give: Giving,
    state: Literal["queued", "done", "failed", "cancelled"] | None = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> Response:
    """Look a batch up: its job, how many of its styles are in which state, and the styles, all or of one state."""
    with db.reading() as session:
        found = find_retraining(session, job)
        styles = list_styles(session, found, limit, cursor, state)
        about = job_out(found) | {"styles": count(session, found.row)}
        items = [retrained_out(style) for style in styles]
        return give.page(items, limit, styles[-1].row if styles else None, **about)
