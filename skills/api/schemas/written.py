"""What goes out, written from rows; `given` says what each is."""

from dataclasses import asdict
from typing import Any

import numpy as np

from skills.db import books
from skills.db import models as rows
from skills.db.base import rfc3339 as at


def surgeon_out(row: rows.Surgeon) -> dict[str, Any]:
    """Write a surgeon."""
    return {
        "surgeon": row.slug,
        "skill_level": row.skill_level,
        "handedness": row.handedness,
        "protocol": row.protocol,
        "consent": row.consent,
        "created_at": at(row.created_at),
    }


def suture_out(row: rows.SutureType) -> dict[str, Any]:
    """Write a suture type."""
    return {
        "suture": row.slug,
        "name": row.name,
        "also_called": row.also_called,
        "family": row.family,
        "description": row.description,
    }


def recording_out(row: rows.StoredRecording) -> dict[str, Any]:
    """Write a recording."""
    return {
        "id": row.sha256,
        "sha256": row.sha256,
        "size_bytes": row.size_bytes,
        "media_type": row.media_type,
        "format": row.format,
        "integrity": row.integrity,
        **row.about,
        "created_at": at(row.created_at),
    }


def demo_out(row: rows.Demonstration) -> dict[str, Any]:
    """Write a demonstration."""
    return {
        "id": row.sha256,
        "sha256": row.sha256,
        "recording": row.recording.sha256,
        "surgeon": row.surgeon.slug,
        "suture": row.suture,
        "arm": row.arm,
        "topic": row.topic,
        "frame": row.frame,
        "instrument": row.instrument,
        "start_s": row.start_s,
        "end_s": row.end_s,
        "session": row.session,
        "hysteresis": row.hysteresis,
        "state": "active" if row.withdrawn_at is None else "withdrawn",
        "report": row.report,
        "created_at": at(row.created_at),
        "withdrawn_at": at(row.withdrawn_at),
    }


def path_out(row: rows.Demonstration) -> dict[str, Any]:
    """Write a demonstration's path."""
    path, recorded = row.path, row.demo
    return {
        "demo": row.sha256,
        "frame": row.frame,
        "grid": row.report["grid"],
        "hysteresis": path.hysteresis,
        "states": path.states.tolist(),
        "path_mm": path.tip_mm.tolist(),
        "stamps_s": recorded.stamps_s.tolist(),
        "recorded_mm": recorded.tip_mm.tolist(),
    }


def reward_map_out(row: rows.Demonstration, kept: rows.StoredRewardMap) -> dict[str, Any]:
    """Write the rewards of a demonstration that are not `other`."""
    rewards, levels = kept.map.rewards, kept.map.levels
    special = np.flatnonzero(rewards != levels.other)
    return {
        "demo": row.sha256,
        "sha256": kept.sha256,
        "grid": row.report["grid"],
        "levels": asdict(levels),
        "states": special.tolist(),
        "rewards": rewards[special].tolist(),
    }


def job_out(row: books.Job) -> dict[str, Any]:
    """Write a job."""
    return {
        "id": row.id,
        "kind": row.kind,
        "state": row.state,
        "progress": row.progress,
        "request": row.request,
        "result": row.result,
        "error": row.error,
        "created_at": at(row.created_at),
        "started_at": at(row.started_at),
        "ended_at": at(row.ended_at),
    }


def retrained_out(row: books.StyleToRetrain) -> dict[str, Any]:
    """Write what became of one style of a batch."""
    return {
        "surgeon": row.demonstration.surgeon.slug,
        "suture": row.demonstration.suture,
        "demo": row.demonstration.sha256,
        "stale_because": row.stale,
        "state": row.state,
        "reason": row.reason,
        "policy_version": row.policy and row.policy.version,
        "sha256": row.policy and row.policy.sha256,
        "comparison": row.comparison,
        "ended_at": at(row.ended_at),
    }


def plan_out(row: rows.Plan) -> dict[str, Any]:
    """Write a plan."""
    return {
        "id": row.sha256,
        "sha256": row.sha256,
        "surgeon": row.policy.surgeon.slug,
        "suture": row.policy.suture,
        "policy": {"version": row.policy.version, "sha256": row.policy.sha256},
        **row.about,
        "created_at": at(row.created_at),
    }


def playback_out(row: rows.StoredPlayback) -> dict[str, Any]:
    """Write a playback; all of its pictures but the first are drawn after the verdict."""
    here = f"/playbacks/{row.sha256}"
    return {
        "id": row.sha256,
        "sha256": row.sha256,
        "plan": row.plan.sha256,
        "feasible": row.feasible,
        "report": row.report,
        "picture": f"{here}/picture.png",
        "pictures": {
            "picture": f"{here}/picture.png",
            "animation_mp4": f"{here}/animation.mp4",
            "animation_gif": f"{here}/animation.gif",
            "joints": f"{here}/joints.png",
            "clearance": f"{here}/clearance.png",
        },
        "created_at": at(row.created_at),
    }


def version_out(row: rows.PolicyVersion) -> dict[str, Any]:
    """Write a line of a style's history."""
    return {
        "version": row.version,
        "sha256": row.sha256,
        "learner": row.manifest["learner"],
        "demos": row.manifest["demos"],
        "seed": row.manifest["seed"],
        "metrics": row.manifest["metrics"],
        "coverage": row.manifest["coverage"],
        "releasable": row.releasable,
        "created_at": at(row.created_at),
    }


def summary_out(row: rows.Release) -> dict[str, Any]:
    """Write a policy version that is released."""
    return {
        "surgeon": row.policy.surgeon.slug,
        "suture": row.suture,
        "released_at": at(row.released_at),
        "released_by": row.released_by,
        **version_out(row.policy),
    }
