"""Scores of a demonstration against a style, and its percentiles among the stored demonstrations.

    ScoreIn --score--> deviation from the style's reference, figures, percentiles, progress over time, skill rating

Percentiles are taken among the stored demonstrations of the suture type, measured against the same reference, by the
skill level that surgeons state; a surgeon's own demonstrations form a progress curve over time. Demonstrations of
surgeons who did not agree to be compared are left out. The rating is that of the whole recording of the motion, as a
trial of a task of the calibration.

A score is computed from stored values at every request and is not stored, so it follows every addition, withdrawal and
erasure. It is meant for self-directed learning; it is not an examination.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.arrays import Floats
from skills.comparison.distances import distances, shape_of
from skills.db import newest
from skills.db.models import Demonstration, MeasuredShape, StoredRecording, Surgeon
from skills.db.session import Database
from skills.demonstration.demonstration import Demo, cut_demo
from skills.errors import BadInput, Conflict, NotFound
from skills.learning.evaluation import TIE_BREAK
from skills.library.comparison import calibrations
from skills.library.comparison.measuring import is_current, shape_or_none
from skills.library.comparison.members import comparable_demo, member_of, sessions_of, without_overlaps
from skills.library.people.consent import may, require
from skills.library.people.recorded import in_recording
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.library.policies import releases
from skills.library.recordings.demos import find_demo, newest_demo
from skills.library.recordings.recordings import Parser, find_recording, stored_recording
from skills.schemas import scores as described
from skills.scoring.calibration import LEVELS, Level
from skills.scoring.deviation import as_recorded, differences, laid, laid_on
from skills.scoring.features import KINDS, Numbers, compare, measure, measure_trial
from skills.scoring.rating import Skill, rate, unrated
from skills.scoring.validation import refusals

LEAST_DEMOS, LEAST_SURGEONS = 5, 2  # of a level: with fewer, a percentile is meaningless, or describes one person
MOST_OTHERS = 1000  # the newest of a suture type; more would not change a percentile visibly
MOST_OF_EXPERT = 20  # the newest of the reference's surgeon, for the expert's own spread


@dataclass(frozen=True, eq=False)
class Other:
    """A stored demonstration, measured like the scored one; `numbers` has its distance from the reference too."""

    row: Demonstration
    numbers: Numbers
    distance_mm: float


def others_of(
    session: Session,
    suture: str,
    onto_mm: Floats,
    compared: Sequence[Demonstration] = (),
    surgeon: Surgeon | None = None,
) -> Iterator[Other]:
    """Measure the newest demonstrations of a suture type against a reference's shape, where consent covers it.

    Of overlapping cuts of one motion one counts: the compared demonstration, or else the newest that is not marked
    recovery or failure, or else the newest.

    Args:
        session: The caller's transaction.
        suture: The suture type.
        onto_mm: The reference's shape, shape (STATES, 3).
        compared: The demonstrations that are compared with each other.
        surgeon: The only surgeon whose demonstrations are measured; None: all.
    """
    of = Demonstration
    query = newest(of, of.suture == suture, of.withdrawn_at.is_(None), limit=MOST_OTHERS)
    if surgeon is not None:
        query = query.where(of.surgeon_row == surgeon.row)
    first = {one.row for one in compared}
    found = sorted(session.scalars(query), key=lambda one: (one.row in first, not one.failed, one.row))
    members, _ = without_overlaps([member_of(row) for row in found if may(row.surgeon, "atlas")])
    counted = {one.row for one in members}
    agreed = {row.row: row for row in found if row.row in counted}
    shapes = _shapes(session, list(agreed))
    if not shapes:
        return
    totals = distances(np.stack([laid(shape, onto_mm) for shape in shapes.values()]), onto_mm[None])[:, 0]
    for (row, shape), total in zip(shapes.items(), totals.tolist(), strict=True):
        reported = {kind.name: getattr(agreed[row].report, kind.name, None) for kind in KINDS}
        distance_mm = total / len(onto_mm)
        numbers = {**reported, "size_mm": float(shape[-1, 0]), "distance_mm": distance_mm}
        yield Other(agreed[row], numbers, distance_mm)


def _shapes(session: Session, rows: Sequence[int]) -> dict[int, Floats]:
    """Return the shapes of demonstrations, by row: those stored for the atlas, and newly measured ones for the rest."""
    of = MeasuredShape
    stored = session.scalars(select(of).where(of.demonstration_row.in_(rows), is_current()))
    shapes = {one.demonstration_row: one.measured.shape_mm for one in stored}
    recorded = select(Demonstration.row, Demonstration.demo).where(Demonstration.row.in_({*rows} - {*shapes}))
    shapes |= {row: shape_or_none(demo) for row, demo in session.execute(recorded)}
    return {row: shape for row, shape in shapes.items() if shape is not None}


def percentiles(
    others: Sequence[Other], mine: Numbers, scored: Demonstration | None, reference: Demonstration
) -> list[described.Percentiles]:
    """Return the percentiles of a motion's figures among the demonstrations of each skill level.

    The scored one and the reference are left out, and all that are marked recovery or failure: a level is represented
    by what is not known to have failed. The curve of a surgeon has them all.
    """
    out = {reference.row, *([scored.row] if scored else [])}
    counted = [one for one in others if one.row.row not in out and not one.row.failed]
    return [
        _percentile(level, [one for one in counted if one.row.surgeon.skill_level == level], mine) for level in LEVELS
    ]


def _percentile(level: Level, some: Sequence[Other], mine: Numbers) -> described.Percentiles:
    """Return the share of a level's demonstrations with a smaller value, for each figure; equal values count half."""
    reason, below = None, None
    surgeons = {one.row.surgeon_row for one in some}
    if len(some) < LEAST_DEMOS or len(surgeons) < LEAST_SURGEONS:
        reason = f"at least {LEAST_DEMOS} demonstrations of {LEAST_SURGEONS} surgeons are needed"
    else:
        below = {name: _share_below(mine[name], [one.numbers[name] for one in some]) for name in mine}
    return described.Percentiles(level=level, demos=len(some), surgeons=len(surgeons), reason=reason, below=below)


def _share_below(value: float | None, among: Sequence[float | None]) -> float | None:
    """Return the share of values below one; None if it, or too many of the others, were not recorded."""
    known = [one for one in among if one is not None]
    if value is None or len(known) < LEAST_DEMOS:
        return None
    return sum(0.5 if math.isclose(one, value) else float(one < value) for one in known) / len(known)


def _up_to(others: Sequence[Other], scored: Demonstration | None) -> list[Other]:
    """Return the demonstrations of the scored one's surgeon up to it in the order of recording; none without it."""
    if scored is None:
        return []
    return [one for one in others if one.row.surgeon_row == scored.surgeon_row and _when(one.row) <= _when(scored)]


def _curve(mine: Sequence[Other]) -> list[described.CurvePoint]:
    """List one surgeon's demonstrations in the order of recording."""
    return [
        described.CurvePoint(
            demo=one.row.sha256,
            session=one.row.session,
            stored_at=one.row.recording.created_at,
            distance_mm=one.distance_mm,
            duration_s=one.numbers["duration_s"],
            log_dimensionless_jerk=one.numbers["log_dimensionless_jerk"],
        )
        for one in sorted(mine, key=lambda one: _when(one.row))
    ]


def _when(row: Demonstration) -> tuple[int, float]:
    return row.recording_row, row.start_s


def by_session(others: Sequence[Other]) -> list[described.SessionFigures]:
    """Return the medians of one surgeon's demonstrations by sessions, in the order of recording.

    As in an atlas, cuts of one recording are of one session, and a recording without a session name is one.
    """
    mine = sorted(others, key=lambda one: _when(one.row))
    of = sessions_of([member_of(one.row) for one in mine])
    firsts = np.unique(of, return_index=True)[1].tolist()
    sessions = [[one for one, number in zip(mine, of, strict=True) if number == of[first]] for first in sorted(firsts)]
    return [
        described.SessionFigures(
            session=some[0].row.session,
            stored_at=some[0].row.recording.created_at,
            demos=len(some),
            distance_mm=float(np.median([one.distance_mm for one in some])),
            duration_s=_median(some, "duration_s"),
            log_dimensionless_jerk=_median(some, "log_dimensionless_jerk"),
        )
        for some in sessions
    ]


def _median(some: Sequence[Other], name: str) -> float | None:
    known = [number for one in some if (number := one.numbers[name]) is not None]
    return float(np.median(known)) if known else None


def progress(database: Database, surgeon: str, suture: str, against: str) -> described.Progress:
    """Return how a surgeon's demonstrations compare with another's reference, session by session.

    Args:
        database: The database, restricted to the rows that the caller may see.
        surgeon: The surgeon whose demonstrations are compared.
        suture: The suture type.
        against: The surgeon of the reference.

    Raises:
        NotFound: There is no such surgeon or suture type, or nothing of the style to compare with.
        Conflict: A consent does not cover a comparison.
        BadPath: The reference ends where it began.
    """
    with database.reading() as session:
        mine = find_surgeon(session, surgeon)
        require(mine, "atlas")
        find_suture_type(session, suture)
        reference, because = _reference(session, against, suture)
        require(reference.surgeon, "atlas")
        others = list(others_of(session, suture, shape_of(reference.demo), [reference], mine))
        return described.Progress(
            surgeon=mine.slug,
            style=described.ScoredStyle(surgeon=against, suture=suture),
            reference=described.Reference(
                demo=reference.sha256, because=because, is_itself=mine.row == reference.surgeon_row
            ),
            sessions=by_session(others),
            demos=_curve(others),
            use=CREDENTIAL,
        )


CREDENTIAL = "Research use only. It compares motions, does not judge the outcome, and is not a credential."


@dataclass(frozen=True, eq=False)
class _Scored:
    """The scored motion, its recording, and its row if it is a stored demonstration."""

    demo: Demo
    recording: StoredRecording
    row: Demonstration | None = None


def score(database: Database, asked: described.ScoreIn, parse: Parser) -> described.Score:
    """Score a motion against a style.

    Args:
        database: The database, restricted to the rows that the caller may see.
        asked: The request.
        parse: The reader of recordings, possibly in another process.

    Raises:
        NotFound: There is no such surgeon, suture type, demonstration or recording, or nothing of the style.
        BadInput: The demonstration is of another suture type, or the reference of another style.
        BadPath: One of the two ends where it began, so it has no shape.
        BadRecording: The requested part is not in the recording.
        Conflict: One of the two was withdrawn, or a consent does not cover the comparison, checked at the end too.
    """
    with database.reading() as session:
        find_suture_type(session, asked.suture)
        reference, because = _reference(session, asked.surgeon, asked.suture, asked.reference)
        require(reference.surgeon, "atlas")
        scored = _stored(session, asked)
        reference_demo, expert = reference.demo, _of_expert(session, reference, scored.row if scored else None)
    if scored is None:
        scored = _of_recording(database, asked, parse)
    # No transaction is open during the computation.
    numbers, beside = measure(scored.demo), measure(reference_demo)
    deviation = laid_on(scored.demo, reference_demo)
    expert = [one for one in expert if shape_or_none(one) is not None]
    named = differences(scored.demo, expert, reference_demo) if expert else None
    skill = _skill(database, scored.recording, asked.task, parse)
    with database.reading() as session:  # again: consent may have ended while the two were compared
        _agreed_still(session, [reference, scored.row], scored.recording)
        compared = [reference, *([scored.row] if scored.row else [])]
        others = list(others_of(session, asked.suture, np.array(deviation.reference_mm), compared))
        if skill.calibrated and not in_recording(session, scored.recording).may("atlas"):
            skill = unrated(NOT_AGREED)
    mine = {**numbers, "distance_mm": deviation.distance_mm}
    row = scored.row
    own = _up_to(others, row)
    return described.Score(
        demo=row.sha256 if row else None,
        recording=scored.recording.sha256,
        arm=scored.demo.arm,
        start_s=scored.demo.start_s,
        end_s=scored.demo.end_s,
        surgeon=row.surgeon.slug if row else None,
        style=described.ScoredStyle(surgeon=asked.surgeon, suture=asked.suture),
        reference=described.Reference(
            demo=reference.sha256, because=because, is_itself=bool(row and row.row == reference.row)
        ),
        figures=compare(numbers, beside),
        deviation=deviation,
        differences=named,
        as_recorded=as_recorded(scored.demo, reference_demo),
        tie_break=TIE_BREAK,
        percentiles=percentiles(others, mine, row, reference),
        curve=_curve(own),
        sessions=by_session(own),
        skill=skill,
        use=CREDENTIAL,
    )


def references(session: Session, suture: str) -> list[Surgeon]:
    """List the surgeons with a demonstration of a suture type to compare with, as far as they agreed, experts first."""
    having = select(Demonstration.surgeon_row).where(Demonstration.suture == suture, Demonstration.learnable)
    found = session.scalars(select(Surgeon).where(Surgeon.row.in_(having)).order_by(Surgeon.slug))
    return sorted((one for one in found if may(one, "atlas")), key=lambda one: one.skill_level != "expert")


def rated_tasks(session: Session) -> list[str]:
    """List the tasks of the current calibration; none of one that is not used."""
    stored = calibrations.newest(session)
    model = None if stored is None else calibrations.read_calibration(stored)
    return [] if model is None else list(model.tasks)


# ---- the two motions ----------------------------------------------------------------------------------------------


def _reference(session: Session, slug: str, suture: str, digest: str | None = None) -> tuple[Demonstration, str]:
    """Return the demonstration that represents a style, and the reason for this choice."""
    surgeon = find_surgeon(session, slug)
    if digest is not None:
        named = find_demo(session, digest)
        if (named.surgeon_row, named.suture) != (surgeon.row, suture):
            raise BadInput("The reference is a demonstration of another style; name one of this surgeon and suture.")
        if named.withdrawn_at is not None:
            raise Conflict("The reference was withdrawn; name another, or none.")
        return named, f"it was requested{f', and is marked {named.outcome}' if named.failed else ''}"
    served = releases.served(session, surgeon, suture)
    if served is not None:
        policy = served.policy
        more = len(policy.manifest.demos) - 1
        rest = f" and {more} more" if more else ""
        return policy.demonstration, f"the released policy, version {policy.version}, was learnt from it{rest}"
    last = newest_demo(session, surgeon.row, suture)
    if last is None:
        raise NotFound(f"There is no demonstration of '{slug}' and '{suture}' to compare with.")
    return last, "no policy is released, and it is the newest demonstration"


def _of_expert(session: Session, reference: Demonstration, scored: Demonstration | None) -> list[Demo]:
    """Return the motions of the reference's surgeon, the reference first, without the scored motion and its cuts."""
    of = Demonstration
    same = of.surgeon_row == reference.surgeon_row, of.suture == reference.suture, of.arm == reference.arm
    query = newest(of, *same, limit=MOST_OF_EXPERT).where(of.learnable)
    others = [one for one in session.scalars(query) if one != reference]
    members = [member_of(one) for one in (*others[::-1], reference, *([scored] if scored else []))]
    counted = {one.row for one in without_overlaps(members)[0]} - {scored.row if scored else None}
    return [one.demo for one in (reference, *others) if one.row in counted]


def _stored(session: Session, asked: described.ScoreIn) -> _Scored | None:
    """Return the stored demonstration to be scored; None if a part of a recording is to be scored."""
    if asked.demo is None:
        return None
    row = comparable_demo(session, asked.demo)
    if row.suture != asked.suture:
        raise BadInput("The demonstration is of another suture type than the style.")
    return _Scored(row.demo, row.recording, row)


def _of_recording(database: Database, asked: described.ScoreIn, parse: Parser) -> _Scored:
    """Cut the motion to be scored out of a stored recording, without storing it."""
    assert asked.recording is not None
    with database.reading() as session:
        stored = find_recording(session, asked.recording)
        _agreed_by_all(session, stored)
    recording = stored_recording(database, stored.sha256, parse).recording
    demo = cut_demo(recording, arm=asked.arm, topic=asked.topic, start_s=asked.start_s, end_s=asked.end_s)
    return _Scored(demo, stored)


def _agreed_by_all(session: Session, recording: StoredRecording) -> None:
    """Refuse a recording without every surgeon's consent; the message names nobody the caller may not see.

    Raises:
        Conflict: The consent of a surgeon with a demonstration in this recording does not cover a comparison.
    """
    if not in_recording(session, recording).may("atlas"):
        raise Conflict("The consent of a surgeon in this recording does not cover comparisons.")


def _agreed_still(session: Session, compared: Sequence[Demonstration | None], recording: StoredRecording) -> None:
    """Check the consents that a score needs once more.

    Raises:
        NotFound: A demonstration was erased since.
        Conflict: A consent does not cover a comparison any more.
    """
    rows = [find_demo(session, one.sha256) for one in compared if one is not None]
    for row in rows:
        require(row.surgeon, "atlas")
    if None in compared:
        _agreed_by_all(session, recording)


NOT_AGREED = "Not rated: the consent of a surgeon in this recording does not cover comparisons."


def _skill(database: Database, recording: StoredRecording, task: str | None, parse: Parser) -> Skill:
    """Return the calibrated model's rating of a whole recording, or the reason why there is none."""
    with database.reading() as session:
        stored = calibrations.newest(session)
        agreed = in_recording(session, recording).may("atlas")
    if stored is None:
        return unrated("Not calibrated: the operator of this installation can calibrate it on rated trials.")
    model = calibrations.read_calibration(stored)
    if model is None:
        return unrated(
            "Not rated: the stored calibration belongs to another version, and is not used. The operator of this "
            "installation can calibrate it again, on rated trials."
        )
    named = task or (model.tasks[0] if len(model.tasks) == 1 else None)
    if named not in model.tasks:
        why = "the calibration has several tasks" if named is None else f"the calibration has no task {named}"
        return unrated(f"Not rated: {why}. Name the recording's task; it has {', '.join(model.tasks)}.")
    judged = stored.about.validated.tasks[named]
    if refused := refusals(judged):
        return unrated(
            f"Not rated: the calibration is not accepted for {named}. {' '.join(refused)} The operator of this "
            "installation can calibrate it again, on rated trials of more surgeons."
        )
    if not agreed:
        return unrated(NOT_AGREED)
    try:
        trial = measure_trial(stored_recording(database, recording.sha256, parse).recording)
        return rate(model, named, trial, stored.sha256, judged)
    except BadInput as error:
        return unrated(f"Not rated: {error.message}")
