"""Answers about policy versions: the policy as JSON and as arrays, its place in the history, and rollouts."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from skills.db import rfc3339
from skills.db.models import PolicyVersion, Release
from skills.gridworld.domain import FINISHED, OUTSIDE
from skills.learning.evaluation import dtw
from skills.learning.policy import Policy, rollout
from skills.library.operation.integrity import covered, learnt
from skills.schemas.policies import Rollout

MAX_JSON_ACTIONS = 10**6  # ours: above it, JSON has the certified domain alone, in `live_actions`


def policy_json(policy: PolicyVersion, release: Release | None) -> dict[str, Any]:
    """Return the JSON of a policy version (`schemas.policies.Policy`), with its actions but without a link to arrays.

    Args:
        policy: The version.
        release: Its release; None: as a version of the style's history.

    Raises:
        Corrupt: The stored values do not match the version's digest.
    """
    actions = actions_of(learnt(policy))
    live = live_actions_of(learnt(policy))
    return {
        "version": policy.version,
        "sha256": policy.sha256,
        **policy.manifest,
        "created_at": rfc3339(policy.created_at),
        "released_at": rfc3339(release.released_at) if release else None,
        "released_by": release.released_by if release else None,
        table_name(policy.manifest, "actions"): actions,
        **({} if live is None else {table_name(policy.manifest, "live_actions"): live}),
    }


def table_name(manifest: dict[str, Any], name: str) -> str:
    """Return the name under which a policy's actions are served: another one in a format with a joining table.

    A client that does not know the joining table then finds no actions, and cannot follow them by the wrong rule.

    Args:
        manifest: The policy's manifest.
        name: The name in the first format.
    """
    return f"{name}_joining" if "joining" in manifest else name


def actions_of(policy: Policy) -> list[list[int]] | None:
    """Return the greedy actions as JSON, by phase and state; None if there are more than `MAX_JSON_ACTIONS`."""
    if policy.domain.phases * policy.path.grid.n_states > MAX_JSON_ACTIONS:
        return None
    table: list[list[int]] = policy.table().tolist()
    return table


def live_actions_of(policy: Policy) -> list[dict[str, list[int]]] | None:
    """Return the greedy actions of the certified domain as JSON (`schemas.policies.PhaseActions`), by phase.

    There are at most `skills.learning.policy.MAX_BYTES` / `BYTES_A_ROW` actions, 7 million; a larger policy cannot be
    learnt.

    Returns:
        None where `actions_of` returns the actions of all states.
    """
    domain = policy.domain
    if domain.phases * policy.path.grid.n_states <= MAX_JSON_ACTIONS:
        return None
    of_phases = np.split(policy.greedy, domain.offset[1:-1])
    return [
        {"low": low, "size": size, "actions": actions.tolist()}
        for low, size, actions in zip(domain.low.tolist(), domain.size.tolist(), of_phases, strict=True)
    ]


def arrays_of(version: PolicyVersion) -> bytes:
    """Return a policy's arrays as the bytes of an .npz, Q values and confidence on the certified domain only.

    The grid is in it, so that the file alone runs the policy (docs/running.md). If the policy has a network, `network`
    holds the bytes of its safetensors file. By another joining rule than the nearest waypoint there are `format` and
    `joins`, (n_states,), the phase after starting in a state or moving onto it in phase 0; and `action` is called
    `action_joining`, see `table_name`. If it was learnt in a scene, `finishing` and `touching`, (n_states,), are the
    odds of each start.
    """
    policy, coverage, manifest = learnt(version), covered(version), version.manifest
    domain, grid = policy.domain, policy.path.grid
    kept = domain.certified
    out = io.BytesIO()
    learnt_too: dict[str, Any] = {}
    if policy.network is not None:
        learnt_too["network"] = np.frombuffer(policy.network.tensors, np.uint8)
    if coverage.finishing is not None and coverage.touching is not None:
        learnt_too |= {"finishing": coverage.finishing, "touching": coverage.touching}
    if "joining" in manifest:
        learnt_too |= {"format": np.int32(manifest["format"]), "joins": domain.joins.astype(np.int32)}
    np.savez_compressed(
        out,
        sha256=np.frombuffer(bytes.fromhex(version.sha256), np.uint8),
        phase=domain.phase_of[kept].astype(np.int32),
        state=domain.state_of[kept].astype(np.int32),
        **{table_name(manifest, "action"): policy.greedy[kept]},  # type: ignore[arg-type]
        q=policy.q[kept],
        confidence=policy.confidence[kept],
        waypoints=policy.path.states,
        reaches_goal=coverage.reaches,
        joins_nearest=coverage.joins_nearest,
        share=coverage.share,
        origin_mm=np.array(grid.origin_mm),
        cell_mm=np.float64(grid.cell_mm),
        shape=np.array(grid.shape, np.int64),
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
    tip, odds = followed.tip_mm, covered(policy) if "scene" in policy.manifest else None
    start = int(followed.states[0])
    return Rollout(
        version=policy.version,
        sha256=policy.sha256,
        frame=policy.manifest["frame"],
        states=followed.states.tolist(),
        phases=followed.phases.tolist(),
        path_mm=tip.tolist(),
        finished=followed.finished,
        dtw_total_mm=dtw(tip, following.path.tip_mm).total_mm,
        finishing=None if odds is None or odds.finishing is None else float(odds.finishing[start]),
        touching=None if odds is None or odds.touching is None else float(odds.touching[start]),
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
