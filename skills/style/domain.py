"""Where a policy is defined: its phases, and the cells of each that it promises something about.

In the *cell* state of the paper there is one phase. In the *phase* state, ours, phase 0 is "not joined yet" and phase
p means "next is waypoint p"; so a path that crosses itself has another state at each crossing. The certified domain is
phase 0 everywhere, and phase p within `REACH` cells (Chebyshev) of waypoints p - 1 and p. Values are kept in *rows*:
phase p owns the box of cells around its two waypoints, and the rows of all boxes stand one after another.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skills.style._arrays import Ints
from skills.style.grid import MOVES, GridPath

REACH = 2  # cells; interface: a hand or an arm pushed two cells off its path is still led back
FINISHED = -1  # in the place of an action: the task is done here
OUTSIDE = -2  # in the place of an action: nothing is promised here, a client stops


@dataclass(frozen=True, eq=False)
class Domain:
    """The rows of a path's certified domain, in the phase state or (`phased` false) in the paper's cell state."""

    path: GridPath
    phased: bool

    @property
    def phases(self) -> int:
        """How many phases: one per waypoint, or one."""
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
        """How many cells each phase's box has along each axis, (P, 3)."""
        last = np.array(self.path.grid.shape) - 1
        high = np.tile(last, (self.phases, 1))
        if self.phased:
            cells = self.path.cells
            high[1:] = np.minimum(np.maximum(cells[:-1], cells[1:]) + REACH, last)
        return np.asarray(high - self.low + 1, np.int64)

    @cached_property
    def offset(self) -> Ints:
        """The first row of each phase, and after the last one the number of rows, (P + 1,)."""
        return np.concatenate(([0], np.cumsum(self.size.prod(axis=1)))).astype(np.int64)

    @property
    def n_rows(self) -> int:
        """The number of rows, boxes' corners outside the domain included."""
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
        """Whether each row is in the certified domain, (rows,); false only at some corners of the boxes."""
        return self.holds(self.phase_of, self.cell_of)

    @cached_property
    def terminal(self) -> NDArray[np.bool_]:
        """Whether each row is the goal in phase 0 or in the last phase, (rows,): finished."""
        ends = (self.phase_of == 0) | (self.phase_of == self.phases - 1)
        return np.asarray(ends & (self.state_of == self.path.goal))

    def holds(self, phases: ArrayLike, cells: ArrayLike) -> NDArray[np.bool_]:
        """Tell for each phase, (...,), and cell of the grid, (..., 3), whether it is in the certified domain."""
        phases, cells = np.asarray(phases), np.asarray(cells)
        waypoints = self.path.cells
        ahead = np.abs(cells - waypoints[phases]).max(axis=-1)
        behind = np.abs(cells - waypoints[phases - 1]).max(axis=-1)
        return np.asarray((phases == 0) | (np.minimum(ahead, behind) <= REACH))

    def rows_of(self, phases: ArrayLike, cells: ArrayLike) -> Ints:
        """Find the row of each phase, (...,), and cell, (..., 3); they must lie in the phase's box."""
        phases, cells = np.asarray(phases), np.asarray(cells)
        at = cells - self.low[phases]
        size = self.size[phases]
        return np.asarray(
            self.offset[phases] + (at[..., 0] * size[..., 1] + at[..., 1]) * size[..., 2] + at[..., 2], np.int64
        )

    @cached_property
    def joins(self) -> Ints:
        """The phase that *moving* onto each state in phase 0 leads to, (n_states,); 0: it stays "not joined".

        A state visited more than once joins at its first visit. The goal is 0: moving onto it in phase 0 finishes.
        """
        joins = np.zeros(self.path.grid.n_states, np.int64)
        if self.phased:
            joins[self.path.states[::-1]] = np.arange(self.phases, 0, -1)
            joins[self.path.goal] = 0
        return joins

    def start(self, state: int) -> tuple[int, bool]:
        """Start in a state: the phase, and whether that is already the end."""
        if not self.phased:
            return 0, state == self.path.goal
        visits = np.flatnonzero(self.path.states == state)
        if len(visits) == 0:
            return 0, False
        first = int(visits[0])
        done = first == self.phases - 1
        return (first if done else first + 1), done

    def enter(self, phase: int, state: int) -> tuple[int, bool]:
        """Move onto a state (or stay in it) in a phase: the phase after it, and whether that finishes."""
        if phase == 0:
            return int(self.joins[state]), state == self.path.goal
        if state != self.path.states[phase]:
            return phase, False
        done = phase == self.phases - 1
        return (phase if done else phase + 1), done

    def move(self, rows: Ints, actions: Ints) -> "Moves":
        """Take an action in each of some rows, both (N,): where each leads."""
        phase, here = self.phase_of[rows], self.cell_of[rows]
        cells = here + MOVES[actions]
        off_grid = ~self.path.grid.holds(cells)
        cells = np.where(off_grid[:, None], here, cells)
        state = self.path.grid.states_of(cells)
        ahead = ~off_grid & (phase > 0) & (state == self.path.states[phase])
        joins = np.where(off_grid | (phase > 0), 0, self.joins[state])
        at_goal = ~off_grid & (phase == 0) & (state == self.path.goal)
        finishes = at_goal | (ahead & (phase == self.phases - 1))
        after = np.where(joins > 0, joins, phase + (ahead & ~finishes))
        inside = self.holds(after, cells) & ~finishes
        row_after = np.full(len(rows), -1, np.int64)
        row_after[inside] = self.rows_of(after[inside], cells[inside])
        return Moves(row_after, state, finishes, ahead & ~finishes, off_grid)


@dataclass(frozen=True, eq=False)
class Moves:
    """Where moves lead, arrays of shape (N,): the row (-1: finished, or out of the domain), the state, and whether it
    finishes, advances to the next waypoint, or would have left the grid and stays.
    """

    row: Ints
    state: Ints
    finishes: NDArray[np.bool_]
    advances: NDArray[np.bool_]
    off_grid: NDArray[np.bool_]
