"""Verdicts on plans with chosen probabilities of success, as a playback stores them."""

from dataclasses import replace
from typing import Any

from skills.library.plans.headline import CHECK_VERSION
from skills.planning.trajectory import Trajectory
from skills.schemas import PolicyName
from skills.schemas.playbacks import Verdict, finite
from skills.verification.arm_errors import UNCALIBRATED, ArmErrors
from skills.verification.gates import Limits
from skills.verification.playback import Playback
from skills.verification.probabilities import (
    JUDGE_VERSION,
    UPWARDS,
    Cost,
    EstimateSettings,
    EstimateUnder,
    Faults,
    PassEstimate,
    Probability,
    SuccessEstimate,
)
from skills.verification.verdict import judge

WITHOUT_HAND_OFF = Faults(pad=0)


def probability(count: int, of: int = 1000, lower: float = 0.5, upper: float = 1.0) -> Probability:
    return Probability(count, of, count / of, lower, upper)


def of_pass(succeeds: Probability | None = None, faults: Faults = WITHOUT_HAND_OFF) -> PassEstimate:
    succeeds = succeeds or probability(990)
    return PassEstimate(succeeds, succeeds, None, None, None, faults)


def doubted(
    whole: Probability, *passes: PassEstimate, errors: ArmErrors = UNCALIBRATED, cost: Cost | None = None, **more: Any
) -> SuccessEstimate:
    """Return a report on a plan under some errors of the arms."""
    under = (EstimateUnder(whole, None, None, passes, errors),)
    costs = () if cost is None else (cost,)
    rest = {"settings": EstimateSettings(), "limits": Limits(), "version": JUDGE_VERSION, "pad_normal": UPWARDS} | more
    return SuccessEstimate(0, None, False, 0, (), under, costs=costs, **rest)


def doubt_of(*lower: float, errors: ArmErrors = UNCALIBRATED, **more: Any) -> SuccessEstimate:
    """Return a report on a plan without a hand-off, whose passes succeed with these lower bounds."""
    passes = [of_pass(probability(990, lower=bound)) for bound in lower]
    return doubted(probability(700), *passes, errors=errors, cost=Cost("registration_mm", probability(880)), **more)


def verdict_on(of_plan: str, motion: Trajectory, measured: Playback, **chosen: Any) -> Verdict:
    """Return the verdict on a motion, with some of its fields as chosen."""
    report = replace(judge(measured, motion), feasible=True, failure=None)
    stated = {
        "failure_sentence": None,
        "estimate": doubt_of(0.97),
        "plan": of_plan,
        "trajectory": "0" * 64,
        "policy": PolicyName(version=1, sha256="0" * 64),
        "frame": "PSM2_base",
        "scene": None,
        "tissue": "judged",
        "executed": None,
        "stated_by": "installation",
        "check_version": CHECK_VERSION,
    }
    return finite(Verdict(**vars(report) | stated | chosen))
