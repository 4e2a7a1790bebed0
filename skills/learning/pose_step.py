"""The next pose of an arm that follows a path of poses: one tick of the law that `skills.learning.tube` certifies.

A tick goes towards the pose of its phase, by at most a step; where the arm is within a step of a later pose of the
window, it commands that pose and its phase.
"""

from dataclasses import dataclass
from math import atan2, floor, isfinite, sin, sqrt
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Floats, Ints, frozen, xyz, xyzw
from skills.compiled import compiled, inner
from skills.errors import BadSettings
from skills.fields import Point, Quaternion
from skills.gridworld.grid import refuse_metres
from skills.learning.pose_style import UNIT_TOLERANCE, PosePath, unit_quaternion
from skills.learning.tube_certificate import TubeLimits

ROUNDING = 1e-9  # mm and rad: a step computed in double precision is off by about 1e-14
LATTICE = 6  # steps from the middle of a ball of starts to its border
SMALLEST_SINE = 1e-6  # of half an angle: below it, a share of the chord equals a share of the arc to rounding


@dataclass(frozen=True, eq=False)
class Hands:
    """The poses and phases of runs that are followed together.

    Attributes:
        tip_mm: Positions in the frame of the path, shape (R, 3).
        rotation_xyzw: Orientations as unit quaternions, shape (R, 4).
        phases: Phases, shape (R,).
    """

    tip_mm: Floats
    rotation_xyzw: Floats
    phases: Ints


@dataclass(frozen=True)
class PoseStep:
    """The next pose of a hand on a path.

    Attributes:
        position_mm: Where to send the tip within one tick, in the frame of the path.
        rotation_xyzw: Its orientation there, a unit quaternion.
        jaw_rad: Angle of the jaw there; None if the path has none.
        phase: The phase after the tick.
        elapsed_s: Time of that phase from the start of the motion.
        share_left: Share of the path's phases that follow it.
        off_mm: Distance of the pose that the hand has reached from that of the phase before the tick.
        off_rad: The angle between their orientations.
        finished: The phase is the last one, and its pose was reached before this tick.
    """

    position_mm: Point
    rotation_xyzw: Quaternion
    jaw_rad: float | None
    phase: int
    elapsed_s: float
    share_left: float
    off_mm: float
    off_rad: float
    finished: bool


def next_pose(
    path: PosePath, tip_mm: ArrayLike, rotation_xyzw: ArrayLike, phase: int | None, limits: TubeLimits
) -> PoseStep:
    """Return the next pose and phase for a pose that the hand has reached.

    Args:
        path: The motion to follow.
        tip_mm: Position in the frame of the path, shape (3,).
        rotation_xyzw: Orientation, a unit quaternion, shape (4,).
        phase: The phase that the last call returned; None at the start: see `joined_phase`.
        limits: Steps, window and joining rule; the disturbance is not used.

    Returns:
        The next pose.

    Raises:
        BadInput: A number is not finite, or the quaternion is not a unit quaternion.
        BadSettings: There is no such phase.
        OutsideGrid: The position seems to be in metres.
    """
    tip, rotation = _row(tip_mm, 3, "tip_mm"), _row(rotation_xyzw, 4, "rotation_xyzw")
    x, y, z, w = rotation[0].tolist()
    length = sqrt(x * x + y * y + z * z + w * w)
    if not abs(length - 1.0) <= UNIT_TOLERANCE:
        unit_quaternion(rotation[0], "rotation_xyzw")  # raises
    rotation /= length
    refuse_metres("The position", tip[0], path.tip_mm[-1])
    last, along = len(path.tip_mm) - 1, (path.tip_mm, path.rotation_xyzw)
    if phase is None:
        phase = joined_phase(path, tip, rotation, limits)
    elif not 0 <= phase <= last:
        raise BadSettings(f"The path has the phases 0 to {last}.", phase=phase)
    phases, off = np.array([phase], np.int64), np.empty((1, 2))
    steps = float(limits.step_mm), float(limits.step_rad), int(limits.ahead)
    step_along(*along, tip, rotation, phases, off, *steps)
    after, (off_mm, off_rad) = int(phases[0]), off[0].tolist()
    return PoseStep(
        xyz(tip[0]),
        xyzw(rotation[0]),
        None if path.jaw_rad is None else float(path.jaw_rad[after]),
        after,
        float(path.elapsed_s[after]),
        (last - after) / last,
        off_mm,
        off_rad,
        bool(phase == last and off_mm <= limits.step_mm and off_rad <= limits.step_rad),
    )


def joined_phase(path: PosePath, tip_mm: Floats, rotation_xyzw: Floats, limits: TubeLimits) -> int:
    """Return the phase at which a start joins a path: that of the nearest pose with enough of the path left.

    Args:
        path: The motion to follow.
        tip_mm: Position in the frame of the path, shape (1, 3).
        rotation_xyzw: Orientation, a unit quaternion, shape (1, 4).
        limits: The joining rule; near is by the larger of distance over `start_mm` and angle over `start_rad`.

    Returns:
        The phase, the first of equally near ones.
    """
    starts = max(float(limits.start_mm), ROUNDING), max(float(limits.start_rad), ROUNDING)
    some = 1 + floor((1.0 - limits.join_share) * (len(path.tip_mm) - 1) + ROUNDING)
    return int(nearest_pose(path.tip_mm[:some], path.rotation_xyzw[:some], tip_mm, rotation_xyzw, *starts))


def near_share(path: PosePath, limits: TubeLimits, radius_mm: float) -> float:
    """Return the least share of a path that a start near its first pose follows, if it is given no phase.

    A pose that is the nearest of such a start is at most twice the radius from the first one. The starts on the lines
    to these poses are tried, and where the path comes back to them, a lattice of others.

    Args:
        path: The motion to follow.
        limits: The joining rule.
        radius_mm: A start is near within this distance of the first pose, in its orientation.

    Returns:
        The share, 0 to 1; 1 of the first phase.
    """
    last, away_mm = len(path.tip_mm) - 1, path.tip_mm - path.tip_mm[0]
    far_mm = np.linalg.norm(away_mm, axis=1, keepdims=True)
    close = far_mm[:, 0] <= 2 * radius_mm
    starts_mm = away_mm[close] * np.minimum(1.0, radius_mm / np.maximum(far_mm[close], ROUNDING))
    if close[np.argmin(close) :].any():
        steps = np.linspace(-radius_mm, radius_mm, 2 * LATTICE + 1)
        lattice = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
        starts_mm = np.concatenate([starts_mm, lattice[np.linalg.norm(lattice, axis=1) <= radius_mm]])
    first_xyzw = path.rotation_xyzw[:1]
    joined = [joined_phase(path, path.tip_mm[:1] + one, first_xyzw, limits) for one in starts_mm]
    return 1 - max(joined) / last


def _row(values: ArrayLike, count: int, name: str) -> Floats:
    """Return a row of finite numbers, shape (1, count); faster than `frozen`, because it is called 100 times a second.

    Raises:
        BadInput: The shape is another one, or a number is not finite.
    """
    row = np.array([values], np.float64)
    if row.shape != (1, count) or not all(map(isfinite, row[0].tolist())):
        frozen(values, np.float64, (count,), name)  # raises
    return row


@inner
def angle_between(a: Any, i: Any, b: Any, j: Any) -> Any:
    """Return the angle between the orientations of row i of `a` and row j of `b`, unit quaternions, in rad.

    Args:
        a: Quaternions x, y, z, w, shape (N, 4).
        i: Index of a row of `a`.
        b: Quaternions x, y, z, w, shape (M, 4).
        j: Index of a row of `b`.

    Returns:
        The angle, 0 to pi; q and -q are the same orientation.
    """
    w = a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2] + a[i, 3] * b[j, 3]
    x = a[i, 3] * b[j, 0] - a[i, 0] * b[j, 3] - a[i, 1] * b[j, 2] + a[i, 2] * b[j, 1]
    y = a[i, 3] * b[j, 1] + a[i, 0] * b[j, 2] - a[i, 1] * b[j, 3] - a[i, 2] * b[j, 0]
    z = a[i, 3] * b[j, 2] - a[i, 0] * b[j, 1] + a[i, 1] * b[j, 0] - a[i, 2] * b[j, 3]
    return 2.0 * atan2(sqrt(x * x + y * y + z * z), abs(w))


@inner
def distance_between(a: Any, i: Any, b: Any, j: Any) -> Any:
    """Return the distance between the positions of row i of `a` and row j of `b`, in mm.

    Args:
        a: Positions in mm, shape (N, 3).
        i: Index of a row of `a`.
        b: Positions in mm in the same frame, shape (M, 3).
        j: Index of a row of `b`.
    """
    x, y, z = b[j, 0] - a[i, 0], b[j, 1] - a[i, 1], b[j, 2] - a[i, 2]
    return sqrt(x * x + y * y + z * z)


@compiled
def step_along(
    path_mm: Any,
    path_xyzw: Any,
    tip_mm: Any,
    rotation_xyzw: Any,
    phases: Any,
    off: Any,
    step_mm: float,
    step_rad: float,
    ahead: int,
) -> None:
    """Make one tick of runs along a path, as the module describes it.

    Args:
        path_mm: Positions of the path, shape (N, 3), float64.
        path_xyzw: Its orientations, unit quaternions, shape (N, 4), float64.
        tip_mm: The positions reached, in the same frame, shape (R, 3), float64, replaced by the commanded ones.
        rotation_xyzw: The orientations reached, unit quaternions, shape (R, 4), float64, replaced likewise.
        phases: The phases before the tick, shape (R,), int64, replaced by those after it.
        off: Distance in mm and angle in rad from the pose of the phase before the tick, shape (R, 2), float64, filled.
        step_mm: Longest step of the position in a tick.
        step_rad: Largest turn in a tick.
        ahead: Phases that one tick may advance.
    """
    last = len(path_mm) - 1
    for run in range(len(phases)):
        phase = phases[run]
        off_mm = distance_between(tip_mm, run, path_mm, phase)
        off_rad = angle_between(rotation_xyzw, run, path_xyzw, phase)
        off[run, 0], off[run, 1] = off_mm, off_rad
        there = min(phase + ahead, last)
        while there > phase and not (
            distance_between(tip_mm, run, path_mm, there) <= step_mm
            and angle_between(rotation_xyzw, run, path_xyzw, there) <= step_rad
        ):
            there -= 1
        if there > phase or (off_mm <= step_mm and off_rad <= step_rad):
            # A pose that is reached is commanded exactly, without the rounding of a step towards it.
            for axis in range(3):
                tip_mm[run, axis] = path_mm[there, axis]
            for axis in range(4):
                rotation_xyzw[run, axis] = path_xyzw[there, axis]
            phases[run] = there
            continue
        share = step_mm / max(off_mm, step_mm)
        for axis in range(3):
            tip_mm[run, axis] += share * (path_mm[phase, axis] - tip_mm[run, axis])
        # The quaternion on the shorter way, at a share of its angle (Shoemake, Animating Rotation, 1985).
        share, half = step_rad / max(off_rad, step_rad), off_rad / 2.0
        dot = 0.0
        for axis in range(4):
            dot += rotation_xyzw[run, axis] * path_xyzw[phase, axis]
        whole = sin(half)
        stay, go = 1.0 - share, share
        if whole > SMALLEST_SINE:
            stay, go = sin((1.0 - share) * half) / whole, sin(share * half) / whole
        if dot < 0.0:
            go = -go
        length = 0.0
        for axis in range(4):
            rotation_xyzw[run, axis] = stay * rotation_xyzw[run, axis] + go * path_xyzw[phase, axis]
            length += rotation_xyzw[run, axis] * rotation_xyzw[run, axis]
        length = sqrt(length)
        for axis in range(4):
            rotation_xyzw[run, axis] /= length


@compiled
def nearest_pose(
    path_mm: Any, path_xyzw: Any, tip_mm: Any, rotation_xyzw: Any, start_mm: float, start_rad: float
) -> Any:
    """Return the index of the nearest pose, by the larger of distance over `start_mm` and angle over `start_rad`.

    Args:
        path_mm: Positions of the path, shape (N, 3), float64.
        path_xyzw: Its orientations, unit quaternions, shape (N, 4), float64.
        tip_mm: A position in the same frame, shape (1, 3), float64.
        rotation_xyzw: An orientation, a unit quaternion, shape (1, 4), float64.
        start_mm: The distance that counts as much as an angle of `start_rad`, above 0.
        start_rad: That angle, above 0.

    Returns:
        The index, the first of equally near ones.
    """
    nearest, best = 0, -1.0
    for phase in range(len(path_mm)):
        off_mm = distance_between(tip_mm, 0, path_mm, phase) / start_mm
        off = max(off_mm, angle_between(rotation_xyzw, 0, path_xyzw, phase) / start_rad)
        if best < 0.0 or off < best:
            nearest, best = phase, off
    return nearest


def advance(path: PosePath, hands: Hands, limits: TubeLimits) -> Hands:
    """Return the commanded poses of one tick, and the phases after it; see the module's description.

    Args:
        path: The motion to follow.
        hands: The poses reached, and the phases before the tick.
        limits: Steps and window.

    Returns:
        The commanded poses and the phases after the tick.
    """
    tip, rotation = (np.array(of, np.float64, order="C") for of in (hands.tip_mm, hands.rotation_xyzw))
    phases = np.array(hands.phases, np.int64)
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    steps = float(limits.step_mm), float(limits.step_rad), int(limits.ahead)
    step_along(path.tip_mm, path.rotation_xyzw, tip, rotation, phases, np.empty((len(tip), 2)), *steps)
    return Hands(tip, rotation, phases)
