"""Speed of batch training compared with the same learning in a bare process pool, in turn, on the same cores.

Besides wall time it reports the processor time of the learning processes: on a machine under other load, only that is
comparable.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing, contextmanager
from itertools import count, islice
from multiprocessing import active_children, get_context
from pathlib import Path
from statistics import median
from typing import NamedTuple, TypeVar

import numpy as np
from rich.table import Table
from sqlalchemy import func, select, update

from skills.db.models import Demonstration, Surgeon, SutureType
from skills.db.packed import unpack_as
from skills.db.service_tables import Executor, Job
from skills.db.session import Database
from skills.errors import BadPath
from skills.gridworld.grid import PAPER_GRID, discretize
from skills.gridworld.reward import RewardMap
from skills.jobs import Engine
from skills.learning.certificate import Certificate, Coverage, NearLimits, certify
from skills.learning.policy import describe_learner, learn_tabular
from skills.learning.q_learning import PhaseQLearning
from skills.library.operation.jobs import PART, attempts_to_submit
from skills.library.people.surgeons import put_surgeon
from skills.library.people.suture_types import seed_suture_types
from skills.library.policies.learning import Lesson, learn_style, lessons
from skills.library.policies.requests import TrainingRequest
from skills.library.policies.retraining import request_retraining
from skills.library.recordings.demos import upload_demo
from skills.schemas.demos import DemoIn
from skills.schemas.people import SurgeonIn
from skills.schemas.training import RetrainingIn
from skills.serving import environment
from skills.settings import Settings
from tests.demonstration.synthetic import RATE_HZ, motions
from tests.library import cases

STYLES = 200  # `python -m tests.bench.batches 1000 3` takes a thousand, three times
ROUNDS = 2
WORKERS = (1, 2, 4)
FIRST = "warm-up"  # a surgeon whose style is trained before the measurement
MOST_S = 600.0
LIMITS = Settings(database_url="sqlite://")  # made once, as by a worker: reading the environment takes 1.5 ms
T = TypeVar("T")


class Took(NamedTuple):
    """The cost of some work, in s: wall time, and processor time of the learning processes."""

    clock_s: float
    processor_s: float


def batches(table: Table, styles: int = STYLES, rounds: int = ROUNDS) -> None:
    """Train all styles of many synthetic surgeons with 1, 2 and 4 workers, and in a bare pool of as many processes."""
    with tempfile.TemporaryDirectory(prefix="skills-batches-") as folder:
        full = Path(folder) / "full.sqlite"
        asked_of = fill(full, styles)
        pools = {
            "learns and drops the results": (kernel, [reward for reward, _ in asked_of]),
            "hands them to its parent": (returned, [reward for reward, _ in asked_of]),
            "drops all that we work out": (worked_out, [lesson for _, lesson in asked_of]),
        }
        for workers in WORKERS:
            took = [
                (ours(full, workers, styles), *(pool(learn, given, workers) for learn, given in pools.values()))
                for _ in range(rounds)
            ]
            whole, *bare_pools = zip(*took, strict=True)
            name = f"{styles} styles, {workers} worker{'s' if workers > 1 else ''}"
            table.add_row(name, *said(whole, styles))
            for what, pooled in zip(pools, bare_pools, strict=True):
                table.add_row(f"  a bare pool that {what}", *said(pooled, styles))
                for by, index in (("the clock", 0), ("the processor", 1)):
                    part = (
                        f"{bare[index] / all_of_it[index]:.2f}" for bare, all_of_it in zip(pooled, whole, strict=True)
                    )
                    table.add_row("", f"by {by}", f"ours has {', '.join(part)} of its rate")
        table.add_row("  the engine and our books alone", *said([ours(full, 2, styles, consent=False)], styles))


def said(took: Sequence[Took], styles: int) -> tuple[str, str]:
    """Format the duration of some rounds, and the time per style."""
    clock_s, processor_s = (median(times) for times in zip(*took, strict=True))
    each_ms = f"{processor_s / styles * 1e3:.1f} ms of the processor each"
    return f"{clock_s:.1f} s", f"{styles / clock_s:.0f} styles/s, {each_ms}"


def used_s(processes: Iterable[int]) -> float:
    """Return the processor time of living processes so far, with all threads, user and system time."""
    ticks = 0
    for process in processes:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])  # utime and stime, see proc(5)
    return ticks / os.sysconf("SC_CLK_TCK")


def fill(file: Path, styles: int) -> list[tuple[RewardMap, Lesson]]:
    """Create a database with a number of styles and enough surgeons; return the inputs of their training."""
    database = Database(f"sqlite:///{file}")
    database.migrate()
    with database.writing() as session:
        seed_suture_types(session)
    with database.reading() as session:
        sutures = session.scalars(select(SutureType.slug)).all()
    names = ((f"surgeon-{number}", suture) for number in count() for suture in sutures)
    for (surgeon, suture), tip_mm in zip(
        [(FIRST, sutures[0]), *islice(names, styles)], inside(styles + 1), strict=True
    ):
        with database.writing() as session:
            put_surgeon(session, surgeon, SurgeonIn(), "bench")
        data = cases.table(tip_mm, rate_hz=RATE_HZ)
        upload_demo(database, cases.upload(data), DemoIn(surgeon=surgeon, suture=suture, grid="paper"), "bench")
    with database.reading() as session:
        rows = list(session.scalars(select(Demonstration.row).order_by(Demonstration.row).offset(1)))
        stored = lessons(session, rows)
    database.forget()
    database.close()
    return [(unpack_as(RewardMap, lesson.reward), lesson) for lesson in stored]


def inside(number: int) -> Iterator[np.ndarray]:
    """Generate motions, (T, 3) mm, that stay in the paper's grid, from one seed."""
    seeds = count()
    for _ in range(number):
        yield next(tip for seed in seeds for tip in islice(motions(seed, PAPER_GRID, seed % 3), 1) if fits(tip))


def fits(tip_mm: np.ndarray) -> bool:
    try:
        discretize(tip_mm, PAPER_GRID)
    except BadPath:
        return False
    return True


# ---- a bare pool


def pool(learn: Callable[[T], object], given: Sequence[T], workers: int) -> Took:
    """Time the computation of every style and nothing else, in a number of warm processes."""
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        list(pool.map(learn, given[:1] * workers * 4))
        processes = [child.pid for child in active_children()]
        began_s, before_s = time.monotonic(), used_s(processes)
        for _ in pool.map(learn, given, chunksize=5):
            pass
        return Took(time.monotonic() - began_s, used_s(processes) - before_s)


def kernel(reward: RewardMap) -> None:
    certify(learn_tabular(reward, PhaseQLearning()))


def returned(reward: RewardMap) -> tuple[np.ndarray, Certificate, Coverage]:
    policy = learn_tabular(reward, PhaseQLearning())
    return policy.q, *certify(policy)


def worked_out(lesson: Lesson) -> None:
    """Learn, certify, check, measure, describe and pack: everything that does not need the database."""
    learn_style(lesson, training_of(lesson), LIMITS)


def training_of(lesson: Lesson) -> TrainingRequest:
    return TrainingRequest(
        surgeon=lesson.surgeon.slug,
        suture=lesson.suture,
        demos=[lesson.sha256],
        learner=PhaseQLearning(),
        near=NearLimits(),
    )


# ---- ours


def ours(full: Path, workers: int, styles: int, *, consent: bool = True) -> Took:
    """Time a batch in a fresh copy of the database, from request to end; without consent nothing is learnt."""
    with tempfile.TemporaryDirectory(prefix="skills-batch-", dir=full.parent) as folder:
        file = Path(folder) / "skills.sqlite"
        shutil.copy(full, file)
        settings = Settings(database_url=f"sqlite:///{file}")
        database = Database(settings.database_url)
        with working(settings, workers, database) as processes, closing(Engine(settings)) as engine:
            for number in range(2 * workers):  # until every worker has learnt something
                other = PhaseQLearning(gamma=0.1 - number / 1000)
                ended(database, asked(database, engine, surgeon=FIRST, learner=describe_learner(other)))
            if not consent:
                with database.writing() as session:
                    session.execute(update(Surgeon).values(consent={"uses": [], "until": None}))
            before_s = used_s(processes)
            job = ended(database, asked(database, engine))
            took = Took((job.ended_at - job.created_at).total_seconds(), used_s(processes) - before_s)
        database.close()
        assert job.result["done" if consent else "failed"] == styles + 1, (job.state, job.error)
        return took


def asked(database: Database, engine: Engine, **what: object) -> int:
    """Request a batch as the service does."""
    job, *_ = request_retraining(database, RetrainingIn(**what), "bench")
    with database.reading() as session:
        told = attempts_to_submit(session, job)
    for row, attempt in told:
        engine.submit(row, attempt, PART)
    return job.row


def ended(database: Database, row: int) -> Job:
    deadline = time.monotonic() + MOST_S
    while time.monotonic() < deadline:
        with database.reading() as session:
            job = session.get_one(Job, row)
        if job.ended_at is not None:
            return job
        time.sleep(0.05)
    raise AssertionError("the batch did not end")


@contextmanager
def working(settings: Settings, workers: int, database: Database) -> Iterator[list[int]]:
    command = [sys.executable, "-m", "skills", "worker"]
    how = environment(settings)
    started = [subprocess.Popen(command, env=how, stderr=subprocess.DEVNULL) for _ in range(workers)]
    try:
        while True:
            with database.reading() as session:
                if session.scalar(select(func.count()).select_from(Executor)) == workers:
                    break
            assert all(worker.poll() is None for worker in started), "a worker has ended"
            time.sleep(0.05)
        yield [worker.pid for worker in started]
    finally:
        for worker in started:
            worker.terminate()
        for worker in started:
            worker.wait()


if __name__ == "__main__":
    from rich.console import Console

    table = Table("what", "time", "in proportion", box=None)
    batches(table, *map(int, sys.argv[1:]))
    Console(width=120).print(table)
