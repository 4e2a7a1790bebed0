"""Hand-offs: the needle between the jaws, and the turn of A2."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import BadInput, ImproperRotation, NoApproach
from skills.kinematics import POINTING_DOWN, check_rotation, matrix_of
from skills.planning.handoff import HELD_MM, NEEDLE_RADIUS_MM, TAKEN_MM, hand_off, realign, turn
from tests.by_day import examples

NUMBERS = st.floats(-1, 1)


def test_a_case_worked_by_hand():
    # PSM_A points down with its hinge along +y; PSM_M comes along -y, so the needle's free end points to +y.
    approach = np.array([0.0, -1.0, 0.0])
    rotation = realign(POINTING_DOWN, approach).rotation
    tip, jaws = hand_off(np.zeros((1, 3)), rotation[None], approach)
    # Held 9 mm below the hinge; a quarter circle further is one radius along +y and one across, along a_M x a_A = +x.
    assert np.allclose(tip[0] + TAKEN_MM * approach, [NEEDLE_RADIUS_MM, NEEDLE_RADIUS_MM, -HELD_MM])
    assert np.allclose(jaws[0, :, 2], approach)
    assert np.allclose(jaws[0, :, 0], [1, 0, 0])


@given(st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS), st.tuples(NUMBERS, NUMBERS, NUMBERS))
def test_psm_m_holds_a_needle_that_runs_along_its_hinge(turned, approach):
    approach = np.array(approach)
    if np.linalg.norm(turned) < 0.1 or np.linalg.norm(approach) < 0.1:
        return
    rotation = realign(matrix_of([turned])[0], approach).rotation
    tip, jaws = hand_off([[10.0, 50.0, -120.0]], rotation[None], approach)
    check_rotation(jaws)
    a_m, n_m = jaws[0, :, 2], jaws[0, :, 0]
    assert np.allclose(a_m, approach / np.linalg.norm(approach))
    # Both grips lie on one circle in the plane normal to PSM_A's approach, whose tangents there are n_A and n_M.
    held = np.array([10.0, 50.0, -120.0]) + HELD_MM * rotation[:, 2]
    taken = tip[0] + TAKEN_MM * a_m
    centre = held + NEEDLE_RADIUS_MM * n_m
    assert abs((taken - held) @ rotation[:, 2]) < 1e-9
    assert np.isclose(np.linalg.norm(taken - centre), NEEDLE_RADIUS_MM)
    assert abs((taken - centre) @ n_m) < 1e-9 and abs((held - centre) @ rotation[:, 0]) < 1e-9


PSM_M = np.array([-0.94, 0.10, -0.33]) / np.linalg.norm([-0.94, 0.10, -0.33])

numbers = st.floats(-1.0, 1.0, allow_nan=False)
vectors = st.tuples(numbers, numbers, numbers).map(np.array).filter(lambda v: np.linalg.norm(v) > 1e-3)
rotations = (
    st.tuples(numbers, numbers, numbers, numbers)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
    .map(lambda q: matrix_of(q[None])[0])
)


def assert_aligned(rotation: np.ndarray, approach_m: np.ndarray) -> None:
    a_m = approach_m / np.linalg.norm(approach_m)
    n, _, a = rotation.T
    assert np.abs(np.cross(n, a_m)).max() < 1e-12  # n parallel to a_M
    assert abs(a @ a_m) < 1e-12  # orthogonal approach
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)


@examples(150)
@given(rotation=rotations, approach_m=vectors, toward=st.none() | vectors)
def test_any_jaw_ends_with_n_along_the_other_arms_approach(rotation, approach_m, toward):
    found = realign(rotation, approach_m, toward)
    assert_aligned(found.rotation, approach_m)
    assert 0.0 <= found.angle_rad <= np.pi
    np.testing.assert_allclose(turn(rotation, found.rotation, [1.0])[0], found.rotation, atol=1e-12)


@pytest.mark.parametrize("sign", [1, -1])
def test_an_approach_along_the_other_arms_is_still_aligned(sign):
    found = realign(POINTING_DOWN, sign * POINTING_DOWN[:, 2])
    assert_aligned(found.rotation, POINTING_DOWN[:, 2])
    assert np.degrees(found.angle_rad) <= 120.0 + 1e-9


def test_the_turn_worked_by_hand_is_86_degrees():
    found = realign(POINTING_DOWN, PSM_M)
    assert np.degrees(found.angle_rad) == pytest.approx(85.7, abs=0.05)
    assert found.sign == 1


def test_of_two_equal_turns_the_positive_sign_is_taken():
    o = POINTING_DOWN[:, 1]
    assert realign(POINTING_DOWN, o).sign == 1  # n turns to o or to -o, a quarter either way


def test_of_two_unequal_turns_the_smaller_is_taken():
    n, _, a = POINTING_DOWN.T
    assert realign(POINTING_DOWN, n).angle_rad == 0.0
    assert realign(POINTING_DOWN, -n).sign == -1  # n is already parallel to it, in the opposite direction
    swapped = realign(POINTING_DOWN, a, toward=n)  # n and a swap places: 90 degrees, or 120 with the other sign
    assert (swapped.sign, np.degrees(swapped.angle_rad)) == (-1, pytest.approx(90.0))


def test_the_new_approach_follows_the_direction_to_the_other_tip():
    found = realign(POINTING_DOWN, [1.0, 0.0, 0.0], toward=[0.5, 1.0, 0.0])
    np.testing.assert_allclose(found.rotation[:, 2], [0.0, 1.0, 0.0], atol=1e-12)


def test_a_jaw_that_is_aligned_already_does_not_turn():
    first = realign(POINTING_DOWN, PSM_M)
    again = realign(first.rotation, PSM_M)
    assert again.angle_rad < 1e-7
    np.testing.assert_allclose(turn(first.rotation, again.rotation, [0, 0.5, 1]), [first.rotation] * 3, atol=1e-7)


def test_a_half_turn_takes_one_and_the_same_way_each_time():
    upside_down = POINTING_DOWN @ np.diag([1.0, -1.0, -1.0])
    way = turn(POINTING_DOWN, upside_down, np.linspace(0, 1, 5))
    np.testing.assert_allclose(way[-1], upside_down, atol=1e-12)
    np.testing.assert_array_equal(way, turn(POINTING_DOWN, upside_down, np.linspace(0, 1, 5)))
    np.testing.assert_allclose(way[2].T @ way[2], np.eye(3), atol=1e-12)


def test_a_direction_without_length_and_numbers_that_are_none_are_refused():
    with pytest.raises(NoApproach):
        realign(POINTING_DOWN, [0.0, 0.0, 0.0])
    with pytest.raises(BadInput, match="NaN"):
        realign(POINTING_DOWN, [np.nan, 0.0, 1.0])
    with pytest.raises(ImproperRotation):
        realign(np.ones((3, 3)), PSM_M)
