"""Algorithm 1 of the paper: sparse rewards along the demonstrated path."""

from dataclasses import asdict, astuple, dataclass
from math import isfinite

import numpy as np

from skills.errors import BadSettings
from skills.style._arrays import Floats, frozen
from skills.style.grid import GridPath


@dataclass(frozen=True)
class RewardLevels:
    """What entering a state pays; the paper orders the levels, its authors' published code has these values."""

    goal: float = 10.0
    visited: float = 1.0
    other: float = 0.0
    off_grid: float = -1.0  # for a move off the grid, which stays where it is

    def __post_init__(self) -> None:
        for name, level in asdict(self).items():
            object.__setattr__(self, name, float(level))  # from an `other` of 0 numpy would make a map of whole numbers
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
        object.__setattr__(self, "rewards", frozen(self.rewards, np.float64, (self.path.grid.n_states,), "rewards"))


def sparse_reward(path: GridPath, levels: RewardLevels | None = None) -> RewardMap:
    """Reward the goal most, every visited state a little, and all others with the rest (Algorithm 1)."""
    levels = levels or RewardLevels()
    rewards = np.full(path.grid.n_states, levels.other)
    rewards[path.states] = levels.visited
    rewards[path.goal] = levels.goal  # last, because a path may cross its goal early
    return RewardMap(path, levels, rewards)
