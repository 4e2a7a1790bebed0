from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
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


@pytest.fixture
def empty(tmp_path: Path) -> Iterator[Callable[[str], Database]]:
    """Yield a function that creates databases without tables, on one back end or the other."""
    with ExitStack() as made:
        yield lambda backend: made.enter_context(backends.opened(backends.blank(backend, tmp_path)))


def _add_kestrel(url: str) -> None:
    with closing(Database(url)) as database:
        database.migrate()
        cases.add_surgeon(database)
