"""Replay of plans on a robot: the replay gate, the replay bag, and the comparison of a recorded replay with its plan.

    plan --cleared--> feasible playback --replay_bag--> zip: a folder for each arm, the plan, the verdict, the policy
    plan, recorded replay --compare_with_plan--> distances between the planned and the recorded tip path

The bag holds neither the time nor the place of its export: the same plan gives the same bytes. It is signed under the
first checkpoint of the history that covers its verdict.
"""

import hashlib
import json
from importlib.resources import files
from typing import Any

from jinja2 import Template
from pydantic import TypeAdapter
from sqlalchemy.orm import Session

from skills.db.models import Plan, StoredPlayback
from skills.db.packed import digest
from skills.db.session import Database
from skills.errors import Corrupt
from skills.formats.replay_bag import ArmMotion, arms_of, folder_of, held_jaw_rad, seal, segment_index, segment_motions
from skills.formats.verify import PLAN, POLICY, README, SEGMENTS, SIGNATURE, VERDICT
from skills.library.operation import proofs
from skills.library.operation.integrity import learnt, learnt_in, planned
from skills.library.plans.description import describe_motion, describe_plan
from skills.library.plans.headline import OF_WORLDS, counted_as, describe_errors, hand_over, not_judged
from skills.library.plans.plans import find_plan, followed_plan, trajectory_of
from skills.library.plans.replay_gate import ReplayConditions, cleared
from skills.library.policies.combined import learnt_from
from skills.planning.handoff import JAW_CLOSED_RAD
from skills.planning.plan import SuturePlan
from skills.planning.trajectory import Trajectory
from skills.schemas.plans import PlanDescription, SegmentIndex
from skills.schemas.playbacks import Verdict
from skills.transparency.notes import Note

LIMITS = (
    "Certified on its grid alone: coverage and grid_certificate list the checks. They do not cover the arm's "
    "accuracy, of tissue, or of another arm, frame or instrument than these."
)
USE = "Research use only; not a medical device. Never replay it on or near a person."


def replay_bag(database: Database, plan_sha256: str, conditions: ReplayConditions) -> bytes:
    """Return the replay bag of a plan, by automatic segment, as the bytes of a zip archive.

    Args:
        database: The database with the plan.
        plan_sha256: The plan's digest.
        conditions: The conditions of the export.

    Raises:
        NotFound: There is no such plan.
        Conflict: The plan must not be replayed, see `cleared`; or consent was withdrawn during the export.
        Corrupt: A stored plan, policy, verdict or motion does not match its digest, or is not as the history has it.
        Busy: The history cannot be signed now.
        BadSettings: The signing key cannot be read.
    """
    with database.reading() as session:
        row = find_plan(session, plan_sha256)
        plan, policy = planned(row), row.policy
        verdict = cleared(session, row, plan, conditions)
        trajectory, report = verdict.measured.trajectory, verdict.report
        # From its verified value, and not the description stored with it.
        about = describe_plan(plan, trajectory, learnt_in(policy))
        arms = _arms(row, plan, trajectory)
        papers = _papers(row, about, verdict)
        rows = (("plans", row.row), ("playbacks", verdict.row), ("policy_versions", policy.row))
    if digest(trajectory) != report.trajectory:
        raise Corrupt("A stored motion is not the one that its verdict judged; restore it from a backup.")
    segments = segment_motions(trajectory, arms)
    index = segment_index(segments, row.sha256)
    papers[SEGMENTS] = {"use": USE, **index.model_dump(mode="json")}
    members = {name: _written(paper) for name, paper in papers.items()}
    head = proofs.head_over(database, rows)
    members[README] = _readme(row, about, report, arms, index, head).encode()
    for part in (part for _, parts in segments for part in parts if part.moves):
        members |= folder_of(part, row.sha256)
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


def describe_segments(session: Session, plan_sha256: str) -> SegmentIndex:
    """Return the automatic segments of a plan, and what must be true before each.

    Raises:
        NotFound: There is no such plan.
        Conflict: The surgeon's consent does not cover training.
    """
    row = followed_plan(session, plan_sha256)
    plan = planned(row)
    trajectory = trajectory_of(plan)
    return segment_index(segment_motions(trajectory, _arms(row, plan, trajectory)), row.sha256)


def _arms(row: Plan, plan: SuturePlan, trajectory: Trajectory) -> tuple[ArmMotion, ...]:
    demo = learnt_from(row.policy).demo
    return arms_of(
        trajectory,
        arm=plan.arm,
        frame=plan.frame,
        other=None if demo.partner is None else demo.partner.arm,
        jaw_rad=held_jaw_rad(demo.jaw_rad, plan.instrument),
    )


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


def _readme(
    row: Plan, about: PlanDescription, report: Verdict, arms: tuple[ArmMotion, ...], index: SegmentIndex, head: Note
) -> str:
    """Return the text of the bag's README: its contents, the figures of each arm to check, and the commands."""
    under = report.estimate.under[0]
    text = (files("skills.library.plans") / "replay_readme.jinja").read_text()
    template = Template(text, autoescape=False, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    readme: str = template.render(
        plan=row.sha256,
        policy=row.policy,
        motion=describe_motion(about),
        counted=OF_WORLDS[counted_as(under)],
        named=describe_errors(under.errors.name),
        stated_by=report.stated_by,
        errors=under.errors.describe(),
        not_judged=", ".join(not_judged(about, under)),
        hand_over=hand_over(under),
        use=USE,
        signature=SIGNATURE,
        checkpoint=head.checkpoint,
        assumed=about.orientation == "assumed tool-down",
        arms=[(arm, _jaw(arm, hands=len(arms) > 1)) for arm in arms],
        planned_arm=about.arm,
        index=index,
    )
    return readme


def _jaw(arm: ArmMotion, *, hands: bool) -> str:
    """Return the range of an arm's jaw, and what it does."""
    least, most = float(arm.jaw_rad.min()), float(arm.jaw_rad.max())
    if arm.role == "PSM_M":
        does = "open as it comes in; closes on the needle at the end of A2"
    else:
        does = "closed, with a holding force" if least == JAW_CLOSED_RAD else "as demonstrated"
        does += " (median)" if least == most != JAW_CLOSED_RAD else ""
        does += "; opens once PSM_M's is closed" if hands else ""
    return f"{least:.4f} rad: {does}" if least == most else f"{least:.4f} to {most:.4f} rad: {does}"
