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

from skills.errors import BadBag, BadSpeed
from skills.formats import replay_bag
from skills.kinematics import forward
from skills.planning.automatic_segments import segments_of
from skills.planning.handoff import JAW_CLOSED_RAD, JAW_OPEN_RAD, JAW_S, OPEN_RAD
from skills.planning.trajectory import time_parametrise
from tests.formats.replays import (
    FRAME,
    PARTS,
    PSM1,
    PSM2,
    RATE_HZ,
    SHARING,
    arms,
    checked,
    folders,
    members,
    papers,
    trajectory,
    unpacked,
)  # fmt: skip
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
    made, folder, name = trajectory(), unpacked(tmp_path, members()), topics[0].split("/")[1]
    said = [one for number, part in enumerate(PARTS) for one in read(folder / part / name)[3 * (number in SHARING) :]]
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
    kept, _ = kept_by_the_robots_script(by_rosbags(unpacked(tmp_path, members()) / "000-A1" / "PSM2"), PSM2[0])
    stamps_s = np.array([one.header.stamp.sec + one.header.stamp.nanosec / 1e9 for one in kept])
    np.testing.assert_allclose(np.diff(stamps_s), 1 / RATE_HZ, rtol=0, atol=2e-9)  # s


def test_where_a_robot_waits_its_last_velocity_is_none(tmp_path):
    kept, _ = kept_by_the_robots_script(by_mcap_ros2(unpacked(tmp_path, members()) / "000-A1" / "PSM2"), PSM2[0])
    speeds = np.array([one.velocity for one in kept])
    assert np.flatnonzero((speeds == 0).all(axis=1)).tolist() == [0, 59]
    steps = np.diff(np.array([one.position for one in kept]), axis=0) * RATE_HZ
    np.testing.assert_allclose(speeds[1:59], (steps[:58] + steps[1:59]) / 2, rtol=0, atol=1e-9)  # rad/s and m/s


@settings(deadline=None)
@given(st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_velocities_carry_the_joints_from_rest_to_rest(count, seed):
    """The velocities' trapezoidal integral is the path, up to end corrections of a quarter step on either side."""
    rng = np.random.default_rng(seed)
    q = np.cumsum(rng.normal(size=(count, 6)), axis=0)
    stamps_ns = replay_bag.EPOCH_NS + np.arange(count) * 5_000_000
    v = replay_bag.velocities_of(stamps_ns, q)
    assert (v[[0, -1]] == 0).all()
    if count > 3:
        way = (q[-1] + q[-2] - q[0] - q[1]) / 2
        np.testing.assert_allclose(v.sum(axis=0) / RATE_HZ, way, rtol=0, atol=1e-9)


# ---- the content ------------------------------------------------------------------------------------------------


def test_the_same_trajectory_gives_the_same_bytes():
    again = folders(trajectory(), arms(trajectory()))
    assert replay_bag.seal(papers(trajectory()) | again) == replay_bag.seal(members())


def test_the_index_of_two_passes_by_hand():
    """Two passes of 81 samples at 200 Hz, 60 of A1 and 21 of A2, a second apart; stamps begin at 1 s."""
    index = replay_bag.segment_index(replay_bag.segment_motions(trajectory(), arms(trajectory())), "1" * 64)
    assert [(one.name, one.pass_index, one.from_ns, one.to_ns, one.by_hand) for one in index.segments] == [
        ("000-A1", 0, 1_000_000_000, 1_295_000_000, ["M1", "M2"]),
        ("001-A2", 0, 1_295_000_000, 1_400_000_000, []),
        ("002-A1", 1, 2_405_000_000, 2_700_000_000, ["M1", "M2"]),
        ("003-A2", 1, 2_700_000_000, 2_805_000_000, []),
    ]
    assert index.segments[1].teleoperated == [] and index.segments[2].teleoperated == ["PSM2", "PSM1"]
    psm_a, psm_m = index.segments[1].arms
    np.testing.assert_allclose(psm_a.position_mm, trajectory().tip_mm[59], atol=1e-9)
    assert (psm_a.arm, psm_a.role, psm_a.moves, psm_a.frame, psm_a.jaw_rad) == ("PSM2", "PSM_A", True, FRAME, 0.1)
    assert (psm_m.arm, psm_m.role, psm_m.moves, psm_m.frame) == ("PSM1", "PSM_M", True, "PSM1_base")
    assert index.position_tolerance_mm == 0.5 == pytest.approx(index.rotation_tolerance_rad * 10.2)


def test_a_hand_over_is_a_segment_in_which_both_arms_stand():
    """PSM_M's jaw closes before PSM_A's opens; the surgeon's hand turns that round before a further A1."""
    motion = time_parametrise([hand_off(), hand_off(-8.0)], rate_hz=100.0, psm_m=BESIDE)
    psm_a, psm_m = arms(motion)
    found = segments_of(motion)
    assert [(one.kind, one.pass_index) for one in found] == [
        ("A1", 0), ("A2", 0), ("hand-over", 0), ("transfer", 1), ("A1", 1), ("A2", 1), ("hand-over", 1),
    ]  # fmt: skip
    assert [one.by_hand for one in found] == [("M1", "M2"), (), (), (), ("M1", "M2"), (), ()]
    for one in found:
        a, m = psm_a.part(one.samples, ""), psm_m.part(one.samples, "")
        changes = (a.jaw_rad[[0, -1]].tolist(), m.jaw_rad[[0, -1]].tolist())
        if one.kind == "hand-over":
            assert changes == ([JAW_CLOSED_RAD, JAW_OPEN_RAD], [JAW_OPEN_RAD, JAW_CLOSED_RAD])
            assert max(np.ptp(a.joints, axis=0).max(), np.ptp(m.joints, axis=0).max()) <= 1e-9
            assert (np.minimum(a.jaw_rad, m.jaw_rad) == JAW_CLOSED_RAD).all()  # one of both holds the needle
            assert one.last - one.first == pytest.approx(2e2 * JAW_S, abs=2)
        else:
            assert (np.ptp(a.jaw_rad), np.ptp(m.jaw_rad)) == (0, 0)
    held = [
        one.needle_held_by
        for one in replay_bag.segment_index(replay_bag.segment_motions(motion, (psm_a, psm_m)), "1" * 64).segments
    ]
    assert held == ["PSM_A", "PSM_A", "PSM_A", "PSM_M", "PSM_A", "PSM_A", "PSM_A"]
    assert [one.moves for one in replay_bag.segment_motions(motion, (psm_a, psm_m))[0][1]] == [
        True,
        False,
    ]  # only PSM_A in A1


def test_sha256sum_itself_reads_the_checksums(tmp_path):
    from subprocess import run

    folder = unpacked(tmp_path, members())
    done = run(["sha256sum", "-c", "SHA256SUMS"], cwd=folder, capture_output=True, text=True, check=True)
    assert done.stdout.count(": OK") == len(members())


@pytest.mark.parametrize("pause_s", [0.0, 0.01])
def test_a_pause_of_one_tick_is_refused(pause_s):
    with pytest.raises(BadSpeed, match="shorter than two samples at 100 Hz"):
        time_parametrise([hand_off(), hand_off(-8.0)], rate_hz=100.0, pause_s=pause_s)


def test_without_psm_ms_place_there_is_no_bag_for_it():
    alone = trajectory(other=False)
    assert [one.name for one in arms(alone)] == ["PSM2"]
    lines = checked(papers(alone) | folders(alone, arms(alone)))
    assert len(lines) == 6 and lines[4] == "It has no hand-off: no PSM_M, no A2."
    assert lines[5].startswith("UNSIGNED")
    with pytest.raises(BadBag, match="PSM_M is in the bag and not in"):
        checked(
            papers(alone, plan={"psm_m": {"base_mm": [0, 0, 0], "instrument": "420006"}}) | folders(alone, arms(alone))
        )


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
