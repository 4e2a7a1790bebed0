"""Clusters of demonstrations: average linkage, silhouettes, and a chart in the plane.

    distances --dendrogram--> Dendrogram --how_many, cut--> the cluster of each demonstration
    distances --chart--> positions in a plane

If no number of clusters is given, it is the one with the best mean silhouette (Rousseeuw, "Silhouettes", J. Comput.
Appl. Math. 1987); if even that is below `WORTH`, there is one cluster.

The chart shows demonstrations at positions in a plane about as far apart as the demonstrations are. It is classical
multidimensional scaling (Torgerson, 1952): the two directions with the largest part of the squared distances.
"""

from dataclasses import dataclass

import numpy as np

from skills.arrays import Floats, Ints, frozen
from skills.errors import BadInput

MOST = 30  # clusters tried: more than a person compares
WORTH = 0.25  # mean silhouette, below which there is "no substantial structure" (Kaufman and Rousseeuw, 1990)


@dataclass(frozen=True, eq=False)
class Dendrogram:
    """The joins of demonstrations, the nearest first.

    Attributes:
        joined: The two parts of each join, shape (N - 1, 2): a number below N is a demonstration, N + k is the result
            of the k-th join.
        heights: Distance between the two parts, averaged over their demonstrations, shape (N - 1,), increasing.
        order: The demonstrations in an order in which no two joins cross, shape (N,).
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
        """Return the cluster of each demonstration, shape (N,), counted from 0 in the order of the dendrogram.

        Raises:
            BadInput: The number of clusters is not between 1 and the number of demonstrations.
        """
        size = len(self.order)
        if not 1 <= clusters <= size:
            raise BadInput(f"{size} demonstrations make 1 to {size} clusters, not {clusters}.", most=size)
        of = list(range(2 * size - 1))  # the join that contains each demonstration and each join
        for made, (one, other) in enumerate(self.joined[: size - clusters].tolist(), start=size):
            of[one] = of[other] = made
        for below in range(2 * size - 2, -1, -1):  # from the last join down, because a join is part of later ones only
            of[below] = of[of[below]]
        numbers: dict[int, int] = {}
        for one in self.order.tolist():
            numbers.setdefault(of[one], len(numbers))
        return np.array([numbers[whole] for whole in of[:size]])


def dendrogram(apart: Floats) -> Dendrogram:
    """Join demonstrations by average linkage.

    Args:
        apart: Distances between all demonstrations, shape (N, N), N at least 1.
    """
    if len(apart) == 1:
        return Dendrogram(np.empty((0, 2), int), np.empty(0), np.zeros(1, int))
    from scipy.cluster.hierarchy import leaves_list, linkage
    from scipy.spatial.distance import squareform

    joins = linkage(squareform((apart + apart.T) / 2, checks=False), "average")
    return Dendrogram(joins[:, :2], joins[:, 2], leaves_list(joins))


def silhouette(apart: Floats, clusters: Ints) -> float:
    """Return the mean silhouette: how much nearer demonstrations are to their own cluster than to the next, -1 to 1.

    A demonstration alone in its cluster counts 0, as in Rousseeuw's paper.

    Args:
        apart: Distances between all, shape (N, N).
        clusters: The cluster of each, from 0 without a gap, at least two of them, shape (N,).
    """
    return _silhouette(apart @ _members(clusters), clusters)


def how_many(apart: Floats, tree: Dendrogram) -> int:
    """Choose the number of clusters with the best mean silhouette; the fewest among equals.

    It is 1 if no silhouette reaches `WORTH`, and for fewer than three demonstrations, for which no silhouette is
    meaningful.

    Args:
        apart: Distances between all demonstrations, shape (N, N).
        tree: Their dendrogram.
    """
    best, chosen = WORTH, 1
    most = min(MOST, len(apart) - 1)
    if most < 2:
        return 1
    finest = tree.cut(most)
    sums, first = apart @ _members(finest), np.unique(finest, return_index=True)[1]
    for clusters in range(2, most + 1):
        cut = tree.cut(clusters)
        # A cluster of this cut is a union of clusters of the finest, so its sums are sums of theirs.
        found = _silhouette(sums @ _members(cut[first]), cut)
        if found > best:
            best, chosen = found, clusters
    return chosen


def _members(clusters: Ints) -> Floats:
    """Return the clusters as one-hot rows, shape (N, clusters)."""
    return np.eye(clusters.max() + 1)[clusters]


def _silhouette(sums: Floats, clusters: Ints) -> float:
    """Return the mean silhouette from the sums of each one's distances to every cluster, shape (N, clusters)."""
    sizes, here = np.bincount(clusters), np.arange(len(clusters))
    own = sums[here, clusters] / (sizes[clusters] - 1).clip(1)
    means = sums / sizes
    means[here, clusters] = np.inf
    others = means.min(axis=1)
    wider = np.maximum(own, others)
    score = np.divide(others - own, wider, out=np.zeros_like(own), where=wider > 0)
    return float(np.where(sizes[clusters] > 1, score, 0.0).mean())


MANY = 64  # demonstrations: from here on, computing all directions takes long when only two are needed


def chart(apart: Floats) -> tuple[Floats, float]:
    """Return positions of demonstrations in a plane (classical multidimensional scaling).

    Args:
        apart: Distances between all demonstrations, shape (N, N).

    Returns:
        The positions in the distances' unit, shape (N, 2), around 0 with the widest direction first; and the share of
        the distances that is right in the plane: 1 minus the mean error over the mean distance.
    """
    total = apart.sum()
    if not total > 0:
        return np.zeros((len(apart), 2)), 1.0
    places = _placed(apart)
    furthest = places[np.abs(places).argmax(axis=0), [0, 1]]
    # The sign of an eigenvector is arbitrary; fix it, so that equal distances give the same chart.
    places = places * np.where(furthest < 0, -1.0, 1.0)
    flat = np.hypot(*(np.subtract.outer(axis, axis) for axis in places.T))
    return places, float(1.0 - np.abs(flat - apart).sum() / total)


def _placed(apart: Floats) -> Floats:
    """Return the coordinates in the two main directions, (N, 2), given the distances between all; N at least 2."""
    squared = apart**2
    mean = squared.mean(axis=0)
    centred = (mean[:, None] + mean[None, :] - squared - mean.mean()) / 2
    if len(apart) < MANY:
        values, vectors = np.linalg.eigh(centred)
    else:
        from scipy.sparse.linalg import eigsh

        # The start is the demonstration furthest out and not random, so that the same atlas has the same chart.
        values, vectors = eigsh(centred, k=2, which="LA", v0=centred[centred.diagonal().argmax()])
    return np.asarray(vectors[:, [-1, -2]] * np.sqrt(values[[-1, -2]].clip(0.0)))
