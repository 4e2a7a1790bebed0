"""The loops of comparing: ordinary Python that `skills.compiled` makes fast. They allocate and raise nothing."""

from typing import Any

from skills.compiled import compiled, inner


@inner
def warped(path: Any, reference: Any, row: Any) -> Any:
    """Sum the Manhattan distances along the shortest warping of two paths, (T, 3) and (R, 3); row: room for R + 1."""
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
    pairs: Any,  # (K, 2): which path, and which reference
    row: Any,  # room for R + 1
    totals: Any,  # (K,), filled
) -> None:
    """Measure how far the path and the reference of each pair are apart."""
    for k in range(pairs.shape[0]):
        totals[k] = warped(paths[pairs[k, 0]], references[pairs[k, 1]], row)


warp_pairs_compiled = compiled(warp_pairs)
