"""Compiled loops before the first job, from a cache folder of the user."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from skills.compiled import cache_folders, check_cache_folder, is_cached
from skills.errors import BadSettings
from tests.api.processes import free_port
from tests.learning.test_kernel_cache import start, told
from tests.waiting import END_S

WARM = """
from threading import enumerate as threads
from skills.jobs.warm_up import TWO_POSES, align_once, learn_once, warm_up
from skills.packing import palette_of
def finish():
    [thread.join() for thread in threads() if thread.name == "warm-up"]
def touched():
    return {name: len(loop.machine.signatures) for name, loop in loops.items()}
"""


@pytest.mark.nightly  # slow if it fails, not wrong
def test_a_worker_warms_up_first_so_its_job_loads_and_compiles_nothing():
    code = "from skills.jobs.worker import _library\n_library()\nfinish()\nwarm = touched()\nlearn()\n"
    each = told(start(WARM + code + "dtw(path.tip_mm, path.tip_mm[::-1])\ntell(warm=warm, after=touched())"))
    assert each["warm"] == each["after"]
    assert sum(each["after"].values()) >= 3


@pytest.mark.nightly  # slow if it fails, not wrong
def test_a_server_warms_up_what_a_rollout_calls():
    asked = "dtw(path.tip_mm, path.tip_mm[::-1])\npalette_of(path.tip_mm)\n"
    asked += "next_pose(TWO_POSES, TWO_POSES.tip_mm[1], TWO_POSES.rotation_xyzw[0], None, TubeLimits())\n"
    code = f"warm_up(align_once).join()\nwarm = touched()\n{asked}"
    each = told(start(WARM + code + "tell(warm=warm, after=touched())"))
    assert each["warm"] == each["after"]
    assert sum(each["after"].values()) == 4


@pytest.mark.nightly  # it compiles everything
def test_what_a_power_cut_left_half_written_is_made_anew(tmp_path):
    tmp_path.chmod(0o700)
    code = WARM + "warm_up(align_once).join()\ntell(aligned=dtw(path.tip_mm, path.tip_mm[::-1]).total_mm)"
    whole = told(start(code, NUMBA_CACHE_DIR=str(tmp_path)))
    (kept,) = tmp_path.rglob("*warp*.nbc")
    os.truncate(kept, 100)
    mended, after = (told(start(code, NUMBA_CACHE_DIR=str(tmp_path))) for _ in range(2))
    assert whole["aligned"] == mended["aligned"] == after["aligned"] > 0
    assert "cannot be loaded; they are compiled again" in mended["logged"]
    assert (mended["compiled"], after["compiled"], after["loaded"], after["logged"]) == (4, 0, 4, "")


# ---- folders that others can write to


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder two levels down that only this user can write to, wherever the tests run."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    folder = tmp_path / "cache" / "learning"
    folder.mkdir(parents=True)
    for part in (folder, *folder.parents[:2]):
        part.chmod(0o700)
    return folder


def test_a_folder_of_ones_own_is_taken_and_so_is_the_one_beside_the_code(folder):
    check_cache_folder(folder)
    for each in cache_folders():
        check_cache_folder(each)


def test_whether_loops_were_compiled_before_is_known_from_their_files(folder, monkeypatch):
    monkeypatch.setattr("skills.compiled.cache_folders", lambda: {folder, None})
    assert not is_cached()
    (folder / "loops.sweep-1.py311.nbi").touch()
    assert is_cached()


@pytest.mark.parametrize("mode", [0o777, 0o775, 0o1777, 0o702], ids=oct)
def test_a_folder_that_others_can_write_to_is_refused(folder, mode):
    folder.chmod(mode)
    with pytest.raises(BadSettings, match=rf"other users can write to {folder}: set NUMBA_CACHE_DIR"):
        check_cache_folder(folder)


def test_a_folder_in_a_world_writable_parent_is_refused_unless_sticky(folder):
    folder.parent.chmod(0o777)
    with pytest.raises(BadSettings, match=f"other users can write to {folder.parent}:"):
        check_cache_folder(folder)
    folder.parent.chmod(0o1777)
    check_cache_folder(folder)


@pytest.mark.skipif(os.geteuid() != 0, reason="a folder of another user: only root can make one")
def test_another_users_folder_is_refused(folder):
    os.chown(folder, 12345, -1)
    with pytest.raises(BadSettings, match="other users can write"):
        check_cache_folder(folder)


def test_a_named_cache_folder_that_is_not_writable_is_refused(folder, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/dev/null/cache")
    for kept in (folder, None):
        with pytest.raises(BadSettings, match="NUMBA_CACHE_DIR=/dev/null/cache is not writable"):
            check_cache_folder(kept)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder.parent))
    check_cache_folder(folder)


@pytest.mark.nightly  # by day tests/formats/test_confined.py, of the readers
@pytest.mark.parametrize("command", ["serve", "worker"])
def test_no_command_starts_with_a_world_writable_machine_code_cache(tmp_path, command):
    open_to_all = tmp_path / "cache"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    environment = {
        "NUMBA_CACHE_DIR": str(open_to_all),
        "SKILLS_DATABASE_URL": f"sqlite:///{tmp_path / 'skills.sqlite'}",
    }
    run = [sys.executable, "-m", "skills", command]
    refused = subprocess.run(run, env={**os.environ, **environment}, capture_output=True, text=True, timeout=END_S)
    assert refused.returncode == 1
    assert refused.stderr.startswith("Machine code is loaded from")
    assert list(tmp_path.iterdir()) == [open_to_all]


@pytest.mark.nightly  # by day the folder is refused in this process
def test_a_running_server_exits_if_its_compiled_loops_would_be_refused(tmp_path):
    """It does so if the package is read-only and the user's cache folder world-writable, which only numba detects."""
    environment = {"NUMBA_CACHE_DIR": "/dev/null/cache", "SKILLS_DATABASE_URL": f"sqlite:///{tmp_path / 'a.sqlite'}"}
    environment |= {"SKILLS_PORT": str(free_port())}
    run = [sys.executable, "-m", "skills", "serve"]
    ended = subprocess.run(run, env={**os.environ, **environment}, capture_output=True, text=True, timeout=END_S)
    assert ended.returncode == 1
    assert "NUMBA_CACHE_DIR=/dev/null/cache is not writable" in ended.stderr


def test_nowhere_to_keep_them_is_said():
    logged = told(start("from skills.compiled import check_cache_folder\ncheck_cache_folder(None)\ntell()"))["logged"]
    assert (
        "every process compiles them again; set NUMBA_CACHE_DIR to a folder that only this user can write to" in logged
    )
