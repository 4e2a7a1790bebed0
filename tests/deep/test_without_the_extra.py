"""Without the extra: torch is not imported, everything else works, and a deep learner names the missing packages."""

import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import skills
from skills import deep
from skills.cli import app
from skills.deep import NEEDED
from skills.errors import LearningFailed
from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.learning.networks import DDPG
from skills.learning.policy import Policy
from tests.api.conftest import service, still, trained  # noqa: F401 - fixtures
from tests.api.service import KESTREL, Service, assert_problem
from tests.by_day import some
from tests.deep.networks import towards

PROJECT = Path(__file__).parents[2]
HEAVY = re.compile(r"^(torch|triton|nvidia-|cuda-|stable-baselines3|sb3-contrib|gymnasium)")
DEEP = ("dqn", "ddpg", "trpo")
WITHOUT = f"import sys; sys.modules.update(dict.fromkeys({NEEDED}))\n"  # as if they were not installed


@pytest.fixture
def absent(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for name in NEEDED:
        monkeypatch.setitem(sys.modules, name, None)
    return


@pytest.fixture
def trained_by(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Policy]:
    """Return a function that learns with another training process, given as `module:function`."""
    monkeypatch.setattr(deep, "require_installed", lambda learner: None)
    path = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (3, 3, 3)), [0, 1, 2])

    def learn(target: str) -> Policy:
        monkeypatch.setattr(deep, "TARGET", target)
        return skills.learn_policy(sparse_reward(path), DDPG(steps=800, width=32, batch=32), 7)

    return learn


def test_a_lesson_goes_to_the_training_process_and_a_network_comes_back(trained_by):
    policy = trained_by("tests.deep.networks:train")
    assert policy.network == towards((0.5, 0.0, 0.0))
    assert policy.training.steps == policy.seed == 7


@pytest.mark.parametrize(
    ("fault", "cause", "advice"),
    some([
        ("crash", "crashed", "SIGSEGV; train again"),
        ("fail", "failed", "code 1; train again, and report it if it happens again"),
        ("garbage", "nonsense", "returned unreadable data; train again"),
        ("a_number", "nonsense", "returned unreadable data; train again"),
    ], 4),
)  # fmt: skip
def test_a_training_process_without_a_network_fails_with_advice(trained_by, fault, cause, advice):
    with pytest.raises(LearningFailed, match=f"^The learning process .*{advice}") as caught:
        trained_by(f"tests.sandbox.faults:{fault}")
    assert caught.value.numbers == {"cause": cause}


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


def test_the_lock_of_the_extra_only_adds_to_the_base_lock():
    pinned = re.compile(r"^([\w.-]+==\S+)", re.MULTILINE)
    base, extra = (
        pinned.findall((PROJECT / name).read_text()) for name in ("requirements.lock", "requirements-deep.lock")
    )
    added = {one.split("==")[0] for one in {*extra} - {*base}}
    assert added >= {"stable-baselines3", "sb3-contrib", "gymnasium"}
    assert added.isdisjoint(one.split("==")[0] for one in base)
    assert "torch" not in added  # its builds have other hashes: the Makefile describes its installation


def test_without_the_extra_tables_are_learnt_and_networks_name_their_needs():
    code = WITHOUT + (
        "import skills\n"
        "path = skills.GridPath(skills.GridWorld((0.0, 0.0, 0.0), 5.0, (3, 3, 3)), [0, 1, 2])\n"
        "reward = skills.sparse_reward(path)\n"
        "print(skills.learn_policy(reward, skills.PhaseQLearning()).replay.states.tolist())\n"
        "try:\n"
        "    skills.learn_policy(reward, skills.DQN())\n"
        "except skills.errors.NotInstalled as refused:\n"
        "    print(refused)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    learnt, refused = done.stdout.splitlines()
    assert learnt == "[0, 1, 2]"
    assert "'dqn' needs torch, stable_baselines3, sb3_contrib, gymnasium" in refused
    assert "make deep" in refused and "suture-skills[deep]" in refused


@pytest.mark.nightly  # by day tests/test_architecture lets skills/deep alone import it
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
        assert problem["type"] == "urn:suture-skills:not-installed"
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
        assert said.exit_code == 1 and "name=value" in said.stderr
    finally:
        settings.cache_clear()
