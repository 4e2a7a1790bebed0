"""Permanent deletion: a surgeon or a demonstration with everything derived from it, or an unused recording.

Recordings are deleted with their surgeon or demonstration, unless a demonstration that remains was cut out of the same
bytes or they were uploaded as another surgeon's too. A recording that was uploaded without a surgeon and never cut is
not known to be anybody's: erasing a surgeon does not reach it, and its uploader deletes it. Events remain; those of an
erased surgeon name a random subject that no longer belongs to anybody.

One transaction erases all that can be seen. Of many jobs and of large recordings it deletes what refers to them, and
`skills.library.operation.sweep` deletes the rest in steps, after the commit.
"""

import secrets
from collections.abc import Sequence

from sqlalchemy import ColumnElement, Select, delete, exists, func, insert, null, select, true
from sqlalchemy.orm import InstrumentedAttribute, Session

from skills.db import in_parts, models, now
from skills.db.changes import announce
from skills.db.models import AT_ONCE_BYTES, Demonstration, Plan, PolicyVersion, RecordingSurgeon, Surgeon
from skills.db.row_visibility import ALL_ROWS
from skills.db.service_tables import Job, record_event
from skills.errors import Conflict, NotAllowed
from skills.library.operation.jobs import ACTIVE as NOT_ENDED
from skills.library.operation.jobs import UNSYNCHRONISED, forget_styles
from skills.library.operation.sweep import delete_jobs
from skills.library.people.surgeons import find_surgeon, salted
from skills.library.policies.releases import withdraw_resting_on
from skills.library.recordings.datasets import drop_exports, exports_from, exports_of
from skills.library.recordings.demos import find_demo
from skills.library.recordings.recordings import find_recording
from skills.remedies import Action, Remedy

INTERVAL = ["recording_row", "surgeon_row", "start_s", "end_s"]
ACTIVE = Job.state.in_(NOT_ENDED)
Dropped = list[tuple[int, int]]  # rows and attempts of jobs that had not ended, so that the engine can cancel them


def erase_surgeon(session: Session, slug: str, actor: str) -> Dropped:
    """Erase a surgeon permanently: from then on requests for the pseudonym are answered with `Erased`.

    Returns:
        The jobs that were deleted before they ended.
    """
    surgeon = find_surgeon(session, slug)
    of_surgeon = Demonstration.surgeon_row == surgeon.row
    # By the state first, since few jobs have not ended: an index of the surgeon's jobs would lead past all that have.
    active = select(Job.row, Job.attempt).where(ACTIVE, Job.surgeon_row + 0 == surgeon.row)
    dropped = [(row, at) for row, at in session.execute(active)]
    dropped += _drop_exports(session, of_surgeon, surgeon)
    # Of this surgeon's batches too, whose styles are all of these demonstrations.
    forget_styles(session, select(Demonstration.row).where(of_surgeon), None)
    for some in in_parts([row for row, _ in dropped]):
        _delete(session, Job.row, some)
    delete_jobs(session, surgeon.row)
    _erase(session, of_surgeon, surgeon, {*session.scalars(_uploaded_for(surgeon))})
    _forget_name(session, surgeon)
    record_event(session, actor, "erase", "surgeon", surgeon.subject, surgeon)
    # A salted digest recognises the pseudonym if somebody uses it again, and cannot be read back.
    salt = secrets.token_hex(32)
    session.add(models.Erasure(salt=salt, digest=salted(salt, slug)))
    session.execute(delete(Surgeon).where(Surgeon.row == surgeon.row))
    return dropped


def _uploaded_for(surgeon: Surgeon) -> Select[int]:
    """Return the query of the recordings that were uploaded for a surgeon."""
    return select(RecordingSurgeon.recording_row).where(RecordingSurgeon.surgeon_row == surgeon.row)


def _forget_name(session: Session, surgeon: Surgeon) -> None:
    """Leave intervals without a name in the recordings that stay, so that what the surgeon refused stays refused."""
    named, gone = RecordingSurgeon, models.ErasedInterval
    for of, start_s, end_s in ((named, null(), null()), (gone, gone.start_s, gone.end_s)):
        theirs = select(of.recording_row, null(), start_s, end_s).where(of.surgeon_row == surgeon.row)
        session.execute(insert(models.ErasedInterval).from_select(INTERVAL, theirs))
        session.execute(delete(of).where(of.surgeon_row == surgeon.row), **UNSYNCHRONISED)


def erased_with(session: Session, surgeon: Surgeon, demo: Demonstration | None = None) -> list[int]:
    """Return the rows of the recordings that are erased with a surgeon, or with one of the surgeon's demonstrations."""
    which = Demonstration.surgeon_row == surgeon.row if demo is None else Demonstration.row == demo.row
    rows = {*session.scalars(select(Demonstration.recording_row).where(which))}
    if demo is None:
        rows |= {*session.scalars(_uploaded_for(surgeon))}
    return sorted(rows - _shared(session, sorted(rows), surgeon, ~which))


def _shared(session: Session, rows: Sequence[int], surgeon: Surgeon, others: ColumnElement[bool]) -> set[int]:
    """Return the recordings that other demonstrations were cut out of, or that were uploaded for other surgeons."""
    of, named = Demonstration.recording_row, RecordingSurgeon
    shared: set[int] = set()
    for some in in_parts(rows):
        shared |= {*session.scalars(select(of).where(of.in_(some), others))}
        also = select(named.recording_row).where(named.recording_row.in_(some), named.surgeon_row != surgeon.row)
        shared |= {*session.scalars(also)}
    return shared


def erase_demo(session: Session, demo_sha256: str, actor: str) -> Dropped:
    """Erase one demonstration and everything that was learnt from it.

    Args:
        session: The caller's transaction.
        demo_sha256: Its digest, or a prefix of it.
        actor: The owner of the key that erases it, for the event.

    Returns:
        The jobs that were deleted before they ended.
    """
    demo = find_demo(session, demo_sha256)
    demo_sha256 = demo.sha256  # in full: the argument may be a prefix
    withdraw_resting_on(session, demo, actor)  # otherwise the release before the served one would be served again
    of_demo = Demonstration.row == demo.row
    plans = {*session.scalars(select(Plan.sha256).where(Plan.policy_row.in_(_resting_on(of_demo))))}
    theirs = select(Job.row, Job.attempt, ACTIVE, Job.request).where(Job.surgeon_row == demo.surgeon_row)
    jobs = [
        (row, attempt, active)
        for row, attempt, active, request in session.execute(theirs)
        if demo_sha256 in request.get("demos", ())
        or request.get("plan") in plans
        or request.get("recording") == demo.recording.sha256  # a try, whose steps describe the demonstration
    ]
    forget_styles(session, select(Demonstration.row).where(of_demo), None)
    for some in in_parts([row for row, _, _ in jobs]):
        forget_styles(session, None, some)
        _delete(session, Job.row, some)
    dropped = [(row, attempt) for row, attempt, active in jobs if active] + _drop_exports(session, of_demo)
    record_event(session, actor, "erase", "demonstration", demo_sha256, demo.surgeon)
    _erase(session, of_demo, demo.surgeon, set())
    return dropped


def _drop_exports(session: Session, which: ColumnElement[bool], surgeon: Surgeon | None = None) -> Dropped:
    """Delete every dataset in which some demonstrations, or anything of a surgeon's recordings, can be seen."""
    rows = {*session.scalars(exports_of(which))}
    if surgeon is not None:
        for of in (RecordingSurgeon, models.ErasedInterval):
            theirs = select(of.recording_row).where(of.surgeon_row == surgeon.row)
            rows |= {*session.scalars(exports_from(theirs))}
    found = select(Job.row, Job.attempt).where(Job.row.in_(rows), ACTIVE)
    dropped = [(row, at) for row, at in session.execute(found.execution_options(**ALL_ROWS))]
    drop_exports(session, sorted(rows))
    return dropped


def delete_recording(session: Session, recording_sha256: str, actor: str, *, as_admin: bool) -> None:
    """Delete a recording without demonstrations; if others uploaded it too, delete only the caller's upload.

    Args:
        session: The caller's transaction.
        recording_sha256: The SHA-256 of its bytes.
        actor: The owner of the key that deletes it.
        as_admin: Delete the recording even if others have uploaded it.

    Raises:
        NotFound: There is none.
        NotAllowed: Only others have uploaded it.
        Conflict: Demonstrations were cut out of it.
    """
    stored, alone = deletable_recording(session, recording_sha256, actor, as_admin=as_admin)
    if not alone:
        mine = (models.RecordingUpload.recording_row == stored.row, models.RecordingUpload.actor == actor)
        session.execute(delete(models.RecordingUpload).where(*mine), **UNSYNCHRONISED)
        return
    record_event(session, actor, "erase", "recording", recording_sha256)
    _delete_recordings(session, [stored.row])


def deletable_recording(
    session: Session, recording_sha256: str, actor: str, *, as_admin: bool
) -> tuple[models.StoredRecording, bool]:
    """Return the recording that `delete_recording` would delete, and whether it itself and not only an upload of it.

    The arguments and errors are those of `delete_recording`.
    """
    stored, of = find_recording(session, recording_sha256), models.RecordingUpload
    senders = {*session.scalars(select(of.actor).where(of.recording_row == stored.row))}
    if not as_admin and actor not in senders:
        raise NotAllowed("Another user uploaded this recording; that user or an admin can delete it.")
    resting = select(exists().where(Demonstration.recording_row == stored.row))
    # Also of other surgeons: a restricted key must not delete bytes under demonstrations that it cannot see.
    if session.scalar(resting.execution_options(**ALL_ROWS)):
        why = "Demonstrations, active or withdrawn, depend on this recording."
        raise Conflict(why, Remedy(Action.ERASE_DEMOS))
    return stored, as_admin or senders == {actor}


def _resting_on(which: ColumnElement[bool]) -> Select[int]:
    """Return the query of the policies that were learnt from some demonstrations, alone or among others."""
    demos = select(Demonstration.row).where(which)
    others = select(models.PolicyDemonstration.policy_row).where(
        models.PolicyDemonstration.demonstration_row.in_(demos)
    )
    return select(PolicyVersion.row).where(PolicyVersion.demonstration_row.in_(demos) | PolicyVersion.row.in_(others))


def _erase(session: Session, which: ColumnElement[bool], surgeon: Surgeon, recordings: set[int]) -> None:
    """Erase demonstrations of a surgeon with everything derived from them, and the recordings that are then unused.

    Long lists of rows are not bound as parameters at once: a statement has a limited number of them.
    """
    announce(session)
    recordings = recordings | {*session.scalars(select(Demonstration.recording_row).where(which))}
    policies = session.scalars(_resting_on(which)).all()
    demos = select(Demonstration.row).where(which)
    # Every cached row with distances of the suture type may hold one from an erased demonstration. Shapes alone, of
    # which an index of neighbours has up to 100,000, stay.
    cached = models.MeasuredShape.demonstration_row
    beside = select(Demonstration.row).where(Demonstration.suture.in_(select(Demonstration.suture).where(which)))
    touched = cached.in_(demos) | (cached.in_(beside) & (models.MeasuredShape.version >= 0))
    session.execute(delete(models.MeasuredShape).where(touched), **UNSYNCHRONISED)
    for some in in_parts(policies):
        by = PolicyVersion
        numbers = select(by.surgeon_row, by.suture, func.max(by.version)).where(by.row.in_(some))
        used = numbers.group_by(by.surgeon_row, by.suture)
        session.execute(insert(models.LastUsed).from_select(["surgeon_row", "suture", "last"], used))
        plans = select(Plan.row).where(Plan.policy_row.in_(some))
        playbacks = select(models.StoredPlayback.row).where(models.StoredPlayback.plan_row.in_(plans))
        # From the leaves to the roots, because of the foreign keys.
        _delete(session, models.StoredPictures.playback_row, playbacks)
        _delete(session, models.StoredPlayback.plan_row, plans)
        for of_policy in (Plan, models.Release, models.PolicyDemonstration, models.StoredPoses):
            _delete(session, of_policy.policy_row, some)
        _delete(session, PolicyVersion.row, some)
    for of_demo in (models.StoredRewardMap, models.DemonstrationOutcome):
        _delete(session, of_demo.demonstration_row, demos)
    mine = Demonstration
    seconds = select(mine.recording_row, mine.surgeon_row, mine.start_s, mine.end_s).where(which)
    # Deleted with a recording that is unused.
    session.execute(insert(models.ErasedInterval).from_select(INTERVAL, seconds))
    session.execute(delete(mine).where(which), **UNSYNCHRONISED)
    for some in in_parts(sorted(recordings)):
        shared = _shared(session, some, surgeon, true())
        _delete_recordings(session, sorted({*some} - shared))


def _delete_recordings(session: Session, rows: Sequence[int]) -> None:
    """Delete recordings with their bytes; the records of their uploads and surgeons are deleted with them.

    The bytes of many or large ones are left to the sweep.
    """
    of = models.StoredRecording
    size = select(func.coalesce(func.sum(of.size_bytes), 0)).where(of.row.in_(rows))
    if (session.scalar(size.execution_options(**ALL_ROWS)) or 0) <= AT_ONCE_BYTES:
        _delete(session, models.RecordingChunk.recording, rows)
    else:
        session.add_all(models.LooseChunks(recording_row=row, due_at=now()) for row in rows)
    _delete(session, of.row, rows)


def _delete(session: Session, column: InstrumentedAttribute[int], values: Sequence[int] | Select[int]) -> None:
    """Delete the rows of a table whose column has one of these values."""
    session.execute(delete(column.class_).where(column.in_(values)), **UNSYNCHRONISED)
