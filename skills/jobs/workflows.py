"""The workflow of one job, and the engine of a worker, which runs it.

Each try is a step of the engine, so finished tries are not repeated when another worker takes over.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from threading import Thread

from dbos import DBOS
from dbos._queue import queue_worker_thread

from skills.jobs import QUEUES, WORKFLOW, configuration, workflow_id
from skills.jobs.attempts import Work
from skills.jobs.bell import Turn

BEAT_S = 0.5  # between two heartbeats while the engine is drained


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
def engine_of(
    work: Work, executor: str, patience_s: Callable[[], int], beat: Callable[[], object], turns: Sequence[Turn]
) -> Iterator[None]:
    """Run the engine for the duration of the block, then drain it: running jobs may finish, new ones are not taken.

    Its threads for what we do not use, such as schedules, delays, messages and queues that are registered later, are
    stopped at once, because each polls the database every second.

    Args:
        work: What performs the jobs.
        executor: The id of this worker in the engine.
        patience_s: Returns the timeout of draining in seconds.
        beat: Writes a heartbeat; without it others would take over the jobs that are being finished.
        turns: When each queue is polled.
    """
    register(work)
    engine = DBOS(config=configuration(work.settings, executor))
    DBOS.launch()
    for stop in (engine._background_jobs_stop_event, *engine.background_thread_stop_events):
        stop.set()
    engine._sys_db._run_background_processes = False
    for turn, (name, at_once) in zip(turns, QUEUES.items(), strict=True):
        queue = DBOS.register_queue(name, worker_concurrency=at_once)
        queue.database_backed_queue = False  # it is not read again at each poll
        engine.background_thread_stop_events.append(turn)
        engine._background_threads.append(Thread(target=queue_worker_thread, args=(turn, engine, queue), daemon=True))
        engine._background_threads[-1].start()
    try:
        yield
    finally:
        drain = Thread(target=DBOS.destroy, kwargs={"workflow_completion_timeout_sec": patience_s()})
        drain.start()
        while drain.is_alive():
            beat()
            drain.join(BEAT_S)
