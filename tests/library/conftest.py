from collections.abc import Iterator
from pathlib import Path

import pytest

from skills.db.session import Database
from tests import backends
from tests.library import cases


@pytest.fixture(params=backends.BACKENDS)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """Yield a new database with the catalogue and kestrel, on either back end."""
    url = backends.fresh(request.param, tmp_path)
    database = Database(url)
    cases.add_surgeon(database)
    yield database
    database.close()
    backends.drop(url)
