"""Distances between all shapes: against another library, by hand, and by laws."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from tslearn.metrics import dtw_path_from_metric

from skills.style.comparing import _kernels
from skills.style.comparing.distances import WORTH_A_THREAD, distances, distances_of, medoid, spread
from skills.style.evaluation import dtw
from tests.style.comparing.cohort import cohort


def test_they_are_those_of_another_library_and_of_our_alignment():
    rng = np.random.default_rng(5)
    shapes, others = rng.normal(0, 10, (4, 30, 3)).cumsum(axis=1), rng.normal(0, 10, (3, 22, 3)).cumsum(axis=1)
    found = distances(shapes, others)
    for i, shape in enumerate(shapes):
        for j, other in enumerate(others):
            np.testing.assert_allclose(found[i, j], dtw_path_from_metric(shape, other, metric="cityblock")[1])
            np.testing.assert_allclose(found[i, j], dtw(shape, other).total_mm)


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
    assert distances([step], [still])[0, 0] == 4.0  # 0 + 1 + 3, whichever way it is warped


@settings(deadline=None)  # the first call compiles
@given(st.integers(0, 1000))
def test_they_are_symmetric_and_nothing_only_from_itself(seed):
    shapes = np.random.default_rng(seed).normal(0, 10, (4, 9, 3))
    found = distances(shapes, shapes)
    np.testing.assert_allclose(found, found.T)
    assert (np.diag(found) == 0).all()
    assert (found[~np.eye(4, dtype=bool)] > 0).all()


def test_the_medoid_is_in_the_middle_and_the_spread_is_the_mean_distance_to_it():
    apart = np.abs(np.subtract.outer([0.0, 1.0, 5.0, 100.0], [0.0, 1.0, 5.0, 100.0]))
    assert medoid(apart, np.array([0, 1, 2])) == 1
    assert spread(apart, np.array([0, 1, 2])) == 2.5
    assert spread(apart, np.array([3])) == 0.0


def test_a_cohorts_surgeons_are_nearer_to_themselves():
    from skills.style.comparing.shapes import shape_of

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
