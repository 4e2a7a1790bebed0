"""Fig. 8: several policies learnt from one demonstration; in the phase state each is the demonstration itself."""

import numpy as np
import pytest

from skills.gridworld import paper
from skills.gridworld.grid import MOVES
from skills.learning.certificate import certify, coverage, mdp_of
from skills.learning.dynamic_programming import exact_values
from skills.learning.evaluation import measure
from skills.learning.policy import Rollout, learn_tabular, rollout
from skills.learning.q_learning import CellQLearning, PhaseQLearning
from tests.gridworld.paths import follow, joins_nearest

EXACT_MM = 1e-9


@pytest.fixture(scope="module")
def true_values(user_reward):
    """Return the value of each state of the certified domain, by dynamic programming: independent of any seed."""
    return exact_values(mdp_of(learn_tabular(user_reward, PhaseQLearning())))


def is_the_demonstration(policy, true_values):
    followed = rollout(policy, paper.USER_START_MM)
    metrics = measure(followed)
    covered = coverage(policy)
    live = policy.domain.certified & ~policy.domain.terminal
    return (
        followed.finished
        and followed.states.tolist() == policy.path.states.tolist()
        and (metrics.exact_states, metrics.path_states, metrics.dtw_total_mm) == (28, 28, 0.0)
        and (covered.reaches.sum(), covered.joins_nearest.sum()) == (1331, 1331)
        and policy.training.settled
        and np.allclose(policy.q.max(axis=1)[live], true_values[live], rtol=1e-9, atol=0)
    )


def test_with_the_phase_the_seed_decides_nothing_so_one_seed_is_enough(user_reward, true_values):
    policies = [learn_tabular(user_reward, PhaseQLearning(), seed) for seed in (*range(20), 10**6)]
    assert {policy.q.tobytes() for policy in policies} == {policies[0].q.tobytes()}
    assert is_the_demonstration(policies[0], true_values)


def test_in_the_papers_state_no_seed_of_50_gives_the_demonstration(user_reward):
    policies = [learn_tabular(user_reward, CellQLearning(), seed) for seed in range(50)]
    assert len({policy.q.tobytes() for policy in policies}) == 50
    followed = [rollout(policy, paper.USER_START_MM) for policy in policies]
    assert all(one.finished for one in followed)
    assert not any(one.states.tolist() == user_reward.path.states.tolist() for one in followed)


def test_a_client_that_follows_the_served_actions_from_every_start_agrees(user_reward, user_path):
    actions = learn_tabular(user_reward, PhaseQLearning(), seed=8).table()
    for start in range(1331):
        states, finished = follow(actions, (11, 11, 11), user_path.states.tolist(), start)
        assert finished
        assert joins_nearest(user_path, states)


def test_the_certificate_of_the_users_policy_is_clean(user_reward):
    certificate, _ = certify(learn_tabular(user_reward, PhaseQLearning(), seed=9))
    assert certificate.every_action_optimal
    assert certificate.demonstration_reproduced
    assert (certificate.starts, certificate.starts_reaching, certificate.starts_joining_nearest) == (1331,) * 3
    assert certificate.checked > 28 * 5**3 // 2  # phase 0 everywhere, and all states within reach of the path


def test_the_papers_state_reaches_the_goal_145_mm_off_whatever_the_seed(user_reward):
    policies = [learn_tabular(user_reward, CellQLearning(), seed) for seed in range(paper.N_POLICIES)]
    for policy in policies:
        metrics = measure(rollout(policy, paper.USER_START_MM))
        assert metrics.dtw_total_mm == pytest.approx(145, abs=EXACT_MM)
        assert metrics.exact_states < metrics.path_states == 28


def test_three_seeds_learn_three_policies_of_different_actions(user_reward):
    learner = CellQLearning(episodes=1000)  # with all 5000 they differ where actions are equally good, or nowhere
    tables = {learn_tabular(user_reward, learner, seed).greedy.tobytes() for seed in range(paper.N_POLICIES)}
    assert len(tables) == paper.N_POLICIES


@pytest.mark.parametrize(("gamma", "total_mm"), [(0.1, 145), (0.3, 145), (0.5, 415), (0.85, 415), (0.88, 145)])
def test_the_exactly_optimal_policy_of_the_papers_state_cuts_corners(user_reward, gamma, total_mm):
    # So Table I is not an accident of learning: the truly best policy of that reward is as far off.
    states = optimal_states(user_reward.rewards, gamma)
    rolled_out = Rollout(user_reward.path, np.array(states), np.zeros(len(states), int), finished=True)
    assert measure(rolled_out).dtw_total_mm == pytest.approx(total_mm, abs=EXACT_MM)


def optimal_states(rewards, gamma, start=551, goal=916):
    """Iterate values over the 1331 cells and follow the best actions: the paper's complete MDP in a few lines."""
    cells = np.stack(np.unravel_index(np.arange(1331), (11, 11, 11)), axis=-1)[:, None] + MOVES
    on_grid = ((cells >= 0) & (cells < 11)).all(axis=-1)
    after = np.where(on_grid, cells @ (121, 11, 1), np.arange(1331)[:, None])
    pays, values = np.where(on_grid, rewards[after], -1.0), np.zeros(1331)
    for _ in range(1000):
        q = pays + gamma * np.where(on_grid & (after == goal), 0, values[after])
        values = np.where(np.arange(1331) == goal, 0, q.max(axis=1))
    states = [start]
    while states[-1] != goal:
        states.append(int(after[states[-1], np.argmax(q[states[-1]] >= q[states[-1]].max() - 1e-12)]))
    return states
