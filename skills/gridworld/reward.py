"""Algorithm 1 of the paper: sparse rewards along the demonstrated path."""

from dataclasses import asdict, astuple, dataclass
from math import isfinite

import numpy as np

from skills.arrays import Floats, freeze
from skills.errors import BadSettings
from skills.fields import schema
from skills.gridworld.grid import GridPath


@schema
@dataclass(frozen=True)
class RewardLevels:
    """The rewards for entering a state; the paper orders them, the values are from its authors' published code.

    Attributes:
        goal: For the goal.
        visited: For a state that the demonstration visits.
        other: For any other state.
        off_grid: For a move off the grid, after which the arm stays in its cell.
    """

    goal: float = 10.0
    visited: float = 1.0
    other: float = 0.0
    off_grid: float = -1.0

    def __post_init__(self) -> None:
        for name, level in asdict(self).items():
            object.__setattr__(self, name, float(level))  # from an integer `other` numpy would make an integer map
        levels = astuple(self)
        if not (all(map(isfinite, levels)) and self.goal > self.visited > self.other >= self.off_grid):
            raise BadSettings(
                "Rewards must be finite and ordered goal > visited > other >= off_grid (Algorithm 1).", levels=levels
            )


@dataclass(frozen=True, eq=False)
class RewardMap:
    """The reward of every state of a path's grid world, `rewards` of shape (n_states,)."""

    path: GridPath
    levels: RewardLevels
    rewards: Floats

    def __post_init__(self) -> None:
        freeze(self, rewards=(self.path.grid.n_states,))


def sparse_reward(path: GridPath, levels: RewardLevels | None = None) -> RewardMap:
    """Return the rewards of Algorithm 1: most for the goal, a little for visited states, `other` for the rest.

    Args:
        path: The demonstrated path.
        levels: The rewards; None for the defaults.

    Returns:
        The reward of every state of the path's grid.
    """
    levels = levels or RewardLevels()
    rewards = np.full(path.grid.n_states, levels.other)
    rewards[path.states] = levels.visited
    rewards[path.goal] = levels.goal  # last, because a path may cross its goal early
    return RewardMap(path, levels, rewards)
