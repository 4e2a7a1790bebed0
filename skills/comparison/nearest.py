"""Exact nearest neighbours of a shape by DTW among many, without measuring all.

    shapes --ShapeIndex.add--> boxes around their parts
    shape --ShapeIndex.nearest--> the nearest ones with their distances, equal to those of all pairs

A shape is measured only if lower bounds of its distance do not exclude it. Warping is unconstrained here, so the bounds
are of boxes around the parts of a path: each point is paired with some point of the other path, so it is at least as
far as the nearest box; of one part, that is LB_Keogh's bound with an unlimited window. More exactly, a warping passes
through the boxes in order (Sakurai, Yoshikawa and Faloutsos, "FTW: fast similarity search under the time warping
distance", PODS 2005). The most promising candidates are measured first; then all whose bound does not exceed the
distance of the last neighbour found. A warping visits only those pairs of points through which it may stay within that
distance, by what is behind it and the boxes' bound of what is ahead (as by Herrmann and Webb, "Early abandoning and
pruning for elastic distances including dynamic time warping", DMKD 2021, but with a bound ahead).

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
PROMISING = 512  # candidates that are measured first
TOGETHER = 512  # shapes whose coarse bounds are computed together, in the fastest cache
SLACK = 1.0 + 1e-9  # sums of a hundred numbers in another order differ by less
MOST = 140_000  # shapes: 420 MiB
FIRST_ROOM, GROWTH = 1024, 4  # shapes; only the used part of the room is memory
WORTH_A_THREAD = 2000  # shapes

Boxes = NDArray[np.float32]
_HELD = {"_shapes": 0, "_coarse": 2, "_fine": 0, "_rows": 0}  # the arrays of an index, and the axis of their shapes


class ShapeIndex:
    """Shapes in mm by their rows, with the boxes around their parts. Not thread-safe."""

    def __init__(self) -> None:
        self._shapes = np.empty((FIRST_ROOM, STATES, 3))
        self._coarse = np.empty((COARSE, 6, FIRST_ROOM), np.float32)  # by shapes last, for vector instructions
        self._fine = np.empty((FIRST_ROOM, 6, FINE), np.float32)
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
            room = min(GROWTH * place, MOST)
            for name, axis in _HELD.items():  # one after the other, so that only one is there twice
                held = getattr(self, name)
                shape = list(held.shape)
                shape[axis] = room
                grown = np.empty(shape, held.dtype)
                np.moveaxis(grown, axis, 0)[:place] = np.moveaxis(held, axis, 0)
                setattr(self, name, grown)
        self._shapes[place], self._rows[place] = shape_mm, row
        self._coarse[:, :, place], self._fine[place] = boxes_of(shape_mm, COARSE).T, boxes_of(shape_mm, FINE)
        self._places[row] = place

    def remove(self, rows: Iterable[int]) -> None:
        """Remove the shapes of these rows, if they are there, and overwrite them."""
        for row in rows:
            place = self._places.pop(row, None)
            if place is None:
                continue
            last = len(self._places)
            for name, axis in _HELD.items():
                held = np.moveaxis(getattr(self, name), axis, 0)
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
        shapes, fine = self._shapes[:size], self._fine[:size]
        lengths = shapes[:, -1, 0].copy() if scaled else np.ones(size)
        bounds = np.empty(size)
        coarse_boxes, fine_boxes = (boxes_of(path, parts).astype(np.float64) for parts in (COARSE, FINE))
        threads = min(THREADS, 1 + size // WORTH_A_THREAD)

        def bound(start: int, end: int) -> None:
            room = np.empty(TOGETHER), np.empty((COARSE, TOGETHER))
            _kernels.bound_all_compiled(coarse_boxes, STATES / COARSE, self._coarse, lengths, start, end, *room, bounds)

        def search(order: Ints) -> tuple[Ints, Floats]:
            found, totals = np.full(count, -1), np.full(count, np.inf)
            found[: len(known[0])], totals[: len(known[0])] = known
            room = np.empty((6, FINE)), np.empty((3, STATES + 1)), np.empty((2, FINE, STATES))
            given = path, np.ascontiguousarray(path.T), fine_boxes, shapes, fine, lengths, order, bounds, SLACK
            _kernels.search_compiled(*given, *room, found, totals)
            return found[found >= 0], totals[found >= 0]

        def search_all(places: Ints) -> tuple[Ints, Floats]:
            order = places[np.argsort(bounds[places], kind="stable")]
            # Dealt out in turn, so that each thread finds near ones soon; each has those that were known before.
            pairs = list(pool.map(search, (np.ascontiguousarray(order[at::threads]) for at in range(threads))))
            found, totals = (np.concatenate(column) for column in zip(*pairs, strict=True))
            found, first = np.unique(found, return_index=True)
            best = np.lexsort((found, totals[first]))[:count]
            return found[best], totals[first][best]

        with ThreadPoolExecutor(threads) as pool:
            ends = np.linspace(0, size, threads + 1).astype(int).tolist()
            list(pool.map(bound, ends[:-1], ends[1:]))
            if among is not None:
                bounds[~among] = np.inf
            known = np.empty(0, np.int64), np.empty(0)
            promising = np.argpartition(bounds, PROMISING)[:PROMISING] if size > PROMISING else np.arange(size)
            known = search_all(promising[np.isfinite(bounds[promising])])
            limit = known[1][-1] * SLACK if len(known[1]) == count else np.finfo(float).max
            left = bounds <= limit
            left[promising] = False
            known = search_all(np.flatnonzero(left))
        return self._rows[known[0]], known[1]


def boxes_of(shape: Floats, parts: int) -> Boxes:
    """Return the lower and upper corners of the boxes around the parts of a shape, rounded outwards.

    Args:
        shape: Shape (STATES, 3).
        parts: Their number, a divisor of STATES.

    Returns:
        Shape (6, parts).
    """
    of = shape.reshape(parts, STATES // parts, 3)
    low, high = of.min(axis=1).astype(np.float32), of.max(axis=1).astype(np.float32)
    return np.concatenate([np.nextafter(low, np.float32(-np.inf)), np.nextafter(high, np.float32(np.inf))], axis=1).T
