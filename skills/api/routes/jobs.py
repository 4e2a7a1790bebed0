"""Routes of trainings, of retrainings (batches of styles), and of jobs of every kind."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Request, Response

from skills.api.authorisation import Asking, needs, refuse_release
from skills.api.dependencies import Actor, Db, Jobs, Limit, RowCursor, Strict, room_for_a_job
from skills.api.openapi import gives, gives_page, gives_stream, says, starts_job
from skills.api.responses import Giving, accepted, say
from skills.api.streams import Stream, Watching
from skills.db.session import Database
from skills.library import jobs as asked
from skills.library.jobs import PART, count, job_json, to_tell
from skills.library.releases import outcomes_of, outcomes_of_styles
from skills.library.retraining import find_retraining, list_styles, request_retraining, retrained_json
from skills.library.training import request_training
from skills.schemas.given import Job, Page, Retraining
from skills.schemas.requests import JOB, RetrainingIn, TrainingIn
from skills.settings import MEBIBYTE

router = APIRouter(route_class=Strict, tags=["jobs"], max_body_size=MEBIBYTE)

JobId = Annotated[str, Path(pattern=JOB)]
EVENTS = gives_stream("job", Job, "The job at every change, until it has ended.", 404)


@router.post("/trainings", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409, 410))
def train(body: TrainingIn, db: Db, jobs: Jobs, actor: Actor, caller: Asking) -> Response:
    """Request the training of a style; an equal request returns the same job.

    With `release`, an equal request whose version is not the one that the style serves now releases it, if it passes
    the gate. `did` states the effect of the request; `result.released` and `served` state what is served now.
    """
    refuse_release(caller, body.release)
    with db.writing() as session:
        job, new, did = request_training(session, body, actor)
        answer = accepted(session, job, did)
    # after the commit; if the engine cannot be notified now, a worker finds the job's row later
    if new:
        jobs.tell(job.row, job.attempt, job.kind)
    return answer


@router.get("/jobs", dependencies=[needs("reader")], **gives_page(Page[Job]))
def list_jobs(
    db: Db,
    give: Giving,
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"] | None = None,
    kind: Literal["training", "retraining", "playback", "pictures"] | None = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> Response:
    """List jobs, the newest first."""
    with db.reading() as session:
        found = asked.list_jobs(session, limit, cursor, state, kind)
        came_of = outcomes_of(session, found)
        said = [job_json(job, came_of[job.row]) for job in found]
        return give.page(said, limit, found[-1].row if found else None)


@router.get("/jobs/{job}", dependencies=[needs("reader")], **gives(Job, 404))
def get_job(job: JobId, db: Db, give: Giving) -> Response:
    """Return a job."""
    return give(_look(db, job))


@router.get("/jobs/{job}/events", dependencies=[needs("reader")], **EVENTS)
async def watch_job(job: JobId, db: Db, caller: Asking, request: Request) -> Stream:
    """Stream a job's changes as server-sent events until it has ended; comments keep the connection alive."""
    watching: Watching = request.app.state.watching
    events = watching.events(db, job, caller.key, request.scope["ask_again"])
    return Stream(events, "text/event-stream", {"Cache-Control": "no-store"})


@router.delete("/jobs/{job}", dependencies=[needs("trainer")], **says(Job, 404, 409))
def cancel_job(job: JobId, db: Db, jobs: Jobs, actor: Actor) -> Response:
    """Cancel a job that has not ended."""
    with db.writing() as session:
        cancelled = asked.cancel(session, job, actor)
        told = to_tell(session, cancelled)
        said = job_json(cancelled, outcomes_of(session, [cancelled])[cancelled.row])
    for row, attempt in told:
        jobs.cancel(row, attempt)
    return say(said)


def _look(db: Database, job: str) -> dict[str, Any]:
    with db.reading() as session:
        found = asked.find_job(session, job)
        return job_json(found, outcomes_of(session, [found])[found.row])


retraining_router = APIRouter(route_class=Strict, tags=["jobs"], max_body_size=MEBIBYTE)


@retraining_router.post("/retrainings", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409, 410))
def retrain(body: RetrainingIn, db: Db, jobs: Jobs, actor: Actor, caller: Asking) -> Response:
    """Request the training of many styles again; an equal request for the same styles returns the same job.

    With `release`, an equal request creates a new job if some of the styles serve another version now than when the job
    ended; the new job covers only these. `did` states the effect of the request.
    """
    refuse_release(caller, body.release)
    with db.writing() as session:
        job, new, did = request_retraining(session, body, actor)
        told = to_tell(session, job) if new else []
        answer = accepted(session, job, did)
    for row, attempt in told:
        jobs.tell(row, attempt, PART)
    return answer


@retraining_router.get("/retrainings/{job}", dependencies=[needs("reader")], **gives_page(Retraining, 404))
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
        about = job_json(found, outcomes_of(session, [found])[found.row]) | {"styles": count(session, found.row)}
        came_of = outcomes_of_styles(session, styles)
        items = [retrained_json(style, came_of[style.row]) for style in styles]
        return give.page(items, limit, styles[-1].row if styles else None, **about)
