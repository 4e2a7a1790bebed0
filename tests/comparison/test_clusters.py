"""Clusters: by hand, against scikit-learn, by laws, and on a cohort of known truth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.comparison.distances import WORTH, dendrogram, distances, how_many, shape_of, silhouette
from skills.errors import BadInput
from tests.comparison.cohort import cohort


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
