"""Exact values by dynamic programming, and value iteration as a learner.

The exact value of every row of a domain, and of every action in it, follows from the rewards without learning.

If no move slips, the values above phase 0 follow from one distance: with d the Chebyshev distance to the next
waypoint (at least 1: staying in its cell enters it), V = gamma^(d-1) A_p, where A_p = 1 + gamma V_(p+1) at that
waypoint, and A of the last phase is the goal's reward. In phase 0, and in the paper's cell state, the values are the
fixed point of value iteration over the grid.

A move *slips* with a given probability: then one of the 27 moves is made instead of it, each with equal probability;
off the grid the arm stays. In that case all values are the fixed point of value iteration over the whole domain.

As a learner in the phase state, `ValueIteration` gives the exact Q values of Algorithm 1's rewards without a move of
the arm. The paper tried value iteration first, in its *cell* state, and gave it up (Sec. III-C;
`skills.learning.max_ent_irl` explains one reason for the failure there, a path that crosses itself is another). In the
phase state it finds the same policy as Q-learning, without exploration: it knows the result of each move, which
Q-learning has to find out.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from skills.arrays import Floats, Ints
from skills.errors import BadSettings
from skills.gridworld.domain import Domain, Moves
from skills.gridworld.grid import MOVES
from skills.gridworld.reward import RewardMap
from skills.learning import _kernels

MAX_SWEEPS = 100_000
STAY = 13  # the action that stays: (0, 0, 0), the middle one of the moves
ENDLESS = "The exact values do not converge: a cycle has a positive reward; use a smaller gamma."
SETTLED = 1e-14  # relative: a value that changes by less has settled


@dataclass(frozen=True, eq=False)
class Mdp:
    """The Markov decision process of a path.

    Attributes:
        domain: The states: phases and cells.
        reward: The rewards.
        gamma: The discount.
        slip: The probability that a move slips.
    """

    domain: Domain
    reward: RewardMap
    gamma: float
    slip: float = 0.0


def exact_values(mdp: Mdp) -> Floats:
    """Return the exact value of every row; 0 at finished rows.

    Args:
        mdp: The decision process.

    Returns:
        Values, shape (rows,).

    Raises:
        BadSettings: Value iteration does not settle, because the rewards pay for going round in circles.
    """
    if mdp.slip > 0:
        return np.asarray(exact_q(mdp).max(axis=1))
    domain, levels, gamma = mdp.domain, mdp.reward.levels, mdp.gamma
    assert not domain.phased or levels.other == 0, "otherwise a longer path earns more, and the formula is wrong"
    waypoints = domain.path.cells
    values = np.zeros(domain.n_rows)
    arrival = levels.goal  # A_p, from the last phase down
    for phase in range(domain.phases - 1, 0, -1):
        rows = slice(domain.offset[phase], domain.offset[phase + 1])
        distance = np.abs(domain.cell_of[rows] - waypoints[phase]).max(axis=1).clip(1)
        values[rows] = gamma ** (distance - 1.0) * arrival
        behind = max(1, int(np.abs(waypoints[phase - 1] - waypoints[phase]).max()))
        arrival = levels.visited + gamma * gamma ** (behind - 1.0) * arrival
    values[domain.terminal] = 0.0  # before phase 0, which joins other phases and reads their values
    values[: domain.offset[1]] = _phase_0_values(mdp, values)
    return values


def _phase_0_values(mdp: Mdp, values: Floats) -> Floats:
    """Iterate values over the whole grid until nothing changes; returns shape (n_states,)."""
    domain, reward = mdp.domain, mdp.reward
    grid, joining = domain.path.grid, np.flatnonzero(domain.joins)
    worth = reward.rewards.copy()  # reward and discounted value of entering each state
    worth[joining] += mdp.gamma * values[domain.rows_of(domain.joins[joining], grid.cells_of(joining))]
    stays = domain.joins == 0
    stays[domain.path.goal] = False
    best, shape = np.zeros(grid.n_states), np.array(grid.shape)
    settled = _kernels.settle_compiled(
        best,
        worth,
        reward.rewards,
        stays,
        shape,
        domain.path.goal,
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
    if mdp.slip > 0:
        return _slipping_q(mdp)
    domain, values = mdp.domain, exact_values(mdp)
    q = np.zeros((domain.n_rows, len(MOVES)))
    for action in range(len(MOVES)):
        q[:, action] = action_values(mdp, values, domain.move(*_everywhere(domain, action)))
    q[~domain.certified | domain.terminal] = 0.0
    return q


def _slipping_q(mdp: Mdp) -> Floats:
    """Iterate values over the whole domain with slips until nothing changes; returns Q values, (rows, 27)."""
    domain = mdp.domain
    moves = [domain.move(*_everywhere(domain, action)) for action in range(len(MOVES))]
    pays = np.stack([_pays(mdp, moved) for moved in moves])
    after = np.stack([moved.row for moved in moves])
    off_grid = np.stack([moved.off_grid for moved in moves])
    nothing = ~domain.certified | domain.terminal
    values = np.zeros(domain.n_rows)
    for _ in range(MAX_SWEEPS):
        made = pays + mdp.gamma * np.append(values, 0.0)[after]
        # A slip off the grid stays at no cost: only an intended move off the grid is a fault of the policy.
        anywhere = np.where(off_grid, made[STAY], made).mean(axis=0)
        q = (1 - mdp.slip) * made + mdp.slip * anywhere
        q[:, nothing] = 0.0
        change, values = np.abs(q.max(axis=0) - values), q.max(axis=0)
        if (change <= SETTLED * np.abs(values)).all():
            return np.ascontiguousarray(q.T)
    raise BadSettings(ENDLESS)


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


def _pays(mdp: Mdp, moves: Moves) -> Floats:
    """Return the reward of a move from every row, (rows,)."""
    levels = mdp.reward.levels
    in_phase_0 = mdp.domain.phase_of == 0
    reward = np.where(in_phase_0, mdp.reward.rewards[moves.state], levels.other)
    reward[moves.advances] = levels.visited
    reward[moves.finishes & ~in_phase_0] = levels.goal
    reward[moves.off_grid] = levels.off_grid
    return np.asarray(reward)


@dataclass(frozen=True)
class ValueIteration:
    """Settings of value iteration in the phase state. The result does not depend on a seed.

    The paper does not state its gamma. Ours is that of `PhaseQLearning`: the nearest waypoint always has the highest
    value.
    """

    kind: ClassVar[str] = "value-iteration"
    phased: ClassVar[bool] = True

    gamma: float = 0.1
    slip: float = 0.0  # probability that one of the 27 moves, drawn uniformly, replaces the intended one

    def __post_init__(self) -> None:
        if not 0 <= self.slip < 1:
            raise BadSettings("slip must lie in [0, 1).", slip=self.slip)
        if not 0 < self.gamma < 1:
            raise BadSettings(
                "gamma must lie in (0, 1): with 1 a later arrival is worth as much as an earlier one.", gamma=self.gamma
            )


def iterate_values(reward: RewardMap, settings: ValueIteration) -> Floats:
    """Compute the Q values of a reward map's domain by value iteration.

    Args:
        reward: The reward map.
        settings: The settings.

    Returns:
        Q values, shape (rows, 27).

    Raises:
        BadSettings: Value iteration does not settle.
    """
    return exact_q(Mdp(Domain(reward.path, settings.phased), reward, settings.gamma, settings.slip))
