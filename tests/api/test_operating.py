"""Operation: readiness under real failures, metrics without personal data, request ids."""

import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import select, update

from skills.client import Client, Retrying
from skills.db import now
from skills.db.models import Demonstration
from skills.db.service_tables import Executor, Job
from skills.db.session import Database
from skills.errors import NotReady
from skills.jobs import refuse_left_over
from skills.jobs.readiness import refuse_unready
from skills.sandbox.containment import LAYERS
from skills.sandbox.forked import layers_held
from skills.serving import _load
from skills.settings import Settings
from tests import backends
from tests.api.conformance import conformance
from tests.api.service import KESTREL, POLICY, Service, assert_problem, serving
from tests.jobs.house import House
from tests.waiting import END_S, crowded, until

CANARY = "canary-7f3a91"
LEASE_S, SHORT_S = END_S, 0.5  # a heartbeat that the test writes once lasts for the test; a silence is waited for


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    """Yield an installation with a worker on PostgreSQL; tests/e2e covers SQLite."""
    url = backends.blank("postgresql", tmp_path)
    house = House(url, tmp_path)
    with house.workers(1):
        yield house
    house.close()
    backends.drop(url)


@pytest.fixture
def installation(tmp_path: Path) -> Settings:
    """Return settings of a SQLite database with an engine database and a heartbeat: all that readiness needs."""
    settings = Settings(database_url=backends.fresh("sqlite", tmp_path), lease_s=LEASE_S)
    with sqlite3.connect(engine_file(settings)) as connection:
        connection.execute("CREATE TABLE workflow_status (workflow_uuid TEXT)")
    beat(settings)
    return settings


def engine_file(settings: Settings) -> Path:
    return Path(settings.engine_url.removeprefix("sqlite:///"))


def database_file(settings: Settings) -> Path:
    return Path(settings.database_url.removeprefix("sqlite:///"))


def beat(settings: Settings, **late: float) -> None:
    """Write a heartbeat as a worker would, with a clock that may be off."""
    with closing(Database(settings.database_url)) as database, database.writing() as session:
        session.merge(Executor(id="one", beat_at=now() - timedelta(**late)))


@pytest.mark.nightly  # a worker; by day tests/e2e/test_service.py waits for it to be ready
def test_with_a_database_a_queue_and_a_worker_it_is_ready(house: House):
    assert refuse_unready(house.settings) == 1
    with serving(house.settings.database_url) as service:
        containment = {name: name in layers_held() for name in LAYERS}
        ready = {"status": "ready", "workers": 1, "containment": containment}
        assert service.http.get("/readyz").json() == ready
    with pytest.raises(NotReady, match="another state of this database"):
        refuse_left_over(house.settings)


def test_a_signing_key_that_is_missing_or_unreadable_is_named(installation: Settings, tmp_path: Path):
    key = tmp_path / "signing.key"
    settings = installation.model_copy(update={"signing_key": key})
    for content, why in ((None, "is missing"), (b"PRIVATE", "not a signing key"), (b"\xff", "cannot be read")):
        if content is not None:
            key.write_bytes(content)
        with pytest.raises(NotReady, match=why):
            refuse_unready(settings)
    key.write_text(installation.signing_key.read_text())
    with serving(installation.database_url, signing_key=key) as service:
        key.unlink()
        problem = assert_problem(service.http.get("/readyz"), 503, "not-ready")
    assert "The signing key is missing" in problem["detail"]
    assert str(tmp_path) not in problem["detail"]
    assert "SKILLS_SIGNING_KEY" in problem["detail"]


def test_samples_that_cannot_be_loaded_are_told_in_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def refuse(*_: object) -> None:
        raise NotReady("The signing key is missing.")

    monkeypatch.setattr("skills.serving.load_samples", refuse)  # only a service that was damaged refuses them
    _load(Settings(), "")
    assert capsys.readouterr().out == (
        "Some samples are not loaded or trained:\n  the service: The signing key is missing.\n"
    )


def test_a_sample_that_is_refused_leaves_the_others_to_be_trained(
    service: Service, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    service.client.put_surgeon("heron")
    service.client.erase_surgeon("heron")  # so it can never be added again
    service.client.put_surgeon("wren")
    train = Client.train

    def refuse_wren(client: Client, surgeon: str, suture: str, **how: bool) -> object:
        if surgeon == "wren":
            raise NotReady("The queue cannot be used.")
        return train(client, surgeon, suture, **how)

    monkeypatch.setattr(Client, "train", refuse_wren)
    monkeypatch.setattr("skills.serving.Client", lambda *_, **__: Client(service.http, retrying=Retrying(attempts=1)))
    _load(Settings(), "")
    said = capsys.readouterr().out
    assert said.startswith("Some samples are not loaded or trained:\n  heron: ")
    assert "was erased" in said
    assert "  wren, " in said
    assert "The queue cannot be used." in said
    with service.database.reading() as session:
        assert {demo.surgeon.slug for demo in session.scalars(select(Demonstration))} == {"kestrel", "plover", "wren"}
        assert {job.request["surgeon"] for job in session.scalars(select(Job))} == {"kestrel", "plover"}


def test_what_is_not_ready_is_a_problem_with_a_name(service: Service):
    problem = assert_problem(service.http.get("/readyz"), 503, "not-ready")
    assert "The job engine's database does not exist" in problem["detail"]
    assert service.http.get("/healthz").status_code == 200


def statement(settings: Settings, *statements: str) -> None:
    with sqlite3.connect(database_file(settings)) as connection:
        for one in statements:
            connection.execute(one)


def make_folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


NO_DATABASE = b"not a database " * 1000
DAMAGED: dict[str, tuple[Callable[[Settings], object], str]] = {
    "missing": (lambda s: database_file(s).unlink(), "The database does not exist"),
    "replaced": (lambda s: database_file(s).write_bytes(NO_DATABASE), "The database cannot be read and written"),
    "empty": (
        lambda s: database_file(s).write_bytes(b""),
        "has no tables yet. Ask the operator of the service to migrate",
    ),
    "folder": (lambda s: make_folder(database_file(s)), "The database does not exist"),
    "other version": (
        lambda s: statement(s, "UPDATE alembic_version SET version_num = '9999'"),
        "is of another version; use the code that made it",
    ),
    "tables": (
        lambda s: statement(s, "PRAGMA foreign_keys=OFF", "DROP TABLE suture_types"),
        "The database cannot be read and written",
    ),
    "engine missing": (lambda s: engine_file(s).unlink(), "The job engine's database does not exist"),
    "engine replaced": (lambda s: engine_file(s).write_bytes(NO_DATABASE), "The job engine's database cannot be used"),
    "engine empty": (lambda s: engine_file(s).write_bytes(b""), "The job engine's database cannot be used"),
    "silent worker": (lambda s: beat(s, hours=1), "No worker has renewed its lease"),
    "no worker": (lambda s: statement(s, "DELETE FROM executors"), "No worker has renewed its lease"),
}


@pytest.mark.parametrize(("damage", "said"), DAMAGED.values(), ids=DAMAGED)
def test_every_part_that_cannot_be_used_is_told_in_time(installation: Settings, damage: Any, said: str):
    assert refuse_unready(installation) == 1
    damage(installation)
    before = sorted(database_file(installation).parent.iterdir())
    began = time.monotonic()
    with pytest.raises(NotReady, match=said):
        refuse_unready(installation.model_copy(update={"lease_s": SHORT_S}))
    assert time.monotonic() - began < 5 * crowded()
    assert sorted(one for one in before if one.suffix == ".sqlite") == sorted(
        one for one in database_file(installation).parent.iterdir() if one.suffix == ".sqlite"
    )


def test_a_database_that_somebody_else_has_locked_is_not_ready_and_then_is(installation: Settings):
    with closing(sqlite3.connect(database_file(installation), isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        began = time.monotonic()
        with pytest.raises(NotReady, match="cannot be read and written"):
            refuse_unready(installation)
        assert time.monotonic() - began < 5 * crowded()
        other.execute("ROLLBACK")
    beat(installation)
    assert refuse_unready(installation) == 1


def test_a_worker_whose_clock_is_an_hour_off_is_known_by_its_beats(installation: Settings):
    over = threading.Event()

    def work() -> None:
        while not over.wait(0.1):
            beat(installation, hours=1)

    beat(installation, hours=1)
    worker = threading.Thread(target=work)
    worker.start()
    try:
        assert refuse_unready(installation) == 1
    finally:
        over.set()
        worker.join()


@pytest.mark.nightly  # by day tests/jobs/test_restarts.py stops a server
def test_a_server_that_was_stopped_makes_it_unready_and_comes_back():
    server = backends.new_server()
    service = Service(server.get_uri(driver="psycopg"))
    with service.http as http:
        assert_problem(http.get("/readyz"), 503, "not-ready")
        assert figures(http.get("/metrics").text)["skills_database_up"] == 1
        server.stop()
        began = time.monotonic()
        problem = assert_problem(http.get("/readyz"), 503, "not-ready")
        assert problem["detail"].startswith("The database cannot be read and written")
        assert figures(http.get("/metrics").text)["skills_database_up"] == 0
        assert_problem(http.get("/surgeons"), 503)
        assert time.monotonic() - began < 10 * crowded()
        server.start()
        assert "job engine" in assert_problem(http.get("/readyz"), 503, "not-ready")["detail"]
        assert figures(http.get("/metrics").text)["skills_database_up"] == 1
        assert http.get("/surgeons").status_code == 200
    server.cleanup()


# ---- metrics -------------------------------------------------------------------------------------------------------


def figures(scraped: str) -> dict[str, float]:
    """Parse scraped metrics as Prometheus does: each sample by its name and labels."""
    return {
        one.name + "".join(f",{name}={value}" for name, value in sorted(one.labels.items())): one.value
        for family in text_string_to_metric_families(scraped)
        for one in family.samples
    }


def test_applications_share_the_routes_that_were_analysed_once(service: Service, still: Service):
    """Analysing them again would cost the first request of each application 90 ms."""
    same = {id(route) for route in service.app.routes} & {id(route) for route in still.app.routes}
    shared = {getattr(route, "path", "") for route in service.app.routes if id(route) in same}
    assert shared >= {*conformance().document["paths"]}


def test_requests_are_counted_by_route_method_and_status(trained: Service):
    before = figures(trained.http.get("/metrics").text)
    for _ in range(3):
        trained.http.get(POLICY)
    trained.http.get("/policies/nobody/simple-running")
    trained.http.get(f"/no/such/{CANARY}")
    trained.http.request(CANARY.upper(), POLICY)
    after = figures(trained.http.get("/metrics").text)
    counted = "skills_request_seconds_count,method={},route={},status={}".format
    route = "/policies/{surgeon}/{suture}"
    assert after[counted("GET", route, 200)] - before.get(counted("GET", route, 200), 0) == 3
    assert after[counted("GET", route, 404)] == 1
    assert after[counted("GET", "none", 404)] == 1
    assert after[counted("other", route, 405)] == 1
    assert after[f"skills_request_seconds_sum,method=GET,route={route},status=200"] > 0


def test_jobs_workers_and_the_database_have_their_figures(trained: Service):
    trained.client.train(**KESTREL, seed=1)
    trained.train(seed=2)
    trained.client.train(**KESTREL, seed=3)
    with trained.database.writing() as session:
        session.execute(update(Job).where(Job.state == "queued").values(created_at=now() - timedelta(minutes=5)))
        session.add(Executor(id="lives"))
        session.add(Executor(id="silent", beat_at=now() - timedelta(minutes=1)))
    found = figures(trained.http.get("/metrics").text)
    assert found["skills_jobs,kind=training,state=succeeded"] == 3
    assert found["skills_jobs,kind=training,state=queued"] == 1
    assert 300 <= found["skills_oldest_queued_seconds"] < 320
    assert (
        0
        < found["skills_job_seconds,kind=training,quantile=0.5"]
        <= found["skills_job_seconds,kind=training,quantile=1.0"]
    )
    assert found["skills_workers"] == 1
    assert found["skills_database_bytes"] >= Path(trained.url.removeprefix("sqlite:///")).stat().st_size
    assert abs(found["skills_last_event_timestamp_seconds"] - time.time()) < 60
    assert found["skills_database_connections_open"] >= 1
    assert any(name.startswith("skills_build_info") for name in found)
    assert found["process_open_fds"] > 0


def test_of_many_jobs_a_scrape_has_the_number_of_the_one_before(trained: Service, monkeypatch: pytest.MonkeyPatch):
    def succeeded() -> float:
        return figures(trained.http.get("/metrics").text)["skills_jobs,kind=training,state=succeeded"]

    first = succeeded()
    monkeypatch.setattr("skills.api.metrics.MANY_JOBS", 1)
    assert succeeded() == first
    trained.train(seed=2)
    assert succeeded() == first  # and counts again, in a thread
    until(lambda: succeeded() == first + 1)
    monkeypatch.undo()
    trained.train(seed=3)
    until(lambda: succeeded() == first + 2)


def test_an_installation_without_jobs_has_figures_too(service: Service):
    found = figures(service.http.get("/metrics").text)
    assert (found["skills_database_up"], found["skills_workers"], found["skills_oldest_queued_seconds"]) == (1, 0, 0)


def test_nobody_is_named_in_the_figures(service: Service):
    service.client.put_surgeon(CANARY)
    asked = (
        ("GET", f"/surgeons/{CANARY}"),
        ("GET", f"/policies/{CANARY}/simple-running"),
        ("PUT", f"/{CANARY}"),
        ("GET", f"/surgeons/{CANARY}/"),
        ("DELETE", f"/surgeons/{CANARY}"),
    )
    for method, path in asked:
        service.http.request(method, path)
    assert CANARY not in service.http.get("/metrics").text


def test_the_figures_are_read_on_either_database(tmp_path: Path):
    url = backends.fresh("postgresql", tmp_path)
    with serving(url) as service:
        service.client.put_surgeon("heron")
        found = figures(service.http.get("/metrics").text)
        assert found["skills_database_bytes"] > 1e6
    service.database.close()
    backends.drop(url)


# ---- request ids ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", ["4bf92f3577b34da6a3ce929d0e0e4736", "9f8b2c1d-0000-4000-8000-123456789abc"])
def test_a_request_keeps_the_id_that_its_caller_gave_it(still: Service, given: str):
    assert still.http.get("/healthz", headers={"X-Request-ID": given}).headers["x-request-id"] == given


@pytest.mark.parametrize(
    "given", ["", CANARY, "short", "x" * 32, "a" * 65, "4bf92f35 77b3", "4bf92f35\u00e9", "DEADBEEF"]
)
def test_what_could_be_anything_else_is_replaced(still: Service, given: str):
    answers = [still.http.get("/healthz", headers={"X-Request-ID": given.encode("latin-1")}) for _ in range(2)]
    ids = {answer.headers["x-request-id"] for answer in answers}
    assert len(ids) == 2
    assert all(len(one) == 16 and int(one, 16) >= 0 for one in ids)
