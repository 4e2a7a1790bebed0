"""Plans and their playback."""

from fastapi import APIRouter, Response

from skills.api.access import needs
from skills.api.deps import Actor, Configured, Db, Digest, Jobs, room_for_a_job
from skills.api.documented import gives, makes, starts_job
from skills.api.replies import Giving, accepted, stored
from skills.api.schemas.given import Plan, Playback
from skills.api.schemas.sent import PlanIn, PlaybackIn
from skills.api.schemas.written import plan_out, playback_out
from skills.api.strict import Strict
from skills.library import plans, playbacks
from skills.settings import MEBIBYTE

router = APIRouter(route_class=Strict, tags=["plans"], max_body_size=MEBIBYTE)


@router.post("/plans", dependencies=[needs("trainer")], **makes(Plan, 404, 410))
def make_plan(body: PlanIn, db: Db, actor: Actor) -> Response:
    """Stack a style's grid world at suture points."""
    row, created = plans.plan_sutures(db, body.request, actor)
    with db.reading() as session:
        return stored(plan_out(plans.find_plan(session, row.sha256)), created, f"/plans/{row.sha256}")


@router.get("/plans/{plan}", dependencies=[needs("reader")], **gives(Plan, 404))
def get_plan(plan: Digest, db: Db, give: Giving) -> Response:
    """Look a plan up."""
    with db.reading() as session:
        return give(plan_out(plans.find_plan(session, plan)))


@router.post("/playbacks", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404))
def play(body: PlaybackIn, db: Db, jobs: Jobs, actor: Actor, settings: Configured) -> Response:
    """Ask for a plan to be played in the simulator."""
    with db.writing() as session:
        job, new = playbacks.request_playback(session, body.plan, actor, settings)
    if new:
        jobs.tell(job.row, job.attempt, job.kind)
    return accepted(job)


@router.get("/playbacks/{playback}", dependencies=[needs("reader")], **gives(Playback, 404))
def get_playback(playback: Digest, db: Db, give: Giving) -> Response:
    """Give the simulator's verdict on a plan."""
    with db.reading() as session:
        row = playbacks.find_playback(session, playback)
        return give(playback_out(row) | {"policy": playbacks.standing_of(session, row)})
