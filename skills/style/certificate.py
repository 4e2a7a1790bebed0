"""What is known for certain about a policy on its grid: exact values, optimal actions, and the starts that succeed.

The exact values come from dynamic programming (`skills.style.exact`), not from learning. It says nothing about the
accuracy of the arm.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skills.style._arrays import frozen
from skills.style.domain import FINISHED
from skills.style.exact import Mdp, action_values, exact_values
from skills.style.policy import Policy, rollout_from
from skills.style.reward import sparse_reward

TIE = 1e-9  # relative; two actions closer than this are equally good (a Q value carries about 1e-15 of rounding)


@dataclass(frozen=True, eq=False)
class Coverage:
    """For every state as a start, (n_states,): does the policy reach the goal, and does it join the demonstration in
    the fewest moves (Chebyshev) and then follow it?
    """

    reaches: NDArray[np.bool_]
    joins_nearest: NDArray[np.bool_]

    def __post_init__(self) -> None:
        for name in ("reaches", "joins_nearest"):
            object.__setattr__(self, name, frozen(getattr(self, name), np.bool_, (None,), name))


@dataclass(frozen=True)
class Certificate:
    """What was checked: every greedy action of the certified domain against exact values, and every start.

    `checked` states (phase and cell) of which `suboptimal` have a greedy action worse than the best one.
    """

    checked: int
    suboptimal: int
    starts: int
    starts_reaching: int
    starts_joining_nearest: int
    demonstration_reproduced: bool

    @property
    def every_action_optimal(self) -> bool:
        """Whether no greedy action is worse than the best one."""
        return self.checked > 0 and self.suboptimal == 0


def certify(policy: Policy) -> tuple[Certificate, Coverage]:
    """Check a policy against exact dynamic programming, and follow it from every start."""
    domain = policy.domain
    live = np.flatnonzero(domain.certified & ~domain.terminal)
    mdp = mdp_of(policy)
    values = exact_values(mdp)
    greedy = policy.greedy[live].astype(np.int64)
    achieved = action_values(mdp, values, live, greedy)
    best = values[live]
    optimal = achieved >= best - TIE * np.abs(best)  # written so that NaN fails
    covered = coverage(policy)
    certificate = Certificate(
        checked=len(live),
        suboptimal=int(np.count_nonzero(~optimal)),
        starts=len(covered.reaches),
        starts_reaching=int(covered.reaches.sum()),
        starts_joining_nearest=int(covered.joins_nearest.sum()),
        demonstration_reproduced=np.array_equal(rollout_from(policy, policy.path.start).states, policy.path.states),
    )
    return certificate, covered


def mdp_of(policy: Policy) -> Mdp:
    """State what a policy is checked against: Algorithm 1's rewards, whatever rewards it was learnt from."""
    return Mdp(policy.domain, sparse_reward(policy.path, policy.levels), policy.learner.gamma)


def coverage(policy: Policy) -> Coverage:
    """Follow the policy from every state at once."""
    return Coverage(_reaches(policy), _joins_nearest(policy))


def _reaches(policy: Policy) -> NDArray[np.bool_]:
    """Tell for every state whether the walk from it ends at the goal, by doubling the length of all walks at once."""
    domain, grid = policy.domain, policy.path.grid
    everywhere = np.arange(domain.n_rows)
    moves = policy.moves
    done = (policy.greedy == FINISHED) | (moves.finishes & (policy.greedy >= 0))
    walk = np.where(done | (policy.greedy < 0) | (moves.row < 0), everywhere, moves.row)
    for _ in range(domain.n_rows.bit_length()):
        walk = walk[walk]
    rows = domain.rows_of(np.zeros(grid.n_states, np.int64), grid.cells_of(np.arange(grid.n_states)))
    at_end = np.zeros(grid.n_states, bool)
    for state in np.unique(policy.path.states):
        phase, at_end[state] = domain.start(int(state))
        rows[state] = domain.rows_of(phase, grid.cells_of(state)) if not at_end[state] else rows[state]
    return np.asarray(at_end | done[walk[rows]])


def _joins_nearest(policy: Policy) -> NDArray[np.bool_]:
    """Tell for every state whether the walk from it meets the path in the fewest moves and then follows it."""
    path = policy.path
    states = np.arange(path.grid.n_states)
    stepped = policy.moves.state[: len(states)]
    on_path = np.isin(states, path.states)
    cells, fewest = path.grid.cells_of(states), np.full(len(states), np.iinfo(np.int64).max)
    for waypoint in path.cells:  # one at a time: all at once would be states x waypoints
        np.minimum(fewest, np.abs(cells - waypoint).max(axis=1), out=fewest)
    at, moved = states.copy(), np.zeros(len(states), np.int64)
    for _ in range(int(fewest.max())):
        walking = ~on_path[at]
        moved += walking
        at = np.where(walking, stepped[at], at)
    follows = _follows(policy)[at] | ((at == path.goal) & (moved > 0))
    return np.asarray(on_path[at] & (moved == fewest) & follows)


def _follows(policy: Policy) -> NDArray[np.bool_]:
    """Tell for every state of the path whether the policy follows the rest of it from the first visit on."""
    domain, path = policy.domain, policy.path
    index = np.arange(len(path.states) - 1)
    rows = domain.rows_of(index + 1 if domain.phased else np.zeros_like(index), path.cells[:-1])
    right = (policy.greedy[rows] >= 0) & (policy.moves.state[rows] == path.states[1:])
    rest = np.append(np.logical_and.accumulate(right[::-1])[::-1], True)
    follows = np.zeros(path.grid.n_states, bool)
    follows[path.states[::-1]] = rest[::-1]  # backwards, so that the first visit stands
    return follows
