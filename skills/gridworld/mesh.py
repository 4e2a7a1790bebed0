"""Tissue of a mesh of triangles, as a height map that is nowhere below the mesh.

    points, triangles --tissue_of_mesh--> Tissue

The highest place of a mesh in a square of the map is at a point of the mesh, where an edge crosses the square's border,
or at the square's corner. A corner of the map gets the highest of these within one step of it, along each axis. Each
square has four such corners, so the surface between them, which is bilinear, is nowhere below the mesh.
"""

import numpy as np
from numpy.typing import ArrayLike

from skills.arithmetic import product
from skills.arrays import Floats, Ints
from skills.errors import BadSettings
from skills.fields import Point
from skills.gridworld.scene import LEAST_STEP_MM, MOST_HEIGHTS, Tissue
from skills.quaternions import unit

ROUNDING = 1e-9  # steps; points this near a line of the map count to both of its sides


def tissue_of_mesh(
    points_mm: ArrayLike, triangles: ArrayLike, normal: Point, *, step_mm: float = 1.0, beyond_mm: float | None = None
) -> Tissue:
    """Return the height map of a mesh of triangles.

    Only what is visible from above counts: below its highest place along the normal all is tissue. With slopes of at
    most L the map is at most 2 sqrt(2) L step_mm too high.

    Args:
        points_mm: Points of the mesh in the frame of the scene, (n, 3).
        triangles: Indices of the three points of each triangle, in any order, (m, 3).
        normal: Direction out of the tissue; any length.
        step_mm: Distance of the map's points; half of the smallest shape that matters, or less.
        beyond_mm: Height of the tissue along the normal where the map has a point and the mesh has nothing, measured
            from the origin of the frame; None refuses such a mesh. Holes between the map's points are not seen.

    Raises:
        BadSettings: Arrays have other shapes or contain numbers that are not finite or indices of no point; the map
            would have too many points or none; or the mesh has a hole.
    """
    points, corners = np.asarray(points_mm, float), np.asarray(triangles)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise BadSettings("The points of a mesh must be finite, of shape (n, 3).", shape=str(points.shape))
    if corners.ndim != 2 or corners.shape[1] != 3 or not len(corners) or corners.dtype.kind not in "iu":
        raise BadSettings("The triangles of a mesh must be integers of shape (m, 3).", shape=str(corners.shape))
    if not (corners.min() >= 0 and corners.max() < len(points)):
        raise BadSettings(f"A triangle of a mesh names a point that is not among its {len(points)}.")
    if not (np.isfinite(step_mm) and step_mm >= LEAST_STEP_MM):
        raise BadSettings(f"step_mm of a height map must be {LEAST_STEP_MM:g} or more.", step_mm=step_mm)
    plane = Tissue.plane((0.0, 0.0, 0.0), normal)
    up, along = unit(np.array([normal, plane.along]))
    axes = np.stack([along, np.cross(up, along)])
    of_points = np.column_stack([product(points, axes.T) / step_mm, product(points, up)])  # (n, 3): steps, steps, mm
    places = of_points[corners]  # (m, 3, 3)
    flat = places.reshape(-1, 3)
    first = np.ceil(flat[:, :2].min(axis=0) - ROUNDING)
    shape = np.floor(flat[:, :2].max(axis=0) + ROUNDING) - first + 1
    if not shape.min() >= 1:
        raise BadSettings("The mesh is smaller than step_mm; use a smaller step_mm.", step_mm=step_mm)
    if not shape.prod() <= MOST_HEIGHTS:
        raise BadSettings(
            f"The height map of this mesh would have {shape.prod():.0f} points, and {MOST_HEIGHTS} are the most; use a "
            "larger step_mm, or the part of the mesh that is near the path.",
            step_mm=step_mm,
        )
    places[..., :2] -= first
    heights = np.full(shape.astype(int), -np.inf)
    inside = _inside(places, heights.shape)
    covered = np.zeros(heights.shape, bool)
    covered[tuple(inside[:, :2].astype(int).T)] = True
    for some in (places.reshape(-1, 3), _crossings(places, 0), _crossings(places, 1), inside):
        _raise_around(heights, some)
    if not covered.all():
        if beyond_mm is None:
            missing = int((~covered).sum())
            raise BadSettings(
                f"The mesh covers {covered.size - missing} of the {covered.size} points of its height map. Cut a "
                "rectangle out of it, or state beyond_mm, the height of the tissue where the mesh has nothing.",
                missing=missing,
            )
        heights = np.where(covered, heights, np.maximum(heights, beyond_mm))
    x, y, z = product(first * step_mm, axes).tolist()
    rows = tuple(tuple(row) for row in heights.tolist())
    return Tissue((x, y, z), normal, plane.along, step_mm, rows)


def _inside(places: Floats, shape: tuple[int, ...]) -> Floats:
    """Return the points of the map that are below or above a triangle, with its height there, (n, 3)."""
    found = [np.empty((0, 3))]
    for (a, b, c), low, high in zip(places, places.min(axis=1), places.max(axis=1), strict=True):
        (u, v), w = (b - a)[:2], (c - a)[:2]
        twice_area = u * w[1] - v * w[0]
        if abs(twice_area) < ROUNDING:
            continue  # upright: its edges have its highest places
        rows, columns = (
            np.arange(max(np.ceil(low[k] - ROUNDING), 0), min(np.floor(high[k] + ROUNDING), shape[k] - 1) + 1)
            for k in (0, 1)
        )
        at = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
        x, y = (at - a[:2]).T
        to_b, to_c = (x * w[1] - y * w[0]) / twice_area, (y * u - x * v) / twice_area
        held = (to_b >= -ROUNDING) & (to_c >= -ROUNDING) & (to_b + to_c <= 1 + ROUNDING)
        rises = a[2] + to_b * (b - a)[2] + to_c * (c - a)[2]
        found.append(np.column_stack([at, rises])[held])
    return np.concatenate(found)


def _crossings(places: Floats, axis: int) -> Floats:
    """Return the points where edges cross the map's lines at whole steps along an axis, (n, 3)."""
    a, b = (np.concatenate([places[:, k] for k in order]) for order in ((0, 1, 2), (1, 2, 0)))
    low, high = np.ceil(np.minimum(a, b)[:, axis]), np.floor(np.maximum(a, b)[:, axis])
    counts: Ints = np.where(a[:, axis] == b[:, axis], 0, np.maximum(high - low + 1, 0)).astype(np.int64)
    edge = np.repeat(np.arange(len(a)), counts)
    line = low[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (line - a[edge, axis]) / (b[edge, axis] - a[edge, axis])
    return np.asarray(a[edge] + share[:, None] * (b[edge] - a[edge]))


def _raise_around(heights: Floats, places: Floats) -> None:
    """Raise the map's points within one step of each place, along each axis, to its height."""
    nearest = np.ceil(places[:, :2] - 1 - ROUNDING).astype(np.int64)
    for row in range(3):
        for column in range(3):
            at = nearest + np.array([row, column])
            near = (at <= places[:, :2] + 1 + ROUNDING) & (at >= 0) & (at < heights.shape)
            known = near.all(axis=1)
            np.maximum.at(heights, tuple(at[known].T), places[known, 2])
