"""Pose styles of policy versions: verified, computed again, and as answers.

A pose style belongs to its policy version: it is released, withdrawn, covered by consent and erased with it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from skills.db.models import PolicyVersion
from skills.demonstration.partner import PartnerMotion
from skills.errors import NotFound
from skills.learning.pose_step import PoseStep, next_pose
from skills.learning.pose_style import PosePath
from skills.learning.tube import CertifiedPoses, certified_poses
from skills.library.operation.integrity import posed
from skills.schemas.pose_styles import NextPose, PartnerPath, PoseStyle

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
    demos, combined = version.demonstrations, version.manifest.combined
    at = 0 if combined is None else [one.sha256 for one in demos].index(combined.at)
    join_share = version.manifest.settings.get("join_share", 0.0)
    return certified_poses([one.demo for one in demos], at, join_share=join_share)


def describe_pose_style(version: PolicyVersion, poses: CertifiedPoses) -> PoseStyle:
    """Return a pose style as it is served."""
    path, other = _lists(poses.path), poses.path.partner
    of_version = {name: getattr(version, name) for name in ("version", "sha256", "suture", "created_at")}
    partner_motion = None
    if other is not None:
        motion = _lists(other)
        partner_motion = PartnerPath.model_construct(
            **motion | {"position_mm": motion["tip_mm"], "scene": poses.partner_scene}
        )
    return PoseStyle.model_construct(  # of verified values: checking thousands of poses takes longer than all else
        **path
        | vars(poses)
        | of_version
        | {"format": FORMAT, "surgeon": version.surgeon.slug, "demos": version.manifest.demos, "tick_s": poses.tick_s}
        | {"position_mm": path["tip_mm"], "partner_motion": partner_motion}
    )


def _lists(value: PosePath | PartnerMotion) -> dict[str, Any]:
    """Return the fields of a value by their names, arrays as lists."""
    return {name: one.tolist() if isinstance(one, np.ndarray) else one for name, one in vars(value).items()}


def describe_step(poses: CertifiedPoses, step: PoseStep) -> dict[str, Any]:
    """Return the fields of a step (`skills.schemas.pose_styles.PoseAnswer`), for messages of sessions without a model.

    A session answers a thousand times a second, for which a model is too slow.
    """
    other, partner_pose = poses.path.partner, None
    if other is not None:
        partner_pose = {
            "arm": other.arm,
            "position_mm": other.tip_mm[step.phase].tolist(),
            "rotation_xyzw": other.rotation_xyzw[step.phase].tolist(),
            "jaw_rad": None if other.jaw_rad is None else float(other.jaw_rad[step.phase]),
        }
    return {**vars(step), "inside": poses.tube.contains(step.off_mm, step.off_rad), "partner_pose": partner_pose}


def find_next(
    version: PolicyVersion,
    poses: CertifiedPoses,
    position_mm: Sequence[float],
    rotation_xyzw: Sequence[float],
    phase: int | None,
) -> NextPose:
    """Return the next pose of a version for a pose and its phase; see `skills.learning.pose_step.next_pose`."""
    step = next_pose(poses.path, position_mm, rotation_xyzw, phase, poses.tube.limits)
    return NextPose(
        version=version.version,
        sha256=version.sha256,
        frame=poses.frame,
        tick_s=poses.tick_s,
        **describe_step(poses, step),
    )
