"""Durable background jobs: the library's use cases as workflows of a job engine, DBOS Transact.

The engine stores its workflows in SQLite or PostgreSQL. The row of a job in our database is authoritative; the engine
only makes sure that a worker processes it.

    attempts    one attempt at a job: try, pause, retry, give up
    in_process  performs jobs in the process of one command, without the engine
    workflows   the workflow of one job, and the engine of a worker, which runs it
    bell        wakes resting workers when a job is enqueued
    watch       a worker's periodic tasks: leases and heartbeats, enqueueing, taking over from dead workers, outcomes
    readiness   checks of the database, the engine and the workers, for health checks
    warm_up     compiles or loads the compiled loops before they are needed
    worker      the worker process; `skills.serving` starts it as a child of the service

Here is the access to the engine for both sides, and `Engine`, with which the service enqueues jobs. Another engine
would change this file, `bell`, `workflows` and `watch`, and nothing else. The engine's inputs are the row and the
attempt of a job, as plain JSON: its tables hold no personal data, and none of their contents is ever unpickled.
Importing DBOS takes over a second, so it is imported where it is first needed.
"""

import logging
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from time import time
from typing import TYPE_CHECKING, Any

from sqlalchemy import TextClause, event, text
from sqlalchemy.dialects import plugins
from sqlalchemy.engine import URL, CreateEnginePlugin, make_url
from sqlalchemy.engine import Engine as Connections

from skills.db.disk import make_private
from skills.db.engines import write_ahead
from skills.db.session import Database
from skills.errors import NotReady
from skills.jobs.bell import ring
from skills.library.operation.jobs import EXPORT, PART, PICTURES
from skills.settings import Settings

if TYPE_CHECKING:
    from dbos import DBOSClient, DBOSConfig

ADOPTED = "recorded outcome"  # end of the engine's message about a job that was cancelled or taken over
APPLICATION = "suture-skills"
# Queues by urgency: a user waits for JOBS, somebody needs BATCHES soon, and pictures and exports are of low priority.
JOBS, BATCHES, LOW_PRIORITY = "jobs", "batches", "low-priority"
# Concurrent jobs of each queue in a worker process, so that no queue blocks another. The engine stores these limits in
# its database for all workers, so they are constants, not settings; the load of a machine is set by its number of
# workers. Two parts of batches: one is learnt while the next one is already there (`library.policies.batches`).
QUEUES = {JOBS: 2, BATCHES: 2, LOW_PRIORITY: 1}
WORKFLOW = "perform_job"
STEPS = "1"  # the engine's "application version": change it if and only if the sequence of steps in `workflows` changes
FAREWELL_S = 2.0  # timeout of `Engine.close`, within which it processes its pending calls
CLOCK = "skills_clock"  # the name of `Clock` in the engine's URL

log = logging.getLogger(__name__)
Call = Callable[["DBOSClient"], None]


def workflow_id(row: int, attempt: int) -> str:
    """Return the workflow id of an attempt at a job; the engine completes a workflow of one id at most once."""
    return f"{row}-{attempt}"


def configuration(settings: Settings, executor: str) -> "DBOSConfig":
    """Return the engine's configuration for one worker process."""
    found: DBOSConfig = _system(settings) | {
        "name": APPLICATION,
        "executor_id": executor,
        "application_version": STEPS,
        "log_level": "WARNING",
        "use_listen_notify": False,  # of messages, which we do not send; new jobs have the bell
    }
    return found


def connect(settings: Settings) -> "DBOSClient":
    """Return a client of the engine; it connects on first use."""
    from dbos import DBOSClient

    prepare(settings)
    return DBOSClient(**_system(settings), application_name=APPLICATION, lazy=True, retry_connection_errors=False)


def _system(settings: Settings) -> Any:
    """Return the settings of the engine's database, with `Clock` if it is a SQLite file."""
    from dbos import DBOSPortableJSONSerializer

    log_faults_alone()
    url = make_url(settings.engine_url)
    if url.get_backend_name() == "sqlite":
        url = url.update_query_pairs([("plugin", CLOCK)])
    return {
        "system_database_url": url.render_as_string(hide_password=False),
        "dbos_system_schema": "dbos",
        "serializer": DBOSPortableJSONSerializer(),  # the default is pickle, which can execute stored bytes
    }


def log_faults_alone() -> None:
    """Leave out of the engine's log what is no fault, and keep it from adding a handler of its own."""
    engine = logging.getLogger("dbos")
    if not engine.handlers:
        engine.addHandler(logging.NullHandler())
    engine.addFilter(_fault)


def _fault(record: logging.LogRecord) -> bool:
    """Return whether a record of the engine is of a fault.

    A job that a user cancels while it runs is none, and of a job that was taken over `skills.jobs.workflows` logs it.
    """
    error = record.exc_info[1] if record.exc_info else None
    return not (type(error).__name__ == "DBOSAwaitedWorkflowCancelledError" or str(record.msg).endswith(ADOPTED))


def prepare(settings: Settings) -> None:
    """Create the engine's SQLite file in WAL mode, readable by this user only.

    DBOS itself does not set the mode; SQLite stores it in the file. Does nothing on PostgreSQL.
    """
    url = make_url(settings.engine_url)
    if url.get_backend_name() != "sqlite" or url.database is None:
        return
    make_private(Path(url.database))
    with closing(sqlite3.connect(url.database)) as connection:
        write_ahead(connection)


class Clock(CreateEnginePlugin):
    """The clock `unixepoch('subsec')` on SQLite files, where SQLite is older than 3.42, as on Debian 12.

    DBOS needs it from Python 3.12 on, whatever the version of SQLite: it is in its statements, and in the defaults of a
    file's tables for as long as the file exists. An older SQLite returns NULL there, and every poll of a queue fails.
    """

    def update_url(self, url: URL) -> URL:
        """Return the URL as it is: it has no more settings for this."""
        return url

    def engine_created(self, engine: Connections) -> None:
        """Add the clock to each new connection that lacks it."""
        event.listen(engine, "connect", _add_clock)


plugins.register(CLOCK, __name__, Clock.__name__)


def _add_clock(connection: sqlite3.Connection, _record: Any) -> None:
    if connection.execute("SELECT unixepoch('subsec')").fetchone() == (None,):
        connection.create_function("unixepoch", 1, _now_s)


def _now_s(modifier: str) -> float:
    """Return the seconds since 1970 in milliseconds, as SQLite does from 3.42 on."""
    if modifier != "subsec":
        raise ValueError(modifier)  # nothing else of the function that this one replaces is used
    return round(time(), 3)


def queue_of(kind: str) -> str:
    """Return the name of the queue for jobs of a kind."""
    return {PART: BATCHES, PICTURES: LOW_PRIORITY, EXPORT: LOW_PRIORITY}.get(kind, JOBS)


def submit(client: "DBOSClient", row: int, attempt: int, kind: str) -> None:
    """Enqueue an attempt at a job in the engine; idempotent."""
    client.enqueue(
        {"queue_name": queue_of(kind), "workflow_name": WORKFLOW, "workflow_id": workflow_id(row, attempt)},
        row,
        attempt,
    )
    ring(client)


def cancel(client: "DBOSClient", row: int, attempt: int) -> None:
    """Cancel an attempt: it does not start any more, and stops after its current step."""
    client.cancel_workflow(workflow_id(row, attempt))


def select_a_workflow(dialect: str) -> TextClause:
    """Return a query that succeeds where the engine's tables can be read."""
    table = "workflow_status" if dialect == "sqlite" else "dbos.workflow_status"
    return text(f"SELECT 1 FROM {table} LIMIT 1")  # noqa: S608 - one of two names of ours


def refuse_left_over(settings: Settings) -> None:
    """Refuse a job engine whose tables belong to another state of the database, for example from before a restore.

    Its workflows refer to jobs by row numbers, which mean other jobs there.

    Raises:
        NotReady: The engine has such tables, or its database cannot be read.
    """
    engine = make_url(settings.engine_url)
    if engine.get_backend_name() == "sqlite":
        if engine.database and Path(engine.database).exists():
            raise NotReady(
                f"{engine.database} is the job engine's database for another state of this database; move it away."
            )
        return
    with closing(Database(settings.engine_url)) as database, database.reading() as session:
        if session.scalar(text("SELECT to_regclass('dbos.workflow_status')")) is not None:
            raise NotReady("The schema `dbos` is the job engine's schema for another state of this database; drop it.")


class Engine:
    """A client of the engine for the service: enqueues and cancels jobs in a background thread, on a best-effort basis.

    Errors are logged and ignored: the row of the job is committed before, and the watch of a worker enqueues again jobs
    that the engine does not know. So a response never waits for the engine, which on SQLite may be locked for long and
    may not have been created yet.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._client: DBOSClient | None = None
        self._calls: SimpleQueue[Call | None] = SimpleQueue()
        self._thread = Thread(target=self._run, name="engine", daemon=True)  # must not delay the exit of the process
        self._thread.start()

    def submit(self, row: int, attempt: int, kind: str) -> None:
        """Enqueue an attempt at a job; call it after its row is committed."""
        self._calls.put(lambda client: submit(client, row, attempt, kind))

    def cancel(self, row: int, attempt: int) -> None:
        """Cancel an attempt of a cancelled job; call it after the cancellation is committed."""
        self._calls.put(lambda client: cancel(client, row, attempt))

    def close(self) -> None:
        """Process the pending calls for up to `FAREWELL_S`, then stop."""
        self._calls.put(None)
        self._thread.join(FAREWELL_S)

    def _run(self) -> None:
        while (call := self._calls.get()) is not None:
            try:
                self._client = self._client or connect(self._settings)
                call(self._client)
            except Exception:
                log.info("The job engine missed a message; the workers' watch will start the job.")
                log.debug("This is why:", exc_info=True)
        if self._client is not None:
            self._client.destroy()
            self._client = None
