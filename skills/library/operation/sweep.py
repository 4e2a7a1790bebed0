"""The sweep: rows that nobody can see any more, or that are older than their retention, deleted in short transactions.

Each step deletes at most `JOBS_AT_ONCE` jobs or `AT_ONCE_BYTES` of chunks, because others wait for it; fewer jobs,
where the step before took longer than `HELD_S`. A step that is interrupted is repeated, so any process may sweep:
whoever has erased something, before it answers; and the workers, once a minute.

A clock that is set ahead by mistake makes everything look old. So a worker deletes by age only while its clock has run
steadily for `STEADY_S` (`SteadyClock`): that is the time in which a wrong clock can be corrected without loss.
"""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import timedelta
from math import inf
from time import monotonic
from typing import Any, cast

from sqlalchemy import Select, Table, delete, exists, or_, select, update
from sqlalchemy.orm import Session, aliased

from skills.db import models, now
from skills.db.models import (
    AT_ONCE_BYTES,
    CHUNK_BYTES,
    LooseChunks,
    Plan,
    StoredPictures,
    StoredPlayback,
    StoredRecording,
)
from skills.db.row_visibility import ALL_ROWS
from skills.db.service_tables import ErasedSurgeon, Job, StyleToRetrain
from skills.db.session import Database
from skills.library.operation import locks
from skills.library.operation.jobs import ACTIVE, BATCH, EXPORT, PICTURES, UNSYNCHRONISED, cancel_parts, identity_of
from skills.library.recordings.content_cache import UNFINISHED
from skills.settings import Settings

JOBS_AT_ONCE = 300
FEWEST_JOBS = 20
HELD_S = 0.05  # ours: half of the time for which nothing may hold SQLite's one lock
PICTURES_AT_ONCE = 10
UNDIVIDED_S = 60.0  # ours: some styles of a batch are added each second, or its request was interrupted
STEADY_S = 3600.0  # ours: retentions are of a year, so an hour more changes nothing
STEP_S = 60.0  # ours: a larger difference is no correction of a clock that was right
_JOBS = cast(Table, Job.__table__)  # bare: who erases need not be allowed to see all that is left
INTERRUPTED = "The service stopped before all styles of the batch were added; request it again."


@dataclass
class SteadyClock:
    """Compares the wall clock with the monotonic one, each time that it is asked."""

    wall: Callable[[], float] = time.time
    elapsed: Callable[[], float] = monotonic
    _ahead_s: float | None = None
    _since_s: float = 0.0

    def is_steady(self) -> bool:
        """Return whether the wall clock has run for `STEADY_S` without a step of more than `STEP_S`."""
        at_s = self.elapsed()
        ahead_s = self.wall() - at_s
        if self._ahead_s is None or not abs(ahead_s - self._ahead_s) <= STEP_S:
            self._since_s = at_s
        self._ahead_s = ahead_s
        return at_s - self._since_s >= STEADY_S


def sweep_erased(database: Database) -> None:
    """Delete all that is left of erased surgeons, deleted recordings and interrupted uploads, after their commit.

    Erased data must not stay in SQLite's write-ahead log either.
    """
    deque(_sweep_jobs(database), maxlen=0)
    while _sweep_chunks(database):
        pass
    database.forget()


def sweep(database: Database, settings: Settings, at_most_s: float = inf, *, by_age: bool = True) -> bool:
    """Delete what is left of erasures, and what is older than its retention; fail batches that were interrupted.

    Args:
        database: The database, without restriction.
        settings: The retentions.
        at_most_s: Stop after the step during which this time has passed.
        by_age: Delete what is older than its retention.

    Returns:
        Whether nothing is left to delete.
    """
    began_s = monotonic()
    database.reserve_space()
    _fail_undivided(database)
    return all(monotonic() - began_s <= at_most_s for _ in _steps(database, settings, by_age))


def _steps(database: Database, settings: Settings, by_age: bool) -> Iterator[None]:
    """Delete what is due, what is old only `by_age`, and yield after each transaction."""
    yield from _sweep_jobs(database)
    pictures, ended = timedelta(days=settings.keep_pictures_days), timedelta(days=settings.keep_jobs_days)
    while _sweep_chunks(database) or (
        by_age and (_sweep_pictures(database, pictures) or _sweep_ended(database, ended))
    ):
        yield


def delete_jobs(session: Session, surgeon_row: int) -> None:
    """Delete the jobs of an erased surgeon that have ended; more than a few are hidden, and left to the sweep."""
    if len(session.scalars(_jobs_of(surgeon_row).limit(JOBS_AT_ONCE + 1)).all()) <= JOBS_AT_ONCE:
        session.execute(delete(_JOBS).where(_JOBS.c.surgeon_row == surgeon_row))
    else:
        session.add(ErasedSurgeon(surgeon_row=surgeon_row))


def drop_contents(database: Database, recordings: Iterable[int]) -> None:
    """Delete the cached contents of recordings in steps, before the transaction that erases these.

    Otherwise they are deleted with the recordings, in one step. A recording that remains is decoded at its next use.

    Args:
        database: The database, restricted or not.
        recordings: The rows of the recordings; one of them may be gone.
    """
    for row in recordings:
        while _drop_content(database, row):
            pass


def _drop_content(database: Database, recording_row: int) -> bool:
    """Delete some chunks of a cached content, which is not used from then on; return whether there may be more."""
    of, entry, at_once = models.ParsedChunk, models.ParsedRecording, AT_ONCE_BYTES // CHUNK_BYTES
    with database.reading() as session:
        sha256 = session.scalar(select(StoredRecording.sha256).where(StoredRecording.row == recording_row))
    if sha256 is None:
        return False
    with database.ending([locks.recording(sha256)]) as session:
        unfinished = update(entry).where(entry.recording_row == recording_row).values(version=UNFINISHED)
        session.execute(unfinished, **UNSYNCHRONISED)
        mine = of.recording_row == recording_row
        numbers = session.scalars(select(of.number).where(mine).order_by(of.number).limit(at_once)).all()
        session.execute(delete(of).where(mine, of.number.in_(numbers)), **UNSYNCHRONISED)
        return len(numbers) == at_once


def _sweep_chunks(database: Database) -> bool:
    """Delete some chunks that are due; return whether there were any."""
    at_once = AT_ONCE_BYTES // CHUNK_BYTES
    with database.ending([locks.SWEEP]) as session:
        row = session.scalar(select(LooseChunks.recording_row).where(LooseChunks.due_at <= now()).limit(1))
        if row is None:
            return False
        of = models.RecordingChunk
        some = select(of.number).where(of.recording == row).order_by(of.number).limit(at_once)
        numbers = session.scalars(some, execution_options=ALL_ROWS).all()
        session.execute(delete(of).where(of.recording == row, of.number.in_(numbers)), **UNSYNCHRONISED)
        if len(numbers) < at_once:
            session.execute(delete(LooseChunks).where(LooseChunks.recording_row == row), **UNSYNCHRONISED)
        return True


def _sweep_jobs(database: Database) -> Iterator[None]:
    """Delete the jobs of erased surgeons, and yield after each transaction.

    The rows of a surgeon's jobs are read once: PostgreSQL finds the next ones of a surgeon with many by walking along
    the table, each time past all that are deleted already.
    """
    with database.reading() as session:
        surgeons = session.scalars(select(ErasedSurgeon.surgeon_row)).all()
    for surgeon_row in surgeons:
        with database.reading() as session:
            rows = session.scalars(_jobs_of(surgeon_row)).all()
        done, at_once = 0, max(JOBS_AT_ONCE // 4, 1)  # more where steps turn out to be fast
        while done < len(rows):
            with database.ending([locks.SWEEP]) as session:
                session.connection()
                began_s = monotonic()
                session.execute(delete(_JOBS).where(_JOBS.c.row.in_(rows[done : done + at_once])))
            done += at_once
            share = HELD_S / max(monotonic() - began_s, 1e-6)
            at_once = min(max(int(at_once * min(share, 2.0)), FEWEST_JOBS), JOBS_AT_ONCE)
            yield
        with database.ending([locks.SWEEP]) as session:
            theirs = delete(ErasedSurgeon).where(ErasedSurgeon.surgeon_row == surgeon_row)
            session.execute(theirs, **UNSYNCHRONISED)
        yield


def _jobs_of(surgeon_row: int) -> Select[int]:
    return select(_JOBS.c.row).where(_JOBS.c.surgeon_row == surgeon_row)


def _fail_undivided(database: Database) -> None:
    """Fail the batches to which nobody adds styles any more."""
    long_ago = now() - timedelta(seconds=UNDIVIDED_S)
    part, of = aliased(Job), StyleToRetrain
    lately = exists().where(of.job_row == Job.row, of.part_row == part.row, part.created_at >= long_ago)
    waiting = (Job.kind == BATCH, Job.state.in_(ACTIVE), Job.submitted_at.is_(None), Job.created_at < long_ago, ~lately)
    with database.reading() as session:
        rows = session.scalars(select(Job.row).where(*waiting)).all()
    for row in rows:
        with database.writing([locks.job(row)]) as session:
            failed = {"state": "failed", "error": INTERRUPTED, "ended_at": now()}
            mine = update(Job).where(Job.row == row, *waiting).values(**failed).returning(Job.row)
            if session.execute(mine).first() is not None:
                cancel_parts(session, row)


def _sweep_pictures(database: Database, age: timedelta) -> bool:
    """Delete some older pictures, with the jobs that drew them, so that they can be requested again."""
    of = StoredPictures
    old = select(of.row, StoredPlayback.sha256, Plan.sha256).join(StoredPlayback, StoredPlayback.row == of.playback_row)
    old = old.join(Plan, Plan.row == StoredPlayback.plan_row).where(of.created_at < now() - age)
    if not _are_there(database, old):
        return False
    with database.writing() as session:
        found = session.execute(old.order_by(of.created_at).limit(PICTURES_AT_ONCE)).all()
        requests = [identity_of(PICTURES, {"plan": plan, "playback": playback}) for _, playback, plan in found]
        drew = (Job.identity.in_(requests), Job.state.not_in(ACTIVE))
        session.execute(delete(Job).where(*drew), **UNSYNCHRONISED)
        session.execute(delete(of).where(of.row.in_([row for row, *_ in found])), **UNSYNCHRONISED)
    return True


def _sweep_ended(database: Database, age: timedelta) -> bool:
    """Delete some jobs that ended longer ago; return whether there were any.

    A batch is deleted after its styles and parts. An export stays as long as its dataset.
    """
    of = StyleToRetrain
    ended = select(Job.row).where(Job.ended_at < now() - age, Job.state.not_in(ACTIVE), Job.kind != EXPORT)
    styles = exists().where(or_(of.part_row == Job.row, of.job_row == Job.row)).correlate(Job)
    alone, batches = ended.where(~styles), ended.where(Job.kind == BATCH, styles)
    if not _are_there(database, ended):
        return False
    with database.writing() as session:
        rows = session.scalars(alone.order_by(Job.ended_at).limit(JOBS_AT_ONCE)).all()
        if rows:
            session.execute(delete(Job).where(Job.row.in_(rows)), **UNSYNCHRONISED)
            return True
        batch = session.scalar(batches.limit(1))
        if batch is None:
            return False  # parts of a batch that has not ended so long ago
        mine = select(of.row).where(of.job_row == batch).limit(JOBS_AT_ONCE)
        session.execute(delete(of).where(of.row.in_(session.scalars(mine).all())), **UNSYNCHRONISED)
        return True


def _are_there(database: Database, rows: Select[*tuple[Any, ...]]) -> bool:
    """Ask without any lock, because mostly there are none."""
    with database.reading() as session:
        return session.execute(rows.limit(1)).first() is not None
