"""Distances between all shapes: against another library, by hand, and by laws."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skills.comparison import _kernels
from skills.comparison.distances import WORTH_A_THREAD, distances, distances_of, medoid, spread
from skills.learning.evaluation import dtw
from tests.comparison.cohort import cohort


def by_tslearn(shape, other):
    from tslearn.metrics import dtw_path_from_metric  # imported here because it imports much

    return dtw_path_from_metric(shape, other, metric="cityblock")[1]


def by_our_alignment(shape, other):
    return dtw(shape, other).total_mm


@pytest.mark.parametrize(
    "method",
    [by_our_alignment, pytest.param(by_tslearn, marks=pytest.mark.nightly)],  # it compiles for 8 s
)
def test_they_are_those_of_a_second_method(method):
    rng = np.random.default_rng(5)
    shapes, others = rng.normal(0, 10, (4, 30, 3)).cumsum(axis=1), rng.normal(0, 10, (3, 22, 3)).cumsum(axis=1)
    found = distances(shapes, others)
    for i, shape in enumerate(shapes):
        for j, other in enumerate(others):
            np.testing.assert_allclose(found[i, j], method(shape, other))


def test_compiled_and_plain_agree_to_the_last_bit():
    rng = np.random.default_rng(6)
    shapes, plain = rng.normal(0, 10, (3, 12, 3)), np.empty((3, 3))
    warped = _kernels.warped
    for i in range(3):
        for j in range(3):
            plain[i, j] = warped(shapes[i], shapes[j], np.empty(13))
    assert (distances(shapes, shapes) == plain).all()


def test_three_points_by_hand():
    still, step = [[0.0, 0, 0], [0.0, 0, 0], [0.0, 0, 0]], [[0.0, 0, 0], [1.0, 0, 0], [1.0, -2.0, 0]]
    assert distances([step], [still])[0, 0] == 4.0  # 0 + 1 + 3, however it is warped


@settings(deadline=None)  # the first call compiles
@given(st.integers(0, 1000))
def test_they_are_symmetric_and_nothing_only_from_itself(seed):
    shapes = np.random.default_rng(seed).normal(0, 10, (4, 9, 3))
    found = distances(shapes, shapes)
    np.testing.assert_allclose(found, found.T)
    assert (np.diag(found) == 0).all()
    assert (found[~np.eye(4, dtype=bool)] > 0).all()


def test_the_medoid_is_central_and_the_spread_is_its_mean_distance():
    apart = np.abs(np.subtract.outer([0.0, 1.0, 5.0, 100.0], [0.0, 1.0, 5.0, 100.0]))
    assert medoid(apart, np.array([0, 1, 2])) == 1
    assert spread(apart, np.array([0, 1, 2])) == 2.5
    assert spread(apart, np.array([3])) == 0.0


def test_a_cohorts_surgeons_are_nearer_to_themselves():
    from skills.comparison.distances import shape_of

    drawn = cohort(1)
    shapes = [shape_of(demo) for demo in drawn.demos]
    apart = distances(shapes, shapes)
    same = drawn.surgeons[:, None] == drawn.surgeons[None, :]
    own, others = apart[same & ~np.eye(len(same), dtype=bool)], apart[~same]
    assert own.mean() < 0.5 * others.mean()


def test_threads_change_no_bit_and_a_pair_is_what_it_is_among_all():
    shapes = np.random.default_rng(7).normal(0, 10, (30, 12, 3))
    every = np.array([(i, j) for i in range(30) for j in range(30)])
    assert len(every) > 2 * WORTH_A_THREAD
    found = distances_of(shapes, every)
    assert (found == distances(shapes, shapes).ravel()).all()
    assert [*found[:5]] == [distances_of(shapes, [pair])[0] for pair in every[:5]]
    assert distances_of(shapes, np.empty((0, 2))).shape == (0,)
