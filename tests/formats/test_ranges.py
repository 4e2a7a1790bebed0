"""Angles that no joint, jaw or orientation has in their unit are refused or asked about, in every format."""

import io

import numpy as np
import pytest

from skills import errors
from skills.formats import bag_writer, read_recording
from tests.formats import lerobots
from tests.formats.bags import START_NS, STEP_NS
from tests.formats.others import zipped
from tests.formats.test_pace import DOWN, in_ns, messages, read, stroke, table

COUNT = 60
OPEN_DEG = np.linspace(-12, 47, COUNT)  # of a jaw


def written(said):
    out = io.BytesIO()
    bag_writer.write_messages(said, out)
    return read_recording(io.BytesIO(out.getvalue()))


def beside(topic, rows):
    """Return a bag's recording with joint states on a topic beside the poses."""
    seconds, tip = stroke(COUNT)
    said = messages(in_ns(seconds), tip, in_ns(seconds))
    return written([*said, *(bag_writer.joint_state(topic, START_NS + k * STEP_NS, row) for k, row in enumerate(rows))])


@pytest.mark.parametrize("degrees", [(171.0, -8.0, 95.0), (-30.0, 12.0, 7.0)])
def test_roll_pitch_and_yaw_beyond_a_turn_are_asked_about(degrees):
    turns = {f"{name}_{{}}": np.full(COUNT, one) for name, one in zip(("roll", "pitch", "yaw"), degrees, strict=True)}
    in_rad, in_deg = ({name.format(unit): one for name, one in turns.items()} for unit in ("rad", "deg"))
    with pytest.raises(errors.NotAQuaternion, match=r"more than a turn\. Are they in degrees"):
        read(table(*stroke(COUNT), **in_rad))
    assert read(table(*stroke(COUNT), **in_deg)).motion_of().rotation_xyzw is not None


@pytest.mark.parametrize(
    ("names", "radians"),
    [
        (("roll", "pitch", "yaw"), [3.05, -0.1, 1.5]),
        (("rx", "ry", "rz"), [2.1, 0.2, -0.9]),
        (("jaw",), [0.7]),
    ],
)
def test_degrees_that_have_the_numbers_of_radians_are_asked_about(names, radians):
    columns = {f"{name}_deg": one * np.linspace(0.9, 1, COUNT) for name, one in zip(names, radians, strict=True)}
    with pytest.raises(errors.BadColumns, match=rf"radians have such numbers.*{names[0]}_rad={names[0]}_deg"):
        read(table(*stroke(COUNT), **columns))
    read(table(*stroke(COUNT), **{name: 57.3 * values for name, values in columns.items()}))


def test_joints_in_degrees_with_numbers_of_radians_are_asked_about():
    names = ["q1_deg", "q2_deg", "q3_m", "q4_deg", "q5_deg", "q6_deg"]
    rows = "\n".join(",".join(map(repr, [k / 100, *row])) for k, row in enumerate(lerobots.joints(40).tolist()))
    with pytest.raises(errors.BadColumns, match="radians have such numbers"):
        read(",".join(["t_s", *names]) + "\n" + rows + "\n", instrument="400006")


def test_an_orientation_or_a_jaw_of_zero_is_one_in_any_unit():
    none = {f"{name}_deg": np.zeros(COUNT) for name in ("roll", "pitch", "yaw", "jaw")}
    assert (read(table(*stroke(COUNT), **none)).jaw_of("PSM").values == 0).all()


def test_a_jaw_in_degrees_is_asked_about_in_every_format():
    with pytest.raises(errors.NotMetres, match=r"jaw's angle of -12 rad at 0\.000 s.*degrees"):
        beside("/PSM1/jaw/measured_js", OPEN_DEG[:, None].tolist())
    with pytest.raises(errors.NotMetres, match="degrees"):
        read(table(*stroke(COUNT), jaw_rad=OPEN_DEG))
    state = lerobots.poses(COUNT)
    state[:, 7] = OPEN_DEG
    with pytest.raises(errors.NotMetres, match="degrees"):
        read(zipped(lerobots.episode(lerobots.columns_of(COUNT, **{"observation.state": state}))), frame="ECM")
    seconds, tip = stroke(COUNT, 30)
    names = [f"psm1_pose.position.{axis}" for axis in "xyz"] + [f"psm1_pose.orientation.{part}" for part in "xyzw"]
    rows = [
        ",".join([str(at), *map(repr, (one / 1000).tolist()), *map(repr, map(float, DOWN)), repr(float(jaw))])
        for at, one, jaw in zip(in_ns(seconds).tolist(), tip, OPEN_DEG, strict=True)
    ]
    with pytest.raises(errors.NotMetres, match="degrees"):
        read("\n".join([",".join(["timestamp", *names, "psm1_jaw"]), *rows, ""]), frame="ECM")


def test_setpoints_and_grippers_in_degrees_are_left_out_with_the_reason():
    for topic in ("/PSM1/jaw/setpoint_js", "/MTMR/gripper/measured_js"):
        assert "degrees" in dict(beside(topic, OPEN_DEG[:, None].tolist()).left_out)[topic]


def test_joints_in_degrees_beside_poses_are_left_out_of_a_bag():
    degrees = lerobots.joints(COUNT)
    degrees[:, [0, 1, 3, 4, 5]] *= 180 / np.pi
    topic = "/PSM1/measured_js"
    assert "no joint of a PSM is" in dict(beside(topic, degrees.tolist()).left_out)[topic]
    assert beside(topic, lerobots.joints(COUNT).tolist()).joints[0].positions.shape == (COUNT, 6)
    names = [f"psm1_joint_{k}" for k in range(1, 7)] + ["psm1_jaw"]
    state = np.concatenate([degrees, np.full((COUNT, 1), 0.2)], axis=1).astype(np.float32)
    columns = lerobots.columns_of(COUNT, **{"observation.state": state})
    with pytest.raises(errors.NotMetres, match="no joint of a PSM is"):
        read(zipped(lerobots.episode(columns, names={"observation.state": names})))
