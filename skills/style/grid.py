"""The grid world of Sec. III-B and III-C: cells of a PSM's workspace, the 27 moves, and a path through them.

Symbols: a *cell* is three integers (ix, iy, iz); its *state* is the index (ix * ny + iy) * nz + iz, which the paper
calls StateToIndex; its centre is origin_mm + cell_mm * (ix, iy, iz). Everything is in the frame of the demonstration.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import isfinite, prod
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from skills.errors import BadSettings, EmptyPath, NeverLeavesGoal, OutsideGrid
from skills.style import paper
from skills.style._arrays import Floats, Ints, frozen

MOVES = frozen([(a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)], np.int64, (27, 3), "moves")
MOVES_NOTE = "action = 9a + 3b + c, with a, b, c in {0, 1, 2} for -1, 0, +1 cell along x, y, z"

MAX_CELLS = 2**24  # ours: a table of rewards of 128 MiB; more is a slip of the units
MARGIN_CELLS = 2  # ours: room for a disturbed start around a fitted path
MAX_HYSTERESIS = 0.5  # cells, ours: with more, a sample beyond the centre of the next cell would not be in it

GridMode = Literal["auto", "paper", "fit"]


@dataclass(frozen=True)
class GridWorld:
    """A box of cubic cells; `shape` counts them along x, y and z."""

    origin_mm: tuple[float, float, float]
    cell_mm: float
    shape: tuple[int, int, int]

    def __post_init__(self) -> None:
        if not (isfinite(self.cell_mm) and self.cell_mm > 0 and all(map(isfinite, self.origin_mm))):
            raise BadSettings("A grid needs a finite origin and a positive cell_mm.", cell_mm=self.cell_mm)
        if min(self.shape) < 1 or self.n_states < 2:
            raise BadSettings("A grid needs at least one cell along each axis and two in all.", shape=self.shape)
        if self.n_states > MAX_CELLS:
            raise BadSettings(
                f"A grid of {self.n_states} cells is over the limit of {MAX_CELLS}; take larger cells.",
                shape=self.shape,
            )

    @property
    def n_states(self) -> int:
        """The number of cells."""
        return prod(self.shape)

    def cells_at(self, tip_mm: ArrayLike) -> Ints:
        """Find the nearest cell of each point, (..., 3); it may lie outside the grid."""
        return np.floor((np.asarray(tip_mm, float) - self.origin_mm) / self.cell_mm + 0.5).astype(np.int64)

    def holds(self, cells: ArrayLike) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Tell for each cell, (..., 3), whether it is in the grid."""
        cells = np.asarray(cells)
        return np.asarray(((cells >= 0) & (cells < self.shape)).all(axis=-1))

    def states_of(self, cells: ArrayLike) -> Ints:
        """Number cells, (..., 3): the paper's StateToIndex, with its bounds checked so that no two places share one.

        Raises:
            OutsideGrid: A cell is not in the grid.
        """
        cells = np.asarray(cells, np.int64)
        if not (inside := self.holds(cells)).all():
            bad = int(np.count_nonzero(~inside))
            raise OutsideGrid(f"{bad} of {inside.size} points lie outside the grid.", points=bad, first=_first(inside))
        _, ny, nz = self.shape
        return np.asarray((cells[..., 0] * ny + cells[..., 1]) * nz + cells[..., 2], np.int64)

    def states_at(self, tip_mm: ArrayLike) -> Ints:
        """Number the nearest cell of each point in mm, (..., 3).

        Raises:
            OutsideGrid: A point is not finite or is nearer to a cell that the grid does not have.
        """
        tip_mm = np.asarray(tip_mm, float)
        if not np.isfinite(tip_mm).all():
            raise OutsideGrid("A position has NaN or infinity in it.")
        if not (np.abs(tip_mm - self.origin_mm) < self.cell_mm * MAX_CELLS).all():
            raise OutsideGrid("A position lies far outside the grid.")
        return self.states_of(self.cells_at(tip_mm))

    def cells_along(self, tip_mm: ArrayLike, hysteresis: float = 0.0) -> Ints:
        """Find the cell of each sample of a motion, (T, 3) mm in order: (T, 3).

        A sample stays in the cell of the one before it until it is more than 0.5 + `hysteresis` cells from that cell's
        centre along some axis; then it goes to its nearest cell. Without hysteresis all are in their nearest cells.

        Raises:
            OutsideGrid: A sample is not finite or is nearer to a cell that the grid does not have.
            BadSettings: The hysteresis is not between 0 and `MAX_HYSTERESIS`.
        """
        _check_hysteresis(hysteresis)
        nearest = self.cells_of(self.states_at(tip_mm))
        if hysteresis == 0 or len(nearest) == 0:
            return nearest
        places = (np.asarray(tip_mm, float) - self.origin_mm) / self.cell_mm
        (a, b, c), reach = nearest[0].tolist(), 0.5 + hysteresis
        entered, entries = 0, []  # the sample that entered the cell which each one is in
        for index, (x, y, z) in enumerate(zip(*places.T.tolist(), strict=True)):
            if abs(x - a) > reach or abs(y - b) > reach or abs(z - c) > reach:
                entered, (a, b, c) = index, nearest[index].tolist()
            entries.append(entered)
        return nearest[entries]

    def cells_of(self, states: ArrayLike) -> Ints:
        """Turn state indices, (...,), back into cells, (..., 3)."""
        return np.stack(np.unravel_index(np.asarray(states, np.int64), self.shape), axis=-1).astype(np.int64)

    def centres_mm(self, states: ArrayLike) -> Floats:
        """Place states, (...,), at the centres of their cells, (..., 3) mm."""
        return self.centres_of(self.cells_of(states))

    def centres_of(self, cells: ArrayLike) -> Floats:
        """Place cells, (..., 3), at their centres, (..., 3) mm."""
        return np.asarray(np.asarray(self.origin_mm) + self.cell_mm * np.asarray(cells), np.float64)


PAPER_GRID = GridWorld(paper.GRID_ORIGIN_MM, paper.CELL_MM, paper.GRID_SHAPE)


@dataclass(frozen=True, eq=False)
class GridPath:
    """A demonstration as the states it visits, in order; neighbours differ by one move, and it leaves its goal's cell.

    `states` is (R,), at least two; `bridged` counts those that no sample of the recording lies in; `hysteresis`, in
    cells, is the one that the samples were put into their cells with.
    """

    grid: GridWorld
    states: Ints
    bridged: int = 0
    hysteresis: float = 0.0

    def __post_init__(self) -> None:
        _check_hysteresis(self.hysteresis)
        object.__setattr__(self, "states", frozen(self.states, np.int64, (None,), "states"))
        if len(self.states) == 0:
            raise EmptyPath("The path has no points; give at least two places.")
        if self.states.min() < 0 or self.states.max() >= self.grid.n_states:
            raise OutsideGrid("The path names states that the grid does not have.")
        if len(self.states) == 1:
            raise NeverLeavesGoal(
                f"The whole path lies in one cell of {self.grid.cell_mm:g} mm, its goal's; "
                "record a longer hand-off or take smaller cells."
            )
        steps = np.abs(np.diff(self.cells, axis=0)).max(axis=1)
        if steps.min() == 0 or steps.max() > 1:
            raise OutsideGrid("Neighbours on a path must be different cells that touch; use `discretize`.")

    @property
    def cells(self) -> Ints:
        """The path as cells, (R, 3)."""
        return self.grid.cells_of(self.states)

    @property
    def tip_mm(self) -> Floats:
        """The path through the centres of its cells, (R, 3) mm."""
        return self.grid.centres_mm(self.states)

    @property
    def start(self) -> int:
        """The state where the demonstration starts."""
        return int(self.states[0])

    @property
    def goal(self) -> int:
        """The state where the demonstration ends: the hand-off."""
        return int(self.states[-1])

    @property
    def revisits(self) -> int:
        """How many of its states the path had visited before: 0 where it never crosses itself."""
        return len(self.states) - len(np.unique(self.states))


def fit_grid(tip_mm: ArrayLike, cell_mm: float = paper.CELL_MM, margin_cells: int = MARGIN_CELLS) -> GridWorld:
    """Lay a grid around points, (T, 3) mm, on whole multiples of the cell, with a margin on every side.

    Raises:
        EmptyPath: There are no points.
        BadSettings: The cell is not a positive length, or the grid would have more than `MAX_CELLS`.
    """
    tip_mm = frozen(tip_mm, np.float64, (None, 3), "tip_mm")
    if len(tip_mm) == 0:
        raise EmptyPath("There are no points to fit a grid to.")
    if not (isfinite(cell_mm) and cell_mm > 0):
        raise BadSettings("cell_mm must be a positive length in mm.", cell_mm=cell_mm)
    low = np.floor(tip_mm.min(axis=0) / cell_mm) - margin_cells
    high = np.ceil(tip_mm.max(axis=0) / cell_mm) + margin_cells
    x, y, z = (float(v) for v in low * cell_mm)
    nx, ny, nz = (int(n) for n in high - low + 1)
    return GridWorld((x, y, z), float(cell_mm), (nx, ny, nz))


def choose_grid(tip_mm: ArrayLike, mode: GridMode = "auto", cell_mm: float | None = None) -> GridWorld:
    """Choose the grid of a demonstration: the paper's where its points lie inside it, else a fitted one.

    `paper` demands the paper's grid (and `discretize` then refuses points outside it), `fit` always fits. Another
    cell than the paper's 5 mm means a fitted grid.
    """
    other_cell = cell_mm is not None and cell_mm != paper.CELL_MM
    if mode == "paper" and other_cell:
        raise BadSettings("The paper's grid has cells of 5 mm; leave cell_mm out or ask for grid 'fit'.")
    if mode == "paper":
        return PAPER_GRID
    if mode == "auto" and not other_cell and PAPER_GRID.holds(PAPER_GRID.cells_at(tip_mm)).all():
        return PAPER_GRID
    return fit_grid(tip_mm, paper.CELL_MM if cell_mm is None else cell_mm)


def discretize(tip_mm: ArrayLike, grid: GridWorld, hysteresis: float = 0.0) -> GridPath:
    """Turn a recorded motion into the states it visits (Sec. III-B, Fig. 6).

    Each sample goes to its nearest cell, consecutive repeats are removed, and a jump over more than one cell is
    bridged by the straight line of touching cells. Hysteresis is ours: a hand that trembles across a face does not
    cross it again and again.

    Args:
        tip_mm: Samples in order, shape (T, 3), in the grid's frame.
        grid: The grid world.
        hysteresis: How far beyond its cell's face a sample stays in it (`GridWorld.cells_along`): 0 to 0.5 cells. 0.25
            takes two fifths off the path of a raw 500 Hz recording; `discretisation_rmse` says what is lost.

    Raises:
        EmptyPath: No samples.
        OutsideGrid: Some samples lie outside the grid.
        NeverLeavesGoal: All samples lie in one cell.
        BadSettings: The hysteresis cannot be meant.
    """
    tip_mm = np.asarray(tip_mm, float)
    if len(tip_mm) == 0:
        raise EmptyPath("The demonstration has no samples.")
    cells = grid.cells_along(tip_mm, hysteresis)
    cells = cells[np.concatenate(([True], (np.diff(cells, axis=0) != 0).any(axis=1)))]
    bridged = [cells[:1], *(_straight(a, b) for a, b in pairwise(cells))]
    path = np.concatenate(bridged)
    return GridPath(grid, grid.states_of(path), bridged=len(path) - len(cells), hysteresis=hysteresis)


def _check_hysteresis(hysteresis: float) -> None:
    if not 0 <= hysteresis <= MAX_HYSTERESIS:
        raise BadSettings(f"A hysteresis is from 0 to {MAX_HYSTERESIS} cells.", hysteresis=hysteresis)


def _straight(a: Ints, b: Ints) -> Ints:
    """Walk from cell a to cell b through touching cells: those after a, b included."""
    n = int(np.abs(b - a).max())
    return np.floor(a + (b - a) * (np.arange(1, n + 1) / n)[:, None] + 0.5).astype(np.int64)


def _first(inside: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> int:
    """Find which point is the first one outside."""
    return int(np.argmin(inside))
