"""LeRobot datasets: an episode read as its numbers, refused where it leaves something open, and cut out alone."""

import io
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from skills import errors
from skills.formats import read_recording
from skills.formats.lerobot.cut import choose_episodes, cut_episode, episodes_of, find_dataset
from skills.kinematics import forward, quaternion_of
from skills.remedies import Door
from tests.formats import lerobots
from tests.formats.lerobots import FPS, NEEDLE_DRIVER, STATE, columns_of, dataset, episode, packed, poses, write
from tests.formats.others import zipped


def read(files, frame="ECM"):
    return read_recording(packed(files), frame=frame)


def cut(path: Path, number: int, **how) -> bytes:
    with find_dataset(path) as found, io.BytesIO() as out:
        cut_episode(found, episodes_of(found)[number], out, **how)
        return out.getvalue()


# ---- what an episode says


@pytest.mark.parametrize("fixed", [True, False], ids=["as datasets writes it", "as pandas writes it"])
def test_the_poses_of_both_arms_are_those_of_the_file(fixed):
    recording = read(episode(data=lerobots.parquet(lerobots.table(columns_of(40), fixed=fixed))))
    state = poses(40).astype(np.float64)
    assert recording.format == "lerobot"
    assert recording.integrity == "full"
    for arm, motion in enumerate(recording.motions):
        assert (motion.arm, motion.topic, motion.frame) == (f"PSM{arm + 1}", f"/PSM{arm + 1}/measured_cp", "ECM")
        np.testing.assert_array_equal(motion.tip_mm, 1000.0 * state[:, 8 * arm : 8 * arm + 3])
        np.testing.assert_array_equal(motion.rotation_xyzw, state[:, 8 * arm + 3 : 8 * arm + 7])
        np.testing.assert_array_equal(recording.jaw_of(motion.arm).values, state[:, 8 * arm + 7])


def test_tools_task_split_and_number_of_the_episode_are_told():
    recording = read(episode(columns_of(40, 1), episodes=3))
    assert recording.tools == (("PSM1", NEEDLE_DRIVER), ("PSM2", "Debakey Forceps"))
    assert dict(recording.notes) == {
        "dataset": "LeRobot v2.1",
        "robot": "dvrk",
        "episode": "1",
        "splits": "train, recovery",
        "task": "needle pass",
        "stamps": "frame_index at 30 Hz",
    }


def test_a_dataset_of_v3_with_one_episode_is_read():
    files = {name: data for name, data in dataset("v3.0").items() if "file-000" not in name or "meta" in name}
    files["meta/info.json"] = lerobots.info_of(lerobots.features_of(columns_of(60)), 1, 60, "v3.0")
    recording = read(files)
    np.testing.assert_array_equal(recording.motions[0].tip_mm, 1000.0 * poses(60, 2)[:, :3].astype(np.float64))
    assert dict(recording.notes)["task"] == "suture throw"


# ---- frames and instruments are stated


def test_poses_without_a_frame_are_refused_in_the_words_of_each_door():
    with pytest.raises(errors.BadColumns, match="does not say in which frame") as refused:
        read(episode(), frame=None)
    assert "--frame ECM" in refused.value.words(Door.COMMAND)
    assert "frame=ECM" in refused.value.words(Door.HTTP)


def test_the_base_of_each_arm_can_be_stated_as_the_frame():
    assert [motion.frame for motion in read(episode(), "base").motions] == ["PSM1_base", "PSM2_base"]


def test_a_frame_that_no_pose_is_in_is_refused():
    columns, names = lerobots.joint_columns([f"PSM1_joint_{k}" for k in range(1, 7)] + ["PSM1_jaw"])
    with pytest.raises(errors.MixedFrames, match="the frames are PSM1_base"):
        read(episode(columns, names=names), "ECM")


@pytest.mark.parametrize(
    "names",
    [
        [*(f"PSM1_joint_{k}" for k in range(1, 7)), "PSM1_jaw"],
        [
            *(f"psm1.joint_position.{k}" for k in ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")),
            "psm1.jaw",
        ],
    ],
    ids=["numbered", "named"],
)
def test_joints_become_poses_with_the_instrument_that_the_dataset_names(names):
    columns, named = lerobots.joint_columns(names)
    recording = read(episode(columns, names=named), None)
    [motion], [joints] = recording.motions, recording.joints
    q = columns["observation.state"][:, :6].astype(np.float64) * [1, 1, 1000, 1, 1, 1]
    tip_mm, turned = forward(q, "400006")
    assert (motion.topic, motion.frame, motion.is_local) == ("/PSM1/local/measured_cp", "PSM1_base", True)
    np.testing.assert_allclose(motion.tip_mm, tip_mm, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(motion.rotation_xyzw, quaternion_of(turned))
    np.testing.assert_array_equal(joints.positions, q)
    assert recording.identifications == ()  # the poses were computed from the joints


def test_joints_of_an_unknown_instrument_need_one_to_be_stated():
    columns, names = lerobots.joint_columns([*(f"PSM2_joint_{k}" for k in range(1, 7)), "PSM2_jaw"])
    with pytest.raises(errors.BadColumns, match="without the number of the instrument"):
        read(episode(columns, names=names), None)
    stated = read(episode(columns, names=names, said={"tools": {"PSM2": "420006"}}), None)
    assert stated.motions[0].frame == "PSM2_base"
    assert dict(stated.tools)["PSM2"] == "420006"


def test_an_instrument_other_than_the_one_of_the_dataset_is_refused():
    columns, names = lerobots.joint_columns([*(f"PSM1_joint_{k}" for k in range(1, 7)), "PSM1_jaw"])
    with pytest.raises(errors.BadColumns, match="stated as 420006, and the dataset names 400006"):
        read(episode(columns, names=names, said={"tools": {"PSM1": "420006"}}), None)


def test_joints_beside_poses_are_used_where_no_frame_is_stated():
    q = lerobots.joints(40).astype(np.float32)
    more = {f"observation.state.psm1.joint_{k + 1}": q[:, k] for k in range(6)}
    recording = read(episode(columns_of(40, **more)), None)
    assert [motion.frame for motion in recording.motions] == ["PSM1_base"]
    unframed = [f"/{arm}/{name}" for name in ("measured_cp", "setpoint_cp") for arm in ("PSM1", "PSM2")]
    assert [topic for topic, _ in recording.left_out] == unframed


# ---- names


def test_columns_one_by_one_as_in_surgsync_are_read_with_the_clock():
    state = poses(40)
    one_each = {
        f"observation.cartesian_state.psm1.{kind}.{part}": state[:, [k]]
        for kind in ("pose", "local_pose")
        for k, part in enumerate(lerobots.PARTS)
    }
    clock = {
        "observation.meta.ros_time_sec": np.full((40, 1), 1_760_000_000),
        "observation.meta.ros_time_nsec": np.arange(40)[:, None] * 10_000_001,
    }
    more = one_each | clock | {"observation.state.psm1.gripper": state[:, [7]]}
    names = {name: [name.rpartition(".")[2]] for name in more}
    recording = read(episode(columns_of(40, **{"observation.state": None}, **more), names=names))
    assert [motion.topic for motion in recording.motions] == ["/PSM1/local/measured_cp", "/PSM1/measured_cp"]
    assert [motion.frame for motion in recording.motions] == ["PSM1_base", "ECM"]
    assert recording.motions[0].stamps_ns[:3].tolist() == [1_760_000_000 * 10**9 + k * 10_000_001 for k in range(3)]
    assert recording.jaw_of("PSM1") is not None


def test_the_camera_and_the_set_up_joints_of_obuda_are_listed_as_not_used():
    state = np.concatenate([poses(40), poses(40)[:, :7]], axis=1)
    names = [*STATE, *(f"ecm_pose.{part}" for part in lerobots.PARTS)]
    suj = [f"suj_psm1_pose.{part}" for part in lerobots.PARTS]
    columns = columns_of(40, **{"observation.state": state, "observation.meta.suj": poses(40)[:, :7]})
    recording = read(episode(columns, names={"observation.state": [names], "observation.meta.suj": [suj]}))
    assert recording.arms == ("PSM1", "PSM2")
    left_out = dict(recording.left_out)
    assert left_out["observation.state"].startswith("not used: ecm_pose.position.x, ")
    assert left_out["observation.meta.suj"].startswith("not used: suj_psm1_pose.position.x, ")


def test_tools_of_both_arms_in_one_feature_are_read():
    pairs = pa.array([["LARGE_NEEDLE_DRIVER:420006[..11]", "x"]] * 40)
    columns = columns_of(40, **{"observation.meta.tool.psm1": None, "observation.meta.tool.psm2": None})
    files = episode(columns, data=lerobots.parquet(columns | {"observation.meta.tool_type": pairs}))
    described = lerobots.features_of(columns) | {
        "observation.meta.tool_type": {"dtype": "text", "shape": [2], "names": ["PSM1_tool_type", "PSM2_tool_type"]}
    }
    files["meta/info.json"] = lerobots.info_of(described, 1, 40)
    assert read(files).tools == (("PSM1", "LARGE_NEEDLE_DRIVER:420006[..11]"), ("PSM2", "x"))


def test_columns_without_names_are_read_as_the_user_states():
    nameless = {"observation.state": [f"motor_{k}" for k in range(16)]}
    with pytest.raises(errors.NoUsableTopic, match="motor_0, motor_1"):
        read(episode(names=nameless))
    columns = {name: f"observation.state[{k}]" for k, name in enumerate(STATE)}
    stated = read(episode(names=nameless, said={"columns": columns}))
    np.testing.assert_array_equal(stated.motions[1].tip_mm, read(episode()).motions[1].tip_mm)


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"psm1_pose.position.q": "motor_0"}, "is no column of ours"),
        ({"psm1_pose.position.x": "motor_16"}, "has no column 'motor_16'. Did you mean"),
        ({"psm1_pose.position.x": 3}, "is not an object of our names"),
        ({"psm1_pose.position.x": "motor_0", "psm1_jaw": "motor_0"}, "two meanings"),
        ({"psm1_pose.position.x": "motor_0"}, "The pose of PSM1 has no column position.y"),
        (["psm1_jaw"], "is not an object"),
    ],
)
def test_wrong_statements_are_refused(columns, words):
    nameless = {"observation.state": [f"motor_{k}" for k in range(16)]}
    with pytest.raises(errors.BadColumns, match=words):
        read(episode(names=nameless, said={"columns": columns}))


def test_two_columns_of_one_meaning_are_refused_until_one_is_stated():
    files = columns_of(40, **{"observation.state.psm1.gripper": poses(40)[:, 0]})
    with pytest.raises(errors.BadColumns, match="Two columns"):
        read(episode(files))
    stated = read(episode(files, said={"columns": {"psm1_jaw": "observation.state[7]"}}))
    np.testing.assert_array_equal(stated.jaw_of("PSM1").values, poses(40)[:, 7].astype(np.float64))


def test_a_pose_with_a_part_of_an_orientation_is_refused():
    names = [name.replace("psm1_pose.orientation.w", "w") for name in STATE]
    with pytest.raises(errors.BadColumns, match=r"no column orientation\.w"):
        read(episode(names={"observation.state": names}))


# ---- stamps


def stamped(seconds, **more):
    recording = read(episode(columns_of(40, timestamp=seconds, **more)))
    return recording.motions[0].stamps_ns, dict(recording.notes)["stamps"]


def test_single_precision_that_agrees_with_fps_gives_exact_stamps():
    stamps_ns, source = stamped((np.arange(40) / FPS).astype(np.float32))
    np.testing.assert_array_equal(stamps_ns, np.rint(np.arange(40) * 1e9 / FPS))
    assert source == "frame_index at 30 Hz"


def test_single_precision_that_is_a_clock_of_its_own_is_used():
    seconds = (np.arange(40) / FPS + 0.004 * (np.arange(40) % 3)).astype(np.float32)
    stamps_ns, source = stamped(seconds)
    np.testing.assert_array_equal(stamps_ns, np.rint(seconds.astype(np.float64) * 1e9))
    assert source == "timestamp, in single precision"


def test_seconds_since_1970_in_single_precision_are_no_clock():
    stamps_ns, source = stamped((1.76e9 + np.arange(40) / FPS).astype(np.float32))
    np.testing.assert_array_equal(stamps_ns, np.rint(np.arange(40) * 1e9 / FPS))
    assert source == "frame_index at 30 Hz; timestamp has steps of 128 s"


def test_double_precision_and_left_out_frames_keep_their_times():
    assert stamped(1.76e9 + np.arange(40) / 32)[0][:2].tolist() == pytest.approx([1.76e18, 1.76e18 + 3.125e7], abs=240)
    frames = np.delete(np.arange(41), 10)
    stamps_ns, _ = stamped((frames / FPS).astype(np.float32), frame_index=frames)
    assert stamps_ns[10] - stamps_ns[9] == pytest.approx(2e9 / FPS, abs=1)


@pytest.mark.parametrize(
    ("more", "error"),
    [
        ({"frame_index": np.arange(40)[::-1].copy()}, errors.BackwardStamps),
        ({"frame_index": np.zeros(40, dtype=np.int64)}, errors.BackwardStamps),
        ({"frame_index": np.arange(40) - 1}, errors.UnreadableRecording),
        ({"timestamp": np.where(np.arange(40) == 3, np.nan, np.arange(40) / FPS)}, errors.NotFinite),
        ({"timestamp": np.arange(40)[::-1] / FPS}, errors.BackwardStamps),
        ({"timestamp": np.arange(40) * 1e12}, errors.UnreadableRecording),
    ],
    ids=["backwards", "one number", "negative", "NaN", "timestamps backwards", "nanoseconds"],
)
def test_frames_out_of_order_are_refused(more, error):
    with pytest.raises(error):
        read(episode(columns_of(40, **more)))


# ---- numbers


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda state: state.__setitem__((3, 1), np.nan), errors.NotFinite),
        (lambda state: state.__setitem__((3, 7), np.inf), errors.NotFinite),
        (lambda state: state.__setitem__((slice(None), slice(0, 3)), 50.0), errors.NotMetres),
        (lambda state: state.__setitem__((5, 6), 3.0), errors.NotAQuaternion),
    ],
    ids=["NaN", "an infinite jaw", "millimetres", "no quaternion"],
)
def test_impossible_numbers_are_refused(change, error):
    state = poses(40)
    change(state)
    with pytest.raises(error):
        read(episode(columns_of(40, **{"observation.state": state})))


def test_a_tip_that_never_leaves_the_cannula_is_refused():
    state = poses(40)
    state[:, [0, 1, 2, 8, 9, 10]] *= 0.1
    with pytest.raises(errors.NotMetres, match="inside the cannula"):
        read(episode(columns_of(40, **{"observation.state": state})), "base")


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("observation.state", pa.array([[0.1] * 16] * 39 + [[0.1] * 15])),
        ("observation.state", pa.array([[0.1] * 16] * 39 + [None])),
        ("observation.state", pa.array([[0.1] * 15 + [None]] * 40)),
        ("observation.state", pa.array([["1"] * 16] * 40)),
        ("observation.state", pa.array([[[0.1]] * 16] * 40)),
        ("timestamp", pa.array([0.1] * 39 + [None])),
        ("observation.meta.tool.psm1", pa.array([1] * 40)),
        ("observation.meta.tool.psm1", pa.array([None] * 40, pa.string())),
    ],
)
def test_gaps_and_other_types_are_refused(column, values):
    with pytest.raises(errors.UnreadableRecording, match=r"does not have \d+ (numbers|texts) in every row"):
        read(episode(data=lerobots.parquet(columns_of(40) | {column: values})))


def test_a_tool_that_changes_within_an_episode_is_refused():
    with pytest.raises(errors.UnreadableRecording, match="tool of PSM1 changes"):
        read(episode(columns_of(2, **{"observation.meta.tool.psm1": ["a", "b"]})))


@pytest.mark.parametrize(
    ("files", "words"),
    [
        (episode(version="v1.6"), "codebase_version of the dataset is 'v1.6'"),
        (episode(fps=0), "fps of the dataset is '0'"),
        (episode(total_frames=41), "claims 41 frames, and the episode has 40"),
        (episode(features={"observation.state": {"dtype": "float32", "shape": "x"}}), "'observation.state' in"),
        (episode(features=[]), "has no features"),
        (episode(data=b"hello"), "truncated or corrupt"),
        (episode(columns_of(0)), "no frames"),
        ({**episode(), "meta/info.json": b"[]"}, "is not a JSON object"),
        ({**episode(), "meta/tasks.jsonl": b"{"}, "is not valid JSON"),
        ({name: data for name, data in episode().items() if "data" not in name}, r"no \.parquet file"),
        ({**episode(), **{f"b/{name}": data for name, data in episode().items()}}, "2 datasets"),
        (episode(data=lerobots.parquet(columns_of(40, timestamp=None))), "has the column 'timestamp' 0 times"),
    ],
)
def test_a_dataset_that_contradicts_itself_is_refused(files, words):
    with pytest.raises(errors.UnreadableRecording, match=words):
        read(files)


def test_a_parquet_file_alone_is_refused_with_the_remedy():
    with pytest.raises(errors.UnknownFormat, match=r"send an episode with its meta/info\.json"):
        read_recording(io.BytesIO(lerobots.parquet(columns_of(4))))


# ---- one episode is one recording


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_several_episodes_are_refused_with_their_number(version):
    with pytest.raises(errors.UnreadableRecording, match=r"has 3 episodes\. A recording is one of them") as refused:
        read(dataset(version))
    assert "--episode" in refused.value.words(Door.COMMAND)


def test_several_episodes_in_one_file_are_refused():
    columns = columns_of(40, episode_index=np.arange(40) // 20)
    with pytest.raises(errors.UnreadableRecording, match="has 2 episodes"):
        read(episode(columns, total_episodes=2))


@pytest.mark.parametrize("number", [0, 1, 2])
def test_an_episode_cut_from_v2_has_the_bytes_of_its_own_file_only(tmp_path, number):
    files = dataset("v2.1")
    folder = write(files, tmp_path)
    with zipfile.ZipFile(io.BytesIO(cut(folder, number))) as archive:
        data = [name for name in archive.namelist() if name.endswith(".parquet")]
        assert [archive.read(name) for name in data] == [files[f"data/chunk-000/episode_{number:06d}.parquet"]]
        tasks = archive.read("meta/tasks.jsonl").decode()
    assert [task in tasks for task in lerobots.TASKS] == [number % 2 == 0, number % 2 == 1]


@pytest.mark.parametrize("groups", [None, 7, 1000], ids=["a group per episode", "groups of 7", "one group"])
@pytest.mark.parametrize("number", [0, 1, 2])
def test_an_episode_cut_from_v3_equals_that_of_v2(tmp_path, number, groups):
    old = cut(write(dataset("v2.1"), tmp_path / "old"), number)
    new = cut(write(dataset("v3.0", groups=groups), tmp_path / "new"), number)
    one, other = (read_recording(io.BytesIO(data), frame="ECM") for data in (old, new))
    for a, b in zip(one.motions, other.motions, strict=True):
        np.testing.assert_array_equal(a.tip_mm, b.tip_mm)
        np.testing.assert_array_equal(a.rotation_xyzw, b.rotation_xyzw)
        np.testing.assert_array_equal(a.stamps_ns, b.stamps_ns)
    assert dict(one.notes) | {"dataset": "LeRobot v3.0"} == dict(other.notes)
    assert one.tools == other.tools


def test_cutting_again_and_cutting_a_zip_give_the_same_bytes(tmp_path):
    for version in ("v2.1", "v3.0"):
        folder = write(dataset(version), tmp_path / version)
        file = tmp_path / f"{version}.zip"
        file.write_bytes(packed(dataset(version)).getvalue())
        assert cut(folder, 1) == cut(folder, 1) == cut(file, 1)


def test_statements_travel_in_the_zip(tmp_path):
    columns, names = lerobots.joint_columns([*(f"q{k}" for k in range(6)), "opening"])
    folder = write(episode(columns, names=names), tmp_path)
    said = {"psm2_jaw": "opening"} | {f"psm2_joint_{k + 1}": f"q{k}" for k in range(6)}
    recording = read_recording(io.BytesIO(cut(folder, 0, columns=said, tools={"PSM2": "400006"})))
    assert (recording.arms, dict(recording.tools)["PSM2"]) == (("PSM2",), "400006")


def test_pictures_within_the_data_are_not_cut_out(tmp_path):
    files = episode()
    data = columns_of(40) | {"observation.images.left": [b"picture"] * 40}
    described = lerobots.features_of(columns_of(40)) | {
        "observation.images.left": {"dtype": "image", "shape": [4, 4, 3], "names": ["height", "width", "channel"]}
    }
    files |= {
        "data/chunk-000/episode_000000.parquet": lerobots.parquet(data),
        "meta/info.json": lerobots.info_of(described, 1, 40),
    }
    alone = cut(write(files, tmp_path), 0)
    assert b"picture" not in alone
    assert b"observation.images" not in alone
    read_recording(io.BytesIO(alone), frame="ECM")


@pytest.mark.parametrize("which", ["3", "-1", "x", "99999999999999999999", "00000000001", ""])
def test_an_episode_that_is_not_there_is_refused_with_those_that_are(tmp_path, which):
    with find_dataset(write(dataset("v2.1"), tmp_path)) as found, pytest.raises(errors.BadInput, match="it has 0 to 2"):
        choose_episodes(found, which)


def test_rows_of_another_episode_are_refused(tmp_path):
    files = dataset("v2.1")
    files["data/chunk-000/episode_000001.parquet"] = files["data/chunk-000/episode_000002.parquet"]
    with pytest.raises(errors.UnreadableRecording, match="are of other episodes"):
        cut(write(files, tmp_path), 1)


def test_places_of_episodes_that_do_not_fit_the_files_are_refused(tmp_path):
    files = dataset("v3.0")
    del files["data/chunk-000/file-001.parquet"]
    with pytest.raises(errors.UnreadableRecording, match="has no file 1 in chunk 0"):
        cut(write(files, tmp_path), 0)
    short = dataset("v3.0")
    short["data/chunk-000/file-000.parquet"] = lerobots.parquet(columns_of(40))
    with pytest.raises(errors.UnreadableRecording, match="has 0 of 50 rows"):
        cut(write(short, tmp_path / "short"), 1)


def test_pyarrow_is_imported_by_the_first_parquet_file_only():
    code = "import sys, skills.formats, skills.formats.lerobot.cut; sys.exit('pyarrow' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_refusal_is_one_of_ours(tmp_path):
    with find_dataset(tmp_path) as found:
        assert found is None
    (tmp_path / "empty.zip").write_bytes(b"PK\x03\x04")
    with pytest.raises(errors.SkillsError), find_dataset(tmp_path / "empty.zip"):
        pass


# ---- the exporter of jhu-dvrk/data_collection ----------------------------------------------------------------------


def from_topics(count=60, step_s=0.01, *, fps=30):
    """Return an episode as its exporter infers it from a bag: a feature per topic, the fields of each sorted."""
    one = poses(count).astype(np.float64)[:, :8]
    q = lerobots.joints(count)
    stamps = 1.76e9 + step_s * np.arange(count)
    fields = {
        "ros.PSM1.local.measured_cp": one[:, [6, 3, 4, 5, 0, 1, 2]],
        "ros.PSM1.measured_cp": one[:, [6, 3, 4, 5, 0, 1, 2]] + [0, 0, 0, 0, 0.01, 0, 0.2],
        "ros.SUJ.PSM1.measured_cp": one[:, [6, 3, 4, 5, 0, 1, 2]] * 0,
        "ros.PSM1.jaw.measured_js": np.column_stack([np.zeros(count), one[:, 7]]),
        "ros.PSM1.measured_js": np.column_stack([stamps, q]),
    }
    turn = [*(f"pose.orientation.{part}" for part in "wxyz"), *(f"pose.position.{axis}" for axis in "xyz")]
    names = {name: {"axes": turn} for name in list(fields)[:3]} | {
        "ros.PSM1.jaw.measured_js": {"axes": ["effort.0", "position.0"]},
        "ros.PSM1.measured_js": {"axes": ["header.stamp.sec", *(f"position.{k}" for k in range(6))]},
    }
    columns = columns_of(count, **{"observation.state": None, "action": None}) | fields
    columns["timestamp"] = stamps - stamps[0]
    columns["timestamp_ns"] = np.rint(1e9 * stamps).astype(np.int64)
    return zipped(episode(columns, names=names, fps=fps)), one, q


def test_features_that_are_called_after_topics_are_read():
    data, one, q = from_topics()
    got = read_recording(io.BytesIO(data), frame="ECM")
    local, pose = got.motion_of(arm="PSM1"), got.motion_of(topic="/PSM1/measured_cp")
    assert (local.topic, local.frame, pose.frame) == ("/PSM1/local/measured_cp", "PSM1_base", "ECM")
    np.testing.assert_allclose(local.tip_mm, 1000 * one[:, :3], atol=1e-9)
    np.testing.assert_allclose(pose.tip_mm[:, 2], 1000 * one[:, 2] + 200, atol=1e-9)
    np.testing.assert_allclose(local.rotation_xyzw, one[:, 3:7], atol=1e-6)
    np.testing.assert_allclose(got.joints[0].positions[:, 2], 1000 * q[:, 2])
    np.testing.assert_allclose(got.jaw_of("PSM1").values, one[:, 7])
    assert got.arms == ("PSM1",)
    assert got.duration_s == pytest.approx(0.59)  # its fps of 30 is nominal
    assert "ros.SUJ.PSM1.measured_cp" in dict(got.left_out)
    assert read_recording(io.BytesIO(data)).arms == ("PSM1",)  # the frame of the other pose is not needed


@pytest.mark.parametrize("jaw", [0.3, np.nan])
def test_joints_without_an_arm_are_those_of_the_stated_tool(jaw, tmp_path):
    q = lerobots.joints(60)
    names = {"axes": [*(f"joint_{k}" for k in range(6)), "jaw"]}
    state = np.column_stack([q, np.full(60, jaw)])
    columns = columns_of(60, **{"observation.state": state, "action": state, "observation.meta.tool.psm1": None})
    columns["observation.meta.tool.psm2"] = None
    files = episode(
        {k: v for k, v in columns.items() if v is not None}, names={"observation.state": names, "action": names}
    )
    with pytest.raises(errors.BadColumns, match="joints, which give no pose without"):
        read_recording(io.BytesIO(zipped(files)))
    with find_dataset(lerobots.write(files, tmp_path)) as dataset, io.BytesIO() as out:
        cut_episode(dataset, choose_episodes(dataset, None)[0], out, tools={"PSM2": "400006"})
        got = read_recording(out)
    assert (got.arms, got.motion_of().frame) == (("PSM2",), "PSM2_base")
    np.testing.assert_allclose(got.joints[0].positions[:, 2], 1000 * q[:, 2])
    assert (got.jaw_of("PSM2") is None) == bool(np.isnan(jaw))
    assert got.setpoints == ()
