"""Compiled loops run beside the plain functions that they are compiled from."""

import warnings
from types import ModuleType

import numpy as np
import pytest


def run_both(monkeypatch: pytest.MonkeyPatch, module: ModuleType, *names: str) -> list[str]:
    """Replace loops of a module by ones that run compiled and plain, and compare all arrays and results.

    Returns:
        The names of the loops that ran and agreed, in order, filled later.
    """
    agreed: list[str] = []

    def both(name):
        loop = getattr(module, name)

        def run(*given):
            twins = [twin(one) for one in given]
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                plain = loop.plain(*twins)
            assert loop(*given) == plain
            assert [bits(one) for one in given] == [bits(one) for one in twins]
            agreed.append(name)
            return plain

        return run

    for name in names:
        monkeypatch.setattr(module, name, both(name))
    return agreed


def twin(given):
    """Return a copy of an array, or of a named tuple of arrays; anything else as it is."""
    if isinstance(given, tuple):
        return type(given)(*map(twin, given))
    return given.copy() if isinstance(given, np.ndarray) else given


def bits(given):
    return [bits(one) for one in given] if isinstance(given, tuple) else np.asarray(given).tobytes()
