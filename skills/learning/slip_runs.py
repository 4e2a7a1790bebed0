"""Seeded runs of controllers on a grid whose moves slip, and controllers to compare a policy with.

    Controller, slips --walk--> Walks --judge--> SlipOutcome

The slips are those of `skills.gridworld.slip`. A *controller* returns the next action of each run, a *walk* is the
sequence of states that results, and an *outcome* summarises walks. `odds` computes the result for a policy exactly,
without random numbers. The paper has no disturbances; all of this is ours.

Two replay controllers take the shortest path to the demonstration, planned once from the start, and then replay it.
Replay has two fair interpretations: of *moves*, one after the other, wherever the arm is; and of *positions by the
clock*, as position control does it: at each tick the next recorded position is commanded, and the arm moves towards it,
at most a cell along each axis. Neither takes its progress in the demonstration into account: a replay that did, and
waited for each waypoint, would be the policy of the phase state.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from skills.arrays import Bytes, Flags, Floats, Ints, freeze
from skills.gridworld.domain import OUTSIDE, Domain
from skills.gridworld.grid import MOVES, GridPath, GridWorld, discretize
from skills.gridworld.slip import STEADY, SlipModel
from skills.learning.evaluation import dtw
from skills.learning.policy import Policy, Rollout

STOPS = -1  # in place of an action: the run ends here (as with every other number below 0)
BUDGET = 10  # times the number of the path's states: moves after which a run ends unfinished
NEGLIGIBLE = 1e-15  # a probability of the size of the rounding error of a sum of 1


class Controller(Protocol):
    """A controller that chooses the actions of parallel runs."""

    def decide(self, tick: int, states: Ints, phases: Ints) -> tuple[Ints, Ints]:
        """Choose the next action of each run.

        Args:
            tick: Number of moves made so far, the same in all runs.
            states: State of each run, shape (N,).
            phases: The phases that this method returned one tick ago, shape (N,); 0 at first.

        Returns:
            The actions, or `STOPS`, and the phases, both of shape (N,).
        """
        ...


@dataclass(frozen=True, eq=False)
class FollowPolicy:
    """A controller that follows a policy in either state, as a client does; it stops outside the certified domain."""

    policy: Policy

    @cached_property
    def table(self) -> Ints:
        """The greedy actions, (phases, n_states)."""
        return self.policy.table().astype(np.int64)

    def decide(self, tick: int, states: Ints, phases: Ints) -> tuple[Ints, Ints]:
        """Update the phases with the states, and look the actions up."""
        domain = self.policy.domain
        phases, _ = domain.start(states) if tick == 0 else domain.enter(phases, states)
        return self.table[phases, states], phases


@dataclass(frozen=True, eq=False)
class StartAnew:
    """A controller that follows a policy, and starts another pass wherever it has left the certified domain."""

    follow: FollowPolicy

    def decide(self, tick: int, states: Ints, phases: Ints) -> tuple[Ints, Ints]:
        """Choose actions as `FollowPolicy`, but start again in runs that are outside the certified domain."""
        actions, phases = self.follow.decide(tick, states, phases)
        phases = np.where(actions == OUTSIDE, self.follow.policy.domain.start(states)[0], phases)
        return self.follow.table[phases, states], phases


def budget(path: GridPath) -> int:
    """Return the greatest number of moves of a run.

    Args:
        path: The demonstrated path.

    Returns:
        `BUDGET` times the number of its states.
    """
    return BUDGET * len(path.states)


@dataclass(frozen=True, eq=False)
class Walks:
    """The results of runs on a grid.

    Attributes:
        path: The demonstrated path.
        states: States of each run, shape (T, N); the last one is repeated after the end.
        moves: Number of moves of each run, shape (N,).
        touched: Whether each run ended by touching the scene, shape (N,); None without a scene. The move that touches
            is counted, and the state before it is the last one.
    """

    path: GridPath
    states: Ints
    moves: Ints
    touched: Flags | None = None

    def __post_init__(self) -> None:
        freeze(self, np.int64, states=(None, None), moves=(None,))

    def of(self, run: int) -> Ints:
        """Return the states of one run, (T,), without consecutive repeats."""
        states = self.states[:, run]
        return states[np.concatenate(([True], np.diff(states) != 0))]


def walk(controller: Controller, path: GridPath, start: int, slips: Bytes, touches: Flags | None = None) -> Walks:
    """Run a controller with slips from a state, until it stops or the moves are used up.

    Args:
        controller: The controller.
        path: The demonstrated path.
        start: State index of the start, the same for all runs.
        slips: The slips, shape (moves, runs), as `SlipModel.draw` returns them.
        touches: Moves that touch a scene and end a run, shape (n_states, 27); None without a scene.

    Returns:
        The walks.
    """
    runs = slips.shape[1]
    after = leads_to(path.grid)
    states, going = np.full(runs, start), np.ones(runs, bool)
    phases, moves, touched = np.zeros(runs, np.int64), np.zeros(runs, np.int64), np.zeros(runs, bool)
    visited = [states]
    for tick, slipped in enumerate(slips):
        actions, phases = controller.decide(tick, states, phases)
        going = going & (actions >= 0)  # a run that has stopped stays stopped, whatever the controller returns later
        if not going.any():
            break
        made = np.where(slipped == STEADY, actions, slipped)
        if touches is not None:
            now = going & touches[states, made]
            moves, touched, going = moves + now, touched | now, going & ~now
        # A run that has stopped has a negative action; the state looked up for it is discarded.
        states = np.where(going, after[states, made], states)
        moves = moves + going
        visited.append(states)
    return Walks(path, np.stack(visited), moves, None if touches is None else touched)


def leads_to(grid: GridWorld) -> Ints:
    """Return the state to which each action leads from each state.

    Args:
        grid: The grid world.

    Returns:
        Shape (n_states, 27); the state itself for a move off the grid.
    """
    here = np.arange(grid.n_states)
    cells = grid.cells_of(here)[:, None] + MOVES
    on_grid = grid.holds(cells)
    after = np.repeat(here[:, None], len(MOVES), axis=1)
    after[on_grid] = grid.states_of(cells[on_grid])
    return after


@dataclass(frozen=True)
class SlipOutcome:
    """A summary of runs.

    Attributes:
        runs: Number of runs.
        arrived: Runs that end in the goal's cell.
        followed: Runs that from their first waypoint on enter every waypoint in order and end at the goal: they finish
            in the phase state.
        left_out: States of the demonstration that a run never visits, in any order; the mean over all runs.
        extra_moves: Additional moves because of slips, the mean over the runs that followed; None if none did.
        dtw_total_mm: Total DTW distance (Manhattan) between the cells of a run and the demonstration's; the mean over
            all runs.
        farthest_mm: Greatest distance (Euclidean) of a run from its nearest waypoint; the mean over all runs.
    """

    runs: int
    arrived: int
    followed: int
    left_out: float
    extra_moves: float | None
    dtw_total_mm: float
    farthest_mm: float


def judge(walks: Walks, planned_moves: int | None = None) -> SlipOutcome:
    """Count and measure walks.

    Args:
        walks: The walks.
        planned_moves: Number of moves without slips; None for that of the demonstration.

    Returns:
        The summary.
    """
    planned = len(walks.path.states) - 1 if planned_moves is None else planned_moves
    followed = follows(walks)
    return SlipOutcome(
        runs=len(walks.moves),
        arrived=int(arrives(walks).sum()),
        followed=int(followed.sum()),
        left_out=float(left_out(walks).mean()),
        extra_moves=float(walks.moves[followed].mean() - planned) if followed.any() else None,
        dtw_total_mm=float(dtw_totals_mm(walks).mean()),
        farthest_mm=float(farthest_mm(walks).mean()),
    )


def arrives(walks: Walks) -> Flags:
    """Return for each run whether it ends in the goal's cell.

    Args:
        walks: The walks.

    Returns:
        Flags of shape (N,).
    """
    return np.asarray(walks.states[-1] == walks.path.goal)


def follows(walks: Walks) -> Flags:
    """Return for each run whether it enters all waypoints in order and ends at the goal; see `SlipOutcome.followed`.

    Args:
        walks: The walks.

    Returns:
        Flags of shape (N,).
    """
    domain = Domain(walks.path, phased=True)
    phases, finished = domain.start(walks.states[0])
    for states in walks.states[1:]:
        phases, now = domain.enter(phases, states)
        finished = finished | now
    return finished & arrives(walks)


def left_out(walks: Walks) -> Ints:
    """Count for each run the distinct states of the demonstration that it never visits.

    Args:
        walks: The walks.

    Returns:
        Counts, shape (N,).
    """
    visited = [(walks.states == state).any(axis=0) for state in np.unique(walks.path.states)]
    return np.asarray(np.count_nonzero(~np.array(visited), axis=0))


def dtw_totals_mm(walks: Walks) -> Floats:
    """Compute each run's total DTW distance to the demonstration; equal runs are aligned once.

    Args:
        walks: The walks.

    Returns:
        Distances in mm, shape (N,).
    """
    grid, totals = walks.path.grid, dict[bytes, float]()
    ways = [walks.of(run) for run in range(len(walks.moves))]
    for states in ways:
        key = states.tobytes()
        if key not in totals:
            totals[key] = dtw(grid.centres_mm(states), walks.path.tip_mm).total_mm
    return np.array([totals[states.tobytes()] for states in ways])


def farthest_mm(walks: Walks) -> Floats:
    """Compute the greatest distance of each run from its nearest waypoint.

    Args:
        walks: The walks.

    Returns:
        Distances in mm, shape (N,).
    """
    grid, path = walks.path.grid, walks.path
    centres, nearest = grid.centres_mm(np.arange(grid.n_states)), np.full(grid.n_states, np.inf)
    for waypoint in path.tip_mm:  # one at a time: the array of all would be states x waypoints
        np.minimum(nearest, np.sqrt(((centres - waypoint) ** 2).sum(axis=1)), out=nearest)
    return np.asarray(nearest[walks.states].max(axis=0))


@dataclass(frozen=True)
class Odds:
    """The probability that a policy finishes, and its mean number of moves if it does (None if it never finishes)."""

    finishes: float
    moves: float | None


def odds(policy: Policy, slip: SlipModel, start: int, moves: int) -> Odds:
    """Compute exactly the result of a policy whose moves slip and which stops outside the certified domain.

    Its rows, finishing and stopping are an absorbing Markov chain: the probability of being in each row is propagated,
    move by move. No random numbers are used, so this is a second method for `walk`.

    Args:
        policy: The policy.
        slip: How moves slip.
        start: State index of the start.
        moves: The greatest number of moves.

    Returns:
        The probability of finishing, and the mean number of moves.
    """
    domain = policy.domain
    phase, done = domain.start(start)
    if done:
        return Odds(1.0, 0.0)
    row_after, finishes = _chain(policy)
    goes_on = row_after >= 0
    chance = np.append(slip.probability * slip.drawn, slip.intended)  # the intended move is the last column
    at, by_move = np.zeros(domain.n_rows), np.zeros(moves)
    at[domain.rows_of(phase, domain.path.grid.cells_of(start))] = 1.0
    for move in range(moves):
        flow = at[:, None] * chance
        by_move[move] = flow[finishes].sum()
        at = np.bincount(row_after[goes_on], weights=flow[goes_on], minlength=domain.n_rows).astype(np.float64)
        if at.sum() < NEGLIGIBLE:
            break
    total = float(by_move.sum())
    return Odds(total, float((by_move * np.arange(1, moves + 1)).sum()) / total if total > 0 else None)


def _chain(policy: Policy) -> tuple[Ints, Flags]:
    """Return the transitions of each row for each of the 27 moves and the intended one, both of shape (rows, 28).

    The first array has the row after the move (-1 if the walk ends), the second whether it finishes. Rows without an
    action lead nowhere.
    """
    domain, live = policy.domain, policy.greedy >= 0
    rows = np.arange(domain.n_rows)
    each = [domain.move(rows, np.full(len(rows), action)) for action in range(len(MOVES))] + [policy.moves]
    row_after = np.column_stack([one.row for one in each])
    finishes = np.column_stack([one.finishes for one in each])
    return np.where(live[:, None], row_after, -1), finishes & live[:, None]


PLACE_VALUES = np.array([9, 3, 1])  # action = steps, each -1, 0 or 1, plus 1, times these


def shortest_way(path: GridPath, start: int) -> Ints:
    """Plan the states from a start straight to the nearest waypoint (Chebyshev; the first of equals), then the path.

    Args:
        path: The demonstrated path.
        start: State index of the start.

    Returns:
        The states, shape (L,), the start first.
    """
    grid = path.grid
    joins_at = int(np.abs(path.cells - grid.cells_of(start)).max(axis=1).argmin())
    rest = path.states[joins_at:]
    if rest[0] == start:
        return rest
    straight = discretize(grid.centres_mm([start, rest[0]]), grid).states
    return np.concatenate((straight, rest[1:]))


def replay(path: GridPath, start: int) -> Rollout:
    """Follow the shortest path to the demonstration, and then the demonstration, without slips.

    Args:
        path: The demonstrated path.
        start: State index of the start.

    Returns:
        The rollout, with phase 0 throughout.
    """
    plan = shortest_way(path, start)
    return Rollout(path, plan, np.zeros_like(plan), finished=int(plan[-1]) == path.goal)


@dataclass(frozen=True, eq=False)
class ReplayMoves:
    """A controller that makes the moves of a plan, (L,) states, in order, whatever happens; then it stops."""

    grid: GridWorld
    plan: Ints

    def decide(self, tick: int, states: Ints, phases: Ints) -> tuple[Ints, Ints]:
        """Return the plan's next move for all runs."""
        if tick >= len(self.plan) - 1:
            return np.full(len(states), STOPS), phases
        before, after = self.grid.cells_of(self.plan[tick : tick + 2])
        return np.full(len(states), _action(after - before)), phases


@dataclass(frozen=True, eq=False)
class ReplayPositions:
    """A controller that commands the positions of a plan, (L,) states, by the clock.

    At the end of the plan it commands the last position until the arm is there.
    """

    grid: GridWorld
    plan: Ints

    def decide(self, tick: int, states: Ints, phases: Ints) -> tuple[Ints, Ints]:
        """Move each run towards the plan's position after this move."""
        last = len(self.plan) - 1
        commanded = self.grid.cells_of(self.plan[min(tick + 1, last)])
        actions = _action((commanded - self.grid.cells_of(states)).clip(-1, 1))
        return np.where((tick >= last) & (states == self.plan[last]), STOPS, actions), phases


def _action(steps: Ints) -> Ints:
    """Return the actions of moves, (..., 3) cells."""
    return np.asarray(((steps + 1) * PLACE_VALUES).sum(axis=-1), np.int64)
