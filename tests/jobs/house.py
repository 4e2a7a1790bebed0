"""An installation for the job tests: a database, the service's engine client, and workers in separate processes."""

import subprocess
import sys
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2 as httpx
from sqlalchemy import ColumnElement, func, select, text

from skills.db.service_tables import Executor, Job
from skills.db.session import Database
from skills.jobs import Engine
from skills.serving import environment
from skills.settings import Settings
from tests.backends import blank, drop
from tests.e2e.conftest import Service, running
from tests.library import cases
from tests.waiting import END_S, until

ROOT = Path(__file__).parents[2]
# As the service starts its workers: `run_worker` enables the garbage collector.
STANDIN = "import gc; gc.disable(); from tests.jobs.standin import main; main()"
Worker = subprocess.Popen[bytes]


class House:
    """One installation."""

    def __init__(self, url: str, folder: Path) -> None:
        self.settings = Settings(database_url=url)
        self.database = Database(url)
        self.database.migrate()
        self.engine = Engine(self.settings)
        self.journal = folder / "journal.txt"
        self.journal.touch()

    def close(self) -> None:
        self.engine.close()
        self.database.close()

    def ask(self, kind: str = "quick", state: str = "queued", attempt: int = 1, **request: object) -> int:
        """Commit a job as the library does, without notifying the engine."""
        name = uuid.uuid4().hex
        asked = {"journal": str(self.journal), **request}
        with self.database.writing() as session:
            job = Job(id=name, kind=kind, identity=name * 2, request=asked, state=state, attempt=attempt)
            session.add(job)
        return job.row

    def job(self, row: int) -> Job:
        with self.database.reading() as session:
            return session.get_one(Job, row)

    def ended(self, row: int, within_s: float = END_S) -> Job:
        """Wait for a job's end, and return the job."""
        until(lambda: self.job(row).state not in ("queued", "running"), within_s)
        return self.job(row)

    def begun(self, row: int, within_s: float = END_S) -> int:
        """Wait until a worker runs a job, and return the worker's process id."""
        until(lambda: self.noted("begins", row), within_s)
        return self.noted("begins", row)[-1]

    def noted(self, word: str, row: int) -> list[int]:
        """List the processes that wrote a word about a job into the journal."""
        lines = (line.split() for line in self.journal.read_text().splitlines())
        return [int(pid) for said, about, pid in lines if (said, int(about)) == (word, row)]

    @contextmanager
    def workers(self, number: int) -> Iterator[dict[int, Worker]]:
        """Start several workers, wait until they run, and make sure that they have stopped at the end."""
        started = [
            subprocess.Popen([sys.executable, "-c", STANDIN], cwd=ROOT, env=environment(self.settings))
            for _ in range(number)
        ]
        try:
            until(lambda: len(self.executors()) == number, by=started)
            self.ended(self.ask())
            yield {worker.pid: worker for worker in started}
        finally:
            for worker in started:
                worker.kill()
                worker.wait()

    def executors(self) -> list[str]:
        with self.database.reading() as session:
            return list(session.scalars(select(Executor.id)))


class Records:
    """The contents of an installation's tables, and of its engine's tables."""

    def __init__(self, url: str) -> None:
        self.database = Database(url)
        self.engine = Database(Settings(database_url=url).engine_url)
        self._workflows = "workflow_status" if url.startswith("sqlite") else "dbos.workflow_status"

    def close(self) -> None:
        self.database.close()
        self.engine.close()

    def held(self) -> dict[str, int]:
        """Return which process holds which job, by the names of its workflows."""
        return self._holders("status = 'PENDING'")

    def begun_since(self, moment: float) -> set[int]:
        """Return the processes that have begun a job since a moment, in seconds of the clock."""
        return set(self._holders(f"started_at_epoch_ms > {moment * 1000:.0f}").values())

    def count(self, table: type, *where: ColumnElement[bool]) -> int:
        with self.database.reading() as session:
            return session.scalar(select(func.count()).select_from(table).where(*where)) or 0

    def jobs(self, state: str) -> int:
        return self.count(Job, Job.state == state)

    def state(self, row: int) -> str:
        with self.database.reading() as session:
            return session.get_one(Job, row).state

    def wrong(self) -> list[tuple[str, str]]:
        """Inspect everything that is stored, as `skills verify` does, and return the faults."""
        return cases.wrong(self.database)

    def _holders(self, which: str) -> dict[str, int]:
        query = text(f"SELECT workflow_uuid, executor_id FROM {self._workflows} WHERE {which}")
        with self.engine.reading() as session:
            return {row.workflow_uuid: int(row.executor_id.partition("-")[0]) for row in session.execute(query)}


def add_demonstration(url: str) -> None:
    """Add a surgeon and a small hand-off to a service."""
    with httpx.Client(base_url=url, timeout=END_S) as http:
        http.put("/surgeons/kestrel", json={}).raise_for_status()
        query, as_table = {"surgeon": "kestrel", "suture": cases.SUTURE}, {"Content-Type": "text/csv"}
        http.post("/demos", params=query, content=cases.hand_off(), headers=as_table).raise_for_status()


class Site(Records):
    """The real service with its workers, and its tables."""

    def __init__(self, service: Service, url: str) -> None:
        super().__init__(url)
        self.service = service


@contextmanager
def site(backend: str, folder: Path, **settings: object) -> Iterator[Site]:
    """Start the service on an empty database of a back end."""
    url = blank(backend, folder)
    with site_at(url, folder, **settings) as place:
        yield place
    drop(url)


@contextmanager
def site_at(url: str, folder: Path, **settings: object) -> Iterator[Site]:
    """Start the service on a database, yield it once it is ready, and stop it at the end."""
    with running(folder, database_url=url, **settings) as service:
        place = Site(service, url)
        try:
            yield place
        finally:
            place.close()
