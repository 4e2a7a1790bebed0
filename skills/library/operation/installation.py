"""Figures of an installation at this moment, without names: its jobs, its workers, its database."""

from collections import defaultdict
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from sqlalchemy import func, select, text
from sqlalchemy.orm import Session

from skills.db import now
from skills.db.service_tables import Event, Executor, Job

RECENT = 500  # jobs in the quantiles of durations: enough for a meaningful 99th percentile
QUANTILES = (0.5, 0.95, 1.0)


@dataclass(frozen=True)
class InstallationFigures:
    """The figures of an installation; `seconds` are quantiles over the jobs that ended last, by kind.

    `verified_at` is when a worker last verified the history, with `faults_found`.
    """

    seconds: dict[str, dict[float, float]]
    oldest_queued_s: float
    workers: int
    database_bytes: int
    last_event_at: datetime | None
    verified_at: datetime | None
    faults_found: int | None


def count_jobs(session: Session) -> dict[tuple[str, str], int]:
    """Return the number of jobs by kind and state; of a million jobs that takes a tenth of a second."""
    counted = session.execute(select(Job.kind, Job.state, func.count()).group_by(Job.kind, Job.state))
    return {(kind, state): count for kind, state, count in counted}


def figures_of_installation(session: Session, lease_s: float) -> InstallationFigures:
    """Return the figures of an installation.

    Args:
        session: A transaction that sees all rows.
        lease_s: A worker counts if its last heartbeat is at most so old, in s.
    """
    at, beats = now(), select(Executor.beat_at)
    ended = select(Executor.verified_at, Executor.faults_found).where(Executor.verified_at.is_not(None))
    verified_at, found = session.execute(ended.order_by(Executor.verified_at.desc()).limit(1)).first() or (None, None)
    oldest = session.scalar(select(func.min(Job.created_at)).where(Job.state == "queued"))
    return InstallationFigures(
        seconds=_seconds(session),
        oldest_queued_s=0.0 if oldest is None else max(0.0, (at - oldest).total_seconds()),
        workers=sum(abs(at - beat_at) <= timedelta(seconds=lease_s) for beat_at in session.scalars(beats)),
        database_bytes=_size(session),
        last_event_at=session.scalar(select(Event.at).order_by(Event.row.desc()).limit(1)),
        verified_at=verified_at,
        faults_found=found,
    )


def _seconds(session: Session) -> dict[str, dict[float, float]]:
    ended = select(Job.kind, Job.started_at, Job.ended_at).where(Job.started_at.is_not(None), Job.ended_at.is_not(None))
    took: dict[str, list[float]] = defaultdict(list)
    for kind, started_at, ended_at in session.execute(ended.order_by(Job.row.desc()).limit(RECENT)):
        assert started_at is not None and ended_at is not None
        took[kind].append((ended_at - started_at).total_seconds())
    return {
        kind: {q: sorted(seconds)[round(q * (len(seconds) - 1))] for q in QUANTILES} for kind, seconds in took.items()
    }


def _size(session: Session) -> int:
    """Return the size of the database in bytes; on SQLite that of its file and its write-ahead log."""
    connection = session.connection()
    if connection.dialect.name != "sqlite":
        return session.scalar(text("SELECT pg_database_size(current_database())")) or 0
    file = Path(connection.engine.url.database or "")
    beside = (file, file.with_name(f"{file.name}-wal"))
    return sum(one.stat().st_size for one in beside if one.is_file())
