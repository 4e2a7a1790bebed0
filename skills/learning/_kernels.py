"""Compiled loops of learning: ordinary Python functions, compiled by numba under the names `*_compiled`.

They take arrays and numbers, allocate nothing and raise nothing. The plain function and the compiled one agree to the
last bit; a test checks it.

Random bits come from xorshift64 (Marsaglia 2003), whose state, `rng`, is one nonzero uint64, shape (1,); an action is
drawn from the low half of 64 bits, the decision to explore or to slip from the high half.
"""

from math import atan2, sin, sqrt
from typing import Any

import numpy as np

from skills.compiled import compiled, inner

# In a model: never tried; would have left the grid, so the arm stays; touches the scene, which ends the pass.
UNKNOWN, OFF_GRID, TOUCHED = -2, -1, -3
# Unsigned integers, because numba makes a float of a uint64 and a Python integer.
NONE, ONE, THREE, SEVEN, NINE, THIRTEEN, SEVENTEEN = (np.uint64(n) for n in (0, 1, 3, 7, 9, 13, 17))
SMALLEST_SINE = 1e-6  # of half an angle: below it, a share of the chord equals a share of the arc to rounding
SCATTER = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio (Knuth 6.4): spreads similar bits over the table
ACTIONS, HALF, LOW_HALF = np.uint64(27), np.uint64(32), np.uint64(0xFFFFFFFF)
STEPS = (0, 4294967296, 6074001000, 7439101574)  # lengths of moves along 0 to 3 axes, in 2^-32 of a cell
HALVES = tuple(0.5**power for power in range(64))  # a part of a sum that is smaller does not change it
NEVER = 2**62  # length of an approach that never enters a waypoint


@inner
def next_random(x: Any) -> Any:
    """Return the next 64 random bits.

    Args:
        x: The previous bits, uint64, not 0.

    Returns:
        The next bits, uint64, not 0.
    """
    x ^= x << THIRTEEN
    x ^= x >> SEVEN
    x ^= x << SEVENTEEN
    return x


@inner
def any_action(bits: Any) -> Any:
    """Return one of the 27 actions, drawn uniformly.

    Args:
        bits: Random bits, uint64; the low half decides.

    Returns:
        The action, 0 to 26, uint64.
    """
    return ((bits & LOW_HALF) * ACTIONS) >> HALF


def run_episodes(
    q: Any,
    value: Any,
    best: Any,
    rewards: Any,
    shape: Any,
    starts: Any,
    epsilons: Any,
    off_grid: float,
    alpha: float,
    gamma: float,
    max_steps: int,
    goal: Any,
    rng: Any,
    tally: Any,
) -> None:
    """Learn Q values in the paper's cell state by Eq. 1, one episode for each start.

    Integers are unsigned, so that numba does not test each index for being negative; x, y and z count from 1, so that a
    move to -1 is 0 and not a wrapped number.

    Args:
        q: Q values, shape (n_states * 27,), float64, learnt in place.
        value: The largest Q value of each state, shape (n_states,), float64, kept up to date.
        best: The action of that Q value, the first of equals, shape (n_states,), int8, kept up to date.
        rewards: Algorithm 1: the reward for entering each state, shape (n_states,), float64.
        shape: Number of cells along each axis, shape (3,), uint64.
        starts: The state that each episode starts in, shape (E,), uint64.
        epsilons: The probability of exploring in each episode, shape (E,), float64.
        off_grid: The reward of a move off the grid.
        alpha: Learning rate.
        gamma: Discount.
        max_steps: The number of moves after which an episode ends.
        goal: The state that finishes an episode, uint64.
        rng: State of the random bits, shape (1,), uint64, advanced in place.
        tally: Counts of steps, of finished episodes, and of those that ran out of steps, shape (3,), int64; added to.
    """
    nx, ny, nz = shape[0], shape[1], shape[2]
    before_first = (ny + ONE) * nz + ONE
    random = rng[0]
    steps = 0
    for episode in range(len(starts)):
        state = starts[episode]
        x = state // (ny * nz) + ONE
        y = state // nz % ny + ONE
        z = state % nz + ONE
        explores = np.uint64(epsilons[episode] * 4294967296.0)
        finished = False
        for _ in range(max_steps):
            random = next_random(random)
            action = any_action(random) if random >> HALF < explores else np.uint64(best[state])
            to_x = x + action // NINE - ONE
            to_y = y + action // THREE % THREE - ONE
            to_z = z + action % THREE - ONE
            after = state
            if (to_x != NONE) & (to_x <= nx) & (to_y != NONE) & (to_y <= ny) & (to_z != NONE) & (to_z <= nz):
                x, y, z = to_x, to_y, to_z
                after = (x * ny + y) * nz + z - before_first
                target = rewards[after]
                finished = after == goal
                if not finished:
                    target += gamma * value[after]
            else:
                target = off_grid + gamma * value[state]
            row = state * ACTIONS
            new = target
            if alpha < 1:
                new = (1 - alpha) * q[row + action] + alpha * target
            q[row + action] = new
            # Only where the best action itself became worse have all 27 values to be compared.
            if new > value[state]:
                value[state] = new
                best[state] = action
            elif action == np.uint64(best[state]):
                if new < value[state]:
                    top = NONE
                    for other in range(1, 27):
                        if q[row + np.uint64(other)] > q[row + top]:
                            top = np.uint64(other)
                    best[state] = top
                    value[state] = q[row + top]
            elif new == value[state] and action < np.uint64(best[state]):
                best[state] = action
            state = after
            steps += 1
            if finished:
                break
        tally[1] += finished
        tally[2] += not finished
    tally[0] += steps
    rng[0] = random


def explore(
    model: Any,
    shape: Any,
    first: int,
    slip: float,
    max_steps: int,
    goal: int,
    rng: Any,
    tally: Any,
    touches: Any,
) -> None:
    """Move in the grid and record the result of each action: one episode for every pair of state and action.

    Args:
        model: The state that each action led to, `OFF_GRID`, `TOUCHED` or `UNKNOWN`, shape (n_states, 27), int32,
            changed in place.
        shape: Number of cells along each axis, shape (3,), int64.
        first: Start state of the first episode times 27, plus its first action; the others follow in order.
        slip: Probability that one of the 27 moves, drawn uniformly, is made instead.
        max_steps: The number of moves after which an episode ends.
        goal: The state that finishes an episode.
        rng: State of the random bits, shape (1,), uint64, advanced in place.
        tally: Counts of steps, of finished episodes, and of episodes that ran out of steps or touched the scene, shape
            (3,), int64; added to.
        touches: Moves that touch the scene and end the episode, shape (n_states, 27), bool; (0, 27) without a scene.
    """
    nx, ny, nz = shape[0], shape[1], shape[2]
    slips = np.uint64(slip * 4294967296.0)
    random = rng[0]
    in_scene = len(touches) > 0
    episodes = nx * ny * nz * 27
    for episode in range(episodes):
        state = (first + episode) % episodes // 27
        action = np.int64((first + episode) % 27)
        finished = False
        for step in range(max_steps):
            if step > 0:
                random = next_random(random)
                action = np.int64(any_action(random))
            slipped = False
            if slips > NONE:
                random = next_random(random)
                slipped = random >> HALF < slips
            made = np.int64(any_action(random)) if slipped else action
            x = state // (ny * nz) + made // 9 - 1
            y = state // nz % ny + made // 3 % 3 - 1
            z = state % nz + made % 3 - 1
            tally[0] += 1
            if in_scene and touches[state, made]:
                model[state, action] = TOUCHED
                break
            if x >= 0 and x < nx and y >= 0 and y < ny and z >= 0 and z < nz:
                after = (x * ny + y) * nz + z
                model[state, action] = after
                state = after
                finished = after == goal
            else:
                model[state, action] = state if slipped else OFF_GRID
            if finished:
                break
        tally[1] += finished
        tally[2] += not finished
    rng[0] = random


def sweep(
    q: Any,
    value: Any,
    model: Any,
    states: Any,
    live: Any,
    stays: Any,
    worth: Any,
    first: int,
    last: int,
    backwards: bool,
    entering: Any,
    off_grid: float,
    touched: float,
    alpha: float,
    gamma: float,
    tolerance: float,
) -> Any:
    """Apply Eq. 1 once to every action of a phase that was tried.

    Args:
        q: Q values, shape (rows, 27), float64, learnt in place.
        value: The largest Q value of each row, shape (rows,), float64, kept up to date.
        model: The state that each action led to, as `explore` records it, shape (n_states, 27), int32.
        states: The state of each row, shape (rows,), int64.
        live: Whether Q values are learnt in each row, shape (rows,), bool.
        stays: Whether the phase stays the same on entering the row's state, shape (rows,), bool.
        worth: Reward and discounted value of entering each state in the phase, shape (n_states,), float64, updated.
        first: First row of the phase.
        last: Last row of the phase, exclusive.
        backwards: Whether rows are processed from the last to the first.
        entering: The reward for entering each state without a change of phase, shape (n_states,), float64.
        off_grid: The reward of a move off the grid.
        touched: The reward of touching the scene.
        alpha: Learning rate.
        gamma: Discount.
        tolerance: Relative change up to which a Q value counts as unchanged.

    Returns:
        The number of Q values whose relative change was greater than the tolerance.
    """
    changed = 0
    for i in range(last - first):
        row = last - 1 - i if backwards else first + i
        if not live[row]:
            continue
        state = states[row]
        top = -np.inf
        for action in range(27):
            to = model[state, action]
            new = q[row, action]
            if to != UNKNOWN:
                target = off_grid + gamma * value[row]
                if to >= 0:
                    target = worth[to]
                elif to == TOUCHED:
                    target = touched
                old = new
                new = (1 - alpha) * old + alpha * target
                q[row, action] = new
                if abs(new - old) > tolerance * abs(new):
                    changed += 1
            if new > top:
                top = new
        value[row] = top
        if stays[row]:
            worth[state] = entering[state] + gamma * top
    return changed


def settle(
    best: Any,
    worth: Any,
    rewards: Any,
    stays: Any,
    shape: Any,
    goal: int,
    off_grid: float,
    gamma: float,
    tolerance: float,
    max_sweeps: int,
) -> Any:
    """Iterate values over the grid, forwards and backwards in turn, until no relative change is above the tolerance.

    Args:
        best: The value of the best move in each state, shape (n_states,), float64, iterated in place.
        worth: Reward and discounted value of entering each state, shape (n_states,), float64, updated.
        rewards: The reward for entering each state, shape (n_states,), float64.
        stays: Whether entering a state neither changes the phase nor finishes, shape (n_states,), bool.
        shape: Number of cells along each axis, shape (3,), int64.
        goal: The state that finishes, whose value is not iterated; -1 if there is none.
        off_grid: The reward of a move off the grid.
        gamma: Discount.
        tolerance: Relative change up to which a value counts as unchanged.
        max_sweeps: Most sweeps; forwards and backwards count as two.

    Returns:
        True if the values settled within `max_sweeps`.
    """
    nx, ny, nz = shape[0], shape[1], shape[2]
    for number in range(max_sweeps):
        changed = 0
        for i in range(len(best)):
            state = i if number % 2 == 0 else len(best) - 1 - i
            if state == goal:
                continue
            x = state // (ny * nz)
            y = state // nz % ny
            z = state % nz
            top = -np.inf
            if x == 0 or y == 0 or z == 0 or x == nx - 1 or y == ny - 1 or z == nz - 1:
                top = off_grid + gamma * best[state]
            for to_x in range(max(x - 1, 0), min(x + 2, nx)):
                for to_y in range(max(y - 1, 0), min(y + 2, ny)):
                    for to_z in range(max(z - 1, 0), min(z + 2, nz)):
                        there = worth[(to_x * ny + to_y) * nz + to_z]
                        if there > top:
                            top = there
            if not abs(top - best[state]) <= tolerance * abs(top):
                changed += 1
            best[state] = top
            if stays[state]:
                worth[state] = rewards[state] + gamma * top
        if changed == 0:
            return True
    return False


def spread_distances(
    distance: Any,
) -> None:
    """Count the fewest moves from each cell (Chebyshev), in one pass forwards and one back (Rosenfeld and Pfaltz 1966).

    Args:
        distance: Shape (nx, ny, nz), int64: 0 at the cells to measure from, elsewhere at least the longest distance;
            changed in place.
    """
    nx, ny, nz = distance.shape
    for way in range(2):
        for i in range(nx):
            x = i if way == 0 else nx - 1 - i
            for j in range(ny):
                y = j if way == 0 else ny - 1 - j
                for k in range(nz):
                    z = k if way == 0 else nz - 1 - k
                    fewest = distance[x, y, z]
                    for to_x in range(max(x - 1, 0), min(x + 2, nx)):
                        for to_y in range(max(y - 1, 0), min(y + 2, ny)):
                            for to_z in range(max(z - 1, 0), min(z + 2, nz)):
                                fewest = min(fewest, distance[to_x, to_y, to_z] + 1)
                    distance[x, y, z] = fewest


def spread_worth(
    best: Any,
    worth: Any,
    given: Any,
    step: int,
) -> None:
    """Spread the worth of given cells over a grid, forwards and backwards in turn, until nothing changes.

    Each move adds `step`, which is negative, so that every cell ends with the best way to a given cell; a way ends at
    the first given cell that it enters. Integers, so that equally good ways are equal.

    Args:
        best: The worth of the best move in each cell, at first less than any, shape (nx, ny, nz), int64; changed in
            place.
        worth: That of entering each cell, at first less than any but at the given cells, shape (nx, ny, nz), int64;
            changed in place.
        given: Cells whose worth is given and does not change, shape (nx, ny, nz), bool.
        step: Change of the worth with each move, below 0.
    """
    nx, ny, nz = best.shape
    changed = True
    while changed:
        changed = False
        for way in range(2):
            for i in range(nx):
                x = i if way == 0 else nx - 1 - i
                for j in range(ny):
                    y = j if way == 0 else ny - 1 - j
                    for k in range(nz):
                        z = k if way == 0 else nz - 1 - k
                        top = best[x, y, z]
                        for to_x in range(max(x - 1, 0), min(x + 2, nx)):
                            for to_y in range(max(y - 1, 0), min(y + 2, ny)):
                                for to_z in range(max(z - 1, 0), min(z + 2, nz)):
                                    top = max(top, worth[to_x, to_y, to_z])
                        if top > best[x, y, z]:
                            best[x, y, z] = top
                            changed = True
                            if not given[x, y, z]:
                                worth[x, y, z] = top + step


def sum_around(
    numbers: Any,
    powers: Any,
    total: Any,
    total_powers: Any,
) -> None:
    """Add up each cell of a grid and its neighbours, at most 27 numbers, each times a power of two.

    Args:
        numbers: Not negative, shape (nx, ny, nz), float64; all but 0 of the same size within a few powers of two.
        powers: The power of two of each, shape (nx, ny, nz), int32.
        total: The sums, shape (nx, ny, nz), float64: 0, or from 1 to below 2.
        total_powers: The power of two of each, shape (nx, ny, nz), int32; 0 for a sum of 0.
    """
    nx, ny, nz = numbers.shape
    for x in range(nx):
        for y in range(ny):
            for z in range(nz):
                added, top = 0.0, 0
                for to_x in range(max(x - 1, 0), min(x + 2, nx)):
                    for to_y in range(max(y - 1, 0), min(y + 2, ny)):
                        for to_z in range(max(z - 1, 0), min(z + 2, nz)):
                            number, power = numbers[to_x, to_y, to_z], powers[to_x, to_y, to_z]
                            if number == 0.0:
                                continue
                            if added == 0.0 or power - top >= len(HALVES):
                                added, top = number, power
                            elif power > top:
                                added, top = added * HALVES[power - top] + number, power
                            elif top - power < len(HALVES):
                                added += number * HALVES[top - power]
                while added >= 2.0:
                    added, top = 0.5 * added, top + 1
                while 0.0 < added < 1.0:
                    added, top = 2.0 * added, top - 1
                total[x, y, z] = added
                total_powers[x, y, z] = top


def find_equal(
    q: Any,
    tie: float,
    value: Any,
    equal: Any,
) -> None:
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


def choose_ways(
    actions: Any,
    length: Any,
    deepest: Any,
    joined: Any,
    ends: Any,
    order: Any,
    equal: Any,
    depth: Any,
    phase_of: Any,
    offset: Any,
    size: Any,
) -> None:
    """Choose of each row's best actions the one with the shortest, then shallowest, then earliest joining way.

    Args:
        actions: The action of each row, 0 to 26, shape (rows,), int64, filled.
        length: The way left on entering each row, in units of `STEPS`, shape (rows,), int64: at first 0 at ends, else
            `NEVER`; filled.
        deepest: The greatest depth on that way, with that of the row, shape (rows,), int64: at first that alone;
            filled.
        joined: The waypoint at which that way ends, shape (rows,), int64: at first that of ends; filled.
        ends: Whether a way ends on entering each row, shape (rows,), bool.
        order: The rows that have an action, shape (N,), int64; one pass is enough if every way goes backwards in it.
        equal: The best actions of each row, a bit for each, shape (rows,), int32, as `find_equal` fills them.
        depth: The depth of each row's cell, shape (rows,), int64.
        phase_of: The phase of each row, shape (rows,), int64.
        offset: The first row of each phase, and the number of rows, shape (P + 1,), int64.
        size: The cells of each phase's box along each axis, shape (P, 3), int64.
    """
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


def count_off_rule(
    rows: Any,
    actions: Any,
    worth: Any,
    tie: Any,
    length: Any,
    deepest: Any,
    joined: Any,
    ends: Any,
    phase_of: Any,
    offset: Any,
    size: Any,
) -> Any:
    """Count the rows in which an action that is as good leads to a better way, or to an equal one at a lower index.

    Args:
        rows: The rows to check, shape (N,), int64.
        actions: The action of each row, shape (rows,), int64.
        worth: Reward and discounted value of entering each row from its phase, shape (rows,), float64.
        tie: The difference up to which two actions of each row are equally good, shape (rows,), float64.
        length: The way left on entering each row by these actions, in units of `STEPS`, shape (rows,), int64; `NEVER`
            if it does not end.
        deepest: The greatest depth on that way, with that of the row, shape (rows,), int64.
        joined: The waypoint at which that way ends, shape (rows,), int64.
        ends: Whether a way ends on entering each row, shape (rows,), bool.
        phase_of: The phase of each row, shape (rows,), int64.
        offset: The first row of each phase, and the number of rows, shape (P + 1,), int64.
        size: The cells of each phase's box along each axis, shape (P, 3), int64.

    Returns:
        The number of rows, with those whose own way never ends.
    """
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


def warp(distance: Any, cost: Any) -> None:
    """Fill the table of accumulated costs of dynamic time warping.

    Args:
        distance: Distance of each pair of points, shape (T, R).
        cost: Shape (T + 1, R + 1), infinite at the edges and 0 at [0, 0]; filled in place.
    """
    for i in range(distance.shape[0]):
        for j in range(distance.shape[1]):
            cost[i + 1, j + 1] = distance[i, j] + min(cost[i, j], cost[i, j + 1], cost[i + 1, j])


def tell_apart(
    bits: Any,
    found: Any,
    places: Any,
    slots: Any,
    shift: Any,
) -> Any:
    """Find the distinct numbers of an array, compared bit by bit, and the index of each element among them.

    Args:
        bits: The bits of the numbers, shape (N,), uint64.
        found: The distinct numbers in order of first appearance, shape (F,), uint64, filled.
        places: Index of each number in `found`, shape (N,), uint8, filled.
        slots: Hash table of indices in `found`, with linear probing: shape (2^k,), int16, more than F and all -1;
            changed in place.
        shift: 64 - k, uint64.

    Returns:
        The number of distinct numbers; -1 if they are more than `found` has room for.
    """
    last_slot = np.uint64(len(slots) - 1)
    count = 0
    which = np.int64(-1)
    before = NONE
    for i in range(len(bits)):
        number = bits[i]
        if number != before or which < 0:  # equal numbers are mostly adjacent, so the table is rarely searched
            before = number
            slot = (number * SCATTER) >> shift
            which = np.int64(slots[slot])
            while which >= 0 and found[which] != number:
                slot = (slot + ONE) & last_slot
                which = np.int64(slots[slot])
            if which < 0:
                if count == len(found):
                    return -1
                which = np.int64(count)
                slots[slot] = which
                found[which] = number
                count += 1
        places[i] = which
    return count


@inner
def angle_between(a: Any, i: Any, b: Any, j: Any) -> Any:
    """Return the angle between the orientations of row i of `a` and row j of `b`, unit quaternions, in rad.

    Args:
        a: Quaternions x, y, z, w, shape (N, 4).
        i: Index of a row of `a`.
        b: Quaternions x, y, z, w, shape (M, 4).
        j: Index of a row of `b`.

    Returns:
        The angle, 0 to pi; q and -q are the same orientation.
    """
    w = a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2] + a[i, 3] * b[j, 3]
    x = a[i, 3] * b[j, 0] - a[i, 0] * b[j, 3] - a[i, 1] * b[j, 2] + a[i, 2] * b[j, 1]
    y = a[i, 3] * b[j, 1] + a[i, 0] * b[j, 2] - a[i, 1] * b[j, 3] - a[i, 2] * b[j, 0]
    z = a[i, 3] * b[j, 2] - a[i, 0] * b[j, 1] + a[i, 1] * b[j, 0] - a[i, 2] * b[j, 3]
    return 2.0 * atan2(sqrt(x * x + y * y + z * z), abs(w))


@inner
def distance_between(a: Any, i: Any, b: Any, j: Any) -> Any:
    """Return the distance between the positions of row i of `a` and row j of `b`, in mm.

    Args:
        a: Positions in mm, shape (N, 3).
        i: Index of a row of `a`.
        b: Positions in mm in the same frame, shape (M, 3).
        j: Index of a row of `b`.
    """
    x, y, z = b[j, 0] - a[i, 0], b[j, 1] - a[i, 1], b[j, 2] - a[i, 2]
    return sqrt(x * x + y * y + z * z)


def step_along(
    path_mm: Any,
    path_xyzw: Any,
    tip_mm: Any,
    rotation_xyzw: Any,
    phases: Any,
    off: Any,
    step_mm: float,
    step_rad: float,
    ahead: int,
) -> None:
    """Make one tick of runs along a path, as `skills.learning.tube` describes it.

    Args:
        path_mm: Positions of the path, shape (N, 3), float64.
        path_xyzw: Its orientations, unit quaternions, shape (N, 4), float64.
        tip_mm: The positions reached, in the same frame, shape (R, 3), float64, replaced by the commanded ones.
        rotation_xyzw: The orientations reached, unit quaternions, shape (R, 4), float64, replaced likewise.
        phases: The phases before the tick, shape (R,), int64, replaced by those after it.
        off: Distance in mm and angle in rad from the pose of the phase before the tick, shape (R, 2), float64, filled.
        step_mm: Longest step of the position in a tick.
        step_rad: Largest turn in a tick.
        ahead: Phases that one tick may advance.
    """
    last = len(path_mm) - 1
    for run in range(len(phases)):
        phase = phases[run]
        off_mm = distance_between(tip_mm, run, path_mm, phase)
        off_rad = angle_between(rotation_xyzw, run, path_xyzw, phase)
        off[run, 0], off[run, 1] = off_mm, off_rad
        there = min(phase + ahead, last)
        while there > phase and not (
            distance_between(tip_mm, run, path_mm, there) <= step_mm
            and angle_between(rotation_xyzw, run, path_xyzw, there) <= step_rad
        ):
            there -= 1
        if there > phase or (off_mm <= step_mm and off_rad <= step_rad):
            # A pose that is reached is commanded exactly, without the rounding of a step towards it.
            for axis in range(3):
                tip_mm[run, axis] = path_mm[there, axis]
            for axis in range(4):
                rotation_xyzw[run, axis] = path_xyzw[there, axis]
            phases[run] = there
            continue
        share = step_mm / max(off_mm, step_mm)
        for axis in range(3):
            tip_mm[run, axis] += share * (path_mm[phase, axis] - tip_mm[run, axis])
        # The quaternion on the shorter way, at a share of its angle (Shoemake, Animating Rotation, 1985).
        share, half = step_rad / max(off_rad, step_rad), off_rad / 2.0
        dot = 0.0
        for axis in range(4):
            dot += rotation_xyzw[run, axis] * path_xyzw[phase, axis]
        whole = sin(half)
        stay, go = 1.0 - share, share
        if whole > SMALLEST_SINE:
            stay, go = sin((1.0 - share) * half) / whole, sin(share * half) / whole
        if dot < 0.0:
            go = -go
        length = 0.0
        for axis in range(4):
            rotation_xyzw[run, axis] = stay * rotation_xyzw[run, axis] + go * path_xyzw[phase, axis]
            length += rotation_xyzw[run, axis] * rotation_xyzw[run, axis]
        length = sqrt(length)
        for axis in range(4):
            rotation_xyzw[run, axis] /= length


def nearest_pose(
    path_mm: Any,
    path_xyzw: Any,
    tip_mm: Any,
    rotation_xyzw: Any,
    start_mm: float,
    start_rad: float,
) -> Any:
    """Return the index of the nearest pose, by the larger of distance over `start_mm` and angle over `start_rad`.

    Args:
        path_mm: Positions of the path, shape (N, 3), float64.
        path_xyzw: Its orientations, unit quaternions, shape (N, 4), float64.
        tip_mm: A position in the same frame, shape (1, 3), float64.
        rotation_xyzw: An orientation, a unit quaternion, shape (1, 4), float64.
        start_mm: The distance that counts as much as an angle of `start_rad`, above 0.
        start_rad: That angle, above 0.

    Returns:
        The index, the first of equally near ones.
    """
    nearest, best = 0, -1.0
    for phase in range(len(path_mm)):
        off_mm = distance_between(tip_mm, 0, path_mm, phase) / start_mm
        off = max(off_mm, angle_between(rotation_xyzw, 0, path_xyzw, phase) / start_rad)
        if best < 0.0 or off < best:
            nearest, best = phase, off
    return nearest


run_episodes_compiled = compiled(run_episodes)
explore_compiled = compiled(explore)
sweep_compiled = compiled(sweep)
settle_compiled = compiled(settle)
spread_distances_compiled = compiled(spread_distances)
spread_worth_compiled = compiled(spread_worth)
sum_around_compiled = compiled(sum_around)
find_equal_compiled = compiled(find_equal)
choose_ways_compiled = compiled(choose_ways)
count_off_rule_compiled = compiled(count_off_rule)
warp_compiled = compiled(warp)
tell_apart_compiled = compiled(tell_apart)
step_along_compiled = compiled(step_along)
nearest_pose_compiled = compiled(nearest_pose)
