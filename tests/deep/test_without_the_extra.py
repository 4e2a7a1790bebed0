"""Without the extra: no torch comes along, everything else works, and a deep learner says what to install."""

import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from skills.cli import app
from skills.deep.learning import NEEDED
from tests.api.conftest import service, still, trained  # noqa: F401 - fixtures
from tests.api.service import KESTREL, Service, assert_problem

PROJECT = Path(__file__).parents[2]
HEAVY = re.compile(r"^(torch|triton|nvidia-|cuda-|stable-baselines3|sb3-contrib|gymnasium)")
DEEP = ("dqn", "ddpg", "trpo")
WITHOUT = f"import sys; sys.modules.update(dict.fromkeys({NEEDED}))\n"  # as if they were not installed


@pytest.fixture
def absent(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for name in NEEDED:
        monkeypatch.setitem(sys.modules, name, None)
    return


def names_in(lock: str) -> list[str]:
    return re.findall(r"^([\w.-]+)==", (PROJECT / lock).read_text(), re.MULTILINE)


def test_what_is_installed_by_default_has_no_torch_in_it():
    assert "safetensors" in names_in("requirements.lock")
    assert [name for name in names_in("requirements.lock") if HEAVY.match(name)] == []
    asked = tomllib.loads((PROJECT / "pyproject.toml").read_text())
    assert [name for name in asked["project"]["dependencies"] if HEAVY.match(name)] == []
    assert {re.match(r"[\w-]+", name)[0] for name in asked["project"]["optional-dependencies"]["deep"]} == {
        "torch", "stable-baselines3", "sb3-contrib", "gymnasium",
    }  # fmt: skip


def test_the_lock_of_the_extra_adds_to_the_other_and_contradicts_it_nowhere():
    pinned = re.compile(r"^([\w.-]+==\S+)", re.MULTILINE)
    base, extra = (
        pinned.findall((PROJECT / name).read_text()) for name in ("requirements.lock", "requirements-deep.lock")
    )
    added = {one.split("==")[0] for one in {*extra} - {*base}}
    assert added >= {"stable-baselines3", "sb3-contrib", "gymnasium"}
    assert added.isdisjoint(one.split("==")[0] for one in base)
    assert "torch" not in added  # its builds have other hashes: the Makefile says how it is taken


def test_a_fresh_process_learns_with_the_table_and_says_what_a_network_needs():
    code = WITHOUT + (
        "import skills\n"
        "path = skills.GridPath(skills.GridWorld((0.0, 0.0, 0.0), 5.0, (3, 3, 3)), [0, 1, 2])\n"
        "reward = skills.sparse_reward(path)\n"
        "print(skills.learn_policy(reward, skills.PhaseQLearning()).replay.states.tolist())\n"
        "try:\n"
        "    skills.learn_policy(reward, skills.DQN())\n"
        "except skills.errors.LearnerNotInstalled as refused:\n"
        "    print(refused)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    learnt, refused = done.stdout.splitlines()
    assert learnt == "[0, 1, 2]"
    assert "'dqn' needs torch, stable_baselines3, sb3_contrib, gymnasium" in refused
    assert "make deep" in refused and "suture-skills[deep]" in refused


def test_neither_the_service_nor_a_worker_nor_the_client_loads_torch():
    code = (
        "import sys, skills.api.app, skills.library, skills.jobs.worker, skills.client, skills.deep\n"
        f"print([name for name in {NEEDED} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.usefixtures("absent")
@pytest.mark.parametrize("kind", DEEP)
def test_the_service_refuses_it_before_there_is_a_job(still: Service, kind: str):  # noqa: F811
    before = still.counts()["jobs"]
    for call, body in (("/trainings", KESTREL), ("/retrainings", {})):
        problem = assert_problem(still.http.post(call, json={**body, "learner": {"kind": kind}}), 409)
        assert problem["type"] == "urn:suture-skills:learner-not-installed"
        assert "Install the extra 'deep'" in problem["detail"] and kind in problem["detail"]
        assert problem["numbers"]["missing"] == [*NEEDED]
    assert still.counts()["jobs"] == before


@pytest.mark.parametrize("kind", DEEP)
def test_settings_that_cannot_be_meant_are_refused_as_any_others(still: Service, kind: str):  # noqa: F811
    for setting in ({"steps": 0}, {"steps": 1.5}, {"width": 10**6}, {"learning_rate": "high"}, {"no_such": 1}):
        answer = still.http.post("/trainings", json={**KESTREL, "learner": {"kind": kind, **setting}})
        assert_problem(answer, 422)


@pytest.mark.usefixtures("absent")
def test_the_command_line_says_it_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from typer.testing import CliRunner

    from skills.settings import settings

    monkeypatch.setenv("SKILLS_DATABASE_URL", f"sqlite:///{tmp_path / 'skills.sqlite'}")
    settings.cache_clear()
    try:
        assert CliRunner().invoke(app, ["migrate"]).exit_code == 0
        said = CliRunner().invoke(app, ["train", "kestrel", "simple-running", "--learner", "ddpg"])
        assert said.exit_code == 1
        assert "Install the extra 'deep'" in said.stderr
        said = CliRunner().invoke(app, ["train", "kestrel", "simple-running", "--setting", "steps=5"])
        assert said.exit_code == 1 and "--learner dqn" in said.stderr
        said = CliRunner().invoke(app, ["train", "kestrel", "simple-running", "--learner", "dqn", "--setting", "steps"])
        assert said.exit_code == 1 and "name=number" in said.stderr
    finally:
        settings.cache_clear()
