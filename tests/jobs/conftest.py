from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.backends import BACKENDS, blank, drop
from tests.jobs.house import House


@pytest.fixture(scope="module", params=BACKENDS)
def house(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """Yield an installation with one worker, on either database."""
    folder = tmp_path_factory.mktemp("house")
    url = blank(request.param, folder)
    yield from _lived_in(url, folder)
    drop(url)


@pytest.fixture
def empty_house(tmp_path: Path) -> Iterator[House]:
    """Yield an installation without workers, on SQLite."""
    house = House(f"sqlite:///{tmp_path / 'skills.sqlite'}", tmp_path)
    yield house
    house.close()


def _lived_in(url: str, folder: Path) -> Iterator[House]:
    house = House(url, folder)
    with house.workers(1):
        yield house
    house.close()
