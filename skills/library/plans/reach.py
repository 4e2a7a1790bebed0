"""Where a style can be planned: maps of suture points, not stored."""

from collections import Counter
from math import ceil, floor, prod

import numpy as np

from skills.arrays import xyz
from skills.db.session import Database
from skills.errors import BadPlan
from skills.library.plans.plans import check_frame, stacked, style_of
from skills.planning.path_fit import ends_of
from skills.schemas import PolicyName
from skills.schemas.reach import Reach, ReachIn
from skills.verification.reach import MAX_PLACES, ReachPlace, map_reach


def map_style(database: Database, request: ReachIn) -> Reach:
    """Return where a plan of one pass is possible, without storing a plan.

    Raises:
        BadPlan: There are too many places, the frame is not an arm's base, or a plan with these settings is refused
            wherever it is.
        NoApproach, NoHandOff: As of a plan.
        Conflict: The surgeon's consent does not cover training.
    """
    counts, rotations = _counts(request.size_mm, request.step_mm), len(request.rotations_xyzw)
    if (places := prod(counts) * rotations) > MAX_PLACES:
        wider = (step for step in range(ceil(request.step_mm), 402))
        least = next(step for step in wider if prod(_counts(request.size_mm, step)) * rotations <= MAX_PLACES)
        raise BadPlan(
            f"A map of {places} places is too large; {MAX_PLACES} are the most.",
            f"Give a step of {least} mm, a smaller box, or fewer rotations.",
            places=places,
        )
    style = style_of(database, request.surgeon, request.suture, request.version)
    centre_mm = request.centre_mm or xyz(ends_of(style.demo, style.policy.path)[1])
    plan = stacked(request.plan_at(centre_mm), style)
    check_frame(plan.frame)
    axes = [(np.arange(one) - (one - 1) / 2) * request.step_mm for one in counts]
    box = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    found = map_reach(plan, (np.array(centre_mm) + box).round(6))
    x, y, z = counts
    return Reach(
        surgeon=request.surgeon,
        suture=request.suture,
        policy=PolicyName(version=style.version, sha256=style.sha256),
        arm=plan.arm,
        frame=plan.frame,
        step_mm=request.step_mm,
        counts=(x, y, z),
        rotations=rotations,
        places=found,
        description=describe_reach(found),
    )


def _counts(size_mm: tuple[float, float, float], step_mm: float) -> list[int]:
    """Return the number of places along each axis."""
    return [floor(size / step_mm + 1e-9) + 1 for size in size_mm]


def describe_reach(places: list[ReachPlace]) -> str:
    """Return the result as sentences: how many places are possible, and what limits most of the others."""
    yes = sum(one.reach == "yes" for one in places)
    words = f"{yes} of {len(places)} places can be planned, each in a plan of its own."
    limits = Counter(one.limited_by for one in places if one.reach == "no" and one.limited_by is not None)
    if limits:
        name, count = limits.most_common(1)[0]
        words += f" Most others are refused for {CALLED.get(name, f'the limits of {name}')} ({count})."
    undecided = sum(one.reach == "in doubt" for one in places)
    return words + (f" {undecided} are so near to a limit that only a plan decides." if undecided else "")


CALLED = {
    "bodies": "the distance of the arms' outer bodies",
    "tools": "the distance of the two tools",
    "scene": "the distance from tissue and obstacles",
    "needle": "the needle in the tissue",
}
