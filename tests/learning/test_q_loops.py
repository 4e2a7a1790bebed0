"""The loops of Q-learning: compiled and plain, and by hand."""

import numpy as np
import pytest

from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.hazards import SceneCosts, hazards_of
from skills.gridworld.reward import sparse_reward
from skills.gridworld.scene import Box, Scene
from skills.gridworld.slip import slip_model
from skills.learning import q_learning
from skills.learning.in_scene import learn_in_scene
from skills.learning.policy import learn_tabular
from skills.learning.q_learning import (
    OFF_GRID,
    UNKNOWN,
    CellQLearning,
    PhaseQLearning,
    Sweeper,
    any_action,
    explore,
    next_random,
    run_episodes,
)
from tests.gridworld.paths import named_path
from tests.learning.loops import run_both

GOAL, VISITED, OTHER, OFF = (10.0, 1.0, 0.0, -1.0)  # rewards
STAY, UP = 13, 14
NOTHING = np.zeros((0, 27), bool)  # touches
ANYWHERE = slip_model(0.0).cumulated
TWO_CELLS = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (1, 1, 2)), np.array([0, 1]))
LEARNERS = [
    CellQLearning(alpha=0.3, epsilon_start=0.9, epsilon_end=0.2, episodes=60, max_steps=30),
    PhaseQLearning(alpha=0.5, max_steps=3, max_sweeps=2),
    PhaseQLearning(alpha=0.5, max_steps=2, max_sweeps=3, slip=0.4),
]


@pytest.mark.parametrize("learner", LEARNERS, ids=["cell", "phase", "phase, slipping"])
@pytest.mark.parametrize("name", ["two cells", "to and fro"])
def test_the_compiled_loops_and_the_plain_ones_agree_to_the_last_bit(monkeypatch, learner, name):
    agreed = run_both(monkeypatch, q_learning, "run_episodes", "explore", "sweep")
    policy = learn_tabular(sparse_reward(named_path(name)), learner, seed=5)
    assert set(agreed) == ({"run_episodes"} if isinstance(learner, CellQLearning) else {"explore", "sweep"})
    assert policy.q.any()
    assert policy.training.steps > policy.training.episodes // 2


def test_compiled_and_plain_loops_agree_in_a_scene_too(monkeypatch):
    agreed = run_both(monkeypatch, q_learning, "explore", "sweep")
    path = named_path("to and fro")
    wall = Box((1.0, 0.0, -200.0), (2.0, 100.0, 0.0))  # between the path and the last row of cells
    hazards = hazards_of(Scene("base", (wall,)), path, "base", SceneCosts(close=0.3))
    assert 0 < hazards.touches.sum() < hazards.touches.size
    learn_in_scene(sparse_reward(path), LEARNERS[2], hazards, seed=5)
    assert set(agreed) == {"explore", "sweep"}


def episodes(starts, *, first, alpha=0.5, gamma=0.5, max_steps=1, epsilon=0.0):
    """Run episodes in the paper's state on two cells, of which the second is the goal; `first` is best at first."""
    q, value, best = np.zeros(2 * 27), np.zeros(2), np.zeros(2, np.int8)
    q[first], value[0], best[0] = 1e-9, 1e-9, first
    tally, rng = np.zeros(3, int), np.ones(1, np.uint64)
    run_episodes(
        q,
        value,
        best,
        sparse_reward(TWO_CELLS).rewards,
        np.array(TWO_CELLS.grid.shape, np.uint64),
        np.array(starts, np.uint64),
        np.full(len(starts), epsilon),
        OFF,
        alpha,
        gamma,
        max_steps,
        np.uint64(TWO_CELLS.goal),
        rng,
        tally,
    )
    assert value.tolist() == q.reshape(2, 27).max(axis=1).tolist()
    assert best.tolist() == q.reshape(2, 27).argmax(axis=1).tolist()
    return q.reshape(2, 27), tally.tolist()


def test_equation_1_by_hand_in_the_papers_state():
    q, tally = episodes([0, 0], first=UP)
    assert q[0, UP] == pytest.approx(5 + 0.5 * (GOAL - 5), abs=1e-8)
    assert tally == [2, 2, 0]
    q, tally = episodes([0], first=STAY)
    assert q[0, STAY] == pytest.approx(0.5 * VISITED, abs=1e-8)
    assert tally == [1, 0, 1]
    q, _ = episodes([0], first=0)
    assert q[0, 0] == pytest.approx(0.5 * OFF, abs=1e-8)
    assert not q[1].any()


def test_an_episode_goes_on_to_the_goal_and_ends_there():
    q, tally = episodes([0] * 3, first=STAY, max_steps=2000, epsilon=0.5)
    assert tally[1:] == [3, 0]
    assert q[0, UP] > 5


def swept(rows, *, model, phases=(1,), alpha=0.5, gamma=0.5):
    """Sweep once over some phases of two cells, in turn; return the Q values of some (phase, cell)."""
    sweeper = Sweeper(sparse_reward(TWO_CELLS), PhaseQLearning(alpha=alpha, gamma=gamma))
    for phase in phases:
        sweeper.sweep(phase, model, (0,))
    return sweeper.q[sweeper.domain.rows_of([p for p, _ in rows], [[0, 0, z] for _, z in rows])]


def explored(max_steps=1, first=0, slip=0.0):
    """Try every action in both cells."""
    model, tally = np.full((2, 27), UNKNOWN, np.int32), np.zeros(3, int)
    shape, rng = np.array(TWO_CELLS.grid.shape), np.ones(1, np.uint64)
    explore(model, shape, first, slip, ANYWHERE, max_steps, TWO_CELLS.goal, rng, tally, NOTHING)
    return model, tally.tolist()


def test_a_model_says_where_every_action_led():
    model, tally = explored()
    assert model[0, [STAY, UP]].tolist() == [0, 1]
    assert model[1, [STAY, UP - 2]].tolist() == [1, 0]
    assert np.count_nonzero(model == OFF_GRID) == 54 - 4
    assert tally == [54, 2, 52]


def test_exploring_ends_at_the_goal_or_after_its_steps():
    _, (steps, finished, out_of_steps) = explored(max_steps=50)
    assert finished + out_of_steps == 54
    assert 54 < steps < 54 * 50


def test_equation_1_by_hand_in_the_phase_state():
    model, _ = explored()
    joined, not_joined = swept([(1, 0), (0, 0)], model=model, phases=(1, 0))
    assert joined[UP] == 0.5 * GOAL
    assert joined[STAY] == OTHER  # it has passed waypoint 0: standing there pays nothing and adds no future value
    assert joined[0] == 0.5 * OFF
    assert not_joined[STAY] == 0.5 * (VISITED + 0.5 * 5)  # joins, and continues with the value of phase 1
    assert not_joined[UP] == 0.5 * GOAL


def test_what_was_never_tried_is_not_learnt():
    model, _ = explored()
    model[0, UP] = UNKNOWN
    (joined,) = swept([(1, 0)], model=model)
    assert joined[UP] == 0
    assert joined[0] == 0.5 * OFF


def test_the_random_numbers_are_those_of_xorshift64():
    # Marsaglia 2003, (13, 7, 17), from the state 1: by hand in whole numbers
    bits, x = np.uint64(1), 1
    for _ in range(1000):
        x ^= x << 13 & 0xFFFFFFFFFFFFFFFF
        x ^= x >> 7
        x ^= x << 17 & 0xFFFFFFFFFFFFFFFF
        bits = next_random(bits)
        assert int(bits) == x


def drawn(count):
    """Draw random bits, one after the other."""
    bits = np.uint64(1)
    for _ in range(count):
        bits = next_random(bits)
        yield bits


def test_exploration_takes_every_action_about_equally_often():
    taken = np.bincount([int(any_action(bits)) for bits in drawn(27_000)], minlength=27)
    assert len(taken) == 27
    assert taken == pytest.approx(1000, abs=160)  # five standard deviations


def test_where_one_starts_to_explore_makes_no_difference_to_what_is_found():
    assert all(np.array_equal(explored(first=first)[0], explored()[0]) for first in range(54))


def test_a_move_slips_at_its_rate_and_a_slip_off_the_grid_stays():
    """In the middle of 3 x 3 x 3 cells a slip is another move 26 times of 27; at a corner 19 of 27 slips stay."""
    grid, rounds, slip = GridWorld((0.0, 0.0, 0.0), 5.0, (3, 3, 3)), 400, 0.3
    rng, tally, moved, stayed = np.ones(1, np.uint64), np.zeros(3, int), 0, 0
    model = np.full((27, 27), UNKNOWN, np.int32)
    for _ in range(rounds):
        explore(model, np.array(grid.shape), 0, slip, ANYWHERE, 1, 26, rng, tally, NOTHING)
        moved += np.count_nonzero(model[13] != np.arange(27))  # from the middle, an action leads to its own number
        stayed += np.count_nonzero(
            model[0][np.arange(27) // 9 == 0] == 0
        )  # nine that lead off the grid unless they slip
    assert moved / (27 * rounds) == pytest.approx(slip * 26 / 27, abs=0.02)
    assert stayed / (9 * rounds) == pytest.approx(slip * (27 - 7) / 27, abs=0.035)
