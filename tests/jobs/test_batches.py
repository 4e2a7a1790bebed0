"""Batches with real workers that run the library: together, killed in the middle, cancelled, poisoned."""

import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from sqlalchemy import func, select, text

from skills.db.books import Event, Executor, Job
from skills.db.models import PolicyVersion
from skills.db.session import WRITE_LOCK, Database
from skills.jobs.child import environment
from skills.library import jobs
from skills.settings import Settings
from skills.style.learning.q_learning import CellQLearning
from tests import backends
from tests.jobs.house import ROOT, until
from tests.library.styles import add_styles, ask_retraining, damage, look, parts_of, states_of, styles_of

SLOW = CellQLearning(episodes=60_000)  # some 50 ms of learning, so that there is a middle
STYLES = 24
PATIENCE_S = 60.0


@pytest.fixture
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    url = backends.fresh(request.param, tmp_path)
    database = Database(url)
    yield database
    database.close()
    backends.drop(url)


@contextmanager
def workers(database: Database, number: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Real workers, ready; each a process that takes one part at a time."""
    command = [sys.executable, "-m", "skills", "worker"]
    how = environment(Settings(database_url=database.url))
    started = [subprocess.Popen(command, cwd=ROOT, env=how, stderr=subprocess.DEVNULL) for _ in range(number)]
    try:
        until(lambda: counted(database, Executor) == number, PATIENCE_S)
        yield started
    finally:
        for worker in started:
            worker.kill()
            worker.wait()


def stop_between_transactions(database: Database, worker: subprocess.Popen[bytes]) -> None:
    """Stop a worker, but not while it holds the one write lock: until it went on, nobody could write."""
    while True:
        worker.send_signal(signal.SIGSTOP)
        try:
            until(lambda: can_write(database), 0.5)
            return
        except AssertionError:
            worker.send_signal(signal.SIGCONT)
            time.sleep(0.05)


def can_write(database: Database) -> bool:
    if database.engine.dialect.name == "postgresql":
        with database.reading() as session:
            return session.scalar(text(f"SELECT pg_try_advisory_xact_lock({WRITE_LOCK})"))
    with closing(sqlite3.connect(database.engine.url.database, timeout=0.1, isolation_level=None)) as connection:
        try:
            connection.execute("BEGIN IMMEDIATE")
        except sqlite3.OperationalError:
            return False
        return True


def counted(database: Database, table: type) -> int:
    with database.reading() as session:
        return session.scalar(select(func.count()).select_from(table))


def done(database: Database, job: Job) -> int:
    return states_of(database, job).count("done")


@pytest.mark.parametrize("database", backends.BACKENDS, indirect=True)
def test_a_batch_survives_the_death_of_a_worker_a_poisoned_style_and_is_asked_for_by_eight_at_once(database: Database):
    """Eight ask at once; one style is damaged; a worker is killed, another stopped and continued past its lease."""
    add_styles(database, STYLES)
    with ThreadPoolExecutor(8) as pool:
        asked = list(pool.map(lambda _: ask_retraining(database, learner=SLOW), range(8)))
    assert len({job.row for job in asked}) == 1
    job = asked[0]
    damage(database, styles_of(database, job)[5].demonstration_row)
    with workers(database, 3) as (killed, stopped, _):
        until(lambda: done(database, job) >= 2, PATIENCE_S)
        killed.kill()
        stop_between_transactions(database, stopped)
        assert look(database, job).state == "running"
        until(lambda: look(database, job).ended_at, PATIENCE_S)
        before = [(style.state, style.policy_row, style.ended_at) for style in styles_of(database, job)]
        os.kill(stopped.pid, signal.SIGCONT)
        late = ask_retraining(database, only_stale=True, learner=SLOW)  # the poisoned one, which it may take
        until(lambda: look(database, late).ended_at, PATIENCE_S)
    after = [(style.state, style.policy_row, style.ended_at) for style in styles_of(database, job)]
    assert after == before
    states = [state for state, *_ in after]
    assert (states.count("done"), states.count("failed"), states[5]) == (STYLES - 1, 1, "failed")
    batch = look(database, job)
    assert (batch.state, batch.progress) == ("failed", 1.0)
    assert counted(database, PolicyVersion) == STYLES - 1 == len({row for _, row, _ in after} - {None})
    assert {part.state for part in parts_of(database, job)} == {"succeeded"}
    with database.reading() as session:
        trained = session.scalars(select(Event.object_id).where(Event.action == "train")).all()
    assert len(trained) == len(set(trained)) == STYLES - 1


@pytest.mark.parametrize("database", ["sqlite", pytest.param("postgresql", marks=pytest.mark.nightly)], indirect=True)
def test_a_batch_cancelled_in_the_middle_keeps_what_was_done_and_adds_nothing(database: Database):
    add_styles(database, STYLES)
    job = ask_retraining(database, learner=SLOW)
    with workers(database, 2):
        until(lambda: done(database, job) >= 2, PATIENCE_S)
        with database.writing() as session:
            jobs.cancel(session, job.id, "test")
        kept = counted(database, PolicyVersion)
        quick = ask_retraining(database, surgeon="surgeon-0")  # the workers are at work on something else by now
        until(lambda: look(database, quick).ended_at, PATIENCE_S)
        assert look(database, quick).state == "succeeded"
    assert set(states_of(database, job)) == {"done", "cancelled"}
    assert (look(database, job).state, done(database, job)) == ("cancelled", kept)
    with database.reading() as session:
        learners = session.scalars(select(PolicyVersion.manifest)).all()
    assert sum(one["settings"].get("episodes") == SLOW.episodes for one in learners) == kept
