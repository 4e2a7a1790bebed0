"""Readiness of an installation: checks of its databases and workers.

There must be a usable database, the one that was signed last with this signing key, a usable database of the job
engine, and at least one live worker. Each check uses new connections with a short timeout, so that the result is
current and arrives in time.
"""

import time
from collections.abc import Mapping
from contextlib import closing
from datetime import datetime, timedelta
from pathlib import Path

from sqlalchemy import select
from sqlalchemy.engine import make_url
from sqlalchemy.exc import SQLAlchemyError

from skills.db import now
from skills.db.models import SutureType
from skills.db.revisions import revision_of, revisions
from skills.db.service_tables import Executor
from skills.db.session import Database
from skills.errors import NotReady, SkillsError
from skills.jobs import select_a_workflow
from skills.remedies import Action, Remedy
from skills.settings import Settings

PATIENCE_MS = 2000  # of each connection; a health check must answer soon
LOOK_S = 0.1  # between two looks at the heartbeats
UNUSABLE = "The database cannot be read and written; check it, its disk and its server."


def refuse_unready(settings: Settings) -> int:
    """Check everything that a request and a job need, and return the number of live workers.

    Raises:
        NotReady: A part cannot be used; the message names it and the remedy.
    """
    _refuse_missing(settings.database_url, "The database")
    try:
        opened = Database.of(settings, patience_ms=PATIENCE_MS)
    except SkillsError as error:
        raise NotReady(UNUSABLE) from error
    with closing(opened) as database:
        _try_database(database)
        database.compare_history()
        _try_engine(settings)
        if not (alive := live_workers(database, settings.lease_s)):
            raise NotReady("No worker has renewed its lease.", Remedy(Action.START_WORKER))
        return alive


def _refuse_missing(url: str, what: str) -> None:
    """Refuse a SQLite file that does not exist; opening it would create it."""
    parsed = make_url(url)
    if parsed.get_backend_name() == "sqlite" and parsed.database and not Path(parsed.database).is_file():
        raise NotReady(f"{what} does not exist.", Remedy(Action.MIGRATE), Remedy(Action.START_WORKER))


def _try_database(database: Database) -> None:
    try:
        with database.writing(()) as session:  # a write transaction, so that a lock or a read-only file is found
            revision = revision_of(session.connection())
            if revision == revisions()[0]:
                session.execute(select(SutureType.slug).limit(1))
    except (SkillsError, SQLAlchemyError) as error:
        raise NotReady(UNUSABLE) from error
    if revision is None:
        raise NotReady("The database has no tables yet.", Remedy(Action.MIGRATE))
    if revision not in revisions():
        raise NotReady("The database is of another version; use the code that made it, or name another database.")
    if revision != revisions()[0]:
        raise NotReady("The database has an older version.", Remedy(Action.MIGRATE))


def _try_engine(settings: Settings) -> None:
    _refuse_missing(settings.engine_url, "The job engine's database")
    try:
        with closing(Database(settings.engine_url, patience_ms=PATIENCE_MS)) as engine, engine.writing(()) as session:
            session.execute(select_a_workflow(session.connection().dialect.name))
    except (SkillsError, SQLAlchemyError) as error:
        raise NotReady("The job engine's database cannot be used; check it, and start a worker.") from error


def live_workers(database: Database, lease_s: float) -> int:
    """Return the number of live workers, by the dates of their heartbeats or, if all are old, by waiting for a new one.

    A clock that was adjusted, or that of another machine, makes a live worker look dead; a heartbeat that changes shows
    that it is alive.
    """
    first = _beats(database)
    alive = sum(abs(now() - beat_at) <= timedelta(seconds=lease_s) for beat_at in first.values())
    until = time.monotonic() + lease_s
    while first and not alive and time.monotonic() < until:
        time.sleep(LOOK_S)
        alive = sum(first.get(name) != beat_at for name, beat_at in _beats(database).items())
    return alive


def _beats(database: Database) -> Mapping[str, datetime]:
    try:
        with database.reading() as session:
            return {one.id: one.beat_at for one in session.execute(select(Executor.id, Executor.beat_at))}
    except (SkillsError, SQLAlchemyError) as error:
        raise NotReady("The database cannot be read; check it, its disk and its server.") from error
