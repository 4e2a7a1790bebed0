"""Exact values by dynamic programming, and value iteration as a learner.

The exact value of every row of a domain, and of every action in it, follows from the rewards without learning.

If no move slips, the values above phase 0 follow from one distance: with d the Chebyshev distance to the next
waypoint (at least 1: staying in its cell enters it), V = gamma^(d-1) A_p, where A_p = 1 + gamma V_(p+1) at that
waypoint, and A of the last phase is the goal's reward. In phase 0, and in the paper's cell state, the values are the
fixed point of value iteration over the grid.

If moves slip (`skills.gridworld.slip`), all values are the fixed point of value iteration over the whole domain.

With gamma 0.1 a state 300 moves from the path has a value below 10^-300, where floating-point numbers lose digits, and
soon all. Such *faint* values are compared by their logarithms (`log_losses`): without slips as integers, in units of
2^-36, so that any number of moves adds up exactly; with slips as the fixed point of value iteration in logarithms.

As a learner in the phase state, `ValueIteration` gives the exact Q values of Algorithm 1's rewards without a move of
the arm. The paper tried value iteration first, in its *cell* state, and gave it up (Sec. III-C;
`skills.learning.max_ent_irl` explains one reason for the failure there, a path that crosses itself is another). In the
phase state it finds the same policy as Q-learning, without exploration: it knows the result of each move, which
Q-learning has to find out.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Bytes, Flags, Floats, Ints
from skills.compiled import compiled
from skills.errors import BadSettings
from skills.gridworld.domain import Domain, Moves
from skills.gridworld.grid import MOVES, moves_between
from skills.gridworld.hazards import STAY, Hazards
from skills.gridworld.reward import RewardMap
from skills.gridworld.slip import SlipModel, slip_model
from skills.learning.learner_state import PhaseState

MAX_SWEEPS = 100_000
NO_STATE = -1  # of the state at which an unjoined pass finishes, where there is none
ENDLESS = "The exact values do not converge: a cycle has a positive reward; use a smaller gamma."
SETTLED = 1e-14  # relative: a value that changes by less has settled
FAINT = 1e-300  # a smaller value is compared by its logarithm; the smallest normal number is 2e-308
LOG_UNIT = 2.0**-36  # of a logarithm as an integer: 1.5e-11
LOG_NONE = -(2**62)  # in place of the logarithm of 0; less than that of any value
LOG_SETTLED = 1e-12  # a logarithm that changes by less has settled; added is its own rounding


@dataclass(frozen=True, eq=False)
class Mdp:
    """The Markov decision process of a path.

    Attributes:
        domain: The states: phases and cells.
        reward: The rewards.
        gamma: The discount.
        slip: How moves slip.
        hazards: A scene on the path's grid, or None; a move that touches it ends the pass.
    """

    domain: Domain
    reward: RewardMap
    gamma: float
    slip: SlipModel = field(default_factory=lambda: slip_model(0.0))
    hazards: Hazards | None = None

    @property
    def closed_form(self) -> bool:
        """Whether the values follow from distances: nothing slips, and nothing is in the way."""
        return self.slip.probability == 0 and self.hazards is None


def exact_values(mdp: Mdp) -> Floats:
    """Return the exact value of every row; 0 at finished rows.

    Args:
        mdp: The decision process.

    Returns:
        Values, shape (rows,).

    Raises:
        BadSettings: Value iteration does not settle, because the rewards pay for going round in circles.
    """
    if not mdp.closed_form:
        return np.asarray(exact_q(mdp).max(axis=1))
    domain = mdp.domain
    assert not domain.phased or mdp.reward.levels.other == 0, "otherwise a longer path earns more"
    moves, arrival = _moves_to_go(mdp)
    values = _powers(mdp.gamma, moves) * arrival
    values[domain.terminal] = 0.0  # before phase 0, which joins other phases and reads their values
    values[: domain.offset[1]] = _phase_0_values(mdp, values)
    return values


def _powers(gamma: float, exponents: Ints) -> Floats:
    """Return gamma to the power of some exponents by repeated multiplication, whose bits no processor decides."""
    return np.asarray(np.cumprod([1.0, *[gamma] * int(exponents.max(initial=0))])[exponents])


def _moves_to_go(mdp: Mdp) -> tuple[Ints, Floats]:
    """Return d - 1 and A_p of each row above phase 0, both (rows,); 0 in phase 0."""
    domain, levels, gamma = mdp.domain, mdp.reward.levels, mdp.gamma
    waypoints, later = domain.path.cells, slice(domain.offset[1], None)
    behind = _powers(gamma, moves_between(waypoints[1:], waypoints[:-1]).clip(1)).tolist()
    arrival = np.zeros(domain.phases)  # A_p
    arrival[1:] = levels.goal
    for phase in range(domain.phases - 2, 0, -1):
        arrival[phase] = levels.visited + behind[phase] * arrival[phase + 1]
    moves = np.zeros(domain.n_rows, np.int64)
    moves[later] = moves_between(domain.cell_of[later], waypoints[domain.phase_of[later]]).clip(1) - 1
    return moves, arrival[domain.phase_of]


def _phase_0_values(mdp: Mdp, values: Floats) -> Floats:
    """Iterate values over the whole grid until nothing changes; returns shape (n_states,)."""
    domain, reward = mdp.domain, mdp.reward
    grid, joining = domain.path.grid, np.flatnonzero(domain.joins)
    rewards = domain.rewards_unjoined(reward)
    worth = rewards.copy()  # reward and discounted value of entering each state
    worth[joining] += mdp.gamma * values[domain.rows_of(domain.joins[joining], grid.cells_of(joining))]
    stays = domain.joins == 0
    stays[domain.path.goal] &= not domain.finishes_unjoined
    best, shape = np.zeros(grid.n_states), np.array(grid.shape)
    settled = settle(
        best,
        worth,
        rewards,
        stays,
        shape,
        domain.path.goal if domain.finishes_unjoined else NO_STATE,
        reward.levels.off_grid,
        float(mdp.gamma),
        SETTLED,
        MAX_SWEEPS,
    )
    if not settled:
        raise BadSettings(ENDLESS)
    return best


def exact_q(mdp: Mdp) -> Floats:
    """Return all exact Q values; 0 at finished rows and outside the certified domain.

    Args:
        mdp: The decision process.

    Returns:
        Q values, shape (rows, 27).

    Raises:
        BadSettings: As for `exact_values`.
    """
    if not mdp.closed_form:
        return _iterated_q(mdp)
    domain, values = mdp.domain, exact_values(mdp)
    q = np.zeros((domain.n_rows, len(MOVES)))
    for action in range(len(MOVES)):
        q[:, action] = action_values(mdp, values, domain.move(*_everywhere(domain, action)))
    q[~domain.certified | domain.terminal] = 0.0
    return q


def _iterated_q(mdp: Mdp) -> Floats:
    """Iterate values over the whole domain until nothing changes, with slips or hazards; returns Q values, (rows, 27).

    Hazards make values that nearly cancel, so these settle absolutely, in proportion to the cost of touching.
    """
    pays, after, off_grid = _each_action(mdp)
    nothing = ~mdp.domain.certified | mdp.domain.terminal
    floor = 0.0
    if mdp.hazards is not None:
        nothing |= mdp.hazards.forbidden[mdp.domain.state_of]
        floor = SETTLED * mdp.hazards.touch
    values = np.zeros(mdp.domain.n_rows)
    for _ in range(MAX_SWEEPS):
        made = pays + mdp.gamma * np.append(values, 0.0)[after]
        # A slip off the grid stays at no cost: only an intended move off the grid is a fault of the policy.
        q = mdp.slip.expected(made, np.where(off_grid, made[STAY], made))
        q[:, nothing] = 0.0
        change, values = np.abs(q.max(axis=0) - values), q.max(axis=0)
        if (change <= SETTLED * np.abs(values) + floor).all():
            return np.ascontiguousarray(q.T)
    raise BadSettings(ENDLESS)


def _each_action(mdp: Mdp) -> tuple[Floats, Ints, Flags]:
    """Make each move from each row, without slips; returns arrays of shape (27, rows).

    The reward, the row after the move (-1: none), and whether the move is off the grid.
    """
    moves = [mdp.domain.move(*_everywhere(mdp.domain, action)) for action in range(len(MOVES))]
    pays = np.stack([_pays(mdp, moved) for moved in moves])
    after = np.stack([moved.row for moved in moves])
    if mdp.hazards is not None:
        touches = mdp.hazards.touches[mdp.domain.state_of].T
        pays = np.where(touches, -mdp.hazards.touch, pays - mdp.hazards.cost[np.stack([m.state for m in moves])])
        after[touches] = -1
    return pays, after, np.stack([moved.off_grid for moved in moves])


def _everywhere(domain: Domain, action: int) -> tuple[Ints, Ints]:
    """Return all rows, and one action for each of them, both (rows,)."""
    return np.arange(domain.n_rows), np.full(domain.n_rows, action)


def action_values(mdp: Mdp, values: Floats, moves: Moves) -> Floats:
    """Return the value of one move from every row if it does not slip.

    Args:
        mdp: The decision process.
        values: The value of every row, shape (rows,).
        moves: The result of the move from every row, arrays of shape (rows,).

    Returns:
        Reward plus discounted value, shape (rows,).
    """
    # Row -1 (finished, or outside the domain) reads the 0 that is appended.
    return np.asarray(_pays(mdp, moves) + mdp.gamma * np.append(values, 0.0)[moves.row])


def log_losses(mdp: Mdp, values: Floats, greedy: Bytes, moves: Moves) -> Floats:
    """Return how much less than the best action the greedy one is worth, as log(best / greedy), in faint rows.

    Args:
        mdp: The decision process, with `other` 0, so that all values are positive.
        values: Its exact values, shape (rows,), as `exact_values` returns them.
        greedy: The greedy action of every row, shape (rows,).
        moves: The result of that action from every row if it does not slip, arrays of shape (rows,).

    Returns:
        Losses, shape (rows,); 0 or more, infinite for a move off the grid. They are meaningful in rows whose value is
        below `FAINT`.

    Raises:
        BadSettings: With slips the logarithms do not settle, because the grid is too long.
    """
    assert mdp.reward.levels.other == 0, "a negative value has no logarithm"
    if mdp.slip.probability > 0:
        q = _slipping_logs(mdp, values)
        with np.errstate(invalid="ignore"):  # a finished row has no action
            return np.asarray(q.max(axis=0) - q[greedy.astype(np.int64).clip(0), np.arange(len(values))])
    best, entering = _logs(mdp, values)
    step = _as_log(mdp.gamma)
    reached = np.where(mdp.domain.phase_of == 0, entering[moves.state], np.append(best, LOG_NONE)[moves.row] + step)
    # A move off the grid stays, so it is worth at most gamma of what the row is.
    return np.asarray(np.where(moves.off_grid | (reached <= LOG_NONE), np.inf, (best - reached) * LOG_UNIT))


def _as_log(numbers: ArrayLike) -> Ints:
    """Return logarithms of positive numbers as integers, in units of `LOG_UNIT`."""
    return np.asarray(np.rint(np.log(numbers) / LOG_UNIT), np.int64)


def _logs(mdp: Mdp, values: Floats) -> tuple[Ints, Ints]:
    """Return the logarithms of all values, (rows,), and of entering each state in phase 0, (n_states,), without slips.

    In phase 0 a faint value is gamma^(d-1) W, with W the worth of entering a state of the path, which is not faint. In
    the cell state too, where a pass may go on from there along any states.
    """
    domain, grid = mdp.domain, mdp.domain.path.grid
    on_path = np.flatnonzero(domain.may_meet)
    moves, arrival = _moves_to_go(mdp)
    best, step = np.full(domain.n_rows, LOG_NONE), _as_log(mdp.gamma)
    above = domain.phase_of > 0
    best[above] = moves[above] * step + _as_log(arrival[above])
    after = domain.rows_of(domain.joins[on_path], grid.cells_of(on_path))
    entering = np.full(grid.n_states, LOG_NONE)
    entering[on_path] = _as_log(domain.rewards_unjoined(mdp.reward)[on_path] + mdp.gamma * values[after])
    given = np.zeros(grid.n_states, bool)
    given[on_path] = True
    of_phase_0 = best[: grid.n_states]
    spread_worth(of_phase_0.reshape(grid.shape), entering.reshape(grid.shape), given.reshape(grid.shape), int(step))
    return best, entering


def _slipping_logs(mdp: Mdp, values: Floats) -> Floats:
    """Iterate the logarithms of Q values with slips until nothing changes, from values on; returns (27, rows)."""
    pays, after, off_grid = _each_action(mdp)
    nothing = ~mdp.domain.certified | mdp.domain.terminal
    with np.errstate(divide="ignore", invalid="ignore"):  # the logarithm of 0 is -inf, and its change may be NaN
        pays = np.log(np.where(off_grid, 0.0, pays))
        logs = np.log(np.where(values < FAINT, 0.0, values))
        for _ in range(MAX_SWEEPS):
            made = np.logaddexp(pays, np.log(mdp.gamma) + np.append(logs, -np.inf)[after])
            made[off_grid] = -np.inf  # it is worth at most gamma of what the row is
            q = mdp.slip.log_expected(made, np.where(off_grid, made[STAY], made))
            q[:, nothing] = -np.inf
            before, logs = logs, q.max(axis=0)
            if ((logs == before) | (np.abs(logs - before) <= LOG_SETTLED + SETTLED * np.abs(logs))).all():
                return np.asarray(q)
    raise BadSettings(f"The exact values do not settle in {MAX_SWEEPS} sweeps: the grid is too long; use larger cells.")


def _pays(mdp: Mdp, moves: Moves) -> Floats:
    """Return the reward of a move from every row, (rows,)."""
    levels = mdp.reward.levels
    in_phase_0 = mdp.domain.phase_of == 0
    reward = np.where(in_phase_0, mdp.domain.rewards_unjoined(mdp.reward)[moves.state], levels.other)
    reward[moves.advances] = levels.visited
    reward[moves.finishes & ~in_phase_0] = levels.goal
    reward[moves.off_grid] = levels.off_grid
    return np.asarray(reward)


@dataclass(frozen=True)
class ValueIteration(PhaseState):
    """Settings of value iteration in the phase state. The result does not depend on a seed.

    The paper does not state its gamma. Ours is that of `PhaseQLearning`: the nearest waypoint always has the highest
    value.
    """

    kind: ClassVar[str] = "value-iteration"

    gamma: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.gamma < 1:
            raise BadSettings(
                "gamma must lie in (0, 1): with 1 a later arrival is worth as much as an earlier one.", gamma=self.gamma
            )


def iterate_values(reward: RewardMap, settings: ValueIteration, hazards: Hazards | None = None) -> Floats:
    """Compute the Q values of a reward map's domain by value iteration.

    Args:
        reward: The reward map.
        settings: The settings.
        hazards: A scene on the path's grid.

    Returns:
        Q values, shape (rows, 27).

    Raises:
        BadSettings: Value iteration does not settle.
    """
    domain = Domain(reward.path, settings.phased, settings.join_share)
    return exact_q(Mdp(domain, reward, settings.gamma, settings.slip_model, hazards))


# ---- compiled loops -------------------------------------------------------------------------------------------------


@compiled
def settle(
    best: Any,
    worth: Any,
    rewards: Any,
    stays: Any,
    shape: Any,
    goal: int,
    off_grid: float,
    gamma: float,
    tolerance: float,
    max_sweeps: int,
) -> Any:
    """Iterate values over the grid, forwards and backwards in turn, until no relative change is above the tolerance.

    Args:
        best: The value of the best move in each state, shape (n_states,), float64, iterated in place.
        worth: Reward and discounted value of entering each state, shape (n_states,), float64, updated.
        rewards: The reward for entering each state, shape (n_states,), float64.
        stays: Whether entering a state neither changes the phase nor finishes, shape (n_states,), bool.
        shape: Number of cells along each axis, shape (3,), int64.
        goal: The state that finishes, whose value is not iterated; -1 if there is none.
        off_grid: The reward of a move off the grid.
        gamma: Discount.
        tolerance: Relative change up to which a value counts as unchanged.
        max_sweeps: Most sweeps; forwards and backwards count as two.

    Returns:
        True if the values settled within `max_sweeps`.
    """
    nx, ny, nz = shape[0], shape[1], shape[2]
    for number in range(max_sweeps):
        changed = 0
        for i in range(len(best)):
            state = i if number % 2 == 0 else len(best) - 1 - i
            if state == goal:
                continue
            x = state // (ny * nz)
            y = state // nz % ny
            z = state % nz
            top = -np.inf
            if x == 0 or y == 0 or z == 0 or x == nx - 1 or y == ny - 1 or z == nz - 1:
                top = off_grid + gamma * best[state]
            for to_x in range(max(x - 1, 0), min(x + 2, nx)):
                for to_y in range(max(y - 1, 0), min(y + 2, ny)):
                    for to_z in range(max(z - 1, 0), min(z + 2, nz)):
                        there = worth[(to_x * ny + to_y) * nz + to_z]
                        if there > top:
                            top = there
            if not abs(top - best[state]) <= tolerance * abs(top):
                changed += 1
            best[state] = top
            if stays[state]:
                worth[state] = rewards[state] + gamma * top
        if changed == 0:
            return True
    return False


@compiled
def spread_worth(best: Any, worth: Any, given: Any, step: int) -> None:
    """Spread the worth of given cells over a grid, forwards and backwards in turn, until nothing changes.

    Each move adds `step`, which is negative, so that every cell ends with the best way to a given cell; a way ends at
    the first given cell that it enters. Integers, so that equally good ways are equal.

    Args:
        best: The worth of the best move in each cell, at first less than any, shape (nx, ny, nz), int64; changed in
            place.
        worth: That of entering each cell, at first less than any but at the given cells, shape (nx, ny, nz), int64;
            changed in place.
        given: Cells whose worth is given and does not change, shape (nx, ny, nz), bool.
        step: Change of the worth with each move, below 0.
    """
    nx, ny, nz = best.shape
    changed = True
    while changed:
        changed = False
        for way in range(2):
            for i in range(nx):
                x = i if way == 0 else nx - 1 - i
                for j in range(ny):
                    y = j if way == 0 else ny - 1 - j
                    for k in range(nz):
                        z = k if way == 0 else nz - 1 - k
                        top = best[x, y, z]
                        for to_x in range(max(x - 1, 0), min(x + 2, nx)):
                            for to_y in range(max(y - 1, 0), min(y + 2, ny)):
                                for to_z in range(max(z - 1, 0), min(z + 2, nz)):
                                    top = max(top, worth[to_x, to_y, to_z])
                        if top > best[x, y, z]:
                            best[x, y, z] = top
                            changed = True
                            if not given[x, y, z]:
                                worth[x, y, z] = top + step
