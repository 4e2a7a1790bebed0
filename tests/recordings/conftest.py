"""What is timed here is reading, and not loading the compiled loops, which a service does once when it starts."""

import pytest

from skills.recordings.confined import get_ready


@pytest.fixture(scope="session", autouse=True)
def _loops_are_loaded() -> None:
    get_ready()
