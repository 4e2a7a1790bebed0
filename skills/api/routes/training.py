"""Routes of trainings: of one style, and of many styles again."""

from typing import Literal

from fastapi import Response

from skills.api.authorisation import Asking, needs, refuse_release
from skills.api.dependencies import Actor, Configured, Db, JobId, Jobs, Limit, RowCursor, room_for_a_job
from skills.api.openapi import gives_page, router_of, starts_job
from skills.api.responses import (
    Giving,
    accepted,
)
from skills.api.strict_json import Strict
from skills.library.operation import locks
from skills.library.operation.jobs import PART, attempts_to_submit, count
from skills.library.policies.gate import GateLimits
from skills.library.policies.outcomes import describe_job, describe_styles
from skills.library.policies.retraining import find_retraining, list_styles, request_retraining
from skills.library.policies.training import request_training
from skills.schemas.training import Retraining, RetrainingIn, TrainingIn
from skills.settings import MEBIBYTE

router = router_of(route_class=Strict, tags=["jobs"], max_body_size=MEBIBYTE)


@router.post("/trainings", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409, 410))
def train(body: TrainingIn, db: Db, jobs: Jobs, actor: Actor, caller: Asking, settings: Configured) -> Response:
    """Request the training of a style; an equal request returns the same job.

    With `release`, an equal request whose version is not the one that the style serves now releases it, if it passes
    the gate. `did` states the effect of the request; `result.released` and `served` state what is served now.
    """
    refuse_release(caller, body.release)
    with db.writing([locks.surgeon(body.surgeon)]) as session:
        job, new, did = request_training(session, body, actor, GateLimits.of(settings))
        answer = accepted(session, job, did)
    # after the commit; if the engine cannot be notified now, a worker finds the job's row later
    if new:
        jobs.submit(job.row, job.attempt, job.kind)
    return answer


@router.post("/retrainings", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409, 410))
def retrain(body: RetrainingIn, db: Db, jobs: Jobs, actor: Actor, caller: Asking, settings: Configured) -> Response:
    """Request the training of many styles again; an equal request for the same styles returns the same job.

    With `release`, an equal request creates a new job if some of the styles serve another version now than when the job
    ended; the new job covers only these. `did` states the effect of the request.
    """
    refuse_release(caller, body.release)
    job, new, did = request_retraining(db, body, actor, GateLimits.of(settings))
    with db.reading() as session:
        told = attempts_to_submit(session, job) if new else []
        answer = accepted(session, job, did)
    for row, attempt in told:
        jobs.submit(row, attempt, PART)
    return answer


@router.get("/retrainings/{job}", dependencies=[needs("reader")], **gives_page(Retraining, 404))
def get_retraining(
    job: JobId,
    db: Db,
    give: Giving,
    state: Literal["queued", "done", "failed", "cancelled"] | None = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> Response:
    """Return a batch: its job, the number of its styles in each state, and the styles, all or of one state."""
    with db.reading() as session:
        found = find_retraining(session, job)
        styles = list_styles(session, found, limit, cursor, state)
        described = dict(describe_job(session, found)) | {"styles": count(session, found.row)}
        items = describe_styles(session, styles)
        return give.page(items, limit, styles[-1].row if styles else None, **described)
