"""The film and plots of a playback, drawn by a worker after the verdict is stored; with the extra `pictures` alone."""

from importlib.util import find_spec
from typing import ClassVar

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.models import StoredPictures, StoredPlayback
from skills.db.service_tables import Job, record_event
from skills.db.session import Database
from skills.errors import NotDrawnYet, NotInstalled
from skills.fields import as_json
from skills.library.operation import jobs
from skills.library.operation.jobs import PICTURES, JobRequest, RequestedJob, Store
from skills.remedies import Action, Remedy
from skills.schemas.results import PicturesResult
from skills.settings import Settings
from skills.verification.playback import Pictures

EXTRA = ("matplotlib", "imageio_ffmpeg")


class PicturesRequest(JobRequest):
    """The request of the pictures of a playback; erasing a demonstration finds the job by the plan."""

    kind: ClassVar[str] = PICTURES

    plan: str
    playback: str


def request_pictures(session: Session, playback: StoredPlayback, actor: str) -> RequestedJob:
    """Queue the pictures of a stored playback.

    Raises:
        NotInstalled: Libraries that draw them are missing here.
    """
    if not can_draw():
        raise NotInstalled(
            "Films and plots need the extra 'pictures', which is not installed here: "
            "`pip install 'suture-skills[pictures]'` for the service and its workers."
        )
    return jobs.ask(session, _wanted(playback), playback.plan.policy.surgeon, actor)


def can_draw() -> bool:
    """Return whether what draws pictures is installed here."""
    return all(find_spec(name) for name in EXTRA)


def draw_pictures(database: Database, request: PicturesRequest, settings: Settings) -> Store[PicturesResult]:
    """Draw the film and plots of a playback; the returned function stores them."""
    from skills.simulation import film, pictures

    with database.reading() as session:
        playback = _playback(session, request)
        measured, report = playback.measured, as_json(playback.report)
    trajectory = measured.trajectory
    shot = film.make_film(trajectory, pad_top_mm=float(measured.pad_mm[2]), memory_bytes=settings.playback_memory_bytes)
    drawn = Pictures(
        animation_mp4=shot.mp4,
        animation_gif=shot.gif,
        joints_png=pictures.png(pictures.draw_joints(trajectory, measured, report)),
        clearance_png=pictures.png(pictures.draw_clearance(trajectory, measured, report)),
    )

    def store(session: Session, actor: str) -> PicturesResult:
        playback = _playback(session, request)
        of_playback = select(StoredPictures.row).where(StoredPictures.playback_row == playback.row)
        # A retry of the job must not store the pictures twice.
        if session.scalar(of_playback) is None:
            session.add(StoredPictures(playback_row=playback.row, drawn=drawn))
            record_event(session, actor, "draw", PICTURES, playback.sha256, playback.plan.policy.surgeon)
        return PicturesResult(playback=playback.sha256)

    return store


def find_pictures(session: Session, playback: StoredPlayback) -> Pictures:
    """Return the pictures of a playback.

    Raises:
        NotDrawnYet: They are not drawn; the message names the job that draws them, or that failed to.
    """
    stored = session.scalar(select(StoredPictures).where(StoredPictures.playback_row == playback.row))
    if stored is None:
        raise _not_drawn(playback, job_of_pictures(session, playback))
    return stored.drawn


def job_of_pictures(session: Session, playback: StoredPlayback) -> Job | None:
    """Return the newest job that draws the pictures of a playback, or failed to."""
    return jobs.newest(session, _wanted(playback))


def _not_drawn(playback: StoredPlayback, job: Job | None) -> NotDrawnYet:
    draw = Remedy(Action.DRAW, playback=playback.sha256, plan=playback.plan.sha256)
    if job is None:
        return NotDrawnYet("No pictures of this playback were requested.", draw)
    see = Remedy(Action.SEE_JOB, job=job.id)
    if job.state in jobs.ACTIVE:
        return NotDrawnYet("The pictures of this playback are being drawn.", see, job=job.id)
    return NotDrawnYet("The pictures of this playback were not drawn.", see, draw, job=job.id)


def _wanted(playback: StoredPlayback) -> PicturesRequest:
    return PicturesRequest(plan=playback.plan.sha256, playback=playback.sha256)


def _playback(session: Session, request: PicturesRequest) -> StoredPlayback:
    return session.scalars(select(StoredPlayback).where(StoredPlayback.sha256 == request.playback)).one()
