"""Replay of plans on a robot: the replay gate, the replay bag, and the comparison of a recorded replay with its plan.

    plan --cleared--> feasible playback --replay_bag--> zip: a folder for each arm, the plan, the verdict, the policy
    plan, recorded replay --compare_with_plan--> distances between the planned and the recorded tip path

The bag holds neither the time nor the place of its export: the same plan gives the same bytes. It is signed under the
first checkpoint of the history that covers its verdict.
"""

import hashlib
import json
from typing import Any

from pydantic import TypeAdapter

from skills.db.models import Plan, StoredPlayback
from skills.db.packed import digest
from skills.db.session import Database
from skills.errors import Corrupt
from skills.formats.replay_bag import ArmMotion, ExecutorTimetable, arms_of, folder_of, held_jaw_rad, pass_times, seal
from skills.formats.verify import EXECUTOR, PLAN, POLICY, README, SIGNATURE, VERDICT
from skills.library.operation import proofs
from skills.library.operation.integrity import learnt, learnt_in, planned
from skills.library.plans.description import describe_motion, describe_plan
from skills.library.plans.headline import OF_WORLDS, counted_as, describe_errors, not_judged
from skills.library.plans.plans import find_plan
from skills.library.plans.replay_gate import ReplayConditions, cleared
from skills.library.policies.combined import learnt_from
from skills.planning.handoff import JAW_CLOSED_RAD
from skills.schemas.plans import PlanDescription
from skills.schemas.playbacks import Verdict
from skills.transparency.notes import Note

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
    database: Database, plan_sha256: str, conditions: ReplayConditions, pass_index: int | None = None
) -> bytes:
    """Return the replay bag of a plan, or of one of its passes, as the bytes of a zip archive.

    Args:
        database: The database with the plan.
        plan_sha256: The plan's digest.
        conditions: The conditions of the export.
        pass_index: Export this pass alone, counted from 0; None: all of them.

    Raises:
        NotFound: There is no such plan.
        Conflict: The plan must not be replayed, see `cleared`; or consent was withdrawn during the export.
        BadPlan: The plan has no such pass.
        Corrupt: A stored plan, policy, verdict or motion does not match its digest, or is not as the history has it.
        Busy: The history cannot be signed now.
        BadSettings: The signing key cannot be read.
    """
    with database.reading() as session:
        row = find_plan(session, plan_sha256)
        plan, policy = planned(row), row.policy
        verdict = cleared(session, row, plan, conditions)
        partner, jaw_rad = (demo := learnt_from(policy).demo).partner, demo.jaw_rad
        trajectory, report = verdict.measured.trajectory, verdict.report
        # From its verified value, and not the description stored with it.
        about = describe_plan(plan, trajectory, learnt_in(policy))
        papers = _papers(row, about, verdict)
        rows = (("plans", row.row), ("playbacks", verdict.row), ("policy_versions", policy.row))
    if digest(trajectory) != report.trajectory:
        raise Corrupt("A stored motion is not the one that its verdict judged; restore it from a backup.")
    arms = arms_of(
        trajectory,
        arm=plan.arm,
        frame=plan.frame,
        other=None if partner is None else partner.arm,
        jaw_rad=held_jaw_rad(jaw_rad, plan.instrument),
        pass_index=pass_index,
    )
    times = pass_times(trajectory, arms)
    timetable = ExecutorTimetable(plan=row.sha256, use=USE, before_each_pass=BY_HAND, passes=times)
    papers[EXECUTOR] = timetable.model_dump()
    members = {name: _written(paper) for name, paper in papers.items()}
    head = proofs.head_over(database, rows)
    members[README] = _readme(row, about, report, arms, head).encode()
    for arm in arms:
        members |= folder_of(arm, row.sha256)
    members[SIGNATURE] = proofs.sign_files(
        database.history,
        head,
        {name: hashlib.sha256(data).hexdigest() for name, data in members.items()},
        kind="replay-bag",
        plan=row.sha256,
        verdict=verdict.sha256,
        policy=policy.sha256,
        trajectory=report.trajectory,
    )
    bag = seal(members)
    with database.reading() as session:  # again: consent or release may have changed while the bag was composed
        cleared(session, find_plan(session, row.sha256), plan, conditions)
    return bag


# ---- the documents in the bag -----------------------------------------------------------------------------------


def _papers(row: Plan, about: PlanDescription, played: StoredPlayback) -> dict[str, dict[str, Any]]:
    """Return the plan, its verdict, and its policy's verified manifest with the limits of its use."""
    policy = row.policy
    learnt(policy)
    named = {"version": policy.version, "sha256": policy.sha256}
    style = {"surgeon": policy.surgeon.slug, "suture": policy.suture, "policy": named}
    plan = {"sha256": row.sha256, "description": describe_motion(about), **about.model_dump(mode="json")}
    report = TypeAdapter(Verdict).dump_python(played.report, mode="json")  # of which its digest is
    verdict = {"sha256": played.sha256, "plan": row.sha256, "policy": policy.sha256, "feasible": played.feasible}
    return {
        PLAN: {"use": USE, **style, **plan},
        VERDICT: {"use": USE, **verdict, "report": report},
        POLICY: {"use": USE, "limits": LIMITS, **named, **policy.manifest.model_dump(mode="json")},
    }


def _written(paper: dict[str, Any]) -> bytes:
    return json.dumps(paper, indent=2, sort_keys=True, allow_nan=False).encode() + b"\n"


def _readme(row: Plan, about: PlanDescription, report: Verdict, arms: tuple[ArmMotion, ...], head: Note) -> str:
    """Return the text of the bag's README: its contents, and the figures of each arm to check before it moves."""
    under, policy = report.estimate.under[0], row.policy
    errors = under.errors
    lines = [
        f"A needle hand-off for replay: plan {row.sha256},",
        f"surgeon {policy.surgeon.slug}, {policy.suture}, policy version {policy.version}.",
        describe_motion(about),
        "",
        f"Every pass is likely enough to {OF_WORLDS[counted_as(under)]} with {describe_errors(errors.name)}, "
        f"as the {report.stated_by} stated them:",
        f"{errors.describe()}.",
        f"Not judged: {', '.join(not_judged(about, under))}.",
        "With greater errors it was not judged: compare these with your arms.",
        "",
        USE,
        "",
        f"1. `skills verify FILE.zip --key KEY` first, with the public key of the service that wrote {SIGNATURE}.",
        "2. Then follow docs/replay.md of suture-skills from its beginning: a simulator before a robot.",
        "",
        f"History {head.checkpoint.origin}: {head.checkpoint.size} leaves, root {head.checkpoint.root.hex()}",
    ]
    if about.orientation == "assumed tool-down":
        lines += [
            "",
            "The demonstration had no orientation. The tool is ASSUMED to point straight down: check its orientation.",
        ]
    for arm in arms:
        lines += ["", *_arm_lines(arm, about.arm, hands=len(arms) > 1)]
    return "\n".join([*lines, ""])


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
