"""Demonstrations of one surgeon and suture type combined into one, and a demonstration moved to another wound line.

    several Demos --combine--> Combined: one path, and the width of the demonstrations' corridor along it
    Demo, start, goal --moved--> Demo

The paper learns from one demonstration. There are three methods to combine several:

* "medoid": the demonstration that is nearest to all the others. Nothing is invented: it was really performed.
* "barycentre": the path with the least total DTW distance to all of them (DTW barycentre averaging; Petitjean,
  Ketterlin and Gancarski, Pattern Recognition 44, 2011). Our distance is the paper's, Manhattan, so the points warped
  to a state are averaged by their *median* along each axis: it minimises the sum of absolute differences, as the mean
  of the original minimises that of squares. Each round warps again and takes medians again; neither makes the total
  larger. It begins with the medoid, so its total is never above the medoid's.
* "corridor": where the demonstrations agree, their middle. Each has one vote on each state of the medoid, the mean of
  its points that are warped to that state. A vote agrees if it is no further from the votes' median than `AGREEING`
  times the distance within which the majority is, and the path is the mean of the votes that agree. A demonstration
  that deviates has no influence there, but counts where it is with the others. Ours.

The *width* at a state is the distance from the path within which the majority of the demonstrations pass it.

They are combined as recorded if their starts, and their goals, lie within `TOGETHER_MM` of each other. Otherwise they
were shown at different places, and only their shapes can be combined: each is moved between the start and the goal of
the newest (`laid`: turned and scaled, with its upper side up); a medoid stays where it was performed. Tempo and tremor
are left out (`skills.comparison.distances`).

A demonstration at another wound line is turned, scaled and moved, so that its shape is preserved. A plan turns and
moves the passes of a policy without changing them (`skills.planning.plan.stack`). If start and goal are further apart
than in the demonstration, or nearer, a pass has to be scaled too, and by the same factor in every direction: only then
is the shape the surgeon's. So the demonstration is moved before it is put into its grid and learnt from, and everything
certified of a policy holds for this one as well. Of the turns that bring the line from start to goal onto the new one,
the one that keeps its upper side up is taken (`skills.comparison.distances.placed`); gravity and the arm above the
wound do not turn. This is ours; the paper moves passes only.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from skills.arithmetic import product
from skills.arrays import Floats, freeze, frozen
from skills.comparison.distances import TREMOR_S, distances, medoid, placed, resampled
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import lengths_along, smoothed_tip
from skills.errors import BadInput, BadPath
from skills.gridworld.grid import GridPath, choose_grid, discretize
from skills.kinematics import matrix_of, quaternion_of
from skills.learning.evaluation import dtw

SCALES = (0.25, 4.0)  # ours: a stitch of 10 mm does not represent one above 40, and tremor would become motion


def moved(demo: Demo, start_mm: ArrayLike, goal_mm: ArrayLike) -> Demo:
    """Return a demonstration moved to another start and goal.

    The tool turns with it. Time stays, so speeds are scaled. The place where the other arm would take the needle is not
    known, so `partner` is None.

    Args:
        demo: The demonstration.
        start_mm: The new start in the demonstration's frame, shape (3,).
        goal_mm: The new goal in the same frame, shape (3,).

    Raises:
        BadPath: The demonstration or the new line ends within a millimetre of its start, or the ratio of their lengths
            is outside `SCALES`.
    """
    start, goal = (frozen(one, np.float64, (3,), name) for one, name in ((start_mm, "start_mm"), (goal_mm, "goal_mm")))
    lengths = np.linalg.norm([goal - start, demo.tip_mm[-1] - demo.tip_mm[0]], axis=1)
    scale = lengths[0] / max(lengths[1], np.finfo(float).tiny)
    if not SCALES[0] <= scale <= SCALES[1]:
        raise BadPath(
            f"From its start to its goal the new path is {scale:.3g} times as long as the demonstrated one; a "
            f"style is scaled by {SCALES[0]:g} to {SCALES[1]:g}.",
            scale=float(scale),
        )
    tip_mm = laid(placed(demo.tip_mm, scaled=True), start, goal)
    turn = product(axes(start, goal).T, axes(demo.tip_mm[0], demo.tip_mm[-1]))
    seen = demo.rotation_xyzw
    rotation = None if seen is None else quaternion_of(product(turn, matrix_of(seen)))
    return replace(demo, tip_mm=tip_mm, rotation_xyzw=rotation, partner=None)


def laid(shape: Floats, start_mm: Floats, goal_mm: Floats) -> Floats:
    """Return a shape moved between a start and a goal, (T, 3): the inverse of `placed(scaled=True)`.

    Args:
        shape: The shape in units of the distance from start to goal, (T, 3).
        start_mm: The start, shape (3,).
        goal_mm: The goal in the same frame, shape (3,).

    Raises:
        BadPath: They lie within a millimetre of each other.
    """
    length_mm = np.linalg.norm(goal_mm - start_mm, axis=-1)
    return np.asarray(start_mm + product(length_mm * shape, axes(start_mm, goal_mm)))


def axes(start_mm: Floats, goal_mm: Floats) -> Floats:
    """Return the axes of a hand-off's own frame as rows, (3, 3): along the line, sideways and upwards.

    Args:
        start_mm: The start, shape (3,).
        goal_mm: The goal in the same frame, shape (3,).

    Raises:
        BadPath: Start and goal lie within a millimetre of each other.
    """
    return placed(np.stack([start_mm, *(start_mm + np.eye(3)), goal_mm]))[1:4].T


TOGETHER_MM = 5.0  # a cell of the paper's grid: of paths further apart, the place would be averaged, not the shape
AGREEING = 2.0  # chosen on cohorts that the results are not measured on; 1.5 and 3 do about as well
NANOMETRE = 6  # decimals of a mm: warping has ties, and every machine should find the same path
MAX_ROUNDS = 100  # of the barycentre; it converges after 5 to 15


# The demonstration nearest to all, the path of the least total distance to all, or the middle of those that agree.
Combining = Literal["medoid", "barycentre", "corridor"]
COMBININGS: tuple[Combining, ...] = get_args(Combining)


@dataclass(frozen=True, eq=False)
class Combined:
    """One path for several demonstrations.

    Attributes:
        tip_mm: The path in the demonstrations' frame, shape (S, 3).
        width_mm: Distance from each state within which the majority of them pass it, shape (S,); 0 for a single one.
        apart_mm: Distance from each demonstration, averaged over the states (DTW), shape (N,).
        medoid: Index of the demonstration that is nearest to all; the newest among equals.
        at: Index of the demonstration whose place it has, if they were shown at different places: the newest, or the
            medoid itself.
        moved: True if they were, so that all were moved there.
    """

    tip_mm: Floats
    width_mm: Floats
    apart_mm: Floats
    medoid: int
    at: int
    moved: bool

    def __post_init__(self) -> None:
        freeze(self, tip_mm=(None, 3), width_mm=(len(self.tip_mm),), apart_mm=(None,))


def combine(demos: Sequence[Demo], how: Combining) -> Combined:
    """Combine demonstrations into one path.

    Apart from which is the newest, their order does not matter.

    Args:
        demos: The demonstrations, oldest first.
        how: The method.

    Raises:
        BadInput: There are none, or they are not of one arm, frame and instrument.
        BadPath: They were shown at different places, and one of them ends within a millimetre of its start.
    """
    if len({(demo.arm, demo.frame, demo.instrument) for demo in demos}) != 1:
        raise BadInput("Only demonstrations of one arm, in one frame and with one instrument can be combined.")
    ways_mm, _ = side_by_side(demos)
    # Reversed, so that the newest is taken among equals.
    nearest = medoid(distances(ways_mm, ways_mm), np.arange(len(demos))[::-1])
    at = nearest if how == "medoid" else len(demos) - 1
    ways_mm, moved = side_by_side(demos, at)
    tip_mm = ways_mm[nearest]
    if how != "medoid":
        tip_mm = (barycentre if how == "barycentre" else corridor)(ways_mm, tip_mm).round(NANOMETRE)
    apart_mm = distances(tip_mm[None], ways_mm)[0] / len(tip_mm)
    return Combined(tip_mm, widths(ways_mm, tip_mm), apart_mm, nearest, at, moved)


@dataclass(frozen=True, eq=False)
class Followed:
    """The input for learning a policy from several demonstrations.

    Attributes:
        combined: The combined path, with its width.
        demo: The path as a demonstration.
        path: The path in its grid, of R waypoints.
    """

    combined: Combined
    demo: Demo
    path: GridPath

    @property
    def width_mm(self) -> Floats:
        """The width of the path at each waypoint, (R,): the largest of the widths warped to it."""
        pairs = dtw(self.combined.tip_mm, self.path.tip_mm).pairs
        wide_mm = np.zeros(len(self.path.states))
        np.maximum.at(wide_mm, pairs[:, 1], self.combined.width_mm[pairs[:, 0]])
        return wide_mm


def followed(demos: Sequence[Demo], paths: Sequence[GridPath], how: Combining) -> Followed:
    """Combine demonstrations and return a demonstration and a grid path to learn from.

    A medoid is one of them, with its path. Any other path is put into the grid of the newest, or if it leaves that
    grid, into a new one with the same cell size.

    Args:
        demos: The demonstrations, oldest first.
        paths: The grid path of each.
        how: The method.

    Raises:
        BadInput: There are none, or they are not of one arm, frame and instrument.
        BadPath: They cannot be moved to one place, or the combined path has no path in the grid.
    """
    combined = combine(demos, how)
    one, like = demos[combined.at], paths[combined.at]
    if how == "medoid":
        return Followed(combined, one, like)
    grid = like.grid
    if not grid.holds(grid.cells_at(combined.tip_mm)).all():
        grid = choose_grid(combined.tip_mm, "auto", grid.cell_mm)
    return Followed(combined, demonstrated(combined, one), discretize(combined.tip_mm, grid, like.hysteresis))


def demonstrated(combined: Combined, newest: Demo) -> Demo:
    """Return a combined path as a demonstration, at an even speed in the duration of the newest.

    Args:
        combined: The combined path.
        newest: The demonstration that gives arm, frame, duration, rotations and jaw angles, at equal parts of its
            length.
    """
    along_mm = lengths_along(newest.tip_mm)
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
    """Return each demonstration's path at a common place, (N, S, 3) mm, and whether they were moved there.

    Args:
        demos: Demonstrations in one frame.
        at: Index of the demonstration to whose place all are moved, if they were shown at different places.

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
    """Return states equally far apart along a demonstration's path, without tremor: (S, 3) mm."""
    return resampled(smoothed_tip(demo.stamps_s, demo.tip_mm, TREMOR_S)[1])


def barycentre(ways_mm: Floats, first_mm: Floats) -> Floats:
    """Return the path of the least total distance to all, (S, 3); a local minimum, which depends on the first path.

    Args:
        ways_mm: The paths, shape (N, T, 3).
        first_mm: The path to begin with, shape (S, 3).
    """
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
    """Return the middle, (S, 3), of the paths that agree at each state of one of them.

    Args:
        ways_mm: The paths, shape (N, T, 3).
        along_mm: The path on whose states they vote, shape (S, 3).
    """
    votes_mm = _votes(ways_mm, along_mm)
    away_mm = np.linalg.norm(votes_mm - np.median(votes_mm, axis=0), axis=-1)
    agree = away_mm <= AGREEING * _of_majority(away_mm)
    return np.asarray((votes_mm * agree[..., None]).sum(axis=0) / agree.sum(axis=0)[:, None])


def widths(ways_mm: Floats, along_mm: Floats) -> Floats:
    """Return the distance from each state of a path within which the majority of the paths pass it, shape (S,) mm.

    Args:
        ways_mm: The paths, shape (N, T, 3).
        along_mm: The path, shape (S, 3).
    """
    return _of_majority(np.linalg.norm(_votes(ways_mm, along_mm) - along_mm, axis=-1))


def _of_majority(away_mm: Floats) -> Floats:
    """Return the least distance, of (N, S), within which more than half of the N are: (S,)."""
    return np.asarray(np.sort(away_mm, axis=0)[len(away_mm) // 2])


def _votes(ways_mm: Floats, along_mm: Floats) -> Floats:
    """Return the mean of each path's points, (N, T, 3), that are warped to each state of one, (S, 3): (N, S, 3)."""
    aligned = [dtw(one, along_mm) for one in ways_mm]
    return np.stack([to.at_reference(one[to.pairs[:, 0]]) for one, to in zip(ways_mm, aligned, strict=True)])
