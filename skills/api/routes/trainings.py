"""Trainings, and jobs of every kind."""

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated, Any, Literal

import orjson
from anyio import to_thread
from fastapi import APIRouter, Path, Request, Response
from fastapi.responses import StreamingResponse

from skills.api.deps import Actor, Db, Jobs, Limit, RowCursor, page
from skills.api.schemas import TrainingIn, job_out
from skills.db.models import Job
from skills.db.session import Database
from skills.library import jobs as asked
from skills.library.batches import to_tell
from skills.library.training import request_training
from skills.settings import MEBIBYTE

router = APIRouter(tags=["jobs"], max_body_size=MEBIBYTE)

JobId = Annotated[str, Path(pattern=r"^[0-9a-f]{16}$")]
WATCH_S = 0.2


def accepted(job: Job, response: Response) -> dict[str, Any]:
    """Answer with a job: 202 while it is to be done, 200 once it is."""
    response.status_code = 200 if job.state == "succeeded" else 202
    response.headers["Location"] = f"/jobs/{job.id}"
    return job_out(job)


@router.post("/trainings", status_code=202, responses={200: {}})
def train(body: TrainingIn, db: Db, jobs: Jobs, actor: Actor, response: Response) -> dict[str, Any]:
    """Ask for a style to be trained; an equal request gives the same job."""
    with db.writing() as session:
        job, new = request_training(
            session,
            body.surgeon,
            body.suture,
            actor,
            demos=body.demos,
            learner=body.chosen,
            seed=body.seed,
            release=body.release,
        )
    if new:
        jobs.tell(job.row, job.attempt, job.kind)
    return accepted(job, response)


@router.get("/jobs")
def list_jobs(
    db: Db,
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"] | None = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> dict[str, Any]:
    """List jobs, the newest first."""
    with db.reading() as session:
        found = asked.list_jobs(session, limit, cursor, state)
        return page([job_out(job) for job in found], limit, found[-1].row if found else None)


@router.get("/jobs/{job}")
def get_job(job: JobId, db: Db) -> dict[str, Any]:
    """Look a job up."""
    return _look(db, job)


@router.get("/jobs/{job}/events")
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


@router.delete("/jobs/{job}")
def cancel_job(job: JobId, db: Db, jobs: Jobs, actor: Actor) -> dict[str, Any]:
    """Cancel a job that has not ended."""
    with db.writing() as session:
        cancelled = asked.cancel(session, job, actor)
        told = to_tell(session, cancelled)
    for row, attempt in told:
        jobs.cancel(row, attempt)
    return job_out(cancelled)


def _look(db: Database, job: str) -> dict[str, Any]:
    with db.reading() as session:
        return job_out(asked.find_job(session, job))
