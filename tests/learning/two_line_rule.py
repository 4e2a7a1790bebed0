"""A rule that needs no learning, only its progress along the demonstration: a rival, and a second method."""

from dataclasses import dataclass

import numpy as np

from skills.arrays import Ints
from skills.gridworld.domain import Domain
from skills.gridworld.grid import GridPath
from skills.learning.slip_runs import STOPS


@dataclass(frozen=True, eq=False)
class TwoLineRule:
    """A controller that goes straight to the nearest waypoint (Chebyshev; the last of equals), then to each in turn.

    On a path that does not cross itself, without slips and obstacles, each of its moves is optimal in the phase state
    with the default gamma, where joining later pays more.
    """

    path: GridPath

    def decide(self, tick: int, states: Ints, phases: Ints) -> tuple[Ints, Ints]:
        """Update the phases with the states, and move each run towards its waypoint."""
        domain, cells = Domain(self.path, phased=True), self.path.grid.cells_of(states)
        phases, done = domain.start(states) if tick == 0 else domain.enter(phases, states)
        apart = np.abs(self.path.cells - cells[:, None]).max(axis=2)
        nearest = len(self.path.states) - 1 - apart[:, ::-1].argmin(axis=1)
        ahead = self.path.cells[np.where(phases > 0, phases, nearest)]
        return np.where(done, STOPS, ((ahead - cells).clip(-1, 1) + 1) @ (9, 3, 1)), phases
