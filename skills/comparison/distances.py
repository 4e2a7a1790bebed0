"""DTW distances between demonstrations as shapes, differences of two shapes by thirds and axes, and clusters.

    Demo --shape_of--> points equally far apart along the path, in a frame of the hand-off
    shapes --distances--> DTW distances between all of them
    distances --dendrogram--> Dendrogram --how_many, cut--> the cluster of each demonstration
    distances --chart--> positions in a plane

The place of a hand-off, its speed and optionally its size are not part of the style, so motions are compared in a frame
of their own. That frame has its origin at the start, x towards the goal, and z as far along the base's z axis as x
allows; y then points to the left. So two shapes begin together and go the same way; scaled, they end together too.
Tempo is left out: states are even along the path, as in the paper's grid, where standing still adds no state. This is
ours; the paper compares paths only at the place where they were recorded.

The distance is dynamic time warping with Manhattan distance (Sec. IV). The total is exact and does not depend on a
tie-break; divided by the number of states of a shape it is about the mm by which they differ at a place. One more shape
costs one row of distances.

`Measured` is the stored result of one demonstration: its shape, and its distances from some others.

`difference` names the axis and the part of the path that separate two shapes, for text and pictures.

*Clusters* are joined by average linkage. If no number of clusters is given, it is the one with the best mean silhouette
(Rousseeuw, "Silhouettes", J. Comput. Appl. Math. 1987); if even that is below `WORTH`, there is one cluster.

The chart shows demonstrations at positions in a plane about as far apart as the demonstrations are. It is classical
multidimensional scaling (Torgerson, 1952): the two directions with the largest part of the squared distances.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from skills.arithmetic import product
from skills.arrays import Floats, Ints, freeze, frozen, interpolated
from skills.compiled import compiled, inner
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import lengths_along, smoothed_tip
from skills.errors import BadInput, BadPath
from skills.learning.evaluation import dtw

STATES = 100  # of a shape; the paper's demonstration has 28 states, our samples 20 to 60
TREMOR_S = 0.2  # a Hann window this wide stops 10 Hz, which would lengthen the path, and rounds no corner of a hand
LEAST_MM = 1.0  # from start to goal; tremor would change the direction of a shorter path
STEEPEST = 0.99  # cosine between x and the base's z axis; beyond it, the base's y axis replaces its z axis


THREADS = 2  # the loops release the GIL; the service, which calls this too, needs its other cores
WORTH_A_THREAD = 200  # pairs; with 100 states they take 6 ms
VERSION = 1  # of shapes, signatures and distances: raise it when their numbers change, so that all are measured again
AXES = ("along the way", "sideways", "upwards")  # x, y and z of a shape's own frame
FURTHER = (("less far along", "further along"), ("further right", "further left"), ("lower", "higher"))  # by sign
PARTS = ("first third", "middle third", "last third")
MOST = 30  # clusters tried: more than a person compares
WORTH = 0.25  # mean silhouette, below which there is "no substantial structure" (Kaufman and Rousseeuw, 1990)


def shape_of(demo: Demo, *, scaled: bool = False) -> Floats:
    """Return a demonstration's path in its own frame, shape (STATES, 3), in mm or scaled.

    Args:
        demo: The demonstration.
        scaled: Whether the unit is the distance from start to goal, instead of mm.

    Raises:
        BadPath: It ends within `LEAST_MM` of its start.
    """
    way_mm = resampled(smoothed_tip(demo.stamps_s, demo.tip_mm, TREMOR_S)[1])
    return placed(way_mm, scaled=scaled)


def in_lengths(shape_mm: Floats) -> Floats:
    """Return a shape in units of the distance from start to goal: the scaled shape of the same demonstration.

    Args:
        shape_mm: The shape in mm, (T, 3).
    """
    return np.asarray(shape_mm / shape_mm[-1, 0])


def resampled(tip_mm: Floats, states: int = STATES) -> Floats:
    """Return points equally far apart along a path, shape (states, 3).

    Args:
        tip_mm: The path, shape (T, 3).
        states: Number of points, the ends included.
    """
    along_mm = lengths_along(tip_mm)
    at_mm = np.linspace(0.0, along_mm[-1], states)
    return interpolated(at_mm, along_mm, tip_mm)


def placed(tip_mm: Floats, *, scaled: bool = False) -> Floats:
    """Return a path in the frame of its start and goal, shape (T, 3).

    Args:
        tip_mm: The path in the arm's base frame, shape (T, 3).
        scaled: Whether the unit is the distance from start to goal, instead of mm.

    Raises:
        BadPath: It ends within `LEAST_MM` of its start.
    """
    length_mm = float(np.linalg.norm(tip_mm[-1] - tip_mm[0], axis=-1))
    there = product(tip_mm - tip_mm[0], own_axes(tip_mm).T) / (length_mm if scaled else 1.0)
    return frozen(there, np.float64, (None, 3), "tip_mm")


def own_axes(tip_mm: Floats) -> Floats:
    """Return the axes of a path's own frame, as rows, shape (3, 3): x towards its goal, y to the left, z upwards.

    Args:
        tip_mm: The path in the arm's base frame, shape (T, 3).

    Raises:
        BadPath: It ends within `LEAST_MM` of its start.
    """
    way_mm = tip_mm[-1] - tip_mm[0]
    length_mm = float(np.linalg.norm(way_mm, axis=-1))
    if not length_mm >= LEAST_MM:
        raise BadPath(
            f"It ends {length_mm:.2f} mm from where it began, so it has no direction and cannot be compared; cut "
            "the hand-off from its start to the point where the needle is taken.",
            length_mm=length_mm,
        )
    x = way_mm / length_mm
    up = np.array([0.0, 0.0, 1.0] if abs(x[2]) < STEEPEST else [0.0, 1.0, 0.0])
    z = up - product(up, x) * x
    z /= np.linalg.norm(z, axis=-1)
    return np.stack([x, np.cross(z, x), z])


def distances(shapes: ArrayLike, references: ArrayLike) -> Floats:
    """Return the distance of each shape to each reference, shape (N, M), in their unit.

    Args:
        shapes: Shape (N, T, 3).
        references: Shape (M, R, 3), in the same unit.
    """
    paths = frozen(shapes, np.float64, (None, None, 3), "shapes")
    to = frozen(references, np.float64, (None, None, 3), "references")
    pairs = np.stack(np.divmod(np.arange(len(paths) * len(to)), max(1, len(to))), axis=1)
    return _measured(paths, to, pairs).reshape(len(paths), len(to))


def distances_of(shapes: ArrayLike, pairs: ArrayLike) -> Floats:
    """Return the distance between the shapes of each pair, shape (K,), in their unit.

    Args:
        shapes: Shape (N, T, 3).
        pairs: Indices of two shapes each, shape (K, 2).
    """
    paths = frozen(shapes, np.float64, (None, None, 3), "shapes")
    return _measured(paths, paths, np.asarray(pairs))


def _measured(paths: Floats, references: Floats, pairs: Ints) -> Floats:
    """Return the distance between a path, (N, T, 3), and a reference, (M, R, 3), of each pair, (K, 2): shape (K,)."""
    chosen = frozen(pairs, np.int64, (None, 2), "pairs")
    totals = np.empty(len(chosen))

    def measure(part: slice) -> None:
        row = np.empty(references.shape[1] + 1)
        warp_pairs(paths, references, chosen[part], row, totals[part])

    ends = np.linspace(0, len(chosen), 1 + min(THREADS, 1 + len(chosen) // WORTH_A_THREAD)).astype(int).tolist()
    parts = [slice(*ends[at : at + 2]) for at in range(len(ends) - 1)]
    if len(parts) == 1:
        measure(parts[0])
        return totals
    with ThreadPoolExecutor(len(parts)) as threads:
        list(threads.map(measure, parts))
    return totals


@inner
def warped(path: Any, reference: Any, row: Any) -> Any:
    """Return the sum of the Manhattan distances along the shortest warping of two paths.

    Args:
        path: Points, shape (T, 3).
        reference: Points in the same unit, shape (R, 3).
        row: Workspace, shape (R + 1,), overwritten.
    """
    # One row of the table is enough, because only the total is returned, not the alignment.
    row[:] = float("inf")
    row[0] = 0.0
    for i in range(path.shape[0]):
        before, row[0] = row[0], float("inf")
        for j in range(reference.shape[0]):
            apart = 0.0
            for axis in range(3):
                apart += abs(path[i, axis] - reference[j, axis])
            best = min(before, row[j], row[j + 1])
            before = row[j + 1]
            row[j + 1] = apart + best
    return row[reference.shape[0]]


@compiled
def warp_pairs(paths: Any, references: Any, pairs: Any, row: Any, totals: Any) -> None:
    """Compute the distance between the path and the reference of each pair.

    Args:
        paths: Points, shape (N, T, 3).
        references: Points in the same unit, shape (M, R, 3).
        pairs: Indices of a path and a reference each, shape (K, 2).
        row: Workspace, shape (R + 1,), overwritten.
        totals: The result, shape (K,), overwritten.
    """
    for k in range(pairs.shape[0]):
        totals[k] = warped(paths[pairs[k, 0]], references[pairs[k, 1]], row)


def medoid(apart: Floats, members: Ints) -> int:
    """Return the member that is nearest to all members; the first among equals.

    Args:
        apart: Distances between all demonstrations, shape (N, N).
        members: Indices into `apart`, at least one.
    """
    return int(members[apart[np.ix_(members, members)].sum(axis=1).argmin()])


def spread(apart: Floats, members: Ints) -> float:
    """Return the consistency of members: the mean distance of the others to their medoid; 0 for a single one.

    Args:
        apart: Distances between all demonstrations, shape (N, N).
        members: Indices into `apart`, at least one.
    """
    others = members[members != (centre := medoid(apart, members))]
    return float(apart[centre, others].mean()) if len(others) else 0.0


@dataclass(frozen=True, eq=False)
class Measured:
    """A shape, and its distances from those of other demonstrations.

    Attributes:
        shape_mm: The result of `shape_of`, shape (STATES, 3); None: the demonstration has no direction.
        others: Numbers that identify the others, shape (K,).
        apart_mm: Distance from each, with the size taken into account, shape (K,).
        apart_scaled: The same for scaled shapes, in units of the distance from start to goal, shape (K,).
        signature: The result of `skills.comparison.recognition.signature_of`, with its NaN.
    """

    shape_mm: Floats | None
    others: Ints
    apart_mm: Floats
    apart_scaled: Floats
    signature: Floats

    def __post_init__(self) -> None:
        count = len(self.others)
        freeze(self, shape_mm=(STATES, 3), apart_mm=(count,), apart_scaled=(count,))
        freeze(self, np.int64, others=(count,))


@dataclass(frozen=True, eq=False)
class Difference:
    """The difference of one shape from another.

    Attributes:
        total: The warping distance, in the shapes' unit.
        offsets: Signed offset of the first shape from the second, averaged over the states of each third of the
            second's path, shape (3 parts, 3 axes).
        nets: The same averaged over the pairs of states there, as `shares` are: a stretch without a counterpart counts
            by its length.
        sizes: The same as `nets`, without signs.
        shares: The part of the total in each third and axis, shape (3 parts, 3 axes); they sum to 1, or are all 0.
        along: Mean offset of the first shape at each state of the second, shape (R, 3), signed.
    """

    total: float
    offsets: Floats
    nets: Floats
    sizes: Floats
    shares: Floats
    along: Floats

    def __post_init__(self) -> None:
        freeze(self, offsets=(3, 3), nets=(3, 3), sizes=(3, 3), shares=(3, 3), along=(None, 3))

    @property
    def where(self) -> tuple[str, str]:
        """The part and the axis with the largest share of the distance, by their names."""
        part, axis = self._most
        return PARTS[part], AXES[axis]

    @property
    def most(self) -> tuple[float, float, float]:
        """The share of the distance there, its net and its size."""
        return float(self.shares[self._most]), float(self.nets[self._most]), float(self.sizes[self._most])

    @property
    def direction(self) -> str | None:
        """The direction in which the first shape is offset there; None if the two cross and no direction prevails."""
        _, net, size = self.most
        return FURTHER[self._most[1]][int(net > 0)] if abs(net) > size / 2 else None

    @property
    def _most(self) -> tuple[int, int]:
        """The third of the path and the axis with the largest share, as indices."""
        part, axis = np.unravel_index(int(self.shares.argmax()), self.shares.shape)
        return int(part), int(axis)


def difference(shape: Floats, reference: Floats) -> Difference:
    """Compare a shape with another, each in its own frame.

    Args:
        shape: The first shape, (T, 3), as `skills.comparison.distances.shape_of` returns it.
        reference: The second, (R, 3), in the same unit.

    Raises:
        EmptyPath: One of them has no state.
    """
    aligned = dtw(shape, reference)
    states = aligned.pairs[:, 1]
    signed = shape[aligned.pairs[:, 0]] - reference[states]
    along = aligned.at_reference(signed)
    third = np.arange(len(reference)) * len(PARTS) // len(reference)
    offsets = np.stack(
        [along[third == part].mean(axis=0) if (third == part).any() else np.zeros(3) for part in range(len(PARTS))]
    )
    inside = third[states] == np.arange(len(PARTS))[:, None]  # membership of the pairs in the thirds
    pairs = inside.sum(axis=1, keepdims=True).clip(1)
    apart = inside @ aligned.differences_mm
    shares = apart / (aligned.total_mm or 1.0)
    return Difference(aligned.total_mm, offsets, inside @ signed / pairs, apart / pairs, shares, along)


# ---- clusters ------------------------------------------------------------------------------------------------------


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
        freeze(self, heights=(size - 1,))
        freeze(self, np.int64, joined=(size - 1, 2), order=(size,))

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
