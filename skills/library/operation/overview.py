"""Lists of pages: the newest items of each kind, and the choices of forms."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from skills.db import newest, now
from skills.db.models import (
    Demonstration,
    Plan,
    StoredPictures,
    StoredPlayback,
    StoredRecording,
    Surgeon,
    SutureType,
)
from skills.db.service_tables import Job
from skills.library.operation.jobs import ACTIVE, requested_again, shown
from skills.library.plans.playback_pictures import job_of_pictures

MOST = 50  # rows of a list on a page
MOST_UNSETTLED, FAILED_DAYS = 10, 7  # ours: jobs on the first page, and for how long a failed one stands there
MOST_LISTED = 200  # of a style's versions and demonstrations, or in a selection, where of more nobody chooses by eye


def surgeons_to_choose(session: Session) -> Sequence[Surgeon] | None:
    """List the surgeons, for a selection in a form; None where they are too many, so that the pseudonym is typed."""
    found = session.scalars(select(Surgeon).order_by(Surgeon.slug).limit(MOST_LISTED + 1)).all()
    return found if len(found) <= MOST_LISTED else None


def all_suture_types(session: Session) -> Sequence[SutureType]:
    """List the suture types."""
    return session.scalars(select(SutureType).order_by(SutureType.slug)).all()


def newest_recordings(
    session: Session, before: int | None = None, limit: int = MOST
) -> list[tuple[StoredRecording, int]]:
    """List recordings, the newest first, each with the number of its active demonstrations."""
    found = session.scalars(newest(StoredRecording, limit=limit, before=before)).all()
    of = Demonstration
    active = (of.withdrawn_at.is_(None), of.recording_row.in_([one.row for one in found]))
    cut = select(of.recording_row, func.count().label("demos")).where(*active).group_by(of.recording_row)
    counts = {one.recording_row: one.demos for one in session.execute(cut)}
    return [(one, counts.get(one.row, 0)) for one in found]


def demos_of_recording(session: Session, recording: StoredRecording) -> Sequence[Demonstration]:
    """List the demonstrations cut out of a recording, in the order of their start times."""
    of = Demonstration
    return session.scalars(select(of).where(of.recording_row == recording.row).order_by(of.start_s)).all()


def newest_plans(
    session: Session, before: int | None = None, limit: int = MOST
) -> list[tuple[Plan, StoredPlayback | None]]:
    """List plans, the newest first, each with its newest playback."""
    found, played = session.scalars(newest(Plan, limit=limit, before=before)).all(), StoredPlayback
    last = select(func.max(played.row)).where(played.plan_row.in_([one.row for one in found])).group_by(played.plan_row)
    of_plan = {one.plan_row: one for one in session.scalars(select(played).where(played.row.in_(last)))}
    return [(one, of_plan.get(one.row)) for one in found]


@dataclass(frozen=True)
class Played:
    """A playback, whether its film and plots are drawn, and the job that draws them or failed to."""

    playback: StoredPlayback
    drawn: bool
    job: Job | None


def playbacks_of(session: Session, plan: Plan) -> list[Played]:
    """List a plan's playbacks, the newest first."""
    query = select(StoredPlayback).where(StoredPlayback.plan_row == plan.row).order_by(StoredPlayback.row.desc())
    listed = []
    for one in session.scalars(query).all():
        drawn = session.scalar(select(StoredPictures.row).where(StoredPictures.playback_row == one.row)) is not None
        listed.append(Played(one, drawn, None if drawn else job_of_pictures(session, one)))
    return listed


def unsettled_jobs(session: Session) -> list[Job]:
    """List the first jobs that have not ended, then the newest that failed lately and were not requested again."""
    active = select(Job).where(*shown(), Job.state.in_(ACTIVE)).order_by(Job.row)
    lately = Job.state == "failed", Job.ended_at > now() - timedelta(days=FAILED_DAYS), ~requested_again()
    failed = newest(Job, *shown(), *lately, limit=MOST_UNSETTLED)
    return [*session.scalars(active.limit(MOST_UNSETTLED)), *session.scalars(failed)]


def newest_job(session: Session, kind: str, plan: str) -> Job | None:
    """Return the newest job of a kind for a plan, or for a playback of it."""
    return session.scalar(newest(Job, Job.plan == plan, Job.kind == kind))
