"""Table I and the RMSE of Sec. IV, recomputed from the published policies."""

from itertools import pairwise

import numpy as np
import pytest

from skills.gridworld import paper
from skills.gridworld.grid import MOVES, PAPER_GRID
from skills.learning.evaluation import dtw

GOAL = 916
PAIRS = 3 * 28  # each of the 28 states is aligned once to each of three shorter rollouts
EXACT_MM = 1e-9


def follow(actions, state):
    """Follow a published policy with the authors' indices; None if it leaves the grid or enters a cycle."""
    states = [state]
    while states[-1] != GOAL:
        ix, iy, iz = states[-1] // 121, states[-1] // 11 % 11, states[-1] % 11
        a, b, c = MOVES[actions[states[-1]]].tolist()
        on_grid = all(0 <= i <= 10 for i in (ix + a, iy + b, iz + c))
        if not on_grid or len(states) > 1331:
            return None
        states.append(states[-1] + 121 * a + 11 * b + c)
    return states


@pytest.fixture(scope="module")
def rollouts_mm(published, user_path):
    return [PAPER_GRID.centres_mm(follow(actions, user_path.start)) for actions in published]


@pytest.fixture(scope="module")
def alignments(rollouts_mm, user_path):
    return [dtw(tip_mm, user_path.tip_mm) for tip_mm in rollouts_mm]


def test_the_printed_rmse_is_in_metres():
    # mean^2 + std^2 = RMSE^2, axis by axis; the paper prints four decimals, of a metre and not of a millimetre
    rmse_mm = np.hypot(paper.TABLE1_MEAN_MM, paper.TABLE1_STD_MM)
    assert rmse_mm == pytest.approx([4.432, 2.728, 1.967], abs=0.0005)  # mm
    assert 1000 * np.array(paper.RMSE_AS_PRINTED_MM) == pytest.approx(rmse_mm, abs=0.05)  # mm


def test_the_discussions_similarity_is_table_1_averaged_over_the_axes():
    assert np.mean(paper.TABLE1_MEAN_MM) == pytest.approx(paper.SIMILARITY_MEAN_MM, abs=0.001)  # mm
    assert np.mean(paper.TABLE1_STD_MM) == pytest.approx(paper.SIMILARITY_STD_MM, abs=0.001)  # mm


def test_the_published_policies_are_140_145_and_145_mm_from_the_user(alignments):
    assert [one.total_mm for one in alignments] == pytest.approx([140, 145, 145], abs=EXACT_MM)


def test_they_cut_corners_and_skip_most_of_the_demonstration(rollouts_mm):
    assert [len(tip_mm) for tip_mm in rollouts_mm] == [11, 10, 10]


def test_the_total_is_table_1s_to_the_last_printed_digit(alignments):
    assert sum(len(one.pairs) for one in alignments) == PAIRS
    total_mm = sum(one.total_mm for one in alignments)
    assert total_mm == pytest.approx(430, abs=EXACT_MM)
    assert sum(paper.TABLE1_MEAN_MM) * PAIRS == pytest.approx(total_mm, abs=3 * 0.0005 * PAIRS)  # mm, by its rounding


@pytest.mark.parametrize(("axis", "least_mm", "most_mm"), [(0, 205, 330), (1, 20, 155), (2, 65, 85)])
def test_how_the_total_splits_over_the_axes_depends_on_the_tie_break(
    alignments, rollouts_mm, user_path, axis, least_mm, most_mm
):
    bounds = np.sum([split_bounds(tip_mm, user_path.tip_mm, axis) for tip_mm in rollouts_mm], axis=0)
    assert bounds.tolist() == [least_mm, most_mm]
    assert least_mm <= sum(one.differences_mm[:, axis].sum() for one in alignments) <= most_mm
    assert least_mm <= paper.TABLE1_MEAN_MM[axis] * PAIRS <= most_mm


def split_bounds(path_mm, reference_mm, axis):
    """Return the least and the most of one axis among all equally short alignments, in mm: whole numbers, so exact."""
    apart = np.rint(np.abs(path_mm[:, None] - reference_mm[None])).astype(int).tolist()
    bounds = []
    for sign in (1, -1):
        costs = {(-1, -1): (0, 0)}
        for i in range(len(path_mm)):
            for j in range(len(reference_mm)):
                before = [costs[at] for at in ((i - 1, j - 1), (i - 1, j), (i, j - 1)) if at in costs]
                total, part = min(before)
                costs[i, j] = (total + sum(apart[i][j]), part + sign * apart[i][j][axis])
        bounds.append(sign * costs[i, j][1])
    return bounds


def test_not_every_published_policy_reaches_the_goal_from_everywhere(published):
    assert [sum(follow(actions, s) is not None for s in range(1331)) for actions in published] == [1205, 1331, 1181]


def test_the_published_policies_move_by_single_cells(rollouts_mm):
    for tip_mm in rollouts_mm:
        assert max(np.abs(b - a).max() for a, b in pairwise(tip_mm)) == pytest.approx(5, abs=EXACT_MM)
