import numpy as np
import pytest

from skills.errors import BadSettings
from skills.gridworld.reward import RewardLevels, sparse_reward
from skills.learning.certificate import certify
from skills.learning.dynamic_programming import ValueIteration
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
