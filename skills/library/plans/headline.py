"""The headline of a playback: level, sentences, and the probability under the stated errors of the arms.

The sentences about a playback are written here only, so that page, JSON, command line and bag agree. A headline has a
level, for a colour: `good` requires that the plan hands the needle over and succeeds with enough certainty under the
stated errors of the arms.
"""

from typing import NamedTuple

from skills.dynamics import NOT_VALIDATED
from skills.errors import Conflict
from skills.fields import percent
from skills.library.plans.description import describe_motion
from skills.schemas.plans import PlanDescription
from skills.schemas.playbacks import CountedEvent, Headline, Level, Verdict
from skills.verification.arm_errors import CALLED, NAMED, ArmErrors
from skills.verification.execution import ExecutionReport
from skills.verification.probabilities import JUDGE_VERSION, EstimateUnder, Probability
from skills.verification.probabilities import NEEDLE as NEEDLE_ERROR

CHECK_VERSION = 1  # part of the job's identity: raise it when verdicts change, so that plans can be played again
# The event of a probability: of the whole plan, of a pass, and of many worlds.
EVENTS = {"hand-over": "the complete plan succeeds", "clearance": "the motion stays within reach and clear"}
OF_A_PASS = {"hand-over": "succeeds", "clearance": "stays within reach and clear"}
OF_WORLDS = {"hand-over": "succeed", "clearance": "stay within reach and clear"}
_LEFT_OUT = {"place": "a hand-off", "arms": "the other arm", "pad": "tissue"}  # by the fault that was not judged


_NEVER_JUDGED = "how exactly the tip meets its points"


MORE_OFTEN_NOT = 0.5  # a plan whose upper bound is below this fails more often than it succeeds


def headline(plan: PlanDescription, report: Verdict, *, errors: ArmErrors, lower_bound: float) -> Headline:
    """Return the headline of a playback: level, text, and the probability under the stated errors of the arms.

    Args:
        plan: The plan's description.
        report: The playback's stored report.
        errors: The errors that the installation states now; a playback whose request stated its own keeps those.
        lower_bound: The value that the lower bound of the entire plan's probability has to reach for the level `good`.
    """
    said = _Estimated() if not report.feasible else _estimated(plan, report, errors)
    level = _level(plan, report, said.probability, lower_bound)
    word, executed = _word(plan, report.feasible, level), describe_execution(report.executed)
    if not report.feasible:
        verdict = str(report.failure_sentence)
    elif said.estimate is None:
        verdict = f"feasible in an exact simulation. {executed} {said.unjudged}"
    else:
        found = [f"feasible in an exact simulation; {said.estimate}", executed, said.costs_most, said.hand_over]
        verdict = " ".join(filter(None, found))
    return Headline(
        level=level,
        word=word,
        text=f"{word}: {verdict} {describe_motion(plan)}",
        errors=report.estimate.under[0].errors.name if report.stated_by == "request" else errors.name,
        probability=said.probability,
        counts=said.counts,
        event=None if said.counts is None else EVENTS[said.counts],
        estimate=said.estimate,
        under=[*said.under],
        not_judged=[*said.not_judged],
        costs_most=said.costs_most,
        hand_over=said.hand_over,
        executed=executed,
    )


def describe_execution(executed: ExecutionReport | None) -> str:
    """Return the sentences on the motion that PSM_A is predicted to execute, or that it was not executed."""
    if executed is None:
        return "Not executed: nobody states how the arm is driven (docs/execution.md)."
    ends = [] if executed.failure is None or executed.surely else [f"At an end of the ranges: {executed.failure}"]
    return " ".join([executed.reasons[0], *ends, NOT_VALIDATED])


class _Estimated(NamedTuple):
    """The probability of a headline, and the sentences on it; of a plan that is not feasible there is none."""

    probability: Probability | None = None
    counts: CountedEvent | None = None
    estimate: str | None = None
    under: tuple[str, ...] = ()
    not_judged: tuple[str, ...] = ()
    costs_most: str | None = None
    hand_over: str | None = None
    unjudged: str = ""


def _estimated(plan: PlanDescription, report: Verdict, errors: ArmErrors) -> _Estimated:
    try:
        stated = judged_under(report, errors)
    except Conflict as unjudged:
        return _Estimated(unjudged=unjudged.words())
    counts, left_out = counted_as(stated), not_judged(plan, stated)
    whole = stated.plan
    estimate = f"with {describe_errors(stated.errors.name)} {EVENTS[counts]} in {_counted(whole)}."
    if left_out != [_NEVER_JUDGED]:
        estimate = f"{estimate} Not judged: {', '.join(left_out)}."
    under = tuple(
        f"{one.errors.name}: {one.errors.describe()}; every pass {OF_A_PASS[counts]} with a probability of at least "
        f"{min((each.succeeds.lower for each in one.passes), default=0.0):.3f} (95 %)"
        for one in report.estimate.under
    )
    return _Estimated(whole, counts, estimate, under, tuple(left_out), costs_most(report), hand_over(stated))


def hand_over(under: EstimateUnder) -> str | None:
    """Return the sentence on how friction would let PSM_M take the needle; None where a pass has no hand-off."""
    if under.held is None or under.straight is None:
        return None
    return (
        f"The hand-over alone, as friction decides it in simulation: held in {_counted(under.held)}, held straight in "
        f"{_counted(under.straight)}. Not in it: tissue, thread, the surgeon."
    )


def judged_under(report: Verdict, errors: ArmErrors) -> EstimateUnder:
    """Return the part of a stored report that counts: the plan's success under the errors stated for the arms.

    These are the errors of the playback's request, or else those that the installation states now.

    Raises:
        Conflict: The verdict is of another version of the checks or of the judge; or the installation states other
            errors since.
    """
    if (report.check_version, report.estimate.version) != (CHECK_VERSION, JUDGE_VERSION):
        raise Conflict("This plan was judged by another version of the checks; play it again.")
    stated = report.estimate.under[0]
    if report.stated_by != "request" and stated.errors != errors:
        raise Conflict(
            f"This plan was judged with {describe_errors(stated.errors.name)}, which the installation stated "
            f"then; now it states {describe_errors(errors.name)}. Play it again."
        )
    return stated


def costs_most(report: Verdict) -> str | None:
    """Return the sentence on the error that costs the most; None where no error was judged by itself."""
    doubted = report.estimate
    if not (costs := doubted.costs):
        return None
    first, whole = costs[0], doubted.under[0].plan
    if whole.count == whole.of:
        return "No error by itself lowers this."
    if first.without.count <= whole.count:
        shift_mm = doubted.settings.suture_point_mm
        beside = f"the suture point's shift of up to {shift_mm:g} mm along each axis, or " if shift_mm else ""
        return (
            f"Without any single error of the arms it is not more: the rest is lost by {beside}several errors together."
        )
    share = f"{percent(first.without.probability, 1)} %"
    well = OF_WORLDS[counted_as(doubted.under[0])]
    return f"Most is lost by {describe_error(first.error)}: without it {share} of the worlds {well}."


def describe_error(error: str) -> str:
    """Return the name of an error of a `Cost` as a phrase."""
    return "the needle's angle in PSM_A's jaws" if error == NEEDLE_ERROR else CALLED[error]


def _level(plan: PlanDescription, report: Verdict, whole: Probability | None, lower_bound: float) -> Level:
    if not report.feasible or (whole is not None and whole.upper < MORE_OFTEN_NOT):
        return "bad"
    within = report.executed is None or report.executed.failure is None
    sure = whole is not None and whole.lower >= lower_bound and within
    return "good" if sure and plan.psm_m_moves else "caution"


def _word(plan: PlanDescription, feasible: bool, level: Level) -> str:
    """Return the level in a word or two."""
    if not feasible:
        return "Not feasible"
    if level == "bad":
        return "Likely to fail"
    if plan.psm_m is None:
        return "No hand-off"
    if not plan.psm_m_moves:
        return "Incomplete"
    return "Likely to succeed" if level == "good" else "Uncertain"


def counted_as(under: EstimateUnder) -> CountedEvent:
    """Return the event of a probability: the needle handed over in every pass, or only a motion that stays clear."""
    return "hand-over" if _judged_in_all(under, "place") else "clearance"


def not_judged(plan: PlanDescription, under: EstimateUnder) -> list[str]:
    """Return, in words, the parts of a plan's success that its probability leaves out."""
    beside = plan.scene is not None and (plan.scene.scene.boxes or plan.scene.scene.capsules)
    obstacles = ["the stated obstacles"] if beside else []
    left_out = [words for fault, words in _LEFT_OUT.items() if not _judged_in_all(under, fault)]
    return [*left_out, *obstacles, _NEVER_JUDGED]


def _judged_in_all(under: EstimateUnder, fault: str) -> bool:
    passes = under.passes
    return bool(passes) and all(getattr(one.faults, fault) is not None for one in passes)


def describe_errors(name: str) -> str:
    """Return the phrase for the errors of this name: a default's, or a laboratory's own."""
    if name not in NAMED:
        return f"the stated errors {name!r}"
    return f"the errors of {'an' if name[0] in 'aeiou' else 'a'} {name} arm"


def _counted(one: Probability) -> str:
    return (
        f"{one.count} of {one.of} worlds: {percent(one.probability, 1)} % ({percent(one.lower, 1)} % to "
        f"{percent(one.upper, 1)} %, 95 %)"
    )
