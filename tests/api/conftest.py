from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import backends
from tests.api.service import Service, copy_of_trained, serving


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    """A service without surgeons."""
    with serving(backends.fresh("sqlite", tmp_path)) as service:
        yield service


@pytest.fixture
def trained(tmp_path: Path) -> Iterator[Service]:
    """A service in which kestrel's style is learnt and released, to be changed."""
    with serving(copy_of_trained(tmp_path)) as service:
        yield service


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """The same, only to be read."""
    with serving(copy_of_trained(tmp_path_factory.mktemp("still"))) as service:
        yield service
