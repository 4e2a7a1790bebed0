"""Two policies of a style compared on the same demonstrations.

A policy measured against its own demonstration alone is always near. So two policies are compared on all active
demonstrations from which either was learnt: dynamic time warping of each policy's path from its demonstrated start with
every demonstration's path in its grid, in mm, and the sum over the demonstrations.
"""

from collections.abc import Callable, Collection, Sequence
from functools import partial
from math import nan
from typing import NamedTuple

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.arrays import Floats
from skills.db.models import Demonstration, PolicyVersion
from skills.learning.evaluation import dtw
from skills.learning.policy import Policy
from skills.library.operation.integrity import learnt
from skills.schemas.policies import PolicyManifest
from skills.schemas.training import FitOnTheSame

ROUNDING_MM = 1e-6  # two sums of the same distances in different order differ by less

Space = tuple[str, str]  # arm and frame; paths in different ones cannot be compared


class StylePath(NamedTuple):
    """The path of a demonstration in its grid, or of a policy from its demonstrated start, shape (T, 3) in mm."""

    sha256: str
    space: Space
    tip_mm: Floats


def not_worse(fit: FitOnTheSame) -> bool:
    """Return whether the trained policy is at least as near as the released one; false if they cannot be compared."""
    if fit.trained_mm is None or fit.released_mm is None:
        return False
    return fit.trained_mm <= fit.released_mm + ROUNDING_MM  # NaN is worse


def format_mm(total_mm: float | None) -> str:
    """Return a DTW total as text."""
    return f"{nan if total_mm is None else total_mm:g}"


def compare_paths(released: StylePath, trained: StylePath, references: Sequence[StylePath]) -> FitOnTheSame:
    """Measure two policies against the same demonstrations.

    Args:
        released: The path of the released policy.
        trained: The path of the new policy.
        references: The demonstrations; the totals are None if there are none, or arms or frames differ.
    """
    comparable = references and len({released.space, trained.space, *(one.space for one in references)}) == 1

    def total_mm(path: StylePath) -> float | None:
        if not comparable:
            return None
        return float(sum(dtw(path.tip_mm, one.tip_mm).total_mm for one in references))

    return FitOnTheSame(tuple(one.sha256 for one in references), total_mm(released), total_mm(trained))


def policy_path(sha256: str, manifest: PolicyManifest, policy: Callable[[], Policy]) -> StylePath:
    """Return the path of a policy from its demonstrated start.

    Args:
        sha256: The policy's digest.
        manifest: Its manifest.
        policy: Loads the policy; called only if it does not reproduce its demonstration, because otherwise the manifest
            has the path.
    """
    if not manifest.grid_certificate.demonstration_reproduced:
        return StylePath(sha256, manifest.space, policy().replay.tip_mm)
    return StylePath(sha256, manifest.space, manifest.grid.centres_mm(np.array(manifest.waypoints)))


def reference_paths(session: Session, demonstrations: Collection[int]) -> dict[int, StylePath]:
    """Return the paths of the active ones of some demonstrations, by row, the oldest first."""
    of = Demonstration
    query = select(of.row, of.sha256, of.arm, of.frame, of.path).where(of.row.in_(demonstrations))
    found = session.execute(query.where(of.withdrawn_at.is_(None)).order_by(of.row))
    return {row: StylePath(sha256, (arm, frame), path.tip_mm) for row, sha256, arm, frame, path in found}


def compare_versions(session: Session, released: PolicyVersion, trained: PolicyVersion) -> FitOnTheSame:
    """Measure two stored versions of a style against the active demonstrations from which either was learnt."""
    rows = {one.row for version in (released, trained) for one in version.demonstrations}
    before, after = (policy_path(one.sha256, one.manifest, partial(learnt, one)) for one in (released, trained))
    return compare_paths(before, after, list(reference_paths(session, rows).values()))
