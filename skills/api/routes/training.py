"""Routes of trainings: of one style, and of many styles again."""

from typing import Literal

from fastapi import Response

from skills.api.authorisation import Asking, refuse_release
from skills.api.dependencies import Actor, Configured, Db, JobId, Jobs, ListingByRow
from skills.api.openapi import gives, router_of, starts_job
from skills.api.responses import accepted, start_job
from skills.library.operation import locks
from skills.library.operation.jobs import PART, attempts_to_submit, count
from skills.library.policies.gate import GateLimits
from skills.library.policies.outcomes import describe_job, describe_styles
from skills.library.policies.retraining import find_retraining, list_styles, request_retraining
from skills.library.policies.training import request_training
from skills.schemas.training import Retraining, RetrainingIn, TrainingIn

router = router_of("jobs")


@router.post("/trainings", **starts_job(404, 409, 410))
def train(body: TrainingIn, db: Db, jobs: Jobs, actor: Actor, caller: Asking, settings: Configured) -> Response:
    """Request the training of a style; an equal request returns the same job.

    With `release`, an equal request whose version is not the one that the style serves now releases it, if it passes
    the gate. `did` states the effect of the request; `result.released` and `served` state what is served now.
    """
    refuse_release(caller, body.release)
    limits, names = GateLimits.of(settings), [locks.surgeon(body.surgeon)]
    return start_job(db, jobs, names, lambda session: request_training(session, body, actor, limits))


@router.post("/retrainings", **starts_job(404, 409, 410))
def retrain(body: RetrainingIn, db: Db, jobs: Jobs, actor: Actor, caller: Asking, settings: Configured) -> Response:
    """Request the training of many styles again; an equal request for the same styles returns the same job.

    With `release`, an equal request creates a new job if some of the styles serve another version now than when the job
    ended; the new job covers only these. `did` states the effect of the request.
    """
    refuse_release(caller, body.release)
    job, new, did = request_retraining(db, body, actor, GateLimits.of(settings))
    with db.reading() as session:
        attempts = attempts_to_submit(session, job) if new else []
        answer = accepted(session, job, did)
    for row, attempt in attempts:
        jobs.submit(row, attempt, PART)
    return answer


@router.get("/retrainings/{job}", **gives("reader", Retraining, 404))
def get_retraining(
    job: JobId, db: Db, listing: ListingByRow, state: Literal["queued", "done", "failed", "cancelled"] | None = None
) -> Response:
    """Return a batch: its job, the number of its styles in each state, and the styles, all or of one state."""
    with db.reading() as session:
        found = find_retraining(session, job)
        styles = list_styles(session, found, listing.limit, listing.cursor, state)
        described = dict(describe_job(session, found)) | {"styles": count(session, found.row)}
        return listing.page(describe_styles(session, styles), styles, **described)
