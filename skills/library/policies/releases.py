"""Releases: the served version of a style, its release if the gate passes, and its withdrawal.

A policy version is released, superseded by a later release, or withdrawn. The newest release of a style that is not
withdrawn is served, for as long as the surgeon's consent covers training. A withdrawal never lets an older release come
back by itself: the releases that the newest one superseded are withdrawn with it, so that nothing is served until
somebody releases again.

`skills.library.policies.gate` has the checks of the gate, `fit` the comparison with the version that is served, and
`outcomes` the answers about jobs, which state what is served now.
"""

from collections.abc import Collection, Mapping, Sequence
from datetime import datetime
from functools import cache
from typing import Any, NamedTuple

from sqlalchemy import (
    JSON,
    ColumnElement,
    ScalarSelect,
    String,
    and_,
    bindparam,
    cast,
    exists,
    func,
    select,
    type_coerce,
)
from sqlalchemy.orm import Session, aliased, selectinload

from skills.db import now
from skills.db.changes import announce
from skills.db.history import HISTORY
from skills.db.leaves import LEAVES
from skills.db.models import Demonstration, PolicyVersion, Release, StoredPoses, Surgeon
from skills.db.service_tables import record_event, record_events
from skills.errors import Conflict, NotFound
from skills.library.operation.history import refuse_edited
from skills.library.operation.integrity import learnt
from skills.library.people import consent
from skills.library.policies.fit import compare_versions, format_mm, not_worse
from skills.library.policies.gate import join_reasons, remedy
from skills.planning.plan import CONSTANT_TURN_DEG, departure_of
from skills.schemas.policies import GateRefusal

Style = tuple[int, str]  # a surgeon's row and a suture type's slug


def _newest_leaf(table: type[Release | Surgeon]) -> ScalarSelect[Any]:
    of_row = (LEAVES.c.table_name == table.__tablename__, LEAVES.c.key == cast(table.row, String))
    return select(func.max(LEAVES.c.row)).where(*of_row).scalar_subquery()


# The newest release of a style that is not withdrawn, with columns that identify it for ever: row numbers are reused
# after an erasure. It is served if the surgeon's consent, returned as text, covers training. A pose style may be added
# to its version later. The newest leaves show that the service changed a row, although somebody changed it back.
NEWEST_RELEASE = (
    select(
        Release.row,
        type_coerce(Release.released_at, String).label("released_at"),
        consent.AS_TEXT.label("consent"),
        StoredPoses.sha256.label("poses"),
        _newest_leaf(Release),
        _newest_leaf(Surgeon),
        PolicyVersion.sha256,
    )
    .join(Surgeon, Surgeon.row == Release.surgeon_row)
    .join(PolicyVersion, PolicyVersion.row == Release.policy_row)
    .outerjoin(StoredPoses, StoredPoses.policy_row == Release.policy_row)
    .where(Surgeon.slug == bindparam("surgeon"), Release.suture == bindparam("suture"))
    .where(Release.withdrawn_at.is_(None))
    .order_by(Release.row.desc())
    .limit(1)
)


def in_force(session: Session, surgeon_row: int, suture: str) -> Sequence[Release]:
    """List a style's releases that are not withdrawn, the newest first.

    That one is served, if consent covers training.
    """
    return session.scalars(
        select(Release)
        .where(Release.surgeon_row == surgeon_row, Release.suture == suture, Release.withdrawn_at.is_(None))
        .order_by(Release.row.desc())
    ).all()


def served(session: Session, surgeon: Surgeon, suture: str) -> Release | None:
    """Return the release that a style serves today; None if there is none or consent does not cover training."""
    releases = in_force(session, surgeon.row, suture)
    return releases[0] if releases and consent.may(surgeon, "training") else None


def refuse_edited_release(session: Session, release: Release) -> None:
    """Refuse to serve a release if it, a later one of its style, its policy or its surgeon was not written by us.

    Raises:
        Corrupt: One of these rows is not as the history has it.
    """
    of_style = (Release.surgeon_row == release.surgeon_row, Release.suture == release.suture)
    releases = session.scalars(select(Release.row).where(*of_style, Release.row >= release.row)).all()
    decide = {"releases": releases, "policy_versions": [release.policy_row], "surgeons": [release.surgeon_row]}
    for table, rows in decide.items():
        refuse_edited(session.connection(), session.info[HISTORY], table, [str(row) for row in rows])


def serves(session: Session, policy: PolicyVersion) -> bool:
    """Return whether a policy version is the one that its style serves."""
    now = served(session, policy.surgeon, policy.suture)
    return now is not None and now.policy_row == policy.row


def served_versions(session: Session, styles: Collection[Style]) -> dict[Style, PolicyVersion]:
    """Return the versions that some styles serve, with one statement; styles that serve nothing are left out."""
    query = select(PolicyVersion).join(Release, Release.policy_row == PolicyVersion.row)
    mine = Release.surgeon_row.in_({who for who, _ in styles}), Release.suture.in_({suture for _, suture in styles})
    found = session.scalars(query.where(*mine, is_served()))
    return {(one.surgeon_row, one.suture): one for one in found}


def shares_served(session: Session, suture: str) -> dict[str, float]:
    """Return the mean share of the demonstration that the starts of each served policy follow, by surgeon."""
    share = type_coerce(PolicyVersion.manifest, JSON)["coverage", "mean_share"]
    query = select(Surgeon.slug, share).select_from(Release).join(Surgeon, Surgeon.row == Release.surgeon_row)
    query = query.join(PolicyVersion, PolicyVersion.row == Release.policy_row)
    found = session.execute(query.where(Release.suture == suture, is_served()))
    return {surgeon: float(mean) for surgeon, mean in found}


@cache
def is_served() -> ColumnElement[bool]:
    """Return a condition on `Release`: its style serves it on the day on which the query is executed."""
    later = aliased(Release)
    superseded = exists().where(
        later.surgeon_row == Release.surgeon_row,
        later.suture == Release.suture,
        later.row > Release.row,
        later.withdrawn_at.is_(None),
    )
    # A scalar and not `exists`: PostgreSQL turns that into a join, and then sorts rows that an index returns in order.
    agreed = select(consent.covered("training")).where(Surgeon.row == Release.surgeon_row).correlate(Release)
    return and_(Release.withdrawn_at.is_(None), ~superseded.correlate(Release), agreed.scalar_subquery())


def release(
    session: Session, policy: PolicyVersion, actor: str, *, constant_turn_deg: float = CONSTANT_TURN_DEG
) -> Release:
    """Release a policy version if it passes the gate; releasing the served version again changes nothing.

    Args:
        session: The caller's transaction.
        policy: The version.
        actor: The user who releases it.
        constant_turn_deg: The turn of the demonstration beyond which the joint limits must have been checked with it.

    Raises:
        Conflict: It does not pass, with the reasons; its demonstration was withdrawn, or marked recovery or failure; or
            the surgeon's consent does not cover training.
        Corrupt: The stored policy does not match its digest.
    """
    consent.require(policy.surgeon, "training")
    learnt(policy)
    served = in_force(session, policy.surgeon_row, policy.suture)
    if served and served[0].policy_row == policy.row:
        return served[0]
    _refuse(session, policy, served[0].policy if served else None, constant_turn_deg)
    return _add(session, [policy], actor)[0]


def _refuse(session: Session, policy: PolicyVersion, served: PolicyVersion | None, constant_turn_deg: float) -> None:
    """Refuse the release of a version that does not pass the gate; see `release`."""
    reasons = [*policy.manifest.grid_certificate.refused_because, *changed_demonstrations(policy)]
    reasons += _held(policy, constant_turn_deg)
    # Only phased policies have to reproduce their demonstration; one of the cell state must at least not be worse.
    if policy.manifest.phases == 1 and served is not None:
        fit = compare_versions(session, served, policy)
        if not not_worse(fit):
            text = (
                "it follows the demonstrations worse than the released one "
                f"({format_mm(fit.trained_mm)} against {format_mm(fit.released_mm)} mm on the same {len(fit.demos)})"
            )
            reasons.append(GateRefusal("worse", text))
    if reasons or not policy.releasable:
        text = f"Version {policy.version} cannot be released: {join_reasons(reasons)}."
        raise Conflict(text, remedy(reasons), reasons=[one.text for one in reasons])


def _add(session: Session, policies: Sequence[PolicyVersion], actor: str) -> list[Release]:
    """Add the releases of versions that pass the gate, with a few statements for all of them."""
    released = [
        Release(policy=one, surgeon_row=one.surgeon_row, suture=one.suture, released_by=actor) for one in policies
    ]
    session.add_all(released)
    record_events(session, actor, "release", "policy-version", [(one.sha256, one.surgeon) for one in policies])
    session.flush()
    announce(session)
    return released


class Released(NamedTuple):
    """The effect of a request for a release: whether it was made, else the reason and the remedy."""

    released: bool
    not_released_because: str | None
    remedy: str | None


NOT_REQUESTED = Released(False, None, None)


def try_release(session: Session, policy: PolicyVersion, actor: str, constant_turn_deg: float) -> Released:
    """Release a policy version if it passes the gate, as `release` does; return why it was not released."""
    if (without := consent.refusal(policy.surgeon, "training")) is not None:
        return Released(False, without.words(), remedy([GateRefusal("consent", without.message)]))
    try:
        release(session, policy, actor, constant_turn_deg=constant_turn_deg)
    except Conflict as refused:
        return Released(False, refused.message, " ".join(refused.advice(None)))
    return Released(True, None, None)


def release_new(
    session: Session, policies: Mapping[int, PolicyVersion | None], actor: str, constant_turn_deg: float
) -> dict[int, Released]:
    """Release versions that this transaction has stored, as `try_release` does, with a few statements for all of them.

    Args:
        session: The caller's transaction. It made the versions, so neither they nor consent are verified again.
        policies: By the row of each version, of different styles, the version that its style serves.
        actor: The user who releases them.
        constant_turn_deg: As in `release`.
    """
    found, passed = dict.fromkeys(policies, Released(True, None, None)), []
    query = select(PolicyVersion).where(PolicyVersion.row.in_(policies))
    for one in session.scalars(
        query.options(selectinload(PolicyVersion.demonstration), selectinload(PolicyVersion.others))
    ):
        try:
            _refuse(session, one, policies[one.row], constant_turn_deg)
            passed.append(one)
        except Conflict as refused:
            found[one.row] = Released(False, refused.message, " ".join(refused.advice(None)))
    _add(session, passed, actor)
    return found


def changed_demonstrations(policy: PolicyVersion) -> list[GateRefusal]:
    """Return the reasons against a release of a version whose demonstration was withdrawn or marked since."""
    return [GateRefusal(change.kind, f"its demonstration {change.text}") for change in policy.objections]


def _held(policy: PolicyVersion, constant_turn_deg: float) -> list[GateRefusal]:
    """Return the reason against a version whose joint limits were checked with the jaw held, though it was turned."""
    driven = policy.manifest.grid_certificate.driven
    if driven is None or driven.orientation == "recorded":
        return []
    if driven.orientation == "assumed tool-down" and policy.manifest.combined is None:
        return []  # its demonstration has no orientation, so it does not have to be read
    turns_deg = [turn.deg for one in policy.demonstrations if (turn := departure_of(one.demo)) is not None]
    if all(deg <= constant_turn_deg for deg in turns_deg):  # each, because `max` passes over a NaN
        return []
    text = (
        f"its joint limits were checked with the jaw held, but its demonstration turns by {max(turns_deg):.1f} "
        f"degrees, over {constant_turn_deg:g}, and a plan turns too; train it again"
    )
    return [GateRefusal("jaw held", text)]


def withdraw(session: Session, surgeon: Surgeon, suture: str, actor: str) -> list[Release]:
    """Withdraw all releases of a style, so that nothing is served until somebody releases again; return them.

    Raises:
        NotFound: Nothing of the style is released.
    """
    releases = list(in_force(session, surgeon.row, suture))
    if not releases:
        raise NotFound(f"No policy of '{surgeon.slug}' and '{suture}' is released.")
    _withdraw(session, releases, actor)
    return releases


def withdraw_all(session: Session, surgeon: Surgeon, actor: str) -> list[Release]:
    """Withdraw all releases of all styles of a surgeon, and return them."""
    mine = select(Release).where(Release.surgeon_row == surgeon.row, Release.withdrawn_at.is_(None))
    releases = list(session.scalars(mine.order_by(Release.row)))
    _withdraw(session, releases, actor)
    return releases


def withdraw_resting_on(
    session: Session, demonstration: Demonstration, actor: str, *, marked: bool = False
) -> list[Release]:
    """Withdraw the releases learnt from a demonstration; if the served one is among them, all of the style.

    Args:
        session: The caller's transaction.
        demonstration: It is withdrawn or erased, or was marked recovery or failure.
        actor: The actor of the events.
        marked: It was marked: the releases of versions that were trained from any outcome stay.
    """
    releases = in_force(session, demonstration.surgeon_row, demonstration.suture)
    resting = [one for one in releases if demonstration in one.policy.demonstrations]
    ending = [one for one in resting if not (marked and one.policy.of_any_outcome)]
    withdrawn = _with_superseded(releases, ending)
    _withdraw(session, withdrawn, actor)
    return withdrawn


def withdraw_policies(session: Session, ended: Mapping[str, datetime], actor: str) -> None:
    """Withdraw releases of policies that ended later; if a served one is among them, all releases of its style.

    Args:
        session: The caller's transaction.
        ended: By the policy's SHA-256, the moment of its end; a release after that moment stays.
        actor: The actor of the events.
    """
    query = select(Release, PolicyVersion.sha256).join(PolicyVersion, PolicyVersion.row == Release.policy_row)
    found = session.execute(query.where(Release.withdrawn_at.is_(None)))
    over = [one for one, sha256 in found if sha256 in ended and one.released_at <= ended[sha256]]
    for style in sorted({(one.surgeon_row, one.suture) for one in over}):
        releases = in_force(session, *style)
        _withdraw(session, _with_superseded(releases, [one for one in releases if one in over]), actor)


def _with_superseded(releases: Sequence[Release], ending: list[Release]) -> list[Release]:
    """Return the ending releases, or all releases of the style if the served one is among them, the newest first."""
    return list(releases) if releases and releases[0] in ending else ending


def _withdraw(session: Session, releases: Sequence[Release], actor: str) -> None:
    for one in releases:
        one.withdrawn_at = now()
        record_event(session, actor, "withdraw", "policy-version", one.policy.sha256, one.policy.surgeon)
    session.flush()
    announce(session)
