"""Demonstrations: hand-offs cut out of recordings and put into their grid worlds, checked before anything is kept."""

import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.base import now
from skills.db.models import Demonstration, Release, StoredRecording, StoredRewardMap, Surgeon
from skills.db.packed import digest
from skills.db.seen import EVERYBODYS
from skills.db.session import Database
from skills.errors import Conflict, NotFound
from skills.library.catalogue import check_consent, find_surgeon, find_suture_type
from skills.library.events import record
from skills.library.recordings import Reader, Upload, find_recording, keep, read_upload, recording_bytes
from skills.library.releases import withdraw_resting_on
from skills.library.verified import demo_identity
from skills.packing import canonical
from skills.recordings import read_recording
from skills.style.demo import Demo, Recording, cut_demo
from skills.style.grid import PAPER_GRID, GridMode, GridPath, choose_grid, discretize
from skills.style.quality import describe, describe_path
from skills.style.reward import RewardMap, sparse_reward


@dataclass(frozen=True)
class Cut:
    """What is asked for of a recording: whose, which part, in which grid."""

    surgeon: str
    suture: str
    arm: str | None = None
    topic: str | None = None
    start_s: float | None = None
    end_s: float | None = None
    grid: GridMode = "auto"
    cell_mm: float | None = None
    hysteresis: float = 0.0
    session: str | None = None


@dataclass(frozen=True, eq=False)
class Made:
    """A demonstration before it is stored."""

    demo: Demo
    path: GridPath
    reward: RewardMap
    report: dict[str, Any]


def make_demo(recording: Recording, cut: Cut) -> Made:
    """Cut a hand-off out of a recording and put it into its grid world."""
    demo = cut_demo(recording, arm=cut.arm, topic=cut.topic, start_s=cut.start_s, end_s=cut.end_s)
    grid = choose_grid(demo.tip_mm, cut.grid, cut.cell_mm)
    path = discretize(demo.tip_mm, grid, cut.hysteresis)
    duplicates = recording.motion_of(arm=demo.arm, topic=demo.topic).duplicate_stamps
    return Made(demo, path, sparse_reward(path), report_on(demo, path, duplicates))


def report_on(demo: Demo, path: GridPath, duplicate_stamps: int) -> dict[str, Any]:
    """Write what is measured of a demonstration and its path, and what to do about it.

    Args:
        demo: The demonstration.
        path: It in its grid.
        duplicate_stamps: Samples of the whole recorded motion that carried the stamp of the sample before.
    """
    of_motion, of_path = describe(demo), describe_path(demo, path)
    advice = [*of_motion.advice, *_about_duplicates(duplicate_stamps), *of_path.advice]
    grid = asdict(path.grid) | {"chosen": "paper" if path.grid == PAPER_GRID else "fit"}
    partner = None if demo.partner is None else asdict(demo.partner) | {"approach": list(demo.partner.approach)}
    numbers = asdict(of_motion) | asdict(of_path) | {"duplicate_stamps": duplicate_stamps}
    written: dict[str, Any] = json.loads(canonical(numbers | {"grid": grid, "partner": partner, "advice": advice}))
    return written  # as it is read back


def full_report(demonstration: Demonstration) -> dict[str, Any]:
    """Measure a stored demonstration again: what was stored of an older one says less."""
    motions = demonstration.recording.about["motions"]
    duplicates = next((m["duplicate_stamps"] for m in motions if m["topic"] == demonstration.topic), 0)
    return report_on(demonstration.demo, demonstration.path, duplicates)


def _about_duplicates(count: int) -> list[str]:
    if count == 0:
        return []
    samples = "1 sample" if count == 1 else f"{count} samples"
    return [f"{samples} carried the stamp of the sample before and were dropped: check the recorder's clock."]


def upload_demo(
    database: Database, upload: Upload, cut: Cut, actor: str, read: Reader = read_recording
) -> tuple[Demonstration, bool]:
    """Store a recording and one demonstration of it, both or neither."""
    with database.reading() as session:  # refused before the long work, looked up again when writing
        find_surgeon(session, cut.surgeon)
        find_suture_type(session, cut.suture)
    recording = read_upload(upload, read)
    made = make_demo(recording, cut)
    with database.writing() as session:
        stored, _ = keep(session, upload, recording, actor)
        return _store_demo(session, stored, made, cut, actor)


def add_demo(
    database: Database, recording_sha256: str, cut: Cut, actor: str, read: Reader = read_recording
) -> tuple[Demonstration, bool]:
    """Cut one more demonstration out of a stored recording."""
    with tempfile.TemporaryFile() as file:
        with database.reading() as session:
            find_surgeon(session, cut.surgeon)
            find_suture_type(session, cut.suture)
            stored = find_recording(session, recording_sha256)
            file.writelines(recording_bytes(session, stored))
        recording = read(file, **stored.reading)
    made = make_demo(recording, cut)
    with database.writing() as session:
        return _store_demo(session, find_recording(session, recording_sha256), made, cut, actor)


def _store_demo(
    session: Session, stored: StoredRecording, made: Made, cut: Cut, actor: str
) -> tuple[Demonstration, bool]:
    surgeon, suture = find_surgeon(session, cut.surgeon), find_suture_type(session, cut.suture)
    demo_sha256 = demo_identity(stored.sha256, surgeon.slug, suture.slug, made.demo, made.path)
    known = session.scalar(select(Demonstration).where(Demonstration.sha256 == demo_sha256))
    if known is not None:
        if known.withdrawn_at is not None:
            raise Conflict("This demonstration was withdrawn; record another, or cut another part of the recording.")
        return known, False
    demonstration = Demonstration(
        sha256=demo_sha256,
        recording=stored,
        surgeon=surgeon,
        suture=suture.slug,
        arm=made.demo.arm,
        topic=made.demo.topic,
        frame=made.demo.frame,
        instrument=made.demo.instrument,
        start_s=made.demo.start_s,
        end_s=made.demo.end_s,
        session=cut.session,
        hysteresis=made.path.hysteresis,
        demo=made.demo,
        path=made.path,
        report=made.report,
    )
    session.add(demonstration)
    session.flush()
    session.add(
        StoredRewardMap(sha256=digest(made.reward), demonstration_row=demonstration.row, map=made.reward),
    )
    record(session, actor, "add", "demonstration", demo_sha256, surgeon)
    return demonstration, True


def find_demo(session: Session, demo_sha256: str) -> Demonstration:
    """Find a demonstration by its digest."""
    demonstration = session.scalar(select(Demonstration).where(Demonstration.sha256 == demo_sha256))
    if demonstration is None:
        raise NotFound("There is no such demonstration; GET /demos lists them.")
    return demonstration


def exported_recording(session: Session, demo_sha256: str) -> StoredRecording:
    """Find the recording of a demonstration, for whoever takes its bytes away.

    Raises:
        Conflict: The consent of a surgeon of whom it holds a demonstration does not cover an export.
    """
    demo = find_demo(session, demo_sha256)
    check_consent(demo.surgeon, "export")
    also = select(Demonstration.surgeon_row).where(Demonstration.recording_row == demo.recording_row)
    others = select(Surgeon).where(Surgeon.row.in_(also), Surgeon.row != demo.surgeon_row)
    for other in session.scalars(others, execution_options=EVERYBODYS):
        try:
            check_consent(other, "export")
        except Conflict:  # whose it is, whoever asks may not be allowed to know
            why = "Another surgeon's hand-off is in this recording, and their consent does not cover export."
            raise Conflict(why) from None
    return demo.recording


def newest_demo(session: Session, surgeon_row: int, suture: str) -> Demonstration | None:
    """Find the newest active demonstration of a style."""
    return session.scalar(
        select(Demonstration)
        .where(Demonstration.surgeon_row == surgeon_row, Demonstration.suture == suture)
        .where(Demonstration.withdrawn_at.is_(None))
        .order_by(Demonstration.row.desc())
        .limit(1)
    )


def list_demos(
    session: Session,
    limit: int,
    before: int | None,
    surgeon: str | None,
    suture: str | None,
    recording: str | None = None,
    active: bool | None = None,
) -> Sequence[Demonstration]:
    """List demonstrations, the newest first: all, or those of a surgeon, a suture type, a recording; active or not."""
    query = select(Demonstration).order_by(Demonstration.row.desc()).limit(limit)
    if before is not None:
        query = query.where(Demonstration.row < before)
    if surgeon is not None:
        query = query.where(Demonstration.surgeon_row == find_surgeon(session, surgeon).row)
    if suture is not None:
        query = query.where(Demonstration.suture == find_suture_type(session, suture).slug)
    if recording is not None:
        query = query.where(Demonstration.recording_row == find_recording(session, recording).row)
    if active is not None:
        query = query.where(Demonstration.withdrawn_at.is_(None) if active else Demonstration.withdrawn_at.is_not(None))
    return session.scalars(query).all()


def withdraw_demo(session: Session, demo_sha256: str, actor: str) -> list[Release]:
    """Withdraw a demonstration and the releases that rest on it; withdrawing it again changes nothing."""
    demonstration = find_demo(session, demo_sha256)
    if demonstration.withdrawn_at is not None:
        return []
    demonstration.withdrawn_at = now()
    record(session, actor, "withdraw", "demonstration", demo_sha256, demonstration.surgeon)
    return withdraw_resting_on(session, demonstration, actor)
