"""Demonstrations: hand-offs cut out of recordings and put into their grid worlds, checked before they are stored.

recording, DemoIn --make_demo--> Made --upload_demo, add_demo--> Added
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np
from sqlalchemy import Table, select
from sqlalchemy.orm import Session

from skills.db import models, newest, now
from skills.db.models import Demonstration
from skills.db.packed import digest
from skills.db.service_tables import record_event
from skills.db.session import Database
from skills.demonstration.demonstration import Demo, cut_demo
from skills.errors import Conflict
from skills.formats.parsed import ParsedContent, parse_recording
from skills.gridworld import reward
from skills.gridworld.grid import GridPath, choose_grid, discretize
from skills.gridworld.reward import sparse_reward
from skills.library.operation import locks
from skills.library.operation.integrity import OF_DEMO, demo_identity, find_by_digest
from skills.library.people import consent
from skills.library.people.recorded import episodes_of, in_recording, recorded_in
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.library.policies.releases import withdraw_resting_on
from skills.library.recordings.parts import choose_part
from skills.library.recordings.recordings import (
    Parser,
    Upload,
    chunks_of,
    find_recording,
    read_upload,
    store_upload,
    stored_recording,
)
from skills.library.recordings.reports import report_on
from skills.remedies import Action, Remedy
from skills.schemas import DemoOutcome, OutcomeAsked
from skills.schemas.demos import ChosenSegment, DemoIn, DemoPath, DemoReport, RewardMap

# The actions of the events that mark an outcome.
MARKS: dict[DemoOutcome, str] = {"success": "mark-success", "recovery": "mark-recovery", "failure": "mark-failure"}


@dataclass(frozen=True, eq=False)
class Made:
    """A demonstration before it is stored."""

    demo: Demo
    path: GridPath
    reward: reward.RewardMap
    report: DemoReport
    segment: ChosenSegment


class Added(NamedTuple):
    """A stored demonstration, whether it is new, and the part of its recording that it was cut from."""

    row: Demonstration
    new: bool
    segment: ChosenSegment


def make_demo(parsed: ParsedContent, cut: DemoIn) -> Made:
    """Cut a hand-off out of a recording and put it into its grid world.

    Raises:
        SegmentNotNamed: Several hand-offs are proposed, and the request names none.
        BadSegment: The part is named in two ways, or there is no such proposal.
    """
    recording = parsed.recording
    part, name, because = choose_part(parsed, cut)
    demo = cut_demo(recording, arm=part.arm, topic=part.topic, start_s=part.start_s, end_s=part.end_s)
    path = discretize(demo.tip_mm, choose_grid(demo.tip_mm, cut.grid, cut.cell_mm), cut.hysteresis)
    motion = recording.motion_of(arm=demo.arm, topic=demo.topic)
    report = report_on(demo, path, motion.duplicate_stamps, motion.backward_stamps)
    return Made(demo, path, sparse_reward(path), report, ChosenSegment(name, demo.start_s, demo.end_s, because))


def upload_demo(database: Database, upload: Upload, cut: DemoIn, actor: str, parse: Parser = parse_recording) -> Added:
    """Store a recording and one demonstration of it, both or neither.

    Args:
        database: The database; the recording is read outside any transaction.
        upload: The recording's bytes.
        cut: The demonstration to cut out of it.
        actor: The owner of the caller's key.
        parse: The reader, possibly in another process.

    Raises:
        SkillsError: As in `make_demo` and `skills.library.recordings.recordings.read_upload`.
    """
    _check_style(database, cut)
    parsed = read_upload(upload, parse)
    made = make_demo(parsed, cut)

    def store(session: Session, stored: models.StoredRecording, _: bool) -> Added:
        return _store_demo(session, stored, made, cut, actor)

    return store_upload(database, upload, parsed, actor, [locks.surgeon(cut.surgeon)], store)


def add_demo(
    database: Database, recording_sha256: str, cut: DemoIn, actor: str, parse: Parser = parse_recording
) -> Added:
    """Cut another demonstration out of a stored recording; it raises the errors of `make_demo` as well."""
    _check_style(database, cut)
    with database.reading() as session:
        recording_sha256 = find_recording(session, recording_sha256).sha256  # in full: the argument may be a prefix
    made = make_demo(stored_recording(database, recording_sha256, parse, intact=True), cut)
    with database.writing([locks.recording(recording_sha256), locks.surgeon(cut.surgeon)]) as session:
        return _store_demo(session, find_recording(session, recording_sha256), made, cut, actor)


def _check_style(database: Database, cut: DemoIn) -> None:
    """Fail early, before the long computation; both are looked up again when writing."""
    with database.reading() as session:
        find_surgeon(session, cut.surgeon)
        find_suture_type(session, cut.suture)


def _store_demo(session: Session, stored: models.StoredRecording, made: Made, cut: DemoIn, actor: str) -> Added:
    surgeon, suture = find_surgeon(session, cut.surgeon), find_suture_type(session, cut.suture)
    demo_sha256 = demo_identity(stored.sha256, surgeon.slug, suture.slug, made.demo, made.path)
    known = session.scalar(select(Demonstration).where(Demonstration.sha256 == demo_sha256))
    # The same cut of the same recording has the same digest, so a repetition returns the stored row.
    if known is not None:
        if known.withdrawn_at is not None:
            raise Conflict("This demonstration was withdrawn; record another, or cut another part of the recording.")
        _refuse_other_outcome(known, cut)
        return Added(known, False, made.segment)
    demonstration = Demonstration(
        sha256=demo_sha256,
        recording=stored,
        surgeon=surgeon,
        suture=suture.slug,
        **{name: getattr(made.demo, name) for name in OF_DEMO},
        session=cut.session,
        hysteresis=made.path.hysteresis,
        demo=made.demo,
        path=made.path,
        report=made.report,
        segment=made.segment,
    )
    session.add(demonstration)
    session.flush()
    map_sha256 = digest(made.reward)
    session.add(models.StoredRewardMap(sha256=map_sha256, demonstration_row=demonstration.row, map=made.reward))
    record_event(session, actor, "add", "demonstration", demo_sha256, surgeon)
    _mark(session, demonstration, cut.outcome, cut.outcome_reason, actor)
    return Added(demonstration, True, made.segment)


def _refuse_other_outcome(known: Demonstration, cut: DemoIn) -> None:
    """Refuse a repetition with another outcome: whoever adds demonstrations may not change one, see `mark_demo`.

    Raises:
        Conflict: The outcome or its reason differs from the stored one.
    """
    if cut.outcome is not None and (cut.outcome, cut.outcome_reason) != (known.outcome, known.outcome_reason):
        because = "" if known.outcome_reason is None else f" ({known.outcome_reason})"
        stored = "without an outcome" if known.outcome is None else f"as a {known.outcome}{because}"
        mark = Remedy(Action.MARK_DEMO, demo=known.sha256, outcome=cut.outcome)
        raise Conflict(f"This demonstration is stored {stored}; adding it again does not change that.", mark)


def find_demo(session: Session, demo_sha256: str) -> Demonstration:
    """Return a demonstration by its digest, see `find_by_digest`."""
    return find_by_digest(session, Demonstration, demo_sha256, "demonstration", Remedy(Action.LIST_DEMOS))


def shown_demo(session: Session, demo_sha256: str) -> Demonstration:
    """Return a demonstration whose own motion is shown.

    Raises:
        Conflict: Its surgeon allows no use.
    """
    demo = find_demo(session, demo_sha256)
    consent.require(demo.surgeon, "any")
    return demo


def demo_for(session: Session, demo_sha256: str, use: consent.Use) -> Demonstration:
    """Return a demonstration whose seconds of the recording are used, with all that is recorded in them.

    Raises:
        Conflict: Somebody in these seconds of the recording does not allow the use.
    """
    demo = find_demo(session, demo_sha256)
    recorded_in(session, episodes_of([demo.row], whole=False)).require(use, {demo.surgeon_row})
    return demo


def exported_recording(session: Session, demo_sha256: str) -> models.StoredRecording:
    """Return the recording of a demonstration, for an export of its bytes.

    Raises:
        Conflict: Somebody in this recording does not allow an export.
    """
    demo = find_demo(session, demo_sha256)
    in_recording(session, demo.recording).require("export", {demo.surgeon_row})
    return demo.recording


def exported_chunk(database: Database, demo_sha256: str, number: int) -> bytes | None:
    """Return one chunk of a demonstration's recording, counted from 0, in a transaction of its own.

    None: there are no more chunks. It raises the errors of `exported_recording`.
    """
    with database.reading() as session:
        row = exported_recording(session, demo_sha256).row
        return session.scalar(chunks_of(row).where(models.RecordingChunk.number == number))


def newest_demo(session: Session, surgeon_row: int, suture: str) -> Demonstration | None:
    """Return the newest demonstration of a style that is learnable."""
    return next(iter(newest_demos(session, surgeon_row, suture, 1)), None)


def newest_demos(
    session: Session, surgeon_row: int, suture: str, most: int, *, any_outcome: bool = False
) -> list[Demonstration]:
    """Return the newest demonstrations of a style, at most `most`, the oldest of them first.

    Args:
        session: The caller's transaction.
        surgeon_row: The surgeon.
        suture: The suture type.
        most: The most demonstrations.
        any_outcome: Return all that are active, and not only those that are learnable.
    """
    of = Demonstration
    wanted = of.withdrawn_at.is_(None) if any_outcome else of.learnable
    found = newest(of, of.surgeon_row == surgeon_row, of.suture == suture, limit=most).where(wanted)
    return list(session.scalars(found))[::-1]


def list_demos(
    session: Session,
    limit: int,
    before: int | None,
    surgeon: str | None,
    suture: str | None,
    recording: str | None = None,
    active: bool | None = None,
    outcome: OutcomeAsked | None = None,
) -> Sequence[Demonstration]:
    """List demonstrations, the newest first.

    Args:
        session: The caller's transaction.
        limit: The length of the page.
        before: The row of the last demonstration of the page before.
        surgeon: List only those of this surgeon.
        suture: List only those of this suture type.
        recording: List only those cut out of this recording, by its digest.
        active: List only active ones, or only withdrawn ones.
        outcome: List only those of this outcome.
    """
    of, query = Demonstration, newest(Demonstration, limit=limit, before=before)
    if surgeon is not None:
        query = query.where(of.surgeon_row == find_surgeon(session, surgeon).row)
    if suture is not None:
        query = query.where(of.suture == find_suture_type(session, suture).slug)
    if recording is not None:
        query = query.where(of.recording_row == find_recording(session, recording).row)
    if active is not None:
        query = query.where(of.withdrawn_at.is_(None) if active else of.withdrawn_at.is_not(None))
    if outcome is not None:
        query = query.where(of.outcome == (None if outcome == "unknown" else outcome))
        if outcome != "unknown":  # found by the marks, which are few, and not by asking every demonstration for its own
            marks = cast(Table, models.DemonstrationOutcome.__table__).c
            query = query.where(of.row.in_(select(marks.demonstration_row).where(marks.outcome == outcome)))
    return session.scalars(query).all()


def withdraw_demo(session: Session, demo_sha256: str, actor: str) -> list[models.Release]:
    """Withdraw a demonstration and return the releases withdrawn with it; a repetition withdraws nothing more."""
    demonstration = find_demo(session, demo_sha256)
    if demonstration.withdrawn_at is None:
        demonstration.withdrawn_at = now()
        record_event(session, actor, "withdraw", "demonstration", demonstration.sha256, demonstration.surgeon)
    return withdraw_resting_on(session, demonstration, actor)


def mark_demo(
    session: Session, demo_sha256: str, outcome: DemoOutcome, reason: str | None, actor: str
) -> Demonstration:
    """Mark the outcome of a demonstration; an equal mark is not stored twice.

    A failure or a recovery withdraws the releases that were learnt from it, except of versions that were trained from
    any outcome.

    Args:
        session: The caller's transaction.
        demo_sha256: Its digest, or a prefix of it.
        outcome: The outcome.
        reason: Why, in the words of the caller.
        actor: The owner of the caller's key.
    """
    demonstration = find_demo(session, demo_sha256)
    if (demonstration.outcome, demonstration.outcome_reason) != (outcome, reason):
        _mark(session, demonstration, outcome, reason, actor)
    if demonstration.failed:
        withdraw_resting_on(session, demonstration, actor, marked=True)
    return demonstration


def _mark(
    session: Session, demonstration: Demonstration, outcome: DemoOutcome | None, reason: str | None, actor: str
) -> None:
    if outcome is not None:
        mark = {"outcome": outcome, "reason": reason, "actor": actor}
        session.add(models.DemonstrationOutcome(demonstration_row=demonstration.row, **mark))
        record_event(session, actor, MARKS[outcome], "demonstration", demonstration.sha256, demonstration.surgeon)
        session.flush()
    session.refresh(demonstration, ["outcome", "outcome_reason"])


def path_of_demo(row: Demonstration) -> DemoPath:
    """Return a demonstration's path: its states and its recorded motion."""
    path, recorded = row.path, row.demo
    return DemoPath(
        demo=row.sha256,
        frame=row.frame,
        grid=row.report.grid,
        hysteresis=path.hysteresis,
        states=path.states.tolist(),
        path_mm=path.tip_mm.tolist(),
        stamps_s=recorded.stamps_s.tolist(),
        recorded_mm=recorded.tip_mm.tolist(),
    )


def reward_map_of(session: Session, row: Demonstration) -> RewardMap:
    """Return the reward map of a demonstration: the states whose reward is not `other`."""
    of = models.StoredRewardMap
    stored = session.scalars(select(of).where(of.demonstration_row == row.row)).one()
    rewards, levels = stored.map.rewards, stored.map.levels
    special = np.flatnonzero(rewards != levels.other)
    return RewardMap(
        demo=row.sha256,
        sha256=stored.sha256,
        grid=row.report.grid,
        levels=levels,
        states=special.tolist(),
        rewards=rewards[special].tolist(),
    )
