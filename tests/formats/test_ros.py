import io
import sqlite3
from dataclasses import replace

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1

from skills.errors import BadSettings, MixedFrames, NoUsableTopic, SkillsError, UnreadableRecording
from skills.formats import bag_writer as messages
from skills.formats import read_recording, topics
from skills.formats.bag_writer import messages_of
from tests.formats import others
from tests.formats.bags import LOCAL, START_NS, STEP_NS, assert_same, recording, sample_folder


def read(data, **how):
    return read_recording(io.BytesIO(data), **how)


@pytest.fixture(scope="module")
def bag1(tmp_path_factory):
    return others.rosbag1(messages_of(recording()), tmp_path_factory.mktemp("ros1") / "session.bag").read_bytes()


@pytest.fixture(scope="module")
def folder3(tmp_path_factory):
    return others.db3(messages_of(recording()), tmp_path_factory.mktemp("ros2") / "session")


@pytest.fixture(scope="module")
def bag3(folder3):
    return (folder3 / "session.db3").read_bytes()


def test_a_ros_1_bag_says_what_the_mcap_of_the_same_motion_says(bag1):
    assert_same(read(bag1), recording(), tolerance_mm=1e-12)
    assert (read(bag1).format, read(bag1).integrity) == ("rosbag1", "none")


def test_a_db3_bag_says_what_the_mcap_of_the_same_motion_says(bag3):
    assert_same(read(bag3), recording(), tolerance_mm=1e-12)
    assert (read(bag3).format, read(bag3).integrity) == ("rosbag2", "none")


def test_everything_of_a_recording_comes_through_both_formats(tmp_path):
    want = replace(others.whole(), notes=())
    said = messages_of(want)
    others.assert_all_the_same(read(others.rosbag1(said, tmp_path / "one.bag").read_bytes()), want)
    others.assert_all_the_same(read((others.db3(said, tmp_path / "two") / "two.db3").read_bytes()), want)


def test_a_real_motion_is_the_same_to_the_last_bit_in_every_format(tmp_path):
    real = read((sample_folder() / "rosbag2" / "rosbag2.mcap").read_bytes())
    said = messages_of(real)
    for data in (
        others.rosbag1(said, tmp_path / "one.bag").read_bytes(),
        (others.db3(said, tmp_path / "two") / "two.db3").read_bytes(),
    ):
        assert_same(read(data), real)
        assert {topic.name: topic.messages for topic in read(data).topics} == {t.name: t.messages for t in real.topics}


def test_types_in_idl_are_read_and_keep_their_checksums():
    poses = [message for message in messages_of(recording()) if message.topic == LOCAL]
    for crcs, integrity in ((True, "full"), (False, "none")):
        got = read(others.idl_mcap(poses, crcs=crcs))
        np.testing.assert_array_equal(got.motion_of().stamps_ns, recording().motion_of().stamps_ns)
        np.testing.assert_allclose(got.motion_of().tip_mm, recording().motion_of().tip_mm, rtol=0, atol=1e-12)
        assert (got.format, got.integrity) == ("mcap", integrity)


def test_old_bags_give_the_tip_as_a_transform(tmp_path):
    types, kind = others.NOETIC.types, topics.TRANSFORM
    with Writer1(tmp_path / "old.bag") as writer:
        connection = writer.add_connection("/PSM2/measured_cp", kind, typestore=others.NOETIC)
        for k in range(5):
            stamp = types["builtin_interfaces/msg/Time"](1_760_000_000, 10_000_000 * k)
            place = types["geometry_msgs/msg/Vector3"](0.001 * k, 0.05, -0.12)
            turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
            header = types["std_msgs/msg/Header"](k, stamp, "PSM2_base")
            transform = types["geometry_msgs/msg/Transform"](place, turn)
            data = others.NOETIC.serialize_ros1(types[kind](header, "PSM2_tool", transform), kind)
            writer.write(connection, START_NS + k, data)
    got = read((tmp_path / "old.bag").read_bytes())
    assert got.motion_of().stamps_ns.tolist() == [1_760_000_000 * 10**9 + 10_000_000 * k for k in range(5)]
    np.testing.assert_array_equal(got.motion_of().tip_mm[:, 0], 1000.0 * (0.001 * np.arange(5)))
    assert [(topic.name, topic.type) for topic in got.topics] == [("/PSM2/measured_cp", kind)]


def test_the_same_checks_hold_as_for_mcap(tmp_path):
    def poses(frames):
        return [
            messages.pose(LOCAL, START_NS + k * STEP_NS, frame, (0.001 * k, 0.05, -0.12), (0.0, 0.0, 0.0, 1.0))
            for k, frame in enumerate(frames)
        ]

    with pytest.raises(MixedFrames, match="'PSM2_base' and 'ECM'"):
        read(others.rosbag1(poses(["PSM2_base", "ECM"]), tmp_path / "frames.bag").read_bytes())
    with pytest.raises(BadSettings, match="ROS 1"):
        read(others.rosbag1(poses(["PSM2_base"] * 3), tmp_path / "rate.bag").read_bytes(), rate_hz=30.0)
    with pytest.raises(MixedFrames, match="PSM2_base"):
        read(others.rosbag1(poses(["PSM2_base"] * 3), tmp_path / "frame.bag").read_bytes(), frame="ECM")


def test_what_is_no_dvrk_recording_is_refused_in_words(tmp_path):
    said = [messages.text("/rosout", START_NS, "hello"), messages.number("/temperature", START_NS, 20.5)]
    for data in (
        others.rosbag1(said, tmp_path / "one.bag").read_bytes(),
        (others.db3(said, tmp_path / "two") / "two.db3").read_bytes(),
    ):
        with pytest.raises(NoUsableTopic, match="/temperature"):
            read(data)


def test_a_database_of_something_else_is_refused(tmp_path):
    path = tmp_path / "other.db3"
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE patients (name TEXT)")
    connection.commit()
    connection.close()
    with pytest.raises(UnreadableRecording, match="db3"):
        read(path.read_bytes())


def test_a_zipped_folder_with_a_db3_or_a_ros_1_bag_is_read(folder3, bag1):
    for members, kind in ((others.folder_members(folder3, "s/"), "rosbag2"), ({"s/x.bag": bag1}, "rosbag1")):
        got = read(others.zipped(members))
        assert_same(got, recording(), tolerance_mm=1e-12)
        assert (got.format, got.integrity) == (kind, "full")


@pytest.mark.parametrize("count", [15, pytest.param(200, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("kind", ["bag1", "bag3"])
def test_a_damaged_bag_is_read_or_refused_and_nothing_else(kind, count, request):
    data, refused = request.getfixturevalue(kind), 0
    for _, bad in others.damaged(data, count, seed=3):
        try:
            read(bad)
        except SkillsError:
            refused += 1
    assert refused > 0.2 * count


def test_nothing_is_left_lying_about(bag1, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    read(bag1)
    with pytest.raises(UnreadableRecording):
        read(bag1[:1000])
    assert list(tmp_path.iterdir()) == []
