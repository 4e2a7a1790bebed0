"""A hostile target: every attempt is refused, as root and as an ordinary user; without containment it would succeed."""

import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections import defaultdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skills.sandbox.containment import LAYERS, NOBODY
from tests.sandbox.hostile import CALLS, ENDED, REFUSED

PROJECT, PACKAGES = Path(__file__).parents[2], Path(np.__file__).parents[1]
ATTEMPTS = REFUSED | ENDED
# Further attempts that a layer refuses to an ordinary user alone, or where namespaces come with a user namespace.
_TRACED = {
    "read the environment of a process",
    "read the environment of its parent",
    "attach to a process",
    "read a process's memory",
}
BY_THE_WAY = defaultdict(set, {"own network": _TRACED, "own files": _TRACED, "signals": _TRACED})
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
    """Check every line; tell those that stay open because this system offers none of the layers that close them."""
    held = set(came["layers"])
    opened = {name for name, error in came["contained"].items() if not error}
    excused = {name for name, one in ATTEMPTS.items() if one.closed_by and held.isdisjoint(one.closed_by)}
    if missing := [name for name in LAYERS if name not in held]:
        told = f"Without {', '.join(missing)}, user {came['uid']} was not refused: {', '.join(sorted(opened)) or '-'}."
        warnings.warn(UserWarning(told), stacklevel=2)
    assert came["contained"].keys() == ATTEMPTS.keys()
    assert opened <= excused, sorted(opened - excused)
    if CALLS in held:
        assert all(came["contained"][name].startswith("contained") for name in ENDED)


@pytest.mark.parametrize("user", sorted({0, NOBODY, os.geteuid()}), ids=lambda user: f"user{user}")
@pytest.mark.filterwarnings("default:Without")
def test_a_hostile_reader_is_refused_every_attempt(user):
    if user == 0 != os.geteuid():
        pytest.skip("NOT TRIED as root: the tests do not run as root.")
    came = attack(user)
    assert came["uid"] == user
    check(came)
    free = {name for name, error in came["free"].items() if not error}
    possible = {name for name, one in ATTEMPTS.items() if one.everywhere and (user == 0 or one.ordinary)}
    assert free >= possible, {name: came["free"][name] for name in possible - free}


def test_the_table_in_the_documentation_has_every_attempt_with_its_layers():
    written = {}
    text = (PROJECT / "docs" / "operating.md").read_text()
    for row in text.partition("| layers | attempts |\n|---|---|\n")[2].partition("\n\n")[0].splitlines():
        _, layers, attempts, _ = (cell.strip() for cell in row.split("|"))
        named = frozenset(() if layers.startswith("none") else layers.split("; "))
        written |= dict.fromkeys(attempts.split("; "), named)
    assert written == {name: one.closed_by for name, one in ATTEMPTS.items()}
    assert f"All\n{len(ATTEMPTS)} were refused" in text


def ordinary() -> int:
    return NOBODY if os.geteuid() == 0 else os.geteuid()


@pytest.mark.nightly  # by day with every layer
@pytest.mark.parametrize(
    "missing", [{"own network", "own files"}, {"file rights", "signals"}], ids=["spaces", "Landlock"]
)
@pytest.mark.filterwarnings("ignore:Without")
def test_without_some_layers_the_others_still_refuse(missing):
    offered = attack(ordinary())["layers"]
    came = attack(ordinary(), *(name for name in offered if name not in missing))
    assert not missing & set(came["layers"])
    check(came)


@pytest.mark.nightly
@pytest.mark.parametrize("layer", sorted({name for one in ATTEMPTS.values() for name in one.closed_by}))
def test_a_layer_alone_refuses_what_it_closes_and_nothing_else(layer):
    """The table of `hostile` and of docs/operating.md, measured; ordinary users need the one of no new privileges."""
    if layer not in attack(ordinary())["layers"]:
        pytest.skip(f"NOT TRIED: this system does not offer {layer}.")
    alone, none = (attack(ordinary(), "no new privileges", *more)["contained"] for more in ((layer,), ()))
    closes = {name for name, one in ATTEMPTS.items() if layer in one.closed_by}
    assert all(alone[name] for name in closes)
    assert {name for name in ATTEMPTS if alone[name] and not none[name]} - closes <= BY_THE_WAY[layer]
