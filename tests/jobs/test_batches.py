"""Batches with real workers that run the library: concurrent, killed midway, cancelled, with a damaged style."""

import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import func, select, text

from skills.db.models import PolicyVersion
from skills.db.service_tables import Event, Executor, Job
from skills.db.session import Database
from skills.learning.q_learning import CellQLearning
from skills.library.operation import jobs
from skills.serving import environment
from skills.settings import Settings
from tests import backends
from tests.jobs.house import ROOT
from tests.library.styles import add_styles, ask_retraining, counted, damage, look, parts_of, states_of, styles_of
from tests.waiting import until

SLOW = CellQLearning(episodes=1_500_000)  # a second or two of learning, so that a test can act midway
STYLES = 16
STOPPED_S = 2.0  # the other workers' transactions end within that time, or the stop is tried again


@pytest.fixture
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    with backends.opened(backends.fresh(request.param, tmp_path)) as database:
        yield database


@contextmanager
def workers(database: Database, number: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Yield real workers, ready; each is a process that takes one part at a time."""
    command = [sys.executable, "-m", "skills", "worker"]
    how = environment(Settings(database_url=database.url))
    started = [subprocess.Popen(command, cwd=ROOT, env=how, stderr=subprocess.DEVNULL) for _ in range(number)]
    try:
        until(lambda: counted(database, Executor) == number, by=started)
        yield started
    finally:
        for worker in started:
            worker.kill()
            worker.wait()


def stop_between_transactions(database: Database, worker: subprocess.Popen[bytes]) -> None:
    """Stop a worker outside of transactions, ours or the engine's: otherwise others would wait until it continues."""
    with closing(Database(Settings(database_url=database.url).engine_url)) as engine:
        while True:
            is_quiet(database, engine, until_s=1e9)  # on a busy machine a transaction is open most of the time
            worker.send_signal(signal.SIGSTOP)
            if is_quiet(database, engine):
                return
            worker.send_signal(signal.SIGCONT)


def is_quiet(*databases: Database, until_s: float = 0.0) -> bool:
    """Return whether all transactions from before a moment, so many seconds from now, end within `STOPPED_S`."""
    with databases[0].reading() as session:
        moment = session.scalar(select(func.now())) + timedelta(seconds=until_s)
    try:
        until(lambda: all(nothing_is_open(database, moment) for database in databases), STOPPED_S)
    except AssertionError:
        return False
    return True


def nothing_is_open(database: Database, since: datetime) -> bool:
    """Return whether all transactions from before a moment have ended; on SQLite, whether nobody is writing."""
    if database.engine.dialect.name == "postgresql":
        older = text(
            "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND backend_type = "
            "'client backend' AND pid <> pg_backend_pid() AND xact_start <= :since "
            # by which one of the engines tells that it does the rare work of all: it is open all the time
            "AND query NOT LIKE 'SELECT pg_try_advisory_xact_lock(%set_config%'"
        )
        with database.reading() as session:
            return session.scalar(older, {"since": since}) == 0
    with closing(sqlite3.connect(database.engine.url.database, timeout=0.1, isolation_level=None)) as connection:
        try:
            connection.execute("BEGIN IMMEDIATE")
        except sqlite3.OperationalError:
            return False
        return True


def done(database: Database, job: Job) -> int:
    return states_of(database, job).count("done")


@pytest.mark.nightly  # four processes; by day tests/library/test_batch_work.py, and test_one_worker takes over
@pytest.mark.parametrize("database", backends.BACKENDS, indirect=True)
def test_a_batch_survives_a_dead_worker_a_bad_style_and_eight_requests(database: Database):
    """Eight requests run at once.

    One style is damaged; a worker is killed, another stopped and continued past its lease.
    """
    add_styles(database, STYLES)
    with ThreadPoolExecutor(8) as pool:
        asked = list(pool.map(lambda _: ask_retraining(database, learner=SLOW), range(8)))
    assert len({job.row for job in asked}) == 1
    job = asked[0]
    damage(database, styles_of(database, job)[5].demonstration_row)
    with workers(database, 3) as (killed, stopped, _):
        until(lambda: done(database, job) >= 2)
        killed.kill()
        stop_between_transactions(database, stopped)
        assert look(database, job).state == "running"
        until(lambda: look(database, job).ended_at)
        before = [(style.state, style.policy_row, style.ended_at) for style in styles_of(database, job)]
        os.kill(stopped.pid, signal.SIGCONT)
        late = ask_retraining(database, only_stale=True, learner=SLOW)  # the damaged one, which it may take
        until(lambda: look(database, late).ended_at)
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


@pytest.mark.nightly  # by day batches are cancelled in tests/api, without workers
@pytest.mark.parametrize("database", backends.BACKENDS, indirect=True)
def test_a_batch_cancelled_midway_keeps_its_results_and_adds_none(database: Database):
    add_styles(database, STYLES)
    job = ask_retraining(database, learner=SLOW)
    with workers(database, 2):
        until(lambda: done(database, job) >= 2)
        with database.writing() as session:
            jobs.cancel(session, job.id, "test")
        kept = counted(database, PolicyVersion)
        quick = ask_retraining(database, surgeon="surgeon-0")  # the workers work on another job by now
        until(lambda: look(database, quick).ended_at)
        assert look(database, quick).state == "succeeded"
    assert set(states_of(database, job)) == {"done", "cancelled"}
    assert (look(database, job).state, done(database, job)) == ("cancelled", kept)
    with database.reading() as session:
        learners = session.scalars(select(PolicyVersion.manifest)).all()
    assert sum(one.settings.get("episodes") == SLOW.episodes for one in learners) == kept
