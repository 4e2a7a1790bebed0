"""Sec. III-B: StateToIndex, and the demonstration as states of the grid world."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import OutsideGrid
from skills.gridworld import paper
from skills.gridworld.grid import MOVES, PAPER_GRID

START, GOAL = 551, 916


def test_the_grid_world_has_1331_points():
    assert PAPER_GRID.n_states == 1331


def test_state_to_index_numbers_the_points_0_to_1330_exactly_once():
    cells = list(product(range(11), repeat=3))
    assert (
        PAPER_GRID.states_of(cells).tolist() == [121 * ix + 11 * iy + iz for ix, iy, iz in cells] == list(range(1331))
    )
    assert PAPER_GRID.cells_of(range(1331)).tolist() == [list(cell) for cell in cells]


def test_every_point_goes_to_its_index_and_back_to_its_place():
    every = np.arange(1331)
    assert (PAPER_GRID.states_at(PAPER_GRID.centres_mm(every)) == every).all()


def test_the_grid_spans_50_mm_along_each_axis():
    assert PAPER_GRID.centres_mm([0, 1330]).tolist() == [[-30, 25, -140], [20, 75, -90]]


def test_the_users_start_and_goal_have_the_indices_of_the_published_data():
    assert PAPER_GRID.states_at(paper.USER_START_MM) == START
    assert PAPER_GRID.states_at([5, 55, -125]) == GOAL


@given(st.tuples(*[st.floats(-200, 200)] * 3))
def test_a_point_has_an_index_only_within_half_a_cell_of_the_grid(point_mm):
    steps = (np.array(point_mm) - paper.GRID_ORIGIN_MM) / 5
    if ((steps >= -0.5) & (steps < 10.5)).all():
        apart = np.abs(PAPER_GRID.centres_mm(PAPER_GRID.states_at(point_mm)) - point_mm)
        assert apart.max() <= 2.5 + 1e-9  # mm
    else:
        with pytest.raises(OutsideGrid):
            PAPER_GRID.states_at(point_mm)


@pytest.mark.parametrize(
    "point_mm",
    [
        (-20, 5, -130),  # a state of the published Fig. 9 data: y 5 for 50, hidden by an abs() in the authors' index
        (-50, 55, -125),  # the mirror of (-10, 55, -125) under that abs()
        (25, 25, -140),  # one past the end of x, where an unchecked index runs on
        (-30, 25, -85),  # one past the end of z, which an unchecked index takes for the next y
        (np.nan, 55, -125),
        (np.inf, 55, -125),
        (1e300, 55, -125),
    ],
)
def test_no_place_off_the_grid_shares_the_index_of_one_on_it(point_mm):
    with pytest.raises(OutsideGrid):
        PAPER_GRID.states_at(point_mm)


def test_a_refusal_counts_the_points_outside_and_names_the_first():
    with pytest.raises(OutsideGrid, match="2 of 4 points") as refusal:
        PAPER_GRID.states_of([[0, 0, 0], [11, 0, 0], [10, 10, 10], [0, -1, 0]])
    assert refusal.value.numbers == {"points": 2, "first": 1}


def test_the_users_demonstration_is_28_states_of_27_places(user_path):
    assert (len(user_path.states), user_path.revisits, user_path.bridged) == (28, 1, 0)
    assert (user_path.start, user_path.goal) == (START, GOAL)


def test_the_users_demonstration_crosses_itself_and_goes_on_another_way(user_path):
    assert user_path.states[9] == user_path.states[13]
    assert user_path.states[10] != user_path.states[14]


def test_the_users_actions_lead_from_each_state_to_the_next(user_path, user_table):
    moves = np.rint(user_table[:, 3:] / 0.005).astype(int)
    assert (user_path.cells[:-1] + moves[:-1] == user_path.cells[1:]).all()
    actions = 9 * (moves[:, 0] + 1) + 3 * (moves[:, 1] + 1) + moves[:, 2] + 1
    assert (MOVES[actions] == moves).all()
    assert moves[-1].any()  # it leads past the goal: the table was cut from a longer recording
