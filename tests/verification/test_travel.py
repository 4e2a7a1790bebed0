"""Bounds between two looks: how far links can have moved, compared with the closed form of their ends."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as some

from skills.kinematics import CLASSIC, forward
from skills.verification.clearance import Bounds, travel_mm
from skills.verification.playback import link_pairs
from tests.planning.motions import small_trajectory


def finger_ends(joints: np.ndarray) -> np.ndarray:
    """Return points all over both fingers' caps, shape (T, K, 3)."""
    tip, rotation = forward(joints)
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    opened = [np.array([0.0, side * (0.6 + 9.1 * np.sin(0.06)), 9.1 * np.cos(0.06)]) for side in (1, -1)]
    around = 1.1 * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    around = np.append(around, [[0.0, 0.0, 1.1]], axis=0)
    points = np.concatenate([end + around for end in opened])
    return tip[:, None] + np.einsum("tij,kj->tki", rotation, points)


@given(st.integers(0, 2**32 - 1), st.floats(1e-4, 0.3))
def test_no_point_of_a_finger_moves_further_than_the_bound(seed, step):
    rng = np.random.default_rng(seed)
    joints = rng.uniform(CLASSIC.lower, CLASSIC.upper, (1, 6))
    joints[:, 2] = rng.uniform(40.0, 240.0)
    joints = np.concatenate([joints, joints + rng.uniform(-step, step, 6) * [1, 1, 50, 1, 1, 1]])
    moved = np.linalg.norm(np.diff(finger_ends(joints), axis=0), axis=2).max()
    assert moved <= travel_mm(joints, "400006")[0, 2] + 1e-9


def test_the_bound_is_worked_by_hand_where_one_joint_moves():
    joints = np.zeros((2, 6))
    joints[:, 2] = 115.6  # the wrist 100 mm beyond the remote centre
    for joint, turned, expected in (
        (0, 0.01, [3.202, 1.127, 1.194, 1.194]),  # the shaft's far end, 316.2 mm behind; the finger tip, 119.4 mm ahead
        (2, 0.5, [0.5, 0.5, 0.5, 0.5]),
        (3, 0.1, [0.0, 1.27, 1.94, 1.94]),
        (5, 0.1, [0.0, 0.0, 1.03, 1.03]),
    ):
        moved = joints.copy()
        moved[1, joint] += turned
        if joint == 2:
            np.testing.assert_allclose(travel_mm(moved, "400006")[0], expected, atol=1e-9)
        else:
            np.testing.assert_allclose(travel_mm(moved, "400006")[0], expected, atol=1e-3)


def bounded(seen: list[float], looked_at: list[int], way: np.ndarray) -> np.ndarray:
    """Bound one pair, the shaft and the pad, for a given travel of the shaft."""
    pair = link_pairs(False)[:1]
    return Bounds(pair, np.array(looked_at), np.array(seen)[:, None], {"PSM_A": np.tile(way[:, None], 4)}).at_least_mm(
        0
    )


def test_between_looks_the_distance_is_bounded_by_the_closing_motion():
    np.testing.assert_allclose(bounded([5.0, 4.0], [0, 4], np.arange(5.0)), [5.0, 4.0, 3.0, 3.0, 4.0])


def test_a_nan_spoils_everything_up_to_its_neighbours():
    found = bounded([5.0, np.nan, 5.0], [0, 3, 6], np.arange(7) * 0.1)
    assert np.isnan(found).tolist() == [False, True, True, True, True, True, False]


@given(some.arrays(np.float64, 40, elements=st.floats(-5.0, 5.0)))
def test_a_distance_is_never_bounded_above_itself(steps):
    apart = 10.0 + np.cumsum(steps)
    looked_at = [*range(0, 39, 7), 39]
    found = bounded(apart[looked_at], looked_at, np.append(0.0, np.cumsum(np.abs(np.diff(apart)))))
    assert (found <= apart + 1e-9).all()
    np.testing.assert_array_equal(found[looked_at], apart[looked_at])


def test_both_arms_may_have_closed_in():
    joints = small_trajectory(1, rate_hz=60.0).joints
    pairs = link_pairs(True)
    looked_at, seen = np.array([0, len(joints) - 1]), np.full((2, len(pairs)), 20.0)
    motion, rest = (joints, "400006"), (np.tile(joints[:1], (len(joints), 1)), "400006")
    one = Bounds.of({"PSM_A": motion, "PSM_M": rest}, pairs, looked_at, seen)
    two = Bounds.of({"PSM_A": motion, "PSM_M": motion}, pairs, looked_at, seen)
    column = [str(pair) for pair in pairs].index("PSM_A finger_1 to PSM_M finger_1")
    np.testing.assert_allclose(20.0 - two.at_least_mm(column), 2 * (20.0 - one.at_least_mm(column)), atol=1e-9)
    assert two.moved_mm() == pytest.approx(2 * one.moved_mm())


def test_four_samples_of_a_plan_are_bounded_by_about_a_millimetre():
    trajectory = small_trajectory(1, rate_hz=240.0)
    fingers = travel_mm(trajectory.joints, "400006")[:, 2]
    along = np.linalg.norm(np.diff(finger_ends(trajectory.joints), axis=0), axis=2).max(axis=1)
    assert (along <= fingers + 1e-9).all()
    assert 4 * fingers.max() < 1.5
