"""The worker process: it runs jobs, beside the service or on its own machine, and watches over the other workers."""

import logging
import os
import signal
import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import cycle
from threading import Event, Thread
from types import FrameType

from dbos import DBOS

from skills import logs
from skills.db.schema import refuse_other_tables
from skills.db.session import Database
from skills.errors import SkillsError
from skills.jobs.engine import BATCHES, JOBS, POLLING_S, QUEUES, configuration, connect
from skills.jobs.lease import Leases
from skills.jobs.logged import logged
from skills.jobs.memory import keep_freed_memory
from skills.jobs.watch import Watch
from skills.jobs.workflows import Perform, Work, register
from skills.settings import Settings

ROUND_S = 0.5
MISSED_ROUNDS = 20  # in a row; where the database is away the engine waits for up to 90 s before it tries again
DRAIN_S = 8  # what works then is cut and done again elsewhere; containers are killed after ten
NICENESS = 10

log = logging.getLogger(__name__)


def run_worker(settings: Settings, *, parent: int | None = None, perform: Perform | None = None) -> None:
    """Run jobs until SIGTERM or SIGINT, or until the parent is gone; then finish what is begun, and return.

    To be called in the main thread of a process of its own, once: the engine
    is one per process. The process ends here and now if its work does not end in time.

    Args:
        parent: The id of the process without which this one has no reason to live.
        perform: Carries a job out; `skills.library.perform_job` unless told otherwise.

    Raises:
        Conflict: The database was not migrated to this version, or to a newer one.
    """
    keep_freed_memory()
    stop = _stopped_by_signals()
    perform = logged(perform or _library())
    executor = f"{os.getpid()}-{uuid.uuid4().hex}"  # never used again: the engine would run its work twice
    database = Database(settings.database_url)
    with database.reading() as session:
        refuse_other_tables(session.connection())
    client = connect(settings)
    work = Work(database, settings, perform)
    watch = Watch(database, client, executor, Leases(settings.lease_s), DBOS._recover_pending_workflows, work.doing)
    try:
        watch.beat()  # before it can hold any work
        with _engine(work, executor, watch):
            _go_round(watch, lambda: stop.wait(ROUND_S) or _orphaned(parent))
        _go_if_cut_short(watch)
        _survive(watch.leave)
    finally:
        client.destroy()
        database.close()


def _go_round(watch: Watch, over: Callable[[], bool]) -> None:
    """Make rounds until it is over, or until the database is back after so long that a new process does better.

    Every other one is a beat alone: to look for what the engine and our rows disagree about takes ten times as long.
    """
    missed = 0
    for step in cycle((watch.round, watch.beat)):
        if not _survive(step):
            missed += 1
        elif missed < MISSED_ROUNDS:
            missed = 0
        else:
            log.error("The database was away for long, and the engine's pauses have grown; this worker starts anew.")
            logging.shutdown()
            os._exit(1)
        if over():
            return


def _library() -> Perform:
    """Take the library's work, and warm up for it."""
    from skills.jobs.warm import learn_once, warm_up  # late: they bring everything along
    from skills.library import perform_job

    warm_up(learn_once)
    return perform_job


@contextmanager
def _engine(work: Work, executor: str, watch: Watch) -> Iterator[None]:
    """Run the engine for as long as the block, and drain it after: no new work, and time for what is begun."""
    register(work)
    DBOS(config=configuration(work.settings, executor))
    DBOS.launch()
    for queue, at_once in QUEUES.items():
        DBOS.register_queue(queue, worker_concurrency=at_once, polling_interval_sec=POLLING_S[queue])
    try:
        yield
    finally:
        drain = Thread(target=DBOS.destroy, kwargs={"workflow_completion_timeout_sec": _patience_s(watch)})
        drain.start()
        while drain.is_alive():  # it beats while it drains, or others would take over what it finishes
            _survive(watch.beat)
            drain.join(ROUND_S)


def _patience_s(watch: Watch) -> int:
    """Choose how long to drain: what is done aside is cut at once, for it may take long and nobody waits for it."""
    return DRAIN_S if _at_work(watch, JOBS, BATCHES) else 0


def _at_work(watch: Watch, *queues: str) -> bool:
    """Tell whether this worker holds work; where the database is away it may, and its threads wait for that."""
    try:
        return watch.at_work(*queues)
    except Exception:
        return True


def _survive(step: Callable[[], None]) -> bool:
    """Take a step of the watch, or miss it: a database that is locked or away for a while must not end the worker."""
    try:
        step()
        return True
    except Exception:
        log.warning("The watch missed a round; the next one makes up for it.", exc_info=True)
        return False


def _stopped_by_signals() -> Event:
    stop = Event()

    def ask(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGTERM, ask)
    signal.signal(signal.SIGINT, ask)
    return stop


def _orphaned(parent: int | None) -> bool:
    return parent is not None and os.getppid() != parent


def _go_if_cut_short(watch: Watch) -> None:
    """End the process if a job still runs: its thread cannot be stopped, and would hold up the exit for as long."""
    if _at_work(watch):
        log.warning("Stopped in the middle of a job; it is done again elsewhere, or after the next start.")
        logging.shutdown()
        os._exit(0)


def main() -> None:
    """Run as a child of the process whose id is the argument, out of the way of what answers requests."""
    settings = Settings()
    logs.configure(settings.log_level, as_json=settings.log_format == "json")
    os.nice(NICENESS)
    try:
        run_worker(settings, parent=int(sys.argv[1]))
    except SkillsError as refused:
        log.error("%s", refused)
        sys.exit(1)
    logging.shutdown()
    os._exit(0)  # nobody waits for what is still being compiled


if __name__ == "__main__":
    main()
