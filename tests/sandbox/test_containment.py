"""Layers: what is found out is demanded of every later process, and what is missing is told, or refused."""

import json
import logging
import os
import subprocess
import sys
import tempfile
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner

from skills import serving
from skills.cli import app
from skills.errors import BadSettings, Busy
from skills.jobs.worker import run_worker
from skills.library.recordings.recordings import confined_reader
from skills.sandbox import forked
from skills.sandbox.containment import LAYERS
from skills.sandbox.forked import ForkServer, layers_held, refuse_uncontained
from skills.settings import Settings, settings
from tests.sandbox.test_forked import LIMITS

PROJECT = Path(__file__).parents[2]
TAKEN_AWAY = {"own network", "own files", "own user"}


@pytest.fixture
def some_layers(monkeypatch):
    """Let every server have those layers alone that this system offers, without three."""
    some = tuple(name for name in layers_held() if name not in TAKEN_AWAY)
    monkeypatch.setattr(forked, "_layers", some)
    return some


def test_each_layer_is_attempted_once_and_in_order():
    assert list(layers_held()) == [name for name in LAYERS if name in layers_held()]
    assert {"no new privileges", "not dumpable", "no capabilities"} <= set(layers_held())


def test_a_layer_that_is_not_entered_is_not_said_to_hold(tmp_path):
    """Each in turn is replaced by one that does nothing; another one may close the same."""
    code = (
        "import json, sys; from skills.sandbox import containment as c; "
        "place = c.Allowance(sys.argv[1], tuple(c.code_folders())); held = {}\n"
        "for name, layer in list(c._LAYERS.items()):\n"
        "    c._LAYERS[name] = layer._replace(apply=lambda place: None)\n"
        "    held[name] = c.offered(place)\n"
        "    c._LAYERS[name] = layer\n"
        "print(json.dumps(held))"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path], cwd=PROJECT, stdout=subprocess.PIPE, check=True)
    by_another = {"no capabilities", "not dumpable"} if os.geteuid() == 0 else {"own user"}  # another user has neither
    held = json.loads(done.stdout)
    assert held.keys() == LAYERS.keys()
    assert {name for name in held if name in held[name]} <= by_another


def test_missing_layers_are_refused_by_name_if_all_are_required(some_layers):
    with pytest.raises(BadSettings, match=r"own network \(needs network and IPC namespaces.*own files.*own user"):
        refuse_uncontained()
    with pytest.raises(BadSettings):
        confined_reader(Settings(containment="required"))
    confined_reader(Settings())


def test_no_service_and_no_worker_starts_without_a_required_layer(some_layers, tmp_path, monkeypatch):
    wanted = Settings(containment="required", database_url=f"sqlite:///{tmp_path}/skills.sqlite", port=0)
    monkeypatch.setattr(serving.logs, "configure", lambda *how, **more: None)
    for start in (serving.serve, run_worker):
        with pytest.raises(BadSettings, match="SKILLS_CONTAINMENT=required"):
            start(wanted)
    assert not list(tmp_path.iterdir())


def test_the_doctor_names_a_missing_layers_need_and_fails_if_required(some_layers, monkeypatch):
    for mode, state in (("available", "missing"), ("required", "failed")):
        monkeypatch.setenv("SKILLS_CONTAINMENT", mode)
        settings.cache_clear()
        done = CliRunner().invoke(app, ["doctor", "--json"])
        _, *layers = json.loads(done.stdout)
        assert {one["check"].removeprefix("containment: "): one["state"] for one in layers} == {
            name: "ok" if name in some_layers else state for name in LAYERS
        }
        assert layers[0]["remark"] == f"needs {LAYERS['own network']}"
    assert done.exit_code == 1
    settings.cache_clear()


def test_missing_layers_are_logged_by_the_first_process_alone(monkeypatch, caplog):
    monkeypatch.setattr(forked, "_layers", None)
    monkeypatch.setattr(forked.log, "disabled", False)
    monkeypatch.setitem(LAYERS, "a layer of the future", "Linux 9")
    with caplog.at_level(logging.WARNING):
        layers_held()
        layers_held()
    assert [record.getMessage().count("a layer of the future") for record in caplog.records] == [1]


def test_a_server_that_cannot_enter_a_demanded_layer_calls_nothing(monkeypatch):
    filtered = (  # a process whose kernel refuses namespaces
        "from skills.sandbox import containment as c; place = c.Allowance('/', ()); "
        "c._no_new_privileges(place); c._system_calls(place); "
    )
    monkeypatch.setattr(forked, "_layers", ("own network",))
    monkeypatch.setattr(forked, "_ENTRY", filtered + forked._ENTRY)
    with (
        closing(ForkServer()) as server,
        tempfile.TemporaryFile() as given,
        pytest.raises(Busy, match="ends repeatedly"),
    ):
        server.call("tests.sandbox.faults:a_number", given, returns=(int,), classes={}, limits=LIMITS)


def test_without_namespaces_the_first_server_finds_the_other_layers(monkeypatch):
    unable = "from skills.sandbox import containment as c; c._libc.unshare = lambda flags: c._libc.setns(-1, 0); "
    monkeypatch.setattr(forked, "_layers", None)
    monkeypatch.setattr(forked, "_ENTRY", unable + forked._ENTRY)
    held = layers_held()
    assert {"own network", "own files"}.isdisjoint(held)
    assert {"no capabilities", "no new privileges", "not dumpable"} <= set(held)


def test_the_layers_of_a_server_are_those_demanded(some_layers):
    with (
        closing(ForkServer("tests.sandbox.faults")) as server,
        tempfile.TemporaryFile() as given,
        server.run("tests.sandbox.faults:surroundings", given, {}, LIMITS) as answer,
    ):
        assert json.load(answer)["threads"] == 1
    assert forked._layers == some_layers
