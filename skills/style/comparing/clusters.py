"""Which demonstrations belong together: average linkage, its dendrogram, and into how many clusters to cut it.

The number of clusters, where nobody names one, is that with the best mean silhouette (Rousseeuw, "Silhouettes", J.
Comput. Appl. Math. 1987); where even that is below `WORTH`, there is one.
"""

from dataclasses import dataclass

import numpy as np

from skills.errors import BadInput
from skills.style._arrays import Floats, Ints, frozen

MOST = 30  # clusters that are tried: more than a person compares
WORTH = 0.25  # of the mean silhouette: below it there is "no substantial structure" (Kaufman and Rousseeuw, 1990)


@dataclass(frozen=True, eq=False)
class Dendrogram:
    """How demonstrations join, the nearest first.

    Attributes:
        joined: Which two join, shape (N - 1, 2): below N a demonstration, N + k what the k-th join made.
        heights: How far these are apart, on average over their demonstrations, shape (N - 1,), increasing.
        order: The demonstrations side by side, so that no two joins cross, shape (N,).
    """

    joined: Ints
    heights: Floats
    order: Ints

    def __post_init__(self) -> None:
        size = len(self.order)
        object.__setattr__(self, "joined", frozen(self.joined, np.int64, (size - 1, 2), "joined"))
        object.__setattr__(self, "heights", frozen(self.heights, np.float64, (size - 1,), "heights"))
        object.__setattr__(self, "order", frozen(self.order, np.int64, (size,), "order"))

    def cut(self, clusters: int) -> Ints:
        """Name the cluster of each demonstration, shape (N,), counted from 0 in the order of the dendrogram.

        Raises:
            BadInput: There are not so many demonstrations.
        """
        size = len(self.order)
        if not 1 <= clusters <= size:
            raise BadInput(f"{size} demonstrations make 1 to {size} clusters, not {clusters}.", most=size)
        of = list(range(2 * size - 1))  # what each demonstration, and each join, is a part of
        for made, (one, other) in enumerate(self.joined[: size - clusters].tolist(), start=size):
            of[one] = of[other] = made
        for below in range(2 * size - 2, -1, -1):  # whatever a join is a part of was made after it
            of[below] = of[of[below]]
        numbers: dict[int, int] = {}
        for one in self.order.tolist():
            numbers.setdefault(of[one], len(numbers))
        return np.array([numbers[whole] for whole in of[:size]])


def dendrogram(apart: Floats) -> Dendrogram:
    """Join demonstrations by average linkage, given the distances between all, shape (N, N); N at least 1."""
    if len(apart) == 1:
        return Dendrogram(np.empty((0, 2), int), np.empty(0), np.zeros(1, int))
    from scipy.cluster.hierarchy import leaves_list, linkage
    from scipy.spatial.distance import squareform

    joins = linkage(squareform((apart + apart.T) / 2, checks=False), "average")
    return Dendrogram(joins[:, :2], joins[:, 2], leaves_list(joins))


def silhouette(apart: Floats, clusters: Ints) -> float:
    """Measure how much nearer demonstrations are to their own cluster than to the next, on average: -1 to 1.

    One alone in its cluster counts 0, as Rousseeuw has it.

    Args:
        apart: Distances between all, shape (N, N).
        clusters: The cluster of each, from 0 without a gap, at least two of them, shape (N,).
    """
    return _silhouette(apart @ _members(clusters), clusters)


def how_many(apart: Floats, tree: Dendrogram) -> int:
    """Choose a number of clusters: that with the best mean silhouette, the fewest of equals; 1 where none is worth it.

    Of fewer than three demonstrations no silhouette tells anything: one cluster.
    """
    best, chosen = WORTH, 1
    most = min(MOST, len(apart) - 1)
    if most < 2:
        return 1
    finest = tree.cut(most)
    sums, first = apart @ _members(finest), np.unique(finest, return_index=True)[1]
    for clusters in range(2, most + 1):
        cut = tree.cut(clusters)
        found = _silhouette(sums @ _members(cut[first]), cut)  # a cluster of this cut is some whole ones of the finest
        if found > best:
            best, chosen = found, clusters
    return chosen


def _members(clusters: Ints) -> Floats:
    """Write which cluster each is in as ones among zeros, shape (N, clusters)."""
    return np.eye(clusters.max() + 1)[clusters]


def _silhouette(sums: Floats, clusters: Ints) -> float:
    """Give the mean silhouette, of the sums of each one's distances to every cluster, shape (N, clusters)."""
    sizes, here = np.bincount(clusters), np.arange(len(clusters))
    own = sums[here, clusters] / (sizes[clusters] - 1).clip(1)
    means = sums / sizes
    means[here, clusters] = np.inf
    others = means.min(axis=1)
    wider = np.maximum(own, others)
    score = np.divide(others - own, wider, out=np.zeros_like(own), where=wider > 0)
    return float(np.where(sizes[clusters] > 1, score, 0.0).mean())
