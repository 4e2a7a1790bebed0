"""Descriptions of plans: their numbers, and the sentences on what they do and leave out."""

from skills.arrays import xyz
from skills.db.models import Plan, StoredPlayback
from skills.gridworld.scene import Scene
from skills.library.operation.integrity import scene_digest
from skills.planning.handoff import PsmM
from skills.planning.path_fit import jaw_recorded
from skills.planning.plan import SuturePlan, pose_xyzw, turn_deg
from skills.planning.trajectory import Trajectory, seams, seconds_by_phase, transfers
from skills.schemas import PolicyName
from skills.schemas import plans as schemas
from skills.schemas.plans import PlanDescription, PlanScene, PlanSummary, Sources, Timetable


def describe_plan(plan: SuturePlan, trajectory: Trajectory, learnt_in: Scene | None) -> PlanDescription:
    """Return the description of a plan; `learnt_in` is the scene of its policy."""
    return PlanDescription.from_attributes_of(
        plan,
        a2=plan.a2 if plan.psm_m is not None else None,
        psm_m=None if plan.psm_m is None else _describe_psm_m(plan.psm_m),
        scene=None if plan.scene is None else _describe_scene(plan.scene, learnt_in),
        passes=[
            schemas.Pass.from_attributes_of(
                one.point,
                start_mm=xyz(one.start_mm),
                states=one.states.tolist(),
                path_mm=one.tip_mm.tolist(),
                jaw_xyzw=pose_xyzw(one.rotation),
                target_xyzw=None if one.target_rotation is None else pose_xyzw(one.target_rotation),
                turn_deg=turn_deg(one),
                transfer=transfer,
            )
            for one, transfer in zip(plan.passes, transfers(trajectory), strict=True)
        ],
        trajectory=Timetable.from_attributes_of(
            trajectory,
            samples=len(trajectory),
            seconds_by_phase=seconds_by_phase(trajectory),
            speed_used_mm_s=trajectory.speed_mm_s,
            jaw="recorded" if all(jaw_recorded(one.hand) for one in plan.passes) else "constant",
            peak_joint_speed_ratio=trajectory.speed_ratio,
            peak_joint_acceleration_ratio=trajectory.acceleration_ratio,
            psm_m_moves=trajectory.psm_m is not None,
            seams=list(seams(trajectory)),
        ),
    )


def _describe_psm_m(psm_m: PsmM) -> schemas.PsmM:
    sources = Sources(approach=psm_m.approach_from, base=psm_m.base_from)
    return schemas.PsmM.from_attributes_of(psm_m, from_=sources)


def _describe_scene(scene: Scene, learnt_in: Scene | None) -> PlanScene:
    return PlanScene(
        sha256=scene_digest(scene),
        learnt_sha256=None if learnt_in is None else scene_digest(learnt_in),
        differs=[] if learnt_in is None else differences(scene, learnt_in),
        scene=scene,
    )


def differences(scene: Scene, learnt_in: Scene) -> list[str]:
    """Return the differences of a scene from the one that a policy was learnt in, as phrases.

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


def summarise(row: Plan, played: StoredPlayback | None) -> PlanSummary:
    """Return a plan in a list, with its newest playback."""
    return PlanSummary(
        id=row.sha256,
        surgeon=row.policy.surgeon.slug,
        suture=row.policy.suture,
        policy=PolicyName.model_validate(row.policy),
        passes=len(row.about.passes),
        hands_over=row.about.psm_m is not None,
        playback=None if played is None else played.sha256,
        feasible=None if played is None else played.feasible,
        created_at=row.created_at,
    )


def describe_stored(row: Plan) -> schemas.Plan:
    """Return a stored plan."""
    return schemas.Plan.model_construct(
        **dict(row.about),
        id=row.sha256,
        sha256=row.sha256,
        surgeon=row.policy.surgeon.slug,
        suture=row.policy.suture,
        policy=PolicyName.model_validate(row.policy),
        hands_over=row.about.psm_m is not None,
        description=describe_motion(row.about),
        created_at=row.created_at,
    )


# ---- sentences -----------------------------------------------------------------------------------------------------


def describe_motion(plan: PlanDescription) -> str:
    """Return the sentences on the motions of a plan, and on those that it leaves out."""
    return " ".join([_moves(plan), *_hand(plan), _scene(plan.scene)])


def _moves(plan: PlanDescription) -> str:
    moves = f"Moves {plan.arm} along {len(plan.passes)} pass{'es' if len(plan.passes) != 1 else ''}"
    if plan.psm_m is None:
        return f"{moves}; no hand-off: no PSM_M, no A2."
    if not plan.psm_m_moves:
        return (
            f"{moves} and turns its jaw to offer the needle (A2); has no motion of PSM_M, because its base is not "
            "known, so the needle is not taken."
        )
    return (
        f"{moves} and hands the needle to PSM_M at the end of each: its jaw turns (A2), PSM_M approaches and retracts."
    )


def _hand(plan: PlanDescription) -> list[str]:
    """Return the sentences on what is the surgeon's."""
    departure, tempo = plan.departure, plan.trajectory.tempo
    if plan.orientation == "recorded":
        said = ["The jaw turns as the surgeon's."]
    elif departure is None:
        said = ["The jaw is held: no orientation was recorded."]
    else:
        said = [
            f"The jaw is held: it departs from the surgeon's by up to {departure.deg:.1f} degrees, and the needle's "
            f"tip by {departure.needle_tip_mm:.1f} mm ({departure.handoff_deg:.1f} degrees and "
            f"{departure.handoff_needle_tip_mm:.1f} mm at the hand-off)."
        ]
    if tempo is not None:
        said.append(f"The tempo is {100 * tempo:.0f} % of the surgeon's.")
    if plan.a2 is not None:
        end = "in the recorded hand-off" if plan.a2 == "recorded" else "as in the paper, across PSM_M's approach"
        said.append(f"A2 ends {end}.")
    return said


def _scene(scene: PlanScene | None) -> str:
    if scene is None:
        return "Tissue: not given, so nothing is checked against it, and this motion is not exported."
    if scene.scene.tissue is None:
        return "Tissue: not given. It is checked against the stated obstacles, and this motion is not exported."
    if scene.learnt_sha256 is None:
        return "It is checked against the stated scene, of which its policy knows nothing."
    if not scene.differs:
        return "It is checked against the scene of its policy, whose odds hold at the demonstrated place alone."
    return f"Its scene is not the one that its policy was learnt in: {', '.join(scene.differs)}."
