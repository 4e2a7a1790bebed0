"""The compiled loops: ordinary Python first, compiled by numba where it is called `*_compiled`.

Arrays and numbers in, nothing allocated, nothing raised. The plain function and the compiled one agree to the last
bit; a test says so. This is the only file that knows numba.

A *row* numbers one (phase, cell) of the certified domain: phase p owns the box of cells from `low[p]` of size
`size[p]`, and its rows start at `offset[p]` (see `skills.style.domain`).
"""

from typing import Any

import numpy as np
from numba import njit
from numba.extending import register_jitable

_HIGH_53 = 1.0 / 9007199254740992.0  # 2^-53


@register_jitable
def next_random(rng: Any) -> Any:
    """Draw 64 random bits: xorshift64 (Marsaglia 2003); `rng` is its state, one uint64 that is not 0."""
    x = rng[0]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    rng[0] = x
    return x


@register_jitable
def best_action(q: Any, row: int) -> int:
    """Find the action of the largest Q value of a row, the first of equals."""
    best = 0
    for action in range(1, 27):
        if q[row, action] > q[row, best]:
            best = action
    return best


def run_episodes(
    q: Any,  # (rows, 27) float64, learnt in place
    rewards: Any,  # (n_states,) float64: Algorithm 1
    joins: Any,  # (n_states,) int64: the phase that entering a state in phase 0 leads to; all 0 in the cell state
    waypoints: Any,  # (P, 3) int64
    low: Any,
    size: Any,
    offset: Any,  # the domain's boxes, see above
    shape: Any,  # (3,) int64
    starts: Any,  # (E, 3) int64: phase, state and first action of each episode; action -1: any
    levels: Any,  # (4,) float64: goal, visited, other, off_grid
    alpha: float,
    gamma: float,
    epsilons: Any,  # (E,) float64: exploration of each episode after its first action
    max_steps: int,
    goal: int,
    reach: int,  # Chebyshev radius of the domain of a phase above 0
    rng: Any,  # (1,) uint64
    tally: Any,  # (3,) int64: steps taken, episodes that finished, episodes that ran out of steps
) -> None:
    """Learn by Eq. 1 of the paper, one episode for each row of `starts`."""
    ny, nz = shape[1], shape[2]
    phases = len(low)
    for episode in range(len(starts)):
        phase = starts[episode, 0]
        x = starts[episode, 1] // (ny * nz)
        y = starts[episode, 1] // nz % ny
        z = starts[episode, 1] % nz
        action = starts[episode, 2]
        running = True
        steps = 0
        while running:
            row = offset[phase] + ((x - low[phase, 0]) * size[phase, 1] + y - low[phase, 1]) * size[phase, 2]
            row += z - low[phase, 2]
            if action < 0:
                if (next_random(rng) >> np.uint64(11)) * _HIGH_53 >= epsilons[episode]:
                    action = best_action(q, row)
                else:
                    action = np.int64(((next_random(rng) >> np.uint64(32)) * np.uint64(27)) >> np.uint64(32))
            to_x = x + action // 9 - 1
            to_y = y + action // 3 % 3 - 1
            to_z = z + action % 3 - 1
            after = phase
            finished = False
            left = False
            if to_x < 0 or to_y < 0 or to_z < 0 or to_x >= shape[0] or to_y >= ny or to_z >= nz:
                reward = levels[3]  # off the grid: stays, and enters nothing
                to_x, to_y, to_z = x, y, z
            elif phase == 0:
                state = (to_x * ny + to_y) * nz + to_z
                reward = rewards[state]
                finished = state == goal
                if joins[state] > 0:
                    after = joins[state]
            else:
                ahead = max(
                    abs(to_x - waypoints[phase, 0]), abs(to_y - waypoints[phase, 1]), abs(to_z - waypoints[phase, 2])
                )
                behind = max(
                    abs(to_x - waypoints[phase - 1, 0]),
                    abs(to_y - waypoints[phase - 1, 1]),
                    abs(to_z - waypoints[phase - 1, 2]),
                )
                finished = ahead == 0 and phase == phases - 1
                reward = levels[2]
                if finished:
                    reward = levels[0]
                elif ahead == 0:
                    reward = levels[1]
                    after = phase + 1
                left = ahead > reach and behind > reach
            target = reward
            if not (finished or left):  # beyond the goal and beyond the domain nothing is promised
                row_after = (
                    offset[after] + ((to_x - low[after, 0]) * size[after, 1] + to_y - low[after, 1]) * size[after, 2]
                )
                row_after += to_z - low[after, 2]
                target = reward + gamma * q[row_after, best_action(q, row_after)]
            q[row, action] += alpha * (target - q[row, action])
            steps += 1
            ended = finished or left or after != phase
            running = not ended and steps < max_steps
            tally[1] += finished
            tally[2] += not ended and not running
            phase = after
            x, y, z = to_x, to_y, to_z
            action = np.int64(-1)
        tally[0] += steps


def warp(distance: Any, cost: Any) -> None:
    """Fill `cost`, (T + 1, R + 1) with infinite edges and cost[0, 0] = 0, for dynamic time warping."""
    for i in range(distance.shape[0]):
        for j in range(distance.shape[1]):
            cost[i + 1, j + 1] = distance[i, j] + min(cost[i, j], cost[i, j + 1], cost[i + 1, j])


run_episodes_compiled = njit(nogil=True, cache=True)(run_episodes)
warp_compiled = njit(nogil=True, cache=True)(warp)
