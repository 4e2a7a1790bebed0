"""Several demonstrations of one surgeon and suture into one way to follow.

    several Demos --combine--> Combined: a way, and how wide the corridor of the demonstrations is along it

The paper learns from one demonstration. Three ways to take several:

* `Medoid`: the demonstration that is nearest to all the others. Nothing is made up: it was really done.
* `Barycentre`: the way with the least total DTW distance to all of them (DTW barycentre averaging; Petitjean, Ketterlin
  and Gancarski, Pattern Recognition 44, 2011). Our distance is the paper's, Manhattan, so what is warped to a state is
  averaged by its *median* along each axis: it minimises the sum of absolute differences, as the mean of the original
  minimises that of squares. Each round warps anew and takes medians anew; neither makes the total larger. It begins
  with the medoid, so its total is never above the medoid's.
* `Corridor`: where the demonstrations agree, their middle. Each has one vote on each state of the medoid, the mean of
  what is warped to it. A vote agrees if it is no further from the votes' median than `AGREEING` times what the majority
  is, and the mean of those that agree is followed. One that goes elsewhere has no say there, and its say where it is
  with the others. Ours.

The *width* at a state is how far from the way the majority of the demonstrations pass it.

They are combined as recorded where their starts, and their goals, lie within `TOGETHER_MM` of each other. Otherwise
they were shown at different places, and only their shapes can be combined: each is laid between the start and the goal
of the newest (`elsewhere.laid`: turned and scaled, its upside up); a medoid stays where it was done. Tempo and tremor
are left out (`comparing.shapes`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, get_args

import numpy as np

from skills.errors import BadInput
from skills.style._arrays import Floats, frozen
from skills.style.comparing.distances import distances, medoid
from skills.style.comparing.shapes import TREMOR_S, placed, resampled
from skills.style.demo import Demo
from skills.style.elsewhere import laid
from skills.style.evaluation import dtw
from skills.style.grid import GridPath, choose_grid, discretize
from skills.style.movement import smoothed_tip

TOGETHER_MM = 5.0  # a cell of the paper's grid: of what is further apart, the place would be averaged, not the shape
AGREEING = 2.0  # chosen on cohorts that the results are not measured on; 1.5 and 3 do about as well
NANOMETRE = 6  # decimals of a mm: warping has ties, and every machine should find the same way
MAX_ROUNDS = 100  # of the barycentre; it stands still after 5 to 15


@dataclass(frozen=True)
class Medoid:
    """Follow the demonstration that is nearest to all."""

    kind: ClassVar[str] = "medoid"


@dataclass(frozen=True)
class Barycentre:
    """Follow the way of the least total distance to all."""

    kind: ClassVar[str] = "barycentre"


@dataclass(frozen=True)
class Corridor:
    """Follow the middle of those that agree."""

    kind: ClassVar[str] = "corridor"


Combining = Medoid | Barycentre | Corridor
COMBININGS: dict[str, type[Combining]] = {one.kind: one for one in get_args(Combining)}


@dataclass(frozen=True, eq=False)
class Combined:
    """One way for several demonstrations.

    Attributes:
        tip_mm: The way, in the demonstrations' frame, shape (S, 3).
        width_mm: How far from each state the majority of them pass it, shape (S,); 0 for one alone.
        apart_mm: How far it is from each demonstration, at a state on average (DTW), shape (N,).
        medoid: Which demonstration is nearest to all; of equals the newest.
        at: Whose place it has, where they were shown at different ones: the newest's, and a medoid its own.
        moved: Whether they were, so that all were laid there.
    """

    tip_mm: Floats
    width_mm: Floats
    apart_mm: Floats
    medoid: int
    at: int
    moved: bool

    def __post_init__(self) -> None:
        for name, shape in {"tip_mm": (None, 3), "width_mm": (len(self.tip_mm),), "apart_mm": (None,)}.items():
            object.__setattr__(self, name, frozen(getattr(self, name), np.float64, shape, name))


def combine(demos: Sequence[Demo], how: Combining) -> Combined:
    """Combine demonstrations, oldest first, into one way; but for which is the newest, their order does not matter.

    Raises:
        BadInput: There are none, or they are not of one arm, frame and instrument.
        BadPath: They were shown at different places, and one of them ends within a millimetre of its start.
    """
    if len({(demo.arm, demo.frame, demo.instrument) for demo in demos}) != 1:
        raise BadInput("Demonstrations are combined if they are of one arm, in one frame, with one instrument.")
    ways_mm, _ = side_by_side(demos)
    nearest = medoid(distances(ways_mm, ways_mm), np.arange(len(demos))[::-1])
    at = nearest if isinstance(how, Medoid) else len(demos) - 1
    ways_mm, moved = side_by_side(demos, at)
    tip_mm = _follow(ways_mm, ways_mm[nearest], how).round(NANOMETRE)
    apart_mm = distances(tip_mm[None], ways_mm)[0] / len(tip_mm)
    return Combined(tip_mm, widths(ways_mm, tip_mm), apart_mm, nearest, at, moved)


@dataclass(frozen=True, eq=False)
class Followed:
    """What a policy is learnt from, of several: the combined way, it as a demonstration, and in its grid."""

    combined: Combined
    demo: Demo
    path: GridPath

    @property
    def width_mm(self) -> Floats:
        """How wide the way is at each waypoint, (R,): the widest of what is warped to it."""
        pairs = dtw(self.combined.tip_mm, self.path.tip_mm).pairs
        wide_mm = np.zeros(len(self.path.states))
        np.maximum.at(wide_mm, pairs[:, 1], self.combined.width_mm[pairs[:, 0]])
        return wide_mm


def followed(demos: Sequence[Demo], paths: Sequence[GridPath], how: Combining) -> Followed:
    """Combine demonstrations, oldest first, each with its path, into what can be learnt from.

    A medoid is one of them, path and all. Another way is put into the grid of the newest, or where it leaves that, into
    one with the same cells.

    Raises:
        BadInput: There are none, or they are not of one arm, frame and instrument.
        BadPath: They cannot be laid on each other, or the way has no path in the grid.
    """
    combined = combine(demos, how)
    one, like = demos[combined.at], paths[combined.at]
    if isinstance(how, Medoid):
        return Followed(combined, one, like)
    grid = like.grid
    if not grid.holds(grid.cells_at(combined.tip_mm)).all():
        grid = choose_grid(combined.tip_mm, "auto", grid.cell_mm)
    return Followed(combined, demonstrated(combined, one), discretize(combined.tip_mm, grid, like.hysteresis))


def demonstrated(combined: Combined, newest: Demo) -> Demo:
    """Write a way as a demonstration: at an even speed in the newest's time, the needle held and taken as there."""
    along_mm = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(newest.tip_mm, axis=0), axis=1)))
    alike = np.searchsorted(along_mm, np.linspace(0.0, along_mm[-1], len(combined.tip_mm))).clip(0, len(along_mm) - 1)
    return replace(
        newest,
        stamps_s=np.linspace(0.0, newest.stamps_s[-1], len(combined.tip_mm)),
        tip_mm=combined.tip_mm,
        rotation_xyzw=None if newest.rotation_xyzw is None else newest.rotation_xyzw[alike],
        jaw_rad=None if newest.jaw_rad is None else newest.jaw_rad[alike],
        clutch_presses=0,
        pauses=(),
    )


def side_by_side(demos: Sequence[Demo], at: int = -1) -> tuple[Floats, bool]:
    """Give each demonstration's way, (N, S, 3) mm, where they can be compared, and whether they were moved there.

    Args:
        demos: Of one frame.
        at: If they were shown at different places, all are laid where this one is.

    Raises:
        BadPath: They were, and one ends within a millimetre of its start.
    """
    ways_mm = np.stack([_way(demo) for demo in demos]).round(NANOMETRE)
    ends_mm = ways_mm[:, [0, -1]]
    apart_mm = np.linalg.norm(ends_mm[:, None] - ends_mm[None], axis=-1)
    if apart_mm.max() <= TOGETHER_MM:
        return ways_mm, False
    return np.stack([laid(placed(way_mm, scaled=True), *ends_mm[at]) for way_mm in ways_mm]).round(NANOMETRE), True


def _way(demo: Demo) -> Floats:
    """Take states equally far apart along a demonstration's way, without tremor: (S, 3) mm."""
    return resampled(smoothed_tip(demo.stamps_s, demo.tip_mm, TREMOR_S)[1])


def _follow(ways_mm: Floats, medoid_mm: Floats, how: Combining) -> Floats:
    match how:
        case Medoid():
            return medoid_mm
        case Barycentre():
            return barycentre(ways_mm, medoid_mm)
        case Corridor():
            return corridor(ways_mm, medoid_mm)


def barycentre(ways_mm: Floats, first_mm: Floats) -> Floats:
    """Find the way, (S, 3), of the least total distance to all, (N, T, 3); from where it begins, so a local one."""
    way_mm, least = first_mm, np.inf
    for _ in range(MAX_ROUNDS):
        aligned = [dtw(one, way_mm).pairs for one in ways_mm]
        warped_mm = np.concatenate([one[pairs[:, 0]] for one, pairs in zip(ways_mm, aligned, strict=True)])
        state = np.concatenate([pairs[:, 1] for pairs in aligned])
        total = float(np.abs(warped_mm - way_mm[state]).sum())
        if not total < least:
            break
        best_mm, least = way_mm, total
        way_mm = np.stack([np.median(warped_mm[state == k], axis=0) for k in range(len(way_mm))])
    return best_mm


def corridor(ways_mm: Floats, along_mm: Floats) -> Floats:
    """Find the middle, (S, 3), of those ways, (N, T, 3), that agree at each state of one of them, (S, 3)."""
    votes_mm = _votes(ways_mm, along_mm)
    away_mm = np.linalg.norm(votes_mm - np.median(votes_mm, axis=0), axis=-1)
    agree = away_mm <= AGREEING * _of_majority(away_mm)
    return np.asarray((votes_mm * agree[..., None]).sum(axis=0) / agree.sum(axis=0)[:, None])


def widths(ways_mm: Floats, along_mm: Floats) -> Floats:
    """Measure how far from each state of a way, (S, 3), the majority of the ways, (N, T, 3), pass: (S,)."""
    return _of_majority(np.linalg.norm(_votes(ways_mm, along_mm) - along_mm, axis=-1))


def _of_majority(away_mm: Floats) -> Floats:
    """Take the least distance, of (N, S), within which more than half of the N are: (S,)."""
    return np.asarray(np.sort(away_mm, axis=0)[len(away_mm) // 2])


def _votes(ways_mm: Floats, along_mm: Floats) -> Floats:
    """Average what of each way, (N, T, 3), is warped to each state of one, (S, 3): (N, S, 3)."""
    votes = []
    for one in ways_mm:
        pairs = dtw(one, along_mm).pairs
        warped = np.stack([np.bincount(pairs[:, 1], axis) for axis in one[pairs[:, 0]].T], axis=1)
        votes.append(warped / np.bincount(pairs[:, 1])[:, None])
    return np.stack(votes)
