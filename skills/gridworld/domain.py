"""The certified domain of a policy: its phases, and the cells of each phase for which it guarantees an action.

In the *cell* state of the paper there is one phase. In the *phase* state, ours, phase 0 is "not joined yet" and phase
p means "the next waypoint is p"; so a path that crosses itself has a different state at each crossing. The certified
domain is all cells in phase 0, and in phase p the cells within `REACH` cells (Chebyshev) of waypoint p - 1 or p. Values
are stored in *rows*: phase p owns the box of cells around its two waypoints, and the rows of all boxes are
concatenated.

The *joining rule* says at which waypoints a pass joins the path: at those from which at least a share `join_share` of
the demonstration's moves is left. 0 is the rule *nearest*: every waypoint joins, and the goal itself finishes. 1 is the
rule *start*: only the first waypoint joins. A waypoint that does not join is, in phase 0, a cell like any other. The
paper's cell state has no phases to join, so it has the rule nearest only.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Flags, Floats, Ints
from skills.errors import BadSettings
from skills.gridworld.grid import MOVES, GridPath, moves_between
from skills.gridworld.reward import RewardMap

REACH = 2  # cells; part of the interface: a hand or an arm pushed two cells off its path is still led back
FINISHED = -1  # in place of an action: the task is finished here
OUTSIDE = -2  # in place of an action: outside the certified domain, a client stops


def check_join_share(join_share: float) -> None:
    """Refuse a joining rule that is not a share.

    Args:
        join_share: The least share of the demonstration that must be left where a pass joins it.

    Raises:
        BadSettings: It is not a number from 0 to 1.
    """
    if not 0 <= join_share <= 1:
        raise BadSettings("join_share must lie in [0, 1].", join_share=join_share)


@dataclass(frozen=True, eq=False)
class Domain:
    """The rows of a path's certified domain, in the phase state or, if `phased` is false, in the paper's cell state.

    Attributes:
        path: The demonstrated path.
        phased: Whether it is in the phase state.
        join_share: The joining rule, 0 to 1; 0 in the cell state.
    """

    path: GridPath
    phased: bool
    join_share: float = 0.0

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
    def certified(self) -> Flags:
        """Flags of the rows in the certified domain, (rows,); false only at some corners of the boxes."""
        return self.holds(self.phase_of, self.cell_of)

    @cached_property
    def terminal(self) -> Flags:
        """Flags of the rows where the task is finished, (rows,): the goal in the last phase, by rule in phase 0 too."""
        ends = (self.phase_of == 0) & self.finishes_unjoined | (self.phase_of == self.phases - 1)
        return np.asarray(ends & (self.state_of == self.path.goal))

    def holds(self, phases: ArrayLike, cells: ArrayLike) -> Flags:
        """Return for each pair of a phase and a cell whether it is in the certified domain.

        Args:
            phases: Phases, shape (...,).
            cells: Cells of the grid, shape (..., 3).

        Returns:
            Flags of shape (...,).
        """
        phases, cells = np.asarray(phases), np.asarray(cells)
        waypoints = self.path.cells
        ahead, behind = (moves_between(cells, waypoints[of]) for of in (phases, phases - 1))
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

    @property
    def finishes_unjoined(self) -> bool:
        """Whether a pass that has not joined the path finishes at the goal: in the cell state, or by the rule nearest.

        By any other rule the goal, from which nothing is left of the demonstration, is no place to join.
        """
        return not self.phased or self.join_share == 0

    @cached_property
    def may_join(self) -> Flags:
        """Flags of the waypoints at which the path may be joined, (R,): the first ones, with enough left."""
        moves = len(self.path.states) - 1
        # A quotient of integers, so that a share such as 0.7 is met exactly where 7 of 10 moves are left.
        return np.asarray(np.arange(moves, -1, -1) / moves >= self.join_share)

    @cached_property
    def joins(self) -> Ints:
        """The phase after *moving* onto each state in phase 0, (n_states,); 0 means that it stays "not joined".

        A state visited more than once joins at its first visit. A goal at which an unjoined pass finishes has 0.
        """
        joins = np.zeros(self.path.grid.n_states, np.int64)
        if self.phased:
            first = self.path.states[self.may_join]
            # Assigned backwards, so that the first visit of a state overwrites later ones.
            joins[first[::-1]] = np.arange(len(first), 0, -1)
        if self.finishes_unjoined:
            joins[self.path.goal] = 0
        return joins

    @cached_property
    def may_meet(self) -> Flags:
        """Flags of the states at which an unjoined pass meets the path, (n_states,): it joins or finishes there."""
        meets = np.zeros(self.path.grid.n_states, np.bool_)
        meets[self.path.states[self.may_join] if self.phased else self.path.states] = True
        return meets

    def rewards_unjoined(self, reward: RewardMap) -> Floats:
        """Return the rewards for entering each state in phase 0, (n_states,): Algorithm 1's, for progress only.

        By another rule than nearest a waypoint that does not join has the reward of any other state, or standing on
        it would pay for ever; and joining in the goal's cell, which a path may cross early, pays as any waypoint does.

        Args:
            reward: The rewards of Algorithm 1, or those that a learner recovered.
        """
        if self.finishes_unjoined:
            return reward.rewards
        return np.where(self.joins > 0, reward.levels.visited, reward.levels.other)

    def start(self, states: ArrayLike) -> tuple[Ints, Flags]:
        """Return the phase of a pass that starts in each state, and whether it is finished there already.

        Args:
            states: States, shape (...,).

        Returns:
            Phases and flags, both of shape (...,).
        """
        states = np.asarray(states)
        at_goal = states == self.path.goal
        first = int(np.argmax(self.path.states == self.path.goal))
        ends = not self.phased or (first == self.phases - 1 and self.may_join[first])
        # A start on the path counts as the move onto it, but for the goal, where moving onto it may finish.
        goal_phase = (first + (first < self.phases - 1)) if self.phased and self.may_join[first] else 0
        return np.where(at_goal, goal_phase, self.joins[states]), at_goal & ends

    @cached_property
    def start_rows(self) -> Ints:
        """The row in which a pass from each state begins, (n_states,); -1 where it is finished there already."""
        states = np.arange(self.path.grid.n_states)
        phases, done = self.start(states)
        return np.where(done, -1, self.rows_of(phases, self.path.grid.cells_of(states)))

    def enter(self, phases: ArrayLike, states: ArrayLike) -> tuple[Ints, Flags]:
        """Return the phase after moving onto each state (or staying in it) in a phase, and whether that finishes.

        Args:
            phases: Phases before the moves, shape (...,).
            states: States moved onto, shape (...,).

        Returns:
            Phases and flags, both of shape (...,).
        """
        phases, states = np.asarray(phases), np.asarray(states)
        ahead = (phases > 0) & (states == self.path.states[phases])
        unjoined = (states == self.path.goal) & self.finishes_unjoined
        finishes = np.where(phases == 0, unjoined, ahead & (phases == self.phases - 1))
        return np.where(phases == 0, self.joins[states], phases + (ahead & ~finishes)), finishes

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
        after, finishes = self.enter(phase, state)
        after, finishes = np.where(off_grid, phase, after), finishes & ~off_grid
        advances = (phase > 0) & (after > phase)
        inside = self.holds(after, cells) & ~finishes
        row_after = np.full(len(rows), -1, np.int64)
        # Only where it is inside: cells beyond the box of a phase have no row.
        row_after[inside] = self.rows_of(after[inside], cells[inside])
        return Moves(row_after, state, finishes, advances, off_grid)


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
    finishes: Flags
    advances: Flags
    off_grid: Flags
