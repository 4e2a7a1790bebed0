"""Whether PSM_M's jaws catch the needle, in closed form and for many slightly wrong hand-offs at once.

Symbols: the needle is an arc of radius r that leaves PSM_A's grip in direction u and bends towards t, so that after
the angle phi it is at r (t (1 - cos phi) + u sin phi) from the grip, where it runs along t sin phi + u cos phi. In the
frame of PSM_M's jaws x lies along their hinge n, y from finger to finger, z along the approach. The fingers close in
the plane x = 0; where the arc crosses it, is

    t_x cos phi - u_x sin phi = t_x + g_x / r     with the grip at g.

When they close the fingers sweep a sector of that plane about the hinge: what is within it they bring to its middle.
All of this is ours.
"""

from dataclasses import dataclass
from math import cos, pi, sin

import numpy as np
from numpy.typing import NDArray

from skills.style._arrays import Floats
from skills.style.clearance import FINGER_RADIUS_MM, WRIST_RADIUS_MM
from skills.style.handoff import HELD_MM, NEEDLE_RADIUS_MM
from skills.style.kinematics import JAW_TIP_MM

NEEDLE_FREE_RAD = 2 * pi / 3  # of the arc beyond PSM_A's grip: two thirds of a half circle, as in urdf/needle.urdf
NEEDLE_THICK_MM = 0.66  # the same file
_HALF_WIDTH_RAD = FINGER_RADIUS_MM / NEEDLE_RADIUS_MM  # of the arc, from the middle of the fingers to their side

Bools = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class HandOff:
    """Both arms as planned at the end of A2, in one frame: tips in mm, shape (3,), and jaws [n o a], shape (3, 3)."""

    tip_a: Floats
    jaw_a: Floats
    tip_m: Floats
    jaw_m: Floats


def catch(planned: HandOff, turned: Floats, apart_mm: Floats, opening_rad: float) -> tuple[Bools, Floats]:
    """Find where and how the needle lies in PSM_M's open jaws.

    Args:
        planned: The hand-off. The needle stands across PSM_A's jaws, its free end against PSM_M's approach.
        turned: How the needle is turned about the grip, in the same frame, shape (N, 3, 3).
        apart_mm: How far PSM_A is off from PSM_M, in the same frame, shape (N, 3).
        opening_rad: How far each of PSM_M's fingers is open.

    Returns:
        Whether it is between the fingers, with needle to spare beside them, shape (N,), and the angle between its
        tangent there and their hinge, rad, shape (N,); NaN where it does not come by.
    """
    n, a = planned.jaw_a[:, 0], planned.jaw_a[:, 2]
    free = n if n @ planned.jaw_m[:, 2] < 0 else -n
    inwards = np.cross(a, free)
    # The jaws are the same either way round: of n and -n the one along which the needle runs.
    n_m, o_m, a_m = planned.jaw_m.T
    jaws = np.stack([n_m, o_m, a_m] if n_m @ inwards >= 0 else [-n_m, -o_m, a_m], axis=1)
    grip = (planned.tip_a + HELD_MM * a - planned.tip_m + apart_mm) @ jaws
    t, u = turned @ inwards @ jaws, turned @ free @ jaws
    amplitude = np.hypot(t[:, 0], u[:, 0])
    level = (t[:, 0] + grip[:, 0] / NEEDLE_RADIUS_MM) / np.maximum(amplitude, 1e-12)
    crosses = np.abs(level) <= 1.0  # NaN does not
    phi = np.where(crosses, np.arccos(np.where(crosses, level, 0.0)), np.nan) - np.arctan2(u[:, 0], t[:, 0])
    sine, cosine = np.sin(phi)[:, None], np.cos(phi)[:, None]
    at, along = grip + NEEDLE_RADIUS_MM * (t * (1 - cosine) + u * sine), t * sine + u * cosine
    to_spare = (phi >= _HALF_WIDTH_RAD) & (phi <= NEEDLE_FREE_RAD - _HALF_WIDTH_RAD)
    return to_spare & _swept(at[:, 1], at[:, 2], opening_rad), np.arccos(np.clip(np.abs(along[:, 0]), 0.0, 1.0))


def _swept(y_mm: Floats, z_mm: Floats, opening_rad: float) -> Bools:
    """Tell whether a needle that crosses the jaws' plane there lies wholly in what the fingers sweep; NaN does not."""
    half = NEEDLE_THICK_MM / 2
    depth = np.hypot(y_mm, z_mm)
    within = (depth >= WRIST_RADIUS_MM + half) & (depth <= JAW_TIP_MM - half)
    return np.asarray(within & (np.abs(y_mm) * cos(opening_rad) + half <= z_mm * sin(opening_rad)))
