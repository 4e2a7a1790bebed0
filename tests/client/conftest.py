from tests.api.conftest import still, trained

__all__ = ["still", "trained"]
