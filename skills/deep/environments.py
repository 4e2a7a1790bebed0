"""The grid world and its continuous space as Gymnasium environments, for any library that uses Gymnasium.

    gymnasium.make("skills.deep.environments:SutureGrid-v0", reward=sparse_reward(path))
    gymnasium.make("skills.deep.environments:SutureSpace-v0", reward=sparse_reward(path), gamma=0.95)

The rewards of the grid are those of Algorithm 1; those of the space are defined, with their reasons, in
`skills.learning.networks`. An episode starts anywhere but in the goal's cell, or at the position of
`options={"start_mm": (x, y, z)}`; it ends at the goal, or after the paper's 100 steps.
"""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from skills.gridworld import paper
from skills.gridworld.grid import MOVES
from skills.gridworld.reward import RewardMap
from skills.learning.networks import Space

GRID, SPACE = "SutureGrid-v0", "SutureSpace-v0"
Info = dict[str, Any]


class SutureGrid(gymnasium.Env[NDArray[np.int64], np.int64]):
    """The grid world of Sec. III-C: the observation is a cell, three integers, and the action one of the 27 moves."""

    def __init__(self, reward: RewardMap) -> None:
        path = reward.path
        self._grid, self._goal = path.grid, path.goal
        self._rewards, self._off_grid = reward.rewards.tolist(), reward.levels.off_grid
        self._cell = (0, 0, 0)
        self.observation_space = gymnasium.spaces.MultiDiscrete(path.grid.shape)
        self.action_space = gymnasium.spaces.Discrete(paper.N_ACTIONS)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[NDArray[np.int64], Info]:
        """Start an episode in a random cell or at `options["start_mm"]`; return the cell."""
        super().reset(seed=seed)
        if options and "start_mm" in options:
            state = int(self._grid.states_at(options["start_mm"]))
        else:
            state = int(self.np_random.integers(self._grid.n_states - 1))
            state += state >= self._goal  # a uniform draw of all states but the goal
        self._cell = tuple(self._grid.cells_of(state).tolist())
        return np.array(self._cell), {}

    def step(self, action: np.int64) -> tuple[NDArray[np.int64], float, bool, bool, Info]:
        """Make a move; a move off the grid stays in the cell."""
        (x, y, z), (nx, ny, nz) = self._cell, self._grid.shape
        dx, dy, dz = _MOVES[int(action)]
        x, y, z = x + dx, y + dy, z + dz
        if not (0 <= x < nx and 0 <= y < ny and 0 <= z < nz):
            return np.array(self._cell), self._off_grid, False, False, {}
        self._cell = (x, y, z)
        state = (x * ny + y) * nz + z
        return np.array(self._cell), self._rewards[state], state == self._goal, False, {}


class SutureSpace(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """The same without cells: the observation is a position in mm, the action a step of up to a cell on each axis."""

    def __init__(self, reward: RewardMap, gamma: float = 0.95) -> None:
        self._space, self._gamma = Space(reward.path, reward.levels), gamma
        low, high = (corner.astype(np.float32) for corner in (self._space.low_mm, self._space.high_mm))
        self._at_mm = self._space.low_mm
        self.observation_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[NDArray[np.float32], Info]:
        """Start an episode at a random position or at `options["start_mm"]`; return the position in mm."""
        super().reset(seed=seed)
        space = self._space
        if options and "start_mm" in options:
            self._at_mm = np.clip(np.asarray(options["start_mm"], float), space.low_mm, space.high_mm)
        else:
            self._at_mm = self.np_random.uniform(space.low_mm, space.high_mm)
            while space.arrived(self._at_mm):
                self._at_mm = self.np_random.uniform(space.low_mm, space.high_mm)
        return self._at_mm.astype(np.float32), {}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, Info]:
        """Make a step; at a face of the box it ends."""
        before, space = self._at_mm, self._space
        self._at_mm = space.moved(before, action)
        pays = space.pays(before[None], action[None], self._at_mm[None], self._gamma)
        return self._at_mm.astype(np.float32), float(pays[0]), bool(space.arrived(self._at_mm)), False, {}


_MOVES = MOVES.tolist()
gymnasium.register(GRID, SutureGrid, max_episode_steps=paper.MAX_STEPS)
gymnasium.register(SPACE, SutureSpace, max_episode_steps=paper.MAX_STEPS)
