"""The limits of the verdict: a sample must keep them by more than round-off, and they are the stated ones."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from skills.kinematics import CANNULA_MM, JOINTS, instrument_of
from skills.planning.trajectory import TRANSFER
from skills.verification.gates import TOLERANCE, Limits
from skills.verification.playback import LINKS
from skills.verification.verdict import judge
from tests.planning.motions import ideal_playback
from tests.verification.test_playback import HAND_OFF, SAMPLE, TRAJECTORY, beside, failed, planted, with_psm_m


def test_the_limits_are_those_that_the_documents_state():
    assert asdict(Limits()) == {
        "fk_mm": 0.01,
        "fk_deg": 0.01,
        "joint_margin": 0.0,
        "insertion_mm": CANNULA_MM,
        "speed_ratio": 1.000001,
        "acceleration_ratio": 1.000001,
        "tracking_mm": 0.1,
        "goal_mm": 0.05,
        "alignment_deg": 0.1,
        "clearance_pad_mm": 1.0,
        "clearance_psm_m_mm": 0.5,
        "clearance_bodies_mm": 2.0,
        "contact_n": 1.0,
        "contact_effort": 0.95,
    }


@pytest.mark.parametrize(
    ("name", "limit", "sample", "towards"),
    [
        ("tracking_mm", 0.1, SAMPLE, np.inf),
        ("tracking_mm", 0.05, HAND_OFF, np.inf),
        ("tracking_mm", 0.05, len(TRAJECTORY) - 1, np.inf),
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


@pytest.mark.parametrize(("ratio", "passes"), [(0.94, True), (0.96, False)])
def test_effort_in_contact_keeps_a_twentieth_in_reserve(ratio, passes):
    effort = np.array(planted("efforts", 0.0).efforts)
    effort[SAMPLE, -1] = -0.2 * ratio  # of the last joint's full effort, in either direction
    touching = replace(planted("contact_n", 0.1), efforts=effort)
    assert judge(touching, TRAJECTORY).feasible is passes
    assert judge(replace(touching, contact_n=np.zeros(len(TRAJECTORY))), TRAJECTORY).feasible


def test_an_effort_above_a_motors_limit_fails_without_contact_too():
    report = judge(planted("efforts", 0.2 * 1.001), TRAJECTORY)
    assert failed(report) == ("effort", SAMPLE)
    assert report.failure.limit == 1.000001


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
    free = Limits(speed_ratio=1e9, acceleration_ratio=1e9, insertion_mm=0.0)
    assert judge(near, TRAJECTORY, replace(free, joint_margin=0.019)).feasible
    assert failed(judge(near, TRAJECTORY, replace(free, joint_margin=0.021))) == (JOINTS[joint], SAMPLE)


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("side", ["lower", "upper"])
def test_a_joint_may_be_at_its_limit_and_no_further(joint, side):
    limit = getattr(instrument_of(TRAJECTORY.instrument), side)[joint]
    outwards = 1e-8 if side == "upper" else -1e-8
    measured = np.array(TRAJECTORY.joints)
    free = Limits(speed_ratio=1e9, acceleration_ratio=1e9, insertion_mm=-1.0)
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
