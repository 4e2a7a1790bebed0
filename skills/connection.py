"""Connection of the commands to a service: at an address, or in this process."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

from skills.client import Client
from skills.settings import Settings


@contextmanager
def connect(settings: Settings, *, works: bool = False) -> Iterator[Client]:
    """Connect to the service at SKILLS_SERVER, or else to the application in this process.

    In-process, jobs need a worker: `works` runs one while the connection is open.
    """
    if settings.server:
        shown = "" if settings.api_key is None else settings.api_key.get_secret_value()
        with Client(settings.server, api_key=shown) as client:
            yield client
        return
    from starlette.testclient import TestClient

    from skills.api.app import create_app
    from skills.library.backup import keep_up_erasures
    from skills.serving import working

    app = create_app(settings)
    # no check of a key is needed: the caller has access to the database anyway
    key = {"X-API-Key": app.state.access.own_key}
    in_process = TestClient(app, base_url="http://localhost", headers=key)
    with in_process as http, working(settings) if works else nullcontext():
        try:
            yield Client(http)
        finally:
            if settings.erasures_file is not None:
                keep_up_erasures(app.state.database, settings.erasures_file)
