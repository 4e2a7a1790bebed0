from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skills.errors import BadSettings
from skills.gridworld.grid import MOVES, GridPath, GridWorld
from skills.gridworld.reward import RewardLevels, sparse_reward
from skills.learning.certificate import certify, coverage
from skills.learning.dynamic_programming import Mdp, exact_q
from skills.learning.max_ent_irl import MaxEntIRL, recover_reward, soft_visits, sum_around
from skills.learning.policy import learn_tabular, rollout_from
from tests.by_day import examples, some
from tests.gridworld.paths import WALKS, named_path, random_path

STAY, ONWARD = 13, 16  # the last move of "an angle" is one along y
FLAT = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (3, 3, 1)), np.array([0, 4, 5, 4, 6]))  # comes back to the middle
CLOSED = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (2, 3, 2)), np.array([0, 3, 8, 0]))
both_tiny = pytest.mark.parametrize("path", [FLAT, CLOSED], ids=["3 x 3 x 1", "2 x 3 x 2, closed"])


def some_rewards(path, seed=0, scale=1.0):
    return scale * np.random.default_rng(seed).normal(size=path.grid.n_states)


def ways(path: GridPath, state: int, moves: int) -> Iterator[list[int]]:
    """Enumerate all trajectories of a number of moves from a state to the goal, as the states that they enter."""
    if moves == 0:
        if state == path.goal:
            yield []
        return
    for cell in path.grid.cells_of(state) + MOVES:
        if path.grid.holds(cell):
            after = int(path.grid.states_of(cell))
            yield from ([after, *rest] for rest in ways(path, after, moves - 1))


# ---- the model, by a second method ------------------------------------------------------------------------------


@both_tiny
@pytest.mark.parametrize("scale", [0.0, 1.0, 30.0])
def test_expected_visits_are_those_of_all_trajectories_written_out(path, scale):
    rewards, moves = some_rewards(path, scale=scale), len(path.states) - 1
    every = np.array(list(ways(path, path.start, moves)))
    pays = rewards[every].sum(axis=1)
    weights = np.exp(pays - pays.max())
    expected = np.zeros(path.grid.n_states)
    np.add.at(expected, every, (weights / weights.sum())[:, None])
    log_z = pays.max() + np.log(weights.sum())
    likelihood, visits = soft_visits(path, rewards)
    assert np.allclose(visits, expected, rtol=1e-12, atol=1e-14)
    assert likelihood == pytest.approx((log_z - rewards[path.states[1:]].sum()) / moves, rel=1e-12)


@both_tiny
def test_visits_less_the_demonstrated_ones_are_the_slope_of_the_likelihood(path):
    rewards, step, moves = some_rewards(path), 1e-5, len(path.states) - 1
    _, visits = soft_visits(path, rewards)
    for state, gradient in enumerate(visits - np.bincount(path.states[1:], minlength=path.grid.n_states)):
        nudge = step * (np.arange(path.grid.n_states) == state)
        up, down = (soft_visits(path, rewards + sign * nudge)[0] for sign in (1, -1))
        assert moves * (up - down) / (2 * step) == pytest.approx(gradient, abs=1e-8)


def test_two_moves_between_two_cells_by_hand():
    path = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (1, 1, 2)), np.array([0, 1, 0]))  # away, and back
    likelihood, visits = soft_visits(path, np.array([0.0, np.log(3)]))  # being away weighs 3, having stayed 1
    assert visits == pytest.approx([1 + 1 / 4, 3 / 4])
    assert likelihood == pytest.approx(-np.log(3 / 4) / 2)


@examples(40)
@given(st.integers(0, 500), st.floats(-50, 50))
def test_visits_add_up_to_the_moves_and_a_constant_changes_nothing(seed, constant):
    path = random_path(seed)
    rewards = some_rewards(path, seed)
    likelihood, visits = soft_visits(path, rewards)
    assert visits.sum() == pytest.approx(len(path.states) - 1, rel=1e-9)
    assert visits.min() >= 0
    assert likelihood >= 0
    moved, visits_too = soft_visits(path, rewards + constant)
    assert moved == pytest.approx(likelihood, rel=1e-9, abs=1e-9)
    assert np.allclose(visits_too, visits, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("scale", [1e3, -1e3, 1e6])
def test_nothing_overflows_or_vanishes(scale):
    # warnings are errors here
    path = GridPath(FLAT.grid, np.tile(FLAT.states[:4], 100)[:399])  # 0 4 5 4 0 4 5 4 ...
    likelihood, visits = soft_visits(path, some_rewards(path, scale=scale))
    assert np.isfinite(likelihood)
    assert visits.sum() == pytest.approx(398)


# ---- the recovered reward ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", some((name for name in WALKS if name != "two cells"), 7))
def test_it_explains_the_demonstration_and_pays_on_its_path(name):
    path = named_path(name)
    recovered = recover_reward(path, MaxEntIRL())
    before, after = recovered.negative_log_likelihood
    assert after < 0.6 * before
    assert recovered.visit_error[1] < recovered.visit_error[0] / 5
    entered = np.isin(np.arange(path.grid.n_states), path.states[1:])
    assert recovered.rewards[entered].mean() > 1 > 0.1 > recovered.rewards[~entered].mean()
    assert (before, after) == tuple(soft_visits(path, r)[0] for r in (np.zeros(len(entered)), recovered.rewards))


def test_where_there_is_only_one_way_there_is_nothing_to_find():
    recovered = recover_reward(named_path("two cells"), MaxEntIRL())
    assert not recovered.rewards.any()
    assert recovered.negative_log_likelihood == (0, 0)


def test_the_penalty_holds_the_rewards_down():
    loose, tight = (recover_reward(FLAT, MaxEntIRL(l2=l2)) for l2 in (0.0, 0.5))
    assert np.abs(tight.rewards).max() < np.abs(loose.rewards).max() / 2
    assert loose.negative_log_likelihood[1] < tight.negative_log_likelihood[1]


# ---- the failure of the recovered reward ------------------------------------------------------------------------


@pytest.mark.nightly  # it explains a result, and nothing else rests on it
def test_the_cause_is_standing_still_on_the_best_cell_for_repeated_pay():
    path = named_path("an angle")
    policy = learn_tabular(sparse_reward(path), MaxEntIRL())
    rewards = recover_reward(path, MaxEntIRL()).rewards
    best = int(rewards.argmax())
    assert best in path.states
    assert best != path.goal
    assert rollout_from(policy, path.start).states[-1] == best
    assert policy.greedy[best] == STAY
    assert policy.q[best, STAY] == pytest.approx(rewards[best] / (1 - 0.8), rel=1e-9)
    before = policy.path.states[-2]
    assert policy.q[before].argmax() != ONWARD  # though the goal is one move away
    assert policy.q[before, ONWARD] == rewards[path.goal]
    assert coverage(policy).reaches.sum() == 1  # the goal itself


@pytest.mark.nightly  # it explains a result, and nothing else rests on it
def test_the_cause_the_same_reward_less_a_constant_arrives_from_everywhere():
    # Every trajectory of the model has T moves, so it cannot distinguish the two; but now standing still costs.
    path = named_path("an angle")
    rewards = recover_reward(path, MaxEntIRL()).rewards
    costs = rewards - rewards.max() - 1
    (likelihood, visits), (same, too) = soft_visits(path, rewards), soft_visits(path, costs)
    assert same == pytest.approx(likelihood, rel=1e-9)
    assert np.allclose(visits, too, rtol=1e-9)
    policy = learn_tabular(sparse_reward(path), MaxEntIRL(iterations=1))
    for pays, reaching in ((rewards, 1), (costs, path.grid.n_states)):
        q = exact_q(Mdp(policy.domain, replace(sparse_reward(path), rewards=pays), 0.99))
        assert coverage(replace(policy, q=q)).reaches.sum() == reaching


@pytest.mark.parametrize("name", some(WALKS, 4))
@pytest.mark.parametrize("gamma", [0.5, *(pytest.param(one, marks=pytest.mark.nightly) for one in (0.01, 0.89))])
def test_the_policy_on_it_is_never_certified(name, gamma):
    policy = learn_tabular(sparse_reward(named_path(name)), MaxEntIRL(iterations=60, gamma=gamma))
    certificate, _ = certify(policy)
    assert not certificate.every_action_optimal
    assert certificate.starts_reaching < certificate.starts / 2
    assert not certificate.demonstration_reproduced or name == "two cells"


@pytest.mark.parametrize("number", some(range(10), 10))
def test_nor_on_self_crossing_paths(number):
    certificate, _ = certify(learn_tabular(sparse_reward(random_path(number)), MaxEntIRL(iterations=60)))
    assert certificate.starts_reaching < certificate.starts / 2


def test_no_seed_is_in_it():
    reward = sparse_reward(FLAT)
    policies = [learn_tabular(reward, MaxEntIRL(iterations=5), seed) for seed in (0, 1)]
    assert len({policy.q.tobytes() for policy in policies}) == 1
    assert (policies[0].training.steps, policies[0].training.settled) == (0, False)


# ---- refused ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("iterations", [0, -1, 1001, np.nan]),
        ("learning_rate", [0.0, -0.1, 1.1, np.nan, np.inf]),
        ("l2", [-0.01, 1.1, np.nan, np.inf]),
        ("gamma", [0.0, -0.1, 0.999, 1.0, np.nan]),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(name, values):
    for value in values:
        with pytest.raises(BadSettings, match=name):
            MaxEntIRL(**{name: value})


def test_a_gamma_at_which_algorithm_1_pays_for_standing_still_is_refused():
    with pytest.raises(BadSettings, match=r"is worth 10 in the long run, arriving only 10: .* gamma below 0\.9"):
        learn_tabular(sparse_reward(FLAT), MaxEntIRL(gamma=0.9))
    learn_tabular(sparse_reward(FLAT, RewardLevels(goal=200.0)), MaxEntIRL(iterations=1, gamma=0.99))


def test_a_path_that_is_too_long_for_its_grid_is_refused():
    path = GridPath(GridWorld((0.0, 0.0, 0.0), 1.0, (200, 200, 200)), np.array([0, 1, 2, 3]))
    with pytest.raises(BadSettings, match="3 moves in a grid of 8000000 cells are too many"):
        recover_reward(path, MaxEntIRL())


@settings(deadline=None)
@given(st.tuples(*[st.integers(1, 5)] * 3), st.integers(0, 2**32))
def test_each_cell_and_its_neighbours_are_added_at_any_power_of_two(shape, seed):
    rng = np.random.default_rng(seed)
    numbers = rng.uniform(0.7, 2.8, shape) * (rng.random(shape) < 0.8)
    powers = rng.integers(-100, 100, shape).astype(np.int32) + np.int32(5000)
    padded = np.pad(np.ldexp(numbers, powers - 5000), 1)
    expected = sum(padded[a : a + shape[0], b : b + shape[1], c : c + shape[2]] for a, b, c in MOVES + 1)
    made = []
    for add in (sum_around.plain, sum_around):
        total, total_powers = np.empty(shape), np.empty(shape, np.int32)
        add(numbers, powers, total, total_powers)
        assert np.allclose(np.ldexp(total, total_powers - 5000 * (total > 0)), expected, rtol=1e-14, atol=0.0)
        assert ((total == 0) | ((total >= 1) & (total < 2))).all()
        made.append((total.tobytes(), total_powers.tobytes()))
    assert made[0] == made[1]
