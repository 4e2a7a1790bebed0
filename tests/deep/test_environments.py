"""The environments: they pass the checkers of the interface's authors, and behave as the grid world does."""

import numpy as np
import pytest

from skills.gridworld.grid import MOVES, PAPER_GRID, GridPath
from skills.gridworld.reward import sparse_reward
from skills.learning.networks import DDPG, Space

pytestmark = [pytest.mark.usefixtures("extra"), pytest.mark.filterwarnings("default")]
PATH = GridPath(PAPER_GRID, PAPER_GRID.states_of([[1, 1, 1], [2, 1, 1], [3, 1, 1], [3, 2, 1], [3, 3, 1]]))
REWARD = sparse_reward(PATH)
BOTH = pytest.mark.parametrize("name", ["SutureGrid-v0", "SutureSpace-v0"])


def made(name: str):
    import gymnasium

    return gymnasium.make(f"skills.deep.environments:{name}", reward=REWARD)


@BOTH
def test_it_passes_the_checkers(name):
    from gymnasium.utils.env_checker import check_env
    from stable_baselines3.common.env_checker import check_env as check_for_baselines

    check_env(made(name).unwrapped, skip_render_check=True)
    check_for_baselines(made(name).unwrapped, skip_render_check=True)


@BOTH
def test_the_same_seed_starts_in_the_same_places_and_another_elsewhere(name):
    first, second, other = made(name), made(name), made(name)
    starts = [
        [one.reset(seed=seed)[0].tolist(), one.reset()[0].tolist()]
        for one, seed in ((first, 3), (second, 3), (other, 4))
    ]
    assert starts[0] == starts[1] != starts[2]


@BOTH
def test_episodes_start_off_the_goal_and_end_there_or_after_100_steps(name):
    world = made(name)
    space = Space(PATH, REWARD.levels)
    for seed in range(200):
        at, _ = world.reset(seed=seed)
        assert PAPER_GRID.states_of(at) != PATH.goal if name == "SutureGrid-v0" else not space.arrived(at)
    world.action_space.seed(0)
    ended = False
    for step in range(1, 101):
        _, _, ended, cut, _ = world.step(np.int64(13) if name == "SutureGrid-v0" else np.zeros(3, np.float32))
        assert cut == (step == 100) and not ended


def test_the_grid_pays_algorithm_1_for_every_move_of_a_random_walk():
    world = made("SutureGrid-v0")
    rng = np.random.default_rng(0)
    cell, _ = world.reset(seed=0)
    for action in rng.integers(27, size=90):
        wanted = cell + MOVES[action]
        cell, pays, ended, _, _ = world.step(action)
        if PAPER_GRID.holds(wanted):
            state = int(PAPER_GRID.states_of(wanted))
            assert cell.tolist() == wanted.tolist() and pays == REWARD.rewards[state] and ended == (state == PATH.goal)
        else:
            assert pays == -1.0 and not ended
        if ended:
            cell, _ = world.reset()


def test_following_the_demonstration_pays_its_waypoints_and_the_goal():
    world = made("SutureGrid-v0")
    cell, _ = world.reset(options={"start_mm": PATH.tip_mm[0]})
    paid = []
    for after in PATH.cells[1:]:
        action = int((after - cell + 1) @ [9, 3, 1])
        cell, pays, ended, _, _ = world.step(action)
        paid.append(pays)
    assert paid == [1, 1, 1, 10] and ended


def test_the_space_pays_what_the_space_says():
    import gymnasium

    gamma = DDPG().discount
    world = gymnasium.make("skills.deep.environments:SutureSpace-v0", reward=REWARD, gamma=gamma)
    space = Space(PATH, REWARD.levels)
    world.reset(seed=1, options={"start_mm": PATH.tip_mm[0]})
    step = np.array([0.5, -0.25, 1.0], np.float32)
    after, pays, ended, _, _ = world.step(step)
    moved = space.moved(PATH.tip_mm[0], step)
    assert after == pytest.approx(moved, abs=1e-4) and not ended
    assert pays == pytest.approx(float(space.pays(PATH.tip_mm[:1], step[None], moved[None], gamma)[0]))
