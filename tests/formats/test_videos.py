"""Videos added to an exported dataset: the right pictures at the right frames, all of them or none, and no others."""

import hashlib
import io
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from skills.errors import BadInput, Corrupt, SkillsError, UnreadableRecording
from skills.formats import read_recording
from skills.formats.lerobot import INFO
from skills.formats.lerobot.cut import cut_episode, episodes_of, find_dataset
from skills.formats.lerobot.videos import Videos, add_videos, choose_videos, find_recorded
from skills.formats.lerobot.writer import AboutDataset, ExportedEpisode, dataset_files
from tests.by_day import some
from tests.formats import lerobots, videos
from tests.formats.lerobots import COUNTS, FPS
from tests.formats.test_lerobot_hostile import cut_all
from tests.formats.videos import CAMERAS, encoded, shown, video_feature

ABOUT = AboutDataset("Sutures", ("PSM1", "PSM2"), fps=FPS)
FIRST = (0, 40, 90)  # the frames of each episode, as they are numbered through
SHARED = f"videos/{CAMERAS[0]}/chunk-000/file-000.mp4"
SINGLE = f"videos/chunk-000/{CAMERAS[0]}/episode_000001.mp4"


def uploaded(folder: Path, numbers: Sequence[int]) -> dict[str, bytes]:
    """Return uploads of some episodes by their SHA-256."""
    uploads = {}
    with find_dataset(folder) as dataset:
        assert dataset is not None
        for number in numbers:
            with io.BytesIO() as out:
                cut_episode(dataset, episodes_of(dataset)[number], out)
                uploads[hashlib.sha256(out.getvalue()).hexdigest()] = out.getvalue()
    return uploads


def chosen(folder: Path, numbers: Sequence[int], version: str) -> Videos:
    return choose_videos([*uploaded(folder, numbers)], find_recorded([folder], FPS), version)


def exported(folder: Path, numbers: Sequence[int], version: Any, to: Path) -> Path:
    """Export some episodes of a dataset with their videos."""
    found = chosen(folder, numbers, version)
    recordings = [read_recording(io.BytesIO(one), frame="ECM") for one in uploaded(folder, numbers).values()]
    for name, file in dataset_files((ExportedEpisode(one, "suture") for one in recordings), ABOUT, version):
        (to / name).parent.mkdir(parents=True, exist_ok=True)
        (to / name).write_bytes(file.read())
    add_videos(to, found)
    return to


def source(folder: Path, version: str, change: Callable[[dict[str, bytes]], Any] | None = None, **how: Any) -> Path:
    """Write a dataset with videos, after a change."""
    files = videos.dataset(version, **how)
    if change is not None:
        change(files)
    return lerobots.write(files, folder / "theirs")


def with_info(change: Callable[[dict[str, Any]], Any]) -> Callable[[dict[str, bytes]], None]:
    """Return the change of info.json."""

    def changed(files: dict[str, bytes]) -> None:
        info = json.loads(files[INFO])
        change(info)
        files[INFO] = json.dumps(info).encode()

    return changed


def pictures_of(folder: Path, number: int, camera: str, length: int) -> list[int]:
    """Return the numbers of the pictures of an episode, found as LeRobot finds them."""
    info = json.loads((folder / INFO).read_text())
    if info["codebase_version"] == "v2.1":
        name = info["video_path"].format(episode_chunk=number // 1000, video_key=camera, episode_index=number)
        return shown(folder / name)[:length]
    row = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()[number]
    place = {part: row[f"videos/{camera}/{part}"] for part in ("chunk_index", "file_index")}
    at = round(row[f"videos/{camera}/from_timestamp"] * FPS)
    assert round(row[f"videos/{camera}/to_timestamp"] * FPS) == at + length
    return shown(folder / info["video_path"].format(video_key=camera, **place))[at : at + length]


@pytest.mark.parametrize(
    ("theirs", "ours", "numbers"),
    some([("v2.1", "v2.1", (0, 1, 2)), ("v2.1", "v2.1", (2, 0)), ("v2.1", "v3.0", (1, 2)), ("v3.0", "v3.0", (0, 1, 2)),
     ("v3.0", "v3.0", (2, 1, 0)), ("v3.0", "v3.0", (2,)), ("v3.0", "v2.1", (2,))], 3),
)  # fmt: skip
def test_each_exported_frame_has_its_picture(theirs, ours, numbers, tmp_path):
    folder = source(tmp_path, theirs)
    out = exported(folder, numbers, ours, tmp_path / "ours")
    for at, number in enumerate(numbers):
        for camera in CAMERAS:
            expected = [*range(FIRST[number], FIRST[number] + COUNTS[number])]
            assert pictures_of(out, at, camera, COUNTS[number]) == expected
    lines = dict(reversed(line.split("  ")) for line in (out / "SHA256SUMS").read_text().splitlines())
    files = [one.relative_to(out).as_posix() for one in out.rglob("*") if one.is_file()]
    assert sorted(lines) == sorted({*files} - {"SHA256SUMS"})
    assert all(hashlib.sha256((out / name).read_bytes()).hexdigest() == one for name, one in lines.items())
    sound, read = cut_all(folder), cut_all(out)
    for at, number in enumerate(numbers):
        for one, other in zip(read[at].motions, sound[number].motions, strict=True):
            np.testing.assert_array_equal(one.tip_mm.astype(np.float32), other.tip_mm.astype(np.float32))


def test_the_metadata_describe_the_videos_as_lerobot_needs_them(tmp_path):
    out = exported(source(tmp_path, "v2.1"), (0, 2), "v2.1", tmp_path / "ours")
    info = json.loads((out / INFO).read_text())
    assert info["total_videos"] == 4
    for camera in CAMERAS:
        assert info["features"][camera] == video_feature(
            **{"video.height": 48, "video.width": 64, "video.channels": 3, "has_audio": False}
        )
    lines = [json.loads(line) for line in (out / "meta/episodes_stats.jsonl").read_text().splitlines()]
    assert [line["stats"][CAMERAS[0]] for line in lines] == [videos.stats_of(0), videos.stats_of(2)]
    readme = (out / "meta/README.md").read_text()
    for said in (f"- `{CAMERAS[0]}`: h264, 64 x 48, yuv420p", "declared that everyone", "without sound"):
        assert said in readme
    assert "There are no pictures" not in readme


def test_statistics_of_all_episodes_are_those_of_their_sum(tmp_path):
    """Means are weighted by the pictures that were sampled, 20 and 22, and the spread has the means' own."""
    out = exported(source(tmp_path, "v2.1"), (0, 2), "v3.0", tmp_path / "ours")
    found = json.loads((out / "meta/stats.json").read_text())[CAMERAS[1]]
    mean = (20 * 0.2 + 22 * 0.4) / 42
    spread = 0.05**2 + (20 * (0.2 - mean) ** 2 + 22 * (0.4 - mean) ** 2) / 42
    assert found["count"] == [42]
    np.testing.assert_allclose(found["mean"][0], [[mean]])
    np.testing.assert_allclose(found["std"][0], [[np.sqrt(spread)]])
    rows = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row[f"stats/{CAMERAS[1]}/mean"] for row in rows] == [videos.stats_of(k)["mean"] for k in (0, 2)]


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_videos_without_statistics_are_added_without(version, tmp_path):
    out = exported(source(tmp_path, version, stats=False), (0, 1), version, tmp_path / "ours")
    assert CAMERAS[0] in json.loads((out / INFO).read_text())["features"]
    assert not any(CAMERAS[0] in one.read_text() for one in out.glob("meta/*stats*"))


def test_a_part_of_the_episodes_in_a_file_is_not_passed_on(tmp_path):
    """The file has the pictures of another episode, whose surgeon may not have consented."""
    with pytest.raises(BadInput, match=r"file-000.mp4 has 90 frames, and not all of them are of exported episodes"):
        chosen(source(tmp_path, "v3.0"), (0, 2), "v3.0")


def test_episodes_in_one_file_are_not_exported_as_v21(tmp_path):
    with pytest.raises(BadInput, match=r"has 2 episodes, and v2.1 a file for each; export with --version v3.0"):
        chosen(source(tmp_path, "v3.0"), (0, 1), "v2.1")


def test_episodes_of_two_datasets_are_exported_together(tmp_path):
    one, other = source(tmp_path / "a", "v2.1"), source(tmp_path / "b", "v3.0")
    recordings = [*uploaded(one, (0,)), *uploaded(other, (2,))]
    found = choose_videos(recordings, find_recorded([one, other], FPS), "v2.1")
    files = [clips[CAMERAS[0]].file for clips in found.clips]
    assert files == [one / SINGLE.replace("000001", "000000"), other / SHARED.replace("file-000", "file-001")]


def test_an_episode_without_a_folder_is_named(tmp_path):
    folder = source(tmp_path, "v2.1")
    recordings = [*uploaded(folder, (0,)), "ab" * 32]
    with pytest.raises(BadInput, match=r"these 1 of 2 episodes: 1 \(recording abababababab\)"):
        choose_videos(recordings, find_recorded([folder], FPS), "v2.1")


def test_an_episode_is_found_with_the_statements_of_its_upload(tmp_path):
    folder = source(tmp_path, "v2.1")
    plain = find_recorded([folder], FPS)
    said = find_recorded([folder], FPS, tools={"PSM1": "400006"})
    assert len(plain) == len(said) == 3
    assert not plain.keys() & said.keys()


REFUSED: dict[str, tuple[Callable[[dict[str, bytes]], Any], str]] = {
    "a missing video": (lambda files: files.pop(SINGLE), "no video of observation.images.endoscope.left for episode 1"),
    "a frame too few": (lambda files: files.update({SINGLE: encoded(40, 49)}), "49 frames, and not all"),
    "a frame too many": (lambda files: files.update({SINGLE: encoded(40, 51)}), "51 frames, and not all"),
    "another rate": (lambda files: files.update({SINGLE: encoded(40, 50, fps=25)}), "not have 30 frames per second"),
    "another size": (lambda files: files.update({SINGLE: encoded(40, 50, width=80)}), "80 x 48.* and h264, 64 x 48"),
    "another codec": (lambda files: files.update({SINGLE: encoded(40, 50, "-c:v", "mpeg4")}), "is mpeg4"),
    "a damaged video": (lambda files: files.update({SINGLE: files[SINGLE][:-1]}), "it is cut"),
    "a text": (lambda files: files.update({SINGLE: b"version https://git-lfs.github.com/spec/v1"}), "no MP4 file"),
    "two videos of an episode": (
        lambda files: files.update({SINGLE.replace("chunk-000", "chunk-001"): files[SINGLE]}), "of the same episode"),
    "a camera that leads out": (
        with_info(lambda info: info["features"].update({"../../etc": video_feature()})), "a camera called '../../etc'"),
    "a camera of dots": (with_info(lambda info: info["features"].update({"..": video_feature()})), "called '..'"),
    "no camera": (
        with_info(lambda info: [info["features"].pop(camera) for camera in CAMERAS]), "has no videos: meta/info.json"),
    "another rate of the dataset": (with_info(lambda info: info.update(fps=25)), "export with --fps 25"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_videos_that_do_not_fit_are_refused_before_anything_is_copied(name, tmp_path):
    change, fault = REFUSED[name]
    folder = source(tmp_path, "v2.1", change)
    with pytest.raises((BadInput, UnreadableRecording), match=fault):
        chosen(folder, (0, 1), "v2.1")


@pytest.mark.parametrize(
    ("part", "wrong"),
    [("from_timestamp", 0.5), ("to_timestamp", float("nan")), ("from_timestamp", None), ("file_index", 7),
     ("from_timestamp", float("inf"))],
)  # fmt: skip
def test_a_wrong_place_in_a_shared_video_is_refused(part, wrong, tmp_path):
    table = "meta/episodes/chunk-000/file-000.parquet"

    def change(files: dict[str, bytes]) -> None:
        rows = pq.read_table(io.BytesIO(files[table])).to_pylist()
        rows[1][f"videos/{CAMERAS[0]}/{part}"] = wrong
        files[table] = lerobots.parquet(lerobots.pa.Table.from_pylist(rows))

    with pytest.raises(SkillsError, match=r"not those of its 50 frames|There is no video"):
        chosen(source(tmp_path, "v3.0", change), (0, 1), "v3.0")


def test_a_link_out_of_the_folder_is_refused(tmp_path):
    folder = source(tmp_path, "v2.1")
    private = tmp_path / "private.mp4"
    (folder / SINGLE).rename(private)
    os.symlink(private, folder / SINGLE)
    with pytest.raises(BadInput, match="a link out of it"):
        chosen(folder, (0, 1), "v2.1")


def test_a_clock_that_is_not_that_of_the_frames_is_refused(tmp_path):
    """At 29.5 Hz the 40th row is 0.66 frames late, so that the video shows other rows than the export."""
    seconds = np.arange(40) / 29.5

    def change(files: dict[str, bytes]) -> None:
        columns = lerobots.columns_of(40, 0, timestamp=seconds)
        files["data/chunk-000/episode_000000.parquet"] = lerobots.parquet(columns)

    with pytest.raises(BadInput, match=r"up to 0.66 frames from the frames' numbers in episode 0"):
        chosen(source(tmp_path, "v2.1", change), (0, 1), "v2.1")


def test_a_video_of_other_rows_than_the_dataset_is_refused(tmp_path):
    folder = source(tmp_path, "v2.1")
    out = exported(folder, (0, 1), "v2.1", tmp_path / "ours")
    for name in ("videos", "meta"):  # as if the dataset had been exported from something else
        assert (out / name).is_dir()
    lines = (out / "meta/episodes.jsonl").read_text().replace('"length": 50', '"length": 48')
    (out / "meta/episodes.jsonl").write_text(lines)
    info = json.loads((out / INFO).read_text())
    info["features"] = {name: one for name, one in info["features"].items() if name not in CAMERAS}
    (out / INFO).write_text(json.dumps(info))
    with pytest.raises(BadInput, match=r"Episode 1 has 48 frames, and its video of .* 50"):
        add_videos(out, chosen(folder, (0, 1), "v2.1"))


def test_a_video_that_changes_while_it_is_copied_is_noticed(tmp_path):
    folder = source(tmp_path, "v2.1")
    found = chosen(folder, (1,), "v2.1")
    (folder / SINGLE).write_bytes(encoded(0, 40))
    recording = read_recording(io.BytesIO(next(iter(uploaded(folder, (1,)).values()))), frame="ECM")
    out = tmp_path / "ours"
    for name, file in dataset_files([ExportedEpisode(recording, "suture")], ABOUT, "v2.1"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(file.read())
    with pytest.raises(Corrupt, match="has changed while it was copied"):
        add_videos(out, found)
    with pytest.raises(BadInput, match="called like another feature"):
        add_videos(exported(folder, (0,), "v2.1", tmp_path / "again"), chosen(folder, (0,), "v2.1"))


def test_a_folder_without_a_dataset_is_refused(tmp_path):
    with pytest.raises(BadInput, match="is not the folder of a LeRobot dataset"):
        find_recorded([tmp_path], FPS)
