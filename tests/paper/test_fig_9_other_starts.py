"""Fig. 9: the same policy from other initial states."""

from itertools import product

import numpy as np
import pytest

from skills.gridworld import paper
from skills.gridworld.grid import PAPER_GRID
from skills.learning.evaluation import measure
from skills.learning.policy import learn_tabular, rollout
from skills.learning.q_learning import PhaseQLearning
from tests.gridworld.paths import joins_nearest

AXES_MM = [np.arange(min(ends), max(ends) + 1, paper.CELL_MM) for ends in paper.FIG9_START_RANGE_MM]
STARTS_MM = list(product(*AXES_MM))


@pytest.fixture(scope="module")
def policy(user_reward):
    return learn_tabular(user_reward, PhaseQLearning())


def test_the_range_of_starts_has_30_grid_points():
    assert len(STARTS_MM) == 5 * 3 * 2


@pytest.mark.parametrize("start_mm", STARTS_MM, ids=lambda mm: "{:g} {:g} {:g}".format(*mm))
def test_from_every_start_in_range_it_joins_and_follows_the_users_path(policy, start_mm):
    followed = rollout(policy, start_mm)
    assert followed.finished
    assert joins_nearest(policy.path, followed.states.tolist())
    assert (
        measure(followed).dtw_total_mm <= 75
    )  # mm; the published cell policies are 145 mm off from the user's own start


def test_between_grid_points_it_starts_from_the_nearest(policy):
    rng = np.random.default_rng(9)
    for start_mm in rng.uniform((-25, 50, -135), (-5, 60, -130), (20, 3)):
        followed = rollout(policy, start_mm)
        assert followed.finished
        assert followed.states[0] == PAPER_GRID.states_at(start_mm)


def test_fig_9s_policy_cannot_be_the_first_published_policy(published):
    # From (-25, 50, -135) mm it never arrives, though the paper draws a path from there.
    state, seen = int(PAPER_GRID.states_at([-25, 50, -135])), set()
    while state not in seen:
        seen.add(state)
        cell = PAPER_GRID.cells_of(state) + np.array(np.unravel_index(published[0][state], (3, 3, 3))) - 1
        state = int(PAPER_GRID.states_of(cell)) if PAPER_GRID.holds(cell) else state
    assert 916 not in seen
