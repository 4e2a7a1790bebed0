"""The other arm at the hand-off: PSM_M, which takes the needle from PSM_A (Sec. III-D).

Two arms have different base frames. The other arm's pose can be expressed in this arm's frame only if the recording has
both poses in one frame: the same pose topic for both arms (such as `measured_cp` in the camera's frame), or this arm's
pose both in its own base and in the other's frame, from which the position of its base follows (`base_frames`). If the
base did not stay in one place, because the camera moved, no partner is returned. If the other arm's base stood still in
that frame as well, its pose in this arm's base is returned too, so that a plan can move both arms.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from skills.arrays import Floats, frozen, xyz
from skills.demonstration.movement import same_signs
from skills.demonstration.recording import BaseFrame, Motion, Recording
from skills.fields import Point, Quaternion, computed_field, schema
from skills.kinematics import INSTRUMENTS, matrix_of

NEAR_MM = 40.0  # between tips that hold one needle: 26 mm along its arc, 17 mm across, plus the width of the jaws
STEADY_MM, STEADY_RAD = 3.0, 0.05  # a base that moved more in the other frame has no single pose
APART_S = 0.1  # a pose further away in time is not used


@schema
@dataclass(frozen=True)
class Partner:
    """The pose of the other arm when it takes the needle, in the demonstration's frame.

    Attributes:
        arm: The other arm's name.
        at_s: Time of the pose, in seconds since the recording's `origin_ns`.
        position_mm: Position of its tip.
        rotation_xyzw: Orientation of its tip, a unit quaternion.
        base_mm: Position of its remote centre; None unless the demonstration's frame is this arm's own base and both
            bases stood still in one common frame.
        base_xyzw: Orientation of its base; None if `base_mm` is None.
        instrument: Its instrument's number; None if it was not recorded or no constants are known for it.
    """

    arm: str
    at_s: float
    position_mm: Point
    rotation_xyzw: Quaternion
    base_mm: Point | None = None
    base_xyzw: Quaternion | None = None
    instrument: str | None = None

    @computed_field  # type: ignore[prop-decorator]
    @property
    def approach(self) -> Point:
        """The direction in which the other arm approaches, of length 1: the third column of its rotation matrix."""
        x, y, z = (float(v) for v in matrix_of(np.array([self.rotation_xyzw]))[0][:, 2])
        return x, y, z


@dataclass(frozen=True, eq=False)
class PartnerMotion:
    """The other arm all along a demonstration or a path, in its frame.

    Attributes:
        arm: The other arm's name.
        tip_mm: Positions of its tip at each stamp or phase, shape (T, 3).
        rotation_xyzw: Its orientations there, unit quaternions, shape (T, 4).
    """

    arm: str
    tip_mm: Floats
    rotation_xyzw: Floats

    def __post_init__(self) -> None:
        count = len(self.tip_mm)
        object.__setattr__(self, "tip_mm", frozen(self.tip_mm, np.float64, (count, 3), "tip_mm"))
        object.__setattr__(self, "rotation_xyzw", frozen(self.rotation_xyzw, np.float64, (count, 4), "rotation_xyzw"))


def partner_at(
    recording: Recording, motion: Motion, second: float, bases: Sequence[BaseFrame], arm: str | None = None
) -> Partner | None:
    """Find the nearest other arm to this arm's tip at one time of a recording, with its pose in this arm's frame.

    Args:
        recording: A recording of both arms.
        motion: The motion of this arm.
        second: The time, in seconds since the recording's `origin_ns`.
        bases: Result of `base_frames` for the recording.
        arm: Name of the other arm; None for the nearest one.

    Returns:
        The other arm; None if no other arm, or not the one named, is within `NEAR_MM`, if its orientation is not known,
        or if its pose cannot be expressed in this arm's frame.
    """
    here, base = pose_at(recording, motion, second), _base_of(motion, bases)
    if here is None:
        return None
    near: list[tuple[float, Partner]] = []
    for other in recording.motions:
        if other.arm == motion.arm or arm not in (None, other.arm) or other.is_local or other.rotation_xyzw is None:
            continue
        there = pose_at(recording, other, second)
        if there is None:
            continue
        seen = _in_frame_of(motion, base, other, other.tip_mm[[there]], other.rotation_xyzw[[there]])
        if seen is None:
            continue
        (position,), (rotation,) = seen
        apart_mm = float(np.linalg.norm(position - motion.tip_mm[here]))
        if apart_mm <= NEAR_MM:
            base_mm, base_xyzw = (None, None) if base is None else _other_base(base, other.arm, bases)
            tool = _instrument_of(recording, other.arm)
            pose = xyz(position), _xyzw(rotation)
            near.append((apart_mm, Partner(other.arm, round(second, 6), *pose, base_mm, base_xyzw, tool)))
    return min(near, key=lambda one: one[0])[1] if near else None


def partner_along(
    recording: Recording, motion: Motion, seconds: Floats, bases: Sequence[BaseFrame], arm: str
) -> PartnerMotion | None:
    """Return the other arm at each time of a demonstration, in the frame of this arm's motion.

    Args:
        recording: A recording of both arms.
        motion: The motion of this arm.
        seconds: Times since the recording's `origin_ns`, increasing, shape (T,).
        bases: Result of `base_frames` for the recording.
        arm: Name of the other arm.

    Returns:
        The other arm's motion; None if its orientation is not known, if its poses cannot be expressed in this arm's
        frame, or if there is none of them within `APART_S` of each time.
    """
    base = _base_of(motion, bases)
    for other in recording.motions:
        if other.arm != arm or other.is_local or other.rotation_xyzw is None:
            continue
        stamps_s = recording.seconds(other.stamps_ns)
        after = np.searchsorted(stamps_s, seconds).clip(1, len(stamps_s) - 1) if len(stamps_s) > 1 else 0
        before_s, after_s = stamps_s[np.maximum(after - 1, 0)], stamps_s[after]
        near = np.minimum(np.abs(seconds - before_s), np.abs(seconds - after_s)) <= APART_S
        seen = _in_frame_of(motion, base, other, other.tip_mm, other.rotation_xyzw)
        if seen is None or not near.all():
            continue
        tip_mm, turned = (
            np.stack([np.interp(seconds, stamps_s, column) for column in columns.T], axis=1)
            for columns in (seen[0], same_signs(seen[1]))
        )
        return PartnerMotion(arm, tip_mm, turned / np.linalg.norm(turned, axis=1, keepdims=True))
    return None


def in_base(partner: Partner, base: BaseFrame, bases: Sequence[BaseFrame]) -> Partner:
    """Transform the other arm's pose into this arm's base.

    Args:
        partner: The other arm in the frame in which this arm's base stands.
        base: This arm's base.
        bases: Result of `base_frames` for the recording.
    """
    position, rotation = _seen_from(base, np.array(partner.position_mm), np.array(partner.rotation_xyzw))
    base_mm, base_xyzw = _other_base(base, partner.arm, bases) if _is_steady(base) else (None, None)
    position_mm, rotation_xyzw = xyz(position), _xyzw(rotation)
    return replace(partner, position_mm=position_mm, rotation_xyzw=rotation_xyzw, base_mm=base_mm, base_xyzw=base_xyzw)


def pose_at(recording: Recording, motion: Motion, second: float) -> int | None:
    """Find the sample of a motion that is nearest to a time.

    Args:
        recording: The recording, for its `origin_ns`.
        motion: A motion of the recording.
        second: The time, in seconds since `origin_ns`.

    Returns:
        Index of the sample; None if no sample is within `APART_S`.
    """
    stamp_ns = recording.origin_ns + round(second * 1e9)
    after = int(np.searchsorted(motion.stamps_ns, stamp_ns))
    around = [index for index in (after - 1, after) if 0 <= index < len(motion.stamps_ns)]
    nearest = min(around, key=lambda index: abs(int(motion.stamps_ns[index]) - stamp_ns))
    return nearest if abs(int(motion.stamps_ns[nearest]) - stamp_ns) <= APART_S * 1e9 else None


def _base_of(motion: Motion, bases: Sequence[BaseFrame]) -> BaseFrame | None:
    """Return the base of a local motion's arm in the frame of its other poses; None unless it stood still there."""
    for one in bases:
        if (one.arm, one.local_frame) == (motion.arm, motion.frame) and motion.is_local and _is_steady(one):
            return one
    return None


def _other_base(base: BaseFrame, arm: str, bases: Sequence[BaseFrame]) -> tuple[Point, Quaternion] | tuple[None, None]:
    """Return the pose of another arm's base in this arm's base; None unless both stood still in one common frame."""
    for one in bases:
        if (one.arm, one.frame) == (arm, base.frame) and _is_steady(one):
            position, rotation = _seen_from(base, np.array(one.position_mm), np.array(one.rotation_xyzw))
            return xyz(position), _xyzw(rotation)
    return None, None


def _is_steady(base: BaseFrame) -> bool:
    return base.spread_mm <= STEADY_MM and base.spread_rad <= STEADY_RAD


def _instrument_of(recording: Recording, arm: str) -> str | None:
    """Return the instrument of an arm, such as 400006; None if it is not known, or its constants are not."""
    number = recording.instrument_on(arm)
    return number if number in INSTRUMENTS else None


def _in_frame_of(
    motion: Motion, base: BaseFrame | None, other: Motion, position_mm: Floats, rotation_xyzw: Floats
) -> tuple[Floats, Floats] | None:
    """Return another arm's poses, (T, 3) and (T, 4), in the frame of a motion; None if they share none."""
    if base is not None and other.frame == base.frame:
        return base.seen_from(position_mm, rotation_xyzw)
    # A local pose and another arm's pose share no frame, even if a recorder gave both frames the same name.
    if motion.is_local or not motion.frame or other.frame != motion.frame:
        return None
    return position_mm, rotation_xyzw


def _seen_from(base: BaseFrame, position_mm: Floats, rotation_xyzw: Floats) -> tuple[Floats, Floats]:
    """Transform one pose from the frame in which a base stands into the base's own frame."""
    position, rotation = base.seen_from(position_mm[None], rotation_xyzw[None])
    return position[0], rotation[0]


def _xyzw(values: Floats) -> Quaternion:
    x, y, z, w = values.tolist()
    return x, y, z, w
