"""What is served: a policy version is released, superseded by a later release, or withdrawn.

The newest release of a style that is not withdrawn is served. A withdrawal never lets an older release come back by
itself: what the newest one superseded is withdrawn with it, so that nothing is served until somebody releases again.
"""

from collections.abc import Sequence

from sqlalchemy import String, bindparam, select, type_coerce
from sqlalchemy.orm import Session

from skills.db.base import now
from skills.db.changes import announce
from skills.db.models import Demonstration, PolicyVersion, Release, Surgeon
from skills.errors import Conflict, NotFound
from skills.library.events import record
from skills.library.verified import learnt

# Which release a style serves, in terms that no other ever has: the number of a row that was erased is used again.
SERVED = (
    select(Release.row, type_coerce(Release.released_at, String).label("released_at"), PolicyVersion.sha256)
    .join(Surgeon, Surgeon.row == Release.surgeon_row)
    .join(PolicyVersion, PolicyVersion.row == Release.policy_row)
    .where(Surgeon.slug == bindparam("surgeon"), Release.suture == bindparam("suture"))
    .where(Release.withdrawn_at.is_(None))
    .order_by(Release.row.desc())
    .limit(1)
)
DTW_SLACK_MM = 0.0  # ours: another learner may be released if its total DTW is no larger than the released one's


def standing(session: Session, surgeon_row: int, suture: str) -> Sequence[Release]:
    """List a style's releases that are not withdrawn, the newest (which is served) first."""
    return session.scalars(
        select(Release)
        .where(Release.surgeon_row == surgeon_row, Release.suture == suture, Release.withdrawn_at.is_(None))
        .order_by(Release.row.desc())
    ).all()


def release(session: Session, policy: PolicyVersion, actor: str) -> Release:
    """Release a policy version if it passes the gate; releasing what is served already changes nothing.

    Raises:
        Conflict: It does not pass, with the reasons; or its demonstration was withdrawn.
        Corrupt: What is stored is not what was certified.
    """
    learnt(policy)
    served = standing(session, policy.surgeon_row, policy.suture)
    if served and served[0].policy_row == policy.row:
        return served[0]
    reasons = list(policy.manifest["grid_certificate"]["refused_because"])
    if policy.rests_on_withdrawn:
        reasons.append("its demonstration was withdrawn")
    if policy.manifest["phases"] == 1 and served:
        before = served[0].policy.manifest["metrics"]["dtw_total_mm"]
        mine = policy.manifest["metrics"]["dtw_total_mm"]
        if not mine <= before + DTW_SLACK_MM:
            reasons.append(f"it follows the demonstration worse than the released one ({mine:g} against {before:g} mm)")
    if reasons or not policy.releasable:
        raise Conflict(f"Version {policy.version} cannot be released: {'; '.join(reasons)}.", reasons=reasons)
    released = Release(policy=policy, surgeon_row=policy.surgeon_row, suture=policy.suture, released_by=actor)
    session.add(released)
    record(session, actor, "release", "policy-version", policy.sha256, policy.surgeon)
    session.flush()
    announce(session)
    return released


def withdraw(session: Session, surgeon: Surgeon, suture: str, actor: str) -> list[Release]:
    """Withdraw all releases of a style: nothing is served until somebody releases again."""
    releases = list(standing(session, surgeon.row, suture))
    if not releases:
        raise NotFound(f"Nothing of '{surgeon.slug}' and '{suture}' is released.")
    _withdraw(session, releases, actor)
    return releases


def withdraw_resting_on(session: Session, demonstration: Demonstration, actor: str) -> list[Release]:
    """Withdraw the releases that rest on a demonstration, and with the served one those that it superseded."""
    releases = standing(session, demonstration.surgeon_row, demonstration.suture)
    resting = [r for r in releases if demonstration in r.policy.demonstrations]
    withdrawn = list(releases) if releases and releases[0] in resting else resting
    _withdraw(session, withdrawn, actor)
    return withdrawn


def _withdraw(session: Session, releases: Sequence[Release], actor: str) -> None:
    for one in releases:
        one.withdrawn_at = now()
        record(session, actor, "withdraw", "policy-version", one.policy.sha256, one.policy.surgeon)
    session.flush()
    announce(session)
