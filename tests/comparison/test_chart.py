"""The chart: exact if the distances fit into a plane, and with its quality reported otherwise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.comparison.distances import MANY, chart


def apart(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points[None, :], axis=2)


@given(st.integers(0, 500), st.integers(2, 30))
def test_what_lies_in_a_plane_keeps_all_its_distances(seed, size):
    points = np.random.default_rng(seed).normal(0, 10, (size, 2))
    places, right = chart(apart(points))
    np.testing.assert_allclose(apart(places), apart(points), atol=1e-5)
    np.testing.assert_allclose(places.mean(axis=0), 0.0, atol=1e-9)
    assert right == pytest.approx(1.0, abs=1e-6)


def test_many_are_placed_as_few_are_and_always_alike(monkeypatch):
    points = np.random.default_rng(3).normal(0, 1, (MANY + 20, 5)) * [9, 5, 2, 1, 1]
    places, right = chart(apart(points))
    assert (chart(apart(points))[0] == places).all()
    monkeypatch.setattr("skills.comparison.distances.MANY", 1000)
    few, the_same = chart(apart(points))
    np.testing.assert_allclose(places, few, atol=1e-7)
    assert right == pytest.approx(the_same)


def test_the_corners_of_a_cube_are_not_all_shown():
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    assert 0.5 < chart(apart(corners))[1] < 0.9


def test_one_and_equal_ones_have_places_too():
    assert chart(np.zeros((1, 1))) == (pytest.approx(np.zeros((1, 2))), 1.0)
    places, right = chart(np.zeros((4, 4)))
    assert not places.any() and right == 1.0
