"""The figures of an installation at this moment: its jobs, its workers, its database. Nobody is named in them."""

from collections import defaultdict
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from sqlalchemy import func, select, text
from sqlalchemy.orm import Session

from skills.db.base import now
from skills.db.books import Event, Executor, Job

RECENT = 500  # jobs whose durations are told: enough for a 99th percentile to mean something
QUANTILES = (0.5, 0.95, 1.0)


@dataclass(frozen=True)
class Condition:
    """What is told of an installation; `seconds` are quantiles over the jobs that ended last, by kind."""

    jobs: dict[tuple[str, str], int]
    seconds: dict[str, dict[float, float]]
    oldest_queued_s: float
    workers: int
    database_bytes: int
    last_event_at: datetime | None


def condition_of(session: Session, lease_s: float) -> Condition:
    """Read the figures of an installation."""
    at, beats = now(), select(Executor.beat_at)
    counted = session.execute(select(Job.kind, Job.state, func.count()).group_by(Job.kind, Job.state))
    oldest = session.scalar(select(func.min(Job.created_at)).where(Job.state == "queued"))
    return Condition(
        jobs={(kind, state): count for kind, state, count in counted},
        seconds=_seconds(session),
        oldest_queued_s=0.0 if oldest is None else max(0.0, (at - oldest).total_seconds()),
        workers=sum(abs(at - beat_at) <= timedelta(seconds=lease_s) for beat_at in session.scalars(beats)),
        database_bytes=_size(session),
        last_event_at=session.scalar(select(Event.at).order_by(Event.row.desc()).limit(1)),
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
    """Measure the database: on SQLite its file and the log beside it."""
    connection = session.connection()
    if connection.dialect.name != "sqlite":
        return session.scalar(text("SELECT pg_database_size(current_database())")) or 0
    file = Path(connection.engine.url.database or "")
    beside = (file, file.with_name(f"{file.name}-wal"))
    return sum(one.stat().st_size for one in beside if one.is_file())
