"""Replay of plans on a robot: the replay gate, the replay bag, and the comparison of a recorded replay with its plan.

    plan --cleared--> feasible playback --replay_bag--> zip: a folder for each arm, the plan, the verdict, the policy
    plan, recorded replay --compare_with_plan--> distances between the planned and the recorded tip path

The bag holds neither the time nor the place of its export: the same plan gives the same bytes. It is signed under the
first checkpoint of the history that covers its verdict.
"""

import hashlib
import json
from typing import Any, Literal

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.arrays import Floats
from skills.db.models import Plan, PolicyVersion, StoredPlayback
from skills.db.packed import digest
from skills.db.session import Database
from skills.errors import BadPlan, Conflict, Corrupt
from skills.formats.replay_bag import (
    ArmMotion,
    ExecutorTimetable,
    arms_of,
    folder_of,
    held_jaw_rad,
    pass_times,
    rows_of_pass,
    seal,
)
from skills.formats.verify import EXECUTOR, PLAN, POLICY, README, SIGNATURE, VERDICT
from skills.learning.evaluation import TIE_BREAK, dtw
from skills.library.operation import proofs
from skills.library.operation.integrity import learnt, learnt_in, planned
from skills.library.people import consent
from skills.library.plans.arm_errors import stated_errors
from skills.library.plans.plans import describe_plan, find_plan, followed_plan, plan_in_words, trajectory_of
from skills.library.plans.playbacks import (
    costs_most,
    counted_as,
    errors_in_words,
    judged_under,
    not_judged,
)
from skills.library.policies import releases, versions
from skills.library.policies.versions import learnt_from
from skills.library.recordings.demos import shown_demo
from skills.packing import canonical, sha256
from skills.planning.handoff import JAW_CLOSED_RAD
from skills.planning.plan import CONSTANT_TURN_DEG, SuturePlan
from skills.planning.trajectory import Trajectory
from skills.remedies import Action, Remedy
from skills.settings import Settings
from skills.transparency.notes import Note
from skills.verification.arm_errors import ArmErrors

POINTS = 1000  # ours, for either path: one every 0.25 mm of a long pass, and 24 MB to align the two


def compare_with_plan(session: Session, plan_sha256: str, demo_sha256: str, pass_index: int = 0) -> dict[str, Any]:
    """Align a recorded replay with a pass of its plan, and return the distances between the two tip paths, in mm.

    The paths are aligned as a whole (dynamic time warping), so the two clocks need not agree; the recording has to be
    cut to the replay itself. Each path is thinned to `POINTS` points at most, so differences below about 0.2 mm are not
    resolved.

    Args:
        session: The caller's transaction.
        plan_sha256: The plan's digest.
        demo_sha256: The digest of the demonstration that was cut out of the replay's recording.
        pass_index: The pass of the plan, counted from 0.

    Raises:
        NotFound: There is no such plan or demonstration.
        Conflict: The consent does not cover training, for the plan, or any use, for the demonstration.
        BadPlan: The plan has no such pass, or the recording is of another arm or in another frame.
    """
    of_plan, of_demo = followed_plan(session, plan_sha256), shown_demo(session, demo_sha256)
    plan, demo = planned(of_plan), of_demo.demo
    if (plan.arm, plan.frame) != (demo.arm, demo.frame):
        raise BadPlan(
            f"The plan is for {plan.arm} in the frame {plan.frame!r}, the recording is of {demo.arm} in "
            f"{demo.frame!r}; record the arm's local/measured_cp."
        )
    trajectory = trajectory_of(plan)
    meant = trajectory.tip_mm[rows_of_pass(trajectory, pass_index)]
    apart_mm = dtw(_thinned(demo.tip_mm), _thinned(meant)).differences_mm
    distance_mm = np.linalg.norm(apart_mm, axis=1)
    return {
        "plan": of_plan.sha256,
        "demo": of_demo.sha256,
        "pass": pass_index,
        "mean_mm": float(distance_mm.mean()),
        "max_mm": float(distance_mm.max()),
        "start_mm": float(np.linalg.norm(demo.tip_mm[0] - meant[0])),
        "end_mm": float(np.linalg.norm(demo.tip_mm[-1] - meant[-1])),
        "dtw_mean_mm": apart_mm.mean(axis=0).tolist(),
        "rmse_mm": np.sqrt((apart_mm**2).mean(axis=0)).tolist(),
        "planned_s": float(np.ptp(trajectory.stamps_s[trajectory.pass_index == pass_index])),
        "recorded_s": float(demo.stamps_s[-1]),
        "tie_break": TIE_BREAK,
    }


def _thinned(path_mm: Floats) -> Floats:
    """Return at most `POINTS` points of a path, shape (T, 3), evenly spaced by index, its ends included."""
    return path_mm[np.linspace(0, len(path_mm) - 1, min(len(path_mm), POINTS)).round().astype(np.int64)]


LIMITS = (
    "Certified on its grid alone: coverage and grid_certificate list the checks. They do not cover the arm's "
    "accuracy, of tissue, or of another arm, frame or instrument than these."
)
BY_HAND = (
    "A surgeon inserts the needle and takes it again by hand (M1, M2): before the first setpoint of the first pass, "
    "and in a further pass before the stamp of take_back, where PSM_A stands to take it. Send no later setpoint before "
    "that is done. Jaws close on the needle and let it go by setpoints: whoever sees that they do not stops them."
)
USE = "Research use only; not a medical device. Never replay it on or near a person."


def replay_bag(
    database: Database,
    plan_sha256: str,
    *,
    errors: ArmErrors,
    lower_bound: float,
    constant_turn_deg: float = CONSTANT_TURN_DEG,
    pass_index: int | None = None,
    handoff: Literal["none"] | None = None,
) -> bytes:
    """Return the replay bag of a plan, or of one of its passes, as the bytes of a zip archive.

    Args:
        database: The database with the plan.
        plan_sha256: The plan's digest.
        errors: The errors of the arms that the installation states, see `check_doubt`.
        lower_bound: The least probability, by its lower bound, with which every pass has to succeed.
        constant_turn_deg: The angle by which a constant orientation may depart from the recorded one.
        pass_index: Export this pass alone, counted from 0; None: all of them.
        handoff: "none" asks for the bag of a plan without a hand-off.

    Raises:
        NotFound: There is no such plan.
        Conflict: The plan must not be replayed, see `cleared`; or consent was withdrawn during the export.
        BadPlan: The plan has no such pass.
        Corrupt: A stored plan, policy, verdict or motion does not match its digest, or is not as the history has it.
        Busy: The history cannot be signed now.
        BadSettings: The signing key cannot be read.
    """
    asked: dict[str, Any] = {"errors": errors, "lower_bound": lower_bound, "constant_turn_deg": constant_turn_deg}
    with database.reading() as session:
        row = find_plan(session, plan_sha256)
        verdict = cleared(session, row, handoff=handoff, **asked)
        plan, demo, policy = planned(row), learnt_from(row.policy), row.policy
        learnt(policy)
        trajectory = verdict.measured.trajectory
        papers = {PLAN: _plan(row, trajectory), VERDICT: _verdict(row, verdict), POLICY: _policy(policy)}
        rows = (("plans", row.row), ("playbacks", verdict.row), ("policy_versions", policy.row))
    if digest(trajectory) != papers[VERDICT]["report"]["trajectory"]:
        raise Corrupt("A stored motion is not the one that its verdict judged; restore it from a backup.")
    arms = arms_of(
        trajectory,
        arm=plan.arm,
        frame=plan.frame,
        other=None if demo.partner is None else demo.partner.arm,
        jaw_rad=held_jaw_rad(demo.jaw_rad, plan.instrument),
        pass_index=pass_index,
    )
    members = {name: _written(paper) for name, paper in papers.items()}
    timetable = ExecutorTimetable(
        plan=row.sha256, use=USE, before_each_pass=BY_HAND, passes=pass_times(trajectory, arms)
    )
    members[EXECUTOR] = _written(timetable.model_dump())
    head = proofs.head_over(database, rows)
    members[README] = _readme(papers[PLAN], papers[VERDICT]["report"], arms, head).encode()
    for arm in arms:
        members |= folder_of(arm, row.sha256)
    members[SIGNATURE] = proofs.sign_files(
        database.history,
        head,
        {name: hashlib.sha256(data).hexdigest() for name, data in members.items()},
        kind="replay-bag",
        plan=row.sha256,
        verdict=papers[VERDICT]["sha256"],
        policy=papers[POLICY]["sha256"],
        trajectory=papers[VERDICT]["report"]["trajectory"],
    )
    bag = seal(members)
    with database.reading() as session:  # again: consent or release may have changed while the bag was composed
        again = find_plan(session, row.sha256)
        cleared(session, again, handoff=handoff, **asked)
    return bag


# ---- the gate ---------------------------------------------------------------------------------------------------


def cleared(
    session: Session,
    plan: Plan,
    *,
    errors: ArmErrors,
    lower_bound: float,
    constant_turn_deg: float = CONSTANT_TURN_DEG,
    handoff: Literal["none"] | None = None,
) -> StoredPlayback:
    """Return the playback that clears a plan for replay: the newest of exactly this plan, feasible and certain enough.

    Args:
        session: The caller's transaction.
        plan: The plan.
        errors: The errors of the arms that the installation states, see `check_doubt`.
        lower_bound: The least probability, by its lower bound, with which every pass has to succeed.
        constant_turn_deg: The angle by which a constant orientation may depart from the recorded one.
        handoff: "none" accepts a plan without a hand-off.

    Raises:
        Conflict: Consent does not cover training and export; the plan has no hand-off, and `handoff` is not "none"; it
            states no tissue; its orientation is constant where the surgeon's turned by more than allowed; the
            demonstration was withdrawn; another policy than the plan's is released, or none; the plan was not played,
            or its verdict is of another version of the checks; it is not feasible, or not certain enough.
        Corrupt: The stored verdict does not match its digest, or the release is not as the history has it.
    """
    policy = plan.policy
    consent.require(versions.followable(policy).surgeon, "export")
    if handoff != "none" and planned(plan).psm_m is None:
        raise Conflict("This plan has no hand-off: no PSM_M, no A2.", Remedy(Action.EXPORT_A1_ALONE))
    scene = planned(plan).scene
    if scene is None or scene.tissue is None:
        raise Conflict(
            "This plan states no tissue, so nothing was compared with it: tissue: not given.",
            Remedy(Action.NAME_TISSUE),
        )
    _check_departure(planned(plan), constant_turn_deg)
    for what in policy.objections:
        raise Conflict(f"The demonstration that this plan depends on {what}; plan with another policy.")
    served = releases.standing(session, policy.surgeon_row, policy.suture)
    if not served or served[0].policy_row != policy.row:
        now = f"version {served[0].policy.version} is" if served else "none is"
        raise Conflict(
            f"This plan follows version {policy.version} of the policy, and {now} released; release that version, or "
            "plan again with the released one."
        )
    releases.refuse_edited_release(session, served[0])
    played = session.scalar(
        select(StoredPlayback).where(StoredPlayback.plan_row == plan.row).order_by(StoredPlayback.row.desc()).limit(1)
    )
    if played is None:
        raise Conflict("This plan was not played in the simulator yet.", Remedy(Action.PLAY, plan=plan.sha256))
    if sha256(canonical([plan.sha256, played.report])) != played.sha256:
        raise Corrupt("A stored verdict does not match its digest; restore it from a backup.")
    if not (played.feasible and played.report["feasible"] is True):
        raise Conflict(
            f"The simulator found this plan infeasible: {played.report['failure_in_words']} Change the plan."
        )
    check_doubt(played.report, errors=errors, lower_bound=lower_bound)
    return played


def conditions_of(settings: Settings) -> dict[str, Any]:
    """Return the conditions under which an installation exports bags, as arguments of `cleared` and `replay_bag`."""
    return {
        "errors": stated_errors(settings.arm_errors),
        "lower_bound": settings.replay_lower_bound,
        "constant_turn_deg": settings.constant_turn_deg,
    }


def refusal_of_bag(session: Session, plan: Plan, settings: Settings) -> Conflict | Corrupt | None:
    """Return the reason why a plan would not be exported now, also as one without a hand-off; None if it would."""
    try:
        cleared(session, plan, handoff="none", **conditions_of(settings))
    except (Conflict, Corrupt) as refusal:
        return refusal
    return None


def _check_departure(planned: SuturePlan, constant_turn_deg: float) -> None:
    """Refuse a plan that holds the jaw where the surgeon turned it.

    Raises:
        Conflict: The departure exceeds the limit.
    """
    if planned.orientation == "recorded":
        return
    departs = planned.departure
    # negated, so that NaN fails
    if departs is not None and not departs.deg <= constant_turn_deg:
        raise Conflict(
            f"This plan holds the jaw, and the surgeon turned it by up to {departs.deg:.1f} degrees: the needle's tip "
            f"would be up to {departs.needle_tip_mm:.1f} mm off. The limit is {constant_turn_deg:g} degrees; plan "
            "again without a constant orientation.",
            deg=departs.deg,
            limit_deg=constant_turn_deg,
        )


def check_doubt(report: dict[str, Any], *, errors: ArmErrors, lower_bound: float) -> None:
    """Refuse a plan whose least certain pass succeeds too rarely when the world differs from the plan.

    Args:
        report: A playback's stored report; its `doubt` is a `skills.verification.probabilities.SuccessEstimate` as
            JSON, with null for NaN.
        errors: The errors of the arms that the installation states; those of the playback's request come first.
        lower_bound: The value that the lower bounds of all passes have to reach.

    Raises:
        Conflict: A pass does not reach it, or the plan was not judged under these errors.
    """
    under = judged_under(report, errors)
    lower = np.array([one["succeeds"]["lower"] for one in under["passes"]], dtype=np.float64)  # null becomes NaN
    least = float(np.min(lower)) if len(lower) else np.nan
    # NaN fails too: it is not >= any bound.
    if not least >= lower_bound:
        most = costs_most(report)
        raise Conflict(
            f"With {errors_in_words(under['errors']['name'])} a pass of this plan may succeed with a probability of "
            f"only {least:.3f}, and {lower_bound:g} is required.{'' if most is None else f' {most}'} Register and "
            "calibrate the arms, state their own errors, and play the plan again.",
            least=least,
            asked=lower_bound,
        )


# ---- the documents in the bag -----------------------------------------------------------------------------------


def _plan(plan: Plan, trajectory: Trajectory) -> dict[str, Any]:
    """Return the plan as the API describes it, from its verified value and not from the description stored with it."""
    policy = plan.policy
    return {
        "use": USE,
        "sha256": plan.sha256,
        "surgeon": policy.surgeon.slug,
        "suture": policy.suture,
        "policy": {"version": policy.version, "sha256": policy.sha256},
        **(about := describe_plan(planned(plan), trajectory, learnt_in(policy))),
        "in_words": plan_in_words(about),
    }


def _verdict(plan: Plan, played: StoredPlayback) -> dict[str, Any]:
    return {
        "use": USE,
        "sha256": played.sha256,
        "plan": plan.sha256,
        "policy": plan.policy.sha256,
        "feasible": played.feasible,
        "report": played.report,
    }


def _policy(policy: PolicyVersion) -> dict[str, Any]:
    """Return the policy's manifest with the limits of its use."""
    return {
        "use": USE,
        "limits": LIMITS,
        "version": policy.version,
        "sha256": policy.sha256,
        **policy.manifest,
    }


def _written(paper: dict[str, Any]) -> bytes:
    return json.dumps(paper, indent=2, sort_keys=True, allow_nan=False).encode() + b"\n"


def _readme(plan: dict[str, Any], report: dict[str, Any], arms: tuple[ArmMotion, ...], head: Note) -> str:
    """Return the text of the bag's README: its contents, and the figures of each arm to check before it moves."""
    under, stated_by = report["doubt"]["under"][0], report["stated_by"]
    errors = ArmErrors(**under["errors"])
    well = "succeed" if counted_as(under) == "hand-over" else "stay within reach and clear"
    about = [
        f"A needle hand-off for replay: plan {plan['sha256']},",
        f"surgeon {plan['surgeon']}, {plan['suture']}, policy version {plan['policy']['version']}.",
        plan["in_words"],
        "",
        f"Every pass is likely enough to {well} with {errors_in_words(errors.name)}, as the {stated_by} stated them:",
        f"{errors.describe()}.",
        f"Not judged: {', '.join(not_judged(under))}.",
        "With greater errors it was not judged: compare these with your arms.",
        "",
        USE,
        "",
        f"1. `skills verify FILE.zip --key KEY` first, with the public key of the service that wrote {SIGNATURE}.",
        "2. Then follow docs/replay.md of suture-skills from its beginning: a simulator before a robot.",
        "",
        f"History {head.checkpoint.origin}: {head.checkpoint.size} leaves, root {head.checkpoint.root.hex()}",
    ]
    if plan["orientation"] == "assumed tool-down":
        about += [
            "",
            "The demonstration had no orientation. The tool is ASSUMED to point straight down: check its orientation.",
        ]
    for arm in arms:
        about += ["", *_arm_lines(arm, plan["arm"], hands=len(arms) > 1)]
    return "\n".join([*about, ""])


def _arm_lines(arm: ArmMotion, planned_arm: str, *, hands: bool) -> list[str]:
    low, high = arm.extent_mm.tolist()
    box = [f"   {axis}:[{a:f}, {b:f}]" for axis, a, b in zip("XYZ", low, high, strict=True)]
    least, most = float(arm.jaw_rad.min()), float(arm.jaw_rad.max())
    if arm.role == "PSM_M":
        jaw = "open as it comes in; closes on the needle at the end of A2"
        named = f"{arm.name}, PSM_M: it takes the needle."
    else:
        jaw = "closed, with a holding force" if least == JAW_CLOSED_RAD else "as demonstrated"
        jaw += " (median)" if least == most != JAW_CLOSED_RAD else ""
        jaw += "; opens once PSM_M's is closed" if hands else ""
        named_so = planned_arm.upper() == arm.name
        assumed = "" if named_so else f" ASSUMED: the demonstration calls its arm {planned_arm!r}."
        named = f"{arm.name}, PSM_A: it brings the needle.{assumed}"
    return [
        named,
        f"   instrument {arm.instrument}, base frame {arm.frame}, {len(arm.stamps_ns)} samples at {arm.rate_hz:g} Hz",
        f"   jaw {f'{least:.4f}' if least == most else f'{least:.4f} to {most:.4f}'} rad: {jaw}",
        "   range of the tip in mm, as `dvrk_bag_replay.py` prints it:",
        *box,
        f"   ros2 run dvrk_python dvrk_bag_replay.py -a {arm.name} -b {arm.name} -m servo_jp",
    ]
