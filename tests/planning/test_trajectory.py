"""Passes in time: through every point, near the polyline, within the limits, and deterministic."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import BadPlan, BadSpeed, ImproperRotation, NoMotion, Unreachable
from skills.kinematics import POINTING_DOWN, angle_between, forward, matrix_of
from skills.planning.trajectory import A1, A2, PassPath, Trajectory, joint_ratios, time_parametrise
from tests.by_day import examples
from tests.planning.motions import HAND_OFF_MM, hand_off, small_trajectory

START_CELL = (4, 6, 1)
walks = st.lists(st.tuples(*[st.integers(-1, 1)] * 3).filter(any), min_size=1, max_size=20)


def distance_to_polyline(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Measure the distance by a second method: to the nearest of a thousand points per move."""
    u = np.linspace(0, 1, 1001)[:, None, None]
    dense = (line[:-1] + u * np.diff(line, axis=0)).reshape(-1, 3)
    return np.array([np.linalg.norm(dense - p, axis=1).min() for p in points])


def assert_equal(one: Trajectory, other: Trajectory) -> None:
    for field in fields(Trajectory):
        a, b = getattr(one, field.name), getattr(other, field.name)
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes(), field.name


@examples(25)
@given(moves=walks)
def test_any_grid_walk_is_followed_within_limits_and_ends_on_its_goal(moves):
    cells = np.clip(np.cumsum([START_CELL, *moves], axis=0), 0, 10)
    line = cells * 5.0 + [-30.0, 25.0, -140.0]
    if not np.diff(line, axis=0).any():
        return
    motion = time_parametrise([PassPath(line, POINTING_DOWN)], rate_hz=60.0)
    assert (motion.tip_mm[-1] == line[-1]).all()
    assert (motion.tip_mm[0] == line[0]).all()
    assert motion.deviation_mm <= 1.25
    assert distance_to_polyline(motion.tip_mm[::7], line).max() <= motion.deviation_mm + 0.01
    assert motion.speed_ratio <= 1.0
    assert motion.acceleration_ratio <= 1.0


def test_every_point_of_the_path_is_passed_exactly_on_a_tick_and_in_order():
    motion = time_parametrise([hand_off()])
    ticks = [int(np.flatnonzero((motion.tip_mm == point).all(axis=1))[0]) for point in HAND_OFF_MM]
    assert ticks == sorted(ticks)


def test_the_joints_really_lead_there():
    motion = small_trajectory()
    tip, rotation = forward(motion.joints)
    assert np.abs(tip - motion.tip_mm).max() < 1e-9  # mm
    assert np.degrees(angle_between(rotation, matrix_of(motion.rotation_xyzw))).max() < 1e-6


def test_a2_begins_where_a1_ends_and_turns_with_the_tip_held():
    motion = time_parametrise([hand_off()])
    turning = motion.phase == A2
    assert (np.diff(motion.phase) >= 0).all()
    assert (motion.tip_mm[turning] == HAND_OFF_MM[-1]).all()
    target = hand_off().target_rotation
    np.testing.assert_allclose(matrix_of(motion.rotation_xyzw[-1:])[0], target, atol=1e-12)
    rotation = matrix_of(motion.rotation_xyzw[turning])
    rate_deg_s = np.degrees(angle_between(rotation[1:], rotation[:-1])) * motion.rate_hz
    assert rate_deg_s.max() == pytest.approx(45.0, abs=0.5)


def test_passes_are_a_pause_apart_and_time_stands_on_ticks():
    motion = time_parametrise([hand_off(), hand_off(-8.0), hand_off(-16.0)], rate_hz=100.0, pause_s=1.5)
    assert motion.passes == 3
    gaps = np.diff(motion.stamps_s)
    np.testing.assert_allclose(gaps[motion.last_samples[:-1]], 1.5, atol=1e-9)
    np.testing.assert_allclose(np.delete(gaps, motion.last_samples[:-1]), 0.01, atol=1e-9)


def test_a_pass_may_be_a2_alone():
    goal = hand_off().tip_mm[-1:]
    motion = time_parametrise([PassPath(goal, POINTING_DOWN, hand_off().target_rotation)])
    assert motion.phase[0] == A1
    assert (motion.phase[1:] == A2).all()


def test_too_high_a_speed_is_brought_down_to_the_joints_limits():
    fast = time_parametrise([hand_off()], speed_mm_s=100.0)
    assert fast.speed_mm_s < 30.0
    assert 0.8 < fast.acceleration_ratio <= 1.0
    slow = time_parametrise([hand_off()], speed_mm_s=5.0)
    assert slow.speed_mm_s == 5.0
    assert slow.duration_s > fast.duration_s


def test_motion_is_slow_at_bends_and_ends_and_at_full_speed_elsewhere():
    line = np.array([[-30, 50, -130], [0, 50, -130], [0, 80, -130]], float)
    motion = time_parametrise([PassPath(line, POINTING_DOWN)], speed_mm_s=10.0)
    speed = np.linalg.norm(np.diff(motion.tip_mm, axis=0), axis=1) * motion.rate_hz
    way = np.append(0, np.cumsum(speed[:-1])) / motion.rate_hz
    assert motion.speed_mm_s == 10.0
    for place, most in ((0, 3.5), (30, 7.5), (60, 3.5)):
        assert speed[np.abs(way - place) < 0.3].max() < most
    for middle in (15, 45):
        assert speed[np.abs(way - middle) < 5].mean() == pytest.approx(10.0, rel=0.05)


def test_two_points_close_to_each_other_are_no_jerk():
    for length in (1e-3, 0.1, 1.0, 10.0):
        line = [[0, 50, -130], [0, 50, -130 + length]]
        assert time_parametrise([PassPath(line, POINTING_DOWN)]).speed_mm_s == 20.0


def test_a_long_move_does_not_swing_out_of_its_corners():
    line = [[0, 50, -130], [0, 50, -120], [40, 50, -120], [40, 55, -120]]
    assert time_parametrise([PassPath(line, POINTING_DOWN)], rate_hz=60.0).deviation_mm <= 1.25


def test_the_same_passes_give_the_same_bytes():
    assert_equal(small_trajectory(), small_trajectory())


def test_ratios_are_worked_by_hand():
    joints = np.zeros((4, 6))
    joints[:, 2] = [100.0, 101.0, 103.0, 103.0]  # mm, at 10 Hz: 10, 20, 0 mm/s; limits 200 mm/s and 200 mm/s2
    speed, acceleration = joint_ratios(joints, [0, 0, 0, 0], 10.0)
    np.testing.assert_allclose(speed[:, 2], [0.05, 0.1, 0.1, 0.0])
    np.testing.assert_allclose(acceleration[:, 2], [0.5, 0.5, 1.0, 0.0])
    across, _ = joint_ratios(joints, [0, 1, 2, 2], 10.0)
    assert not across.any()  # the transfer between passes does not count


def test_a_point_out_of_reach_is_named_with_its_pass():
    far = PassPath([[0, 50, -130], [0, 50, -400]], POINTING_DOWN)
    with pytest.raises(Unreachable, match="Pass 1, A1") as caught:
        time_parametrise([hand_off(), far])
    assert (caught.value.numbers["pass"], caught.value.numbers["joint"]) == (1, "insertion")
    assert int(str(caught.value.numbers["sample"])) > 0


@pytest.mark.parametrize("speed", [0.0, -1.0, np.nan, np.inf, 100.1])
def test_a_speed_that_no_motion_has_is_refused(speed):
    with pytest.raises(BadSpeed):
        time_parametrise([hand_off()], speed_mm_s=speed)


@pytest.mark.parametrize("wrong", [{"rate_hz": np.nan}, {"rate_hz": 5.0}, {"pause_s": -1.0}, {"pause_s": np.nan}])
def test_a_rate_or_pause_that_is_none_is_refused(wrong):
    with pytest.raises(BadSpeed):
        time_parametrise([hand_off()], **wrong)


def test_motion_beyond_any_length_is_refused_before_it_fills_the_memory():
    with pytest.raises(BadPlan, match="metres"):
        PassPath([[0, 0, 0], [1e300, 0, 0]], POINTING_DOWN)
    with pytest.raises(BadSpeed, match="samples"):
        time_parametrise([hand_off()], speed_mm_s=1e-9)


def test_a_pass_in_which_nothing_moves_is_refused():
    still = np.tile([[0.0, 50.0, -130.0]], (3, 1))
    for passes in ([], [PassPath(np.empty((0, 3)), POINTING_DOWN)], [PassPath(still, POINTING_DOWN)]):
        with pytest.raises(NoMotion):
            time_parametrise(passes)


def test_false_values_are_refused_at_once():
    with pytest.raises(ImproperRotation):
        PassPath(HAND_OFF_MM, np.ones((3, 3)))
    motion = small_trajectory(1)
    changed = {field.name: getattr(motion, field.name) for field in fields(Trajectory)}
    with pytest.raises(BadPlan, match="must increase"):
        Trajectory(**changed | {"stamps_s": motion.stamps_s[::-1]})
    with pytest.raises(BadPlan, match="numbered from 0"):
        Trajectory(**changed | {"phase": np.full(len(motion), 3)})
