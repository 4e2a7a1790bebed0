"""What can be seen of a playback: the still that comes with the verdict, and what is drawn after it."""

import hashlib
from collections.abc import Callable
from typing import Any

from fastapi import APIRouter, Response

from skills.api.answers import Body, answer
from skills.api.deps import Actor, Db, Digest
from skills.api.routes.policies import Match
from skills.api.routes.trainings import accepted
from skills.db.session import Database
from skills.library import pictures
from skills.library.playbacks import find_playback
from skills.settings import MEBIBYTE
from skills.style.pictures import Pictures

router = APIRouter(prefix="/playbacks/{playback}", tags=["plans"], max_body_size=MEBIBYTE)

PNG, GIF, MP4 = "image/png", "image/gif", "video/mp4"


@router.get("/picture.png")
def get_picture(playback: Digest, db: Db, if_none_match: Match = None) -> Response:
    """Give a still picture of the playback: the scene with all passes."""
    with db.reading() as session:
        return _sent(find_playback(session, playback).measured.picture_png, PNG, if_none_match)


@router.get("/animation.mp4")
def get_animation(playback: Digest, db: Db, if_none_match: Match = None) -> Response:
    """Give the film of the whole trajectory, as H.264."""
    return _sent(_drawn(db, playback, lambda drawn: drawn.animation_mp4), MP4, if_none_match)


@router.get("/animation.gif")
def get_animation_gif(playback: Digest, db: Db, if_none_match: Match = None) -> Response:
    """Give the same film as a GIF."""
    return _sent(_drawn(db, playback, lambda drawn: drawn.animation_gif), GIF, if_none_match)


@router.get("/joints.png")
def get_joints_plot(playback: Digest, db: Db, if_none_match: Match = None) -> Response:
    """Give a plot of the joints of both arms against their limits, over time."""
    return _sent(_drawn(db, playback, lambda drawn: drawn.joints_png), PNG, if_none_match)


@router.get("/clearance.png")
def get_clearance_plot(playback: Digest, db: Db, if_none_match: Match = None) -> Response:
    """Give a plot of the distances between surfaces over time, with what is allowed."""
    return _sent(_drawn(db, playback, lambda drawn: drawn.clearance_png), PNG, if_none_match)


@router.post("/pictures", status_code=202, responses={200: {}})
def draw_pictures(playback: Digest, db: Db, actor: Actor, response: Response) -> dict[str, Any]:
    """Ask for the film and the plots; every new playback has asked for its own, so this gives the job that draws them.

    A worker finds the job by itself: nobody tells the engine, for nobody waits.
    """
    with db.writing() as session:
        job, _ = pictures.request(session, find_playback(session, playback), actor)
    return accepted(job, response)


def _drawn(db: Database, playback: str, which: Callable[[Pictures], bytes]) -> bytes:
    with db.reading() as session:
        return which(pictures.find_pictures(session, find_playback(session, playback)))


def _sent(content: bytes, media_type: str, if_none_match: str | None) -> Response:
    return answer(Body(content, media_type, f'"{hashlib.sha256(content).hexdigest()}"'), if_none_match)
