"""Recordings: the bases of their arms, by paired poses and by joints."""

import io
from dataclasses import replace

import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore

from skills import packing
from skills.demonstration.demonstration import cut_demo
from skills.demonstration.recording import PAIR_NS, Joints, Motion, Recording, base_frames
from skills.demonstration.segments import propose_segments
from skills.errors import JointsDisagree, NotMetres
from skills.formats import read_recording
from skills.formats.bag_writer import write_mcap
from skills.formats.parsed import parse, parse_recording
from skills.formats.reader_process import KNOWN
from skills.kinematics import angle_between, forward, instrument_of, matrix_of, quaternion_of, solutions_of
from tests.demonstration.arms import MISTAKES, REAL, Recorded, another_unit, cut, drawn, real
from tests.demonstration.sessions import A, Kind, M, session
from tests.formats.bags import sample_folder

BASE_MM = np.array([120.0, -40.0, 250.0])
TURN = np.array([0.2, -0.5, 0.4, 0.74])
TURN /= np.linalg.norm(TURN)
STAMPS_NS = 10**18 + np.arange(200) * 10**7


def turns(rng, count):
    drawn = rng.normal(size=(count, 4))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def local(rng):
    tip_mm = rng.uniform(-100, 100, (200, 3))
    return Motion("PSM1", "/PSM1/local/measured_cp", "PSM1_base", STAMPS_NS, tip_mm, turns(rng, 200))


def seen(motion, *, moved_mm=0.0, turned_rad=0.0, late_ns=0, topic="/PSM1/measured_cp", frame="ECM"):
    """Express a motion in the frame in which the base stands; in the second half of the time the base may move."""
    base = np.tile(matrix_of(TURN[None]), (len(motion.stamps_ns), 1, 1))
    half = np.arange(len(base)) >= len(base) // 2 + 1
    little = matrix_of(np.array([[np.sin(turned_rad / 2), 0.0, 0.0, np.cos(turned_rad / 2)]]))[0]
    base[half] = base[half] @ little
    place = BASE_MM + np.where(half, moved_mm, 0.0)[:, None] * (1.0, 0.0, 0.0)
    tip_mm = place + np.einsum("tij,tj->ti", base, motion.tip_mm)
    rotation = quaternion_of(base @ matrix_of(motion.rotation_xyzw))
    return Motion(motion.arm, topic, frame, motion.stamps_ns + late_ns, tip_mm, rotation)


def of(*motions):
    return base_frames(Recording(format="mcap", integrity="full", motions=motions))


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def test_a_base_that_stood_still_is_found_exactly(rng):
    motion = local(rng)
    (base,) = of(motion, seen(motion))
    assert (base.arm, base.frame, base.local_frame) == ("PSM1", "ECM", "PSM1_base")
    np.testing.assert_allclose(base.position_mm, BASE_MM, rtol=0, atol=1e-9)
    assert angle_between(matrix_of(np.array([base.rotation_xyzw])), matrix_of(TURN[None]))[0] < 1e-9
    assert base.spread_mm < 1e-9
    assert base.spread_rad < 1e-7


def test_two_local_poses_of_an_arm_place_no_base(rng):
    motion = local(rng)
    assert of(motion, replace(motion, topic="/PSM1/local/filtered_cp", frame="PSM1_filtered")) == ()


def test_a_base_that_moved_says_how_far(rng):
    motion = local(rng)
    (base,) = of(motion, seen(motion, moved_mm=7.0))
    assert base.spread_mm == pytest.approx(7.0, abs=1e-6)
    np.testing.assert_allclose(base.position_mm, BASE_MM, rtol=0, atol=1e-6)
    (base,) = of(motion, seen(motion, turned_rad=0.1))
    assert base.spread_rad == pytest.approx(0.1, abs=1e-6)
    assert base.spread_mm > 5.0


def test_one_pose_that_is_wrong_changes_the_spread_and_not_the_base(rng):
    motion = local(rng)
    tip_mm = seen(motion).tip_mm.copy()
    tip_mm[17] += 30.0
    (base,) = of(motion, replace(seen(motion), tip_mm=tip_mm))
    np.testing.assert_allclose(base.position_mm, BASE_MM, rtol=0, atol=1e-6)
    assert base.spread_mm == pytest.approx(30.0 * np.sqrt(3.0))


def test_poses_are_paired_by_the_nearest_stamp_within_2_ms(rng):
    motion = local(rng)
    for late_ns in (-PAIR_NS, -1, PAIR_NS):
        (base,) = of(motion, seen(motion, late_ns=late_ns))
        assert base.spread_mm < 1e-9
    assert of(motion, seen(motion, late_ns=PAIR_NS + 1)) == ()


def test_a_base_is_told_only_where_both_poses_are_there_and_turned(rng):
    motion = local(rng)
    other = seen(motion)
    assert of(motion) == of(other) == ()
    assert of(motion, replace(other, arm="PSM2")) == ()
    assert of(motion, replace(other, frame="PSM1_base")) == ()
    assert of(motion, replace(other, rotation_xyzw=None)) == ()
    one = slice(0, 1)
    single = Motion(motion.arm, motion.topic, motion.frame, STAMPS_NS[one], motion.tip_mm[one], TURN[None])
    assert of(single, other) == of(replace(single, topic="/a"), motion) == ()


def test_quaternions_of_the_other_sign_are_the_same_turns(rng):
    motion = local(rng)
    signs = np.where(rng.random(200) < 0.5, -1.0, 1.0)[:, None]
    other = seen(motion)
    one, two = of(motion, other), of(motion, replace(other, rotation_xyzw=other.rotation_xyzw * signs))
    np.testing.assert_allclose(one[0].position_mm, two[0].position_mm, rtol=0, atol=1e-9)
    assert two[0].spread_rad < 1e-7


def test_where_orientations_do_not_fit_the_tips_the_tips_decide(rng):
    motion = local(rng)
    other = replace(seen(motion), rotation_xyzw=motion.rotation_xyzw)
    (base,) = of(motion, other)
    np.testing.assert_allclose(base.position_mm, BASE_MM, rtol=0, atol=1e-6)
    assert base.spread_mm < 1e-6
    off_rad = angle_between(matrix_of(TURN[None]), np.eye(3)[None])[0]
    assert base.spread_rad == pytest.approx(off_rad, abs=1e-6)


def test_the_recorded_arms_base_stands_still_in_the_camera_frame():
    """In this bag the tips were rotated by 90 degrees and shifted, while the orientations were left unchanged."""
    with (sample_folder() / "rosbag2" / "rosbag2.mcap").open("rb") as file:
        recording = read_recording(file)
    (base,) = base_frames(recording)
    assert (base.arm, base.frame, base.local_frame) == ("PSM2", "ECM", "PSM2_base")
    assert base.position_mm == pytest.approx((20.0, -10.0, 100.0), abs=1e-6)
    assert base.rotation_xyzw == pytest.approx((0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)), abs=1e-9)
    assert base.spread_mm < 1e-6
    assert base.spread_rad == pytest.approx(np.pi / 2)


CAMERA, LOCAL = f"/{A}/measured_cp", f"/{A}/local/measured_cp"


def joints_of(motion: Motion, instrument: str = "400006", late_ns: int = 300_000) -> Joints:
    """Return the joints that put the tip of an instrument where a motion has it, on stamps of their own."""
    q = solutions_of(motion.tip_mm, matrix_of(motion.rotation_xyzw), instrument_of(instrument))[:, 0]
    q[:, 3:] = np.unwrap(q[:, 3:], axis=0)
    return Joints(motion.arm, f"/{motion.arm}/measured_js", motion.stamps_ns + late_ns, q)


@pytest.fixture(scope="module")
def recorded() -> Recording:
    """Return a session of two arms with poses in both frames and joints."""
    value, _ = session(Kind(seed=4, passes=1))
    joints = tuple(joints_of(value.motion_of(topic=f"/{arm}/local/measured_cp")) for arm in (A, M))
    return replace(value, joints=joints)


def only(value: Recording, word: str) -> Recording:
    """Keep the motions whose topics contain (or, with a leading "-", do not contain) a word."""
    keep = [(word[1:] not in m.topic) if word[0] == "-" else (word in m.topic) for m in value.motions]
    return replace(value, motions=tuple(m for m, kept in zip(value.motions, keep, strict=True) if kept))


def test_poses_and_partner_in_a_cameras_frame_become_those_of_the_base(recorded):
    camera = only(recorded, "-local")
    (part,) = propose_segments(recorded, A)
    wanted, got = (cut_demo(one, arm=A, start_s=part.start_s, end_s=part.end_s) for one in (recorded, camera))
    assert (got.topic, got.frame, got.instrument) == (CAMERA, f"{A}_base", "400006")
    assert np.linalg.norm(got.tip_mm - wanted.tip_mm, axis=1).max() < 0.05  # mm; the session's poses have 0.02 mm noise
    assert angle_between(matrix_of(got.rotation_xyzw), matrix_of(wanted.rotation_xyzw)).max() < 1e-3
    assert got.partner.arm == wanted.partner.arm == M
    assert got.partner.instrument == "400006"
    np.testing.assert_allclose(got.partner.position_mm, wanted.partner.position_mm, atol=0.05)
    np.testing.assert_allclose(got.partner.base_mm, wanted.partner.base_mm, atol=0.05)


def test_what_joints_show_travels_with_the_recording(recorded):
    """So that a cut in another process, or from the cache, does not compute it again."""
    told, file = parse(recorded), io.BytesIO()
    packing.write(file, told, KNOWN)
    file.seek(0)
    again = packing.read(file, KNOWN)
    assert vars(again.recording).keys() >= {"identifications", "bases"}
    assert again.recording.identifications == recorded.identifications != ()
    assert again.recording.bases == recorded.bases != ()
    with pytest.raises(ValueError, match="Out of range float"):
        replace(told, bases=(replace(told.bases[0], spread_mm=float("nan")),))


def test_the_bases_of_a_recording_in_the_cameras_frame_are_found(recorded):
    paired = {base.arm: base for base in base_frames(recorded)}
    shown = {base.arm: base for base in base_frames(only(recorded, "-local"))}
    assert set(shown) == {A, M}
    for arm, base in shown.items():
        assert (base.frame, base.local_frame) == ("ECM", f"{arm}_base")
        np.testing.assert_allclose(base.position_mm, paired[arm].position_mm, atol=0.05)


def test_without_joints_a_demonstration_is_in_the_frame_of_its_poses(recorded):
    assert cut_demo(replace(only(recorded, "-local"), joints=()), arm=A).frame == "ECM"


def test_poses_without_a_frames_name_in_the_base_are_named_after_it(recorded):
    local = recorded.motion_of(topic=LOCAL)
    nameless = replace(recorded, motions=(replace(local, topic=CAMERA, frame=""),))
    demo = cut_demo(nameless)
    assert demo.frame == f"{A}_base"
    np.testing.assert_allclose(demo.tip_mm, cut_demo(recorded, topic=LOCAL).tip_mm, atol=0.02)


@pytest.mark.parametrize("instrument", ["400006", "420006", "400006-Si", "420006-Classic"])
@pytest.mark.parametrize("topic", [LOCAL, CAMERA])
def test_the_instrument_of_a_demonstration_is_the_one_that_its_joints_show(recorded, instrument, topic):
    joints = (joints_of(recorded.motion_of(topic=LOCAL), instrument),)
    tools = ((A, f"LARGE_NEEDLE_DRIVER:{instrument.partition('-')[0]}"),)
    demo = cut_demo(replace(recorded, joints=joints, tools=tools), topic=topic)
    assert (demo.instrument, demo.frame) == (instrument, f"{A}_base")


@pytest.mark.parametrize(
    ("named", "instrument"),
    [
        ("LARGE_NEEDLE_DRIVER:420006", "420006"),
        ("LARGE_NEEDLE_DRIVER:420006[..11]", "420006"),
        ("MEGA_NEEDLE_DRIVER:400194", "400194"),
        ("", "400006"),
    ],
)
def test_without_joints_the_instrument_is_the_stated_one(recorded, named, instrument):
    assert cut_demo(replace(recorded, joints=(), tools=((A, named),)), arm=A).instrument == instrument


@pytest.mark.parametrize("topic", [LOCAL, CAMERA])
def test_a_stated_instrument_that_does_not_fit_is_refused_by_name(recorded, topic):
    stated = replace(recorded, tools=((A, "MEGA_NEEDLE_DRIVER:400194"),))
    with pytest.raises(JointsDisagree, match="states 400194, but its joints and poses fit 400006") as caught:
        cut_demo(stated, topic=topic)
    assert caught.value.numbers["stated"] == "400194"
    assert "Correct the name of the tool" in str(caught.value)
    assert cut_demo(stated, arm=M).instrument == "400006"  # the other arm is not concerned


def test_poses_that_are_not_in_the_base_as_stated_are_refused(recorded):
    camera = recorded.motion_of(topic=CAMERA)
    for stated in (replace(camera, topic=LOCAL), replace(camera, frame=f"{A}_base")):
        with pytest.raises(
            JointsDisagree, match="stated to be relative to the arm's base, but the joints put the base"
        ):
            cut_demo(replace(recorded, motions=(stated,)))


def test_joints_in_degrees_contradict_poses_and_are_reported(recorded):
    (joints, *_) = recorded.joints
    degrees = replace(joints, positions=joints.positions * np.degrees([1, 1, np.pi / 180, 1, 1, 1]))
    value = replace(recorded, joints=(degrees,))
    with pytest.raises(JointsDisagree, match="if the joints were in degrees"):
        cut_demo(value, topic=LOCAL)
    assert cut_demo(value, topic=CAMERA).frame == "ECM"
    assert {one.found.verdict for one in value.identifications} == {"contradiction"}


def test_joints_far_in_time_from_the_poses_show_nothing(recorded):
    (joints, *_) = recorded.joints
    elsewhere = replace(joints, stamps_ns=joints.stamps_ns + 10**12)
    sparse = replace(joints, stamps_ns=joints.stamps_ns[::20], positions=joints.positions[::20])  # 0.2 s apart
    for one in (elsewhere, sparse):
        assert replace(recorded, joints=(one,)).identifications == ()


@pytest.mark.needs("recordings")
def test_the_camera_of_a_real_bag_is_found():
    store, rows = get_typestore(Stores.ROS1_NOETIC), {"/PSM2/measured_js": [], "/PSM2/measured_cp": []}
    with Reader(sample_folder() / "calibration" / "pitch_exp_traj_02_test_cropped.bag") as reader:
        for connection, _, data in reader.messages():
            if connection.topic in rows:
                message = store.deserialize_ros1(data, connection.msgtype)
                stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                rows[connection.topic].append((stamp_ns, message))
    (js, cp) = (
        [row for row, last in zip(of, [(-1, None), *of], strict=False) if row[0] > last[0]] for of in rows.values()
    )
    q = np.array([message.position for _, message in js]) * [1, 1, 1000, 1, 1, 1]
    poses = [message.pose for _, message in cp]
    tip_mm = 1000 * np.array([(p.position.x, p.position.y, p.position.z) for p in poses])
    turns = np.array([(p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w) for p in poses])
    stamps = [np.array([stamp for stamp, _ in of]) for of in (js, cp)]
    motion = Motion("PSM2", "/PSM2/measured_cp", "ECM", stamps[1], tip_mm, turns)
    value = Recording("rosbag1", "full", (motion,), joints=(Joints("PSM2", "/PSM2/measured_js", stamps[0], q),))
    (one,) = value.identifications
    assert (one.found.verdict, one.found.instrument) == ("identified", "400006")
    assert one.found.residual_mm < 0.05
    # The console's setting, as it seems: 200 mm along x, turned by 150 degrees about x.
    np.testing.assert_allclose(one.found.position_mm, [200.0, 0.0, 0.0], atol=0.005)
    assert abs(one.found.rotation_xyzw[0]) == pytest.approx(np.sin(np.radians(75)), abs=1e-5)
    demo = cut_demo(value)
    assert demo.frame == "PSM2_base"
    expected = forward(np.stack([np.interp(motion.stamps_ns, stamps[0], column) for column in q.T], axis=1))[0]
    assert np.sqrt((np.linalg.norm(demo.tip_mm - expected, axis=1) ** 2).mean()) < 0.05


@pytest.mark.needs("recordings")
@pytest.mark.parametrize("count", [2, pytest.param(40, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("mistake", [None, *MISTAKES])
def test_a_file_says_what_its_joints_show_and_no_planted_mistake_is_silent(mistake, count):
    for seed in range(count):
        one = drawn(2000 + seed) if seed % 4 else cut(real(REAL[seed // 4 % 3]), seed)
        try:
            about = parse_recording(
                io.BytesIO(one_file(mistake(one, np.random.default_rng(seed)) if mistake else one))
            ).about
        except NotMetres:  # positions a thousand times too large
            assert mistake is another_unit
            continue
        (shown,) = about.identifications
        verdict, stated = shown.found.verdict, shown.found.stated
        assert (verdict in ("identified", "undetermined")) == (mistake is None), (seed, one.truth, stated, shown)


def one_file(one: Recorded) -> bytes:
    """Write what was recorded as the MCAP file of a dVRK."""
    stamps_ns = np.arange(len(one.joints)) * 10**7
    topic, frame = ("/PSM2/local/measured_cp", "PSM2_base") if one.in_base else ("/PSM2/measured_cp", "ECM")
    motion = Motion("PSM2", topic, frame, stamps_ns, one.tip_mm, quaternion_of(one.rotation))
    joints = (Joints("PSM2", "/PSM2/measured_js", stamps_ns, one.joints),)
    tools = () if one.stated is None else (("PSM2", one.stated),)
    return write_mcap(Recording("mcap", "full", (motion,), joints=joints, tools=tools))
