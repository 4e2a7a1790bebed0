"""The data of the paper's study, which the project may not contain: found through SKILLS_PAPER_DATA, never copied."""

import os
from pathlib import Path

import numpy as np
import pytest

from skills.gridworld.grid import PAPER_GRID, GridPath, discretize
from skills.gridworld.reward import RewardMap, sparse_reward
from tests.needs import need


@pytest.fixture(scope="session")
def paper_data() -> Path:
    need("paper")
    folder = os.environ["SKILLS_PAPER_DATA"]
    assert Path(folder, "user_path_grid11.csv").is_file(), f"SKILLS_PAPER_DATA={folder} has no user_path_grid11.csv"
    return Path(folder)


@pytest.fixture(scope="session")
def user_table(paper_data: Path) -> np.ndarray:
    """Return the user's discretised demonstration, (28, 6): position and action in metres."""
    return np.loadtxt(paper_data / "user_path_grid11.csv", delimiter=",")


@pytest.fixture(scope="session")
def user_path(user_table: np.ndarray) -> GridPath:
    return discretize(1000 * user_table[:, :3], PAPER_GRID)


@pytest.fixture(scope="session")
def user_reward(user_path: GridPath) -> RewardMap:
    return sparse_reward(user_path)


@pytest.fixture(scope="session")
def published(paper_data: Path) -> list[np.ndarray]:
    """Return the three published greedy policies, an action for each of the 1331 states."""
    return [np.load(paper_data / f"published_policy_{i}.npy").astype(int) for i in (1, 2, 3)]
