"""Exact values by dynamic programming: what every place of a domain is worth, and every action in it. No learning.

Where no move slips, the values above phase 0 follow from one distance: with d the Chebyshev distance to the next
waypoint (at least 1: staying in its cell enters it), V = gamma^(d-1) A_p, where A_p = 1 + gamma V_(p+1) at that
waypoint, and A of the last phase is the goal's reward. In phase 0, and in the paper's cell state, they are the fixed
point of value iteration over the grid.

A move *slips* with a probability of its own: instead of it, one of the 27 is made, each as likely; off the grid it
stays. Then all values are the fixed point of value iteration over the whole domain.
"""

from dataclasses import dataclass

import numpy as np

from skills.errors import BadSettings
from skills.style._arrays import Floats, Ints
from skills.style.domain import Domain, Moves
from skills.style.grid import MOVES
from skills.style.learning import _kernels
from skills.style.reward import RewardMap

MAX_SWEEPS = 100_000
STAY = 13  # the middle one of the moves
ENDLESS = "Exact values do not settle: the rewards pay for going round in circles; take a smaller gamma."
SETTLED = 1e-14  # relative: a value that changes by less has settled


@dataclass(frozen=True, eq=False)
class Mdp:
    """The Markov decision process of a path: where one can be, what moving pays there, the discount, and how likely a
    move slips.
    """

    domain: Domain
    reward: RewardMap
    gamma: float
    slip: float = 0.0


def exact_values(mdp: Mdp) -> Floats:
    """Work the exact value of every row out, (rows,); 0 where there is nothing more to gain.

    Raises:
        BadSettings: Value iteration has no fixed point, since the rewards pay for going round in circles.
    """
    if mdp.slip > 0:
        return np.asarray(exact_q(mdp).max(axis=1))
    domain, levels, gamma = mdp.domain, mdp.reward.levels, mdp.gamma
    assert not domain.phased or levels.other == 0, "else a longer way would pay more, and the formula above is wrong"
    waypoints = domain.path.cells
    values = np.zeros(domain.n_rows)
    arrival = levels.goal  # A_p, from the last phase down
    for phase in range(domain.phases - 1, 0, -1):
        rows = slice(domain.offset[phase], domain.offset[phase + 1])
        distance = np.abs(domain.cell_of[rows] - waypoints[phase]).max(axis=1).clip(1)
        values[rows] = gamma ** (distance - 1.0) * arrival
        behind = max(1, int(np.abs(waypoints[phase - 1] - waypoints[phase]).max()))
        arrival = levels.visited + gamma * gamma ** (behind - 1.0) * arrival
    values[domain.terminal] = 0.0
    values[: domain.offset[1]] = _phase_0_values(mdp, values)
    return values


def _phase_0_values(mdp: Mdp, values: Floats) -> Floats:
    """Iterate values over the whole grid until nothing changes, (n_states,)."""
    domain, reward = mdp.domain, mdp.reward
    grid, joining = domain.path.grid, np.flatnonzero(domain.joins)
    worth = reward.rewards.copy()  # of entering a state
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
    """Work every exact Q value out, (rows, 27); 0 where one is finished and outside the certified domain.

    Raises:
        BadSettings: See `exact_values`.
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
    """Iterate values over the whole domain where moves slip, until nothing changes, (rows, 27)."""
    domain = mdp.domain
    moves = [domain.move(*_everywhere(domain, action)) for action in range(len(MOVES))]
    pays = np.stack([_pays(mdp, moved) for moved in moves])
    after = np.stack([moved.row for moved in moves])
    off_grid = np.stack([moved.off_grid for moved in moves])
    nothing = ~domain.certified | domain.terminal
    values = np.zeros(domain.n_rows)
    for _ in range(MAX_SWEEPS):
        made = pays + mdp.gamma * np.append(values, 0.0)[after]
        anywhere = np.where(off_grid, made[STAY], made).mean(axis=0)
        q = (1 - mdp.slip) * made + mdp.slip * anywhere
        q[:, nothing] = 0.0
        change, values = np.abs(q.max(axis=0) - values), q.max(axis=0)
        if (change <= SETTLED * np.abs(values)).all():
            return np.ascontiguousarray(q.T)
    raise BadSettings(ENDLESS)


def _everywhere(domain: Domain, action: int) -> tuple[Ints, Ints]:
    """Name an action in every row, both (rows,)."""
    return np.arange(domain.n_rows), np.full(domain.n_rows, action)


def action_values(mdp: Mdp, values: Floats, moves: Moves) -> Floats:
    """Work out what a move from every row is worth where it does not slip, (rows,), given the values, (rows,)."""
    return np.asarray(_pays(mdp, moves) + mdp.gamma * np.append(values, 0.0)[moves.row])


def _pays(mdp: Mdp, moves: Moves) -> Floats:
    """Say what a move from every row pays, (rows,)."""
    levels = mdp.reward.levels
    in_phase_0 = mdp.domain.phase_of == 0
    reward = np.where(in_phase_0, mdp.reward.rewards[moves.state], levels.other)
    reward[moves.advances] = levels.visited
    reward[moves.finishes & ~in_phase_0] = levels.goal
    reward[moves.off_grid] = levels.off_grid
    return np.asarray(reward)
