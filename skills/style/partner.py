"""The other arm at the hand-off: PSM_M, which takes the needle from PSM_A (Sec. III-D).

Two arms have different base frames. The other arm's pose can be told in this arm's frame only where the recording has
both in one frame: the same pose topics of both (such as `measured_cp` in the camera's frame), or this arm's pose in
its own base and in the other's frame, which gives the place of its base (`base_frames`). Where the base did not stay
in one place, because the camera moved, nothing is said. Where the other arm's base stood in that frame too, its place
in this arm's base is told, so that a plan can move both.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skills.style._arrays import Floats
from skills.style.kinematics import INSTRUMENTS, matrix_of, quaternion_of
from skills.style.recording import BaseFrame, Motion, Recording

Xyz = tuple[float, float, float]
Xyzw = tuple[float, float, float, float]

NEAR_MM = 40.0  # between tips that hold one needle: 26 mm along its arc, 17 mm across, and the jaws beside it
STEADY_MM, STEADY_RAD = 3.0, 0.05  # a base that moved more than this in the other frame is in no one place
APART_S = 0.1  # a pose further away in time than this is not the pose of the moment


@dataclass(frozen=True)
class Partner:
    """The pose of the other arm when it takes the needle, in the demonstration's frame; `at_s` in the recording.

    `base_mm` and `base_xyzw` are its remote centre and its base's turn in that frame, None unless that is this arm's
    own base; `instrument` is its instrument's number, None where it was not recorded or no constants are known for it.
    """

    arm: str
    at_s: float
    position_mm: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]
    base_mm: tuple[float, float, float] | None = None
    base_xyzw: tuple[float, float, float, float] | None = None
    instrument: str | None = None

    @property
    def approach(self) -> tuple[float, float, float]:
        """The direction in which it approaches: the third column of its rotation."""
        x, y, z = (float(v) for v in matrix_of(np.array([self.rotation_xyzw]))[0][:, 2])
        return x, y, z


def partner_at(
    recording: Recording, motion: Motion, second: float, bases: Sequence[BaseFrame], arm: str | None = None
) -> Partner | None:
    """Find the arm that is near this one's tip at a time of the recording, and its pose in this one's frame.

    None where no other arm, or not the one asked for, is near, its orientation is not known, or its place cannot be
    told.

    Args:
        recording: Both arms.
        motion: This arm's.
        second: When.
        bases: What `base_frames` found in the recording.
        arm: The other arm; None: whichever is nearest.
    """
    here, base = pose_at(recording, motion, second), _base_of(motion, bases)
    if here is None:
        return None
    near: list[tuple[float, Partner]] = []
    for other in recording.motions:
        if other.arm == motion.arm or arm not in (None, other.arm) or _is_local(other) or other.rotation_xyzw is None:
            continue
        there = pose_at(recording, other, second)
        if there is None:
            continue
        position, rotation = other.tip_mm[there], other.rotation_xyzw[there]
        if base is not None and other.frame == base.frame:
            position, rotation = _seen_from(base, position, rotation)
        elif _is_local(motion) or not motion.frame or other.frame != motion.frame:
            continue
        apart_mm = float(np.linalg.norm(position - motion.tip_mm[here]))
        if apart_mm <= NEAR_MM:
            base_mm, base_xyzw = (None, None) if base is None else _other_base(base, other.arm, bases)
            tool = _instrument_of(recording, other.arm)
            pose = _xyz(position), _xyzw(rotation)
            near.append((apart_mm, Partner(other.arm, round(second, 6), *pose, base_mm, base_xyzw, tool)))
    return min(near, key=lambda one: one[0])[1] if near else None


def pose_at(recording: Recording, motion: Motion, second: float) -> int | None:
    """Find the sample of a motion at a time of the recording; None where it has none within `APART_S`."""
    stamp_ns = recording.origin_ns + round(second * 1e9)
    after = int(np.searchsorted(motion.stamps_ns, stamp_ns))
    around = [index for index in (after - 1, after) if 0 <= index < len(motion.stamps_ns)]
    nearest = min(around, key=lambda index: abs(int(motion.stamps_ns[index]) - stamp_ns))
    return nearest if abs(int(motion.stamps_ns[nearest]) - stamp_ns) <= APART_S * 1e9 else None


def _is_local(motion: Motion) -> bool:
    """Say whether a pose is relative to the arm's own remote centre, whatever its frame is called."""
    return "/local/" in motion.topic


def _base_of(motion: Motion, bases: Sequence[BaseFrame]) -> BaseFrame | None:
    """Find where the base of a local motion's arm is in the frame of its other poses; None unless it stays there."""
    for one in bases:
        if (one.arm, one.local_frame) == (motion.arm, motion.frame) and _is_local(motion) and _is_steady(one):
            return one
    return None


def _other_base(base: BaseFrame, arm: str, bases: Sequence[BaseFrame]) -> tuple[Xyz, Xyzw] | tuple[None, None]:
    """Find where another arm's base is in this arm's; None unless both stay in one common frame."""
    for one in bases:
        if (one.arm, one.frame) == (arm, base.frame) and _is_steady(one):
            position, rotation = _seen_from(base, np.array(one.position_mm), np.array(one.rotation_xyzw))
            return _xyz(position), _xyzw(rotation)
    return None, None


def _is_steady(base: BaseFrame) -> bool:
    return base.spread_mm <= STEADY_MM and base.spread_rad <= STEADY_RAD


def _instrument_of(recording: Recording, arm: str) -> str | None:
    """Find the number of an arm's instrument, which the console names as "LARGE_NEEDLE_DRIVER:400006"."""
    number = dict(recording.tools).get(arm, "").rpartition(":")[2]
    return number if number in INSTRUMENTS else None


def _seen_from(base: BaseFrame, position_mm: Floats, rotation_xyzw: Floats) -> tuple[Floats, Floats]:
    """Bring a pose from the frame in which a base stands into the base's own."""
    turn = matrix_of(np.array([base.rotation_xyzw]))[0]
    rotation = quaternion_of(turn.T @ matrix_of(rotation_xyzw[None]))[0]
    return (position_mm - np.asarray(base.position_mm)) @ turn, rotation


def _xyz(values: Floats) -> Xyz:
    x, y, z = values.tolist()
    return x, y, z


def _xyzw(values: Floats) -> Xyzw:
    x, y, z, w = values.tolist()
    return x, y, z, w
