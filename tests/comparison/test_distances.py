"""Shapes, their distances, and their clusters: against other libraries, by hand, and by laws."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skills.comparison.distances import (
    MANY,
    STATES,
    VERSION,
    WORTH,
    WORTH_A_THREAD,
    chart,
    dendrogram,
    difference,
    distances,
    distances_of,
    how_many,
    in_lengths,
    medoid,
    placed,
    resampled,
    shape_of,
    silhouette,
    spread,
    warped,
)
from skills.errors import BadInput, BadPath
from skills.learning.evaluation import dtw
from tests.comparison.cohort import cohort, demo_of


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


HUMPS_MM = np.array([[3.0, 6.0], [1.0, -2.0], [0.0, 1.0]])
PINNED_MM = [[10.769038, 2.972388, 2.66079], [22.036847, 3.008288, 4.690078], [33.111112, 1.089212, 6.643578]]


def test_a_quarter_circle_worked_by_hand():
    angle = np.linspace(0.0, np.pi / 2, 2001)
    path = np.stack([10 * np.sin(angle), np.zeros_like(angle), 10 * (1 - np.cos(angle))], axis=1)
    shape = placed(resampled(path, 3))  # its start, the middle of its path, its goal
    half, long = 10 * (np.sqrt(2.0) - 1.0) / np.sqrt(2.0), 10 * np.sqrt(2.0)
    np.testing.assert_allclose(shape, [[0, 0, 0], [long / 2, 0, -(10 - long / 2)], [long, 0, 0]], atol=1e-4)
    assert half == pytest.approx(10 - long / 2)


@settings(deadline=None)  # the first call compiles
@given(st.floats(-np.pi, np.pi), st.tuples(*[st.floats(-50, 50)] * 3), st.floats(1.5, 6.0), st.floats(0.3, 3.0))
def test_place_turn_tempo_and_size_say_nothing(turn_rad, place_mm, duration_s, size):
    plain = demo_of(HUMPS_MM, 0.0, np.zeros(3), 3.0)
    moved = demo_of(HUMPS_MM, turn_rad, np.array(place_mm), duration_s)
    assert distances([shape_of(plain)], [shape_of(moved)])[0, 0] / STATES < 0.1  # mm: the window smooths over time
    once, larger = resampled(plain.tip_mm), resampled(plain.tip_mm * size)
    np.testing.assert_allclose(placed(once, scaled=True), placed(larger, scaled=True), atol=1e-9)
    np.testing.assert_allclose(placed(once) * size, placed(larger), atol=1e-9)


def test_standing_still_and_sampling_say_nothing():
    way = np.linspace(0.0, 1.0, 50)[:, None] * np.array([30.0, 10.0, 5.0])
    rested = np.repeat(way, [20 if row == 25 else 1 + row % 3 for row in range(50)], axis=0)
    np.testing.assert_allclose(resampled(way), resampled(rested), atol=1e-9)


def test_a_shape_begins_at_the_origin_and_goes_along_x_with_z_upwards():
    shape = shape_of(demo_of(HUMPS_MM, 0.7, np.array([1.0, 2.0, -100.0]), 3.0))
    assert shape.shape == (STATES, 3)
    np.testing.assert_allclose(shape[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(shape[-1, 1:], 0.0, atol=1e-9)
    assert shape[-1, 0] > 35
    assert shape[STATES // 2, 2] > 3  # its largest hump points upwards


def test_straight_up_is_a_way_too_and_none_at_all_is_refused():
    up = np.linspace(0.0, 1.0, 20)[:, None] * np.array([0.0, 0.0, -30.0])
    np.testing.assert_allclose(placed(up)[-1], [30.0, 0.0, 0.0], atol=1e-12)
    around = np.array([[0.0, 0, 0], [20.0, 0, 0], [0.5, 0, 0]])
    with pytest.raises(BadPath, match=r"0\.50 mm"):
        placed(around)
    with pytest.raises(BadPath):
        placed(np.full((3, 3), np.nan))


def test_a_shape_in_lengths_is_the_scaled_one():
    demo = demo_of(HUMPS_MM, 0.7, np.array([1.0, 2.0, -100.0]), 3.0)
    np.testing.assert_allclose(in_lengths(shape_of(demo)), shape_of(demo, scaled=True), atol=1e-12)


def test_cached_shapes_have_a_version_that_is_raised_when_they_change():
    """A failure means that shapes differ from before: raise `distances.VERSION`, then update these numbers."""
    shape = shape_of(demo_of(HUMPS_MM, 0.7, np.array([1.0, 2.0, -100.0]), 3.0))
    assert VERSION == 1
    np.testing.assert_allclose(shape[[25, 50, 75]], PINNED_MM, atol=1e-6)


def along(states: int) -> np.ndarray:
    return np.linspace(0.0, 1.0, states)[:, None] * np.array([300.0, 0.0, 0.0])


def test_a_hump_in_the_last_third_is_found_there_with_its_sign():
    reference = along(30)
    shape = reference.copy()
    shape[22:28, 2] += 4.0
    found = difference(shape, reference)
    assert found.where == ("last third", "upwards")
    assert found.total == pytest.approx(24.0)
    assert found.offsets[2, 2] == pytest.approx(2.4)
    assert found.shares[2, 2] == pytest.approx(1.0)
    assert found.shares.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(found.along, shape - reference)
    assert difference(reference, shape).offsets[2, 2] == pytest.approx(-2.4)


def test_a_shift_sideways_is_everywhere():
    found = difference(along(12) - np.array([0.0, 2.0, 0.0]), along(12))
    assert found.where[1] == "sideways"
    np.testing.assert_allclose(found.offsets[:, 1], -2.0)
    np.testing.assert_allclose(found.shares[:, 1], 1 / 3)


def test_nothing_differs_from_itself():
    found = difference(along(9), along(9))
    assert found.total == 0.0
    assert not found.offsets.any()
    assert not found.shares.any()


def test_where_they_cross_neither_lies_further():
    reference = along(30)
    shape = reference.copy()
    shape[10:15, 1], shape[15:20, 1] = 3.0, -3.0
    found = difference(shape, reference)
    assert found.where == ("middle third", "sideways")
    share, offset, size = found.most
    assert (share, offset, size) == (pytest.approx(1.0), pytest.approx(0.0), pytest.approx(3.0))
    assert found.direction is None
    assert difference(reference + np.array([0, 0, 1.0]), reference).direction == "higher"
    assert difference(reference, reference + np.array([0, 1.0, 0])).direction == "further right"


def apart(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points[None, :], axis=2)


@given(st.integers(0, 500), st.integers(2, 30))
def test_what_lies_in_a_plane_keeps_all_its_distances(seed, size):
    points = np.random.default_rng(seed).normal(0, 10, (size, 2))
    places, right = chart(apart(points))
    np.testing.assert_allclose(apart(places), apart(points), atol=1e-5)
    np.testing.assert_allclose(places.mean(axis=0), 0.0, atol=1e-9)
    assert right == pytest.approx(1.0, abs=1e-6)


def test_many_are_placed_as_few_are_and_always_alike(monkeypatch):
    points = np.random.default_rng(3).normal(0, 1, (MANY + 20, 5)) * [9, 5, 2, 1, 1]
    places, right = chart(apart(points))
    assert (chart(apart(points))[0] == places).all()
    monkeypatch.setattr("skills.comparison.distances.MANY", 1000)
    few, the_same = chart(apart(points))
    np.testing.assert_allclose(places, few, atol=1e-7)
    assert right == pytest.approx(the_same)


def test_the_corners_of_a_cube_are_not_all_shown():
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    assert 0.5 < chart(apart(corners))[1] < 0.9


def test_one_and_equal_ones_have_places_too():
    assert chart(np.zeros((1, 1))) == (pytest.approx(np.zeros((1, 2))), 1.0)
    places, right = chart(np.zeros((4, 4)))
    assert not places.any() and right == 1.0


def on_a_line(*places: float) -> np.ndarray:
    return np.abs(np.subtract.outer(places, places))


def test_four_places_on_a_line_by_hand():
    tree = dendrogram(on_a_line(0.0, 10.0, 1.0, 12.0))
    assert tree.joined.tolist() == [[0, 2], [1, 3], [4, 5]]
    assert tree.heights.tolist() == [1.0, 2.0, 10.5]  # the mean of 10, 12, 9, 11
    assert tree.order.tolist() == [0, 2, 1, 3]
    assert tree.cut(1).tolist() == [0, 0, 0, 0]
    assert tree.cut(2).tolist() == [0, 1, 0, 1]
    assert tree.cut(3).tolist() == [0, 1, 0, 2]
    assert tree.cut(4).tolist() == [0, 2, 1, 3]


@given(st.integers(0, 500), st.integers(3, 25), st.data())
def test_they_are_those_of_another_library(seed, size, data):
    from sklearn.cluster import AgglomerativeClustering  # here, because the import takes a second
    from sklearn.metrics import adjusted_rand_score, silhouette_score

    points = np.random.default_rng(seed).normal(0, 1, (size, 3))
    apart = np.abs(points[:, None] - points[None, :]).sum(axis=2)
    tree = dendrogram(apart)
    clusters = data.draw(st.integers(2, size - 1))
    ours = tree.cut(clusters)
    theirs = AgglomerativeClustering(clusters, metric="precomputed", linkage="average").fit_predict(apart)
    assert adjusted_rand_score(ours, theirs) == 1.0
    assert sorted(set(ours.tolist())) == list(range(clusters))
    np.testing.assert_allclose(silhouette(apart, ours), silhouette_score(apart, ours, metric="precomputed"))
    assert (np.diff(tree.heights) >= 0).all()
    assert sorted(tree.order.tolist()) == list(range(size))
    assert (np.diff(ours[tree.order]) >= 0).all()  # the members of a cluster are adjacent in the order


def test_a_cohorts_surgeons_are_its_clusters():
    from sklearn.metrics import adjusted_rand_score

    drawn = cohort(1)
    shapes = [shape_of(demo) for demo in drawn.demos]
    apart = distances(shapes, shapes)
    tree = dendrogram(apart)
    chosen = how_many(apart, tree)
    assert 6 <= chosen <= 10
    assert adjusted_rand_score(drawn.surgeons, tree.cut(chosen)) > 0.8


def test_one_style_with_noise_is_one_cluster_and_so_are_too_few():
    rng = np.random.default_rng(2)
    points = rng.normal(0, 1, (60, 12))  # in many directions, so that none is nearer to some than to others
    apart = np.linalg.norm(points[:, None] - points[None, :], axis=2)
    assert how_many(apart, dendrogram(apart)) == 1
    assert silhouette(apart, dendrogram(apart).cut(2)) < WORTH
    for few in (on_a_line(3.0), on_a_line(0.0, 50.0)):
        assert how_many(few, dendrogram(few)) == 1
    assert how_many(on_a_line(0.0, 1.0, 50.0), dendrogram(on_a_line(0.0, 1.0, 50.0))) == 2


def test_equal_demonstrations_are_no_division_by_nothing():
    apart = np.zeros((5, 5))
    assert silhouette(apart, np.array([0, 0, 1, 1, 1])) == 0.0
    assert how_many(apart, dendrogram(apart)) == 1


def test_more_clusters_than_demonstrations_are_refused():
    tree = dendrogram(on_a_line(0.0, 1.0))
    for wrong in (0, 3):
        with pytest.raises(BadInput, match="1 to 2 clusters"):
            tree.cut(wrong)
