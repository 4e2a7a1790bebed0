"""The pose in which PSM_M takes the needle."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from skills.kinematics import POINTING_DOWN, check_rotation, matrix_of
from skills.planning.handoff import HELD_MM, NEEDLE_RADIUS_MM, TAKEN_MM, hand_off, realign

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
