"""The judge: nothing wrong passes, and the first wrong sample is named."""

from dataclasses import replace

import numpy as np
import pytest

from skills.errors import BadInput
from skills.style.kinematics import forward, quaternion_of
from skills.style.playback import JudgeSettings, Playback, judge
from skills.style.trajectory import A1, A2, Trajectory
from tests.style.motions import ideal_playback, small_trajectory

TRAJECTORY = small_trajectory(passes=2, rate_hz=60.0)
SAMPLE = int(TRAJECTORY.last_samples[0]) + 40  # in A1 of the second pass


def planted(name: str, value: float, sample: int = SAMPLE) -> Playback:
    """An ideal playback with one wrong number in it."""
    playback = ideal_playback(TRAJECTORY)
    array = np.array(getattr(playback, name))
    array[sample] = value
    return replace(playback, **{name: array})


def test_an_ideal_playback_is_feasible():
    report = judge(ideal_playback(TRAJECTORY), TRAJECTORY)
    assert report.feasible
    assert report.failure is None
    assert report.unreachable_samples == 0
    assert report.turns_deg == pytest.approx((85.7, 85.7), abs=0.05)
    assert report.peak_acceleration_ratio == pytest.approx(TRAJECTORY.acceleration_ratio)
    assert report.least_margin_joint == "pitch"


@pytest.mark.parametrize(
    ("name", "value", "quantity", "limit"),
    [
        ("tracking_mm", 0.5, "servo error", 0.1),
        ("clearance_pad_mm", -0.2, "clearance to the pad", 1.0),
        ("tip_mm", 0.0, "tip off the closed form", 0.01),
    ],
)
def test_a_planted_fault_is_named_with_pass_phase_sample_value_and_limit(name, value, quantity, limit):
    report = judge(planted(name, value), TRAJECTORY)
    assert not report.feasible
    assert report.failure is not None
    assert (report.failure.quantity, report.failure.limit) == (quantity, limit)
    assert (report.failure.sample, report.failure.pass_index, report.failure.phase) == (SAMPLE, 1, A1)
    assert quantity in str(report.failure)


@pytest.mark.parametrize("name", ["tip_mm", "rotation_xyzw", "joints", "tracking_mm", "clearance_pad_mm"])
def test_nan_in_any_measurement_fails(name):
    report = judge(planted(name, np.nan), TRAJECTORY)
    assert not report.feasible
    assert report.failure is not None
    assert report.failure.sample in (SAMPLE - 1, SAMPLE)  # a NaN joint spoils the speed just before it, too


def test_nan_in_the_clearance_to_psm_m_fails_even_where_the_jaws_may_meet():
    clearance = np.full(len(TRAJECTORY), 20.0)
    clearance[-1] = np.nan
    assert TRAJECTORY.phase[-1] == A2
    assert not judge(replace(ideal_playback(TRAJECTORY), clearance_psm_m_mm=clearance), TRAJECTORY).feasible


def test_the_jaws_may_meet_in_a2_and_not_before():
    meeting = np.where(TRAJECTORY.phase == A2, -1.0, 20.0)
    assert judge(replace(ideal_playback(TRAJECTORY), clearance_psm_m_mm=meeting), TRAJECTORY).feasible
    early = judge(replace(ideal_playback(TRAJECTORY), clearance_psm_m_mm=meeting - 20.0), TRAJECTORY)
    assert early.failure is not None
    assert (early.failure.quantity, early.failure.sample) == ("clearance to PSM_M", 0)


def test_a_speed_above_the_limits_is_found_whatever_the_trajectory_claims():
    hurried = replace(TRAJECTORY, rate_hz=1000.0, stamps_s=TRAJECTORY.stamps_s * 60.0 / 1000.0)
    report = judge(ideal_playback(hurried), hurried)
    assert report.failure is not None
    assert "acceleration of" in report.failure.quantity or "speed of" in report.failure.quantity
    assert report.peak_speed_ratio > 1.0


def test_a_joint_beyond_its_limit_is_named():
    report = judge(planted("joints", 5.0), TRAJECTORY)  # every joint at 5 rad, the insertion at 5 mm
    assert report.failure is not None
    assert report.failure.sample in (SAMPLE - 1, SAMPLE)
    assert report.unreachable_samples == 1
    assert report.least_margin < 0


def test_a_wrist_inside_the_cannula_is_refused():
    joints = np.zeros((3, 6))
    joints[:, 2] = 30.0
    tip, rotation = forward(joints)
    inside = Trajectory(
        60.0, "400006", np.arange(3) / 60, tip, quaternion_of(rotation), joints, [0] * 3, [1] * 3, 1.0, 1.0, 0, 0, 0
    )
    failure = judge(ideal_playback(inside), inside).failure
    assert failure is not None
    assert (failure.quantity, failure.value, failure.limit) == ("insertion out of the cannula", 30.0, 35.0)


def test_the_earliest_of_several_faults_is_reported():
    late = planted("clearance_pad_mm", -1.0, SAMPLE + 5)
    both = replace(late, tracking_mm=planted("tracking_mm", 9.0, SAMPLE).tracking_mm)
    failure = judge(both, TRAJECTORY).failure
    assert failure is not None
    assert (failure.sample, failure.quantity) == (SAMPLE, "servo error")


def test_an_end_off_its_target_is_refused_though_the_way_there_was_tolerated():
    end = int(TRAJECTORY.last_samples[0])
    failure = judge(planted("tracking_mm", 0.08, end), TRAJECTORY).failure
    assert failure is not None
    assert (failure.quantity, failure.sample) == ("servo error at the goal", end)


def test_timings_are_no_part_of_the_report():
    quick = ideal_playback(TRAJECTORY)
    slow = replace(quick, seconds_per_step=1.0)
    assert judge(quick, TRAJECTORY) == judge(slow, TRAJECTORY)


def test_settings_decide_and_are_kept_in_the_report():
    strict = JudgeSettings(clearance_pad_mm=6.0)
    report = judge(ideal_playback(TRAJECTORY), TRAJECTORY, strict)
    assert not report.feasible
    assert report.settings == strict


def test_the_playback_of_another_trajectory_is_refused():
    with pytest.raises(BadInput, match="samples"):
        judge(ideal_playback(small_trajectory(1, rate_hz=60.0)), TRAJECTORY)
    with pytest.raises(BadInput, match="shape"):
        replace(ideal_playback(TRAJECTORY), tracking_mm=np.zeros(3))
