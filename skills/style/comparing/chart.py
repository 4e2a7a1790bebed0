"""A chart of demonstrations: places in a plane about as far apart as the demonstrations are.

Classical multidimensional scaling (Torgerson, 1952): the two directions that hold most of the squared distances.
"""

import numpy as np

from skills.style._arrays import Floats

MANY = 64  # demonstrations: of more, all directions would take long to find where two are wanted


def chart(apart: Floats) -> tuple[Floats, float]:
    """Lay demonstrations out in a plane, given the distances between all, shape (N, N).

    Returns:
        Their places in the distances' unit, shape (N, 2), around 0 with the widest direction first; and the share of
        the distances that is right on it: 1 less the mean error over the mean distance.
    """
    total = apart.sum()
    if not total > 0:
        return np.zeros((len(apart), 2)), 1.0
    places = _placed(apart)
    furthest = places[np.abs(places).argmax(axis=0), [0, 1]]
    places = places * np.where(furthest < 0, -1.0, 1.0)  # a vector's sign says nothing: it is always the same here
    flat = np.hypot(*(np.subtract.outer(axis, axis) for axis in places.T))
    return places, float(1.0 - np.abs(flat - apart).sum() / total)


def _placed(apart: Floats) -> Floats:
    """Find the two directions, (N, 2), given the distances between all; N at least 2."""
    squared = apart**2
    mean = squared.mean(axis=0)
    centred = (mean[:, None] + mean[None, :] - squared - mean.mean()) / 2
    if len(apart) < MANY:
        values, vectors = np.linalg.eigh(centred)
    else:
        from scipy.sparse.linalg import eigsh

        # From the one that lies furthest out, for the start must be no draw: the same atlas has the same chart.
        values, vectors = eigsh(centred, k=2, which="LA", v0=centred[centred.diagonal().argmax()])
    return np.asarray(vectors[:, [-1, -2]] * np.sqrt(values[[-1, -2]].clip(0.0)))
