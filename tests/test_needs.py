"""A fresh machine: missing needs are skipped and named, or fail if required; a missing Python gives a sentence."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.needs import NEEDS, need, required

ROOT = Path(__file__).parents[1]
OF_THE_PAGE = "tests/e2e/test_page.py::test_everything_is_reached_with_the_keyboard_and_the_focus_is_seen"


@pytest.mark.parametrize("name", NEEDS)
def test_a_missing_need_skips_with_its_remedy_and_fails_if_required(name: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(NEEDS, name, type(NEEDS[name])(NEEDS[name].missing, NEEDS[name].remedy, lambda: None))
    monkeypatch.delenv("TESTS_REQUIRE", raising=False)
    with pytest.raises(pytest.skip.Exception, match="not here: ") as skipped:
        need(name)
    assert NEEDS[name].remedy in str(skipped.value)
    monkeypatch.setenv("TESTS_REQUIRE", f"{name},recordings")
    with pytest.raises(pytest.fail.Exception, match="so this is a failure and no skip"):
        need(name)


def test_a_need_that_does_not_exist_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("TESTS_REQUIRE", "browser, chrome")
    with pytest.raises(pytest.UsageError, match="names chrome; there are browser, recordings"):
        required()


@pytest.mark.nightly  # runs of pytest in a run of pytest
@pytest.mark.parametrize(("require", "code"), [("", 0), ("browser", 1)])
def test_without_a_browser_the_last_line_says_how_to_get_it_and_ci_fails(require: str, code: int):
    environment = {**os.environ, "PATH": "/nowhere", "TESTS_REQUIRE": require}
    command = [sys.executable, "-m", "pytest", "-n", "0", OF_THE_PAGE]
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert run.returncode == code, run.stdout + run.stderr
    if require:
        assert "the page's browser is not here: apt-get install chromium" in run.stdout
    else:
        assert run.stdout.splitlines()[-1] == "1 NOT TESTED - the page's browser is not here: apt-get install chromium"


def test_make_without_python_says_what_to_install(tmp_path: Path):
    make = shutil.which("make")
    words = [f"PATH={tmp_path}", f"VENV={tmp_path}/venv", "PYTHON=python3.none"]
    run = subprocess.run([make, "--no-print-directory", "demo", *words], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 2
    assert run.stderr.startswith('Python 3.11 was not found as "python3.none". Install it (Debian: apt-get install')
    assert not (tmp_path / "venv").exists()
