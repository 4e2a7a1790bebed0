"""What is known for certain about a policy on its grid: exact values, optimal actions, and the starts that succeed.

The exact values come from dynamic programming (`skills.style.exact`), not from learning. It says nothing about the
accuracy of the arm.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skills.style._arrays import Floats, frozen
from skills.style.domain import FINISHED
from skills.style.exact import Mdp, action_values, exact_q, exact_values
from skills.style.learning import _kernels
from skills.style.policy import Policy
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

    `checked` states (phase and cell) of which `suboptimal` have a greedy action worse than the best one; from
    `finishing` of them the policy rejoins the demonstration and finishes. Where the policy was learnt with slips, the
    exact values are those of the world that slips; all walks are without slips.
    """

    checked: int
    suboptimal: int
    finishing: int
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
    live = policy.domain.certified & ~policy.domain.terminal
    achieved, best = _achieved(policy)
    optimal = achieved >= best - TIE * np.abs(best)  # written so that NaN fails
    finishing = finishes(policy)
    covered = _coverage(policy, finishing)
    certificate = Certificate(
        checked=int(live.sum()),
        suboptimal=int(np.count_nonzero(live & ~optimal)),
        finishing=int(np.count_nonzero(live & finishing)),
        starts=len(covered.reaches),
        starts_reaching=int(covered.reaches.sum()),
        starts_joining_nearest=int(covered.joins_nearest.sum()),
        demonstration_reproduced=np.array_equal(policy.replay.states, policy.path.states),
    )
    return certificate, covered


def mdp_of(policy: Policy) -> Mdp:
    """State what a policy is checked against: Algorithm 1's rewards, whatever rewards it was learnt from."""
    learner = policy.learner
    return Mdp(policy.domain, sparse_reward(policy.path, policy.levels), learner.gamma, learner.slip)


def _achieved(policy: Policy) -> tuple[Floats, Floats]:
    """Work out what each row's greedy action is worth if all is done well after it, and the best one, both (rows,)."""
    mdp = mdp_of(policy)
    if mdp.slip > 0:
        q = exact_q(mdp)
        return q[np.arange(len(q)), policy.greedy.astype(np.int64).clip(0)], q.max(axis=1)
    best = exact_values(mdp)
    return action_values(mdp, best, policy.moves), best


def finishes(policy: Policy) -> NDArray[np.bool_]:
    """Tell for every row whether the walk from it finishes, (rows,), by doubling the length of all walks at once."""
    moves = policy.moves
    done = (policy.greedy == FINISHED) | (moves.finishes & (policy.greedy >= 0))
    walk = np.arange(policy.domain.n_rows)
    walk = np.where(done | (policy.greedy < 0) | (moves.row < 0), walk, moves.row)
    for _ in range(policy.domain.n_rows.bit_length()):
        walk = walk[walk]
    return np.asarray(done[walk])


def coverage(policy: Policy) -> Coverage:
    """Follow the policy from every state at once."""
    return _coverage(policy, finishes(policy))


def _coverage(policy: Policy, finishing: NDArray[np.bool_]) -> Coverage:
    domain, path = policy.domain, policy.path
    reaches = finishing[: path.grid.n_states].copy()  # phase 0
    visited, first = np.unique(path.states, return_index=True)  # who starts on the path has counted the first visit
    last = len(path.states) - 1
    phases = np.minimum(first + 1, last) if domain.phased else np.zeros_like(first)
    over = first == last if domain.phased else visited == path.goal
    reaches[visited] = over | finishing[domain.rows_of(phases, path.grid.cells_of(visited))]
    return Coverage(reaches, _joins_nearest(policy))


def _joins_nearest(policy: Policy) -> NDArray[np.bool_]:
    """Tell for every state whether the walk from it meets the path in the fewest moves and then follows it."""
    path = policy.path
    states = np.arange(path.grid.n_states)
    stepped = policy.moves.state[: len(states)]
    on_path = np.isin(states, path.states)
    fewest = np.where(on_path, 0, len(states))
    _kernels.spread_distances_compiled(fewest.reshape(path.grid.shape))
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
