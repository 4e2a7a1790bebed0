"""Quaternions x, y, z, w: products, turned points, rotation vectors, orientations between others, and their mean.

They are arrays of shape (..., 4) and of length 1, which `of_vector` and `dominant` return and the others expect; q and
-q are the same orientation. All results have the same bits on every processor (`skills.arithmetic`).
"""

import numpy as np

from skills.arithmetic import arctan2, cos, product, sin
from skills.arrays import Floats

INVERSE = np.array([-1.0, -1.0, -1.0, 1.0])  # a unit quaternion times this is its inverse
_SQUARINGS = 60  # of a matrix: by then a second eigenvalue that is smaller by 1e-15 is gone


def unit(quaternions: Floats) -> Floats:
    """Return quaternions, or other rows, divided by their lengths."""
    return np.asarray(quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True))


def multiplied(one: Floats, other: Floats) -> Floats:
    """Return the products of quaternions: the turn `other`, then the turn `one`."""
    v, w = one[..., :3], one[..., 3:]
    u, t = other[..., :3], other[..., 3:]
    vector = w * u + t * v + np.cross(v, u)
    return np.concatenate([vector, w * t - (v * u).sum(axis=-1, keepdims=True)], axis=-1)


def turned(turns: Floats, points_mm: Floats) -> Floats:
    """Return points, shape (..., 3), turned by quaternions."""
    across = 2.0 * np.cross(turns[..., :3], points_mm)
    return np.asarray(points_mm + turns[..., 3:] * across + np.cross(turns[..., :3], across))


def angle_of(turns: Floats) -> Floats:
    """Return the angles of turns, rad, 0 to pi, shape (...,)."""
    return 2.0 * arctan2(np.linalg.norm(turns[..., :3], axis=-1), np.abs(turns[..., 3]))


def vector_of(turns: Floats) -> Floats:
    """Return the rotation vectors of turns, rad, at most half a turn long, shape (..., 3)."""
    length = np.linalg.norm(turns[..., :3], axis=-1)
    by = np.where(length > 0, angle_of(turns) / np.where(length > 0, length, 1.0), 2.0)
    return np.asarray(turns[..., :3] * np.copysign(by, turns[..., 3])[..., None])


def of_vector(vector_rad: Floats) -> Floats:
    """Return the quaternions of rotation vectors, shape (..., 3): the axis times the angle."""
    angle = np.linalg.norm(vector_rad, axis=-1, keepdims=True)
    by = np.where(angle > 0, sin(angle / 2) / np.where(angle > 0, angle, 1.0), 0.5)
    return np.concatenate([vector_rad * by, cos(angle / 2)], axis=-1)


def between(one: Floats, other: Floats, shares: Floats) -> Floats:
    """Return the orientations at shares, (...,), of the shorter turn from one to another (slerp)."""
    return multiplied(one, of_vector(shares[..., None] * vector_of(multiplied(one * INVERSE, other))))


def dominant(matrices: Floats) -> Floats:
    """Return the eigenvectors of the largest eigenvalues, (..., 4), of symmetric matrices without negative ones.

    They are those of the matrices' squares of squares, of which in the end nothing else is left. The largest component
    is positive.

    Args:
        matrices: Shape (..., 4, 4), none of them zero.
    """
    for _ in range(_SQUARINGS):
        scaled = matrices / np.trace(matrices, axis1=-2, axis2=-1)[..., None, None]
        matrices = product(scaled, scaled)
        if (np.abs(matrices - scaled) <= np.finfo(float).eps).all():
            break
    largest = np.diagonal(matrices, axis1=-2, axis2=-1).argmax(axis=-1)
    return unit(np.take_along_axis(matrices, largest[..., None, None], axis=-2)[..., 0, :])


def best_turn(covariance: Floats) -> Floats:
    """Return the turn that best leads from points to others, shape (4,), by their covariance (Kabsch's problem).

    It is the dominant eigenvector of a matrix of Davenport's (Horn, Closed-form absolute orientation, 1987).

    Args:
        covariance: The sum of the outer products of the other points with the points, shape (3, 3).
    """
    size, least = np.trace(covariance), np.abs(covariance).sum()
    across = covariance[[2, 0, 1], [1, 2, 0]] - covariance[[1, 2, 0], [2, 0, 1]]
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = covariance + covariance.T - size * np.eye(3)
    matrix[:3, 3] = matrix[3, :3] = across
    matrix[3, 3] = size + np.finfo(float).tiny  # of points that all are in one place, no turn
    return dominant(matrix + least * np.eye(4))


def mean_rotation(rotation_xyzw: Floats, weights: Floats) -> Floats:
    """Return the weighted mean orientation at each phase.

    It is the eigenvector of the largest eigenvalue of the weighted sum of outer products, so q and -q are the same.

    Args:
        rotation_xyzw: Orientations of K demonstrations, unit quaternions, shape (K, P, 4).
        weights: The weight of each demonstration, shape (K,).

    Returns:
        Unit quaternions of either sign, shape (P, 4).
    """
    return dominant(np.einsum("k,kpi,kpj->pij", weights, rotation_xyzw, rotation_xyzw))
