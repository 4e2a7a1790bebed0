"""All signals of a dVRK recording besides the motions; broken ones are left out and named."""

import io

import numpy as np
import pytest

from skills.errors import BackwardStamps, NotFinite, NoUsableTopic, SkillsError
from skills.formats import bag_writer, read_recording, topics
from skills.formats.bag_writer import messages_of
from skills.formats.mcap import read_mcap
from skills.formats.topics import TopicKind
from tests.formats import bags, large, others
from tests.formats.bags import LOCAL, START_NS, STEP_NS, bag, header, pose, straight
from tests.formats.definitions import DEFINITIONS

POSES = [(START_NS + k * STEP_NS, LOCAL, topics.POSE, one) for k, one in enumerate(straight(10))]


def read(*events):
    return read_mcap(io.BytesIO(bag([*POSES, *events], definitions=DEFINITIONS)))


def at(step, topic, message_type, **message):
    """Write an event `step` steps after the start, with a header if its type has one."""
    stamp_ns = START_NS + step * STEP_NS
    plain = message_type in (topics.BOOL, topics.FLOAT64, topics.STRING)
    return stamp_ns, topic, message_type, message if plain else {"header": header(stamp_ns), **message}


def joints(step, topic, positions):
    names = [f"j{k}" for k in range(len(positions))]
    return at(step, topic, topics.JOINT_STATE, name=names, position=positions, velocity=[], effort=[])


def joy(step, topic, buttons):
    return at(step, topic, topics.JOY, axes=[], buttons=buttons)


def test_a_session_with_everything_in_it_is_read():
    master = pose(START_NS, 0.1, frame="MTMR_base")
    recording = read(
        joints(0, "/PSM2/measured_js", [0.1, 0.2, 0.15, 0.3, 0.4, 0.5]),
        joints(0, "/MTMR/measured_js", [0.1, 0.2, 0.15, 0.3, 0.4, 0.5, 0.6]),
        joints(0, "/PSM2/jaw/measured_js", [0.7]),
        joints(0, "/MTMR/gripper/measured_js", [0.8]),
        (START_NS, "/MTMR/measured_cp", topics.POSE, master),
        joy(1, "/footpedals/clutch", [1]),
        joy(2, "/footpedals/cam_plus", [2]),
        at(3, "/console/operator_present", topics.BOOL, data=True),
        at(4, "/MTMR_PSM2/following", topics.BOOL, data=True),
        at(5, "/MTMR_PSM2/following", topics.BOOL, data=False),
        at(4, "/MTMR_PSM2/scale", topics.FLOAT64, data=0.2),
        at(1, "/PSM2/tool_type", topics.STRING, data="LARGE_NEEDLE_DRIVER:400006"),
        at(2, "/PSM2/tool_type", topics.STRING, data="PROGRASP_FORCEPS:400049"),
    )
    psm, mtm = sorted(recording.joints, key=lambda one: one.arm)[::-1]
    assert (psm.arm, psm.positions.tolist()) == ("PSM2", [[0.1, 0.2, 150.0, 0.3, 0.4, 0.5]])
    assert (mtm.arm, mtm.positions.tolist()) == ("MTMR", [[0.1, 0.2, 0.15, 0.3, 0.4, 0.5, 0.6]])
    assert [(arm, signal.values.tolist()) for arm, signal in recording.jaws] == [("PSM2", [0.7])]
    assert [(arm, signal.values.tolist()) for arm, signal in recording.grippers] == [("MTMR", [0.8])]
    assert [(one.arm, one.frame, one.tip_mm[0, 0]) for one in recording.masters] == [("MTMR", "MTMR_base", 100.0)]
    assert recording.arms == ("PSM2",)
    assert {name: signal.values.tolist() for name, signal in recording.pedals} == {
        "/console/operator_present": [1.0],
        "/footpedals/cam_plus": [2.0],
        "/footpedals/clutch": [1.0],
    }
    assert recording.clutch is dict(recording.pedals)["/footpedals/clutch"]
    (following,) = recording.following
    assert following[0] == "MTMR_PSM2"
    assert following[1].values.tolist() == [1.0, 0.0]
    assert following[1].stamps_ns.tolist() == [START_NS + 4 * STEP_NS, START_NS + 5 * STEP_NS]  # the time of logging
    assert [(name, signal.values.tolist()) for name, signal in recording.scales] == [("MTMR_PSM2", [0.2])]
    assert recording.tools == (("PSM2", "PROGRASP_FORCEPS:400049"),)
    assert recording.left_out == ()


@pytest.mark.parametrize(
    ("event", "said"),
    [
        (joints(0, "/PSM2/measured_js", [0.1, float("nan"), 0.2]), "NaN"),
        (joints(0, "/PSM2/measured_js", [0.1]), "1 joints"),
        (joints(0, "/MTMR/gripper/measured_js", []), "without a value"),
        (joy(0, "/footpedals/coag", []), "without a value"),
        (at(0, "/PSM2/tool_type", topics.STRING, data="x" * 300), "no instrument"),
        (at(0, "/PSM2/tool_type", topics.STRING, data="a\nb"), "no instrument"),
        (at(0, "/MTMR_PSM2/scale", topics.FLOAT64, data=float("inf")), "NaN or infinity"),
        ((START_NS, "/MTMR/measured_cp", topics.POSE, pose(START_NS, 50.0)), "50 m"),
    ],
)
def test_what_a_demonstration_does_not_rest_on_is_left_out_and_named(event, said):
    recording = read(event)
    ((topic, why),) = recording.left_out
    assert topic == event[1]
    assert said in why
    assert len(recording.motions) == 1
    named = (recording.joints, recording.masters, recording.grippers, recording.pedals, recording.scales)
    assert not any(named)
    assert not recording.tools


@pytest.mark.parametrize(
    ("events", "error"),
    [
        ([joints(0, "/PSM2/jaw/measured_js", [])], NoUsableTopic),
        ([joints(0, "/PSM2/jaw/measured_js", [float("nan")])], NotFinite),
        ([joy(0, "/console/clutch", [])], NoUsableTopic),
        (
            [(START_NS + 1, "/console/clutch", topics.JOY, {"header": header(START_NS - k)}) for k in (0, 1)],
            SkillsError,
        ),
        ([(START_NS, "/PSM1/measured_cp", topics.POSE, pose(START_NS, float("nan")))], NotFinite),
        (
            [
                (START_NS + k, "/PSM1/measured_cp", topics.POSE, pose(START_NS - k * STEP_NS, 0.0, frame="ECM"))
                for k in (0, 1)
            ],
            BackwardStamps,
        ),
    ],
)
def test_what_a_demonstration_rests_on_is_refused(events, error):
    with pytest.raises(error):
        read(*events)


def test_a_definition_without_what_is_wanted_is_left_out():
    definitions = {**DEFINITIONS, topics.FLOAT64: "float64 other\n"}
    event = at(0, "/MTMR_PSM2/scale", topics.FLOAT64, other=0.2)
    ((topic, why),) = read_mcap(io.BytesIO(bag([*POSES, event], definitions=definitions))).left_out
    assert topic == "/MTMR_PSM2/scale"
    assert "have no data" in why


@pytest.mark.parametrize(
    ("topic", "message_type", "kind", "whose"),
    [
        ("/PSM2/local/measured_cp", topics.POSE, TopicKind.MOTION, "PSM2"),
        ("/PSM2/measured_cp", topics.TRANSFORM, TopicKind.MOTION, "PSM2"),
        ("/CRTK/psm2/measured_cp", topics.POSE, TopicKind.MOTION, "psm2"),
        ("/dvrk/PSM1/position_cartesian_current", topics.POSE, TopicKind.MOTION, "PSM1"),
        ("/MTML1/measured_cp", topics.POSE, TopicKind.MASTER, "MTML1"),
        ("/MTMR2/gripper/measured_js", topics.JOINT_STATE, TopicKind.GRIPPER, "MTMR2"),
        ("/CRTK/psm1/measured_js", topics.JOINT_STATE, TopicKind.JOINTS, "psm1"),
        ("/PSM3/jaw/measured_js", topics.JOINT_STATE, TopicKind.JAW, "PSM3"),
        ("/console/clutch", topics.BOOL, TopicKind.PEDAL, "/console/clutch"),
        ("/dvrk/footpedals/bicoag", topics.JOY, TopicKind.PEDAL, "/dvrk/footpedals/bicoag"),
        ("/MTML_PSM1/following", topics.BOOL, TopicKind.FOLLOWING, "MTML_PSM1"),
        ("/PSM1/tool_type", topics.STRING, TopicKind.TOOL, "PSM1"),
        ("/PSM2/setpoint_cp", topics.POSE, TopicKind.SETPOINT, "PSM2"),
        ("/CRTK/psm2/local/setpoint_cp", topics.TRANSFORM, TopicKind.SETPOINT, "psm2"),
        ("/dvrk/PSM2/position_cartesian_desired", topics.POSE, TopicKind.SETPOINT, "PSM2"),
        ("/PSM2/jaw/setpoint_js", topics.JOINT_STATE, TopicKind.JAW_SETPOINT, "PSM2"),
    ],
)
def test_a_topic_and_its_type_say_what_it_tells(topic, message_type, kind, whose):
    said = topics.meaning(topic, message_type)
    assert said is not None
    assert (said.kind, said.owner) == (kind, whose)


@pytest.mark.parametrize(
    ("topic", "message_type"),
    [
        ("/MTMR/setpoint_cp", topics.POSE),
        ("/PSM2/servo_cp", topics.POSE),
        ("/PSM2/goal_cp", topics.POSE),
        ("/CRTK/psm2/T_b_w", topics.POSE),
        ("/SUJ/PSM2/measured_cp", topics.POSE),
        ("/ECM/measured_cp", topics.POSE),
        ("/CRTK/Needle/measured_cp", topics.POSE),
        ("/PSM2/setpoint_js", topics.JOINT_STATE),
        ("/MTMR/jaw/setpoint_js", topics.JOINT_STATE),
        ("/SUJ/PSM2/measured_js", topics.JOINT_STATE),
        ("/SUJ/joint_states", topics.JOINT_STATE),
        ("/MTMR/jaw/measured_js", topics.JOINT_STATE),
        ("/console/teleop/enabled", topics.BOOL),
        ("/console/teleop/scale", topics.FLOAT64),
        ("/console/camera_quick_tap", topics.JOY),
        ("/PSM2/measured_cp", topics.JOINT_STATE),
    ],
)
def test_other_topics_tell_nothing_here(topic, message_type):
    assert topics.meaning(topic, message_type) is None


def test_what_an_arm_was_told_to_do_is_no_demonstration_of_what_it_did():
    told = [(log, "/PSM2/setpoint_cp", kind, message) for log, _, kind, message in POSES]
    with pytest.raises(NoUsableTopic, match="setpoint_cp"):
        read_mcap(io.BytesIO(bag(told)))


def test_four_arms_are_read_as_they_were_made():
    recording = read_mcap(io.BytesIO(large.four_arms(seconds=2.0)))
    assert sorted((one.arm, one.frame, len(one.stamps_ns)) for one in (*recording.motions, *recording.masters)) == [
        (arm, frame, 400) for arm in ("MTML", "MTMR", "PSM1", "PSM2") for frame in ("ECM", f"{arm}_base")
    ]
    assert {one.arm: one.positions.shape for one in recording.joints} == dict.fromkeys(
        ("MTML", "MTMR", "PSM1", "PSM2"), (400, 6)
    )
    assert recording.integrity == "full"
    for one in recording.motions:
        assert np.ptp(one.tip_mm, axis=0).max() > 5.0


@pytest.mark.parametrize("space", ["/dvrk", ""])
def test_the_topics_of_dvrk_1_are_those_of_today_under_other_names(space):
    arm, at = f"{space}/PSM1", [START_NS + k * STEP_NS for k in range(8)]
    turn, place = (0.0, 0.0, 0.0, 1.0), (0.01, 0.05, -0.12)
    said = []
    for stamp_ns in at:
        said += [
            bag_writer.pose(f"{arm}/position_cartesian_current", stamp_ns, "ECM", (0.02, 0.0, 0.1), turn),
            bag_writer.pose(f"{arm}/position_cartesian_local_current", stamp_ns, "PSM1_base", place, turn),
            bag_writer.joint_state(f"{arm}/state_joint_current", stamp_ns, [0.1, 0.2, 0.15, 0.3, 0.4, 0.5]),
            bag_writer.joint_state(f"{arm}/state_jaw_current", stamp_ns, [0.7]),
            bag_writer.joint_state(f"{arm}/state_jaw_desired", stamp_ns, [0.6]),
            bag_writer.joint_state(f"{space}/MTMR/state_gripper_current", stamp_ns, [0.5]),
            bag_writer.joint_state(f"{arm}/state_wheel_current", stamp_ns, [0.5]),
            bag_writer.joint_state(f"{arm}/state_joint_desired", stamp_ns, [0.5]),
        ]
    out = io.BytesIO()
    bag_writer.write_messages(said, out)
    got = read_recording(io.BytesIO(out.getvalue()))
    assert got.motion_of().topic == f"{arm}/position_cartesian_local_current"
    assert got.motion_of().states_base
    assert got.joints[0].positions[0].tolist() == [0.1, 0.2, 150.0, 0.3, 0.4, 0.5]
    assert (got.jaw_of("PSM1").values[0], got.jaw_setpoint_of("PSM1").values[0]) == (0.7, 0.6)
    assert [name for name, _ in got.grippers] == ["MTMR"]
    assert [topic for topic, _ in got.left_out] == [f"{arm}/state_wheel_current"]  # a setpoint of joints is never read


def test_what_is_not_understood_of_an_arm_is_left_out_by_name(tmp_path):
    odd = [bag_writer.joint_state("/PSM2/torque", START_NS + k, [0.1]) for k in range(9)]
    path = others.rosbag1(sorted([*messages_of(bags.recording(20)), *odd], key=lambda m: m.log_ns), tmp_path / "a.bag")
    assert [topic for topic, _ in read_recording(io.BytesIO(path.read_bytes())).left_out] == ["/PSM2/torque"]
