"""Faults of a bag for replay that `skills verify` finds."""

import io
import json
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
from skills.formats.columns import in_mm
from skills.formats.verify import verify_bag
from skills.kinematics import forward, quaternion_of
from tests.formats.others import zipped
from tests.formats.replays import FRAME, PSM2, arm, arms, checked, folders, members, papers, trajectory


def test_a_whole_bag_is_found_right_and_told_of():
    lines = verify_bag(io.BytesIO(replay_bag.seal(members())))
    assert lines[0].startswith("22 files")
    assert lines[2] == "4 segments: 000-A1, 001-A2, 002-A1, 003-A2."
    assert lines[3].startswith("PSM1 (PSM_M, 420006): 162 samples in 1.80 s")
    assert lines[4].startswith("PSM2 (PSM_A, 400006): 162 samples in 1.80 s")
    low, high = trajectory().tip_mm.min(axis=0), trajectory().tip_mm.max(axis=0)
    assert f"X [{low[0]:.2f}, {high[0]:.2f}]" in lines[4]


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
    files = members()
    for _, (part,) in replay_bag.segment_motions(trajectory(), [arm(name)]):
        said = [one for one in map(change, replay_bag.messages_of(part)) if one is not None]
        made = bag_folder(said, name, replay_bag.notes_of(part, "1" * 64))
        files = files | {f"{part.segment}/{file}": data for file, data in made.items()}
    return files


def remade(motion: replay_bag.ArmMotion, plan: str = "1" * 64) -> dict[str, bytes]:
    moving = [motion if motion.name == one.name else one for one in arms(trajectory())]
    index = replay_bag.segment_index(replay_bag.segment_motions(trajectory(), moving), "1" * 64).model_dump(mode="json")
    return papers(trajectory(), index=index) | folders(trajectory(), moving, plan)


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
    with pytest.raises(BadBag, match="sample 1 is earlier or later than 200 Hz has it"):
        checked(remade(replace(arm(), stamps_ns=faster)))


def test_a_missing_jaw_sample_is_found():
    with pytest.raises(BadBag, match="60 setpoints of its joints, 60 of its tip and 59 of its jaw"):
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
    with pytest.raises(BadBag, match="001-A2/PSM2, sample 1: wrist_pitch is beyond its limit"):
        checked(remade(replace(arm(), joints=joints)))


def test_a_leap_is_found_within_a_segment():
    joints = arm().joints.copy()
    joints[40:, 0] += 0.01  # at 200 Hz 2 rad/s, over the limit of 1.57
    with pytest.raises(BadBag, match="000-A1/PSM2, sample 40: yaw jumps"):
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
    parts = [part for _, (part,) in replay_bag.segment_motions(trajectory(), [arm()])]
    joints = iter(row for part in parts for row in part.joints.tolist())
    speeds = iter(row for part in parts for row in replay_bag.velocities_of(part.stamps_ns, part.joints).tolist())

    def change(one: bag_writer.Message) -> bag_writer.Message:
        if one.topic != PSM2[0]:
            return one
        return bag_writer.joint_state(one.topic, one.log_ns, next(joints), names, velocities=next(speeds), frame=frame)

    with pytest.raises(BadBag, match="other names of joints or frames"):
        checked(rewritten(change))


def test_a_jaw_in_a_frame_is_found():
    """It has none, as those of the dVRK."""

    def change(one: bag_writer.Message) -> bag_writer.Message:
        if one.topic != PSM2[2]:
            return one
        return bag_writer.joint_state(one.topic, one.log_ns, [0.1], ["jaw"], velocities=[0.0], frame="PSM2_base")

    with pytest.raises(BadBag, match="other names of joints or frames"):
        checked(rewritten(change))


@pytest.mark.parametrize("topic", PSM2)
@pytest.mark.parametrize("about", [{"offered_qos_profiles": "- durability: 1"}, {"callerid": "/other"}, {}])
def test_another_quality_of_service_of_a_topic_is_found(monkeypatch, topic, about):
    """Such as a latched one, which a controller that comes late would still obey."""
    real = McapWriter.register_channel

    def register(self, name, encoding, schema, metadata):
        return real(self, name, encoding, schema, about if name == topic else metadata)

    monkeypatch.setattr(McapWriter, "register_channel", register)
    changed = rewritten(lambda one: one)
    monkeypatch.undo()
    with pytest.raises(BadBag, match=f"{topic} offers another quality of service"):
        checked(changed)


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
    other = replay_bag.arms_of(trajectory(), arm="PSM1", frame=FRAME, jaw_rad=0.1)
    index = replay_bag.segment_index(replay_bag.segment_motions(trajectory(), other), "1" * 64).model_dump(mode="json")
    with pytest.raises(BadBag, match="The plan is for PSM2, but the bag has another PSM_A"):
        checked(papers(trajectory(), index=index) | folders(trajectory(), other))


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
        checked(members() | {"000-A1/PSM2/PSM2.mcap": file.getvalue()})


def test_the_arms_keep_the_same_time():
    late = replace(arm("PSM1"), stamps_ns=arm("PSM1").stamps_ns + 1)
    with pytest.raises(BadBag, match=r"segments.json is not the index of this bag, at '000-A1'"):
        checked(remade(late))


def test_half_a_plan_is_found():
    files = {name: data for name, data in members().items() if name[:3] not in ("002", "003")}
    with pytest.raises(BadBag, match="is not the index of this bag, at '002-A1'"):
        checked(files)
    index = json.loads(files["segments.json"])
    half = json.dumps(index | {"segments": index["segments"][:2]}).encode()
    with pytest.raises(BadBag, match="number of samples"):
        checked(files | {"segments.json": half})


@pytest.mark.parametrize(
    ("segment", "changes"),
    [
        (1, {"name": "001-A1", "kind": "A1"}),
        (1, {"kind": "hand-over"}),
        (1, {"needle_held_by": "PSM_M"}),
        (1, {"from_ns": 1_290_000_000}),
        (2, {"to_ns": 2_705_000_000}),
        (0, {"arms": []}),
        (3, {"arms": "moved"}),
    ],
)
def test_another_index_than_the_folders_is_found(segment, changes):
    index = json.loads(members()["segments.json"])
    if changes.get("arms") == "moved":
        changes = {"arms": [one | {"position_mm": [0.0, 0.0, -100.0]} for one in index["segments"][segment]["arms"]]}
    index["segments"][segment] |= changes
    with pytest.raises(BadBag, match=r"segments.json is not the index of this bag"):
        checked(members() | {"segments.json": json.dumps(index).encode()})


def test_segments_that_begin_elsewhere_than_the_one_before_ended_are_found():
    """Each folder is right in itself, and the index is of these folders."""
    jumped = replace(arm(), joints=arm().joints + np.where(np.arange(162) >= 81, 0.01, 0.0)[:, None])
    tip_mm, rotation = forward(in_mm(jumped.joints), jumped.instrument)
    jumped = replace(jumped, tip_m=tip_mm / 1000.0, rotation_xyzw=quaternion_of(rotation))
    moving = (jumped, arm("PSM1"))
    index = replay_bag.segment_index(replay_bag.segment_motions(trajectory(), moving), "1" * 64).model_dump(mode="json")
    with pytest.raises(BadBag, match=r"not the index of this bag, at '002-A1'"):
        checked(papers(trajectory(), index=index) | folders(trajectory(), moving))


def test_a_file_without_checksums_is_found(monkeypatch):
    monkeypatch.setattr(bag_writer, "Writer", partial(McapWriter, enable_crcs=False))
    with pytest.raises(BadBag, match=r"Not every message of PSM1.mcap is covered by a checksum"):
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
        ({"index": {"plan": "5" * 64}}, "segments.json is not the index of this bag"),
        ({"index": {"segments": []}}, "segments.json is not the index of this bag"),
        ({"index": {"segments": [{"name": "000-A1"}]}}, "has a missing or invalid field"),
        ({"index": {"position_tolerance_mm": None}}, "has a missing or invalid field"),
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
        checked(members() | {"000-A1/PSM3/PSM3.mcap": b""})
    with pytest.raises(BadBag, match="SHA256SUMS must list"):
        verify_bag(io.BytesIO(zipped(members() | {"SHA256SUMS": b"\n"})))


def test_metadata_of_something_else_are_found():
    other, mine = (members()[f"{part}/PSM2/metadata.yaml"] for part in ("001-A2", "000-A1"))
    for wrong in (other, mine.replace(b"cdr", b"cbr"), mine + b" ", b"", mine.replace(b"PSM2.mcap", b"PSM1.mcap")):
        with pytest.raises(BadBag, match=r"000-A1/PSM2/metadata.yaml does not describe"):
            checked(members() | {"000-A1/PSM2/metadata.yaml": wrong})


@pytest.mark.parametrize("data", [b"", b"PK", b"PK\x05\x06" + bytes(18), b"no zip at all" * 9])
def test_what_is_no_bag_is_refused(data):
    with pytest.raises(SkillsError):
        verify_bag(io.BytesIO(data))


def test_a_bomb_is_refused_before_it_is_unpacked():
    with pytest.raises(SkillsError):
        verify_bag(io.BytesIO(zipped(members() | {"SHA256SUMS": bytes(200 << 20)})))
