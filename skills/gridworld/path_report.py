"""Discretisation loss: a demonstration compared with its path through the cells.

Demo, GridPath --describe_path--> PathReport
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import xyz
from skills.demonstration.demonstration import Demo
from skills.demonstration.quality import times_in_words
from skills.fields import Count, Fraction, Point, stored_schema
from skills.gridworld import paper
from skills.gridworld.grid import PAPER_GRID, GridPath, GridWorld, discretize

CALMING_HYSTERESIS = 0.25  # cells
CALMED_SHARE = 0.8  # of the states: if hysteresis reduces the path to this share, it trembles across faces


@stored_schema
@dataclass(frozen=True, kw_only=True)
class PathReport:
    """The measures of a demonstration's path through its grid world.

    Attributes:
        path_states: Number of states that the path visits.
        revisits: Number of them that it had visited before; 0 if it never crosses itself.
        bridged_cells: Number of them in which no sample lies.
        returns: Number of moves back into the cell that the path has just left.
        discretisation_rmse_mm: Discretisation error along x, y and z.
        discretisation_rmse_3d_mm: The same as one length.
        outside_paper_grid_share: Share of the samples outside the paper's grid, 0 to 1.
        advised_hysteresis: Hysteresis in cells that would remove the tremor; None if none is advised.
        advice: Sentences to the surgeon.
    """

    path_states: Count
    revisits: Count
    bridged_cells: Count
    returns: Count | None = None
    discretisation_rmse_mm: Point
    discretisation_rmse_3d_mm: float | None = None
    outside_paper_grid_share: Fraction | None = None
    advised_hysteresis: float | None = None
    advice: tuple[str, ...]


def describe_path(demo: Demo, path: GridPath) -> PathReport:
    """Measure the path of a demonstration through its grid, and the error of the discretisation.

    Args:
        demo: The demonstration.
        path: Its path, as `discretize` returns it.

    Returns:
        The measures and the advice in words.
    """
    lost_mm = discretisation_rmse(demo.tip_mm, path.grid, path.hysteresis)
    outside = float((~PAPER_GRID.holds(PAPER_GRID.cells_at(demo.tip_mm))).mean())
    returns = int((path.states[2:] == path.states[:-2]).sum())
    advised, advice = _calming(demo, path, returns, lost_mm)
    if outside > 0:
        advice += _about_the_papers_grid(outside, path)
    return PathReport(
        path_states=len(path.states),
        revisits=path.revisits,
        bridged_cells=path.bridged,
        returns=returns,
        discretisation_rmse_mm=lost_mm,
        discretisation_rmse_3d_mm=float(np.linalg.norm(lost_mm)),
        outside_paper_grid_share=outside,
        advised_hysteresis=advised,
        advice=advice,
    )


def discretisation_rmse(tip_mm: ArrayLike, grid: GridWorld, hysteresis: float = 0.0) -> tuple[float, float, float]:
    """Return the RMSE between samples and the centres of their cells.

    With hysteresis the cells are not always the nearest ones (`GridWorld.cells_along`).

    Args:
        tip_mm: Samples in order, shape (T, 3), in the grid's frame.
        grid: The grid world.
        hysteresis: In cells.

    Returns:
        The errors in mm along x, y and z.

    Raises:
        OutsideGrid: Some samples lie outside the grid.
        BadSettings: The hysteresis is not between 0 and 0.5 cells.
    """
    tip_mm = np.asarray(tip_mm, float)
    apart = tip_mm - grid.centres_of(grid.cells_along(tip_mm, hysteresis))
    return xyz(np.sqrt((apart**2).mean(axis=0)))


def _calming(
    demo: Demo, path: GridPath, returns: int, lost_mm: tuple[float, float, float]
) -> tuple[float | None, tuple[str, ...]]:
    """Return the advised hysteresis and its advice if the path trembles across the faces of its cells."""
    # A path that already has this hysteresis gains nothing from the advice.
    if path.hysteresis >= CALMING_HYSTERESIS or returns == 0:
        return None, ()
    calm = discretize(demo.tip_mm, path.grid, CALMING_HYSTERESIS)
    if len(calm.states) > CALMED_SHARE * len(path.states):
        return None, ()
    calm_mm = discretisation_rmse(demo.tip_mm, path.grid, CALMING_HYSTERESIS)
    return CALMING_HYSTERESIS, (
        f"The path returns to the cell that it has just left {times_in_words(returns)}, as with a tremor at a "
        f"cell face. Request hysteresis {CALMING_HYSTERESIS}: {len(calm.states)} states instead of "
        f"{len(path.states)}, at {np.linalg.norm(calm_mm):.1f} instead of {np.linalg.norm(lost_mm):.1f} mm.",
    )


def _about_the_papers_grid(outside: float, path: GridPath) -> tuple[str, ...]:
    size = " x ".join(f"{count}" for count in path.grid.shape)
    share = "all" if outside == 1 else f"{outside:.0%}"
    return (
        f"{share.capitalize()} of the samples are outside the paper's grid "
        f"({' x '.join(str(n) for n in paper.GRID_SHAPE)} cells of {paper.CELL_MM:g} mm), so a grid of {size} was "
        "fitted: learning works as well, but the grid is not the paper's.",
    )
