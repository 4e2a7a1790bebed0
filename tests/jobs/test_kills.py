"""SIGKILL of the worker, of the API and of both, at random instants during trainings: nothing is lost or doubled.

The real service over HTTP. A client requests many trainings, and then repeats random requests of them, regardless of
failed requests. The figures of a round are printed, with the seed of its instants.
"""

import os
import random
import signal
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event as Flag
from threading import Thread

import httpx2 as httpx
import pytest
from sqlalchemy import select

from skills.db.models import PolicyVersion
from skills.db.service_tables import Event, Job
from tests.backends import BACKENDS
from tests.e2e.conftest import WORKER
from tests.jobs.house import Site, add_demonstration, site
from tests.library import cases
from tests.waiting import END_S, crowded, until

KINDS = ("worker", "API", "both")
A_FEW, MANY = (100, 1), (200, 3)  # jobs per round, and kills of each kind
INSTANT_S = 0.5  # from the resumption of work to the next kill, at most
RESUMED_S = 10.0  # on an idle machine, where it takes about 7
PATIENCE_S = END_S
NIGHTLY_ROUNDS = 17  # 51 kills of each kind
LEARNERS = ({"kind": "phase-q-learning"}, {"kind": "cell-q-learning", "episodes": 20_000})  # the second takes longer


@dataclass
class Figures:
    """The results of a round."""

    kills: Counter[str] = field(default_factory=Counter)
    cut: int = 0  # jobs held by a killed worker
    took_s: list[float] = field(default_factory=list)
    resumed_s: list[float] = field(default_factory=list)  # the part of that time without waiting for a processor


class Asker:
    """A client that requests trainings, all of them and then random ones again, until it is stopped."""

    def __init__(self, url: str, rng: random.Random, jobs: int) -> None:
        self.jobs = jobs
        self.ids: dict[int, set[str]] = {number: set() for number in range(jobs)}
        self.answers: Counter[str] = Counter()
        self._url, self._rng, self._over = url, rng, Flag()
        self._thread = Thread(target=self._run)

    @contextmanager
    def asking(self) -> Iterator[None]:
        self._thread.start()
        try:
            yield
        finally:
            self._over.set()
            self._thread.join()

    @property
    def acknowledged(self) -> int:
        return sum(bool(ids) for ids in self.ids.values())

    def _run(self) -> None:
        with httpx.Client(base_url=self._url, timeout=10.0) as http:
            while self.acknowledged < self.jobs:
                self._ask(http, self.acknowledged)
            while not self._over.wait(0.1):
                self._ask(http, self._rng.randrange(self.jobs))

    def _ask(self, http: httpx.Client, number: int) -> None:
        learner = LEARNERS[number % 4 == 0]
        body = {"surgeon": "kestrel", "suture": cases.SUTURE, "seed": number, "learner": learner}
        try:
            answer = http.post("/trainings", json=body)
        except httpx.TransportError as error:
            self.answers[type(error).__name__] += 1
            self._over.wait(0.05)
            return
        self.answers[str(answer.status_code)] += 1
        if answer.is_success:
            self.ids[number].add(answer.json()["id"])


def kill_and_see_it_resumed(place: Site, kind: str, rng: random.Random, figures: Figures) -> None:
    """Kill, and wait until the killed processes hold no job and another process has begun one.

    The time for which the successors were ready to run but had no processor is subtracted: it is no property of theirs,
    and on a busy machine it is most of the time.
    """
    service, workers = place.service, place.service.children(WORKER)
    victims = {"worker": [rng.choice(workers)], "API": [service.process.pid], "both": [service.process.pid, *workers]}
    alive = {pid: waited(pid) for pid in workers}
    killed, began, waited_s = time.time(), time.monotonic(), 0.0
    for pid in victims[kind]:
        os.kill(pid, signal.SIGKILL)
    gone = set(victims[kind]) if kind == "worker" else {*victims[kind], *workers}  # the workers exit after the API
    if kind != "worker":
        service.process.wait(PATIENCE_S)
        service.launch()
        until(lambda: service.children(WORKER), PATIENCE_S)
        waited_s += waited(service.process.pid)
    figures.cut += sum(pid in victims[kind] for pid in place.held().values())
    until(lambda: place.begun_since(killed) - gone and not gone & set(place.held().values()), PATIENCE_S)
    took_s = time.monotonic() - began
    waited_s += max(waited(pid) - alive.get(pid, 0.0) for pid in service.children(WORKER))
    figures.kills[kind] += 1
    figures.took_s.append(took_s)
    figures.resumed_s.append(took_s - waited_s)


def waited(pid: int) -> float:
    """Return the seconds that a process's main thread has waited for a processor; 0 if the kernel does not count."""
    counted = Path(f"/proc/{pid}/schedstat")
    return int(counted.read_text().split()[1]) / 1e9 if counted.exists() else 0.0


def one_round(backend: str, folder: Path, workers: int, seed: int, jobs: int, each: int) -> Figures:
    """Kill at random instants while the trainings run; check everything at the end."""
    rng, figures = random.Random(seed), Figures()
    kinds = [*KINDS] * each
    rng.shuffle(kinds)
    print(f"{backend}, {workers} workers, seed {seed}: ", end="", flush=True)
    blameless = {"job_attempts": 20}  # otherwise a job is given up after three dead workers
    with site(backend, folder, workers=workers, log_level="error", **blameless) as place:
        add_demonstration(place.service.url)
        own = random.Random(seed)  # separate, so that the instants do not depend on it
        asker = Asker(place.service.url, own, jobs)
        with asker.asking():
            until(lambda: place.jobs("succeeded"), PATIENCE_S)
            for kind in kinds:
                time.sleep(rng.uniform(0.0, INSTANT_S))
                assert place.count(Job, Job.ended_at.is_(None)), "all jobs ended before the last kill"
                kill_and_see_it_resumed(place, kind, rng, figures)
            until(lambda: asker.acknowledged == jobs, PATIENCE_S)
        until(lambda: place.count(Job, Job.ended_at.is_(None)) == 0, PATIENCE_S)
        every_job_ended_once(place, asker)
    print(
        f"kills {dict(figures.kills)}, jobs cut {figures.cut}, answers {dict(asker.answers)}, "
        f"resumed within {max(figures.resumed_s):.1f} s (by the clock {max(figures.took_s):.1f} s)"
    )
    return figures


def every_job_ended_once(place: Site, asker: Asker) -> None:
    """Assert that there is one job per request and one policy per job, and that everything is complete."""
    assert {len(ids) for ids in asker.ids.values()} == {1}
    with place.database.reading() as session:
        jobs = list(session.scalars(select(Job)))
        policies = session.scalars(select(PolicyVersion.sha256)).all()
        trained = session.scalars(select(Event.object_id).where(Event.action == "train")).all()
        finished = session.scalars(select(Event.object_id).where(Event.action == "finish")).all()
    assert {job.id for job in jobs} == set.union(*asker.ids.values())
    assert [job.error for job in jobs if job.state != "succeeded"] == []
    assert sorted(job.result["sha256"] for job in jobs) == sorted(policies) == sorted(trained)
    assert sorted(finished) == sorted(job.id for job in jobs)
    assert len(jobs) == len(set(policies)) == asker.jobs
    assert place.wrong() == []


@pytest.mark.nightly  # 50 s; by day test_many_workers kills one
@pytest.mark.parametrize("backend", BACKENDS)
def test_every_job_ends_once_whoever_is_killed_while_they_run(backend: str, tmp_path: Path):
    figures = one_round(backend, tmp_path, 1, random.randrange(10**6), *A_FEW)
    assert max(figures.resumed_s) <= RESUMED_S * crowded()


@pytest.mark.nightly
@pytest.mark.parametrize("number", range(NIGHTLY_ROUNDS))
@pytest.mark.parametrize("backend", BACKENDS)
def test_fifty_kills_of_each_kind(backend: str, number: int, tmp_path: Path):
    figures = one_round(backend, tmp_path, 1 + number % 2, number, *MANY)
    assert max(figures.resumed_s) <= RESUMED_S
