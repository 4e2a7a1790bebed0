"""The verdict: each gate, each limit, and its figures."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from skills.errors import BadInput
from skills.kinematics import CANNULA_MM, JOINTS, POINTING_DOWN, forward, instrument_of, inverse, quaternion_of
from skills.planning.handoff import OtherArm
from skills.planning.trajectory import A1, A2, TRANSFER, Trajectory
from skills.verification.gates import TOLERANCE, Limits
from skills.verification.playback import LINKS, Playback, link_pairs
from skills.verification.verdict import PlaybackReport, judge
from tests.planning.motions import PSM_M, ideal_playback, small_trajectory

TRAJECTORY = small_trajectory(passes=2, rate_hz=60.0)
SAMPLE = int(np.flatnonzero((TRAJECTORY.pass_index == 1) & (TRAJECTORY.phase == A1))[20])
HAND_OFF = int(TRAJECTORY.last_samples[0])


def planted(name: str, value: float, sample: int = SAMPLE) -> Playback:
    """Return an ideal playback with one wrong number in it."""
    playback = ideal_playback(TRAJECTORY)
    array = np.array(getattr(playback, name))
    array[sample] = value
    return replace(playback, **{name: array})


def beside(trajectory: Trajectory = TRAJECTORY) -> Trajectory:
    """Return the same with a PSM_M that stands still, 200 mm away and rotated about the vertical."""
    joints = inverse([[0.0, 55.0, -135.0]], POINTING_DOWN)
    half = np.sqrt(0.5)
    other = OtherArm([200.0, 0.0, 0.0], [0.0, 0.0, half, half], "400006", np.tile(joints, (len(trajectory), 1)))
    return replace(trajectory, psm_m=other)


def with_psm_m(clearance: np.ndarray | float = 20.0, pair: str = "PSM_A finger_1 to PSM_M finger_2") -> Playback:
    """Return an ideal playback of `beside`, with one pair of links at a given distance."""
    count = len(TRAJECTORY)
    seen = np.full((count, 24), 20.0)
    seen[:, [str(one) for one in link_pairs(True)].index(pair)] = clearance
    tip = np.tile([200.0 - 55.0, 0.0, -135.0], (count, 1))
    return replace(ideal_playback(TRAJECTORY), clearances_mm=seen, psm_m_tip_mm=tip)


def failed(report: PlaybackReport) -> tuple[str, int]:
    assert not report.feasible
    assert report.failure is not None
    return report.failure.quantity, report.failure.sample


def test_an_ideal_playback_is_feasible():
    report = judge(ideal_playback(TRAJECTORY), TRAJECTORY)
    assert report.feasible
    assert report.failure is None
    assert report.unreachable_samples == 0
    assert [end.turn_deg for end in report.ends] == pytest.approx([85.7, 85.7], abs=0.05)
    assert report.peak_acceleration_ratio == pytest.approx(TRAJECTORY.acceleration_ratio)
    assert report.least_margin_joint == "pitch"
    assert not report.psm_m_in_scene
    assert [arm.name for arm in report.arms] == ["PSM_A"]
    assert report.arms[0].instrument.shaft_mm == 416.2


@pytest.mark.parametrize(
    ("name", "value", "quantity", "limit"),
    [
        ("clearances_mm", -0.2, "clearance of PSM_A roll_link to the pad", 1.0),
        ("tip_mm", 0.0, "tip off the closed form", 0.01),
        ("shaft_off_mm", 0.02, "shaft off the remote centre", 0.01),
        ("contact_n", 1.5, "force of contact", 1.0),
    ],
)
def test_a_planted_fault_is_named_with_pass_phase_sample_value_and_limit(name, value, quantity, limit):
    report = judge(planted(name, value), TRAJECTORY)
    assert failed(report) == (quantity, SAMPLE)
    assert (report.failure.limit, report.failure.pass_index, report.failure.phase) == (limit, 1, A1)
    assert "Pass 1, A1" in str(report.failure)
    assert quantity in str(report.failure)


@pytest.mark.parametrize(
    "name",
    ["tip_mm", "rotation_xyzw", "joints", "clearances_mm", "contact_n", "shaft_off_mm"],
)
def test_nan_in_any_measurement_fails(name):
    _, sample = failed(judge(planted(name, np.nan), TRAJECTORY))
    assert sample in (SAMPLE - 1, SAMPLE)  # a NaN joint also invalidates the speed just before it


def test_a_joint_beyond_its_limit_is_named():
    report = judge(planted("joints", 5.0), TRAJECTORY)  # every joint at 5 rad, the insertion at 5 mm
    assert failed(report)[1] in (SAMPLE - 1, SAMPLE)
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


def test_a_speed_above_the_limits_is_found_whatever_the_trajectory_claims():
    hurried = replace(TRAJECTORY, rate_hz=1000.0, stamps_s=TRAJECTORY.stamps_s * 60.0 / 1000.0)
    report = judge(ideal_playback(hurried), hurried)
    assert "acceleration of" in failed(report)[0]
    assert report.peak_speed_ratio > 1.0


def test_stamps_closer_than_the_rate_says_are_a_hidden_speed_and_found():
    stamps = np.array(TRAJECTORY.stamps_s)
    stamps[SAMPLE:] -= 0.5 / 60.0
    hurried = replace(TRAJECTORY, stamps_s=stamps)
    report = judge(ideal_playback(hurried), hurried)
    assert failed(report) == ("time since the sample before", SAMPLE)
    assert report.failure.value == pytest.approx(0.5)


def test_a_pose_that_leaps_between_passes_is_found_though_a_second_goes_by():
    leap = HAND_OFF + 1
    joints = np.array(TRAJECTORY.joints)
    joints[leap:, 2] += 5.0
    tip, rotation = forward(joints)
    leaping = replace(TRAJECTORY, joints=joints, tip_mm=tip, rotation_xyzw=quaternion_of(rotation))
    quantity, sample = failed(judge(ideal_playback(leaping), leaping))
    assert quantity in ("speed of insertion", "acceleration of insertion")
    assert sample in (HAND_OFF, leap)


def test_the_earliest_of_several_faults_is_reported():
    late = planted("clearances_mm", -1.0, SAMPLE + 5)
    both = replace(late, contact_n=planted("contact_n", 9.0, SAMPLE).contact_n)
    assert failed(judge(both, TRAJECTORY)) == ("force of contact", SAMPLE)


# ---- distances -------------------------------------------------------------------------------------------------


def test_what_nobody_looked_at_counts_as_near_as_it_may_have_come():
    whole = ideal_playback(TRAJECTORY)
    looked_at = np.append(np.arange(0, len(TRAJECTORY) - 1, 12), len(TRAJECTORY) - 1)
    seldom = replace(
        whole,
        looked_at=looked_at,
        clearances_mm=np.full((len(looked_at), 4), 1.01),
        shaft_off_mm=np.zeros(len(looked_at)),
    )
    quantity, sample = failed(judge(seldom, TRAJECTORY))
    assert "clearance of PSM_A" in quantity
    assert sample not in looked_at
    report = judge(replace(seldom, clearances_mm=np.full((len(looked_at), 4), 30.0)), TRAJECTORY)
    assert report.feasible
    assert report.moved_between_looks_mm > 1.0
    nearest = report.clearances[0]
    assert nearest.least_mm == 30.0
    assert 30.0 - report.moved_between_looks_mm / 2 - 1e-9 <= nearest.at_least_mm < 30.0


def test_the_nearest_links_are_named_in_each_phase():
    seen = np.full((len(TRAJECTORY), 4), 50.0)
    seen[SAMPLE, LINKS.index("finger_2")] = 7.0
    seen[HAND_OFF, LINKS.index("wrist_pitch_link")] = 6.0
    report = judge(replace(ideal_playback(TRAJECTORY), clearances_mm=seen), TRAJECTORY)
    found = [(one.phase, one.link, one.other, one.least_mm, one.sample) for one in report.clearances]
    expected = [("A1", "finger_2", "pad", 7.0, SAMPLE), ("A2", "wrist_pitch_link", "pad", 6.0, HAND_OFF)]
    assert found == expected
    assert report.clearance_pad_mm == 6.0


@pytest.mark.parametrize("other", ["wrist_pitch_link", "roll_link"])
def test_only_fingers_may_meet(other):
    meeting = np.full(len(TRAJECTORY), 20.0)
    meeting[HAND_OFF] = 0.2
    pair = f"PSM_A finger_1 to PSM_M {other}"
    assert failed(judge(with_psm_m(meeting, pair), beside())) == (f"clearance of {pair}", HAND_OFF)


def test_the_fingers_may_meet_at_the_hand_off_and_while_they_part():
    meeting = np.full(len(TRAJECTORY), 20.0)
    meeting[HAND_OFF : HAND_OFF + 4] = -0.1, -0.1, 0.2, 0.4
    assert TRAJECTORY.phase[HAND_OFF + 3] == TRANSFER
    report = judge(with_psm_m(meeting), beside())
    assert report.feasible, report.failure
    assert report.clearance_psm_m_mm == -0.1


@pytest.mark.parametrize("sample", [SAMPLE, HAND_OFF - 1, HAND_OFF + 6])
def test_the_fingers_may_not_meet_before_the_hand_off_nor_again_after_it(sample):
    meeting = np.full(len(TRAJECTORY), 20.0)
    meeting[HAND_OFF] = -0.1
    meeting[sample] = 0.4
    assert failed(judge(with_psm_m(meeting), beside())) == ("clearance of PSM_A finger_1 to PSM_M finger_2", sample)


def test_nan_between_fingers_fails_even_where_they_may_meet():
    meeting = np.full(len(TRAJECTORY), 20.0)
    meeting[-1] = np.nan
    assert TRAJECTORY.phase[-1] == A2
    assert failed(judge(with_psm_m(meeting), beside()))[1] == len(TRAJECTORY) - 1


# ---- PSM_M -----------------------------------------------------------------------------------------------------


def test_psm_ms_own_faults_are_named_as_its_own():
    def changed(joint: int, sample: slice, value: float) -> Trajectory:
        whole = beside()
        joints = np.array(whole.psm_m.joints)
        joints[sample, joint] += value
        return replace(whole, psm_m=replace(whole.psm_m, joints=joints))

    near_limit = np.radians(91.0) - beside().psm_m.joints[0, 0] + 0.01
    assert failed(judge(with_psm_m(), changed(0, slice(None), near_limit))) == ("PSM_M's yaw", 0)
    quantity, sample = failed(judge(with_psm_m(), changed(2, slice(SAMPLE, None), 5.0)))
    assert quantity == "speed of PSM_M's insertion"
    assert sample == SAMPLE - 1  # by the difference to the next one


def test_psm_m_elsewhere_than_its_joints_say_is_found():
    playback = with_psm_m()
    moved = np.array(playback.psm_m_tip_mm)
    moved[SAMPLE] += 0.02
    report = judge(replace(playback, psm_m_tip_mm=moved), beside())
    assert failed(report) == ("PSM_M's tip off the closed form", SAMPLE)
    assert judge(playback, beside()).psm_m_fk_error_mm < 1e-9


def test_the_jaws_angles_to_psm_ms_approach_are_told_where_that_is_known():
    [first, _] = judge(ideal_playback(TRAJECTORY), TRAJECTORY, approach_m=PSM_M).ends
    assert first.n_to_a_m_deg == pytest.approx(0.0, abs=1e-6)
    assert first.a_to_a_m_deg == pytest.approx(90.0, abs=1e-6)
    assert judge(ideal_playback(TRAJECTORY), TRAJECTORY).ends[0].n_to_a_m_deg is None
    [own, _] = judge(with_psm_m(), beside(), approach_m=PSM_M).ends  # its own pose: straight down
    assert own.a_to_a_m_deg == pytest.approx(np.degrees(np.arccos(-forward(TRAJECTORY.joints)[1][HAND_OFF, 2, 2])))


# ---- the report ------------------------------------------------------------------------------------------------


def test_settings_decide_and_are_kept_in_the_report():
    strict = Limits(clearance_pad_mm=6.0)
    report = judge(ideal_playback(TRAJECTORY), TRAJECTORY, strict)
    assert not report.feasible
    assert report.settings == strict


def test_the_playback_of_another_trajectory_is_refused():
    with pytest.raises(BadInput, match="samples"):
        judge(ideal_playback(small_trajectory(1, rate_hz=60.0)), TRAJECTORY)
    with pytest.raises(BadInput, match="PSM_M"):
        judge(ideal_playback(TRAJECTORY), beside())
    with pytest.raises(BadInput, match="shape"):
        replace(ideal_playback(TRAJECTORY), tracking_mm=np.zeros(3))
    with pytest.raises(BadInput, match="first"):
        replace(ideal_playback(TRAJECTORY), looked_at=np.arange(len(TRAJECTORY))[::-1])


def test_the_limits_are_those_that_the_documents_state():
    assert asdict(Limits()) == {
        "fk_mm": 0.01,
        "fk_deg": 0.01,
        "joint_margin": 0.0,
        "insertion_mm": CANNULA_MM,
        "speed_ratio": 1.000001,
        "acceleration_ratio": 1.000001,
        "jerk_ratio": 0.32,
        "vibration_counts": 1.0,
        "alignment_deg": 0.1,
        "clearance_pad_mm": 1.0,
        "clearance_psm_m_mm": 0.5,
        "clearance_bodies_mm": 2.0,
        "contact_n": 1.0,
    }


@pytest.mark.parametrize(
    ("name", "limit", "sample", "towards"),
    [
        ("clearances_mm", 1.0, SAMPLE, -np.inf),
        ("contact_n", 1.0, SAMPLE, np.inf),
        ("shaft_off_mm", 0.01, SAMPLE, np.inf),
    ],
)
def test_a_sample_within_its_tolerance_of_a_limit_is_refused(name, limit, sample, towards):
    within = limit - 1.1 * np.copysign(TOLERANCE, towards)
    assert judge(planted(name, within, sample), TRAJECTORY).feasible
    report = judge(planted(name, limit - 0.9 * np.copysign(TOLERANCE, towards), sample), TRAJECTORY)
    assert failed(report)[1] == sample
    assert report.failure.limit == limit


def test_between_arms_the_limit_of_the_arms_counts():
    pair = "PSM_A roll_link to PSM_M roll_link"
    apart = np.full(len(TRAJECTORY), 20.0)
    apart[SAMPLE] = 0.5 + 1.1 * TOLERANCE
    assert judge(with_psm_m(apart, pair), beside()).feasible
    apart[SAMPLE] = 0.5 + 0.9 * TOLERANCE
    assert failed(judge(with_psm_m(apart, pair), beside())) == (f"clearance of {pair}", SAMPLE)


def turned(degrees: float, sample: int):
    """Return an ideal playback in which the tip is turned about its own first axis at one sample."""
    half = np.radians(degrees) / 2
    rotation = np.array(TRAJECTORY.rotation_xyzw)
    x, y, z, w = rotation[sample]
    c, s = np.cos(half), np.sin(half)
    rotation[sample] = [x * c + w * s, y * c + z * s, z * c - y * s, w * c - x * s]
    return replace(ideal_playback(TRAJECTORY), rotation_xyzw=rotation)


def test_a_turn_of_the_jaw_is_measured_in_degrees():
    assert judge(turned(0.009, SAMPLE), TRAJECTORY).feasible
    report = judge(turned(0.011, SAMPLE), TRAJECTORY)
    assert failed(report) == ("rotation off the closed form", SAMPLE)
    assert report.failure.value == pytest.approx(0.011, rel=1e-6)


def test_a_rotation_that_is_none_fails_though_its_axis_and_angle_are_right():
    rotation = np.array(TRAJECTORY.rotation_xyzw)
    rotation[SAMPLE] *= 1.1
    report = judge(replace(ideal_playback(TRAJECTORY), rotation_xyzw=rotation), TRAJECTORY)
    assert failed(report) == ("rotation off the closed form", SAMPLE)
    assert np.isnan(report.failure.value)


def test_at_the_goal_the_alignment_has_its_own_limit():
    loose = Limits(fk_deg=1.0)
    assert judge(turned(0.2, SAMPLE), TRAJECTORY, loose).feasible
    assert judge(turned(0.09, HAND_OFF), TRAJECTORY, loose).feasible
    assert failed(judge(turned(0.11, HAND_OFF), TRAJECTORY, loose)) == ("alignment error", HAND_OFF)


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("side", ["lower", "upper"])
def test_a_margin_of_the_joints_is_a_part_of_their_range(joint, side):
    tool = instrument_of(TRAJECTORY.instrument)
    part = 0.02 if side == "lower" else 0.98
    measured = np.array(TRAJECTORY.joints)
    measured[SAMPLE, joint] = ((1 - part) * tool.lower + part * tool.upper)[joint]
    near = replace(ideal_playback(TRAJECTORY), joints=measured)
    free = Limits(speed_ratio=1e9, acceleration_ratio=1e9, jerk_ratio=1e9, vibration_counts=1e9, insertion_mm=0.0)
    assert judge(near, TRAJECTORY, replace(free, joint_margin=0.019)).feasible
    assert failed(judge(near, TRAJECTORY, replace(free, joint_margin=0.021))) == (JOINTS[joint], SAMPLE)


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("side", ["lower", "upper"])
def test_a_joint_may_be_at_its_limit_and_no_further(joint, side):
    limit = getattr(instrument_of(TRAJECTORY.instrument), side)[joint]
    outwards = 1e-8 if side == "upper" else -1e-8
    measured = np.array(TRAJECTORY.joints)
    free = Limits(speed_ratio=1e9, acceleration_ratio=1e9, jerk_ratio=1e9, vibration_counts=1e9, insertion_mm=-1.0)
    measured[SAMPLE, joint] = limit
    assert judge(replace(ideal_playback(TRAJECTORY), joints=measured), TRAJECTORY, free).feasible
    measured[SAMPLE, joint] = limit + outwards
    beyond = judge(replace(ideal_playback(TRAJECTORY), joints=measured), TRAJECTORY, free)
    assert failed(beyond) == (JOINTS[joint], SAMPLE)


@pytest.mark.parametrize(("early", "passes"), [(1e-7, True), (1e-5, False)])
def test_stamps_may_be_early_by_round_off_alone(early, passes):
    stamps = np.array(TRAJECTORY.stamps_s)
    stamps[SAMPLE:] -= early / TRAJECTORY.rate_hz
    hurried = replace(TRAJECTORY, stamps_s=stamps)
    assert judge(ideal_playback(hurried), hurried).feasible is passes


def test_the_transfer_alone_excuses_fingers_after_the_hand_off():
    pair = "PSM_A finger_1 to PSM_M finger_2"
    apart = np.full(len(TRAJECTORY), 20.0)
    after = int(np.flatnonzero((np.arange(len(TRAJECTORY)) > HAND_OFF) & (TRAJECTORY.phase != TRANSFER))[0])
    apart[HAND_OFF : after + 1] = 0.4
    assert failed(judge(with_psm_m(apart), beside())) == (f"clearance of {pair}", after)


def test_of_two_pairs_too_near_at_one_sample_the_nearer_is_reported():
    seen = np.full((len(TRAJECTORY), 4), 5.0)
    seen[:, LINKS.index("finger_2")] = 50.0
    seen[SAMPLE, LINKS.index("roll_link")], seen[SAMPLE, LINKS.index("finger_2")] = 0.5, 0.2
    report = judge(replace(ideal_playback(TRAJECTORY), clearances_mm=seen), TRAJECTORY)
    assert failed(report) == ("clearance of PSM_A finger_2 to the pad", SAMPLE)
