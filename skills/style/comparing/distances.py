"""How far apart shapes are: dynamic time warping with Manhattan distance (Sec. IV), between all of them.

The total is exact and has no tie-break; divided by the states of a shape it is about the mm by which they differ at a
place. One more shape costs one row.
"""

import numpy as np
from numpy.typing import ArrayLike

from skills.style._arrays import Floats, Ints, frozen
from skills.style.comparing import _kernels


def distances(shapes: ArrayLike, references: ArrayLike) -> Floats:
    """Measure the distance of each shape, (N, T, 3), to each reference, (M, R, 3): (N, M), in their own unit."""
    paths = frozen(shapes, np.float64, (None, None, 3), "shapes")
    to = frozen(references, np.float64, (None, None, 3), "references")
    totals = np.empty((len(paths), len(to)))
    _kernels.warp_each_compiled(paths, to, np.empty(to.shape[1] + 1), totals)
    return totals


def medoid(apart: Floats, members: Ints) -> int:
    """Find the member, of rows of a square matrix of distances, that is nearest to all; of equals the first."""
    return int(members[apart[np.ix_(members, members)].sum(axis=1).argmin()])


def spread(apart: Floats, members: Ints) -> float:
    """Measure how consistent members are: the mean distance to their medoid of the others; 0 of one alone."""
    others = members[members != (centre := medoid(apart, members))]
    return float(apart[centre, others].mean()) if len(others) else 0.0
