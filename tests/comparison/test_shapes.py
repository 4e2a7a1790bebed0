"""Aligned motions: place, rotation about the vertical, tempo and size make no difference."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skills.comparison.distances import STATES, VERSION, distances, in_lengths, placed, resampled, shape_of
from skills.errors import BadPath
from tests.comparison.cohort import demo_of

HUMPS_MM = np.array([[3.0, 6.0], [1.0, -2.0], [0.0, 1.0]])
PINNED_MM = [[10.769038, 2.972388, 2.66079], [22.036847, 3.008288, 4.690078], [33.111112, 1.089212, 6.643578]]


def test_a_quarter_circle_worked_by_hand():
    angle = np.linspace(0.0, np.pi / 2, 2001)
    path = np.stack([10 * np.sin(angle), np.zeros_like(angle), 10 * (1 - np.cos(angle))], axis=1)
    shape = placed(resampled(path, 3))  # its start, the middle of its path, its goal
    half, long = 10 * (np.sqrt(2.0) - 1.0) / np.sqrt(2.0), 10 * np.sqrt(2.0)
    np.testing.assert_allclose(shape, [[0, 0, 0], [long / 2, 0, -(10 - long / 2)], [long, 0, 0]], atol=1e-4)
    assert half == pytest.approx(10 - long / 2)


@settings(deadline=None)  # the first call compiles
@given(st.floats(-np.pi, np.pi), st.tuples(*[st.floats(-50, 50)] * 3), st.floats(1.5, 6.0), st.floats(0.3, 3.0))
def test_place_turn_tempo_and_size_say_nothing(turn_rad, place_mm, duration_s, size):
    plain = demo_of(HUMPS_MM, 0.0, np.zeros(3), 3.0)
    moved = demo_of(HUMPS_MM, turn_rad, np.array(place_mm), duration_s)
    assert distances([shape_of(plain)], [shape_of(moved)])[0, 0] / STATES < 0.1  # mm: the window smooths over time
    once, larger = resampled(plain.tip_mm), resampled(plain.tip_mm * size)
    np.testing.assert_allclose(placed(once, scaled=True), placed(larger, scaled=True), atol=1e-9)
    np.testing.assert_allclose(placed(once) * size, placed(larger), atol=1e-9)


def test_standing_still_and_sampling_say_nothing():
    way = np.linspace(0.0, 1.0, 50)[:, None] * np.array([30.0, 10.0, 5.0])
    rested = np.repeat(way, [20 if row == 25 else 1 + row % 3 for row in range(50)], axis=0)
    np.testing.assert_allclose(resampled(way), resampled(rested), atol=1e-9)


def test_a_shape_begins_at_the_origin_and_goes_along_x_with_z_upwards():
    shape = shape_of(demo_of(HUMPS_MM, 0.7, np.array([1.0, 2.0, -100.0]), 3.0))
    assert shape.shape == (STATES, 3)
    np.testing.assert_allclose(shape[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(shape[-1, 1:], 0.0, atol=1e-9)
    assert shape[-1, 0] > 35
    assert shape[STATES // 2, 2] > 3  # its largest hump points upwards


def test_straight_up_is_a_way_too_and_none_at_all_is_refused():
    up = np.linspace(0.0, 1.0, 20)[:, None] * np.array([0.0, 0.0, -30.0])
    np.testing.assert_allclose(placed(up)[-1], [30.0, 0.0, 0.0], atol=1e-12)
    around = np.array([[0.0, 0, 0], [20.0, 0, 0], [0.5, 0, 0]])
    with pytest.raises(BadPath, match=r"0\.50 mm"):
        placed(around)
    with pytest.raises(BadPath):
        placed(np.full((3, 3), np.nan))


def test_a_shape_in_lengths_is_the_scaled_one():
    demo = demo_of(HUMPS_MM, 0.7, np.array([1.0, 2.0, -100.0]), 3.0)
    np.testing.assert_allclose(in_lengths(shape_of(demo)), shape_of(demo, scaled=True), atol=1e-12)


def test_cached_shapes_have_a_version_that_is_raised_when_they_change():
    """A failure means that shapes differ from before: raise `distances.VERSION`, then update these numbers."""
    shape = shape_of(demo_of(HUMPS_MM, 0.7, np.array([1.0, 2.0, -100.0]), 3.0))
    assert VERSION == 2
    np.testing.assert_allclose(shape[[25, 50, 75]], PINNED_MM, atol=1e-6)
