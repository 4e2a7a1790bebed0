"""Certificate of a policy on its grid: exact values, optimal actions, and the starts from which it succeeds.

    Policy --certify--> Certificate, Coverage

The exact values come from dynamic programming (`skills.learning.dynamic_programming`), not from learning. The
certificate makes no statement about the accuracy of the arm.

Two actions are equally good if their exact values differ by less than `TIE`, relatively. Values below `FAINT`, far from
the path, are compared by their logarithms, so the comparison does not depend on the size of the grid.
"""

from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray

from skills.arrays import Floats, frozen
from skills.gridworld.domain import FINISHED
from skills.gridworld.reward import sparse_reward
from skills.learning import _kernels
from skills.learning.dynamic_programming import FAINT, Mdp, action_values, exact_q, exact_values, log_losses
from skills.learning.policy import Policy

TIE = 1e-9  # relative; two actions closer than this are equally good (a Q value carries about 1e-15 of rounding)


@dataclass(frozen=True, eq=False)
class Coverage:
    """The success of a policy from every state as a start, arrays of shape (n_states,).

    Attributes:
        reaches: The policy reaches the goal.
        joins_nearest: The policy joins the demonstration in the fewest moves (Chebyshev) and then follows it.
    """

    reaches: NDArray[np.bool_]
    joins_nearest: NDArray[np.bool_]

    def __post_init__(self) -> None:
        for name in ("reaches", "joins_nearest"):
            object.__setattr__(self, name, frozen(getattr(self, name), np.bool_, (None,), name))


@dataclass(frozen=True)
class Certificate:
    """The result of checking every greedy action of the certified domain against exact values, and every start.

    If the policy was learnt with slips, the exact values are those of the world that slips; all walks are without
    slips.

    Attributes:
        checked: Number of states (phase and cell) that were checked.
        suboptimal: Number of them whose greedy action is worse than the best one.
        finishing: Number of them from which the policy rejoins the demonstration and finishes.
        starts: Number of states as starts of a pass.
        starts_reaching: Number of starts from which the policy reaches the goal.
        starts_joining_nearest: Number of starts from which it joins the demonstration in the fewest moves and follows
            it.
        demonstration_reproduced: The rollout from the demonstrated start visits the demonstration's states, in order.
        faint: Number of checked states whose exact value is below `FAINT`, so that logarithms were compared.
    """

    checked: int
    suboptimal: int
    finishing: int
    starts: int
    starts_reaching: int
    starts_joining_nearest: int
    demonstration_reproduced: bool
    faint: int = 0

    @property
    def every_action_optimal(self) -> bool:
        """True if at least one state was checked and no greedy action is worse than the best one."""
        return self.checked > 0 and self.suboptimal == 0


def certify(policy: Policy) -> tuple[Certificate, Coverage]:
    """Check a policy against exact dynamic programming, and follow it from every start.

    Args:
        policy: The policy.

    Returns:
        The certificate, and the coverage of all starts.

    Raises:
        BadSettings: Exact values do not settle (`exact_values`).
    """
    live = policy.domain.certified & ~policy.domain.terminal
    achieved, best = _achieved(policy)
    optimal = achieved >= best - TIE * np.abs(best)  # written so that NaN fails
    # Only where `other` is 0 do the values of distant states approach 0.
    faint = live & (best < FAINT) & (policy.levels.other == 0)
    if faint.any():
        optimal[faint] = log_losses(mdp_of(policy), best, policy.greedy, policy.moves)[faint] <= TIE
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
        faint=int(np.count_nonzero(faint)),
    )
    return certificate, covered


def mdp_of(policy: Policy) -> Mdp:
    """Return the decision process that a policy is checked against.

    Its rewards are those of Algorithm 1, even if the policy was learnt from others.

    Args:
        policy: The policy.

    Returns:
        The process, with the discount and the slip of the policy's learner.
    """
    learner = policy.learner
    return Mdp(policy.domain, sparse_reward(policy.path, policy.levels), learner.gamma, learner.slip)


def _achieved(policy: Policy) -> tuple[Floats, Floats]:
    """Return the value of each row's greedy action with optimal moves after it, and that of the best, both (rows,)."""
    mdp = mdp_of(policy)
    if mdp.slip > 0:
        q = exact_q(mdp)
        return q[np.arange(len(q)), policy.greedy.astype(np.int64).clip(0)], q.max(axis=1)
    best = exact_values(mdp)
    return action_values(mdp, best, policy.moves), best


def finishes(policy: Policy) -> NDArray[np.bool_]:
    """Return for every row whether the walk from it finishes.

    The walks of all rows are computed at once, by doubling their length.

    Args:
        policy: The policy.

    Returns:
        Flags of shape (rows,).
    """
    moves = policy.moves
    done = (policy.greedy == FINISHED) | (moves.finishes & (policy.greedy >= 0))
    walk = np.arange(policy.domain.n_rows)
    walk = np.where(done | (policy.greedy < 0) | (moves.row < 0), walk, moves.row)
    # A walk without a loop has fewer moves than there are rows, and each pass doubles the length.
    for _ in range(policy.domain.n_rows.bit_length()):
        walk = walk[walk]
    return np.asarray(done[walk])


def least_gamma(policy: Policy) -> float | None:
    """Return a gamma, in steps of 0.01, with which no value in the policy's grid is faint (below `FAINT`).

    Args:
        policy: The policy.

    Returns:
        The gamma; None if the bound that slips leave says nothing about any below 1.
    """
    path, slip = policy.path, policy.learner.slip
    moves = np.full(path.grid.n_states, path.grid.n_states)
    moves[path.states] = 0
    _kernels.spread_distances_compiled(moves.reshape(path.grid.shape))
    # A move multiplies a value by gamma (1 - slip) or more, and the worth of the path is at least `visited`.
    least = (FAINT / policy.levels.visited) ** (1 / max(1, int(moves.max()))) / (1 - slip)
    gamma = ceil(100 * least) / 100
    return gamma if gamma < 1 else None


def coverage(policy: Policy) -> Coverage:
    """Follow a policy from every state at once.

    Args:
        policy: The policy.

    Returns:
        The success from every start.
    """
    return _coverage(policy, finishes(policy))


def _coverage(policy: Policy, finishing: NDArray[np.bool_]) -> Coverage:
    domain, path = policy.domain, policy.path
    reaches = finishing[: path.grid.n_states].copy()  # phase 0
    # A start on the path counts as its first visit of that state, so its phase is the next one.
    visited, first = np.unique(path.states, return_index=True)
    last = len(path.states) - 1
    phases = np.minimum(first + 1, last) if domain.phased else np.zeros_like(first)
    over = first == last if domain.phased else visited == path.goal
    reaches[visited] = over | finishing[domain.rows_of(phases, path.grid.cells_of(visited))]
    return Coverage(reaches, _joins_nearest(policy))


def _joins_nearest(policy: Policy) -> NDArray[np.bool_]:
    """Return for every state whether the walk from it meets the path in the fewest moves and then follows it."""
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
    """Return for every state of the path whether the policy follows the rest of it from the first visit on."""
    domain, path = policy.domain, policy.path
    index = np.arange(len(path.states) - 1)
    rows = domain.rows_of(index + 1 if domain.phased else np.zeros_like(index), path.cells[:-1])
    right = (policy.greedy[rows] >= 0) & (policy.moves.state[rows] == path.states[1:])
    rest = np.append(np.logical_and.accumulate(right[::-1])[::-1], True)
    follows = np.zeros(path.grid.n_states, bool)
    follows[path.states[::-1]] = rest[::-1]  # backwards, so that the first visit stands
    return follows
