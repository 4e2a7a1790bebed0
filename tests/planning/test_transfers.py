"""Transfers from one pass to the next: continuous, within the joints' speeds, with errors for unreachable places."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import BadPlan, Unreachable
from skills.kinematics import POINTING_DOWN, angle_between, instrument_of, matrix_of
from skills.planning.handoff import PsmM
from skills.planning.motion_laws import A1, A2, PEAK, TRANSFER
from skills.planning.trajectory import (
    PassPath,
    Trajectory,
    joint_ratios,
    seams,
    seconds_by_phase,
    time_parametrise,
    transfers,
)
from tests.by_day import examples
from tests.planning.motions import HAND_OFF_MM, PSM_M, hand_off

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
