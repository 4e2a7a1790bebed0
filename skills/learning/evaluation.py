"""Evaluation of a policy: dynamic time warping, the figures of Sec. IV, and rollouts in the continuous space.

    Rollout --measure--> Metrics
    Policy --check_in_space--> SpaceRollouts

Paths are aligned by dynamic time warping with Manhattan distance. Many alignments are equally short, so the division of
the total over the axes depends on the tie-break; the total does not. At equal cost, ours steps back in both paths
together first, then along the path, then along the reference.

The certificate checks a policy on the grid, cell by cell. A policy of the continuous space is checked here without a
grid as well: its network is evaluated step by step from starts drawn uniformly in the box, until the position is in the
goal's cell or the paper's 100 steps are used up.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Floats, Ints, frozen, xyz
from skills.compiled import compiled
from skills.errors import EmptyPath
from skills.fields import Count, Point, schema
from skills.gridworld import paper
from skills.learning.networks import DDPG, TRPO, InSpace, Network, Space, asked_step
from skills.learning.policy import Policy, Rollout

TIE_BREAK = "of equally short alignments: both paths together first, then along the path, then along the reference"


@dataclass(frozen=True, eq=False)
class Alignment:
    """Pairs of indices (path, reference), (K, 2), and the absolute differences in mm along each axis, (K, 3)."""

    pairs: Ints
    differences_mm: Floats

    @property
    def total_mm(self) -> float:
        """The Manhattan distance summed over all pairs; independent of the tie-break."""
        return float(self.differences_mm.sum())

    def at_reference(self, values: Floats) -> Floats:
        """Return the mean of the values of the pairs, (K, D), at each point of the reference, (R, D)."""
        points = self.pairs[:, 1]
        return np.stack([np.bincount(points, column) for column in values.T], axis=1) / np.bincount(points)[:, None]


def dtw(path_mm: ArrayLike, reference_mm: ArrayLike) -> Alignment:
    """Align two paths of different length and measure their distance.

    Dynamic time warping with Manhattan distance, as in Sec. IV of the paper (exact, whereas its authors' code
    approximates).

    Args:
        path_mm: Points in the demonstration's frame, shape (T, 3).
        reference_mm: The surgeon's path, same frame, shape (R, 3).

    Returns:
        Pairs of indices, shape (K, 2), and the absolute differences in mm, shape (K, 3).

    Raises:
        EmptyPath: Either path has no points.
        BadInput: A path is not rows of three finite numbers.
    """
    path, reference = np.asarray(path_mm, float), np.asarray(reference_mm, float)
    if len(path) == 0 or len(reference) == 0:
        raise EmptyPath("An alignment needs two paths with at least one point each.")
    path = frozen(path, np.float64, (None, 3), "path_mm")
    reference = frozen(reference, np.float64, (None, 3), "reference_mm")
    pairs = _warped(path, reference)
    return Alignment(pairs, np.abs(path[pairs[:, 0]] - reference[pairs[:, 1]]))


def _warped(path: Floats, reference: Floats) -> Ints:
    """Return the pairs of indices, (K, 2), of a shortest alignment of path and reference."""
    if np.array_equal(path, reference):  # the diagonal costs nothing, and is the first among ties
        return np.repeat(np.arange(len(path))[:, None], 2, axis=1)
    distance = np.abs(path[:, None, :] - reference[None, :, :]).sum(axis=-1)
    cost = np.full((len(path) + 1, len(reference) + 1), np.inf)
    cost[0, 0] = 0.0
    warp(distance, cost)
    return _walk_back(cost)


@compiled
def warp(distance: Any, cost: Any) -> None:
    """Fill the table of accumulated costs of dynamic time warping.

    Args:
        distance: Distance of each pair of points, shape (T, R).
        cost: Shape (T + 1, R + 1), infinite at the edges and 0 at [0, 0]; filled in place.
    """
    for i in range(distance.shape[0]):
        for j in range(distance.shape[1]):
            cost[i + 1, j + 1] = distance[i, j] + min(cost[i, j], cost[i, j + 1], cost[i + 1, j])


def _walk_back(cost: Floats) -> Ints:
    """Return the pairs of indices, (K, 2), along the cheapest way through a table that `warp` filled."""
    i, j = cost.shape[0] - 1, cost.shape[1] - 1
    pairs = [(i - 1, j - 1)]
    while (i, j) != (1, 1):
        back = ((i - 1, j - 1), (i - 1, j), (i, j - 1))
        i, j = min(back, key=lambda ij: cost[ij])  # the first of equals
        pairs.append((i - 1, j - 1))
    return np.array(pairs[::-1])


@schema
@dataclass(frozen=True)
class Metrics:
    """The deviation of a rollout from its demonstration (interface: `metrics`); triples are x, y and z."""

    dtw_total_mm: float
    dtw_mean_mm: Point
    dtw_std_mm: Point
    rmse_mm: Point
    exact_states: Count
    path_states: Count
    discretisation_rmse_mm: Point | None
    tie_break: str = TIE_BREAK


def measure(rollout: Rollout, discretisation_rmse_mm: tuple[float, float, float] | None = None) -> Metrics:
    """Measure a rollout against the discretised demonstration it was learnt from (Sec. IV, Table I).

    Args:
        rollout: The rollout.
        discretisation_rmse_mm: Discretisation error along x, y and z; copied into the result.

    Returns:
        The metrics, in mm.
    """
    path = rollout.path
    apart = dtw(rollout.tip_mm, path.tip_mm).differences_mm
    both = min(len(rollout.states), len(path.states))
    return Metrics(
        dtw_total_mm=float(apart.sum()),
        dtw_mean_mm=xyz(apart.mean(axis=0)),
        dtw_std_mm=xyz(apart.std(axis=0)),
        rmse_mm=xyz(np.sqrt((apart**2).mean(axis=0))),
        exact_states=int(np.count_nonzero(rollout.states[:both] == path.states[:both])),
        path_states=len(path.states),
        discretisation_rmse_mm=discretisation_rmse_mm,
    )


STARTS = 1000  # ours: the share that arrives is then known to 3 percentage points, with 95 % confidence at worst


@schema
@dataclass(frozen=True)
class SpaceRollouts:
    """The results of following a policy in the continuous space from starts drawn by a seed.

    Attributes:
        starts: Number of starts drawn.
        reached: Number of them from which the goal is reached.
        seed: The seed of the starts.
        dtw_total_mm: Total DTW distance from the demonstration, the mean over all starts drawn.
        demonstrated_start_reached: The goal is reached from the demonstrated start.
        demonstrated_start_dtw_mm: Total DTW distance from the demonstrated start.
    """

    starts: Count
    reached: Count
    seed: Count
    dtw_total_mm: float
    demonstrated_start_reached: bool
    demonstrated_start_dtw_mm: float


def check_in_space(policy: Policy, starts: int = STARTS, seed: int = 0) -> SpaceRollouts | None:
    """Follow a policy from the demonstrated start and from random starts in its continuous space.

    The policy is followed as it is, without noise.

    Args:
        policy: The policy.
        starts: Number of random starts, drawn uniformly from the box.
        seed: The seed of the starts.

    Returns:
        The results; None for a policy that was learnt on a grid.
    """
    learner, network, path = policy.learner, policy.network, policy.path
    if network is None or not isinstance(learner, DDPG | TRPO):
        return None
    space = Space(path, policy.levels)
    drawn = np.random.Generator(np.random.PCG64(seed)).uniform(space.low_mm, space.high_mm, (starts, 3))
    ways = follow_in_space(learner, network, space, np.concatenate((path.tip_mm[:1], drawn)))
    reached = [bool(space.arrived(way[-1])) for way in ways]
    apart_mm = [dtw(way, path.tip_mm).total_mm for way in ways]
    return SpaceRollouts(
        starts=starts,
        reached=sum(reached[1:]),
        seed=seed,
        dtw_total_mm=float(np.mean(apart_mm[1:])),
        demonstrated_start_reached=reached[0],
        demonstrated_start_dtw_mm=apart_mm[0],
    )


def follow_in_space(learner: InSpace, network: Network, space: Space, starts_mm: Floats) -> list[Floats]:
    """Follow a network from each start until it is in the goal's cell or has made `paper.MAX_STEPS` steps.

    Args:
        learner: The settings of the learner.
        network: Its network.
        space: The space of the path.
        starts_mm: Starts, shape (N, 3).

    Returns:
        The N paths, each of shape (T, 3) in mm, starts included.
    """
    at_mm = np.asarray(starts_mm, float)
    going = ~space.arrived(at_mm)
    visited, lengths = [at_mm], np.ones(len(at_mm), np.int64)
    for _ in range(paper.MAX_STEPS):
        moved_mm = space.moved(at_mm, asked_step(learner, network, space, at_mm))
        # Paths that have arrived stay where they are, so that all can be stacked; the repeats are cut off below.
        at_mm = np.where(going[:, None], moved_mm, at_mm)
        visited.append(at_mm)
        lengths += going
        going &= ~space.arrived(at_mm)
    ways = np.stack(visited, axis=1)
    return [way[:length] for way, length in zip(ways, lengths, strict=True)]
