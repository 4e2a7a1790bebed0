import io
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from skills import errors
from skills.demonstration.recording import Motion, Recording
from skills.formats import read_recording, topics, write_mcap
from skills.formats.mcap import NeedsRosbags, read_mcap
from tests.by_day import examples
from tests.formats import bags
from tests.formats.records import boundaries


def read(data, **how):
    return read_recording(io.BytesIO(data), **how)


# ---- round trips ------------------------------------------------------------------------------------------------


def test_what_we_write_we_read():
    bags.assert_same(read(write_mcap(bags.recording())), bags.recording(), tolerance_mm=1e-12)


def test_what_we_write_carries_full_checksums():
    assert read(write_mcap(bags.recording())).integrity == "full"


def test_the_same_recording_gives_the_same_bytes():
    assert write_mcap(bags.recording()) == write_mcap(bags.recording())


def test_another_library_reads_the_same_values_from_what_we_write(tmp_path):
    file = tmp_path / "written.mcap"
    file.write_bytes(write_mcap(bags.recording()))
    got = {}
    with AnyReader([file], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, log_ns, raw in reader.messages():
            got.setdefault(connection.topic, []).append((log_ns, reader.deserialize(raw, connection.msgtype)))
    motion, jaw, clutch = bags.recording().motions[0], bags.recording().jaw_of("PSM2"), bags.recording().clutch
    poses = [message for _, message in got[bags.LOCAL]]
    stamps = [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for message in poses]
    assert stamps == motion.stamps_ns.tolist() == [log_ns for log_ns, _ in got[bags.LOCAL]]
    places = [(m.pose.position.x, m.pose.position.y, m.pose.position.z) for m in poses]
    np.testing.assert_array_equal(places, motion.tip_mm / 1000.0)
    turns = [(q.x, q.y, q.z, q.w) for q in (m.pose.orientation for m in poses)]
    np.testing.assert_array_equal(turns, motion.rotation_xyzw)
    assert {message.header.frame_id for message in poses} == {"PSM2_base"}
    assert [message.position[0] for _, message in got["/PSM2/jaw/measured_js"]] == jaw.values.tolist()
    assert [message.buttons[0] for _, message in got["/console/clutch"]] == clutch.values.tolist()


@st.composite
def recordings(draw):
    count = draw(st.integers(1, 12))
    steps = draw(st.lists(st.integers(1, 10**12), min_size=count, max_size=count))
    tips = draw(st.lists(st.tuples(*[st.floats(-1000, 1000)] * 3), min_size=count, max_size=count))
    turns = np.random.default_rng(draw(st.integers(0, 2**32))).normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    motion = Motion(
        "PSM1", "/PSM1/measured_cp", draw(st.sampled_from(["ECM", "PSM1_base"])), np.cumsum(steps), tips, turns
    )
    return Recording(format="mcap", integrity="full", motions=(motion,))


@examples(30)
@given(recordings())
def test_any_motion_survives_being_written_and_read(one):
    bags.assert_same(read_mcap(io.BytesIO(write_mcap(one))), one, tolerance_mm=1e-12)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_every_compression_of_chunks_is_read(compression):
    assert len(read(bags.pose_bag(bags.straight(), compression=compression)).motion_of().stamps_ns) == 20


def test_a_motion_without_orientation_cannot_be_written():
    motion = bags.recording().motions[0]
    bare = Motion(motion.arm, motion.topic, motion.frame, motion.stamps_ns, motion.tip_mm)
    with pytest.raises(errors.BadRecording, match="orientation"):
        write_mcap(Recording(format="csv", integrity="none", motions=(bare,)))


# ---- damage -----------------------------------------------------------------------------------------------------


def test_a_chunk_that_readers_pass_over_is_noticed():
    data = bytearray(bags.pose_bag(bags.straight(60)))
    second_chunk = [at for at in boundaries(data) if data[at] == 0x06][1]
    data[second_chunk] = 0xF6  # the opcode of an unknown record
    with pytest.raises(errors.UnreadableRecording, match="60 messages"):
        read(bytes(data))


def test_bytes_after_the_end_are_refused():
    data = bags.pose_bag(bags.straight())
    with pytest.raises(errors.UnreadableRecording, match="bytes after the end"):
        read(data + data)


def test_a_chunk_that_claims_too_much_is_refused_before_it_is_unpacked():
    data = bytearray(bags.pose_bag(bags.straight()))
    chunk = next(at for at in boundaries(data) if data[at] == 0x06)
    struct.pack_into("<Q", data, chunk + 9 + 16, 2**30)
    with pytest.raises(errors.UnreadableRecording, match="limits"):
        read(bytes(data))


def test_a_chunk_that_unpacks_to_more_than_it_claims_is_refused():
    data = bytearray(bags.pose_bag(bags.straight()))
    chunk = next(at for at in boundaries(data) if data[at] == 0x06)
    struct.pack_into("<Q", data, chunk + 9 + 16, 100)
    with pytest.raises(errors.UnreadableRecording, match="100 bytes"):
        read(bytes(data))


def test_a_refusal_says_how_to_recover():
    with pytest.raises(errors.UnreadableRecording, match="mcap recover"):
        read(bags.pose_bag(bags.straight())[:-20])


def test_chunks_without_checksums_are_reported():
    assert read(bags.pose_bag(bags.straight(), crcs=False)).integrity == "none"
    data = bytearray(bags.pose_bag(bags.straight(60)))
    chunk = next(at for at in boundaries(data) if data[at] == 0x06)
    struct.pack_into("<I", data, chunk + 9 + 24, 0)
    assert read(bytes(data)).integrity == "partial"


def test_one_checksum_of_the_whole_data_section_is_full_too():
    whole = bags.unchunked(bags.straight(), checksum=True)
    assert read(whole).integrity == "full"
    assert read(bags.unchunked(bags.straight(), checksum=False)).integrity == "none"
    flipped = bytearray(whole)
    flipped[whole.index(bags.LOCAL.encode()) + 300] ^= 1
    with pytest.raises(errors.UnreadableRecording, match="CRC"):
        read(bytes(flipped))


# ---- refused contents -------------------------------------------------------------------------------------------


def test_a_frame_that_changes_on_the_way_is_refused_with_both_names():
    with pytest.raises(errors.MixedFrames, match="'PSM2_base' and 'ECM'"):
        read(bags.pose_bag([*bags.straight(3), bags.pose(bags.START_NS + 3 * bags.STEP_NS, 0.003, frame="ECM")]))


def test_stamps_that_run_backwards_are_refused_with_the_time():
    poses = bags.straight(10)
    poses[7] = bags.pose(bags.START_NS + 2 * bags.STEP_NS, 0.007)
    with pytest.raises(errors.BackwardStamps, match=r"at 0\.060 s"):
        read(bags.pose_bag(poses))


def test_messages_are_taken_in_the_order_of_their_log_time():
    poses = [
        (bags.START_NS + k * bags.STEP_NS, bags.LOCAL, topics.POSE, message)
        for k, message in enumerate(bags.straight(10))
    ]
    bags.assert_same(read(bags.bag(poses[::-1])), read(bags.bag(poses)))


def test_repeated_stamps_are_dropped_and_counted():
    poses = bags.straight(100)
    poses[4] = bags.pose(bags.START_NS + 3 * bags.STEP_NS, 0.5)
    motion = read(bags.pose_bag(poses)).motion_of()
    assert (motion.duplicate_stamps, motion.backward_stamps, len(motion.stamps_ns)) == (1, 0, 99)
    assert motion.tip_mm[3, 0] == pytest.approx(3.0)


def test_messages_recorded_twice_are_dropped_whatever_their_share():
    poses = [one for one in bags.straight(10) for _ in range(3)]
    motion = read(bags.pose_bag(poses)).motion_of()
    assert (motion.duplicate_stamps, len(motion.stamps_ns)) == (20, 10)
    np.testing.assert_array_equal(motion.tip_mm, read(bags.pose_bag(bags.straight(10))).motion_of().tip_mm)


def test_a_clock_that_stood_still_is_refused():
    with pytest.raises(errors.RepeatedStamps, match="9 of 10"):
        read(bags.pose_bag([bags.pose(bags.START_NS, 0.001 * k) for k in range(10)]))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_is_none_is_refused_with_topic_and_time(value):
    with pytest.raises(errors.NotFinite, match=rf"{bags.LOCAL}.*at 0\.030 s"):
        read(bags.pose_bag([*bags.straight(3), bags.pose(bags.START_NS + 3 * bags.STEP_NS, value)]))


def test_millimetres_in_the_place_of_metres_are_refused():
    with pytest.raises(errors.NotMetres, match="50 m"):
        read(bags.pose_bag([bags.pose(bags.START_NS + k * bags.STEP_NS, 1.0 * k, y_m=50.0) for k in range(5)]))


@pytest.mark.parametrize("factor", [1000.0, 39.37])
def test_a_hand_off_in_millimetres_or_inches_is_refused_with_its_size(factor):
    place_m = np.array([0.01, 0.05, -0.12]) * factor
    poses = [
        bags.pose(bags.START_NS + k * bags.STEP_NS, place_m[0] * k / 20, y_m=place_m[1], z_m=place_m[2])
        for k in range(21)
    ]
    with pytest.raises(errors.NotMetres, match=f"{abs(place_m[2]):g} m at 0.000 s"):
        read(bags.pose_bag(poses))


def test_non_finite_poses_are_refused_with_the_time_of_the_first():
    rng = np.random.default_rng(5)
    poses = bags.straight(1000)
    spoilt = sorted(rng.choice(1000, 10, replace=False).tolist())
    for k in spoilt:
        poses[k]["pose"]["position"][rng.choice(list("xyz"))] = float("nan")
    with pytest.raises(errors.NotFinite, match=rf"at {spoilt[0] * bags.STEP_NS / 1e9:.3f} s"):
        read(bags.pose_bag(poses))


def test_shuffled_stamps_are_refused_with_the_sample():
    order = np.random.default_rng(6).permutation(200)
    poses = [bags.pose(bags.START_NS + int(k) * bags.STEP_NS, 0.0002 * int(k)) for k in order]
    first = int(np.argmax(np.diff(order) < 0)) + 1
    with pytest.raises(errors.BackwardStamps, match=rf"sample {first}\)"):
        read(bags.pose_bag(poses))


def test_a_quaternion_of_another_length_is_refused():
    with pytest.raises(errors.NotAQuaternion):
        read(bags.pose_bag(bags.straight(turn=(0.0, 0.0, 0.0, 0.0))))


def test_a_recording_without_a_psm_says_what_it_has():
    with pytest.raises(errors.NoUsableTopic, match="/MTMR/measured_cp"):
        read(bags.pose_bag(bags.straight(), topic="/MTMR/measured_cp"))


def test_the_passive_arm_that_carries_a_psm_is_not_its_tip():
    with pytest.raises(errors.NoUsableTopic):
        read(bags.pose_bag(bags.straight(), topic="/SUJ/PSM2/local/measured_cp"))


def test_a_jaw_without_position_is_refused():
    jaw = {"header": bags.header(bags.START_NS), "name": ["jaw"], "position": [], "velocity": [], "effort": []}
    poses = [(bags.START_NS, bags.LOCAL, topics.POSE, message) for message in bags.straight(2)]
    with pytest.raises(errors.NoUsableTopic, match="jaw"):
        read(bags.bag([*poses, (bags.START_NS, "/PSM2/jaw/measured_js", topics.JOINT_STATE, jaw)]))


def test_idl_schemas_are_left_to_rosbags_with_the_checksum_status():
    data = bags.pose_bag(bags.straight(), compression=CompressionType.NONE, crcs=False).replace(b"ros2msg", b"ros2idl")
    with pytest.raises(NeedsRosbags, match="ros2idl") as refused:
        read_mcap(io.BytesIO(data))
    assert refused.value.numbers["integrity"] == "none"


def test_a_rate_for_a_recording_with_stamps_is_refused():
    with pytest.raises(errors.BadSettings):
        read(bags.pose_bag(bags.straight()), rate_hz=100.0)


def test_a_frame_that_the_recording_does_not_have_is_refused():
    assert read(bags.pose_bag(bags.straight()), frame="PSM2_base").motion_of().frame == "PSM2_base"
    with pytest.raises(errors.MixedFrames, match="PSM2_base"):
        read(bags.pose_bag(bags.straight()), frame="ECM")
