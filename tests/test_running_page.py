"""The runner of docs/running.md against the service's own `next_step`, on real and synthetic policies."""

import io
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from skills.api.responses import json_of
from skills.arrays import xyz
from skills.formats import read_recording
from skills.gridworld.grid import GridWorld, discretize
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import coverage
from skills.learning.policy import Learner, Policy, learn_tabular, next_step
from skills.learning.q_learning import CellQLearning, PhaseQLearning
from skills.library.policies import answers, learning
from skills.schemas import policy_document
from tests.by_day import some
from tests.formats.bags import sample_folder
from tests.gridworld.paths import WALKS, learnt

PAGE = (Path(__file__).parent.parent / "docs" / "running.md").read_text()
(RUNNER,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
LEARNERS: list[Learner] = [PhaseQLearning(), CellQLearning()]


@cache
def names() -> dict[str, Any]:
    found: dict[str, Any] = {}
    exec(compile(RUNNER, "running.md", "exec"), found)
    return found


@cache
def recorded(cell_mm: float, learner: Learner) -> Policy:
    """Learn the motion of a recorded arm on a grid around it."""
    with (sample_folder() / "old_transform_stamped.mcap").open("rb") as file:
        tip_mm = read_recording(file).motions[0].tip_mm
    low = tip_mm.min(axis=0) - 2 * cell_mm
    x, y, z = (int(n) for n in np.ceil((tip_mm.max(axis=0) - low) / cell_mm) + 3)
    grid = GridWorld(xyz(low), cell_mm, (x, y, z))
    return learn_tabular(sparse_reward(discretize(tip_mm, grid, 0.25)), learner)


def as_npz(policy: Policy) -> io.BytesIO:
    """Return the service's arrays of a policy."""
    version: Any = SimpleNamespace(sha256="00" * 32, manifest=SimpleNamespace(joining=learning._joining(policy)))
    return io.BytesIO(answers.arrays_of(version))


def as_json(policy: Policy) -> io.StringIO:
    """Return the part of the service's JSON from which a policy runs."""
    grid = policy.path.grid
    about = {
        "joining": learning._joining(policy),
        "grid": {"origin_mm": grid.origin_mm, "cell_mm": grid.cell_mm, "shape": grid.shape},
        "waypoints": policy.path.states.tolist(),
        "actions": policy_document.actions_of(policy),
        "live_actions": policy_document.live_actions_of(policy),
    }
    return io.StringIO(json_of(about).decode())


def agrees(runner: Any, policy: Policy, states: NDArray[np.int64]) -> None:
    """Compare a runner with `next_step` in the middle of cells, in every phase."""
    for state in states:
        here = policy.path.grid.centres_mm(state)
        for phase in (None, *range(policy.domain.phases)):
            step = next_step(policy, here, phase)
            assert runner.next(here, phase) == (step.phase, step.action, step.done), (state, phase)


IN_JSON = some(((name, "json") for name in WALKS), 3)
IN_OTHER_FORMS = [  # by day of one walk
    pytest.param(name, form, marks=[pytest.mark.nightly] * (number > 0))
    for number, name in enumerate(WALKS)
    for form in ("live", "npz")
]


@pytest.fixture
def loaded(monkeypatch: pytest.MonkeyPatch) -> Callable[[Policy, str], Any]:
    """Return a function that writes a policy as the service does, and reads it as the page does."""

    def load(policy: Policy, form: str) -> Any:
        monkeypatch.setattr(answers, "learnt", lambda _: policy)
        monkeypatch.setattr(answers, "covered", lambda _: coverage(policy))
        if form == "live":
            monkeypatch.setattr(policy_document, "MAX_JSON_ACTIONS", 0)
        written = as_npz(policy) if form == "npz" else as_json(policy)
        return names()["from_npz" if form == "npz" else "from_json"](written)

    return load


@pytest.mark.parametrize(
    "rule",
    [{}, {"phased": False}, {"join_share": 0.5}, pytest.param({"join_share": 1.0}, marks=pytest.mark.nightly)],
    ids=["phase", "cell", "joining half", "joining the start"],
)
@pytest.mark.parametrize(("name", "form"), [*IN_JSON, *IN_OTHER_FORMS])
def test_the_runner_acts_as_the_service_in_every_state_and_phase(loaded, name, rule, form):
    policy = learnt(name, **rule)
    runner = loaded(policy, form)
    agrees(runner, policy, np.arange(policy.path.grid.n_states))
    outside = policy.path.grid.centres_mm(0) - policy.path.grid.cell_mm
    assert runner.next(outside, 0) == (0, None, False)


@pytest.mark.parametrize("form", [pytest.param("live", marks=pytest.mark.nightly), "npz"])
@pytest.mark.parametrize("learner", LEARNERS, ids=["phase", "cell"])
def test_the_runner_acts_as_the_service_on_a_recording(loaded, learner, form):
    policy = recorded(5.0, learner)
    states = np.random.default_rng(0).choice(policy.path.grid.n_states, 50)
    agrees(loaded(policy, form), policy, np.concatenate((states, policy.path.states[::5])))


@pytest.mark.nightly  # every state and phase, three times
@pytest.mark.parametrize("learner", LEARNERS, ids=["phase", "cell"])
def test_the_runner_acts_as_the_service_everywhere_on_a_recording(loaded, learner):
    policy = recorded(10.0, learner)
    for form in ("json", "live", "npz"):
        agrees(loaded(policy, form), policy, np.arange(policy.path.grid.n_states))


def test_the_json_of_a_large_policy_has_its_live_actions_alone(loaded):
    """A recording of 4.0 million entries, with the limit as it is; the page states these sizes."""
    policy = recorded(2.0, PhaseQLearning())
    domain = policy.domain
    assert domain.phases * policy.path.grid.n_states == 4_012_000 > policy_document.MAX_JSON_ACTIONS
    assert policy_document.actions_of(policy) is None
    live = policy_document.live_actions_of(policy)
    assert live is not None
    assert sum(len(box.actions) for box in live) == domain.n_rows == 64_258
    assert len(json_of(live)) == pytest.approx(0.18e6, rel=0.03)
    rows = np.random.default_rng(0).choice(np.flatnonzero(domain.certified), 200)
    agrees(loaded(policy, "json"), policy, np.unique(domain.state_of[rows])[:20])


def test_the_runner_is_as_long_as_the_page_says():
    lines = [line for line in RUNNER.splitlines() if line.strip()]
    assert len(lines) <= 58
    assert len(lines[lines.index("class Runner:") : lines.index("def from_json(file):")]) <= 38
