"""What a worker does with one job: it tries, pauses, tries again, and in the end gives up.

Every try is a step of the engine, so tries that were finished are not repeated when another worker takes over. No
exception reaches the engine, which would keep its text; the outcome stands in our row, and every change of that row
names the attempt and the states it may come from.
"""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from dbos import DBOS
from sqlalchemy import func, update

from skills.db.base import now
from skills.db.books import Job
from skills.db.session import Database
from skills.errors import Busy, SkillsError
from skills.jobs.engine import WORKFLOW, workflow_id
from skills.library.batches import PART, end_part
from skills.settings import Settings

ACTIVE = ("queued", "running")
FIRST_PAUSE_S = 0.2
LONGEST_REASON = 2000  # characters, as the column has it

log = logging.getLogger(__name__)
Perform = Callable[[Database, int, int, Settings], None]


@dataclass(frozen=True)
class Work:
    """How jobs are carried out in this process."""

    database: Database
    settings: Settings
    perform: Perform
    doing: set[str] = field(default_factory=set)  # workflows that have been begun and have not ended

    @contextmanager
    def begun(self, workflow: str) -> Iterator[None]:
        """Keep a workflow among those that are being done for as long as the block."""
        self.doing.add(workflow)
        try:
            yield
        finally:
            self.doing.discard(workflow)

    def try_once(self, row: int, attempt: int, tries: int) -> bool:
        """Try to carry a job out; tell whether that settled it, for good or bad.

        The pause comes before the second try and grows fourfold; it is not the engine's durable sleep, which would
        take a step of the clock for time that has passed.
        """
        time.sleep(FIRST_PAUSE_S * 4 ** (tries - 1) if tries else 0.0)
        try:
            if start(self.database, row, attempt):
                self.perform(self.database, row, attempt, self.settings)
            return True
        except Busy:
            log.warning("Job %d: the database was busy at try %d.", row, tries + 1)
            return False
        except SkillsError as refused:
            return self._end(row, attempt, str(refused))
        except Exception:
            log.exception("Job %d: try %d of %d failed.", row, tries + 1, self.settings.job_attempts)
            return False

    def give_up(self, row: int, attempt: int) -> bool:
        """Say that the job failed through no fault of the request; what happened is in the worker's log."""
        return self._end(
            row,
            attempt,
            f"It was tried {self.settings.job_attempts} times and failed inside the service each time; "
            "ask again, and if it fails again show the worker's log to whoever operates it.",
        )

    def _end(self, row: int, attempt: int, reason: str) -> bool:
        try:
            fail(self.database, row, attempt, reason)
        except Exception:  # the watch finds a workflow that ended and a row that did not, and fails it then
            log.exception("Job %d: it failed, and that could not be written.", row)
        return True


def start(database: Database, row: int, attempt: int) -> bool:
    """Mark a job as running, or find it so after a crash; tell whether this attempt is still wanted."""
    changes = {"state": "running", "started_at": func.coalesce(Job.started_at, now())}
    with database.writing() as session:
        mine = (Job.row == row, Job.attempt == attempt, Job.state.in_(ACTIVE))
        return session.execute(update(Job).where(*mine).values(**changes).returning(Job.row)).first() is not None


def fail(database: Database, row: int, attempt: int, reason: str, state: str = "failed") -> bool:
    """End a job without a result, unless it has ended or another attempt has it; tell whether it was so ended."""
    reason = reason[:LONGEST_REASON]
    changes = {"state": state, "error": reason, "ended_at": now()}
    with database.writing() as session:
        mine = (Job.row == row, Job.attempt == attempt, Job.state.in_(ACTIVE))
        ended = session.execute(update(Job).where(*mine).values(**changes).returning(Job.kind, Job.request)).first()
        if ended is not None and ended.kind == PART:
            end_part(session, ended.request["retraining"], row, state, reason)
        return ended is not None


def register(work: Work) -> None:
    """Declare the workflow and its steps to the engine, before it is launched.

    Its steps are the tries and, after the last, giving up. Change `engine.STEPS` when that sequence changes.
    """
    attempts = work.settings.job_attempts

    @DBOS.step(name="try_job")
    def try_job(row: int, attempt: int, tries: int) -> bool:
        return work.try_once(row, attempt, tries)

    @DBOS.step(name="give_up")
    def give_up(row: int, attempt: int) -> bool:
        return work.give_up(row, attempt)

    # A job that kills its worker is handed on as often as one that raises is tried.
    @DBOS.workflow(name=WORKFLOW, max_recovery_attempts=attempts - 1)
    def perform_job(row: int, attempt: int) -> None:
        with work.begun(workflow_id(row, attempt)):
            if not any(try_job(row, attempt, tries) for tries in range(attempts)):
                give_up(row, attempt)
