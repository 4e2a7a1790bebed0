"""Learning in a scene: a case worked by hand, second methods, and planted defects."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skills.errors import BadSettings
from skills.gridworld.domain import Domain
from skills.gridworld.grid import MOVES, GridPath, GridWorld
from skills.gridworld.hazards import SceneCosts, hazards_of
from skills.gridworld.reward import sparse_reward
from skills.gridworld.scene import Box, Scene, Tissue
from skills.gridworld.slip import STEADY, slip_model
from skills.learning.certificate import certify
from skills.learning.dynamic_programming import ValueIteration
from skills.learning.in_scene import certify_in_scene, learn_in_scene, odds_in_scene
from skills.learning.policy import learn_tabular
from skills.learning.q_learning import PhaseQLearning
from skills.learning.slip_runs import FollowPolicy, budget, follows, walk
from tests.by_day import some
from tests.gridworld.paths import WALKS, named_path

FORWARD = 9 * 2 + 3 + 1
ACROSS = int(np.flatnonzero((MOVES == [0, 1, 0]).all(axis=1))[0])


def corridor():
    """Return a path from the second to the third of three cells in a row, of which the first is forbidden."""
    path = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (3, 1, 1)), np.array([1, 2]))
    scene = Scene("base", (Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),))
    return path, hazards_of(scene, path, "base", SceneCosts(touch=40.0, close=0.0))


def room(**costs):
    """Return a path in a room, with a wall across the way to it, and tissue a cell below it."""
    grid = GridWorld((0.0, 0.0, 0.0), 5.0, (7, 6, 4))
    path = GridPath(grid, grid.states_of([[4, 1, 2], [5, 2, 2], [5, 3, 1], [4, 4, 1], [3, 4, 1]]))
    wall = Box((10.0, -3.0, -3.0), (11.0, 17.0, 18.0))  # from the first row of cells on, with a gap at the far side
    scene = Scene("base", (wall,), tissue=Tissue.plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    return path, hazards_of(scene, path, "base", SceneCosts(**costs))


@pytest.mark.parametrize("slip", [0.0, 0.3, 0.8])
def test_odds_and_value_in_a_corridor_are_those_worked_by_hand(slip):
    """Of 27 slips one goes forward and finishes, one goes back and touches, and 25 stay, most of them at a wall."""
    path, hazards = corridor()
    policy = learn_in_scene(sparse_reward(path), ValueIteration(gamma=0.9, slip=slip), hazards)
    row = int(policy.domain.rows_of(1, [1, 0, 0]))
    assert policy.greedy[row] == FORWARD
    again = slip * 25 / 27
    certificate, odds = certify_in_scene(policy, hazards)
    assert odds.finishes[1] == pytest.approx((1 - slip + slip / 27) / (1 - again))
    assert odds.touches[1] == pytest.approx(slip / 27 / (1 - again))
    assert (odds.finishes[[0, 2]].tolist(), odds.touches[[0, 2]].tolist()) == ([0, 1], [1, 0])
    worth = ((1 - slip + slip / 27) * 10 - slip / 27 * 40) / (1 - 0.9 * again)
    assert policy.q[row].max() == pytest.approx(worth)
    assert certificate.every_action_optimal
    assert certificate.starts == 2
    assert certificate.most_touching == odds.touches[1]


@pytest.mark.parametrize("slip", [pytest.param(0.0, marks=pytest.mark.nightly), 0.2])
def test_exact_values_satisfy_bellmans_equation_written_out(slip):
    path, hazards = room(close=0.2, deeper_per_mm=0.03, touch=30.0)
    gamma, domain, grid = 0.9, Domain(path, phased=True), path.grid
    q = learn_in_scene(sparse_reward(path), ValueIteration(gamma, slip=slip), hazards).q
    live = domain.certified & ~domain.terminal & ~hazards.forbidden[domain.state_of]
    rewards = sparse_reward(path).rewards
    for row in np.random.default_rng(0).choice(np.flatnonzero(live), 150):
        phase, here = int(domain.phase_of[row]), domain.cell_of[row]

        def made(action, intended, phase=phase, here=here):
            cell = here + MOVES[action]
            off = not grid.holds(cell)
            if off and not intended:
                return made(13, intended=False)
            state = int(grid.states_of(here if off else cell))
            if hazards.touches[grid.states_of(here), action]:
                return -30.0
            after, done = (phase, False) if off else domain.enter(phase, state)
            pays = rewards[state] if phase == 0 else 10.0 if done else float(after > phase)
            goes_on = not done and bool(domain.holds(after, grid.cells_of(state)))
            later = q[domain.rows_of(after, grid.cells_of(state))].max() if goes_on else 0.0
            return (-1.0 if off else pays) - hazards.cost[state] + gamma * later

        slipped = np.mean([made(action, intended=False) for action in range(27)])
        expected = [(1 - slip) * made(action, intended=True) + slip * slipped for action in range(27)]
        assert q[row] == pytest.approx(expected, abs=1e-9)


def test_the_exact_odds_are_those_of_many_runs():
    path, hazards = room()
    policy = learn_in_scene(sparse_reward(path), ValueIteration(gamma=0.95, slip=0.3), hazards)
    _, odds = certify_in_scene(policy, hazards)
    for start in (path.start, 0 + 3, int(path.grid.states_of([0, 0, 3]))):
        walks = walk(
            FollowPolicy(policy), path, start, slip_model(0.3).draw(runs=4000, moves=300, seed=1), hazards.touches
        )
        assert walks.touched is not None
        assert follows(walks).mean() == pytest.approx(odds.finishes[start], abs=0.035)  # four standard deviations
        assert walks.touched.mean() == pytest.approx(odds.touches[start], abs=0.035)
    assert (odds.finishes + odds.touches <= 1 + 1e-9).all()


def test_without_slips_every_start_goes_round_the_wall_and_finishes():
    path, hazards = room()
    for learner in (ValueIteration(gamma=0.95), PhaseQLearning(gamma=0.95)):
        policy = learn_in_scene(sparse_reward(path), learner, hazards)
        certificate, odds = certify_in_scene(policy, hazards)
        assert certificate.every_action_optimal
        assert (certificate.least_finishing, certificate.most_touching) == (1, 0)
        assert certify(policy)[0].every_action_optimal
        assert not certify(replace(policy, surroundings=None))[0].every_action_optimal  # detours, in the empty world
        behind = int(path.grid.states_of([0, 0, 2]))
        walks = walk(FollowPolicy(policy), path, behind, np.full((50, 1), STEADY, np.int8), hazards.touches)
        assert follows(walks).all()
        assert walks.moves[0] > np.abs(path.cells - [0, 0, 2]).max(axis=1).min() + len(path.states) - 1
        assert odds.finishes[behind] == 1


@pytest.mark.parametrize("slip", [0.0, 0.3])
@pytest.mark.parametrize("name", some(WALKS, 4))
def test_an_empty_scene_changes_nothing_that_is_learnt(name, slip):
    reward = sparse_reward(named_path(name))
    nothing = hazards_of(Scene("base"), reward.path, "base")
    sampled = PhaseQLearning(slip=slip, alpha=0.3 if slip else 1.0, max_sweeps=20)
    assert np.array_equal(learn_in_scene(reward, sampled, nothing).q, learn_tabular(reward, sampled).q)
    exact = ValueIteration(slip=slip)
    expected = learn_tabular(reward, exact).q
    assert learn_in_scene(reward, exact, nothing).q == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_learnt_values_approach_the_exact_ones():
    path, hazards = room(touch=5.0)
    reward = sparse_reward(path)
    exact = learn_in_scene(reward, ValueIteration(gamma=0.95, slip=0.2), hazards)
    live = exact.domain.certified & ~exact.domain.terminal & ~hazards.forbidden[exact.domain.state_of]
    apart = [
        np.abs(learn_in_scene(reward, settings, hazards).q.max(axis=1) - exact.q.max(axis=1))[live].mean()
        for settings in (
            PhaseQLearning(gamma=0.95, slip=0.2, alpha=1.0, max_sweeps=50),
            PhaseQLearning(gamma=0.95, slip=0.2, alpha=0.3, max_sweeps=100),
            PhaseQLearning(gamma=0.95, slip=0.2, alpha=0.02, max_sweeps=600),
        )
    ]
    assert apart == sorted(apart, reverse=True)
    assert apart[-1] < 0.3


def test_a_policy_that_does_not_know_the_wall_fails_and_touches_it():
    path, hazards = room()
    blind = learn_tabular(sparse_reward(path), PhaseQLearning(gamma=0.95))
    certificate, odds = certify_in_scene(blind, hazards)
    assert not certificate.every_action_optimal
    assert odds.touches[path.grid.states_of([0, 0, 2])] == 1
    assert certificate.mean_touching > 0.1


@pytest.mark.parametrize("worse", [STAY := 13, ACROSS])
def test_one_worse_action_is_found(worse):
    path, hazards = room()
    policy = learn_in_scene(sparse_reward(path), ValueIteration(gamma=0.95, slip=0.2), hazards)
    row = int(policy.domain.rows_of(0, [0, 5, 3]))
    q = policy.q.copy()
    assert q[row, worse] < q[row].max() - 1e-6
    q[row, worse] = q.max() + 1
    assert certify_in_scene(policy, hazards)[0].suboptimal == 0
    assert certify_in_scene(replace(policy, q=q), hazards)[0].suboptimal == 1


def test_a_gamma_too_small_beside_the_cost_of_touching_is_refused():
    path, hazards = room(touch=1e6)
    policy = learn_in_scene(sparse_reward(path), ValueIteration(gamma=0.001), hazards)
    with pytest.raises(BadSettings, match=r"With gamma 0.001 the values of \d+ states are too small"):
        certify_in_scene(policy, hazards)


def test_more_slips_than_learnt_for_finish_less_often():
    path, hazards = room()
    policy = learn_in_scene(sparse_reward(path), ValueIteration(gamma=0.95, slip=0.1), hazards)
    finishing = [
        odds_in_scene(policy, hazards, slip_model(slip)).finishes[~hazards.forbidden].mean() for slip in (0.0, 0.3, 0.6)
    ]
    assert finishing == sorted(finishing, reverse=True)
    assert finishing[0] == 1
    assert finishing[-1] < 0.8


def test_a_run_that_touches_ends_before_the_obstacle():
    path, hazards = room()
    start = int(path.grid.states_of([0, 0, 2]))
    blind = FollowPolicy(learn_tabular(sparse_reward(path), PhaseQLearning()))
    steady = np.full((budget(path), 3), STEADY, np.int8)
    walks = walk(blind, path, start, steady, hazards.touches)
    assert walks.touched is not None
    assert walks.touched.all()
    last = path.grid.cells_of(walks.states[-1])
    assert (last[:, 0] <= 2).all()
    assert not hazards.forbidden[walks.states].any()
    assert walk(blind, path, start, steady).touched is None


def test_the_examples_of_the_page_run():
    page = (Path(__file__).parents[2] / "docs" / "scenes.md").read_text()
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(block, "scenes.md", "exec"), names)
    assert names["certificate"].every_action_optimal
    assert 0.5 < names["odds"].finishes[names["path"].start] < 1
    assert 6 < names["tissue"].above_mm([20, 20, 5]) <= 6.5
