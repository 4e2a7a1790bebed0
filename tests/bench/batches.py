"""How fast a batch is trained, beside the same learning in a bare process pool, in turn, on the same cores."""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from itertools import count, islice
from multiprocessing import get_context
from pathlib import Path
from statistics import median

import numpy as np
from rich.table import Table
from sqlalchemy import func, select, update

from skills.db.models import Demonstration, Executor, Job, StoredRewardMap, Surgeon, SutureType
from skills.db.session import Database
from skills.errors import BadPath
from skills.jobs.child import environment
from skills.library.catalogue import put_surgeon, seed_catalogue
from skills.library.demos import Cut, upload_demo
from skills.library.retraining import request_retraining
from skills.settings import Settings
from skills.style.certificate import Certificate, Coverage, certify
from skills.style.grid import PAPER_GRID, discretize
from skills.style.learning.q_learning import PhaseQLearning
from skills.style.policy import learn_policy
from skills.style.reward import RewardMap
from tests.library import cases
from tests.style.synthetic import RATE_HZ, motions

STYLES = 200  # `python -m tests.bench.batches 1000 3` takes the thousand, three times
ROUNDS = 2
WORKERS = (1, 2, 4)
FIRST = "warm-up"  # a surgeon whose style is trained before any clock runs
MOST_S = 600.0


def batches(table: Table, styles: int = STYLES, rounds: int = ROUNDS) -> None:
    """Train all styles of many synthetic surgeons with 1, 2 and 4 workers, beside a bare pool of as many processes."""
    with tempfile.TemporaryDirectory(prefix="skills-batches-") as folder:
        full = Path(folder) / "full.sqlite"
        rewards = fill(full, styles)
        for workers in WORKERS:
            took = [
                (pool_s(rewards, workers, kernel), pool_s(rewards, workers, returned), ours_s(full, workers, styles))
                for _ in range(rounds)
            ]
            bare_s, _, all_s = (median(times) for times in zip(*took, strict=True))
            name = f"{styles} styles, {workers} worker{'s' if workers > 1 else ''}"
            table.add_row(name, f"{all_s:.1f} s", f"{styles / all_s:.0f} styles/s")
            for index, what in enumerate(("a bare pool that drops its results", "  that hands them to its parent")):
                shares = ", ".join(f"{times[index] / times[2]:.2f}" for times in took)
                table.add_row(f"  {what}", f"{median(t[index] for t in took):.1f} s", f"ours has {shares} of its rate")
            cores = min(workers, os.cpu_count() or 1)
            above_ms = (all_s - bare_s) * cores / styles * 1e3
            table.add_row("  a style, above its learning", f"{above_ms:.1f} ms", "of a core")
        empty_s = ours_s(full, 2, styles, consent=False)
        table.add_row("  the engine and our books alone", f"{empty_s / styles * 1e3:.1f} ms", "a style, two workers")


def fill(file: Path, styles: int) -> list[RewardMap]:
    """Make a database with so many styles, as many surgeons as it takes; their reward maps."""
    database = Database(f"sqlite:///{file}")
    database.migrate()
    with database.writing() as session:
        seed_catalogue(session)
    with database.reading() as session:
        sutures = session.scalars(select(SutureType.slug)).all()
    names = ((f"surgeon-{number}", suture) for number in count() for suture in sutures)
    for (surgeon, suture), tip_mm in zip(
        [(FIRST, sutures[0]), *islice(names, styles)], inside(styles + 1), strict=True
    ):
        with database.writing() as session:
            put_surgeon(session, surgeon, {}, "bench")
        data = cases.table(tip_mm, rate_hz=RATE_HZ)
        upload_demo(database, cases.upload(data), Cut(surgeon, suture, grid="paper"), "bench")
    with database.reading() as session:
        of_all = select(StoredRewardMap.map).join(Demonstration).order_by(Demonstration.row).offset(1)
        rewards = list(session.scalars(of_all))
    database.forget()
    database.close()
    return rewards


def inside(number: int) -> Iterator[np.ndarray]:
    """Draw motions, (T, 3) mm, that stay in the paper's grid, one of a seed."""
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


def pool_s(rewards: list[RewardMap], workers: int, work: Callable[[RewardMap], object]) -> float:
    """Time the learning and the certificate of every style and nothing else, in so many processes that are warm."""
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        list(pool.map(kernel, rewards[:1] * workers * 4))
        began_s = time.monotonic()
        for _ in pool.map(work, rewards, chunksize=5):
            pass
        return time.monotonic() - began_s


def kernel(reward: RewardMap) -> None:
    certify(learn_policy(reward, PhaseQLearning()))


def returned(reward: RewardMap) -> tuple[np.ndarray, Certificate, Coverage]:
    policy = learn_policy(reward, PhaseQLearning())
    return policy.q, *certify(policy)


# ---- ours


def ours_s(full: Path, workers: int, styles: int, *, consent: bool = True) -> float:
    """Time a batch in a fresh copy of the database, from its request to its end; without consent nothing is learnt."""
    with tempfile.TemporaryDirectory(prefix="skills-batch-", dir=full.parent) as folder:
        file = Path(folder) / "skills.sqlite"
        shutil.copy(full, file)
        settings = Settings(database_url=f"sqlite:///{file}")
        database = Database(settings.database_url)
        with working(settings, workers, database):
            for number in range(2 * workers):  # everybody has learnt something
                ended(database, asked(database, surgeon=FIRST, learner=PhaseQLearning(gamma=0.1 - number / 1000)))
            if not consent:
                with database.writing() as session:
                    session.execute(update(Surgeon).values(consent={"uses": [], "until": None}))
            job = ended(database, asked(database))
        database.close()
        assert job.result["done" if consent else "failed"] == styles + 1, (job.state, job.error)
        return (job.ended_at - job.created_at).total_seconds()


def asked(database: Database, **what: object) -> int:
    with database.writing() as session:
        return request_retraining(session, "bench", **what)[0].row


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
def working(settings: Settings, workers: int, database: Database) -> Iterator[None]:
    command = [sys.executable, "-m", "skills", "worker"]
    how = environment(settings)
    started = [subprocess.Popen(command, env=how, stderr=subprocess.DEVNULL) for _ in range(workers)]
    try:
        while True:
            with database.reading() as session:
                if session.scalar(select(func.count()).select_from(Executor)) == workers:
                    break
            time.sleep(0.05)
        yield
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
