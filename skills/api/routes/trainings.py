"""Trainings, and jobs of every kind."""

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated, Any, Literal

import orjson
from anyio import to_thread
from fastapi import APIRouter, Path, Request, Response
from fastapi.responses import StreamingResponse

from skills.api.access import Asking, needs, refuse_release
from skills.api.deps import Actor, Db, Jobs, Limit, RowCursor, room_for_a_job
from skills.api.documented import gives, gives_page, gives_stream, says, starts_job
from skills.api.replies import Giving, accepted, say
from skills.api.schemas.given import Job, Page
from skills.api.schemas.sent import TrainingIn
from skills.api.schemas.written import job_out
from skills.api.strict import Strict
from skills.db.session import Database
from skills.library import jobs as asked
from skills.library.batches import to_tell
from skills.library.training import request_training
from skills.settings import MEBIBYTE

router = APIRouter(route_class=Strict, tags=["jobs"], max_body_size=MEBIBYTE)

JobId = Annotated[str, Path(pattern=r"^[0-9a-f]{16}$")]
WATCH_S = 0.2
EVENTS = gives_stream("job", Job, "The job at every change, until it has ended.", 404)


@router.post("/trainings", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409, 410))
def train(body: TrainingIn, db: Db, jobs: Jobs, actor: Actor, caller: Asking) -> Response:
    """Ask for a style to be trained; an equal request gives the same job."""
    refuse_release(caller, body.release)
    with db.writing() as session:
        job, new = request_training(
            session,
            body.surgeon,
            body.suture,
            actor,
            demos=body.demos,
            combine=body.combining,
            learner=body.chosen,
            seed=body.seed,
            release=body.release,
        )
    if new:
        jobs.tell(job.row, job.attempt, job.kind)
    return accepted(job)


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
        return give.page([job_out(job) for job in found], limit, found[-1].row if found else None)


@router.get("/jobs/{job}", dependencies=[needs("reader")], **gives(Job, 404))
def get_job(job: JobId, db: Db, give: Giving) -> Response:
    """Look a job up."""
    return give(_look(db, job))


@router.get("/jobs/{job}/events", dependencies=[needs("reader")], **EVENTS)
async def watch_job(job: JobId, db: Db, request: Request) -> StreamingResponse:
    """Watch a job (server-sent events): one event for each change, until it has ended."""
    first = await to_thread.run_sync(_look, db, job)

    async def changes() -> AsyncIterator[bytes]:
        last, now = None, first
        while not await request.is_disconnected():
            if now != last:
                yield b"event: job\ndata: " + orjson.dumps(now) + b"\n\n"
                last = now
            if now["state"] not in asked.ACTIVE:
                return
            await asyncio.sleep(WATCH_S)
            now = await to_thread.run_sync(_look, db, job)

    return StreamingResponse(changes(), media_type="text/event-stream", headers={"Cache-Control": "no-store"})


@router.delete("/jobs/{job}", dependencies=[needs("trainer")], **says(Job, 404, 409))
def cancel_job(job: JobId, db: Db, jobs: Jobs, actor: Actor) -> Response:
    """Cancel a job that has not ended."""
    with db.writing() as session:
        cancelled = asked.cancel(session, job, actor)
        told = to_tell(session, cancelled)
    for row, attempt in told:
        jobs.cancel(row, attempt)
    return say(job_out(cancelled))


def _look(db: Database, job: str) -> dict[str, Any]:
    with db.reading() as session:
        return job_out(asked.find_job(session, job))
