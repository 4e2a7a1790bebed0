"""Two plain rivals of a policy: the shortest way to the path, and then the demonstration replayed.

The way is planned once, from the start. Replay has two honest readings: of *moves*, one after the other, wherever the
arm is; and of *positions by the clock*, as position control does it, where each tick the next recorded position is
commanded and the arm moves towards it, at most a cell along each axis. Neither looks where it is in the demonstration:
a replay that did, and waited for each waypoint, would be the policy of the phase state.
"""

from dataclasses import dataclass

import numpy as np

from skills.style._arrays import Ints
from skills.style.disturbance import STOPS
from skills.style.grid import GridPath, GridWorld, discretize
from skills.style.policy import Rollout

PLACE_VALUES = np.array([9, 3, 1])  # of a move's three steps, each -1, 0 or 1, in the number of its action


def shortest_way(path: GridPath, start: int) -> Ints:
    """Plan the states from a start straight to the nearest waypoint (Chebyshev; the first of equals) and on, (L,)."""
    grid = path.grid
    joins_at = int(np.abs(path.cells - grid.cells_of(start)).max(axis=1).argmin())
    rest = path.states[joins_at:]
    if rest[0] == start:
        return rest
    straight = discretize(grid.centres_mm([start, rest[0]]), grid).states
    return np.concatenate((straight, rest[1:]))


def replay(path: GridPath, start: int) -> Rollout:
    """Follow the shortest way to the path, and then the path, undisturbed."""
    plan = shortest_way(path, start)
    return Rollout(path, plan, np.zeros_like(plan), finished=int(plan[-1]) == path.goal)


@dataclass(frozen=True, eq=False)
class ReplayMoves:
    """Make the moves of a plan, (L,) states, one after the other, whatever happens; then stop."""

    grid: GridWorld
    plan: Ints

    def decide(self, tick: int, states: Ints, phases: Ints) -> tuple[Ints, Ints]:
        """Take the plan's next move in all runs alike."""
        if tick >= len(self.plan) - 1:
            return np.full(len(states), STOPS), phases
        before, after = self.grid.cells_of(self.plan[tick : tick + 2])
        return np.full(len(states), _action(after - before)), phases


@dataclass(frozen=True, eq=False)
class ReplayPositions:
    """Command the positions of a plan, (L,) states, by the clock; at its end the last one, until the arm is there."""

    grid: GridWorld
    plan: Ints

    def decide(self, tick: int, states: Ints, phases: Ints) -> tuple[Ints, Ints]:
        """Move each run towards where the plan would be after this move."""
        last = len(self.plan) - 1
        commanded = self.grid.cells_of(self.plan[min(tick + 1, last)])
        actions = _action((commanded - self.grid.cells_of(states)).clip(-1, 1))
        return np.where((tick >= last) & (states == self.plan[last]), STOPS, actions), phases


def _action(steps: Ints) -> Ints:
    """Number moves, (..., 3) cells."""
    return np.asarray((steps + 1) @ PLACE_VALUES, np.int64)
