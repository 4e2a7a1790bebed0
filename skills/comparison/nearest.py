"""Exact nearest neighbours of a shape by DTW among many, without measuring all.

    shapes --ShapeIndex.add--> boxes around their parts
    shape --ShapeIndex.nearest--> the nearest ones with their distances, equal to those of all pairs

A shape is measured only if lower bounds of its distance do not exclude it. Warping is unconstrained here, so the bounds
are of boxes around the parts of a path: each point is paired with some point of the other path, so it is at least as
far as the nearest box; of one part, that is LB_Keogh's bound with an unlimited window. More exactly, a warping passes
through the boxes in order (Sakurai, Yoshikawa and Faloutsos, "FTW: fast similarity search under the time warping
distance", PODS 2005). The candidates are taken by increasing bound until it exceeds the distance of the last neighbour
found; a warping is abandoned once it exceeds that too.

Shapes and boxes are held in memory: 3.1 kB for each, at most `MOST`.
"""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from skills.arrays import Flags, Floats, Ints
from skills.comparison import _kernels
from skills.comparison.distances import STATES, THREADS

COARSE, FINE = 10, 20  # parts of a shape; the coarse boxes are compared with all shapes, the fine ones with some
SLACK = 1.0 + 1e-9  # sums of a hundred numbers in another order differ by less
MOST = 140_000  # shapes: 420 MiB
FIRST_ROOM, LAST_GROWN = 1024, 16_384  # shapes; beyond, there is room for `MOST`, of which only the used part is memory
GROWTH = 4
WORTH_A_THREAD = 2000  # shapes

Boxes = NDArray[np.float32]


class ShapeIndex:
    """Shapes in mm by their rows, with the boxes around their parts. Not thread-safe."""

    def __init__(self) -> None:
        self._shapes = np.empty((FIRST_ROOM, STATES, 3))
        self._coarse = np.empty((FIRST_ROOM, COARSE, 6), np.float32)
        self._fine = np.empty((FIRST_ROOM, FINE, 6), np.float32)
        self._rows = np.empty(FIRST_ROOM, np.int64)
        self._places: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, row: int) -> bool:
        return row in self._places

    @property
    def rows(self) -> Ints:
        """The rows of the shapes, in the order of their places, shape (N,)."""
        return self._rows[: len(self)]

    def shape_of(self, row: int) -> Floats:
        """Return the shape of a row that is in the index, (STATES, 3), in mm."""
        return np.array(self._shapes[self._places[row]])

    def add(self, row: int, shape_mm: Floats) -> None:
        """Add a shape, (STATES, 3), under a row that is not in the index, which has fewer than `MOST`."""
        assert row not in self._places and len(self) < MOST
        place = len(self)
        if place == len(self._rows):
            for name in (
                "_shapes",
                "_coarse",
                "_fine",
                "_rows",
            ):  # one after the other, so that only one is there twice
                held = getattr(self, name)
                room = np.empty((int(GROWTH * place), *held.shape[1:]), held.dtype)
                room[:place] = held
                setattr(self, name, room)
        self._shapes[place], self._rows[place] = shape_mm, row
        self._coarse[place], self._fine[place] = boxes_of(shape_mm, COARSE), boxes_of(shape_mm, FINE)
        self._places[row] = place

    def remove(self, rows: Iterable[int]) -> None:
        """Remove the shapes of these rows, if they are there, and overwrite them."""
        for row in rows:
            place = self._places.pop(row, None)
            if place is None:
                continue
            last = len(self._places)
            for held in (self._shapes, self._coarse, self._fine, self._rows):
                held[place] = held[last]
                held[last] = 0
            if place != last:
                self._places[int(self._rows[place])] = place

    def nearest(
        self, shape: Floats, count: int, *, scaled: bool = False, among: Flags | None = None
    ) -> tuple[Ints, Floats]:
        """Return the rows of the nearest shapes and their DTW totals, nearest first; each of shape (C,), C <= count.

        Of equally near ones the first in the index comes first.

        Args:
            shape: Shape (STATES, 3), in mm or scaled.
            count: Number of neighbours, at least 1.
            scaled: Compare shapes in lengths of start to goal.
            among: The places that may be found, shape (N,); None: all.
        """
        size = len(self)
        path = np.array(shape, np.float64, order="C")
        shapes, coarse, fine = self._shapes[:size], self._coarse[:size], self._fine[:size]
        lengths = shapes[:, -1, 0].copy() if scaled else np.ones(size)
        bounds = np.empty(size)
        mine = {parts: boxes_of(path, parts) for parts in (COARSE, FINE)}
        threads = min(THREADS, 1 + size // WORTH_A_THREAD)

        def bound(part: slice) -> None:
            room = np.empty((COARSE, 6)), np.empty(COARSE)
            _kernels.bound_all_compiled(mine[COARSE], STATES / COARSE, coarse[part], lengths[part], *room, bounds[part])

        def search(order: Ints) -> tuple[Ints, Floats]:
            room = np.empty((FINE, 6)), np.empty(STATES + 1), np.empty((STATES, 3))
            found, totals = np.empty(count, np.int64), np.empty(count)
            _kernels.search_compiled(
                path, mine[FINE], STATES / FINE, shapes, fine, lengths, order, bounds, SLACK, *room, found, totals
            )
            return found[found >= 0], totals[found >= 0]

        with ThreadPoolExecutor(threads) as pool:
            ends = np.linspace(0, size, threads + 1).astype(int).tolist()
            list(pool.map(bound, (slice(*ends[at : at + 2]) for at in range(threads))))
            places = np.arange(size) if among is None else np.flatnonzero(among)
            order = places[np.argsort(bounds[places], kind="stable")]
            # Dealt out in turn, so that each thread finds near ones soon.
            found = list(pool.map(search, (np.ascontiguousarray(order[at::threads]) for at in range(threads))))
        nearest, totals = (np.concatenate(column) for column in zip(*found, strict=True))
        first = np.lexsort((nearest, totals))[:count]
        return self._rows[nearest[first]], totals[first]


def boxes_of(shape: Floats, parts: int) -> Boxes:
    """Return the lower and upper corners of the boxes around the parts of a shape, rounded outwards.

    Args:
        shape: Shape (STATES, 3).
        parts: Their number, a divisor of STATES.

    Returns:
        Shape (parts, 6).
    """
    of = shape.reshape(parts, STATES // parts, 3)
    low, high = of.min(axis=1).astype(np.float32), of.max(axis=1).astype(np.float32)
    return np.concatenate([np.nextafter(low, np.float32(-np.inf)), np.nextafter(high, np.float32(np.inf))], axis=1)
