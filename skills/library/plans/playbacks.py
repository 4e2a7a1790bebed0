"""Playbacks: plans played in the simulator, the verdict, its headline in words, and the film and plots.

    plan --check_playback--> playback --draw_pictures--> film and plots
    plan, playback --headline--> level, text and probability

The sentences about a plan and a playback are written here only, so that page, JSON, command line and bag agree. A
headline has a level, for a colour: `good` requires that the plan hands the needle over and succeeds with enough
certainty under the stated errors of the arms. The comparisons are written so that null or NaN is never good.

A plan may be played even if its policy was withdrawn since: a verdict moves no arm. Every playback is returned with the
current state of the policy's release, and it is the replay bag that is refused for a policy that is not released.

The film and plots of a playback are drawn by a worker after the verdict is stored. A client that waits for the verdict
does not wait for them, and they are not part of it.
"""

from collections.abc import Callable
from dataclasses import asdict
from math import isfinite
from typing import Any, Literal

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db import rfc3339
from skills.db.models import StoredPictures, StoredPlayback
from skills.db.packed import digest
from skills.db.service_tables import Job, record_event
from skills.db.session import Database
from skills.errors import Conflict, NotDrawnYet
from skills.library.operation import jobs
from skills.library.operation.integrity import find_by_digest, learnt, planned
from skills.library.operation.jobs import PICTURES, PicturesRequest, PlaybackRequest
from skills.library.plans.arm_errors import stated_errors
from skills.library.plans.plans import (
    check_frame,
    find_plan,
    hand_of,
    hands_over,
    plan_in_words,
    psm_m_moves,
    trajectory_of,
)
from skills.library.policies import releases, versions
from skills.packing import canonical, sha256
from skills.remedies import Action, Remedy
from skills.settings import Settings
from skills.verification.arm_errors import CALLED, NAMED, ArmErrors
from skills.verification.playback import Pictures
from skills.verification.probabilities import JUDGE_VERSION
from skills.verification.probabilities import NEEDLE as NEEDLE_ERROR
from skills.verification.verdict import judge_plan

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
    """Return the part of a stored report that counts: a `EstimateUnder` as JSON, under the errors stated for the arms.

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


def request_playback(
    session: Session, plan_sha256: str, actor: str, settings: Settings, errors: ArmErrors | None = None
) -> tuple[Job, bool]:
    """Queue the playback of a plan in the simulator; return the job, and whether it is new.

    Args:
        session: The caller's transaction.
        plan_sha256: The plan's digest.
        actor: The caller's name.
        settings: The installation's settings.
        errors: The errors of the arms that are to play it; None: those that the installation states.

    Raises:
        BadPlan: Its frame is not the arm's base, so the simulator would place it wrongly.
        Conflict: The surgeon's consent does not cover training.
    """
    plan = find_plan(session, plan_sha256)
    versions.followable(plan.policy)
    check_frame(plan.about["frame"])
    request = playback_request(plan.sha256, settings, errors)
    return jobs.ask(session, "playback", request, plan.policy.surgeon, actor)


def playback_request(plan_sha256: str, settings: Settings, errors: ArmErrors | None) -> PlaybackRequest:
    """Return the request of a playback's job, all defaults resolved; the arguments are those of `request_playback`."""
    return {
        "plan": plan_sha256,
        "check_version": CHECK_VERSION,
        "errors": asdict(stated_errors(settings.arm_errors) if errors is None else errors),
        "stated_by": "installation" if errors is None else "request",
    }


def check_playback(
    database: Database, request: PlaybackRequest, settings: Settings
) -> Callable[[Session, str], dict[str, Any]]:
    """Play a plan in the simulator, judge it, and estimate its probability of success by Monte Carlo.

    The returned function stores all of it.
    """
    from skills.simulation.player import play

    with database.reading() as session:
        stored = find_plan(session, request["plan"])
        plan, policy = planned(stored), {"version": stored.policy.version, "sha256": stored.policy.sha256}
        followed, demo = learnt(stored.policy), hand_of(stored.policy)
    check_frame(plan.frame)
    trajectory = trajectory_of(plan)
    measured = play(trajectory, timeout_s=settings.playback_timeout_s, memory_bytes=settings.playback_memory_bytes)
    errors = ArmErrors(**request["errors"])
    verdict = judge_plan(plan, trajectory, measured, policy=followed, demo=demo, errors=errors)
    report = _finite(asdict(verdict.report)) | {
        "doubt": _finite(asdict(verdict.success)),
        "stated_by": request["stated_by"],
        "check_version": request["check_version"],
        "failure_in_words": verdict.failure_sentence,
        "scene": None if verdict.scene is None else _finite(asdict(verdict.scene)),
        "tissue": "not given" if plan.scene is None or plan.scene.tissue is None else "judged",
        "plan": request["plan"],
        "trajectory": digest(trajectory),
        "policy": policy,
        "frame": plan.frame,
    }
    identity = sha256(canonical([request["plan"], report]))

    def store(session: Session, actor: str) -> dict[str, Any]:
        # A retry of the job computes the same report and digest, and must not store it twice.
        known = session.scalar(select(StoredPlayback).where(StoredPlayback.sha256 == identity))
        if known is None:
            plan = find_plan(session, request["plan"])
            known = StoredPlayback(
                sha256=identity, plan=plan, feasible=verdict.report.feasible, report=report, measured=measured
            )
            session.add(known)
            record_event(session, actor, "play", "playback", identity, plan.policy.surgeon)
            session.flush()
            request_pictures(session, known, actor)
        return {"playback": known.sha256, "feasible": known.feasible}

    return store


def find_playback(session: Session, playback_sha256: str) -> StoredPlayback:
    """Return a playback by its digest."""
    return find_by_digest(session, StoredPlayback, playback_sha256, "playback", Remedy(Action.ADD_PLAYBACK))


def shown_playback(session: Session, playback_sha256: str) -> StoredPlayback:
    """Return a playback by its digest, whose motion is shown.

    Raises:
        Conflict: The surgeon's consent does not cover training (any more).
    """
    playback = find_playback(session, playback_sha256)
    versions.followable(playback.plan.policy)
    return playback


def headline_of(playback: StoredPlayback, settings: Settings) -> dict[str, Any]:
    """Return the headline of a playback at the errors and the lower bound of the installation's settings."""
    errors, lower_bound = stated_errors(settings.arm_errors), settings.replay_lower_bound
    return headline(playback.plan.about, playback.report, errors=errors, lower_bound=lower_bound)


def standing_of(session: Session, playback: StoredPlayback) -> dict[str, Any]:
    """Return the policy version that a playback's plan follows, and whether its style serves it now."""
    policy = playback.plan.policy
    return {"version": policy.version, "sha256": policy.sha256, "released": releases.serves(session, policy)}


def _finite(data: Any) -> Any:
    """Return JSON data with null for NaN and infinity, which JSON does not have, and lists for tuples."""
    if isinstance(data, float):
        return data if isfinite(data) else None
    if isinstance(data, dict):
        return {name: _finite(value) for name, value in data.items()}
    if isinstance(data, list | tuple):
        return [_finite(value) for value in data]
    return data


def request_pictures(session: Session, playback: StoredPlayback, actor: str) -> tuple[Job, bool]:
    """Queue the pictures of a stored playback; return the job, and whether it is new."""
    return jobs.ask(session, PICTURES, _wanted(playback), playback.plan.policy.surgeon, actor)


def draw_pictures(
    database: Database, request: PicturesRequest, settings: Settings
) -> Callable[[Session, str], dict[str, Any]]:
    """Draw the film and plots of a playback; the returned function stores them."""
    from skills.simulation import film, pictures

    with database.reading() as session:
        playback = _playback(session, request)
        measured, report = playback.measured, playback.report
    trajectory = measured.trajectory
    shot = film.make_film(trajectory, pad_top_mm=float(measured.pad_mm[2]), memory_bytes=settings.playback_memory_bytes)
    drawn = Pictures(
        animation_mp4=shot.mp4,
        animation_gif=shot.gif,
        joints_png=pictures.png(pictures.draw_joints(trajectory, measured, report)),
        clearance_png=pictures.png(pictures.draw_clearance(trajectory, measured, report)),
    )

    def store(session: Session, actor: str) -> dict[str, Any]:
        playback = _playback(session, request)
        of_playback = select(StoredPictures.row).where(StoredPictures.playback_row == playback.row)
        # A retry of the job must not store the pictures twice.
        if session.scalar(of_playback) is None:
            session.add(StoredPictures(playback_row=playback.row, drawn=drawn))
            record_event(session, actor, "draw", PICTURES, playback.sha256, playback.plan.policy.surgeon)
        return {"playback": playback.sha256}

    return store


def find_pictures(session: Session, playback: StoredPlayback) -> Pictures:
    """Return the pictures of a playback.

    Raises:
        NotDrawnYet: They are not drawn; the message names the job that draws them, or that failed to.
    """
    stored = session.scalar(select(StoredPictures).where(StoredPictures.playback_row == playback.row))
    if stored is None:
        raise _not_drawn(playback, job_of_pictures(session, playback))
    return stored.drawn


def job_of_pictures(session: Session, playback: StoredPlayback) -> Job | None:
    """Return the newest job that draws the pictures of a playback, or failed to."""
    return jobs.newest(session, PICTURES, _wanted(playback))


def _not_drawn(playback: StoredPlayback, job: Job | None) -> NotDrawnYet:
    draw = Remedy(Action.DRAW, playback=playback.sha256, plan=playback.plan.sha256)
    if job is None:
        return NotDrawnYet("No pictures of this playback were requested.", draw)
    see = Remedy(Action.SEE_JOB, job=job.id)
    if job.state in jobs.ACTIVE:
        return NotDrawnYet("The pictures of this playback are being drawn.", see, job=job.id)
    return NotDrawnYet("The pictures of this playback were not drawn.", see, draw, job=job.id)


def _wanted(playback: StoredPlayback) -> PicturesRequest:
    return {"plan": playback.plan.sha256, "playback": playback.sha256}


def _playback(session: Session, request: PicturesRequest) -> StoredPlayback:
    return session.scalars(select(StoredPlayback).where(StoredPlayback.sha256 == request["playback"])).one()


def playback_json(row: StoredPlayback, headline: dict[str, Any]) -> dict[str, Any]:
    """Return a playback's JSON with its headline; all of its pictures but the first are drawn after the verdict."""
    here = f"/playbacks/{row.sha256}"
    return {
        "id": row.sha256,
        "sha256": row.sha256,
        "plan": row.plan.sha256,
        "feasible": row.feasible,
        "headline": headline,
        "report": row.report,
        "picture": f"{here}/picture.png",
        "pictures": {
            "picture": f"{here}/picture.png",
            "animation_mp4": f"{here}/animation.mp4",
            "animation_gif": f"{here}/animation.gif",
            "joints": f"{here}/joints.png",
            "clearance": f"{here}/clearance.png",
        },
        "created_at": rfc3339(row.created_at),
    }
