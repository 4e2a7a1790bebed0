"""The starts of a policy as SVG: its grid world layer by layer, every cell marked by how it reaches the goal.

A cell is told apart by its mark (a dot, a stripe, a cross), and only then by its colour. A grid that is larger than can
be seen is drawn in blocks of cells, each as its worst start.
"""

from collections.abc import Iterator
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from skills.style.certificate import Coverage
from skills.style.grid import GridPath

KINDS = ("fails", "otherwise", "follows")  # the worst first
MOST_TILES, MOST_LAYERS = 36, 24  # of a side, and of the height: more cannot be seen on a page
TILE = 10  # units of the drawing, and of the marks' patterns in the template
SEEN_WELL = 11  # tiles of a side: with more of them start and goal are drawn larger than a tile


def layers(coverage: Coverage, path: GridPath) -> list[tuple[str, str]]:
    """Draw every layer of the grid, seen along z: (its z in mm, its SVG), the lowest first."""
    kinds, block = _tiles(coverage, path)
    grid = path.grid
    drawn = []
    for number in range(kinds.shape[2]):
        first, last = number * block, min((number + 1) * block, grid.shape[2]) - 1
        z_mm = [f"{grid.origin_mm[2] + grid.cell_mm * layer:g}" for layer in dict.fromkeys((first, last))]
        name = f"z {' to '.join(z_mm)} mm"
        drawn.append((name, _layer(kinds[:, :, number], name, _demonstration(path, first, last, block))))
    return drawn


def block_of(path: GridPath) -> int:
    """Say how many cells along each axis are drawn as one tile: 1 but for large grids."""
    nx, ny, nz = path.grid.shape
    return max(-(-max(nx, ny) // MOST_TILES), -(-nz // MOST_LAYERS))


def _tiles(coverage: Coverage, path: GridPath) -> tuple[NDArray[np.int8], int]:
    """Sort the starts into `KINDS`, (X, Y, Z) tiles, each as its worst start; and how many cells a tile has a side."""
    block, shape = block_of(path), path.grid.shape
    kinds = np.where(coverage.reaches, np.where(coverage.joins_nearest, 2, 1), 0).astype(np.int8).reshape(shape)
    for axis, side in enumerate(shape):
        kinds = np.minimum.reduceat(kinds, np.arange(0, side, block), axis=axis)
    return kinds, block


def _layer(kinds: NDArray[np.int8], name: str, demonstration: str) -> str:
    wide, high = (TILE * side for side in kinds.shape)
    tiles = "".join(_runs(kinds))
    return (
        f'<svg class="layer" viewBox="-2 -2 {wide + 4} {high + 4}" role="img" aria-label="The starts at {name}">{tiles}'
        f'<rect class="edge" x="0" y="0" width="{wide}" height="{high}"/>{demonstration}</svg>'
    )


def _runs(kinds: NDArray[np.int8]) -> Iterator[str]:
    """Draw the tiles of a layer, those of one kind that stand side by side as one; y grows upwards."""
    for down, row in enumerate(kinds.T[::-1].tolist()):
        right = 0
        for kind, run in groupby(row):
            wide = len(list(run))
            yield (
                f'<rect class="{KINDS[kind]}" x="{TILE * right}" y="{TILE * down}" width="{TILE * wide}" '
                f'height="{TILE}"/>'
            )
            right += wide


def _demonstration(path: GridPath, first: int, last: int, block: int) -> str:
    """Draw the demonstration where it is in these layers: its cells, its moves within them, its start and its goal."""
    nx, ny, _ = path.grid.shape
    unit = TILE / block  # a cell
    right, up = ((path.cells[:, :2] + 0.5) * unit).T
    places = np.stack([right, TILE * -(-ny // block) - up], axis=1).round(2)
    here = np.flatnonzero((path.cells[:, 2] >= first) & (path.cells[:, 2] <= last))
    stretches = np.split(here, np.flatnonzero(np.diff(here) > 1) + 1)
    drawn = [f'<polyline class="way" points="{_points(places[one])}"/>' for one in stretches if len(one) > 1]
    drawn += [
        f'<circle class="visited" cx="{x:g}" cy="{y:g}" r="{unit / 5:g}"/>'
        for x, y in np.unique(places[here], axis=0).tolist()
    ]
    large = max(1.0, max(nx, ny) / block / SEEN_WELL)
    if 0 in here:
        x, y = places[0].tolist()
        drawn.append(f'<circle class="from" cx="{x:g}" cy="{y:g}" r="{3.6 * large:g}"/>')
    if len(places) - 1 in here:
        x, y = places[-1].tolist()
        side = f"{5 * large:g}"
        drawn.append(f'<path class="to" d="M{x:g} {y - 5 * large:g}l{side} {side}l-{side} {side}l-{side} -{side}z"/>')
    return "".join(drawn)


def _points(places: NDArray[np.float64]) -> str:
    return " ".join(f"{x:g},{y:g}" for x, y in places.tolist())
