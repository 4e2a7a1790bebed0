"""How far an arm's links are from the pad and from another arm's, in closed form and for many poses at once.

    joints --links_of--> Links --clearance_to_pad--> mm a link
    two of them --clearance_between--> mm a pair of links

The links' surfaces are those that collide in `urdf/psm.urdf`: a capsule each, which is all points within a radius of a
straight axis. So distances are exact, as the simulator's are, and at a microsecond a pose quick enough for thousands of
variations of a plan. All of it is ours.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from skills.style._arrays import Floats
from skills.style.handoff import HOLDING_RAD
from skills.style.kinematics import DEFAULT_INSTRUMENT, JAW_TIP_MM, WRIST_MM, instrument_of

# The capsules of urdf/psm.urdf, in mm: shaft, wrist (from its pitch axis to the hinge) and the two fingers.
LINKS = ("roll_link", "wrist_pitch_link", "finger_1", "finger_2")
FINGERS = slice(2, 4)
SHAFT_RADIUS_MM, WRIST_RADIUS_MM, FINGER_RADIUS_MM = 4.0, 3.6, 1.1
RADII_MM = np.array([SHAFT_RADIUS_MM, WRIST_RADIUS_MM, FINGER_RADIUS_MM, FINGER_RADIUS_MM])
FINGER_MM = JAW_TIP_MM - FINGER_RADIUS_MM  # a finger's axis, from the hinge on; its round end is the finger's tip
ASIDE_MM = 0.6  # a finger's axis from the plane in which the two meet

_PARALLEL = 1e-12  # of the product of two squared lengths: with less between them any start finds the nearest points


@dataclass(frozen=True, eq=False)
class Links:
    """Where an arm's links are in T poses: their axes from end to end, mm in any one frame, both of shape (T, 4, 3)."""

    begin_mm: Floats
    end_mm: Floats

    def moved(self, by_mm: Floats) -> "Links":
        """Move each pose by an offset, shape (T, 3)."""
        return Links(self.begin_mm + by_mm[:, None], self.end_mm + by_mm[:, None])

    def seen_from(self, base: Floats, base_mm: Floats) -> "Links":
        """Tell the same in the frame in which theirs is at `base_mm`, shape (3,), and turned by `base`, (3, 3)."""
        return Links(self.begin_mm @ base.T + base_mm, self.end_mm @ base.T + base_mm)


def links_of(joints: ArrayLike, instrument: str = DEFAULT_INSTRUMENT, opening_rad: float = HOLDING_RAD) -> Links:
    """Find where the joints put an arm's links, in its base frame.

    Args:
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6). Limits are not checked; NaN stays NaN.
        instrument: Number of the instrument.
        opening_rad: How far each finger is open.
    """
    tool = instrument_of(instrument)
    q = np.asarray(joints, dtype=np.float64)
    (s1, s2, s4, s5, s6), (c1, c2, c4, c5, c6) = (f(q[:, (0, 1, 3, 4, 5)]).T[:, :, None] for f in (np.sin, np.cos))
    # The axes of the Denavit-Hartenberg frames, as the inverse of `kinematics` has them.
    shaft = np.concatenate([c2 * s1, -s2, -c2 * c1], axis=1)
    x3 = np.concatenate([-s1 * s2, -c2, c1 * s2], axis=1)
    y3 = np.cross(shaft, x3)
    z5 = c4 * y3 - s4 * x3
    x5 = s5 * (c4 * x3 + s4 * y3) + c5 * shaft
    o = -s6 * x5 - c6 * z5
    a = np.cross(o, np.cross(z5, x5))
    wrist = (q[:, 2:3] - tool.wrist_offset_mm) * shaft
    hinge = wrist + WRIST_MM * x5
    axes = [(wrist - tool.shaft_mm * shaft, wrist), (wrist, hinge)]
    for side in (1.0, -1.0):
        outwards = side * np.cos(opening_rad) * o - np.sin(opening_rad) * a
        begin = hinge + ASIDE_MM * outwards
        axes.append((begin, begin + FINGER_MM * (np.cos(opening_rad) * a + side * np.sin(opening_rad) * o)))
    begins, ends = zip(*axes, strict=True)
    return Links(np.stack(begins, axis=1), np.stack(ends, axis=1))


def clearance_to_pad(arm: Links, pad_top_mm: ArrayLike) -> Floats:
    """Measure how far each link is above all that is no higher than the pad's top, negative below.

    Args:
        arm: The arm, in a frame whose z is up.
        pad_top_mm: Height of the pad's top, one for all poses, or one for each, shape (T,).

    Returns:
        Distances in mm, shape (T, 4); the columns are `LINKS`.
    """
    lowest = np.minimum(arm.begin_mm[:, :, 2], arm.end_mm[:, :, 2]) - RADII_MM
    return np.asarray(lowest - np.asarray(pad_top_mm, np.float64).reshape(-1, 1))


def clearance_between(arm: Links, other: Links) -> Floats:
    """Measure how far the links of two arms are apart, told in one frame and in as many poses.

    Returns:
        Distances in mm, negative where they overlap, shape (T, 4, 4); rows and columns are `LINKS`.
    """
    p, u = arm.begin_mm, arm.end_mm - arm.begin_mm
    q, v = other.begin_mm, other.end_mm - other.begin_mm
    return np.asarray(_between(p, u, q, v) - (RADII_MM[:, None] + RADII_MM))


def _between(p: Floats, u: Floats, q: Floats, v: Floats) -> Floats:
    """Measure the distance of every segment p + s u from every segment q + t v, s and t in 0..1, shape (T, P, Q).

    The s that is best for the lines, the t that is best for it, and the s that is best for that; then the squared
    distance as a polynomial in both.
    """
    uu, vv = _dot(u, u)[:, :, None], _dot(v, v)[:, None, :]
    qs, vs = np.swapaxes(q, 1, 2), np.swapaxes(v, 1, 2)
    uv = u @ vs
    ur = _dot(u, p)[:, :, None] - u @ qs
    vr = p @ vs - _dot(v, q)[:, None, :]
    rr = _dot(p, p)[:, :, None] + _dot(q, q)[:, None, :] - 2 * (p @ qs)
    slant = np.maximum(uu * vv - uv * uv, _PARALLEL * uu * vv)
    s = np.clip((uv * vr - ur * vv) / slant, 0.0, 1.0)
    t = np.clip((uv * s + vr) / vv, 0.0, 1.0)
    s = np.clip((uv * t - ur) / uu, 0.0, 1.0)
    squared = rr + uu * s * s + vv * t * t + 2 * (ur * s - vr * t - uv * s * t)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))  # round-off where they touch


def _dot(u: Floats, v: Floats) -> Floats:
    return np.asarray(np.einsum("tki,tki->tk", u, v))
