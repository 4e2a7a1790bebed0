import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skills.errors import BadInput, EmptyPath
from skills.gridworld.grid import PAPER_GRID, GridWorld, discretisation_rmse
from skills.learning.evaluation import TIE_BREAK, dtw, measure, warp
from skills.learning.policy import Rollout
from tests.gridworld.paths import named_path

whole_mm = st.integers(-20, 20).map(float)
paths_mm = st.integers(1, 8).flatmap(lambda n: arrays(float, (n, 3), elements=whole_mm))


def on_x(*x_mm):
    return [[x, 0, 0] for x in x_mm]


def test_two_paths_aligned_by_hand():
    apart = dtw(on_x(0, 3), on_x(0, 1, 3))
    assert apart.pairs.tolist() == [[0, 0], [0, 1], [1, 2]]
    assert apart.differences_mm.tolist() == on_x(0, 1, 0)
    assert apart.total_mm == 1


def test_the_distance_is_manhattans():
    assert dtw([[1, 2, 3]], [[2, 0, 6]]).total_mm == 1 + 2 + 3


def test_a_path_that_lingers_is_no_further_away():
    assert dtw(on_x(0, 0, 0, 5, 5, 10), on_x(0, 5, 10, 10)).total_mm == 0


def test_ties_go_back_through_both_paths_first_then_along_the_path():
    assert dtw(on_x(0, 0, 0), on_x(0, 0)).pairs.tolist() == [[0, 0], [1, 0], [2, 1]]
    assert "both paths together first" in TIE_BREAK


@settings(deadline=None)
@given(paths_mm)
def test_a_path_is_at_no_distance_from_itself(path_mm):
    apart = dtw(path_mm, path_mm)
    assert apart.total_mm == 0
    assert apart.pairs.tolist() == [[i, i] for i in range(len(path_mm))]


@settings(deadline=None)
@given(paths_mm, paths_mm)
def test_the_dtw_total_is_symmetric_reversible_and_never_negative(path_mm, other_mm):
    total_mm = dtw(path_mm, other_mm).total_mm
    assert total_mm >= 0
    assert dtw(other_mm, path_mm).total_mm == total_mm
    assert dtw(path_mm[::-1], other_mm[::-1]).total_mm == total_mm  # which breaks ties at the other end


@settings(deadline=None)
@given(paths_mm, paths_mm)
def test_an_alignment_goes_from_start_to_end_without_skipping(path_mm, other_mm):
    pairs = dtw(path_mm, other_mm).pairs
    assert pairs[0].tolist() == [0, 0]
    assert pairs[-1].tolist() == [len(path_mm) - 1, len(other_mm) - 1]
    assert {tuple(step) for step in np.diff(pairs, axis=0).tolist()} <= {(1, 1), (1, 0), (0, 1)}


short_mm = st.integers(1, 4).flatmap(lambda n: arrays(float, (n, 3), elements=whole_mm))


@settings(deadline=None)
@given(short_mm, short_mm)
def test_no_alignment_at_all_is_shorter_and_ties_have_the_same_total(path_mm, other_mm):
    def all_totals(i, j):
        here = np.abs(path_mm[i] - other_mm[j]).sum()
        if i == j == 0:
            return [here]
        before = [(i - 1, j - 1), (i - 1, j), (i, j - 1)]
        return [here + total for a, b in before if a >= 0 and b >= 0 for total in all_totals(a, b)]

    assert dtw(path_mm, other_mm).total_mm == min(all_totals(len(path_mm) - 1, len(other_mm) - 1))


def test_how_the_total_splits_over_the_axes_depends_on_the_tie_break_alone():
    path_mm, other_mm = [[0, 0, 0], [0, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    forth, back = dtw(path_mm, other_mm), dtw(np.flip(path_mm, 0), np.flip(other_mm, 0))
    assert forth.total_mm == back.total_mm == 2
    assert len({tuple(split) for split in (forth.differences_mm.sum(axis=0), back.differences_mm.sum(axis=0))}) == 2


@pytest.mark.nightly  # its library compiles for 12 s
def test_the_total_is_tslearns():
    from tslearn.metrics import dtw_path_from_metric  # here, because the import takes seconds

    rng = np.random.default_rng(0)
    for _ in range(30):
        path_mm, other_mm = (rng.normal(0, 20, (rng.integers(1, 60), 3)) for _ in range(2))
        _, total_mm = dtw_path_from_metric(path_mm, other_mm, metric="cityblock")
        assert dtw(path_mm, other_mm).total_mm == pytest.approx(total_mm, rel=1e-12)


@pytest.mark.parametrize(("path_mm", "other_mm"), [([], on_x(0)), (on_x(0), []), (np.empty((0, 3)), np.empty((0, 3)))])
def test_an_empty_path_is_refused(path_mm, other_mm):
    with pytest.raises(EmptyPath):
        dtw(path_mm, other_mm)


@pytest.mark.parametrize("path_mm", [on_x(0, np.nan), on_x(np.inf), [[0, 0]], [0, 0, 0]])
def test_points_that_are_no_places_are_refused(path_mm):
    with pytest.raises(BadInput):
        dtw(path_mm, on_x(0, 1))


def test_the_figures_of_table_1_by_hand():
    path = named_path("an angle")  # three cells along x, three along y
    shortcut = [0, 1, 2, 4, 5, 6]  # it cuts the corner, which is 5 mm from either neighbour
    metrics = measure(Rollout(path, path.states[shortcut], np.zeros(6, int), finished=True))
    assert metrics.dtw_total_mm == 5
    assert (metrics.exact_states, metrics.path_states) == (3, 7)
    assert sum(metrics.dtw_mean_mm) == pytest.approx(5 / 7, abs=1e-12)  # mm, over seven pairs
    for mean, std, rmse in zip(metrics.dtw_mean_mm, metrics.dtw_std_mm, metrics.rmse_mm, strict=True):
        assert rmse**2 == pytest.approx(mean**2 + std**2, abs=1e-12)  # mm^2
    assert metrics.rmse_mm[2] == 0


def test_the_demonstration_itself_is_exact():
    path = named_path("a figure of eight")
    metrics = measure(Rollout(path, path.states, np.zeros(len(path.states), int), finished=True), (1.0, 2.0, 3.0))
    assert (metrics.dtw_total_mm, metrics.exact_states, metrics.path_states) == (0, 17, 17)
    assert metrics.dtw_mean_mm == metrics.dtw_std_mm == metrics.rmse_mm == (0, 0, 0)
    assert metrics.discretisation_rmse_mm == (1, 2, 3)


def test_rounding_loses_what_the_samples_are_off_their_cells():
    grid = GridWorld((0.0, 0.0, 0.0), 10.0, (3, 3, 3))
    assert discretisation_rmse([[3, 0, 10], [13, 14, 10]], grid) == pytest.approx((3, np.sqrt(8), 0), abs=1e-12)  # mm
    assert discretisation_rmse(PAPER_GRID.centres_mm(np.arange(1331)), PAPER_GRID) == (0, 0, 0)


def test_with_hysteresis_the_loss_is_measured_from_the_samples_own_cells():
    grid = GridWorld((0.0, 0.0, 0.0), 10.0, (3, 3, 3))
    tip_mm = [[0, 0, 0], [7, 0, 0], [8, 0, 6]]  # at 7 mm still in cell 0; at 8 mm in cells 1 along x and 1 along z
    assert discretisation_rmse(tip_mm, grid, 0.25) == pytest.approx(
        (np.sqrt((7**2 + 2**2) / 3), 0, np.sqrt(4**2 / 3)), abs=1e-12
    )  # mm
    assert discretisation_rmse(tip_mm, grid) == pytest.approx(
        (np.sqrt((3**2 + 2**2) / 3), 0, np.sqrt(4**2 / 3)), abs=1e-12
    )  # mm


@settings(deadline=None)
@given(arrays(float, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.floats(0, 1e6)))
def test_the_compiled_warp_and_the_plain_one_agree_to_the_last_bit(distance):
    costs = []
    for fill in (warp.plain, warp):
        cost = np.full((distance.shape[0] + 1, distance.shape[1] + 1), np.inf)
        cost[0, 0] = 0.0
        fill(distance, cost)
        costs.append(cost.tobytes())
    assert costs[0] == costs[1]
