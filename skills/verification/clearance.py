"""Clearance: distances between surfaces in closed form, and bounds on them between samples.

    joints --links_of--> Links --clearance_to_pad--> mm per link
    two of them --clearance_between--> mm per pair of links
    joints --travel_mm--> mm per link and step
    distances at some samples, travel --Bounds--> least distances at every sample

The surfaces of the links are those that collide in `urdf/psm.urdf`: one capsule each, which is the set of points within
a radius of a straight axis. So distances are exact, as the simulator's are, and at a microsecond per pose fast enough
for thousands of variations of a plan.

Between samples distances are bounded. No point of a link moves further than the sum, over the joints before it, of the
joint's turn times the link's greatest distance from that joint's axis. And between two measurements no two surfaces
come nearer than the measured distance minus the distance that both have moved since, or will move until the next one.
Both are bounds, so nothing is missed between the measurements. All of this is ours.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Floats, Ints
from skills.kinematics import DEFAULT_INSTRUMENT, INSERTION, JAW_TIP_MM, WRIST_MM, instrument_of
from skills.planning.handoff import HOLDING_RAD
from skills.verification.playback import LINKS, LinkPair

# The reach of the surfaces in `urdf/psm.urdf` from the wrist's pitch axis and from the hinge, mm.
SHAFT_RADIUS_MM = 4.0
WRIST_REACH_MM = WRIST_MM + 3.6
FINGER_REACH_MM = 10.3  # the tip's cap is 10.22 from the hinge


def travel_mm(joints: Floats, instrument: str) -> Floats:
    """Return upper bounds on the distance that any point of a link's surface moves from each sample to the next.

    Args:
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6).
        instrument: Number of the instrument.

    Returns:
        Millimetres for each of `playback.LINKS`, shape (T - 1, 4).
    """
    tool = instrument_of(instrument)
    moved = np.abs(np.diff(joints, axis=0))
    # The wrist's depth beyond the remote centre, about which yaw and pitch turn.
    wrist = joints[:, INSERTION] - tool.wrist_offset_mm
    deep = np.maximum(np.abs(wrist[1:]), np.abs(wrist[:-1]))
    behind = tool.shaft_mm - np.minimum(wrist[1:], wrist[:-1])  # the shaft's other end
    finger = WRIST_MM + FINGER_REACH_MM
    swung, slid, rolled, pitched, yawed = moved[:, 0] + moved[:, 1], moved[:, 2], moved[:, 3], moved[:, 4], moved[:, 5]
    shaft = swung * (np.maximum(deep, behind) + SHAFT_RADIUS_MM) + slid  # rolling does not move its surface
    wrists = swung * (deep + WRIST_REACH_MM) + slid + (rolled + pitched) * WRIST_REACH_MM
    fingers = swung * (deep + finger) + slid + (rolled + pitched) * finger + yawed * FINGER_REACH_MM
    return np.stack([shaft, wrists, fingers, fingers], axis=1)


@dataclass(frozen=True, eq=False)
class Bounds:
    """Lower bounds on the distances of pairs of links at every sample, from distances measured at some samples.

    Attributes:
        pairs: The pairs of links, P of them.
        looked_at: The samples of the measurements, ascending, with the first and the last of all, shape (C,).
        seen_mm: The distances measured there, shape (C, P).
        ways_mm: Greatest distance that each body's links can have moved since the first sample, shape (T, 4); a body
            that is missing here does not move.
    """

    pairs: tuple[LinkPair, ...]
    looked_at: Ints
    seen_mm: Floats
    ways_mm: Mapping[str, Floats]

    @classmethod
    def of(
        cls, moving: Mapping[str, tuple[Floats, str]], pairs: Sequence[LinkPair], looked_at: Ints, seen_mm: Floats
    ) -> "Bounds":
        """Return the bounds for moving arms.

        Args:
            moving: Joints, shape (T, 6), and instrument of each arm that moves, by its name.
            pairs: The pairs of links, P of them.
            looked_at: The samples of the measurements, ascending, with the first and the last of all, shape (C,).
            seen_mm: The distances measured there, shape (C, P).
        """
        ways = {
            name: np.concatenate([np.zeros((1, len(LINKS))), np.cumsum(travel_mm(joints, tool), axis=0)])
            for name, (joints, tool) in moving.items()
        }
        return cls(tuple(pairs), looked_at, seen_mm, ways)

    def at_least_mm(self, column: int) -> Floats:
        """Return a lower bound on one pair's distance, shape (T,): exact where it was measured, NaN next to a NaN."""
        way, looked_at, seen = self._way_mm(column), self.looked_at, self.seen_mm[:, column]
        sample = np.arange(len(way))
        before = np.searchsorted(looked_at, sample, side="right") - 1
        after = np.searchsorted(looked_at, sample, side="left")
        since = seen[before] - (way - way[looked_at[before]])
        until = seen[after] - (way[looked_at[after]] - way)
        return np.asarray(np.maximum(since, until))

    def moved_mm(self) -> float:
        """Return the greatest distance by which any pair can have approached between two measurements."""
        steps = (np.diff(self._way_mm(column)[self.looked_at]) for column in range(len(self.pairs)))
        return max(float(step.max(initial=0.0)) for step in steps)

    def _way_mm(self, column: int) -> Floats:
        """Return the distance that both links of a pair together can have moved, shape (T,)."""
        pair = self.pairs[column]
        links = ((pair.body, pair.link), (pair.other, pair.other_link))
        ways = [self.ways_mm[body][:, LINKS.index(link)] for body, link in links if body in self.ways_mm]
        return np.asarray(np.sum(ways, axis=0))


# The capsules of urdf/psm.urdf, in mm: shaft, wrist (from its pitch axis to the hinge) and the two fingers.
FINGERS = slice(2, 4)
WRIST_RADIUS_MM, FINGER_RADIUS_MM = 3.6, 1.1
RADII_MM = np.array([SHAFT_RADIUS_MM, WRIST_RADIUS_MM, FINGER_RADIUS_MM, FINGER_RADIUS_MM])
FINGER_MM = JAW_TIP_MM - FINGER_RADIUS_MM  # a finger's axis, from the hinge on; its round end is the finger's tip
ASIDE_MM = 0.6  # a finger's axis from the plane in which the two meet

_PARALLEL = 1e-12  # part of the product of two squared lengths: segments are then parallel, and any start works


@dataclass(frozen=True, eq=False)
class Links:
    """The links of an arm in T poses: both ends of their axes, mm in any one frame, both of shape (T, 4, 3)."""

    begin_mm: Floats
    end_mm: Floats

    def moved(self, by_mm: Floats) -> "Links":
        """Return the links with each pose moved by an offset, shape (T, 3)."""
        return Links(self.begin_mm + by_mm[:, None], self.end_mm + by_mm[:, None])

    def seen_from(self, base: Floats, base_mm: Floats) -> "Links":
        """Return the links in a frame where their own frame is at `base_mm`, shape (3,), turned by `base`, (3, 3)."""
        return Links(self.begin_mm @ base.T + base_mm, self.end_mm @ base.T + base_mm)


def links_of(joints: ArrayLike, instrument: str = DEFAULT_INSTRUMENT, opening_rad: float = HOLDING_RAD) -> Links:
    """Return the links of an arm with these joints, in its base frame.

    Args:
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6). Limits are not checked; NaN stays NaN.
        instrument: Number of the instrument.
        opening_rad: Opening of each finger.
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
    """Return the height of each link above everything that is no higher than the pad's top; negative is below.

    Args:
        arm: The arm, in a frame whose z points up.
        pad_top_mm: Height of the pad's top, one for all poses, or one for each, shape (T,).

    Returns:
        Distances in mm, shape (T, 4); the columns are `LINKS`.
    """
    lowest = np.minimum(arm.begin_mm[:, :, 2], arm.end_mm[:, :, 2]) - RADII_MM
    return np.asarray(lowest - np.asarray(pad_top_mm, np.float64).reshape(-1, 1))


def clearance_between(arm: Links, other: Links) -> Floats:
    """Return the distances between the links of two arms.

    Args:
        arm: One arm in T poses.
        other: The other arm, in the same frame and in as many poses.

    Returns:
        Distances in mm, negative where they overlap, shape (T, 4, 4); rows and columns are `LINKS`.
    """
    p, u = arm.begin_mm, arm.end_mm - arm.begin_mm
    q, v = other.begin_mm, other.end_mm - other.begin_mm
    return np.asarray(_between(p, u, q, v) - (RADII_MM[:, None] + RADII_MM))


def _between(p: Floats, u: Floats, q: Floats, v: Floats) -> Floats:
    """Return the distance of every segment p + s u from every segment q + t v, s and t in 0..1, shape (T, P, Q).

    It takes the s that is best for the lines, the t that is best for that s, and the s that is best for that t; then
    the squared distance as a polynomial in both.
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
