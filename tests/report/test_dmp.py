"""The movement primitive: the same as the library's, run many at a time and with disturbances."""

import numpy as np
import pytest
from movement_primitives.dmp import DMP

from skills.gridworld.grid import MOVES, discretize
from skills.gridworld.slip import STEADY, slip_model
from skills.learning.slip_runs import judge
from skills.report.numbers import sample_source
from skills.report.rivals import REST_TICKS, STEPS, learn_primitive, rollouts, walk_primitive

PATH = sample_source().path
PRIMITIVE = learn_primitive(PATH)
STAY, BACK = (MOVES.tolist().index([step] * 3) for step in (0, -1))


def steady(moves: int, runs: int = 1) -> np.ndarray:
    return np.full((moves, runs), STEADY, np.int8)


def test_an_undisturbed_primitive_repeats_the_demo_and_stops_on_its_clock():
    assert PRIMITIVE.weights.shape == (3, len(PATH.states) - 1 + REST_TICKS)
    walks = walk_primitive(PRIMITIVE, np.array([PATH.start, PATH.start]), steady(200, runs=2))
    assert [walks.of(run).tolist() for run in range(2)] == [PATH.states.tolist()] * 2
    assert walks.moves.tolist() == [len(PATH.states) - 1] * 2


def test_many_at_a_time_go_where_the_library_s_own_run_of_one_goes():
    moves = len(PATH.states) - 1
    start_mm = PATH.tip_mm[0] + (5.0, 0.0, 5.0)
    one = DMP(3, float(moves + REST_TICKS), dt=1 / STEPS, n_weights_per_dim=PRIMITIVE.weights.shape[1])
    one.set_weights(PRIMITIVE.weights)
    one.configure(start_y=start_mm, start_yd=PATH.tip_mm[1] - PATH.tip_mm[0], goal_y=PATH.tip_mm[-1])
    one.reset()
    tip_mm, velocity = [start_mm], one.start_yd
    for _ in range(moves * STEPS):
        here_mm, velocity = one.step(tip_mm[-1], velocity, step_function="rk4")
        tip_mm.append(here_mm)
    starts = PATH.grid.states_at([PATH.tip_mm[0], start_mm])
    walks = walk_primitive(PRIMITIVE, starts, steady(moves, runs=2))
    expected = discretize(tip_mm[::STEPS], PATH.grid)
    assert walks.of(1).tolist() == expected.states.tolist()


def test_from_every_start_it_arrives():
    ways = rollouts(PRIMITIVE, np.arange(PATH.grid.n_states))
    assert all(way.finished and way.states[-1] == PATH.goal for way in ways)
    assert [int(way.states[0]) for way in ways] == list(range(PATH.grid.n_states))


def test_a_slip_takes_the_place_of_the_tick_s_own_move():
    slips = steady(60, runs=2)
    slips[0] = STAY, BACK
    start = PATH.grid.states_of([(5, 5, 5)])[0]
    walks = walk_primitive(PRIMITIVE, np.array([start, start]), slips[:1])
    assert PATH.grid.cells_of(walks.states[-1]).tolist() == [[5, 5, 5], [4, 4, 4]]


def test_it_never_leaves_the_grid_and_neighbouring_cells_touch():
    corner = PATH.grid.states_of(np.zeros((50, 3), int))
    walks = walk_primitive(PRIMITIVE, corner, slip_model(0.5).draw(runs=50, moves=60, seed=2))
    assert walks.states.min() >= 0
    assert walks.states.max() < PATH.grid.n_states
    steps = np.abs(np.diff(PATH.grid.cells_of(walks.states), axis=0)).max(axis=-1)
    assert steps.max() == 1


@pytest.mark.parametrize("slip", [0.05, 0.2])
def test_pushed_about_it_still_arrives_but_leaves_states_out(slip):
    slips = slip_model(slip).draw(runs=100, moves=300, seed=0)
    outcome = judge(walk_primitive(PRIMITIVE, np.full(100, PATH.start), slips))
    assert outcome.arrived == 100
    assert outcome.followed < 50
    assert outcome.left_out > 0
