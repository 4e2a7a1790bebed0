"""Networks written by hand: what a learner beyond the table may leave behind, without torch."""

import numpy as np

from skills.style.grid import GridWorld
from skills.style.network import Network


def table_as_network(grid: GridWorld, q: np.ndarray) -> Network:
    """Write a table, (n_states, 27), as a network on the grid: a hidden unit for each cell, and for it alone."""
    shape, cells = np.array(grid.shape), grid.cells_of(np.arange(grid.n_states))
    weight = np.zeros((grid.n_states, shape.sum()))
    for axis, offset in enumerate(np.cumsum(shape) - shape):
        weight[np.arange(grid.n_states), offset + cells[:, axis]] = 1.0
    return Network.of([(weight, np.full(grid.n_states, -2.0)), (q.T, np.zeros(q.shape[1]))])


def always(step: tuple[float, float, float]) -> Network:
    """Answer with the same three numbers everywhere."""
    return Network.of([(np.zeros((3, 3)), step)])


def towards(scaled: tuple[float, float, float], gain: float = 10.0) -> Network:
    """Step towards a place, given as the space scales it."""
    return Network.of([(-gain * np.eye(3), gain * np.array(scaled))])
