"""Policies of a style: which is served, its history, what it does from a place, and its numbers for a client."""

import io
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import exists, select
from sqlalchemy.orm import Session, aliased

from skills.db.base import rfc3339
from skills.db.models import PolicyVersion, Release
from skills.errors import NotFound
from skills.library import releases
from skills.library.catalogue import find_surgeon, find_suture_type
from skills.library.verified import covered, learnt
from skills.style.domain import FINISHED, OUTSIDE
from skills.style.evaluation import dtw
from skills.style.policy import Policy, rollout

MAX_JSON_ACTIONS = 10**6  # interface.md: above it JSON has null and a link to the arrays


@dataclass(frozen=True)
class Served:
    """The policy version that a style serves, and its release."""

    policy: PolicyVersion
    release: Release


def policy_of(session: Session, surgeon: str, suture: str) -> Served:
    """Find what is served for a style.

    Raises:
        NotFound: The surgeon or suture type is unknown, or nothing is released; then with the candidates.
    """
    who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)
    standing = releases.standing(session, who.row, what.slug)
    if standing:
        return Served(standing[0].policy, standing[0])
    versions = list_versions(session, surgeon, suture, limit=20)
    if not versions:
        raise NotFound(
            f"Nothing was trained for '{surgeon}' and '{suture}'; POST /trainings with release true does it.",
            candidates=[],
        )
    raise NotFound(
        f"No policy of '{surgeon}' and '{suture}' is released; POST /policies/{surgeon}/{suture}/versions/N/release "
        "releases one.",
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
    """List what is served, one release per style, in the order of release: all, or of a surgeon, or a suture type."""
    later = aliased(Release)
    superseded = exists().where(
        later.surgeon_row == Release.surgeon_row,
        later.suture == Release.suture,
        later.row > Release.row,
        later.withdrawn_at.is_(None),
    )
    query = select(Release).where(Release.row > (after or 0), Release.withdrawn_at.is_(None), ~superseded)
    if surgeon is not None:
        query = query.where(Release.surgeon_row == find_surgeon(session, surgeon).row)
    if suture is not None:
        query = query.where(Release.suture == find_suture_type(session, suture).slug)
    return session.scalars(query.order_by(Release.row).limit(limit)).all()


def find_version(session: Session, surgeon: str, suture: str, version: int) -> PolicyVersion:
    """Find one version of a style."""
    who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)
    policy = session.scalar(
        select(PolicyVersion).where(
            PolicyVersion.surgeon_row == who.row,
            PolicyVersion.suture == what.slug,
            PolicyVersion.version == version,
        )
    )
    if policy is None:
        raise NotFound(f"'{surgeon}' and '{suture}' have no version {version}.")
    return policy


def find_by_digest(session: Session, policy_sha256: str) -> PolicyVersion:
    """Find a policy version by its digest, as it is cited."""
    policy = session.scalar(select(PolicyVersion).where(PolicyVersion.sha256 == policy_sha256))
    if policy is None:
        raise NotFound("There is no policy version of this digest.")
    return policy


def missing(session: Session, policies: Collection[str]) -> set[str]:
    """Tell which of some policy versions, by digest, are not there (any more)."""
    found = session.scalars(select(PolicyVersion.sha256).where(PolicyVersion.sha256.in_(policies)))
    return set(policies) - set(found)


def choose(session: Session, surgeon: str, suture: str, version: int | None) -> PolicyVersion:
    """Find the version asked for, or what is served."""
    if version is not None:
        return find_version(session, surgeon, suture, version)
    return policy_of(session, surgeon, suture).policy


def about_policy(policy: PolicyVersion, release: Release | None) -> dict[str, Any]:
    """Write a policy as a client is told of it (interface.md), but for its actions."""
    return {
        "version": policy.version,
        "sha256": policy.sha256,
        **policy.manifest,
        "created_at": rfc3339(policy.created_at),
        "released_at": rfc3339(release.released_at) if release else None,
        "released_by": release.released_by if release else None,
    }


def actions_of(policy: Policy) -> list[list[int]] | None:
    """Write the greedy actions for JSON, or None where they are too many."""
    if policy.domain.phases * policy.path.grid.n_states > MAX_JSON_ACTIONS:
        return None
    table: list[list[int]] = policy.table().tolist()
    return table


def arrays_of(version: PolicyVersion) -> bytes:
    """Write a policy's arrays as an .npz, its Q values and confidence on the certified domain only.

    Where a network was learnt, `network` holds the bytes of its safetensors file.
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


def about_rollout(policy: PolicyVersion, start_mm: Sequence[float]) -> dict[str, Any]:
    """Roll a policy out from a place, in mm of its frame.

    Raises:
        OutsideGrid: The place is not in the grid.
    """
    following = learnt(policy)
    followed = rollout(following, np.asarray(start_mm, float))
    tip = followed.tip_mm
    return {
        "version": policy.version,
        "sha256": policy.sha256,
        "frame": policy.manifest["frame"],
        "states": followed.states.tolist(),
        "phases": followed.phases.tolist(),
        "path_mm": tip.tolist(),
        "finished": followed.finished,
        "dtw_total_mm": dtw(tip, following.path.tip_mm).total_mm,
    }
