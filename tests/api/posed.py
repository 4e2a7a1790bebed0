"""An installation with a pose style."""

from pathlib import Path

from tests import backends
from tests.api.service import KESTREL, MCAP, serving
from tests.library.test_pose_styles import both_arms, turning


def of_pose_style(backend: str, folder: Path) -> str:
    """Copy a database in which kestrel's pose style has a released version, and one that is not; return its URL."""
    return backends.copy_of("posed", _learn, backend, folder)


def of_both_arms(backend: str, folder: Path) -> str:
    """Copy a database in which kestrel's pose style is released with the other arm's motion; return its URL."""
    return backends.copy_of("both_arms", _learn_both, backend, folder)


def _learn_both(url: str) -> None:
    with serving(url) as service:
        service.client.put_surgeon("kestrel")
        service.client.add_demo(both_arms(), media_type=MCAP, **KESTREL, arm="PSM2", segment="whole")
        job = service.train(release=True)
        assert job["result"]["released"], job["result"]


def _learn(url: str) -> None:
    with serving(url) as service:
        service.client.put_surgeon("kestrel")
        service.client.add_demo(turning(), media_type=MCAP, **KESTREL)
        job = service.train(release=True)
        assert job["result"]["released"], job["result"]
        service.train(seed=2)
