"""The continuous space: targets and rewards of steps, and no gain from detours."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.gridworld.grid import PAPER_GRID, GridPath
from skills.gridworld.reward import RewardLevels
from skills.learning.networks import DRIFT, Space

CORNER = GridPath(PAPER_GRID, PAPER_GRID.states_of([[1, 1, 1], [2, 1, 1], [3, 1, 1], [3, 2, 1], [3, 3, 1]]))
CROSSED = GridPath(PAPER_GRID, PAPER_GRID.states_of([[1, 1, 1], [2, 1, 1], [2, 2, 1], [1, 2, 1], [1, 1, 1], [0, 0, 1]]))
SPACE = Space(CORNER, RewardLevels())
GAMMA = 0.9


def mm(*cells: float) -> np.ndarray:
    return np.asarray(PAPER_GRID.origin_mm) + 5.0 * np.asarray(cells)


def pays(before: np.ndarray, step: tuple[float, float, float]) -> float:
    after = SPACE.moved(before, step)
    return float(SPACE.pays(before[None], np.asarray(step)[None], after[None], GAMMA)[0])


def test_a_step_is_at_most_a_cell_along_each_axis_and_ends_at_a_face():
    assert SPACE.moved(mm(5, 5, 5), (0.5, -2, 9)) == pytest.approx(mm(5.5, 4, 6))
    assert SPACE.moved(mm(0.2, 10, 5), (-1, 1, 0)) == pytest.approx(mm(0, 10, 5))


def test_the_box_is_scaled_to_one_around_its_middle():
    assert SPACE.scaled([mm(0, 0, 0), mm(10, 5, 10)]).tolist() == [[-1, -1, -1], [1, 0, 1]]


def test_one_has_arrived_in_the_goals_cell_and_nowhere_else():
    assert SPACE.arrived([mm(3, 3, 1), mm(3.4, 2.6, 1.4), mm(3.6, 3, 1), mm(3, 2, 1)]).tolist() == [
        True,
        True,
        False,
        False,
    ]


def test_how_far_along_and_how_far_off_by_hand():
    along, off = SPACE.along([mm(1, 1, 1), mm(2.5, 1, 1), mm(3, 2.5, 1), mm(2, 1, 3), mm(5, 3, 1)])
    assert along.tolist() == pytest.approx([0, 1.5, 3.5, 1, 4])
    assert off.tolist() == pytest.approx([0, 0, 0, 2, 2])


def test_where_a_path_crosses_itself_one_is_at_the_later_visit():
    along, _ = Space(CROSSED, RewardLevels()).along([mm(1, 1, 1)])
    assert along.tolist() == [4]


def test_what_steps_pay_by_hand():
    assert pays(mm(1, 1, 1), (1, 0, 0)) == pytest.approx(GAMMA * 1 - 0)  # a cell further
    assert pays(mm(2, 1, 1), (0, 0, 0)) == pytest.approx((GAMMA - 1) * 1)  # standing still costs
    assert pays(mm(2, 1, 1), (0, 0, 1)) == pytest.approx(GAMMA * (1 - 1) - 1 - DRIFT)  # off the path
    assert pays(mm(2, 1, 1), (1, 1, 0)) == pytest.approx(1.0)  # two cells' progress in one step: cut at 1
    assert pays(mm(3, 2, 1), (0, 1, 0)) == pytest.approx(min(GAMMA * 4 - 3, 1) + 10)  # the goal
    low = Space(CROSSED, RewardLevels(off_grid=-2.0))
    corner, out = mm(0, 5, 5)[None], np.array([[-1.0, 0.0, 0.0]])
    stays = low.pays(corner, 0 * out, corner, GAMMA)
    assert low.pays(corner, out, low.moved(corner, out), GAMMA) == pytest.approx(stays - 2)


@given(st.lists(st.tuples(*[st.floats(-1, 1)] * 3), min_size=1, max_size=12), st.tuples(*[st.floats(1, 9)] * 3))
def test_no_way_round_pays(steps, start):
    """The goal's reward is left out: it ends an episode, so that no loop passes it."""
    at = first = mm(*start)
    total, weight = 0.0, 1.0
    for step in [*steps, *[None] * 12]:
        made = np.asarray((first - at) / 5.0 if step is None else step).clip(-1, 1)
        then = SPACE.moved(at, made)
        gained = float(SPACE.pays(at[None], made[None], then[None], GAMMA)[0])
        total += weight * (gained - 10 * bool(SPACE.arrived(then)))
        at, weight = then, weight * GAMMA
    assert at == pytest.approx(first)
    (s,), (u,) = SPACE.along(first[None])
    assert total <= (weight - 1) * float(s - u) + 1e-6  # the sum of the potential alone


def test_a_box_without_height_has_a_middle_and_nothing_else():
    flat = GridPath(type(PAPER_GRID)((0.0, 0.0, 0.0), 5.0, (3, 3, 1)), np.array([0, 1, 2]))
    assert Space(flat, RewardLevels()).scaled([[5.0, 10.0, 0.0]]).tolist() == [[0.0, 1.0, 0.0]]
