"""The certified domain of a policy: its phases, and the cells of each phase for which it guarantees an action.

In the *cell* state of the paper there is one phase. In the *phase* state, ours, phase 0 is "not joined yet" and phase
p means "the next waypoint is p"; so a path that crosses itself has a different state at each crossing. The certified
domain is all cells in phase 0, and in phase p the cells within `REACH` cells (Chebyshev) of waypoint p - 1 or p. Values
are stored in *rows*: phase p owns the box of cells around its two waypoints, and the rows of all boxes are
concatenated.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skills.arrays import Ints
from skills.gridworld.grid import MOVES, GridPath

REACH = 2  # cells; part of the interface: a hand or an arm pushed two cells off its path is still led back
FINISHED = -1  # in place of an action: the task is finished here
OUTSIDE = -2  # in place of an action: outside the certified domain, a client stops


@dataclass(frozen=True, eq=False)
class Domain:
    """The rows of a path's certified domain, in the phase state or, if `phased` is false, in the paper's cell state."""

    path: GridPath
    phased: bool

    @property
    def phases(self) -> int:
        """Number of phases P: one per waypoint in the phase state, 1 in the cell state."""
        return len(self.path.states) if self.phased else 1

    @cached_property
    def low(self) -> Ints:
        """The lowest cell of each phase's box, (P, 3)."""
        low = np.zeros((self.phases, 3), np.int64)
        if self.phased:
            cells = self.path.cells
            low[1:] = np.maximum(np.minimum(cells[:-1], cells[1:]) - REACH, 0)
        return low

    @cached_property
    def size(self) -> Ints:
        """Number of cells of each phase's box along each axis, (P, 3)."""
        last = np.array(self.path.grid.shape) - 1
        high = np.tile(last, (self.phases, 1))
        if self.phased:
            cells = self.path.cells
            high[1:] = np.minimum(np.maximum(cells[:-1], cells[1:]) + REACH, last)
        return np.asarray(high - self.low + 1, np.int64)

    @cached_property
    def offset(self) -> Ints:
        """The first row of each phase, followed by the number of rows, (P + 1,)."""
        return np.concatenate(([0], np.cumsum(self.size.prod(axis=1)))).astype(np.int64)

    @property
    def n_rows(self) -> int:
        """The number of rows, including the corners of boxes that lie outside the domain."""
        return int(self.offset[-1])

    @cached_property
    def phase_of(self) -> Ints:
        """The phase of each row, (rows,)."""
        return np.repeat(np.arange(self.phases), np.diff(self.offset))

    @cached_property
    def cell_of(self) -> Ints:
        """The cell of each row, (rows, 3)."""
        phase = self.phase_of
        size, at = self.size[phase], np.arange(self.n_rows) - self.offset[phase]
        rest, z = np.divmod(at, size[:, 2])
        x, y = np.divmod(rest, size[:, 1])
        return np.asarray(self.low[phase] + np.stack([x, y, z], axis=-1))

    @cached_property
    def state_of(self) -> Ints:
        """The state index of each row's cell, (rows,)."""
        return self.path.grid.states_of(self.cell_of)

    @cached_property
    def certified(self) -> NDArray[np.bool_]:
        """Flags of the rows in the certified domain, (rows,); false only at some corners of the boxes."""
        return self.holds(self.phase_of, self.cell_of)

    @cached_property
    def terminal(self) -> NDArray[np.bool_]:
        """Flags of the rows at which the task is finished, (rows,): the goal in phase 0 or in the last phase."""
        ends = (self.phase_of == 0) | (self.phase_of == self.phases - 1)
        return np.asarray(ends & (self.state_of == self.path.goal))

    def holds(self, phases: ArrayLike, cells: ArrayLike) -> NDArray[np.bool_]:
        """Return for each pair of a phase and a cell whether it is in the certified domain.

        Args:
            phases: Phases, shape (...,).
            cells: Cells of the grid, shape (..., 3).

        Returns:
            Flags of shape (...,).
        """
        phases, cells = np.asarray(phases), np.asarray(cells)
        waypoints = self.path.cells
        ahead = np.abs(cells - waypoints[phases]).max(axis=-1)
        behind = np.abs(cells - waypoints[phases - 1]).max(axis=-1)
        return np.asarray((phases == 0) | (np.minimum(ahead, behind) <= REACH))

    def rows_of(self, phases: ArrayLike, cells: ArrayLike) -> Ints:
        """Return the row of each pair of a phase and a cell; bounds are not checked.

        Args:
            phases: Phases, shape (...,).
            cells: Cells, shape (..., 3), each inside the box of its phase.

        Returns:
            Rows, shape (...,).
        """
        phases, cells = np.asarray(phases), np.asarray(cells)
        at = cells - self.low[phases]
        size = self.size[phases]
        return np.asarray(
            self.offset[phases] + (at[..., 0] * size[..., 1] + at[..., 1]) * size[..., 2] + at[..., 2], np.int64
        )

    @cached_property
    def joins(self) -> Ints:
        """The phase after *moving* onto each state in phase 0, (n_states,); 0 means that it stays "not joined".

        A state visited more than once joins at its first visit. The goal has 0: moving onto it in phase 0 finishes.
        """
        joins = np.zeros(self.path.grid.n_states, np.int64)
        if self.phased:
            # Assigned backwards, so that the first visit of a state overwrites later ones.
            joins[self.path.states[::-1]] = np.arange(self.phases, 0, -1)
            joins[self.path.goal] = 0
        return joins

    def start(self, state: int) -> tuple[int, bool]:
        """Return the phase of a pass that starts in a state, and whether it is finished there already."""
        if not self.phased:
            return 0, state == self.path.goal
        visits = np.flatnonzero(self.path.states == state)
        if len(visits) == 0:
            return 0, False
        first = int(visits[0])
        done = first == self.phases - 1
        return (first if done else first + 1), done

    def enter(self, phase: int, state: int) -> tuple[int, bool]:
        """Return the phase after moving onto a state (or staying in it) in a phase, and whether that finishes."""
        if phase == 0:
            return int(self.joins[state]), state == self.path.goal
        if state != self.path.states[phase]:
            return phase, False
        done = phase == self.phases - 1
        return (phase if done else phase + 1), done

    def move(self, rows: Ints, actions: Ints) -> "Moves":
        """Take an action in each of some rows, without slips.

        Args:
            rows: Rows, shape (N,).
            actions: Actions, 0 to 26, shape (N,).

        Returns:
            The result of each move.
        """
        phase, here = self.phase_of[rows], self.cell_of[rows]
        cells = here + MOVES[actions]
        off_grid = ~self.path.grid.holds(cells)
        cells = np.where(off_grid[:, None], here, cells)  # before `states_of`, which refuses cells off the grid
        state = self.path.grid.states_of(cells)
        ahead = ~off_grid & (phase > 0) & (state == self.path.states[phase])
        joins = np.where(off_grid | (phase > 0), 0, self.joins[state])
        at_goal = ~off_grid & (phase == 0) & (state == self.path.goal)
        finishes = at_goal | (ahead & (phase == self.phases - 1))
        after = np.where(joins > 0, joins, phase + (ahead & ~finishes))
        inside = self.holds(after, cells) & ~finishes
        row_after = np.full(len(rows), -1, np.int64)
        # Only where it is inside: cells beyond the box of a phase have no row.
        row_after[inside] = self.rows_of(after[inside], cells[inside])
        return Moves(row_after, state, finishes, ahead & ~finishes, off_grid)


@dataclass(frozen=True, eq=False)
class Moves:
    """The results of moves, arrays of shape (N,).

    Attributes:
        row: The row after the move; -1 if the task is finished or the row would be outside the domain.
        state: The state after the move.
        finishes: The move finishes the task.
        advances: The move enters the next waypoint, and the task goes on.
        off_grid: The move would have left the grid; the arm stays in its cell.
    """

    row: Ints
    state: Ints
    finishes: NDArray[np.bool_]
    advances: NDArray[np.bool_]
    off_grid: NDArray[np.bool_]
