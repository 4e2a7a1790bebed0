from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skills.errors import BadInput, BadPath, BadSettings, EmptyPath, NeverLeavesGoal, OutsideGrid
from skills.gridworld.grid import (
    MARGIN_CELLS,
    PAPER_GRID,
    GridPath,
    GridWorld,
    choose_grid,
    discretisation_rmse,
    discretize,
    fit_grid,
)

ORIGIN = (0.0, 0.0, 0.0)
LINE = GridWorld(ORIGIN, 1.0, (9, 1, 1))
clouds_mm = st.integers(1, 12).flatmap(lambda n: arrays(float, (n, 3), elements=st.floats(-100, 100)))
cells_mm = st.sampled_from([1.0, 2.5, 3.3, 5.0, 7.0])
motions_mm = clouds_mm.map(lambda tip_mm: tip_mm / 10)  # a few cells wide, so that samples are often near a face
hystereses = st.one_of(st.sampled_from([0.0, 0.25, 0.5]), st.floats(0, 0.5))


# ---- the grid world ---------------------------------------------------------------------------------------------


@given(st.tuples(*[st.integers(1, 9)] * 3).filter(lambda shape: max(shape) > 1))
def test_every_state_has_one_cell_and_every_cell_one_state(shape):
    grid = GridWorld(ORIGIN, 2.0, shape)
    every = np.arange(grid.n_states)
    assert (grid.states_of(grid.cells_of(every)) == every).all()
    assert (grid.states_at(grid.centres_mm(every)) == every).all()


def test_a_grid_of_unequal_sides_counts_z_fastest():
    grid = GridWorld((1.0, 2.0, 3.0), 0.5, (2, 3, 4))
    assert grid.states_of([[0, 0, 1], [0, 1, 0], [1, 0, 0]]).tolist() == [1, 4, 12]
    assert grid.centres_mm(23).tolist() == [1.5, 3, 4.5]


@pytest.mark.parametrize("shape", [(0, 5, 5), (-1, -1, 5), (1, 1, 1)])
def test_a_grid_without_room_is_refused(shape):
    with pytest.raises(BadSettings, match="at least one cell"):
        GridWorld(ORIGIN, 5.0, shape)


@pytest.mark.parametrize("cell_mm", [0.0, -5.0, np.nan, np.inf])
def test_a_cell_that_is_no_length_is_refused(cell_mm):
    with pytest.raises(BadSettings, match="positive cell_mm"):
        GridWorld(ORIGIN, cell_mm, (2, 2, 2))
    with pytest.raises(BadSettings, match="positive length"):
        fit_grid([[0, 0, 0]], cell_mm)


def test_an_origin_that_is_nowhere_is_refused():
    with pytest.raises(BadSettings, match="finite origin"):
        GridWorld((0.0, np.nan, 0.0), 5.0, (2, 2, 2))


def test_too_many_cells_are_refused_with_their_number():
    with pytest.raises(BadSettings, match=f"{1001**3} cells is over the limit.*larger cells"):
        GridWorld(ORIGIN, 5.0, (1001, 1001, 1001))
    with pytest.raises(BadSettings, match="over the limit"):
        fit_grid([[0, 0, 0], [300, 300, 300]], cell_mm=0.5)


# ---- the choice of a grid ---------------------------------------------------------------------------------------


@given(clouds_mm, cells_mm)
def test_a_fitted_grid_holds_all_points_with_room_for_the_margin(tip_mm, cell_mm):
    grid = fit_grid(tip_mm, cell_mm)
    cells = grid.cells_at(tip_mm)
    assert cells.min() >= MARGIN_CELLS
    assert (cells <= np.array(grid.shape) - 1 - MARGIN_CELLS).all()
    room = (cells.max(axis=0) - cells.min(axis=0)) + 1 + 2 * MARGIN_CELLS
    assert (np.array(grid.shape) <= room + 2).all()  # at most one cell more at each end, from rounding outwards


@given(clouds_mm, cells_mm)
def test_a_fitted_grid_lies_on_whole_multiples_of_its_cell(tip_mm, cell_mm):
    steps = np.array(fit_grid(tip_mm, cell_mm).origin_mm) / cell_mm
    assert steps == pytest.approx(np.rint(steps), abs=1e-9)


def test_fitting_to_nothing_is_refused():
    with pytest.raises(EmptyPath):
        fit_grid(np.empty((0, 3)))


INSIDE_MM, OUTSIDE_MM = [[-10, 55, -135], [5, 55, -125]], [[-10, 55, -135], [30, 55, -125]]


def test_a_path_inside_the_papers_grid_gets_it_unless_fitting_is_requested():
    assert choose_grid(INSIDE_MM) == choose_grid(INSIDE_MM, cell_mm=5.0) == PAPER_GRID
    assert choose_grid(INSIDE_MM, "paper") == PAPER_GRID
    assert choose_grid(INSIDE_MM, "fit") == GridWorld((-20.0, 45.0, -145.0), 5.0, (8, 5, 7))


def test_a_path_off_the_papers_grid_gets_a_fitted_one_by_default():
    assert choose_grid(OUTSIDE_MM) == fit_grid(OUTSIDE_MM)
    with pytest.raises(OutsideGrid, match="1 of 2 points are outside"):
        discretize(OUTSIDE_MM, choose_grid(OUTSIDE_MM, "paper"))


def test_another_cell_means_a_fitted_grid():
    assert choose_grid(INSIDE_MM, cell_mm=2.5) == fit_grid(INSIDE_MM, 2.5)
    with pytest.raises(BadSettings, match="request grid 'fit'"):
        choose_grid(INSIDE_MM, "paper", cell_mm=2.5)


# ---- the path ---------------------------------------------------------------------------------------------------


def test_samples_snap_to_the_nearest_cell_and_only_repeats_are_removed():
    x_mm = [0.0, 0.4, 0.6, 1.4, 0.9, 0.2, 1.0]
    path = discretize([[x, 0, 0] for x in x_mm], LINE)
    assert path.states.tolist() == [0, 1, 0, 1]
    assert (path.bridged, path.revisits, path.start, path.goal) == (0, 2, 0, 1)


def test_a_jump_is_bridged_by_the_straight_line_of_touching_cells():
    grid = GridWorld(ORIGIN, 1.0, (5, 5, 5))
    path = discretize([[0, 0, 0], [4, 2, 0]], grid)
    assert path.cells.tolist() == [[0, 0, 0], [1, 1, 0], [2, 1, 0], [3, 2, 0], [4, 2, 0]]
    assert path.bridged == 3


@given(clouds_mm.filter(lambda tip_mm: np.ptp(tip_mm, axis=0).max() > 20), cells_mm, hystereses)
def test_every_path_is_26_connected_and_passes_all_samples_in_order(tip_mm, cell_mm, hysteresis):
    grid = fit_grid(tip_mm, max(cell_mm, 2.5))
    path = discretize(tip_mm, grid, hysteresis)
    assert all(np.abs(b - a).max() == 1 for a, b in pairwise(path.cells))
    left = iter(path.states.tolist())
    sampled = [state for state, _ in groups(grid.states_of(grid.cells_along(tip_mm, hysteresis)).tolist())]
    assert all(state in left for state in sampled)
    assert path.bridged == len(path.states) - len(sampled)
    assert (path.start, path.goal, path.hysteresis) == (sampled[0], sampled[-1], hysteresis)


def groups(states):
    """Drop consecutive repeats."""
    return [(state, i) for i, state in enumerate(states) if i == 0 or state != states[i - 1]]


@given(st.tuples(*[st.integers(0, 8)] * 3), st.tuples(*[st.integers(0, 8)] * 3))
def test_a_bridge_is_shortest_and_stays_within_half_a_cell_of_the_line(a, b):
    if a == b:
        return
    grid = GridWorld(ORIGIN, 1.0, (9, 9, 9))
    cells = discretize([a, b], grid).cells
    a, b = np.array(a), np.array(b)
    n = np.abs(b - a).max()
    assert len(cells) == n + 1
    on_the_line = a + (b - a) * (np.arange(n + 1) / n)[:, None]
    assert np.abs(cells - on_the_line).max() <= 0.5 + 1e-9  # cells


# ---- hysteresis -------------------------------------------------------------------------------------------------


def along(x_mm, hysteresis):
    """Return the cells of places on `LINE`."""
    return LINE.cells_along([[x, 0, 0] for x in x_mm], hysteresis)[:, 0].tolist()


def test_a_sample_stays_in_its_cell_until_it_is_beyond_the_hysteresis():
    x_mm = [0.3, 0.6, 0.75, 0.76, 0.5, 0.25, 0.24, 0.7]
    assert along(x_mm, 0.25) == [0, 0, 0, 1, 1, 1, 0, 0]
    assert along(x_mm, 0.0) == [0, 1, 1, 1, 1, 0, 0, 1]
    assert discretize([[x, 0, 0] for x in x_mm], LINE, 0.25).states.tolist() == [0, 1, 0]


def test_it_then_goes_to_its_nearest_cell_along_all_axes():
    grid = GridWorld(ORIGIN, 1.0, (5, 5, 5))
    tip_mm = [[0, 0, 0], [0, 0.7, 0], [0.8, 0.7, 0.4], [0.8, 0.7, 3.4]]
    assert grid.cells_along(tip_mm, 0.25).tolist() == [[0, 0, 0], [0, 0, 0], [1, 1, 0], [1, 1, 3]]
    assert discretize(tip_mm, grid, 0.25).bridged == 2


@given(motions_mm, cells_mm)
def test_without_hysteresis_every_sample_is_in_its_nearest_cell(tip_mm, cell_mm):
    grid = fit_grid(tip_mm, cell_mm)
    assert grid.cells_along(tip_mm).tolist() == grid.cells_at(tip_mm).tolist()


@given(motions_mm, cells_mm, hystereses)
def test_a_sample_changes_to_the_nearest_cell_only_beyond_the_hysteresis(tip_mm, cell_mm, hysteresis):
    grid = fit_grid(tip_mm, cell_mm)
    cells = grid.cells_along(tip_mm, hysteresis)
    off = np.abs(tip_mm - np.array(grid.origin_mm) - cell_mm * cells).max(axis=1) / cell_mm  # cells
    assert (off <= 0.5 + hysteresis + 1e-9).all()
    nearest = grid.cells_at(tip_mm)
    assert (cells[0] == nearest[0]).all()
    for before, cell, near, tip in zip(cells, cells[1:], nearest[1:], tip_mm[1:], strict=False):
        if (cell != before).any():
            assert (cell == near).all()
            assert np.abs(tip - grid.origin_mm - cell_mm * before).max() / cell_mm > 0.5 + hysteresis - 1e-9


@given(motions_mm.filter(lambda tip_mm: np.ptp(tip_mm, axis=0).max() > 4), hystereses)
def test_a_path_is_never_longer_than_without_hysteresis(tip_mm, hysteresis):
    """It enters some of the nearest cells, in order, and a path that leaves places out is no longer."""
    grid = fit_grid(tip_mm, 1.0)
    assert len(discretize(tip_mm, grid, hysteresis).states) <= len(discretize(tip_mm, grid).states)


shaking = arrays(float, 80, elements=st.floats(-1, 1))


@given(shaking, st.floats(0.05, 0.5))
def test_a_tremor_within_the_hysteresis_crosses_no_face(shake, hysteresis):
    x_mm = 0.5 + 0.99 * hysteresis * shake
    assert set(along([0.0, *x_mm], hysteresis)) == {0}


@given(shaking, st.floats(0.05, 0.3), st.floats(0, 0.1))
def test_a_trembling_hand_that_goes_one_way_crosses_each_face_once(shake, hysteresis, pace_mm):
    x_mm = pace_mm * np.arange(80) + 0.99 * hysteresis * shake
    cells = along([0.0, *x_mm.clip(0)], hysteresis)
    assert (np.diff(cells) >= 0).all()


def test_without_hysteresis_such_a_hand_crosses_them_again_and_again():
    x_mm = 0.1 * np.arange(80) + 0.24 * (-1.0) ** np.arange(80)
    assert np.count_nonzero(np.diff(along(x_mm.clip(0), 0.0)) < 0) >= 8
    assert np.count_nonzero(np.diff(along(x_mm.clip(0), 0.25)) < 0) == 0


def test_the_goal_is_the_cell_that_the_last_sample_is_still_in():
    assert discretize([[0, 0, 0], [1, 0, 0], [1.7, 0, 0]], LINE, 0.25).goal == 1


def test_a_sample_outside_the_grid_is_refused_even_within_the_hysteresis():
    for hysteresis in (0.0, 0.25):
        with pytest.raises(OutsideGrid, match="1 of 3 points"):
            discretize([[0, 0, 0], [8, 0, 0], [8.6, 0, 0]], LINE, hysteresis)


@pytest.mark.parametrize("hysteresis", [-0.01, 0.51, np.nan, np.inf])
def test_a_hysteresis_that_cannot_be_meant_is_refused(hysteresis):
    tip_mm = [[0, 0, 0], [1, 0, 0]]
    for refused in (
        lambda: discretize(tip_mm, LINE, hysteresis),
        lambda: discretisation_rmse(tip_mm, LINE, hysteresis),
        lambda: GridPath(LINE, np.array([0, 1]), hysteresis=hysteresis),
    ):
        with pytest.raises(BadSettings, match=r"must be 0 to 0\.5 cells"):
            refused()


# ---- refused paths ----------------------------------------------------------------------------------------------


def test_an_empty_path_is_refused():
    with pytest.raises(EmptyPath):
        discretize(np.empty((0, 3)), PAPER_GRID)
    with pytest.raises(EmptyPath):
        GridPath(PAPER_GRID, np.array([], int))


def test_a_demo_that_never_leaves_the_goal_is_refused():
    with pytest.raises(NeverLeavesGoal, match="longer hand-off or take smaller cells"):
        discretize([[0, 50, -100], [1, 51, -101], [0, 50, -100]], PAPER_GRID)


@pytest.mark.parametrize("states", [[0, 2], [0, 0], [0, 1, 1]])
def test_a_path_with_gaps_or_repeats_is_refused(states):
    with pytest.raises(OutsideGrid, match="cells that touch"):
        GridPath(LINE, np.array(states))


@pytest.mark.parametrize("states", [[-1, 0], [8, 9]])
def test_a_path_through_states_that_the_grid_does_not_have_is_refused(states):
    with pytest.raises(OutsideGrid, match="does not have"):
        GridPath(LINE, np.array(states))


def test_samples_that_are_not_numbers_are_refused():
    with pytest.raises(OutsideGrid, match="NaN"):
        discretize([[0, 50, -100], [np.nan, 50, -100]], PAPER_GRID)


def test_a_path_is_one_row_of_states_and_cannot_be_changed():
    with pytest.raises(BadInput, match="shape"):
        GridPath(LINE, np.array([[0, 1]]))
    path = GridPath(LINE, np.array([0, 1]))
    with pytest.raises(ValueError, match="read-only"):
        path.states[0] = 5


@pytest.mark.parametrize("shape", [(5, 2), (5,), (3, 5, 3)])
def test_a_path_of_another_shape_is_refused_in_words(shape):
    with pytest.raises(BadPath, match=r"give a row of x, y and z in mm for each sample"):
        discretize(np.zeros(shape), GridWorld(ORIGIN, 5.0, (11, 11, 11)))
