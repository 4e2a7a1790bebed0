import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skills.gridworld.grid import MOVES, GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.gridworld.scene import Box, Scene, SceneCosts, hazards_of
from skills.learning import _kernels
from skills.learning.certificate import certify
from skills.learning.in_scene import learn_in_scene
from skills.learning.policy import learn_tabular
from skills.learning.q_learning import CellQLearning, PhaseQLearning, Sweeper
from tests.gridworld.paths import named_path

GOAL, VISITED, OTHER, OFF_GRID = (10.0, 1.0, 0.0, -1.0)
STAY, UP = 13, 14
NOTHING = np.zeros((0, 27), bool)  # touches
TWO_CELLS = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (1, 1, 2)), np.array([0, 1]))
LEARNERS = [
    CellQLearning(alpha=0.3, epsilon_start=0.9, epsilon_end=0.2, episodes=60, max_steps=30),
    PhaseQLearning(alpha=0.5, max_steps=3, max_sweeps=2),
    PhaseQLearning(alpha=0.5, max_steps=2, max_sweeps=3, slip=0.4),
]


@pytest.mark.parametrize("learner", LEARNERS, ids=["cell", "phase", "phase, slipping"])
@pytest.mark.parametrize("name", ["two cells", "to and fro"])
def test_the_compiled_loops_and_the_plain_ones_agree_to_the_last_bit(monkeypatch, learner, name):
    agreed: list[str] = []
    for loop in ("run_episodes", "explore", "sweep"):
        monkeypatch.setattr(_kernels, f"{loop}_compiled", both(loop, agreed))
    policy = learn_tabular(sparse_reward(named_path(name)), learner, seed=5)
    assert set(agreed) == ({"run_episodes"} if isinstance(learner, CellQLearning) else {"explore", "sweep"})
    assert policy.q.any()
    assert policy.training.steps > policy.training.episodes // 2


def test_compiled_and_plain_loops_agree_in_a_scene_too(monkeypatch):
    agreed: list[str] = []
    for loop in ("explore", "sweep"):
        monkeypatch.setattr(_kernels, f"{loop}_compiled", both(loop, agreed))
    path = named_path("to and fro")
    wall = Box((1.0, 0.0, -200.0), (2.0, 100.0, 0.0))  # between the path and the last row of cells
    hazards = hazards_of(Scene("base", (wall,)), path, "base", SceneCosts(close=0.3))
    assert 0 < hazards.touches.sum() < hazards.touches.size
    learn_in_scene(sparse_reward(path), PhaseQLearning(alpha=0.5, max_steps=2, max_sweeps=3, slip=0.4), hazards, seed=5)
    assert set(agreed) == {"explore", "sweep"}


def both(loop, agreed):
    """Run a loop compiled and plain on the same numbers, and compare all its arrays and its result."""
    compiled, plain = getattr(_kernels, f"{loop}_compiled"), getattr(_kernels, loop)

    def run(*arguments):
        twins = [a.copy() if isinstance(a, np.ndarray) else a for a in arguments]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            by_hand = plain(*twins)
        answer = compiled(*arguments)
        assert answer == by_hand
        for array, twin in zip(arguments, twins, strict=True):
            assert np.asarray(array).tobytes() == np.asarray(twin).tobytes()
        agreed.append(loop)
        return answer

    return run


@pytest.mark.parametrize("learner", [PhaseQLearning(), LEARNERS[2]], ids=["settled", "sampled"])
@pytest.mark.parametrize("name", ["two cells", "to and fro"])
def test_the_compiled_rule_among_ties_and_the_plain_one_agree(monkeypatch, learner, name):
    agreed: list[str] = []
    for loop in ("find_equal", "choose_ways", "count_off_rule"):
        monkeypatch.setattr(_kernels, f"{loop}_compiled", both(loop, agreed))
    certify(learn_tabular(sparse_reward(named_path(name)), learner, seed=5))
    assert agreed == ["find_equal", "choose_ways", "count_off_rule"]


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


@settings(deadline=None)
@given(arrays(float, st.integers(0, 300), elements=st.sampled_from([0.0, -0.0, 1.0, 0.1, np.nan, np.inf, 5e-324])))
def test_the_compiled_palette_and_the_plain_one_agree(values):
    bits, found = values.view(np.uint64), []
    for tell_apart in (_kernels.tell_apart, _kernels.tell_apart_compiled):
        read_only = bits.copy()
        read_only.flags.writeable = False
        colours, places, slots = np.zeros(4, np.uint64), np.zeros(len(bits), np.uint8), np.full(8, -1, np.int16)
        with np.errstate(over="ignore"):  # the product's upper bits are meant to be lost
            count = tell_apart(read_only, colours, places, slots, np.uint64(61))
        found.append((count, colours.tobytes(), places.tobytes(), slots.tobytes()))
    assert found[0] == found[1]


def episodes(starts, *, first, alpha=0.5, gamma=0.5, max_steps=1, epsilon=0.0):
    """Run episodes in the paper's state on two cells, of which the second is the goal; `first` is best at first."""
    q, value, best = np.zeros(2 * 27), np.zeros(2), np.zeros(2, np.int8)
    q[first], value[0], best[0] = 1e-9, 1e-9, first
    tally, rng = np.zeros(3, int), np.ones(1, np.uint64)
    _kernels.run_episodes_compiled(
        q,
        value,
        best,
        sparse_reward(TWO_CELLS).rewards,
        np.array(TWO_CELLS.grid.shape, np.uint64),
        np.array(starts, np.uint64),
        np.full(len(starts), epsilon),
        OFF_GRID,
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
    assert q[0, 0] == pytest.approx(0.5 * OFF_GRID, abs=1e-8)
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
    model, tally = np.full((2, 27), _kernels.UNKNOWN, np.int32), np.zeros(3, int)
    shape, rng = np.array(TWO_CELLS.grid.shape), np.ones(1, np.uint64)
    _kernels.explore_compiled(model, shape, first, slip, max_steps, TWO_CELLS.goal, rng, tally, NOTHING)
    return model, tally.tolist()


def test_a_model_says_where_every_action_led():
    model, tally = explored()
    assert model[0, [STAY, UP]].tolist() == [0, 1]
    assert model[1, [STAY, UP - 2]].tolist() == [1, 0]
    assert np.count_nonzero(model == _kernels.OFF_GRID) == 54 - 4
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
    assert joined[0] == 0.5 * OFF_GRID
    assert not_joined[STAY] == 0.5 * (VISITED + 0.5 * 5)  # joins, and continues with the value of phase 1
    assert not_joined[UP] == 0.5 * GOAL


def test_what_was_never_tried_is_not_learnt():
    model, _ = explored()
    model[0, UP] = _kernels.UNKNOWN
    (joined,) = swept([(1, 0)], model=model)
    assert joined[UP] == 0
    assert joined[0] == 0.5 * OFF_GRID


def test_the_random_numbers_are_those_of_xorshift64():
    # Marsaglia 2003, (13, 7, 17), from the state 1: by hand in whole numbers
    bits, x = np.uint64(1), 1
    for _ in range(1000):
        x ^= x << 13 & 0xFFFFFFFFFFFFFFFF
        x ^= x >> 7
        x ^= x << 17 & 0xFFFFFFFFFFFFFFFF
        bits = _kernels.next_random(bits)
        assert int(bits) == x


def drawn(count):
    """Draw random bits, one after the other."""
    bits = np.uint64(1)
    for _ in range(count):
        bits = _kernels.next_random(bits)
        yield bits


def test_exploration_takes_every_action_about_equally_often():
    taken = np.bincount([int(_kernels.any_action(bits)) for bits in drawn(27_000)], minlength=27)
    assert len(taken) == 27
    assert taken == pytest.approx(1000, abs=160)  # five standard deviations


def test_where_one_starts_to_explore_makes_no_difference_to_what_is_found():
    assert all(np.array_equal(explored(first=first)[0], explored()[0]) for first in range(54))


def test_a_move_slips_at_its_rate_and_a_slip_off_the_grid_stays():
    """In the middle of 3 x 3 x 3 cells a slip is another move 26 times of 27; at a corner 19 of 27 slips stay."""
    grid, rounds, slip = GridWorld((0.0, 0.0, 0.0), 5.0, (3, 3, 3)), 400, 0.3
    rng, tally, moved, stayed = np.ones(1, np.uint64), np.zeros(3, int), 0, 0
    model = np.full((27, 27), _kernels.UNKNOWN, np.int32)
    for _ in range(rounds):
        _kernels.explore_compiled(model, np.array(grid.shape), 0, slip, 1, 26, rng, tally, NOTHING)
        moved += np.count_nonzero(model[13] != np.arange(27))  # from the middle, an action leads to its own number
        stayed += np.count_nonzero(
            model[0][np.arange(27) // 9 == 0] == 0
        )  # nine that lead off the grid unless they slip
    assert moved / (27 * rounds) == pytest.approx(slip * 26 / 27, abs=0.02)
    assert stayed / (9 * rounds) == pytest.approx(slip * (27 - 7) / 27, abs=0.035)


@settings(deadline=None)
@given(st.tuples(*[st.integers(1, 6)] * 3), st.integers(1, 5), st.integers(0, 2**32))
def test_the_fewest_moves_to_some_places_are_those_of_the_distance_to_each(shape, count, seed):
    rng = np.random.default_rng(seed)
    places = rng.integers(shape, size=(count, 3))
    cells = np.stack(np.indices(shape), axis=-1)
    expected = np.abs(cells[..., None, :] - places).max(axis=-1).min(axis=-1)
    for spread in (_kernels.spread_distances, _kernels.spread_distances_compiled):
        distance = np.full(shape, 1000)
        distance[tuple(places.T)] = 0
        spread(distance)
        assert np.array_equal(distance, expected)


@settings(deadline=None)
@given(st.tuples(*[st.integers(1, 6)] * 3), st.integers(1, 5), st.integers(0, 2**32))
def test_worth_spreads_from_given_cells_and_never_through_them(shape, count, seed):
    rng = np.random.default_rng(seed)
    given_cells = np.zeros(shape, bool)
    given_cells[tuple(rng.integers(shape, size=(count, 3)).T)] = True
    start = np.where(given_cells, rng.integers(-50, 50, size=shape), -(2**62))
    expected, worth = np.full(shape, -(2**62)), start.copy()
    for _ in range(given_cells.size + 1):  # all neighbours at once, as often as a way can be long
        padded = np.pad(worth, 1, constant_values=-(2**62))
        around = [padded[a : a + shape[0], b : b + shape[1], c : c + shape[2]] for a, b, c in MOVES + 1]
        expected = np.maximum(expected, np.max(around, axis=0))
        worth = np.where(given_cells, start, np.where(expected > -(2**61), expected - 7, -(2**62)))
    for spread in (_kernels.spread_worth, _kernels.spread_worth_compiled):
        best, entering = np.full(shape, -(2**62)), start.copy()
        spread(best, entering, given_cells, -7)
        assert np.array_equal(best, expected)
        assert np.array_equal(entering, worth)


@settings(deadline=None)
@given(st.tuples(*[st.integers(1, 5)] * 3), st.integers(0, 2**32))
def test_each_cell_and_its_neighbours_are_added_at_any_power_of_two(shape, seed):
    rng = np.random.default_rng(seed)
    numbers = rng.uniform(0.7, 2.8, shape) * (rng.random(shape) < 0.8)
    powers = rng.integers(-100, 100, shape).astype(np.int32) + np.int32(5000)
    padded = np.pad(np.ldexp(numbers, powers - 5000), 1)
    expected = sum(padded[a : a + shape[0], b : b + shape[1], c : c + shape[2]] for a, b, c in MOVES + 1)
    made = []
    for add in (_kernels.sum_around, _kernels.sum_around_compiled):
        total, total_powers = np.empty(shape), np.empty(shape, np.int32)
        add(numbers, powers, total, total_powers)
        assert np.allclose(np.ldexp(total, total_powers - 5000 * (total > 0)), expected, rtol=1e-14, atol=0.0)
        assert ((total == 0) | ((total >= 1) & (total < 2))).all()
        made.append((total.tobytes(), total_powers.tobytes()))
    assert made[0] == made[1]


@pytest.mark.parametrize("sweeps", [2, 10])
def test_the_compiled_values_settle_as_the_plain_ones_do_to_the_last_bit(sweeps):
    path = named_path("a figure of eight")
    found = []
    for settle in (_kernels.settle, _kernels.settle_compiled):
        rewards = sparse_reward(path).rewards
        best, worth = np.zeros(path.grid.n_states), rewards.copy()
        stays = np.arange(path.grid.n_states) != path.goal
        shape = np.array(path.grid.shape)
        settled = settle(best, worth, rewards, stays, shape, path.goal, OFF_GRID, 0.5, 1e-14, sweeps)
        found.append((settled, best.tobytes(), worth.tobytes()))
    assert found[0] == found[1]
    assert found[0][0] == (sweeps == 10)
