"""The rule among equally good actions: the shortest approach, then the shallowest, then the earliest to join.

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
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from skills.arrays import Flags, Floats, Ints
from skills.compiled import compiled, inner
from skills.errors import BadSettings
from skills.fields import Point, schema
from skills.gridworld.domain import Domain, Moves
from skills.gridworld.grid import MOVES, GridWorld
from skills.learning.dynamic_programming import Mdp

STEPS = (0, 4294967296, 6074001000, 7439101574)  # lengths of moves along 0 to 3 axes, in 2^-32 of a cell
NEVER = 2**62  # length of an approach that never enters a waypoint
TIE = 1e-9  # relative; two actions closer than this are equally good (a Q value carries about 1e-15 of rounding)
OPTIMAL = "optimal to 1e-9 of their value"  # of actions: as `TIE` tells them apart, wherever they are counted
NM_PER_MM = 1e6


@schema
@dataclass(frozen=True)
class ShortestApproach:
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
    kind: Literal["shortest-approach"] = "shortest-approach"

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


REMOTE_CENTRE = ShortestApproach(depth_from_mm=(0.0, 0.0, 0.0))  # of a demonstration in the base frame of its arm


def rule_in(frame: str, depth_along: Sequence[float] | None = None) -> ShortestApproach:
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
    return ShortestApproach(depth_along=None if depth_along is None else cast(Point, tuple(depth_along)))


class Boxes(NamedTuple):
    """The rows of a domain: the phase of each, (rows,); the first row of each phase, and the number of rows, (P + 1,).

    `size` has the number of cells of each phase's box along each axis, (P, 3). All are int64.
    """

    phase_of: Ints
    offset: Ints
    size: Ints


class Approaches(NamedTuple):
    """The approach that is left on entering each row, arrays of shape (rows,), int64.

    Attributes:
        length: Its length, in units of `STEPS`; `NEVER` if it does not end.
        deepest: The greatest depth on it, with that of the row.
        joined: The waypoint at which it ends.
    """

    length: Ints
    deepest: Ints
    joined: Ints


def choose(domain: Domain, q: Floats, rule: ShortestApproach) -> Ints:
    """Return the action of each row by the rule; meaningless in rows without one.

    Args:
        domain: The certified domain, in the phase state.
        q: Q values, shape (rows, 27).
        rule: The rule.

    Returns:
        Actions, 0 to 26, shape (rows,).
    """
    value, equal = np.empty(len(q)), np.empty(len(q), np.int32)
    find_equal(q, TIE, value, equal)
    live = np.flatnonzero(domain.certified & ~domain.terminal)
    action = np.zeros(len(q), np.int64)
    ends, joined = _ends(domain)
    depth = rule.depths_nm(domain.path.grid)[domain.state_of]
    approaches = Approaches(np.where(ends, 0, NEVER), depth.copy(), joined)
    order = live[_falling(value[live])]  # best actions lead to larger values: after one pass all is decided
    choose_approaches(action, approaches, ends, order, equal, depth, _boxes(domain))
    return action


def off_rule(mdp: Mdp, values: Floats, actions: Ints, moves: Moves, rule: ShortestApproach) -> int:
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
    rows = np.flatnonzero(domain.certified & ~domain.terminal)
    # With slips the values of two actions differ by less than those of entering their rows.
    tie = TIE / mdp.slip.intended * np.abs(values)
    approaches = _approaches(domain, actions, moves, rule)
    return int(count_off_rule(rows, actions, worth, tie, approaches, ends, _boxes(domain)))


def _boxes(domain: Domain) -> Boxes:
    return Boxes(domain.phase_of, domain.offset, domain.size)


def _ends(domain: Domain) -> tuple[Flags, Ints]:
    """Return whether a way ends on entering each row from its phase, and the waypoint that it enters, (rows,) each."""
    path, first = domain.path, domain.offset[1]
    joined = domain.phase_of.copy()
    joined[:first] = domain.joins - 1
    if domain.finishes_unjoined:
        joined[path.goal] = domain.phases - 1
    ends = domain.state_of == path.states[domain.phase_of]
    ends[:first] = joined[:first] >= 0
    return ends, joined


def _approaches(domain: Domain, actions: Ints, moves: Moves, rule: ShortestApproach) -> Approaches:
    """Return the approach that is left on entering each row by given actions.

    The walks from all rows are computed at once, by doubling their length.
    """
    ends, joined = _ends(domain)
    none = domain.n_rows  # in place of the row after the last one of a way
    depth = rule.depths_nm(domain.path.grid)
    joins = (moves.row >= 0) & (domain.phase_of[moves.row] != domain.phase_of)
    arrives = ends | ((actions >= 0) & (moves.finishes | moves.advances | joins))
    after = np.append(np.where(arrives | (actions < 0) | (moves.row < 0), none, moves.row), none)
    step = np.array(STEPS)[np.abs(MOVES).sum(axis=1)][actions]
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
    length[joined < 0] = NEVER
    return Approaches(length[:-1], deepest[:-1], joined[:-1])


def _falling(values: Floats) -> Ints:
    """Return the order of values from the largest to the smallest, as far as their first 20 binary digits tell."""
    bits = ~values.view(np.uint64)  # of positive numbers, whose bits are in the order of the numbers
    # Integers of 16 bits, because they are sorted in a third of the time of the numbers.
    upper, lower = ((bits >> np.uint64(digits)).astype(np.uint16) for digits in (48, 32))
    return np.asarray(np.lexsort((lower, upper)), np.int64)


# ---- compiled loops -------------------------------------------------------------------------------------------------


@compiled
def find_equal(q: Any, tie: float, value: Any, equal: Any) -> None:
    """Find the best actions of each row.

    Args:
        q: Q values, shape (rows, 27), float64.
        tie: Relative difference up to which two actions are equally good.
        value: The largest Q value of each row, shape (rows,), float64, filled.
        equal: The actions that are as good as that one, a bit for each, shape (rows,), int32, filled.
    """
    for row in range(len(q)):
        top = -np.inf
        for action in range(27):
            if q[row, action] > top:
                top = q[row, action]
        least = top - tie * abs(top)
        bits = 0
        for action in range(27):
            if q[row, action] >= least:
                bits |= 1 << action
        value[row] = top
        equal[row] = bits


@inner
def place_in_box(at: Any, size_y: Any, size_z: Any) -> Any:
    """Return the place x, y, z of a row in the box of its phase, counted from the box's first row.

    Args:
        at: Index of the row, counted from the box's first one.
        size_y: Number of the box's cells along y.
        size_z: Number of its cells along z.
    """
    rest = at // size_z
    x = rest // size_y
    return x, rest - x * size_y, at - rest * size_z


@compiled
def choose_approaches(actions: Any, approaches: Any, ends: Any, order: Any, equal: Any, depth: Any, boxes: Any) -> None:
    """Choose of each row's best actions the one with the shortest, then shallowest, then earliest joining approach.

    Args:
        actions: The action of each row, 0 to 26, shape (rows,), int64, filled.
        approaches: `Approaches`, filled. At first the length is 0 at ends and else `NEVER`, the depth that of the row
            alone, the waypoint that of ends.
        ends: Whether an approach ends on entering each row, shape (rows,), bool.
        order: The rows that have an action, shape (N,), int64; one pass is enough if every approach goes backwards in
            it.
        equal: The best actions of each row, a bit for each, shape (rows,), int32, as `find_equal` fills them.
        depth: The depth of each row's cell, shape (rows,), int64.
        boxes: `Boxes`.
    """
    length, deepest, joined = approaches
    phase_of, offset, size = boxes
    number, changed, waits = 0, 1, 0
    while changed > 0 and (number != 1 or waits > 0):
        changed = 0
        for i in range(len(order)):
            row = order[i] if number % 2 == 0 else order[len(order) - 1 - i]
            bits, phase = equal[row], phase_of[row]
            size_y, size_z = size[phase, 1], size[phase, 2]
            x, y, z = place_in_box(row - offset[phase], size_y, size_z)
            chosen, best_length, best_depth, best_joined = -1, NEVER, 0, 0
            for action in range(27):
                if not bits >> action & 1:
                    continue
                if chosen < 0:
                    chosen = action  # the lowest index counts where no way is found
                dx, dy, dz = action // 9 - 1, action // 3 % 3 - 1, action % 3 - 1
                if x + dx < 0 or x + dx >= size[phase, 0] or y + dy < 0 or y + dy >= size_y:
                    continue
                if z + dz < 0 or z + dz >= size_z:
                    continue
                after = row + (dx * size_y + dy) * size_z + dz
                if after == row and not ends[row]:
                    continue
                if length[after] == NEVER:
                    waits += 1  # its way may be found later in this pass
                    continue
                way = length[after] + STEPS[dx * dx + dy * dy + dz * dz]
                if way > best_length:
                    continue
                if (
                    way < best_length
                    or deepest[after] < best_depth
                    or (deepest[after] == best_depth and joined[after] < best_joined)
                ):
                    chosen, best_length, best_depth, best_joined = action, way, deepest[after], joined[after]
            actions[row] = max(chosen, 0)
            best_depth = max(best_depth, depth[row])
            if not ends[row] and (
                length[row] != best_length or deepest[row] != best_depth or joined[row] != best_joined
            ):
                length[row], deepest[row], joined[row] = best_length, best_depth, best_joined
                changed += 1
        number += 1


@compiled
def count_off_rule(rows: Any, actions: Any, worth: Any, tie: Any, approaches: Any, ends: Any, boxes: Any) -> Any:
    """Count the rows in which an equally good action leads to a better approach, or to an equal one at a lower index.

    Args:
        rows: The rows to check, shape (N,), int64.
        actions: The action of each row, shape (rows,), int64.
        worth: Reward and discounted value of entering each row from its phase, shape (rows,), float64.
        tie: The difference up to which two actions of each row are equally good, shape (rows,), float64.
        approaches: `Approaches` by these actions.
        ends: Whether an approach ends on entering each row, shape (rows,), bool.
        boxes: `Boxes`.

    Returns:
        The number of rows, with those whose own approach never ends.
    """
    length, deepest, joined = approaches
    phase_of, offset, size = boxes
    off = 0
    for i in range(len(rows)):
        row = rows[i]
        phase = phase_of[row]
        size_x, size_y, size_z = size[phase, 0], size[phase, 1], size[phase, 2]
        x, y, z = place_in_box(row - offset[phase], size_y, size_z)
        dx, dy, dz = actions[row] // 9 - 1, actions[row] // 3 % 3 - 1, actions[row] % 3 - 1
        made = row + (dx * size_y + dy) * size_z + dz
        outside = x + dx < 0 or x + dx >= size_x or y + dy < 0 or y + dy >= size_y or z + dz < 0 or z + dz >= size_z
        if outside or length[made] == NEVER or (made == row and not ends[row]):
            off += 1
            continue
        own = length[made] + STEPS[dx * dx + dy * dy + dz * dz]
        least = worth[made] - tie[row]
        better = False
        for dx in range(-1 if x > 0 else 0, 2 if x < size_x - 1 else 1):
            for dy in range(-1 if y > 0 else 0, 2 if y < size_y - 1 else 1):
                for dz in range(-1 if z > 0 else 0, 2 if z < size_z - 1 else 1):
                    after = row + (dx * size_y + dy) * size_z + dz
                    if worth[after] < least:
                        continue
                    way = length[after] + STEPS[dx * dx + dy * dy + dz * dz]
                    if way > own or (after == row and not ends[row]):
                        continue
                    if (
                        way < own
                        or deepest[after] < deepest[made]
                        or (
                            deepest[after] == deepest[made]
                            and (joined[after] < joined[made] or (joined[after] == joined[made] and after < made))
                        )
                    ):
                        better = True
        off += better
    return off
