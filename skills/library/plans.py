"""Plans and their playback: grid worlds stacked at suture points, and the simulator's verdict on the motion."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any, Literal

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.models import Job, Plan, StoredPlayback
from skills.db.session import Database
from skills.errors import BadPlan, NotFound
from skills.library import jobs, policies
from skills.library.events import record
from skills.library.verified import learnt, plan_identity, planned
from skills.packing import canonical, sha256
from skills.settings import Settings
from skills.style.demo import Demo
from skills.style.plan import SuturePlan, SuturePoint, pose_xyzw, rotation_of, stack
from skills.style.playback import judge
from skills.style.trajectory import Trajectory, time_parametrise

RATE_HZ = 240.0  # ours: PyBullet's own step

Approach = tuple[float, float, float]


@dataclass(frozen=True)
class PlanRequest:
    """What is asked for: a style, where its passes end and start, and what the arm should be.

    `approach_m` is PSM_M's approach in the arm's frame; "demonstrated" takes it from the demonstration, where that has
    it, and None plans A1 alone.
    """

    surgeon: str
    suture: str
    suture_points: Sequence[SuturePoint]
    version: int | None = None
    starts_mm: Sequence[Sequence[float] | None] | None = None
    arm: str | None = None
    frame: str | None = None
    instrument: str | None = None
    speed_mm_s: float = 20.0
    approach_m: Approach | Literal["demonstrated"] | None = "demonstrated"


def plan_sutures(database: Database, request: PlanRequest, actor: str) -> tuple[Plan, bool]:
    """Stack a style's policy at suture points and store the plan: (the row, whether it is new).

    Raises:
        BadPlan: The arm, frame or instrument is not the demonstration's, or a pass is out of reach.
    """
    with database.reading() as session:
        policy = policies.choose(session, request.surgeon, request.suture, request.version)
        demo, followed, sha = policy.demonstration.demo, learnt(policy), policy.sha256
    for name in ("arm", "frame", "instrument"):
        asked, have = getattr(request, name), getattr(demo, name)
        if asked is not None and asked != have:
            raise BadPlan(
                f"The policy was demonstrated with {name} '{have}'; a plan keeps it, so give that or leave it out."
            )
    approach, source = _approach(request, demo)
    plan = stack(
        followed,
        request.suture_points,
        arm=demo.arm,
        frame=demo.frame,
        instrument=demo.instrument,
        rotation=rotation_of(demo.rotation_xyzw),
        demo=demo,
        starts_mm=request.starts_mm,
        approach_m=approach,
        speed_mm_s=request.speed_mm_s,
    )
    trajectory = trajectory_of(plan)
    identity = plan_identity(sha, plan)
    about = describe_plan(plan, trajectory, source)
    with database.writing() as session:
        known = session.scalar(select(Plan).where(Plan.sha256 == identity))
        if known is not None:
            return known, False
        policy = policies.find_by_digest(session, sha)
        stored = Plan(sha256=identity, policy=policy, plan=plan, about=about)
        session.add(stored)
        record(session, actor, "plan", "plan", identity, policy.surgeon)
        session.flush()
        return stored, True


def _approach(request: PlanRequest, demo: Demo) -> tuple[Approach | None, str | None]:
    """Choose PSM_M's approach, and say where it comes from: the request, else the demonstration."""
    if request.approach_m != "demonstrated":
        return request.approach_m, None if request.approach_m is None else "the request"
    if demo.partner is None:
        return None, None
    return demo.partner.approach, f"the demonstration: {demo.partner.arm} at {demo.partner.at_s:g} s of its recording"


def trajectory_of(plan: SuturePlan) -> Trajectory:
    """Put a plan into time, at `RATE_HZ`; the same plan gives the same bytes."""
    return time_parametrise(plan.pass_paths, speed_mm_s=plan.speed_mm_s, rate_hz=RATE_HZ, instrument=plan.instrument)


def describe_plan(plan: SuturePlan, trajectory: Trajectory, source: str | None) -> dict[str, Any]:
    """Write what a client is told of a plan, but for its digests; `source` is where PSM_M's approach comes from."""
    return {
        "arm": plan.arm,
        "frame": plan.frame,
        "instrument": plan.instrument,
        "orientation": plan.orientation,
        "path": plan.path,
        "psm_m": None if plan.approach_m is None else {"approach": list(plan.approach_m), "from": source},
        "realignment": plan.approach_m is not None,
        "speed_mm_s": plan.speed_mm_s,
        "passes": [
            {
                "position_mm": list(one.point.position_mm),
                "rotation_xyzw": list(one.point.rotation_xyzw),
                "start_mm": one.start_mm.tolist(),
                "states": one.states.tolist(),
                "path_mm": one.tip_mm.tolist(),
                "jaw_xyzw": list(pose_xyzw(one.rotation)),
                "target_xyzw": None if one.target_rotation is None else list(pose_xyzw(one.target_rotation)),
            }
            for one in plan.passes
        ],
        "trajectory": {
            "rate_hz": trajectory.rate_hz,
            "samples": len(trajectory),
            "duration_s": trajectory.duration_s,
            "speed_used_mm_s": trajectory.speed_mm_s,
            "peak_joint_speed_ratio": trajectory.speed_ratio,
            "peak_joint_acceleration_ratio": trajectory.acceleration_ratio,
            "deviation_mm": trajectory.deviation_mm,
        },
    }


def find_plan(session: Session, plan_sha256: str) -> Plan:
    """Find a plan by its digest."""
    plan = session.scalar(select(Plan).where(Plan.sha256 == plan_sha256))
    if plan is None:
        raise NotFound("There is no such plan; POST /plans makes one.")
    return plan


def request_playback(session: Session, plan_sha256: str, actor: str) -> tuple[Job, bool]:
    """Ask for a plan to be played in the simulator: the job, and whether it is a new one."""
    plan = find_plan(session, plan_sha256)
    return jobs.ask(session, "playback", {"plan": plan.sha256}, plan.policy.surgeon, actor)


def check_playback(
    database: Database, request: dict[str, Any], settings: Settings
) -> Callable[[Session, str], dict[str, Any]]:
    """Play a plan in the simulator and judge it; the returned function stores both."""
    from skills.sim.player import play

    with database.reading() as session:
        plan = planned(find_plan(session, request["plan"]))
    trajectory = trajectory_of(plan)
    measured = play(trajectory, timeout_s=settings.playback_timeout_s, memory_bytes=settings.playback_memory_bytes)
    verdict = judge(measured, trajectory)
    report = _finite(asdict(verdict))
    report["failure_in_words"] = None if verdict.failure is None else str(verdict.failure)
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
        return {"playback": known.sha256, "feasible": known.feasible}

    return store


def find_playback(session: Session, playback_sha256: str) -> StoredPlayback:
    """Find a playback by its digest."""
    playback = session.scalar(select(StoredPlayback).where(StoredPlayback.sha256 == playback_sha256))
    if playback is None:
        raise NotFound("There is no such playback; POST /playbacks asks for one.")
    return playback


def _finite(data: Any) -> Any:
    """Write NaN and infinity, which JSON does not have, as null, and tuples as lists."""
    if isinstance(data, float):
        return data if isfinite(data) else None
    if isinstance(data, dict):
        return {name: _finite(value) for name, value in data.items()}
    if isinstance(data, list | tuple):
        return [_finite(value) for value in data]
    return data
