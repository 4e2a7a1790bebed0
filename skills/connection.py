"""Where the commands find the service: at an address, or in this very process."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

from skills.client import Client
from skills.settings import Settings


@contextmanager
def connect(settings: Settings, *, works: bool = False) -> Iterator[Client]:
    """Connect to the service of the settings: at SKILLS_SERVER, else to the application in this process.

    In-process, jobs need a worker: `works` starts one for as long as the connection is open.
    """
    if settings.server:
        shown = "" if settings.api_key is None else settings.api_key.get_secret_value()
        with Client(settings.server, api_key=shown) as client:
            yield client
        return
    from starlette.testclient import TestClient

    from skills.api.app import create_app
    from skills.serving import working

    app = create_app(settings)
    key = {"X-API-Key": app.state.access.own_key}  # whoever runs this has the database in their hands anyway
    in_process = TestClient(app, base_url="http://localhost", headers=key)
    with in_process as http, working(settings) if works else nullcontext():
        yield Client(http)
