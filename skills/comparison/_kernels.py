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
