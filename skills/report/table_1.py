"""Table I and the RMSE of Sec. IV, with what cannot be said of them: how a distance splits over the axes.

The paper compares "the average of the three learnt trajectories" with the user's: its numbers are those of all pairs of
the three alignments together. Many alignments are equally short, and each splits the same total over x, y and z in its
own way; so a mean along an axis means something only together with the rule that picks one. The range of its sum does
not need one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skills.style import paper
from skills.style.evaluation import dtw
from skills.style.policy import Rollout

Triple = tuple[float, float, float]
PAPER_PAIRS = 3 * 28  # each of the user's 28 states with a state of each of three shorter rollouts


@dataclass(frozen=True)
class Row:
    """A row of Table I: triples are x, y and z, in mm.

    Attributes:
        of: Whose trajectories.
        mean_mm: Of the differences of all pairs, with the tie-break of `evaluation.TIE_BREAK`.
        std_mm: Their standard deviation (of the population).
        rmse_mm: Their root mean square: sqrt(mean^2 + std^2).
        sum_mm: The mean times the pairs.
        least_mm: The least that this sum is in any equally short alignment; None where the paths are not known.
        most_mm: The most.
        total_mm: Over all axes: the DTW distance, whatever the tie-break.
        pairs: How many.
        unfinished: Rollouts that never came to the goal; then the row compares a stranded path.
    """

    of: str
    mean_mm: Triple
    std_mm: Triple
    rmse_mm: Triple
    sum_mm: Triple
    least_mm: Triple | None
    most_mm: Triple | None
    total_mm: float
    pairs: int
    unfinished: int


def as_printed() -> Row:
    """Give the paper's own row, with the RMSE that follows from it in the unit that it has."""
    mean, std = np.array(paper.TABLE1_MEAN_MM), np.array(paper.TABLE1_STD_MM)
    return Row(
        of="the paper, as printed",
        mean_mm=paper.TABLE1_MEAN_MM,
        std_mm=paper.TABLE1_STD_MM,
        rmse_mm=_triple(np.hypot(mean, std)),
        sum_mm=_triple(mean * PAPER_PAIRS),
        least_mm=None,
        most_mm=None,
        total_mm=float(mean.sum() * PAPER_PAIRS),
        pairs=PAPER_PAIRS,
        unfinished=0,
    )


def pooled(of: str, rollouts: Sequence[Rollout]) -> Row:
    """Compare rollouts with the demonstration they were learnt from: all pairs of all alignments together."""
    apart = np.concatenate([dtw(one.tip_mm, one.path.tip_mm).differences_mm for one in rollouts])
    least, most = np.sum([axis_bounds_mm(one) for one in rollouts], axis=0)
    return Row(
        of=of,
        mean_mm=_triple(apart.mean(axis=0)),
        std_mm=_triple(apart.std(axis=0)),
        rmse_mm=_triple(np.sqrt((apart**2).mean(axis=0))),
        sum_mm=_triple(apart.sum(axis=0)),
        least_mm=_triple(least),
        most_mm=_triple(most),
        total_mm=float(apart.sum()),
        pairs=len(apart),
        unfinished=sum(not one.finished for one in rollouts),
    )


def axis_bounds_mm(rollout: Rollout) -> tuple[Triple, Triple]:
    """Find the least and the most of each axis's sum among all equally short alignments with the demonstration."""
    cells = rollout.path.grid.cells_of(rollout.states)
    apart = np.abs(cells[:, None] - rollout.path.cells[None])  # in whole cells, so that equal is equal
    cell_mm = rollout.path.grid.cell_mm
    least = [cell_mm * _least_of_axis(apart.tolist(), axis, 1) for axis in range(3)]
    most = [-cell_mm * _least_of_axis(apart.tolist(), axis, -1) for axis in range(3)]
    return _triple(least), _triple(most)


def _least_of_axis(apart: list[list[list[int]]], axis: int, sign: int) -> int:
    """Warp with the cost (total, sign * share of the axis), compared in this order: the second of the best."""
    costs = {(-1, -1): (0, 0)}
    for i, row in enumerate(apart):
        for j, one in enumerate(row):
            before = (costs[at] for at in ((i - 1, j - 1), (i - 1, j), (i, j - 1)) if at in costs)
            total, share = min(before)
            costs[i, j] = (total + sum(one), share + sign * one[axis])
    return costs[len(apart) - 1, len(apart[0]) - 1][1]


def _triple(values: Sequence[float] | np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Triple:
    x, y, z = (round(float(v), 9) + 0.0 for v in values)  # to a millionth of a micrometre: sums of millimetres
    return x, y, z
