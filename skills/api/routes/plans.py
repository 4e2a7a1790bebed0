"""Plans and their playback."""

from typing import Any

from fastapi import APIRouter, Response

from skills.api.deps import Actor, Configured, Db, Digest, Jobs
from skills.api.routes.trainings import accepted
from skills.api.schemas import PlanIn, PlaybackIn, plan_out, playback_out
from skills.library import plans, playbacks
from skills.settings import MEBIBYTE

router = APIRouter(tags=["plans"], max_body_size=MEBIBYTE)


@router.post("/plans", status_code=201, responses={200: {}})
def make_plan(body: PlanIn, db: Db, actor: Actor, response: Response) -> dict[str, Any]:
    """Stack a style's grid world at suture points."""
    row, created = plans.plan_sutures(db, body.request, actor)
    response.status_code = 201 if created else 200
    response.headers["Location"] = f"/plans/{row.sha256}"
    with db.reading() as session:
        return plan_out(plans.find_plan(session, row.sha256))


@router.get("/plans/{plan}")
def get_plan(plan: Digest, db: Db) -> dict[str, Any]:
    """Look a plan up."""
    with db.reading() as session:
        return plan_out(plans.find_plan(session, plan))


@router.post("/playbacks", status_code=202, responses={200: {}})
def play(
    body: PlaybackIn, db: Db, jobs: Jobs, actor: Actor, settings: Configured, response: Response
) -> dict[str, Any]:
    """Ask for a plan to be played in the simulator."""
    with db.writing() as session:
        job, new = playbacks.request_playback(session, body.plan, actor, settings)
    if new:
        jobs.tell(job.row, job.attempt, job.kind)
    return accepted(job, response)


@router.get("/playbacks/{playback}")
def get_playback(playback: Digest, db: Db) -> dict[str, Any]:
    """Give the simulator's verdict on a plan."""
    with db.reading() as session:
        row = playbacks.find_playback(session, playback)
        return playback_out(row) | {"policy": playbacks.standing_of(session, row)}
