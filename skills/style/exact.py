"""Exact values by dynamic programming: what every place of a domain is worth, and every action in it. No learning.

Above phase 0 the values follow from one distance: with d the Chebyshev distance to the next waypoint (at least 1:
staying in its cell enters it), V = gamma^(d-1) A_p, where A_p = 1 + gamma V_(p+1) at that waypoint, and A of the last
phase is the goal's reward. In phase 0, and in the paper's cell state, they are the fixed point of value iteration over
the grid.
"""

from dataclasses import dataclass

import numpy as np

from skills.errors import BadSettings
from skills.style._arrays import Floats, Ints
from skills.style.domain import Domain
from skills.style.grid import MOVES
from skills.style.reward import RewardMap

MAX_SWEEPS = 100_000


@dataclass(frozen=True, eq=False)
class Mdp:
    """The Markov decision process of a path: where one can be, what moving pays there, and the discount."""

    domain: Domain
    reward: RewardMap
    gamma: float


def exact_values(mdp: Mdp) -> Floats:
    """Work the exact value of every row out, (rows,); 0 where there is nothing more to gain.

    Raises:
        BadSettings: Value iteration has no fixed point, since the rewards pay for going round in circles.
    """
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
    """Iterate values over the whole grid until nothing changes, (n_states,).

    The 27 moves reach a cell's 3 x 3 x 3 neighbours, so the best of them is a maximum filter, one axis at a time.
    """
    domain, grid, gamma = mdp.domain, mdp.domain.path.grid, mdp.gamma
    goal, joining = domain.path.goal, np.flatnonzero(domain.joins)
    entering = mdp.reward.rewards.copy()  # what entering a state is worth, where that is settled already
    entering[joining] += gamma * values[domain.rows_of(domain.joins[joining], grid.cells_of(joining))]
    open_states = np.setdiff1d(np.arange(grid.n_states), [*joining, goal])
    cells = grid.cells_of(np.arange(grid.n_states))
    at_edge = ((cells == 0) | (cells == np.array(grid.shape) - 1)).any(axis=1)
    best = np.zeros(grid.n_states)
    for _ in range(MAX_SWEEPS):
        entering[open_states] = mdp.reward.rewards[open_states] + gamma * best[open_states]
        better = _best_neighbour(entering.reshape(grid.shape)).ravel()
        better[at_edge] = np.maximum(better[at_edge], mdp.reward.levels.off_grid + gamma * best[at_edge])
        better[goal] = 0.0
        change, best = np.abs(better - best), better
        if (change <= 1e-14 * np.abs(best)).all():
            return best
    raise BadSettings("Exact values do not settle: the rewards pay for going round in circles; take a smaller gamma.")


def _best_neighbour(worth: Floats) -> Floats:
    """Find the largest value among each cell and those that touch it, (nx, ny, nz)."""
    for axis in range(3):
        before, after = worth.copy(), worth.copy()
        np.moveaxis(before, axis, 0)[1:] = np.moveaxis(worth, axis, 0)[:-1]
        np.moveaxis(after, axis, 0)[:-1] = np.moveaxis(worth, axis, 0)[1:]
        worth = np.maximum(worth, np.maximum(before, after))
    return worth


def action_values(mdp: Mdp, values: Floats, rows: Ints, actions: Ints) -> Floats:
    """Work out what taking an action in each row is worth, (N,), if all goes on with the given values, (rows,)."""
    reward, after = _outcome(mdp, rows, actions)
    return np.asarray(reward + mdp.gamma * np.append(values, 0.0)[after])


def exact_q(mdp: Mdp) -> Floats:
    """Work every exact Q value out, (rows, 27); 0 where one is finished and outside the certified domain."""
    domain, values = mdp.domain, exact_values(mdp)
    live = np.flatnonzero(domain.certified & ~domain.terminal)
    q = np.zeros((domain.n_rows, len(MOVES)))
    for action in range(len(MOVES)):
        q[live, action] = action_values(mdp, values, live, np.full(len(live), action))
    return q


def _outcome(mdp: Mdp, rows: Ints, actions: Ints) -> tuple[Floats, Ints]:
    """Take an action in each row: what it pays, and the row after it (-1 beyond the end), both (N,)."""
    levels, moves = mdp.reward.levels, mdp.domain.move(rows, actions)
    in_phase_0 = mdp.domain.phase_of[rows] == 0
    reward = np.where(in_phase_0, mdp.reward.rewards[moves.state], levels.other)
    reward[moves.advances] = levels.visited
    reward[moves.finishes & ~in_phase_0] = levels.goal
    reward[moves.off_grid] = levels.off_grid
    return reward, moves.row
