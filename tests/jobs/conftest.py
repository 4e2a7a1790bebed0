from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.backends import BACKENDS, blank, drop
from tests.jobs.house import House

ON_BOTH_BY_DAY = {"test_one_worker"}  # the life of a request; what follows from it runs on PostgreSQL at night


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        here = item.path.parent == Path(__file__).parent and item.path.stem not in ON_BOTH_BY_DAY
        if here and "house" in getattr(item, "fixturenames", ()) and "postgresql" in item.name:
            item.add_marker(pytest.mark.nightly)


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
