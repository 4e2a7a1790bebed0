"""Settings of the deep learners, and their networks tabulated on the grid and followed in the space."""

from dataclasses import replace

import numpy as np
import pytest

from skills.db import models  # noqa: F401 - declares what is stored
from skills.db.packed import digest, pack, unpack_as
from skills.errors import BadInput, BadSettings
from skills.gridworld.domain import Domain
from skills.gridworld.grid import MOVES, PAPER_GRID, GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import certify
from skills.learning.dynamic_programming import Mdp, exact_q
from skills.learning.evaluation import check_in_space
from skills.learning.networks import DDPG, DQN, TRPO, network_q
from skills.learning.policy import Policy, check_learnable, learn_tabular, next_step, rollout
from skills.learning.q_learning import CellQLearning, Training
from tests.deep.networks import always, table_as_network, towards

PATH = GridPath(PAPER_GRID, PAPER_GRID.states_of([[1, 1, 1], [2, 1, 1], [3, 1, 1], [3, 2, 1], [3, 3, 1]]))
REWARD = sparse_reward(PATH)
NOTHING = Training(0, 0, 0, 0, 0, 0, False)
ALL = pytest.mark.parametrize("learner", [DQN, DDPG, TRPO])


def policy_of(learner, network, reward=REWARD) -> Policy:
    return Policy(reward.path, reward.levels, learner, 0, NOTHING, network_q(reward, learner, network), network)


def exact(reward, gamma: float) -> np.ndarray:
    return exact_q(Mdp(Domain(reward.path, phased=False), reward, gamma))


@ALL
@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("steps", (0, -1, 10**10)),
        ("width", (0, 2000)),
        ("batch", (0, 10**6)),
        ("steps_per_update", (0,)),
        ("worlds", (0, 65)),
        ("learning_rate", (0.0, -1.0, 2.0, float("nan"))),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(learner, name, values):
    for value in values:
        with pytest.raises(BadSettings, match=name):
            learner(**{name: value})


@pytest.mark.parametrize(
    ("learner", "name", "value"),
    [(DQN, "gamma", 1.0), (DQN, "gamma", float("nan")), (DQN, "target_every", 0), (DDPG, "discount", 1.0),
     (DDPG, "noise", -0.1), (DDPG, "noise", float("nan")), (TRPO, "discount", 0.0), (TRPO, "trust", 0.0)],
)  # fmt: skip
def test_settings_of_one_learner_that_cannot_be_meant_are_refused(learner, name, value):
    with pytest.raises(BadSettings, match=name):
        learner(**{name: value})


def test_a_table_written_as_a_network_equals_it_and_passes_the_gate():
    learner = DQN()
    table = exact(REWARD, learner.gamma)
    policy = policy_of(learner, table_as_network(PAPER_GRID, table))
    assert policy.q == pytest.approx(table, abs=1e-6)
    certificate, _ = certify(policy)
    assert certificate.every_action_optimal and certificate.starts_reaching == 1331


def test_one_wrong_answer_of_a_network_is_found():
    table = exact(REWARD, 0.8).copy()
    table[0] = -table[0]
    certificate, _ = certify(policy_of(DQN(), table_as_network(PAPER_GRID, table)))
    assert certificate.suboptimal == 1


@pytest.mark.parametrize("learner", [DDPG(), TRPO()], ids=lambda one: one.kind)
def test_the_greedy_move_is_the_one_nearest_to_the_step_that_is_asked_for(learner):
    step = (0.9, 0.2, -0.6)
    asked = np.arctanh(step) if isinstance(learner, DDPG) else step
    policy = policy_of(learner, always(tuple(asked)))
    inside = PAPER_GRID.states_of([5, 5, 5])
    assert MOVES[policy.greedy[inside]].tolist() == [1, 0, -1]
    apart = [np.linalg.norm(np.array(step) - move) for move in MOVES.tolist()]
    assert policy.q[inside] == pytest.approx(1 - np.array(apart) / np.sqrt(12), abs=1e-5)
    first, second = sorted(policy.q[inside])[:-3:-1]
    assert policy.confidence[inside] == pytest.approx(1 - second / first) and policy.confidence[inside] > 0


def test_at_a_face_the_move_is_the_one_that_the_box_lets_be_made():
    policy = policy_of(TRPO(), always((1.0, 1.0, 0.0)))
    assert MOVES[policy.greedy[PAPER_GRID.states_of([10, 5, 5])]].tolist() == [0, 1, 0]
    assert not policy.moves.off_grid[policy.greedy >= 0].any()


@pytest.mark.parametrize("learner", [DQN(), DDPG()], ids=lambda one: one.kind)
def test_a_network_of_another_grid_or_learner_is_refused(learner):
    other = GridWorld((0.0, 0.0, 0.0), 5.0, (3, 3, 4))
    with pytest.raises(BadInput, match="takes"):
        network_q(REWARD, learner, table_as_network(other, np.zeros((36, 27))))


def goal_network():
    """Return a network that walks straight to the goal from everywhere: the box is ten cells, so its half is five."""
    at = (PATH.tip_mm[-1] - PAPER_GRID.centres_mm(0)) / 25.0 - 1.0
    return towards(tuple(at), gain=5.0)


def test_a_network_that_walks_to_the_goal_arrives_from_1000_starts():
    policy = policy_of(TRPO(), goal_network())
    walked = check_in_space(policy)
    assert (walked.starts, walked.reached, walked.seed) == (1000, 1000, 0)
    assert walked.demonstrated_start_reached
    # (1, 1, 1), (2, 2, 1), (3, 3, 1): the middle one is a cell from each of (2, 1, 1), (3, 2, 1), two from (3, 1, 1)
    assert walked.demonstrated_start_dtw_mm == pytest.approx(20.0, abs=1e-4)
    assert check_in_space(policy) == walked
    assert check_in_space(policy, seed=1).dtw_total_mm != walked.dtw_total_mm


def test_a_network_that_stands_still_arrives_nowhere_but_where_it_is():
    walked = check_in_space(policy_of(DDPG(), always((0.0, 0.0, 0.0))), starts=50)
    assert not walked.demonstrated_start_reached
    assert walked.reached <= 2


def test_what_was_learnt_on_the_grid_is_not_followed_in_the_space():
    assert check_in_space(learn_tabular(REWARD, CellQLearning(episodes=5))) is None
    assert check_in_space(policy_of(DQN(), table_as_network(PAPER_GRID, np.zeros((1331, 27))))) is None


def test_a_policy_with_a_network_is_stored_exactly_and_rolls_out_the_same():
    rng = np.random.default_rng(0)
    table = exact(REWARD, 0.8) + rng.normal(
        scale=1e-3, size=(1331, 27)
    )  # thirty thousand different numbers: no palette
    policy = policy_of(DQN(), table_as_network(PAPER_GRID, table))
    back = unpack_as(Policy, pack(policy))
    assert back.network == policy.network and back.q.tobytes() == policy.q.tobytes()
    assert digest(back) == digest(policy)
    start_mm = PAPER_GRID.centres_mm(1200)
    assert rollout(back, start_mm).states.tolist() == rollout(policy, start_mm).states.tolist()
    assert next_step(back, start_mm, None) == next_step(policy, start_mm, None)


def test_a_network_changes_the_digest_and_no_network_keeps_the_old_one():
    policy = policy_of(TRPO(), always((0.5, 0.0, 0.0)))
    other = replace(policy, network=always((0.25, 0.0, 0.0)))
    assert len({digest(policy), digest(other), digest(replace(policy, network=None))}) == 3
    plain = learn_tabular(REWARD, CellQLearning(episodes=5))
    assert b"network" not in pack(plain)


@ALL
def test_rewards_that_pay_for_circling_are_refused_as_for_the_table(learner):
    with pytest.raises(BadSettings, match="in the long run"):
        check_learnable(REWARD, DQN(gamma=0.95), 0)
    with pytest.raises(BadSettings, match="seed"):
        check_learnable(REWARD, learner(), -1)
