"""Routes of playbacks: the verdict on a plan, the still picture, and the film and plots that are drawn afterwards."""

from collections.abc import Callable

from fastapi import Response
from sqlalchemy.orm import Session

from skills.api.dependencies import Accept, Actor, Configured, Db, Digest, Jobs
from skills.api.openapi import Declared, gives, gives_file, router_of, starts_job
from skills.api.responses import Giving, as_asked, start_job
from skills.db.session import Database
from skills.formats import BYTES
from skills.library.operation import locks
from skills.library.operation.jobs import RequestedJob
from skills.library.plans import plans, playbacks
from skills.library.plans.playback_pictures import find_pictures, request_pictures
from skills.library.plans.playbacks import describe_playback, find_playback, shown_playback
from skills.schemas.playbacks import Playback, PlaybackIn
from skills.verification.playback import Pictures

router = router_of("plans")


@router.post("/playbacks", **starts_job(404, 409))
def play(body: PlaybackIn, db: Db, jobs: Jobs, actor: Actor, settings: Configured) -> Response:
    """Request the playback of a plan in the simulator."""
    with db.reading() as session:
        surgeon = plans.find_plan(session, body.plan).policy.surgeon.slug

    def request(session: Session) -> RequestedJob:
        return playbacks.request_playback(session, body.plan, actor, settings, body.arm_errors, body.driven)

    return start_job(db, jobs, [locks.surgeon(surgeon)], request)


@router.get("/playbacks/{playback}", **gives("reader", Playback, 404))
def get_playback(playback: Digest, db: Db, give: Giving, settings: Configured) -> Response:
    """Return the simulator's verdict on a plan."""
    with db.reading() as session:
        return give(describe_playback(session, find_playback(session, playback), settings))


PNG, GIF, MP4 = "image/png", "image/gif", "video/mp4"


def _given(kind: str) -> Declared:
    """Describe a picture route; plain bytes are a second media type, for generated clients that know no other."""
    return gives_file("reader", (BYTES, kind), 404, 409)


@router.get("/playbacks/{playback}/picture.png", **_given(PNG))
def get_picture(playback: Digest, db: Db, give: Giving, accept: Accept) -> Response:
    """Return a still picture of the playback: the scene with all passes."""
    with db.reading() as session:
        return give.bytes(shown_playback(session, playback).measured.picture_png, as_asked(accept, PNG))


@router.get("/playbacks/{playback}/animation.mp4", **_given(MP4))
def get_animation(playback: Digest, db: Db, give: Giving, accept: Accept) -> Response:
    """Return the film of the whole trajectory, as H.264."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.animation_mp4), as_asked(accept, MP4))


@router.get("/playbacks/{playback}/animation.gif", **_given(GIF))
def get_animation_gif(playback: Digest, db: Db, give: Giving, accept: Accept) -> Response:
    """Return the same film as a GIF."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.animation_gif), as_asked(accept, GIF))


@router.get("/playbacks/{playback}/joints.png", **_given(PNG))
def get_joints_plot(playback: Digest, db: Db, give: Giving, accept: Accept) -> Response:
    """Return a plot of the joints of both arms over time, with their limits."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.joints_png), as_asked(accept, PNG))


@router.get("/playbacks/{playback}/clearance.png", **_given(PNG))
def get_clearance_plot(playback: Digest, db: Db, give: Giving, accept: Accept) -> Response:
    """Return a plot of the distances between surfaces over time, with the permitted minimum."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.clearance_png), as_asked(accept, PNG))


@router.post("/playbacks/{playback}/pictures", **starts_job(404, 409))
def draw_pictures(playback: Digest, db: Db, jobs: Jobs, actor: Actor) -> Response:
    """Request the film and the plots; every new playback has requested them already, so this returns that job."""
    with db.reading() as session:
        surgeon = find_playback(session, playback).plan.policy.surgeon.slug

    def request(session: Session) -> RequestedJob:
        return request_pictures(session, shown_playback(session, playback), actor)

    return start_job(db, jobs, [locks.surgeon(surgeon)], request)


def _drawn(db: Database, playback: str, which: Callable[[Pictures], bytes]) -> bytes:
    with db.reading() as session:
        return which(find_pictures(session, shown_playback(session, playback)))
