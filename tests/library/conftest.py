from collections.abc import Iterator
from pathlib import Path

import pytest

from skills.db.session import Database
from tests import backends
from tests.library import cases

# Files whose SQL may behave differently on PostgreSQL. The other files run on it at night.
ON_BOTH_BY_DAY = {
    *("test_library", "test_erasing", "test_restoring", "test_consent", "test_batches", "test_outcomes"),
    *("test_parsed", "test_datasets"),
}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        here = item.path.parent == Path(__file__).parent and item.path.stem not in ON_BOTH_BY_DAY
        if here and "postgresql" in item.name:
            item.add_marker(pytest.mark.nightly)


@pytest.fixture(params=backends.BACKENDS)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """Yield a new database with the catalogue and kestrel, on either back end."""
    url = backends.fresh(request.param, tmp_path)
    database = Database(url)
    cases.add_surgeon(database)
    yield database
    database.close()
    backends.drop(url)
