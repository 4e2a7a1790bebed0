"""The policy cache: every process serves the current release only, on both databases."""

import gc
import threading
import time
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import httpx2 as httpx
import numpy as np
import pytest
from sqlalchemy import text

from skills.api.encoded_policies import FORMATS, NPZ
from skills.api.responses import JSON, Body, negotiate
from skills.db.changes import APPLICATION, BOUND_S
from skills.db.session import Database
from skills.db.weighted_cache import WeightedCache
from skills.errors import UnknownFormat
from skills.library.operation import integrity
from skills.library.people.keys import create_key
from skills.library.people.surgeons import put_surgeon
from skills.schemas.people import SurgeonIn
from tests import backends
from tests.api.processes import learn_two_versions, server
from tests.api.service import CSV, KESTREL, POLICY, Service, assert_problem, serving
from tests.library import cases
from tests.waiting import END_S, until

RELEASE = f"{POLICY}/release"
BY_DAY_S, AT_NIGHT_S = 0.4, 10.0  # of changes and readers as fast as they can


@dataclass(frozen=True)
class Pair:
    """An application in this process and a server on one database, in which kestrel's style has two versions."""

    url: str
    one: httpx.Client
    other: httpx.Client

    @property
    def on_sqlite(self) -> bool:
        return self.url.startswith("sqlite")

    def settle(self, version: int | None) -> float:
        """Wait until the other server serves a version, None for no version; return how long it did not, in seconds.

        SQLite needs no wait; on PostgreSQL the wait must not exceed the bound.
        """
        began = time.monotonic()
        while (found := served(self.other)) != version:
            asked = time.monotonic()
            assert not self.on_sqlite, f"{found} was served after {version} was acknowledged"
            assert asked - began < BOUND_S + 1.0
        return time.monotonic() - began

    def cut(self) -> None:
        """Cut the connections on which PostgreSQL notifies the servers of changes."""
        database = Database(self.url)
        with database.writing() as session:
            lines = text(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
                "WHERE application_name = :name AND datname = current_database()"
            )
            session.execute(lines, {"name": APPLICATION})
        database.close()


@pytest.fixture(scope="module", params=backends.BACKENDS)
def pair(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    url = backends.copy_of("two_versions", learn_two_versions, request.param, tmp_path_factory.mktemp("pair"))
    with serving(url) as service, server(url) as other:
        seeing(service)
        yield Pair(url, service.http, other)
    backends.drop(url)


def served(client: httpx.Client) -> int | None:
    """Return the version that is served, None if there is none."""
    answer = client.get(POLICY)
    assert answer.status_code in (200, 404)
    return answer.json()["version"] if answer.status_code == 200 else None


def release(client: httpx.Client, version: int) -> None:
    assert client.post(f"{POLICY}/versions/{version}/release").status_code == 200


def test_a_release_or_withdrawal_in_one_process_takes_effect_in_another(pair: Pair):
    for version in (1, 2, 1):
        release(pair.one, version)
        pair.settle(version)
        assert served(pair.one) == version, "what a process has acknowledged, it serves"
        assert pair.one.delete(RELEASE).status_code == 204
        assert served(pair.one) is None
        pair.settle(None)


@pytest.mark.parametrize("pair", ["postgresql"], indirect=True)
def test_also_while_the_line_that_tells_of_changes_is_cut(pair: Pair):
    release(pair.one, 1)
    pair.settle(1)
    over = threading.Event()

    def cut() -> None:
        while not over.wait(0.05):
            pair.cut()

    pair.cut()
    cutting = threading.Thread(target=cut)
    cutting.start()
    try:
        for version in (2, 1, 2):
            release(pair.one, version)
            pair.settle(version)
            assert pair.one.delete(RELEASE).status_code == 204
            pair.settle(None)
    finally:
        over.set()
        cutting.join()


# ---- load


@dataclass(frozen=True)
class Told:
    """A change of the served version: possibly visible from its request on, certainly from its acknowledgement on."""

    version: int | None
    asked: float
    acknowledged: float


@dataclass(frozen=True)
class Seen:
    """One response to a reader."""

    version: int | None
    asked: float
    given: float


def staleness_s(seen: Seen, told: list[Told]) -> float:
    """Return how long the response had been outdated at its request, in s; 0 if it may have been valid meanwhile."""
    late = []
    for one, following in zip(told, [*told[1:], None], strict=True):
        over = float("inf") if following is None else following.acknowledged
        if one.version == seen.version and one.asked <= seen.given:
            late.append(max(0.0, seen.asked - over))
    return min(late)


def test_staleness_counts_from_the_acknowledgement_of_the_next_change():
    told = [Told(1, 0, 1), Told(None, 4, 5), Told(2, 8, 9)]
    given = [(1, 2, 3), (1, 4.9, 6), (1, 6, 7), (None, 4.5, 4.6), (None, 10, 11), (2, 8.1, 8.2), (2, 20, 21)]
    assert [staleness_s(Seen(*one), told) for one in given] == [0, 0, 1, 0, 1, 0, 0]


@pytest.mark.parametrize("hammered_s", [BY_DAY_S, pytest.param(AT_NIGHT_S, marks=pytest.mark.nightly)])
def test_under_load_nothing_is_served_after_its_end_is_acknowledged(pair: Pair, hammered_s: float):
    release(pair.one, 1)
    pair.settle(1)
    began = time.monotonic()
    told = [Told(1, began, began)]
    seen: list[Seen] = []
    over = threading.Event()

    def read() -> None:
        with httpx.Client(base_url=pair.other.base_url, timeout=END_S) as client:
            while not over.is_set():
                asked = time.monotonic()
                version = served(client)
                seen.append(Seen(version, asked, time.monotonic()))

    readers = [threading.Thread(target=read) for _ in range(3)]
    for reader in readers:
        reader.start()
    try:
        while (passed_s := time.monotonic() - began) < hammered_s or {one.version for one in seen} != {1, 2, None}:
            assert passed_s < END_S
            for version in (2, 1, None, 1):
                asked = time.monotonic()
                if version is None:
                    assert pair.one.delete(RELEASE).status_code == 204
                else:
                    release(pair.one, version)
                told.append(Told(version, asked, time.monotonic()))
                time.sleep(0.01)
    finally:
        over.set()
        for reader in readers:
            reader.join()
    late = max(staleness_s(one, told) for one in seen)
    print(f"{pair.url.partition(':')[0]}: {len(seen)} answers, {len(told)} changes, at most {late * 1e3:.2f} ms late")
    assert late == 0 if pair.on_sqlite else late < BOUND_S


# ---- the cache


def test_a_service_serves_what_it_has_just_released_on_postgresql_too(tmp_path: Path):
    url = backends.copy_of("two_versions", learn_two_versions, "postgresql", tmp_path)
    with serving(url) as service:
        seeing(service)
        for version in (2, 1) * 5:
            release(service.http, version)
            assert served(service.http) == version
            assert service.http.delete(RELEASE).status_code == 204
            assert served(service.http) is None
    backends.drop(url)


@pytest.mark.parametrize("backend", backends.BACKENDS)
def test_erased_policies_leave_all_processes_memory_without_a_request(backend: str, tmp_path: Path):
    url = backends.copy_of("two_versions", learn_two_versions, backend, tmp_path)
    with serving(url) as service, serving(url) as other:
        seeing(service)
        sha256 = service.client.policy(**KESTREL)["sha256"]
        bodies = [weakref.ref(read_and_kept(service, kind)) for kind in (JSON, NPZ)]
        assert all(body() is not None for body in bodies)
        assert sha256 in integrity.remembered()
        other.client.erase_surgeon("kestrel")
        assert_problem(service.http.get(f"/policy-versions/{sha256}"), 404)
        until(lambda: gc.collect() >= 0 and not any(body() for body in bodies))
        until(lambda: sha256 not in integrity.remembered())
        assert_problem(service.http.get(POLICY), 410)
    backends.drop(url)


def seeing(service: Service) -> None:
    """Wait until a service receives the changes of its database."""
    until(lambda: version(service) is not None)


def version(service: Service) -> int | None:
    return service.http.portal.call(service.app.state.served.changes.version)


def read_and_kept(service: Service, kind: str) -> Body:
    """Request a policy, and return its cached body."""
    assert service.http.get(POLICY, headers={"Accept": kind}).status_code == 200
    body = service.http.portal.call(service.app.state.served.cached, *KESTREL.values(), kind)
    assert body is not None
    return body


def test_a_policy_learnt_again_after_an_erasure_gets_its_own_dates(trained: Service):
    before = trained.client.policy(**KESTREL)
    rows = trained.counts()["releases"]
    demo = trained.client.demos()[0]["id"]
    assert trained.http.delete(f"/demos/{demo}?erase=true").status_code == 204
    assert_problem(trained.http.get(POLICY), 404)
    trained.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    assert trained.train(release=True)["result"]["released"]
    after = trained.client.policy(**KESTREL)
    assert (after["sha256"], trained.counts()["releases"]) == (before["sha256"], rows)
    assert after["released_at"] > before["released_at"]
    assert (before["version"], after["version"]) == (1, 2)
    assert trained.http.get(f"{POLICY}/versions/2").json()["created_at"] == after["created_at"] > before["created_at"]


def test_a_verified_policy_is_served_by_digest_and_a_damaged_one_refused(trained: Service):
    before = trained.http.get(POLICY)
    trained.tamper("UPDATE policy_versions SET learnt = x'00'")
    assert trained.http.get(POLICY).content == before.content
    integrity.forget(integrity.remembered())
    with serving(trained.url) as started_later:
        assert_problem(started_later.http.get(POLICY), 503, "corrupt")


def test_what_is_kept_is_bounded_by_its_bytes():
    kept: WeightedCache[int, bytes] = WeightedCache(100, len)
    for number in range(10):
        kept.put(number, bytes(30))
    assert [key for key, _ in kept.items()] == [7, 8, 9]
    kept.get(7)
    kept.put(8, bytes(60))
    assert [key for key, _ in kept.items()] == [7, 8]
    kept.put(11, bytes(101))
    assert kept.get(11) is None
    kept.forget([8, 12])
    kept.put(13, bytes(70))
    assert [key for key, _ in kept.items()] == [7, 13]
    kept.put(13, bytes(101))
    assert kept.get(13) is None, "an older value must not outlive one that is too heavy"


def test_a_list_of_what_is_kept_marks_nothing_as_used():
    kept: WeightedCache[str, int] = WeightedCache(2)
    kept.put("first", 1)
    kept.put("second", 2)
    kept.get("first")
    assert len(kept.items()) == 2
    kept.put("third", 3)
    assert kept.get("first") == 1 and kept.get("second") is None


def test_threads_may_share_what_is_kept():
    kept: WeightedCache[int, bytes] = WeightedCache(100, len)

    def use(seed: int) -> None:
        rng = np.random.default_rng(seed)
        for number in rng.integers(0, 12, 3000).tolist():
            kept.put(number, bytes(1 + number))
            kept.get(number + 1)
            kept.items()
            kept.forget([number + 2])

    with ThreadPoolExecutor(8) as threads:
        list(threads.map(use, range(8)))  # raises what a thread raised
    assert sum(len(value) for _, value in kept.items()) <= 100


# ---- database queries


def test_the_short_way_and_the_long_one_give_the_same_answers(trained: Service):
    tag = trained.http.get(POLICY).headers["etag"]
    asked = [
        {},
        {"Accept": NPZ},
        {"Accept": f"{JSON};q=0.5, {NPZ}"},
        {"Accept": "text/html, application/*;q=0.1"},
        {"If-None-Match": tag},
        {"If-None-Match": f"W/{tag}"},
        {"If-None-Match": '"other", *'},
        {"If-None-Match": '"other"'},
    ]
    for headers in asked:
        for method in ("GET", "HEAD"):
            cold = Service(trained.url)  # not started, so that it queries everything
            answers = [one.http.request(method, POLICY, headers=headers) for one in (cold, trained, trained)]
            given = [(one.status_code, one.content, told(one)) for one in answers]
            assert given[0] == given[1] == given[2], headers
            assert (given[0][0] == 304) == (headers.get("If-None-Match", '"other"') != '"other"')
            assert bool(given[0][1]) == (method == "GET" and given[0][0] == 200)


def told(answer: httpx.Response) -> dict[str, str]:
    return {name: value for name, value in answer.headers.items() if name != "x-request-id"}


def test_a_client_that_wants_other_bytes_than_there_are_gets_none(trained: Service):
    tag = trained.http.get(POLICY).headers["etag"]
    for path in (POLICY, f"{POLICY}/versions/1"):
        its = trained.http.get(path).headers["etag"]
        for match in (its, "*", f'"other", {its}'):
            assert trained.http.get(path, headers={"If-Match": match}).status_code == 200
        assert_problem(trained.http.get(path, headers={"If-Match": '"other"'}), 412, "precondition-failed")
    trained.train(seed=2, release=True)
    assert_problem(trained.http.get(POLICY, headers={"If-Match": tag}), 412)


@pytest.mark.parametrize(
    ("accept", "given"),
    [
        ("*/*", JSON),
        (NPZ, NPZ),
        (f"{NPZ}, {JSON}", NPZ),
        (f"{JSON}, {NPZ}", JSON),
        (f"{JSON};q=0.2, {NPZ};q=0.3", NPZ),
        (f"{NPZ};q=0, */*", JSON),
        (f"TEXT/html, {NPZ.upper()}; q=0.001", NPZ),
        ("text/html", None),
        (f"{JSON};q=0", None),
        ("", None),
    ],
)
def test_the_format_is_what_the_client_weighs_most(accept: str, given: str | None):
    if given is None:
        with pytest.raises(UnknownFormat):
            negotiate(accept, *FORMATS)
    else:
        assert negotiate(accept, *FORMATS) == given


def test_a_cached_policy_is_not_given_to_whoever_may_not_see_it(trained: Service):
    assert served(trained.http) == 1
    with trained.database.writing() as session:
        put_surgeon(session, "heron", SurgeonIn(), "test")
        session.flush()
        keys = {who: create_key(session, who, "reader", "test", surgeons=[who])[1] for who in ("kestrel", "heron")}
    trained.app.state.access.forget()
    for headers, status in (
        ({"X-API-Key": keys["kestrel"]}, 200),
        ({"X-API-Key": keys["heron"]}, 404),
        ({"X-API-Key": "nobody's"}, 401),
        ({}, 401),
    ):
        for kind in (JSON, NPZ):
            assert trained.http.get(POLICY, headers={"Accept": kind, **headers}).status_code == status


def test_a_served_policy_is_counted_by_its_route_however_it_was_found(trained: Service):
    for _ in range(3):
        trained.http.get(POLICY)
    counted = 'skills_request_seconds_count{method="GET",route="/policies/{surgeon}/{suture}",status="200"} 3.0'
    assert counted in trained.http.get("/metrics").text


# ---- notifications


def test_whatever_changes_what_is_served_is_told_on_postgresql(tmp_path: Path):
    """Each change is made as another process would: this process sees its own commits without a notification."""
    url = backends.copy_of("two_versions", learn_two_versions, "postgresql", tmp_path)
    with serving(url) as service, serving(url) as other:
        demo = other.client.demos()[0]["id"]
        seeing(service)

        def learn() -> None:
            other.client.add_demo(cases.hand_off((5.0, 5.0, 0.0)), media_type=CSV, **KESTREL)
            assert other.train(release=True)["result"]["released"]

        for work in (
            lambda: other.client.release(**KESTREL, version=2),
            lambda: other.client.withdraw(**KESTREL),
            lambda: other.client.release(**KESTREL, version=1),
            lambda: other.client.withdraw_demo(demo),
            learn,
            lambda: other.client.withdraw_demo(demo, erase=True),
            lambda: other.client.erase_surgeon("kestrel"),
        ):
            before = version(service)
            work()
            until(lambda before=before: version(service) not in (None, before))
    backends.drop(url)
