"""The worker process: it runs jobs and watches over the other workers.

It runs as a child of the service or on another machine. Each attempt at a job is logged in one line: the number of the
attempt, the kind of the job, the outcome and the duration.

The worker configures the C library not to return freed memory to the system between styles. A policy's arrays have a
few megabytes; by default malloc returns such blocks to the system when they are freed, and the next style pays a page
fault for every page again: a sixth of the time of a batch (`tests/bench/batches.py`).
"""

import ctypes
import gc
import logging
import os
import signal
import sys
import time
import uuid
from collections.abc import Callable
from threading import Event, Thread
from typing import NoReturn

from sqlalchemy import select

from skills import logs
from skills.db.revisions import refuse_other_tables
from skills.db.service_tables import Job
from skills.db.session import Database
from skills.errors import SkillsError
from skills.jobs import BATCHES, JOBS, QUEUES, connect
from skills.jobs.attempts import Perform, Work
from skills.jobs.bell import Turn, listen
from skills.jobs.watch import Leases, Watch
from skills.jobs.workflows import engine_of, recover_workflows
from skills.library.operation.sweep import SteadyClock, sweep
from skills.logs import job_id, log_fields
from skills.sandbox.forked import refuse_uncontained
from skills.settings import Settings

SET_NAME, NAME = 15, b"skills-worker"  # of linux/prctl.h; as top and ps show it
TRIM, MMAP = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of malloc.h
KEPT_BYTES = 64 << 20  # unused memory that the process may hold
PIECE_BYTES = 32 << 20  # larger blocks are still returned at once; glibc allows no higher threshold


def keep_freed_memory() -> bool:
    """Configure malloc not to return up to `KEPT_BYTES` of freed memory to the system.

    Returns:
        Whether the C library supports it; glibc does.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    return bool(mallopt(TRIM, KEPT_BYTES) and mallopt(MMAP, PIECE_BYTES))


def logged(perform: Perform) -> Perform:
    """Wrap `perform` so that each attempt at a job is logged.

    An exception is logged by its class name only, because its message may contain personal data.
    """

    def run(database: Database, row: int, attempt: int, settings: Settings) -> None:
        about = select(Job.id, Job.kind, Job.state).where(Job.row == row)

        def look() -> tuple[str, ...]:
            with database.reading() as session:
                return tuple(session.execute(about).first() or ("", "", "erased"))

        name, kind, _ = look()
        token, began, outcome = job_id.set(name), time.monotonic(), ""
        try:
            perform(database, row, attempt, settings)
            outcome = look()[2]
        except Exception as error:
            outcome = type(error).__name__
            raise
        finally:
            seconds = round(time.monotonic() - began, 3)
            log_fields(log, "job", kind=kind, attempt=attempt, outcome=outcome, seconds=seconds)
            job_id.reset(token)

    return run


ROUND_S, REST_S = 0.3, 1.5  # between two heartbeats of a worker with jobs, and of one at rest
SELDOM = 40  # heartbeats between two rounds at rest, which delete what is out of date
SWEEPING_S = 0.2  # in a round, which must stay much shorter than a lease
MISSED_ROUNDS = 30  # in a row; while the database is unavailable the engine's retry pauses grow up to 90 s
DRAIN_S = 8  # jobs that run longer are aborted and run again elsewhere; container runtimes kill after 10 s
NICENESS = 10
VERIFY_FIRST_S = 30.0  # after the start of a worker, which has more urgent work then

log = logging.getLogger(__name__)


def run_worker(settings: Settings, *, parent: int | None = None, perform: Perform | None = None) -> None:
    """Run jobs until SIGTERM or SIGINT, or until the parent has exited; then finish running jobs, and return.

    Call it once, in the main thread of a dedicated process: there is one engine per process. If running jobs do not end
    within the timeout, the process exits immediately.

    Args:
        parent: Process id of the parent; the worker stops when that process has exited. None: no such check.
        perform: Callback that performs a job; `skills.library.perform.perform_job` by default.

    Raises:
        Conflict: The database has not been migrated to this version, or is of a newer one.
        BadSettings: The settings require containment that this system does not offer.
    """
    if settings.containment == "required":
        refuse_uncontained()
    keep_freed_memory()
    stop = Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    perform = logged(perform or _library())
    executor = f"{os.getpid()}-{uuid.uuid4().hex}"  # unique: with a reused id the engine would run its work twice
    database = Database.of(settings)
    with database.reading() as session:
        refuse_other_tables(session.connection())
    client = connect(settings)
    work = Work(database, settings, perform)
    leases, clock, turns = Leases(settings.lease_s), SteadyClock(), [Turn() for _ in QUEUES]

    def poll() -> None:
        for turn in turns:
            turn.come()

    def sweeping() -> bool:
        return sweep(database, settings, SWEEPING_S, by_age=clock.is_steady())

    watch = Watch(database, client, executor, leases, recover_workflows, work.doing, sweeping)
    try:
        watch.beat()  # registered before it can hold any job, so that others can take over
        Thread(target=_keep_verified, args=(watch, settings.verify_every_s), daemon=True, name="verify").start()
        # Those of `LOW_PRIORITY` may take long, no user waits for them, and they are run again.
        with engine_of(
            work,
            executor,
            patience_s=lambda: DRAIN_S if _at_work(watch, JOBS, BATCHES) else 0,
            beat=lambda: _survive(watch.beat),
            turns=turns,
        ):
            Thread(target=listen, args=(settings, poll), daemon=True, name="bell").start()
            gc.freeze()  # everything imported so far stays, so later collections skip it
            gc.enable()  # the callers disable it while they import
            _go_round(watch, poll, lambda seconds: stop.wait(seconds) or parent not in (None, os.getppid()))
        if _at_work(watch):  # a job's thread cannot be stopped, and a normal exit would wait for it
            log.warning("Stopped during a job; another worker, or this one after its next start, will run it again.")
            logging.shutdown()
            os._exit(0)
        _survive(watch.leave)
    finally:
        client.destroy()
        database.close()


def _go_round(watch: Watch, poll: Callable[[], None], over: Callable[[float], bool]) -> None:
    """Run rounds of the watch, and poll the queues, until `over(seconds)`, which waits between two rounds, is true.

    Every second round is only a heartbeat, because comparing the engine's workflows with our rows takes ten times as
    long. While nothing is due nearly every one is, and the bell alone has the queues polled: the worker rests. The
    process exits if the database comes back after `MISSED_ROUNDS` or more failed rounds: the engine's retry pauses have
    then grown so long that a new process is faster.
    """
    missed, beats = 0, SELDOM  # in a row: failed rounds, and heartbeats
    while True:
        whole = beats >= (1 if watch.due else SELDOM)
        beats = 0 if whole else beats + 1
        if not _survive(watch.round if whole else watch.beat):
            missed += 1
        elif missed < MISSED_ROUNDS:
            missed = 0
        else:
            log.error(
                "The database was unavailable for long, and the engine's retry pauses have grown; this worker restarts."
            )
            _survive(watch.hand_back)
            logging.shutdown()
            os._exit(1)
        if watch.due:
            poll()
        if over(ROUND_S if watch.due else min(REST_S, watch.leases.lease_s * 0.75)):
            return


def _keep_verified(watch: Watch, every_s: float) -> None:
    """Verify the history, and again each time; a large one less often, so that it takes a tenth of a core at most."""
    pause_s = min(VERIFY_FIRST_S, every_s)
    while True:
        time.sleep(pause_s)
        began_s = time.monotonic()
        _survive(watch.verify)
        pause_s = max(every_s, 9 * (time.monotonic() - began_s))


def _library() -> Perform:
    """Return the library's `perform_job`, and start the warm-up for it."""
    from skills.jobs.warm_up import learn_once, warm_up
    from skills.library.perform import perform_job

    warm_up(learn_once)
    return perform_job


def _at_work(watch: Watch, *queues: str) -> bool:
    """Return whether this worker holds jobs of some queues.

    Where the database is unavailable it may hold some whose threads wait for the database, so True is returned.
    """
    try:
        return watch.at_work(*queues)
    except Exception:
        return True


def _survive(step: Callable[[], object]) -> bool:
    """Run a step of the watch and return whether it succeeded.

    Exceptions are only logged: a database that is locked or unavailable for a while must not end the worker.
    """
    try:
        step()
        return True
    except Exception:
        log.warning("The watch missed a round; the next one does its work.", exc_info=True)
        return False


def run_child(settings: Settings, parent: int) -> NoReturn:
    """Run as a child of a process, at lower priority than request handling, and under a name of its own."""
    ctypes.CDLL(None).prctl(SET_NAME, NAME)
    os.nice(NICENESS)
    code = 1
    try:
        run_worker(settings, parent=parent)
        code = 0
    except SkillsError as refused:
        log.error("%s", refused)
    except Exception:
        log.exception("The worker failed.")
    logging.shutdown()
    os._exit(code)  # does not wait for the warm-up thread, which may still be compiling


def main() -> None:
    """Run as a child of the process whose id is the first argument, in an interpreter of its own."""
    settings = Settings()
    logs.configure(settings.log_level, as_json=settings.log_format == "json")
    run_child(settings, int(sys.argv[1]))
