"""Written bags, and timelines as MCAP files: read by another library, and a timeline is refused as a recording."""

import io
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from skills.demonstration.recording import Recording
from skills.errors import BadRecording, NoUsableTopic
from skills.formats import bag_writer, read_recording, write_bag, write_mcap
from skills.formats.bag_folder import read_metadata
from skills.formats.bag_writer import DEFINITIONS, messages_of, timeline_mcap
from skills.verification.timeline import timeline_of_recording
from tests.formats.bags import START_NS, STEP_NS, recording
from tests.formats.others import assert_all_the_same, whole
from tests.verification.timelines import two_arms

JAZZY = get_typestore(Stores.ROS2_JAZZY)


def test_everything_of_a_recording_survives_being_written_and_read():
    assert_all_the_same(read_recording(io.BytesIO(write_mcap(whole()))), whole())


def test_the_definitions_are_those_of_ros_2_jazzy():
    for name, definition in DEFINITIONS.items():
        mine = definition.replace("std_msgs/Header", "std_msgs/msg/Header").split()
        theirs = JAZZY.generate_msgdef(name, ros_version=2)[0].replace("std_msgs/Header", "std_msgs/msg/Header").split()
        assert sorted(mine) == sorted(theirs)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a bag folder for replay: poses and jaws that a PSM is to follow."""
    turn = (0.0, 0.0, 0.6, 0.8)
    said = [
        message
        for k in range(20)
        for message in (
            bag_writer.pose("/PSM1/setpoint_cp", START_NS + k * STEP_NS, "PSM1_base", (0.001 * k, 0.05, -0.1), turn),
            bag_writer.joint_state("/PSM1/jaw/setpoint_js", START_NS + k * STEP_NS, [0.1 * k], ["jaw"]),
        )
    ]
    folder = tmp_path_factory.mktemp("replay")
    with zipfile.ZipFile(io.BytesIO(write_bag(said, "plan"))) as archive:
        archive.extractall(folder)
    return folder / "plan"


def test_a_bag_folder_has_what_ros_2_needs(folder):
    assert sorted(path.name for path in folder.iterdir()) == ["metadata.yaml", "plan.mcap"]
    with (folder / "plan.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
    assert all(channel.message_encoding == "cdr" for channel in summary.channels.values())
    assert all("offered_qos_profiles" in channel.metadata for channel in summary.channels.values())
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    known = read_metadata((folder / "metadata.yaml").read_text())
    assert known.files == ("plan.mcap",)
    assert known.counts == {"/PSM1/setpoint_cp": 20, "/PSM1/jaw/setpoint_js": 20}


def test_the_metadata_are_readable_by_ros_2_humble_and_jazzy(folder):
    """Both read versions 1 to 5 alike: every value of the type that their decoders ask for."""
    told = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert told["version"] == 5
    assert {type(one["topic_metadata"]["offered_qos_profiles"]) for one in told["topics_with_message_count"]} == {str}
    assert {type(told[name]) for name in ("storage_identifier", "compression_format", "compression_mode")} == {str}
    for times in (told, *told["files"]):
        assert type(times["duration"]["nanoseconds"]) is type(times["message_count"]) is int
        assert type(times["starting_time"]["nanoseconds_since_epoch"]) is int
    assert told["relative_file_paths"] == [one["path"] for one in told["files"]] == ["plan.mcap"]
    newer = {"custom_data", "ros_distro"}
    assert not newer & told.keys()


def test_rosbags_opens_a_bag_folder_with_equal_values(folder):
    with AnyReader([folder]) as reader:
        assert reader.message_count == 40
        assert reader.duration == 19 * STEP_NS + 1
        got = [(c.topic, log_ns, reader.deserialize(data, c.msgtype)) for c, log_ns, data in reader.messages()]
    poses = [(log_ns, said) for topic, log_ns, said in got if topic == "/PSM1/setpoint_cp"]
    assert [log_ns for log_ns, _ in poses] == [START_NS + k * STEP_NS for k in range(20)]
    assert [said.pose.position.x for _, said in poses] == [0.001 * k for k in range(20)]
    assert {said.header.frame_id for _, said in poses} == {"PSM1_base"}
    jaws = [said for topic, _, said in got if topic == "/PSM1/jaw/setpoint_js"]
    assert [(said.name, said.position.tolist()) for said in jaws] == [(["jaw"], [0.1 * k]) for k in range(20)]


def test_mcap_ros2_support_opens_it_with_equal_values(folder):
    with (folder / "plan.mcap").open("rb") as file:
        got = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    poses = [said for _, channel, _, said in got if channel.topic == "/PSM1/setpoint_cp"]
    assert [said.pose.position.x for said in poses] == [0.001 * k for k in range(20)]
    assert [said.header.stamp.sec * 10**9 + said.header.stamp.nanosec for said in poses] == [
        START_NS + k * STEP_NS for k in range(20)
    ]


def test_every_kind_of_message_is_what_the_other_library_writes():
    stamp = JAZZY.types["builtin_interfaces/msg/Time"](1_760_000_000, 5)
    for frame in ("", "a", "ab", "abc", "PSM2_base"):
        header, at = JAZZY.types["std_msgs/msg/Header"](stamp, frame), 1_760_000_000 * 10**9 + 5
        point = JAZZY.types["geometry_msgs/msg/Point"](0.1, 0.2, 0.3)
        turn = JAZZY.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.6, 0.8)
        pose = JAZZY.types["geometry_msgs/msg/Pose"](point, turn)
        doubles, none = np.array([0.25, 1.5]), np.array([], dtype=np.float64)
        pairs = [
            (bag_writer.pose("/t", at, frame, (0.1, 0.2, 0.3), (0.0, 0.0, 0.6, 0.8)), (header, pose)),
            (bag_writer.joint_state("/t", at, [0.25, 1.5], ["a", "jaw"], frame=frame),
             (header, ["a", "jaw"], doubles, none, none)),
            (bag_writer.joy("/t", at, [1, -2], frame=frame),
             (header, np.array([], dtype=np.float32), np.array([1, -2], dtype=np.int32))),
            (bag_writer.boolean("/t", at, True), (True,)),
            (bag_writer.number("/t", at, 0.2), (0.2,)),
            (bag_writer.text("/t", at, frame), (frame,)),
        ]  # fmt: skip
        for mine, fields in pairs:
            theirs = JAZZY.serialize_cdr(JAZZY.types[mine.type](*fields), mine.type)
            assert mine.data.ljust(len(theirs), b"\0") == bytes(theirs), (mine.type, frame)


def test_a_recording_that_starts_before_1970_cannot_be_written():
    motion = recording().motions[0]
    early = replace(motion, stamps_ns=motion.stamps_ns - 2 * START_NS)
    with pytest.raises(BadRecording, match="1970"):
        messages_of(Recording(format="csv", integrity="none", motions=(early,)))


def test_a_viewers_file_has_poses_in_metres_and_says_it_is_to_look_at():
    timeline = timeline_of_recording(two_arms(3.0))
    data = timeline_mcap(timeline, "recordings/abc")
    reader = make_reader(io.BytesIO(data), decoder_factories=[DecoderFactory()])
    (notes,) = reader.iter_metadata()
    assert notes.metadata["use"] == "to look at; not for execution" and notes.metadata["source"] == "recordings/abc"
    seen: dict[str, list] = {}
    for _, channel, message, said in reader.iter_decoded_messages():
        seen.setdefault(channel.topic, []).append((message.log_time, said))
    assert set(seen) >= {
        "/shown/arm_PSM1/pose",
        "/shown/arm_PSM2/joints",
        "/shown/arm_PSM1/jaw",
        "/shown/stage",
        "/shown/Outer_bodies_apart",
    }
    assert all(topic.startswith("/shown/") for topic in seen)
    stamp_ns, pose = seen["/shown/arm_PSM2/pose"][100]  # every second row
    assert stamp_ns == 1_000_000_000 and pose.header.frame_id == "ECM"
    assert pose.pose.position.x == pytest.approx(timeline.arms[1].tip_mm[200, 0] / 1000)
    assert seen["/shown/arm_PSM1/joints"][0][1].position[2] == pytest.approx(timeline.arms[0].joints[0, 2] / 1000)
    assert [said.data for _, said in seen["/shown/stage"]] == ["grasping", "driving", "hand-off"]
    assert timeline_mcap(timeline, "recordings/abc") == data
    with pytest.raises(NoUsableTopic):
        read_recording(io.BytesIO(data))
