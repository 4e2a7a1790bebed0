"""Demonstrations: hand-offs cut out of recordings and put into their grid worlds, checked before anything is kept."""

import io
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.base import now
from skills.db.models import Demonstration, Release, StoredRecording, StoredRewardMap
from skills.db.packed import canonical, digest, sha256
from skills.db.session import Database
from skills.errors import Conflict, NotFound
from skills.library.catalogue import find_surgeon, find_suture_type
from skills.library.events import record
from skills.library.recordings import Upload, find_recording, keep, read_upload, recording_bytes
from skills.library.releases import withdraw_resting_on
from skills.recordings import read_recording
from skills.style.demo import Demo, Recording, cut_demo, describe
from skills.style.evaluation import discretisation_rmse
from skills.style.grid import PAPER_GRID, GridMode, GridPath, choose_grid, discretize
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
    report = asdict(describe(demo)) | {
        "grid": asdict(grid) | {"chosen": "paper" if grid == PAPER_GRID else "fit"},
        "path_states": len(path.states),
        "revisits": path.revisits,
        "bridged_cells": path.bridged,
        "discretisation_rmse_mm": list(discretisation_rmse(demo.tip_mm, grid, path.hysteresis)),
    }
    return Made(demo, path, sparse_reward(path), report)


def upload_demo(database: Database, upload: Upload, cut: Cut, actor: str) -> tuple[Demonstration, bool]:
    """Store a recording and one demonstration of it, both or neither."""
    with database.reading() as session:  # refused before the long work, looked up again when writing
        find_surgeon(session, cut.surgeon)
        find_suture_type(session, cut.suture)
    recording = read_upload(upload)
    made = make_demo(recording, cut)
    with database.writing() as session:
        stored, _ = keep(session, upload, recording, actor)
        return _store_demo(session, stored, made, cut, actor)


def add_demo(database: Database, recording_sha256: str, cut: Cut, actor: str) -> tuple[Demonstration, bool]:
    """Cut one more demonstration out of a stored recording."""
    with database.reading() as session:
        find_surgeon(session, cut.surgeon)
        find_suture_type(session, cut.suture)
        stored = find_recording(session, recording_sha256)
        data = b"".join(recording_bytes(session, stored))
    made = make_demo(read_recording(io.BytesIO(data), **stored.reading), cut)
    with database.writing() as session:
        return _store_demo(session, find_recording(session, recording_sha256), made, cut, actor)


def _store_demo(
    session: Session, stored: StoredRecording, made: Made, cut: Cut, actor: str
) -> tuple[Demonstration, bool]:
    surgeon, suture = find_surgeon(session, cut.surgeon), find_suture_type(session, cut.suture)
    identity: dict[str, Any] = {
        "recording": stored.sha256,
        "surgeon": surgeon.slug,
        "suture": suture.slug,
        "arm": made.demo.arm,
        "topic": made.demo.topic,
        "segment_s": [made.demo.start_s, made.demo.end_s],
        "grid": asdict(made.path.grid),
    }
    if made.path.hysteresis:  # else left out, so that a demonstration is still known by the digest it always had
        identity["hysteresis"] = made.path.hysteresis
    demo_sha256 = sha256(canonical(identity))
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
    session: Session, limit: int, before: int | None, surgeon: str | None, suture: str | None
) -> Sequence[Demonstration]:
    """List demonstrations, the newest first."""
    query = select(Demonstration).order_by(Demonstration.row.desc()).limit(limit)
    if before is not None:
        query = query.where(Demonstration.row < before)
    if surgeon is not None:
        query = query.where(Demonstration.surgeon_row == find_surgeon(session, surgeon).row)
    if suture is not None:
        query = query.where(Demonstration.suture == find_suture_type(session, suture).slug)
    return session.scalars(query).all()


def withdraw_demo(session: Session, demo_sha256: str, actor: str) -> list[Release]:
    """Withdraw a demonstration and the releases that rest on it; withdrawing it again changes nothing."""
    demonstration = find_demo(session, demo_sha256)
    if demonstration.withdrawn_at is not None:
        return []
    demonstration.withdrawn_at = now()
    record(session, actor, "withdraw", "demonstration", demo_sha256, demonstration.surgeon)
    return withdraw_resting_on(session, demonstration, actor)
