"""Routes of jobs: their state, their events, and cancelling them."""

from functools import partial
from typing import Literal

from fastapi import Request, Response

from skills.api.authorisation import Asking
from skills.api.dependencies import Actor, Db, JobId, Jobs, ListingByRow
from skills.api.job_events import Watching
from skills.api.openapi import gives, gives_stream, router_of, says
from skills.api.responses import Giving, say
from skills.api.streams import Stream
from skills.library.operation import jobs as asked
from skills.library.operation import locks
from skills.library.operation.jobs import attempts_to_submit
from skills.library.policies.outcomes import describe_job, describe_jobs
from skills.schemas import Page
from skills.schemas.operation import Job

router = router_of("jobs")

EVENTS = gives_stream("reader", "job", Job, "The job at every change, until it has ended.", 404)


@router.get("/jobs", **gives("reader", Page[Job]))
def list_jobs(
    db: Db,
    listing: ListingByRow,
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"] | None = None,
    kind: Literal["training", "retraining", "playback", "pictures", "dataset", "try"] | None = None,
) -> Response:
    """List jobs, the newest first."""
    with db.reading() as session:
        found = asked.list_jobs(session, listing.limit, listing.cursor, state, kind)
        return listing.page(describe_jobs(session, found), found)


@router.get("/jobs/{job}", **gives("reader", Job, 404))
def get_job(job: JobId, db: Db, give: Giving) -> Response:
    """Return a job."""
    with db.reading() as session:
        return give(describe_job(session, asked.find_job(session, job)))


@router.get("/jobs/{job}/events", **EVENTS)
async def watch_job(job: JobId, db: Db, caller: Asking, request: Request) -> Stream:
    """Stream a job's changes as server-sent events until it has ended; comments keep the connection alive."""
    watching: Watching = request.app.state.watching
    events = watching.events(db, job, caller.key, partial(request.scope["ask_again"], request.scope))
    return Stream(events, "text/event-stream", {"Cache-Control": "no-store"})


@router.delete("/jobs/{job}", **says("trainer", Job, 404, 409))
def cancel_job(job: JobId, db: Db, jobs: Jobs, actor: Actor) -> Response:
    """Cancel a job that has not ended."""
    with db.reading() as session:
        row = asked.find_job(session, job).row
    with db.writing([locks.job(row)]) as session:
        cancelled = asked.cancel(session, job, actor)
        attempts = attempts_to_submit(session, cancelled)
        said = describe_job(session, cancelled)
    for row, attempt in attempts:
        jobs.cancel(row, attempt)
    return say(said)
