"""An installation with a pose style."""

import shutil
from pathlib import Path

from tests import backends
from tests.api.service import KESTREL, MCAP, serving
from tests.library.test_pose_styles import turning


def of_pose_style(backend: str, folder: Path) -> str:
    """Return the URL of a database in which kestrel's pose style has a released version, and one that is not.

    On SQLite it is a copy; the first one is created once in a run.
    """
    if backend == "sqlite":
        shutil.copy(backends.template("posed", _learn), folder / "posed.sqlite")
        return f"sqlite:///{folder / 'posed.sqlite'}"
    url = backends.fresh(backend, folder)
    _learn(url)
    return url


def _learn(url: str) -> None:
    with serving(url) as service:
        service.client.put_surgeon("kestrel")
        service.client.add_demo(turning(), media_type=MCAP, **KESTREL)
        job = service.train(release=True)
        assert job["result"]["released"], job["result"]
        service.train(seed=2)
