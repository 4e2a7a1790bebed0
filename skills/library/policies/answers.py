"""Answers about policy versions: the policy as JSON and as arrays, its place in the history, and rollouts."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skills.db.models import PolicyVersion, Release
from skills.gridworld.domain import FINISHED, OUTSIDE
from skills.learning.evaluation import dtw
from skills.learning.policy import rollout
from skills.library.operation.integrity import covered, learnt
from skills.schemas import policies as schemas
from skills.schemas.policies import PolicySummary, Rollout, Version
from skills.schemas.policy_document import actions_of, live_actions_of


def describe_policy(version: PolicyVersion, release: Release | None, arrays: str) -> schemas.Policy:
    """Return a policy version with its actions.

    Args:
        version: The version.
        release: Its release; None: as a version of the style's history.
        arrays: Where its arrays are.

    Raises:
        Corrupt: The stored values do not match the version's digest.
    """
    policy = learnt(version)
    return schemas.Policy.model_construct(  # of verified values: checking a million actions takes longer than all else
        **dict(version.manifest),
        version=version.version,
        sha256=version.sha256,
        created_at=version.created_at,
        released_at=release.released_at if release else None,
        released_by=release.released_by if release else None,
        actions=actions_of(policy),
        live_actions=live_actions_of(policy),
        arrays=arrays,
    )


def arrays_of(version: PolicyVersion) -> bytes:
    """Return a policy's arrays as the bytes of an .npz, Q values and confidence on the certified domain only.

    The grid is in it, so that the file alone runs the policy (docs/running.md). If the policy has a network, `network`
    holds the bytes of its safetensors file. By another joining rule than the nearest waypoint there is `joins`,
    (n_states,), the phase after starting in a state or moving onto it in phase 0. If it was learnt in a scene,
    `finishing` and `touching`, (n_states,), are the odds of each start.
    """
    policy, coverage = learnt(version), covered(version)
    domain, grid = policy.domain, policy.path.grid
    certified = domain.certified
    optional: dict[str, NDArray[Any]] = {}
    if policy.network is not None:
        optional["network"] = np.frombuffer(policy.network.tensors, np.uint8)
    if coverage.finishing is not None and coverage.touching is not None:
        optional |= {"finishing": coverage.finishing, "touching": coverage.touching}
    if version.manifest.joining is not None:
        optional["joins"] = domain.joins.astype(np.int32)
    out = io.BytesIO()
    np.savez_compressed(
        out,
        sha256=np.frombuffer(bytes.fromhex(version.sha256), np.uint8),
        phase=domain.phase_of[certified].astype(np.int32),
        state=domain.state_of[certified].astype(np.int32),
        action=policy.greedy[certified],
        q=policy.q[certified],
        confidence=policy.confidence[certified],
        waypoints=policy.path.states,
        reaches_goal=coverage.reaches,
        joins_nearest=coverage.joins_nearest,
        share=coverage.share,
        origin_mm=np.array(grid.origin_mm),
        cell_mm=np.float64(grid.cell_mm),
        shape=np.array(grid.shape, np.int64),
        finished=np.int8(FINISHED),
        outside=np.int8(OUTSIDE),
        **optional,  # type: ignore[arg-type]
    )
    return out.getvalue()


def roll_out(version: PolicyVersion, start_mm: Sequence[float]) -> Rollout:
    """Return a rollout from a position in mm, in the frame of the policy.

    Raises:
        OutsideGrid: The position is not in the grid.
    """
    policy = learnt(version)
    followed = rollout(policy, np.asarray(start_mm, float))
    tip, odds = followed.tip_mm, covered(version) if policy.surroundings is not None else None
    start = int(followed.states[0])
    return Rollout(
        version=version.version,
        sha256=version.sha256,
        frame=version.manifest.frame,
        states=followed.states.tolist(),
        phases=followed.phases.tolist(),
        path_mm=tip.tolist(),
        finished=followed.finished,
        dtw_total_mm=dtw(tip, policy.path.tip_mm).total_mm,
        finishing=None if odds is None or odds.finishing is None else float(odds.finishing[start]),
        touching=None if odds is None or odds.touching is None else float(odds.touching[start]),
    )


def summarise(release: Release) -> PolicySummary:
    """Return the summary of a released policy version."""
    return PolicySummary(
        **dict(Version.model_validate(release.policy)),
        surgeon=release.policy.surgeon.slug,
        suture=release.suture,
        released_at=release.released_at,
        released_by=release.released_by,
    )
