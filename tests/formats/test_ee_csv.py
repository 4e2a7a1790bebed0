import io
import re

import numpy as np
import pytest

from skills.errors import (
    BadColumns,
    BadSettings,
    MixedFrames,
    NotAQuaternion,
    NoUsableTopic,
    UnreadableRecording,
)
from skills.formats import read_recording
from skills.formats.parsed import parse
from tests.formats import written

PLAIN = written.ee_csv(rows=120)
MORE = written.ee_csv(rows=120, more=True)


def read(text, **how):
    return read_recording(io.BytesIO(text.encode()), **{"frame": "base", **how})


def changed(text, column, row, cell):
    """Replace a cell; row 0 is the first below the header."""
    lines = text.splitlines()
    cells = lines[row + 1].split(",")
    cells[lines[0].split(",").index(column)] = cell
    lines[row + 1] = ",".join(cells)
    return "\n".join(lines) + "\n"


def without(text, *columns):
    lines = [line.split(",") for line in text.splitlines()]
    kept = [k for k, name in enumerate(lines[0]) if name not in columns]
    return "\n".join(",".join(line[k] for k in kept) for line in lines) + "\n"


def test_both_arms_are_read_with_their_jaws_to_the_last_bit():
    recording, moving = read(written.ee_csv()), written.sample("kestrel").motion_of()
    assert recording.arms == ("PSM1", "PSM2")
    motion = recording.motion_of(arm="PSM2")
    every = round(len(moving.stamps_ns) / len(motion.stamps_ns))
    np.testing.assert_array_equal(motion.stamps_ns, moving.stamps_ns[::every])
    np.testing.assert_allclose(motion.tip_mm, moving.tip_mm[::every], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(motion.rotation_xyzw, moving.rotation_xyzw[::every])
    assert (motion.topic, motion.frame, recording.format) == ("/PSM2/measured_cp", "PSM2_base", "csv")
    jaw, want = recording.jaw_of("PSM2"), written.sample("kestrel").jaw_of("PSM2")
    np.testing.assert_array_equal(jaw.values, np.interp(motion.stamps_ns, want.stamps_ns, want.values))
    assert [one.arm for one in parse(recording).proposed] == ["PSM2"]


def test_numbers_as_numpy_prints_them_say_the_same():
    plain, numpy = read(PLAIN).motion_of(arm="PSM2"), read(written.ee_csv(rows=120, numpy=True)).motion_of(arm="PSM2")
    np.testing.assert_array_equal(plain.tip_mm, numpy.tip_mm)
    np.testing.assert_array_equal(plain.stamps_ns, numpy.stamps_ns)


def test_the_frame_is_asked_for_and_one_base_is_not_that_of_two_arms():
    with pytest.raises(BadColumns, match="does not say in which frame"):
        read_recording(io.BytesIO(PLAIN.encode()))
    assert {one.frame for one in read(PLAIN, frame="ECM").motions} == {"ECM"}
    with pytest.raises(MixedFrames, match=r"PSM1, PSM2.*'PSM1_base' is the base of one arm"):
        read(PLAIN, frame="PSM1_base")


def test_joints_are_read_and_columns_of_other_things_listed_as_not_used():
    recording = read(MORE)
    joints = {one.arm: one.positions for one in recording.joints}
    want = written.joints_of(
        np.column_stack(
            [
                recording.motion_of(topic="/PSM2/measured_cp").tip_mm / 1000,
                recording.motion_of(topic="/PSM2/measured_cp").rotation_xyzw,
            ]
        )
    )
    want[:, 2] *= 1000
    np.testing.assert_allclose(joints["PSM2"], want, atol=1e-9)
    unused = [one.name for one in recording.columns if not one.quantity]
    assert "ecm_pose.position.x" in unused
    assert not [name for name in unused if re.match(r"psm\d_(pose|sp|jaw|js)", name)]


def test_the_pose_in_the_base_is_read_where_the_other_pose_confirms_it():
    recording = read(MORE, frame="ECM")
    assert recording.motion_of(arm="PSM2").topic == "/PSM2/local/measured_cp"
    (base,) = recording.bases
    assert (base.arm, base.frame, base.local_frame) == ("PSM2", "ECM", "PSM2_base")
    (left,) = recording.left_out
    assert left[0] == "/PSM1/local/measured_cp"
    assert "stands still" in left[1]


def test_a_pose_that_no_fixed_transform_confirms_is_left_out():
    text = MORE
    for row in range(40, 80):
        text = changed(text, "psm2_rcm_pose.position.x", row, "0.06")
    recording = read(text, frame="ECM")
    assert "/PSM2/local/measured_cp" not in {one.topic for one in recording.motions}
    assert "No fixed transform" in dict(recording.left_out)["/PSM2/local/measured_cp"]


def test_an_arm_of_zeros_is_left_out_and_a_zero_quaternion_refused():
    zeros = PLAIN
    lines = [line.split(",") for line in zeros.splitlines()]
    of_arm = [k for k, name in enumerate(lines[0]) if name.startswith("psm1_pose")]
    for line in lines[1:]:
        for k in of_arm:
            line[k] = "np.float64(0.0)"
    recording = read("\n".join(",".join(line) for line in lines) + "\n")
    assert recording.arms == ("PSM2",)
    assert "was not recorded" in dict(recording.left_out)["/PSM1/measured_cp"]
    broken = PLAIN
    for part in "xyzw":
        broken = changed(broken, f"psm2_pose.orientation.{part}", 7, "0.0")
    with pytest.raises(NotAQuaternion, match="PSM2"):
        read(broken)


def test_without_stamps_a_rate_is_needed_and_joints_need_an_instrument():
    text = without(PLAIN, "timestamp")
    with pytest.raises(BadColumns, match="rate_hz"):
        read(text)
    assert np.diff(read(text, rate_hz=30.0).motions[0].stamps_ns).max() == 33_333_334
    joints = without(MORE, *[f"psm{arm}_{name}" for arm in (1, 2) for name in (*written.STATES, *written.LOCALS)])
    with pytest.raises(NoUsableTopic, match="instrument"):
        read(joints)
    got = read(joints, instrument="400006").motion_of(arm="PSM2")
    np.testing.assert_allclose(got.tip_mm, read(MORE).motion_of(topic="/PSM2/measured_cp").tip_mm, atol=1e-6)
    assert got.frame == "PSM2_base"


def test_samples_recorded_twice_are_dropped_and_counted():
    lines = PLAIN.splitlines()
    twice = [lines[0], *[line for line in lines[1:] for _ in range(2)]]
    motion = read("\n".join(twice) + "\n").motion_of(arm="PSM2")
    assert (motion.duplicate_stamps, len(motion.stamps_ns)) == (120, 120)


@pytest.mark.parametrize(
    ("text", "how", "error", "message"),
    [
        (without(PLAIN, "psm1_pose.position.y"), {}, BadColumns, "y of PSM1's pose is missing"),
        (without(MORE, "psm1_js[2]"), {}, BadColumns, "q3 of PSM1's joints is missing"),
        (PLAIN.replace("psm1_sp.position.x", "psm1_pose.position.x", 1), {}, BadColumns, "twice"),
        (PLAIN.replace("psm1_sp.position.x", "timestamp", 1), {}, BadColumns, "twice"),
        (PLAIN[:-3], {}, UnreadableRecording, "was cut"),
        (PLAIN, {"rate_hz": 30.0}, BadColumns, "use one of them"),
        (PLAIN, {"table_arm": "PSM1"}, BadSettings, "omit table_arm"),
        (changed(PLAIN, "psm2_pose.position.x", 3, "None"), {}, UnreadableRecording, "Row 5, column psm2_pose.pos"),
        (changed(PLAIN, "timestamp", 3, "1750000000.5"), {}, BadColumns, "in which unit is it"),
    ],
)
def test_what_cannot_be_meant_is_refused(text, how, error, message):
    with pytest.raises(error, match=message):
        read(text, **how)


def test_a_mapping_reads_one_arm_of_it():
    column = [f"{axis}_m=psm2_pose.position.{axis}" for axis in "xyz"]
    recording = read(PLAIN, column=[*column, "t_ns=timestamp"], table_arm="PSM2", frame="base")
    np.testing.assert_array_equal(recording.motion_of().tip_mm, read(PLAIN).motion_of(arm="PSM2").tip_mm)
