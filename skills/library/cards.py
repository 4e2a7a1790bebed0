"""The policy card: all there is to say of one policy version, as a document to attach to a paper.

    PolicyVersion --card_of--> Card: its facts as plain JSON, and the values that its pictures are drawn from

A card is written from verified values alone: before a word of it is written every digest on it is computed again, the
recording's over its bytes. It holds nothing of when or by whom it was asked for: the same state gives the same bytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from skills import __version__
from skills.db.base import rfc3339 as at
from skills.db.models import (
    Demonstration,
    Plan,
    PolicyVersion,
    Release,
    StoredPlayback,
    StoredRewardMap,
    Surgeon,
    SutureType,
)
from skills.db.packed import digest
from skills.errors import Corrupt
from skills.library import card_words as words
from skills.library import releases
from skills.library.catalogue import find_suture_type
from skills.library.combined import combined_of, learnt_from
from skills.library.demos import full_report
from skills.library.inspection import AGREES
from skills.library.verified import covered, learnt, what_identifies
from skills.style.certificate import Coverage
from skills.style.combining import Combined
from skills.style.demo import Demo
from skills.style.doubt import CALIBRATED_MM, UNCALIBRATED_MM
from skills.style.grid import GridPath
from skills.style.reward import sparse_reward

FORMAT = 1  # of the JSON: raise it when a field goes or means something else
Facts = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Card:
    """What is said of a policy version, and for the pictures what it was learnt from, its path and its coverage."""

    facts: Facts
    demo: Demo
    path: GridPath
    coverage: Coverage
    combined: Combined | None


def card_of(session: Session, version: PolicyVersion) -> Card:
    """Write the card of a policy version.

    Raises:
        Corrupt: Something on the card, or that it rests on, is not what its digest was taken of.
    """
    demonstrations = version.demonstrations
    of_them = StoredRewardMap.demonstration_row.in_([one.row for one in demonstrations])
    rewards = session.scalars(select(StoredRewardMap).where(of_them)).all()
    released = session.scalars(select(Release).where(Release.policy_row == version.row).order_by(Release.row)).all()
    recordings = {one.recording.row: one.recording for one in demonstrations}.values()
    _refuse_damaged([*recordings, *demonstrations, *rewards, version, *released])
    coverage, demo, combined = covered(version), learnt_from(version), _combined(version)
    facts: Facts = {
        "format": FORMAT,
        "written_by": f"suture-skills {__version__}",
        "title": f"{version.surgeon.slug}, {version.suture}, version {version.version}",
        "use": words.USE,
        "what_it_is": words.IS if combined is None else words.of_several(len(demonstrations), combined["in_words"]),
        "what_it_is_not": words.IS_NOT,
        "policy": _policy(version),
        "status": _status(session, version, released),
        "surgeon": _surgeon(version.surgeon),
        "suture_type": _suture_type(find_suture_type(session, version.suture)),
        "demonstrations": [_demonstration(one) for one in demonstrations],
        "combined": combined,
        "learner": _learner(version),
        "metrics": _metrics(version),
        "certificate": version.manifest["grid_certificate"],
        "coverage": _coverage(version, coverage),
        "limits": _limits(version, demo),
        "lineage": _lineage(session, version),
        "citation": words.citation(version),
    }
    return Card(facts, demo, learnt(version).path, coverage, combined_of(version))


def _refuse_damaged(rows: Sequence[Any]) -> None:
    """Look at rows as `skills verify` does.

    Raises:
        Corrupt: One of them is not what its digest was taken of, or does not agree with what it rests on.
    """
    for row in rows:
        why = next(AGREES[type(row)](row), None)
        if why is not None:
            raise Corrupt(
                f"No card can be written. In {row.__tablename__}, {why}: `skills verify` names the row; restore it "
                "from a backup."
            )


def _policy(version: PolicyVersion) -> Facts:
    told = ("arm", "frame", "instrument", "grid", "start_mm", "goal_mm", "phases")
    return {
        "sha256": version.sha256,
        "version": version.version,
        "surgeon": version.surgeon.slug,
        "suture": version.suture,
        "training": version.training,
        "created_at": at(version.created_at),
        **{name: version.manifest[name] for name in told},
        "n_states": version.manifest["coverage"]["n_states"],
        "where": f"/policy-versions/{version.sha256}",
    }


def _status(session: Session, version: PolicyVersion, released: Sequence[Release]) -> Facts:
    """Tell what became of a version: its releases, and what its style serves now."""
    standing = releases.standing(session, version.surgeon_row, version.suture)
    served = standing[0].policy if standing else None
    refused = list(version.manifest["grid_certificate"]["refused_because"])
    if version.rests_on_withdrawn:
        refused.append("its demonstration was withdrawn")
    return {
        "released_now": served is not None and served.row == version.row,
        "served_now": None if served is None else {"version": served.version, "sha256": served.sha256},
        "releasable": version.releasable and not refused,
        "refused_because": refused,
        "releases": [
            {
                "released_at": at(one.released_at),
                "released_by": one.released_by,
                "withdrawn_at": at(one.withdrawn_at),
                "serving": bool(standing) and standing[0].row == one.row,
            }
            for one in released
        ],
        "in_words": words.status(version.version, None if served is None else served.version, refused, bool(released)),
    }


def _surgeon(surgeon: Surgeon) -> Facts:
    return {
        "pseudonym": surgeon.slug,
        "skill_level": surgeon.skill_level,
        "handedness": surgeon.handedness,
        "protocol": surgeon.protocol,
        "consent": surgeon.consent,
        "consent_in_words": words.consent(surgeon.consent),
    }


def _suture_type(suture: SutureType) -> Facts:
    return {
        "suture": suture.slug,
        "name": suture.name,
        "also_called": suture.also_called,
        "family": suture.family,
        "description": suture.description,
    }


def _demonstration(row: Demonstration) -> Facts:
    recording, report, path = row.recording, full_report(row), row.path
    return {
        "sha256": row.sha256,
        "state": "active" if row.withdrawn_at is None else "withdrawn",
        "withdrawn_at": at(row.withdrawn_at),
        "state_in_words": words.demonstration_state(row.withdrawn_at),
        "arm": row.arm,
        "topic": row.topic,
        "frame": row.frame,
        "instrument": row.instrument,
        "start_s": row.start_s,
        "end_s": row.end_s,
        "session": row.session,
        "hysteresis": path.hysteresis,
        "path_states": len(path.states),
        "created_at": at(row.created_at),
        "report": report,
        "quality_in_words": words.quality(report),
        "lost_in_words": words.lost(report),
        "where": f"/demos/{row.sha256}",
        "recording": {
            "sha256": recording.sha256,
            "format": recording.format,
            "media_type": recording.media_type,
            "size_bytes": recording.size_bytes,
            "integrity": recording.integrity,
            "created_at": at(recording.created_at),
            "where": f"/demos/{row.sha256}/recording",
        },
    }


def _combined(version: PolicyVersion) -> Facts | None:
    """Tell how several demonstrations became one way; None of one alone."""
    said = version.manifest.get("combined")
    return None if said is None else said | {"in_words": words.combined(said, len(version.demonstrations))}


def _learner(version: PolicyVersion) -> Facts:
    manifest = version.manifest
    told = ("settings", "seed", "reward_levels", "training")
    return {
        "kind": manifest["learner"],
        "version": manifest["learner_version"],
        **{name: manifest[name] for name in told},
        "in_words": words.learner(manifest["phases"], manifest["training"]["settled"]),
    }


def _metrics(version: PolicyVersion) -> list[Facts]:
    """Write every metric of a policy with its unit and how it is measured."""
    measured = version.manifest["metrics"]
    return [
        {
            "name": name,
            "label": label,
            "value": measured[name],
            "unit": unit.format(**measured),
            "how": how.format(**measured),
        }
        for name, label, unit, how in words.METRICS
        if measured.get(name) is not None
    ]


def _coverage(version: PolicyVersion, coverage: Coverage) -> Facts:
    """Count the starts by how they reach the goal, in all and in every layer of the grid."""
    grid = learnt(version).path.grid
    follows = coverage.reaches & coverage.joins_nearest
    otherwise = coverage.reaches & ~coverage.joins_nearest
    sums = [one.reshape(grid.shape).sum(axis=(0, 1)).tolist() for one in (follows, otherwise, ~coverage.reaches)]
    z_mm = [grid.origin_mm[2] + grid.cell_mm * layer for layer in range(grid.shape[2])]
    layers = [
        {"z_mm": z, "follow": one, "reach_otherwise": two, "do_not_reach": three}
        for z, one, two, three in zip(z_mm, *sums, strict=True)
    ]
    counts = {name: int(sum(layer[name] for layer in layers)) for name in ("follow", "reach_otherwise", "do_not_reach")}
    return {
        **version.manifest["coverage"],
        **counts,
        "shares": {name: count / grid.n_states for name, count in counts.items()},
        "layers": layers,
        "in_words": words.coverage(counts, grid.n_states),
    }


def _limits(version: PolicyVersion, demo: Demo) -> Facts:
    return {
        "certified_domain": words.domain(version.manifest["phases"]),
        "joint_limits": words.joint_limits(
            demo.frame,
            demo.instrument,
            demo.rotation_xyzw is not None,
            version.manifest["metrics"]["path_states"],
            version.releasable,
        ),
        "tip_accuracy": words.tip_accuracy(),
        "tip_error_mm": {"calibrated": CALIBRATED_MM, "not_calibrated": UNCALIBRATED_MM},
        "not_checked": words.NOT_CHECKED,
    }


def _lineage(session: Session, version: PolicyVersion) -> Facts:
    """Write the chain of digests from the recordings to the policy, and what each was taken of.

    Where that is JSON, `digest_of` holds it whole, so that a reader can compute the digest without this service.
    """
    links: list[tuple[str, str, Any]] = []
    for one in version.demonstrations:
        recording = one.recording.sha256
        taken_of = what_identifies(recording, version.surgeon.slug, version.suture, one.demo, one.path)
        links += [("recording", recording, None), ("demonstration", one.sha256, taken_of)]
    policy = learnt(version)
    links += [
        ("reward map", digest(sparse_reward(policy.path, policy.levels)), None),
        ("policy", version.sha256, [version.manifest, digest(policy)]),
    ]
    return {
        "chain": [
            {"what": what, "sha256": sha256, "how": words.DIGESTS[what], "digest_of": of} for what, sha256, of in links
        ],
        "rests_on_it": _resting_on(session, version),
        "verify": words.VERIFY,
    }


def _resting_on(session: Session, version: PolicyVersion) -> Facts:
    plans = select(func.count()).select_from(Plan).where(Plan.policy_row == version.row)
    played = select(func.count()).select_from(StoredPlayback).join(Plan).where(Plan.policy_row == version.row)
    counts = {
        "plans": session.scalar(plans) or 0,
        "playbacks": session.scalar(played) or 0,
        "feasible_playbacks": session.scalar(played.where(StoredPlayback.feasible)) or 0,
    }
    return {**counts, "in_words": words.resting(**counts)}
