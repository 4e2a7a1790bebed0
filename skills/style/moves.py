"""Moves from rest to rest: each tip on a straight line, each jaw about one axis, all by one minimum-jerk law.

This is how A2 turns the jaw, how a tip comes to where A1 begins, and all that PSM_M does. The law is
u^3 (10 - 15 u + 6 u^2) of the time's part u; its greatest rate is `PEAK` times its mean. The paper only asks for no
jerky movements; the law is ours.

Both arms' poses are told in one frame, PSM_A's base, and they move together: the one that needs longer sets the time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from skills.style._arrays import Floats, frozen
from skills.style._spline import check_length
from skills.style.kinematics import angle_between
from skills.style.realign import turn

TRANSFER, A1, A2 = 0, 1, 2  # the phases of a pass, in order (`skills.style.passes`)
PHASES = ("transfer", "A1", "A2")
PEAK = 1.875
SAME_POINT_MM = 1e-6
_SAME_TURN_RAD = 1e-9


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a tip is, mm, shape (3,), and its [n o a], shape (3, 3)."""

    tip_mm: Floats
    rotation: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "tip_mm", frozen(self.tip_mm, np.float64, (3,), "tip_mm"))
        object.__setattr__(self, "rotation", frozen(self.rotation, np.float64, (3, 3), "rotation"))


Arms = tuple[Pose, ...]  # PSM_A, and PSM_M where it moves beside it


@dataclass(frozen=True, eq=False)
class Poses:
    """One arm tick by tick: tips in mm, shape (T, 3), and their [n o a], shape (T, 3, 3)."""

    tip_mm: Floats
    rotation: Floats

    def __len__(self) -> int:
        """The number of ticks."""
        return len(self.tip_mm)

    def __getitem__(self, ticks: slice) -> "Poses":
        """Cut out some ticks."""
        return Poses(self.tip_mm[ticks], self.rotation[ticks])


@dataclass(frozen=True)
class Pace:
    """How fast a tip goes at most, how fast a jaw turns at most, and how often we look."""

    speed_mm_s: float
    turn_rad_s: float
    rate_hz: float

    def slowed(self, part: float) -> "Pace":
        """Take a part of both speeds."""
        return replace(self, speed_mm_s=self.speed_mm_s * part, turn_rad_s=self.turn_rad_s * part)


def move(start: Arms, end: Arms, pace: Pace, least_ticks: int = 0) -> tuple[Poses, ...]:
    """Bring the arms from one place to another; of each the poses after 0, 1, ... ticks, both ends exactly.

    Where nothing moves there is the start alone, unless `least_ticks` asks for more.
    """
    ticks = max(least_ticks, *(_ticks(a, b, pace) for a, b in zip(start, end, strict=True)))
    u = np.arange(ticks + 1) / max(1, ticks)
    done = u**3 * (10 - 15 * u + 6 * u * u)
    return tuple(_between(a, b, done) for a, b in zip(start, end, strict=True))


def held(pose: Pose, ticks: int) -> Poses:
    """Hold a pose for some ticks."""
    return Poses(np.tile(pose.tip_mm, (ticks, 1)), np.tile(pose.rotation, (ticks, 1, 1)))


def joined(parts: Sequence[Poses]) -> Poses:
    """Put parts one after another."""
    return Poses(np.concatenate([one.tip_mm for one in parts]), np.concatenate([one.rotation for one in parts]))


def _ticks(start: Pose, end: Pose, pace: Pace) -> int:
    """Count the ticks that one arm needs, 0 where it stays."""
    way_mm = float(np.linalg.norm(end.tip_mm - start.tip_mm))
    angle = float(angle_between(start.rotation[None], end.rotation[None])[0])
    if way_mm <= SAME_POINT_MM and angle <= _SAME_TURN_RAD:
        return 0
    ticks = ceil(PEAK * max(way_mm / pace.speed_mm_s, angle / pace.turn_rad_s) * pace.rate_hz)
    check_length(ticks)
    return ticks


def _between(start: Pose, end: Pose, done: Floats) -> Poses:
    tip = start.tip_mm + done[:, None] * (end.tip_mm - start.tip_mm)
    rotation = turn(start.rotation, end.rotation, done)
    if len(done) > 1:  # round-off left out: what follows begins exactly there
        tip[-1], rotation[-1] = end.tip_mm, end.rotation
    return Poses(tip, rotation)
