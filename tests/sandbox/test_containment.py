"""Layers: what is found out is demanded of every later process, and what is missing is told, or refused."""

import json
import logging
import tempfile
from contextlib import closing

import pytest
from typer.testing import CliRunner

from skills.cli import app
from skills.errors import BadSettings, Busy
from skills.library.recordings import confined_reader
from skills.sandbox import forked
from skills.sandbox.containment import LAYERS
from skills.sandbox.forked import ForkServer, layers_held, refuse_uncontained
from skills.settings import Settings, settings
from tests.sandbox.test_forked import LIMITS

SOME = tuple(name for name in LAYERS if name not in ("own network", "own files", "own user"))


@pytest.fixture
def with_some_layers(monkeypatch):
    monkeypatch.setattr(forked, "_layers", SOME)


def test_each_layer_is_attempted_once_and_in_order():
    assert list(layers_held()) == [name for name in LAYERS if name in layers_held()]
    assert {"no new privileges", "not dumpable", "no capabilities", "system calls"} <= set(layers_held())


def test_missing_layers_are_refused_by_name_if_all_are_required(with_some_layers):
    with pytest.raises(BadSettings, match=r"own network \(needs network and IPC namespaces.*own files.*own user"):
        refuse_uncontained()
    with pytest.raises(BadSettings):
        confined_reader(Settings(containment="required"))
    confined_reader(Settings())


def test_the_doctor_names_what_a_missing_layer_needs_and_fails_if_it_is_required(with_some_layers, monkeypatch):
    for mode, state in (("available", "missing"), ("required", "failed")):
        monkeypatch.setenv("SKILLS_CONTAINMENT", mode)
        settings.cache_clear()
        done = CliRunner().invoke(app, ["doctor", "--json"])
        _, *layers = json.loads(done.stdout)
        assert {one["check"].removeprefix("containment: "): one["state"] for one in layers} == {
            name: "ok" if name in SOME else state for name in LAYERS
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
        "from skills.sandbox import containment as c; place = c.Place('/', ()); "
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
    assert {"no capabilities", "no new privileges", "not dumpable", "system calls"} <= set(held)


def test_the_layers_of_a_server_are_those_demanded(with_some_layers):
    server = ForkServer("tests.sandbox.faults")
    with (
        tempfile.TemporaryFile() as given,
        server.run("tests.sandbox.faults:surroundings", given, {}, LIMITS) as answer,
    ):
        assert json.load(answer)["threads"] == 1
    server.close()
    assert forked._layers == SOME
