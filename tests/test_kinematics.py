"""The arm's kinematics against the numbers worked by hand and against itself."""

import numpy as np
import pytest

from skills import kinematics
from skills.errors import BadInput, ImproperRotation, UnknownInstrument, Unreachable
from skills.kinematics import (
    CANNULA_MM,
    CLASSIC,
    INSTRUMENTS,
    JAW_TIP_MM,
    POINTING_DOWN,
    SI,
    WRIST_MM,
    angle_between,
    forward,
    instrument_of,
    inverse,
    joint_margins,
    matrix_of,
    nearest_limit,
    quaternion_of,
    reachable,
    solutions_of,
)
from tests.learning.loops import run_both

START_MM, GOAL_MM = (-10.0, 55.0, -135.0), (5.0, 55.0, -125.0)
# yaw, pitch in degrees, insertion in mm, roll, wrist pitch, wrist yaw in degrees
REACH = [
    (START_MM, 0.0, (-4.236, -23.537, 153.328, 0.0, 23.537, 4.236)),
    (GOAL_MM, 0.0, (2.291, -25.367, 143.978, 0.0, 25.367, -2.291)),
    (START_MM, JAW_TIP_MM, (-4.581, -25.348, 144.069, 0.0, 25.348, 4.581)),
    (GOAL_MM, JAW_TIP_MM, (2.494, -27.466, 134.850, 0.0, 27.466, -2.494)),
]


def any_joints(count: int, seed: int = 7) -> np.ndarray:
    """Return joints within their limits, with the wrist out of the cannula."""
    joints = np.random.default_rng(seed).uniform(CLASSIC.lower, CLASSIC.upper, (count, 6))
    joints[:, 2] = np.random.default_rng(seed).uniform(CANNULA_MM, CLASSIC.upper[2], count)
    return joints


def by_table(joints: np.ndarray, instrument: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses of joints by the published Denavit-Hartenberg table, one transform after the other."""
    tool, q = instrument_of(instrument), joints.T
    pose, half = np.tile(np.eye(4), (len(joints), 1, 1)), np.pi / 2
    for alpha, a, theta, d in (
        (half, 0.0, q[0] + half, 0.0),
        (-half, 0.0, q[1] - half, 0.0),
        (half, 0.0, 0.0, q[2] - tool.arm.remote_centre_mm),
        (0.0, 0.0, q[3], tool.shaft_mm),
        (-half, 0.0, q[4] - half, 0.0),
        (-half, WRIST_MM, q[5] - half, 0.0),
    ):
        link = np.zeros_like(pose)
        ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
        rows = ((ct, -st, 0, a), (st * ca, ct * ca, -sa, -sa * d), (st * sa, ct * sa, ca, ca * d), (0, 0, 0, 1))
        for row, numbers in enumerate(rows):
            for column, number in enumerate(numbers):
                link[:, row, column] = number
        pose = pose @ link
    return pose[:, :3, 3], pose[:, :3, :3] @ np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]])


def test_zero_joints_put_the_tip_above_the_remote_centre_pointing_down():
    tip, rotation = forward(np.zeros((1, 6)))
    np.testing.assert_allclose(tip[0], [0, 0, 6.5], atol=1e-12)
    np.testing.assert_allclose(rotation[0], POINTING_DOWN, atol=1e-15)


@pytest.mark.parametrize(("point_mm", "tip_offset_mm", "expected"), REACH)
def test_the_papers_start_and_goal_need_the_joints_worked_by_hand(point_mm, tip_offset_mm, expected):
    hinge = np.array(point_mm) - tip_offset_mm * POINTING_DOWN[:, 2]
    joints = inverse([hinge], POINTING_DOWN)[0]
    worked = np.degrees(joints)
    worked[2] = joints[2]
    np.testing.assert_allclose(worked, expected, atol=1e-3)  # degrees and mm


def test_inverse_then_forward_comes_back_for_ten_thousand_poses():
    tip, rotation = forward(any_joints(10_000))
    again, turned = forward(inverse(tip, rotation))
    assert np.abs(again - tip).max() < 1e-9  # mm
    assert np.degrees(angle_between(rotation, turned)).max() < 1e-9


def test_forward_then_inverse_returns_the_same_joints_from_nearby():
    wanted = any_joints(200)
    tip, rotation = forward(wanted)
    found = np.concatenate([inverse(tip[[k]], rotation[[k]], near=wanted[k]) for k in range(200)])
    assert np.abs(found - wanted).max() < 1e-9


def test_every_cell_of_the_papers_grid_is_reachable():
    axis = 5.0 * np.arange(11)
    cells = np.stack(np.meshgrid(axis - 30, axis + 25, axis - 140, indexing="ij"), axis=-1).reshape(-1, 3)
    assert reachable(cells, POINTING_DOWN).sum() == 1331
    joints = inverse(cells, POINTING_DOWN)
    assert np.degrees(np.abs(joints[:, 0])).max() == pytest.approx(18.4, abs=0.05)
    assert np.degrees(np.abs(joints[:, 1])).max() == pytest.approx(42.8, abs=0.05)
    assert (joints[:, 2].min(), joints[:, 2].max()) == pytest.approx((100.3, 169.2), abs=0.05)


def test_a_turning_tool_keeps_its_branch_and_rolls_on_past_half_a_turn():
    angles = np.linspace(0.0, 4.4, 500)
    c, s, zero, one = np.cos(angles), np.sin(angles), np.zeros(500), np.ones(500)
    about_z = np.moveaxis(np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]), 2, 0)
    joints = inverse(np.tile([0.0, 30.0, -130.0], (500, 1)), about_z @ POINTING_DOWN)
    assert np.abs(np.diff(joints[:, 3])).max() < 0.02  # rad: no jump
    assert abs(joints[-1, 3]) == pytest.approx(4.4, abs=0.02)  # and beyond a half turn


def test_the_first_unreachable_pose_is_named_with_joint_value_and_limit():
    with pytest.raises(Unreachable, match="insertion") as caught:
        inverse([[0, 0, -100], [0, 0, -400], [0, 0, -500]], POINTING_DOWN)
    numbers = caught.value.numbers
    assert (numbers["sample"], numbers["joint"]) == (1, "insertion")
    assert (numbers["value"], numbers["limit"]) == pytest.approx((406.5, 240.0))
    assert reachable([[0, 0, -100], [0, 0, -400]], POINTING_DOWN).tolist() == [True, False]


def test_a_wrist_in_the_remote_centre_is_out_of_reach_and_not_a_wrong_pose():
    tip, rotation = forward(np.array([[0.1, 0.1, 15.6, 0.0, 0.0, 0.0]]))
    assert not reachable(tip, rotation)[0]
    with pytest.raises(Unreachable):
        inverse(tip, rotation)


def test_the_si_with_its_own_tool_gives_the_classics_poses():
    joints = any_joints(100)
    for classic, si in zip(forward(joints, "400006"), forward(joints, "420006"), strict=True):
        np.testing.assert_allclose(classic, si, atol=1e-10)
    assert instrument_of("420006").wrist_offset_mm == pytest.approx(instrument_of("400006").wrist_offset_mm)


@pytest.mark.parametrize(
    ("mixed", "own", "further_in_mm"), [("400006-Si", "420006", 50.8), ("420006-Classic", "400006", -50.8)]
)
def test_a_tool_on_the_other_arm_is_off_by_the_difference_of_the_shafts(mixed, own, further_in_mm):
    joints = any_joints(100)
    deeper = joints + np.array([0.0, 0.0, further_in_mm, 0.0, 0.0, 0.0])
    for one, other in zip(forward(deeper, mixed), forward(joints, own), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-10)
    assert instrument_of(mixed).cannula_mm == pytest.approx(CANNULA_MM + further_in_mm)
    assert instrument_of(own).cannula_mm == CANNULA_MM
    np.testing.assert_array_equal(instrument_of(mixed).upper, instrument_of(own).upper)  # the arm's limits


@pytest.mark.parametrize("instrument", INSTRUMENTS)
def test_the_closed_form_is_the_published_table_of_every_instrument(instrument):
    joints = any_joints(1000)
    for ours, theirs in zip(forward(joints, instrument), by_table(joints, instrument), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-10)


def test_margins_count_from_the_nearer_limit():
    margins = joint_margins([[0.0, 0.0, 250.0, 4.0, 0.0, 0.0]])[0]
    assert margins[2] == pytest.approx(-10.0)
    assert margins[3] == pytest.approx(np.radians(260) - 4.0)


def test_nan_and_false_rotations_are_refused():
    with pytest.raises(BadInput, match="NaN"):
        inverse([[np.nan, 0, -100]], POINTING_DOWN)
    with pytest.raises(BadInput, match="NaN"):
        forward([[0, np.inf, 0, 0, 0, 0]])
    with pytest.raises(ImproperRotation):
        inverse([[0, 0, -100]], -POINTING_DOWN)
    with pytest.raises(ImproperRotation):
        matrix_of([[0.0, 0.0, 0.0, 0.0]])
    with pytest.raises(BadInput, match="rotations"):
        inverse(np.zeros((2, 3)), np.tile(POINTING_DOWN, (3, 1, 1)))


def test_an_unknown_instrument_is_refused_with_those_that_are_known():
    with pytest.raises(UnknownInstrument, match="400006"):
        forward(np.zeros((1, 6)), "470006")


def test_no_poses_have_no_joints():
    assert inverse(np.empty((0, 3)), POINTING_DOWN).shape == (0, 6)


def test_quaternions_and_matrices_say_the_same_and_change_smoothly():
    _, rotation = forward(any_joints(500))
    quaternions = quaternion_of(rotation)
    np.testing.assert_allclose(matrix_of(quaternions), rotation, atol=1e-14)
    np.testing.assert_allclose(quaternion_of(POINTING_DOWN[None])[0], [0.5**0.5, 0.5**0.5, 0, 0], atol=1e-15)
    assert (np.einsum("ti,ti->t", quaternions[1:], quaternions[:-1]) >= 0).all()


def test_the_si_has_its_own_efforts():
    """PSM_Si.json has ftmax 17.0845 Nm, 17.0845 Nm and 40.9063 N; LARGE_NEEDLE_DRIVER_420006.json the other three."""
    assert SI.effort == (17.0845, 17.0845, 40.9063, 0.33, 0.25, 0.20)
    assert CLASSIC.effort[:3] == (3.316, 3.316, 9.878)


def test_compiled_solutions_agree_with_plain_ones_to_the_last_bit(monkeypatch: pytest.MonkeyPatch):
    tip, rotation = forward(any_joints(200))
    tip[0], tip[1] = 0.0, WRIST_MM * rotation[1, :, 0]  # on an axis of the wrist, and out of the cannula
    agreed = run_both(monkeypatch, kinematics, "_solve")
    found = solutions_of(tip, rotation, instrument_of("400006"))
    assert agreed == ["_solve"] * 2
    assert np.isfinite(found[2:]).all()


def test_the_nearest_limit_is_that_of_all_solutions_one_by_one():
    tip, rotation = forward(any_joints(500, seed=8))
    tip[::7] *= 1.5
    tool = instrument_of("400006")
    margins = joint_margins(solutions_of(tip, rotation, tool).reshape(-1, 6)).reshape(len(tip), 6, 6)
    left = (margins / (tool.upper - tool.lower)).min(axis=2).max(axis=1)
    nearest, beyond = nearest_limit(tip, rotation)
    assert nearest.tip_mm == tuple(tip[left.argmin()].tolist())
    assert (
        beyond == np.count_nonzero(~reachable(tip, rotation)) == np.count_nonzero((margins < -1e-9).any(2).all(1)) > 0
    )
