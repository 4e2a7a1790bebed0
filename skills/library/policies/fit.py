"""Two policies of a style compared on the same demonstrations."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import nan
from typing import Any

import numpy as np
from sqlalchemy import (
    select,
)
from sqlalchemy.orm import Session

from skills.arrays import Floats
from skills.db.models import (
    Demonstration,
    PolicyVersion,
)
from skills.gridworld.grid import GridPath, GridWorld
from skills.learning.evaluation import dtw
from skills.learning.policy import Policy
from skills.library.operation.integrity import learnt
from skills.schemas.training import FitOnTheSame

ROUNDING_MM = 1e-6  # two sums of the same distances in different order differ by less


@dataclass(frozen=True, eq=False)
class Taught:
    """A demonstration that a policy may have been learnt from: its digest, its arm and frame, and its path."""

    sha256: str
    space: tuple[str, str]  # arm and frame; paths in different ones cannot be compared
    path: GridPath


@dataclass(frozen=True, eq=False)
class PolicyWay:
    """The path of a policy from its demonstrated start, shape (T, 3) in mm, with its arm and frame."""

    tip_mm: Floats
    space: tuple[str, str]


def not_worse(fit: FitOnTheSame) -> bool:
    """Return whether the trained policy is at least as near as the released one; false if they cannot be compared."""
    if fit.trained_mm is None or fit.released_mm is None:
        return False
    return fit.trained_mm <= fit.released_mm + ROUNDING_MM  # NaN is worse


def shown_mm(total_mm: float | None) -> str:
    """Return a DTW total in words."""
    return f"{nan if total_mm is None else total_mm:g}"


def fit_of(released: PolicyWay, trained: PolicyWay, demos: Sequence[Taught]) -> FitOnTheSame:
    """Measure two policies against the same demonstrations.

    Args:
        released: The path of the released policy.
        trained: The path of the new policy.
        demos: The demonstrations; the totals are None if there are none, or arms or frames differ.
    """
    one_space = {released.space, trained.space, *(demo.space for demo in demos)}
    return FitOnTheSame(
        tuple(demo.sha256 for demo in demos),
        *(_total_mm(way, demos) if len(one_space) == 1 and demos else None for way in (released, trained)),
    )


def _total_mm(way: PolicyWay, demos: Sequence[Taught]) -> float:
    return float(sum(dtw(way.tip_mm, demo.path.tip_mm).total_mm for demo in demos))


def way_of(manifest: Mapping[str, Any], policy: Callable[[], Policy]) -> PolicyWay:
    """Return the path of a policy from its demonstrated start.

    Args:
        manifest: The policy's manifest.
        policy: Loads the policy; called only if it does not reproduce its demonstration, because otherwise the manifest
            has the path.
    """
    space = manifest["arm"], manifest["frame"]
    if manifest["grid_certificate"]["demonstration_reproduced"] is not True:
        return PolicyWay(policy().replay.tip_mm, space)
    grid = GridWorld(
        tuple(manifest["grid"]["origin_mm"]), manifest["grid"]["cell_mm"], tuple(manifest["grid"]["shape"])
    )
    return PolicyWay(grid.centres_mm(np.array(manifest["waypoints"])), space)


def taught(session: Session, demonstrations: Collection[int]) -> dict[int, Taught]:
    """Return the active ones of some demonstrations, by row, the oldest first."""
    of = Demonstration
    query = select(of.row, of.sha256, of.arm, of.frame, of.path).where(of.row.in_(demonstrations))
    found = session.execute(query.where(of.withdrawn_at.is_(None)).order_by(of.row))
    return {row: Taught(sha256, (arm, frame), path) for row, sha256, arm, frame, path in found}


def fit_of_versions(session: Session, released: PolicyVersion, trained: PolicyVersion) -> FitOnTheSame:
    """Measure two stored versions of a style against the active demonstrations from which either was learnt."""
    rows = {one.row for version in (released, trained) for one in version.demonstrations}
    before, after = (way_of(one.manifest, partial(learnt, one)) for one in (released, trained))
    return fit_of(before, after, list(taught(session, rows).values()))
