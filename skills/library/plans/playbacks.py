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
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db import rfc3339
from skills.db.models import StoredPlayback
from skills.db.packed import digest
from skills.db.service_tables import Job, record_event
from skills.db.session import Database
from skills.library.operation import jobs
from skills.library.operation.integrity import find_by_digest, learnt, planned
from skills.library.operation.jobs import PlaybackRequest
from skills.library.plans.arm_errors import stated_errors
from skills.library.plans.headline import CHECK_VERSION, headline
from skills.library.plans.pictures import request_pictures
from skills.library.plans.plans import check_frame, find_plan, hand_of, trajectory_of
from skills.library.policies import releases, versions
from skills.packing import canonical, sha256
from skills.remedies import Action, Remedy
from skills.settings import Settings
from skills.verification.arm_errors import ArmErrors
from skills.verification.verdict import judge_plan


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
        "doubt": _finite(asdict(verdict.doubt)),
        "stated_by": request["stated_by"],
        "check_version": request["check_version"],
        "failure_in_words": verdict.failure_in_words,
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
