"""Hand-off geometry: the needle between the jaws of both arms, and the turn of PSM_A's jaw in A2 (Sec. III-D).

    rotation of PSM_A, approach a_M of PSM_M --realign--> Realignment, the target of A2
    pose of PSM_A after A2, a_M --hand_off--> pose of PSM_M's jaws around the needle

Symbols: the columns of a rotation are [n o a]: n the normal of the jaw (its hinge axis), o from finger to finger, a the
approach. a_M is the approach of PSM_M.

A2: the paper wants PSM_A to approach PSM_M orthogonally, with n of PSM_A parallel to a of PSM_M. It gives no formula;
the reading of n, o, a as the dVRK's columns and everything below are ours. The target has n* = sign * a_M, and a* is
the desired approach minus its component along a_M. So a* is orthogonal to a_M by construction, and of the two signs the
one with the smaller turn is taken.

Hand-off: after A2 the hinge axis n of PSM_A lies along a_M, and the needle's tangent in PSM_A's jaws lies along n. So
PSM_M cannot hold the needle at the same place: its jaws close around a needle that runs along *their* hinge axis, which
is normal to a_M. A quarter of the circle further along, the needle does run that way. The paper does not state where
PSM_M grips; this choice is ours.

The needle lies in the plane normal to PSM_A's approach, its free end on the side from which PSM_M comes, so that PSM_M
reaches it from outside its circle.
"""

from dataclasses import dataclass
from math import pi, radians
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from skills.arithmetic import arctan2, cos, product, sin
from skills.arrays import Floats, freeze, frozen
from skills.errors import BadPlan, NoApproach
from skills.kinematics import DEFAULT_INSTRUMENT, check_rotation, instrument_of, matrix_of, quaternion_of
from skills.quaternions import unit

NEEDLE_RADIUS_MM = 26.0 / pi  # a half circle of 26 mm along the arc, as in `urdf/needle.urdf`
HELD_MM = 9.0  # from the hinge along the approach to the place where the jaws hold the needle; the fingers end at 10.2
# From PSM_M's hinge to the place where it takes the needle. Ours: 2 mm nearer to the hinge than in PSM_A's jaws,
# because at 9 mm the needle slips off the tips in 18 of 100 hand-offs of calibrated arms, and at 7 mm in one of 1000
# (`skills.verification.monte_carlo`).
TAKEN_MM = 7.0
HOLDING_RAD = 0.06  # opening of each finger of jaws that hold a needle
OPEN_RAD = radians(30)  # opening of each finger of PSM_M as it comes in: 60 degrees in all, as `open()` of dvrk_python
JAW_CLOSED_RAD = radians(-20)  # as `close()` of dvrk_python's PSM: beyond closed, so that the jaw presses
JAW_OPEN_RAD = 2 * OPEN_RAD
JAW_S = 0.8  # ours: from open to closed; a finger then accelerates at half of its limit
NEEDLE_FREE_RAD = 2 * pi / 3  # of the arc beyond PSM_A's grip: two thirds of a half circle, as in urdf/needle.urdf
_NO_LENGTH = 1e-12
_PARALLEL = 1e-9  # of a cosine: 45 microradians, for quaternions of six digits

Enters = Literal["start", "after_A1"]


@dataclass(frozen=True)
class PsmM:
    """The data about PSM_M that a plan uses, in the frame of the planned arm.

    Attributes:
        approach: Direction in which it approaches the needle, of any length.
        base_mm: Position of its remote centre; None if it is not known, and then PSM_M is in no scene and in no bag.
        base_xyzw: Rotation of its base, a unit quaternion; None exactly where `base_mm` is None.
        instrument: Number of its instrument.
        enters: "after_A1": it comes in during A2, as a surgeon would bring it; "start": it waits at the hand-off from
            the start.
        approach_from: Source of the approach, in words.
        base_from: Source of the base, in words; None exactly where `base_mm` is None.
        taken_mm: Its recorded position as it takes the needle; None if it was not recorded, or is not to be used.
        taken_xyzw: Its recorded rotation there, a unit quaternion; None exactly where `taken_mm` is None.
    """

    approach: tuple[float, float, float]
    base_mm: tuple[float, float, float] | None = None
    base_xyzw: tuple[float, float, float, float] | None = None
    instrument: str = DEFAULT_INSTRUMENT
    enters: Enters = "after_A1"
    approach_from: str = "the caller"
    base_from: str | None = None
    taken_mm: tuple[float, float, float] | None = None
    taken_xyzw: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        unit_approach(self.approach)
        if (self.taken_mm is None) != (self.taken_xyzw is None):
            raise BadPlan("PSM_M's recorded pose is a position and a rotation; give both, or neither.")
        if self.taken_mm is not None and self.taken_xyzw is not None:
            frozen(self.taken_mm, np.float64, (3,), "taken_mm")
            matrix_of([self.taken_xyzw])
        instrument_of(self.instrument)
        if self.enters not in get_args(Enters):
            raise BadPlan(f"PSM_M enters at one of {', '.join(get_args(Enters))}.")
        if self.base_mm is None or self.base_xyzw is None:
            if self.base_mm is not None or self.base_xyzw is not None or self.base_from is not None:
                raise BadPlan("PSM_M's base is a position and a rotation; give both, or neither.")
            return
        frozen(self.base_mm, np.float64, (3,), "base_mm")
        matrix_of([self.base_xyzw])
        if self.base_from is None:
            object.__setattr__(self, "base_from", "the caller")


@dataclass(frozen=True, eq=False)
class OtherArm:
    """The motion of PSM_M during a trajectory of PSM_A, sample by sample.

    Attributes:
        base_mm: Its remote centre in the PSM_A base frame, shape (3,).
        base_xyzw: The rotation of its base in that frame, unit quaternion, shape (4,).
        instrument: Number of its instrument.
        joints: Its joints at every sample of the trajectory, rad and mm, shape (T, 6).
        jaw_rad: Angle of its jaw, shape (T,); None: not planned.
    """

    base_mm: Floats
    base_xyzw: Floats
    instrument: str
    joints: Floats
    jaw_rad: Floats | None = None

    def __post_init__(self) -> None:
        freeze(self, base_mm=(3,), base_xyzw=(4,), joints=(None, 6), jaw_rad=(len(self.joints),))
        matrix_of(self.base_xyzw[None])


def needle_tips_mm() -> Floats:
    """Return the needle's free end relative to the hinge of the jaws that hold it, on either side, mm, shape (2, 3).

    In the frame [n o a] of the jaws: `HELD_MM` along the approach the arc begins along n, to the one side or the other.
    """
    along, across = NEEDLE_RADIUS_MM * sin(NEEDLE_FREE_RAD), NEEDLE_RADIUS_MM * (1 - cos(NEEDLE_FREE_RAD))
    return np.array([[along, across, HELD_MM], [-along, -across, HELD_MM]])


def unit_approach(approach_m: ArrayLike) -> Floats:
    """Return the direction of an approach as a unit vector, shape (3,).

    Args:
        approach_m: The approach, of any length, shape (3,).

    Raises:
        NoApproach: It has no length.
    """
    direction = frozen(approach_m, np.float64, (3,), "approach_m")
    length = float(np.linalg.norm(direction, axis=-1))
    if not length > _NO_LENGTH:
        raise NoApproach("PSM_M's approach has length 0; give its direction in PSM_A's base frame.")
    return np.asarray(direction / length)


def hand_off(tip_mm: ArrayLike, rotation: ArrayLike, approach_m: ArrayLike) -> tuple[Floats, Floats]:
    """Return the poses in which PSM_M takes the needle from PSM_A.

    Args:
        tip_mm: PSM_A's tip (its hinge) after A2, mm in any one frame, shape (T, 3).
        rotation: Its rotation [n o a] there, shape (T, 3, 3); n lies along `approach_m`.
        approach_m: PSM_M's approach in the same frame, of any length, shape (3,).

    Returns:
        PSM_M's tip (its hinge), mm, shape (T, 3), and its rotation [n o a], shape (T, 3, 3), both in that frame.

    Raises:
        BadPlan: PSM_A's jaw is not turned for the hand-off: its n and a_M are not parallel.
        NoApproach: `approach_m` has no length.
    """
    turned = frozen(rotation, np.float64, (None, 3, 3), "rotation")
    check_rotation(turned)
    a_m = unit_approach(approach_m)
    if not (np.abs(product(turned[:, :, 0], a_m)) >= 1 - _PARALLEL).all():
        raise BadPlan("PSM_A's jaw is not turned to PSM_M's approach; realign it first.")
    a = turned[:, :, 2]
    # The needle's tangent where PSM_M takes it: a quarter of a circle after PSM_A's grip it points from that grip
    # towards the centre.
    tangent = np.cross(a_m, a)
    tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    held = frozen(tip_mm, np.float64, (None, 3), "tip_mm") + HELD_MM * a
    taken = held + NEEDLE_RADIUS_MM * (tangent - a_m)
    approach = np.broadcast_to(a_m, a.shape)
    jaws = np.stack([tangent, np.cross(approach, tangent), approach], axis=2)
    return taken - TAKEN_MM * a_m, jaws


_TOO_PARALLEL = 0.1  # least length of a unit vector's part across a_M: below it, round-off decides its direction
_TIE_RAD = 1e-9  # turns that differ by less are equal, and the positive sign is taken


@dataclass(frozen=True, eq=False)
class Realignment:
    """The target of A2 and the turn that leads to it.

    Attributes:
        rotation: Target [n o a] in the PSM_A base frame, shape (3, 3).
        angle_rad: Angle of the turn from the present rotation, 0 to pi.
        axis: Axis of the turn in the PSM_A base frame, shape (3,); the target's n if nothing turns.
        sign: +1 if n* runs along a_M, -1 if against it.
    """

    rotation: Floats
    angle_rad: float
    axis: Floats
    sign: int

    def __post_init__(self) -> None:
        freeze(self, rotation=(3, 3), axis=(3,))


def realign(rotation: ArrayLike, approach_m: ArrayLike, toward: ArrayLike | None = None) -> Realignment:
    """Return the rotation of the jaw in which PSM_A hands the needle to PSM_M, and the turn to it (Sec. III-D).

    Args:
        rotation: PSM_A's present rotation [n o a] in its base frame, shape (3, 3).
        approach_m: PSM_M's approach a_M in the *same* frame, shape (3,), of any length. The two arms have different
            base frames; transforming it requires their registration.
        toward: Direction from PSM_A's tip to PSM_M's, same frame, shape (3,), which the new approach follows as closely
            as it can; by default the present approach, which gives the smallest turn.

    Returns:
        The target rotation, with the angle and the axis of the turn.

    Raises:
        BadInput: A number is NaN or infinite.
        ImproperRotation: `rotation` is not a rotation.
        NoApproach: `approach_m` has no length.
    """
    present = frozen(rotation, np.float64, (3, 3), "rotation")
    check_rotation(present[None])
    a_m = unit_approach(approach_m)
    a_star = _across(a_m, present, toward)
    options = [_toward(present, sign * a_m, a_star, sign) for sign in (1, -1)]
    return options[1] if options[1].angle_rad < options[0].angle_rad - _TIE_RAD else options[0]


def turn(rotation: ArrayLike, target: ArrayLike, fractions: ArrayLike) -> Floats:
    """Interpolate evenly about one axis from one rotation to another (slerp).

    Args:
        rotation: Start [n o a], shape (3, 3).
        target: End [n o a], shape (3, 3).
        fractions: Parts of the turn that are done, 0 to 1, shape (T,).

    Returns:
        Rotations, shape (T, 3, 3). The axis of a half turn has no sign; the same one is taken each time.
    """
    start = frozen(rotation, np.float64, (3, 3), "rotation")
    angle, axis = _turn_between(start, frozen(target, np.float64, (3, 3), "target"))
    u = frozen(fractions, np.float64, (None,), "fractions") * angle
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    about = np.eye(3) + sin(u)[:, None, None] * cross + (1 - cos(u))[:, None, None] * product(cross, cross)
    return product(about, start)


def _across(a_m: Floats, present: Floats, toward: ArrayLike | None) -> Floats:
    """Return the part across a_M, of unit length, of the first desired approach that is not along a_M."""
    n, o, a = present.T
    wanted = [a, o, n] if toward is None else [frozen(toward, np.float64, (3,), "toward"), a, o, n]
    for direction in wanted:
        v = _unit(direction)
        across = None if v is None else v - a_m * product(a_m, v)
        if across is not None and np.linalg.norm(across, axis=-1) >= _TOO_PARALLEL:
            across = unit(across)
            across = across - a_m * product(a_m, across)  # again, to remove the rest that round-off left along a_M
            return unit(across)
    raise AssertionError("three orthogonal directions cannot all be along one")


def _toward(present: Floats, n_star: Floats, a_star: Floats, sign: int) -> Realignment:
    """Return the realignment to one of the two rotations with this approach."""
    target = np.stack([n_star, np.cross(a_star, n_star), a_star], axis=1)
    angle, axis = _turn_between(present, target)
    return Realignment(target, angle, n_star if angle == 0 else axis, sign)


def _turn_between(start: Floats, target: Floats) -> tuple[float, Floats]:
    """Measure the turn that leads from start to target: its angle, 0 to pi, and its axis in the base frame."""
    x, y, z, w = quaternion_of(product(target, start.T)[None])[0]
    vector = np.array([x, y, z]) * (1.0 if w >= 0 else -1.0)
    length = float(np.linalg.norm(vector, axis=-1))
    if length < 1e-15:
        return 0.0, np.array([0.0, 0.0, 1.0])
    return float(2 * arctan2(length, abs(w))), vector / length


def _unit(vector: Floats) -> Floats | None:
    """Return a vector with length 1; None if it has none."""
    length = float(np.linalg.norm(vector, axis=-1))
    return vector / length if length > 1e-12 else None
