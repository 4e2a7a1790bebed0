"""A hostile target: every attempt is refused, as root and as an ordinary user; without containment it would succeed."""

import json
import os
import subprocess
import sys
import tempfile
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skills.sandbox.containment import LAYERS, NOBODY
from tests.sandbox.hostile import BY_LAYER, ENDED, REFUSED, ROOT_ONLY, UNTRIED

PROJECT, PACKAGES = Path(__file__).parents[2], Path(np.__file__).parents[1]
ORDINARY_PYTHON = f"/usr/bin/python3.{sys.version_info.minor}"


@cache
def attack(user: int, *layers: str) -> dict[str, Any]:
    """Make every attempt in a process of a user, and return what came of it; skip where no such process is possible."""
    command = [sys.executable, "-m", "tests.sandbox.hostile", *layers]
    how: dict[str, Any] = {}
    if user != os.geteuid():
        if os.geteuid() != 0:
            pytest.skip(f"NOT TRIED as user {user}: only root can start its process.")
        how = {"user": user, "group": user, "extra_groups": ()}
        command[0] = next((one for one in (sys.executable, ORDINARY_PYTHON) if _runs(one, how)), "")
        if not command[0]:
            pytest.skip(f"NOT TRIED as user {user}: it can run neither {sys.executable} nor {ORDINARY_PYTHON}.")
    with tempfile.TemporaryDirectory() as folder:
        os.chown(folder, user, user)
        environment = {"TMPDIR": folder, "PATH": os.defpath, "PYTHONPATH": f"{PROJECT}{os.pathsep}{PACKAGES}"}
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        done = subprocess.run(command, cwd=PROJECT, env=environment, stdout=subprocess.PIPE, check=True, **how)
    came: dict[str, Any] = json.loads(done.stdout)
    return came


def _runs(python: str, how: dict[str, Any]) -> bool:
    try:
        return subprocess.run([python, "-c", ""], **how, check=False, stderr=subprocess.DEVNULL).returncode == 0
    except OSError:
        return False


def check(came: dict[str, Any]) -> None:
    """Check every line; warn of those that this system leaves open because it does not offer their layer."""
    missing = [name for name in LAYERS if name not in came["layers"]]
    opened = sorted(name for name, error in came["contained"].items() if not error)
    excused = {name for name, layer in BY_LAYER.items() if layer in missing}
    if missing:
        warnings.warn(UserWarning(f"This system does not offer {missing}; not refused: {opened}"), stacklevel=2)
    assert set(opened) <= excused, came["contained"]
    assert came["contained"].keys() == {*REFUSED, *ENDED}
    assert all(came["contained"][name].startswith("contained") for name in ENDED)


@pytest.mark.parametrize("user", sorted({0, NOBODY, os.geteuid()}), ids=lambda user: f"user{user}")
def test_a_hostile_reader_is_refused_every_attempt(user):
    if user == 0 != os.geteuid():
        pytest.skip("NOT TRIED as root: the tests do not run as root.")
    came = attack(user)
    assert came["uid"] == user
    check(came)
    free = {name for name, error in came["free"].items() if not error}
    possible = {*REFUSED, *ENDED} - UNTRIED - (ROOT_ONLY if user else set())
    assert free >= possible, {name: came["free"][name] for name in possible - free}


@pytest.mark.parametrize(
    "missing", [{"own network", "own files"}, {"file rights", "signals"}], ids=["spaces", "Landlock"]
)
@pytest.mark.filterwarnings("ignore:This system does not offer")
def test_without_some_layers_the_others_still_refuse(missing):
    user = NOBODY if os.geteuid() == 0 else os.geteuid()
    offered = attack(user)["layers"]
    came = attack(user, *(name for name in offered if name not in missing))
    assert not missing & set(came["layers"])
    check(came)
