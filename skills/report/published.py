"""The policies that the paper's authors published: a greedy action for each cell, without values."""

import numpy as np

from skills.style._arrays import Ints
from skills.style.grid import MOVES, GridPath
from skills.style.policy import Rollout


def follow(actions: Ints, path: GridPath, start: int) -> Rollout:
    """Follow a published policy from a state to the path's goal; it stops unfinished where it comes back to a state."""
    after = steps_of(actions, path)
    states = [start]
    while states[-1] != path.goal and states[-1] not in states[:-1]:
        states.append(int(after[states[-1]]))
    return Rollout(path, np.array(states), np.zeros(len(states), np.int64), finished=states[-1] == path.goal)


def starts_reaching(actions: Ints, path: GridPath) -> int:
    """Count the states from which a published policy reaches the path's goal."""
    after = steps_of(actions, path)
    for _ in range(len(after).bit_length()):
        after = after[after]  # twice as far
    return int(np.count_nonzero(after == path.goal))


def steps_of(actions: Ints, path: GridPath) -> Ints:
    """Find the state after each state, (n_states,); at the goal and at the edge of the grid one stays."""
    grid, here = path.grid, np.arange(path.grid.n_states)
    cells = grid.cells_of(here) + MOVES[actions]
    on_grid = grid.holds(cells)
    after = here.copy()
    after[on_grid] = grid.states_of(cells[on_grid])
    after[path.goal] = path.goal
    return after
