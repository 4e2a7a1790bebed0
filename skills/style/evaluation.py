"""How close a path is to another: dynamic time warping with Manhattan distance, and the figures of Sec. IV.

Many alignments are equally short, so how the total splits over the axes depends on the tie-break; only the total does
not. Ours, at equal cost, goes back through both paths together first, then along the path, then along the reference.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from skills.errors import EmptyPath
from skills.style._arrays import Floats, Ints, frozen
from skills.style.grid import GridWorld
from skills.style.learning import _kernels
from skills.style.policy import Rollout

TIE_BREAK = "of equally short alignments: both paths together first, then along the path, then along the reference"


@dataclass(frozen=True, eq=False)
class Alignment:
    """Pairs of indices (path, reference), (K, 2), and the absolute differences in mm along each axis, (K, 3)."""

    pairs: Ints
    differences_mm: Floats

    @property
    def total_mm(self) -> float:
        """The Manhattan distance summed over all pairs: exact, whatever the tie-break."""
        return float(self.differences_mm.sum())


def dtw(path_mm: ArrayLike, reference_mm: ArrayLike) -> Alignment:
    """Align two paths of different length and report how far apart they are.

    Dynamic time warping with Manhattan distance, as in Sec. IV of the paper (exact, where its authors' code
    approximates).

    Args:
        path_mm: Points in the demonstration's frame, shape (T, 3).
        reference_mm: The surgeon's path, same frame, shape (R, 3).

    Raises:
        EmptyPath: Either path has no points.
    """
    path, reference = np.asarray(path_mm, float), np.asarray(reference_mm, float)
    if len(path) == 0 or len(reference) == 0:
        raise EmptyPath("Two paths with at least one point each can be aligned.")
    path = frozen(path, np.float64, (None, 3), "path_mm")
    reference = frozen(reference, np.float64, (None, 3), "reference_mm")
    pairs = _warped(path, reference)
    return Alignment(pairs, np.abs(path[pairs[:, 0]] - reference[pairs[:, 1]]))


def _warped(path: Floats, reference: Floats) -> Ints:
    """Find which point of the path stands beside which of the reference, (K, 2)."""
    if np.array_equal(path, reference):  # both together costs nothing, and comes first among ties
        return np.repeat(np.arange(len(path))[:, None], 2, axis=1)
    distance = np.abs(path[:, None, :] - reference[None, :, :]).sum(axis=-1)
    cost = np.full((len(path) + 1, len(reference) + 1), np.inf)
    cost[0, 0] = 0.0
    _kernels.warp_compiled(distance, cost)
    return _walk_back(cost)


def _walk_back(cost: Floats) -> Ints:
    i, j = cost.shape[0] - 1, cost.shape[1] - 1
    pairs = [(i - 1, j - 1)]
    while (i, j) != (1, 1):
        back = ((i - 1, j - 1), (i - 1, j), (i, j - 1))
        i, j = min(back, key=lambda ij: cost[ij])  # the first of equals
        pairs.append((i - 1, j - 1))
    return np.array(pairs[::-1])


@dataclass(frozen=True)
class Metrics:
    """How well a rollout reproduces its demonstration (interface: `metrics`); triples are x, y and z."""

    dtw_total_mm: float
    dtw_mean_mm: tuple[float, float, float]
    dtw_std_mm: tuple[float, float, float]
    rmse_mm: tuple[float, float, float]
    exact_states: int
    path_states: int
    discretisation_rmse_mm: tuple[float, float, float] | None
    tie_break: str = TIE_BREAK


def measure(rollout: Rollout, discretisation_rmse_mm: tuple[float, float, float] | None = None) -> Metrics:
    """Measure a rollout against the discretised demonstration it was learnt from (Sec. IV, Table I)."""
    path = rollout.path
    apart = dtw(rollout.tip_mm, path.tip_mm).differences_mm
    both = min(len(rollout.states), len(path.states))
    return Metrics(
        dtw_total_mm=float(apart.sum()),
        dtw_mean_mm=_xyz(apart.mean(axis=0)),
        dtw_std_mm=_xyz(apart.std(axis=0)),
        rmse_mm=_xyz(np.sqrt((apart**2).mean(axis=0))),
        exact_states=int(np.count_nonzero(rollout.states[:both] == path.states[:both])),
        path_states=len(path.states),
        discretisation_rmse_mm=discretisation_rmse_mm,
    )


def discretisation_rmse(tip_mm: ArrayLike, grid: GridWorld, hysteresis: float = 0.0) -> tuple[float, float, float]:
    """Measure what the grid loses: RMSE of samples in order, (T, 3) mm, against the centres of the cells they are in.

    With hysteresis, in cells, these are not always the nearest ones (`GridWorld.cells_along`).
    """
    tip_mm = np.asarray(tip_mm, float)
    apart = tip_mm - grid.centres_of(grid.cells_along(tip_mm, hysteresis))
    return _xyz(np.sqrt((apart**2).mean(axis=0)))


def _xyz(values: Floats) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
