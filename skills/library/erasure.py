"""The one deletion there is: a surgeon, or one demonstration, and everything derived from it.

Recordings go too, unless a demonstration that stays shares the bytes. Events stay; those of an erased surgeon name a
random subject that no longer belongs to anybody.
"""

import secrets
from collections.abc import Sequence

from sqlalchemy import Select, delete, select
from sqlalchemy.orm import Session

from skills.db.books import Job
from skills.db.changes import announce
from skills.db.models import (
    Demonstration,
    Erasure,
    MeasuredShape,
    Plan,
    PolicyDemonstration,
    PolicyVersion,
    RecordingChunk,
    Release,
    StoredPictures,
    StoredPlayback,
    StoredRecording,
    StoredRewardMap,
    Surgeon,
)
from skills.library.batches import BATCH, forget_styles
from skills.library.catalogue import find_surgeon, salted
from skills.library.demos import find_demo
from skills.library.events import record


def erase_surgeon(session: Session, slug: str, actor: str) -> list[Job]:
    """Erase a surgeon for good: the pseudonym answers "erased" from now on.

    Returns:
        The jobs that were deleted, so that the engine can be told to drop them.
    """
    surgeon = find_surgeon(session, slug)
    of_surgeon = Demonstration.surgeon_row == surgeon.row
    jobs = _jobs(session, surgeon)
    demos = session.scalars(select(Demonstration).where(of_surgeon)).all()
    _drop_jobs(session, jobs, demos)
    _erase(session, demos)
    record(session, actor, "erase", "surgeon", surgeon.subject, surgeon)
    salt = secrets.token_hex(32)
    session.add(Erasure(salt=salt, digest=salted(salt, slug)))
    session.execute(delete(Surgeon).where(Surgeon.row == surgeon.row))
    return jobs


def erase_demo(session: Session, demo_sha256: str, actor: str) -> list[Job]:
    """Erase one demonstration and what was learnt from it; the jobs that were deleted."""
    demo = find_demo(session, demo_sha256)
    of_demo = select(Plan.sha256).where(Plan.policy_row.in_(_resting_on([demo.row])))
    plans = set(session.scalars(of_demo))
    jobs = [
        job
        for job in _jobs(session, demo.surgeon)
        if demo_sha256 in job.request.get("demos", ()) or job.request.get("plan") in plans
    ]
    _drop_jobs(session, jobs, [demo])
    record(session, actor, "erase", "demonstration", demo_sha256, demo.surgeon)
    _erase(session, [demo])
    return jobs


def _jobs(session: Session, surgeon: Surgeon) -> list[Job]:
    return list(session.scalars(select(Job).where(Job.surgeon_row == surgeon.row)))


def _drop_jobs(session: Session, jobs: Sequence[Job], demos: Sequence[Demonstration]) -> None:
    forget_styles(session, [demo.row for demo in demos], [job.row for job in jobs if job.kind == BATCH])
    session.execute(delete(Job).where(Job.row.in_([job.row for job in jobs])))


def _resting_on(demos: Sequence[int]) -> Select[int]:
    """Write which policies were learnt from one of these demonstrations, alone or among others."""
    others = select(PolicyDemonstration.policy_row).where(PolicyDemonstration.demonstration_row.in_(demos))
    return select(PolicyVersion.row).where(PolicyVersion.demonstration_row.in_(demos) | PolicyVersion.row.in_(others))


def _erase(session: Session, demos: Sequence[Demonstration]) -> None:
    announce(session)
    rows = [demo.row for demo in demos]
    recordings = {demo.recording_row for demo in demos}
    policies = session.scalars(_resting_on(rows)).all()
    plans = select(Plan.row).where(Plan.policy_row.in_(policies))
    playbacks = select(StoredPlayback.row).where(StoredPlayback.plan_row.in_(plans))
    # In each row of the suture type may be a distance from what is erased.
    beside = select(Demonstration.row).where(Demonstration.suture.in_({demo.suture for demo in demos}))
    for statement in (
        delete(MeasuredShape).where(MeasuredShape.demonstration_row.in_(beside)),
        delete(StoredPictures).where(StoredPictures.playback_row.in_(playbacks)),
        delete(StoredPlayback).where(StoredPlayback.plan_row.in_(plans)),
        delete(Plan).where(Plan.policy_row.in_(policies)),
        delete(Release).where(Release.policy_row.in_(policies)),
        delete(PolicyDemonstration).where(PolicyDemonstration.policy_row.in_(policies)),
        delete(PolicyVersion).where(PolicyVersion.row.in_(policies)),
        delete(StoredRewardMap).where(StoredRewardMap.demonstration_row.in_(rows)),
        delete(Demonstration).where(Demonstration.row.in_(rows)),
    ):
        session.execute(statement, execution_options={"synchronize_session": False})
    shared = select(Demonstration.recording_row).where(Demonstration.recording_row.in_(recordings))
    for row in recordings - set(session.scalars(shared)):
        session.execute(delete(RecordingChunk).where(RecordingChunk.recording == row))
        session.execute(delete(StoredRecording).where(StoredRecording.row == row))
