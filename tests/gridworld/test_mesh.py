"""Meshes of tissue: the map is nowhere below the mesh, exact where it is flat, and a hole is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from skills.errors import BadSettings
from skills.gridworld.mesh import tissue_of_mesh
from skills.gridworld.scene import MOST_HEIGHTS, Scene

SQUARE = [[0, 0, 2], [10, 0, 2], [0, 10, 2], [10, 10, 2]]
HALVES = [[0, 1, 2], [3, 2, 1]]
UP = (0.0, 0.0, 1.0)


def hills(seed, count=60, size_mm=12.0):
    """Return the points and triangles of a rough surface above a square."""
    rng = np.random.default_rng(seed)
    corners = size_mm * np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    xy = np.concatenate([corners, rng.uniform(0, size_mm, (count, 2))])
    return np.column_stack([xy, rng.normal(0, 3, len(xy))]), Delaunay(xy).simplices


def on(points, triangles, rng):
    """Return places on a mesh: in each triangle, on its edges, and its corners."""
    shares = rng.dirichlet((0.5, 0.5, 0.5), (len(triangles), 8))
    shares[:, 0], shares[:, 1, 0] = (0, 0, 1), 0
    shares /= shares.sum(axis=2, keepdims=True)
    return (shares[..., None] * points[triangles][:, None]).sum(axis=2).reshape(-1, 3)


def turn_of(rng):
    """Return a random rotation."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return turn * np.sign(np.linalg.det(turn))


@given(seed=st.integers(0, 10**6), step_mm=st.sampled_from([0.5, 1.0, 3.0]))
def test_no_place_of_a_mesh_in_any_pose_is_above_its_map(seed, step_mm):
    points, triangles = hills(seed)
    rng = np.random.default_rng(seed)
    turn, shift = turn_of(rng), rng.normal(0, 50, 3)
    points = points @ turn.T + shift
    tissue = tissue_of_mesh(points, triangles, tuple(turn[:, 2]), step_mm=step_mm, beyond_mm=-1000.0)
    assert tissue.above_mm(on(points, triangles, rng)).max() <= 1e-6


def test_a_flat_mesh_is_the_plane():
    tissue = tissue_of_mesh(SQUARE, HALVES, (0.0, 0.0, 3.0))
    at = np.random.default_rng(1).uniform((-5, -5, -5), (15, 15, 15), (50, 3))
    assert tissue.above_mm(at) == pytest.approx(at[:, 2] - 2)


def test_a_slope_is_too_high_by_two_steps_at_most():
    points = np.add(SQUARE, [[0, 0, 0], [0, 0, 5], [0, 0, 0], [0, 0, 5]])
    tissue = tissue_of_mesh(points, HALVES, UP)
    high = -tissue.above_mm(on(points, np.array(HALVES), np.random.default_rng(2)))
    assert high.min() >= 0 and high.max() <= 0.5 * 2 + 1e-9


def test_of_a_closed_mesh_the_upper_side_counts():
    low = np.array(SQUARE, float) - [0, 0, 8]
    sides = [[0, 1, 5], [0, 5, 4], [1, 3, 7], [1, 7, 5]]
    closed = tissue_of_mesh(np.concatenate([SQUARE, low]), [*HALVES, [4, 5, 6], [7, 6, 5], *sides], UP)
    assert closed.above_mm([[5, 5, 2.5], [5, 5, -2]]) == pytest.approx([0.5, -4])


def test_a_spike_between_the_points_of_the_map_is_not_lost():
    points = [*SQUARE, [5.5, 5.5, 40]]
    tissue = tissue_of_mesh(points, [[0, 1, 4], [1, 3, 4], [3, 2, 4], [2, 0, 4]], UP, step_mm=2.0)
    assert Scene("base", tissue=tissue).touches([5.5, 5.5, 60], [5.5, 5.5, 39.9])


def test_a_mesh_with_a_hole_is_refused_or_gets_the_stated_height():
    with pytest.raises(BadSettings, match="covers 66 of the 121 points"):
        tissue_of_mesh(SQUARE, HALVES[:1], UP)
    filled = tissue_of_mesh(SQUARE, HALVES[:1], UP, beyond_mm=-4.0)
    assert filled.above_mm([[1, 1, 0], [9, 9, 0]]) == pytest.approx([-2, 4])


@pytest.mark.parametrize(
    ("points", "triangles", "how", "words"),
    [
        ([[0, 0, np.nan]], [[0, 0, 0]], {}, "finite"),
        ([[0, 0]], [[0, 0, 0]], {}, r"\(n, 3\)"),
        (SQUARE, [[0, 1]], {}, r"\(m, 3\)"),
        (SQUARE, [], {}, r"\(m, 3\)"),
        (SQUARE, [[0.0, 1.0, 2.0]], {}, "integers"),
        (SQUARE, [[0, 1, 4]], {}, "not among its 4"),
        (SQUARE, [[0, 1, -1]], {}, "not among its 4"),
        (SQUARE, HALVES, {"step_mm": 0.01}, "step_mm"),
        (SQUARE, HALVES, {"step_mm": np.nan}, "step_mm"),
        (SQUARE, HALVES, {"step_mm": 0.1}, f"{MOST_HEIGHTS} are the most"),
        ([[0.2, 0.2, 0], [0.4, 0.2, 0], [0.2, 0.4, 0]], [[0, 1, 2]], {}, "smaller than step_mm"),
        (SQUARE, HALVES[:1], {"beyond_mm": np.nan}, "not finite"),
    ],
)
def test_an_impossible_mesh_is_refused(points, triangles, how, words):
    with pytest.raises(BadSettings, match=words):
        tissue_of_mesh(points, triangles, UP, **how)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 0.0), (np.nan, 0.0, 1.0)])
def test_a_mesh_needs_a_direction_out_of_it(normal):
    with pytest.raises(BadSettings):
        tissue_of_mesh(SQUARE, HALVES, normal)
