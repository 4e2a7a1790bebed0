"""Seeded hand-off motions with a known number of self-crossings: smooth, at 100 Hz, in mm.

A motion is a spline (Catmull-Rom) through random places, some of which occur a second time: there it crosses itself,
by construction. A motion that also comes near itself elsewhere, or leaves its grid, is drawn again.
"""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from skills.errors import BadPath
from skills.gridworld.grid import PAPER_GRID, GridPath, GridWorld, discretize, fit_grid

RATE_HZ = 100.0
SPEED_MM_S = 30.0
ALL_EDGES = [0, 1, 3, 2, 0, 4, 5, 1, 5, 7, 3, 7, 6, 2, 6, 4]  # of a box; corners are 4x + 2y + z, with x, y, z 0 or 1


def crossings(path: GridPath) -> int:
    """Count the self-crossings of a path: the longest runs of states that were each visited before.

    A run is one crossing, however many cells both passes share.
    """
    again = np.ones(len(path.states), bool)
    again[np.unique(path.states, return_index=True)[1]] = False
    return int(np.count_nonzero(np.diff(again.astype(int)) == 1))  # a first state is never a second visit


def crossing_path(seed: int, n_crossings: int, room: GridWorld = PAPER_GRID, fit_mm: float | None = None) -> GridPath:
    """Draw motions through a grid world until one has the number of crossings, in its cells or in a fitted grid's."""
    for tip_mm in motions(seed, room, n_crossings):
        grid = room if fit_mm is None else fit_grid(tip_mm, fit_mm)
        try:
            path = discretize(tip_mm, grid)
        except BadPath:
            continue
        if crossings(path) == n_crossings:
            return path
    raise AssertionError("motions do not end")


def motions(seed: int, room: GridWorld, n_crossings: int) -> Iterator[np.ndarray]:
    """Draw an endless sequence of motions, (T, 3) mm; more crossings mean fewer other places, for lack of room."""
    rng = np.random.default_rng((seed, n_crossings))
    while True:
        n = n_crossings + int(rng.integers(2, 8 - n_crossings))
        order = list(range(n))
        for place in sorted(rng.permutation(n - 2)[:n_crossings], reverse=True):  # so earlier positions do not shift
            order.insert(int(rng.integers(place + 3, len(order) + 1)), int(place))
        yield spline(places_mm(rng, room, n)[order])


def winding_path(seed: int, room: GridWorld, n_states: int) -> GridPath:
    """Return a path of a number of states that winds through a grid world, its faces included, with any crossings."""
    places = places_mm(np.random.default_rng(seed), room, n_states)
    return GridPath(room, discretize(within(room, spline(places)), room).states[:n_states])


def edge_path(room: GridWorld) -> GridPath:
    """Follow all twelve edges of a grid world, some of them there and back, through its eight corners."""
    corners = np.indices((2, 2, 2)).reshape(3, -1).T[ALL_EDGES] * (np.array(room.shape) - 1)
    places = room.centres_mm(room.states_of(corners))
    return discretize(within(room, spline(places[np.insert((np.diff(places, axis=0) != 0).any(1), 0, True)])), room)


def places_mm(rng: np.random.Generator, room: GridWorld, n: int) -> np.ndarray:
    """Draw n places in a grid world, (n, 3) mm."""
    return np.asarray(room.origin_mm) + room.cell_mm * rng.random((n, 3)) * (np.array(room.shape) - 1)


def within(room: GridWorld, tip_mm: np.ndarray) -> np.ndarray:
    """Clip a motion at the faces of a grid world."""
    low = np.asarray(room.origin_mm)
    return np.clip(tip_mm, low, low + room.cell_mm * (np.array(room.shape) - 1))


def spline(places: np.ndarray) -> np.ndarray:
    """Connect places, (N, 3) mm, smoothly: samples at `RATE_HZ`, (T, 3) mm, one of them on every place."""
    ends = np.vstack([2 * places[0] - places[1], places, 2 * places[-1] - places[-2]])
    slopes = (ends[2:] - ends[:-2]) / 2
    parts = []
    for (a, b), (to_a, to_b) in zip(pairwise(places), pairwise(slopes), strict=True):
        count = max(1, round(float(np.linalg.norm(b - a)) / SPEED_MM_S * RATE_HZ))
        u = (np.arange(count) / count)[:, None]
        blend = (2 * u**3 - 3 * u**2 + 1) * a + (3 * u**2 - 2 * u**3) * b
        parts.append(blend + (u**3 - 2 * u**2 + u) * to_a + (u**3 - u**2) * to_b)
    return np.vstack([*parts, places[-1:]])
