"""What becomes of a pass when the arm slips: many seeded runs of a controller on the grid, and how they end.

*Slip*: with probability `slip`, instead of the intended move one of the 27 moves, drawn uniformly, is made. It may be
the intended one; off the grid the arm stays. A *controller* says what to do next in each run, a *walk* is what came of
it, and an *outcome* counts walks. `odds` works the same out for a policy without drawing anything. The paper disturbs
nothing; all of this is ours.
"""

from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skills.errors import BadSettings
from skills.style._arrays import Bytes, Floats, Ints, frozen
from skills.style.domain import OUTSIDE, Domain
from skills.style.evaluation import dtw
from skills.style.grid import MOVES, GridPath, GridWorld
from skills.style.policy import Policy

STOPS = -1  # in the place of an action: the run ends here (so does every other number below 0)
STEADY = -1  # in the place of a slip: the intended move is made
BUDGET = 10  # times the path's states: moves after which a run ends unfinished
NEGLIGIBLE = 1e-15  # a probability: the rounding of a sum of 1
NORMAL_95 = 1.959964  # 95 % of a normal distribution lie so many deviations around its mean

Bools = NDArray[np.bool_]


class Controller(Protocol):
    """Something that leads runs from cell to cell."""

    def decide(self, tick: int, states: Ints, phases: Ints) -> tuple[Ints, Ints]:
        """Choose the next action of each run, (N,), or `STOPS`.

        Args:
            tick: Moves made so far, the same in all runs.
            states: Where each run is, (N,).
            phases: What this answered beside the actions one tick ago, (N,); 0 at first.
        """
        ...


@dataclass(frozen=True, eq=False)
class FollowPolicy:
    """Follow a policy in either state as a client does; it stops where the policy promises nothing."""

    policy: Policy

    @cached_property
    def table(self) -> Ints:
        """The greedy actions, (phases, n_states)."""
        return self.policy.table().astype(np.int64)

    def decide(self, tick: int, states: Ints, phases: Ints) -> tuple[Ints, Ints]:
        """Count the states into the phases, and look the actions up."""
        domain = self.policy.domain
        phases, _ = start_all(domain, states) if tick == 0 else enter_all(domain, phases, states)
        return self.table[phases, states], phases


@dataclass(frozen=True, eq=False)
class StartAnew:
    """Follow a policy, and where it promises nothing begin another pass from there."""

    follow: FollowPolicy

    def decide(self, tick: int, states: Ints, phases: Ints) -> tuple[Ints, Ints]:
        """Do as `FollowPolicy`, and start again where that is lost."""
        actions, phases = self.follow.decide(tick, states, phases)
        phases = np.where(actions == OUTSIDE, start_all(self.follow.policy.domain, states)[0], phases)
        return self.follow.table[phases, states], phases


def start_all(domain: Domain, states: Ints) -> tuple[Ints, Bools]:
    """Start in many states at once, (N,): the phases, and which of them are already the end, as `Domain.start` says."""
    phase, done = domain.start(domain.path.goal)
    at_goal = states == domain.path.goal
    return np.where(at_goal, phase, domain.joins[states]), at_goal & done


def enter_all(domain: Domain, phases: Ints, states: Ints) -> tuple[Ints, Bools]:
    """Move onto many states at once, (N,): the phases after it and which of them finish, as `Domain.enter` says."""
    ahead = (phases > 0) & (states == domain.path.states[phases])
    finishes = np.where(phases == 0, states == domain.path.goal, ahead & (phases == domain.phases - 1))
    return np.where(phases == 0, domain.joins[states], phases + (ahead & ~finishes)), finishes


def budget(path: GridPath) -> int:
    """Limit the moves of a run."""
    return BUDGET * len(path.states)


def draw_slips(slip: float, *, runs: int, moves: int, seed: int) -> Bytes:
    """Draw the action that a slip makes in each move of each run, (moves, runs), or `STEADY`.

    The same arguments give the same bytes, and of the same seed a larger `slip` adds slips to those of a smaller one;
    so all controllers can meet the same ones.

    Raises:
        BadSettings: The slip is no probability, or there is nothing to run.
    """
    if not 0 <= slip <= 1:
        raise BadSettings("A slip is a probability, from 0 to 1.", slip=slip)
    if runs < 1 or moves < 1 or seed < 0:
        raise BadSettings("Slips need at least one run and one move, and a seed of 0 or more.", runs=runs, moves=moves)
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    chance, drawn = rng.random((moves, runs)), rng.integers(len(MOVES), size=(moves, runs))
    return np.where(chance < slip, drawn, STEADY).astype(np.int8)


@dataclass(frozen=True, eq=False)
class Walks:
    """Runs from one start or several: their states, (T, N), the last one repeated after the end, and how many moves
    each made, (N,).
    """

    path: GridPath
    states: Ints
    moves: Ints

    def __post_init__(self) -> None:
        object.__setattr__(self, "states", frozen(self.states, np.int64, (None, None), "states"))
        object.__setattr__(self, "moves", frozen(self.moves, np.int64, (self.states.shape[1],), "moves"))

    def of(self, run: int) -> Ints:
        """Take the states of one run, (T,), without consecutive repeats."""
        states = self.states[:, run]
        return states[np.concatenate(([True], np.diff(states) != 0))]


def walk(controller: Controller, path: GridPath, start: int, slips: Bytes) -> Walks:
    """Let a controller lead runs from a state until it stops or there are no more moves; slips are (moves, runs)."""
    runs = slips.shape[1]
    leads_to = _leads_to(path.grid)
    states, going = np.full(runs, start), np.ones(runs, bool)
    phases, moves = np.zeros(runs, np.int64), np.zeros(runs, np.int64)
    visited = [states]
    for tick, slipped in enumerate(slips):
        actions, phases = controller.decide(tick, states, phases)
        going = going & (actions >= 0)
        if not going.any():
            break
        made = np.where(slipped == STEADY, actions, slipped)
        states = np.where(going, leads_to[states, made], states)
        moves = moves + going
        visited.append(states)
    return Walks(path, np.stack(visited), moves)


def _leads_to(grid: GridWorld) -> Ints:
    """Find the state after each state and action, (n_states, 27)."""
    here = np.arange(grid.n_states)
    cells = grid.cells_of(here)[:, None] + MOVES
    on_grid = grid.holds(cells)
    after = np.repeat(here[:, None], len(MOVES), axis=1)
    after[on_grid] = grid.states_of(cells[on_grid])
    return after


@dataclass(frozen=True)
class Outcome:
    """How runs ended.

    Attributes:
        runs: How many.
        arrived: Those that end in the goal's cell.
        followed: Those that, from where they join the path on, enter every waypoint in its order, and end at the goal:
            they finish in the phase state.
        left_out: States of the demonstration that a run never visits, in any order, on average over all runs.
        extra_moves: What slips cost those that followed, on average, in moves; None where none followed.
        dtw_total_mm: DTW between the cells of a run and the demonstration's, Manhattan, on average over all runs.
        farthest_mm: How far from the nearest waypoint a run comes at worst (Euclidean), on average over all runs.
    """

    runs: int
    arrived: int
    followed: int
    left_out: float
    extra_moves: float | None
    dtw_total_mm: float
    farthest_mm: float


def judge(walks: Walks, planned_moves: int | None = None) -> Outcome:
    """Count and measure walks; `planned_moves` are those without a slip, of the demonstration itself if left out."""
    planned = len(walks.path.states) - 1 if planned_moves is None else planned_moves
    followed = follows(walks)
    return Outcome(
        runs=len(walks.moves),
        arrived=int(arrives(walks).sum()),
        followed=int(followed.sum()),
        left_out=float(left_out(walks).mean()),
        extra_moves=float(walks.moves[followed].mean() - planned) if followed.any() else None,
        dtw_total_mm=float(dtw_totals_mm(walks).mean()),
        farthest_mm=float(farthest_mm(walks).mean()),
    )


def arrives(walks: Walks) -> Bools:
    """Tell for each run whether it ends in the goal's cell, (N,)."""
    return np.asarray(walks.states[-1] == walks.path.goal)


def follows(walks: Walks) -> Bools:
    """Tell for each run whether it enters all waypoints in order and ends at the goal, (N,): see `Outcome`."""
    domain = Domain(walks.path, phased=True)
    phases, finished = start_all(domain, walks.states[0])
    for states in walks.states[1:]:
        phases, now = enter_all(domain, phases, states)
        finished = finished | now
    return finished & arrives(walks)


def left_out(walks: Walks) -> Ints:
    """Count for each run the different states of the demonstration that it never visits, (N,)."""
    visited = [(walks.states == state).any(axis=0) for state in np.unique(walks.path.states)]
    return np.asarray(np.count_nonzero(~np.array(visited), axis=0))


def dtw_totals_mm(walks: Walks) -> Floats:
    """Measure each run's DTW distance to the demonstration, (N,) mm; equal runs are aligned once."""
    grid, totals = walks.path.grid, dict[bytes, float]()
    ways = [walks.of(run) for run in range(len(walks.moves))]
    for states in ways:
        key = states.tobytes()
        if key not in totals:
            totals[key] = dtw(grid.centres_mm(states), walks.path.tip_mm).total_mm
    return np.array([totals[states.tobytes()] for states in ways])


def farthest_mm(walks: Walks) -> Floats:
    """Measure how far from its nearest waypoint each run comes at worst, (N,) mm."""
    grid, path = walks.path.grid, walks.path
    centres, nearest = grid.centres_mm(np.arange(grid.n_states)), np.full(grid.n_states, np.inf)
    for waypoint in path.tip_mm:  # one at a time: all at once would be states x waypoints
        np.minimum(nearest, np.sqrt(((centres - waypoint) ** 2).sum(axis=1)), out=nearest)
    return np.asarray(nearest[walks.states].max(axis=0))


def wilson(count: int, of: int) -> tuple[float, float]:
    """Bound a share that was counted by its Wilson score interval, 95 %."""
    share, z2 = count / of, NORMAL_95**2
    middle = (share + z2 / (2 * of)) / (1 + z2 / of)
    half = NORMAL_95 * sqrt(share * (1 - share) / of + z2 / (4 * of**2)) / (1 + z2 / of)
    return max(0.0, middle - half), min(1.0, middle + half)


@dataclass(frozen=True)
class Odds:
    """The probability that a policy finishes, and how many moves it then takes on average (None: it never does)."""

    finishes: float
    moves: float | None


def odds(policy: Policy, slip: float, start: int, moves: int) -> Odds:
    """Work out how a policy fares that stops where it promises nothing, with so many moves at most.

    Its rows, finishing and stopping are an absorbing Markov chain: the probability of being in each row is moved on,
    move by move. Nothing is drawn, so this is a second method for `walk`.
    """
    domain = policy.domain
    phase, done = domain.start(start)
    if done:
        return Odds(1.0, 0.0)
    row_after, finishes = _chain(policy)
    goes_on = row_after >= 0
    chance = np.full(len(MOVES) + 1, slip / len(MOVES))
    chance[-1] = 1 - slip  # of the intended move, which stands last
    at, by_move = np.zeros(domain.n_rows), np.zeros(moves)
    at[domain.rows_of(phase, domain.path.grid.cells_of(start))] = 1.0
    for move in range(moves):
        flow = at[:, None] * chance
        by_move[move] = flow[finishes].sum()
        at = np.bincount(row_after[goes_on], weights=flow[goes_on], minlength=domain.n_rows).astype(np.float64)
        if at.sum() < NEGLIGIBLE:
            break
    total = float(by_move.sum())
    return Odds(total, float(by_move @ np.arange(1, moves + 1)) / total if total > 0 else None)


def _chain(policy: Policy) -> tuple[Ints, Bools]:
    """Find what follows each row after each of the 27 moves and after the intended one, (rows, 28): the row (-1: it
    ends), and whether it finishes. Rows without an action lead nowhere.
    """
    domain, live = policy.domain, policy.greedy >= 0
    rows = np.arange(domain.n_rows)
    each = [domain.move(rows, np.full(len(rows), action)) for action in range(len(MOVES))] + [policy.moves]
    row_after = np.column_stack([one.row for one in each])
    finishes = np.column_stack([one.finishes for one in each])
    return np.where(live[:, None], row_after, -1), finishes & live[:, None]
