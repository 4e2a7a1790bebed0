"""The watch of each worker over all jobs: leases and heartbeats, enqueueing, taking over from dead workers, outcomes.

The engine does not take over from a dead worker, does not know jobs that were never enqueued in it, and does not write
the outcome of a workflow into our rows. A round of the watch does all three, with leases and heartbeats. Every worker
runs such rounds, so each change is one conditional, idempotent statement, and any worker may make it.
"""

import logging
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from math import inf
from typing import Any

from dbos import DBOSClient, WorkflowStatus
from sqlalchemy import bindparam, delete, exists, func, insert, or_, select, update

from skills.db import now
from skills.db.leaves import CHECKPOINTS, LEAVES
from skills.db.service_tables import Executor, Job
from skills.db.session import Database
from skills.jobs import JOBS, QUEUES, STEPS, cancel, submit, workflow_id
from skills.jobs.attempts import fail
from skills.library.operation import locks
from skills.library.operation.history import NAMED, Verified, sign_some_history, verify_history
from skills.library.operation.jobs import ACTIVE, BATCH, UNSYNCHRONISED

log = logging.getLogger(__name__)

LONGEST_LOOK_S = 1.0


@dataclass
class Leases:
    """The time since the last heartbeat of each worker, as measured by one observer.

    A heartbeat is only compared with the one seen before; its date is never compared with a clock. Time is that of this
    process's monotonic clock, and each look adds at most `LONGEST_LOOK_S`. So a wall clock that jumps by an hour has no
    effect, on one machine or several; nor has a pause of the observer, of the machine, or of the database, after which
    all heartbeats are old. The cost: a worker that has just started waits for a full lease before it takes over from
    others.
    """

    lease_s: float
    clock: Callable[[], float] = time.monotonic
    _looked_s: float | None = None
    _seen: dict[str, object] = field(default_factory=dict)
    _silent_s: dict[str, float] = field(default_factory=dict)

    def look(self, beats: Mapping[str, object]) -> Mapping[str, float]:
        """Compare the heartbeats with those of the last look, and return the seconds since the last change of each.

        Args:
            beats: The last heartbeat by executor; None for an executor that holds work but has no heartbeat.

        Returns:
            Seconds by executor; 0 where the heartbeat has changed or was not seen before.
        """
        now_s = self.clock()
        passed_s = 0.0 if self._looked_s is None else min(now_s - self._looked_s, LONGEST_LOOK_S)
        self._looked_s = now_s
        self._silent_s = {
            executor: self._silent_s[executor] + passed_s if self._seen.get(executor, self) == beat else 0.0
            for executor, beat in beats.items()
        }
        self._seen = dict(beats)
        return self._silent_s

    def dead(self) -> set[str]:
        """Return the executors whose lease has expired."""
        return {executor for executor, silent_s in self._silent_s.items() if silent_s > self.lease_s}


AT_ONCE = 100  # jobs compared in a round: a round must stay much shorter than a lease
FORGOTTEN_AFTER_LEASES = 30
SWEEP_S = 60.0  # between two sweeps, if nothing was left by the first
ENGINE_DAYS = 7  # ours: the engine's rows of ended workflows are kept as long, for whoever looks into a failure
ENGINE_ATTEMPTS = 10  # of one job: an engine that has failed that often will fail again

# Statuses of a workflow that ended without a result in our row, with the state and the reason for the row.
ENDINGS = {
    "CANCELLED": ("cancelled", "It was cancelled in the job engine."),
    "MAX_RECOVERY_ATTEMPTS_EXCEEDED": (
        "failed",
        "The worker died at each attempt at this job; check the worker's log, then request it again.",
    ),
}

# The engine runs only the parts of a batch, not the batch itself.
UNFINISHED = (Job.state.in_(ACTIVE), Job.kind != BATCH)
_jobs_or_leaves = or_(exists().where(*UNFINISHED), exists().where(LEAVES.c.number.is_(None)))
_newest = select(func.max(CHECKPOINTS.c.row)).scalar_subquery()
BEAT = update(Executor).values(beat_at=bindparam("at")).where(Executor.id == bindparam("me"))
BEAT = BEAT.returning(_jobs_or_leaves.label("due"), _newest.label("checkpoint"))

# `workflows.perform_job` raises nothing itself. If a workflow ends with an error, or without an outcome in our row, the
# engine's database or ours was unavailable. The job did not fail, so a new attempt is started.
ENGINE_FAILED = ("ERROR", "SUCCESS")
DATABASE_FAILED = ("OperationalError", "TimeoutError")  # SQLAlchemy's errors, by which the engine ends a workflow


@dataclass
class Watch:
    """The periodic rounds of one worker.

    Attributes:
        database: Our database.
        client: Client of the engine.
        executor: Id of this worker in the engine and in our table of executors.
        leases: Leases of the other workers.
        recover: Callback that returns the pending workflows of dead executors to their queue, provided that they are
            still pending and still assigned to those executors.
        doing: Ids of the workflows that this worker is running; a live view, not a copy.
        sweep: Deletes what nobody needs any more in our database for a moment; returns whether nothing is left.
        due: Whether at the last heartbeat there may have been something to do.
    """

    database: Database
    client: DBOSClient
    executor: str
    leases: Leases
    recover: Callable[[list[str]], object]
    doing: Collection[str] = frozenset()
    sweep: Callable[[], bool] = lambda: True
    due: bool = True
    _swept_s: float | None = None
    _checkpoint: int | None = None  # the newest at the last heartbeat

    def __post_init__(self) -> None:
        self._unheard = Leases(self.leases.lease_s, self.leases.clock)

    def beat(self) -> None:
        """Write a heartbeat, and find out whether there may be something `due`, for a round to do.

        That is so while jobs have not ended or leaves of the history are unsigned, and after each new checkpoint. A
        worker at rest does nothing but this, in one statement.
        """
        self.due = True  # also where this fails
        with self.database.statements.connect() as connection:
            found = connection.execute(BEAT, {"me": self.executor, "at": now()}).first()
            if found is None:  # the first heartbeat, or others have deleted our row
                connection.execute(insert(Executor).values(id=self.executor))
            else:
                self.due, self._checkpoint = found.due or found.checkpoint != self._checkpoint, found.checkpoint

    def round(self) -> None:
        """Write a heartbeat, sign the history, take over from dead workers, enqueue new jobs, read back outcomes."""
        self.beat()
        if not sign_some_history(self.database):
            return  # of another database than was signed last nothing is done
        self._take_over()
        live = self._live()
        names = [workflow_id(job.row, job.attempt) for job in live]
        known = {one.workflow_id: one for one in self._workflows(workflow_ids=names)} if names else {}
        for job, name in zip(live, names, strict=True):
            workflow = known.get(name)
            if workflow is None:
                submit(self.client, job.row, job.attempt, job.kind)
            elif workflow.status in ENDINGS:
                state, reason = ENDINGS[workflow.status]
                fail(self.database, job.row, job.attempt, reason, state)
            elif workflow.status in ENGINE_FAILED:
                self._begin_again(job.row, job.attempt)
        self._note_submitted([job.row for job in live if job.submitted_at is None])
        if self._swept_s is None or time.monotonic() - self._swept_s > SWEEP_S:
            self._forget_ended()
            if self.sweep():
                self._swept_s = time.monotonic()

    def verify(self) -> None:
        """Verify the history and all logged rows, if this is the first of the workers; log and count the faults."""
        with self.database.reading() as session:
            first = session.scalar(select(func.min(Executor.id)).where(Executor.id.not_in(self.leases.dead())))
        if first != self.executor or self.database.history.refused is not None:
            return
        with self.database.reading() as session:
            found = list(verify_history(session.connection(), self.database.history, None, Verified()))
        for name, why in found[:NAMED]:
            log.error("The history is not whole: %s: %s; run `skills verify`.", name, why)
        with self.database.writing(()) as session:
            mine = update(Executor).where(Executor.id == self.executor)
            session.execute(mine.values(verified_at=now(), faults_found=len(found)))

    def leave(self) -> None:
        """Sign the last leaves of the history, and remove this worker from the table of executors."""
        sign_some_history(self.database, inf)
        with self.database.writing(()) as session:
            session.execute(delete(Executor).where(Executor.id == self.executor))

    def hand_back(self) -> None:
        """Start a new attempt at each job that this worker holds: the jobs are not what ends it."""
        for workflow in self._pending(self.executor):
            self._start_over(workflow.workflow_id)

    def at_work(self, *queues: str) -> bool:
        """Return whether this worker still holds workflows of some queues, by default of any."""
        return bool(self._pending(self.executor, queues or QUEUES))

    def _take_over(self) -> None:
        """Return the workflows of dead workers to their queues, and forget workers that have been silent for long.

        The engine's own `resume_workflow` is not used: it would run cancelled work, would take work that a third worker
        has just taken over, and would reset the count of workers that the work has killed.
        """
        pending = self._pending()
        self._give_back({workflow.workflow_id for workflow in pending if workflow.executor_id == self.executor})
        holders = {workflow.executor_id for workflow in pending if workflow.executor_id}
        with self.database.reading() as session:
            beats = {row.id: row.beat_at for row in session.execute(select(Executor.id, Executor.beat_at))}
        others = {**dict.fromkeys(holders), **beats}
        others.pop(self.executor, None)
        silent_s = self.leases.look(others)
        if dead := sorted(self.leases.dead()):
            self._inherit(dead)
        for executor in others.keys() - holders:
            if silent_s[executor] > FORGOTTEN_AFTER_LEASES * self.leases.lease_s:
                with self.database.writing(()) as session:
                    silent = delete(Executor).where(Executor.id == executor, Executor.beat_at == beats[executor])
                    session.execute(silent)

    def _forget_ended(self) -> None:
        """Delete some of the engine's rows of workflows that ended long ago; the outcomes are in our rows."""
        before = (now() - timedelta(days=ENGINE_DAYS)).isoformat()
        ended = self._workflows(status=["SUCCESS", *ENDINGS, "ERROR"], end_time=before, limit=AT_ONCE)
        if ended:
            self.client.delete_workflows([one.workflow_id for one in ended])

    def _give_back(self, mine: set[str]) -> None:
        """Return workflows to the queue that are assigned to this worker but have not been started for a full lease.

        That happens when the connection breaks between a commit and its response: the worker never learns of the
        assignment.
        """
        self._unheard.look(dict.fromkeys(mine.difference(self.doing)))
        for workflow in self._unheard.dead():
            log.warning("Job %s was claimed and never started; it is queued again.", workflow)
            self.client._sys_db.reenqueue_for_recovery(workflow, [self.executor], JOBS)

    def _inherit(self, dead: list[str]) -> None:
        """Return the workflows of dead workers to their queues.

        A workflow of another version of the steps, which only workers of that version could resume, is started again as
        a new attempt.
        """
        left = self._workflows(status=["PENDING", "ENQUEUED"], executor_id=dead, queue_name=list(QUEUES))
        for workflow in left:
            if workflow.app_version != STEPS:
                self._start_over(workflow.workflow_id)
        ours = {w.executor_id for w in left if w.app_version == STEPS and w.status == "PENDING" and w.executor_id}
        if ours:
            log.warning("Taking over from %s, silent for longer than its lease.", ", ".join(sorted(ours)))
            self.recover(sorted(ours))

    def _live(self) -> Sequence[Any]:
        """Return jobs that have not ended: those never enqueued first, then the oldest."""
        query = select(Job.row, Job.attempt, Job.submitted_at, Job.kind).where(*UNFINISHED)
        with self.database.reading() as session:
            return session.execute(query.order_by(Job.submitted_at.is_not(None), Job.row).limit(AT_ONCE)).all()

    def _workflows(self, **chosen: Any) -> list[WorkflowStatus]:
        """Return some workflows of the engine, without their inputs and outputs, which are not needed here."""
        return self.client.list_workflows(**chosen, load_input=False, load_output=False)

    def _pending(self, executor: str | None = None, queues: Iterable[str] = QUEUES) -> list[WorkflowStatus]:
        return self._workflows(status="PENDING", queue_name=list(queues), executor_id=executor)

    def _start_over(self, workflow: str) -> None:
        """Start a new attempt at a job whose current attempt cannot be resumed.

        It is enqueued in this round or the next; after a crash in between, the old attempt finds that it is no longer
        current.
        """
        row, attempt = map(int, workflow.split("-"))
        again = {"state": "queued", "attempt": attempt + 1, "submitted_at": None}
        with self.database.writing([locks.job(row)]) as session:
            mine = (Job.row == row, Job.attempt == attempt, Job.state.in_(ACTIVE))
            session.execute(update(Job).where(*mine).values(**again))
        cancel(self.client, row, attempt)

    def _begin_again(self, row: int, attempt: int) -> None:
        """Start a new attempt at a job in which the engine failed, or fail the job after `ENGINE_ATTEMPTS`.

        Those at which its database was busy or away are not counted.
        """
        ended = self.client.list_workflows(workflow_id_prefix=f"{row}-", status=[*ENGINE_FAILED], load_input=False)
        failed = sum(getattr(one.error, "name", None) not in DATABASE_FAILED for one in ended)
        if failed < ENGINE_ATTEMPTS:
            log.warning("The job engine failed in job %d at attempt %d; it is started again.", row, attempt)
            self._start_over(workflow_id(row, attempt))
        else:
            reason = f"The job engine failed {failed} times in this job; check the worker's log, then request it again."
            fail(self.database, row, attempt, reason)

    def _note_submitted(self, rows: Sequence[int]) -> None:
        if rows:
            # Rows that another transaction changes now are left for the next round: waiting for several rows in an
            # order of its own could deadlock.
            new = select(Job.row).where(Job.row.in_(rows), Job.submitted_at.is_(None))
            with self.database.writing(()) as session:
                mine = Job.row.in_(new.with_for_update(skip_locked=True))
                session.execute(update(Job).where(mine).values(submitted_at=now()), **UNSYNCHRONISED)
