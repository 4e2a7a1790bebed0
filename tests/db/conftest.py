from collections.abc import Iterator
from pathlib import Path

import pytest

from skills.db.session import Database
from tests import backends


@pytest.fixture(params=backends.BACKENDS)
def url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """Yield the URL of a new migrated database, on either back end."""
    url = backends.fresh(request.param, tmp_path)
    yield url
    backends.drop(url)


@pytest.fixture
def database(url: str) -> Iterator[Database]:
    database = Database(url)
    yield database
    database.close()
