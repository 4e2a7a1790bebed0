"""The report of a Monte Carlo estimate: its settings, counts, probabilities, and the cost of each error.

faults of N variations --counted--> EstimateUnder: every pass, and the whole plan
EstimateUnder, Cost --SuccessEstimate--> the report as plain numbers, which is a part of a stored verdict
"""

from dataclasses import dataclass
from math import isfinite, radians

import numpy as np

from skills.arithmetic import wilson
from skills.arrays import Flags
from skills.errors import BadSettings
from skills.fields import Count, Figure, Fraction, Point, schema
from skills.planning.handoff import OPEN_RAD
from skills.verification.arm_errors import ArmErrors
from skills.verification.clearance import GRASPS
from skills.verification.gates import Limits

JUDGE_VERSION = 1  # raise it when the same plan would be judged otherwise
UPWARDS = (0.0, 0.0, 1.0)
ON_THE_WAY, AT_THE_END = ("reach", "limits", "pad", "arms", "bodies", "needle"), ("place", "angle")
NEEDLE = "needle"  # of a `Cost`: the needle's angle in the jaws, which is no error of the arms


@schema
@dataclass(frozen=True)
class EstimateSettings:
    """The errors beside those of the arms, and the conditions of a catch. All are ours; each has its reason.

    Attributes:
        variations: Variations of each pass. With 1000 the bounds are 6 % apart at a probability of a half, 0.4 % at
            one.
        suture_point_mm: Greatest error of the suture point along each axis.
        needle_rad: Greatest rotation of the needle in PSM_A's jaws.
        stated_rad: Greatest angle between the needle's tangent and PSM_M's hinge: the angle by which the needle itself
            bends within jaws that are 2.2 mm wide, so they close on it as on a straight one.
        opening_rad: Opening of each of PSM_M's fingers as it comes in, and throughout where its jaw is not planned.
        stretches: Number of stretches of equal travel into which a pass is divided; some poses of each are checked
            (`looked_at`). With 20, about 50 poses per pass, no other pose was nearer to the pad, nor by more than 0.2
            mm to the other arm.
        unknown_depth_mm: Distance of PSM_M's hinge from its remote centre where its base is not known.
    """

    variations: Count = 1000
    suture_point_mm: float = 5.0
    needle_rad: float = radians(10)
    stated_rad: float = radians(15)
    opening_rad: float = OPEN_RAD
    stretches: Count = 20
    unknown_depth_mm: float = 200.0

    def __post_init__(self) -> None:
        if not (1 <= self.variations <= 1_000_000 and 1 <= self.stretches <= 1000):
            raise BadSettings("The repetition in inexact worlds needs 1 to 1000000 variations and 1 to 1000 stretches.")
        for one in (self.suture_point_mm, self.needle_rad, self.stated_rad, self.opening_rad, self.unknown_depth_mm):
            if not (isfinite(one) and one >= 0):
                raise BadSettings("Every error size must be a finite number, 0 or more.", given=one)


@schema
@dataclass(frozen=True)
class Probability:
    """The number of successful variations, and the probability with its Wilson bounds, 95 %."""

    count: Count
    of: Count
    probability: Fraction
    lower: Fraction
    upper: Fraction


@schema
@dataclass(frozen=True)
class Faults:
    """The number of variations with each fault; one variation may have several. None: the fault was not judged.

    Attributes:
        reach: A joint of either arm beyond its limits.
        limits: The same, or nearer to the limits than the playback allows, or a wrist inside the cannula.
        pad: An arm too near the pad.
        arms: The arms' tools too near each other.
        bodies: Their outer bodies too near each other, or to the other arm's tool.
        needle: The needle in tissue, once it has come out of it.
        place: The needle not between PSM_M's fingers.
        angle: The needle at a wrong angle there, or not there at all.
    """

    reach: Count | None = None
    limits: Count | None = None
    pad: Count | None = None
    arms: Count | None = None
    bodies: Count | None = None
    needle: Count | None = None
    place: Count | None = None
    angle: Count | None = None


@schema
@dataclass(frozen=True)
class PassEstimate:
    """A pass under some errors: it succeeds if it is clear and, if there is a hand-off, the needle is caught.

    Attributes:
        succeeds: Clear and caught.
        clear: Without a fault on the way.
        caught: The needle whole between PSM_M's fingers, and nearly along their hinge; None: no hand-off.
        held: The needle held by PSM_M in whatever way, as friction decides it in simulation; of the hand-over alone.
        straight: Held nearly along the hinge; the same.
        faults: The faults.
    """

    succeeds: Probability
    clear: Probability
    caught: Probability | None
    held: Probability | None
    straight: Probability | None
    faults: Faults


@schema
@dataclass(frozen=True)
class EstimateUnder:
    """A plan under some errors of the arms: every pass, and all of them one after another.

    Attributes:
        plan: The whole plan.
        held: The needle is held by PSM_M in every pass, see `PassEstimate`; None where a pass has no hand-off.
        straight: It is held straight in every pass.
        passes: Each pass.
        errors: The errors.
    """

    plan: Probability
    held: Probability | None
    straight: Probability | None
    passes: tuple[PassEstimate, ...]
    errors: ArmErrors


@schema
@dataclass(frozen=True)
class Cost:
    """The cost of one error: the whole plan, in the same worlds, with this error set to zero.

    Attributes:
        error: Its field in the stated errors, or "needle": the needle's angle in PSM_A's jaws.
        without: The whole plan without it.
    """

    error: str
    without: Probability


@schema
@dataclass(frozen=True)
class SuccessEstimate:
    """The result as plain numbers: the same for the same trajectory, pad, errors, settings and seed on every machine.

    Attributes:
        seed: Seed of the random numbers.
        pad_top_mm: Height of the pad's top along its normal; None: nothing was compared with one.
        with_psm_m: Whether PSM_M's arm was in the scene.
        hand_offs: Number of passes in which a catch was judged.
        looked_at: Number of checked poses of each pass.
        under: Under the stated errors first, then under those of the defaults that differ from them.
        settings: The errors beside those of the arms.
        limits: The playback's limits.
        costs: The errors that the stated ones consist of, the one that costs the most first.
        version: Version of the judge.
        pad_normal: Unit direction out of the pad.
    """

    seed: Count
    pad_top_mm: Figure
    with_psm_m: bool
    hand_offs: Count
    looked_at: tuple[int, ...]
    under: tuple[EstimateUnder, ...]
    settings: EstimateSettings
    limits: Limits
    costs: tuple[Cost, ...]
    version: Count
    pad_normal: Point


def counted(found: list[dict[str, Flags]], taken: list[dict[str, Flags]], errors: ArmErrors) -> EstimateUnder:
    """Count the variations of each pass; variation k of a plan succeeds if variation k of all its passes does.

    Args:
        found: For each pass and each fault that was judged whether it occurs, shape (N,).
        taken: For each pass with a hand-off whether the needle is "held", and "straight", shape (N,).
        errors: The errors of the arms.
    """
    wrong = np.any([np.any(list(one.values()), axis=0) for one in found], axis=0)
    held, straight = (share(~np.all([one[name] for one in taken], axis=0)) if all(taken) else None for name in GRASPS)
    passes = tuple(_pass(*one) for one in zip(found, taken, strict=True))
    return EstimateUnder(share(wrong), held, straight, passes, errors)


def _pass(found: dict[str, Flags], taken: dict[str, Flags]) -> PassEstimate:
    """Count the variations of one pass without a fault, with each fault, and in which the needle is taken."""
    on_the_way, at_the_end = ([found[name] for name in names if name in found] for names in (ON_THE_WAY, AT_THE_END))
    return PassEstimate(
        succeeds=share(np.any(on_the_way + at_the_end, axis=0)),
        clear=share(np.any(on_the_way, axis=0)),
        caught=share(np.any(at_the_end, axis=0)) if at_the_end else None,
        **{name: share(~taken[name]) if taken else None for name in GRASPS},
        faults=Faults(**{name: int(np.count_nonzero(wrong)) for name, wrong in found.items()}),
    )


def share(wrong: Flags) -> Probability:
    """Count the variations without a fault.

    Args:
        wrong: Whether each variation has a fault, shape (N,), at least one.
    """
    count, of = int(np.count_nonzero(~wrong)), len(wrong)
    lower, upper = wilson(count, of)
    return Probability(count, of, count / of, lower, upper)
