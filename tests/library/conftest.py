from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from skills.db.session import Database
from tests import backends
from tests.library import cases


@pytest.fixture(params=backends.BACKENDS)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """Yield a new database with the catalogue and kestrel, on either back end."""
    with backends.opened(backends.copy_of("kestrels", _add_kestrel, request.param, tmp_path)) as database:
        yield database


def _add_kestrel(url: str) -> None:
    with closing(Database(url)) as database:
        database.migrate()
        cases.add_surgeon(database)
