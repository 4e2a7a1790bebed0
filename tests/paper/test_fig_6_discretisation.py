"""Fig. 6: the loss from rounding a raw recording to 5 mm."""

import numpy as np
import pytest

from skills.errors import OutsideGrid
from skills.gridworld.grid import PAPER_GRID, choose_grid, discretisation_rmse, discretize, fit_grid


@pytest.fixture(scope="module")
def raw_mm(paper_data):
    table = np.loadtxt(paper_data / "psm_poses_500hz.csv", delimiter=",", skiprows=1)
    return 1000 * table[:, 3:6]


def test_a_raw_recording_of_the_study_needs_no_bridge_at_5_mm(raw_mm):
    path = discretize(raw_mm, choose_grid(raw_mm))
    assert len(raw_mm) == 18407
    assert path.bridged == 0


def test_the_raw_path_is_off_the_papers_grid_and_demanding_it_is_refused(raw_mm):
    assert choose_grid(raw_mm) == fit_grid(raw_mm)
    with pytest.raises(OutsideGrid, match=f"{len(raw_mm)} of {len(raw_mm)} points are outside"):
        discretize(raw_mm, choose_grid(raw_mm, "paper"))


@pytest.mark.parametrize("cell_mm", [5.0, 2.5, 1.0])
def test_rounding_loses_about_what_a_uniform_error_would(raw_mm, cell_mm):
    rmse_mm = discretisation_rmse(raw_mm, fit_grid(raw_mm, cell_mm))
    # uniform over the cell: h / sqrt(12), 1.44 mm at 5 mm; no more than half a cell off in any case
    assert rmse_mm == pytest.approx((cell_mm / np.sqrt(12),) * 3, rel=0.25)


@pytest.mark.parametrize(
    ("cell_mm", "hysteresis", "states", "revisits", "lost_mm"),
    [
        (5.0, 0.0, 360, 225, 2.546),
        (5.0, 0.25, 214, 110, 3.088),
        (2.5, 0.0, 710, 277, 1.203),
        (2.5, 0.25, 458, 129, 1.387),
        (1.0, 0.0, 1683, 198, 0.557),
        (1.0, 0.25, 1067, 68, 0.612),
    ],
)
def test_hysteresis_halves_the_crossings_and_costs_a_tenth_of_a_cell(
    raw_mm, cell_mm, hysteresis, states, revisits, lost_mm
):
    grid = fit_grid(raw_mm, cell_mm)
    path = discretize(raw_mm, grid, hysteresis)
    assert (len(path.states), path.revisits, path.bridged) == (states, revisits, 0)
    assert np.linalg.norm(discretisation_rmse(raw_mm, grid, hysteresis)) == pytest.approx(lost_mm, abs=0.001)  # mm


def test_the_users_path_loses_nothing_since_it_was_published_rounded(user_table):
    assert discretisation_rmse(1000 * user_table[:, :3], PAPER_GRID) == pytest.approx((0, 0, 0), abs=1e-9)  # mm
