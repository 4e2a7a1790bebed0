"""Plans: grid worlds stacked at suture points."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.models import Plan
from skills.db.session import Database
from skills.errors import BadPlan, NoApproach, NotFound
from skills.library import policies
from skills.library.combined import learnt_from
from skills.library.events import record
from skills.library.verified import learnt, plan_identity
from skills.style.handoff import Enters, PsmM
from skills.style.kinematics import DEFAULT_INSTRUMENT
from skills.style.partner import Partner
from skills.style.plan import SuturePlan, SuturePoint, pose_xyzw, rotation_of, stack
from skills.style.timetable import seams, seconds_by_phase, transfers
from skills.style.trajectory import Trajectory, time_parametrise


@dataclass(frozen=True)
class Beside:
    """What is asked of PSM_M, in the arm's frame; what is None is taken from the demonstration, where that has it.

    `source` says where the given numbers come from.
    """

    approach: tuple[float, float, float] | None = None
    base_mm: tuple[float, float, float] | None = None
    base_xyzw: tuple[float, float, float, float] | None = None
    instrument: str | None = None
    enters: Enters = "after_A1"
    source: str = "the request"


@dataclass(frozen=True)
class PlanRequest:
    """What is asked for: a style, where its passes end and start, and what the arms should be.

    Without `realignment` A1 alone is planned. Without `psm_m` it is all the demonstration's, and where that does not
    know PSM_M, A1 alone.
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
    rate_hz: float = 200.0
    tip_offset_mm: float = 0.0
    psm_m: Beside | None = None
    realignment: bool = True


def plan_sutures(database: Database, request: PlanRequest, actor: str) -> tuple[Plan, bool]:
    """Stack a style's policy at suture points and store the plan: (the row, whether it is new).

    Raises:
        BadPlan: The arm, frame or instrument is not the demonstration's, or a pass is out of reach of either arm.
        NoApproach: PSM_M is asked for, and neither request nor demonstration knows its approach.
    """
    with database.reading() as session:
        policy = policies.choose(session, request.surgeon, request.suture, request.version)
        demo, followed, sha = learnt_from(policy), learnt(policy), policy.sha256
    for name in ("arm", "frame", "instrument"):
        asked, have = getattr(request, name), getattr(demo, name)
        if asked is not None and asked != have:
            raise BadPlan(
                f"The policy was demonstrated with {name} '{have}'; a plan keeps it, so give that or leave it out."
            )
    plan = stack(
        followed,
        request.suture_points,
        arm=demo.arm,
        frame=demo.frame,
        instrument=demo.instrument,
        rotation=rotation_of(demo.rotation_xyzw),
        demo=demo,
        starts_mm=request.starts_mm,
        psm_m=_psm_m(request.psm_m, demo.partner) if request.realignment else None,
        speed_mm_s=request.speed_mm_s,
        rate_hz=request.rate_hz,
        tip_offset_mm=request.tip_offset_mm,
    )
    trajectory = trajectory_of(plan)
    identity = plan_identity(sha, plan)
    about = describe_plan(plan, trajectory)
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


def _psm_m(asked: Beside | None, partner: Partner | None) -> PsmM | None:
    """Put together what is known of PSM_M, and say of each part where it comes from: the request comes first."""
    if asked is None and partner is None:
        return None
    wanted, seen = asked or Beside(), _demonstrated(partner)
    approach = wanted if wanted.approach is not None else seen
    if approach.approach is None:
        raise NoApproach("The demonstration does not say how PSM_M approaches; give psm_m.approach, or no psm_m.")
    base = wanted if wanted.base_mm is not None else seen
    return PsmM(
        approach=approach.approach,
        base_mm=base.base_mm,
        base_xyzw=base.base_xyzw,
        instrument=wanted.instrument or seen.instrument or DEFAULT_INSTRUMENT,
        enters=wanted.enters,
        approach_from=approach.source,
        base_from=None if base.base_mm is None else base.source,
    )


def _demonstrated(partner: Partner | None) -> Beside:
    """Write what a demonstration knows of PSM_M as if it had been asked for."""
    if partner is None:
        return Beside()
    source = f"the demonstration: {partner.arm} at {partner.at_s:g} s of its recording"
    return Beside(partner.approach, partner.base_mm, partner.base_xyzw, partner.instrument, source=source)


def trajectory_of(plan: SuturePlan) -> Trajectory:
    """Put a plan into time, at its own rate; the same plan gives the same bytes."""
    return time_parametrise(
        plan.pass_paths,
        speed_mm_s=plan.speed_mm_s,
        rate_hz=plan.rate_hz,
        instrument=plan.instrument,
        psm_m=plan.psm_m,
    )


def describe_plan(plan: SuturePlan, trajectory: Trajectory) -> dict[str, Any]:
    """Write what a client is told of a plan, but for its digests."""
    moved = transfers(trajectory)
    return {
        "arm": plan.arm,
        "frame": plan.frame,
        "instrument": plan.instrument,
        "orientation": plan.orientation,
        "path": plan.path,
        "psm_m": None if plan.psm_m is None else _describe_psm_m(plan.psm_m),
        "realignment": plan.psm_m is not None,
        "speed_mm_s": plan.speed_mm_s,
        "tip_offset_mm": plan.tip_offset_mm,
        "passes": [
            {
                "position_mm": list(one.point.position_mm),
                "rotation_xyzw": list(one.point.rotation_xyzw),
                "start_mm": one.start_mm.tolist(),
                "states": one.states.tolist(),
                "path_mm": one.tip_mm.tolist(),
                "jaw_xyzw": list(pose_xyzw(one.rotation)),
                "target_xyzw": None if one.target_rotation is None else list(pose_xyzw(one.target_rotation)),
                "transfer": None if transfer is None else asdict(transfer),
            }
            for one, transfer in zip(plan.passes, moved, strict=True)
        ],
        "trajectory": {
            "rate_hz": trajectory.rate_hz,
            "samples": len(trajectory),
            "duration_s": trajectory.duration_s,
            "seconds_by_phase": seconds_by_phase(trajectory),
            "speed_used_mm_s": trajectory.speed_mm_s,
            "peak_joint_speed_ratio": trajectory.speed_ratio,
            "peak_joint_acceleration_ratio": trajectory.acceleration_ratio,
            "deviation_mm": trajectory.deviation_mm,
            "psm_m_moves": trajectory.psm_m is not None,
            "seams": [asdict(seam) for seam in seams(trajectory)],
        },
    }


def _describe_psm_m(psm_m: PsmM) -> dict[str, Any]:
    return {
        "approach": list(psm_m.approach),
        "base_mm": None if psm_m.base_mm is None else list(psm_m.base_mm),
        "base_xyzw": None if psm_m.base_xyzw is None else list(psm_m.base_xyzw),
        "instrument": psm_m.instrument,
        "enters": psm_m.enters,
        "from": {"approach": psm_m.approach_from, "base": psm_m.base_from},
    }


def find_plan(session: Session, plan_sha256: str) -> Plan:
    """Find a plan by its digest."""
    plan = session.scalar(select(Plan).where(Plan.sha256 == plan_sha256))
    if plan is None:
        raise NotFound("There is no such plan; POST /plans makes one.")
    return plan
