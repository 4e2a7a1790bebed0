"""Fig. 7: one policy, its grid world stacked at five suture points."""

from dataclasses import dataclass

import numpy as np

from skills.style._arrays import Floats
from skills.style.plan import SuturePoint, stack
from skills.style.policy import Policy

N_PASSES = 5
SPACING_MM = (0.0, -15.0, 0.0)  # ours: wider than stitches are, so that five passes can be told apart in a picture


@dataclass(frozen=True, eq=False)
class Stacked:
    """Passes, (K, 3) mm each, and their suture points, (N, 3) mm.

    `worst_miss_mm` is the largest difference, along any axis, between a pass and the demonstration moved there.
    """

    points_mm: Floats
    passes_mm: tuple[Floats, ...]
    worst_miss_mm: float


def stack_passes(policy: Policy) -> Stacked:
    """Stack a policy from its own goal on, each pass from the demonstrated start moved with its grid."""
    path = policy.path
    goal_mm = path.grid.centres_mm(path.goal)
    points_mm = goal_mm + np.arange(N_PASSES)[:, None] * SPACING_MM
    points = [SuturePoint((x, y, z)) for x, y, z in points_mm.tolist()]
    plan = stack(policy, points, arm="PSM", frame="PSM_base", instrument="any", rotation=None)
    passes = tuple(one.tip_mm for one in plan.passes)
    moved = [path.tip_mm + (point - goal_mm) for point in points_mm]
    misses = [_miss_mm(one, demonstrated) for one, demonstrated in zip(passes, moved, strict=True)]
    return Stacked(points_mm, passes, round(max(misses), 9))


def _miss_mm(tip_mm: Floats, demonstrated_mm: Floats) -> float:
    same = tip_mm.shape == demonstrated_mm.shape
    return float(np.abs(tip_mm - demonstrated_mm).max()) if same else float("inf")
