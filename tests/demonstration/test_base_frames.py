"""The place of an arm's base, computed from its pose in its own base and in another frame."""

from dataclasses import replace

import numpy as np
import pytest

from skills.demonstration.recording import PAIR_NS, Motion, Recording, base_frames
from skills.formats import read_recording
from skills.kinematics import angle_between, matrix_of, quaternion_of
from tests.formats.bags import sample_folder

BASE_MM = np.array([120.0, -40.0, 250.0])
TURN = np.array([0.2, -0.5, 0.4, 0.74])
TURN /= np.linalg.norm(TURN)
STAMPS_NS = 10**18 + np.arange(200) * 10**7


def turns(rng, count):
    drawn = rng.normal(size=(count, 4))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def local(rng):
    tip_mm = rng.uniform(-100, 100, (200, 3))
    return Motion("PSM1", "/PSM1/local/measured_cp", "PSM1_base", STAMPS_NS, tip_mm, turns(rng, 200))


def seen(motion, *, moved_mm=0.0, turned_rad=0.0, late_ns=0, topic="/PSM1/measured_cp", frame="ECM"):
    """Express a motion in the frame in which the base stands; in the second half of the time the base may move."""
    base = np.tile(matrix_of(TURN[None]), (len(motion.stamps_ns), 1, 1))
    half = np.arange(len(base)) >= len(base) // 2 + 1
    little = matrix_of(np.array([[np.sin(turned_rad / 2), 0.0, 0.0, np.cos(turned_rad / 2)]]))[0]
    base[half] = base[half] @ little
    place = BASE_MM + np.where(half, moved_mm, 0.0)[:, None] * (1.0, 0.0, 0.0)
    tip_mm = place + np.einsum("tij,tj->ti", base, motion.tip_mm)
    rotation = quaternion_of(base @ matrix_of(motion.rotation_xyzw))
    return Motion(motion.arm, topic, frame, motion.stamps_ns + late_ns, tip_mm, rotation)


def of(*motions):
    return base_frames(Recording(format="mcap", integrity="full", motions=motions))


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def test_a_base_that_stood_still_is_found_exactly(rng):
    motion = local(rng)
    (base,) = of(motion, seen(motion))
    assert (base.arm, base.frame, base.local_frame) == ("PSM1", "ECM", "PSM1_base")
    np.testing.assert_allclose(base.position_mm, BASE_MM, rtol=0, atol=1e-9)
    assert angle_between(matrix_of(np.array([base.rotation_xyzw])), matrix_of(TURN[None]))[0] < 1e-9
    assert base.spread_mm < 1e-9
    assert base.spread_rad < 1e-7


def test_two_local_poses_of_an_arm_place_no_base(rng):
    motion = local(rng)
    assert of(motion, replace(motion, topic="/PSM1/local/filtered_cp", frame="PSM1_filtered")) == ()


def test_a_base_that_moved_says_how_far(rng):
    motion = local(rng)
    (base,) = of(motion, seen(motion, moved_mm=7.0))
    assert base.spread_mm == pytest.approx(7.0, abs=1e-6)
    np.testing.assert_allclose(base.position_mm, BASE_MM, rtol=0, atol=1e-6)
    (base,) = of(motion, seen(motion, turned_rad=0.1))
    assert base.spread_rad == pytest.approx(0.1, abs=1e-6)
    assert base.spread_mm > 5.0


def test_one_pose_that_is_wrong_changes_the_spread_and_not_the_base(rng):
    motion = local(rng)
    tip_mm = seen(motion).tip_mm.copy()
    tip_mm[17] += 30.0
    (base,) = of(motion, replace(seen(motion), tip_mm=tip_mm))
    np.testing.assert_allclose(base.position_mm, BASE_MM, rtol=0, atol=1e-6)
    assert base.spread_mm == pytest.approx(30.0 * np.sqrt(3.0))


def test_poses_are_paired_by_the_nearest_stamp_within_2_ms(rng):
    motion = local(rng)
    for late_ns in (-PAIR_NS, -1, PAIR_NS):
        (base,) = of(motion, seen(motion, late_ns=late_ns))
        assert base.spread_mm < 1e-9
    assert of(motion, seen(motion, late_ns=PAIR_NS + 1)) == ()


def test_a_base_is_told_only_where_both_poses_are_there_and_turned(rng):
    motion = local(rng)
    other = seen(motion)
    assert of(motion) == of(other) == ()
    assert of(motion, replace(other, arm="PSM2")) == ()
    assert of(motion, replace(other, frame="PSM1_base")) == ()
    assert of(motion, replace(other, rotation_xyzw=None)) == ()
    one = slice(0, 1)
    single = Motion(motion.arm, motion.topic, motion.frame, STAMPS_NS[one], motion.tip_mm[one], TURN[None])
    assert of(single, other) == of(replace(single, topic="/a"), motion) == ()


def test_quaternions_of_the_other_sign_are_the_same_turns(rng):
    motion = local(rng)
    signs = np.where(rng.random(200) < 0.5, -1.0, 1.0)[:, None]
    other = seen(motion)
    one, two = of(motion, other), of(motion, replace(other, rotation_xyzw=other.rotation_xyzw * signs))
    np.testing.assert_allclose(one[0].position_mm, two[0].position_mm, rtol=0, atol=1e-9)
    assert two[0].spread_rad < 1e-7


def test_where_orientations_do_not_fit_the_tips_the_tips_decide(rng):
    motion = local(rng)
    other = replace(seen(motion), rotation_xyzw=motion.rotation_xyzw)
    (base,) = of(motion, other)
    np.testing.assert_allclose(base.position_mm, BASE_MM, rtol=0, atol=1e-6)
    assert base.spread_mm < 1e-6
    off_rad = angle_between(matrix_of(TURN[None]), np.eye(3)[None])[0]
    assert base.spread_rad == pytest.approx(off_rad, abs=1e-6)


def test_the_recorded_arms_base_stands_still_in_the_camera_frame():
    """In this bag the tips were rotated by 90 degrees and shifted, while the orientations were left unchanged."""
    with (sample_folder() / "rosbag2" / "rosbag2.mcap").open("rb") as file:
        recording = read_recording(file)
    (base,) = base_frames(recording)
    assert (base.arm, base.frame, base.local_frame) == ("PSM2", "ECM", "PSM2_base")
    assert base.position_mm == pytest.approx((20.0, -10.0, 100.0), abs=1e-6)
    assert base.rotation_xyzw == pytest.approx((0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)), abs=1e-9)
    assert base.spread_mm < 1e-6
    assert base.spread_rad == pytest.approx(np.pi / 2)
