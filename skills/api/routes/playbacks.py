"""Routes of playbacks: the verdict on a plan, the still picture, and the film and plots that are drawn afterwards."""

from collections.abc import Callable
from typing import Any

from fastapi import Response

from skills.api.authorisation import needs
from skills.api.dependencies import Accept, Actor, Configured, Db, Digest, Jobs, room_for_a_job
from skills.api.openapi import gives, gives_file, router_of, starts_job
from skills.api.responses import Giving, accepted, as_asked
from skills.api.strict_json import Strict
from skills.db.session import Database
from skills.formats import BYTES
from skills.library.operation import locks
from skills.library.plans import plans, playbacks
from skills.library.plans.playback_pictures import find_pictures, request_pictures
from skills.library.plans.playbacks import describe_playback, find_playback, shown_playback
from skills.schemas.playbacks import Playback, PlaybackIn
from skills.settings import MEBIBYTE
from skills.verification.playback import Pictures

router = router_of(route_class=Strict, tags=["plans"], max_body_size=MEBIBYTE)


@router.post("/playbacks", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409))
def play(body: PlaybackIn, db: Db, jobs: Jobs, actor: Actor, settings: Configured) -> Response:
    """Request the playback of a plan in the simulator."""
    with db.reading() as session:
        surgeon = plans.find_plan(session, body.plan).policy.surgeon.slug
    with db.writing([locks.surgeon(surgeon)]) as session:
        job, new, did = playbacks.request_playback(session, body.plan, actor, settings, body.arm_errors)
        answer = accepted(session, job, did)
    # after the commit; if the engine cannot be notified now, a worker finds the job's row later
    if new:
        jobs.submit(job.row, job.attempt, job.kind)
    return answer


@router.get("/playbacks/{playback}", dependencies=[needs("reader")], **gives(Playback, 404))
def get_playback(playback: Digest, db: Db, give: Giving, settings: Configured) -> Response:
    """Return the simulator's verdict on a plan."""
    with db.reading() as session:
        return give(describe_playback(session, find_playback(session, playback), settings))


picture_router = router_of(prefix="/playbacks/{playback}", tags=["plans"], max_body_size=MEBIBYTE)


PNG, GIF, MP4 = "image/png", "image/gif", "video/mp4"


def _given(kind: str) -> dict[str, Any]:
    """Describe a picture route; plain bytes are a second media type, for generated clients that know no other."""
    return gives_file((BYTES, kind), 404, 409)


@picture_router.get("/picture.png", dependencies=[needs("reader")], **_given(PNG))
def get_picture(playback: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Return a still picture of the playback: the scene with all passes."""
    with db.reading() as session:
        return give.bytes(shown_playback(session, playback).measured.picture_png, as_asked(accept, PNG))


@picture_router.get("/animation.mp4", dependencies=[needs("reader")], **_given(MP4))
def get_animation(playback: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Return the film of the whole trajectory, as H.264."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.animation_mp4), as_asked(accept, MP4))


@picture_router.get("/animation.gif", dependencies=[needs("reader")], **_given(GIF))
def get_animation_gif(playback: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Return the same film as a GIF."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.animation_gif), as_asked(accept, GIF))


@picture_router.get("/joints.png", dependencies=[needs("reader")], **_given(PNG))
def get_joints_plot(playback: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Return a plot of the joints of both arms over time, with their limits."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.joints_png), as_asked(accept, PNG))


@picture_router.get("/clearance.png", dependencies=[needs("reader")], **_given(PNG))
def get_clearance_plot(playback: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Return a plot of the distances between surfaces over time, with the permitted minimum."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.clearance_png), as_asked(accept, PNG))


@picture_router.post("/pictures", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409))
def draw_pictures(playback: Digest, db: Db, actor: Actor) -> Response:
    """Request the film and the plots; every new playback has requested them already, so this returns that job.

    The engine is not notified, because nobody waits for pictures: a worker finds the job in the queue by itself.
    """
    with db.reading() as session:
        surgeon = find_playback(session, playback).plan.policy.surgeon.slug
    with db.writing([locks.surgeon(surgeon)]) as session:
        job, _, did = request_pictures(session, shown_playback(session, playback), actor)
        return accepted(session, job, did)


def _drawn(db: Database, playback: str, which: Callable[[Pictures], bytes]) -> bytes:
    with db.reading() as session:
        return which(find_pictures(session, shown_playback(session, playback)))
