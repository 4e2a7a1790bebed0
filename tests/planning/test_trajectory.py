"""Trajectories: laws of motion, transfers, and the other arm."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import BadInput, BadPlan, BadSpeed, ImproperRotation, NoApproach, NoMotion, Unreachable
from skills.kinematics import POINTING_DOWN, angle_between, forward, instrument_of, matrix_of
from skills.planning.handoff import JAW_S, PsmM, realign, unit_approach
from skills.planning.handoff import hand_off as taking_pose
from skills.planning.motion_laws import PEAK
from skills.planning.passes import STAND_OFF_MM
from skills.planning.trajectory import (
    A1,
    A2,
    TRANSFER,
    PassPath,
    Trajectory,
    joint_ratios,
    seams,
    seconds_by_phase,
    stands_from,
    time_parametrise,
    transfers,
)
from tests.by_day import examples
from tests.planning.motions import HAND_OFF_MM, PSM_M, hand_off, small_trajectory

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


BESIDE = PsmM(PSM_M, (160.0, 20.0, 20.0), (0.0, 0.0, float(np.sin(np.radians(22.5))), float(np.cos(np.radians(22.5)))))
GOAL_MM = HAND_OFF_MM[-1]


def about_z(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def turned_pass(degrees: float, start_mm=None) -> PassPath:
    """Return a short pass whose grid world is rotated about its goal, without A2."""
    line = (HAND_OFF_MM - GOAL_MM) @ about_z(degrees).T + GOAL_MM
    return PassPath(line, about_z(degrees) @ POINTING_DOWN, None, start_mm)


def assert_nothing_leaps(motion: Trajectory) -> None:
    """Assert that between samples, whatever the stamps, no joint moves further than its speed allows in one tick."""
    arms = [(motion.joints, motion.instrument)]
    if motion.psm_m is not None:
        arms.append((motion.psm_m.joints, motion.psm_m.instrument))
    for joints, instrument in arms:
        tick = instrument_of(instrument).speed / motion.rate_hz
        assert (np.abs(np.diff(joints, axis=0)) <= tick * (1 + 1e-9)).all()


@examples(25)
@given(
    shifts=st.lists(st.tuples(*[st.floats(-15, 15)] * 3), min_size=2, max_size=4),
    turns=st.lists(st.floats(-60, 60), min_size=4, max_size=4),
    outside=st.lists(st.none() | st.tuples(*[st.floats(-20, 20)] * 3), min_size=4, max_size=4),
    with_m=st.booleans(),
    enters=st.sampled_from(["start", "after_A1"]),
)
def test_no_joint_of_either_arm_leaps_anywhere_and_none_exceeds_its_limits(shifts, turns, outside, with_m, enters):
    from skills.planning.handoff import realign

    passes = []
    for shift, turn, off in zip(shifts, turns, outside, strict=False):
        one = turned_pass(turn)
        tip = one.tip_mm + np.array(shift)
        target = realign(one.rotation, PSM_M).rotation
        passes.append(PassPath(tip, one.rotation, target, None if off is None else tip[0] + off))
    psm_m = PsmM(PSM_M, BESIDE.base_mm, BESIDE.base_xyzw, enters=enters) if with_m else None
    motion = time_parametrise(passes, rate_hz=60.0, psm_m=psm_m)
    assert_nothing_leaps(motion)
    assert (motion.psm_m is not None) == with_m
    for joints in [motion.joints, *([] if motion.psm_m is None else [motion.psm_m.joints])]:
        speed, acceleration = joint_ratios(joints, motion.pass_index, motion.rate_hz)
        assert speed.max() <= motion.speed_ratio <= 1.0
        assert acceleration.max() <= motion.acceleration_ratio <= 1.0


def test_a_pass_goes_on_from_the_very_pose_in_which_the_last_one_ended():
    motion = time_parametrise([hand_off(-8.0 * k) for k in range(3)], rate_hz=100.0)
    for last in motion.last_samples[:-1]:
        np.testing.assert_array_equal(motion.tip_mm[last], motion.tip_mm[last + 1])
        np.testing.assert_allclose(motion.joints[last], motion.joints[last + 1], atol=1e-12)
        assert (motion.phase[last], motion.phase[last + 1]) == (A2, TRANSFER)
    for seam in seams(motion):
        assert seam.pause_s == pytest.approx(1.0)
        assert (seam.leap_mm, seam.leap_deg) == (0.0, pytest.approx(0.0, abs=1e-6))
        assert seam.joint_leap < 1e-9


def test_a_transfer_is_straight_turns_the_jaw_back_and_rests_at_both_ends():
    motion = time_parametrise([hand_off(), hand_off(-8.0)], rate_hz=200.0)
    at = np.flatnonzero((motion.pass_index == 1) & (motion.phase == TRANSFER))
    start, end = GOAL_MM, hand_off(-8.0).tip_mm[0]
    along = (motion.tip_mm[at] - start) @ (end - start) / np.linalg.norm(end - start)
    away = motion.tip_mm[at] - start - along[:, None] * (end - start) / np.linalg.norm(end - start)
    assert np.linalg.norm(away, axis=1).max() < 1e-9
    assert (np.diff(along) >= 0).all()
    np.testing.assert_array_equal(motion.tip_mm[at[-1] + 1], end)
    rotation = matrix_of(motion.rotation_xyzw)
    np.testing.assert_allclose(rotation[at[0]], hand_off().target_rotation, atol=1e-12)
    np.testing.assert_allclose(rotation[at[-1] + 1], POINTING_DOWN, atol=1e-12)
    steps = np.diff(along)
    assert max(steps[0], steps[-1]) < steps.max() / 1000


def test_the_seconds_of_a_transfer_are_worked_by_hand():
    # 30 mm at 20 mm/s at most, by the minimum-jerk law: 1.875 * 30 / 20 s.
    passes = [PassPath([[0, 50, -130], [10, 50, -130]], POINTING_DOWN)]
    passes.append(PassPath([[40, 50, -130], [50, 50, -130]], POINTING_DOWN))
    motion = time_parametrise(passes, rate_hz=200.0, speed_mm_s=20.0)
    first, second = transfers(motion)
    assert first is None
    assert (second.length_mm, second.duration_s) == (pytest.approx(30.0), pytest.approx(PEAK * 30 / 20, abs=0.005))
    spent = seconds_by_phase(motion)
    assert spent["transfer"] == second.duration_s
    assert spent["A2"] == 0.0
    assert sum(spent.values()) == pytest.approx(len(motion) / 200.0)
    steps = np.linalg.norm(np.diff(motion.tip_mm, axis=0), axis=1) * 200.0
    assert steps[motion.phase[:-1] == TRANSFER].max() == pytest.approx(20.0, rel=1e-3)


def test_a_start_elsewhere_is_reached_by_a_transfer_in_the_first_pass_too():
    start = HAND_OFF_MM[0] + [-30.0, 0.0, 0.0]
    motion = time_parametrise([PassPath(HAND_OFF_MM, POINTING_DOWN, None, start)], rate_hz=100.0)
    np.testing.assert_array_equal(motion.tip_mm[0], start)
    before = motion.phase == TRANSFER
    assert before.sum() > 100
    assert (np.diff(motion.phase) >= 0).all()
    np.testing.assert_array_equal(motion.tip_mm[np.argmin(before)], HAND_OFF_MM[0])
    (one,) = transfers(motion)
    assert one.length_mm == pytest.approx(30.0)


def test_a_start_that_is_where_a1_begins_needs_no_transfer():
    motion = time_parametrise([PassPath(HAND_OFF_MM, POINTING_DOWN, None, HAND_OFF_MM[0])], rate_hz=60.0)
    assert transfers(motion) == [None]
    assert (motion.phase == A1).all()


def test_a_transfer_alone_is_slowed_where_it_alone_is_too_fast():
    slow_a1 = [PassPath([[0, 50, -130], [0.2, 50, -130]], POINTING_DOWN, None)]
    back = PassPath([[60, 60, -100], [60.2, 60, -100]], about_z(150) @ POINTING_DOWN, None)
    motion = time_parametrise([*slow_a1, back], rate_hz=100.0, speed_mm_s=100.0)
    _, one = transfers(motion)
    assert one.duration_s > 1.2 * PEAK * one.length_mm / 100.0
    assert motion.acceleration_ratio <= 1.0
    assert_nothing_leaps(motion)


def test_twelve_passes_round_a_circle_do_not_leap_at_any_seam():
    # 330 degrees in all. Begun with the least roll, 160 degrees, it would end beyond 260 and have to jump back.
    motion = time_parametrise([turned_pass(200 - 30.0 * k) for k in range(12)], rate_hz=60.0)
    assert_nothing_leaps(motion)
    roll = np.degrees(motion.joints[:, 3])
    assert abs(roll[0]) == pytest.approx(200, abs=5)
    assert np.ptp(roll) == pytest.approx(330, abs=10)


def test_a_jaw_that_winds_on_for_ever_is_refused_by_pass_phase_and_joint():
    with pytest.raises(Unreachable, match=r"Pass \d+, transfer: the jaw winds up to roll") as caught:
        time_parametrise([turned_pass(30.0 * k) for k in range(24)], rate_hz=60.0)
    numbers = caught.value.numbers
    assert numbers["pass"] == 9  # on the way from 240 to 270 degrees, of 260
    assert (numbers["joint"], numbers["phase"]) == ("roll", TRANSFER)
    assert abs(float(numbers["limit"])) == pytest.approx(np.radians(260))
    assert abs(float(numbers["value"])) > np.radians(260)


def test_a_transfer_out_of_reach_is_named_with_its_pass_and_phase():
    far = PassPath(HAND_OFF_MM, POINTING_DOWN, None, [0.0, 50.0, -400.0])
    with pytest.raises(Unreachable, match="Pass 1, transfer") as caught:
        time_parametrise([hand_off(), far], rate_hz=60.0)
    numbers = caught.value.numbers
    assert (numbers["pass"], numbers["phase"], numbers["joint"]) == (1, TRANSFER, "insertion")
    with pytest.raises(BadPlan, match="metres"):
        PassPath(HAND_OFF_MM, POINTING_DOWN, None, [0.0, 0.0, 1e5])


def test_turning_back_takes_the_shorter_way():
    motion = time_parametrise([hand_off(), hand_off()], rate_hz=100.0)
    at = (motion.pass_index == 1) & (motion.phase == TRANSFER)
    rotation = matrix_of(motion.rotation_xyzw[at])
    turned = np.degrees(angle_between(rotation[1:], rotation[:-1])).sum()
    assert turned == pytest.approx(85.7, abs=0.1)


def in_psm_a_frame(motion: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return PSM_M's tip and jaw by its joints, in the PSM_A base frame."""
    tip, rotation = forward(motion.psm_m.joints, motion.psm_m.instrument)
    base = matrix_of(motion.psm_m.base_xyzw[None])[0]
    return tip @ base.T + motion.psm_m.base_mm, base @ rotation


def taking(motion: Trajectory, number: int) -> tuple[np.ndarray, np.ndarray]:
    last = motion.last_samples[number]
    tip, jaws = taking_pose(motion.tip_mm[[last]], matrix_of(motion.rotation_xyzw[[last]]), PSM_M)
    return tip[0], jaws[0]


def planned(count: int = 2, psm_m: PsmM = BESIDE, **how) -> Trajectory:
    return time_parametrise([hand_off(-8.0 * k) for k in range(count)], **{"rate_hz": 100.0, "psm_m": psm_m, **how})


def test_psm_m_waits_behind_the_hand_off_in_a1_and_is_there_at_a2s_end():
    motion = planned(3)
    tip, rotation = in_psm_a_frame(motion)
    for number in range(3):
        there, jaws = taking(motion, number)
        of_pass = motion.pass_index == number
        waiting = tip[of_pass & (motion.phase == A1)]
        assert np.abs(waiting - (there - STAND_OFF_MM * jaws[:, 2])).max() < 1e-9
        last = motion.last_samples[number]
        assert np.abs(tip[last] - there).max() < 1e-9
        # Its jaws may be taken either way round; only the approach and the hinge's line count.
        assert rotation[last][:, 2] == pytest.approx(jaws[:, 2], abs=1e-9)
        assert abs(rotation[last][:, 0] @ jaws[:, 0]) == pytest.approx(1.0, abs=1e-9)


def test_it_comes_in_along_its_approach_while_psm_a_turns():
    motion = planned(1)
    tip, rotation = in_psm_a_frame(motion)
    coming = tip[motion.phase == A2][: -2 * round(JAW_S * motion.rate_hz)]  # then the jaws move
    there, jaws = taking(motion, 0)
    behind = (there - coming) @ jaws[:, 2]
    assert np.abs(there - coming - behind[:, None] * jaws[:, 2]).max() < 1e-9
    assert (np.diff(behind) < 0).all()
    assert behind[-1] == pytest.approx(0.0, abs=1e-9)
    assert angle_between(rotation, np.broadcast_to(rotation[0], rotation.shape)).max() < 1e-9


def test_it_leaves_before_psm_a_comes_back():
    motion = planned(2)
    tip, _ = in_psm_a_frame(motion)
    at = np.flatnonzero((motion.pass_index == 1) & (motion.phase == TRANSFER))
    psm_a_moves = np.linalg.norm(motion.tip_mm[at] - motion.tip_mm[at[0]], axis=1) > 1e-9
    gone = np.linalg.norm(tip[at] - taking(motion, 0)[0], axis=1)
    assert gone[~psm_a_moves].min() == pytest.approx(0.0, abs=1e-9)
    assert gone[psm_a_moves].min() >= STAND_OFF_MM - 1e-6


def test_told_to_it_is_at_the_hand_off_from_the_start():
    motion = planned(2, PsmM(PSM_M, BESIDE.base_mm, BESIDE.base_xyzw, enters="start"))
    tip, _ = in_psm_a_frame(motion)
    for number in range(2):
        there, _ = taking(motion, number)
        here = (motion.pass_index == number) & (motion.phase != TRANSFER)
        assert np.abs(tip[here] - there).max() < 1e-9


@examples(20)
@given(st.floats(-15, 15), st.floats(-15, 15), st.floats(-15, 15), st.floats(-25, 25))  # within 20 not all are in reach
def test_wherever_its_base_is_its_tip_is_at_the_same_place(dx, dy, dz, tilt_deg):
    half = np.radians(35 + tilt_deg) / 2
    moved = PsmM(PSM_M, (160 + dx, 20 + dy, 20 + dz), (0.0, float(np.sin(half)), 0.0, float(np.cos(half))))
    one, other = planned(1, rate_hz=20.0), planned(1, moved, rate_hz=20.0)
    np.testing.assert_allclose(in_psm_a_frame(one)[0][-1], in_psm_a_frame(other)[0][-1], atol=1e-9)


def test_of_the_two_ways_round_it_takes_the_one_with_less_roll():
    # A base rotated by half a turn about its own axis needs the other way, and then rolls of the same size.
    x, y, z, w = BESIDE.base_xyzw
    turned = PsmM(PSM_M, BESIDE.base_mm, (y, -x, w, -z))
    one, other = planned(1), planned(1, turned)
    assert np.abs(one.psm_m.joints[:, 3]).max() <= np.pi / 2
    np.testing.assert_allclose(np.abs(one.psm_m.joints[:, 3]), np.abs(other.psm_m.joints[:, 3]), atol=1e-9)
    jaws = in_psm_a_frame(one)[1][-1], in_psm_a_frame(other)[1][-1]
    assert jaws[0][:, 2] == pytest.approx(jaws[1][:, 2], abs=1e-9)
    assert jaws[0][:, 0] == pytest.approx(-jaws[1][:, 0], abs=1e-9)


def test_where_its_base_is_not_known_the_trajectory_is_psm_as_alone():
    motion, alone = planned(2, PsmM(PSM_M)), planned(2, None)
    assert motion.psm_m is None
    assert motion.joints.tobytes() == alone.joints.tobytes()


def test_a2_without_a_turn_still_lasts_as_long_as_it_needs_to_come_in():
    ready = realign(POINTING_DOWN, PSM_M).rotation
    motion = time_parametrise([PassPath(HAND_OFF_MM, ready, ready)], rate_hz=100.0, psm_m=BESIDE)
    seconds = np.count_nonzero(motion.phase == A2) / 100.0
    assert seconds == pytest.approx(PEAK * STAND_OFF_MM / 20.0 + 2 * JAW_S, abs=0.02)
    still = time_parametrise([PassPath(HAND_OFF_MM, ready, ready)], rate_hz=100.0)
    assert np.count_nonzero(still.phase == A2) == 1


def test_a2_is_slowed_until_psm_ms_joints_are_within_their_limits_too():
    motion = planned(2, speed_mm_s=100.0)
    speed, acceleration = joint_ratios(motion.psm_m.joints, motion.pass_index, 100.0)
    assert speed.max() <= 1.0
    assert acceleration.max() <= 1.0
    alone = planned(2, None, speed_mm_s=100.0)
    assert np.count_nonzero(motion.phase == A2) > 0 and len(motion) > len(alone)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["along", "against"])
def test_an_approach_along_psm_as_own_is_met_across_it(sign):
    approach = tuple((sign * POINTING_DOWN[:, 2]).tolist())
    target = realign(POINTING_DOWN, approach).rotation
    tip, jaws = taking_pose(HAND_OFF_MM[-1:], target[None], approach)
    assert np.isfinite(tip).all()
    assert jaws[0][:, 2] == pytest.approx(approach)
    assert target[:, 2] @ unit_approach(approach) == pytest.approx(0.0, abs=1e-12)


def test_a_jaw_that_is_not_turned_for_it_is_refused():
    with pytest.raises(BadPlan, match="realign"):
        taking_pose(HAND_OFF_MM[-1:], POINTING_DOWN[None], POINTING_DOWN[:, 2])
    with pytest.raises(BadPlan, match="Pass 0 has no A2"):
        time_parametrise([hand_off(with_a2=False)], psm_m=BESIDE)


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"approach": (0.0, 0.0, 0.0)}, NoApproach),
        ({"approach": (np.nan, 0.0, 1.0)}, BadInput),
        ({"base_mm": (1.0, 2.0, 3.0)}, BadPlan),
        ({"base_xyzw": (0.0, 0.0, 0.0, 1.0)}, BadPlan),
        ({"base_mm": (np.inf, 2.0, 3.0), "base_xyzw": (0.0, 0.0, 0.0, 1.0)}, BadInput),
        ({"base_mm": (1.0, 2.0, 3.0), "base_xyzw": (0.0, 0.0, 0.0, 0.0)}, BadPlan),
        ({"instrument": "470006"}, BadPlan),
        ({"enters": "later"}, BadPlan),
    ],
)
def test_what_cannot_be_meant_of_psm_m_is_refused(wrong, error):
    with pytest.raises(error):
        PsmM(**{"approach": PSM_M, **wrong})


def test_a_place_beyond_psm_m_is_named_with_arm_pass_phase_and_joint():
    away = PsmM(PSM_M, (400.0, 20.0, 20.0), BESIDE.base_xyzw)
    with pytest.raises(Unreachable, match="Pass 0, A1, PSM_M: Sample 0") as caught:
        planned(2, away)
    numbers = caught.value.numbers
    assert (numbers["arm"], numbers["pass"], numbers["phase"], numbers["joint"]) == ("PSM_M", 0, A1, "insertion")
    assert float(numbers["value"]) > float(numbers["limit"]) == 240.0
    # Its own instrument counts: an Si arm reaches 50 mm further.
    near = PsmM(PSM_M, (225.0, 20.0, 20.0), BESIDE.base_xyzw, "400006")
    si = PsmM(PSM_M, (225.0, 20.0, 20.0), BESIDE.base_xyzw, "420006")
    with pytest.raises(Unreachable):
        planned(1, near)
    assert planned(1, si).psm_m.instrument == "420006"


def test_the_same_plan_gives_the_same_bytes_of_both_arms():
    one, other = planned(2), planned(2)
    assert one.psm_m.joints.tobytes() == other.psm_m.joints.tobytes()
    assert one.joints.tobytes() == other.joints.tobytes()


@examples(60)
@given(held=st.integers(0, 500), end=st.integers(0, 600))
def test_a_stand_begins_after_the_last_sample_that_differs(held, end):
    motion = small_trajectory()
    joints = motion.joints.copy()
    joints[max(end - held, 0) : end + 1] = joints[end]
    begins = stands_from(replace(motion, joints=joints), end)
    stood = (np.abs(joints[: end + 1] - joints[end]) <= 1e-6).all(axis=1)
    assert stood[begins:].all() and (begins == 0 or not stood[begins - 1])
