"""Sec. III-C and Fig. 5: maximum-entropy IRL finds the path, and value iteration on its reward stands still."""

from dataclasses import replace

import numpy as np
import pytest

from skills.learning.certificate import certify, coverage
from skills.learning.dynamic_programming import Mdp, exact_q
from skills.learning.evaluation import measure
from skills.learning.max_ent_irl import MaxEntIRL, recover_reward
from skills.learning.policy import learn_tabular, rollout_from

pytestmark = pytest.mark.nightly  # it reproduces a result; by day tests/learning/test_max_ent_irl.py
STAY = 13


@pytest.fixture(scope="module")
def recovered(user_path):
    return recover_reward(user_path, MaxEntIRL())


def test_it_finds_the_demonstration_more_likely_than_before(recovered):
    assert recovered.negative_log_likelihood == pytest.approx((2.995, 1.379), abs=0.001)  # nat per move
    assert recovered.visit_error == pytest.approx((48.1, 2.1), abs=0.1)  # of 27 visits


def test_unlike_in_fig_5_the_visited_cells_stand_out(recovered, user_path):
    visited = np.unique(user_path.states)
    highest = np.argsort(-recovered.rewards)[: len(visited)]
    others = np.setdiff1d(np.arange(1331), visited)
    assert (len(visited), np.isin(highest, visited).sum()) == (27, 25)
    # the two that are missing: the start, which is never entered, and the goal, which every trajectory enters anyway
    assert np.setdiff1d(visited, highest).tolist() == [user_path.start, user_path.goal]
    assert recovered.rewards[visited].mean() == pytest.approx(3.31, abs=0.05)
    assert recovered.rewards[others].mean() == pytest.approx(-0.08, abs=0.01)
    assert recovered.rewards[others].max() < 0.001


@pytest.mark.nightly  # it reproduces a result, and nothing else rests on it
@pytest.mark.parametrize("gamma", [0.1, 0.8])
def test_value_iteration_on_it_reaches_the_goal_from_the_goal_alone(recovered, user_reward, gamma):
    policy = learn_tabular(user_reward, MaxEntIRL(gamma=gamma))
    states = rollout_from(policy, user_reward.path.start).states
    assert states[-1] == recovered.rewards.argmax()
    assert policy.greedy[states[-1]] == STAY
    certificate, _ = certify(policy)
    assert (certificate.starts_reaching, certificate.starts) == (1, 1331)
    assert certificate.suboptimal > 300
    assert not certificate.demonstration_reproduced


def test_it_is_not_for_lack_of_exploration_that_it_fails(recovered, user_reward):
    # The same reward less a constant, which is equivalent for the model: now standing still costs.
    costs = recovered.rewards - recovered.rewards.max() - 1
    policy = learn_tabular(user_reward, MaxEntIRL(iterations=1))
    for pays, reaching in ((recovered.rewards, 1), (costs, 1331)):
        q = exact_q(Mdp(policy.domain, replace(user_reward, rewards=pays), 0.99))
        assert coverage(replace(policy, q=q)).reaches.sum() == reaching
    followed = measure(rollout_from(replace(policy, q=q), user_reward.path.start))
    assert followed.dtw_total_mm == pytest.approx(555)  # and yet it does not follow the path
