"""The headline of a playback: level, sentences, and the probability under the stated errors of the arms.

The sentences about a playback are written here only, so that page, JSON, command line and bag agree. A headline has a
level, for a colour: `good` requires that the plan hands the needle over and succeeds with enough certainty under the
stated errors of the arms.
"""

from skills.errors import Conflict
from skills.library.plans.description import describe_motion
from skills.schemas.plans import PlanDescription
from skills.schemas.playbacks import CountedEvent, Headline, Level, Verdict
from skills.verification.arm_errors import CALLED, NAMED, ArmErrors
from skills.verification.probabilities import JUDGE_VERSION, EstimateUnder, Probability
from skills.verification.probabilities import NEEDLE as NEEDLE_ERROR

CHECK_VERSION = 1  # part of the job's identity: raise it when verdicts change, so that plans can be played again
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
    feasible = report.feasible
    try:
        under = judged_under(report, errors)
    except Conflict as unjudged:
        whole, name, most, odds = None, errors.name, None, f". {unjudged.words()}"
        counts: CountedEvent | None = None
        left_out: list[str] = []
    else:
        whole, name, most = under.plan, under.errors.name, costs_most(report)
        counts, left_out = counted_as(under), not_judged(under)
        odds = f"; {_odds(under)}{'' if most is None else f' {most}'}"
    level = _level(plan, feasible, whole, lower_bound)
    word = _word(plan, feasible, level)
    exact = f"feasible in an exact simulation{odds}"
    verdict = exact if feasible else report.failure_sentence
    return Headline(
        level=level,
        word=word,
        text=f"{word}: {verdict} {describe_motion(plan)}",
        errors=name,
        probability=whole,
        counts=counts,
        not_judged=left_out,
        costs_most=most,
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
    share = _percent(first.without.probability)
    well = "succeed" if counted_as(doubted.under[0]) == "hand-over" else "stay clear"
    return f"Most is lost by {describe_error(first.error)}: without it {share} of the worlds {well}."


def describe_error(error: str) -> str:
    """Return the name of an error of a `Cost` as a phrase."""
    return "the needle's angle in PSM_A's jaws" if error == NEEDLE_ERROR else CALLED[error]


def _level(plan: PlanDescription, feasible: bool, whole: Probability | None, lower_bound: float) -> Level:
    if not feasible or (whole is not None and whole.upper < MORE_OFTEN_NOT):
        return "bad"
    sure = whole is not None and whole.lower >= lower_bound
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


def not_judged(under: EstimateUnder) -> list[str]:
    """Return, in words, the parts of a plan's success that its probability leaves out."""
    return [words for fault, words in _LEFT_OUT.items() if not _judged_in_all(under, fault)] + [_NEVER_JUDGED]


def _judged_in_all(under: EstimateUnder, fault: str) -> bool:
    passes = under.passes
    return bool(passes) and all(getattr(one.faults, fault) is not None for one in passes)


def _odds(under: EstimateUnder) -> str:
    whole, left_out = under.plan, not_judged(under)
    of = "the complete plan succeeds" if counted_as(under) == "hand-over" else "the motion stays within reach and clear"
    said = (
        f"with {describe_errors(under.errors.name)} {of} in {whole.count} of {whole.of} worlds: "
        f"{_percent(whole.probability)} ({_percent(whole.lower)} to {_percent(whole.upper)}, 95 %)."
    )
    return said if left_out == [_NEVER_JUDGED] else f"{said} Not judged: {', '.join(left_out)}."


def describe_errors(name: str) -> str:
    """Return the phrase for the errors of this name: a default's, or a laboratory's own."""
    if name not in NAMED:
        return f"the stated errors {name!r}"
    return f"the errors of {'an' if name[0] in 'aeiou' else 'a'} {name} arm"


def _percent(part: float) -> str:
    """Return a share as a percentage; a share just below 1 is not rounded to 100 %."""
    if 0.9995 <= part < 1:
        return "above 99.9 %"
    return f"{100 * part:.1f} %"
