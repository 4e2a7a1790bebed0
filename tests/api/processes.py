"""A server in a process of its own beside this one, on one database, without workers."""

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import httpx2 as httpx

from skills.serving import environment
from skills.settings import Settings
from tests.api.service import CSV, KESTREL, serving
from tests.library import cases
from tests.waiting import END_S

PATIENCE_S = END_S


@contextmanager
def server(url: str) -> Iterator[httpx.Client]:
    """Start a server as `skills serve` does, and yield a client of it once it responds."""
    settings = Settings(database_url=url, port=free_port(), workers=0)
    process = subprocess.Popen([sys.executable, "-m", "skills", "serve"], env=environment(settings))
    try:
        wait_until_it_answers(settings.port, process)
        with httpx.Client(base_url=f"http://127.0.0.1:{settings.port}", timeout=PATIENCE_S) as client:
            yield client
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


def learn_two_versions(url: str) -> None:
    """Learn kestrel's style twice, and release the first version."""
    with serving(url) as service:
        service.client.put_surgeon("kestrel")
        service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
        service.train(release=True)
        service.train(seed=2)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port: int = taken.getsockname()[1]
        return port


def wait_until_it_answers(port: int, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while True:
        assert process.poll() is None, "the server ended"
        assert time.monotonic() < deadline, "the server does not answer"
        try:
            httpx.get(f"http://127.0.0.1:{port}/healthz", timeout=PATIENCE_S)
        except httpx.TransportError:
            time.sleep(0.05)
        else:
            return
