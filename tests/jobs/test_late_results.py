"""A worker that is stopped past its lease and continued: another has done its training, and its result is discarded."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select, text

from skills.db.models import PolicyVersion
from skills.db.service_tables import Event, Executor, Job
from skills.jobs import workflow_id
from skills.learning.q_learning import CellQLearning
from skills.serving import environment
from skills.settings import Settings
from tests import backends
from tests.jobs.house import ROOT, Records, Worker
from tests.jobs.test_batches import stop_between_transactions
from tests.library import cases
from tests.waiting import END_S, crowded, until

SLOW = CellQLearning(episodes=4_000_000)  # some seconds of learning, so that a test can act midway
PATIENCE_S = END_S


@pytest.fixture(params=backends.BACKENDS)
def records(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Records]:
    url = backends.fresh(request.param, tmp_path)
    records = Records(url)
    yield records
    records.close()
    backends.drop(url)


@contextmanager
def workers(records: Records, folder: Path) -> Iterator[dict[int, Worker]]:
    """Yield two real workers, ready, by process id; each logs its every attempt into a file, by number.

    On a busy machine their lease is longer: neither may take over from the other while that only waits for a processor.
    """
    lease_s = 2.0 * crowded()
    how = environment(Settings(database_url=records.database.url, log_level="info", lease_s=lease_s))
    started: dict[int, Worker] = {}
    for number in range(2):
        with (folder / f"{number}.log").open("wb") as log:
            worker = subprocess.Popen([sys.executable, "-m", "skills", "worker"], cwd=ROOT, env=how, stderr=log)
            started[worker.pid] = worker
    try:
        until(lambda: records.count(Executor) == 2, PATIENCE_S, by=started.values())
        yield started
    finally:
        for worker in started.values():
            worker.kill()
            worker.wait()


def stop(records: Records, worker: Worker) -> None:
    """Stop a worker while it holds the write lock of neither our database nor the engine's."""
    stop_between_transactions(records.database, worker)


def told(log: Path, job: Job) -> bool:
    """Return whether a worker has logged the end of an attempt at a job; its warnings name the job too."""
    lines = log.read_text().splitlines()
    return any(" job kind=training " in line and f"job_id={job.id}" in line for line in lines)


def everything(records: Records) -> list[tuple[Any, ...]]:
    """Return the rows that trainings write: every job, policy version and event."""
    with records.database.reading() as session:
        jobs = select(Job.row, Job.state, Job.attempt, Job.result, Job.error, Job.progress, Job.ended_at)
        policies = select(PolicyVersion.row, PolicyVersion.sha256, PolicyVersion.version)
        rows = [
            session.execute(query.order_by(text("1"))) for query in (jobs, policies, select(Event.row, Event.sha256))
        ]
        return [tuple(row) for found in rows for row in found]


@pytest.mark.nightly  # by day `tests/jobs/test_many_workers.py` has a late result, of workers with a stand-in
@pytest.mark.parametrize("times", [1, 20])
def test_the_late_result_of_a_stopped_worker_changes_nothing(records: Records, times: int, tmp_path: Path):
    cases.add_surgeon(records.database)
    cases.add_demo(records.database)
    asked, late = 0, 0
    with workers(records, tmp_path) as started:
        logs = {worker: tmp_path / f"{number}.log" for number, worker in enumerate(started)}
        while late < times:
            job = cases.ask_training(records.database, learner=SLOW, seed=asked)
            asked += 1
            stopped = stopped_in_the_middle(records, started, job)
            if stopped is None:
                continue
            until(partial(has_ended, records, job), PATIENCE_S)
            before = everything(records)
            (other,) = started.keys() - {stopped.pid}
            until(partial(told, logs[other], job), PATIENCE_S)  # the line follows the commit of the job's end
            stopped.send_signal(signal.SIGCONT)
            until(partial(told, logs[stopped.pid], job), PATIENCE_S)
            assert everything(records) == before
            assert records.state(job.row) == "succeeded"
            late += 1
    assert records.count(PolicyVersion) == asked == records.count(Event, Event.action == "finish")
    assert records.wrong() == []
    print(f"late results that changed nothing: {late} of {times}")


def stopped_in_the_middle(records: Records, started: dict[int, Worker], job: Job) -> Worker | None:
    """Stop the worker that works on a job, and return it; None if it was too fast, and then the job has ended."""
    until(lambda: records.state(job.row) != "queued", PATIENCE_S)
    worker = started.get(records.held().get(workflow_id(job.row, job.attempt), 0))
    if worker is None:  # it has ended, or is between two workers
        until(partial(has_ended, records, job), PATIENCE_S)
        return None
    stop(records, worker)
    if has_ended(records, job):
        worker.send_signal(signal.SIGCONT)
        return None
    return worker


def has_ended(records: Records, job: Job) -> bool:
    return records.state(job.row) not in ("queued", "running")
