"""Whether an installation can work: its database, the job engine's, and a worker that lives.

Each is tried anew, on connections of its own and with little patience, so that the answer is of now and comes in time.
"""

import time
from collections.abc import Mapping
from contextlib import closing
from datetime import datetime, timedelta
from pathlib import Path

from sqlalchemy import select, text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import SQLAlchemyError

from skills.db.base import now
from skills.db.books import Executor
from skills.db.models import SutureType
from skills.db.schema import revision_of, revisions
from skills.db.session import Database
from skills.errors import NotReady, SkillsError
from skills.settings import Settings

PATIENCE_MS = 2000
LOOK_S = 0.1


def refuse_unready(settings: Settings) -> int:
    """Try what a request and a job need: the number of workers.

    Raises:
        NotReady: Something cannot be used; the message says what, and what to do.
    """
    _refuse_missing(settings.database_url, "The database")
    with closing(Database(settings.database_url, patience_ms=PATIENCE_MS)) as database:
        _try_database(database)
        _try_engine(settings)
        return _workers(database, settings.lease_s)


def refuse_left_over(settings: Settings) -> None:
    """Refuse a job engine that remembers the jobs of another state of the database: it would mix them up.

    Raises:
        NotReady: It does, or it cannot be asked.
    """
    engine = make_url(settings.engine_url)
    if engine.get_backend_name() == "sqlite":
        if engine.database and Path(engine.database).exists():
            raise NotReady(f"{engine.database} is the job engine's of another state of this database; move it away.")
        return
    with closing(Database(settings.engine_url, patience_ms=PATIENCE_MS)) as database, database.reading() as session:
        if session.scalar(text("SELECT to_regclass('dbos.workflow_status')")) is not None:
            raise NotReady("The schema `dbos` is the job engine's of another state of this database; drop it.")


def _refuse_missing(url: str, what: str) -> None:
    """Refuse a file that is not there, which trying to open it would make."""
    parsed = make_url(url)
    if parsed.get_backend_name() == "sqlite" and parsed.database and not Path(parsed.database).is_file():
        raise NotReady(f"{what} is not there; `skills migrate` makes the database, a worker the job engine's.")


def _try_database(database: Database) -> None:
    try:
        with database.writing() as session:  # a lock that can be had, on a database that can be written
            revision = revision_of(session.connection())
            if revision == revisions()[0]:
                session.execute(select(SutureType.slug).limit(1))
    except (SkillsError, SQLAlchemyError) as error:
        raise NotReady("The database cannot be read and written; look at it, its disk and its server.") from error
    if revision is None:
        raise NotReady("The database has no tables yet; run `skills migrate`.")
    if revision not in revisions():
        raise NotReady("The database was brought to a newer version; update the code of this process.")
    if revision != revisions()[0]:
        raise NotReady("The database is of an older version; run `skills migrate`.")


def _try_engine(settings: Settings) -> None:
    _refuse_missing(settings.engine_url, "The job engine's database")
    try:
        with closing(Database(settings.engine_url, patience_ms=PATIENCE_MS)) as engine, engine.writing() as session:
            table = "workflow_status" if session.connection().dialect.name == "sqlite" else "dbos.workflow_status"
            session.execute(text(f"SELECT 1 FROM {table} LIMIT 1"))  # noqa: S608 - one of two names of ours
    except (SkillsError, SQLAlchemyError) as error:
        raise NotReady("The job engine's database cannot be used; look at it, and start a worker.") from error


def _workers(database: Database, lease_s: float) -> int:
    """Count the workers that live: by the clock, and where that says none, by watching for a beat.

    A clock that stepped, or another machine's, makes a live worker look dead; a beat that changes shows that it lives.
    """
    first = _beats(database)
    alive = sum(abs(now() - beat_at) <= timedelta(seconds=lease_s) for beat_at in first.values())
    until = time.monotonic() + lease_s
    while first and not alive and time.monotonic() < until:
        time.sleep(LOOK_S)
        alive = sum(first.get(name) != beat_at for name, beat_at in _beats(database).items())
    if not alive:
        raise NotReady("No worker has shown that it lives; start one with `skills worker`, and look at its log.")
    return alive


def _beats(database: Database) -> Mapping[str, datetime]:
    try:
        with database.reading() as session:
            return {one.id: one.beat_at for one in session.execute(select(Executor.id, Executor.beat_at))}
    except (SkillsError, SQLAlchemyError) as error:
        raise NotReady("The database cannot be read; look at it, its disk and its server.") from error
