"""A line in the log for every try at a job: which one, of what kind, how it ended, how long it took."""

import logging
import time

from sqlalchemy import select

from skills.db.books import Job
from skills.db.session import Database
from skills.jobs.workflows import Perform
from skills.logs import job_id, told
from skills.settings import Settings

log = logging.getLogger(__name__)


def logged(perform: Perform) -> Perform:
    """Carry jobs out in the same way, and tell of each; an error is told by its class alone."""

    def run(database: Database, row: int, attempt: int, settings: Settings) -> None:
        name, kind, _ = _look(database, row)
        token, began, outcome = job_id.set(name), time.monotonic(), ""
        try:
            perform(database, row, attempt, settings)
            outcome = _look(database, row)[2]
        except Exception as error:
            outcome = type(error).__name__
            raise
        finally:
            seconds = round(time.monotonic() - began, 3)
            told(log, "job", kind=kind, attempt=attempt, outcome=outcome, seconds=seconds)
            job_id.reset(token)

    return run


def _look(database: Database, row: int) -> tuple[str, str, str]:
    with database.reading() as session:
        found = session.execute(select(Job.id, Job.kind, Job.state).where(Job.row == row)).first()
    return ("", "", "erased") if found is None else (found.id, found.kind, found.state)
