"""What can be seen of a playback: the still that comes with the verdict, and what is drawn after it."""

from collections.abc import Callable

from fastapi import APIRouter, Response

from skills.api.access import needs
from skills.api.deps import Actor, Db, Digest, room_for_a_job
from skills.api.documented import gives_file, starts_job
from skills.api.replies import Giving, accepted
from skills.db.session import Database
from skills.library import pictures
from skills.library.playbacks import find_playback
from skills.settings import MEBIBYTE
from skills.style.pictures import Pictures

router = APIRouter(prefix="/playbacks/{playback}", tags=["plans"], max_body_size=MEBIBYTE)

PNG, GIF, MP4 = "image/png", "image/gif", "video/mp4"


@router.get("/picture.png", dependencies=[needs("reader")], **gives_file((PNG,), 404))
def get_picture(playback: Digest, db: Db, give: Giving) -> Response:
    """Give a still picture of the playback: the scene with all passes."""
    with db.reading() as session:
        return give.bytes(find_playback(session, playback).measured.picture_png, PNG)


@router.get("/animation.mp4", dependencies=[needs("reader")], **gives_file((MP4,), 404))
def get_animation(playback: Digest, db: Db, give: Giving) -> Response:
    """Give the film of the whole trajectory, as H.264."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.animation_mp4), MP4)


@router.get("/animation.gif", dependencies=[needs("reader")], **gives_file((GIF,), 404))
def get_animation_gif(playback: Digest, db: Db, give: Giving) -> Response:
    """Give the same film as a GIF."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.animation_gif), GIF)


@router.get("/joints.png", dependencies=[needs("reader")], **gives_file((PNG,), 404))
def get_joints_plot(playback: Digest, db: Db, give: Giving) -> Response:
    """Give a plot of the joints of both arms against their limits, over time."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.joints_png), PNG)


@router.get("/clearance.png", dependencies=[needs("reader")], **gives_file((PNG,), 404))
def get_clearance_plot(playback: Digest, db: Db, give: Giving) -> Response:
    """Give a plot of the distances between surfaces over time, with what is allowed."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.clearance_png), PNG)


@router.post("/pictures", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404))
def draw_pictures(playback: Digest, db: Db, actor: Actor) -> Response:
    """Ask for the film and the plots; every new playback has asked for its own, so this gives the job that draws them.

    A worker finds the job by itself: nobody tells the engine, for nobody waits.
    """
    with db.writing() as session:
        job, _ = pictures.request(session, find_playback(session, playback), actor)
    return accepted(job)


def _drawn(db: Database, playback: str, which: Callable[[Pictures], bytes]) -> bytes:
    with db.reading() as session:
        return which(pictures.find_pictures(session, find_playback(session, playback)))
