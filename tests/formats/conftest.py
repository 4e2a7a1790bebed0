"""Compilation before the tests: their timings are of reading, without loading compiled loops, as in a service."""

import pytest

from skills.formats.reader_process import ConfinedReader, get_ready
from skills.sandbox.forked import ForkServer
from tests.formats.confined import on


@pytest.fixture(scope="session", autouse=True)
def _loops_are_loaded() -> None:
    get_ready()


@pytest.fixture(scope="module")
def reader(reading_server: ForkServer) -> ConfinedReader:
    """A reader for one call at a time, with generous limits."""
    reading_server.start()
    return on(reading_server)
