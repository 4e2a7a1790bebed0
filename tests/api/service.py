"""The application in this process, its typed client, and a stand-in for the worker."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2 as httpx
from pydantic import BaseModel
from sqlalchemy import select, text
from starlette.testclient import TestClient

from skills.api.app import create_app
from skills.client import Client, Retrying
from skills.db import Base
from skills.db.service_tables import Job
from skills.library.operation.jobs import BATCH, PART
from skills.settings import Settings
from tests import backends
from tests.api.conformance import conformance
from tests.library import cases

KESTREL = {"surgeon": "kestrel", "suture": cases.SUTURE}
POLICY = f"/policies/kestrel/{cases.SUTURE}"
CSV, MCAP = "text/csv", "application/vnd.mcap"
GOAL_MM = [5.0, 55.0, -125.0]


class AsSent(Client):
    """The client, which returns the JSON of a response as it was sent, after parsing it as any client does."""

    def _read(self, kind: type[BaseModel], said: Any) -> Any:
        kind.model_validate(said)
        return said

    def wait(self, job: dict[str, Any], **_how: Any) -> dict[str, Any]:
        """Return a job that `Service.work` has carried out: there is no worker to wait for."""
        return self.job(job["id"])


class Service:
    """One installation: `http` sends raw requests, `client` makes typed calls."""

    def __init__(self, url: str, **settings: Any) -> None:
        self.url = url
        self.app = create_app(Settings(database_url=url, **settings))
        self.database = self.app.state.database
        self.http = TestClient(self.app, base_url="http://localhost", raise_server_exceptions=False)
        self.http.event_hooks["response"].append(conformance().check)
        self.client = AsSent(self.http, retrying=Retrying(attempts=1))

    def work(self) -> list[dict[str, Any]]:
        """Carry out all waiting jobs as a worker does, and return them."""
        with self.database.reading() as session:
            active = Job.state.in_(("queued", "running")), Job.kind != BATCH  # a batch's parts are what a worker takes
            jobs = session.scalars(select(Job).where(*active)).all()
        done = [cases.work(self.database, job) for job in jobs]
        return [self.client.job(job.id) for job in done if job.kind != PART]

    def train(self, **asked: Any) -> dict[str, Any]:
        """Train kestrel's style, and return the job."""
        job = self.client.train(**KESTREL, **asked)
        self.work()
        return self.client.job(job["id"])

    def counts(self) -> dict[str, int]:
        """Count the rows of every table."""
        with self.database.reading() as session:
            return {t: session.scalar(text(f"SELECT count(*) FROM {t}")) for t in Base.metadata.tables}

    def tamper(self, *statements: str, **values: Any) -> None:
        """Change rows as somebody with write access to the file would, bypassing the triggers."""
        with self.database.writing() as session:
            names = "SELECT name FROM sqlite_master WHERE type = 'trigger'"
            for name in session.scalars(text(names)).all():
                session.execute(text(f"DROP TRIGGER {name}"))
            for statement in statements:
                session.execute(text(statement), values)


@contextmanager
def serving(url: str, **settings: Any) -> Iterator[Service]:
    service = Service(url, **settings)
    with service.http:
        yield service


def copy_of_trained(folder: Path) -> str:
    """Copy a database in which kestrel's style is learnt and released; it is built once in a run."""
    shutil.copy(backends.template("trained", _train), folder / "skills.sqlite")
    return f"sqlite:///{folder / 'skills.sqlite'}"


def _train(url: str) -> None:
    with serving(url) as service:
        service.client.put_surgeon("kestrel", skill_level="expert")
        service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
        job = service.train(release=True)
        assert job["result"]["released"], job


def assert_problem(answer: httpx.Response, status: int | range, kind: str | None = None) -> dict[str, Any]:
    """Assert that the response is an RFC 9457 problem with a sentence, without details of our implementation."""
    assert answer.status_code == status if isinstance(status, int) else answer.status_code in status, answer.text[:500]
    assert answer.headers["content-type"] == "application/problem+json", answer.text[:500]
    assert answer.headers["x-request-id"]
    problem = answer.json()
    assert problem["status"] == answer.status_code
    assert problem["type"].startswith("urn:suture-skills:")
    assert problem["title"]
    assert problem["detail"].rstrip().endswith((".", "?", ")")), problem["detail"]
    assert not any(word in answer.text for word in ("Traceback", "sqlalchemy", "site-packages", "SELECT ", 'File "'))
    if kind is not None:
        assert problem["type"] == f"urn:suture-skills:{kind}", problem
    return problem
