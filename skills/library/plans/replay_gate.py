"""The replay gate: the playback that clears a plan for replay, or the reason against it."""

from dataclasses import dataclass
from math import nan
from typing import Literal

from sqlalchemy.orm import Session

from skills.db import newest
from skills.db.models import Plan, StoredPlayback
from skills.errors import Conflict, Corrupt
from skills.library.operation.integrity import planned
from skills.library.people import consent
from skills.library.plans.arm_errors import stated_errors
from skills.library.plans.headline import OF_WORLDS, costs_most, counted_as, describe_errors, judged_under
from skills.library.policies import releases, versions
from skills.planning.plan import CONSTANT_TURN_DEG, SuturePlan
from skills.remedies import Action, Remedy
from skills.schemas.playbacks import Verdict
from skills.settings import Settings
from skills.verification.arm_errors import ArmErrors


@dataclass(frozen=True)
class ReplayConditions:
    """The conditions under which an installation exports a bag.

    Attributes:
        errors: The errors of the arms that the installation states, see `check_probability`.
        lower_bound: The least probability, by its lower bound, with which every pass has to succeed.
        constant_turn_deg: The angle by which a constant orientation may depart from the recorded one.
        handoff: "none" accepts a plan without a hand-off.
        executed: Whether the verdict has to predict the executed motion: the installation states how PSM_A is driven.
    """

    errors: ArmErrors
    lower_bound: float
    constant_turn_deg: float = CONSTANT_TURN_DEG
    handoff: Literal["none"] | None = None
    executed: bool = False

    @classmethod
    def of(cls, settings: Settings, handoff: Literal["none"] | None = None) -> "ReplayConditions":
        """Return those of an installation's settings."""
        errors = stated_errors(settings.arm_errors)
        return cls(errors, settings.replay_lower_bound, settings.constant_turn_deg, handoff, bool(settings.servo))


def cleared(session: Session, row: Plan, plan: SuturePlan, conditions: ReplayConditions) -> StoredPlayback:
    """Return the playback that clears a plan for replay: the newest of exactly this plan, feasible and certain enough.

    Args:
        session: The caller's transaction.
        row: The stored plan.
        plan: Its verified value.
        conditions: The conditions of the export.

    Raises:
        Conflict: Consent does not cover training and export; the plan has no hand-off, and `handoff` is not "none"; it
            states no tissue; its orientation is constant where the surgeon's turned by more than allowed; the
            demonstration was withdrawn; another policy than the plan's is released, or none; the plan was not played,
            or its verdict is of another version of the checks; it is not feasible, or not certain enough.
        Corrupt: The stored verdict does not match its digest, or the release is not as the history has it.
    """
    policy = row.policy
    consent.require(versions.followable(policy).surgeon, "export")
    if conditions.handoff != "none" and plan.psm_m is None:
        raise Conflict("This plan has no hand-off: no PSM_M, no A2.", Remedy(Action.EXPORT_A1_ALONE))
    if plan.scene is None or plan.scene.tissue is None:
        raise Conflict(
            "This plan states no tissue, so nothing was compared with it: tissue: not given.",
            Remedy(Action.NAME_TISSUE),
        )
    _check_departure(plan, conditions.constant_turn_deg)
    for change in policy.objections:
        raise Conflict(f"The demonstration that this plan depends on {change.text}; plan with another policy.")
    served = releases.in_force(session, policy.surgeon_row, policy.suture)
    if not served or served[0].policy_row != policy.row:
        now = f"version {served[0].policy.version} is" if served else "none is"
        raise Conflict(
            f"This plan follows version {policy.version} of the policy, and {now} released; release that version, or "
            "plan again with the released one."
        )
    releases.refuse_edited_release(session, served[0])
    played = session.scalar(newest(StoredPlayback, StoredPlayback.plan_row == row.row))
    if played is None:
        raise Conflict("This plan was not played in the simulator yet.", Remedy(Action.PLAY, plan=row.sha256))
    if (played.report.plan, played.report.identity) != (row.sha256, played.sha256):
        raise Corrupt("A stored verdict does not match its digest; restore it from a backup.")
    if not (played.feasible and played.report.feasible):
        raise Conflict(f"The simulator found this plan infeasible: {played.report.failure_sentence} Change the plan.")
    if conditions.executed and played.report.executed is None:
        raise Conflict("This plan was judged before it was stated how the arm is driven. Play it again.")
    check_probability(played.report, errors=conditions.errors, lower_bound=conditions.lower_bound)
    return played


def refusal_of_bag(session: Session, plan: Plan, settings: Settings) -> Conflict | Corrupt | None:
    """Return the reason why a plan would not be exported now, also as one without a hand-off; None if it would."""
    try:
        cleared(session, plan, planned(plan), ReplayConditions.of(settings, handoff="none"))
    except (Conflict, Corrupt) as refusal:
        return refusal
    return None


def _check_departure(plan: SuturePlan, constant_turn_deg: float) -> None:
    """Refuse a plan that holds the jaw where the surgeon turned it.

    Raises:
        Conflict: The departure exceeds the limit.
    """
    if plan.orientation == "recorded":
        return
    departs = plan.departure
    # negated, so that NaN fails
    if departs is not None and not departs.deg <= constant_turn_deg:
        raise Conflict(
            f"This plan holds the jaw, and the surgeon turned it by up to {departs.deg:.1f} degrees: the needle's tip "
            f"would be up to {departs.needle_tip_mm:.1f} mm off. The limit is {constant_turn_deg:g} degrees; plan "
            "again without a constant orientation.",
            deg=departs.deg,
            limit_deg=constant_turn_deg,
        )


def check_probability(report: Verdict, *, errors: ArmErrors, lower_bound: float) -> None:
    """Refuse a plan whose least certain pass succeeds too rarely when the world differs from the plan.

    Args:
        report: A playback's stored report.
        errors: The errors of the arms that the installation states; those of the playback's request come first.
        lower_bound: The value that the lower bounds of all passes have to reach.

    Raises:
        Conflict: A pass does not reach it, or the plan was not judged under these errors.
    """
    under = judged_under(report, errors)
    lowest = [one.succeeds.lower for one in under.passes] or [nan]
    # NaN fails too: it is not >= any bound. So each is compared: `min` passes over a NaN that is not the first.
    if failing := [lower for lower in lowest if not lower >= lower_bound]:
        least, most = min(failing), costs_most(report)
        raise Conflict(
            f"With {describe_errors(under.errors.name)} a pass of this plan may {OF_WORLDS[counted_as(under)]} with a "
            f"probability of "
            f"only {least:.3f}, and {lower_bound:g} is required.{'' if most is None else f' {most}'} Register and "
            "calibrate the arms, state their own errors, and play the plan again.",
            least=least,
            asked=lower_bound,
        )
