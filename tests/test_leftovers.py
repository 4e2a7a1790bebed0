"""Leftovers: a run that leaves a process or a file behind fails and names it, and however it ends, nothing remains."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.jobs.test_many_workers import alive
from tests.waiting import until

ROOT = Path(__file__).parents[1]
LEAVES = """
import os, subprocess, sys, tempfile, time
from pathlib import Path

def test_that_leaves_things_behind():
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    process.returncode = 0  # or Python itself complains
    tempfile.mkstemp(prefix="forgotten-")
    Path(os.environ["SAID"]).write_text(f"{process.pid} {os.environ['TESTS_FOLDER']}")
    time.sleep(float(os.environ["SLEEPS_S"]))
"""


def start(folder: Path, sleeps_s: float) -> subprocess.Popen[str]:
    """Start a separate run, of a test that leaves a process and a file behind."""
    (folder / "test_it.py").write_text(LEAVES)
    environment = {**os.environ, "SAID": str(folder / "said"), "SLEEPS_S": str(sleeps_s), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.conftest", "-p", "no:cacheprovider", "test_it.py"]
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True)


def is_gone(folder: Path) -> bool:
    pid, place = (folder / "said").read_text().split()
    return not alive(int(pid)) and not Path(place).exists()


@pytest.mark.nightly  # a run of pytest in a run of pytest
def test_a_run_with_leftovers_fails_and_names_the_test(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("TESTS_GRACE_S", "0.5")
    run = start(tmp_path, 0.0)
    said, _ = run.communicate()
    assert run.returncode == 1, said
    assert "1 passed" in said
    process, file = said.splitlines()[-2:]
    assert process.startswith("LEFT BEHIND - process ")
    assert process.endswith("started by test_it.py::test_that_leaves_things_behind (call)")
    assert file.startswith("LEFT BEHIND - forgotten-")
    assert is_gone(tmp_path)


@pytest.mark.nightly  # a run of pytest in a run of pytest
def test_a_run_that_is_killed_leaves_nothing(tmp_path: Path):
    run = start(tmp_path, 600.0)
    with run:
        until(lambda: (tmp_path / "said").exists() and (tmp_path / "said").read_text())
        run.send_signal(signal.SIGKILL)
    until(lambda: is_gone(tmp_path))
