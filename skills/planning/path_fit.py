"""Smooth paths along the raw demonstration, inside a rollout's cells, and the hand along them.

    Demo, GridPath --trace--> SmoothedDemo;   Rollout, SmoothedDemo, start --fit_to_demo--> FittedPath

The grid rounds a demonstration to the centres of its cells, half a cell away (h / 2 in 3-D) on average. The recording
has the surgeon's actual place in each cell. All of this is ours; the paper drives from centre to centre.

* A *visit* is one entry of a rollout. The tail of a rollout that visits the demonstration's last waypoints one after
  the other is where it *follows* the demonstration; each sample of the recording belongs to the waypoint that
  `discretize` made of it, so a path that crosses itself is followed branch by branch.
* The *guide* is the curve that the path should follow: the start, the centres of the cells before the demonstration is
  joined, the demonstration without tremor and rests, its last sample. Its first and last sample are in the policy's
  first and last cell, but not in their centres, so the path of a hand begins and ends where the hand did. If a rollout
  joins the demonstration later, the demonstrated part of the guide begins where the demonstration is nearest to the
  centre of the cell and is shifted to meet it; the shift fades over the length of one cell.
* The *clock* of a path tells when the hand was where: times in the demonstration, and the index of the path's point at
  each, with a fraction. So orientation, jaw and tempo can be those of the hand. What comes
  before the demonstration is joined was not demonstrated, and takes no time on this clock.
* The path is the smoothest sequence of points near the guide, each in the grid and in the cell of its visit. With
  hysteresis a point may be as far outside of that cell as the recording may be (`GridWorld.cells_along`):

      minimise  sum |x_i - guide_i|^2 + STIFFNESS sum |x_(i-1) - 2 x_i + x_(i+1)|^2,  x_i in its cell, ends held

A visit in which the guide advances by less than `GRAZED` is grazed, through tremor or across a corner, and gets no
point. The remaining points still go from cell to touching cell in the rollout's order.

The *hand* along a pass: when the surgeon was where, how the jaw was turned, and how far it was open.

    Demo, FittedPath --hand_along--> Hand;   Demos, PoseStyle --styled--> Demo with the hand of the style

The clock of a fitted path has the times of the demonstration along it. So orientation, jaw and
tempo of a pass are those recorded at the same time, and not at the nearest place: where a path crosses itself, or the
hand turns at rest, nearness decides nothing. All of this is ours; the paper holds the orientation.

* The hand rests before its first sample and after its last. Tip, orientation and jaw are averaged by the Hann window
  that takes the tremor out of the path (`TREMOR_S`), over a time that is longer by half a window on both sides. The
  path has been averaged already, but without that the tip would change its speed from point to point, and jerk more
  than the surgeon's. So a pass begins and ends at rest, at the first and the last recorded pose exactly. In bends the
  tip leaves the path by `Hand.deviation_mm`.
* Before the demonstration is joined nothing was recorded: the tip goes along the path's approach at the mean speed of
  what follows, and the jaw is held as it was where the path joins.
* A pause of the hand remains one, also one in which the arm was not driven.

Of several demonstrations the pose style is the hand (`skills.learning.pose_style`): its motion between the ends of the
path that they were combined into, at equal shares of the lengths of both paths.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import dist, inf, sqrt

import numpy as np

from skills.arithmetic import product
from skills.arrays import Flags, Floats, Ints, freeze, interpolated
from skills.compiled import compiled
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import lengths_along, same_signs, smoothed_tip
from skills.errors import BadPlan
from skills.gridworld.grid import GridPath
from skills.kinematics import instrument_of, matrix_of, quaternion_of
from skills.learning.policy import Rollout
from skills.quaternions import mean_rotation, unit

TREMOR_S = 0.25  # a Hann window this wide has its zeros at 8, 12, 16 Hz and passes less than 3 % in between
# Lengths as parts of a cell:
STEP = 0.1  # between points: 0.5 mm in the paper's cells; wider ones round off the small motions of a hand
GRAZED = 0.02  # a visit that advances by less is due to tremor, or crosses a corner
BLEND = 1.0
MOVED = 0.02  # a hand that stays within this distance is at rest
INSIDE = 0.001  # distance from the cell's faces, so that rounding never puts a point into the neighbouring cell
STIFFNESS = 0.3  # halves waves that are 4 points long, 2 mm in the paper's cells; preserves longer ones
_ROUNDS = 120


@dataclass(frozen=True, eq=False)
class SmoothedDemo:
    """A demonstration without tremor and rests.

    Attributes:
        path: The demonstration in its grid.
        tip_mm: Points in the demonstration's frame, shape (N, 3).
        waypoints: The waypoint of each point, shape (N,).
        seconds: The time of each point in the demonstration, shape (N,), ascending.
        ends_mm: Its first and its last sample, each within its cell, shape (2, 3).
        end_s: The time of its last sample.
    """

    path: GridPath
    tip_mm: Floats
    waypoints: Ints
    seconds: Floats
    ends_mm: Floats
    end_s: float

    def __post_init__(self) -> None:
        count = len(self.tip_mm)
        freeze(self, tip_mm=(count, 3), seconds=(count,), ends_mm=(2, 3))
        freeze(self, np.int64, waypoints=(count,))


@dataclass(frozen=True, eq=False)
class FittedPath:
    """A smooth path in the grid; along each axis a point is at most 0.5 + hysteresis cells from its visit's centre.

    Attributes:
        tip_mm: Points in the demonstration's frame, shape (K, 3).
        visits: The rollout's visit of each point, ascending, shape (K,).
        clock_s: Times in the demonstration, shape (C,), ascending; the first is when it is joined.
        places: The index of a point of `tip_mm`, with a fraction, at each of these times, shape (C,), ascending.
    """

    tip_mm: Floats
    visits: Ints
    clock_s: Floats
    places: Floats

    def __post_init__(self) -> None:
        freeze(self, tip_mm=(None, 3), clock_s=(None,), places=(len(self.clock_s),))
        freeze(self, np.int64, visits=(len(self.tip_mm),))


def trace(demo: Demo, path: GridPath) -> SmoothedDemo:
    """Return a demonstration without tremor (8 to 12 Hz) and rests, with the waypoint of each point.

    Waypoints that contain no sample get a point on the straight line between the samples around them.

    Args:
        demo: The demonstration.
        path: The path that `discretize` made from it.

    Raises:
        BadPlan: The path was not made from this demonstration.
        OutsideGrid: This demonstration is not inside the path's grid.
    """
    waypoints = _waypoints(demo.tip_mm, path)
    seconds, tip = smoothed_tip(demo.stamps_s, demo.tip_mm, TREMOR_S)
    calm = interpolated(demo.stamps_s, seconds, tip)
    bridged = np.setdiff1d(np.arange(len(path.states)), waypoints)
    before = np.searchsorted(waypoints, bridged) - 1
    share = (bridged - waypoints[before]) / (waypoints[before + 1] - waypoints[before])
    calm = np.concatenate((calm, calm[before] + share[:, None] * (calm[before + 1] - calm[before])))
    times = np.concatenate((demo.stamps_s, demo.stamps_s[before] + share * np.diff(demo.stamps_s)[before]))
    waypoints = np.concatenate((waypoints, bridged))
    order = np.argsort(waypoints, kind="stable")
    moving = order[_moving(calm[order], MOVED * path.grid.cell_mm)]
    ends = ends_of(demo, path)
    return SmoothedDemo(path, calm[moving], waypoints[moving], times[moving], ends, float(demo.stamps_s[-1]))


def ends_of(demo: Demo, path: GridPath) -> Floats:
    """Return the first and the last sample of a demonstration, each within its cell, shape (2, 3).

    Args:
        demo: The demonstration.
        path: The path that `discretize` made from it.
    """
    half = path.grid.cell_mm * (0.5 - INSIDE)
    centres = path.tip_mm[[0, -1]]
    # hysteresis lets a sample belong to a cell from just outside of it
    return demo.tip_mm[[0, -1]].clip(centres - half, centres + half).round(6)


def fit_to_demo(followed: Rollout, demonstrated: SmoothedDemo, start_mm: Floats | None = None) -> FittedPath:
    """Fit a smooth path to the demonstration that a rollout follows, within the rollout's cells in their order.

    With hysteresis a point may be outside of its cell by as much, but not outside of the grid.

    Args:
        followed: A rollout that reaches the goal.
        demonstrated: The demonstration that its policy was learnt from.
        start_mm: Start of the path in the demonstration's frame, shape (3,), in the rollout's first cell; None: the
            demonstration's own, for a rollout that begins in its first cell.

    Returns:
        The path from the start to the demonstration's last sample, rounded to a nanometre.
    """
    assert followed.finished and np.array_equal(followed.path.states, demonstrated.path.states)
    guide, visits, clock_s = _guide(followed, demonstrated, start_mm)
    along = lengths_along(guide)
    if along[-1] == 0:
        return FittedPath(guide[:1], visits[:1], clock_s[[0, -1]], np.zeros(2))
    grid, cell_mm = followed.path.grid, followed.path.grid.cell_mm
    at, visits = _touching(*_spread(along, visits, cell_mm), grid.cells_of(followed.states))
    wanted = interpolated(at, along, guide)
    centres = followed.tip_mm[visits]
    half = cell_mm * (0.5 - INSIDE)
    away = half + cell_mm * followed.path.hysteresis
    first, last = grid.centres_mm([0, grid.n_states - 1])
    low, high = np.maximum(centres - away, first - half), np.minimum(centres + away, last + half)
    # The ends are fixed, because start and goal are promised to clients.
    low[0] = high[0] = guide[0]
    low[-1] = high[-1] = guide[-1]
    tip = _smoothest(wanted, low, high, STIFFNESS)
    tip[1:-1] = tip[1:-1].round(6)  # to a nanometre, so that every machine computes the same bytes
    return FittedPath(tip, visits, clock_s, np.interp(along, at, np.arange(len(at))))


def _waypoints(tip_mm: Floats, path: GridPath) -> Ints:
    """Return the waypoint of each sample, (T,), counted as in `discretize`: a jump over n cells is n waypoints."""
    cells = path.grid.cells_along(tip_mm, path.hysteresis)
    waypoints = np.append(0, np.cumsum(np.abs(np.diff(cells, axis=0)).max(axis=1)))
    if waypoints[-1] != len(path.states) - 1 or (path.cells[waypoints] != cells).any():
        raise BadPlan("The policy was not learnt from this demonstration; give the demonstration of its path.")
    return waypoints


def _moving(tip_mm: Floats, least_mm: float) -> Ints:
    """Return the indices, (M,), of points at least this far from the previous one returned; the first point is one."""
    found, places = [0], tip_mm.tolist()
    for index, place in enumerate(places):
        if dist(place, places[found[-1]]) >= least_mm:
            found.append(index)
    return np.array(found)


def _guide(followed: Rollout, demonstrated: SmoothedDemo, start_mm: Floats | None) -> tuple[Floats, Ints, Floats]:
    """Return the points of the guide, (M, 3), the visit of each, (M,), and its time in the demonstration, (M,)."""
    last = len(followed.states) - 1
    joined = last + 1 - _tail(followed)
    start, goal = demonstrated.ends_mm if start_mm is None else (start_mm, demonstrated.ends_mm[1])
    approach = np.concatenate((start[None], followed.tip_mm[1 : joined + 1]))
    visits = demonstrated.waypoints - (len(demonstrated.path.states) - 1 - last)
    part = np.flatnonzero((visits >= joined) & (joined < last))  # none where only the goal's cell is left
    part = part[_nearest(demonstrated.tip_mm[part], visits[part] == joined, approach[-1]) :]
    part = part[::-1][_nearest(demonstrated.tip_mm[part][::-1], visits[part][::-1] == last, goal) :][::-1]
    tip, over_mm = demonstrated.tip_mm[part], BLEND * followed.path.grid.cell_mm
    if len(part) and visits[part[0]] == joined:
        tip = _blended(tip, approach[-1], over_mm)
    if len(part) and visits[part[-1]] == last:
        tip = _blended(tip[::-1], goal, over_mm)[::-1]
    of_visit = np.concatenate((np.arange(joined + 1), visits[part], [last]))
    seconds = demonstrated.seconds[part]
    # A hand at its own start moves off when the surgeon did; elsewhere, or if the rollout leaves out a loop, the clock
    # begins where the path joins.
    whole = start_mm is None and joined == 0 and last + 1 == len(demonstrated.path.states)
    joins_s = 0.0 if whole else float(seconds[0]) if len(part) else demonstrated.end_s
    clock_s = np.concatenate((np.full(joined + 1, joins_s), seconds, [demonstrated.end_s]))
    return np.concatenate((approach, tip, goal[None])), of_visit, clock_s


def _tail(followed: Rollout) -> int:
    """Count the visits at the end that are the demonstration's last waypoints, one after the other."""
    both = min(len(followed.states), len(followed.path.states))
    differ = np.flatnonzero(followed.states[-both:] != followed.path.states[-both:])
    return both if len(differ) == 0 else both - 1 - int(differ[-1])


def _nearest(tip_mm: Floats, of_visit: Flags, place_mm: Floats) -> int:
    """Return the index of a visit's point, the first in order, nearest to a place; 0 if the visit has no points."""
    count = int(np.count_nonzero(of_visit))
    return int(np.linalg.norm(tip_mm[:count] - place_mm, axis=1).argmin()) if count else 0


def _blended(tip_mm: Floats, place_mm: Floats, over_mm: float) -> Floats:
    """Return a path, (M, 3), that begins at a place and joins the original path over a length."""
    along = lengths_along(tip_mm)
    share = np.minimum(along / over_mm, 1.0)[:, None]
    blended: Floats = tip_mm + (place_mm - tip_mm[0]) * (1 - share * share * (3 - 2 * share))
    return blended


def _spread(along: Floats, visits: Ints, cell_mm: float) -> tuple[Floats, Ints]:
    """Choose the positions of the points along the guide, (K,) mm, and the visit of each, (K,).

    Every visit is divided evenly; neighbouring grazed visits are merged if together they are long enough for a point.
    """
    first = np.flatnonzero(np.append(True, np.diff(visits) > 0))
    after = np.append(first[1:], len(visits))
    edges = np.concatenate(([0.0], (along[after[:-1] - 1] + along[first[1:]]) / 2, along[-1:]))
    grazed = np.diff(edges) < GRAZED * cell_mm
    unit = np.append(0, np.cumsum(~(grazed[1:] & grazed[:-1])))
    begin = np.flatnonzero(np.append(True, np.diff(unit) > 0))
    end = np.append(begin[1:], len(first))
    kept = edges[end] - edges[begin] >= GRAZED * cell_mm
    begin, end = begin[kept], end[kept]
    between = (edges[end[:-1]] + edges[begin[1:]]) / 2
    limits = np.concatenate(([0.0], between, along[-1:]))
    # Not of all limits: a path of almost no length has no visit that gets a point.
    low, wide = limits[: len(begin)], np.diff(limits)[: len(begin)]
    counts = np.maximum(1, np.rint(wide / (STEP * cell_mm))).astype(np.int64)
    of = np.repeat(np.arange(len(counts)), counts)
    places = low[of] + wide[of] * (np.arange(len(of)) - (np.cumsum(counts) - counts)[of] + 0.5) / counts[of]
    number = (np.searchsorted(edges, places, side="right") - 1).clip(begin[of], end[of] - 1)
    return np.concatenate(([0.0], places, along[-1:])), np.concatenate((visits[:1], visits[first[number]], visits[-1:]))


def _touching(at: Floats, visits: Ints, cells: Ints) -> tuple[Floats, Ints]:
    """Insert a point for every skipped visit between cells that do not touch.

    A violent movement can skip a cell, because the average of its samples lies in neither of two distant cells.
    """
    apart = np.flatnonzero(np.abs(np.diff(cells[visits], axis=0)).max(axis=1) > 1)
    left_out = [np.arange(visits[i] + 1, visits[i + 1]) for i in apart]
    places = [np.linspace(at[i], at[i + 1], len(new) + 2)[1:-1] for i, new in zip(apart, left_out, strict=True)]
    before = np.repeat(apart + 1, [len(new) for new in left_out])
    return np.insert(at, before, np.concatenate([[], *places])), np.insert(
        visits, before, np.concatenate([np.empty(0, np.int64), *left_out])
    )


def _smoothest(wanted: Floats, low: Floats, high: Floats, stiffness: float) -> Floats:
    """Solve the minimisation of the module's docstring for points within boxes, all of shape (K, 3).

    By Nesterov's accelerated projected gradient.
    """
    x = wanted.clip(low, high)
    bend = np.zeros((len(x) + 2, 3))  # of each point, with a point before the first and one after the last
    _descend(wanted.ravel(), low.ravel(), high.ravel(), stiffness, x.ravel(), x.flatten(), bend.ravel())
    return x


@compiled
def _descend(
    wanted: Floats, low: Floats, high: Floats, stiffness: float, x: Floats, ahead: Floats, bend: Floats
) -> None:
    """Move `x` towards the minimum; all arrays flat, `ahead` equal to `x` and `bend` 0 at first."""
    rate = 1 / (1 + 16 * stiffness)  # 1 over the largest curvature of the objective; the smallest is 1
    push = (1 - sqrt(rate)) / (1 + sqrt(rate))
    for _ in range(_ROUNDS):
        for i in range(6, len(x)):
            bend[i] = stiffness * ((ahead[i] - ahead[i - 3]) - (ahead[i - 3] - ahead[i - 6]))
        for i in range(len(x)):
            slope = ahead[i] - wanted[i] + bend[i + 6] + bend[i] - 2 * bend[i + 3]
            after = min(max(ahead[i] - rate * slope, low[i]), high[i])
            ahead[i] = after + push * (after - x[i])
            x[i] = after


LEAST_MM_S = 1.0  # ours: of an approach, if what is followed after it hardly moves
NEAR = 8  # pieces of the path, to either side of the present one, whose distance is measured
LEAST_STEP_S = 1e-6
LONGEST_S = 3600.0  # ours: no hand-off takes an hour; a stamp that is years off would exhaust the memory


@dataclass(frozen=True, eq=False)
class Hand:
    """The hand along one pass, at the surgeon's own tempo.

    Attributes:
        seconds: Times from the start of the pass, shape (M,), evenly spaced from 0.
        tip_mm: The tip in the arm's frame, shape (M, 3).
        deviation_mm: Its greatest distance from the pass's path.
        rotation_xyzw: The jaw's rotation in the arm's frame, unit quaternions, shape (M, 4); None: held.
        jaw_rad: Angle of the jaw, shape (M,); None if it was not recorded.
    """

    seconds: Floats
    tip_mm: Floats
    deviation_mm: float
    rotation_xyzw: Floats | None = None
    jaw_rad: Floats | None = None

    def __post_init__(self) -> None:
        count = len(self.seconds)
        freeze(self, seconds=(count,), tip_mm=(count, 3), rotation_xyzw=(count, 4), jaw_rad=(count,))
        if count < 2 or self.seconds[0] != 0 or (np.diff(self.seconds) <= 0).any():
            raise BadPlan("The times of a hand begin at 0 and increase; give at least two.")
        if self.rotation_xyzw is not None:
            matrix_of(self.rotation_xyzw)

    @property
    def duration_s(self) -> float:
        """Seconds from the first time to the last."""
        return float(self.seconds[-1])

    @property
    def peak_mm_s(self) -> float:
        """The greatest speed of the tip."""
        return float((np.linalg.norm(np.diff(self.tip_mm, axis=0), axis=1) / np.diff(self.seconds)).max())

    @property
    def length_mm(self) -> float:
        """The length of the tip's way."""
        return float(np.linalg.norm(np.diff(self.tip_mm, axis=0), axis=1).sum())

    def at(self, count: int) -> tuple[Floats, Floats | None, Floats | None]:
        """Return the hand at evenly spaced times from its first to its last, both exact.

        Args:
            count: The number of times, at least 2.

        Returns:
            Positions of the tip, mm, shape (count, 3); rotations [n o a], shape (count, 3, 3), or None; and angles of
            the jaw, shape (count,), or None.
        """
        seen, jaw = self.rotation_xyzw, self.jaw_rad
        turned = None if seen is None else matrix_of(self._between(same_signs(seen), count))
        opened = None if jaw is None else self._between(jaw, count).clip(jaw.min(), jaw.max())
        return self._between(self.tip_mm, count), turned, opened

    def _between(self, values: Floats, count: int) -> Floats:
        """Return values, (M, ...), at evenly spaced times, (count, ...)."""
        from scipy.interpolate import CubicSpline  # here, because clients read plans without it

        # A cubic spline, because a step of the speed at every sample would be an acceleration without bound.
        found = CubicSpline(self.seconds, values)(np.linspace(0.0, self.duration_s, count))
        found[[0, -1]] = values[[0, -1]]
        return np.asarray(found)


def hand_along(demo: Demo, fitted: FittedPath, *, turning: bool) -> Hand:
    """Return the hand along a fitted path, in the demonstration's frame.

    Args:
        demo: The demonstration that the path is fitted to.
        fitted: The path.
        turning: Whether the jaw turns as it was recorded; otherwise it is held.

    Raises:
        BadPlan: The demonstration is longer than an hour.
    """
    if not demo.stamps_s[-1] <= LONGEST_S:
        raise BadPlan(f"The demonstration takes {demo.stamps_s[-1]:g} s; a pass of at most {LONGEST_S:g} s is planned.")
    joins_s, clock_s, places = _clock(fitted)
    times = np.unique(np.concatenate((clock_s, demo.stamps_s)))
    times = times[(times >= clock_s[0]) & (times <= clock_s[-1])]
    recorded_s = np.maximum(times, joins_s)  # during the approach the jaw is as where the path joins
    points = np.arange(len(fitted.tip_mm), dtype=np.float64)
    grid_s, tip_mm = _calm(times, interpolated(np.interp(times, clock_s, places), points, fitted.tip_mm))
    turned, opened = None, None
    if turning and demo.rotation_xyzw is not None:
        _, turned = _calm(times, interpolated(recorded_s, demo.stamps_s, same_signs(demo.rotation_xyzw)))
        turned = unit(turned)
    if (jaw := jaw_within(demo)) is not None:
        opened = _calm(times, np.interp(recorded_s, demo.stamps_s, jaw)[:, None])[1][:, 0]
    off_mm = _off_mm(tip_mm, fitted.tip_mm, np.interp(grid_s, clock_s, places))
    return Hand((grid_s - grid_s[0]).round(9), tip_mm, off_mm, turned, opened)


def _calm(seconds: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Average values, (T, N), of a hand that rests before and after, over `TREMOR_S`; first and last are exact.

    Returns:
        Even times, (M,), from half a window before the first to half a window after the last, and the means, (M, N).
    """
    half_s = TREMOR_S / 2
    rested_s = np.concatenate(([seconds[0] - half_s], seconds, [seconds[-1] + half_s]))
    grid_s, calm = smoothed_tip(rested_s, np.concatenate((values[:1], values, values[-1:])), TREMOR_S)
    calm[[0, -1]] = values[[0, -1]]  # without the window's round-off
    return grid_s, calm.round(9)  # so that every machine computes the same bytes


def _clock(fitted: FittedPath) -> tuple[float, Floats, Floats]:
    """Return when the demonstration is joined, and times and places of the path, its approach included.

    The approach has the mean speed of what is followed after it.
    """
    way_mm = lengths_along(fitted.tip_mm)
    joins_s = float(fitted.clock_s[0])
    joined = int(np.flatnonzero(fitted.clock_s == joins_s)[-1])  # the approach is all at one time
    clock_s, places = fitted.clock_s[joined:], fitted.places[joined:]
    lead_mm = float(np.interp(places[0], np.arange(len(way_mm)), way_mm))
    followed_s = float(clock_s[-1]) - joins_s
    speed_mm_s = (way_mm[-1] - lead_mm) / followed_s if followed_s > 0 else 0.0
    lead_s = lead_mm / max(float(speed_mm_s), LEAST_MM_S)
    if lead_s:
        before = np.flatnonzero(way_mm < lead_mm)
        clock_s = np.concatenate((joins_s - lead_s * (1 - way_mm[before] / lead_mm), clock_s))
        places = np.concatenate((before, places))
    last = np.append(np.diff(clock_s) > 0, True)  # of equal times the last place counts
    return joins_s, clock_s[last], places[last]


def _off_mm(tip_mm: Floats, line: Floats, places: Floats) -> float:
    """Return the greatest distance, mm, of positions, (M, 3), from a line, (K, 3), near given places on it, (M,)."""
    if len(line) == 1:
        return float(np.linalg.norm(tip_mm - line[0], axis=1).max())
    return sqrt(_furthest_mm2(np.ascontiguousarray(tip_mm), np.array(line), places))


@compiled
def _furthest_mm2(tip: Floats, line: Floats, places: Floats) -> float:
    """Return the square of the greatest distance."""
    furthest = 0.0
    for at in range(len(tip)):
        nearest, piece = inf, int(places[at])
        for first in range(max(piece - NEAR, 0), min(piece + NEAR, len(line) - 2) + 1):
            u, v, w = tip[at, 0] - line[first, 0], tip[at, 1] - line[first, 1], tip[at, 2] - line[first, 2]
            a, b = line[first + 1, 0] - line[first, 0], line[first + 1, 1] - line[first, 1]
            c = line[first + 1, 2] - line[first, 2]
            part = min(max((u * a + v * b + w * c) / max(a * a + b * b + c * c, 1e-12), 0.0), 1.0)
            u, v, w = u - part * a, v - part * b, w - part * c
            nearest = min(nearest, u * u + v * v + w * w)
        furthest = max(furthest, nearest)
    return furthest


def moved(hand: Hand, rotation: Floats, about_mm: Floats, to_mm: Floats) -> Hand:
    """Return a hand that is moved rigidly.

    Args:
        hand: The hand.
        rotation: Rotation of its new frame relative to the old one, shape (3, 3).
        about_mm: A place in the old frame, shape (3,).
        to_mm: That place in the new frame.
    """
    turned = hand.rotation_xyzw
    if turned is not None:
        turned = same_signs(quaternion_of(product(rotation, matrix_of(turned))))
    return replace(hand, tip_mm=product(hand.tip_mm - about_mm, rotation.T) + to_mm, rotation_xyzw=turned)


def jaw_recorded(hand: Hand | None) -> bool:
    """Return whether a pass has the angles of the surgeon's jaw.

    Args:
        hand: The hand along the pass; None in a plan without a demonstration.
    """
    return hand is not None and hand.jaw_rad is not None


def jaw_within(demo: Demo) -> Floats | None:
    """Return the demonstrated angles of the jaw, shape (T,), within the range of the instrument.

    Args:
        demo: The demonstration.

    Returns:
        Angles in rad, clipped to the range; None if there are none, or if their median is outside of the range: JIGSAWS
        has another zero.
    """
    if demo.jaw_rad is None:
        return None
    low, high = instrument_of(demo.instrument).jaw_rad
    return demo.jaw_rad.clip(low, high) if low <= float(np.median(demo.jaw_rad)) <= high else None


def styled(followed: Demo, demos: Sequence[Demo]) -> Demo:
    """Return the demonstration that several were combined into, with orientation, jaw and tempo of their pose style.

    Args:
        followed: Their combination, whose positions remain.
        demos: The demonstrations; without the orientation of every one, none is returned.
    """
    from skills.learning.pose_style import learn_pose_style  # here, because of scipy

    if any(demo.rotation_xyzw is None for demo in demos):
        return replace(followed, rotation_xyzw=None)
    style = learn_pose_style(demos)
    even = np.full(len(demos), 1.0 / len(demos))
    start_xyzw, goal_xyzw = mean_rotation(style.rotation_xyzw[:, [0, -1]], even)
    path = style.between(followed.tip_mm[0], start_xyzw, followed.tip_mm[-1], goal_xyzw)
    elapsed_s = np.interp(_shares(followed.tip_mm), _shares(path.tip_mm), path.elapsed_s)
    quaternions = interpolated(elapsed_s, path.elapsed_s, same_signs(path.rotation_xyzw))
    steps_s = np.diff(elapsed_s).clip(LEAST_STEP_S)  # of samples at one place, the second is a moment later
    return replace(
        followed,
        stamps_s=np.append(0.0, np.cumsum(steps_s)),
        rotation_xyzw=unit(quaternions),
        jaw_rad=None if path.jaw_rad is None else np.interp(elapsed_s, path.elapsed_s, path.jaw_rad),
    )


def _shares(tip_mm: Floats) -> Floats:
    """Return the part of a path's length up to each point, (T,), from 0 to 1."""
    along = lengths_along(tip_mm)
    return np.asarray(along / along[-1])
