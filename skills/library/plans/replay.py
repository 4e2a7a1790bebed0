"""Replay of plans on a robot: the replay gate, the replay bag, and the comparison of a recorded replay with its plan.

    plan --cleared--> feasible playback --replay_bag--> zip: a folder for each arm, the plan, the verdict, the policy
    plan, recorded replay --compare_with_plan--> distances between the planned and the recorded tip path

The bag holds neither the time nor the place of its export: the same plan gives the same bytes. It is signed under the
first checkpoint of the history that covers its verdict.
"""

import hashlib
import json
from typing import Any, Literal

from skills.db.models import Plan, PolicyVersion, StoredPlayback
from skills.db.packed import digest
from skills.db.session import Database
from skills.errors import Corrupt
from skills.formats.replay_bag import (
    ArmMotion,
    arms_of,
    folder_of,
    held_jaw_rad,
    seal,
    timetable,
)
from skills.formats.verify import EXECUTOR, PLAN, POLICY, README, SIGNATURE, VERDICT
from skills.library.operation import proofs
from skills.library.operation.integrity import learnt, learnt_in, planned
from skills.library.plans.description import describe_plan, plan_in_words
from skills.library.plans.headline import counted_as, errors_in_words, not_judged
from skills.library.plans.plans import find_plan
from skills.library.plans.replay_gate import cleared
from skills.library.policies.combined import learnt_from
from skills.planning.handoff import JAW_CLOSED_RAD
from skills.planning.plan import CONSTANT_TURN_DEG
from skills.planning.trajectory import Trajectory
from skills.transparency import Note
from skills.verification.arm_errors import ArmErrors

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
    members[EXECUTOR] = _written(
        {"use": USE, "plan": row.sha256, "before_each_pass": BY_HAND, "passes": timetable(trajectory, arms)}
    )
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
        f"{errors.in_words}.",
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
