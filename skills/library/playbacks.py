"""Playbacks: plans played in the simulator, and its verdict on the motion.

A plan may be played whatever became of its policy since: a verdict moves nothing. Whether the policy is still released
is told with every playback, as of now, and it is the replay bag that is refused where it is not.
"""

from collections.abc import Callable
from dataclasses import asdict
from math import isfinite
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.books import Job
from skills.db.models import StoredPlayback
from skills.db.session import Database
from skills.errors import BadPlan, NotFound
from skills.library import jobs, pictures, releases
from skills.library.events import record
from skills.library.plans import find_plan, trajectory_of
from skills.library.verified import planned
from skills.packing import canonical, sha256
from skills.settings import Settings
from skills.style.doubt import DoubtSettings, doubt
from skills.style.trajectory import Trajectory
from skills.style.verdict import judge

CHECK_VERSION = 1  # to be raised with whatever changes a verdict: a plan that is asked for again is then played again


def request_playback(session: Session, plan_sha256: str, actor: str, settings: Settings) -> tuple[Job, bool]:
    """Ask for a plan to be played in the simulator: the job, and whether it is a new one.

    Raises:
        BadPlan: Its frame is not the arm's base, so the simulator would put it somewhere else.
    """
    plan = find_plan(session, plan_sha256)
    check_frame(plan.about["frame"])
    errors = sorted({*DoubtSettings().tip_errors_mm, settings.replay_tip_error_mm})
    request = {"plan": plan.sha256, "check_version": CHECK_VERSION, "tip_errors_mm": errors}
    return jobs.ask(session, "playback", request, plan.policy.surgeon, actor)


def check_playback(
    database: Database, request: dict[str, Any], settings: Settings
) -> Callable[[Session, str], dict[str, Any]]:
    """Play a plan in the simulator, judge it, and count in how many inexact worlds it succeeds; the returned function
    stores all of it.
    """
    from skills.sim.player import play

    with database.reading() as session:
        stored = find_plan(session, request["plan"])
        plan, policy = planned(stored), {"version": stored.policy.version, "sha256": stored.policy.sha256}
    check_frame(plan.frame)
    trajectory = trajectory_of(plan)
    measured = play(trajectory, timeout_s=settings.playback_timeout_s, memory_bytes=settings.playback_memory_bytes)
    approach_m = None if plan.psm_m is None else plan.psm_m.approach
    verdict = judge(measured, trajectory, approach_m=approach_m)
    varied = DoubtSettings(tip_errors_mm=tuple(request["tip_errors_mm"]))
    doubted = doubt(trajectory, approach_m=approach_m, pad_top_mm=float(measured.pad_mm[2]), settings=varied)
    report = _finite(asdict(verdict)) | {
        "doubt": _finite(asdict(doubted)),
        "failure_in_words": None if verdict.failure is None else str(verdict.failure),
        "plan": request["plan"],
        "trajectory": trajectory_digest(trajectory),
        "policy": policy,
        "frame": plan.frame,
    }
    identity = sha256(canonical([request["plan"], report]))

    def store(session: Session, actor: str) -> dict[str, Any]:
        known = session.scalar(select(StoredPlayback).where(StoredPlayback.sha256 == identity))
        if known is None:
            plan = find_plan(session, request["plan"])
            known = StoredPlayback(
                sha256=identity, plan=plan, feasible=verdict.feasible, report=report, measured=measured
            )
            session.add(known)
            record(session, actor, "play", "playback", identity, plan.policy.surgeon)
            session.flush()
            pictures.request(session, known, actor)
        return {"playback": known.sha256, "feasible": known.feasible}

    return store


def find_playback(session: Session, playback_sha256: str) -> StoredPlayback:
    """Find a playback by its digest."""
    playback = session.scalar(select(StoredPlayback).where(StoredPlayback.sha256 == playback_sha256))
    if playback is None:
        raise NotFound("There is no such playback; POST /playbacks asks for one.")
    return playback


def standing_of(session: Session, playback: StoredPlayback) -> dict[str, Any]:
    """Tell which policy version a playback's plan follows, and whether it is released now."""
    policy = playback.plan.policy
    released = releases.standing(session, policy.surgeon_row, policy.suture)
    return {
        "version": policy.version,
        "sha256": policy.sha256,
        "released": any(one.policy_row == policy.row for one in released),
    }


def trajectory_digest(trajectory: Trajectory) -> str:
    """Compute the SHA-256 of a motion: of the stamps and joints that were checked, sample by sample."""
    parts = [trajectory.stamps_s, trajectory.joints]
    if trajectory.psm_m is not None:
        parts += [trajectory.psm_m.base_mm, trajectory.psm_m.base_xyzw, trajectory.psm_m.joints]
    return sha256(b"".join(part.tobytes() for part in parts))


def check_frame(frame: str) -> None:
    """Refuse a frame that is not an arm's base.

    Raises:
        BadPlan: Joints can be solved in the arm's base alone.
    """
    if not frame.endswith("_base"):
        raise BadPlan(
            f"The plan is in the frame '{frame}', which is not the arm's base, so nobody knows where the arm must go; "
            "demonstrate with local/measured_cp.",
            frame=frame,
        )


def _finite(data: Any) -> Any:
    """Write NaN and infinity, which JSON does not have, as null, and tuples as lists."""
    if isinstance(data, float):
        return data if isfinite(data) else None
    if isinstance(data, dict):
        return {name: _finite(value) for name, value in data.items()}
    if isinstance(data, list | tuple):
        return [_finite(value) for value in data]
    return data
