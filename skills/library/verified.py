"""Values read back from the database, each compared with the digest that its row is known by.

A column is guarded by its own checksum (`skills.db.packed`); this guards what belongs together: a policy and what is
said of it, a plan and the policy that it follows. What does not agree is refused; nothing takes its place.
"""

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

from skills.db.models import Plan, PolicyVersion
from skills.db.packed import digest
from skills.errors import Corrupt
from skills.library.kept import Kept
from skills.packing import canonical, sha256
from skills.style.certificate import Coverage
from skills.style.demo import Demo
from skills.style.grid import GridPath
from skills.style.plan import SuturePlan
from skills.style.policy import Policy

_policies: Kept[str, tuple[dict[str, Any], Policy]] = Kept(32)  # by digest, with what it was taken of; a few MB each


def learnt(version: PolicyVersion) -> Policy:
    """Read a policy, and check that it and all that is said of it are what its digest was taken of.

    Raises:
        Corrupt: They are not.
    """
    manifest, policy = _policies.get(version.sha256) or (None, None)
    if policy is None or manifest != version.manifest:  # it is the row's manifest that a client is told
        policy = version.learnt
        if policy_identity(version.manifest, policy) != version.sha256:
            raise Corrupt("A stored policy is not what was certified; restore it from a backup or train it again.")
        _policies.put(version.sha256, (version.manifest, policy))
    return policy


def remembered() -> list[str]:
    """List the policies that are still in memory, by digest."""
    return [policy for policy, _ in _policies.items()]


def forget(policies: Iterable[str]) -> None:
    """Keep nothing of these policies in memory: they were erased."""
    _policies.forget(policies)


def covered(version: PolicyVersion) -> Coverage:
    """Read the coverage of a policy that was verified.

    Raises:
        Corrupt: It is not what was certified.
    """
    coverage = version.covered
    if digest(coverage) != version.manifest["coverage"]["sha256"]:
        raise Corrupt("A stored policy's coverage is not what was certified; restore it from a backup.")
    return coverage


def planned(plan: Plan) -> SuturePlan:
    """Read a plan, and check that it is what its digest was taken of.

    Raises:
        Corrupt: It is not; no arm should follow it.
    """
    if plan_identity(plan.policy.sha256, plan.plan) != plan.sha256:
        raise Corrupt("A stored plan is not what was planned; restore it from a backup or plan again.")
    return plan.plan


def demo_identity(recording_sha256: str, surgeon: str, suture: str, demo: Demo, path: GridPath) -> str:
    """Compute a demonstration's digest: over its recording, its style, the part of it and the grid."""
    return sha256(canonical(what_identifies(recording_sha256, surgeon, suture, demo, path)))


def what_identifies(recording_sha256: str, surgeon: str, suture: str, demo: Demo, path: GridPath) -> dict[str, Any]:
    """Write what a demonstration's digest is taken of."""
    identity: dict[str, Any] = {
        "recording": recording_sha256,
        "surgeon": surgeon,
        "suture": suture,
        "arm": demo.arm,
        "topic": demo.topic,
        "segment_s": [demo.start_s, demo.end_s],
        "grid": asdict(path.grid),
    }
    if demo.pauses:  # of a recording with presses, the same segment once had the samples in them
        identity["left_out"] = [asdict(pause) for pause in demo.pauses]
    if path.hysteresis:  # else left out, so that a demonstration is still known by the digest it always had
        identity["hysteresis"] = path.hysteresis
    return identity


def policy_identity(manifest: dict[str, Any], policy: Policy) -> str:
    """Compute a policy version's digest: over its identity, its numbers and all that a client is told of it."""
    return policy_identity_of(manifest, digest(policy))


def policy_identity_of(manifest: dict[str, Any], numbers: str) -> str:
    """Compute a policy version's digest from that of its numbers, see `policy_identity`."""
    return sha256(canonical([manifest, numbers]))


def plan_identity(policy_sha256: str, plan: SuturePlan) -> str:
    """Compute a plan's digest: over the policy version it follows and its passes."""
    return sha256(canonical([policy_sha256, digest(plan)]))
