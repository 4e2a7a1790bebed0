"""LeRobot datasets that we write, as other programs read them: LeRobot itself, and Open-H's validator. Nightly."""

import json
import os
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.formats import videos
from tests.formats.test_lerobot_writer import ABOUT, COMMANDED, commanded_episodes, episodes, written
from tests.formats.test_videos import exported, source
from tests.needs import need

pytestmark = pytest.mark.nightly

Write = Callable[[Path, str], Path]


@pytest.fixture(params=["next state", "setpoint"])
def write(request: pytest.FixtureRequest) -> Write:
    """Return the writer of a dataset with each rule of the action, given a folder and a version."""
    if request.param == "next state":
        return lambda folder, version: written(folder, episodes(), version, ABOUT)
    return lambda folder, version: written(folder, commanded_episodes(), version, COMMANDED)


LOAD = """
import json, sys
from importlib.metadata import version
from lerobot.datasets.lerobot_dataset import LeRobotDataset
names = ("observation.state", "action", "timestamp", "frame_index", "episode_index", "index", "task_index")
found = LeRobotDataset("local/ours", root=sys.argv[1])
frames = [found[k] for k in range(len(found))]
columns = {name: [frame[name].tolist() for frame in frames] for name in names}
print(json.dumps({"version": version("lerobot"), "columns": columns, "tasks": [frame["task"] for frame in frames]}))
"""
CONVERT = """
import sys
from pathlib import Path
from lerobot.datasets.v30 import convert_dataset_v21_to_v30 as v30
old, new = Path(sys.argv[1]), Path(sys.argv[2])
v30.convert_info(old, new, 100, 200)
v30.convert_tasks(old, new)
v30.convert_episodes_metadata(old, new, v30.convert_data(old, new, 100))
"""


@cache
def interpreters() -> dict[str, str]:
    """Return the interpreters with LeRobot by its version."""
    need("lerobot")
    code = "from importlib.metadata import version; print(version('lerobot'))"
    return {run(python, code).strip(): python for python in os.environ["TESTS_LEROBOT"].split(":")}


def run(python: str, code: str, *arguments: str) -> str:
    with TemporaryDirectory() as folder:  # torch and datasets leave their caches behind
        quiet = {"HF_HUB_OFFLINE": "1", "HF_DATASETS_DISABLE_PROGRESS_BARS": "1", "HF_HOME": folder, "TMPDIR": folder}
        command = [python, "-c", code, *arguments]
        done = subprocess.run(command, env=os.environ | quiet, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.strip().splitlines()[-1] if done.stdout.strip() else ""


@pytest.mark.parametrize(("lerobot", "version"), [("0.3.3", "v2.1"), ("0.4.4", "v3.0")])
def test_lerobot_loads_every_frame_with_equal_numbers(tmp_path: Path, write: Write, lerobot: str, version: str):
    python = interpreters()[lerobot]
    folder = write(tmp_path, version)
    loaded = json.loads(run(python, LOAD, str(folder)))
    table = pq.ParquetDataset(sorted((folder / "data").rglob("*.parquet"))).read()
    for name, column in loaded["columns"].items():
        np.testing.assert_array_equal(np.array(column), np.array(table[name].to_pylist()))
    assert loaded["tasks"] == table["instruction.text"].to_pylist()


PICTURES = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
found = LeRobotDataset("local/ours", root=sys.argv[1], video_backend="pyav")  # torchcodec needs ffmpeg's libraries
frames = [found[k] for k in range(len(found))]
halves = {name: [[round(float(half.median()) * 219 + 16) for half in frame[name][1].chunk(2, dim=1)]
                 for frame in frames] for name in found.meta.camera_keys}
means = {name: found.meta.stats[name]["mean"].ravel().tolist() for name in found.meta.camera_keys}
print(json.dumps({"halves": halves, "means": means}))
"""


@pytest.mark.parametrize(("lerobot", "version"), [("0.3.3", "v2.1"), ("0.4.4", "v3.0")])
def test_lerobot_decodes_the_picture_of_every_frame(tmp_path: Path, lerobot: str, version: str):
    """Its own decoder finds the pictures by their times; green is the luma of a grey picture, between 16 and 235."""
    folder = exported(source(tmp_path, version), (0, 1, 2), version, tmp_path / "ours")
    loaded = json.loads(run(interpreters()[lerobot], PICTURES, str(folder)))
    assert loaded["halves"].keys() == {*videos.CAMERAS}
    for found in loaded["halves"].values():
        luma = [np.repeat(np.array([halves]), videos.WIDTH // 2, axis=1) for halves in found]
        assert [videos.number_of(one) for one in luma] == [*range(150)]
    counts = [videos.stats_of(k)["count"][0] for k in range(3)]
    mean = np.average([videos.stats_of(k)["mean"][0][0][0] for k in range(3)], weights=counts)
    for found in loaded["means"].values():
        np.testing.assert_allclose(found[0], mean)


def test_lerobots_own_conversion_of_v2_equals_our_v3(tmp_path: Path, write: Write):
    python = interpreters()["0.4.4"]
    old, ours = (write(tmp_path / version, version) for version in ("v2.1", "v3.0"))
    new = tmp_path / "converted"
    run(python, CONVERT, str(old), str(new))
    one, other = (pq.read_table(folder / "data/chunk-000/file-000.parquet") for folder in (new, ours))
    assert one.to_pydict() == other.to_pydict()
    stats, our_stats = (json.loads((folder / "meta/stats.json").read_text()) for folder in (new, ours))
    assert stats.keys() == our_stats.keys()
    for feature, found in stats.items():
        for name, values in found.items():
            np.testing.assert_allclose(our_stats[feature][name], values, rtol=0, atol=1e-12)
    assert json.loads((new / "meta/info.json").read_text()) == json.loads((ours / "meta/info.json").read_text())


def test_open_hs_validator_has_no_warning_with_videos(tmp_path: Path):
    need("openh")
    folder = exported(source(tmp_path, "v2.1"), (0, 1, 2), "v2.1", tmp_path / "ours")
    command = [interpreters()["0.3.3"], os.environ["TESTS_OPENH_VALIDATOR"], str(folder), "--verbose"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "ERROR" not in done.stdout
    assert "Found 6 video files" in done.stdout


def test_open_hs_validator_reports_no_error(tmp_path: Path, write: Write):
    need("openh")
    folder = write(tmp_path, "v2.1")
    python = interpreters()["0.3.3"]  # which the validator uses if it is there
    command = [python, os.environ["TESTS_OPENH_VALIDATOR"], str(folder), "--verbose"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "ERROR" not in done.stdout
    assert "skipping" not in done.stdout
