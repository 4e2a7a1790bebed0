"""Following a pose path from where the hand is, and a tube that the motion provably stays in.

    PosePath, pose, phase --next_pose--> the next pose and phase
    PosePath, TubeLimits --certify_tube--> TubeCertificate

Phase k is the index of a pose of the path. In each tick the farthest pose of the next `ahead` phases that one step can
reach, in mm and in rad, becomes the phase, and is where the hand is sent; if not even the present phase's pose can be
reached, a whole step is made towards it, and the phase waits. So time does not run away from a hand that is held.

*The bound.* Let s be the longest step, e the largest disturbance of a tick, m the path's largest move over the window,
and r the distance from the pose of the phase, each in mm and each in rad.

1. If r <= e and e + m <= s, all of the window can be reached, so the hand is sent to phase k + `ahead` exactly, and
   after the disturbance r <= e again. The rest of the path takes one tick for each window.
2. Otherwise, if the pose of the phase is beyond s, r becomes at most r - s + e, which is smaller as s > e; if it is
   within s, the hand is sent to a pose of the path, and r <= e afterwards.

So a start at most r0 from the path comes within e of it in finite time, and the distance is never above the larger of
r0 and e: the radius of the tube. Between two ticks the hand moves on the straight line, and with a window of several
phases the path may bulge from it; that bulge is added. Distances of poses are Euclidean, those of orientations the
angle of the rotation between them; both obey the triangle inequality, which is all that is used.

The premises are checked, not assumed: `certify_tube` measures m and the bulge on the path, and calls the update itself
at every phase, at the distances at which its branches meet. It does not prove anything of the arm that executes it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from skills.arrays import Flags, Floats, Ints, frozen
from skills.errors import BadSettings
from skills.fields import schema
from skills.learning.pose_style import PosePath, unit_quaternion

ROUNDING = 1e-9  # mm and rad: a step computed in double precision is off by about 1e-14
DIRECTIONS = 26  # towards which the update is tried: along the axes, and the diagonals between them


@schema
@dataclass(frozen=True)
class TubeLimits:
    """The assumptions of a tube.

    Attributes:
        step_mm: Longest step of the position in a tick.
        step_rad: Largest turn in a tick.
        disturbance_mm: Largest distance between the commanded position and the one that is reached in a tick.
        disturbance_rad: Largest angle between the commanded orientation and the one that is reached.
        start_mm: Largest distance of a start from the path.
        start_rad: Largest angle of a start from the path's orientation there.
        ahead: Phases that one tick may advance.
    """

    step_mm: float = 6.0  # with 101 phases of a hand-off of 60 mm a phase is 0.6 mm on average, 2 mm where it is fast
    step_rad: float = 0.2
    disturbance_mm: float = 1.0  # a calibrated dVRK arm is within 1 mm of its command
    disturbance_rad: float = 0.02
    start_mm: float = 20.0
    start_rad: float = 0.5
    ahead: int = 1

    def __post_init__(self) -> None:
        numbers = [
            self.step_mm,
            self.step_rad,
            self.disturbance_mm,
            self.disturbance_rad,
            self.start_mm,
            self.start_rad,
        ]
        if not (np.isfinite(numbers).all() and min(numbers) >= 0 and 1 <= self.ahead <= 100):
            raise BadSettings("The limits of a tube are finite and not negative, and it looks 1 to 100 phases ahead.")
        if not (self.disturbance_mm < self.step_mm and self.disturbance_rad < self.step_rad):
            raise BadSettings(
                "The disturbance of a tick must be smaller than its step, or the hand need never arrive; "
                "make the step longer.",
                step_mm=self.step_mm,
                disturbance_mm=self.disturbance_mm,
                step_rad=self.step_rad,
                disturbance_rad=self.disturbance_rad,
            )


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

    @property
    def rotations(self) -> Rotation:
        """The orientations."""
        return Rotation.from_quat(self.rotation_xyzw)


Update = Callable[[PosePath, Hands, TubeLimits], Hands]


def next_pose(
    path: PosePath, tip_mm: ArrayLike, rotation_xyzw: ArrayLike, phase: int | None, limits: TubeLimits
) -> tuple[Floats, Floats, int]:
    """Return the next pose and phase for a pose that the hand has reached.

    Args:
        path: The motion to follow.
        tip_mm: Position in the frame of the path, shape (3,).
        rotation_xyzw: Orientation, a unit quaternion, shape (4,).
        phase: The phase that the last call returned; None at the start: the nearest of the path (`nearest_phase`).
        limits: Steps and window; disturbance and start are not used.

    Returns:
        The next position, shape (3,), orientation, shape (4,), and phase. The motion is finished when the phase is the
        last one and its pose is reached.

    Raises:
        BadInput: A number is not finite, or the quaternion is not a unit quaternion.
        BadSettings: There is no such phase.
    """
    tip = frozen(tip_mm, np.float64, (3,), "tip_mm")
    rotation = unit_quaternion(rotation_xyzw, "rotation_xyzw")
    if phase is not None and not 0 <= phase < len(path.tip_mm):
        raise BadSettings(f"The path has the phases 0 to {len(path.tip_mm) - 1}.", phase=phase)
    now = nearest_phase(path, tip, Rotation.from_quat(rotation), limits) if phase is None else phase
    after = advance(path, Hands(tip[None], rotation[None], np.array([now])), limits)
    return after.tip_mm[0], after.rotation_xyzw[0], int(after.phases[0])


def nearest_phase(path: PosePath, tip_mm: Floats, rotation: Rotation, limits: TubeLimits) -> int:
    """Return the phase whose pose is nearest, the larger of distance over `start_mm` and angle over `start_rad`."""
    off_mm = np.linalg.norm(path.tip_mm - tip_mm, axis=1) / max(limits.start_mm, ROUNDING)
    off_rad = (rotation.inv() * Rotation.from_quat(path.rotation_xyzw)).magnitude() / max(limits.start_rad, ROUNDING)
    return int(np.argmin(np.maximum(off_mm, off_rad)))


def advance(path: PosePath, hands: Hands, limits: TubeLimits) -> Hands:
    """Return the commanded poses of one tick, and the phases after it; see the module's description.

    Args:
        path: The motion to follow.
        hands: The poses reached, and the phases before the tick.
        limits: Steps and window.

    Returns:
        The commanded poses and the phases after the tick.
    """
    poses, last = Rotation.from_quat(path.rotation_xyzw), len(path.tip_mm) - 1
    back = hands.rotations.inv()
    phases, reached = hands.phases.copy(), np.zeros(len(hands.phases), bool)
    for ahead in range(limits.ahead, -1, -1):
        there = np.minimum(hands.phases + ahead, last)
        off_mm = np.linalg.norm(path.tip_mm[there] - hands.tip_mm, axis=1)
        off_rad = (back * poses[there]).magnitude()
        now = ~reached & (off_mm <= limits.step_mm) & (off_rad <= limits.step_rad)
        phases[now], reached = there[now], reached | now
    to_mm = path.tip_mm[phases] - hands.tip_mm
    turn = (back * poses[phases]).as_rotvec()
    far_mm, far_rad = np.linalg.norm(to_mm, axis=1), np.linalg.norm(turn, axis=1)
    # A pose that is reached is commanded exactly, without the rounding of a step towards it.
    tip_mm = hands.tip_mm + to_mm * (limits.step_mm / np.maximum(far_mm, limits.step_mm))[:, None]
    turned = hands.rotations * Rotation.from_rotvec(
        turn * (limits.step_rad / np.maximum(far_rad, limits.step_rad))[:, None]
    )
    exact = np.where(reached[:, None], path.rotation_xyzw[phases], turned.as_quat())
    return Hands(np.where(reached[:, None], path.tip_mm[phases], tip_mm), exact, phases)


@schema
@dataclass(frozen=True)
class TubeCertificate:
    """The proof that a motion stays in a tube around a path and reaches its end, under the limits that it states.

    Attributes:
        limits: The assumptions.
        move_mm: The path's largest move within the window.
        move_rad: Its largest turn within the window.
        radius_mm: No position is further from the path.
        radius_rad: No orientation is further from the path's at the phase.
        ticks: After so many ticks every run has reached the end.
        checked: Updates that were checked.
        faults: Premises that do not hold; the certificate holds if there are none.
    """

    limits: TubeLimits
    move_mm: float
    move_rad: float
    radius_mm: float
    radius_rad: float
    ticks: int
    checked: int
    faults: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether every premise holds, and something was checked."""
        return not self.faults and self.checked > 0


def certify_tube(path: PosePath, limits: TubeLimits, update: Update = advance) -> TubeCertificate:
    """Certify that runs from all starts near a path stay in a tube around it and reach its end.

    Args:
        path: The motion to follow.
        limits: The assumptions.
        update: The update of one tick.

    Returns:
        The certificate, with the premises that do not hold.
    """
    moves = [_moves(path, ahead) for ahead in range(1, limits.ahead + 1)]
    move_mm, move_rad = (float(max(move[k] for move in moves)) for k in (0, 1))
    faults = []
    for unit, step, disturbance, move in (
        ("mm", limits.step_mm, limits.disturbance_mm, move_mm),
        ("rad", limits.step_rad, limits.disturbance_rad, move_rad),
    ):
        if not disturbance + move <= step:  # written so that NaN fails
            faults.append(
                f"A step of {step:g} {unit} is not as long as the disturbance of {disturbance:g} {unit} and the path's "
                f"move of {move:.3g} {unit} together"
            )
    if not (np.abs(np.linalg.norm(path.rotation_xyzw, axis=1) - 1.0) <= ROUNDING).all():
        faults.append("The path has quaternions that are not of length one")
    tried, wrong = _try_update(path, limits, update)
    bulge_mm, bulge_rad = _bulge(path, limits.ahead)
    approach = max(
        (limits.start_mm - limits.disturbance_mm) / (limits.step_mm - limits.disturbance_mm),
        (limits.start_rad - limits.disturbance_rad) / (limits.step_rad - limits.disturbance_rad),
        0.0,
    )
    return TubeCertificate(
        limits,
        move_mm,
        move_rad,
        max(limits.start_mm, limits.disturbance_mm) + bulge_mm,
        max(limits.start_rad, limits.disturbance_rad) + bulge_rad,
        ceil(approach) + 1 + ceil((len(path.tip_mm) - 1) / limits.ahead),
        tried,
        (*faults, *wrong),
    )


def _moves(path: PosePath, ahead: int) -> tuple[float, float]:
    """Return the largest distance and angle between two poses of a path that are some phases apart."""
    rotations = Rotation.from_quat(path.rotation_xyzw)
    moved = np.linalg.norm(path.tip_mm[ahead:] - path.tip_mm[:-ahead], axis=1)
    return float(moved.max(initial=0.0)), float(
        (rotations[:-ahead].inv() * rotations[ahead:]).magnitude().max(initial=0.0)
    )


def _bulge(path: PosePath, ahead: int) -> tuple[float, float]:
    """Return how far a path is at most from the straight way between two poses of it within the window, mm and rad."""
    furthest_mm, furthest_rad = 0.0, 0.0
    rotations = Rotation.from_quat(path.rotation_xyzw)
    for window in range(2, ahead + 1):
        turn = (rotations[:-window].inv() * rotations[window:]).as_rotvec()
        for inside in range(1, window):
            share = inside / window
            chord = (1 - share) * path.tip_mm[:-window] + share * path.tip_mm[window:]
            off = np.linalg.norm(path.tip_mm[inside : inside - window] - chord, axis=1)
            way = rotations[:-window] * Rotation.from_rotvec(share * turn)
            angle = (way.inv() * rotations[inside : inside - window]).magnitude()
            furthest_mm, furthest_rad = max(furthest_mm, off.max()), max(furthest_rad, angle.max())
    return float(furthest_mm), float(furthest_rad)


def _try_update(path: PosePath, limits: TubeLimits, update: Update) -> tuple[int, list[str]]:
    """Check what the bound assumes of the update, at every phase, to all sides, at the distances that decide.

    Returns:
        The number of updates checked, and the assumptions that do not hold.
    """
    sides = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)])
    sides = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    far_mm, far_rad = (
        _deciding(step, disturbance, start)
        for step, disturbance, start in (
            (limits.step_mm, limits.disturbance_mm, limits.start_mm),
            (limits.step_rad, limits.disturbance_rad, limits.start_rad),
        )
    )
    grid = np.stack(
        np.meshgrid(np.arange(len(path.tip_mm)), np.arange(DIRECTIONS), far_mm, far_rad, indexing="ij"), axis=-1
    ).reshape(-1, 4)
    phases, side = grid[:, 0].astype(np.int64), grid[:, 1].astype(np.int64)
    poses = Rotation.from_quat(path.rotation_xyzw)
    before = Hands(
        path.tip_mm[phases] + sides[side] * grid[:, 2:3],
        (poses[phases] * Rotation.from_rotvec(sides[side[::-1]] * grid[:, 3:])).as_quat(),
        phases,
    )
    after = update(path, before, limits)
    stepped = np.linalg.norm(after.tip_mm - before.tip_mm, axis=1)
    turned = (before.rotations.inv() * after.rotations).magnitude()
    off_mm = np.linalg.norm(after.tip_mm - path.tip_mm[after.phases], axis=1)
    off_rad = (after.rotations.inv() * poses[after.phases]).magnitude()
    waits = after.phases == before.phases
    wanted_mm = np.where(waits, np.maximum(grid[:, 2] - limits.step_mm, 0.0), 0.0)
    wanted_rad = np.where(waits, np.maximum(grid[:, 3] - limits.step_rad, 0.0), 0.0)
    inside = (grid[:, 2] <= limits.disturbance_mm) & (grid[:, 3] <= limits.disturbance_rad)
    due = np.minimum(before.phases + limits.ahead, len(path.tip_mm) - 1)
    checks: dict[str, Flags] = {
        "An orientation is not a unit quaternion": (
            np.abs(np.linalg.norm(after.rotation_xyzw, axis=1) - 1.0) <= ROUNDING
        ),
        "A step is longer than the longest": stepped <= limits.step_mm + ROUNDING,
        "A turn is larger than the largest": turned <= limits.step_rad + ROUNDING,
        "The phase advances by more than the window, or goes back": (
            (after.phases >= before.phases) & (after.phases <= due)
        ),
        "The phase advances to a position that is not reached": waits | (off_mm <= ROUNDING),
        "The phase advances to an orientation that is not reached": waits | (off_rad <= ROUNDING),
        "A step does not come nearer to the position by its whole length": off_mm <= wanted_mm + ROUNDING,
        "A turn does not come nearer to the orientation by its whole size": off_rad <= wanted_rad + ROUNDING,
        "The phase does not advance by the window within the disturbance": ~inside | (after.phases == due),
    }
    return len(grid), [
        f"{name} at {int((~held).sum())} of {len(grid)} poses" for name, held in checks.items() if not held.all()
    ]


def _deciding(step: float, disturbance: float, start: float) -> Floats:
    """Return the distances at which the branches of the update meet, and some between them."""
    return np.unique(
        [0.0, disturbance / 2, disturbance, (disturbance + step) / 2, step, 1.001 * step, (step + start) / 2, start]
    )
