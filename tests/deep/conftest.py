import pytest

from tests.needs import need


@pytest.fixture(scope="session")
def extra() -> None:
    """Skip if the deep learners are not installed."""
    need("deep")
