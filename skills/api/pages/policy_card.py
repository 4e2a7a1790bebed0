"""The policy card as one standalone HTML file, and its drawings of the policy's coverage of the grid world.

The grid world is drawn by layers, each cell marked by how its start reaches the goal: by its mark (a dot, a stripe, a
cross) first and by its colour second. If the grid is larger than can be seen, a tile stands for a block of cells, drawn
as its worst start.
"""

from collections.abc import Iterator
from itertools import groupby
from math import hypot

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from skills.api.pages.demonstration import path_views
from skills.api.pages.page import standalone
from skills.api.pages.svg import box, dots, drawing, element, group, line
from skills.gridworld.grid import GridPath
from skills.gridworld.path_report import discretisation_rmse
from skills.learning.certificate import Coverage
from skills.library.cards import Card

KINDS = ("fails", "otherwise", "follows")  # the worst first
MOST_TILES, MOST_LAYERS = 36, 24  # tiles along x and y, and layers along z: more cannot be seen on a page
TILE = 10  # side of a tile, in units of the drawing; the mark patterns in the template have the same size
SEEN_WELL = 11  # tiles along a side: with more, start and goal are drawn larger than a tile


def card_page(card: Card) -> str:
    """Return the HTML of a policy card."""
    facts, partner = card.written(), card.demo.partner
    return standalone(
        "card",
        card=facts,
        metric={one["name"]: one for one in facts["metrics"]},
        path_states=len(card.path.states),
        lost_mm=hypot(*discretisation_rmse(card.demo.tip_mm, card.path.grid, card.path.hysteresis)),
        views=path_views(card.demo, card.path, card.combined),
        layers=layers(card.coverage, card.path),
        block=block_of(card.path),
        pauses=bool(card.demo.pauses),
        partner=None if partner is None else partner.arm,
        code=_code,
    )


def _code(text: str) -> Markup:
    """Escape a text, and mark up the parts between backticks as code."""
    parts = enumerate(text.split("`"))
    return group(Markup("<code>{}</code>").format(part) if odd % 2 else escape(part) for odd, part in parts)


def layers(coverage: Coverage, path: GridPath) -> list[tuple[str, Markup]]:
    """Draw every layer of the grid, seen along z: (its z in mm, SVG), the lowest first."""
    kinds, block = _tiles(coverage, path)
    grid = path.grid
    drawn = []
    for number in range(kinds.shape[2]):
        first, last = number * block, min((number + 1) * block, grid.shape[2]) - 1
        z_mm = [f"{grid.origin_mm[2] + grid.cell_mm * layer:g}" for layer in dict.fromkeys((first, last))]
        name = f"z {' to '.join(z_mm)} mm"
        wide, high = (TILE * side for side in kinds.shape[:2])
        parts = (*_runs(kinds[:, :, number]), box("edge", 0, 0, wide, high), *_demonstration(path, first, last, block))
        drawn.append((name, drawing(f"The starts at {name}", (-2, -2), (wide + 4, high + 4), *parts, kind="layer")))
    return drawn


def block_of(path: GridPath) -> int:
    """Return the number of cells along each axis that are drawn as one tile: 1 except for large grids."""
    nx, ny, nz = path.grid.shape
    return max(-(-max(nx, ny) // MOST_TILES), -(-nz // MOST_LAYERS))


def _tiles(coverage: Coverage, path: GridPath) -> tuple[NDArray[np.int8], int]:
    """Classify the starts by `KINDS`: tiles, shape (X, Y, Z), each as its worst start; and the cells per side."""
    block, shape = block_of(path), path.grid.shape
    kinds = np.where(coverage.reaches, np.where(coverage.joins_nearest, 2, 1), 0).astype(np.int8).reshape(shape)
    for axis, side in enumerate(shape):
        kinds = np.minimum.reduceat(kinds, np.arange(0, side, block), axis=axis)
    return kinds, block


def _runs(kinds: NDArray[np.int8]) -> Iterator[Markup]:
    """Draw the tiles of a layer, adjacent ones of a kind as one rectangle; y increases upwards."""
    for down, row in enumerate(kinds.T[::-1].tolist()):
        right = 0
        for kind, run in groupby(row):
            wide = len(list(run))
            yield box(KINDS[kind], TILE * right, TILE * down, TILE * wide, TILE)
            right += wide


def _demonstration(path: GridPath, first: int, last: int, block: int) -> Iterator[Markup]:
    """Draw the part of the demonstration in these layers: its cells, its moves within them, its start and its goal."""
    nx, ny, _ = path.grid.shape
    unit = TILE / block  # a cell
    right, up = ((path.cells[:, :2] + 0.5) * unit).T
    places = np.stack([right, TILE * -(-ny // block) - up], axis=1).round(2)
    here = np.flatnonzero((path.cells[:, 2] >= first) & (path.cells[:, 2] <= last))
    stretches = np.split(here, np.flatnonzero(np.diff(here) > 1) + 1)
    yield from (line("way", places[one]) for one in stretches if len(one) > 1)
    yield dots("visited", np.unique(places[here], axis=0), unit / 5)
    large = max(1.0, max(nx, ny) / block / SEEN_WELL)
    if 0 in here:
        yield dots("from", places[:1], 3.6 * large)
    if len(places) - 1 in here:
        (x, y), side = places[-1].tolist(), 5 * large
        yield element(
            "path", kind="to", d=f"M{x:g} {y - side:g}l{side:g} {side:g}l-{side:g} {side:g}l-{side:g} -{side:g}z"
        )
