"""Compilation before the tests: their timings are of reading, without loading compiled loops, as in a service."""

import pytest

from skills.formats.reader_process import get_ready


@pytest.fixture(scope="session", autouse=True)
def _loops_are_loaded() -> None:
    get_ready()
