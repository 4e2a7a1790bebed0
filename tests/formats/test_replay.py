"""The bag for replay: its content, and how other programs read it."""

from math import radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from skills.errors import BadBag, BadPlan
from skills.formats import replay_bag
from skills.kinematics import forward
from skills.planning.handoff import JAW_CLOSED_RAD, JAW_OPEN_RAD, JAW_S, OPEN_RAD
from skills.planning.trajectory import time_parametrise
from tests.formats.replays import FRAME, PSM1, PSM2, RATE_HZ, arm, checked, members, papers, trajectory, unpacked
from tests.planning.motions import hand_off
from tests.planning.test_trajectory import BESIDE


def kept_by_the_robots_script(read: list[tuple[str, Any]], topic: str) -> tuple[list[Any], int]:
    """Select messages as `dvrk_bag_replay.py` does: in the bag's order, none that is not later than the one before."""
    previous_s, kept, dropped = 0.0, [], 0
    for name, said in read:
        if name == topic:
            stamp_s = said.header.stamp.sec + said.header.stamp.nanosec / 1e9
            if stamp_s <= previous_s:
                dropped += 1
            else:
                kept.append(said)
                previous_s = stamp_s
    return kept, dropped


def by_rosbags(folder: Path) -> list[tuple[str, Any]]:
    with AnyReader([folder]) as reader:
        return [(c.topic, reader.deserialize(data, c.msgtype)) for c, _, data in reader.messages()]


def by_mcap_ros2(folder: Path) -> list[tuple[str, Any]]:
    with (folder / f"{folder.name}.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [(channel.topic, said) for _, channel, _, said in reader.iter_decoded_messages()]


# ---- the robot's own script -------------------------------------------------------------------------------------


@pytest.mark.parametrize("read", [by_rosbags, by_mcap_ros2])
@pytest.mark.parametrize("topics", [PSM2, PSM1])
def test_the_robots_script_keeps_every_sample_of_the_trajectory_exactly(tmp_path, read, topics):
    made, folder = trajectory(), unpacked(tmp_path, members())
    said = read(folder / topics[0].split("/")[1])
    assert {name for name, _ in said} == set(topics)
    (joints, no_joints), (tips, no_tips), (jaws, no_jaws) = (kept_by_the_robots_script(said, topic) for topic in topics)
    assert (no_joints, no_tips, no_jaws) == (0, 0, 0)
    assert len(joints) == len(tips) == len(jaws) == len(made)
    meant = made.joints if topics is PSM2 else made.psm_m.joints
    metric = np.stack([*meant[:, :2].T, meant[:, 2] / 1000.0, *meant[:, 3:].T], axis=1)
    assert np.array_equal([list(one.position) for one in joints], metric)
    assert {tuple(one.name) for one in joints} == {("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")}
    assert {one.header.frame_id for one in joints} == {""}
    places = np.array([[one.pose.position.x, one.pose.position.y, one.pose.position.z] for one in tips])
    if topics is PSM2:
        assert np.array_equal(places, made.tip_mm / 1000.0)
        turns = [[getattr(one.pose.orientation, axis) for axis in "xyzw"] for one in tips]
        assert np.array_equal(turns, made.rotation_xyzw)
    np.testing.assert_allclose(
        places * 1000.0, forward(meant, "400006" if topics is PSM2 else "420006")[0], rtol=0, atol=1e-9
    )  # mm
    assert {one.header.frame_id for one in tips} == {f"{topics[0][1:5]}_base"}
    assert {tuple(one.position) + tuple(one.velocity) for one in jaws} == {
        (0.1, 0.0) if topics is PSM2 else (2 * OPEN_RAD, 0.0)
    }
    stamps_ns = [one.header.stamp.sec * 10**9 + one.header.stamp.nanosec for one in jaws]
    np.testing.assert_array_equal(stamps_ns, replay_bag.EPOCH_NS + np.rint(made.stamps_s * 1e9).astype(int))


def test_the_robots_script_waits_between_setpoints_as_planned(tmp_path):
    kept, _ = kept_by_the_robots_script(by_rosbags(unpacked(tmp_path, members()) / "PSM2"), PSM2[0])
    stamps_s = np.array([one.header.stamp.sec + one.header.stamp.nanosec / 1e9 for one in kept])
    np.testing.assert_allclose(np.diff(stamps_s), np.diff(trajectory().stamps_s), rtol=0, atol=2e-9)  # s


def test_where_a_robot_waits_its_last_velocity_is_none(tmp_path):
    kept, _ = kept_by_the_robots_script(by_mcap_ros2(unpacked(tmp_path, members()) / "PSM2"), PSM2[0])
    speeds = np.array([one.velocity for one in kept])
    assert np.flatnonzero((speeds == 0).all(axis=1)).tolist() == [0, 80, 81, 161]
    steps = np.diff(np.array([one.position for one in kept]), axis=0) * RATE_HZ
    np.testing.assert_allclose(speeds[1:80], (steps[:79] + steps[1:80]) / 2, rtol=0, atol=1e-9)  # rad/s and m/s


@settings(deadline=None)
@given(st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_velocities_carry_the_joints_from_rest_to_rest(count, seed):
    """The velocities' trapezoidal integral is the path, up to end corrections of a quarter step on either side."""
    rng = np.random.default_rng(seed)
    q = np.cumsum(rng.normal(size=(count, 6)), axis=0)
    stamps_ns = replay_bag.EPOCH_NS + np.arange(count) * 5_000_000
    v = replay_bag.velocities_of(stamps_ns, q, RATE_HZ)
    assert (v[[0, -1]] == 0).all()
    if count > 3:
        way = (q[-1] + q[-2] - q[0] - q[1]) / 2
        np.testing.assert_allclose(v.sum(axis=0) / RATE_HZ, way, rtol=0, atol=1e-9)


# ---- the content ------------------------------------------------------------------------------------------------


def test_the_same_trajectory_gives_the_same_bytes():
    again = [
        replay_bag.folder_of(one, "1" * 64)
        for one in replay_bag.arms_of(trajectory(), arm="PSM2", frame=FRAME, other="PSM1", jaw_rad=0.1)
    ]
    assert replay_bag.seal(papers(trajectory()) | again[0] | again[1]) == replay_bag.seal(members())


def test_the_timetable_has_every_phase_and_hand_over_on_one_clock():
    """Two passes of 81 samples at 200 Hz, 60 of A1 and 21 of A2, a second apart; stamps begin at 1 s."""
    arms = replay_bag.arms_of(trajectory(), arm="PSM2", frame=FRAME, other="PSM1", jaw_rad=0.1)
    first, second = replay_bag.pass_times(trajectory(), arms)
    assert first.phases == [
        replay_bag.PhaseTimes(phase="A1", from_ns=1_000_000_000, to_ns=1_295_000_000),
        replay_bag.PhaseTimes(phase="A2", from_ns=1_300_000_000, to_ns=1_400_000_000),
    ]
    assert first.hand_over is first.take_back is None  # the jaws of this motion do not move
    assert second.phases[0].from_ns == 2_405_000_000
    alone = replay_bag.arms_of(trajectory(), arm="PSM2", frame=FRAME, other="PSM1", jaw_rad=0.1, pass_index=1)
    assert replay_bag.pass_times(trajectory(), alone) == [second]


def test_the_timetable_states_when_the_needle_changes_hands():
    """PSM_M's jaw closes before PSM_A's opens, and in a further pass the other way round; both by the setpoints."""
    motion = time_parametrise([hand_off(), hand_off(-8.0)], rate_hz=100.0, psm_m=BESIDE)
    arms = replay_bag.arms_of(motion, arm="PSM2", frame=FRAME, other="PSM1")
    first, second = replay_bag.pass_times(motion, arms)
    assert first.take_back is None
    for change, order in ((first.hand_over, ("PSM1", "PSM2")), (second.take_back, ("PSM2", "PSM1"))):
        closes, opens = change.jaws_in_order
        assert (closes.arm, opens.arm) == order
        assert (closes.jaw_rad, opens.jaw_rad) == (JAW_CLOSED_RAD, JAW_OPEN_RAD)
        assert change.at_ns == closes.from_ns < closes.to_ns == opens.from_ns < opens.to_ns
        assert opens.to_ns - closes.from_ns == pytest.approx(2e9 * JAW_S, abs=2.1e7)
        for one in change.jaws_in_order:
            (arm,) = (arm for arm in arms if arm.name == one.arm)
            assert arm.jaw_rad[arm.stamps_ns == one.to_ns] == one.jaw_rad
    held = np.minimum(*(arm.jaw_rad for arm in arms))
    assert (held == JAW_CLOSED_RAD).all()  # at every sample one of both holds the needle


def test_sha256sum_itself_reads_the_checksums(tmp_path):
    from subprocess import run

    folder = unpacked(tmp_path, members())
    done = run(["sha256sum", "-c", "SHA256SUMS"], cwd=folder, capture_output=True, text=True, check=True)
    assert done.stdout.count(": OK") == len(members())


def test_one_pass_alone_keeps_its_samples_and_their_stamps():
    whole, alone = arm(), replay_bag.arms_of(trajectory(), arm="PSM2", frame=FRAME, jaw_rad=0.1, pass_index=1)[0]
    np.testing.assert_array_equal(alone.stamps_ns, whole.stamps_ns[81:])
    np.testing.assert_array_equal(alone.joints, whole.joints[81:])
    assert replay_bag.notes_of(alone, "1" * 64)["pass"] == "1"
    checked(members(0))
    checked(members(1))


@pytest.mark.parametrize("number", [-1, 2])
def test_a_pass_that_the_plan_does_not_have_is_refused(number):
    with pytest.raises(BadPlan, match="0 to 1"):
        replay_bag.arms_of(trajectory(), arm="PSM2", frame=FRAME, pass_index=number)


def test_without_psm_ms_place_there_is_no_bag_for_it():
    arms = replay_bag.arms_of(trajectory(other=False), arm="PSM2", frame=FRAME, jaw_rad=0.1)
    assert [one.name for one in arms] == ["PSM2"]
    lines = checked(papers(trajectory(other=False)) | replay_bag.folder_of(arms[0], "1" * 64))
    assert len(lines) == 5 and lines[3] == "It has no hand-off: no PSM_M, no A2."
    assert lines[4].startswith("UNSIGNED")
    with pytest.raises(BadBag, match="PSM_M is in the bag and not in"):
        checked(papers(trajectory()) | replay_bag.folder_of(arms[0], "1" * 64))


@pytest.mark.parametrize(
    ("arm", "other", "names"),
    [
        ("PSM2", "PSM1", ("PSM2", "PSM1")),
        ("PSM1", None, ("PSM1", "PSM2")),
        ("PSM2", "PSM2", ("PSM2", "PSM1")),
        ("psm1", "psm3", ("PSM1", "PSM3")),
        ("PSM", None, ("PSM1", "PSM2")),
        ("PSM_left", "PSM_right", ("PSM1", "PSM2")),
    ],
)
def test_arms_are_named_as_the_robots_script_names_them(arm, other, names):
    assert replay_bag.arm_names(arm, other) == names


def test_psm_a_holds_what_it_held_in_the_demonstration_if_its_jaw_can():
    assert replay_bag.held_jaw_rad(np.array([0.2, 0.1, 0.9]), "400006") == 0.2
    assert replay_bag.held_jaw_rad(None, "400006") == JAW_CLOSED_RAD
    assert (
        replay_bag.held_jaw_rad(np.full(9, -1.9), "400006") == JAW_CLOSED_RAD == radians(-20)
    )  # JIGSAWS has another zero
