import io

import numpy as np
import pytest

from skills import errors
from skills.formats import read_recording
from tests.formats.bags import LOCAL, recording

FIELDS = ["header.frame_id", "header.stamp.nanosec", "header.stamp.sec"]
FIELDS += [f"pose.orientation.{axis}" for axis in "wxyz"] + [f"pose.position.{axis}" for axis in "xyz"]


def rows(motion):
    for stamp, (x, y, z), (qx, qy, qz, qw) in zip(
        motion.stamps_ns, motion.tip_mm / 1000, motion.rotation_xyzw, strict=True
    ):
        yield [stamp + 7, motion.frame, stamp % 10**9, stamp // 10**9, qw, qx, qy, qz, x, y, z]


def table(lines, *, topic=LOCAL, kind="geometry_msgs/msg/PoseStamped", fields=FIELDS):
    head = f"# Topic: {topic}\n# Type: {kind}\n" + ",".join(["timestamp", *fields]) + "\r\n"
    return head + "".join(",".join(str(cell) for cell in line) + "\r\n" for line in lines)


def read(text, **how):
    return read_recording(io.BytesIO(text.encode()), **how)


LINES = list(rows(recording().motions[0]))


def test_the_table_of_a_topic_says_what_its_bag_says():
    got, want = read(table(LINES)), recording().motions[0]
    motion = got.motion_of()
    assert (motion.arm, motion.topic, motion.frame) == (want.arm, want.topic, want.frame)
    np.testing.assert_array_equal(motion.stamps_ns, want.stamps_ns)
    np.testing.assert_allclose(motion.tip_mm, want.tip_mm, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(motion.rotation_xyzw, want.rotation_xyzw)
    assert (got.format, got.integrity, got.topics[0].messages) == ("csv", "none", 40)


def with_cell(row, column, value):
    return [[value if (k, j) == (row, column) else cell for j, cell in enumerate(line)] for k, line in enumerate(LINES)]


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        (table(LINES, topic="/MTML/measured_cp"), errors.NoUsableTopic, "/MTML/measured_cp"),
        (table(LINES, kind="sensor_msgs/msg/JointState"), errors.NoUsableTopic, "JointState"),
        (table(LINES, fields=FIELDS[1:]), errors.BadColumns, "frame_id"),
        (table(LINES, fields=[*FIELDS, FIELDS[0]]), errors.BadColumns, "frame_id"),
        (table([]), errors.UnreadableRecording, "no rows"),
        (table(with_cell(3, 8, "far")), errors.UnreadableRecording, "Row 7"),
        (table([*LINES[:3], LINES[3][:5]]), errors.UnreadableRecording, "Row 7"),
        (table(with_cell(3, 8, "0.0_1")), errors.UnreadableRecording, "Row 7"),
        (table(with_cell(3, 2, 10**9)), errors.UnreadableRecording, "Row 7"),
        (table(with_cell(3, 8, "nan")), errors.NotFinite, LOCAL),
        (table(with_cell(3, 1, "ECM")), errors.MixedFrames, "2 frames"),
        (table(with_cell(3, 3, 17)), errors.BackwardStamps, LOCAL),
    ],
)
def test_a_table_that_cannot_be_meant_is_refused(text, error, message):
    with pytest.raises(error, match=message):
        read(text)


def test_neither_a_rate_nor_another_frame_is_taken():
    with pytest.raises(errors.BadSettings):
        read(table(LINES), rate_hz=100.0)
    with pytest.raises(errors.MixedFrames, match="PSM2_base"):
        read(table(LINES), frame="ECM")
