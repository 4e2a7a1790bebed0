"""Plans: grid worlds stacked at suture points, and suture points read from a simulator's recording.

PlanIn --plan_sutures--> Plan, stored
recording of a simulated scene --find_suture_points--> SuturePoints, not stored
ReachIn --map_style--> Reach: at which suture points a style can be planned, not stored
"""

from collections import Counter
from dataclasses import asdict, dataclass, replace
from functools import partial
from math import ceil, floor, prod
from typing import Any

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.arrays import xyz
from skills.db import rfc3339
from skills.db.models import Plan, PolicyVersion, StoredPlayback
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
from skills.library.operation.integrity import find_by_digest, learnt, plan_identity, planned, scene_digest
from skills.library.policies import versions
from skills.library.policies.versions import combined_of, learnt_from
from skills.library.recordings.recordings import Reader, Upload, read_upload
from skills.planning.handoff import PsmM
from skills.planning.path_fit import ends_of, jaw_recorded, styled
from skills.planning.plan import SuturePlan, pose_xyzw, stack, turn_deg
from skills.planning.trajectory import Trajectory, seams, seconds_by_phase, time_parametrise, transfers
from skills.remedies import Action, Remedy
from skills.schemas import PolicyName
from skills.schemas.plans import PlanIn, PsmMIn
from skills.schemas.reach import Reach, ReachIn
from skills.schemas.recordings import TableIn
from skills.verification.reach import MAX_PLACES, ReachPlace, map_reach


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
    plan, learnt_in, sha = stacked(request, style), style.learnt_in, style.sha256
    trajectory = trajectory_of(plan)
    identity = plan_identity(sha, plan)
    about = describe_plan(plan, trajectory, learnt_in)
    with database.writing([locks.surgeon(request.surgeon)]) as session:
        # Consent may have ended, or a demonstration been withdrawn, while the plan was computed.
        policy = versions.followable(versions.find_by_digest(session, sha))
        if request.version is None and (changes := policy.objections):
            raise Conflict(f"The demonstration that the plan would follow {changes[0]}; plan again.")
        # An equal plan has the same digest, so a repeated request returns the stored row.
        known = session.scalar(select(Plan).where(Plan.sha256 == identity))
        if known is not None:
            return known, False
        stored = Plan(sha256=identity, policy=policy, plan=plan, about=about)
        session.add(stored)
        record_event(session, actor, "plan", "plan", identity, policy.surgeon)
        session.flush()
        return stored, True


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
    return replace(plan, scene=_scene(request, plan.frame, style.learnt_in))


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
    demo, demos = learnt_from(version), [one.demo for one in version.demonstrations]
    return demo if combined_of(version) is None else styled(demo, demos)


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
    if 0 < request.speed_mm_s < LEAST_MM:
        raise BadSpeed(
            f"A speed of {request.speed_mm_s:g} mm/s seems to be in metres per second.",
            f"Give {1000 * request.speed_mm_s:g} mm/s.",
            speed_mm_s=request.speed_mm_s,
        )
    if 0 < request.tip_offset_mm < LEAST_MM:
        raise BadPlan(
            f"A tip offset of {request.tip_offset_mm:g} mm seems to be in metres.",
            f"Give {1000 * request.tip_offset_mm:g} mm.",
            tip_offset_mm=request.tip_offset_mm,
        )


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
    if request.handoff == "none" or not request.realignment:
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


def describe_plan(plan: SuturePlan, trajectory: Trajectory, learnt_in: Scene | None) -> dict[str, Any]:
    """Return the JSON of a plan without its digests; `learnt_in` is the scene of its policy."""
    moved = transfers(trajectory)
    return {
        "arm": plan.arm,
        "frame": plan.frame,
        "instrument": plan.instrument,
        "orientation": plan.orientation,
        "departure": None if plan.departure is None else asdict(plan.departure),
        "a2": plan.a2 if plan.psm_m is not None else None,
        "path": plan.path,
        "psm_m": None if plan.psm_m is None else _describe_psm_m(plan.psm_m),
        "realignment": plan.psm_m is not None,
        "scene": None if plan.scene is None else _describe_scene(plan.scene, learnt_in),
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
                "turn_deg": turn_deg(one),
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
            "tempo": trajectory.tempo,
            "jaw": "recorded" if all(jaw_recorded(one.hand) for one in plan.passes) else "constant",
            "peak_joint_speed_ratio": trajectory.speed_ratio,
            "peak_joint_acceleration_ratio": trajectory.acceleration_ratio,
            "deviation_mm": trajectory.deviation_mm,
            "psm_m_moves": trajectory.psm_m is not None,
            "seams": [asdict(seam) for seam in seams(trajectory)],
        },
    }


def _describe_scene(scene: Scene, learnt_in: Scene | None) -> dict[str, Any]:
    return {
        "sha256": scene_digest(scene),
        "learnt_sha256": None if learnt_in is None else scene_digest(learnt_in),
        "differs": [] if learnt_in is None else differences(scene, learnt_in),
        "scene": scene.as_json(),
    }


def differences(scene: Scene, learnt_in: Scene) -> list[str]:
    """Return the differences of a scene from the one that a policy was learnt in, in words.

    Boxes and capsules are compared as sets, so another order is no difference.
    """
    found = []
    for one, other, where in (
        (learnt_in, scene, "of the learnt scene is not in this one"),
        (scene, learnt_in, "is not in the learnt scene"),
    ):
        found += [f"box {k} {where}" for k, box in enumerate(one.boxes) if box not in other.boxes]
        found += [f"capsule {k} {where}" for k, capsule in enumerate(one.capsules) if capsule not in other.capsules]
    if scene.tissue != learnt_in.tissue:
        was, now = learnt_in.tissue is not None, scene.tissue is not None
        found.append(f"the tissue {'is another one' if was and now else 'is missing' if was else 'is new'}")
    if scene.margin_mm != learnt_in.margin_mm:
        found.append(f"the margin is {scene.margin_mm:g} mm and not {learnt_in.margin_mm:g} mm")
    return found


def _describe_psm_m(psm_m: PsmM) -> dict[str, Any]:
    return {
        "approach": list(psm_m.approach),
        "base_mm": None if psm_m.base_mm is None else list(psm_m.base_mm),
        "base_xyzw": None if psm_m.base_xyzw is None else list(psm_m.base_xyzw),
        "instrument": psm_m.instrument,
        "enters": psm_m.enters,
        "from": {"approach": psm_m.approach_from, "base": psm_m.base_from},
    }


def hands_over(about: dict[str, Any]) -> bool:
    """Return whether a described plan has a hand-off: A2 towards PSM_M."""
    return about["psm_m"] is not None


def plan_in_words(about: dict[str, Any]) -> str:
    """Return the sentences on the motions of a described plan, and on those that it leaves out."""
    return " ".join([_moves_in_words(about), *_hand_in_words(about), _scene_in_words(about["scene"])])


def _scene_in_words(scene: dict[str, Any] | None) -> str:
    """Return the sentences on the scene of a described plan; None: it has none."""
    if scene is None:
        return "Tissue: not given, so nothing is checked against it, and this motion is not exported."
    if scene["scene"].get("tissue") is None:
        return "Tissue: not given. It is checked against the stated obstacles, and this motion is not exported."
    if scene["learnt_sha256"] is None:
        return "It is checked against the stated scene, of which its policy knows nothing."
    if not scene["differs"]:
        return "It is checked against the scene of its policy, whose odds hold at the demonstrated place alone."
    return f"Its scene is not the one that its policy was learnt in: {', '.join(scene['differs'])}."


def _hand_in_words(about: dict[str, Any]) -> list[str]:
    """Return the sentences on what is the surgeon's."""
    held, departure, tempo = about["orientation"], about["departure"], about["trajectory"]["tempo"]
    if held == "recorded":
        words = ["The jaw turns as the surgeon's."]
    elif departure is None:
        words = ["The jaw is held: no orientation was recorded."]
    else:
        words = [
            f"The jaw is held: it departs from the surgeon's by up to {departure['deg']:.1f} degrees, and the needle's "
            f"tip by {departure['needle_tip_mm']:.1f} mm ({departure['handoff_deg']:.1f} degrees and "
            f"{departure['handoff_needle_tip_mm']:.1f} mm at the hand-off)."
        ]
    if tempo is not None:
        words.append(f"The tempo is {100 * tempo:.0f} % of the surgeon's.")
    if about["a2"] is not None:
        end = "in the recorded hand-off" if about["a2"] == "recorded" else "as in the paper, across PSM_M's approach"
        words.append(f"A2 ends {end}.")
    return words


def _moves_in_words(about: dict[str, Any]) -> str:
    count = len(about["passes"])
    moves = f"Moves {about['arm']} along {count} pass{'es' if count != 1 else ''}"
    if not hands_over(about):
        return f"{moves}; no hand-off: no PSM_M, no A2."
    if not psm_m_moves(about):
        return (
            f"{moves} and turns its jaw to offer the needle (A2); has no motion of PSM_M, because its base is not "
            "known, so the needle is not taken."
        )
    return (
        f"{moves} and hands the needle to PSM_M at the end of each: its jaw turns (A2), PSM_M approaches and retracts."
    )


def psm_m_moves(about: dict[str, Any]) -> bool:
    """Return whether a described plan moves PSM_M too; its base must be known for that."""
    return hands_over(about) and about["trajectory"]["psm_m_moves"] is True


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


def plan_summary_json(row: Plan, played: StoredPlayback | None) -> dict[str, Any]:
    """Return the JSON of a plan in a list, with its newest playback."""
    return {
        "id": row.sha256,
        "surgeon": row.policy.surgeon.slug,
        "suture": row.policy.suture,
        "policy": {"version": row.policy.version, "sha256": row.policy.sha256},
        "passes": len(row.about["passes"]),
        "hands_over": hands_over(row.about),
        "playback": None if played is None else played.sha256,
        "feasible": None if played is None else played.feasible,
        "created_at": rfc3339(row.created_at),
    }


def plan_json(row: Plan) -> dict[str, Any]:
    """Return a plan's JSON."""
    return {
        "id": row.sha256,
        "sha256": row.sha256,
        "surgeon": row.policy.surgeon.slug,
        "suture": row.policy.suture,
        "policy": {"version": row.policy.version, "sha256": row.policy.sha256},
        **row.about,
        "hands_over": hands_over(row.about),
        "in_words": plan_in_words(row.about),
        "created_at": rfc3339(row.created_at),
    }


def map_style(database: Database, request: ReachIn) -> Reach:
    """Return where a plan of one pass is possible, without storing a plan.

    Raises:
        BadPlan: There are too many places, the frame is not an arm's base, or a plan with these settings is refused
            wherever it is.
        NoApproach, NoHandOff: As of a plan.
        Conflict: The surgeon's consent does not cover training.
    """
    counts, rotations = _counts(request.size_mm, request.step_mm), len(request.rotations_xyzw)
    if (places := prod(counts) * rotations) > MAX_PLACES:
        wider = (step for step in range(ceil(request.step_mm), 402))
        least = next(step for step in wider if prod(_counts(request.size_mm, step)) * rotations <= MAX_PLACES)
        raise BadPlan(
            f"A map of {places} places is too large; {MAX_PLACES} are the most.",
            f"Give a step of {least} mm, a smaller box, or fewer rotations.",
            places=places,
        )
    style = style_of(database, request.surgeon, request.suture, request.version)
    centre_mm = request.centre_mm or xyz(ends_of(style.demo, style.policy.path)[1])
    plan = stacked(request.plan_at(centre_mm), style)
    check_frame(plan.frame)
    axes = [(np.arange(one) - (one - 1) / 2) * request.step_mm for one in counts]
    box = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    found = map_reach(plan, (np.array(centre_mm) + box).round(6))
    x, y, z = counts
    return Reach(
        surgeon=request.surgeon,
        suture=request.suture,
        policy=PolicyName(version=style.version, sha256=style.sha256),
        arm=plan.arm,
        frame=plan.frame,
        step_mm=request.step_mm,
        counts=(x, y, z),
        rotations=rotations,
        places=found,
        in_words=in_words(found),
    )


def _counts(size_mm: tuple[float, float, float], step_mm: float) -> list[int]:
    """Return the number of places along each axis."""
    return [floor(size / step_mm + 1e-9) + 1 for size in size_mm]


def in_words(places: list[ReachPlace]) -> str:
    """Return the result as sentences: how many places are possible, and what limits most of the others."""
    yes = sum(one.reach == "yes" for one in places)
    words = f"{yes} of {len(places)} places can be planned, each in a plan of its own."
    limits = Counter(one.limited_by for one in places if one.reach == "no" and one.limited_by is not None)
    if limits:
        name, count = limits.most_common(1)[0]
        words += f" Most others are refused for {CALLED.get(name, f'the limits of {name}')} ({count})."
    doubt = sum(one.reach == "in doubt" for one in places)
    return words + (f" {doubt} are so near to a limit that only a plan decides." if doubt else "")


CALLED = {
    "bodies": "the distance of the arms' outer bodies",
    "tools": "the distance of the two tools",
    "scene": "the distance from tissue and obstacles",
    "needle": "the needle in the tissue",
}


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
