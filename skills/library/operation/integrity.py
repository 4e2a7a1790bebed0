"""Integrity of stored values: rows found by digest, and values verified against the digest of their row.

    digest, in full or a prefix --find_by_digest--> row
    row --learnt, posed, covered, planned--> verified value, or `Corrupt`

A column is protected by its own checksum (`skills.db.packed`); this module verifies values that belong together: a
policy with its manifest, a plan with the policy that it follows. A value that does not match its digest is refused;
nothing is substituted for it.
"""

from collections.abc import Iterable
from dataclasses import asdict
from typing import TypeVar

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db import Identified
from skills.db.models import Plan, PolicyVersion, StoredPoses
from skills.db.packed import digest
from skills.db.weighted_cache import WeightedCache
from skills.demonstration.demonstration import Demo
from skills.errors import AmbiguousDigest, Corrupt, NotFound
from skills.gridworld.grid import GridPath
from skills.gridworld.scene import Scene
from skills.learning.certificate import Coverage
from skills.learning.policy import Policy
from skills.learning.tube import CertifiedPoses, clear_tube
from skills.packing import canonical, sha256
from skills.planning.plan import SuturePlan
from skills.remedies import Remedy
from skills.schemas.policies import PolicyManifest

Row = TypeVar("Row", bound=Identified)

WHOLE = 64
# The columns of a demonstration that repeat attributes of its motion.
OF_DEMO = ("arm", "topic", "frame", "instrument", "start_s", "end_s")
SHOWN = 5


def find_by_digest(session: Session, table: type[Row], digest: str, what: str, *remedies: Remedy) -> Row:
    """Return the row with this digest, or the only row that the caller may see whose digest has this prefix.

    Args:
        session: The caller's transaction.
        table: The model of the row.
        digest: A SHA-256 in hex, all 64 digits or a prefix.
        what: The noun for messages, such as "plan".
        *remedies: The remedies of a `NotFound`.

    Raises:
        NotFound: There is none; the error carries the remedies.
        AmbiguousDigest: Several digests have this prefix; the error lists them.
    """
    query = select(table)
    if len(digest) == WHOLE:
        found = session.scalars(query.where(table.sha256 == digest)).all()
    else:  # a range, which the index serves on both back ends; "g" is after every digit of a digest
        begins = query.where(table.sha256 >= digest, table.sha256 < f"{digest}g")
        found = session.scalars(begins.order_by(table.sha256).limit(SHOWN + 1)).all()
    if not found:
        raise NotFound(f"There is no {what} with this digest.", *remedies)
    if len(found) > 1:
        candidates = [row.sha256 for row in found[:SHOWN]]
        raise AmbiguousDigest(
            f"Several {what}s have a digest with this prefix: "
            f"{', '.join(candidates)}{', and more' if len(found) > SHOWN else ''}.",
            "Give more characters of the digest.",
            candidates=candidates,
        )
    return found[0]


_policies: WeightedCache[str, tuple[PolicyManifest, Policy]] = WeightedCache(32)  # by digest; a few MB each


def learnt(version: PolicyVersion) -> Policy:
    """Return the policy of a version, after verifying it and its manifest against the version's digest.

    Raises:
        Corrupt: They do not match the digest.
    """
    manifest, policy = _policies.get(version.sha256) or (None, None)
    if policy is None or manifest != version.manifest:  # the API serves the row's manifest, so it is verified too
        policy = version.learnt
        if version.manifest.identity(digest(policy)) != version.sha256:
            raise Corrupt("A stored policy does not match its digest; restore it from a backup or train it again.")
        _policies.put(version.sha256, (version.manifest, policy))
    return policy


_poses: WeightedCache[str, tuple[str, CertifiedPoses]] = WeightedCache(256)  # by the policy's digest; 10 or 15 kB each


def posed(stored: StoredPoses) -> CertifiedPoses:
    """Return the pose style of a policy version, after verifying it against its digest.

    Its tube is clear of the scene that the version was learnt in.

    Raises:
        Corrupt: It, or its version, does not match; no arm should follow it.
    """
    policy = stored.policy.sha256
    sha256, poses = _poses.get(policy) or (None, None)
    if poses is None or sha256 != stored.sha256:
        poses = stored.poses
        if poses_identity_of(policy, digest(poses)) != stored.sha256:
            raise Corrupt("A stored pose style does not match its digest; restore it from a backup or train again.")
        if stored.policy.manifest.scene is not None and (scene := learnt_in(stored.policy)) is not None:
            poses = clear_tube(poses, scene)
        _poses.put(policy, (stored.sha256, poses))
    return poses


def remembered() -> list[str]:
    """List the digests of the policies in this process's caches."""
    return [policy for kept in (_policies, _poses) for policy, _ in kept.items()]


def forget(policies: Iterable[str]) -> None:
    """Remove policies, by digest, from the caches: they were erased."""
    gone = list(policies)
    _policies.forget(gone)
    _poses.forget(gone)


def covered(version: PolicyVersion) -> Coverage:
    """Return the coverage of a version whose policy was verified.

    Raises:
        Corrupt: It does not match the digest in the version's manifest.
    """
    coverage = version.covered
    if digest(coverage) != version.manifest.coverage.sha256:
        raise Corrupt("The coverage of a stored policy does not match its digest; restore it from a backup.")
    return coverage


def planned(plan: Plan) -> SuturePlan:
    """Return a stored plan, after verifying it against its digest.

    Raises:
        Corrupt: It does not match; no arm should follow it.
    """
    if plan_identity(plan.policy.sha256, plan.plan) != plan.sha256:
        raise Corrupt("A stored plan does not match its digest; restore it from a backup or plan again.")
    return plan.plan


def demo_identity(recording_sha256: str, surgeon: str, suture: str, demo: Demo, path: GridPath) -> str:
    """Return a demonstration's digest: over its recording, its style, its segment and its grid."""
    return sha256(canonical(what_identifies(recording_sha256, surgeon, suture, demo, path)))


def what_identifies(recording_sha256: str, surgeon: str, suture: str, demo: Demo, path: GridPath) -> dict[str, object]:
    """Return the JSON of which a demonstration's digest is computed."""
    return {
        "recording": recording_sha256,
        "surgeon": surgeon,
        "suture": suture,
        "arm": demo.arm,
        "topic": demo.topic,
        "segment_s": [demo.start_s, demo.end_s],
        "left_out": [asdict(pause) for pause in demo.pauses],
        "grid": asdict(path.grid),
        "hysteresis": path.hysteresis,
    }


def poses_identity_of(policy_sha256: str, poses: str) -> str:
    """Return a pose style's digest from that of the policy version to which it belongs, and that of its value."""
    return sha256(canonical([policy_sha256, poses]))


def learnt_in(version: PolicyVersion) -> Scene | None:
    """Return the scene that a version was learnt in; None for none."""
    surroundings = learnt(version).surroundings
    return None if surroundings is None else surroundings.scene


def scene_digest(scene: Scene) -> str:
    """Return a scene's digest: over its JSON."""
    return sha256(canonical(scene.as_json()))


def plan_identity(policy_sha256: str, plan: SuturePlan) -> str:
    """Return a plan's digest: over the policy version that it follows and its passes."""
    return sha256(canonical([policy_sha256, digest(plan)]))
