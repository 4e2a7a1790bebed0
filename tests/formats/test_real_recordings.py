import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skills.demonstration.demonstration import cut_demo
from skills.demonstration.segments import propose_segments
from skills.formats import read_recording
from skills.gridworld.grid import discretize, fit_grid
from tests.formats.bags import sample_folder


@pytest.fixture(scope="module")
def rosbag():
    with (sample_folder() / "rosbag2" / "rosbag2.mcap").open("rb") as file:
        return read_recording(file)


@pytest.fixture(scope="module")
def old():
    with (sample_folder() / "old_transform_stamped.mcap").open("rb") as file:
        return read_recording(file)


def test_the_same_motion_in_two_encodings_is_the_same_to_the_last_bit(rosbag, old):
    new_motion, old_motion = rosbag.motion_of(), old.motion_of()
    np.testing.assert_array_equal(new_motion.stamps_ns, old_motion.stamps_ns)
    np.testing.assert_array_equal(new_motion.tip_mm, old_motion.tip_mm)
    np.testing.assert_array_equal(new_motion.rotation_xyzw, old_motion.rotation_xyzw)


def test_the_same_motion_in_two_encodings_gives_the_same_path(rosbag, old):
    (moving, *_), grid = propose_segments(rosbag), None
    paths = []
    for recording in (replace(rosbag, clutch=None), old):  # the old one has no clutch, and so nothing to leave out
        tip_mm = cut_demo(recording, start_s=moving.start_s, end_s=moving.end_s).tip_mm
        grid = grid or fit_grid(tip_mm)
        paths.append(discretize(tip_mm, grid))
    assert len(paths[0].states) == 187
    np.testing.assert_array_equal(paths[0].states, paths[1].states)


def test_the_local_topic_is_preferred_to_the_one_in_the_camera_frame(rosbag):
    assert rosbag.motion_of().frame == "PSM2_base"
    assert cut_demo(rosbag, topic="/PSM2/measured_cp").frame == "ECM"


def test_a_bag_without_checksums_says_so(rosbag, old):
    assert (rosbag.integrity, old.integrity) == ("none", "full")


def test_the_topics_of_a_bag_are_counted(rosbag):
    assert {topic.name: topic.messages for topic in rosbag.topics} == {
        "/PSM2/local/measured_cp": 2000,
        "/PSM2/measured_cp": 2000,
        "/PSM2/jaw/measured_js": 2000,
        "/console/clutch": 5,
    }


def test_two_presses_are_counted_and_the_quick_tap_is_not(rosbag):
    assert cut_demo(rosbag).clutch_presses == 2


def test_what_was_recorded_while_the_clutch_was_down_is_left_out(rosbag):
    demo, whole = cut_demo(rosbag), cut_demo(replace(rosbag, clutch=None))
    assert [pause.cause for pause in demo.pauses] == ["clutch", "clutch"]
    inside = sum(((whole.stamps_s >= p.start_s) & (whole.stamps_s <= p.end_s)).sum() for p in demo.pauses)
    assert len(demo.stamps_s) == len(whole.stamps_s) - inside < len(whole.stamps_s)


def test_the_jaw_is_open_at_first_and_closed_in_the_middle(rosbag):
    jaw_rad = cut_demo(rosbag).jaw_rad
    assert jaw_rad is not None
    assert jaw_rad[0] == pytest.approx(0.9)
    assert jaw_rad[1000] < 0.5


def test_the_proposed_hand_off_starts_where_the_arm_starts_to_move(rosbag, old):
    for recording in (rosbag, old):
        (segment,) = propose_segments(recording, "PSM2")
        assert segment.start_s == pytest.approx(7.0, abs=0.3)
        assert segment.end_s > 19.0


@pytest.mark.needs("paper")
def test_the_papers_table_and_its_bag_agree_on_position_and_orientation(old):
    with Path(os.environ["SKILLS_PAPER_DATA"], "psm_poses_500hz.csv").open("rb") as file:
        motion = read_recording(file, rate_hz=500.0).motion_of()
    every_fifth = slice(0, 10_000, 5)  # the bag is the table thinned from 500 to 100 Hz
    np.testing.assert_array_equal(motion.tip_mm[every_fifth], old.motion_of().tip_mm)
    np.testing.assert_allclose(motion.rotation_xyzw[every_fifth], old.motion_of().rotation_xyzw, rtol=0, atol=1e-12)


def test_the_sample_of_a_real_bag_that_goes_back_is_dropped_and_counted():
    with (sample_folder() / "calibration" / "pitch_exp_traj_02_test_cropped.bag").open("rb") as file:
        bag = read_recording(file)
    motion, joints = bag.motion_of(), bag.joints[0]
    assert (len(motion.stamps_ns), motion.backward_stamps, motion.duplicate_stamps) == (3299, 1, 0)
    assert (len(joints.stamps_ns), joints.backward_stamps) == (3299, 1)
    assert (motion.frame, bag.left_out) == ("ECM", ())
