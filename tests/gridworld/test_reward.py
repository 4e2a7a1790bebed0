import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import BadInput, BadSettings
from skills.gridworld.reward import RewardLevels, RewardMap, sparse_reward
from tests.gridworld.paths import named_path, random_path


@pytest.mark.parametrize(
    "levels",
    [
        {"goal": 1.0},
        {"goal": 0.5},
        {"visited": 0.0},
        {"visited": -1.0},
        {"other": 1.0},
        {"off_grid": 0.5},
        {"goal": np.nan},
        {"visited": np.nan},
        {"other": np.nan},
        {"off_grid": np.nan},
        {"goal": np.inf},
        {"off_grid": -np.inf},
    ],
    ids=str,
)
def test_levels_out_of_order_or_not_finite_are_refused(levels):
    with pytest.raises(BadSettings, match="ordered goal > visited > other >= off_grid"):
        RewardLevels(**levels)


def test_a_move_off_the_grid_may_pay_what_other_states_pay():
    assert RewardLevels(off_grid=0.0).off_grid == 0


def test_levels_given_as_whole_numbers_do_not_round_the_others():
    rewards = sparse_reward(named_path("an angle"), RewardLevels(goal=10.5, visited=1.5, other=0, off_grid=-1)).rewards
    assert sorted(set(rewards)) == [0, 1.5, 10.5]


@given(st.integers(0, 500))
def test_every_map_has_one_goal_and_pays_on_the_path_alone(seed):
    path = random_path(seed)
    rewards = sparse_reward(path).rewards
    assert np.flatnonzero(rewards == 10).tolist() == [path.goal]
    assert set(np.flatnonzero(rewards)) == set(path.states)
    assert rewards.sum() == 10 + len(np.unique(path.states)) - 1


def test_a_map_of_another_size_or_with_nan_is_refused():
    path = named_path("an angle")
    with pytest.raises(BadInput, match="shape"):
        RewardMap(path, RewardLevels(), np.zeros(path.grid.n_states + 1))
    with pytest.raises(BadInput, match="NaN"):
        RewardMap(path, RewardLevels(), np.full(path.grid.n_states, np.nan))


def test_a_map_cannot_be_changed():
    rewards = sparse_reward(named_path("an angle")).rewards
    with pytest.raises(ValueError, match="read-only"):
        rewards[0] = 1
