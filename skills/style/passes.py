"""A pass before it has a time, and the way that both arms take in it.

    transfer   from the end of the pass before to where A1 begins; ours, so that a plan is one motion
    A1         PSM_A's tip along its polyline, the jaw held
    A2         PSM_A's jaw turns with the tip held, and PSM_M comes in

A transfer goes through *stations*, at rest in each. Between passes: PSM_M goes back, then PSM_A comes to its start with
its jaw turned back while PSM_M goes to its next stand-off. PSM_A waits until PSM_M has left, for the needle leaves from
between its jaws. Where a pass starts outside its grid world, its start is one more station.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skills.errors import BadPlan, NoMotion
from skills.style._arrays import Floats, frozen
from skills.style.handoff import PsmM
from skills.style.kinematics import check_rotation
from skills.style.moves import SAME_POINT_MM, Arms, Pose
from skills.style.other_arm import Meeting, meeting

FAR_MM = 1e4  # ten metres: no point of a PSM's, but one whose squares do not overflow


@dataclass(frozen=True, eq=False)
class PassPath:
    """One pass before it has a time.

    Attributes:
        tip_mm: Points of A1 in the PSM base frame, shape (K, 3), K >= 1; one point alone means that A1 is nothing.
        rotation: The jaw's [n o a] held during A1, shape (3, 3).
        target_rotation: Where A2 turns it, shape (3, 3), or None for a pass without A2.
        start_mm: Where the pass starts, shape (3,), where that is not A1's first point; a transfer leads from there.
    """

    tip_mm: Floats
    rotation: Floats
    target_rotation: Floats | None = None
    start_mm: Floats | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "tip_mm", frozen(self.tip_mm, np.float64, (None, 3), "tip_mm"))
        object.__setattr__(self, "rotation", frozen(self.rotation, np.float64, (3, 3), "rotation"))
        check_rotation(self.rotation[None])
        points = self.tip_mm
        if self.start_mm is not None:
            object.__setattr__(self, "start_mm", frozen(self.start_mm, np.float64, (3,), "start_mm"))
            points = np.append(points, self.start_mm[None], axis=0)
        if (np.abs(points) > FAR_MM).any():
            raise BadPlan("A point is more than ten metres away; give millimetres in the PSM base frame.")
        if self.target_rotation is not None:
            target = frozen(self.target_rotation, np.float64, (3, 3), "target_rotation")
            check_rotation(target[None])
            object.__setattr__(self, "target_rotation", target)


@dataclass(frozen=True, eq=False)
class Way:
    """Where the arms go in one pass.

    Attributes:
        transfer: Stations before A1; the last is where A1 begins.
        line: Points of A1, no two after another the same, shape (K, 3).
        handed: Where A2 leads; None for a pass without it.
    """

    transfer: tuple[Arms, ...]
    line: Floats
    handed: Arms | None

    @property
    def last(self) -> Arms:
        """Where the pass ends."""
        return self.handed or (Pose(self.line[-1], self.transfer[-1][0].rotation), *self.transfer[-1][1:])


def ways(passes: Sequence[PassPath], psm_m: PsmM | None) -> list[Way]:
    """Lay out every pass, with PSM_M beside PSM_A where its base is known.

    Raises:
        NoMotion: There is no pass, or one in which nothing moves.
        BadPlan: A pass has no A2, and PSM_M should come for the needle.
    """
    if not passes:
        raise NoMotion("A plan needs at least one pass.")
    beside = psm_m if psm_m is not None and psm_m.base_mm is not None else None
    found: list[Way] = []
    before: Meeting | None = None
    for number, one in enumerate(passes):
        line = _polyline(one, number)
        meets = None if beside is None else _meeting(one, number, beside)
        stations = _stations(one, line, meets, before, found[-1].last if found else None)
        handed = None
        if one.target_rotation is not None:
            handed = _arms(Pose(line[-1], one.target_rotation), None if meets is None else meets.taking)
        found.append(Way(stations, line, handed))
        before = meets
    return found


def _stations(
    one: PassPath, line: Floats, meets: Meeting | None, before: Meeting | None, last: Arms | None
) -> tuple[Arms, ...]:
    """List the stations of a transfer; two after another may be the same."""
    first = Pose(line[0], one.rotation)
    start = first if one.start_mm is None else Pose(one.start_mm, one.rotation)
    waits = None if meets is None else meets.waiting
    if last is None:
        return _arms(start, waits), _arms(first, waits)
    away = None if before is None else before.stand_off
    off = None if meets is None else meets.stand_off
    return last, _arms(last[0], away), _arms(start, off), _arms(first, off), _arms(first, waits)


def _arms(psm_a: Pose, psm_m: Pose | None) -> Arms:
    return (psm_a,) if psm_m is None else (psm_a, psm_m)


def _meeting(one: PassPath, number: int, psm_m: PsmM) -> Meeting:
    if one.target_rotation is None:
        raise BadPlan(f"Pass {number} has no A2, so PSM_M cannot take the needle.", **{"pass": number})
    return meeting(Pose(one.tip_mm[-1], one.target_rotation), psm_m)


def _polyline(one: PassPath, number: int) -> Floats:
    """Drop repeated points, shape (K, 3).

    Raises:
        NoMotion: Nothing moves in this pass.
    """
    points = one.tip_mm
    if not len(points):
        raise NoMotion(f"Pass {number} has no points.", **{"pass": number})
    moves = np.linalg.norm(np.diff(points, axis=0), axis=1) > SAME_POINT_MM
    # The last of equal points is kept, so that the pass ends exactly on its last one.
    kept: Floats = points[np.append(moves, True)]
    if len(kept) < 2 and one.target_rotation is None:
        raise NoMotion(f"Pass {number} neither moves nor turns; give it two points or a target.", **{"pass": number})
    return kept
