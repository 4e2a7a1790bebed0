"""The connection of a command to the service, or to the application in its own process, and waiting for jobs there."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from typing import TYPE_CHECKING

from skills.cli.output import job_status

if TYPE_CHECKING:
    from skills.client import Client
    from skills.db.session import Database
    from skills.schemas.operation import Job
    from skills.settings import Settings

WAIT_S = 3600.0  # ours: a training takes seconds, with thousands of states at most an hour
MANY = 64  # workers for a batch: as many as the settings say, which allow no more


@contextmanager
def service(*, workers: int = 0) -> Iterator["Client"]:
    """Connect to the service, or to the application in this process with up to a number of workers (`connect`)."""
    from skills.settings import settings

    with connect(settings(), workers=workers) as client:
        yield client


@contextmanager
def connect(settings: "Settings", *, workers: int = 0) -> Iterator["Client"]:
    """Connect to the service at SKILLS_SERVER, or else to the application in this process.

    In-process, a single job is performed in a thread (`InProcess`). For the parts of a batch as many workers as the
    settings say, but not more than `workers`, run while the connection is open.
    """
    from skills.client import Client

    if settings.server:
        shown = "" if settings.api_key is None else settings.api_key.get_secret_value()
        with Client(settings.server, api_key=shown) as client:
            yield client
        return
    from starlette.testclient import TestClient

    from skills.api.app import create_app
    from skills.jobs import Engine
    from skills.jobs.in_process import InProcess

    alone = workers == 1 <= settings.workers
    with _crew(settings, workers):  # first, because workers are forks, and the application has threads
        app = create_app(settings, by_path=True, engine=InProcess if alone else Engine)
        # no check of a key is needed: the caller has access to the database anyway
        key = {"X-API-Key": app.state.access.own_key}
        with TestClient(app, base_url="http://localhost", headers=key) as http:
            try:
                yield Client(http)
            finally:
                if settings.erasures_file is not None:
                    from skills.library.operation.erasure_list import keep_up_erasures

                    keep_up_erasures(app.state.database, settings.erasures_file)


def _crew(settings: "Settings", workers: int) -> AbstractContextManager[None]:
    if workers < 2:
        return nullcontext()
    from skills.serving import working

    return working(settings.model_copy(update={"workers": min(workers, settings.workers)}))


@contextmanager
def installation(*, patience_ms: int | None = None) -> Iterator["Database"]:
    """Open the database of this installation."""
    from skills.db.session import Database
    from skills.settings import settings

    with closing(Database(settings().database_url, patience_ms=patience_ms)) as database:
        yield database


def finished(client: "Client", job: "Job", timeout_s: float = WAIT_S) -> "Job":
    """Wait for a job, with a status line on stderr."""
    with job_status(job) as update:
        return client.wait(job, timeout_s, progress=update)
