"""Policy versions of a style: the served one, the history, and finding one."""

from collections.abc import Collection, Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session, selectinload

from skills.db.models import PolicyVersion, Release
from skills.errors import NotFound
from skills.library.operation import integrity
from skills.library.people import consent
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.library.policies import releases
from skills.remedies import Action, Remedy


def served_release(session: Session, surgeon: str, suture: str) -> Release:
    """Return the release of the policy version that a style serves.

    Raises:
        NotFound: The surgeon or suture type is unknown, or nothing is served; the error then lists the candidates.
        Corrupt: Its release, its version or its surgeon was changed by others than the service.
    """
    who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)
    served = releases.served(session, who, what.slug)
    if served is not None:
        releases.refuse_edited_release(session, served)
        return served
    # Without candidates: no version of this surgeon may be released.
    refused = consent.refusal(who, "training")
    if refused is not None:
        raise NotFound(f"No policy of '{surgeon}' and '{suture}' is served. {refused}", candidates=[])
    versions = list_versions(session, surgeon, suture, limit=20)
    if not versions:
        raise NotFound(
            f"No policy of '{surgeon}' and '{suture}' was trained.",
            Remedy(Action.TRAIN, surgeon=surgeon, suture=suture),
            candidates=[],
        )
    # The newest version that may be released, for the remedy.
    best = next((one.version for one in versions if one.releasable), None)
    raise NotFound(
        f"No policy of '{surgeon}' and '{suture}' is released.",
        Remedy(Action.LIST_VERSIONS, surgeon=surgeon, suture=suture),
        *([Remedy(Action.RELEASE, surgeon=surgeon, suture=suture, version=best)] if best is not None else []),
        candidates=[{"version": v.version, "sha256": v.sha256, "releasable": v.releasable} for v in versions],
    )


def list_versions(
    session: Session, surgeon: str, suture: str, limit: int, before: int | None = None
) -> Sequence[PolicyVersion]:
    """List the versions of a style, the newest first."""
    who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)
    query = select(PolicyVersion).where(PolicyVersion.surgeon_row == who.row, PolicyVersion.suture == what.slug)
    if before is not None:
        query = query.where(PolicyVersion.version < before)
    return session.scalars(query.order_by(PolicyVersion.version.desc()).limit(limit)).all()


def list_served(
    session: Session, limit: int, after: int | None, surgeon: str | None = None, suture: str | None = None
) -> Sequence[Release]:
    """List the served releases, one for each style, in the order of release.

    Args:
        session: The caller's transaction.
        limit: The length of the page.
        after: The row of the last release of the page before.
        surgeon: List only those of this surgeon.
        suture: List only those of this suture type.
    """
    query = select(Release).where(Release.row > (after or 0), releases.is_served())
    if surgeon is not None:
        query = query.where(Release.surgeon_row == find_surgeon(session, surgeon).row)
    if suture is not None:
        query = query.where(Release.suture == find_suture_type(session, suture).slug)
    # The versions of the whole page with one statement more; a join would make SQLite read all of them.
    query = query.options(selectinload(Release.policy))
    return session.scalars(query.order_by(Release.row).limit(limit)).all()


def find_version(session: Session, surgeon: str, suture: str, version: int) -> PolicyVersion:
    """Return one version of a style."""
    who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)
    policy = session.scalar(
        select(PolicyVersion).where(
            PolicyVersion.surgeon_row == who.row,
            PolicyVersion.suture == what.slug,
            PolicyVersion.version == version,
        )
    )
    if policy is None:
        raise NotFound(
            f"'{surgeon}' and '{suture}' have no version {version}.",
            Remedy(Action.LIST_VERSIONS, surgeon=surgeon, suture=suture),
        )
    return policy


def find_by_digest(session: Session, policy_sha256: str) -> PolicyVersion:
    """Return a policy version by its digest, the identifier used in citations."""
    return integrity.find_by_digest(session, PolicyVersion, policy_sha256, "policy version")


def missing(session: Session, policies: Collection[str]) -> set[str]:
    """Return those of some policy versions, by digest, that are not in the database (any more)."""
    found = session.scalars(select(PolicyVersion.sha256).where(PolicyVersion.sha256.in_(policies)))
    return set(policies) - set(found)


def choose(session: Session, surgeon: str, suture: str, version: int | None) -> PolicyVersion:
    """Return the requested version, or the served one if `version` is None.

    Raises:
        NotFound: There is no such version, or nothing is served.
        Conflict: The surgeon's consent does not cover training.
    """
    if version is not None:
        return followable(find_version(session, surgeon, suture, version))
    return served_release(session, surgeon, suture).policy


def followable(policy: PolicyVersion) -> PolicyVersion:
    """Return a policy version that may be followed, released or not.

    Raises:
        Conflict: The surgeon's consent does not cover training (any more).
    """
    consent.require(policy.surgeon, "training")
    return policy
