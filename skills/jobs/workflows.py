"""The workflow of one job: try, pause, retry, give up.

Each try is a step of the engine, so finished tries are not repeated when another worker takes over. No exception
reaches the engine, which would store its text; the outcome is stored in our row, and each update of that row names the
attempt and the states that it may replace.
"""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from threading import Thread

from dbos import DBOS
from sqlalchemy import func, update

from skills.db import now
from skills.db.service_tables import LONGEST_REASON, Job
from skills.db.session import Database
from skills.errors import Busy, DatabaseBusy, SkillsError
from skills.jobs import POLLING_S, QUEUES, WORKFLOW, configuration, workflow_id
from skills.library.operation import locks
from skills.library.operation.jobs import ACTIVE, PART, end_part, names_of
from skills.settings import Settings

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.2, 10.0
BEAT_S = 0.5  # between two heartbeats while the engine is drained
log = logging.getLogger(__name__)
Perform = Callable[[Database, int, int, Settings], None]


@dataclass(frozen=True)
class Work:
    """The dependencies of jobs in this process: database, settings and the callback that performs a job."""

    database: Database
    settings: Settings
    perform: Perform
    doing: set[str] = field(default_factory=set)  # ids of the workflows that are running in this process

    def try_once(self, row: int, attempt: int, tries: int) -> bool:
        """Try to perform a job and return whether it is settled, by success or by a permanent failure.

        There is a pause before each retry; it starts at `FIRST_PAUSE_S` and is multiplied by four each time. It is not
        the engine's durable sleep, which would count a step of the wall clock as time that has passed. A busy database
        is waited for, and takes no try.
        """
        time.sleep(FIRST_PAUSE_S * 4 ** (tries - 1) if tries else 0.0)

        def perform() -> None:
            if start(self.database, row, attempt):
                self.perform(self.database, row, attempt, self.settings)

        try:
            self._when_not_busy(row, perform)
            return True
        except Busy as busy:  # temporary, so it is retried; other errors of ours would fail again
            log.warning("Job %d, attempt %d: %s", row, tries + 1, busy.message)
            return False
        except SkillsError as refused:
            return self._end(row, attempt, refused.words())
        except Exception:
            log.exception("Job %d: attempt %d of %d failed.", row, tries + 1, self.settings.job_attempts)
            return False

    def give_up(self, row: int, attempt: int) -> bool:
        """Mark the job as failed for an internal reason and return True; the cause is in the worker's log."""
        return self._end(
            row,
            attempt,
            f"All {self.settings.job_attempts} attempts failed inside the service; request it again, and if it "
            "fails again, send the worker's log to the operator of the service.",
        )

    def _end(self, row: int, attempt: int, reason: str) -> bool:
        try:
            self._when_not_busy(row, lambda: fail(self.database, row, attempt, reason))
        except Exception:  # the watch finds that the workflow has ended and the row has not, and fails it then
            log.exception("Job %d: it failed, and that could not be written.", row)
        return True

    def _when_not_busy(self, row: int, do: Callable[[], object]) -> None:
        """Call a function until the database is not busy; it does nothing once the job has ended or was taken over."""
        for waited in count():
            try:
                do()
                return
            except DatabaseBusy as busy:
                log.warning("Job %d waits for the database: %s", row, busy.message)
            time.sleep(min(FIRST_PAUSE_S * 4**waited, LONGEST_PAUSE_S))


def start(database: Database, row: int, attempt: int) -> bool:
    """Mark a job as running, also where it is already (after a crash).

    Returns:
        Whether this attempt is still current; False where the job has ended or has a newer attempt.
    """
    changes = {"state": "running", "started_at": func.coalesce(Job.started_at, now())}
    with database.writing([locks.job(row)]) as session:
        mine = (Job.row == row, Job.attempt == attempt, Job.state.in_(ACTIVE))
        return session.execute(update(Job).where(*mine).values(**changes).returning(Job.row)).first() is not None


def fail(database: Database, row: int, attempt: int, reason: str, state: str = "failed") -> bool:
    """End a job without a result, unless it has ended or has a newer attempt.

    Returns:
        Whether this call ended it.
    """
    reason = reason[:LONGEST_REASON]
    changes = {"state": state, "error": reason, "ended_at": now()}
    with database.reading() as session:
        named = names_of(session, row)
    with database.writing(named) as session:
        mine = (Job.row == row, Job.attempt == attempt, Job.state.in_(ACTIVE))
        ended = session.execute(update(Job).where(*mine).values(**changes).returning(Job.kind, Job.request)).first()
        if ended is not None and ended.kind == PART:
            end_part(session, ended.request["retraining"], row, state, reason)
        return ended is not None


def register(work: Work) -> None:
    """Register the workflow and its steps with the engine, before it is launched.

    The steps are the tries and, after the last, giving up. Change `jobs.STEPS` when that sequence changes.
    """
    attempts = work.settings.job_attempts

    @DBOS.step(name="try_job")
    def try_job(row: int, attempt: int, tries: int) -> bool:
        return work.try_once(row, attempt, tries)

    @DBOS.step(name="give_up")
    def give_up(row: int, attempt: int) -> bool:
        return work.give_up(row, attempt)

    # A job that kills its worker is recovered as many times as one that raises is retried.
    @DBOS.workflow(name=WORKFLOW, max_recovery_attempts=attempts - 1)
    def perform_job(row: int, attempt: int) -> None:
        work.doing.add(name := workflow_id(row, attempt))
        try:
            if not any(try_job(row, attempt, tries) for tries in range(attempts)):
                give_up(row, attempt)
        finally:
            work.doing.discard(name)


def recover_workflows(executors: list[str]) -> None:
    """Return the pending workflows of dead executors to their queues, if they are still theirs."""
    DBOS._recover_pending_workflows(executors)


@contextmanager
def engine_of(work: Work, executor: str, patience_s: Callable[[], int], beat: Callable[[], object]) -> Iterator[None]:
    """Run the engine for the duration of the block, then drain it: running jobs may finish, new ones are not taken.

    Args:
        work: What performs the jobs.
        executor: The id of this worker in the engine.
        patience_s: Returns the timeout of draining in seconds.
        beat: Writes a heartbeat; without it others would take over the jobs that are being finished.
    """
    register(work)
    DBOS(config=configuration(work.settings, executor))
    DBOS.launch()
    for queue, at_once in QUEUES.items():
        DBOS.register_queue(queue, worker_concurrency=at_once, polling_interval_sec=POLLING_S[queue])
    try:
        yield
    finally:
        drain = Thread(target=DBOS.destroy, kwargs={"workflow_completion_timeout_sec": patience_s()})
        drain.start()
        while drain.is_alive():
            beat()
            drain.join(BEAT_S)
