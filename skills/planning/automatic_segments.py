"""Automatic segments of a plan: what the arms do by themselves between two tasks of the surgeon's hand.

    Trajectory --segments_of--> AutomaticSegment ...

A pass begins once the surgeon has inserted the needle with PSM_M (M1) and grasped it with PSM_A (M2; the paper, Fig.
2). Its segments are

    approach    from a start outside the grid world to where A1 begins; of the first pass alone
    transfer    of a further pass: PSM_M leaves with the needle, and both arms go to where A1 begins
    A1          PSM_A moves the needle along the path
    A2          PSM_A turns the needle, and PSM_M comes in
    hand-over   both arms stand; PSM_M's jaw closes on the needle, and then PSM_A's opens

At both ends of a segment the arms stand, so an execution may wait there. Between a transfer and A1 the surgeon does M1
and M2: what a trajectory has there, the jaws that change while both arms stand, belongs to no segment.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from skills.planning.motion_laws import A1
from skills.planning.trajectory import Trajectory, stands_from

SegmentKind = Literal["approach", "transfer", "A1", "A2", "hand-over"]
HandTask = Literal["M1", "M2"]
BY_HAND: tuple[HandTask, ...] = (
    "M1",
    "M2",
)  # before the first segment of the first pass, and before A1 of each further one


@dataclass(frozen=True)
class AutomaticSegment:
    """Samples of a trajectory, from `first` to `last`; neighbours share the sample in which the arms stand."""

    kind: SegmentKind
    pass_index: int
    first: int
    last: int
    by_hand: tuple[HandTask, ...] = ()

    @property
    def samples(self) -> slice:
        """Its samples."""
        return slice(self.first, self.last + 1)


def segments_of(trajectory: Trajectory) -> list[AutomaticSegment]:
    """Return the automatic segments of a trajectory in their order."""
    found: list[AutomaticSegment] = []
    for number in range(trajectory.passes):
        rows = np.flatnonzero(trajectory.pass_index == number)
        along = rows[trajectory.phase[rows] == A1].tolist()
        first, last = int(rows[0]), int(rows[-1])
        begin, end = (along[0], along[-1]) if along else (first, first)
        before = BY_HAND
        if begin > first:
            arrived = max(first, stands_from(trajectory, begin))
            kind: SegmentKind = "transfer" if number else "approach"
            found.append(AutomaticSegment(kind, number, first, arrived, () if number else BY_HAND))
            before = BY_HAND if number else ()
        if end > begin:
            found.append(AutomaticSegment("A1", number, begin, end, before))
            before = ()
        turned = max(end, stands_from(trajectory, last)) if _jaws_move(trajectory, end, last) else last
        if turned > end:
            found.append(AutomaticSegment("A2", number, end, turned, before))
        if last > turned:
            found.append(AutomaticSegment("hand-over", number, turned, last))
    return found


def _jaws_move(trajectory: Trajectory, first: int, last: int) -> bool:
    """Return whether a jaw of either arm changes between two samples, as in a hand-over."""
    jaws = [arm.jaw_rad[first : last + 1] for arm in trajectory.arms if arm.jaw_rad is not None]
    return any((jaw != jaw[0]).any() for jaw in jaws)
