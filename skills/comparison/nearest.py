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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skills.arrays import Flags, Floats, Ints
from skills.comparison.distances import STATES, THREADS
from skills.compiled import compiled, inner

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
            """Fill the bounds of the shapes from `start` to `end`."""
            room = np.empty(TOGETHER), np.empty((COARSE, TOGETHER))
            bound_all(coarse_boxes, STATES / COARSE, self._coarse, lengths, start, end, *room, bounds)

        def search(order: Ints) -> tuple[Ints, Floats]:
            """Return the places and totals of the nearest shapes among those of an order, and of those known before."""
            found, totals = np.full(count, -1), np.full(count, np.inf)
            found[: len(known[0])], totals[: len(known[0])] = known
            room = np.empty((6, FINE)), np.empty((3, STATES + 1)), np.empty((2, FINE, STATES))
            given = path, np.ascontiguousarray(path.T), fine_boxes, shapes, fine, lengths, order, bounds, SLACK
            search_shapes(*given, *room, found, totals)
            return found[found >= 0], totals[found >= 0]

        def search_all(places: Ints) -> tuple[Ints, Floats]:
            """Return the places and totals of the nearest shapes among some places, on all threads."""
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


# ---- compiled loops -------------------------------------------------------------------------------------------------


@inner
def boxes_apart(path_boxes: Any, boxes: Any, near: Any, far: Any) -> Any:
    """Return the sum of each box's distance from the nearest of the others, or that of the others if it is larger.

    Args:
        path_boxes: Lower and upper corner around each part of a path, shape (6, B).
        boxes: The same of another path, shape (6, B).
        near: Workspace, at least of shape (B,), overwritten: the distance of each of the path's boxes.
        far: The same of the others.
    """
    parts = path_boxes.shape[1]
    near[:parts] = float("inf")
    far[:parts] = float("inf")
    for i in range(parts):
        _approach(path_boxes, boxes, i, far)
        _approach(boxes, path_boxes, i, near)
    from_path, from_others = 0.0, 0.0
    for i in range(parts):
        from_path += near[i]
        from_others += far[i]
    return max(from_path, from_others)


@inner
def _approach(boxes: Any, others: Any, i: int, least: Any) -> None:
    """Lower the distances of the others to those from box i."""
    low_x, low_y, low_z = boxes[0, i], boxes[1, i], boxes[2, i]
    high_x, high_y, high_z = boxes[3, i], boxes[4, i], boxes[5, i]
    from_x, from_y, from_z, to_x, to_y, to_z = others[0], others[1], others[2], others[3], others[4], others[5]
    for j in range(others.shape[1]):  # a plain loop over contiguous numbers, which becomes vector instructions
        apart = max(max(from_x[j] - high_x, low_x - to_x[j]), 0.0)
        apart += max(max(from_y[j] - high_y, low_y - to_y[j]), 0.0)
        apart += max(max(from_z[j] - high_z, low_z - to_z[j]), 0.0)
        least[j] = min(least[j], apart)


@inner
def points_apart(axes: Any, boxes: Any, apart: Any, before: Any) -> Any:
    """Return the sum of each point's distance from the nearest box.

    Args:
        axes: The points of a path by axes, shape (3, T).
        boxes: Corners around each part of another path, shape (6, B).
        apart: The distance of each point from each box, shape (B, T), filled.
        before: The sum over the points before each one, shape (T,), filled.
    """
    x, y, z = axes[0], axes[1], axes[2]
    before[:] = float("inf")
    for part in range(boxes.shape[1]):
        low_x, low_y, low_z = boxes[0, part], boxes[1, part], boxes[2, part]
        high_x, high_y, high_z = boxes[3, part], boxes[4, part], boxes[5, part]
        from_it = apart[part]
        for i in range(axes.shape[1]):
            there = max(max(low_x - x[i], x[i] - high_x), 0.0)
            there += max(max(low_y - y[i], y[i] - high_y), 0.0)
            there += max(max(low_z - z[i], z[i] - high_z), 0.0)
            from_it[i] = there
            before[i] = min(before[i], there)
    total = 0.0
    for i in range(axes.shape[1]):
        nearest = before[i]
        before[i] = total
        total += nearest
    return total


@inner
def ahead_within(apart: Any, before: Any, limit: float, ahead: Any) -> Any:
    """Return a lower bound of `warped` from the boxes around a reference's parts; infinity if it exceeds a limit.

    A warping passes through the parts in order, and each of its steps costs at least the distance of the path's point
    from the box of the part. It is followed from its end to its start, and only as far as the limit allows.

    Args:
        apart: The distance of each point from each box, shape (B, T).
        before: A lower bound of the cost before each point, shape (T,).
        limit: The bound from which on the exact one is not needed.
        ahead: A lower bound of the cost from each point in each part to the end, the point included, shape (B, T),
            filled; infinite where the limit is exceeded.
    """
    parts, points = apart.shape[0], apart.shape[1]
    ahead[:] = float("inf")
    lowest, highest = points - 1, points - 1  # the points from which the part after this one leads to the end
    for part in range(parts - 1, -1, -1):
        after, here = ahead[min(part + 1, parts - 1)], ahead[part]
        low, high = -1, -1
        for i in range(highest, -1, -1):
            best = float("inf")
            if i + 1 < points:
                best = here[i + 1]
            elif part == parts - 1:
                best = 0.0
            if part + 1 < parts:
                best = min(best, after[i])
                if i + 1 < points:
                    best = min(best, after[i + 1])
            if best == float("inf") and i + 1 < lowest:
                break
            total = apart[part, i] + best
            if before[i] + total <= limit:
                here[i] = total
                low = i
                high = max(high, i)
        lowest, highest = low, high
        if high < 0:
            return float("inf")
    return ahead[0, 0]


@inner
def warped_within(path: Any, reference: Any, length: float, ahead: Any, limit: float, row: Any, next_row: Any) -> Any:
    """Return the same as `warped`, to the last bit; infinity if every warping exceeds a limit.

    Only those pairs of points are visited through which a warping may stay within the limit.

    Args:
        path: Points, shape (T, 3).
        reference: Points, shape (T, 3).
        length: What the reference is divided by.
        ahead: A lower bound of the cost from each point of the path, paired with one of each part of the reference, to
            the end, shape (B, T).
        limit: The total from which on the exact one is not needed.
        row: Workspace, shape (T + 1,), overwritten.
        next_row: The same.
    """
    points, each = reference.shape[0], reference.shape[0] // ahead.shape[0]
    row[0] = 0.0
    first, last = 0, 0  # the cells of the row that are within the limit are between these
    for i in range(path.shape[0]):
        start = max(1, first)
        next_row[start - 1] = float("inf")
        low, high = -1, -1
        for j in range(start, points + 1):
            best = next_row[j - 1]
            if j - 1 <= last:
                best = min(best, row[j - 1])
            elif best == float("inf"):
                break
            if j <= last:
                best = min(best, row[j])
            next_row[j] = float("inf")
            if best + ahead[(j - 1) // each, i] <= limit:
                apart = 0.0
                for axis in range(3):
                    apart += abs(path[i, axis] - reference[j - 1, axis] / length)
                next_row[j] = apart + best
                if low < 0:
                    low = j
                high = j
        if low < 0:
            return float("inf")
        first, last = low, high
        row, next_row = next_row, row
    return row[points] if last == points else float("inf")


@compiled
def bound_all(
    path_boxes: Any, each: float, boxes: Any, lengths: Any, start: int, end: int, near: Any, row: Any, bounds: Any
) -> None:
    """Compute a lower bound of the distance of a path from each shape.

    Every point of a path is paired with some point of the other, so it costs at least its box's distance from the
    nearest box of the other.

    Args:
        path_boxes: Lower and upper corner around each part of the path, shape (6, B).
        each: Number of points in a part, of the path as of the shapes.
        boxes: Corners around each part of the shapes, shape (B, 6, at least N).
        lengths: What the boxes of each shape are divided by, shape (N,).
        start: The first shape.
        end: The shape after the last one.
        near: Workspace, shape (W,), overwritten.
        row: Workspace, shape (B, W), overwritten.
        bounds: The result, shape (N,), overwritten from `start` to `end`.
    """
    parts = path_boxes.shape[1]
    for at in range(start, end, near.shape[0]):
        to = min(at + near.shape[0], end)
        scale, least, out = lengths[at:to], near[: to - at], bounds[at:to]
        out[:] = 0.0
        row[:] = float("inf")
        for i in range(parts):
            low_x, low_y, low_z = path_boxes[0, i], path_boxes[1, i], path_boxes[2, i]
            high_x, high_y, high_z = path_boxes[3, i], path_boxes[4, i], path_boxes[5, i]
            least[:] = float("inf")
            for j in range(parts):
                from_x, from_y, from_z = boxes[j, 0, at:to], boxes[j, 1, at:to], boxes[j, 2, at:to]
                to_x, to_y, to_z = boxes[j, 3, at:to], boxes[j, 4, at:to], boxes[j, 5, at:to]
                from_other = row[j]
                for k in range(to - at):  # over shapes, so that it becomes vector instructions
                    apart = max(max(from_x[k] - high_x * scale[k], low_x * scale[k] - to_x[k]), 0.0)
                    apart += max(max(from_y[k] - high_y * scale[k], low_y * scale[k] - to_y[k]), 0.0)
                    apart += max(max(from_z[k] - high_z * scale[k], low_z * scale[k] - to_z[k]), 0.0)
                    least[k] = min(least[k], apart)
                    from_other[k] = min(from_other[k], apart)
            for k in range(to - at):
                out[k] += least[k]
        least[:] = 0.0
        for j in range(parts):
            from_other = row[j]
            for k in range(to - at):
                least[k] += from_other[k]
        for k in range(to - at):
            out[k] = each * max(out[k], least[k]) / scale[k]


@compiled
def search_shapes(
    path: Any,
    axes: Any,
    path_boxes: Any,
    shapes: Any,
    boxes: Any,
    lengths: Any,
    order: Any,
    bounds: Any,
    slack: float,
    corners: Any,
    rows: Any,
    parts: Any,
    nearest: Any,
    totals: Any,
) -> int:
    """Find the nearest shapes of a path, exactly; return how many were warped.

    Args:
        path: Points, shape (T, 3).
        axes: The same by axes, shape (3, T).
        path_boxes: Lower and upper corner around each part of the path, shape (6, B).
        shapes: Shape (N, T, 3).
        boxes: Corners around each part of the shapes, shape (N, 6, B).
        lengths: What each shape and its boxes are divided by, shape (N,).
        order: The candidates, best by increasing bound, shape (K,).
        bounds: A lower bound for each shape, shape (N,).
        slack: Factor above 1: a bound is not trusted to exceed a total by less, because both are rounded.
        corners: Workspace, shape (6, B), overwritten.
        rows: Workspace, shape (3, T + 1), overwritten.
        parts: Workspace, shape (2, B, T), overwritten.
        nearest: The candidates found, shape (C,), by increasing distance, then increasing index; -1 where there are
            fewer.
        totals: Their distances, shape (C,), infinite where there are fewer.
    """
    count, each = nearest.shape[0], path.shape[0] / path_boxes.shape[1]
    apart, ahead, before = parts[0], parts[1], rows[2, : path.shape[0]]
    warped_whole = 0
    for at in range(order.shape[0]):
        one = order[at]
        limit = totals[count - 1] * slack
        if bounds[one] > limit:
            continue
        for axis in range(6):
            for part in range(corners.shape[1]):
                corners[axis, part] = boxes[one, axis, part] / lengths[one]
        if each * boxes_apart(path_boxes, corners, rows[0], rows[1]) > limit:
            continue
        if points_apart(axes, corners, apart, before) > limit or ahead_within(apart, before, limit, ahead) > limit:
            continue
        warped_whole += 1
        total = warped_within(path, shapes[one], lengths[one], ahead, limit, rows[0], rows[1])
        last = count - 1
        if total == float("inf") or total > totals[last] or (total == totals[last] and one > nearest[last]):
            continue
        while last > 0 and (total < totals[last - 1] or (total == totals[last - 1] and one < nearest[last - 1])):
            totals[last] = totals[last - 1]
            nearest[last] = nearest[last - 1]
            last -= 1
        totals[last] = total
        nearest[last] = one
    return warped_whole
