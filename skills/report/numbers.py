"""All numbers of the report, computed from a source: Table I, the figures and the rivals.

The paper compares "the average of the three learnt trajectories" with the user's: its numbers are those of all pairs of
the three alignments together. Many alignments are equally short, and each splits the same total over x, y and z
differently; so the mean along an axis is meaningful only together with the tie-break that selects one alignment. The
range of its sum over all of them needs no tie-break.

Nothing here draws or writes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skills.gridworld import paper
from skills.gridworld.reward import sparse_reward
from skills.learning.evaluation import dtw
from skills.learning.max_ent_irl import MaxEntIRL
from skills.learning.policy import Rollout, learn_tabular
from skills.learning.q_learning import CellQLearning, PhaseQLearning
from skills.report.figures import (
    ArrivingStarts,
    Discretised,
    FigureSource,
    LearntStyle,
    OtherStart,
    RewardFunctions,
    Stacked,
    Tried,
    arriving,
    compare_path,
    compare_rewards,
    other_starts,
    stack_passes,
    three_policies,
    try_seeds,
    two_rivals,
)
from skills.report.rivals import Disturbed, disturb, learn_primitive

Triple = tuple[float, float, float]
PAPER_PAIRS = 3 * 28  # each of the user's 28 states is paired with a state of each of three shorter rollouts


@dataclass(frozen=True)
class Row:
    """A row of Table I; triples are x, y and z, in mm.

    Attributes:
        of: The trajectories of the row.
        mean_mm: Mean of the differences of all pairs, with the tie-break of `evaluation.TIE_BREAK`.
        std_mm: Their standard deviation (of the population).
        rmse_mm: Their root mean square: sqrt(mean^2 + std^2).
        sum_mm: The mean times the number of pairs.
        least_mm: The smallest such sum in any equally short alignment; None if the paths are not known.
        most_mm: The largest such sum; None likewise.
        total_mm: The sum over all axes: the DTW distance, whatever the tie-break.
        pairs: Number of pairs.
        unfinished: Number of rollouts that never reach the goal; the row then compares an incomplete path.
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
    """Return the paper's own row, with the RMSE that follows from its mean and standard deviation, in mm."""
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
    """Return the row of rollouts compared with their demonstration: all pairs of all alignments together."""
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
    """Return the least and largest sum of each axis, in mm, over all equally short alignments of a rollout."""
    cells = rollout.path.grid.cells_of(rollout.states)
    apart = np.abs(cells[:, None] - rollout.path.cells[None])  # in whole cells, so that ties are exact
    cell_mm = rollout.path.grid.cell_mm
    least = [cell_mm * _least_of_axis(apart.tolist(), axis, 1) for axis in range(3)]
    most = [-cell_mm * _least_of_axis(apart.tolist(), axis, -1) for axis in range(3)]
    return _triple(least), _triple(most)


def _least_of_axis(apart: list[list[list[int]]], axis: int, sign: int) -> int:
    """Return the least of `sign` times an axis's sum, in cells, over all equally short alignments.

    Warps with the cost (total, sign * share of the axis), compared in this order.
    """
    costs = {(-1, -1): (0, 0)}
    for i, row in enumerate(apart):
        for j, one in enumerate(row):
            before = (costs[at] for at in ((i - 1, j - 1), (i - 1, j), (i, j - 1)) if at in costs)
            total, share = min(before)
            costs[i, j] = (total + sum(one), share + sign * one[axis])
    return costs[len(apart) - 1, len(apart[0]) - 1][1]


def _triple(values: Sequence[float] | np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Triple:
    # 1e-9 mm, which removes rounding errors of sums; + 0.0 turns -0.0 into 0.0
    x, y, z = (round(float(v), 9) + 0.0 for v in values)
    return x, y, z


@dataclass(frozen=True)
class Effort:
    """The amount of computation: iterations of IRL, seeds for each learner, and runs for each slip probability."""

    irl_iterations: int = MaxEntIRL().iterations
    seeds: int = 200
    runs: int = 1000


@dataclass(frozen=True, eq=False)
class Numbers:
    """All computed numbers of one source."""

    source: FigureSource
    fig_5: RewardFunctions
    fig_6: Discretised
    fig_7: Stacked
    fig_8: tuple[LearntStyle, ...]
    fig_8_rivals: tuple[LearntStyle, ...]
    tried: tuple[Tried, ...]
    fig_9: tuple[OtherStart, ...]
    arriving: tuple[ArrivingStarts, ...]
    table_1: tuple[Row, ...]
    disturbed: tuple[Disturbed, ...]


def compute(source: FigureSource, effort: Effort) -> Numbers:
    """Compute all numbers of one source; the same arguments give the same numbers.

    Raises:
        BadSettings: The number of iterations is impossible.
    """
    reward, primitive = sparse_reward(source.path), learn_primitive(source.path)
    policy = learn_tabular(reward, PhaseQLearning(), seed=0)
    fig_8 = three_policies(source)
    return Numbers(
        source=source,
        fig_5=compare_rewards(source.path, effort.irl_iterations),
        fig_6=compare_path(source.recorded),
        fig_7=stack_passes(policy),
        fig_8=fig_8,
        fig_8_rivals=two_rivals(source, primitive),
        tried=try_seeds(source, effort.seeds),
        fig_9=other_starts(source, policy, primitive),
        arriving=arriving(source, policy, primitive),
        table_1=_table_1(source, fig_8),
        disturbed=disturb(policy, learn_tabular(reward, CellQLearning(), seed=0), primitive, effort.runs),
    )


def _table_1(source: FigureSource, fig_8: Sequence[LearntStyle]) -> tuple[Row, ...]:
    """Return a row for each learner's three policies together; the printed row is only about the paper's user."""
    learners = dict.fromkeys(one.by for one in fig_8)
    rows = [pooled(by, [one.rollout for one in fig_8 if one.by == by]) for by in learners]
    return (as_printed(), *rows) if source.published else tuple(rows)
