"""How far apart shapes are: dynamic time warping with Manhattan distance (Sec. IV), between all of them.

The total is exact and has no tie-break; divided by the states of a shape it is about the mm by which they differ at a
place. One more shape costs one row.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike

from skills.style._arrays import Floats, Ints, frozen
from skills.style.comparing import _kernels

THREADS = 2  # the loops let others run meanwhile; the service, which calls this too, needs its other cores
WORTH_A_THREAD = 200  # pairs; of 100 states they take 6 ms


def distances(shapes: ArrayLike, references: ArrayLike) -> Floats:
    """Measure the distance of each shape, (N, T, 3), to each reference, (M, R, 3): (N, M), in their own unit."""
    paths = frozen(shapes, np.float64, (None, None, 3), "shapes")
    to = frozen(references, np.float64, (None, None, 3), "references")
    pairs = np.stack(np.divmod(np.arange(len(paths) * len(to)), max(1, len(to))), axis=1)
    return _measured(paths, to, pairs).reshape(len(paths), len(to))


def distances_of(shapes: ArrayLike, pairs: ArrayLike) -> Floats:
    """Measure how far the shapes of each pair are apart; pairs of rows, (K, 2), of shapes, (N, T, 3): (K,)."""
    paths = frozen(shapes, np.float64, (None, None, 3), "shapes")
    return _measured(paths, paths, np.asarray(pairs))


def _measured(paths: Floats, references: Floats, pairs: Ints) -> Floats:
    chosen = frozen(pairs, np.int64, (None, 2), "pairs")
    totals = np.empty(len(chosen))

    def measure(part: slice) -> None:
        row = np.empty(references.shape[1] + 1)
        _kernels.warp_pairs_compiled(paths, references, chosen[part], row, totals[part])

    ends = np.linspace(0, len(chosen), 1 + min(THREADS, 1 + len(chosen) // WORTH_A_THREAD)).astype(int).tolist()
    parts = [slice(*ends[at : at + 2]) for at in range(len(ends) - 1)]
    if len(parts) == 1:
        measure(parts[0])
        return totals
    with ThreadPoolExecutor(len(parts)) as threads:
        list(threads.map(measure, parts))
    return totals


def medoid(apart: Floats, members: Ints) -> int:
    """Find the member, of rows of a square matrix of distances, that is nearest to all; of equals the first."""
    return int(members[apart[np.ix_(members, members)].sum(axis=1).argmin()])


def spread(apart: Floats, members: Ints) -> float:
    """Measure how consistent members are: the mean distance to their medoid of the others; 0 of one alone."""
    others = members[members != (centre := medoid(apart, members))]
    return float(apart[centre, others].mean()) if len(others) else 0.0
