"""The rule among equally good actions: the shortest way, then the shallowest, then the earliest joining point.

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
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from skills.arrays import Floats, Ints
from skills.errors import BadSettings
from skills.fields import Point, schema
from skills.gridworld.domain import Domain, Moves
from skills.gridworld.grid import MOVES, GridWorld
from skills.learning import _kernels
from skills.learning.dynamic_programming import Mdp

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
    """
    if frame.endswith("_base"):
        return REMOTE_CENTRE
    return ShortestWay(depth_along=None if depth_along is None else (depth_along[0], depth_along[1], depth_along[2]))


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
