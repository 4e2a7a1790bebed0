"""An installation with keys and the data of two surgeons, and requests under the key of one user."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2 as httpx
from fastapi.routing import iter_route_contexts

from skills.library.people.keys import create_key
from skills.seeds.recordings import sample_recordings
from tests import backends
from tests.api.service import CSV, GOAL_MM, KESTREL, MCAP, Service, serving
from tests.library import cases

HERON = {"surgeon": "heron", "suture": cases.SUTURE}


def key(service: Service, owner: str, role: Any, **how: Any) -> str:
    """Create a key, as the installation's command line does."""
    with service.database.writing() as session:
        text = create_key(session, owner, role, "local", **how)[1]
    service.app.state.access.forget()
    return text


class As:
    """A user with a key, who sends requests with it."""

    def __init__(self, service: Service, text: str) -> None:
        self._http = service.http
        self._headers = {"X-API-Key": text}

    def __call__(self, method: str, path: str, **how: Any) -> httpx.Response:
        return self._http.request(method, path, headers=self._headers | how.pop("headers", {}), **how)


def routes(service: Service) -> Iterator[tuple[str, str, list[Any]]]:
    """List every route: method, path and its dependencies."""
    for route in iter_route_contexts(service.app.routes):
        for method in sorted((route.methods or set()) - {"HEAD"}):
            yield method, str(route.path), list(getattr(route, "dependencies", None) or [])


def copy_of_told(folder: Path) -> str:
    """Copy a database in which kestrel has everything up to a playback with pictures, and heron a demonstration."""
    shutil.copy(backends.template("told", _tell), folder / "skills.sqlite")
    return f"sqlite:///{folder / 'skills.sqlite'}"


def _tell(url: str) -> None:
    with serving(url) as service:
        client = service.client
        client.put_surgeon("kestrel", skill_level="expert")
        client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
        client.put_surgeon("heron")
        bag = next(sample.data for sample in sample_recordings() if sample.surgeon == "heron")
        client.add_demo(bag, media_type=MCAP, **HERON)
        client.retrain(surgeon="kestrel", release=True)
        service.work()
        client.train(**KESTREL, learner={"kind": "value-iteration"}, release=True)
        service.work()
        plan = client.plan(**KESTREL, suture_points=[{"position_mm": GOAL_MM}], handoff="none", tissue_mm=-170.0)
        client.play(plan["sha256"])
        service.work()
