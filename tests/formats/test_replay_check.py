"""Faults of a bag for replay that `skills verify` finds."""

import io
import zipfile
from dataclasses import replace
from functools import partial
from math import radians
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter

from skills.errors import BadBag, SkillsError
from skills.formats import bag_writer, replay_bag
from skills.formats.bag_writer import bag_folder
from skills.formats.verify import verify_bag
from tests.formats.others import zipped
from tests.formats.replays import FRAME, PSM2, RATE_HZ, arm, checked, members, papers, trajectory


def test_a_whole_bag_is_found_right_and_told_of():
    lines = verify_bag(io.BytesIO(replay_bag.seal(members())))
    assert lines[0].startswith("10 files")
    assert lines[2].startswith("PSM1 (PSM_M, 420006): 162 samples in 1.80 s")
    assert lines[3].startswith("PSM2 (PSM_A, 400006): 162 samples in 1.80 s")
    low, high = trajectory().tip_mm.min(axis=0), trajectory().tip_mm.max(axis=0)
    assert f"X [{low[0]:.2f}, {high[0]:.2f}]" in lines[3]


@pytest.mark.parametrize("name", sorted({**members(), "SHA256SUMS": b""}))
def test_a_flipped_byte_is_found_wherever_it_is(name):
    """Members are stored uncompressed, so that the byte is in the member itself.

    The archive's own checksum is correct.
    """
    with zipfile.ZipFile(io.BytesIO(replay_bag.seal(members()))) as archive:
        files = {one: archive.read(one) for one in archive.namelist()}
    for place in (0, len(files[name]) // 3, len(files[name]) - 1):
        flipped = bytearray(files[name])
        flipped[place] ^= 0x10
        with pytest.raises(BadBag) as refused:
            verify_bag(io.BytesIO(zipped(files | {name: bytes(flipped)}, zipfile.ZIP_STORED)))
        assert name in str(refused.value)


def test_a_flipped_byte_of_the_archive_is_found_by_its_own_checksums():
    whole = replay_bag.seal(members())
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(whole), 60).tolist():
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(rng.integers(0, 8))
        try:
            verify_bag(io.BytesIO(bytes(flipped)))
        except SkillsError:
            continue
        with zipfile.ZipFile(io.BytesIO(bytes(flipped))) as archive:  # dates and the like: nothing that moves
            assert {name: archive.read(name) for name in archive.namelist()} | members() == {
                name: archive.read(name) for name in archive.namelist()
            }


def rewritten(change: Any, name: str = "PSM2") -> dict[str, bytes]:
    """Return the files of a bag in which one arm's messages were changed, with all checksums correct."""
    said = [one for one in map(change, replay_bag.messages_of(arm(name))) if one is not None]
    return members() | bag_folder(said, name, replay_bag.notes_of(arm(name), "1" * 64))


def remade(motion: replay_bag.ArmMotion, plan: str = "1" * 64) -> dict[str, bytes]:
    return members() | replay_bag.folder_of(motion, plan)


def stamp_of(sample: int) -> int:
    return int(arm().stamps_ns[sample])


def test_a_changed_stamp_is_found():
    def change(one: bag_writer.Message) -> bag_writer.Message:
        if one.topic != PSM2[2] or one.log_ns != stamp_of(7):
            return one
        late = bag_writer.joint_state(one.topic, one.log_ns + 1, [0.1], ["jaw"], velocities=[0.0])
        return replace(late, log_ns=one.log_ns)

    with pytest.raises(BadBag, match=r"/PSM2/jaw/setpoint_js has stamps or log times that differ"):
        checked(rewritten(change))


@pytest.mark.parametrize("first", [0, -5])
def test_a_stamp_that_a_robot_would_drop_is_found(first):
    stamps_ns = arm().stamps_ns.copy()
    stamps_ns[3] = stamps_ns[2] + first
    with pytest.raises(BadBag, match="sample 3"):
        checked(remade(replace(arm(), stamps_ns=stamps_ns)))
    with pytest.raises(BadBag, match="sample 0"):
        checked(remade(replace(arm(), stamps_ns=arm().stamps_ns - replay_bag.EPOCH_NS)))


def test_a_bag_that_was_made_faster_is_found():
    faster = replay_bag.EPOCH_NS + (arm().stamps_ns - replay_bag.EPOCH_NS) * 9 // 10
    with pytest.raises(BadBag, match="sample 1 is earlier than 200 Hz allows"):
        checked(remade(replace(arm(), stamps_ns=faster)))


def test_a_missing_jaw_sample_is_found():
    with pytest.raises(BadBag, match="162 setpoints of its joints, 162 of its tip and 161 of its jaw"):
        checked(rewritten(lambda one: None if one.topic == PSM2[2] and one.log_ns == stamp_of(9) else one))


def test_a_moving_jaw_is_found():
    def change(one: bag_writer.Message) -> bag_writer.Message:
        if one.topic != PSM2[2] or one.log_ns < stamp_of(100):
            return one
        return bag_writer.joint_state(one.topic, one.log_ns, [0.9], ["jaw"], velocities=[0.0])

    with pytest.raises(BadBag, match="velocity that does not match"):
        checked(rewritten(change))
    with pytest.raises(BadBag, match="angle that the instrument cannot have"):
        checked(remade(replace(arm(), jaw_rad=np.full(len(arm().jaw_rad), 1.5))))


def test_a_jaw_that_opens_as_planned_is_accepted():
    assert checked(remade(replace(arm(), jaw_rad=np.linspace(0.1, 0.4, len(arm().jaw_rad)))))


@pytest.mark.parametrize("joint", range(6))
def test_a_joint_scaled_by_a_thousandth_is_found(joint):
    joints = arm().joints.copy()
    joints[:, joint] *= 1.001
    with pytest.raises(
        BadBag, match=r"/PSM2/setpoint_cp is up to .* from the pose at which /PSM2/setpoint_js puts the tip"
    ):
        checked(remade(replace(arm(), joints=joints)))


def test_metres_taken_for_millimetres_are_found():
    joints = arm().joints.copy()
    joints[:, 2] *= 1000.0
    with pytest.raises(BadBag, match="insertion is beyond its limit"):
        checked(remade(replace(arm(), joints=joints)))


def test_a_joint_beyond_its_limit_is_found_by_sample_and_name():
    joints = arm().joints.copy()
    joints[60:, 4] = radians(81)
    with pytest.raises(BadBag, match="PSM2, sample 60: wrist_pitch is beyond its limit"):
        checked(remade(replace(arm(), joints=joints)))


@pytest.mark.parametrize("sample", [40, 81])
def test_a_leap_is_found_within_a_pass_and_between_passes(sample):
    joints = arm().joints.copy()
    joints[sample:, 0] += 0.01  # at 200 Hz 2 rad/s, over the limit of 1.57
    with pytest.raises(BadBag, match=f"PSM2, sample {sample}: yaw jumps"):
        checked(remade(replace(arm(), joints=joints)))


def test_a_velocity_that_is_no_difference_is_found():
    def change(one: bag_writer.Message) -> bag_writer.Message:
        if one.topic != PSM2[0] or one.log_ns != stamp_of(50):
            return one
        return bag_writer.joint_state(one.topic, one.log_ns, arm().joints[50].tolist(), NAMES, velocities=[0.0] * 6)

    with pytest.raises(BadBag, match="sample 50: yaw has a velocity"):
        checked(rewritten(change))


NAMES = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")


@pytest.mark.parametrize(("names", "frame"), [((*NAMES[:4], "wrist_yaw", "wrist_pitch"), ""), (NAMES, "ECM"), ((), "")])
def test_other_names_of_joints_or_frames_are_found(names, frame):
    speeds = iter(replay_bag.velocities_of(arm().stamps_ns, arm().joints, RATE_HZ).tolist())
    joints = iter(arm().joints.tolist())

    def change(one: bag_writer.Message) -> bag_writer.Message:
        if one.topic != PSM2[0]:
            return one
        return bag_writer.joint_state(one.topic, one.log_ns, next(joints), names, velocities=next(speeds), frame=frame)

    with pytest.raises(BadBag, match="other names of joints or frames"):
        checked(rewritten(change))


def test_a_pose_in_another_frame_is_found():
    with pytest.raises(BadBag, match="other names of joints or frames"):
        checked(remade(replace(arm(), frame="ECM")))


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_nan_and_infinity_are_found(wrong):
    joints = arm().joints.copy()
    joints[5, 3] = wrong
    with pytest.raises(BadBag, match="NaN or infinity"):
        checked(remade(replace(arm(), joints=joints)))


def test_arms_that_changed_places_are_found():
    def moved(name: str) -> str:
        return name.replace("PSM1", "PSM0").replace("PSM2", "PSM1").replace("PSM0", "PSM2")

    with pytest.raises(BadBag, match=r"PSM1.mcap has the topic '/PSM2/setpoint_js'"):
        checked({moved(name): data for name, data in members().items()})
    swapped = [
        replay_bag.folder_of(one, "1" * 64)
        for one in replay_bag.arms_of(trajectory(), arm="PSM1", frame=FRAME, jaw_rad=0.1)
    ]
    with pytest.raises(BadBag, match="The plan is for PSM2, but the bag has another PSM_A"):
        checked(members() | swapped[0] | swapped[1])


def test_a_topic_too_many_is_found():
    def change(one: bag_writer.Message) -> bag_writer.Message:
        return replace(one, topic="/PSM2/servo_jp") if one.topic == PSM2[0] else one

    with pytest.raises(BadBag, match=r"'/PSM2/servo_jp', which is not a setpoint topic of PSM2"):
        checked(rewritten(change))


def test_another_type_is_found():
    def change(one: bag_writer.Message) -> bag_writer.Message:
        return replace(bag_writer.text(one.topic, one.log_ns, "x")) if one.topic == PSM2[1] else one

    with pytest.raises(BadBag, match="does not have the type geometry_msgs/msg/PoseStamped"):
        checked(rewritten(change))


def test_a_topic_without_a_type_is_found():
    file = io.BytesIO()
    out = McapWriter(file)
    out.start(profile="ros2")
    channel = out.register_channel(PSM2[0], "cdr", 0)
    out.add_message(channel, replay_bag.EPOCH_NS, b"", replay_bag.EPOCH_NS)
    out.finish()
    with pytest.raises(BadBag, match="does not have the type sensor_msgs/msg/JointState"):
        checked(members() | {"PSM2/PSM2.mcap": file.getvalue()})


def test_the_arms_keep_the_same_time():
    late = replace(arm("PSM1"), stamps_ns=arm("PSM1").stamps_ns + 1)
    with pytest.raises(BadBag, match="two arms have different stamps"):
        checked(remade(late))


def test_half_a_plan_is_found():
    columns = ("stamps_ns", "joints", "tip_m", "rotation_xyzw", "jaw_rad")
    half = replace(arm(), **{name: getattr(arm(), name)[81:] for name in columns})
    with pytest.raises(BadBag, match="number of samples"):
        checked(remade(half))


def test_a_file_without_checksums_is_found(monkeypatch):
    monkeypatch.setattr(bag_writer, "Writer", partial(McapWriter, enable_crcs=False))
    with pytest.raises(BadBag, match=r"Not every message of PSM2.mcap is covered by a checksum"):
        checked(remade(arm()))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"plan": {"sha256": "3" * 64}, "verdict": {"plan": "1" * 64}}, "another plan"),
        ({"plan": {"sha256": "3" * 64}}, "PSM1.mcap was made from another plan"),
        ({"policy": {"sha256": "3" * 64}}, "name 2 policies"),
        ({"plan": {"policy": {"sha256": "3" * 64}}}, "name 2 policies"),
        ({"verdict": {"policy": "4" * 64}}, "name 2 policies"),
        ({"verdict": {"policy": None}}, "has a missing or invalid field"),
        ({"verdict": {"feasible": False}}, "does not find the plan feasible"),
        ({"verdict": {"feasible": 1}}, "has a missing or invalid field"),
        ({"report": {"feasible": False}}, "does not find the plan feasible"),
        ({"verdict": {"sha256": "4" * 64}}, "does not match its digest"),
        ({"verdict": {"report": {"feasible": True, "tracking_max_mm": 0.0}}}, "does not match its digest"),
        ({"verdict": {"report": []}}, "has a missing or invalid field"),
        ({"plan": {"policy": []}}, "has a missing or invalid field"),
        ({"plan": {"passes": []}}, "has a missing or invalid field"),
        ({"plan": {"arm": 3}}, "has a missing or invalid field"),
        ({"plan": {"frame": None}}, "has a missing or invalid field"),
        ({"plan": {"passes": [{"path_mm": [[0, 0, 0]]}]}}, "mm from the end of the motion in plan.json"),
        ({"plan": {"passes": [{"path_mm": [[float("nan"), 0, 0]]}]}}, "mm from the end of the motion in plan.json"),
        ({"plan": {"instrument": "420006"}}, "another instrument"),
        ({"plan": {"trajectory": {"rate_hz": 100.0, "samples": 162}}}, "another instrument, rate"),
        ({"plan": {"trajectory": {"rate_hz": 200.0, "samples": 161}}}, "number of samples"),
        ({"plan": {"frame": "ECM"}}, "other names of joints or frames"),
        ({"plan": {"psm_m": None}}, "PSM_M is in the bag and not in"),
        ({"plan": {"psm_m": {"base_mm": [0, 0, 0], "instrument": "400006"}}}, "with another instrument"),
        ({"plan": {"psm_m": {"base_mm": None}}}, "PSM_M is in the bag and not in"),
        ({"plan": {"psm_m": True}}, "has a missing or invalid field"),
        ({"executor": {"plan": "5" * 64}}, "executor.json is not the timetable of this bag"),
        ({"executor": {"passes": []}}, "executor.json is not the timetable of this bag"),
        ({"executor": {"passes": [{"phases": [{"from_ns": 1}], "hand_over": None}]}}, "has a missing or invalid field"),
        ({"executor": {"passes": [{"phases": [], "hand_over": {"at_ns": 7}}]}}, "has a missing or invalid field"),
        ({"executor": {"passes": [{"index": 0, "phases": [], "hand_over": None}]}}, "is not the timetable of this bag"),
    ],
)
def test_papers_that_do_not_belong_together_are_found(changes, words):
    with pytest.raises(BadBag, match=words):
        checked(members() | papers(trajectory(), **changes))


@pytest.mark.parametrize("paper", [b"", b"[]", b"{", b"[" * 100_000, b"\xff"])
def test_papers_that_are_none_are_found(paper):
    with pytest.raises(SkillsError):
        checked(members() | {"plan.json": paper})


def test_a_file_too_few_or_too_many_is_found():
    with pytest.raises(BadBag, match=r"lacks README.txt"):
        checked({name: data for name, data in members().items() if name != "README.txt"})
    with pytest.raises(BadBag, match=r"'notes.txt', which does not belong"):
        checked(members() | {"notes.txt": b""})
    with pytest.raises(BadBag, match="this has 0"):
        checked(papers(trajectory()))
    with pytest.raises(BadBag, match="this has 3"):
        checked(members() | {"PSM3/PSM3.mcap": b""})
    with pytest.raises(BadBag, match="SHA256SUMS must list"):
        verify_bag(io.BytesIO(zipped(members() | {"SHA256SUMS": b"\n"})))


def test_metadata_of_something_else_are_found():
    other = replay_bag.folder_of(replay_bag.arms_of(trajectory(), arm="PSM2", frame=FRAME, pass_index=0)[0], "1" * 64)[
        "PSM2/metadata.yaml"
    ]
    mine = members()["PSM2/metadata.yaml"]
    for wrong in (other, mine.replace(b"cdr", b"cbr"), mine + b" ", b"", mine.replace(b"PSM2.mcap", b"PSM1.mcap")):
        with pytest.raises(BadBag, match=r"PSM2/metadata.yaml does not describe"):
            checked(members() | {"PSM2/metadata.yaml": wrong})


@pytest.mark.parametrize("data", [b"", b"PK", b"PK\x05\x06" + bytes(18), b"no zip at all" * 9])
def test_what_is_no_bag_is_refused(data):
    with pytest.raises(SkillsError):
        verify_bag(io.BytesIO(data))


def test_a_bomb_is_refused_before_it_is_unpacked():
    with pytest.raises(SkillsError):
        verify_bag(io.BytesIO(zipped(members() | {"SHA256SUMS": bytes(200 << 20)})))
