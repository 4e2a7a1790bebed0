"""Hand-offs and grids of any shape: the policy is the demonstration, and every start is led onto it."""

from functools import cache, partial

import numpy as np
import pytest

from skills.gridworld.grid import PAPER_GRID, GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import certify
from skills.learning.evaluation import dtw
from skills.learning.policy import Policy, learn_tabular, rollout_from
from skills.learning.q_learning import PhaseQLearning
from tests.by_day import some
from tests.demonstration.synthetic import crossing_path, crossings, edge_path, winding_path
from tests.gridworld.paths import follow, joins_nearest

N_DEMONSTRATIONS, SEEDS = 200, range(5)
FINE = GridWorld((0.0, 0.0, 0.0), 2.5, (21, 21, 21))
FINEST = GridWorld((-20.0, 0.0, -150.0), 1.0, (51, 51, 51))
OBLONG = GridWorld((-30.0, 25.0, -140.0), 5.0, (7, 23, 11))
FLAT = GridWorld((0.0, 0.0, 0.0), 5.0, (23, 19, 1))
THIN = GridWorld((0.0, 0.0, 0.0), 5.0, (1, 1, 12))
SHAPES = {
    "5 states": partial(winding_path, 0, PAPER_GRID, 5),
    "400 states": partial(winding_path, 1, PAPER_GRID, 400),
    "2.5 mm": partial(crossing_path, 2, 5, FINE),
    "7 x 23 x 11": partial(crossing_path, 3, 5, OBLONG),
    "one cell thick": partial(crossing_path, 4, 5, FLAT),
    "one cell wide": partial(winding_path, 5, THIN, 60),
    "along the edges": partial(edge_path, PAPER_GRID),
    "along the edges of 7 x 23 x 11": partial(edge_path, OBLONG),
    "in a fitted grid of 5 mm": partial(crossing_path, 6, 5, fit_mm=5.0),
    "in a fitted grid of 2.5 mm": partial(crossing_path, 7, 3, fit_mm=2.5),
}
LARGE = {
    "1 mm": partial(crossing_path, 8, 5, FINEST),
    "400 states of 1 mm": partial(winding_path, 9, FINEST, 400),
    "in a fitted grid of 1 mm": partial(crossing_path, 10, 2, fit_mm=1.0),
}


@cache
def demonstration(number: int) -> GridPath:
    """Draw a demonstration in the paper's grid, with 0 to 5 crossings in turn."""
    return crossing_path(number, number % 6)


def check(path: GridPath, seed: int) -> Policy:
    """Learn, and check: the demonstration exactly, every action optimal, every start to the goal by the nearest way."""
    policy = learn_tabular(sparse_reward(path), PhaseQLearning(), seed)
    assert policy.training.settled
    followed = rollout_from(policy, path.start)
    assert followed.finished
    assert followed.states.tolist() == path.states.tolist()
    assert dtw(followed.tip_mm, path.tip_mm).total_mm == 0
    certificate, _ = certify(policy)
    assert certificate.every_action_optimal
    assert certificate.demonstration_reproduced
    assert certificate.starts == path.grid.n_states
    assert certificate.starts_reaching == certificate.starts_joining_nearest == certificate.starts
    return policy


def check_as_a_client(policy: Policy, starts: np.ndarray) -> None:
    """Follow the served actions from the demonstrated start and others, by the interface's text alone."""
    path = policy.path
    followed = partial(follow, policy.table(), path.grid.shape, path.states.tolist())
    assert followed(path.start) == (path.states.tolist(), True)
    for start in starts.tolist():
        states, finished = followed(start)
        assert finished
        assert joins_nearest(path, states)


# ---- the demonstrations themselves


@pytest.mark.parametrize("n_crossings", some(range(6), 3))
def test_a_synthetic_demonstration_crosses_itself_as_often_as_was_asked(n_crossings):
    paths = [crossing_path(seed, n_crossings) for seed in range(4)]
    for path in paths:
        assert crossings(path) == n_crossings <= path.revisits
        assert path.bridged == 0
    assert len({path.states.tobytes() for path in paths}) == len(paths)
    assert crossing_path(3, n_crossings).states.tolist() == paths[3].states.tolist()


def test_crossings_are_counted_by_hand():
    grid = GridWorld((0.0, 0.0, 0.0), 1.0, (3, 3, 1))
    around = [0, 1, 4, 3]
    assert crossings(GridPath(grid, np.array(around))) == 0
    assert crossings(GridPath(grid, np.array([*around, 0]))) == 1
    assert crossings(GridPath(grid, np.array([*around, 0, 1, 2]))) == 1  # two cells shared in a row
    assert crossings(GridPath(grid, np.array([*around, 0, 1, 2, 4]))) == 2


@pytest.mark.nightly  # of the test's own generator
def test_they_are_of_all_lengths():
    lengths = [len(demonstration(number).states) for number in range(30)]
    assert min(lengths) < 20
    assert max(lengths) > 80
    assert len(winding_path(0, PAPER_GRID, 5).states) == 5
    assert len(SHAPES["400 states"]().states) == len(LARGE["400 states of 1 mm"]().states) == 400
    assert crossings(SHAPES["400 states"]()) > 40


def test_a_path_along_the_edges_touches_every_corner_and_leaves_no_margin():
    path = SHAPES["along the edges"]()
    corners = np.indices((2, 2, 2)).reshape(3, -1).T * 10
    assert set(PAPER_GRID.states_of(corners)) <= set(path.states)
    assert ((path.cells == 0) | (path.cells == 10)).sum(axis=1).mean() > 1.8


# ---- learning from them


@pytest.mark.parametrize("number", some(range(12), 4))
def test_12_demos_on_5_seeds_are_exact_from_all_starts(number):
    for seed in SEEDS:
        check(demonstration(number), seed)


@pytest.mark.parametrize("number", some(range(0, 40, 13), 2))
def test_a_client_that_knows_the_text_alone_says_so_too(number):
    policy = check(demonstration(number), seed=0)
    check_as_a_client(policy, np.arange(PAPER_GRID.n_states))


@pytest.mark.parametrize("name", some(SHAPES, 2))
def test_a_demonstration_and_a_grid_of_any_shape_are_learnt_exactly(name):
    path = SHAPES[name]()
    policy = check(path, seed=0)
    check_as_a_client(policy, np.random.default_rng(0).permutation(path.grid.n_states)[:100])


@pytest.mark.parametrize("name", some(LARGE, 3))
def test_a_demonstration_in_cells_of_1_mm_is_learnt_exactly(name):
    check(LARGE[name](), seed=0)


@pytest.mark.nightly
@pytest.mark.parametrize("number", range(N_DEMONSTRATIONS))
def test_200_demos_on_5_seeds_are_exact_from_all_starts(number):
    for seed in SEEDS:
        check(demonstration(number), seed)
