"""What a worker does between jobs: it shows that it lives, and makes our rows and the engine's agree.

The engine does not take over from a worker that died, does not know of a job that it was never told of, and does not
write into our rows how a workflow ended. A round of the watch does all three. Every worker makes such rounds, so
each change is one conditional statement, and it does not matter who makes it, nor how often.
"""

import logging
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

from dbos import DBOSClient, WorkflowStatus
from sqlalchemy import delete, select, update

from skills.db.base import now
from skills.db.books import Executor, Job
from skills.db.session import Database
from skills.jobs.engine import JOBS, QUEUES, STEPS, drop, tell, workflow_id
from skills.jobs.lease import Leases
from skills.jobs.workflows import ACTIVE, fail
from skills.library.batches import BATCH

AT_ONCE = 100  # rows looked at in a round: a round must stay much shorter than a lease
FORGOTTEN_AFTER_LEASES = 30

# How a workflow can end without a result in our row, and what that makes of the row.
ENDINGS = {
    "CANCELLED": ("cancelled", "It was cancelled in the job engine."),
    "ERROR": ("failed", "The job engine could not carry it out; ask again."),
    "MAX_RECOVERY_ATTEMPTS_EXCEEDED": (
        "failed",
        "Its worker died every time while working on it; ask again once the worker's log has been looked at.",
    ),
    "SUCCESS": ("failed", "It ended without a result, and why could not be written; ask again."),
}

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Live:
    """A job that has not ended."""

    row: int
    attempt: int
    told: bool
    kind: str

    @property
    def workflow(self) -> str:
        """The name of its workflow."""
        return workflow_id(self.row, self.attempt)


class Watch:
    """The rounds of one worker."""

    def __init__(
        self,
        database: Database,
        client: DBOSClient,
        executor: str,
        leases: Leases,
        recover: Callable[[list[str]], object],
        doing: Collection[str] = frozenset(),
    ) -> None:
        """Watch for one executor.

        Args:
            recover: Hands the pending workflows of dead executors back to their queue, on the condition that they
                are still pending and still theirs.
            doing: The workflows that this worker is working on, as they are at any time.
        """
        self._database = database
        self._client = client
        self._executor = executor
        self._leases = leases
        self._recover = recover
        self._doing = doing
        self._unheard = Leases(leases.lease_s, leases.clock)

    def beat(self) -> None:
        """Show that this worker lives."""
        with self._database.writing() as session:
            mine = update(Executor).where(Executor.id == self._executor).values(beat_at=now()).returning(Executor.id)
            if session.execute(mine).first() is None:  # the first beat, or others have forgotten us
                session.add(Executor(id=self._executor))

    def round(self) -> None:
        """Beat, take over from the dead, tell what was not told, and read back what ended."""
        self.beat()
        self._take_over()
        live = self._live()
        known = {w.workflow_id: w for w in self._workflows(live)}
        for job in live:
            workflow = known.get(job.workflow)
            if workflow is None:
                tell(self._client, job.row, job.attempt, job.kind)
            elif workflow.status in ENDINGS:
                state, reason = ENDINGS[workflow.status]
                fail(self._database, job.row, job.attempt, reason, state)
        self._remember_told([job.row for job in live if not job.told])

    def leave(self) -> None:
        """Take this worker's name off the list."""
        with self._database.writing() as session:
            session.execute(delete(Executor).where(Executor.id == self._executor))

    def at_work(self, *queues: str) -> bool:
        """Tell whether this worker still holds work, of some queues or of any."""
        return bool(self._pending(self._executor, queues or QUEUES))

    def _take_over(self) -> None:
        """Give back the work of workers whose lease ran out; forget those silent for long.

        The engine's own `resume_workflow` would run cancelled work, would take work that a third worker has just
        taken over, and would forget how often the work has killed its worker.
        """
        pending = self._pending()
        self._give_back({workflow.workflow_id for workflow in pending if workflow.executor_id == self._executor})
        holders = {workflow.executor_id for workflow in pending if workflow.executor_id}
        with self._database.reading() as session:
            beats = {row.id: row.beat_at for row in session.execute(select(Executor.id, Executor.beat_at))}
        others = {**dict.fromkeys(holders), **beats}
        others.pop(self._executor, None)
        silent_s = self._leases.look(others)
        if dead := sorted(self._leases.dead()):
            self._inherit(dead)
        for executor in others.keys() - holders:
            if silent_s[executor] > FORGOTTEN_AFTER_LEASES * self._leases.lease_s:
                self._forget(executor, beats[executor])

    def _give_back(self, mine: set[str]) -> None:
        """Give back what is this worker's and has not been begun for a lease: it was not heard that it had been taken.

        That is so where the connection breaks between a commit and its answer.
        """
        self._unheard.look(dict.fromkeys(mine.difference(self._doing)))
        for workflow in self._unheard.dead():
            log.warning("Job %s was taken and never begun; it is given back.", workflow)
            self._client._sys_db.reenqueue_for_recovery(workflow, [self._executor], JOBS)

    def _inherit(self, dead: list[str]) -> None:
        """Give back what the dead were working on; start over what only workers of another version could go on with."""
        left = self._client.list_workflows(
            status=["PENDING", "ENQUEUED"],
            executor_id=dead,
            queue_name=list(QUEUES),
            load_input=False,
            load_output=False,
        )
        for workflow in left:
            if workflow.app_version != STEPS:
                self._start_over(workflow.workflow_id)
        ours = {w.executor_id for w in left if w.app_version == STEPS and w.status == "PENDING" and w.executor_id}
        if ours:
            log.warning("Taking over from %s, silent for longer than its lease.", ", ".join(sorted(ours)))
            self._recover(sorted(ours))

    def _forget(self, executor: str, beat_at: object) -> None:
        with self._database.writing() as session:
            session.execute(delete(Executor).where(Executor.id == executor, Executor.beat_at == beat_at))

    def _live(self) -> list[Live]:
        """Read jobs that have not ended: what was never told first, then the oldest; of batches their parts alone."""
        query = select(Job.row, Job.attempt, Job.told_at.is_not(None), Job.kind).where(Job.state.in_(ACTIVE))
        query = query.where(Job.kind != BATCH)
        with self._database.reading() as session:
            rows = session.execute(query.order_by(Job.told_at.is_not(None), Job.row).limit(AT_ONCE)).all()
        return [Live(*row) for row in rows]

    def _workflows(self, live: Sequence[Live]) -> list[WorkflowStatus]:
        if not live:
            return []
        names = [job.workflow for job in live]
        return self._client.list_workflows(workflow_ids=names, load_input=False, load_output=False)

    def _pending(self, executor: str | None = None, queues: Iterable[str] = QUEUES) -> list[WorkflowStatus]:
        return self._client.list_workflows(
            status="PENDING", queue_name=list(queues), executor_id=executor, load_input=False, load_output=False
        )

    def _start_over(self, workflow: str) -> None:
        """Begin a new attempt: this one was begun by another sequence of steps, with which nobody here can go on.

        It is told in this round or the next; a crash in between leaves an old attempt that finds itself unwanted.
        """
        row, attempt = map(int, workflow.split("-"))
        again = {"state": "queued", "attempt": attempt + 1, "told_at": None}
        with self._database.writing() as session:
            mine = (Job.row == row, Job.attempt == attempt, Job.state.in_(ACTIVE))
            session.execute(update(Job).where(*mine).values(**again))
        drop(self._client, row, attempt)

    def _remember_told(self, rows: Sequence[int]) -> None:
        if rows:
            with self._database.writing() as session:
                session.execute(update(Job).where(Job.row.in_(rows), Job.told_at.is_(None)).values(told_at=now()))
