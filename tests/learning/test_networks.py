"""Networks: their bytes, the settings that learn them, and the continuous space."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import save

from skills.db import models  # noqa: F401 - declares what is stored
from skills.db.packed import digest, pack, unpack_as
from skills.errors import BadInput, BadSettings
from skills.gridworld.domain import Domain
from skills.gridworld.grid import MOVES, PAPER_GRID, GridPath, GridWorld
from skills.gridworld.reward import RewardLevels, sparse_reward
from skills.learning.certificate import certify
from skills.learning.dynamic_programming import Mdp, exact_q
from skills.learning.evaluation import check_in_space
from skills.learning.networks import DDPG, DQN, DRIFT, TRPO, Network, Space, network_q
from skills.learning.policy import Policy, check_learnable, learn_tabular, next_step, rollout
from skills.learning.q_learning import CellQLearning, Training
from tests.deep.networks import always, table_as_network, towards

SMALL = Network.of([([[1.0, -1.0], [2.0, 0.5]], [0.0, -1.0]), ([[1.0, 3.0]], [0.25])])


def test_a_network_worked_by_hand():
    # (2, 1): hidden (1, 3.5), output 1 + 10.5 + 0.25; (0, 1): hidden (-1, -0.5), both cut off.
    assert SMALL.answer([[2.0, 1.0], [0.0, 1.0]]).tolist() == [[11.75], [0.25]]
    assert (SMALL.inputs, SMALL.outputs) == (2, 1)


@given(st.lists(st.integers(1, 5), min_size=2, max_size=4), st.integers(0, 2**32 - 1))
def test_a_network_comes_back_to_the_last_bit_and_answers_the_same(widths, seed):
    rng = np.random.default_rng(seed)
    layers = [(rng.normal(size=(m, n)), rng.normal(size=m)) for n, m in pairwise(widths)]
    network = Network.of(layers)
    back = unpack_as(Network, pack(network))
    assert back == network and digest(back) == digest(network)
    inputs = rng.normal(size=(7, widths[0]))
    assert back.answer(inputs).tobytes() == network.answer(inputs).tobytes()
    for (weight, bias), (w, b) in zip(layers, back.layers, strict=True):
        assert (w == weight.astype(np.float32)).all() and (b == bias.astype(np.float32)).all()


def test_a_network_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        SMALL.layers[0][0][0, 0] = 7


def f4(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.float32)


@pytest.mark.parametrize(
    "tensors",
    [
        b"",
        b"not a network",
        SMALL.tensors[:-1],
        save({}),
        save({"0.weight": f4(2, 2)}),
        save({"0.weight": f4(2, 2), "0.bias": f4(3)}),
        save({"0.weight": f4(2, 2), "0.bias": f4(2), "2.weight": f4(2, 2), "2.bias": f4(2)}),
        save({"0.weight": f4(2, 2), "0.bias": f4(2), "1.weight": f4(2, 3), "1.bias": f4(2)}),
        save({"0.weight": f4(2, 2), "0.bias": f4(2), "more": f4(2)}),
        save({"0.weight": np.zeros((2, 2)), "0.bias": np.zeros(2)}),
        save({"0.weight": f4(2, 2) + np.float32(np.nan), "0.bias": f4(2)}),
        save({"0.weight": f4(2, 2), "0.bias": f4(2) + np.float32(np.inf)}),
    ],
    ids=["empty", "text", "cut", "none", "no bias", "bias", "gap", "widths", "more", "float64", "nan", "inf"],
)
def test_what_is_no_network_is_refused(tensors):
    with pytest.raises(BadInput):
        Network(tensors)


def test_a_network_is_a_safetensors_file_that_others_read():
    length = int.from_bytes(SMALL.tensors[:8], "little")
    named = json.loads(SMALL.tensors[8 : 8 + length])
    assert {name: about["shape"] for name, about in named.items()} == {
        "0.weight": [2, 2], "0.bias": [2], "1.weight": [1, 2], "1.bias": [1],
    }  # fmt: skip


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


CORNER = GridPath(PAPER_GRID, PAPER_GRID.states_of([[1, 1, 1], [2, 1, 1], [3, 1, 1], [3, 2, 1], [3, 3, 1]]))
CROSSED = GridPath(PAPER_GRID, PAPER_GRID.states_of([[1, 1, 1], [2, 1, 1], [2, 2, 1], [1, 2, 1], [1, 1, 1], [0, 0, 1]]))
SPACE = Space(CORNER, RewardLevels())
GAMMA = 0.9


def mm(*cells: float) -> np.ndarray:
    return np.asarray(PAPER_GRID.origin_mm) + 5.0 * np.asarray(cells)


def pays(before: np.ndarray, step: tuple[float, float, float]) -> float:
    after = SPACE.moved(before, step)
    return float(SPACE.pays(before[None], np.asarray(step)[None], after[None], GAMMA)[0])


def test_a_step_is_at_most_a_cell_along_each_axis_and_ends_at_a_face():
    assert SPACE.moved(mm(5, 5, 5), (0.5, -2, 9)) == pytest.approx(mm(5.5, 4, 6))
    assert SPACE.moved(mm(0.2, 10, 5), (-1, 1, 0)) == pytest.approx(mm(0, 10, 5))


def test_the_box_is_scaled_to_one_around_its_middle():
    assert SPACE.scaled([mm(0, 0, 0), mm(10, 5, 10)]).tolist() == [[-1, -1, -1], [1, 0, 1]]


def test_one_has_arrived_in_the_goals_cell_and_nowhere_else():
    assert SPACE.arrived([mm(3, 3, 1), mm(3.4, 2.6, 1.4), mm(3.6, 3, 1), mm(3, 2, 1)]).tolist() == [
        True,
        True,
        False,
        False,
    ]


def test_how_far_along_and_how_far_off_by_hand():
    along, off = SPACE.along([mm(1, 1, 1), mm(2.5, 1, 1), mm(3, 2.5, 1), mm(2, 1, 3), mm(5, 3, 1)])
    assert along.tolist() == pytest.approx([0, 1.5, 3.5, 1, 4])
    assert off.tolist() == pytest.approx([0, 0, 0, 2, 2])


def test_where_a_path_crosses_itself_one_is_at_the_later_visit():
    along, _ = Space(CROSSED, RewardLevels()).along([mm(1, 1, 1)])
    assert along.tolist() == [4]


def test_what_steps_pay_by_hand():
    assert pays(mm(1, 1, 1), (1, 0, 0)) == pytest.approx(GAMMA * 1 - 0)  # a cell further
    assert pays(mm(2, 1, 1), (0, 0, 0)) == pytest.approx((GAMMA - 1) * 1)  # standing still costs
    assert pays(mm(2, 1, 1), (0, 0, 1)) == pytest.approx(GAMMA * (1 - 1) - 1 - DRIFT)  # off the path
    assert pays(mm(2, 1, 1), (1, 1, 0)) == pytest.approx(1.0)  # two cells' progress in one step: cut at 1
    assert pays(mm(3, 2, 1), (0, 1, 0)) == pytest.approx(min(GAMMA * 4 - 3, 1) + 10)  # the goal
    low = Space(CROSSED, RewardLevels(off_grid=-2.0))
    corner, out = mm(0, 5, 5)[None], np.array([[-1.0, 0.0, 0.0]])
    stays = low.pays(corner, 0 * out, corner, GAMMA)
    assert low.pays(corner, out, low.moved(corner, out), GAMMA) == pytest.approx(stays - 2)


@given(st.lists(st.tuples(*[st.floats(-1, 1)] * 3), min_size=1, max_size=12), st.tuples(*[st.floats(1, 9)] * 3))
def test_no_way_round_pays(steps, start):
    """The goal's reward is left out: it ends an episode, so that no loop passes it."""
    at = first = mm(*start)
    total, weight = 0.0, 1.0
    for step in [*steps, *[None] * 12]:
        made = np.asarray((first - at) / 5.0 if step is None else step).clip(-1, 1)
        then = SPACE.moved(at, made)
        gained = float(SPACE.pays(at[None], made[None], then[None], GAMMA)[0])
        total += weight * (gained - 10 * bool(SPACE.arrived(then)))
        at, weight = then, weight * GAMMA
    assert at == pytest.approx(first)
    (s,), (u,) = SPACE.along(first[None])
    assert total <= (weight - 1) * float(s - u) + 1e-6  # the sum of the potential alone


def test_a_box_without_height_has_a_middle_and_nothing_else():
    flat = GridPath(type(PAPER_GRID)((0.0, 0.0, 0.0), 5.0, (3, 3, 1)), np.array([0, 1, 2]))
    assert Space(flat, RewardLevels()).scaled([[5.0, 10.0, 0.0]]).tolist() == [[0.0, 1.0, 0.0]]
