"""Certificate of a policy on its grid: exact values, optimal actions, and the starts from which it succeeds.

    Policy --certify--> Certificate, Coverage

The exact values come from dynamic programming (`skills.learning.dynamic_programming`), not from learning. The
certificate makes no statement about the accuracy of the arm.

Two actions are equally good if their exact values differ by less than `TIE`, relatively. Values below `FAINT`, far from
the path, are compared by their logarithms, so the comparison does not depend on the size of the grid. In a scene, where
values nearly cancel, actions are equally good also if they differ by less than `NOISE` of the cost of touching.
"""

from dataclasses import asdict, dataclass
from math import inf, prod

import numpy as np

from skills.arrays import Bytes, Flags, Floats, Ints, freeze
from skills.errors import BadSettings
from skills.fields import Count, schema
from skills.gridworld.domain import FINISHED
from skills.gridworld.reward import sparse_reward
from skills.learning.dynamic_programming import FAINT, Mdp, action_values, exact_q, exact_values, log_losses
from skills.learning.policy import Policy
from skills.learning.ties import TIE, off_rule

NOISE = 1e-12  # of the cost of touching: values that nearly cancel are exact to less
FAINTEST = 100  # times that noise: a smaller value is not compared


@dataclass(frozen=True, eq=False)
class Coverage:
    """The success of a policy from every state as a start, arrays of shape (n_states,).

    Attributes:
        reaches: The policy reaches the goal.
        joins_nearest: The policy joins the demonstration in the fewest moves (Chebyshev) that its joining rule allows,
            and then follows it.
        share: The share of the demonstration that the policy follows, see `shares_of`.
        finishing: In a scene, the probability that a pass with the learnt slip finishes; None without a scene.
        touching: In a scene, the probability that it touches the scene; None without a scene.
    """

    reaches: Flags
    joins_nearest: Flags
    share: Floats
    finishing: Floats | None = None
    touching: Floats | None = None

    def __post_init__(self) -> None:
        count = len(self.reaches)
        freeze(self, np.bool_, reaches=(count,), joins_nearest=(count,))
        freeze(self, share=(count,), finishing=(count,), touching=(count,))


@dataclass(frozen=True)
class NearLimits:
    """The limit that a release must meet at the starts near the demonstrated one.

    Attributes:
        radius_mm: A start is near if a position within this distance of the demonstrated start's centre lies in its
            cell. Ours: 3 mm, the tip error of an uncalibrated arm, which may start there when sent to the demonstrated
            start.
        least_share: Least share of the demonstration that every near start must follow. Ours: 0.4, between the 0.91 or
            more of all recordings and samples, and the 0.1 or less of paths that come back beside their start
            (docs/joining.md).
    """

    radius_mm: float = 3.0
    least_share: float = 0.4

    def __post_init__(self) -> None:
        if not (0 < self.radius_mm < inf and 0 <= self.least_share <= 1):
            raise BadSettings("radius_mm must be positive, and least_share in [0, 1].", **asdict(self))


@schema
@dataclass(frozen=True, kw_only=True)
class NearStarts(NearLimits):
    """The starts near the demonstrated one, and the limit that they must meet.

    Attributes:
        starts: Number of near starts; the demonstrated one is among them.
        share: The smallest share of the demonstration that the policy follows from one of them.
    """

    starts: Count
    share: float

    @property
    def within(self) -> bool:
        """Whether every near start follows enough of the demonstration; written so that NaN fails."""
        return self.share >= self.least_share


@dataclass(frozen=True)
class OddsLimits:
    """The limits that a release of a policy learnt in a scene must meet, at the starts near the demonstrated one.

    Attributes:
        least_finishing: Least probability of finishing. Ours: 0.9; on the paper's user, with tissue 5 mm below its
            path, exact policies have 0.96, 0.87 and 0.71 with slips of 0.1, 0.2 and 0.3 (docs/scenes.md).
        most_touching: Greatest probability of touching the scene. Ours: 0.05, half of the passes that may fail; there
            the same policies have 0.04, 0.10 and 0.18.
    """

    least_finishing: float = 0.9
    most_touching: float = 0.05

    def __post_init__(self) -> None:
        if not (0 <= self.least_finishing <= 1 and 0 <= self.most_touching <= 1):
            raise BadSettings("least_finishing and most_touching must be in [0, 1].", **asdict(self))


@schema
@dataclass(frozen=True, kw_only=True)
class NearOdds(OddsLimits):
    """The odds of the allowed starts near the demonstrated one (`NearStarts`), and the limits that they must meet.

    Attributes:
        starts: Number of these starts.
        finishing: The smallest probability of finishing from one of them.
        touching: The greatest probability of touching the scene from one of them.
    """

    starts: Count
    finishing: float
    touching: float

    @property
    def within(self) -> bool:
        """Whether every such start finishes often enough and touches seldom enough; written so that NaN fails."""
        return self.finishing >= self.least_finishing and self.touching <= self.most_touching


@dataclass(frozen=True)
class Certificate:
    """The result of checking every greedy action of the certified domain against exact values, and every start.

    If the policy was learnt with slips, the exact values are those of the world that slips; all walks are without
    slips. If it was learnt in a scene, they are those of that scene, and states where it stops are not checked.

    Attributes:
        checked: Number of states (phase and cell) that were checked.
        suboptimal: Number of them whose greedy action is worse than the best one.
        finishing: Number of them from which the policy rejoins the demonstration and finishes.
        starts: Number of states as starts of a pass.
        starts_reaching: Number of starts from which the policy reaches the goal.
        starts_joining_nearest: Number of starts from which it joins the demonstration in the fewest moves that its
            joining rule allows, and follows it.
        starts_goal_alone: Number of starts from which it reaches the goal and follows no move of the demonstration.
        mean_share: Share of the demonstration that it follows, see `shares_of`: the mean over all starts.
        median_share: The median over all starts.
        demonstration_reproduced: The rollout from the demonstrated start visits the demonstration's states, in order.
        faint: Number of checked states whose exact value is below `FAINT`, so that logarithms were compared.
        off_rule: Number of the checked states whose greedy action is not the one that the policy's rule selects of the
            exactly best ones (`Policy.ties`); None if it has no rule but the lowest index.
    """

    checked: int
    suboptimal: int
    finishing: int
    starts: int
    starts_reaching: int
    starts_joining_nearest: int
    starts_goal_alone: int
    mean_share: float
    median_share: float
    demonstration_reproduced: bool
    off_rule: int | None
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
    if policy.hazards is None:
        optimal, faint, best = _compared(policy, live)
    else:
        live &= policy.greedy >= 0
        optimal, best = optimal_in_scene(mdp_of(policy), policy.greedy, live)
        faint = np.zeros_like(live)
    finishing = finishes(policy)
    greedy, ties = policy.greedy.astype(np.int64), policy.ties
    off = None if ties is None else off_rule(mdp_of(policy), best, greedy, policy.moves, ties)
    covered = coverage(policy, finishing)
    share = covered.share
    certificate = Certificate(
        checked=int(live.sum()),
        suboptimal=int(np.count_nonzero(live & ~optimal)),
        finishing=int(np.count_nonzero(live & finishing)),
        starts=len(covered.reaches),
        starts_reaching=int(covered.reaches.sum()),
        starts_joining_nearest=int(covered.joins_nearest.sum()),
        starts_goal_alone=int(np.count_nonzero(covered.reaches & (share == 0))),
        mean_share=float(share.mean()),
        median_share=float(np.median(share)),
        demonstration_reproduced=np.array_equal(policy.replay.states, policy.path.states),
        faint=int(np.count_nonzero(faint)),
        off_rule=off,
    )
    return certificate, covered


def _compared(policy: Policy, live: Flags) -> tuple[Flags, Flags, Floats]:
    """Return whether each row's greedy action is optimal, whether logarithms were compared, and the value, (rows,)."""
    achieved, best = _achieved(policy)
    optimal = achieved >= best - TIE * np.abs(best)  # written so that NaN fails
    # Only where `other` is 0 do the values of distant states approach 0.
    faint = live & (best < FAINT) & (policy.levels.other == 0)
    if faint.any():
        optimal[faint] = log_losses(mdp_of(policy), best, policy.greedy, policy.moves)[faint] <= TIE
    return optimal, faint, best


def optimal_in_scene(mdp: Mdp, greedy: Bytes, live: Flags) -> tuple[Flags, Floats]:
    """Compare greedy actions with exact values in a scene.

    Args:
        mdp: The decision process, with hazards.
        greedy: The action of each row, (rows,).
        live: The rows that are compared, (rows,).

    Returns:
        Whether the action of each row is optimal, (rows,), meaningless in other rows; and the exact value, (rows,).

    Raises:
        BadSettings: Exact values do not settle, or some are too small to be compared, because gamma is too small.
    """
    assert mdp.hazards is not None, "certify compares without a scene"
    q = exact_q(mdp)
    best, achieved = q.max(axis=1), q[np.arange(len(q)), greedy.astype(np.int64).clip(0)]
    noise = NOISE * mdp.hazards.touch
    small = live & (best != 0) & ~(np.abs(best) > FAINTEST * noise)
    if small.any():
        raise BadSettings(
            f"With gamma {mdp.gamma:g} the values of {np.count_nonzero(small)} states are too small to be compared "
            "with the cost of touching; use a gamma nearer to 1.",
            gamma=mdp.gamma,
        )
    return np.asarray(achieved >= best - TIE * np.abs(best) - noise), best  # written so that NaN fails


def near_starts(policy: Policy, share: Floats, limits: NearLimits) -> NearStarts:
    """Return how much of the demonstration the policy follows from the starts near the demonstrated one.

    Args:
        policy: The policy.
        share: The share of each start, shape (n_states,), as `shares_of` returns it.
        limits: The radius, and the least share.

    Returns:
        The number of near starts, and the smallest share among them.
    """
    near = _near(policy, limits)
    return NearStarts(**asdict(limits), starts=int(near.sum()), share=float(share[near].min()))


def near_odds(policy: Policy, covered: Coverage, near: NearLimits, limits: OddsLimits) -> NearOdds:
    """Return the odds of a policy learnt in a scene from the starts near the demonstrated one.

    Args:
        policy: The policy.
        covered: Its coverage, with the odds of all starts.
        near: The radius within which starts are near.
        limits: The limits of the odds.
    """
    assert covered.finishing is not None and covered.touching is not None, "it was learnt in a scene"
    there = _near(policy, near)
    finishing, touching = float(covered.finishing[there].min()), float(covered.touching[there].max())
    return NearOdds(**asdict(limits), starts=int(there.sum()), finishing=finishing, touching=touching)


def _near(policy: Policy, limits: NearLimits) -> Flags:
    """Mark the states that are starts near the demonstrated one, (n_states,); in a scene the allowed ones."""
    grid = policy.path.grid
    away_mm = grid.cell_mm * np.abs(grid.cells_of(np.arange(grid.n_states)) - policy.path.cells[0])
    near = np.linalg.norm((away_mm - grid.cell_mm / 2).clip(0), axis=1) <= limits.radius_mm
    return np.asarray(near if policy.hazards is None else near & ~policy.hazards.forbidden)


def mdp_of(policy: Policy) -> Mdp:
    """Return the decision process that a policy is checked against.

    Its rewards are those of Algorithm 1, even if the policy was learnt from others.

    Args:
        policy: The policy.

    Returns:
        The process, with the discount and the slip of the policy's learner, and the scene that it was learnt in.
    """
    learner = policy.learner
    reward = sparse_reward(policy.path, policy.levels)
    return Mdp(policy.domain, reward, learner.gamma, learner.slip_model, policy.hazards)


def _achieved(policy: Policy) -> tuple[Floats, Floats]:
    """Return the value of each row's greedy action with optimal moves after it, and that of the best, both (rows,)."""
    mdp = mdp_of(policy)
    if mdp.slip.probability > 0:
        q = exact_q(mdp)
        return q[np.arange(len(q)), policy.greedy.astype(np.int64).clip(0)], q.max(axis=1)
    best = exact_values(mdp)
    return action_values(mdp, best, policy.moves), best


def finishes(policy: Policy) -> Flags:
    """Return for every row whether the walk from it finishes.

    Args:
        policy: The policy.

    Returns:
        Flags of shape (rows,).
    """
    done = (policy.greedy == FINISHED) | (policy.moves.finishes & (policy.greedy >= 0))
    return _along(policy, done) > 0


def shares_of(policy: Policy, finishing: Flags) -> Floats:
    """Return for every state as a start the share of the demonstration that the policy follows.

    The share is the number of moves with which both the walk from the start and the demonstration end, over all moves
    of the demonstration: 1 where the walk ends with the whole demonstration, 0 where it comes to the goal by another
    way or does not reach it. Moves are counted and not millimetres, because they are what the policy learnt one by
    one, and whole numbers are compared exactly.

    Args:
        policy: The policy.
        finishing: Flags of the rows whose walks finish, shape (rows,), as `finishes` returns them.

    Returns:
        Shares from 0 to 1, shape (n_states,).
    """
    states, moving = policy.path.states, policy.greedy >= 0
    last = len(states) - 1
    left = _along(policy, moving)  # moves to the end, where the walk finishes
    # The state at which the demonstration has as many moves left.
    as_shown = moving & (left <= last) & (policy.domain.state_of == states[(last - left).clip(0)])
    followed = _along(policy, finishing & (_along(policy, ~as_shown) == 0))
    rows = policy.domain.start_rows
    return np.asarray(np.where(rows >= 0, followed[rows], 0) / last)


def _along(policy: Policy, counted: Flags) -> Ints:
    """Count the marked rows along the walk from every row, itself included, (rows,).

    The walks of all rows are computed at once, by doubling their length. For a walk that goes in circles the count is
    positive if a row of it is marked, and means nothing else.
    """
    moves, end = policy.moves, policy.domain.n_rows
    stops = (policy.greedy < 0) | moves.finishes | (moves.row < 0)
    walk = np.append(np.where(stops, end, moves.row), end)
    count = np.append(counted.astype(np.int64), 0)
    # A walk without a loop has fewer moves than there are rows.
    for _ in range(end.bit_length()):
        if (walk == end).all():
            break
        count += count[walk]
        walk = walk[walk]
    return np.asarray(count[:-1])


def least_gamma(policy: Policy) -> float | None:
    """Return a gamma, in steps of 0.01, with which no value in the policy's grid is faint (below `FAINT`).

    Args:
        policy: The policy.

    Returns:
        The gamma; None if the bound that slips leave says nothing about any below 1.
    """
    intended = policy.learner.slip_model.intended
    # A move multiplies a value by gamma times the probability that it does not slip, or more, and the worth of the path
    # is at least `visited`.
    least, longest = FAINT / policy.levels.visited, max(1, int(_fewest_moves(policy).max()))
    enough = (one / 100 for one in range(1, 100) if prod([one / 100 * intended] * longest) >= least)
    return next(enough, None)


def _fewest_moves(policy: Policy) -> Ints:
    """Return the fewest moves (Chebyshev) from each state to one at which an unjoined pass meets the path."""
    from scipy.ndimage import distance_transform_cdt  # here, because it is slow to import

    away = ~policy.domain.may_meet.reshape(policy.path.grid.shape)
    return np.asarray(distance_transform_cdt(away, "chessboard").ravel(), np.int64)


def coverage(policy: Policy, finishing: Flags | None = None) -> Coverage:
    """Follow a policy from every state at once.

    Args:
        policy: The policy.
        finishing: What `finishes` returns for it, where it is known.

    Returns:
        The success from every start.
    """
    rows, done = policy.domain.start_rows, finishes(policy) if finishing is None else finishing
    return Coverage((rows < 0) | done[rows], _joins_nearest(policy), shares_of(policy, done))


def _joins_nearest(policy: Policy) -> Flags:
    """Return for every state whether the walk from it meets the path in the fewest moves and then follows it.

    It meets the path at the waypoints at which its joining rule lets it join.
    """
    path = policy.path
    states = np.arange(path.grid.n_states)
    stepped = np.where(policy.greedy[: len(states)] >= 0, policy.moves.state[: len(states)], states)
    on_path = policy.domain.may_meet
    fewest = _fewest_moves(policy)
    at, moved = states.copy(), np.zeros(len(states), np.int64)
    for _ in range(int(fewest.max())):
        walking = ~on_path[at]
        moved += walking
        at = np.where(walking, stepped[at], at)
    follows = _follows(policy)[at] | ((at == path.goal) & (moved > 0) & policy.domain.finishes_unjoined)
    return np.asarray(on_path[at] & (moved == fewest) & follows)


def _follows(policy: Policy) -> Flags:
    """Return for every state of the path whether the policy follows the rest of it from the first visit on."""
    domain, path = policy.domain, policy.path
    index = np.arange(len(path.states) - 1)
    rows = domain.rows_of(index + 1 if domain.phased else np.zeros_like(index), path.cells[:-1])
    right = (policy.greedy[rows] >= 0) & (policy.moves.state[rows] == path.states[1:])
    rest = np.append(np.logical_and.accumulate(right[::-1])[::-1], True)
    follows = np.zeros(path.grid.n_states, bool)
    follows[path.states[::-1]] = rest[::-1]  # backwards, so that the first visit stands
    return follows
