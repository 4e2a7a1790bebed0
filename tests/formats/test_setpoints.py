"""Setpoints: read beside the measured motion from every format, never a motion, and never a reason for a refusal."""

import io
from dataclasses import replace

import numpy as np
import pytest

from skills import packing
from skills.demonstration.demonstration import cut_demo
from skills.demonstration.recording import Recording
from skills.errors import NoUsableTopic
from skills.formats import bag_writer as messages
from skills.formats import read_recording, topics
from skills.formats.bag_writer import Message, messages_of, write_messages
from skills.formats.columns import APART_MM
from skills.formats.mcap import read_mcap
from skills.formats.parsed import parse
from skills.formats.reader_process import KNOWN
from skills.schemas.recordings import Setpoints
from tests.formats import lerobots, written
from tests.formats.bags import LOCAL, START_NS, STEP_NS, assert_same, recording
from tests.formats.others import NOETIC, rosbag1, whole
from tests.formats.test_confined import same

TIP, JAW = "/PSM2/local/setpoint_cp", "/PSM2/jaw/setpoint_js"
TURN = (0.0, 0.0, 0.0, 1.0)
COUNT = 40


def tip(k: int, *, x_m: float = 0.001, frame: str = "PSM2_base", turn=TURN, at_ns: int | None = None) -> Message:
    """Return one setpoint of a tip, logged at step k."""
    log_ns = START_NS + k * STEP_NS
    said = messages.pose(TIP, log_ns if at_ns is None else at_ns, frame, (x_m, 0.05, -0.12), turn)
    return replace(said, log_ns=log_ns)


def jaw(k: int, *angles: float) -> Message:
    """Return one setpoint of a jaw."""
    return messages.joint_state(JAW, START_NS + k * STEP_NS, angles, ["jaw"][: len(angles)])


def tips(**change) -> list[Message]:
    """Return sound setpoints of a tip, of which the fifth is changed."""
    return [tip(k, **(change if k == 5 else {})) for k in range(COUNT)]


def mcap(said: list[Message]) -> bytes:
    with io.BytesIO() as out:
        write_messages(sorted([*messages_of(recording(COUNT)), *said], key=lambda one: one.log_ns), out)
        return out.getvalue()


FAULTS = {
    "NaN": (tips(x_m=float("nan")), "NaN"),
    "metres": (tips(x_m=50.0), "50 m"),
    "quaternion": (tips(turn=(0.0, 0.0, 0.0, 2.0)), "length 2"),
    "frames": (tips(frame="ECM"), "2 frames"),
    "backwards": (tips(at_ns=START_NS - 10**9), "decrease"),
    "truncated": ([*tips()[:20], replace(tip(20), data=tip(20).data[:-30]), *tips()[21:]], ""),
    "jaw of NaN": ([jaw(k, float("nan")) for k in range(COUNT)], "NaN"),
    "jaw without a value": ([jaw(k) for k in range(COUNT)], "without a value"),
}


# ---- bags


def test_setpoints_of_a_bag_belong_to_the_motion_in_their_frame():
    found = read_mcap(io.BytesIO(mcap([*tips(), *(jaw(k, 0.3) for k in range(COUNT))])))
    (setpoint,) = found.setpoints
    assert found.setpoint_of(found.motion_of()) is setpoint
    assert (setpoint.topic, setpoint.tip_mm[0, 0]) == (TIP, 1.0)
    assert found.jaw_setpoint_of("PSM2").values.tolist() == [0.3] * COUNT
    assert [motion.topic for motion in found.motions] == [LOCAL]
    assert found.left_out == ()


@pytest.mark.parametrize(
    ("arm", "topic", "frame"),
    [
        ("PSM1", "/PSM1/local/setpoint_cp", "PSM2_base"),
        ("PSM2", TIP, "ECM"),
        ("PSM2", "/PSM2/setpoint_cp", "camera"),
    ],
)
def test_setpoints_of_another_arm_or_frame_are_not_paired(arm, topic, frame):
    motion = recording().motions[0]
    setpoint = replace(motion, arm=arm, topic=topic, frame=frame)
    assert replace(recording(), setpoints=(setpoint,)).setpoint_of(motion) is None


def test_the_same_frame_name_of_a_base_and_of_a_camera_is_no_pair():
    motion = replace(recording().motions[0], frame="Cart")  # local by its topic
    setpoint = replace(motion, topic="/PSM2/setpoint_cp")
    found = replace(recording(), motions=(motion,), setpoints=(setpoint,))
    assert found.setpoint_of(motion) is None
    local = replace(setpoint, topic=TIP)
    assert replace(found, setpoints=(setpoint, local)).setpoint_of(motion) is local


def test_a_recording_of_setpoints_alone_is_refused():
    with io.BytesIO() as out:
        write_messages(tips(), out)
        with pytest.raises(NoUsableTopic, match="setpoint_cp"):
            read_recording(out)


def test_setpoints_change_no_demonstration():
    plain, commanded = (read_mcap(io.BytesIO(mcap(said))) for said in ([], tips(x_m=0.2)))
    one, other = (cut_demo(found, arm="PSM2") for found in (plain, commanded))
    np.testing.assert_array_equal(one.tip_mm, other.tip_mm)
    assert parse(plain).proposed == parse(commanded).proposed


@pytest.mark.parametrize("fault", FAULTS)
def test_no_fault_of_setpoints_refuses_a_bag(fault, tmp_path):
    said, why = FAULTS[fault]
    found = read_mcap(io.BytesIO(mcap(said)))
    assert_same(found, recording(COUNT), tolerance_mm=1e-12)
    assert (found.setpoints, found.jaw_setpoints) == ((), ())
    ((topic, because),) = found.left_out
    assert topic == said[0].topic
    assert why in because


@pytest.mark.parametrize("fault", [name for name in FAULTS if name != "truncated"])
def test_no_fault_of_setpoints_refuses_a_ros_1_bag(fault, tmp_path):
    said, why = FAULTS[fault]
    every = sorted([*messages_of(recording(COUNT)), *said], key=lambda one: one.log_ns)
    found = read_recording(io.BytesIO(rosbag1(every, tmp_path / "session.bag").read_bytes()))
    assert (len(found.motions), found.setpoints, found.jaw_setpoints) == (1, (), ())
    assert why in dict(found.left_out)[said[0].topic]


def test_a_damaged_message_of_setpoints_refuses_no_bag(tmp_path, monkeypatch):
    real, seen = NOETIC.serialize_ros1, []

    def cut(value, message_type):
        data = real(value, message_type)
        seen.append(message_type)
        at_setpoint = message_type == topics.POSE and value.header.frame_id == "commanded" and len(seen) > 50
        return data[:-9] if at_setpoint else data

    monkeypatch.setattr(NOETIC, "serialize_ros1", cut)
    said = [tip(k, frame="commanded") for k in range(COUNT)]
    every = sorted([*messages_of(recording(COUNT)), *said], key=lambda one: one.log_ns)
    data = rosbag1(every, tmp_path / "session.bag").read_bytes()
    monkeypatch.undo()
    found = read_recording(io.BytesIO(data))
    assert_same(found, recording(COUNT), tolerance_mm=1e-12)
    assert found.setpoints == ()
    assert dict(found.left_out) == {TIP: f"A message of {TIP} ends within a field."}


def later(count: int) -> Recording:
    """Return the motion of the recording a second later."""
    motion = recording(count).motions[0]
    return Recording("mcap", "full", (replace(motion, stamps_ns=motion.stamps_ns + 10**9),))


def test_parts_that_do_not_agree_lose_their_setpoints_alone():
    camera = sorted([*messages_of(later(COUNT)), *(tip(k, frame="ECM") for k in range(COUNT))], key=lambda m: m.log_ns)
    with io.BytesIO() as out:
        write_messages(camera, out)
        found = read_mcap(io.BytesIO(mcap(tips())), others=[io.BytesIO(out.getvalue())])
    assert len(found.motions[0].stamps_ns) == 2 * COUNT
    assert found.setpoints == ()
    assert "record each frame on a separate topic" in dict(found.left_out)[TIP]


# ---- tables


TABLE = written.ee_csv(rows=60)


def read_table(text: str) -> Recording:
    return read_recording(io.BytesIO(text.encode()), frame="ECM")


def changed(text: str, name: str, cell: str) -> str:
    """Return a table with a cell of its third row changed."""
    rows = [line.split(",") for line in text.splitlines()]
    rows[3][rows[0].index(name)] = cell
    return "\n".join(map(",".join, rows)) + "\n"


def test_the_setpoints_of_a_table_are_its_columns():
    found = read_table(TABLE)
    for motion in found.motions:
        setpoint = found.setpoint_of(motion)
        np.testing.assert_array_equal(setpoint.tip_mm, motion.tip_mm)  # the samples have them equal
        np.testing.assert_array_equal(setpoint.rotation_xyzw, motion.rotation_xyzw)
        np.testing.assert_array_equal(found.jaw_setpoint_of(motion.arm).values, found.jaw_of(motion.arm).values)
    assert {column.quantity for column in found.columns} >= {"PSM1 setpoint x", "PSM1 setpoint jaw", "PSM2 setpoint qw"}


@pytest.mark.parametrize(
    ("text", "topic", "why"),
    [
        (changed(TABLE, "psm1_sp.position.y", "nan"), "/PSM1/setpoint_cp", "NaN"),
        (changed(TABLE, "psm1_sp.position.y", "no number"), "/PSM1/setpoint_cp", "not a number"),
        (changed(TABLE, "psm2_jaw_sp", "inf"), "/PSM2/jaw/setpoint_js", "NaN or inf"),
        (changed(TABLE, "psm2_sp.orientation.w", "3"), "/PSM2/setpoint_cp", "length"),
        (TABLE.replace("psm2_sp.orientation.w", "else", 1), "/PSM2/setpoint_cp", "missing"),
        (TABLE.replace("psm2_sp.orientation.w", "psm2_sp.orientation.x", 1), "/PSM2/setpoint_cp", "twice"),
    ],
)
def test_no_fault_of_setpoints_refuses_a_table(text, topic, why):
    found, plain = read_table(text), read_table(TABLE)
    assert_same(found, plain)
    assert topic not in {one.topic for one in found.setpoints} | {one.topic for _, one in found.jaw_setpoints}
    assert why in dict(found.left_out)[topic]


def test_setpoints_far_from_the_tip_are_in_another_frame_and_left_out():
    head, *rows = TABLE.splitlines()
    at = head.split(",").index("psm2_sp.position.z")

    def moved(by_mm: float) -> Recording:
        cells = [row.split(",") for row in rows]
        for row in cells:
            row[at] = repr(float(row[at]) + by_mm / 1000)
        return read_table("\n".join([head, *map(",".join, cells)]) + "\n")

    assert {one.arm for one in moved(APART_MM - 0.1).setpoints} == {"PSM1", "PSM2"}
    far = moved(APART_MM + 0.1)
    assert {one.arm for one in far.setpoints} == {"PSM1"}
    assert "another frame" in dict(far.left_out)["/PSM2/setpoint_cp"]


# ---- LeRobot


def read_episode(action, *, names=None, frame: str | None = "ECM", **how) -> Recording:
    files = lerobots.episode(lerobots.columns_of(40, action=action), names=names and {"action": [names]}, **how)
    return read_recording(lerobots.packed(files), frame=frame)


def test_actions_that_are_called_setpoints_are_read_as_such():
    action = lerobots.commands()
    found = read_episode(action)
    for k, motion in enumerate(found.motions):
        setpoint = found.setpoint_of(motion)
        at = 8 * k
        np.testing.assert_array_equal(setpoint.tip_mm, 1000.0 * action[:, at : at + 3].astype(np.float64))
        np.testing.assert_array_equal(setpoint.rotation_xyzw, action[:, at + 3 : at + 7].astype(np.float64))
        np.testing.assert_array_equal(found.jaw_setpoint_of(motion.arm).values, action[:, at + 7].astype(np.float64))
    assert found.left_out == ()


def test_actions_under_the_names_of_the_state_are_not_read():
    found = read_episode(lerobots.commands(), names=lerobots.STATE)
    assert (found.setpoints, found.jaw_setpoints, found.left_out) == ((), (), ())


def test_stated_columns_are_setpoints_whatever_their_names():
    said = {"columns": {name: f"action[{k}]" for k, name in enumerate(lerobots.ACTION)}}
    found = read_episode(lerobots.commands(), names=lerobots.STATE, said=said)
    assert [one.topic for one in found.setpoints] == ["/PSM1/setpoint_cp", "/PSM2/setpoint_cp"]


def test_setpoints_of_joints_become_poses_in_the_base():
    q = lerobots.joints(40)
    state = {f"observation.state.psm1.joint_{k + 1}": q[:, k] for k in range(6)}
    command = {f"action.psm1_joint_sp_{k + 1}": q[:, k] for k in range(6)}
    columns = lerobots.columns_of(40, **state, **command, **{"observation.state": None, "action": None})
    found = read_recording(lerobots.packed(lerobots.episode(columns)), frame=None)
    (motion,), (setpoint,) = found.motions, found.setpoints
    assert found.setpoint_of(motion) is setpoint
    assert setpoint.topic == "/PSM1/local/setpoint_cp"
    np.testing.assert_array_equal(setpoint.tip_mm, motion.tip_mm)


def with_change(row: int, column: int, value: float) -> np.ndarray:
    action = lerobots.commands()
    action[row, column] = value
    return action


@pytest.mark.parametrize(
    ("action", "names", "topic", "why"),
    [
        (with_change(3, 0, np.nan), None, "/PSM1/setpoint_cp", "NaN"),
        (with_change(3, 7, np.inf), None, "/PSM1/jaw/setpoint_js", "NaN"),
        (with_change(3, 6, 4.0), None, "/PSM1/setpoint_cp", "length"),
        (np.ones((40, 16), np.float32), None, "/PSM1/setpoint_cp", "length"),
        (lerobots.commands()[:, :15], lerobots.ACTION[1:], "/PSM1/setpoint_cp", "no column position.x"),
        (lerobots.commands(), [*lerobots.ACTION[:-1], "psm1_jaw_sp"], "/PSM1/jaw/setpoint_js", "Two columns"),
        (["text"] * 40, None, None, None),
    ],
)
def test_no_fault_of_setpoints_refuses_an_episode(action, names, topic, why):
    found = read_episode(action, names=names)
    assert_same(found, read_episode(lerobots.commands()))
    if topic is not None:
        assert topic not in {one.topic for one in found.setpoints} | {one.topic for _, one in found.jaw_setpoints}
        assert why in dict(found.left_out)[topic]


def test_a_column_of_setpoints_that_cannot_be_read_refuses_no_episode():
    columns = lerobots.columns_of(40)
    short = lerobots.parquet(lerobots.table(columns | {"action": lerobots.commands()[:, :3]}))
    files = lerobots.episode(columns, data=short)
    found = read_recording(lerobots.packed(files), frame="ECM")
    assert_same(found, read_episode(lerobots.commands()))
    assert found.setpoints == ()
    assert "does not have 16 numbers" in dict(found.left_out)["/PSM1/setpoint_cp"]


# ---- passed on


def test_setpoints_pass_between_processes_unchanged():
    given = whole()
    with io.BytesIO() as file:
        packing.write(file, given, KNOWN)
        file.seek(0)
        assert same(given, packing.read(file, KNOWN))


def test_setpoints_are_described_where_there_are_any():
    assert parse(recording()).about.setpoints == []
    assert parse(whole()).about.setpoints == [
        Setpoints("PSM2", TIP, "PSM2_base", 10),
        Setpoints("PSM2", "/PSM2/setpoint_cp", "ECM", 10),
        Setpoints("PSM2", JAW, None, 10),
    ]
