"""The cache of compiled loops: concurrent processes, a read-only installation, and no writable folder."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import skills
from tests.waiting import END_S

PROJECT = Path(skills.__file__).parents[1]
NOWHERE = "/dev/null"  # as a folder: nothing can be created in it, not even by root
TELL = """
import hashlib, json
import numpy as np
from skills.learning.certificate import certify
from skills.learning.evaluation import dtw
from skills.gridworld.grid import GridPath, GridWorld
from skills.compiled import LOOPS
from skills.learning.q_learning import CellQLearning, PhaseQLearning
from skills.packing import palette_of
from skills.learning.policy import learn_tabular
from skills.learning.pose_style import PosePath
from skills.learning.pose_step import (Hands, advance, next_pose)
from skills.learning.tube_certificate import (TubeLimits)
from skills.learning.tube import (certify_tube)
from skills.gridworld.reward import RewardLevels, sparse_reward
IN = ("skills.learning", "skills.packing")
loops = {loop.plain.__name__: loop for loop in LOOPS if loop.plain.__module__.startswith(IN)}
path = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (3, 3, 3)), np.array([0, 1, 4, 3, 0, 13, 26]))
def learn(levels=RewardLevels(), **settings):
    policy = learn_tabular(sparse_reward(path, levels), PhaseQLearning(**settings), 3)
    certify(policy)
    palette_of(policy.q)
    return hashlib.sha256(policy.q.tobytes()).hexdigest()
def tell(**more):
    stats = [loop.machine.stats for loop in loops.values()]
    loaded, compiled = (sum(sum(getattr(s, n).values()) for s in stats) for n in ("cache_hits", "cache_misses"))
    print(json.dumps({"kept": stats[0].cache_path, "loaded": loaded, "compiled": compiled, **more}))
"""
LEARN = "tell(learnt=learn())"


def start(code: str, installed: Path = PROJECT, home: str = NOWHERE, **environment: str) -> subprocess.Popen[str]:
    """Run code after `TELL` in a fresh interpreter, with the package of a folder and a home folder."""
    others = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    environment = {**others, "PYTHONPATH": str(installed), "PYTHONSAFEPATH": "1", "HOME": home, **environment}
    return subprocess.Popen(
        [sys.executable, "-c", TELL + code], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def told(process: subprocess.Popen[str]) -> dict:
    """Wait for a process, and return its output."""
    out, err = process.communicate(timeout=END_S)
    assert process.returncode == 0, err
    return {**json.loads(out), "logged": err}


@pytest.fixture(scope="session")
def read_only(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the package in which nothing can be cached, even by root."""
    installed = tmp_path_factory.mktemp("installed")
    shutil.copytree(PROJECT / "skills", installed / "skills", ignore=shutil.ignore_patterns("__pycache__", "*.mcap"))
    for part in ("learning", "formats/mcap"):
        (installed / "skills" / part / "__pycache__").touch()
    return installed


# ---- the place of the cache


@pytest.mark.nightly  # three processes compile everything
def test_three_processes_fill_an_empty_cache_and_a_fourth_loads_it(read_only, tmp_path):
    at_once = [told(p) for p in [start(LEARN, read_only, NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(3)]]
    after = told(start(LEARN, read_only, NUMBA_CACHE_DIR=str(tmp_path)))
    assert len({each["learnt"] for each in [*at_once, after]}) == 1
    assert at_once[0]["compiled"] + at_once[0]["loaded"] == after["loaded"] > 0
    assert after["compiled"] == 0
    assert Path(after["kept"]).parent == tmp_path


@pytest.mark.nightly  # starts two interpreters
def test_a_read_only_installation_uses_the_users_cache_folder_by_default(read_only, tmp_path):
    kept = told(start("tell()", read_only, home=str(tmp_path)))["kept"]
    assert Path(kept).is_relative_to(tmp_path / ".cache" / "numba")


@pytest.mark.nightly  # it compiles everything
def test_without_a_writable_folder_every_process_compiles_and_logs_it(read_only):
    code = "from skills.jobs.warm_up import learn_once, warm_up\nwarm_up(learn_once).join()\n" + LEARN
    alone = told(start(code, read_only))
    assert alone["kept"] is None
    assert (alone["loaded"], alone["compiled"] > 0) == (0, True)
    assert alone["learnt"] == told(start(LEARN))["learnt"]
    assert "every process compiles them again; set NUMBA_CACHE_DIR" in alone["logged"]


@pytest.mark.nightly  # it compiles
def test_every_loop_compiles_one_signature_for_all_number_types():
    # Two processes that compile a loop for two signatures at once can store one's code under the other's name: numba
    # gives both files the same name. This once made a process learn with alpha 0 for 0.5, and report that as settled.
    code = """
whole, costly = RewardLevels(10, 1, 0, -1), RewardLevels(0, -1, -2, -2)
learn(), learn(alpha=1, gamma=0.5), learn(whole, slip=0), learn(RewardLevels(10, 1.5, 0, -1), alpha=0.5)
few = CellQLearning(episodes=5)
cells = few, PhaseQLearning(gamma=1e-305), CellQLearning(episodes=5, gamma=1e-305), CellQLearning.published()
cells += (CellQLearning(episodes=5, alpha=1, epsilon_start=0),)
for levels, cell in [(whole, cell) for cell in cells] + [(costly, CellQLearning(gamma=1))]:
    certify(learn_tabular(sparse_reward(path, levels), cell))
dtw(path.tip_mm, path.tip_mm), dtw(path.tip_mm[::-1], path.tip_mm.astype(int).tolist()[1:])
unaligned = np.frombuffer(bytes(17), np.float64, offset=1)
palette_of(np.zeros((2, 3))), palette_of(np.zeros((2, 3)).T), palette_of(unaligned), palette_of(np.zeros(0))
pose, still = [0, 0, 0, 1], np.zeros(2)
along, far = PosePath(np.eye(2, 3), np.tile(pose, (2, 1)), [0, 1], None, still, still), TubeLimits(3, 1, 0, 0, 9, 1)
next_pose(along, [0, 0, 5], pose, None, far), next_pose(along, np.eye(3)[0], pose, np.int32(1), TubeLimits())
certify_tube(along, far), advance(along, Hands(np.zeros((3, 4)).T, np.eye(4).T, np.zeros(4, np.int32)), far)
tell(signatures={name: len(loop.machine.signatures) for name, loop in loops.items()})"""
    signatures = told(start(code))["signatures"]
    assert signatures == dict.fromkeys(signatures, 1)
