"""LeRobot datasets that we write: read again as the same numbers, complete, and in bounded memory."""

import hashlib
import io
import json
import re
import tracemalloc
import zipfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from skills.demonstration.recording import Label, Motion, Recording, Signal
from skills.errors import BadInput, MixedFrames, NoUsableTopic, UnreadableRecording
from skills.formats import read_recording, write_mcap
from skills.formats.checksums import SUMS
from skills.formats.lerobot.cut import cut_episode, episodes_of, find_dataset
from skills.formats.lerobot.writer import (
    TABLE_ROWS,
    AboutDataset,
    ExportedEpisode,
    action_rule,
    dataset_files,
)
from skills.library.recordings.datasets import splits_by_group
from tests.formats import lerobots

ABOUT = AboutDataset("Sutures", ("PSM1", "PSM2"), licence="CC-BY-4.0", consent="Export, until 2030.")
VERSIONS = ("v2.1", "v3.0")


def recording(count: int = 40, seed: int = 0, rate_hz: float = 30.0) -> Recording:
    """Return both arms as single precision holds them, in the camera's frame, with a stage and one tool."""
    state = lerobots.poses(count, seed).astype(np.float64)
    stamps_ns = 1_760_000_000 * 10**9 + np.rint(np.arange(count) * 1e9 / rate_hz).astype(np.int64)
    motions, jaws = [], []
    for k, arm in enumerate(("PSM1", "PSM2")):
        at = 8 * k
        tip_mm, turns = 1000.0 * state[:, at : at + 3], state[:, at + 3 : at + 7]
        motions.append(Motion(arm, f"/{arm}/measured_cp", "ECM", stamps_ns, tip_mm, turns))
        jaws.append((arm, Signal(stamps_ns, state[:, at + 7])))
    labels = (Label("A1", "stage", int(stamps_ns[5]), int(stamps_ns[9])),)
    tools = (("PSM1", lerobots.NEEDLE_DRIVER),)
    return Recording("mcap", "full", tuple(motions), tuple(jaws), labels=labels, tools=tools)


def commanded(given: Recording, seed: int) -> Recording:
    """Return a recording with setpoints as single precision holds them, at other times than its poses."""
    count = len(given.motions[0].stamps_ns)
    action = lerobots.commands(count, seed).astype(np.float64)
    tips, jaws = [], []
    for k, motion in enumerate(given.motions):
        at, stamps_ns = 8 * k, motion.stamps_ns + 3_000_000
        tip_mm, turns = 1000.0 * action[:, at : at + 3], action[:, at + 3 : at + 7]
        tips.append(Motion(motion.arm, f"/{motion.arm}/setpoint_cp", motion.frame, stamps_ns, tip_mm, turns))
        jaws.append((motion.arm, Signal(stamps_ns, action[:, at + 7])))
    return replace(given, setpoints=tuple(tips), jaw_setpoints=tuple(jaws))


def commanded_episodes() -> list[ExportedEpisode]:
    return [replace(one, recording=commanded(one.recording, k)) for k, one in enumerate(episodes())]


def episodes(counts: Iterable[int] = (40, 50, 60)) -> list[ExportedEpisode]:
    splits = ("train", "val", "failure")
    return [
        ExportedEpisode(recording(count, k), lerobots.TASKS[k % 2], splits[min(k, 2)]) for k, count in enumerate(counts)
    ]


def written(folder: Path, given: Iterable[ExportedEpisode], version: str, about: AboutDataset = ABOUT) -> Path:
    for name, file in dataset_files(given, about, version):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(file.read())
    return folder


def read(folder: Path, number: int) -> Recording:
    with find_dataset(folder) as dataset, io.BytesIO() as out:
        cut_episode(dataset, episodes_of(dataset)[number], out)
        return read_recording(out)


@pytest.mark.parametrize("version", VERSIONS)
def test_what_is_written_is_read_as_the_same_bits(tmp_path, version):
    folder = written(tmp_path, episodes(), version)
    for number, episode in enumerate(episodes()):
        again, given = read(folder, number), episode.recording
        for one, other in zip(again.motions, given.motions, strict=True):
            assert (one.arm, one.frame, one.topic) == (other.arm, "ECM", other.topic)
            np.testing.assert_array_equal(one.tip_mm.astype(np.float32), other.tip_mm.astype(np.float32))
            np.testing.assert_array_equal(one.rotation_xyzw, other.rotation_xyzw)
            np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns - other.stamps_ns[0])
            np.testing.assert_array_equal(again.jaw_of(one.arm).values, given.jaw_of(one.arm).values)
        assert again.tools == given.tools
        assert dict(again.notes)["task"] == episode.task
        assert dict(again.notes)["splits"] == episode.split


@pytest.mark.parametrize(("most", "files"), [(1000, [0, 0, 0]), (2, [0, 0, 1])])
def test_both_versions_have_the_same_data_and_statistics(tmp_path, monkeypatch, most, files):
    monkeypatch.setattr("skills.formats.lerobot.writer.FILE_EPISODES", most)
    old, new = (written(tmp_path / version, episodes(), version) for version in VERSIONS)
    whole = pq.read_table(new / "data/chunk-000")
    parts = [pq.read_table(old / f"data/chunk-000/episode_{k:06d}.parquet") for k in range(3)]
    assert whole.num_rows == 150
    for name in whole.column_names:
        assert whole[name].to_pylist() == [value for part in parts for value in part[name].to_pylist()]
    lines = [json.loads(line) for line in (old / "meta/episodes_stats.jsonl").read_text().splitlines()]
    rows = pq.read_table(new / "meta/episodes").to_pylist()
    assert [row["data/file_index"] for row in rows] == files
    for line, row in zip(lines, rows, strict=True):
        for feature, stats in line["stats"].items():
            assert stats == {name: row[f"stats/{feature}/{name}"] for name in stats}


def test_statistics_are_those_of_all_frames(tmp_path):
    stats = json.loads((written(tmp_path, episodes(), "v3.0") / "meta/stats.json").read_text())
    state = np.concatenate([lerobots.poses(count, k) for k, count in enumerate((40, 50, 60))]).astype(np.float64)
    found = stats["observation.state"]
    assert (found["min"], found["max"]) == (state.min(axis=0).tolist(), state.max(axis=0).tolist())
    np.testing.assert_allclose(found["mean"], state.mean(axis=0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found["std"], state.std(axis=0), rtol=0, atol=1e-12)
    assert found["count"] == [150]
    assert stats["index"]["max"] == [149.0]


@pytest.mark.parametrize("version", VERSIONS)
def test_the_manifest_has_every_other_file(tmp_path, version):
    folder = written(tmp_path, episodes(), version)
    lines = [line.split("  ") for line in (folder / SUMS).read_text().splitlines()]
    files = sorted(file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file())
    assert [name for _, name in lines] == sorted(set(files) - {SUMS})
    for digest, name in lines:
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest


def test_the_same_episodes_make_the_same_bytes(tmp_path):
    one, other = (written(tmp_path / name, episodes(), "v3.0") / SUMS for name in ("a", "b"))
    assert one.read_bytes() == other.read_bytes()


def test_actions_are_the_next_states_and_stages_are_named(tmp_path):
    folder = written(tmp_path, episodes((40,)), "v2.1")
    table = pq.read_table(folder / "data/chunk-000/episode_000000.parquet")
    state, action = (np.array(table[name].to_pylist()) for name in ("observation.state", "action"))
    np.testing.assert_array_equal(action, np.concatenate([state[1:], state[-1:]]))
    stages = table["observation.meta.stage"].to_pylist()
    assert [k for k, name in enumerate(stages) if name == "A1"] == [5, 6, 7, 8, 9]
    assert set(stages) == {"A1", ""}


COMMANDED = replace(ABOUT, action="setpoint")


@pytest.mark.parametrize("version", VERSIONS)
def test_no_setpoint_from_outside_an_interval_is_an_action(tmp_path, version):
    given = commanded(recording(40), 0)
    stamps_ns = given.motions[0].stamps_ns
    part = ExportedEpisode(given, "x", start_ns=int(stamps_ns[5]), end_ns=int(stamps_ns[9]))
    again = read(written(tmp_path, [part], version, COMMANDED), 0)
    # The setpoint nearest to the last frame is 3 ms after the interval.
    for one, other in zip(again.setpoints, given.setpoints, strict=True):
        assert np.abs(one.tip_mm - other.tip_mm[[5, 6, 7, 8, 8]]).max() < 1e-9


@pytest.mark.parametrize("version", VERSIONS)
def test_setpoints_written_as_actions_are_read_as_the_same_bits(tmp_path, version):
    given = commanded_episodes()
    folder = written(tmp_path, given, version, COMMANDED)
    for number, episode in enumerate(given):
        again, recording = read(folder, number), episode.recording
        assert again.left_out == ()
        for one, other in zip(again.setpoints, recording.setpoints, strict=True):
            assert (one.arm, one.frame, one.topic) == (other.arm, "ECM", other.topic)
            np.testing.assert_array_equal(one.tip_mm.astype(np.float32), other.tip_mm.astype(np.float32))
            np.testing.assert_array_equal(one.rotation_xyzw, other.rotation_xyzw)
            np.testing.assert_array_equal(
                again.jaw_setpoint_of(one.arm).values, recording.jaw_setpoint_of(one.arm).values
            )
    more = [replace(one, recording=read(folder, k)) for k, one in enumerate(given)]
    assert action_rule(more, ABOUT) == "setpoint"
    folders = folder, written(tmp_path / "again", more, version, COMMANDED)
    whole, rewritten = (pq.ParquetDataset(sorted((one / "data").rglob("*.parquet"))).read() for one in folders)
    for name in ("observation.state", "action", "timestamp"):
        assert whole[name].to_pylist() == rewritten[name].to_pylist()


def test_the_rule_of_the_actions_is_stated_and_names_tell_it(tmp_path):
    for about, rule, first in (
        (ABOUT, "next state", "psm1_pose.position.x"),
        (COMMANDED, "setpoint", lerobots.ACTION[0]),
    ):
        folder = written(tmp_path / rule, commanded_episodes(), "v2.1", about)
        assert json.loads((folder / "meta/suture-skills.json").read_text())["action"] == rule
        assert ("setpoints" in (folder / "meta/README.md").read_text()) is (rule == "setpoint")
        (names,) = json.loads((folder / "meta/info.json").read_text())["features"]["action"]["names"]
        assert names[0] == first
        assert bool(read(folder, 0).setpoints) is (rule == "setpoint")


def sparse(one: Recording) -> Recording:
    """Return a recording whose setpoints have a gap of 0.2 s."""
    kept = np.r_[0:10, 16 : len(one.setpoints[0].stamps_ns)]
    first = one.setpoints[0]
    gap = replace(
        first, stamps_ns=first.stamps_ns[kept], tip_mm=first.tip_mm[kept], rotation_xyzw=first.rotation_xyzw[kept]
    )
    return replace(one, setpoints=(gap, *one.setpoints[1:]))


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda one: replace(one, setpoints=one.setpoints[:1]), NoUsableTopic),
        (lambda one: replace(one, jaw_setpoints=one.jaw_setpoints[:1]), NoUsableTopic),
        (
            lambda one: replace(one, setpoints=(one.setpoints[0], replace(one.setpoints[1], frame="PSM2_base"))),
            NoUsableTopic,
        ),
        (
            lambda one: replace(one, setpoints=(one.setpoints[0], replace(one.setpoints[1], rotation_xyzw=None))),
            NoUsableTopic,
        ),
        (sparse, UnreadableRecording),
    ],
    ids=["an arm", "a jaw", "another frame", "no orientation", "a gap"],
)
def test_setpoints_that_an_episode_lacks_are_no_actions(tmp_path, change, error):
    first, second, third = commanded_episodes()
    assert action_rule([first, second, third], ABOUT) == "setpoint"
    given = [first, replace(second, recording=change(second.recording)), third]
    assert action_rule(given, ABOUT) == "next state"
    with pytest.raises(error):
        written(tmp_path, given, "v2.1", COMMANDED)


def test_a_faster_recording_is_sampled_and_never_interpolated(tmp_path):
    fast = recording(400, rate_hz=100.0)
    again = read(written(tmp_path, [ExportedEpisode(fast, "x")], "v2.1"), 0)
    assert len(again.motions[0].stamps_ns) == 120
    recorded = {tuple(point) for point in fast.motions[0].tip_mm.astype(np.float32).tolist()}
    assert all(tuple(point) in recorded for point in again.motions[0].tip_mm.astype(np.float32).tolist())


def test_a_part_of_a_recording_and_one_arm_can_be_written(tmp_path):
    whole = recording(60)
    start, end = (int(whole.motions[0].stamps_ns[k]) for k in (10, 29))
    about = replace(ABOUT, arms=("PSM2",))
    again = read(written(tmp_path, [ExportedEpisode(whole, "x", "train", start, end)], "v2.1", about), 0)
    assert again.arms == ("PSM2",)
    np.testing.assert_array_equal(again.motions[0].tip_mm, whole.motions[1].tip_mm[10:30])


def test_splits_follow_the_order_of_the_episodes(tmp_path):
    info = json.loads((written(tmp_path, episodes((10, 10, 10, 10)), "v2.1") / "meta/info.json").read_text())
    assert info["splits"] == {"train": "0:1", "val": "1:2", "failure": "2:4"}
    with pytest.raises(BadInput, match="in the order of their splits"):
        written(tmp_path, reversed(episodes()), "v2.1")


def test_no_surgeon_is_in_two_splits_and_the_shares_are_near():
    rng = np.random.default_rng(0)
    for _ in range(50):
        surgeons = {f"s{k}": int(rng.integers(1, 30)) for k in range(40)}
        splits = splits_by_group(surgeons)
        assert splits.keys() == surgeons.keys()
        shares = {name: sum(n for s, n in surgeons.items() if splits[s] == name) for name in ("train", "val", "test")}
        total = sum(surgeons.values())
        assert abs(shares["train"] / total - 0.8) < 0.05
        assert abs(shares["val"] / total - 0.1) < 0.05
    assert splits_by_group({"one": 3}) == {"one": "train"}


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (lambda one: replace(one, jaws=one.jaws[:1]), NoUsableTopic, "no jaw of PSM2"),
        (lambda one: replace(one, motions=one.motions[:1]), NoUsableTopic, "no pose for arm PSM2"),
        (
            lambda one: replace(one, motions=(one.motions[0], replace(one.motions[1], rotation_xyzw=None))),
            NoUsableTopic,
            "no orientation of PSM2",
        ),
        (
            lambda one: replace(one, motions=(one.motions[0], replace(one.motions[1], frame="PSM2_base"))),
            MixedFrames,
            "PSM2 is in the frame PSM2_base in episode 1, and in ECM",
        ),
    ],
    ids=["jaw", "arm", "orientation", "frame"],
)
def test_an_episode_that_lacks_something_is_refused(tmp_path, change, error, words):
    given = [ExportedEpisode(recording(), "x"), ExportedEpisode(change(recording()), "x")]
    with pytest.raises(error, match=words):
        written(tmp_path, given, "v2.1")


def test_a_gap_and_arms_without_a_common_time_are_refused(tmp_path):
    whole = recording(60)
    jaws = tuple(
        (arm, Signal(np.delete(one.stamps_ns, range(20, 25)), np.delete(one.values, range(20, 25))))
        for arm, one in whole.jaws
    )
    with pytest.raises(UnreadableRecording, match=r"no sample within one frame of 0\.7"):
        written(tmp_path, [ExportedEpisode(replace(whole, jaws=jaws), "x")], "v2.1")
    late = tuple((arm, Signal(one.stamps_ns + 10**12, one.values)) for arm, one in whole.jaws)
    with pytest.raises(NoUsableTopic, match="no time in common"):
        written(tmp_path, [ExportedEpisode(replace(whole, jaws=late), "x")], "v2.1")
    with pytest.raises(BadInput, match="no episodes"):
        written(tmp_path, [], "v3.0")


def test_the_frames_of_our_own_datasets_cannot_be_contradicted(tmp_path):
    folder = written(tmp_path, episodes((40,)), "v2.1")
    with find_dataset(folder) as dataset, io.BytesIO() as out:
        cut_episode(dataset, episodes_of(dataset)[0], out)
        assert {motion.frame for motion in read_recording(out, frame="ECM").motions} == {"ECM"}
        with pytest.raises(MixedFrames, match="stated as PSM1_base, and the dataset says ECM"):
            read_recording(out, frame="base")


@pytest.mark.nightly  # 4 s of processor time
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_memory_does_not_grow_with_the_number_of_episodes(version):
    one = recording(400)

    def peak(count: int) -> int:
        tracemalloc.start()
        for _, file in dataset_files((ExportedEpisode(one, "x") for _ in range(count)), ABOUT, version):
            file.seek(0, io.SEEK_END)
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    peak(10)  # imports
    assert peak(2 * TABLE_ROWS) < peak(TABLE_ROWS) + (1 << 20)  # the piece of a file that is read at once


def test_a_zip_of_our_dataset_with_one_episode_is_a_recording(tmp_path):
    with io.BytesIO() as out:
        with zipfile.ZipFile(out, "w") as archive:
            for name, file in dataset_files(episodes((40,)), ABOUT, "v3.0"):
                archive.writestr(name, file.read())
        assert read_recording(out).arms == ("PSM1", "PSM2")


def test_the_example_of_the_page_writes_a_dataset_that_is_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("session.mcap").write_bytes(write_mcap(recording(120, rate_hz=100.0)))
    page = (Path(__file__).parents[2] / "docs" / "lerobot.md").read_text()
    [example] = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(example, {})
    assert len(read(Path("dataset"), 0).motions[0].stamps_ns) == 36
