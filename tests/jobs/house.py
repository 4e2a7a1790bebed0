"""A database, the service's side of the engine, and workers as processes of their own."""

import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import select

from skills.db.models import Executor, Job
from skills.db.session import Database
from skills.jobs.child import environment
from skills.jobs.engine import Engine
from skills.settings import Settings

ROOT = Path(__file__).parents[2]
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

    def ask(self, kind: str = "quick", state: str = "queued", **request: object) -> int:
        """Commit a job as the library does; nobody is told of it."""
        name = uuid.uuid4().hex
        asked = {"journal": str(self.journal), **request}
        with self.database.writing() as session:
            job = Job(id=name, kind=kind, identity=name * 2, request=asked, state=state)
            session.add(job)
        return job.row

    def job(self, row: int) -> Job:
        with self.database.reading() as session:
            return session.get_one(Job, row)

    def ended(self, row: int, within_s: float = 10.0) -> Job:
        """Wait for a job's end."""
        until(lambda: self.job(row).state not in ("queued", "running"), within_s)
        return self.job(row)

    def begun(self, row: int, within_s: float = 10.0) -> int:
        """Wait until somebody works on a job, and tell who."""
        until(lambda: self.noted("begins", row), within_s)
        return self.noted("begins", row)[-1]

    def noted(self, word: str, row: int) -> list[int]:
        """List the processes that noted a word about a job."""
        lines = (line.split() for line in self.journal.read_text().splitlines())
        return [int(pid) for said, about, pid in lines if (said, int(about)) == (word, row)]

    @contextmanager
    def workers(self, number: int) -> Iterator[dict[int, Worker]]:
        """Start workers side by side, wait until they work, and see that they are gone in the end."""
        started = [
            subprocess.Popen([sys.executable, "-m", "tests.jobs.standin"], cwd=ROOT, env=environment(self.settings))
            for _ in range(number)
        ]
        try:
            until(lambda: len(self.executors()) == number, 30.0)
            self.ended(self.ask(), 15.0)
            yield {worker.pid: worker for worker in started}
        finally:
            for worker in started:
                worker.kill()
                worker.wait()

    def executors(self) -> list[str]:
        with self.database.reading() as session:
            return list(session.scalars(select(Executor.id)))


def until(what: Callable[[], object], within_s: float) -> float:
    """Wait for something; tell how long it took, in seconds."""
    began = time.monotonic()
    while not what():
        assert time.monotonic() - began < within_s, f"it did not happen within {within_s} s"
        time.sleep(0.02)
    return time.monotonic() - began
