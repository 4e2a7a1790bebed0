"""The recording of `bags.recording` in other formats: ROS 1 bags, .db3 bags, MCAP with IDL, zips."""

import io
import zipfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from skills.demonstration.recording import Joints, Motion, Signal
from skills.formats import topics
from skills.formats.bag_writer import Message
from tests.formats.bags import START_NS, STEP_NS, assert_same, recording

JAZZY, NOETIC = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)

POSE_IDL = """
module geometry_msgs { module msg { struct Point { double x; double y; double z; }; }; };
module geometry_msgs { module msg { struct Quaternion { double x; double y; double z; double w; }; }; };
module geometry_msgs { module msg {
  struct Pose { geometry_msgs::msg::Point position; geometry_msgs::msg::Quaternion orientation; };
}; };
module builtin_interfaces { module msg { struct Time { int32 sec; uint32 nanosec; }; }; };
module std_msgs { module msg { struct Header { builtin_interfaces::msg::Time stamp; string frame_id; }; }; };
module geometry_msgs { module msg {
  struct PoseStamped { std_msgs::msg::Header header; geometry_msgs::msg::Pose pose; };
}; };
"""


def whole(count=10):
    """Return a recording with every kind of content that a recording may have."""
    stamps_ns = START_NS + np.arange(count) * STEP_NS
    turns = np.tile([0.0, 0.0, 0.6, 0.8], (count, 1))
    tip_mm = np.linspace([-100, 0, -200], [100, 50, -100], count)
    master = Motion("MTMR", "/MTMR/measured_cp", "MTMR_base", stamps_ns, tip_mm, turns)
    joints = Joints(
        "PSM2", "/PSM2/measured_js", stamps_ns, np.linspace([0.1, 0.2, 90, 0, 0, 0], [1, 1, 120, 1, 1, 1], count)
    )
    master_joints = Joints("MTMR", "/MTMR/measured_js", stamps_ns, np.ones((count, 7)))
    setpoint = Motion("PSM2", "/PSM2/setpoint_cp", "ECM", stamps_ns + 7, tip_mm + 0.5, turns)
    local = replace(setpoint, topic="/PSM2/local/setpoint_cp", frame="PSM2_base")
    pedal = Signal(stamps_ns[:2], np.array([1.0, 0.0]), "/footpedals/coag")
    clutch = Signal(stamps_ns[:2], np.array([1.0, 0.0]), "/console/clutch")
    return replace(
        recording(count),
        masters=(master,),
        joints=(master_joints, joints),
        grippers=(("MTMR", Signal(stamps_ns, np.linspace(0, 1, count), "/MTMR/gripper/measured_js")),),
        clutch=clutch,
        pedals=(("/console/clutch", clutch), ("/footpedals/coag", pedal)),
        following=(("MTMR_PSM2", Signal(stamps_ns[:2], np.array([1.0, 0.0]), "/MTMR_PSM2/following")),),
        scales=(("MTMR_PSM2", Signal(stamps_ns[:1], np.array([0.2]), "/MTMR_PSM2/scale")),),
        tools=(("PSM2", "LARGE_NEEDLE_DRIVER:400006"),),
        notes=(("original sha256", "00ff"),),
        setpoints=(local, setpoint),
        jaw_setpoints=(("PSM2", Signal(stamps_ns, np.linspace(0.8, 0.2, count), "/PSM2/jaw/setpoint_js")),),
    )


def assert_all_the_same(got, want):
    """Assert that two recordings are equal in all their content."""
    assert_same(got, want, tolerance_mm=1e-12)
    moving = zip((*got.masters, *got.setpoints), (*want.masters, *want.setpoints), strict=True)
    for one, other in moving:
        assert (one.arm, one.topic, one.frame) == (other.arm, other.topic, other.frame)
        np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
        np.testing.assert_allclose(one.tip_mm, other.tip_mm, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(one.rotation_xyzw, other.rotation_xyzw)
    for one, other in zip(got.joints, want.joints, strict=True):
        assert (one.arm, one.topic) == (other.arm, other.topic)
        np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
        np.testing.assert_allclose(one.positions, other.positions, rtol=0, atol=1e-12)
    for name in ("grippers", "pedals", "following", "scales", "jaw_setpoints"):
        for (who, one), (whom, other) in zip(getattr(got, name), getattr(want, name), strict=True):
            assert (who, one.topic) == (whom, other.topic)
            np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
            np.testing.assert_array_equal(one.values, other.values)
    assert (got.tools, got.notes) == (want.tools, want.notes)


def rosbag1(said: Iterable[Message], path: Path, **how) -> Path:
    """Write messages as a ROS 1 bag."""
    with Writer1(path) as writer:
        connections = {}
        for number, message in enumerate(said):
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(message.topic, message.type, typestore=NOETIC)
            value = JAZZY.deserialize_cdr(message.data, message.type)
            data = NOETIC.serialize_ros1(in_noetic(value, message.type, number), message.type)
            writer.write(connections[message.topic], message.log_ns, data)
    return path


def in_noetic(value, message_type, number):
    """Return the same message with the header of ROS 1, which has a sequence number."""
    kind = NOETIC.types[message_type]
    if message_type.startswith("std_msgs"):
        return kind(value.data)
    header = value.header
    stamp = NOETIC.types["builtin_interfaces/msg/Time"](header.stamp.sec, header.stamp.nanosec)
    fields = {name: getattr(value, name) for name in kind.__dataclass_fields__ if not name.startswith("__")}
    fields["header"] = NOETIC.types["std_msgs/msg/Header"](seq=number, stamp=stamp, frame_id=header.frame_id)
    return kind(**fields)


def db3(said: Iterable[Message], folder: Path) -> Path:
    """Write messages as a bag folder with a .db3 file."""
    return rosbag2(said, folder, StoragePlugin.SQLITE3)


def rosbag2(said: Iterable[Message], folder: Path, plugin: StoragePlugin = StoragePlugin.MCAP) -> Path:
    """Write messages as a bag folder, with rosbags."""
    with Writer2(folder, version=9, storage_plugin=plugin) as writer:
        connections = {}
        for message in said:
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(message.topic, message.type, typestore=JAZZY)
            writer.write(connections[message.topic], message.log_ns, message.data)
    return folder


def idl_mcap(said: Iterable[Message], *, crcs: bool = True) -> bytes:
    """Write poses as MCAP whose type is defined in IDL, as a recorder without .msg files does."""
    file = io.BytesIO()
    writer = McapWriter(file, enable_crcs=crcs)
    writer.start(profile="ros2")
    schema = writer.register_schema(topics.POSE, "ros2idl", POSE_IDL.encode())
    channels = {}
    for message in said:
        assert message.type == topics.POSE
        if message.topic not in channels:
            channels[message.topic] = writer.register_channel(message.topic, "cdr", schema)
        writer.add_message(channels[message.topic], message.log_ns, message.data, message.log_ns)
    writer.finish()
    return file.getvalue()


def zipped(members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Compress members by name."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return out.getvalue()


def folder_members(folder: Path, within: str = "") -> dict[str, bytes]:
    """Return the files of a folder by name."""
    return {within + str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def damaged(data: bytes, count: int, seed: int) -> Iterable[tuple[str, bytes]]:
    """Yield damaged copies: half of them truncated, half with a flipped bit."""
    rng = np.random.default_rng(seed)
    for _ in range(count // 2):
        cut, bit = int(rng.integers(1, len(data))), int(rng.integers(0, 8 * len(data)))
        yield f"cut at {cut}", data[:cut]
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << (bit % 8)
        yield f"bit {bit}", bytes(flipped)
