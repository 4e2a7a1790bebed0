"""The grid world without its grid: positions in mm, and steps of any length up to a cell along each axis.

The *space* is the box between the centres of a grid's outermost cells. A *step* is three numbers from -1 to 1, cells
along x, y and z; where it would leave the box it ends at its face. One has arrived in the goal's cell. Rewards here are
ours, for Algorithm 1 pays per cell, and again for standing still, which in a continuous space is all that is ever
learnt. With s the length of the demonstration up to its point nearest to a position (the later one of equals) and u
the distance to that point, both in cells, a step from p to q pays

    min(gamma F(q) - F(p), 1) - u(q) / 2 - [stopped at a face] + goal [arrived],      F = s - u

`F` is a potential: what it pays adds up to nothing on any round trip (Ng, Harada and Russell 1999), so no loop is worth
anything. Cutting at 1, one cell's progress, only ever pays less, and takes the gain out of a shortcut: who leaves out
half of the path is paid for one cell of it. Half the distance keeps the tip on the path, and a cell's reward less is
what leaving the box costs.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skills.style._arrays import Floats
from skills.style.grid import GridPath
from skills.style.reward import RewardLevels

DRIFT = 0.5  # ours: what a cell's distance from the path costs with each step


@dataclass(frozen=True, eq=False)
class Space:
    """The space of a path's grid world, and what moving in it pays."""

    path: GridPath
    levels: RewardLevels

    @cached_property
    def low_mm(self) -> Floats:
        """The box's lowest corner, (3,) mm."""
        return self.path.grid.centres_mm(0)

    @cached_property
    def high_mm(self) -> Floats:
        """The box's highest corner, (3,) mm."""
        return self.path.grid.centres_mm(self.path.grid.n_states - 1)

    def scaled(self, positions_mm: ArrayLike) -> Floats:
        """Scale positions, (..., 3) mm, so that the box is -1 to 1 along each axis (0 along one without length)."""
        extent = np.where(self.high_mm > self.low_mm, self.high_mm - self.low_mm, np.inf)
        return np.asarray(2 * (np.asarray(positions_mm, float) - (self.low_mm + self.high_mm) / 2) / extent)

    def moved(self, positions_mm: ArrayLike, steps: ArrayLike) -> Floats:
        """Take steps, (..., 3), from positions, (..., 3) mm: where they lead."""
        made_mm = np.clip(np.asarray(steps, float), -1.0, 1.0) * self.path.grid.cell_mm
        return np.asarray(np.clip(np.asarray(positions_mm, float) + made_mm, self.low_mm, self.high_mm))

    def arrived(self, positions_mm: ArrayLike) -> NDArray[np.bool_]:
        """Tell for each position, (..., 3) mm, whether it is in the goal's cell."""
        goal = self.path.cells[-1]
        return np.asarray((self.path.grid.cells_at(positions_mm) == goal).all(axis=-1))

    def along(self, positions_mm: ArrayLike) -> tuple[Floats, Floats]:
        """Find how far along the demonstration each position, (N, 3) mm, is, and how far off it, both (N,) in cells."""
        cells = (np.asarray(positions_mm, float)[:, None] - self._from_mm) / self.path.grid.cell_mm  # (N, R - 1, 3)
        share = np.clip((cells * self._legs).sum(axis=-1) / self._lengths**2, 0.0, 1.0)
        off = np.linalg.norm(cells - share[..., None] * self._legs, axis=-1)
        nearest = off.shape[1] - 1 - off[:, ::-1].round(9).argmin(axis=1)  # the later one of equals
        rows = np.arange(len(off))
        length = self._before[nearest] + share[rows, nearest] * self._lengths[nearest]
        return np.asarray(length), np.asarray(off[rows, nearest])

    def pays(self, before_mm: ArrayLike, steps: ArrayLike, after_mm: ArrayLike, gamma: float) -> Floats:
        """Say what steps from positions to positions pay, all (N, 3): (N,)."""
        (s, u), (then, off) = self.along(before_mm), self.along(after_mm)
        made = (np.asarray(after_mm, float) - np.asarray(before_mm, float)) / self.path.grid.cell_mm
        stopped = (np.abs(made - np.clip(np.asarray(steps, float), -1.0, 1.0)) > 1e-6).any(axis=-1)
        progress = np.minimum(gamma * (then - off) - (s - u), 1.0)
        here = progress - DRIFT * off + self.levels.off_grid * stopped
        return np.asarray(here + self.levels.goal * self.arrived(after_mm))

    @cached_property
    def _from_mm(self) -> Floats:
        return self.path.tip_mm[:-1]

    @cached_property
    def _legs(self) -> Floats:
        return np.asarray(np.diff(self.path.cells, axis=0), np.float64)

    @cached_property
    def _lengths(self) -> Floats:
        return np.asarray(np.linalg.norm(self._legs, axis=1))

    @cached_property
    def _before(self) -> Floats:
        return np.concatenate(([0.0], np.cumsum(self._lengths)[:-1]))
