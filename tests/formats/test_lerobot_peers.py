"""LeRobot datasets that we write, as other programs read them: LeRobot itself, and Open-H's validator. Nightly."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.formats.test_lerobot_writer import episodes, written
from tests.needs import need

pytestmark = pytest.mark.nightly

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


def interpreters() -> dict[str, str]:
    """Return the interpreters with LeRobot by its version."""
    need("lerobot")
    code = "from importlib.metadata import version; print(version('lerobot'))"
    return {run(python, code).strip(): python for python in os.environ["TESTS_LEROBOT"].split(":")}


def run(python: str, code: str, *arguments: str) -> str:
    quiet = os.environ | {"HF_HUB_OFFLINE": "1", "HF_DATASETS_DISABLE_PROGRESS_BARS": "1"}
    done = subprocess.run([python, "-c", code, *arguments], env=quiet, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.strip().splitlines()[-1] if done.stdout.strip() else ""


@pytest.mark.parametrize(("lerobot", "version"), [("0.3.3", "v2.1"), ("0.4.4", "v3.0")])
def test_lerobot_loads_every_frame_with_equal_numbers(tmp_path: Path, lerobot: str, version: str):
    python = interpreters()[lerobot]
    folder = written(tmp_path, episodes(), version)
    loaded = json.loads(run(python, LOAD, str(folder)))
    table = pq.ParquetDataset(sorted((folder / "data").rglob("*.parquet"))).read()
    for name, column in loaded["columns"].items():
        np.testing.assert_array_equal(np.array(column), np.array(table[name].to_pylist()))
    assert loaded["tasks"] == table["instruction.text"].to_pylist()


def test_lerobots_own_conversion_of_v2_equals_our_v3(tmp_path: Path):
    python = interpreters()["0.4.4"]
    old, ours = (written(tmp_path / version, episodes(), version) for version in ("v2.1", "v3.0"))
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


def test_open_hs_validator_reports_no_error(tmp_path: Path):
    need("openh")
    folder = written(tmp_path, episodes(), "v2.1")
    command = [sys.executable, os.environ["TESTS_OPENH_VALIDATOR"], str(folder), "--verbose"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "ERROR" not in done.stdout
