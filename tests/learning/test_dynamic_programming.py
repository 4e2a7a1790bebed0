import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skills.errors import BadSettings
from skills.gridworld.grid import MOVES
from skills.gridworld.reward import RewardLevels, sparse_reward
from skills.learning.certificate import certify
from skills.learning.dynamic_programming import ValueIteration, settle, spread_worth
from skills.learning.policy import MAX_SEED, learn_tabular, rollout_from
from skills.learning.q_learning import PhaseQLearning
from tests.gridworld.paths import WALKS, named_path, random_path

PATHS = {**{name: named_path(name) for name in WALKS}, **{f"random {n}": random_path(n) for n in range(12)}}
every_path = pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)


@every_path
def test_it_certifies_by_construction(path):
    policy = learn_tabular(sparse_reward(path), ValueIteration())
    certificate, covered = certify(policy)
    assert certificate.every_action_optimal
    assert certificate.demonstration_reproduced
    assert rollout_from(policy, path.start).states.tolist() == path.states.tolist()
    assert covered.reaches.all()
    assert covered.joins_nearest.all()


@every_path
def test_it_finds_what_q_learning_in_the_phase_state_finds_by_trying(path):
    solved = learn_tabular(sparse_reward(path), ValueIteration())
    learnt = learn_tabular(sparse_reward(path), PhaseQLearning(), seed=1)
    assert np.array_equal(solved.table(), learnt.table())
    assert np.allclose(solved.q, learnt.q, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("gamma", [0.01, 0.5, 0.95])
def test_so_it_does_at_other_discounts(gamma):
    reward = sparse_reward(named_path("a figure of eight"))
    solved = learn_tabular(reward, ValueIteration(gamma=gamma))
    learnt = learn_tabular(reward, PhaseQLearning(gamma=gamma))
    assert np.allclose(solved.q, learnt.q, rtol=1e-9, atol=1e-15)
    assert certify(solved)[0].every_action_optimal


def test_no_seed_is_in_it_and_no_arm_moves():
    reward = sparse_reward(named_path("closed"))
    policies = [learn_tabular(reward, ValueIteration(), seed) for seed in (0, 1, MAX_SEED)]
    assert len({policy.q.tobytes() for policy in policies}) == 1
    training = policies[0].training
    assert (training.steps, training.episodes, training.settled) == (0, 0, True)


def test_the_values_two_moves_before_the_goal_by_hand():
    policy = learn_tabular(sparse_reward(named_path("an angle")), ValueIteration(gamma=0.5))
    a, b, stay = 22, 16, 13  # A and B are a cell along x and along y
    last, before = policy.row(6, int(policy.path.states[5])), policy.row(5, int(policy.path.states[4]))
    assert policy.q[last, [b, a, stay]].tolist() == [10, 5, 5]  # the other one is one diagonal move from the goal
    assert policy.q[before, [b, stay]].tolist() == [1 + 0.5 * 10, 0.5 * 6]


@pytest.mark.parametrize("gamma", [0.0, -0.1, 1.0, 1.5, np.nan, np.inf])
def test_a_gamma_that_cannot_be_meant_is_refused(gamma):
    with pytest.raises(BadSettings, match="gamma"):
        ValueIteration(gamma=gamma)


@pytest.mark.parametrize("seed", [True, -1, 1.0, "1", MAX_SEED + 1], ids=repr)
def test_even_a_seed_that_is_not_used_must_be_one(seed):
    with pytest.raises(BadSettings, match="seed must be an integer"):
        learn_tabular(sparse_reward(named_path("two cells")), ValueIteration(), seed)


def test_moves_that_advance_nothing_must_pay_nothing():
    reward = sparse_reward(named_path("an angle"), RewardLevels(other=-0.5))
    with pytest.raises(BadSettings, match="`other` must be 0"):
        learn_tabular(reward, ValueIteration())


@settings(deadline=None)
@given(st.tuples(*[st.integers(1, 6)] * 3), st.integers(1, 5), st.integers(0, 2**32))
def test_worth_spreads_from_given_cells_and_never_through_them(shape, count, seed):
    rng = np.random.default_rng(seed)
    given_cells = np.zeros(shape, bool)
    given_cells[tuple(rng.integers(shape, size=(count, 3)).T)] = True
    start = np.where(given_cells, rng.integers(-50, 50, size=shape), -(2**62))
    expected, worth = np.full(shape, -(2**62)), start.copy()
    for _ in range(given_cells.size + 1):  # all neighbours at once, as often as a way can be long
        padded = np.pad(worth, 1, constant_values=-(2**62))
        around = [padded[a : a + shape[0], b : b + shape[1], c : c + shape[2]] for a, b, c in MOVES + 1]
        expected = np.maximum(expected, np.max(around, axis=0))
        worth = np.where(given_cells, start, np.where(expected > -(2**61), expected - 7, -(2**62)))
    for spread in (spread_worth.plain, spread_worth):
        best, entering = np.full(shape, -(2**62)), start.copy()
        spread(best, entering, given_cells, -7)
        assert np.array_equal(best, expected)
        assert np.array_equal(entering, worth)


@pytest.mark.parametrize("sweeps", [2, 10])
def test_the_compiled_values_settle_as_the_plain_ones_do_to_the_last_bit(sweeps):
    path = named_path("a figure of eight")
    found = []
    for iterate in (settle.plain, settle):
        rewards = sparse_reward(path).rewards
        best, worth = np.zeros(path.grid.n_states), rewards.copy()
        stays = np.arange(path.grid.n_states) != path.goal
        shape = np.array(path.grid.shape)
        settled = iterate(best, worth, rewards, stays, shape, path.goal, -1.0, 0.5, 1e-14, sweeps)
        found.append((settled, best.tobytes(), worth.tobytes()))
    assert found[0] == found[1]
    assert found[0][0] == (sweeps == 10)
