"""The real service: a server and its worker as separate processes on loopback, with a database in a folder."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING

import httpx2 as httpx
import pytest

from skills.client import Client
from skills.settings import Settings
from skills.simulation import film
from tests import backends
from tests.library import cases
from tests.waiting import END_S, children, until

if TYPE_CHECKING:
    from playwright.sync_api import Browser

WORKER, FORK_SERVER = "skills-worker", "fork_server"
REPLACED = 2  # workers that may die while a service starts, as where its database is not yet reachable


def answers(client: Client, path: str) -> bool:
    """Return whether a starting service answers a request for a path with success."""
    try:
        return client.http.get(path).is_success
    except httpx.TransportError:
        return False


class Service:
    """A service that can be killed and restarted on the same database."""

    def __init__(self, folder: Path, **settings: object) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self.database = folder / "skills.sqlite"
        backends.place(self.database)
        self.environment = {
            **{k: v for k, v in os.environ.items() if not k.startswith("SKILLS_")},
            "SKILLS_DATABASE_URL": f"sqlite:///{self.database}",
            "SKILLS_WORKERS": "1",
            "SKILLS_PORT": str(self.port),  # for those that start it by another command
            **{f"SKILLS_{name.upper()}": str(value) for name, value in settings.items()},
        }
        self.command = [sys.executable, "-m", "skills", "serve", "--port", str(self.port)]
        self.process: subprocess.Popen[bytes] | None = None
        self.stdout: IO[bytes] | None = None

    def launch(self) -> None:
        self.process = subprocess.Popen(self.command, env=self.environment, stdout=self.stdout)

    def start(self) -> None:
        self.launch()
        path = "/healthz" if self.environment["SKILLS_WORKERS"] == "0" else "/readyz"  # ready only with a worker
        workers: set[int] = set()

        def ready() -> bool:
            workers.update(self.children(WORKER))
            assert len(workers) <= int(self.environment["SKILLS_WORKERS"]) + REPLACED, "its workers die at their start"
            return answers(client, path)

        with Client(self.url) as client:
            until(ready, by=[self.process])

    def child(self, word: str) -> int:
        """Return the child process with a word in its name or on its command line: its worker, or its fork server."""
        (child,) = self.children(word)
        return child

    def children(self, word: str) -> list[int]:
        """Return the child processes with a word in their names or on their command lines."""
        assert self.process is not None
        found = []
        for pid in children(self.process.pid):
            with suppress(ProcessLookupError, FileNotFoundError):  # it has just ended
                said = Path(f"/proc/{pid}/cmdline").read_text() + Path(f"/proc/{pid}/comm").read_text()
                found += [pid] if word in said else []
        return found

    def kill(self) -> None:
        assert self.process is not None
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(END_S)

    def stop(self) -> int:
        assert self.process is not None
        self.process.terminate()
        return self.process.wait(END_S)


@contextmanager
def running(folder: Path, **settings: object) -> Iterator[Service]:
    service = Service(folder, **settings)
    try:
        service.start()  # inside `try`, so that a service that is not ready in time is stopped too
        yield service
    finally:
        if service.process is not None and service.process.poll() is None:
            service.stop()


@contextmanager
def by_a_thread(folder: Path) -> Iterator[Service]:
    """Start a service whose jobs a thread carries out: a worker takes three seconds to start, and draws whole films."""
    with running(folder, workers=0) as started, pytest.MonkeyPatch.context() as patched:
        patched.setattr(film, "FRAMES", 4)
        patched.setattr(film, "FRAMES_PER_PASS", 4)
        with cases.working(Settings(database_url=f"sqlite:///{started.database}")):
            yield started


@pytest.fixture(scope="module")
def browser() -> "Iterator[Browser]":
    from tests.e2e.browsers import browsing  # here, because most tests of this folder need none

    with browsing() as started:
        yield started


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with by_a_thread(tmp_path_factory.mktemp("service")) as started:
        yield started


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[Client]:
    with Client(service.url) as connected:
        yield connected
