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
from math import pi
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from skills.style._arrays import Floats, frozen
from skills.style.kinematics import DEFAULT_INSTRUMENT, check_rotation, matrix_of

NEEDLE_RADIUS_MM = 26.0 / pi  # a half circle of 26 mm along the arc, as `urdf/needle.urdf` has it
HELD_MM = 9.0  # from the hinge along the approach to where the jaws hold the needle; the fingers end at 10.2

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
    """

    approach: tuple[float, float, float]
    base_mm: tuple[float, float, float] | None = None
    base_xyzw: tuple[float, float, float, float] | None = None
    instrument: str = DEFAULT_INSTRUMENT
    enters: Enters = "after_A1"


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


def hand_off(tip_mm: ArrayLike, rotation: ArrayLike, approach_m: ArrayLike) -> tuple[Floats, Floats]:
    """Find the poses in which PSM_M takes the needle from PSM_A.

    Args:
        tip_mm: PSM_A's tip (its hinge) after A2, mm in any one frame, shape (T, 3).
        rotation: Its [n o a] there, shape (T, 3, 3); n lies along `approach_m`.
        approach_m: PSM_M's approach in the same frame, of any length, shape (3,).

    Returns:
        PSM_M's tip (its hinge), mm, shape (T, 3), and its [n o a], shape (T, 3, 3), both in that frame.
    """
    turned = frozen(rotation, np.float64, (None, 3, 3), "rotation")
    check_rotation(turned)
    a_m = frozen(approach_m, np.float64, (3,), "approach_m")
    a_m = a_m / np.linalg.norm(a_m)
    a = turned[:, :, 2]
    tangent = np.cross(a_m, a)  # of the needle where PSM_M takes it: towards the circle's centre from PSM_A's grip
    tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    held = frozen(tip_mm, np.float64, (None, 3), "tip_mm") + HELD_MM * a
    taken = held + NEEDLE_RADIUS_MM * (tangent - a_m)
    approach = np.broadcast_to(a_m, a.shape)
    jaws = np.stack([tangent, np.cross(approach, tangent), approach], axis=2)
    return taken - HELD_MM * a_m, jaws
