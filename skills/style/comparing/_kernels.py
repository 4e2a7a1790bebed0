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


def warp_each(
    paths: Any,  # (N, T, 3)
    references: Any,  # (M, R, 3)
    row: Any,  # room for R + 1
    totals: Any,  # (N, M), filled
) -> None:
    """Measure the distance of each path to each reference."""
    for i in range(paths.shape[0]):
        for j in range(references.shape[0]):
            totals[i, j] = warped(paths[i], references[j], row)


warp_each_compiled = compiled(warp_each)
