"""Rivals of the policy under slips: dynamic movement primitives, and replay controllers.

Dynamic movement primitives (Ijspeert et al. 2013) come from the library `movement_primitives`. A demonstration becomes
an attractor in continuous space: a spring to the goal and a forcing term, a weighted sum of basis functions of the
clock. One tick is one move of the grid. The training data is the path through the centres of its cells at an even
speed, and a rest at the goal so that the primitive learns to brake; it starts with the speed of the first move. It has
a basis function for each tick of that data: with half as many it may leave states out, and more change little. Each
tick continues from the actual position of the arm.

Every controller meets the same slips: those of one seed, and a larger probability adds to them.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from movement_primitives.dmp import DMP

from skills.arrays import Bytes, Floats, Ints, interpolated
from skills.gridworld.grid import MOVES, GridPath
from skills.gridworld.reward import sparse_reward
from skills.gridworld.slip import STEADY, slip_model
from skills.learning import slip_runs
from skills.learning.dynamic_programming import ValueIteration
from skills.learning.policy import Policy, Rollout, learn_tabular

REST_TICKS = 5
STEPS = 20  # integration steps per tick
RIDGE = 1e-4  # of the regression; without it the last weights are so large that the motion overshoots after its end


@dataclass(frozen=True, eq=False)
class Primitive:
    """A learnt primitive of a path: the weights of the basis functions along each axis, shape (3, K)."""

    path: GridPath
    weights: Floats


def learn_primitive(path: GridPath) -> Primitive:
    """Learn a path's primitive by ridge regression; nothing is random."""
    ticks = len(path.states) - 1 + REST_TICKS
    at = np.arange(ticks * STEPS + 1) / STEPS
    shown_mm = interpolated(at, np.arange(len(path.states), dtype=np.float64), path.tip_mm)
    primitive = _dmp(path, dimensions=3)
    primitive.imitate(at, shown_mm, regularization_coefficient=RIDGE)
    return Primitive(path, np.array(primitive.forcing_term.weights_))


def _dmp(path: GridPath, dimensions: int) -> Any:
    ticks = len(path.states) - 1 + REST_TICKS
    return DMP(dimensions, execution_time=float(ticks), dt=1 / STEPS, n_weights_per_dim=ticks)


def walk_primitive(primitive: Primitive, starts: Ints, slips: Bytes) -> slip_runs.Walks:
    """Run a primitive from the centres of starts, shape (N,), with slips, shape (moves, N).

    A slip replaces the primitive's motion in a tick and moves the arm by one cell; a motion off the grid is not made. A
    run ends at the first tick after the demonstration's duration at which the arm is in the goal's cell.
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
            # the integrator without compiled code
            own, _ = dmp.step(dmp.current_y, dmp.current_yd, step_function="rk4")
        displaced_mm = at_mm + grid.cell_mm * MOVES[slipped]
        to_mm = np.where((slipped == STEADY)[:, None], own.reshape(-1, 3), displaced_mm)
        moved = going & grid.holds(grid.cells_at(to_mm))
        at_mm = np.where(moved[:, None], to_mm, at_mm)
        moves = moves + going
        cells.append(grid.cells_at(at_mm))
    return slip_runs.Walks(path, grid.states_of(_bridged(np.stack(cells))), moves)


def _many(primitive: Primitive, starts: Ints) -> Any:
    """Return one primitive that runs many in parallel, three dimensions each, which do not affect each other."""
    tip_mm = primitive.path.tip_mm
    dmp = _dmp(primitive.path, dimensions=3 * len(starts))
    dmp.set_weights(np.tile(primitive.weights, (len(starts), 1)))
    dmp.configure(
        start_y=primitive.path.grid.centres_mm(starts).reshape(-1),
        start_yd=np.tile(tip_mm[1] - tip_mm[0], len(starts)),
        goal_y=np.tile(tip_mm[-1], len(starts)),
    )
    dmp.reset()
    dmp.initialized = True  # otherwise the first step would reset the position to the start
    return dmp


def _bridged(cells: Ints) -> Ints:
    """Insert straight lines of touching cells between the cells of all ticks, shape (T, N, 3), as `discretize` does."""
    jump = np.diff(cells, axis=0)
    far = np.abs(jump).max(axis=-1, keepdims=True).clip(1)
    between = [np.floor(cells[:-1] + jump * np.minimum(n / far, 1) + 0.5) for n in range(1, int(far.max()) + 1)]
    every = np.stack(between, axis=1).reshape(-1, *cells.shape[1:])
    return np.concatenate((cells[:1], every.astype(np.int64)))


def rollouts(primitive: Primitive, starts: Ints) -> list[Rollout]:
    """Run a primitive without slips from many starts, shape (N,), and return a rollout for each."""
    moves = 3 * len(primitive.path.states)
    walks = walk_primitive(primitive, starts, np.full((moves, len(starts)), STEADY, np.int8))
    ways = [walks.of(run) for run in range(len(starts))]
    goal = primitive.path.goal
    return [Rollout(primitive.path, way, np.zeros_like(way), bool(way[-1] == goal)) for way in ways]


SLIPS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3)
SEED = 0
OURS, ANEW, CELL = "ours: phase and cell", "ours, started anew where lost", "the paper's state: cell"
SOLVED = "ours, solved for this slip"
MOVES_REPLAYED, POSITIONS_REPLAYED = "replay of moves", "replay of positions by the clock"
PRIMITIVE = "dynamic movement primitive"

Run = Callable[[Bytes], slip_runs.Walks]


@dataclass(frozen=True)
class Disturbed:
    """The outcome of one controller under slips of one probability; `exact` is that of ours without sampling."""

    by: str
    slip: float
    outcome: slip_runs.SlipOutcome
    exact: slip_runs.Odds | None


def disturb(ours: Policy, cell: Policy, primitive: Primitive, runs: int) -> tuple[Disturbed, ...]:
    """Run every controller from the demonstrated start, `runs` times for each probability of a slip."""
    return tuple(one for slip in SLIPS for one in _at(slip, ours, cell, primitive, runs))


def _at(slip: float, ours: Policy, cell: Policy, primitive: Primitive, runs: int) -> Iterator[Disturbed]:
    path, moves = ours.path, slip_runs.budget(ours.path)
    slips = slip_model(slip).draw(runs=runs, moves=moves, seed=SEED)
    solved = learn_tabular(sparse_reward(path, ours.levels), ValueIteration(slip=slip))
    without_drawing = {OURS: ours, SOLVED: solved}
    for by, run in _runners(ours, solved, cell, primitive).items():
        exact = (
            slip_runs.odds(without_drawing[by], slip_model(slip), path.start, moves) if by in without_drawing else None
        )
        yield Disturbed(by, slip, slip_runs.judge(run(slips)), exact)


def _runners(ours: Policy, solved: Policy, cell: Policy, primitive: Primitive) -> dict[str, Run]:
    """Return all controllers by name, as functions of the slips."""
    path = ours.path
    plan = slip_runs.shortest_way(path, path.start)
    controllers: dict[str, slip_runs.Controller] = {
        OURS: slip_runs.FollowPolicy(ours),
        SOLVED: slip_runs.FollowPolicy(solved),
        ANEW: slip_runs.StartAnew(slip_runs.FollowPolicy(ours)),
        CELL: slip_runs.FollowPolicy(cell),
        MOVES_REPLAYED: slip_runs.ReplayMoves(path.grid, plan),
        POSITIONS_REPLAYED: slip_runs.ReplayPositions(path.grid, plan),
    }
    runners: dict[str, Run] = {by: _led_by(controller, ours) for by, controller in controllers.items()}
    runners[PRIMITIVE] = lambda slips: walk_primitive(primitive, np.full(slips.shape[1], path.start), slips)
    return runners


def _led_by(controller: slip_runs.Controller, ours: Policy) -> Run:
    return lambda slips: slip_runs.walk(controller, ours.path, ours.path.start, slips)
