"""Policies of a style: the served version, the history, rollouts, and the arrays for a client."""

import io
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.base import rfc3339
from skills.db.models import PolicyVersion, Release
from skills.errors import NotFound
from skills.gridworld.domain import FINISHED, OUTSIDE
from skills.learning.evaluation import dtw
from skills.learning.policy import Policy, rollout
from skills.library import consent, integrity, releases
from skills.library.catalogue import find_surgeon, find_suture_type
from skills.library.integrity import covered, learnt
from skills.remedies import Action, Remedy
from skills.schemas.policies import Rollout

MAX_JSON_ACTIONS = 10**6  # interface.md: above it, JSON has null and a link to the arrays


@dataclass(frozen=True)
class Served:
    """The policy version that a style serves, and its release."""

    policy: PolicyVersion
    release: Release


def policy_of(session: Session, surgeon: str, suture: str) -> Served:
    """Return the policy version that a style serves.

    Raises:
        NotFound: The surgeon or suture type is unknown, or nothing is served; the error then lists the candidates.
    """
    who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)
    served = releases.served(session, who, what.slug)
    if served is not None:
        return Served(served.policy, served)
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
    return policy_of(session, surgeon, suture).policy


def followable(policy: PolicyVersion) -> PolicyVersion:
    """Return a policy version that may be followed, released or not.

    Raises:
        Conflict: The surgeon's consent does not cover training (any more).
    """
    consent.require(policy.surgeon, "training")
    return policy


def about_policy(policy: PolicyVersion, release: Release | None) -> dict[str, Any]:
    """Return the JSON of a policy (interface.md) without its actions."""
    return {
        "version": policy.version,
        "sha256": policy.sha256,
        **policy.manifest,
        "created_at": rfc3339(policy.created_at),
        "released_at": rfc3339(release.released_at) if release else None,
        "released_by": release.released_by if release else None,
    }


def actions_of(policy: Policy) -> list[list[int]] | None:
    """Return the greedy actions as JSON, by phase and state; None if there are more than `MAX_JSON_ACTIONS`."""
    if policy.domain.phases * policy.path.grid.n_states > MAX_JSON_ACTIONS:
        return None
    table: list[list[int]] = policy.table().tolist()
    return table


def arrays_of(version: PolicyVersion) -> bytes:
    """Return a policy's arrays as the bytes of an .npz, Q values and confidence on the certified domain only.

    If the policy has a network, `network` holds the bytes of its safetensors file.
    """
    policy, coverage = learnt(version), covered(version)
    domain = policy.domain
    kept = domain.certified
    out = io.BytesIO()
    learnt_too: dict[str, Any] = {}
    if policy.network is not None:
        learnt_too["network"] = np.frombuffer(policy.network.tensors, np.uint8)
    np.savez_compressed(
        out,
        sha256=np.frombuffer(bytes.fromhex(version.sha256), np.uint8),
        phase=domain.phase_of[kept].astype(np.int32),
        state=domain.state_of[kept].astype(np.int32),
        action=policy.greedy[kept],
        q=policy.q[kept],
        confidence=policy.confidence[kept],
        waypoints=policy.path.states,
        reaches_goal=coverage.reaches,
        joins_nearest=coverage.joins_nearest,
        finished=np.int8(FINISHED),
        outside=np.int8(OUTSIDE),
        **learnt_too,
    )
    return out.getvalue()


def about_rollout(policy: PolicyVersion, start_mm: Sequence[float]) -> Rollout:
    """Return a rollout from a position in mm, in the frame of the policy.

    Raises:
        OutsideGrid: The position is not in the grid.
    """
    following = learnt(policy)
    followed = rollout(following, np.asarray(start_mm, float))
    tip = followed.tip_mm
    return Rollout(
        version=policy.version,
        sha256=policy.sha256,
        frame=policy.manifest["frame"],
        states=followed.states.tolist(),
        phases=followed.phases.tolist(),
        path_mm=tip.tolist(),
        finished=followed.finished,
        dtw_total_mm=dtw(tip, following.path.tip_mm).total_mm,
    )


def version_json(row: PolicyVersion) -> dict[str, Any]:
    """Return the JSON of a policy version in a style's history."""
    return {
        "version": row.version,
        "sha256": row.sha256,
        "learner": row.manifest["learner"],
        "demos": row.manifest["demos"],
        "seed": row.manifest["seed"],
        "metrics": row.manifest["metrics"],
        "coverage": row.manifest["coverage"],
        "releasable": row.releasable,
        "created_at": rfc3339(row.created_at),
    }


def summary_json(row: Release) -> dict[str, Any]:
    """Return the JSON of a released policy version."""
    return {
        "surgeon": row.policy.surgeon.slug,
        "suture": row.suture,
        "released_at": rfc3339(row.released_at),
        "released_by": row.released_by,
        **version_json(row.policy),
    }
