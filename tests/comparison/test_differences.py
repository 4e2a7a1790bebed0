"""Parts in which two shapes differ, by hand."""

import numpy as np
import pytest

from skills.comparison.distances import difference


def along(states: int) -> np.ndarray:
    return np.linspace(0.0, 1.0, states)[:, None] * np.array([300.0, 0.0, 0.0])


def test_a_hump_in_the_last_third_is_found_there_with_its_sign():
    reference = along(30)
    shape = reference.copy()
    shape[22:28, 2] += 4.0
    found = difference(shape, reference)
    assert found.where == ("last third", "upwards")
    assert found.total == pytest.approx(24.0)
    assert found.offsets[2, 2] == pytest.approx(2.4)
    assert found.shares[2, 2] == pytest.approx(1.0)
    assert found.shares.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(found.along, shape - reference)
    assert difference(reference, shape).offsets[2, 2] == pytest.approx(-2.4)


def test_a_shift_sideways_is_everywhere():
    found = difference(along(12) - np.array([0.0, 2.0, 0.0]), along(12))
    assert found.where[1] == "sideways"
    np.testing.assert_allclose(found.offsets[:, 1], -2.0)
    np.testing.assert_allclose(found.shares[:, 1], 1 / 3)


def test_nothing_differs_from_itself():
    found = difference(along(9), along(9))
    assert found.total == 0.0
    assert not found.offsets.any()
    assert not found.shares.any()


def test_where_they_cross_neither_lies_further():
    reference = along(30)
    shape = reference.copy()
    shape[10:15, 1], shape[15:20, 1] = 3.0, -3.0
    found = difference(shape, reference)
    assert found.where == ("middle third", "sideways")
    share, offset, size = found.most
    assert (share, offset, size) == (pytest.approx(1.0), pytest.approx(0.0), pytest.approx(3.0))
    assert found.direction is None
    assert difference(reference + np.array([0, 0, 1.0]), reference).direction == "higher"
    assert difference(reference, reference + np.array([0, 1.0, 0])).direction == "further right"
