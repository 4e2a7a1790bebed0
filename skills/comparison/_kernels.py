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
def warped_within(path: Any, reference: Any, row: Any, limit: float) -> Any:
    """Return the same as `warped`; infinity if every warping exceeds a limit before its end.

    Args:
        path: Points, shape (T, 3).
        reference: Points in the same unit, shape (R, 3).
        row: Workspace, shape (R + 1,), overwritten.
        limit: The total from which on the exact one is not needed.
    """
    row[:] = float("inf")
    row[0] = 0.0
    for i in range(path.shape[0]):
        before, row[0] = row[0], float("inf")
        least = float("inf")
        for j in range(reference.shape[0]):
            apart = 0.0
            for axis in range(3):
                apart += abs(path[i, axis] - reference[j, axis])
            best = min(before, row[j], row[j + 1])
            before = row[j + 1]
            row[j + 1] = apart + best
            least = min(least, row[j + 1])
        if least > limit:
            return float("inf")
    return row[reference.shape[0]]


@inner
def boxed_within(path: Any, boxes: Any, row: Any, limit: float) -> Any:
    """Return a lower bound of `warped` from the boxes around a reference's parts; infinity if it exceeds a limit.

    A warping passes through the parts in order, and each of its steps costs at least the distance of the path's point
    from the box of the part.

    Args:
        path: Points, shape (T, 3).
        boxes: Lower and upper corner around each part of the reference, shape (B, 6).
        row: Workspace, at least of shape (B + 1,), overwritten.
        limit: The bound from which on the exact one is not needed.
    """
    parts = boxes.shape[0]
    row[: parts + 1] = float("inf")
    row[0] = 0.0
    for i in range(path.shape[0]):
        before, row[0] = row[0], float("inf")
        least = float("inf")
        for j in range(parts):
            apart = 0.0
            for axis in range(3):
                apart += max(0.0, boxes[j, axis] - path[i, axis], path[i, axis] - boxes[j, axis + 3])
            best = min(before, row[j], row[j + 1])
            before = row[j + 1]
            row[j + 1] = apart + best
            least = min(least, row[j + 1])
        if least > limit:
            return float("inf")
    return row[parts]


@inner
def boxes_apart(boxes: Any, others: Any, row: Any) -> Any:
    """Return the sum of each box's distance from the nearest of the others, or that of the others if it is larger.

    Args:
        boxes: Lower and upper corner around each part of a path, shape (B, 6).
        others: The same of another path, shape (B, 6).
        row: Workspace, at least of shape (B,), overwritten.
    """
    parts = boxes.shape[0]
    row[:parts] = float("inf")
    total = 0.0
    for i in range(parts):
        nearest = float("inf")
        for j in range(parts):
            apart = 0.0
            for axis in range(3):
                apart += max(0.0, others[j, axis] - boxes[i, axis + 3], boxes[i, axis] - others[j, axis + 3])
            nearest = min(nearest, apart)
            row[j] = min(row[j], apart)
        total += nearest
    from_others = 0.0
    for j in range(parts):
        from_others += row[j]
    return max(total, from_others)


def bound_all(
    path_boxes: Any,  # (B, 6)
    each: float,  # points in a part
    boxes: Any,  # (N, B, 6)
    lengths: Any,  # (N,)
    corners: Any,  # room for (B, 6)
    row: Any,  # room for B + 1
    bounds: Any,  # (N,), filled
) -> None:
    """Compute a lower bound of the distance of a path from each shape.

    Every point of a path is paired with some point of the other, so it costs at least its box's distance from the
    nearest box of the other.

    Args:
        path_boxes: Lower and upper corner around each part of the path, shape (B, 6).
        each: Number of points in a part, of the path as of the shapes.
        boxes: Corners around each part of the shapes, shape (N, B, 6).
        lengths: What the boxes of each shape are divided by, shape (N,).
        corners: Workspace, shape (B, 6), overwritten.
        row: Workspace, at least of shape (B,), overwritten.
        bounds: The result, shape (N,), overwritten.
    """
    for k in range(boxes.shape[0]):
        for j in range(boxes.shape[1]):
            for axis in range(6):
                corners[j, axis] = boxes[k, j, axis] / lengths[k]
        bounds[k] = each * boxes_apart(path_boxes, corners, row)


def search(
    path: Any,  # (T, 3)
    path_boxes: Any,  # (B, 6)
    each: float,  # points in a part
    shapes: Any,  # (N, T, 3)
    boxes: Any,  # (N, B, 6)
    lengths: Any,  # (N,)
    order: Any,  # (K,): candidates, by increasing bound
    bounds: Any,  # (N,)
    slack: float,
    corners: Any,  # room for (B, 6)
    row: Any,  # room for T + 1
    scaled: Any,  # room for a shape, (T, 3)
    nearest: Any,  # (C,), filled with candidates
    totals: Any,  # (C,), filled
) -> int:
    """Find the nearest shapes of a path, exactly; return how many were warped whole.

    Args:
        path: Points, shape (T, 3).
        path_boxes: Lower and upper corner around each part of the path, shape (B, 6).
        each: Number of points in a part.
        shapes: Shape (N, T, 3).
        boxes: Corners around each part of the shapes, shape (N, B, 6).
        lengths: What each shape and its boxes are divided by, shape (N,).
        order: The candidates, by increasing bound, shape (K,).
        bounds: A lower bound for each shape, shape (N,).
        slack: Factor above 1: a bound is not trusted to exceed a total by less, because both are rounded.
        corners: Workspace, shape (B, 6), overwritten.
        row: Workspace, shape (T + 1,), overwritten.
        scaled: Workspace, shape (T, 3), overwritten.
        nearest: The candidates found, shape (C,), by increasing distance, then increasing index; -1 where there are
            fewer.
        totals: Their distances, shape (C,), infinite where there are fewer.
    """
    count = nearest.shape[0]
    nearest[:] = -1
    totals[:] = float("inf")
    warped_whole = 0
    for at in range(order.shape[0]):
        one = order[at]
        limit = totals[count - 1] * slack
        if bounds[one] > limit:
            break
        for j in range(boxes.shape[1]):
            for axis in range(6):
                corners[j, axis] = boxes[one, j, axis] / lengths[one]
        if each * boxes_apart(path_boxes, corners, row) > limit or boxed_within(path, corners, row, limit) > limit:
            continue
        for i in range(path.shape[0]):
            for axis in range(3):
                scaled[i, axis] = shapes[one, i, axis] / lengths[one]
        warped_whole += 1
        total = warped_within(path, scaled, row, limit)
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
