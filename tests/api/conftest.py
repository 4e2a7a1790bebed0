from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import backends
from tests.api.keyed import copy_of_told
from tests.api.service import Service, copy_of_trained, serving


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    """Yield a service without surgeons."""
    with serving(backends.copy_of("served", _serve, "sqlite", tmp_path)) as service:
        yield service


def _serve(url: str) -> None:
    with serving(url):
        """It has stored the catalogue of suture types."""


@pytest.fixture
def here(service: Service) -> Service:
    """Return a service with the surgeon kestrel."""
    service.client.put_surgeon("kestrel")
    return service


@pytest.fixture
def trained(tmp_path: Path) -> Iterator[Service]:
    """Yield a service in which kestrel's style is learnt and released; the test may change it."""
    with serving(copy_of_trained(tmp_path)) as service:
        yield service


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """Yield the same service, shared between tests and read-only."""
    with serving(copy_of_trained(tmp_path_factory.mktemp("still"))) as service:
        yield service


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """Yield a service in which kestrel has everything up to a playback with pictures, and heron a demonstration."""
    with serving(copy_of_told(tmp_path_factory.mktemp("told"))) as service:
        yield service
