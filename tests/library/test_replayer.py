"""The README of a replay bag, followed literally: its commands hand the needle over on a stand-in for the bus.

By day a short replayer of ours plays a pass; at night the laboratory's own script plays two, unmodified, in real time.
Who runs it fetches jhu-dvrk/dvrk_python, and names its folder in SKILLS_TEST_DVRK_PYTHON.
"""

import io
import json
import math
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skills.db.session import Database
from skills.formats.bag_folder import METADATA
from skills.library.plans.plans import plan_sutures
from skills.library.plans.replay import replay_bag
from skills.planning.handoff import JAW_CLOSED_RAD, JAW_OPEN_RAD
from skills.schemas.plans import PlanIn
from tests.formats.test_replay import by_rosbags
from tests.library import cases
from tests.library.test_replay import OF_A1_ALONE, judged

STAND_IN = Path(__file__).parents[1] / "formats" / "bus_stand_in"
LABORATORY = Path(os.environ.get("SKILLS_TEST_DVRK_PYTHON", "")) / "scripts" / "dvrk_bag_replay.py"
ASKS = b'-> Press "Enter"'
COMMAND = re.compile(r"^   ((?:tee|ros2) .*)$", re.MULTILINE)
TAKEN, LET_GO = ("PSM2", JAW_CLOSED_RAD), ("PSM1", JAW_OPEN_RAD)
APART_S = 0.1  # two programs that begin with the same Enter
SCRIPTS = [
    pytest.param(STAND_IN / "replayer.py", 1, 0.02, id="ours"),
    pytest.param(LABORATORY, 2, 1.0, id="the laboratory's", marks=pytest.mark.nightly),
]


def bag_of(database: Database, to: Path, passes: int) -> Path:
    """Unpack the bag of a plan with a hand-over in each pass."""
    cases.trained(database, release=True)
    half = math.radians(45) / 2
    base = {"position_mm": (160.0, 20.0, 20.0), "rotation_xyzw": (0.0, 0.0, math.sin(half), math.cos(half))}
    points = [{"position_mm": (5.0 + 3.0 * number, 55.0, -125.0)} for number in range(passes)]
    asked: dict[str, Any] = {"surgeon": "kestrel", "suture": cases.SUTURE, "suture_points": points, "tissue_mm": -170.0}
    asked |= {"psm_m": {"approach": (-0.94, 0.10, -0.33), "base": base}, "speed_mm_s": 60.0, "rate_hz": 100.0}
    plan, _ = plan_sutures(database, PlanIn(**asked), "test")
    judged(database, plan)
    with zipfile.ZipFile(io.BytesIO(replay_bag(database, plan.sha256, OF_A1_ALONE))) as archive:
        archive.extractall(to)
    return to


def follow(command: str, bag: Path, surroundings: dict[str, str]) -> None:
    """Run a command of the README, and press Enter twice, each time once all of its scripts ask."""
    pipe = subprocess.PIPE
    shell = ["bash", "-c", command]
    with subprocess.Popen(shell, cwd=bag, env=surroundings, stdin=pipe, stdout=pipe, stderr=subprocess.STDOUT) as done:
        assert done.stdin is not None and done.stdout is not None
        said = b""
        for asked in (1, 2):
            while said.count(ASKS) < asked * command.count("dvrk_bag_replay.py"):
                new = os.read(done.stdout.fileno(), 4096)
                assert new, said.decode()
                said += new
            done.stdin.write(b"\n")
            done.stdin.flush()
        done.stdin.close()
        said += done.stdout.read()
    assert done.returncode == 0, said.decode()


def on(bus: Path) -> Iterator[dict[str, Any]]:
    return map(json.loads, bus.read_text().splitlines())


@pytest.mark.parametrize(("script", "passes", "sleep"), SCRIPTS)
def test_the_readme_followed_literally_hands_the_needle_over(
    database: Database, tmp_path: Path, script: Path, passes: int, sleep: float
):
    if not script.is_file():
        pytest.skip("SKILLS_TEST_DVRK_PYTHON names no clone of jhu-dvrk/dvrk_python")
    bag = bag_of(database, tmp_path / "bag", passes)
    ros2, bus = tmp_path / "ros2", tmp_path / "bus"
    ros2.write_text(f'#!/bin/sh\n[ "$1 $2 $3" = "run dvrk_python dvrk_bag_replay.py" ] && shift 3 && '
                    f'exec {sys.executable} {script} "$@"\n')  # fmt: skip
    ros2.chmod(0o700)
    surroundings = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHONPATH": str(STAND_IN)}
    surroundings |= {"BUS": str(bus), "SLEEP": str(sleep)}
    index = json.loads((bag / "segments.json").read_text())["segments"]
    commands = COMMAND.findall((bag / "README.txt").read_text())
    for command in commands:
        follow(command, bag, surroundings)

    played = list(on(bus))
    began_s: dict[str, list[float]] = {}
    for arm in ("PSM1", "PSM2"):
        names = [one["name"] for one in index if (bag / one["name"] / arm / METADATA).exists()]
        for device in (f"/{arm}", f"/{arm}/jaw"):
            read = [
                [said for on, said in by_rosbags(bag / name / arm) if on == f"{device}/setpoint_js"] for name in names
            ]
            commands = [one for one in played if one["topic"] == f"{device}/servo_jp"]
            meant = [(list(said.position), list(said.velocity)) for one in read for said in one]
            assert [(one["position"], one["velocity"]) for one in commands] == meant
            starts, ends = ([list(one[end].position) for one in read] for end in (0, -1))
            assert [one["position"] for one in played if one["topic"] == f"{device}/move_jp"] == starts
            if device == f"/{arm}":  # each segment begins where the one before ended; jaws are changed by hand too
                np.testing.assert_allclose(starts[1:], ends[:-1], atol=1e-9)
                first = np.cumsum([0, *map(len, read)])[:-1]
                for name, at in zip(names, first.tolist(), strict=True):
                    began_s.setdefault(name, []).append(commands[at]["at_s"])
    # In every hand-over PSM2 has closed before PSM1 opens.
    ends, before = [], {"PSM1": JAW_CLOSED_RAD, "PSM2": JAW_OPEN_RAD}
    for arm, at in ((one["topic"][1:5], one["position"][0]) for one in played if one["topic"].endswith("jaw/servo_jp")):
        ends += [(arm, at)] if before[arm] != at and (arm, at) in (TAKEN, LET_GO) else []
        before[arm] = at
    assert ends == [TAKEN, LET_GO] * passes
    together = {one["name"] for one in index if one["kind"] in ("A2", "transfer")}
    assert {name for name, at_s in began_s.items() if len(at_s) == 2} >= together
    if sleep == 1.0:
        assert max(np.ptp(began_s[name]) for name in together) <= APART_S
