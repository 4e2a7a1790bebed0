"""Pose styles of policy versions: verified, computed again, and as answers."""

from collections.abc import Sequence
from typing import Any

from skills.db import rfc3339
from skills.db.models import PolicyVersion
from skills.errors import NotFound
from skills.fields import as_json
from skills.learning.tube import CertifiedPoses, PoseStep, certified_poses, next_pose
from skills.library.operation.integrity import posed
from skills.schemas.pose_styles import NextPose

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
    """Return the next pose of a version for a pose and its phase; see `skills.learning.tube.next_pose`."""
    step = next_pose(poses.path, position_mm, rotation_xyzw, phase, poses.tube.limits)
    named = {"version": version.version, "sha256": version.sha256, "frame": poses.frame, "tick_s": poses.tick_s}
    return NextPose.model_validate(named | next_json(poses, step))
