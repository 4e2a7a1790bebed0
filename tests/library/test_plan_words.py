"""Headlines of plans: they name omissions, and are green only if the hand-over is probable enough."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from skills.dynamics import NOT_VALIDATED, Servo
from skills.gridworld.scene import Scene, Tissue
from skills.library.plans.description import describe_motion
from skills.library.plans.headline import CHECK_VERSION, costs_most, headline
from skills.schemas import plans as schemas
from skills.schemas.plans import PlanDescription, PlanScene, Timetable
from skills.schemas.playbacks import Headline
from skills.verification.arm_errors import CALIBRATED, UNCALIBRATED, ArmErrors
from skills.verification.execution import ExecutionReport
from skills.verification.gates import Failure
from skills.verification.monte_carlo import estimate_success
from skills.verification.probabilities import JUDGE_VERSION, Cost, EstimateSettings, Faults, SuccessEstimate
from tests.library.verdicts import doubted, of_pass, probability
from tests.verification.test_monte_carlo import PAD_TOP_MM, motion
from tests.verification.test_monte_carlo import PSM_M as OTHER_ARM

NAN = float("nan")
PSM_M = schemas.PsmM.model_construct(approach=(-1.0, 0.0, 0.0))
TISSUE = Scene("PSM1_base", tissue=Tissue.plane((0.0, 0.0, -140.0), (0.0, 0.0, 1.0)))
NONE = Scene("PSM1_base")
JUDGED = Faults(place=0, arms=0, pad=0)


def about(passes: int = 5, psm_m: schemas.PsmM | None = None, moves: bool = False) -> PlanDescription:
    motion = Timetable.model_construct(psm_m_moves=moves, tempo=None)
    hand = {"orientation": "recorded", "departure": None, "a2": None, "scene": None}
    return PlanDescription.model_construct(arm="PSM1", passes=[None] * passes, psm_m=psm_m, trajectory=motion, **hand)


FULL = about(psm_m=PSM_M, moves=True)


def shown(scene: Scene, learnt: str | None = None, *differs: str) -> PlanScene:
    return PlanScene.model_construct(sha256="cd", learnt_sha256=learnt, differs=list(differs), scene=scene)


def line_of(of: PlanDescription, doubt: SuccessEstimate, errors: ArmErrors = CALIBRATED, **more: Any) -> Headline:
    stored = {"check_version": CHECK_VERSION, "stated_by": "installation", "feasible": True, "estimate": doubt}
    stored["executed"] = None
    report: Any = SimpleNamespace(**stored | {"failure_sentence": "Pass 0, A1, sample 3: no."} | more)
    return headline(of, report, errors=errors, lower_bound=0.95)


def told(of: PlanDescription, lower: float, count: int = 990, feasible: bool = True) -> Headline:
    whole = probability(count, lower=lower, upper=min(1.0, count / 1000 + 0.03))
    cost = Cost("registration_deg", probability(count + 4))
    return line_of(of, doubted(whole, of_pass(faults=JUDGED), errors=CALIBRATED, cost=cost), feasible=feasible)


@pytest.mark.parametrize(
    ("of", "words"),
    [
        (about(), "Moves PSM1 along 5 passes; no hand-off: no PSM_M, no A2."),
        (about(1), "Moves PSM1 along 1 pass; no hand-off: no PSM_M, no A2."),
        (about(2, PSM_M), "has no motion of PSM_M"),
        (FULL, "hands the needle to PSM_M at the end of each"),
    ],
)
def test_a_plan_says_what_it_does_and_leaves_out(of: dict[str, Any], words: str):
    assert words in describe_motion(of)


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (None, "Tissue: not given, so nothing is checked against it, and this motion is not exported."),
        (shown(NONE), "Tissue: not given. It is checked against the stated obstacles, and"),
        (shown(TISSUE), "the stated scene, of which its policy knows nothing."),
        (shown(TISSUE, "ab"), "the scene of its policy, whose odds hold at the"),
        (
            shown(TISSUE, "ab", "box 0 is new", "c"),
            "the one that its policy was learnt in: box 0 is new, c",
        ),
    ],
)
def test_a_plan_and_its_verdict_say_which_scene_was_checked(scene: PlanScene | None, words: str):
    of = FULL.model_copy(update={"scene": scene})
    assert words in describe_motion(of)
    assert words in told(of, 0.98).text


def test_an_executed_motion_is_in_the_headline_with_what_it_is_worth():
    failure = Failure(3, 0, 1, 0.03, "effort", 1.0, 0.95, "of its limit", 1.0, 0.03)
    figures = (Servo(), 0.4, (0.9, 0.5, 1.2), 1.0, (1.0, 0.1, 2.0), 0.5, {})
    whole, passes = probability(990, lower=0.98), of_pass(faults=JUDGED)
    for failing, level in ((None, "good"), (failure, "caution")):
        found = ExecutionReport(*figures, failing, False, ("The tip is predicted 0.40 mm off.", NOT_VALIDATED))
        line = line_of(FULL, doubted(whole, passes, errors=CALIBRATED), executed=found)
        assert line.level == level
        assert line.executed in line.text
        assert line.executed.startswith("The tip is predicted 0.40 mm off.") and line.executed.endswith(NOT_VALIDATED)
        assert ("At an end of the ranges: Pass 0, A1, sample 3" in line.executed) == (failing is not None)


def test_a_plan_that_hands_over_and_succeeds_surely_is_good():
    line = told(FULL, 0.98)
    assert (line.level, line.word) == ("good", "Likely to succeed")
    assert "in 990 of 1000 worlds: 99.0 % (98.0 % to 100.0 %, 95 %)" in line.text
    assert "with the errors of a calibrated arm the complete plan" in line.text
    assert line.costs_most in line.text
    assert line.executed == "Not executed: nobody states how the arm is driven (docs/execution.md)."
    assert line.executed in line.text
    assert line.costs_most == "Most is lost by the rotation of PSM_M's base: without it 99.4 % of the worlds succeed."


@pytest.mark.parametrize(
    ("of", "lower", "count", "feasible", "level", "word"),
    [
        (FULL, 0.286, 315, True, "bad", "Likely to fail"),
        (FULL, 0.90, 920, True, "caution", "Uncertain"),
        (FULL, 0.45, 480, True, "caution", "Uncertain"),
        (about(), 0.99, 995, True, "caution", "No hand-off"),
        (about(2, PSM_M), 0.99, 995, True, "caution", "Incomplete"),
        (FULL, 0.99, 995, False, "bad", "Not feasible"),
        (FULL, NAN, 995, True, "caution", "Uncertain"),
    ],
)
def test_nothing_else_is_good(of, lower, count, feasible, level, word):
    line = told(of, lower, count, feasible)
    assert (line.level, line.word) == (level, word)
    assert line.text.startswith(f"{word}: ")
    assert describe_motion(of) in line.text


@pytest.mark.parametrize(
    ("trajectory", "pad_top_mm", "counts", "left_out"),
    [
        (motion(1, OTHER_ARM), PAD_TOP_MM, "hand-over", []),
        (motion(1, OTHER_ARM), None, "hand-over", ["tissue"]),
        (motion(1), PAD_TOP_MM, "hand-over", ["the other arm"]),
        (motion(1, with_a2=False), PAD_TOP_MM, "clearance", ["a hand-off", "the other arm"]),
        (motion(1, with_a2=False), None, "clearance", ["a hand-off", "the other arm", "tissue"]),
    ],
)
def test_odds_count_what_was_judged_and_name_what_was_not(trajectory, pad_top_mm, counts, left_out):
    settings = EstimateSettings(variations=20)
    found = estimate_success(
        trajectory, approach_m=OTHER_ARM.approach, pad_top_mm=pad_top_mm, errors=UNCALIBRATED, settings=settings
    )
    line = line_of(FULL if counts == "hand-over" else about(1), found, UNCALIBRATED)
    always = "how exactly the tip meets its points"
    assert (line.counts, line.not_judged) == (counts, [*left_out, always])
    assert ("the complete plan succeeds in" in line.text) == (counts == "hand-over")
    assert ("the motion stays within reach and clear in" in line.text) == (counts == "clearance")
    assert ("Not judged:" in line.text) == bool(left_out)
    if left_out:
        assert f"Not judged: {', '.join(left_out)}, {always}." in line.text


def test_without_a_hand_off_no_error_is_said_to_cost_success():
    cost = Cost("tip_bias_mm", probability(20, 20))
    found = doubted(probability(15, 20), of_pass(faults=Faults(reach=0, limits=0, pad=0)), errors=CALIBRATED, cost=cost)
    most = line_of(about(1), found).costs_most
    assert most is not None and most.endswith("without it 100.0 % of the worlds stay within reach and clear.")


@pytest.mark.parametrize(
    ("count", "without", "shift_mm", "words"),
    [
        (20, 20, 5.0, "No error by itself lowers this."),
        (15, 16, 5.0, "Most is lost by "),
        (
            15,
            15,
            5.0,
            "it is not more: the rest is lost by the suture point's shift of up to 5 mm along each axis, or sev",
        ),
        (15, 15, 0.0, "it is not more: the rest is lost by several errors together."),
    ],
)
def test_what_lowers_a_probability_is_named_also_if_it_is_no_arm_error(count, without, shift_mm, words):
    settings = EstimateSettings(suture_point_mm=shift_mm)
    cost = Cost("tip_bias_mm", probability(without, 20))
    report: Any = SimpleNamespace(estimate=doubted(probability(count, 20), of_pass(), cost=cost, settings=settings))
    assert words in (costs_most(report) or "")


def test_an_error_that_was_not_judged_is_said_and_not_good():
    whole = probability(999, lower=0.99)
    other = doubted(whole, errors=CALIBRATED)
    another = "judged by another version of the checks; play it again."
    for found, check, words in (
        (replace(other, version=JUDGE_VERSION - 1), CHECK_VERSION, another),
        (other, CHECK_VERSION - 1, another),
        (
            other,
            CHECK_VERSION,
            "with the errors of a calibrated arm, which the installation stated then; now it states",
        ),
    ):
        line = line_of(FULL, found, UNCALIBRATED, check_version=check)
        assert (line.level, line.probability, line.costs_most) == ("caution", None, None)
        assert words in line.text
    line = line_of(FULL, other, UNCALIBRATED, stated_by="request")
    assert (line.level, line.errors) == ("good", "calibrated")
    line = line_of(FULL, other, UNCALIBRATED, stated_by="request", feasible=False)
    assert (line.level, line.errors, line.probability) == ("bad", "calibrated", None)
