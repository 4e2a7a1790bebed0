"""What a lab's robot may replay: the gate, and the bag with its papers.

    plan --cleared--> feasible playback --replay_bag--> zip: a folder for each arm, the plan, the verdict, the policy

The bag holds nothing of when and where it was exported: the same plan gives the same bytes.
"""

import json
from typing import Any

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.models import Plan, PolicyVersion, StoredPlayback
from skills.db.session import Database
from skills.errors import Conflict, Corrupt
from skills.library import releases
from skills.library.catalogue import check_consent
from skills.library.combined import learnt_from
from skills.library.plans import describe_plan, find_plan, trajectory_of
from skills.library.playbacks import trajectory_digest
from skills.library.verified import learnt, planned
from skills.packing import canonical, sha256
from skills.recordings.replay import JAW_CLOSED_RAD, ArmMotion, arm_names, arms_of, folder_of, held_jaw_rad, seal
from skills.recordings.replay_check import PLAN, POLICY, README, VERDICT
from skills.style.trajectory import Trajectory

LIMITS = (
    "Certified on its grid alone: coverage and grid_certificate say what was checked. They say nothing of the arm's "
    "accuracy, of tissue, or of another arm, frame or instrument than these."
)
USE = "Research use only; not a medical device. Never replay it on or near a person."


def replay_bag(
    database: Database, plan_sha256: str, *, tip_error_mm: float, lower_bound: float, pass_index: int | None = None
) -> bytes:
    """Compose the bag of a plan, or of one of its passes, counted from 0: a zip archive.

    Args:
        database: Where the plan is.
        plan_sha256: The plan's digest.
        tip_error_mm: Which tip error the doubt is taken under, see `check_doubt`.
        lower_bound: The least probability, by its lower bound, with which every pass succeeds.
        pass_index: One pass alone; None: all of them.

    Raises:
        NotFound: There is no such plan.
        Conflict: It must not be replayed, see `cleared`; or what was played are not the samples that would be exported.
        BadPlan: The plan has no such pass.
        Corrupt: What is stored is not what was planned, learnt or judged.
    """
    with database.reading() as session:
        row = find_plan(session, plan_sha256)
        verdict = cleared(session, row, tip_error_mm=tip_error_mm, lower_bound=lower_bound)
        plan, demo, policy = planned(row), learnt_from(row.policy), row.policy
        learnt(policy)
        trajectory = trajectory_of(plan)
        papers = {PLAN: _plan(row, trajectory), VERDICT: _verdict(row, verdict), POLICY: _policy(policy)}
    if trajectory_digest(trajectory) != papers[VERDICT]["report"].get("trajectory"):
        raise Conflict(
            "The arm would move otherwise than when the plan was played, by an older version; play it again."
        )
    arms = arms_of(
        trajectory,
        arm=plan.arm,
        frame=plan.frame,
        other=None if demo.partner is None else demo.partner.arm,
        jaw_rad=held_jaw_rad(demo.jaw_rad, plan.instrument),
        pass_index=pass_index,
    )
    members = {name: _written(paper) for name, paper in papers.items()}
    members[README] = _readme(papers[PLAN], arms).encode()
    for arm in arms:
        members |= folder_of(arm, plan_sha256)
    return seal(members)


# ---- the gate ---------------------------------------------------------------------------------------------------


def cleared(session: Session, plan: Plan, *, tip_error_mm: float, lower_bound: float) -> StoredPlayback:
    """Find the playback that lets a plan be replayed: the newest of exactly this plan, feasible and certain enough.

    Raises:
        Conflict: Consent does not cover an export; the demonstration was withdrawn; another policy than the plan's is
            released, or none; the plan was not played, is not feasible, or not certain enough.
        Corrupt: The stored verdict is not the one that was given.
    """
    policy = plan.policy
    check_consent(policy.surgeon, "export")
    if policy.rests_on_withdrawn:
        raise Conflict("The demonstration that this plan rests on was withdrawn; plan with another policy.")
    served = releases.standing(session, policy.surgeon_row, policy.suture)
    if not served or served[0].policy_row != policy.row:
        now = f"version {served[0].policy.version} is" if served else "none is"
        raise Conflict(
            f"This plan follows version {policy.version} of the policy, and {now} released; release that version, or "
            "plan again with the released one."
        )
    played = session.scalar(
        select(StoredPlayback).where(StoredPlayback.plan_row == plan.row).order_by(StoredPlayback.row.desc()).limit(1)
    )
    if played is None:
        raise Conflict("This plan was not played in the simulator yet; POST /playbacks asks for it.")
    if sha256(canonical([plan.sha256, played.report])) != played.sha256:
        raise Corrupt(
            "A stored verdict is not the one that was given; restore it from a backup or play the plan again."
        )
    if not (played.feasible and played.report["feasible"] is True):
        raise Conflict(
            f"The simulator found this plan infeasible: {played.report['failure_in_words']} Change the plan."
        )
    check_doubt(played.report, tip_error_mm=tip_error_mm, lower_bound=lower_bound)
    return played


def check_doubt(report: dict[str, Any], *, tip_error_mm: float, lower_bound: float) -> None:
    """Refuse a plan whose least certain pass may succeed less often than it should when the world is not exact.

    Args:
        report: A playback's stored report; its `doubt` is a `style.doubt.Doubt` as JSON, null where that has NaN.
        tip_error_mm: The tip error that is expected of the robot: one that was judged.
        lower_bound: What the lower bounds of all passes have to reach.

    Raises:
        Conflict: One does not, or doubt was not judged under this tip error.
    """
    judged = (report.get("doubt") or {}).get("under", [])
    passes = [one for under in judged if under["tip_error_mm"] == tip_error_mm for one in under["passes"]]
    if not passes:
        raise Conflict(
            f"With a tip error of {tip_error_mm:g} mm this plan was not judged; play it again with POST /playbacks."
        )
    least = float(np.min(np.array([one["succeeds"]["lower"] for one in passes], dtype=np.float64)))  # null becomes NaN
    if not least >= lower_bound:
        raise Conflict(
            f"With a tip error of {tip_error_mm:g} mm a pass of this plan may succeed with a probability of only "
            f"{least:.3f}, and {lower_bound:g} is asked for; move its suture points, or calibrate the robot.",
            least=least,
            asked=lower_bound,
        )


# ---- the papers -------------------------------------------------------------------------------------------------


def _plan(plan: Plan, trajectory: Trajectory) -> dict[str, Any]:
    """Write the plan as a client is told of it, from its verified value and not from what was written beside it."""
    policy = plan.policy
    return {
        "use": USE,
        "sha256": plan.sha256,
        "surgeon": policy.surgeon.slug,
        "suture": policy.suture,
        "policy": {"version": policy.version, "sha256": policy.sha256},
        **describe_plan(planned(plan), trajectory),
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
    """Write the policy's card: its manifest, and how far it goes."""
    return {
        "use": USE,
        "limits": LIMITS,
        "version": policy.version,
        "sha256": policy.sha256,
        **policy.manifest,
    }


def _written(paper: dict[str, Any]) -> bytes:
    return json.dumps(paper, indent=2, sort_keys=True, allow_nan=False).encode() + b"\n"


def _readme(plan: dict[str, Any], arms: tuple[ArmMotion, ...]) -> str:
    """Say what the bag is, and of each arm what a person has to compare before it moves."""
    about = [
        f"A needle hand-off for replay: plan {plan['sha256']},",
        f"surgeon {plan['surgeon']}, {plan['suture']}, policy version {plan['policy']['version']}.",
        "",
        USE,
        "",
        "1. `skills verify FILE.zip` first; `sha256sum -c SHA256SUMS` in the unpacked folder checks the files alone.",
        "2. Then docs/replay.md of suture-skills, from the top: a simulator before a robot.",
    ]
    if plan["orientation"] != "demonstrated":
        about += ["", "The demonstration had no orientation. The tool is ASSUMED to point straight down: compare it."]
    for arm in arms:
        about += ["", *_arm_lines(arm, plan["arm"])]
    return "\n".join([*about, ""])


def _arm_lines(arm: ArmMotion, planned_arm: str) -> list[str]:
    low, high = arm.extent_mm.tolist()
    box = [f"   {axis}:[{a:f}, {b:f}]" for axis, a, b in zip("XYZ", low, high, strict=True)]
    if arm.role == "PSM_M":
        jaw = "stays open; nothing takes the needle until a surgeon closes it"
        named = f"{arm.name}, PSM_M: it takes the needle."
    else:
        jaw = "closed, and it presses" if arm.jaw_rad == JAW_CLOSED_RAD else "as demonstrated (median)"
        known = planned_arm.upper() == arm_names(planned_arm)[0]
        assumed = "" if known else f" ASSUMED: the demonstration calls its arm {planned_arm!r}."
        named = f"{arm.name}, PSM_A: it brings the needle.{assumed}"
    return [
        named,
        f"   instrument {arm.instrument}, base frame {arm.frame}, {len(arm.stamps_ns)} samples at {arm.rate_hz:g} Hz",
        f"   jaw {arm.jaw_rad:.4f} rad: {jaw}",
        "   range of the tip in mm, as `dvrk_bag_replay.py` prints it:",
        *box,
        f"   ros2 run dvrk_python dvrk_bag_replay.py -a {arm.name} -b {arm.name} -m servo_jp",
    ]
