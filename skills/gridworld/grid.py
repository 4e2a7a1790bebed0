"""The grid world of Sec. III-B and III-C: cells, the 27 moves, a path through them, and its error.

Symbols: a *cell* is three integers (ix, iy, iz); its *state* is the index (ix * ny + iy) * nz + iz, which the paper
calls StateToIndex; its centre is origin_mm + cell_mm * (ix, iy, iz). Everything is in the frame of the demonstration.

    tip --discretize--> GridPath
    Demo, GridPath --describe_path--> PathReport: the loss by the discretisation
"""

from dataclasses import dataclass
from itertools import pairwise
from math import isfinite, prod
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Flags, Floats, Ints, freeze, frozen, xyz
from skills.demonstration.demonstration import Demo
from skills.demonstration.quality import describe_count
from skills.errors import BadPath, BadSettings, EmptyPath, NeverLeavesGoal, OutsideGrid
from skills.fields import Count, Fraction, Point, percent, schema
from skills.gridworld import paper

MOVES = frozen([(a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)], np.int64, (27, 3), "moves")

FAR_MM = 10.0  # ours: a motion this far from the origin of its frame has no point within a millimetre of it
MAX_CELLS = 2**24  # ours: a table of rewards of 128 MiB; a larger grid is a mistake of units
MARGIN_CELLS = 2  # ours: room for a disturbed start around a fitted path
MAX_HYSTERESIS = 0.5  # cells, ours: with more, a sample beyond the centre of the next cell would not be in it

GridMode = Literal["auto", "paper", "fit"]
CALMING_HYSTERESIS = 0.25  # cells
CALMED_SHARE = 0.8  # of the states: if hysteresis reduces the path to this share, it trembles across faces


@dataclass(frozen=True)
class GridWorld:
    """A box of cubic cells.

    Attributes:
        origin_mm: Centre of cell (0, 0, 0), in the frame of the demonstration.
        cell_mm: Length of a cell's edge.
        shape: Number of cells along x, y and z.
    """

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
        """Return the nearest cell of each point in mm, both of shape (..., 3); it may lie outside the grid."""
        return np.floor((np.asarray(tip_mm, float) - self.origin_mm) / self.cell_mm + 0.5).astype(np.int64)

    def holds(self, cells: ArrayLike) -> Flags:
        """Return for each cell, (..., 3), whether it is in the grid."""
        cells = np.asarray(cells)
        inside = (cells >= 0) & (cells < self.shape)
        # Not `all`, which takes several times as long over an axis of three.
        return np.asarray(inside[..., 0] & inside[..., 1] & inside[..., 2])

    def states_of(self, cells: ArrayLike) -> Ints:
        """Return the states of cells, (..., 3): the paper's StateToIndex, with bounds checked.

        Without the check two cells could share a state.

        Raises:
            OutsideGrid: A cell is not in the grid.
        """
        cells = np.asarray(cells, np.int64)
        if not (inside := self.holds(cells)).all():
            bad = int(np.count_nonzero(~inside))
            raise OutsideGrid(
                f"{bad} of {inside.size} points are outside the grid.", points=bad, first=int(inside.argmin())
            )
        _, ny, nz = self.shape
        return np.asarray((cells[..., 0] * ny + cells[..., 1]) * nz + cells[..., 2], np.int64)

    def states_at(self, tip_mm: ArrayLike) -> Ints:
        """Return the state of the nearest cell of each point in mm, (..., 3).

        Raises:
            OutsideGrid: A point is not finite, or its nearest cell is not in the grid.
        """
        tip_mm = np.asarray(tip_mm, float)
        if not np.isfinite(tip_mm).all():
            raise OutsideGrid("A position contains NaN or infinity.")
        # Checked before the conversion to integers, which overflows for very large numbers.
        if not (np.abs(tip_mm - self.origin_mm) < self.cell_mm * MAX_CELLS).all():
            raise OutsideGrid("A position is far outside the grid.")
        if tip_mm.shape == (3,) and not self.holds(self.cells_at(tip_mm)).all():
            low, high = (self.centres_mm(np.array(state)) for state in (0, self.n_states - 1))
            raise OutsideGrid(
                f"{shown_mm(tip_mm)} is outside the grid with cell centres from {shown_mm(low)} to {shown_mm(high)}.",
                "Choose a position inside it.",
                points=1,
                first=0,
            )
        return self.states_of(self.cells_at(tip_mm))

    def cells_along(self, tip_mm: ArrayLike, hysteresis: float = 0.0) -> Ints:
        """Return the cell of each sample of a motion.

        A sample stays in the cell of the sample before until it is more than 0.5 + `hysteresis` cells from that cell's
        centre along some axis; then it goes to its nearest cell. Without hysteresis every sample is in its nearest
        cell.

        Args:
            tip_mm: Samples in order, shape (T, 3), in the grid's frame.
            hysteresis: In cells, 0 to `MAX_HYSTERESIS`.

        Returns:
            Cells, shape (T, 3).

        Raises:
            OutsideGrid: A sample is not finite, or its nearest cell is not in the grid.
            BadSettings: The hysteresis is not between 0 and `MAX_HYSTERESIS`.
        """
        _check_hysteresis(hysteresis)
        nearest = self.cells_of(self.states_at(tip_mm))
        if hysteresis == 0 or len(nearest) == 0:
            return nearest
        places = (np.asarray(tip_mm, float) - self.origin_mm) / self.cell_mm
        (a, b, c), reach = nearest[0].tolist(), 0.5 + hysteresis
        entered, entries = 0, []  # for each sample, the index of the sample that entered its cell
        for index, (x, y, z) in enumerate(zip(*places.T.tolist(), strict=True)):
            if abs(x - a) > reach or abs(y - b) > reach or abs(z - c) > reach:
                entered, (a, b, c) = index, nearest[index].tolist()
            entries.append(entered)
        return nearest[entries]

    def cells_of(self, states: ArrayLike) -> Ints:
        """Return the cells, (..., 3), of state indices, (...,)."""
        return np.stack(np.unravel_index(np.asarray(states, np.int64), self.shape), axis=-1).astype(np.int64)

    def centres_mm(self, states: ArrayLike) -> Floats:
        """Return the centres in mm, (..., 3), of the cells of states, (...,)."""
        return self.centres_of(self.cells_of(states))

    def centres_of(self, cells: ArrayLike) -> Floats:
        """Return the centres in mm, (..., 3), of cells, (..., 3)."""
        return np.asarray(np.asarray(self.origin_mm) + self.cell_mm * np.asarray(cells), np.float64)


def moves_between(cells: Ints, others: Ints) -> Ints:
    """Return the least number of moves between cells, (...,): the largest difference along an axis.

    Args:
        cells: Cells, shape (..., 3).
        others: Other cells, of the same shape, or one cell.
    """
    away = np.abs(cells - others)
    # Not `max`, which takes several times as long over an axis of three.
    return np.asarray(np.maximum(np.maximum(away[..., 0], away[..., 1]), away[..., 2]))


PAPER_GRID = GridWorld(paper.GRID_ORIGIN_MM, paper.CELL_MM, paper.GRID_SHAPE)


@dataclass(frozen=True, eq=False)
class GridPath:
    """A demonstration as the sequence of states it visits: neighbours differ by one move; it leaves its goal's cell.

    Attributes:
        grid: The grid world.
        states: State indices, shape (R,), R at least 2.
        bridged: Number of states in which no sample of the recording lies.
        hysteresis: The hysteresis, in cells, with which the samples were assigned to cells.
    """

    grid: GridWorld
    states: Ints
    bridged: int = 0
    hysteresis: float = 0.0

    def __post_init__(self) -> None:
        _check_hysteresis(self.hysteresis)
        freeze(self, np.int64, states=(None,))
        if len(self.states) == 0:
            raise EmptyPath("The path has no points; give at least two positions.")
        if self.states.min() < 0 or self.states.max() >= self.grid.n_states:
            raise OutsideGrid("The path names states that the grid does not have.")
        if len(self.states) == 1:
            raise NeverLeavesGoal(
                f"The complete path is in one cell of {self.grid.cell_mm:g} mm, that of its goal; record a longer "
                "hand-off or take smaller cells."
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
        """The first state of the demonstration."""
        return int(self.states[0])

    @property
    def goal(self) -> int:
        """The last state of the demonstration: the hand-off."""
        return int(self.states[-1])

    @property
    def revisits(self) -> int:
        """Number of states that the path had visited before; 0 if it never crosses itself."""
        return len(self.states) - len(np.unique(self.states))


def fit_grid(tip_mm: ArrayLike, cell_mm: float = paper.CELL_MM, margin_cells: int = MARGIN_CELLS) -> GridWorld:
    """Fit a grid around points: its cells' centres are whole multiples of the cell, with a margin on every side.

    Args:
        tip_mm: Points, shape (T, 3).
        cell_mm: Length of a cell's edge.
        margin_cells: Cells added on each side.

    Returns:
        The grid, in the frame of the points.

    Raises:
        EmptyPath: There are no points.
        BadSettings: The cell is not a positive length, or the grid would have more than `MAX_CELLS`.
    """
    tip_mm = frozen(tip_mm, np.float64, (None, 3), "tip_mm")
    if len(tip_mm) == 0:
        raise EmptyPath("A grid cannot be fitted to no points.")
    if not (isfinite(cell_mm) and cell_mm > 0):
        raise BadSettings("cell_mm must be a positive length in mm.", cell_mm=cell_mm)
    # On whole multiples, so that grids of one cell size have their centres in common.
    low = np.floor(tip_mm.min(axis=0) / cell_mm) - margin_cells
    high = np.ceil(tip_mm.max(axis=0) / cell_mm) + margin_cells
    x, y, z = (float(v) for v in low * cell_mm)
    nx, ny, nz = (int(n) for n in high - low + 1)
    return GridWorld((x, y, z), float(cell_mm), (nx, ny, nz))


def choose_grid(tip_mm: ArrayLike, mode: GridMode = "auto", cell_mm: float | None = None) -> GridWorld:
    """Choose the grid of a demonstration: the paper's if all points lie inside it, otherwise a fitted one.

    Args:
        tip_mm: Points, shape (T, 3), in the frame of the demonstration.
        mode: "paper" requires the paper's grid (`discretize` then refuses points outside it), "fit" always fits a grid,
            "auto" chooses.
        cell_mm: Length of a cell's edge; None for the paper's 5 mm. Any other length needs a fitted grid.

    Returns:
        The grid.

    Raises:
        BadSettings: `mode` is "paper" and `cell_mm` is not 5 mm, or as for `fit_grid`.
        EmptyPath: A grid is to be fitted, and there are no points.
    """
    other_cell = cell_mm is not None and cell_mm != paper.CELL_MM
    if mode == "paper" and other_cell:
        raise BadSettings("The paper's grid has cells of 5 mm; omit cell_mm or request grid 'fit'.")
    if mode == "paper":
        return PAPER_GRID
    if mode == "auto" and not other_cell and PAPER_GRID.holds(PAPER_GRID.cells_at(tip_mm)).all():
        return PAPER_GRID
    return fit_grid(tip_mm, paper.CELL_MM if cell_mm is None else cell_mm)


def refuse_metres(what: str, position_mm: ArrayLike, known_mm: ArrayLike) -> None:
    """Refuse a position given in metres: within 1 mm of the origin, while the motion is far from it.

    Args:
        what: Name of the position, for the beginning of the message.
        position_mm: The position, shape (3,).
        known_mm: A position of the motion in the same frame, shape (3,).

    Raises:
        OutsideGrid: The position is not 0, its coordinates are all below 1 mm, and `known_mm` is more than `FAR_MM`
            from the origin along some axis.
    """
    position, known = np.asarray(position_mm, float), np.asarray(known_mm, float)
    if 0 < np.abs(position).max() < 1 and np.abs(known).max() > FAR_MM:
        raise OutsideGrid(
            f"{what} {shown_mm(position)} is less than 1 mm from the origin: it seems to be in metres.",
            f"Give millimetres: {shown_mm(position * 1000)}.",
            position_mm=position.tolist(),
        )


def shown_mm(position_mm: ArrayLike) -> str:
    """Format a position for a message.

    Args:
        position_mm: The position, shape (3,).

    Returns:
        Text such as "(1, 2.5, -3) mm".
    """
    return f"({', '.join(f'{value:g}' for value in np.asarray(position_mm, float))}) mm"


def discretize(tip_mm: ArrayLike, grid: GridWorld, hysteresis: float = 0.0) -> GridPath:
    """Return the states that a recorded motion visits (Sec. III-B, Fig. 6).

    Each sample goes to its nearest cell, consecutive repeats are removed, and a jump over more than one cell is
    bridged by the straight line of touching cells. Hysteresis is ours: with it a hand that trembles across the face of
    a cell does not cross it again and again.

    Args:
        tip_mm: Samples in order, shape (T, 3), in the grid's frame.
        grid: The grid world.
        hysteresis: Distance beyond its cell's face up to which a sample stays in the cell (`GridWorld.cells_along`), 0
            to 0.5 cells. 0.25 shortens the path of a raw 500 Hz recording by two fifths; `discretisation_rmse` measures
            the loss of accuracy.

    Returns:
        The path, at least two states.

    Raises:
        EmptyPath: There are no samples.
        BadPath: The samples are not rows of three numbers.
        OutsideGrid: Some samples lie outside the grid.
        NeverLeavesGoal: All samples lie in one cell.
        BadSettings: The hysteresis is not between 0 and `MAX_HYSTERESIS`.
    """
    tip_mm = np.asarray(tip_mm, float)
    if tip_mm.size == 0:
        raise EmptyPath("The demonstration has no samples.")
    if tip_mm.ndim != 2 or tip_mm.shape[1] != 3:
        raise BadPath(
            f"tip_mm has the shape {tip_mm.shape}; give a row of x, y and z in mm for each sample, shape (T, 3).",
            shape=tip_mm.shape,
        )
    cells = grid.cells_along(tip_mm, hysteresis)
    cells = cells[np.concatenate(([True], (np.diff(cells, axis=0) != 0).any(axis=1)))]
    bridged = [cells[:1], *(_straight(a, b) for a, b in pairwise(cells))]
    path = np.concatenate(bridged)
    return GridPath(grid, grid.states_of(path), bridged=len(path) - len(cells), hysteresis=hysteresis)


def _check_hysteresis(hysteresis: float) -> None:
    if not 0 <= hysteresis <= MAX_HYSTERESIS:
        raise BadSettings(f"A hysteresis must be 0 to {MAX_HYSTERESIS} cells.", hysteresis=hysteresis)


def _straight(a: Ints, b: Ints) -> Ints:
    """Return the touching cells on the straight line from cell a to cell b, without a and with b."""
    n = int(np.abs(b - a).max())
    return np.floor(a + (b - a) * (np.arange(1, n + 1) / n)[:, None] + 0.5).astype(np.int64)


# ---- the loss of discretisation ------------------------------------------------------------------------------------


@schema
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
    returns: Count
    discretisation_rmse_mm: Point
    discretisation_rmse_3d_mm: float
    outside_paper_grid_share: Fraction
    advised_hysteresis: float | None
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
        discretisation_rmse_3d_mm=float(np.linalg.norm(lost_mm, axis=-1)),
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
    became_mm, was_mm = np.linalg.norm([calm_mm, lost_mm], axis=1)
    return CALMING_HYSTERESIS, (
        f"The path returns to the cell that it has just left {describe_count(returns)}, as with a tremor at a "
        f"cell face. Request hysteresis {CALMING_HYSTERESIS}: {len(calm.states)} states instead of "
        f"{len(path.states)}, at {became_mm:.1f} instead of {was_mm:.1f} mm.",
    )


def _about_the_papers_grid(outside: float, path: GridPath) -> tuple[str, ...]:
    """Return the advice that the samples are not all in the paper's grid."""
    size = " x ".join(f"{count}" for count in path.grid.shape)
    share = "all" if outside == 1 else f"{percent(outside)}%"
    return (
        f"{share.capitalize()} of the samples are outside the paper's grid "
        f"({' x '.join(str(n) for n in paper.GRID_SHAPE)} cells of {paper.CELL_MM:g} mm), so a grid of {size} was "
        "fitted: learning works as well, but the grid is not the paper's.",
    )
