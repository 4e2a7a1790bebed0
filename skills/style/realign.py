"""A2: turning PSM_A's jaw for the hand-off, as Sec. III-D of the paper asks.

Symbols: a rotation's columns are [n o a]: n the normal of the jaw (its hinge axis), o from finger to finger, a the
approach. The paper wants PSM_A to approach PSM_M orthogonally, with n of PSM_A parallel to a of PSM_M. It gives no
formula; the reading of n, o, a as the dVRK's columns and everything below is ours.

The target has n* = sign * a_M, and for a* what the wanted approach leaves when its part along a_M is taken away. So a*
is orthogonal to a_M by itself, and of the two signs the one with the smaller turn is taken.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from skills.style._arrays import Floats, frozen
from skills.style.handoff import unit_approach
from skills.style.kinematics import check_rotation, quaternion_of

_TOO_PARALLEL = 0.1  # of a unit vector's part across a_M: with less, its direction there is a matter of round-off
_TIE_RAD = 1e-9  # turns nearer than this are equal, and the positive sign is taken


@dataclass(frozen=True, eq=False)
class Realignment:
    """Where A2 turns the jaw, and how.

    Attributes:
        rotation: Target [n o a] in the PSM_A base frame, shape (3, 3).
        angle_rad: The turn from the present rotation, 0 to pi.
        axis: Its axis in the PSM_A base frame, shape (3,); the target's n where nothing turns.
        sign: +1 where n* runs along a_M, -1 where against it.
    """

    rotation: Floats
    angle_rad: float
    axis: Floats
    sign: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation", frozen(self.rotation, np.float64, (3, 3), "rotation"))
        object.__setattr__(self, "axis", frozen(self.axis, np.float64, (3,), "axis"))


def realign(rotation: ArrayLike, approach_m: ArrayLike, toward: ArrayLike | None = None) -> Realignment:
    """Find the jaw pose in which PSM_A hands the needle to PSM_M (Sec. III-D).

    Args:
        rotation: PSM_A's present rotation [n o a] in its base frame, shape (3, 3).
        approach_m: PSM_M's approach a_M in the *same* frame, shape (3,), of any length. The two arms have different
            base frames; bringing it here needs their registration.
        toward: Direction from PSM_A's tip to PSM_M's, same frame, shape (3,), which the new approach shall follow as
            far as it can; by default the present approach, which turns least.

    Raises:
        BadInput: A number is NaN or infinite, or `rotation` is none.
        NoApproach: `approach_m` has no length.
    """
    present = frozen(rotation, np.float64, (3, 3), "rotation")
    check_rotation(present[None])
    a_m = unit_approach(approach_m)
    a_star = _across(a_m, present, toward)
    options = [_toward(present, sign * a_m, a_star, sign) for sign in (1, -1)]
    return options[1] if options[1].angle_rad < options[0].angle_rad - _TIE_RAD else options[0]


def turn(rotation: ArrayLike, target: ArrayLike, fractions: ArrayLike) -> Floats:
    """Turn evenly about one axis from one rotation to another (slerp).

    Args:
        rotation: Start [n o a], shape (3, 3).
        target: End [n o a], shape (3, 3).
        fractions: How much of the turn is done, 0 to 1, shape (T,).

    Returns:
        Rotations, shape (T, 3, 3). A half turn, whose axis has no sign, takes one and the same each time.
    """
    start = frozen(rotation, np.float64, (3, 3), "rotation")
    angle, axis = _turn_between(start, frozen(target, np.float64, (3, 3), "target"))
    u = frozen(fractions, np.float64, (None,), "fractions") * angle
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    about = np.eye(3) + np.sin(u)[:, None, None] * cross + (1 - np.cos(u))[:, None, None] * (cross @ cross)
    return np.asarray(about @ start)


def _across(a_m: Floats, present: Floats, toward: ArrayLike | None) -> Floats:
    """Take the first wanted approach that is not along a_M, and return its part across a_M, of unit length."""
    n, o, a = present.T
    wanted = [a, o, n] if toward is None else [frozen(toward, np.float64, (3,), "toward"), a, o, n]
    for direction in wanted:
        v = _unit(direction)
        across = None if v is None else v - a_m * (a_m @ v)
        if across is not None and np.linalg.norm(across) >= _TOO_PARALLEL:
            across = across / np.linalg.norm(across)
            across = across - a_m * (a_m @ across)  # again, to lose what the subtraction left
            return np.asarray(across / np.linalg.norm(across))
    raise AssertionError("three orthogonal directions cannot all be along one")


def _toward(present: Floats, n_star: Floats, a_star: Floats, sign: int) -> Realignment:
    target = np.stack([n_star, np.cross(a_star, n_star), a_star], axis=1)
    angle, axis = _turn_between(present, target)
    return Realignment(target, angle, n_star if angle == 0 else axis, sign)


def _turn_between(start: Floats, target: Floats) -> tuple[float, Floats]:
    """Measure the turn that leads from start to target: its angle, 0 to pi, and its axis in the base frame."""
    x, y, z, w = quaternion_of((target @ start.T)[None])[0]
    vector = np.array([x, y, z]) * (1.0 if w >= 0 else -1.0)
    length = float(np.linalg.norm(vector))
    if length < 1e-15:
        return 0.0, np.array([0.0, 0.0, 1.0])
    return float(2 * np.arctan2(length, abs(w))), vector / length


def _unit(vector: Floats) -> Floats | None:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-12 else None
