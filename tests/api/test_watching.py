"""Watching jobs over a real connection: revoked access ends the stream, heartbeats arrive, watchers share one query."""

import re
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import httpx2 as httpx
import pytest
import uvicorn
from sqlalchemy import event
from sqlalchemy.exc import InternalError

from skills.db.session import Database
from skills.library.people.keys import create_key, revoke_key
from tests import backends
from tests.api.service import Service
from tests.library import cases

PATIENCE_S = 60.0


@pytest.fixture(params=backends.BACKENDS)
def asked(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Service, str, str]]:
    """Yield a service on loopback with a waiting job: the service, its address and the path of the job's events."""
    url = backends.fresh(request.param, tmp_path)
    service = Service(url, heartbeat_s=0.3, key_watchers=3)
    with closing(Database(url)) as database:
        cases.add_surgeon(database)
        cases.add_demo(database)
        job = cases.ask_training(database)
    server = uvicorn.Server(uvicorn.Config(service.app, port=0, log_level="critical", timeout_graceful_shutdown=1))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    yield service, f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}", f"/jobs/{job.id}/events"
    server.should_exit = True
    thread.join()
    backends.drop(url)


def test_a_revoked_key_is_told_no_more_and_signs_of_life_come_meanwhile(asked: tuple[Service, str, str]):
    service, address, path = asked
    with service.database.writing() as session:
        key, text = create_key(session, "anna", "reader", "local")
    with httpx.Client(base_url=address, headers={"X-API-Key": text}, timeout=PATIENCE_S) as http:
        lines, signs = [], 0
        with http.stream("GET", path) as answer:
            assert answer.status_code == 200
            for line in answer.iter_lines():
                lines.append(line)
                signs += line.startswith(":")
                if signs == 2:
                    with service.database.writing() as session:
                        revoke_key(session, key.id, "local")
                assert signs < PATIENCE_S / 0.3, "it goes on"
        assert lines[0] == "event: job"
        assert http.get("/surgeons").status_code == 401


def test_a_key_watches_so_many_jobs_at_once(asked: tuple[Service, str, str]):
    service, address, path = asked
    with service.database.writing() as session:
        _, text = create_key(session, "anna", "reader", "local")
    with httpx.Client(base_url=address, headers={"X-API-Key": text}, timeout=PATIENCE_S) as http:
        streams = [http.send(http.build_request("GET", path), stream=True) for _ in range(4)]
        assert [one.status_code for one in streams] == [200, 200, 200, 429]
        streams[0].close()
        deadline = time.monotonic() + PATIENCE_S
        while (again := http.send(http.build_request("GET", path), stream=True)).status_code == 429:
            again.close()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        for one in (*streams, again):
            one.close()


def looks_of(service: Service, http: httpx.Client, path: str, watchers: int, seconds: float) -> tuple[int, float]:
    """Count a service's transactions while a number of clients watch a job; return also for how many seconds."""
    streams = [http.send(http.build_request("GET", path), stream=True) for _ in range(watchers)]
    begun: list[object] = []
    count = begun.append
    event.listen(service.database.engine, "begin", count)
    since = time.monotonic()
    time.sleep(seconds)
    counted, lasted_s = len(begun), time.monotonic() - since  # on a busy machine it sleeps longer
    event.remove(service.database.engine, "begin", count)
    for one in streams:
        one.close()
    return counted, lasted_s


def test_fifty_watchers_cost_no_more_looks_than_one(asked: tuple[Service, str, str]):
    service, address, path = asked
    limits = httpx.Limits(max_connections=None)
    with httpx.Client(base_url=address, timeout=PATIENCE_S, limits=limits) as http:
        looks, lasted_s = looks_of(service, http, path, 50, 2.0)
    assert looks <= 7.5 * lasted_s, looks  # five a second from watching on PostgreSQL, and the sweep of the cache


def test_a_look_that_fails_does_not_end_the_looks_for_all(asked: tuple[Service, str, str]):
    service, address, path = asked
    failed: list[object] = []

    def fail(*_: object) -> None:
        failed.append(None)
        raise InternalError("SELECT", {}, Exception("not one of those that are translated"))

    with httpx.Client(base_url=address, timeout=PATIENCE_S) as http, http.stream("GET", path) as answer:
        lines, since = answer.iter_lines(), time.monotonic()
        assert next(lines) == "event: job"
        event.listen(service.database.engine, "before_cursor_execute", fail)
        with closing(Database(service.database.url)) as database:
            cases.add_surgeon(database, "wren")  # a commit, which is looked at
        while not failed:
            time.sleep(0.01)
        event.remove(service.database.engine, "before_cursor_execute", fail)
        assert httpx.delete(address + path.removesuffix("/events"), timeout=PATIENCE_S).status_code == 200
        for line in lines:
            assert time.monotonic() < since + PATIENCE_S, "it goes on, without the change"
            if '"state":"cancelled"' in line:
                return
        raise AssertionError("it ended without the change")


def test_a_change_is_told_to_all_who_watch(asked: tuple[Service, str, str]):
    _, address, path = asked
    found: list[str] = []
    with httpx.Client(base_url=address, timeout=PATIENCE_S) as http:
        threads = [threading.Thread(target=lambda: found.append(http.get(path).text)) for _ in range(3)]
        for one in threads:
            one.start()
        assert http.delete(path.removesuffix("/events")).status_code == 200
        for one in threads:
            one.join()
    assert [re.findall('"state":"([a-z]+)"', text)[-1] for text in found] == ["cancelled"] * 3
