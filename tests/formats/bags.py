"""Small recordings for the tests, built message by message."""

import io
import os
from pathlib import Path

import numpy as np
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType
from mcap.writer import Writer as RecordWriter
from mcap_ros2.writer import Writer

from skills.demonstration.recording import Motion, Recording, Signal
from skills.formats import topics
from skills.formats.bag_writer import DEFINITIONS
from tests.needs import need

START_NS = 1_760_000_000_000_000_000
STEP_NS = 10_000_000
LOCAL = "/PSM2/local/measured_cp"


def sample_folder() -> Path:
    need("recordings")
    return Path(os.environ["SKILLS_SAMPLE_RECORDINGS"])


def header(stamp_ns, frame=""):
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


def pose(stamp_ns, x_m, *, frame="PSM2_base", y_m=0.05, z_m=-0.12, turn=(0.0, 0.0, 0.0, 1.0)):
    orientation = dict(zip("xyzw", turn, strict=True))
    position = {"x": x_m, "y": y_m, "z": z_m}
    return {"header": header(stamp_ns, frame), "pose": {"position": position, "orientation": orientation}}


def bag(messages, *, compression=CompressionType.ZSTD, chunk_size=1024, crcs=True, definitions=DEFINITIONS):
    """Write messages (log time, topic, type, message) in the given order."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=chunk_size, compression=compression, enable_crcs=crcs)
    schemas = {}
    for log_ns, topic, message_type, message in messages:
        if message_type not in schemas:
            schemas[message_type] = writer.register_msgdef(message_type, definitions[message_type])
        writer.write_message(topic, schemas[message_type], message, log_time=log_ns)
    writer.finish()
    return file.getvalue()


def pose_bag(poses, *, topic=LOCAL, **how):
    """Write poses on one topic, logged one step apart regardless of their own stamps."""
    return bag([(START_NS + k * STEP_NS, topic, topics.POSE, message) for k, message in enumerate(poses)], **how)


def unchunked(poses, *, checksum):
    """Write poses outside of any chunk, with or without a checksum of the whole data section."""
    records = list(StreamReader(io.BytesIO(pose_bag(poses))).records)
    schema, channel = (next(r for r in records if isinstance(r, kind)) for kind in (Schema, Channel))
    file = io.BytesIO()
    writer = RecordWriter(file, use_chunking=False, enable_data_crcs=checksum)
    writer.start(profile="ros2")
    writer.register_channel(channel.topic, "cdr", writer.register_schema(schema.name, "ros2msg", schema.data))
    for message in (r for r in records if isinstance(r, Message)):
        writer.add_message(1, message.log_time, message.data, message.publish_time)
    writer.finish()
    return file.getvalue()


def straight(count=20, **changes):
    """Return poses 1 mm apart along x."""
    return [pose(START_NS + k * STEP_NS, 0.001 * k, **changes) for k in range(count)]


def recording(count=40):
    """Return a recording with every kind of content: 1 mm steps, a jaw, one press and one quick tap."""
    stamps_ns = START_NS + np.arange(count) * STEP_NS + np.arange(count) % 3
    tip_mm = np.stack([np.arange(count) * 1.0, 50.0 + 0.1 * np.arange(count), np.full(count, -120.0)], axis=1)
    rotation = np.tile([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0], (count, 1))
    return Recording(
        format="mcap",
        integrity="full",
        motions=(Motion("PSM2", LOCAL, "PSM2_base", stamps_ns, tip_mm, rotation),),
        jaws=(("PSM2", Signal(stamps_ns, np.linspace(0.9, 0.1, count))),),
        clutch=Signal(START_NS + np.array([5, 9, 12]) * STEP_NS, np.array([1.0, 0.0, 2.0])),
    )


def assert_same(one, other, *, tolerance_mm=0.0):
    """Assert that two recordings are equal: positions within a tolerance, everything else exactly."""
    assert [(m.arm, m.topic, m.frame) for m in one.motions] == [(m.arm, m.topic, m.frame) for m in other.motions]
    for a, b in zip(one.motions, other.motions, strict=True):
        np.testing.assert_array_equal(a.stamps_ns, b.stamps_ns)
        np.testing.assert_allclose(a.tip_mm, b.tip_mm, rtol=0, atol=tolerance_mm)
        np.testing.assert_array_equal(a.rotation_xyzw, b.rotation_xyzw)
    assert [arm for arm, _ in one.jaws] == [arm for arm, _ in other.jaws]
    assert (one.clutch is None) == (other.clutch is None)
    signals = [(a, b) for (_, a), (_, b) in zip(one.jaws, other.jaws, strict=True)]
    for a, b in signals + ([(one.clutch, other.clutch)] if one.clutch is not None else []):
        np.testing.assert_array_equal(a.stamps_ns, b.stamps_ns)
        np.testing.assert_array_equal(a.values, b.values)
