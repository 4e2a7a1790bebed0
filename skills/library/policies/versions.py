"""Policies of a style: the served version, history, rollouts, arrays for a client, demonstrations and pose style.

A policy may be learnt from several demonstrations. A combined path that is none of the demonstrations is stored only as
the policy's path. To get more of it, combine the demonstrations again, which gives the same result; `skills verify`
compares the resulting path with the policy's.

A pose style belongs to its policy version: it is released, withdrawn, covered by consent and erased with it.

    PolicyVersion --poses_of--> CertifiedPoses, verified, if its tube's certificate holds
    PolicyVersion --poses_of_demonstrations--> the same, computed again from what is stored
"""

import io
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import orjson
from sqlalchemy import Select, Text, cast, exists, func, select
from sqlalchemy.orm import Session, selectinload

from skills.comparison.combining import COMBININGS, Combined, Combining, Corridor, Followed, followed
from skills.db import rfc3339
from skills.db.models import Demonstration, PolicyDemonstration, PolicyVersion, Release, Surgeon
from skills.demonstration.demonstration import Demo
from skills.errors import BadInput, Conflict, NotFound
from skills.fields import as_json
from skills.gridworld.domain import FINISHED, OUTSIDE
from skills.gridworld.grid import GridPath
from skills.learning.evaluation import dtw
from skills.learning.policy import rollout
from skills.learning.pose_step import PoseStep, next_pose
from skills.learning.tube import CertifiedPoses, certified_poses
from skills.library.operation import integrity
from skills.library.operation.integrity import covered, learnt, posed
from skills.library.operation.jobs import KEPT, RetrainingRequest
from skills.library.people import consent
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.library.policies import releases
from skills.library.policies.releases import is_served
from skills.library.recordings.demos import find_demo, newest_demos
from skills.remedies import Action, Remedy
from skills.schemas import policies as described
from skills.schemas.policies import Rollout
from skills.schemas.policy_document import actions_of, live_actions_of, table_name
from skills.schemas.pose_styles import NextPose

MOST_DEMOS = 50  # ours: all pairs are compared, and the combined path with each some ten times, in a third of a second
ROWS_AT_ONCE = 1000  # of a query that reads many manifests, some 3 kB each
BEST = Corridor()  # nearest to left-out demonstrations, with an outlier and without: docs/results.md


@dataclass(frozen=True)
class Served:
    """The policy version that a style serves, and its release."""

    policy: PolicyVersion
    release: Release


def policy_of(session: Session, surgeon: str, suture: str) -> Served:
    """Return the policy version that a style serves.

    Raises:
        NotFound: The surgeon or suture type is unknown, or nothing is served; the error then lists the candidates.
        Corrupt: Its release, its version or its surgeon was changed by others than the service.
    """
    who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)
    served = releases.served(session, who, what.slug)
    if served is not None:
        releases.refuse_edited_release(session, served)
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
    return policy_of(session, surgeon, suture).policy


def followable(policy: PolicyVersion) -> PolicyVersion:
    """Return a policy version that may be followed, released or not.

    Raises:
        Conflict: The surgeon's consent does not cover training (any more).
    """
    consent.require(policy.surgeon, "training")
    return policy


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


# ---- policies learnt from several demonstrations -------------------------------------------------------------------


def choose_demos(
    session: Session, who: Surgeon, suture: str, demos: list[str] | None, *, any_outcome: bool = False
) -> list[Demonstration]:
    """Return the requested demonstrations, the oldest first, or the newest one of the style if none are named.

    Args:
        session: The caller's transaction.
        who: The surgeon.
        suture: The suture type.
        demos: Their digests, or None.
        any_outcome: Accept demonstrations that are marked recovery or failure.

    Raises:
        NotFound: One is unknown.
        Conflict: One was withdrawn, or marked recovery or failure; or the style has none.
        BadInput: One is of another style or named twice, there are too many, or they cannot be combined.
    """
    if demos:
        chosen = sorted((find_demo(session, one) for one in demos), key=lambda demo: demo.row)
    else:
        chosen = newest_demos(session, who.row, suture, 1, any_outcome=any_outcome)
    if not chosen:
        raise _none(session, who, suture)
    if len(chosen) > MOST_DEMOS:
        raise BadInput(f"At most {MOST_DEMOS} demonstrations can be combined.", demos=len(chosen))
    if len({demo.row for demo in chosen}) < len(chosen):
        raise BadInput("A demonstration is named twice; name each once.")
    if any((demo.surgeon_row, demo.suture) != (who.row, suture) for demo in chosen):
        raise BadInput("The demonstration belongs to another style.")
    if any(demo.withdrawn_at is not None for demo in chosen):
        raise Conflict("The demonstration was withdrawn.")
    if not any_outcome and (failed := [demo for demo in chosen if demo.failed]):
        one, reason = failed[0], (failed[0].outcome_reason or "no reason is given").rstrip(".")
        why = f"The demonstration {one.sha256[:12]} is marked {one.outcome}: {reason}."
        raise Conflict(why, Remedy(Action.TRAIN_ANY), demos=[demo.sha256 for demo in failed])
    refuse_unlike(chosen)
    return chosen


def _none(session: Session, who: Surgeon, suture: str) -> Conflict:
    """Return the error that a style has no demonstration to learn from."""
    if newest_demos(session, who.row, suture, 1, any_outcome=True):
        why = f"Every active demonstration of '{suture}' by '{who.slug}' is marked recovery or failure."
        return Conflict(why, Remedy(Action.TRAIN_ANY))
    add = Remedy(Action.ADD_DEMO, surgeon=who.slug, suture=suture)
    return Conflict(f"'{who.slug}' has no active demonstration of '{suture}'.", add)


@dataclass(frozen=True)
class Recipe:
    """The number of demonstrations of a style's served policy, and the way they were combined."""

    demos: int
    how: Combining


def recipes_of(session: Session, surgeons: Collection[int] | None = None) -> dict[tuple[int, str], Recipe]:
    """Return, with one statement, the recipes of the styles that serve a policy of several demonstrations.

    Args:
        session: The caller's transaction.
        surgeons: The rows of surgeons; None: all.

    Returns:
        By style: a surgeon's row and a suture type.
    """
    if surgeons is not None and not surgeons:
        return {}
    by, other = PolicyVersion, PolicyDemonstration
    kind = by.manifest["combined"]["kind"].as_string()
    mine = other.policy_row == by.row
    others = select(func.count()).select_from(other).where(mine).correlate(by).scalar_subquery()
    several = exists().where(mine).correlate(by)
    query = select(Release.surgeon_row, Release.suture, kind, others).join(by, by.row == Release.policy_row)
    query = query.where(is_served(), several)
    if surgeons is not None:
        query = query.where(Release.surgeon_row.in_(surgeons))
    found = session.execute(query)
    return {(who, suture): Recipe(more + 1, combining_of({"kind": how})) for who, suture, how, more in found}


@dataclass(frozen=True)
class LearntIn:
    """The scene that a served policy was learnt in, its digest, and the learner, as JSON."""

    sha256: str
    surroundings: dict[str, Any]
    learner: dict[str, Any]


@dataclass
class Kept:
    """The properties of served policies that a batch keeps, by style: a surgeon's row and a suture type.

    A style has no rule if its policy joins at the nearest waypoint, and no scene if it was learnt in none.
    """

    rules: dict[tuple[int, str], float] = field(default_factory=dict)
    scenes: dict[tuple[int, str], LearntIn] = field(default_factory=dict)


def kept_of(session: Session, surgeons: Collection[int] | None = None) -> Kept:
    """Return the joining rules and the scenes of the styles that serve a policy.

    Args:
        session: The caller's transaction.
        surgeons: The rows of surgeons; None: all.
    """
    kept = Kept()
    if surgeons is not None and not surgeons:
        return kept
    by = PolicyVersion
    query = select(Release.surgeon_row, Release.suture, cast(by.manifest, Text)).join(by, by.row == Release.policy_row)
    query = query.where(is_served())
    if surgeons is not None:
        query = query.where(Release.surgeon_row.in_(surgeons))
    for who, suture, text in in_pieces(session, query):
        about = orjson.loads(text)
        scene, settings = about.get("scene"), about["settings"]
        if share := settings.get("join_share"):
            kept.rules[who, suture] = share
        if scene is not None:
            surroundings = {name: scene[name] for name in ("scene", "costs")}
            kept.scenes[who, suture] = LearntIn(scene["sha256"], surroundings, {"kind": about["learner"], **settings})
    return kept


def in_pieces(session: Session, query: Select[*tuple[Any, ...]]) -> Iterator[Any]:
    """Yield the rows of a query that may return very many, without having all of them in memory.

    Columns of JSON are requested as text, and parsed here: the databases parse them anew for each part of them.
    """
    yield from session.execute(query, execution_options={"yield_per": ROWS_AT_ONCE})


def learner_kept(asked: RetrainingRequest, rule: float | None, there: LearntIn | None) -> dict[str, Any]:
    """Return the JSON of the learner by which a batch learns a style.

    Args:
        asked: The batch. If it names no learner, a style keeps what the following say.
        rule: The joining rule of the policy that the style serves; None: the nearest waypoint.
        there: The scene that this policy was learnt in; None: none.
    """
    if asked["joins"] != KEPT:
        return asked["learner"]
    by_rule = asked["learner"] if rule is None else asked["learner"] | {"join_share": rule}
    return by_rule if there is None else there.learner


def refuse_unlike(demonstrations: Sequence[Demonstration]) -> None:
    """Refuse demonstrations that cannot be combined, before their values are read.

    Raises:
        BadInput: They differ in arm, frame or instrument.
    """
    for name in ("arm", "frame", "instrument"):
        if len(found := sorted({getattr(one, name) for one in demonstrations})) > 1:
            raise BadInput(
                f"The demonstrations have the {name}s {', '.join(found)}; only demonstrations of one arm, in one "
                "frame and with one instrument can be combined."
            )


def combining_of(described: dict[str, Any]) -> Combining:
    """Return the combination that a JSON object describes."""
    return COMBININGS[described["kind"]]()


def describe_combined(found: Followed, how: Combining, demos: Sequence[str]) -> dict[str, Any]:
    """Return the JSON of a combination: its kind, its medoid, and the widths and distances of the combined path.

    Args:
        found: The combined path.
        how: The way of combining.
        demos: The digests of the demonstrations, the oldest first.
    """
    combined = found.combined
    written: dict[str, Any] = as_json(
        described.Combined(
            kind=how.kind,
            medoid=demos[combined.medoid],
            at=demos[combined.at],
            moved=combined.moved,
            apart_mm=tuple(combined.apart_mm.round(6).tolist()),
            width_mm=tuple(found.width_mm.round(6).tolist()),
            hysteresis=found.path.hysteresis,
            bridged_cells=found.path.bridged,
        )
    )
    return written


def learnt_from(version: PolicyVersion) -> Demo:
    """Return the demonstration that a policy was learnt from, or the one that its demonstrations were combined into."""
    return version.demonstration.demo if "combined" not in version.manifest else _followed(version).demo


def path_of(version: PolicyVersion) -> GridPath:
    """Return the path that a policy was learnt from, computed from its demonstrations and not read from the policy."""
    return version.demonstration.path if "combined" not in version.manifest else _followed(version).path


def combined_of(version: PolicyVersion) -> Combined | None:
    """Return the combination of a policy's demonstrations; None for a single one."""
    return None if "combined" not in version.manifest else _followed(version).combined


def _followed(version: PolicyVersion) -> Followed:
    rows = version.demonstrations
    return followed([one.demo for one in rows], [one.path for one in rows], combining_of(version.manifest["combined"]))


FORMAT = "suture-skills pose style 1"


def poses_of(version: PolicyVersion) -> CertifiedPoses:
    """Return the pose style of a policy version, verified.

    Raises:
        NotFound: It has none, with the reason: its demonstrations have no orientation, or the certificate of the tube
            does not hold, in the scene of the version or in any.
        Corrupt: The stored one does not match its digest.
    """
    if version.poses is None:
        raise _absent(version)
    poses = posed(version.poses)
    if not poses.tube.holds:
        raise NotFound(
            f"The pose style of version {version.version} is not served, because the certificate of its tube does not "
            f"hold: {'; '.join(poses.tube.faults)}.",
            "Use the policy of the grid, or record the hand-off more slowly, or further from the scene.",
        )
    return poses


def has_poses(version: PolicyVersion) -> bool:
    """Return whether a policy version has a pose style whose tube's certificate holds.

    Raises:
        Corrupt: The stored one does not match its digest.
    """
    return version.poses is not None and posed(version.poses).tube.holds


def _absent(version: PolicyVersion) -> NotFound:
    """Return the error that a version has no pose style, with the reason."""
    without = [one.sha256[:12] for one in version.demonstrations if one.demo.rotation_xyzw is None]
    return NotFound(
        f"Version {version.version} has no pose style, because its demonstration {', '.join(without)} has no "
        "orientation; record poses, and train from them."
    )


def poses_of_demonstrations(version: PolicyVersion) -> CertifiedPoses | None:
    """Compute the pose style of a policy version from its demonstrations, without the other arm's motion.

    None if a demonstration has no orientation.
    """
    demos, combined = version.demonstrations, version.manifest.get("combined")
    at = 0 if combined is None else [one.sha256 for one in demos].index(combined["at"])
    return certified_poses([one.demo for one in demos], at)


def pose_style_json(version: PolicyVersion, poses: CertifiedPoses) -> dict[str, Any]:
    """Return the JSON of a pose style (`schemas.policies.PoseStyle`)."""
    path = poses.path
    return {
        "format": FORMAT,
        "version": version.version,
        "sha256": version.sha256,
        "surgeon": version.surgeon.slug,
        "suture": version.suture,
        "arm": poses.arm,
        "frame": poses.frame,
        "demos": version.manifest["demos"],
        "position_mm": path.tip_mm.tolist(),
        "rotation_xyzw": path.rotation_xyzw.tolist(),
        "jaw_rad": None if path.jaw_rad is None else path.jaw_rad.tolist(),
        "elapsed_s": path.elapsed_s.tolist(),
        "spread_mm": path.spread_mm.tolist(),
        "spread_rad": path.spread_rad.tolist(),
        "turn_share": path.turn_share,
        "tick_s": poses.tick_s,
        "tube": as_json(poses.tube),
        "scene": None if poses.scene is None else as_json(poses.scene),
        "partner": None if poses.partner is None else as_json(poses.partner),
        **_beside(poses),
        "created_at": rfc3339(version.created_at),
    }


def _beside(poses: CertifiedPoses) -> dict[str, Any]:
    """Return the field of the other arm's motion; none where there is none, as it was before there were any."""
    other, near = poses.path.partner, poses.partner_scene
    if other is None:
        return {}
    jaw_rad = None if other.jaw_rad is None else other.jaw_rad.tolist()
    moved = {"arm": other.arm, "position_mm": other.tip_mm.tolist(), "rotation_xyzw": other.rotation_xyzw.tolist()}
    return {"partner_motion": {**moved, "jaw_rad": jaw_rad, "scene": None if near is None else as_json(near)}}


def next_json(poses: CertifiedPoses, step: PoseStep) -> dict[str, Any]:
    """Return the JSON of a step (`schemas.policies.PoseAnswer`)."""
    inside = poses.tube.contains(step.off_mm, step.off_rad)
    return {**vars(step), "inside": inside, "partner_pose": _partner_pose(poses, step.phase)}


def _partner_pose(poses: CertifiedPoses, phase: int) -> dict[str, Any] | None:
    """Return the JSON of the other arm's pose at a phase (`schemas.policies.PartnerPose`); None if it has none."""
    other = poses.path.partner
    if other is None:
        return None
    pose = {"position_mm": other.tip_mm[phase].tolist(), "rotation_xyzw": other.rotation_xyzw[phase].tolist()}
    return {"arm": other.arm, **pose, "jaw_rad": None if other.jaw_rad is None else float(other.jaw_rad[phase])}


def about_next(
    version: PolicyVersion,
    poses: CertifiedPoses,
    position_mm: Sequence[float],
    rotation_xyzw: Sequence[float],
    phase: int | None,
) -> NextPose:
    """Return the next pose of a version for a pose and its phase; see `skills.learning.pose_step.next_pose`."""
    step = next_pose(poses.path, position_mm, rotation_xyzw, phase, poses.tube.limits)
    named = {"version": version.version, "sha256": version.sha256, "frame": poses.frame, "tick_s": poses.tick_s}
    return NextPose.model_validate(named | next_json(poses, step))
