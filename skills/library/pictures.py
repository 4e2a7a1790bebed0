"""The pictures of a playback: its film and its plots, drawn by a worker once the verdict is stored.

Nobody who waits for a verdict waits for them, and what they show is no part of it.
"""

from collections.abc import Callable
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.books import Job
from skills.db.models import StoredPictures, StoredPlayback
from skills.db.session import Database
from skills.errors import Conflict, NotDrawnYet
from skills.library import jobs
from skills.library.events import record
from skills.library.plans import trajectory_of
from skills.library.verified import planned
from skills.settings import Settings
from skills.style.pictures import Pictures

KIND = "pictures"


def request(session: Session, playback: StoredPlayback, actor: str) -> tuple[Job, bool]:
    """Ask for the pictures of a stored playback: the job, and whether it is a new one."""
    return jobs.ask(session, KIND, _wanted(playback), playback.plan.policy.surgeon, actor)


def draw_pictures(
    database: Database, request: dict[str, Any], settings: Settings
) -> Callable[[Session, str], dict[str, Any]]:
    """Draw a playback; the returned function stores what was drawn."""
    from skills.sim import film, plots

    with database.reading() as session:
        playback = _playback(session, request)
        plan, measured, report = planned(playback.plan), playback.measured, playback.report
    trajectory = trajectory_of(plan)
    if len(measured) != len(trajectory):
        raise Conflict("An older version played this plan, with other samples; plan it and play it again.")
    shot = film.shoot(trajectory, pad_top_mm=float(measured.pad_mm[2]), memory_bytes=settings.playback_memory_bytes)
    drawn = Pictures(
        animation_mp4=shot.mp4,
        animation_gif=shot.gif,
        joints_png=plots.png(plots.draw_joints(trajectory, measured, report)),
        clearance_png=plots.png(plots.draw_clearance(trajectory, measured, report)),
    )

    def store(session: Session, actor: str) -> dict[str, Any]:
        playback = _playback(session, request)
        of_playback = select(StoredPictures.row).where(StoredPictures.playback_row == playback.row)
        if session.scalar(of_playback) is None:
            session.add(StoredPictures(playback_row=playback.row, drawn=drawn))
            record(session, actor, "draw", KIND, playback.sha256, playback.plan.policy.surgeon)
        return {"playback": playback.sha256}

    return store


def find_pictures(session: Session, playback: StoredPlayback) -> Pictures:
    """Find what was drawn of a playback.

    Raises:
        NotDrawnYet: Nothing yet; the message names the job that draws it, or what became of it.
    """
    stored = session.scalar(select(StoredPictures).where(StoredPictures.playback_row == playback.row))
    if stored is None:
        raise _not_drawn(playback, jobs.newest(session, KIND, _wanted(playback)))
    return stored.drawn


def _not_drawn(playback: StoredPlayback, job: Job | None) -> NotDrawnYet:
    again = f"POST /playbacks/{playback.sha256}/pictures asks for it"
    if job is None:
        return NotDrawnYet(f"Nobody has asked for pictures of this playback; {again}.")
    if job.state in jobs.ACTIVE:
        return NotDrawnYet(f"It is being drawn; the job is /jobs/{job.id}.", job=job.id)
    return NotDrawnYet(f"It was not drawn, see /jobs/{job.id}; {again} again.", job=job.id)


def _wanted(playback: StoredPlayback) -> dict[str, Any]:
    """Write what is asked for; the plan is named because erasing a demonstration finds its jobs by it."""
    return {"plan": playback.plan.sha256, "playback": playback.sha256}


def _playback(session: Session, request: dict[str, Any]) -> StoredPlayback:
    return session.scalars(select(StoredPlayback).where(StoredPlayback.sha256 == request["playback"])).one()
