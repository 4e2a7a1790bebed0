"""Sec. III-C: the 27 actions, the three rules that end an episode, and the reward that pays for standing still."""

from itertools import product

import numpy as np
import pytest

from skills.errors import BadSettings
from skills.gridworld import paper
from skills.gridworld.grid import MOVES
from skills.learning.certificate import certify
from skills.learning.policy import learn_tabular, rollout
from skills.learning.q_learning import CellQLearning, PhaseQLearning

CELL = CellQLearning(episodes=300)
PHASE = PhaseQLearning(max_steps=paper.MAX_STEPS)


def test_there_are_27_actions_in_the_order_of_their_index():
    assert MOVES.tolist() == [list(move) for move in product((-1, 0, 1), repeat=3)]


@pytest.mark.parametrize(
    ("action", "move"),
    [(0, (-1, -1, -1)), (4, (-1, 0, 0)), (12, (0, 0, -1)), (13, (0, 0, 0)), (16, (0, 1, 0)), (22, (1, 0, 0))],
)
def test_an_action_index_is_9a_plus_3b_plus_c(action, move):
    assert tuple(MOVES[action]) == move


def test_the_stop_rules_are_the_papers():
    assert (paper.MAX_STEPS, paper.MAX_EPISODE_S) == (100, 30 * 60)
    for learner in (CellQLearning(), PhaseQLearning()):
        assert learner.max_episode_s == 1800
    assert CellQLearning().max_steps == 100


@pytest.mark.parametrize("learner", [CELL, PHASE], ids=["cell", "phase"])
def test_an_episode_ends_at_the_goal(learner, user_reward):
    training = learn_tabular(user_reward, learner).training
    assert 0 < training.finished < training.episodes


@pytest.mark.parametrize("learner", [CELL, PHASE], ids=["cell", "phase"])
def test_an_episode_ends_after_100_steps(learner, user_reward):
    training = learn_tabular(user_reward, learner).training
    assert training.out_of_steps > 0
    assert training.out_of_time == 0
    assert 100 * training.out_of_steps <= training.steps <= 100 * training.episodes


@pytest.mark.parametrize("learner", [CELL, PHASE], ids=["cell", "phase"])
def test_an_episode_ends_when_the_arm_has_moved_for_30_minutes(learner, user_reward):
    slow = type(learner)(**{**vars(learner), "step_s": 60.0})  # so that 30 steps take the 30 minutes
    training = learn_tabular(user_reward, slow).training
    assert training.out_of_time > 0
    assert training.out_of_steps == 0
    assert 30 * training.out_of_time <= training.steps <= 30 * training.episodes


@pytest.mark.parametrize("learner", [CELL, PHASE], ids=["cell", "phase"])
def test_every_episode_ends_by_one_of_the_three_rules(learner, user_reward):
    training = learn_tabular(user_reward, learner).training
    assert training.finished + training.out_of_steps == training.episodes


def test_in_the_phase_state_every_action_of_every_cell_is_tried_once(user_reward):
    training = learn_tabular(user_reward, PhaseQLearning()).training
    assert training.steps == training.episodes == 1331 * 27
    assert training.finished == 27  # onto the goal, from each of its 26 neighbours and from itself


@pytest.mark.parametrize("gamma", [0.9, 0.95, 1.0])
def test_rewards_that_pay_more_for_standing_than_arriving_are_refused(user_reward, gamma):
    # 1 / (1 - 0.9) = 10: the effect of the paper's reward map on its value iteration
    with pytest.raises(BadSettings, match=r"[Ss]tanding on a visited cell is"):
        learn_tabular(user_reward, CellQLearning(gamma=gamma))


def test_published_parameters_strand_the_users_start_on_nearly_every_seed(user_reward):
    reached = [
        rollout(learn_tabular(user_reward, CellQLearning.published(), s), paper.USER_START_MM) for s in range(20)
    ]
    assert sum(one.finished for one in reached) <= 1  # measured on 200 seeds: 0.5 %


@pytest.mark.nightly
def test_the_published_parameters_arrive_on_fewer_than_3_seeds_in_100(user_reward):
    reached = [
        rollout(learn_tabular(user_reward, CellQLearning.published(), s), paper.USER_START_MM) for s in range(200)
    ]
    assert sum(one.finished for one in reached) < 6


def test_in_the_papers_state_the_optimal_policy_cannot_cross_itself(user_reward):
    policy = learn_tabular(user_reward, CellQLearning(), seed=1)
    certificate, _ = certify(policy)
    assert certificate.every_action_optimal
    assert not certificate.demonstration_reproduced
    assert len(np.unique(rollout(policy, paper.USER_START_MM).states)) == 10
