"""The headline of a playback: level, sentences, and the probability under the stated errors of the arms."""

from dataclasses import asdict
from typing import Any, Literal

from skills.errors import Conflict
from skills.library.plans.description import hands_over, plan_in_words, psm_m_moves
from skills.verification.arm_errors import CALLED, NAMED, ArmErrors
from skills.verification.probabilities import JUDGE_VERSION
from skills.verification.probabilities import NEEDLE as NEEDLE_ERROR

Level = Literal["good", "caution", "bad"]


Counts = Literal["hand-over", "clearance"]


_LEFT_OUT = {"place": "a hand-off", "arms": "the other arm", "pad": "tissue"}  # by the fault that was not judged


_NEVER_JUDGED = "how exactly the tip meets its points"


MORE_OFTEN_NOT = 0.5  # a plan whose upper bound is below this fails more often than it succeeds


def headline(about: dict[str, Any], report: dict[str, Any], *, errors: ArmErrors, lower_bound: float) -> dict[str, Any]:
    """Return the headline of a playback: level, text, and the probability under the stated errors of the arms.

    Args:
        about: The plan's description, as `describe_plan` writes it.
        report: The playback's stored report.
        errors: The errors that the installation states now; a playback whose request stated its own keeps those.
        lower_bound: The value that the lower bound of the entire plan's probability has to reach for the level `good`.
    """
    feasible = report["feasible"] is True
    try:
        under = judged_under(report, errors)
    except Conflict as unjudged:
        whole, name, most, odds = None, errors.name, None, f". {unjudged.words()}"
        counts, left_out = None, []
    else:
        whole, name, most = under["plan"], under["errors"]["name"], costs_most(report)
        counts, left_out = counted_as(under), not_judged(under)
        odds = f"; {_odds(under)}{'' if most is None else f' {most}'}"
    level = _level(about, feasible, whole, lower_bound)
    word = _word(about, feasible, level)
    exact = f"feasible in an exact simulation{odds}"
    verdict = exact if feasible else report["failure_in_words"]
    return {
        "level": level,
        "word": word,
        "text": f"{word}: {verdict} {plan_in_words(about)}",
        "errors": name,
        "probability": whole,
        "counts": counts,
        "not_judged": left_out,
        "costs_most": most,
    }


def judged_under(report: dict[str, Any], errors: ArmErrors) -> dict[str, Any]:
    """Return the part of a stored report that counts: a `DoubtUnder` as JSON, under the errors stated for the arms.

    These are the errors of the playback's request, or else those that the installation states now.

    Raises:
        Conflict: The verdict is of another version of the checks or of the judge; or the installation states other
            errors since.
    """
    if (report["check_version"], report["doubt"]["version"]) != (CHECK_VERSION, JUDGE_VERSION):
        raise Conflict("This plan was judged by another version of the checks; play it again.")
    stated: dict[str, Any] = report["doubt"]["under"][0]
    if report["stated_by"] != "request" and stated["errors"] != asdict(errors):
        raise Conflict(
            f"This plan was judged with {errors_in_words(stated['errors']['name'])}, which the installation stated "
            f"then; now it states {errors_in_words(errors.name)}. Play it again."
        )
    return stated


def costs_most(report: dict[str, Any]) -> str | None:
    """Return the sentence on the error that costs the most; None where no error was judged by itself."""
    doubted = report["doubt"]
    if not (costs := doubted["costs"]):
        return None
    first, whole = costs[0], doubted["under"][0]["plan"]
    if whole["count"] == whole["of"]:
        return "No error by itself lowers this."
    if first["without"]["count"] <= whole["count"]:
        shift_mm = doubted["settings"]["suture_point_mm"]
        beside = f"the suture point's shift of up to {shift_mm:g} mm along each axis, or " if shift_mm else ""
        return (
            f"Without any single error of the arms it is not more: the rest is lost by {beside}several errors together."
        )
    share = _percent(first["without"]["probability"])
    well = "succeed" if counted_as(doubted["under"][0]) == "hand-over" else "stay clear"
    return f"Most is lost by {error_called(first['error'])}: without it {share} of the worlds {well}."


def error_called(error: str) -> str:
    """Return the name of an error of a `Cost` as a phrase."""
    return "the needle's angle in PSM_A's jaws" if error == NEEDLE_ERROR else CALLED[error]


def _level(about: dict[str, Any], feasible: bool, whole: dict[str, Any] | None, lower_bound: float) -> Level:
    if not feasible or (whole is not None and whole["upper"] is not None and whole["upper"] < MORE_OFTEN_NOT):
        return "bad"
    sure = whole is not None and whole["lower"] is not None and whole["lower"] >= lower_bound
    return "good" if sure and psm_m_moves(about) else "caution"


def _word(about: dict[str, Any], feasible: bool, level: Level) -> str:
    """Return the level in a word or two."""
    if not feasible:
        return "Not feasible"
    if level == "bad":
        return "Likely to fail"
    if not hands_over(about):
        return "No hand-off"
    if not psm_m_moves(about):
        return "Incomplete"
    return "Likely to succeed" if level == "good" else "Uncertain"


def counted_as(under: dict[str, Any]) -> Counts:
    """Return the event of a probability: the needle handed over in every pass, or only a motion that stays clear."""
    return "hand-over" if _judged_in_all(under, "place") else "clearance"


def not_judged(under: dict[str, Any]) -> list[str]:
    """Return, in words, the parts of a plan's success that its probability leaves out."""
    return [words for fault, words in _LEFT_OUT.items() if not _judged_in_all(under, fault)] + [_NEVER_JUDGED]


def _judged_in_all(under: dict[str, Any], fault: str) -> bool:
    passes = under["passes"]
    return bool(passes) and all(one["faults"].get(fault) is not None for one in passes)


def _odds(under: dict[str, Any]) -> str:
    whole, left_out = under["plan"], not_judged(under)
    of = "the complete plan succeeds" if counted_as(under) == "hand-over" else "the motion stays within reach and clear"
    said = (
        f"with {errors_in_words(under['errors']['name'])} {of} in {whole['count']} of {whole['of']} worlds: "
        f"{_percent(whole['probability'])} ({_percent(whole['lower'])} to {_percent(whole['upper'])}, 95 %)."
    )
    return said if left_out == [_NEVER_JUDGED] else f"{said} Not judged: {', '.join(left_out)}."


def errors_in_words(name: str) -> str:
    """Return the phrase for the errors of this name: a default's, or a laboratory's own."""
    if name not in NAMED:
        return f"the stated errors {name!r}"
    return f"the errors of {'an' if name[0] in 'aeiou' else 'a'} {name} arm"


def _percent(part: float | None) -> str:
    """Return a share as a percentage; a share just below 1 is not rounded to 100 %."""
    if part is None:
        return "unknown"
    if 0.9995 <= part < 1:
        return "above 99.9 %"
    return f"{100 * part:.1f} %"


CHECK_VERSION = 1  # part of the job's identity: raise it when verdicts change, so that plans can be played again
