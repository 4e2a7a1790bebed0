"""Pose styles of policy versions: the served one, its JSON, and the next pose.

    PolicyVersion --poses_of--> CertifiedPoses, verified, if its tube's certificate holds
    PolicyVersion --poses_of_demonstrations--> the same, computed again from what is stored

A pose style belongs to its policy version: it is released, withdrawn, covered by consent and erased with it.
"""

from collections.abc import Sequence
from typing import Any

from skills.db import rfc3339
from skills.db.models import PolicyVersion
from skills.errors import NotFound
from skills.fields import as_json
from skills.learning.tube import CertifiedPoses, PoseStep, certified_poses, next_pose
from skills.library.integrity import posed
from skills.remedies import Action, Remedy
from skills.schemas.policies import NextPose

FORMAT = "suture-skills pose style 1"


def poses_of(version: PolicyVersion) -> CertifiedPoses:
    """Return the pose style of a policy version, verified.

    Raises:
        NotFound: It has none, with the reason: it is older than pose styles, its demonstrations have no orientation, or
            the certificate of the tube does not hold.
        Corrupt: The stored one does not match its digest.
    """
    if version.poses is None:
        raise _absent(version)
    poses = posed(version.poses)
    if not poses.tube.holds:
        raise NotFound(
            f"The pose style of version {version.version} is not served, because the certificate of its tube does not "
            f"hold: {'; '.join(poses.tube.faults)}.",
            "Use the policy of the grid, or record the hand-off more slowly.",
        )
    return poses


def _absent(version: PolicyVersion) -> NotFound:
    """Return the error that a version has no pose style, with the reason."""
    surgeon, suture = version.surgeon.slug, version.suture
    without = [one.sha256[:12] for one in version.demonstrations if one.demo.rotation_xyzw is None]
    if without:
        return NotFound(
            f"Version {version.version} has no pose style, because its demonstration {', '.join(without)} has no "
            "orientation; record poses, and train from them."
        )
    return NotFound(
        f"Version {version.version} has no pose style: it was trained before there were any.",
        Remedy(Action.TRAIN, surgeon=surgeon, suture=suture),
    )


def poses_of_demonstrations(version: PolicyVersion, turn_share: float | None = None) -> CertifiedPoses | None:
    """Compute the pose style of a policy version from its demonstrations; None if one has no orientation.

    Args:
        version: The version.
        turn_share: The share of the demonstrations' mean turn; default: the one that `learn_pose_style` chooses.
    """
    demos, combined = version.demonstrations, version.manifest.get("combined")
    at = 0 if combined is None else [one.sha256 for one in demos].index(combined["at"])
    return certified_poses([one.demo for one in demos], at, turn_share)


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
        "partner": None if poses.partner is None else as_json(poses.partner),
        "created_at": rfc3339(version.created_at),
    }


def next_json(poses: CertifiedPoses, step: PoseStep) -> dict[str, Any]:
    """Return the JSON of a step (`schemas.policies.PoseAnswer`)."""
    return {**vars(step), "inside": poses.tube.contains(step.off_mm, step.off_rad)}


def about_next(
    version: PolicyVersion,
    poses: CertifiedPoses,
    position_mm: Sequence[float],
    rotation_xyzw: Sequence[float],
    phase: int | None,
) -> NextPose:
    """Return the next pose of a version for a pose and its phase; see `skills.learning.tube.next_pose`."""
    step = next_pose(poses.path, position_mm, rotation_xyzw, phase, poses.tube.limits)
    named = {"version": version.version, "sha256": version.sha256, "frame": poses.frame, "tick_s": poses.tick_s}
    return NextPose.model_validate(named | next_json(poses, step))
