"""Small named grid paths, seeded random ones, and a client that knows the policy's rules from their text alone."""

from functools import cache

import numpy as np

from skills.gridworld.grid import MOVES, GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.learning.policy import Policy, learn_tabular
from skills.learning.q_learning import CellQLearning, PhaseQLearning

# Each is a walk through whole cells; the grid has one cell of room on every side.
WALKS = {
    "an angle": "AAABBB",
    "closed": "AABBaabb",
    "through its goal": "AABBaabbA",
    "again and again through its goal": "BBbAaBbCcBBbb",
    "to and fro": "AaAaAaAaBB",
    "a figure of eight": "AABBaabbABABaabb",
    "from its goal through its goal": "ACcaBCcb",
    "two cells": "A",
}
STEPS = {
    letter: np.eye(3, dtype=int)["ABC".index(letter.upper())] * (1 if letter.isupper() else -1) for letter in "ABCabc"
}


@cache
def named_path(name: str) -> GridPath:
    """Return one of `WALKS`: A, B and C are a cell along x, y and z, a, b and c one back."""
    cells = np.cumsum([np.zeros(3, int), *(STEPS[letter] for letter in WALKS[name])], axis=0)
    cells -= cells.min(axis=0) - 1
    x, y, z = (int(n) for n in cells.max(axis=0) + 2)
    grid = GridWorld((-10.0, 20.0, -130.0), 5.0, (x, y, z))
    return GridPath(grid, grid.states_of(cells))


@cache
def learnt(name: str, *, phased: bool = True, join_share: float = 0.0) -> Policy:
    """Learn one of `WALKS` with the defaults, and with a joining rule in the phase state."""
    learner = PhaseQLearning(join_share=join_share) if phased else CellQLearning()
    return learn_tabular(sparse_reward(named_path(name)), learner, seed=0)


def random_path(seed: int) -> GridPath:
    """Return a path that revisits cells: closed, early through its goal, back and forth, or closed through its goal."""
    rng = np.random.default_rng(seed)
    nx, ny, nz = (int(n) for n in rng.integers((3, 3, 1), (8, 8, 7)))
    grid = GridWorld((0.0, 0.0, 0.0), 5.0, (nx, ny, nz))
    there = _wander(rng, grid, rng.integers(0, grid.shape), int(rng.integers(4, 20)))
    more = _wander(rng, grid, there[-1], int(rng.integers(4, 20)))
    middle = there[len(there) // 2]
    cells = {
        0: [*there, *_straight(there[-1], there[0])],  # closed: starts at its goal
        1: [*there, *more[1:], *_straight(more[-1], middle)],  # crosses its goal early
        2: [*there, *[there[-2], there[-1]] * 4, *more[1:]],  # back and forth between two cells, and on
        3: [*there, *_straight(there[-1], there[0]), *more[::-1], *more[1:], *_straight(more[-1], there[0])],
    }[seed % 4]
    states = grid.states_of(_without_gaps(cells))
    return GridPath(grid, states) if len(np.unique(states)) < len(states) else random_path(seed + 1000)


def _wander(rng: np.random.Generator, grid: GridWorld, cell: np.ndarray, moves: int) -> list[np.ndarray]:
    cells = [cell]
    while len(cells) <= moves:
        after = cells[-1] + MOVES[rng.integers(27)]
        if grid.holds(after) and (after != cells[-1]).any():
            cells.append(after)
    return cells


def _straight(a: np.ndarray, b: np.ndarray) -> list[np.ndarray]:
    """Return the cells from a to b, without a."""
    cells = []
    while (a != b).any():
        a = a + np.sign(b - a)
        cells.append(a)
    return cells


def _without_gaps(cells: list[np.ndarray]) -> np.ndarray:
    """Join parts that do not touch, and drop consecutive repeats."""
    joined = cells[:1]
    for cell in cells[1:]:
        joined += _straight(joined[-1], cell)
    return np.array(joined)


def follow(
    actions: np.ndarray,
    shape: tuple[int, int, int],
    waypoints: list[int],
    start: int,
    joining: dict[int, int] | None = None,
) -> tuple[list[int], bool]:
    """Follow served actions, (phases, n_states), as the OpenAPI document describes: states, and whether it finishes.

    Written from that text alone. `joining` is the table of format 2, the phase by state.
    """
    phased, (_, ny, nz) = len(actions) > 1, shape
    goal = waypoints[-1] if joining is None else None  # at which an unjoined pass ends
    if joining is None:
        joining = {state: waypoints.index(state) + 1 for state in waypoints} if phased else {}
    phase = joining.get(start, 0)
    state, states = start, [start]
    if phase == len(waypoints):
        return states, True
    for _ in range(actions.size):
        action = int(actions[phase][state])
        if action < 0:
            return states, action == -1
        cell = (
            state // (ny * nz) + action // 9 - 1,
            state // nz % ny + action // 3 % 3 - 1,
            state % nz + action % 3 - 1,
        )
        if all(0 <= i < n for i, n in zip(cell, shape, strict=True)):
            state = (cell[0] * ny + cell[1]) * nz + cell[2]
            if phase == 0 and state == goal:
                return [*states, state], True
            if phase == 0:
                phase = joining.get(state, 0)
            elif phase > 0 and state == waypoints[phase]:
                if phase == len(waypoints) - 1:
                    return [*states, state], True
                phase += 1
        states.append(state)
    return states, False


def joins_nearest(path: GridPath, states: list[int], join_share: float = 0.0) -> bool:
    """Return whether a rollout meets the path in the fewest moves (Chebyshev) and then follows it to the end.

    It meets the path at the waypoints after which at least `join_share` of the path's moves are left.
    """
    waypoints = path.states.tolist()
    moves = len(waypoints) - 1
    first = sum((moves - i) / moves >= join_share for i in range(moves + 1))
    fewest = int(np.abs(path.cells[:first] - path.grid.cells_of(states[0])).max(axis=1).min())
    met = next((i for i, state in enumerate(states) if state in waypoints[:first]), None)
    if met is None or met != fewest:
        return False
    rest = states[met:]
    return rest == waypoints[waypoints.index(rest[0]) :] or (join_share == 0 and met > 0 and rest == [path.goal])


def share_of(path: GridPath, states: list[int], *, finished: bool) -> float:
    """Return the share of a path that a walk follows: the moves with which both end, over those of the path."""
    waypoints = path.states.tolist()
    if not finished:
        return 0.0
    alike = 0
    for one, other in zip(reversed(states), reversed(waypoints), strict=False):
        if one != other:
            break
        alike += 1
    return (alike - 1) / (len(waypoints) - 1)
