"""Algorithm 1: sparse reward generation."""

import numpy as np
import pytest

from skills.errors import BadSettings
from skills.gridworld.grid import PAPER_GRID, GridPath
from skills.gridworld.reward import RewardLevels, sparse_reward
from tests.gridworld.paths import WALKS, named_path


def test_the_users_reward_map_has_one_goal_and_26_visited_states(user_reward, user_path):
    values, counts = np.unique(user_reward.rewards, return_counts=True)
    assert dict(zip(values.tolist(), counts.tolist(), strict=True)) == {0.0: 1304, 1.0: 26, 10.0: 1}
    assert user_reward.rewards[916] == 10
    assert (user_reward.rewards[user_path.states[:-1]] == 1).all()


@pytest.mark.parametrize("name", WALKS)
def test_the_goal_keeps_its_reward_even_if_the_path_crosses_it_early(name):
    path = named_path(name)
    rewards = sparse_reward(path).rewards
    for state in range(path.grid.n_states):
        expected = 10 if state == path.goal else 1 if state in path.states else 0
        assert rewards[state] == expected


def test_the_levels_stand_in_the_papers_order():
    levels = RewardLevels()
    assert levels.goal >= 10 * levels.visited > levels.other  # much greater
    with pytest.raises(BadSettings, match="goal > visited > other"):
        RewardLevels(goal=1, visited=1)


def test_other_levels_go_to_the_same_states():
    path = GridPath(PAPER_GRID, np.array([0, 1, 2]))
    rewards = sparse_reward(path, RewardLevels(goal=7, visited=0.5, other=-0.25, off_grid=-3)).rewards
    assert rewards[:4].tolist() == [0.5, 0.5, 7, -0.25]
