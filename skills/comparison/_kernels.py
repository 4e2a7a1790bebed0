"""The loops of the comparison: ordinary Python that `skills.compiled` compiles. They allocate and raise nothing."""

from typing import Any

from skills.compiled import compiled, inner


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


def warp_pairs(
    paths: Any,  # (N, T, 3)
    references: Any,  # (M, R, 3)
    pairs: Any,  # (K, 2): indices of the path and the reference
    row: Any,  # room for R + 1
    totals: Any,  # (K,), filled
) -> None:
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


warp_pairs_compiled = compiled(warp_pairs)


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


def bound_all(
    path_boxes: Any,  # (6, B)
    each: float,  # points in a part
    boxes: Any,  # (B, 6, at least N)
    lengths: Any,  # (N,)
    start: int,
    end: int,
    near: Any,  # room for as many shapes as are bounded together
    row: Any,  # room for B times as many
    bounds: Any,  # (N,), filled from start to end
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


def search(
    path: Any,  # (T, 3)
    axes: Any,  # (3, T)
    path_boxes: Any,  # (6, B)
    shapes: Any,  # (N, T, 3)
    boxes: Any,  # (N, 6, B)
    lengths: Any,  # (N,)
    order: Any,  # (K,): candidates
    bounds: Any,  # (N,)
    slack: float,
    corners: Any,  # room for (6, B)
    rows: Any,  # room for (3, T + 1)
    parts: Any,  # room for (2, B, T)
    nearest: Any,  # (C,), with candidates found before, and filled
    totals: Any,  # (C,), the same
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


bound_all_compiled = compiled(bound_all)
search_compiled = compiled(search)
