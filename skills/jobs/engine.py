"""How both sides reach the job engine: the worker that runs it, and the service that only tells it things.

The engine's inputs are the row and the attempt of a job, as plain JSON: nothing personal is kept in its tables, and
nothing in them is ever unpickled. DBOS takes over a second to import, so it is imported where it is first needed.
"""

import logging
import sqlite3
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import TYPE_CHECKING

from sqlalchemy.engine import make_url

from skills.library.batches import PART
from skills.settings import Settings

if TYPE_CHECKING:
    from dbos import DBOSClient, DBOSConfig

APPLICATION = "suture-skills"
JOBS, BATCHES, ASIDE = "jobs", "batches", "aside"  # a person waits for the first, somebody for the second, nobody else
# How many of each a worker process does at once, so that none holds up another. The engine keeps these numbers in its
# database, the same for all workers: they are no setting, and a machine is limited by how many workers it has.
# Two parts of batches: one is learnt, and the next one is there when it ends (`library.batch_work`).
QUEUES = {JOBS: 2, BATCHES: 2, ASIDE: 1}
WORKFLOW = "perform_job"
STEPS = "1"  # the engine's "application version": to be changed with the sequence of steps in `workflows`, only then
# How often each worker looks for more of each. To look takes 3 ms of the processor, of idle workers too; a part of a
# batch keeps one for a second.
POLLING_S = {JOBS: 0.3, BATCHES: 0.3, ASIDE: 1.0}
FAREWELL_S = 2.0

log = logging.getLogger(__name__)
Errand = Callable[["DBOSClient"], None]


def workflow_id(row: int, attempt: int) -> str:
    """Name the workflow of one attempt at one job; the same name can never run twice to an end."""
    return f"{row}-{attempt}"


def configuration(settings: Settings, executor: str) -> "DBOSConfig":
    """Configure the engine of one worker process."""
    from dbos import DBOSPortableJSONSerializer

    return {
        "name": APPLICATION,
        "system_database_url": settings.engine_url,
        "dbos_system_schema": "dbos",
        "serializer": DBOSPortableJSONSerializer(),  # the default is pickle
        "executor_id": executor,
        "application_version": STEPS,
        "log_level": "WARNING",
        "use_listen_notify": False,  # queues poll anyway, and we send no messages
    }


def connect(settings: Settings) -> "DBOSClient":
    """Open a client of the engine; it connects when it is first used."""
    from dbos import DBOSClient, DBOSPortableJSONSerializer

    prepare(settings)
    return DBOSClient(
        system_database_url=settings.engine_url,
        dbos_system_schema="dbos",
        serializer=DBOSPortableJSONSerializer(),
        application_name=APPLICATION,
        lazy=True,
        retry_connection_errors=False,
    )


def prepare(settings: Settings) -> None:
    """Give the engine's SQLite file a write-ahead log, which it keeps from then on: DBOS itself does not."""
    url = make_url(settings.engine_url)
    if url.get_backend_name() != "sqlite" or url.database is None:
        return
    Path(url.database).parent.mkdir(parents=True, exist_ok=True)
    connection = sqlite3.connect(url.database)
    try:
        connection.execute("PRAGMA journal_mode=WAL")
    finally:
        connection.close()


def queue_of(kind: str) -> str:
    """Name the queue that jobs of a kind wait in."""
    return {PART: BATCHES, "pictures": ASIDE}.get(kind, JOBS)


def tell(client: "DBOSClient", row: int, attempt: int, kind: str) -> None:
    """Tell the engine of an attempt at a job; telling it again changes nothing."""
    client.enqueue(
        {"queue_name": queue_of(kind), "workflow_name": WORKFLOW, "workflow_id": workflow_id(row, attempt)},
        row,
        attempt,
    )


def drop(client: "DBOSClient", row: int, attempt: int) -> None:
    """Take an attempt back: it does not start any more, nor go on after the step it is in."""
    client.cancel_workflow(workflow_id(row, attempt))


class Engine:
    """The engine as the service sees it: it is told of jobs, in the background, and may miss it.

    Whatever goes wrong here is logged and let go: the row of the job is committed before, and a worker's watch tells
    again what the engine does not know. So an answer to a request never waits for the engine, which on SQLite may be
    locked for long and may not have been created yet.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._client: DBOSClient | None = None
        self._errands: SimpleQueue[Errand | None] = SimpleQueue()
        self._thread = Thread(target=self._run, name="engine", daemon=True)  # must not hold up the exit
        self._thread.start()

    def tell(self, row: int, attempt: int, kind: str) -> None:
        """Tell of an attempt at a job, after the commit of its row."""
        self._errands.put(lambda client: tell(client, row, attempt, kind))

    def cancel(self, row: int, attempt: int) -> None:
        """Drop an attempt whose job was cancelled, after the commit of that."""
        self._errands.put(lambda client: drop(client, row, attempt))

    def close(self) -> None:
        """Do the errands that can be done at once, and let go."""
        self._errands.put(None)
        self._thread.join(FAREWELL_S)

    def _run(self) -> None:
        while (errand := self._errands.get()) is not None:
            try:
                self._client = self._client or connect(self._settings)
                errand(self._client)
            except Exception:
                log.info("The job engine missed a message; the workers' watch makes up for it.")
                log.debug("This is why:", exc_info=True)
        if self._client is not None:
            self._client.destroy()
            self._client = None
