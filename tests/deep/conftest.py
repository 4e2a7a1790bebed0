from importlib.util import find_spec

import pytest

from skills.deep.learning import NEEDED


@pytest.fixture(scope="session")
def extra() -> None:
    """What learns with networks, or a loud skip."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        pytest.skip("THE EXTRA 'deep' IS NOT INSTALLED: no learner beyond the table was tried (`make deep`)")
