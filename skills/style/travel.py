"""How far the links of an arm can have moved from one sample to the next, and what that says about distances.

    joints --travel_mm--> mm a link and step
    distances at some samples, travel --Bounds--> what they are at least at every sample

No point of a link moves further than the sum, over the joints before it, of the joint's turn times the link's greatest
distance from that joint's axis. And no two surfaces come nearer, between two looks, than what was seen less what both
have moved since, or have yet to move. Both are bounds, so nothing hides between the looks. All of this is ours.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from skills.style._arrays import Floats, Ints
from skills.style.kinematics import INSERTION, WRIST_MM, instrument_of
from skills.style.playback import LINKS, LinkPair

# The reach of `urdf/psm.urdf`'s surfaces from the wrist's pitch axis and from the hinge, mm.
SHAFT_RADIUS_MM = 4.0
WRIST_REACH_MM = WRIST_MM + 3.6
FINGER_REACH_MM = 10.3  # the tip's cap is 10.22 from the hinge


def travel_mm(joints: Floats, instrument: str) -> Floats:
    """Bound how far any point of a link's surface moves from each sample to the next.

    Args:
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6).
        instrument: Number of the instrument.

    Returns:
        Millimetres for each of `playback.LINKS`, shape (T - 1, 4).
    """
    tool = instrument_of(instrument)
    moved = np.abs(np.diff(joints, axis=0))
    wrist = joints[:, INSERTION] - tool.wrist_offset_mm  # beyond the remote centre, about which yaw and pitch turn
    deep = np.maximum(np.abs(wrist[1:]), np.abs(wrist[:-1]))
    behind = tool.shaft_mm - np.minimum(wrist[1:], wrist[:-1])  # the shaft's other end
    finger = WRIST_MM + FINGER_REACH_MM
    swung, slid, rolled, pitched, yawed = moved[:, 0] + moved[:, 1], moved[:, 2], moved[:, 3], moved[:, 4], moved[:, 5]
    shaft = swung * (np.maximum(deep, behind) + SHAFT_RADIUS_MM) + slid  # rolling leaves its surface where it is
    wrists = swung * (deep + WRIST_REACH_MM) + slid + (rolled + pitched) * WRIST_REACH_MM
    fingers = swung * (deep + finger) + slid + (rolled + pitched) * finger + yawed * FINGER_REACH_MM
    return np.stack([shaft, wrists, fingers, fingers], axis=1)


@dataclass(frozen=True, eq=False)
class Bounds:
    """What the distances of pairs of links are at least at every sample, from what was seen at some.

    Attributes:
        pairs: The pairs of links, P of them.
        looked_at: The samples at which they were seen, ascending, the first and the last among them, shape (C,).
        seen_mm: Their distances there, shape (C, P).
        ways_mm: How far each body's links can have moved since the first sample, shape (T, 4); what is not here, stays.
    """

    pairs: tuple[LinkPair, ...]
    looked_at: Ints
    seen_mm: Floats
    ways_mm: Mapping[str, Floats]

    @classmethod
    def of(
        cls, moving: Mapping[str, tuple[Floats, str]], pairs: Sequence[LinkPair], looked_at: Ints, seen_mm: Floats
    ) -> "Bounds":
        """Bound the distances of what moves: joints, shape (T, 6), and instrument of each arm, by its name."""
        ways = {
            name: np.concatenate([np.zeros((1, len(LINKS))), np.cumsum(travel_mm(joints, tool), axis=0)])
            for name, (joints, tool) in moving.items()
        }
        return cls(tuple(pairs), looked_at, seen_mm, ways)

    def at_least_mm(self, column: int) -> Floats:
        """Bound one pair's distance, never too large, shape (T,): as seen where it was; NaN beside a NaN."""
        way, looked_at, seen = self._way_mm(column), self.looked_at, self.seen_mm[:, column]
        sample = np.arange(len(way))
        before = np.searchsorted(looked_at, sample, side="right") - 1
        after = np.searchsorted(looked_at, sample, side="left")
        since = seen[before] - (way - way[looked_at[before]])
        until = seen[after] - (way[looked_at[after]] - way)
        return np.asarray(np.maximum(since, until))

    def moved_mm(self) -> float:
        """Say how much nearer any pair can have come from one look to the next."""
        steps = (np.diff(self._way_mm(column)[self.looked_at]) for column in range(len(self.pairs)))
        return max(float(step.max(initial=0.0)) for step in steps)

    def _way_mm(self, column: int) -> Floats:
        """Add up how far both links of a pair can have moved, shape (T,)."""
        pair = self.pairs[column]
        links = ((pair.body, pair.link), (pair.other, pair.other_link))
        ways = [self.ways_mm[body][:, LINKS.index(link)] for body, link in links if body in self.ways_mm]
        return np.asarray(np.sum(ways, axis=0))
