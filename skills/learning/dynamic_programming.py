"""Exact values by dynamic programming, value iteration as a learner, and the rule among equally good actions.

The exact value of every row of a domain, and of every action in it, follows from the rewards without learning.

If no move slips, the values above phase 0 follow from one distance: with d the Chebyshev distance to the next
waypoint (at least 1: staying in its cell enters it), V = gamma^(d-1) A_p, where A_p = 1 + gamma V_(p+1) at that
waypoint, and A of the last phase is the goal's reward. In phase 0, and in the paper's cell state, the values are the
fixed point of value iteration over the grid.

A move *slips* with a given probability: then one of the 27 moves is made instead of it, each with equal probability;
off the grid the arm stays. In that case all values are the fixed point of value iteration over the whole domain.

With gamma 0.1 a state 300 moves from the path has a value below 10^-300, where floating-point numbers lose digits, and
soon all. Such *faint* values are compared by their logarithms (`log_losses`): without slips as integers, in units of
2^-36, so that any number of moves adds up exactly; with slips as the fixed point of value iteration in logarithms.

As a learner in the phase state, `ValueIteration` gives the exact Q values of Algorithm 1's rewards without a move of
the arm. The paper tried value iteration first, in its *cell* state, and gave it up (Sec. III-C;
`skills.learning.max_ent_irl` explains one reason for the failure there, a path that crosses itself is another). In the
phase state it finds the same policy as Q-learning, without exploration: it knows the result of each move, which
Q-learning has to find out.

Among equally good actions the rule takes that of the shortest way, then the shallowest, then the earliest to join:

    Domain, Q values --choose--> the action of each row
    Domain, exact values, actions --off_rule--> the number of rows whose action is not the one of the rule

Four of five rows have several best actions, because the value of a move depends on the number of moves alone: a move
along a diagonal costs as much as one along an axis. The paper takes any of them. The rule, ours, compares *approaches*:
the walks from a row, by best actions only, to the first waypoint that they enter, which is the joining point in phase 0
and the next waypoint later. It selects the action

    1. whose approach is the shortest, through the centres of its cells;
    2. of these, whose approach has the smallest greatest depth, in the cells after the first, which all have in common;
    3. of these, whose approach joins the path earliest;
    4. of these, with the lowest index.

An approach continues by the rule, so that the length L, the depth D and the joining point J of a row follow from those
of the next one: L = step + L', D = max(depth', D'), J = J'. Best actions lead to larger values, so there are no loops.
If no walk of best actions enters a waypoint, as in values that were sampled too rarely, the lowest index counts.

All three are compared as integers, so that no rounding decides: lengths in 2^-32 of a cell, in which the sums of 1,
sqrt(2) and sqrt(3) of any two approaches differ, and depths in nanometres.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, isfinite
from typing import ClassVar, Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skills.arrays import Bytes, Flags, Floats, Ints
from skills.errors import BadSettings
from skills.fields import Point, schema
from skills.gridworld.domain import Domain, Moves, check_join_share
from skills.gridworld.grid import MOVES, GridWorld, moves_between
from skills.gridworld.reward import RewardMap
from skills.gridworld.scene import STAY, Hazards
from skills.learning import _kernels

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
        slip: The probability that a move slips.
        hazards: A scene on the path's grid, or None; a move that touches it ends the pass.
    """

    domain: Domain
    reward: RewardMap
    gamma: float
    slip: float = 0.0
    hazards: Hazards | None = None

    @property
    def closed_form(self) -> bool:
        """Whether the values follow from distances: nothing slips, and nothing is in the way."""
        return self.slip == 0 and self.hazards is None


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
    settled = _kernels.settle_compiled(
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
        anywhere = np.where(off_grid, made[STAY], made).mean(axis=0)
        q = (1 - mdp.slip) * made + mdp.slip * anywhere
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
    if mdp.slip > 0:
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
    _kernels.spread_worth_compiled(
        of_phase_0.reshape(grid.shape), entering.reshape(grid.shape), given.reshape(grid.shape), int(step)
    )
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
            anywhere = np.logaddexp.reduce(np.where(off_grid, made[STAY], made)) - np.log(len(MOVES))
            q = np.logaddexp(np.log1p(-mdp.slip) + made, np.log(mdp.slip) + anywhere)
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
class ValueIteration:
    """Settings of value iteration in the phase state. The result does not depend on a seed.

    The paper does not state its gamma. Ours is that of `PhaseQLearning`: the nearest waypoint always has the highest
    value.
    """

    kind: ClassVar[str] = "value-iteration"
    phased: ClassVar[bool] = True

    gamma: float = 0.1
    slip: float = 0.0  # probability that one of the 27 moves, drawn uniformly, replaces the intended one
    join_share: float = 0.0  # the joining rule: least share of the demonstration that a start is led to follow

    def __post_init__(self) -> None:
        check_join_share(self.join_share)
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
    domain = Domain(reward.path, settings.phased, settings.join_share)
    return exact_q(Mdp(domain, reward, settings.gamma, settings.slip))


TIE = 1e-9  # relative; two actions closer than this are equally good (a Q value carries about 1e-15 of rounding)
NM_PER_MM = 1e6


@schema
@dataclass(frozen=True)
class ShortestWay:
    """The rule among equally good actions: shortest way, then least depth, then earliest joining point, lowest index.

    The way is the one to the first waypoint that is entered, and its depth is the greatest of its cells. Depth is not
    compared if neither of its two measures is given.

    Attributes:
        depth_from_mm: The point whose distance is the depth: the remote centre, the origin of an arm's base frame.
        depth_along: The direction in which depth increases, in the frame of the demonstration.
        kind: The name of the rule.
    """

    depth_from_mm: Point | None = None
    depth_along: Point | None = None
    kind: Literal["shortest-way"] = "shortest-way"

    def __post_init__(self) -> None:
        if self.depth_from_mm is not None and self.depth_along is not None:
            raise BadSettings("Depth is a distance from a point or a coordinate along a direction, not both.")
        for name in ("depth_from_mm", "depth_along"):
            given = getattr(self, name)
            if given is None:
                continue
            if len(given) != 3 or not all(map(isfinite, given)):
                raise BadSettings(f"{name} must be three finite numbers.")
            object.__setattr__(self, name, tuple(map(float, given)))  # as read from JSON, it is a list
        if self.depth_along is not None and not hypot(*self.depth_along) > 0:
            raise BadSettings("depth_along must not be (0, 0, 0): give the direction in which depth increases.")

    def depths_nm(self, grid: GridWorld) -> Ints:
        """Return the depth of every cell's centre in whole nanometres, (n_states,); 0 if depth is not compared."""
        # Along each axis, because the centres of all cells would take three times the memory.
        axes = [o + grid.cell_mm * np.arange(n) for o, n in zip(grid.origin_mm, grid.shape, strict=True)]
        if self.depth_from_mm is not None:
            parts = [(axis - at) ** 2 for axis, at in zip(axes, self.depth_from_mm, strict=True)]
        elif self.depth_along is not None:
            length = hypot(*self.depth_along)
            parts = [axis * (part / length) for axis, part in zip(axes, self.depth_along, strict=True)]
        else:
            return np.zeros(grid.n_states, np.int64)
        depth = parts[0][:, None, None] + parts[1][:, None] + parts[2]
        if self.depth_from_mm is not None:
            depth = np.sqrt(depth)
        return np.asarray(np.rint(depth.reshape(-1) * NM_PER_MM), np.int64)


REMOTE_CENTRE = ShortestWay(depth_from_mm=(0.0, 0.0, 0.0))  # of a demonstration in the base frame of its arm


def rule_in(frame: str, depth_along: Sequence[float] | None = None) -> ShortestWay:
    """Return the rule for a demonstration in a frame.

    In the base of an arm, depth is the distance from the remote centre. In another frame it is measured along the given
    direction, and not compared without one.

    Args:
        frame: Name of the frame; that of an arm's base ends with "_base".
        depth_along: The direction in which depth increases in that frame, three numbers; not used in an arm's base.

    Raises:
        BadSettings: The direction is not three finite numbers, or has the length 0.
    """
    if frame.endswith("_base"):
        return REMOTE_CENTRE
    return ShortestWay(depth_along=None if depth_along is None else cast(Point, tuple(depth_along)))


def choose(domain: Domain, q: Floats, rule: ShortestWay) -> Ints:
    """Return the action of each row by the rule; meaningless in rows without one.

    Args:
        domain: The certified domain, in the phase state.
        q: Q values, shape (rows, 27).
        rule: The rule.

    Returns:
        Actions, 0 to 26, shape (rows,).
    """
    value, equal = np.empty(len(q)), np.empty(len(q), np.int32)
    _kernels.find_equal_compiled(q, TIE, value, equal)
    live = np.flatnonzero(domain.certified & ~domain.terminal)
    action = np.zeros(len(q), np.int64)
    ends, joined = _ends(domain)
    depth = rule.depths_nm(domain.path.grid)[domain.state_of]
    _kernels.choose_ways_compiled(
        action,
        np.where(ends, 0, _kernels.NEVER),
        depth.copy(),
        joined,
        ends,
        live[_falling(value[live])],  # best actions lead to larger values: after one pass all is decided
        equal,
        depth,
        domain.phase_of,
        domain.offset,
        domain.size,
    )
    return action


def off_rule(mdp: Mdp, values: Floats, actions: Ints, moves: Moves, rule: ShortestWay) -> int:
    """Count the rows whose action is not the one that the rule selects of the exactly best ones.

    The lengths, depths and joining points are those of the walks by the given actions. The rule holds everywhere if no
    best action of any row has a better next row: Bellman's equations, whose solution is unique, because no step of a
    walk has the length 0.

    Args:
        mdp: The decision process.
        values: Its exact values, shape (rows,).
        actions: The action of each row, shape (rows,); negative in rows without one.
        moves: Their results, arrays of shape (rows,).
        rule: The rule.

    Returns:
        The number of rows.
    """
    domain, levels, path = mdp.domain, mdp.reward.levels, mdp.domain.path
    ends, joined = _ends(domain)
    worth = levels.other + mdp.gamma * values  # reward and discounted value of entering each row from its phase
    last = domain.phases - 1
    goes_on = np.flatnonzero(ends & (joined < last))  # the waypoint joined is the one behind in the phase that follows
    after = domain.rows_of(joined[goes_on] + 1, path.cells[joined[goes_on]])
    worth[goes_on] = levels.visited + mdp.gamma * values[after]
    worth[ends & (joined == last)] = levels.goal
    return int(
        _kernels.count_off_rule_compiled(
            np.flatnonzero(domain.certified & ~domain.terminal),
            actions,
            worth,
            # With slips the values of two actions differ by less than those of entering their rows.
            TIE / (1 - mdp.slip) * np.abs(values),
            *_walks(domain, actions, moves, rule),
            ends,
            domain.phase_of,
            domain.offset,
            domain.size,
        )
    )


def _ends(domain: Domain) -> tuple[NDArray[np.bool_], Ints]:
    """Return whether a way ends on entering each row from its phase, and the waypoint that it enters, (rows,) each."""
    path, first = domain.path, domain.offset[1]
    joined = domain.phase_of.copy()
    joined[:first] = domain.joins - 1
    if domain.finishes_unjoined:
        joined[path.goal] = domain.phases - 1
    ends = domain.state_of == path.states[domain.phase_of]
    ends[:first] = joined[:first] >= 0
    return ends, joined


def _walks(domain: Domain, actions: Ints, moves: Moves, rule: ShortestWay) -> tuple[Ints, Ints, Ints]:
    """Return the way left on entering each row by given actions: its length, greatest depth and waypoint, (rows,) each.

    The walks from all rows are computed at once, by doubling their length.
    """
    ends, joined = _ends(domain)
    none = domain.n_rows  # in place of the row after the last one of a way
    depth = rule.depths_nm(domain.path.grid)
    joins = (moves.row >= 0) & (domain.phase_of[moves.row] != domain.phase_of)
    arrives = ends | ((actions >= 0) & (moves.finishes | moves.advances | joins))
    after = np.append(np.where(arrives | (actions < 0) | (moves.row < 0), none, moves.row), none)
    step = np.array(_kernels.STEPS)[np.abs(MOVES).sum(axis=1)][actions]
    length = np.append(np.where(ends, 0, step), 0)
    deepest = depth[domain.state_of]
    deepest = np.append(np.where(ends, deepest, np.maximum(deepest, depth[moves.state])), np.iinfo(np.int64).min)
    ahead = np.where(domain.phase_of > 0, domain.phase_of, domain.joins[moves.state] - 1)
    ahead[(domain.phase_of == 0) & moves.finishes] = domain.phases - 1
    joined = np.append(np.where(ends, joined, np.where(arrives, ahead, -1)), -1)
    for _ in range(domain.n_rows.bit_length()):  # a walk without a loop has fewer moves than there are rows
        if (after == none).all():
            break
        length, deepest = length + length[after], np.maximum(deepest, deepest[after])
        joined = np.where(joined < 0, joined[after], joined)
        after = after[after]
    length[joined < 0] = _kernels.NEVER
    return length[:-1], deepest[:-1], joined[:-1]


def _falling(values: Floats) -> Ints:
    """Return the order of values from the largest to the smallest, as far as their first 20 binary digits tell."""
    bits = ~values.view(np.uint64)  # of positive numbers, whose bits are in the order of the numbers
    # Integers of 16 bits, because they are sorted in a third of the time of the numbers.
    upper, lower = ((bits >> np.uint64(digits)).astype(np.uint16) for digits in (48, 32))
    return np.asarray(np.lexsort((lower, upper)), np.int64)
