"""The logs: a line for each request and each job, with their ids, and no personal data."""

import inspect
import io
import json
import logging
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from skills import logs
from skills.client.blocking.client import Client
from skills.db.service_tables import Job
from skills.db.session import Database
from skills.demo import wait_until_ready
from skills.errors import BadInput
from skills.jobs import log_faults_alone
from skills.jobs.attempts import Work
from skills.jobs.worker import logged
from skills.settings import Settings
from tests import backends
from tests.api.service import CSV, Service, serving
from tests.e2e.conftest import Service as Processes
from tests.library import cases
from tests.waiting import END_S

CANARY = "canary-7f3a91"


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> Iterator[io.StringIO]:
    """Yield all that is logged in this process, as JSON."""
    out = io.StringIO()
    monkeypatch.setattr(sys, "stderr", out)
    root, ours = logging.getLogger(), logging.getLogger(logs.OURS)
    before = root.handlers[:], root.level, ours.level
    logs.configure("debug", as_json=True)
    yield out
    root.handlers[:], root.level, ours.level = before
    logging.getLogger("skills").setLevel(before[2])


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    with serving(backends.fresh("sqlite", tmp_path)) as service:
        yield service


def lines(said: io.StringIO) -> list[dict[str, Any]]:
    return [json.loads(line) for line in said.getvalue().splitlines()]


def test_a_line_has_its_moment_its_ids_and_its_fields(said: io.StringIO):
    logs.request_id.set("deadbeef")
    logs.log_fields(logging.getLogger("skills.test"), "request", status=200, ms=1.5)
    logs.request_id.set(None)
    (line,) = lines(said)
    assert line.pop("at").endswith("+00:00")
    expected = {"level": "info", "logger": "skills.test", "message": "request", "status": 200, "ms": 1.5}
    assert line == expected | {"request_id": "deadbeef"}


def test_a_job_that_is_cancelled_while_it_runs_is_no_error_of_the_engine(said: io.StringIO):
    from dbos import _core
    from dbos._error import DBOSAwaitedWorkflowCancelledError

    log_faults_alone()
    engine = logging.getLogger("dbos")
    for adopted in ("the owner's recorded outcome", "the recorded outcome"):
        assert f"Waiting for {adopted}" in inspect.getsource(_core)
        engine.warning(f"Workflow 9-1 is no longer owned by this execution. Waiting for {adopted}")
    for error in (DBOSAwaitedWorkflowCancelledError("9-1"), RuntimeError("x")):
        engine.error("Exception encountered in background workflow:", exc_info=error)
    assert [line["error"] for line in lines(said)] == ["RuntimeError"]


def test_as_text_it_is_a_line_too():
    record = logging.LogRecord("skills.test", logging.INFO, __file__, 1, "job %d\nended", (7,), None)
    record.fields = {"kind": "training", "seconds": 1.25}
    text = logs.Lines(as_json=False).format(record)
    assert text.endswith("info skills.test job 7 ended kind=training seconds=1.25")
    assert "\n" not in text


def test_exceptions_are_logged_by_class_and_place_without_their_messages(said: io.StringIO):
    try:
        try:
            raise ValueError(f"no such file: /srv/{CANARY}.mcap")
        except ValueError as error:
            raise RuntimeError(f"Key (slug)=({CANARY}) already exists") from error
    except RuntimeError:
        logging.getLogger("skills.test").exception("It failed.")
        logging.getLogger("uvicorn.error").exception("Exception in ASGI application\n")
    assert CANARY not in said.getvalue()
    for line in lines(said):
        assert (line["level"], line["error"], line["because_of"]) == ("error", "RuntimeError", ["ValueError"])
        assert line["raised_at"][0].startswith("tests.test_logs:")


def test_of_a_librarys_message_nothing_that_was_filled_in_is_told(said: io.StringIO):
    logging.getLogger("asyncio").error(f"Task exception was never retrieved\nfuture: <Task {CANARY}>")
    logging.getLogger("some.library").warning("cannot read %s", CANARY)
    logging.getLogger("some.library").info("not told at all")
    assert [line["message"] for line in lines(said)] == ["Task exception was never retrieved", "cannot read %s"]


def test_settings_choose_how_much_and_how(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SKILLS_LOG_LEVEL", "warning")
    monkeypatch.setenv("SKILLS_LOG_FORMAT", "json")
    assert (Settings().log_level, Settings().log_format) == ("warning", "json")
    monkeypatch.setenv("SKILLS_LOG_FORMAT", "xml")
    with pytest.raises(ValueError, match="log_format"):
        Settings()


def test_requests_are_logged_by_route_and_id_and_probes_at_debug_level(said: io.StringIO, service: Service):
    answer = service.http.get(f"/surgeons/{CANARY}", headers={"X-Request-ID": "4bf92f35-1"})
    service.http.get("/healthz")
    assert answer.headers["x-request-id"] == "4bf92f35-1"
    told = [line for line in lines(said) if line["logger"] == "skills.api.request"]
    assert [(line["route"], line["status"], line["level"]) for line in told] == [
        ("/surgeons/{surgeon}", 404, "info"),
        ("/healthz", 200, "debug"),
    ]
    assert told[0]["request_id"] == "4bf92f35-1"
    assert told[0]["ms"] > 0


def test_nobody_is_in_the_log_whatever_is_asked_and_however_it_fails(
    said: io.StringIO, service: Service, monkeypatch: pytest.MonkeyPatch
):
    http = service.http
    service.client.put_surgeon(CANARY)
    service.client.add_demo(cases.hand_off(), media_type=CSV, surgeon=CANARY, suture=cases.SUTURE, session=CANARY)
    for method, path, body in (
        ("GET", f"/surgeons/{CANARY}", None),
        ("GET", f"/policies/{CANARY}/simple-running", None),
        ("POST", "/trainings", {"surgeon": CANARY, "suture": CANARY}),
        ("POST", "/trainings", {"surgeon": CANARY, CANARY: CANARY}),
        ("PUT", f"/surgeons/{CANARY}?{CANARY}={CANARY}", {"skill_level": CANARY}),
        ("GET", f"/{CANARY}", None),
        ("POST", f"/demos?surgeon={CANARY}&suture={CANARY}", None),
        (CANARY.upper(), "/surgeons", None),
    ):
        http.request(method, path, json=body, headers={"X-Request-ID": CANARY, "User-Agent": CANARY})

    def fail(*_: object) -> None:
        raise RuntimeError(f"no such surgeon: {CANARY}")

    monkeypatch.setattr("skills.library.people.surgeons.find_surgeon", fail)
    assert http.get(f"/surgeons/{CANARY}").status_code == 500
    assert [line["error"] for line in lines(said) if "error" in line] == ["RuntimeError"]
    assert CANARY not in said.getvalue()
    assert len(lines(said)) >= 10


@pytest.mark.parametrize("error", [BadInput(f"no such surgeon: {CANARY}"), RuntimeError(f"/srv/{CANARY}.mcap")])
def test_a_failed_job_is_logged_by_its_id_kind_and_error_class(said: io.StringIO, service: Service, error: Exception):
    cases.add_surgeon(service.database)
    cases.add_demo(service.database)
    job = cases.ask_training(service.database)

    def fail(database: Database, row: int, attempt: int, settings: Settings) -> None:
        raise error

    Work(service.database, Settings(database_url=service.url), logged(fail)).try_once(job.row, job.attempt, 0)
    (told,) = [line for line in lines(said) if line["message"] == "job"]
    assert (told["kind"], told["attempt"], told["outcome"]) == ("training", 1, type(error).__name__)
    assert (told["job_id"], told["seconds"] >= 0) == (job.id, True)
    assert CANARY not in said.getvalue()


def test_a_job_that_succeeds_or_is_erased_on_the_way_is_told(said: io.StringIO, service: Service):
    cases.add_surgeon(service.database)
    cases.add_demo(service.database)
    job = cases.ask_training(service.database)

    def succeed(database: Database, row: int, attempt: int, settings: Settings) -> None:
        with database.writing() as session:
            session.get_one(Job, row).state = "succeeded"

    def erase(database: Database, row: int, attempt: int, settings: Settings) -> None:
        with database.writing() as session:
            session.delete(session.get_one(Job, row))

    for perform in (succeed, erase):
        logged(perform)(service.database, job.row, 1, Settings())
    logged(lambda *_: None)(service.database, job.row, 1, Settings())
    told = [line for line in lines(said) if line["message"] == "job"]
    assert [line["outcome"] for line in told] == ["succeeded", "erased", "erased"]
    assert [line.get("job_id") for line in told] == [job.id, job.id, None]


class Overheard(Processes):
    """A service whose log goes to a file."""

    def start(self) -> None:
        with self.database.with_name("log").open("ab") as log:
            self.process = subprocess.Popen(self.command, env=self.environment, stderr=log)
        with Client(self.url) as client:
            wait_until_ready(client, self.process)


@pytest.mark.nightly  # a service and its worker; by day requests and jobs are logged in this process
def test_the_real_service_logs_a_failed_job_without_naming_anybody(tmp_path: Path):
    service = Overheard(tmp_path, log_format="json", log_level="debug", job_attempts=1)
    service.start()
    try:
        with Client(service.url) as client:
            client.put_surgeon(CANARY)
            client.add_demo(cases.hand_off(), media_type=CSV, surgeon=CANARY, suture=cases.SUTURE)
            database = Database(f"sqlite:///{service.database}")
            with database.writing() as session:
                session.connection().exec_driver_sql("DELETE FROM reward_maps")  # so that training fails inside
            database.close()
            job = client.train(CANARY, cases.SUTURE)
            with pytest.raises(Exception, match="failed"):
                client.wait(job, timeout_s=END_S)
            client.erase_surgeon(CANARY)
    finally:
        assert service.stop() == 0
    text = (tmp_path / "log").read_text()
    assert CANARY not in text
    told = [json.loads(line) for line in text.splitlines()]
    (failed,) = [line for line in told if line["message"] == "job"]
    assert (failed["job_id"], failed["kind"]) == (job.id, "training")
    assert failed["outcome"] in [line["error"] for line in told if "error" in line]
    routes = {line["route"] for line in told if line["logger"] == "skills.api.request"}
    assert {"/surgeons/{surgeon}", "/demos", "/trainings", "/jobs/{job}", "/readyz"} <= routes
