"""Dynamic movement primitives (Ijspeert et al. 2013) as a rival, from the library `movement_primitives`.

A demonstration becomes an attractor in continuous space: a spring to the goal and a forcing term, a weighted sum of
basis functions of the clock. One tick is one move of the grid. It is shown the path through the centres of its cells at
an even speed, and a rest at the goal so that it learns to brake; it starts with the speed of the first move. It has a
basis function for each tick that it is shown: with half as many it may leave states out, and more change little. In
each tick it goes on from where the arm really is.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from movement_primitives.dmp import DMP

from skills.style._arrays import Bytes, Floats, Ints
from skills.style.disturbance import STEADY, Walks
from skills.style.grid import MOVES, GridPath
from skills.style.policy import Rollout

REST_TICKS = 5
STEPS = 20  # of integration in a tick
RIDGE = 1e-4  # of the regression; without it the last weights are so large that it overshoots after its time


@dataclass(frozen=True, eq=False)
class Primitive:
    """What was learnt of a path: the weights of the basis functions along each axis, (3, K)."""

    path: GridPath
    weights: Floats


def learn_primitive(path: GridPath) -> Primitive:
    """Learn a path's primitive by ridge regression; nothing is drawn at random."""
    ticks = len(path.states) - 1 + REST_TICKS
    at = np.arange(ticks * STEPS + 1) / STEPS
    shown_mm = np.column_stack([np.interp(at, np.arange(len(path.states)), axis_mm) for axis_mm in path.tip_mm.T])
    primitive = _dmp(path, dimensions=3)
    primitive.imitate(at, shown_mm, regularization_coefficient=RIDGE)
    return Primitive(path, np.array(primitive.forcing_term.weights_))


def _dmp(path: GridPath, dimensions: int) -> Any:
    ticks = len(path.states) - 1 + REST_TICKS
    return DMP(dimensions, execution_time=float(ticks), dt=1 / STEPS, n_weights_per_dim=ticks)


def walk_primitive(primitive: Primitive, starts: Ints, slips: Bytes) -> Walks:
    """Run a primitive from the centres of starts, (N,), with slips, (moves, N).

    A slip takes the place of all that it would have moved in a tick, and is a whole cell's width long; off the grid the
    arm stays. It ends at the first tick after the demonstration's duration at which it is in the goal's cell.
    """
    path, grid = primitive.path, primitive.path.grid
    dmp = _many(primitive, starts)
    at_mm, moves, going = grid.centres_mm(starts), np.zeros(len(starts), np.int64), np.ones(len(starts), bool)
    cells = [grid.cells_at(at_mm)]
    goal_cell, duration = path.cells[-1], len(path.states) - 1
    for tick, slipped in enumerate(slips):
        going = going & ((tick < duration) | (cells[-1] != goal_cell).any(axis=1))
        if not going.any():
            break
        dmp.current_y = at_mm.reshape(-1).copy()
        for _ in range(STEPS):
            own, _ = dmp.step(dmp.current_y, dmp.current_yd, step_function="rk4")  # the one without compiled code
        displaced_mm = at_mm + grid.cell_mm * MOVES[slipped]
        to_mm = np.where((slipped == STEADY)[:, None], own.reshape(-1, 3), displaced_mm)
        moved = going & grid.holds(grid.cells_at(to_mm))
        at_mm = np.where(moved[:, None], to_mm, at_mm)
        moves = moves + going
        cells.append(grid.cells_at(at_mm))
    return Walks(path, grid.states_of(_bridged(np.stack(cells))), moves)


def _many(primitive: Primitive, starts: Ints) -> Any:
    """Set many runs up as one primitive of three dimensions each: dimensions know nothing of each other."""
    tip_mm = primitive.path.tip_mm
    dmp = _dmp(primitive.path, dimensions=3 * len(starts))
    dmp.set_weights(np.tile(primitive.weights, (len(starts), 1)))
    dmp.configure(
        start_y=primitive.path.grid.centres_mm(starts).reshape(-1),
        start_yd=np.tile(tip_mm[1] - tip_mm[0], len(starts)),
        goal_y=np.tile(tip_mm[-1], len(starts)),
    )
    dmp.reset()
    dmp.initialized = True  # else its first step takes the start for where the arm is
    return dmp


def _bridged(cells: Ints) -> Ints:
    """Put the straight line of touching cells between the cells of all ticks, (T, N, 3), as `discretize` does."""
    jump = np.diff(cells, axis=0)
    far = np.abs(jump).max(axis=-1, keepdims=True).clip(1)
    between = [np.floor(cells[:-1] + jump * np.minimum(n / far, 1) + 0.5) for n in range(1, int(far.max()) + 1)]
    every = np.stack(between, axis=1).reshape(-1, *cells.shape[1:])
    return np.concatenate((cells[:1], every.astype(np.int64)))


def rollouts(primitive: Primitive, starts: Ints) -> list[Rollout]:
    """Run a primitive undisturbed from many starts, (N,): the states of each."""
    moves = 3 * len(primitive.path.states)
    walks = walk_primitive(primitive, starts, np.full((moves, len(starts)), STEADY, np.int8))
    ways = [walks.of(run) for run in range(len(starts))]
    goal = primitive.path.goal
    return [Rollout(primitive.path, way, np.zeros_like(way), bool(way[-1] == goal)) for way in ways]
