"""The hand-off itself: the needle in PSM_A's jaws, and where PSM_M takes it (Sec. III-D).

    pose of PSM_A after A2, approach of PSM_M --hand_off--> pose of PSM_M's jaws about the needle

After A2 PSM_A's hinge axis n lies along a_M, PSM_M's approach, and the needle's tangent in PSM_A's jaws lies along n.
So PSM_M cannot hold the needle at the same place: its jaws close about a needle that runs along *their* hinge axis,
which is normal to a_M. A quarter of the circle further on the needle does. The paper does not say where PSM_M grips;
this is ours.

The needle lies in the plane normal to PSM_A's approach, its free end towards where PSM_M comes from, so that PSM_M
reaches it from outside of its circle.
"""

from dataclasses import dataclass
from math import pi, radians
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from skills.errors import BadPlan, NoApproach
from skills.style._arrays import Floats, frozen
from skills.style.kinematics import DEFAULT_INSTRUMENT, check_rotation, instrument_of, matrix_of

NEEDLE_RADIUS_MM = 26.0 / pi  # a half circle of 26 mm along the arc, as `urdf/needle.urdf` has it
HELD_MM = 9.0  # from the hinge along the approach to where the jaws hold the needle; the fingers end at 10.2
# From PSM_M's hinge to where it takes the needle. Ours: 2 mm nearer than PSM_A holds it, because 9 mm out it slips off
# the tips in 18 of 100 hand-offs of calibrated arms; so near the hinge, in one of 1000 (`skills.style.doubt`).
TAKEN_MM = 7.0
HOLDING_RAD = 0.06  # of each finger of jaws that hold a needle
OPEN_RAD = radians(30)  # of each finger of PSM_M when it comes: 60 degrees in all, which `open()` of dvrk_python sends
_NO_LENGTH = 1e-12
_PARALLEL = 1e-9  # of a cosine: 45 microradians, for quaternions of six digits

Enters = Literal["start", "after_A1"]


@dataclass(frozen=True)
class PsmM:
    """What a plan knows of PSM_M, in the frame of the planned arm.

    Attributes:
        approach: The direction in which it approaches the needle, of any length.
        base_mm: Where its remote centre is; None: not known, so it is in no scene and no bag.
        base_xyzw: How its base is turned, a unit quaternion; None exactly where `base_mm` is.
        instrument: Number of its instrument.
        enters: It comes in during A2, as a surgeon would bring it; or it waits at the hand-off from the start.
        approach_from: Where the approach is known from, in words.
        base_from: Where the base is known from; None exactly where `base_mm` is.
    """

    approach: tuple[float, float, float]
    base_mm: tuple[float, float, float] | None = None
    base_xyzw: tuple[float, float, float, float] | None = None
    instrument: str = DEFAULT_INSTRUMENT
    enters: Enters = "after_A1"
    approach_from: str = "the caller"
    base_from: str | None = None

    def __post_init__(self) -> None:
        unit_approach(self.approach)
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
    """PSM_M as it moves beside a trajectory of PSM_A, sample by sample.

    Attributes:
        base_mm: Its remote centre in the PSM_A base frame, shape (3,).
        base_xyzw: Its base's rotation there, unit quaternion, shape (4,).
        instrument: Number of its instrument.
        joints: Its joints at every sample of the trajectory, rad and mm, shape (T, 6).
    """

    base_mm: Floats
    base_xyzw: Floats
    instrument: str
    joints: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "base_mm", frozen(self.base_mm, np.float64, (3,), "base_mm"))
        object.__setattr__(self, "base_xyzw", frozen(self.base_xyzw, np.float64, (4,), "base_xyzw"))
        object.__setattr__(self, "joints", frozen(self.joints, np.float64, (None, 6), "joints"))
        matrix_of(self.base_xyzw[None])


def unit_approach(approach_m: ArrayLike) -> Floats:
    """Take the direction of an approach, shape (3,), of unit length.

    Raises:
        NoApproach: It has no length.
    """
    direction = frozen(approach_m, np.float64, (3,), "approach_m")
    length = float(np.linalg.norm(direction))
    if not length > _NO_LENGTH:
        raise NoApproach("PSM_M's approach has no length; give its direction in PSM_A's base frame.")
    return np.asarray(direction / length)


def hand_off(tip_mm: ArrayLike, rotation: ArrayLike, approach_m: ArrayLike) -> tuple[Floats, Floats]:
    """Find the poses in which PSM_M takes the needle from PSM_A.

    Args:
        tip_mm: PSM_A's tip (its hinge) after A2, mm in any one frame, shape (T, 3).
        rotation: Its [n o a] there, shape (T, 3, 3); n lies along `approach_m`.
        approach_m: PSM_M's approach in the same frame, of any length, shape (3,).

    Returns:
        PSM_M's tip (its hinge), mm, shape (T, 3), and its [n o a], shape (T, 3, 3), both in that frame.

    Raises:
        BadPlan: PSM_A's jaw is not turned for it: its n and a_M are not parallel.
        NoApproach: `approach_m` has no length.
    """
    turned = frozen(rotation, np.float64, (None, 3, 3), "rotation")
    check_rotation(turned)
    a_m = unit_approach(approach_m)
    if not (np.abs(turned[:, :, 0] @ a_m) >= 1 - _PARALLEL).all():
        raise BadPlan("PSM_A's jaw is not turned to PSM_M's approach; realign it first.")
    a = turned[:, :, 2]
    tangent = np.cross(a_m, a)  # of the needle where PSM_M takes it: towards the circle's centre from PSM_A's grip
    tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    held = frozen(tip_mm, np.float64, (None, 3), "tip_mm") + HELD_MM * a
    taken = held + NEEDLE_RADIUS_MM * (tangent - a_m)
    approach = np.broadcast_to(a_m, a.shape)
    jaws = np.stack([tangent, np.cross(approach, tangent), approach], axis=2)
    return taken - TAKEN_MM * a_m, jaws
