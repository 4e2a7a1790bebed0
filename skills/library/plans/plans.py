"""Plans: grid worlds stacked at suture points, and suture points read from a simulator's recording.

PlanIn --plan_sutures--> Plan, stored
recording of a simulated scene --find_suture_points--> SuturePoints, not stored
ReachIn --map_style--> Reach: at which suture points a style can be planned, not stored
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.models import Plan, PolicyVersion
from skills.db.service_tables import record_event
from skills.db.session import Database
from skills.demonstration.demonstration import Demo
from skills.demonstration.partner import Partner
from skills.errors import BadPlan, BadSpeed, Conflict, NoApproach, NoHandOff
from skills.formats.suture_points import READ, SuturePoints, suture_points
from skills.gridworld.grid import refuse_metres
from skills.gridworld.scene import Scene, Tissue
from skills.kinematics import DEFAULT_INSTRUMENT
from skills.learning.policy import Policy
from skills.library.operation import locks
from skills.library.operation.integrity import find_by_digest, learnt, plan_identity, planned
from skills.library.plans.description import describe_plan
from skills.library.plans.readings import readings
from skills.library.policies import versions
from skills.library.policies.combined import learnt_from
from skills.library.recordings.recordings import Reader, Upload, read_upload
from skills.planning.handoff import PsmM
from skills.planning.path_fit import styled
from skills.planning.plan import SuturePlan, stack
from skills.planning.trajectory import Trajectory, time_parametrise
from skills.remedies import Action, Remedy
from skills.schemas.plans import PlanIn, PsmMIn
from skills.schemas.recordings import TableIn
from skills.verification.reach import map_reach


def find_suture_points(upload: Upload, arm: str | None, frame: str | None, read: Reader) -> SuturePoints:
    """Read the marks of a scene in a separate process, and transform them to an arm's base frame.

    Args:
        upload: An MCAP file.
        arm: The arm; None if the file has the base of a single one.
        frame: The name of the arm's base frame.
        read: The reader: `ConfinedReader` or a compatible callable.

    Raises:
        BadRecording: It cannot be used; `skills.errors` lists the kinds.
    """
    scene = read_upload(upload.read_as(TableIn()), partial(read, target=READ))
    return suture_points(scene, arm=arm, frame=frame)


DEEP_MM = 50.0  # ours: no suture is so deep in tissue
LEAST_MM = 0.1  # ours: a speed (mm/s) or an offset below it was given in metres


def plan_sutures(database: Database, request: PlanIn, actor: str) -> tuple[Plan, bool]:
    """Stack a style's policy at suture points and store the plan; return the row, and whether it is new.

    Raises:
        BadPlan: The arm, frame or instrument is not the demonstration's, an orientation or a hand-off is requested that
            was not recorded, or a pass is out of reach of either arm.
        Conflict: The surgeon's consent does not cover training, or a demonstration of the served version was withdrawn
            or marked recovery or failure meanwhile.
        NoApproach: A hand-off is requested, and neither request nor demonstration has PSM_M's approach.
        NoHandOff: The plan would have no hand-off, and such a plan was not requested.
    """
    style = style_of(database, request.surgeon, request.suture, request.version)
    try:
        plan, sha = stacked(request, style), style.sha256
        about = describe_plan(plan, trajectory_of(plan), style.learnt_in)
    except BadPlan as error:
        meant = [words for words, other in readings(request) if fits(other, style)]
        if meant:
            error.remedies += (f"Read {', or '.join(meant)}, every pass is within reach and clear: is that meant?",)
        raise
    identity = plan_identity(sha, plan)
    with database.writing([locks.surgeon(request.surgeon)]) as session:
        # Consent may have ended, or a demonstration been withdrawn, while the plan was computed.
        policy = versions.followable(versions.find_by_digest(session, sha))
        if request.version is None and (changes := policy.objections):
            raise Conflict(f"The demonstration that the plan would follow {changes[0].text}; plan again.")
        # An equal plan has the same digest, so a repeated request returns the stored row.
        known = session.scalar(select(Plan).where(Plan.sha256 == identity))
        if known is not None:
            return known, False
        stored = Plan(sha256=identity, policy=policy, plan=plan, about=about)
        session.add(stored)
        record_event(session, actor, "plan", "plan", identity, policy.surgeon)
        session.flush()
        return stored, True


def fits(request: PlanIn, style: "FollowedStyle") -> bool:
    """Return whether a plan can be made in which every pass is within reach and clear, in closed form."""
    try:
        plan = stacked(request, style)
        trajectory_of(plan)
        places = [
            place
            for one in plan.passes
            for place in map_reach(replace(plan, passes=(one,)), np.array([one.point.position_mm]))
        ]
    except BadPlan:
        return False
    return all(place.reach != "no" for place in places)


@dataclass(frozen=True, eq=False)
class FollowedStyle:
    """The policy version that a plan follows, and the demonstration whose hand it has."""

    version: int
    sha256: str
    policy: Policy
    demo: Demo

    @property
    def learnt_in(self) -> Scene | None:
        """The scene in which the policy was learnt."""
        return None if self.policy.surroundings is None else self.policy.surroundings.scene


def style_of(database: Database, surgeon: str, suture: str, version: int | None) -> FollowedStyle:
    """Return the requested version of a style, or the served one.

    Raises:
        NotFound: There is no such version, or nothing is served.
        Conflict: The surgeon's consent does not cover training.
    """
    with database.reading() as session:
        policy = versions.choose(session, surgeon, suture, version)
        return FollowedStyle(policy.version, policy.sha256, learnt(policy), hand_of(policy))


def stacked(request: PlanIn, style: FollowedStyle) -> SuturePlan:
    """Return the plan that a request asks for, with its scene; nothing is stored.

    Raises:
        BadPlan, NoApproach, NoHandOff: As of `plan_sutures`.
    """
    demo = style.demo
    for name in ("arm", "frame", "instrument"):
        # The policy is certified for the demonstrated arm, frame and instrument only.
        asked, have = getattr(request, name), getattr(demo, name)
        if asked is not None and asked != have:
            raise BadPlan(
                f"The policy was demonstrated with {name} '{have}'; a plan must have the same, so give that value "
                "or omit it."
            )
    _refuse_metres(style.policy, request)
    plan = stack(
        style.policy,
        [point.value for point in request.suture_points],
        demo=demo,
        starts_mm=request.starts_mm,
        psm_m=_takes_the_needle(request, demo.partner),
        speed_mm_s=request.speed_mm_s,
        rate_hz=request.rate_hz,
        tip_offset_mm=request.tip_offset_mm,
        orientation=request.orientation,
        a2=request.a2,
    )
    _refuse_centimetres(plan, request.tissue_mm)
    return replace(plan, scene=_scene(request, plan.frame, style.learnt_in))


def _refuse_centimetres(plan: SuturePlan, tissue_mm: float | None) -> None:
    """Refuse a height of tissue far above all of the motion that would be below it in centimetres.

    Raises:
        BadPlan: It is.
    """
    top_mm = max(float(one.tip_mm[:, 2].max()) for one in plan.passes)
    if tissue_mm is not None and tissue_mm > top_mm + DEEP_MM and 10.0 * tissue_mm < top_mm:
        raise BadPlan(
            f"All of the motion is more than {tissue_mm - top_mm:.0f} mm below tissue at a height of {tissue_mm:g} mm; "
            "this seems to be in centimetres.",
            f"Give {10 * tissue_mm:g} mm.",
            tissue_mm=tissue_mm,
        )


def _scene(request: PlanIn, frame: str, learnt_in: Scene | None) -> Scene | None:
    """Return the scene that the motion is compared with, with the stated height of its tissue.

    Raises:
        BadPlan: The tissue is stated twice, or its height seems to be in metres.
    """
    scene = learnt_in if request.scene is None else request.scene.value
    if request.tissue_mm is None:
        return scene
    if request.scene is not None and request.scene.tissue is not None:
        raise BadPlan("The request has tissue_mm, and its scene has tissue.", "Omit one of them.")
    if abs(request.tissue_mm) < 1.0:
        raise BadPlan(
            f"Tissue at a height of {request.tissue_mm:g} mm is at the remote centre; this seems to be in metres.",
            f"Give {1000 * request.tissue_mm:g} mm.",
            tissue_mm=request.tissue_mm,
        )
    level = Tissue.plane((0.0, 0.0, request.tissue_mm), (0.0, 0.0, 1.0))
    return Scene(frame, tissue=level) if scene is None else replace(scene, tissue=level)


def hand_of(version: PolicyVersion) -> Demo:
    """Return the demonstration whose hand a plan of a policy follows: of several, with that of their pose style."""
    found = learnt_from(version)
    return found.demo if found.combined is None else styled(found.demo, [one.demo for one in version.demonstrations])


def _refuse_metres(policy: Policy, request: PlanIn) -> None:
    """Refuse lengths that can only have been meant in metres, before reach is checked.

    Raises:
        OutsideGrid: A suture point or a start lies within a millimetre of the origin, far from the motion.
        BadSpeed: The speed is less than a tenth of a millimetre a second.
        BadPlan: The tip's offset is shorter than a tenth of a millimetre.
    """
    goal_mm = policy.path.grid.centres_mm(policy.path.goal)
    for number, point in enumerate(request.suture_points):
        refuse_metres(f"Suture point {number}", point.position_mm, goal_mm)
    for number, start_mm in enumerate(request.starts_mm or ()):
        if start_mm is not None:
            refuse_metres(f"The start of pass {number}", start_mm, goal_mm)
    for error, quantity, name, unit in (
        (BadSpeed, "speed", "speed_mm_s", "mm/s"),
        (BadPlan, "tip offset", "tip_offset_mm", "mm"),
    ):
        if 0 < (given := getattr(request, name)) < LEAST_MM:
            why = f"A {quantity} of {given:g} {unit} seems to be in metres."
            raise error(why, f"Give {1000 * given:g} {unit}.", **{name: given})


def _takes_the_needle(request: PlanIn, partner: Partner | None) -> PsmM | None:
    """Return the arm that takes the needle; None if a plan without a hand-off is requested.

    Raises:
        NoHandOff: Neither request nor demonstration has PSM_M, and a plan without it was not requested.
        BadPlan: PSM_M is given in a request without a hand-off.
    """
    if request.handoff == "none" and request.psm_m is not None:
        raise BadPlan(
            "handoff is 'none', but the request has psm_m, the arm that takes the needle.", "Omit one of them."
        )
    if request.handoff == "none":
        return None
    if request.psm_m is None and partner is None:
        raise NoHandOff(
            "This plan would have no hand-off: neither the request nor the demonstration has the pose of PSM_M, "
            "the arm that takes the needle.",
            Remedy(Action.NAME_PSM_M),
        )
    return _psm_m(request.psm_m or PsmMIn(), partner)


def _psm_m(asked: PsmMIn, partner: Partner | None) -> PsmM:
    """Return PSM_M from the request, completed from the demonstration, with the source of each part."""
    requested = "the request" if asked.source is None else f"the request: {asked.source}"
    shown = "" if partner is None else f"the demonstration: {partner.arm} at {partner.at_s:g} s of its recording"
    approach, approach_from = asked.approach, requested
    if approach is None and partner is not None:
        approach, approach_from = partner.approach, shown
    if approach is None:
        raise NoApproach("The demonstration has no approach direction of PSM_M.", Remedy(Action.NAME_PSM_M))
    base_mm, base_xyzw, base_from = None, None, None
    if asked.base is not None:
        base_mm, base_xyzw, base_from = asked.base.position_mm, asked.base.rotation_xyzw, requested
    elif partner is not None and partner.base_mm is not None:
        base_mm, base_xyzw, base_from = partner.base_mm, partner.base_xyzw, shown
    # With another approach than the recorded one, PSM_M cannot take the needle in the recorded pose.
    seen = partner if asked.approach is None else None
    return PsmM(
        approach=approach,
        base_mm=base_mm,
        base_xyzw=base_xyzw,
        instrument=asked.instrument or (partner and partner.instrument) or DEFAULT_INSTRUMENT,
        enters=asked.enters,
        approach_from=approach_from,
        base_from=base_from,
        taken_mm=None if seen is None else seen.position_mm,
        taken_xyzw=None if seen is None else seen.rotation_xyzw,
    )


def trajectory_of(plan: SuturePlan) -> Trajectory:
    """Return the trajectory of a plan, sampled at its own rate; the same plan gives the same bytes."""
    return time_parametrise(
        plan.passes,
        speed_mm_s=plan.speed_mm_s,
        rate_hz=plan.rate_hz,
        instrument=plan.instrument,
        psm_m=plan.psm_m,
    )


def motion_of(session: Session, plan_sha256: str) -> SuturePlan:
    """Return the motion of a stored plan, for a client that exports it to follow it.

    Raises:
        NotFound: There is no such plan.
        Conflict: The surgeon's consent does not cover training (any more).
        Corrupt: It does not match its digest.
    """
    return planned(followed_plan(session, plan_sha256))


def followed_plan(session: Session, plan_sha256: str) -> Plan:
    """Return a plan by its digest, whose motion is shown or played.

    Raises:
        Conflict: The surgeon's consent does not cover training (any more).
    """
    plan = find_plan(session, plan_sha256)
    versions.followable(plan.policy)
    return plan


def find_plan(session: Session, plan_sha256: str) -> Plan:
    """Return a plan by its digest."""
    return find_by_digest(session, Plan, plan_sha256, "plan", Remedy(Action.MAKE_PLAN))


def check_frame(frame: str) -> None:
    """Refuse a frame that is not an arm's base.

    Raises:
        BadPlan: Joints can be solved in the frame of the arm's base only.
    """
    if not frame.endswith("_base"):
        raise BadPlan(
            f"The plan is in the frame '{frame}', which is not the frame of the arm's base, so the joints cannot "
            "be computed; demonstrate with local/measured_cp.",
            frame=frame,
        )
