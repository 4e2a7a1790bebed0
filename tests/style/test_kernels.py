import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skills.style.domain import REACH, Domain
from skills.style.grid import GridPath, GridWorld
from skills.style.learning import _kernels
from skills.style.learning.q_learning import CellQLearning, PhaseQLearning
from skills.style.policy import learn_policy
from skills.style.reward import sparse_reward
from tests.style.paths import named_path

GOAL, VISITED, OTHER, OFF_GRID = LEVELS = (10.0, 1.0, 0.0, -1.0)
STAY, UP = 13, 14
TWO_CELLS = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (1, 1, 2)), np.array([0, 1]))
BOTH = [
    CellQLearning(alpha=0.3, epsilon_start=0.9, epsilon_end=0.2, episodes=60, max_steps=30),
    PhaseQLearning(alpha=0.5, epsilon=0.4, max_steps=20, max_sweeps=2),
]


@pytest.mark.parametrize("learner", BOTH, ids=lambda learner: learner.kind)
@pytest.mark.parametrize("name", ["two cells", "to and fro"])
def test_the_compiled_episodes_and_the_plain_ones_agree_to_the_last_bit(monkeypatch, learner, name):
    compiled, calls = _kernels.run_episodes_compiled, []

    def both(*arguments):
        if len(calls) > 8:  # the first ones are enough: plain Python is slow
            return compiled(*arguments)
        starts = arguments[8][:400]
        arguments = [*arguments[:8], starts, *arguments[9:12], arguments[12][:400], *arguments[13:]]
        twins = [a.copy() if isinstance(a, np.ndarray) else a for a in arguments]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            _kernels.run_episodes(*twins)
        compiled(*arguments)
        q, rng, tally = arguments[0], arguments[-2], arguments[-1]
        calls.append((q.tobytes(), rng.tobytes(), tally.tobytes()))
        assert calls[-1] == (twins[0].tobytes(), twins[-2].tobytes(), twins[-1].tobytes())
        return None

    monkeypatch.setattr(_kernels, "run_episodes_compiled", both)
    policy = learn_policy(sparse_reward(named_path(name)), learner, seed=5)
    assert calls
    assert policy.q.any()
    assert policy.training.steps > policy.training.episodes // 2


@settings(deadline=None)
@given(arrays(float, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.floats(0, 1e6)))
def test_the_compiled_warp_and_the_plain_one_agree_to_the_last_bit(distance):
    costs = []
    for warp in (_kernels.warp, _kernels.warp_compiled):
        cost = np.full((distance.shape[0] + 1, distance.shape[1] + 1), np.inf)
        cost[0, 0] = 0.0
        warp(distance, cost)
        costs.append(cost.tobytes())
    assert costs[0] == costs[1]


def episodes(starts, *, phased, alpha=0.5, gamma=0.5, max_steps=1, epsilon=0.0):
    """Run given episodes on two cells, of which the second is the goal."""
    domain = Domain(TWO_CELLS, phased)
    q, tally, rng = np.zeros((domain.n_rows, 27)), np.zeros(3, int), np.ones(1, np.uint64)
    _kernels.run_episodes_compiled(
        q,
        sparse_reward(TWO_CELLS).rewards,
        domain.joins,
        TWO_CELLS.cells,
        domain.low,
        domain.size,
        domain.offset,
        np.array(TWO_CELLS.grid.shape),
        np.array(starts),
        np.array(LEVELS),
        alpha,
        gamma,
        np.full(len(starts), epsilon),
        max_steps,
        TWO_CELLS.goal,
        REACH,
        rng,
        tally,
    )
    return q, tally.tolist()


def test_equation_1_by_hand_in_the_papers_state():
    up, stay, off = (0, 0, UP), (0, 0, STAY), (0, 0, 0)
    q, tally = episodes([up, up, stay, off], phased=False)
    assert q[0, UP] == 5 + 0.5 * (GOAL - 5) == 7.5
    assert q[0, STAY] == 0.5 * (VISITED + 0.5 * 7.5) == 2.375
    assert q[0, 0] == 0.5 * (OFF_GRID + 0.5 * 7.5) == 1.375
    assert not q[1].any()
    assert tally == [4, 2, 2]


def test_equation_1_by_hand_in_the_phase_state():
    at_start = [(1, 0, UP), (1, 0, STAY), (1, 0, 0), (0, 0, STAY), (0, 0, UP)]
    q, tally = episodes(at_start, phased=True)
    rows = Domain(TWO_CELLS, phased=True).rows_of([0, 1], [[0, 0, 0], [0, 0, 0]])
    not_joined, joined = q[rows]
    assert joined[UP] == 0.5 * GOAL
    assert joined[STAY] == 0.5 * (OTHER + 0.5 * 5)  # it has left waypoint 0 behind: standing there pays nothing
    assert joined[0] == 0.5 * (OFF_GRID + 0.5 * 5)
    assert not_joined[STAY] == 0.5 * (VISITED + 0.5 * 5)  # joins, and goes on with what phase 1 is worth
    assert not_joined[UP] == 0.5 * GOAL
    assert tally == [5, 2, 2]  # the one that joined ended for that reason


def test_an_episode_goes_on_greedily_to_the_goal_after_its_given_first_action():
    q, tally = episodes([(0, 0, UP), (0, 0, STAY)], phased=False, max_steps=100)
    assert tally == [3, 2, 0]  # one move, then two
    assert q[0, UP] == 7.5


def test_of_equally_good_actions_the_first_is_taken():
    q = np.zeros((2, 27))
    q[1, [5, 20]] = 1
    assert [_kernels.best_action(q, row) for row in (0, 1)] == [0, 5]


def test_the_random_numbers_are_those_of_xorshift64():
    # Marsaglia 2003, (13, 7, 17), from the state 1: by hand in whole numbers
    rng, x = np.ones(1, np.uint64), 1
    for _ in range(1000):
        x ^= x << 13 & 0xFFFFFFFFFFFFFFFF
        x ^= x >> 7
        x ^= x << 17 & 0xFFFFFFFFFFFFFFFF
        assert int(_kernels.next_random(rng)) == x


def test_exploration_takes_every_action_about_equally_often():
    # With a small alpha and next to no gamma an action's Q value counts how often it was taken.
    alpha = 1e-6
    q, _ = episodes([(0, 0, -1)] * 27_000, phased=False, alpha=alpha, gamma=1e-12, epsilon=1.0)
    pays = np.full(27, OFF_GRID)
    pays[[STAY, UP]] = VISITED, GOAL
    assert q[0] / (alpha * pays) == pytest.approx(1000, abs=160)  # five standard deviations
