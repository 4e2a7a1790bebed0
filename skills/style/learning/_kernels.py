"""The compiled loops: ordinary Python first, compiled by numba where it is called `*_compiled`.

Arrays and numbers in, nothing allocated, nothing raised. The plain function and the compiled one agree to the last
bit; a test says so. This is the only file that knows numba.

Random bits come from xorshift64 (Marsaglia 2003), whose state is one uint64 that is not 0; an action is drawn from the
low half of 64 bits, and whether to explore from the high half.
"""

from typing import Any

import numpy as np
from numba import njit
from numba.extending import register_jitable

UNKNOWN, OFF_GRID = -2, -1  # in a model: never tried; would leave the grid, and stays


@register_jitable
def next_random(rng: Any) -> Any:
    """Draw 64 random bits; `rng` is the generator's state, (1,) uint64."""
    x = rng[0]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    rng[0] = x
    return x


@register_jitable
def any_action(bits: Any) -> Any:
    """Turn random bits into one of the 27 actions."""
    return np.int64(((bits & np.uint64(0xFFFFFFFF)) * np.uint64(27)) >> np.uint64(32))


def run_episodes(
    q: Any,  # (n_states * 27,) float64, learnt in place
    value: Any,  # (n_states,) float64: the largest Q value of each state, kept up to date
    best: Any,  # (n_states,) int8: its action, the first of equals
    rewards: Any,  # (n_states,) float64: Algorithm 1
    shape: Any,  # (3,) int64
    starts: Any,  # (E,) int64: the state that each episode starts in
    epsilons: Any,  # (E,) float64: its exploration
    off_grid: float,  # the reward of a move off the grid
    alpha: float,
    gamma: float,
    max_steps: int,
    goal: int,
    rng: Any,
    tally: Any,  # (3,) int64: steps taken, episodes that finished, episodes that ran out of steps
) -> None:
    """Learn in the paper's cell state by Eq. 1, one episode for each start."""
    nx, ny, nz = shape[0], shape[1], shape[2]
    for episode in range(len(starts)):
        state = starts[episode]
        x = state // (ny * nz)
        y = state // nz % ny
        z = state % nz
        explores = np.uint64(epsilons[episode] * 4294967296.0)
        finished = False
        for _ in range(max_steps):
            bits = next_random(rng)
            action = any_action(bits) if bits >> np.uint64(32) < explores else np.int64(best[state])
            a = action // 9
            b = (action - 9 * a) // 3
            to_x = x + a - 1
            to_y = y + b - 1
            to_z = z + action - 9 * a - 3 * b - 1
            after = state
            if to_x >= 0 and to_x < nx and to_y >= 0 and to_y < ny and to_z >= 0 and to_z < nz:
                x, y, z = to_x, to_y, to_z
                after = (x * ny + y) * nz + z
                target = rewards[after]
                finished = after == goal
                if not finished:
                    target += gamma * value[after]
            else:
                target = off_grid + gamma * value[state]
            row = state * 27
            new = (1 - alpha) * q[row + action] + alpha * target
            q[row + action] = new
            if new > value[state]:
                value[state] = new
                best[state] = action
            elif action == best[state] and new < value[state]:
                top = 0
                for other in range(1, 27):
                    if q[row + other] > q[row + top]:
                        top = other
                best[state] = top
                value[state] = q[row + top]
            elif new == value[state] and action < best[state]:
                best[state] = action
            state = after
            tally[0] += 1
            if finished:
                break
        tally[1] += finished
        tally[2] += not finished


def explore(
    model: Any,  # (n_states, 27) int32: the state that each action led to, `OFF_GRID` or `UNKNOWN`
    shape: Any,  # (3,) int64
    starts: Any,  # (E,) int64: the state that each episode starts in, times 27, plus its first action
    max_steps: int,
    goal: int,
    rng: Any,
    tally: Any,  # as for `run_episodes`
) -> None:
    """Move about in the grid and remember where each action led, one episode for each start."""
    nx, ny, nz = shape[0], shape[1], shape[2]
    for episode in range(len(starts)):
        state = starts[episode] // 27
        action = starts[episode] % 27
        finished = False
        for step in range(max_steps):
            if step > 0:
                action = any_action(next_random(rng))
            x = state // (ny * nz) + action // 9 - 1
            y = state // nz % ny + action // 3 % 3 - 1
            z = state % nz + action % 3 - 1
            tally[0] += 1
            if x >= 0 and x < nx and y >= 0 and y < ny and z >= 0 and z < nz:
                after = (x * ny + y) * nz + z
                model[state, action] = after
                state = after
                finished = after == goal
            else:
                model[state, action] = OFF_GRID
            if finished:
                break
        tally[1] += finished
        tally[2] += not finished


def sweep(
    q: Any,  # (rows, 27) float64, learnt in place
    value: Any,  # (rows,) float64: the largest Q value of each row
    model: Any,  # as for `explore`
    cells: Any,  # (n_states, 3) int64
    rewards: Any,  # (n_states,) float64: Algorithm 1
    joins: Any,  # (n_states,) int64: the phase that entering a state in phase 0 leads to, 0: it stays
    waypoints: Any,  # (P, 3) int64
    low: Any,
    size: Any,
    offset: Any,  # the boxes of the domain's phases: see `skills.style.domain`
    states: Any,  # (rows,) int64: the state of each row
    live: Any,  # (rows,) bool: whether anything is to be learnt in it
    phase: int,
    backwards: bool,  # whether rows are taken from the last one to the first
    levels: Any,  # (4,) float64: goal, visited, other, off_grid
    alpha: float,
    gamma: float,
    goal: int,
    reach: int,  # Chebyshev radius of the domain of a phase above 0
    tolerance: float,
) -> Any:
    """Apply Eq. 1 once to every action that was tried in a phase: how many Q values changed, relatively, by more."""
    changed = 0
    last = len(low) - 1
    first = offset[phase]
    count = offset[phase + 1] - first
    for i in range(count):
        row = first + (count - 1 - i if backwards else i)
        if not live[row]:
            continue
        top = -np.inf
        for action in range(27):
            to = model[states[row], action]
            if to == UNKNOWN:
                top = max(top, q[row, action])
                continue
            after = phase
            ends = False
            if to == OFF_GRID:
                reward = levels[3]
                going_on = value[row]
            else:
                x, y, z = cells[to, 0], cells[to, 1], cells[to, 2]
                if phase == 0:
                    reward = rewards[to]
                    ends = to == goal
                    if joins[to] > 0:
                        after = joins[to]
                else:
                    reward = levels[2]
                    ahead = max(
                        abs(x - waypoints[phase, 0]), abs(y - waypoints[phase, 1]), abs(z - waypoints[phase, 2])
                    )
                    behind = max(
                        abs(x - waypoints[phase - 1, 0]),
                        abs(y - waypoints[phase - 1, 1]),
                        abs(z - waypoints[phase - 1, 2]),
                    )
                    if ahead == 0 and phase == last:
                        reward = levels[0]
                        ends = True
                    elif ahead == 0:
                        reward = levels[1]
                        after = phase + 1
                    elif ahead > reach and behind > reach:
                        ends = True  # beyond the domain nothing is promised
                going_on = 0.0
                if not ends:
                    at = ((x - low[after, 0]) * size[after, 1] + y - low[after, 1]) * size[after, 2]
                    going_on = value[offset[after] + at + z - low[after, 2]]
            old = q[row, action]
            new = (1 - alpha) * old + alpha * (reward + gamma * going_on)
            q[row, action] = new
            top = max(top, new)
            if abs(new - old) > tolerance * abs(new):
                changed += 1
        value[row] = top
    return changed


def warp(distance: Any, cost: Any) -> None:
    """Fill `cost`, (T + 1, R + 1) with infinite edges and cost[0, 0] = 0, for dynamic time warping."""
    for i in range(distance.shape[0]):
        for j in range(distance.shape[1]):
            cost[i + 1, j + 1] = distance[i, j] + min(cost[i, j], cost[i, j + 1], cost[i + 1, j])


run_episodes_compiled = njit(nogil=True, cache=True)(run_episodes)
explore_compiled = njit(nogil=True, cache=True)(explore)
sweep_compiled = njit(nogil=True, cache=True)(sweep)
warp_compiled = njit(nogil=True, cache=True)(warp)
