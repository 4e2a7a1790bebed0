"""Grid worlds in answers."""

from dataclasses import dataclass

from skills.fields import schema
from skills.gridworld.grid import GridWorld


@schema
@dataclass(frozen=True)
class Grid(GridWorld):
    """A grid world: the centre of the state (ix * ny + iy) * nz + iz is `origin_mm + cell_mm * (ix, iy, iz)`."""


@schema
@dataclass(frozen=True)
class ChosenGrid(GridWorld):
    """A demonstration's grid world, and whether it is the paper's or was fitted to the path.

    Attributes:
        chosen: paper or fit.
    """

    chosen: str
