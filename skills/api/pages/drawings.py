"""SVG drawings of the pages, and the two standalone pages made of them: the report to the surgeon and the policy card.

The markup is in `templates/drawings.html`; the functions here compute its numbers. Colours and line styles are
in the style sheet of the page and chosen by class, so that a drawing follows the light or dark theme. Lengths are
pixels. Colour never stands alone:

* A score shows distance from the reference by colour and by line width, in steps of half, one, two and four cells of
  the paper's grid.
* Layers of a grid world mark each cell by how its start reaches the goal: a dot, a stripe or a cross first, a colour
  second. If the grid is larger than can be seen, a tile stands for a block of cells, drawn as its worst start.
* An atlas distinguishes surgeons by marker first: with six colours and seven markers, 42 surgeons have one of their
  own. If there are more demonstrations than can be seen, they are drawn in groups, as the dendrogram joins them.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from math import ceil, floor, hypot, log10
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from skills.api.pages import standalone, templates
from skills.arrays import Floats
from skills.comparison.combining import Combined
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import smoothed_speed
from skills.demonstration.quality import describe_count, pieces_of
from skills.gridworld import paper
from skills.gridworld.grid import GridPath, discretisation_rmse
from skills.learning.certificate import Coverage
from skills.library.policies.cards import Card
from skills.schemas.comparison import Atlas
from skills.schemas.demos import Demonstration
from skills.schemas.scores import CurvePoint
from skills.scoring.deviation import Deviation

VIEW, COURSE = (320, 328), (1000, 190)  # size of a view along an axis, and of a plot over time or along the path
MOST_POINTS = 1500  # per line: more cannot be seen
AXES = "xyz"
ALONG_AXES = ((0, 1), (0, 2), (1, 2))
# a view of a score: its axes, their names and its own
OF_SCORE = (
    (0, 2, "along", "up", "from the side"),
    (0, 1, "along", "left", "from above"),
    (1, 2, "left", "up", "head on"),
)
STEPS_MM = tuple(paper.CELL_MM * times for times in (0.5, 1.0, 2.0, 4.0))  # bounds between five line widths and colours
KINDS = ("fails", "otherwise", "alone", "part", "most")  # the worst first
HALF = 0.5  # share of the demonstration that separates the two last kinds
MOST_TILES, MOST_LAYERS = 36, 24  # tiles along x and y, and layers along z: more cannot be seen on a page
TILE = 10  # side of a tile, in units of the drawing; the mark patterns in the template have the same size
SEEN_WELL = 11  # tiles along a side: with more, start and goal are drawn larger than a tile
WIDE, HIGH, MARGIN = 640, 440, 34  # of the chart
TREE, CELL, MOST_GROUPS = 150, 11, 48  # width of the dendrogram, side of a cell, and largest number of rows
SHADES = 9  # of distance: the eye distinguishes no more


def draw(name: str, **numbers: Any) -> Markup:
    """Return the drawing of a name in `templates/drawings.html`, which has its markup."""
    drawn: Markup = getattr(templates().get_template("drawings.html").module, name)(**numbers)
    return drawn


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Return round numbers between two limits, at steps of at least a `most`-th of the range."""
    rough = (high - low) / most
    power = 10.0 ** floor(log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough)
    return [round(number * step, 9) for number in range(ceil(low / step), floor(high / step) + 1)]


@dataclass(frozen=True)
class Plot:
    """Axes: the limits of the data, `low` and `high` as (x, y), and the edges in a drawing of `size` between them."""

    low: tuple[float, float]
    high: tuple[float, float]
    size: tuple[int, int]
    left: float
    top: float
    right: float
    bottom: float

    @property
    def scale(self) -> float:
        """Pixels per unit of x."""
        return (self.right - self.left) / (self.high[0] - self.low[0])

    def place(self, points: Floats) -> Floats:
        """Return points, shape (T, 2), in pixels; y increases upwards."""
        share = (points - np.array(self.low)) / np.subtract(self.high, self.low)
        return np.asarray(share * (self.right - self.left, self.top - self.bottom) + (self.left, self.bottom))

    def x(self, value: float) -> float:
        """Return the pixel of a value of x."""
        return float(self.place(np.array([[value, self.low[1]]]))[0, 0])

    def y(self, value: float) -> float:
        """Return the pixel of a value of y."""
        return float(self.place(np.array([[self.low[0], value]]))[0, 1])

    def ticks(self, axis: int, most: int = 6) -> list[float]:
        """Return at most so many round numbers along an axis, 0 for x and 1 for y."""
        return ticks(self.low[axis], self.high[axis], most)


def _view_of(points: Floats, axes: tuple[int, int]) -> Plot:
    """Return the axes of a view of points, shape (T, 3); its scale is the same for all pairs of axes."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = float((high - low).max()) * 0.525 or 0.5
    (x, y) = ((low + high) / 2)[list(axes)].tolist()
    return Plot((x - half, y - half), (x + half, y + half), VIEW, 34, 16, VIEW[0] - 8, VIEW[1] - 34)


def _course(end: float, top: float, start: float = 0.0) -> Plot:
    return Plot((start, 0.0), (end, top), COURSE, 34, 14, COURSE[0] - 12, COURSE[1] - 34)


# ---- the report --------------------------------------------------------------------------------------------------


def report_page(about: Demonstration, demo: Demo, path: GridPath) -> str:
    """Return the HTML of the quality report to the surgeon: advice, path, speed and figures.

    Args:
        about: The demonstration, with its whole report.
        demo: Its motion.
        path: Its path in its grid.
    """
    return standalone(
        "demo_report",
        about=about,
        report=about.report,
        views=path_views(demo, path),
        speed=speed(demo, about.report.a1_s),
        pauses=bool(demo.pauses),
        partner=None if demo.partner is None else demo.partner.arm,
        times=describe_count,
    )


def path_views(demo: Demo, path: GridPath, combined: Combined | None = None) -> list[Markup]:
    """Draw the path as recorded and in its grid, seen along z, y and x, all at one scale.

    If several demonstrations were combined, the corridor of the combination is drawn behind the path.
    """
    half = path.grid.cell_mm / 2
    partner = [] if demo.partner is None else [demo.partner.position_mm]
    seen = np.concatenate((demo.tip_mm, path.tip_mm - half, path.tip_mm + half, np.reshape(partner, (-1, 3))))
    return [_path_view(demo, path, combined, axes, _view_of(seen, axes)) for axes in ALONG_AXES]


def _path_view(demo: Demo, path: GridPath, combined: Combined | None, axes: tuple[int, int], plot: Plot) -> Markup:
    def place(points: Any) -> Floats:
        return plot.place(np.reshape(points, (-1, 3))[:, axes])

    pieces = pieces_of(demo)
    corridor = [] if combined is None else zip(place(combined.tip_mm), combined.width_mm * plot.scale, strict=True)
    return draw(
        "path_view",
        plot=plot,
        right=AXES[axes[0]],
        up=AXES[axes[1]],
        cell=path.grid.cell_mm * plot.scale,
        cells=np.unique(place(path.tip_mm).round(2), axis=0),
        corridor=corridor,
        states=place(path.tip_mm),
        pauses=[place(demo.tip_mm[[one.stop - 1, other.start]]) for one, other in pairwise(pieces)],
        pieces=[place(_thinned(demo.tip_mm[piece])) for piece in pieces],
        start=place(demo.tip_mm[0]),
        goal=place(demo.tip_mm[-1]),
        partner=[] if demo.partner is None else place(demo.partner.position_mm),
    )


def _thinned(points: Floats) -> Floats:
    """Return every n-th point, shape (T, 2 or 3), at most about `MOST_POINTS`; the last one is always included."""
    every = -(-len(points) // MOST_POINTS)
    return np.concatenate((points[:-1:every], points[-1:]))


def speed(demo: Demo, a1_s: float) -> Markup:
    """Draw the smoothed speed over time, with pauses shaded, and the time at which A1 ends and A2 begins."""
    end_s = float(demo.stamps_s[-1])
    moving = [piece for piece in pieces_of(demo) if piece.stop - piece.start > 1]
    speeds = [smoothed_speed(demo.stamps_s[piece], demo.tip_mm[piece]) for piece in moving]
    plot = _course(end_s, max([float(one.max()) for _, one in speeds], default=0.0) * 1.08 or 1.0)
    return draw(
        "speed",
        plot=plot,
        pauses=demo.pauses,
        a1_s=a1_s,
        has_a2=end_s - a1_s > 0.02 * end_s,
        speeds=[_thinned(plot.place(np.stack([seconds - demo.stamps_s[0], one], axis=1))) for seconds, one in speeds],
    )


# ---- the score ---------------------------------------------------------------------------------------------------


def score_key() -> list[tuple[str, str]]:
    """Return the legend of the five steps: (CSS class, words)."""
    bounds = [f"{step:g}" for step in STEPS_MM]
    words = [f"up to {bounds[0]} mm", *(f"to {bound} mm" for bound in bounds[1:]), "more"]
    return [(f"apart-{number}", one) for number, one in enumerate(words)]


def deviation_views(deviation: Deviation) -> list[tuple[str, Markup]]:
    """Draw the path over the reference, seen along each axis at one scale: (name of the view, SVG)."""
    path, reference = (np.array(way) for way in (deviation.path_mm, deviation.reference_mm))
    drawn = []
    for a, b, right, up, name in OF_SCORE:
        plot = _view_of(np.concatenate([path, reference]), (a, b))
        placed = plot.place(path[:, (a, b)])
        ways = _steps(placed, np.array(deviation.apart_mm))
        across = {"plot": plot, "right": right, "up": up, "reference": plot.place(reference[:, (a, b)])}
        drawn.append((name, draw("deviation_view", **across, ways=ways, start=placed[:1], goal=placed[-1:])))
    return drawn


def deviation_along(deviation: Deviation) -> Markup:
    """Draw the distance from the reference along the path, divided into its thirds."""
    apart = np.array(deviation.apart_mm)
    plot = _distances(apart, 1.1)
    ways = _steps(plot.place(np.stack([np.arange(len(apart)), apart], axis=1)), apart)
    return draw("deviation_along", plot=plot, last=len(apart) - 1, ways=ways)


def score_curve(curve: Sequence[CurvePoint], scored: str) -> Markup:
    """Draw the distances of a surgeon's demonstrations in recording order; `scored` is the digest of the scored one."""
    apart = np.array([one.distance_mm for one in curve])
    plot = _distances(apart, 1.15)
    spots = plot.place(np.stack([np.arange(len(apart)), apart], axis=1))
    is_scored = np.array([one.demo == scored for one in curve])
    shown = np.unique(np.linspace(0, len(apart) - 1, min(len(apart), 10)).round().astype(int)).tolist()
    return draw("score_curve", plot=plot, spots=spots, before=spots[~is_scored], scored=spots[is_scored], shown=shown)


def _distances(apart_mm: Floats, room: float) -> Plot:
    """Return the axes of distances in a row, shape (T,), with some room at the sides and above."""
    last = max(1, len(apart_mm) - 1)
    return _course(1.006 * last, max(float(apart_mm.max()) * room, STEPS_MM[0]), start=-0.006 * last)


def _steps(spots: Floats, apart_mm: Floats) -> list[tuple[int, Floats]]:
    """Return the segments of a path, pixels of shape (T, 2), each with the step of the larger distance at its ends."""
    steps = np.searchsorted(STEPS_MM, apart_mm).tolist()
    return [(max(steps[i : i + 2]), spots[i : i + 2]) for i in range(len(spots) - 1)]


# ---- the policy card -----------------------------------------------------------------------------------------------


def card_page(card: Card) -> str:
    """Return the HTML of a policy card."""
    facts, partner = card.facts, card.demo.partner
    return standalone(
        "card",
        card=facts,
        training=vars(facts.learner.training),
        reward_levels=vars(facts.learner.reward_levels),
        metric={one.name: one for one in facts.metrics},
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
    return Markup().join(Markup("<code>{}</code>").format(part) if odd % 2 else part for odd, part in parts)


def layers(coverage: Coverage, path: GridPath) -> list[tuple[str, Markup]]:
    """Draw every layer of the grid, seen along z: (its z in mm, SVG), the lowest first."""
    kinds, block = _tiles(coverage, path)
    grid = path.grid
    drawn = []
    for number in range(kinds.shape[2]):
        first, last = number * block, min((number + 1) * block, grid.shape[2]) - 1
        z_mm = [f"{grid.origin_mm[2] + grid.cell_mm * layer:g}" for layer in dict.fromkeys((first, last))]
        name = f"z {' to '.join(z_mm)} mm"
        size = {"wide": TILE * kinds.shape[0], "high": TILE * kinds.shape[1]}
        numbers = {"runs": [*_runs(kinds[:, :, number])], **_cells_of_path(path, first, last, block)}
        drawn.append((name, draw("layer", at=name, **size, **numbers)))
    return drawn


def block_of(path: GridPath) -> int:
    """Return the number of cells along each axis that are drawn as one tile: 1 except for large grids."""
    nx, ny, nz = path.grid.shape
    return max(-(-max(nx, ny) // MOST_TILES), -(-nz // MOST_LAYERS))


def _tiles(coverage: Coverage, path: GridPath) -> tuple[NDArray[np.int8], int]:
    """Classify the starts by `KINDS`: tiles, shape (X, Y, Z), each as its worst start; and the cells per side."""
    block, shape = block_of(path), path.grid.shape
    followed = np.select([coverage.share == 0, coverage.share < HALF], [KINDS.index("alone"), KINDS.index("part")], 4)
    kinds = np.where(coverage.reaches, np.where(coverage.joins_nearest, followed, 1), 0).astype(np.int8).reshape(shape)
    for axis, side in enumerate(shape):
        kinds = np.minimum.reduceat(kinds, np.arange(0, side, block), axis=axis)
    return kinds, block


def _runs(kinds: NDArray[np.int8]) -> Iterator[tuple[str, int, int, int, int]]:
    """Yield the tiles of a layer, adjacent ones of a kind as one rectangle; y increases upwards."""
    for down, row in enumerate(kinds.T[::-1].tolist()):
        right = 0
        for kind, run in groupby(row):
            wide = len(list(run))
            yield KINDS[kind], TILE * right, TILE * down, TILE * wide, TILE
            right += wide


def _cells_of_path(path: GridPath, first: int, last: int, block: int) -> dict[str, object]:
    """Return the part of the demonstration in these layers: its moves within them, its cells, and its ends."""
    nx, ny, _ = path.grid.shape
    unit = TILE / block  # a cell
    right, up = ((path.cells[:, :2] + 0.5) * unit).T
    places = np.stack([right, TILE * -(-ny // block) - up], axis=1).round(2)
    here = np.flatnonzero((path.cells[:, 2] >= first) & (path.cells[:, 2] <= last))
    stretches = np.split(here, np.flatnonzero(np.diff(here) > 1) + 1)
    return {
        "ways": [places[one] for one in stretches if len(one) > 1],
        "visited": np.unique(places[here], axis=0),
        "unit": unit,
        "start": places[:1] if 0 in here else [],
        "goal": places[-1:] if len(places) - 1 in here else [],
        "large": max(1.0, max(nx, ny) / block / SEEN_WELL),
    }


# ---- the atlas: markers and chart ----------------------------------------------------------------------------------


def _numbers(atlas: Atlas) -> dict[str, int]:
    """Return the number of each surgeon, which decides about the marker."""
    return {one.surgeon: number for number, one in enumerate(atlas.surgeons)}


def keys(atlas: Atlas) -> dict[str, Markup]:
    """Return the marker of each surgeon as a drawing of its own, to stand next to the name."""
    return {surgeon: draw("key", number=number) for surgeon, number in _numbers(atlas).items()}


def chart(atlas: Atlas) -> Markup:
    """Draw every demonstration at its position on the chart; the medoid of each surgeon has a ring and a name."""
    places = np.array([one.at for one in atlas.demos])
    low, high = places.min(axis=0), places.max(axis=0)
    room = np.array([WIDE - 3 * MARGIN, HIGH - 3.5 * MARGIN]) / np.maximum(high - low, 1e-9)
    scale = float(min(*room, 1e3))  # pixels per unit along both axes; limited, for the case that all points coincide
    seen = ((places - (low + high) / 2) * [scale, -scale] + [WIDE / 2, (HIGH - MARGIN) / 2]).round(1).tolist()
    numbers, of = _numbers(atlas), {one.medoid: one.surgeon for one in atlas.surgeons}
    asked = None if atlas.recognised is None else atlas.recognised.demo
    spots, medoids = [], []
    for one, (x, y) in zip(atlas.demos, seen, strict=True):
        said = f"{one.surgeon}, session {one.session or 'not named'}, cluster {one.cluster}"
        spots.append({"x": x, "y": y, "said": said, "mark": numbers[one.surgeon], "is_asked": one.id == asked})
        if (name := of.get(one.id)) is not None:
            half = 3.6 * len(name)
            # shifted, so that a name is not cut off at the edge
            medoids.append((x, y, min(max(x, half + 2), WIDE - half - 2), name))
    ruler = _ruler(scale, atlas.scaled)
    return draw("chart", size=(WIDE, HIGH), spots=spots, medoids=medoids, ruler=ruler)


def _ruler(scale: float, scaled: bool) -> dict[str, object]:
    """Return a scale bar: the axes of the chart have no meaning, its distances do."""
    long = 10.0 ** np.floor(np.log10(WIDE / 4 / scale))
    long = next(long * factor for factor in (5, 2, 1) if long * factor * scale <= WIDE / 3)
    said = f"{100 * long:g} % of the length" if scaled else f"{long:g} mm"
    return {"begin": MARGIN, "end": MARGIN + long * scale, "y": HIGH - 14, "said": said}


# ---- the atlas: distances and dendrogram ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Leaf:
    """A group of demonstrations, drawn as one row and column of cells; `part` is its number in the dendrogram."""

    part: int
    members: list[int]
    surgeon: str
    said: str


def matrix(atlas: Atlas) -> Markup:
    """Draw the distances between all demonstrations, darker means nearer, and the dendrogram that orders them."""
    leaves = _leaves(atlas)
    far = _between(_whole(atlas), leaves)
    top, numbers = float(far.max()) or 1.0, _numbers(atlas)
    rows = []
    for leaf, row in zip(leaves, far.tolist(), strict=True):
        titles = (f"{leaf.said} – {other.said}: {distance:.3g}" for other, distance in zip(leaves, row, strict=True))
        cells = [(_shade(distance / top), title) for distance, title in zip(row, titles, strict=True)]
        rows.append({"mark": numbers[leaf.surgeon], "cells": cells})
    what = "demonstrations" if len(leaves) == len(atlas.demos) else "groups of demonstrations"
    label = f"The distances between {len(leaves)} {what} in the order of the dendrogram to the left"
    size = TREE + CELL * len(leaves) + 24, CELL * len(leaves) + 8
    tree = _joins(atlas, leaves)
    return draw("matrix", label=label, size=size, tree=tree, tree_width=TREE, cell=CELL, leaves=rows)


def _shade(share: float) -> str:
    """Return the class of a share of the largest distance."""
    return f"s{min(int(share * SHADES), SHADES - 1)}"


def _leaves(atlas: Atlas) -> list[_Leaf]:
    """Group the demonstrations, in order, by the first merges of the dendrogram, until at most `MOST_GROUPS` remain."""
    count = len(atlas.demos)
    of = {one: [one] for one in range(count)}
    for made, merge in enumerate(atlas.merges[: max(0, count - MOST_GROUPS)], start=count):
        of[made] = of.pop(merge.one) + of.pop(merge.other)
    place = {one: at for at, one in enumerate(atlas.order)}
    return [_leaf(atlas, part, of[part]) for part in sorted(of, key=lambda part: place[of[part][0]])]


def _leaf(atlas: Atlas, part: int, members: list[int]) -> _Leaf:
    whose = Counter(atlas.demos[one].surgeon for one in members)
    said = ", ".join(name if count == 1 else f"{count} of {name}" for name, count in whose.most_common(3))
    return _Leaf(part, members, whose.most_common(1)[0][0], said + (" and others" if len(whose) > 3 else ""))


def _whole(atlas: Atlas) -> Floats:
    whole = np.zeros((len(atlas.demos),) * 2)
    for at, row in enumerate(atlas.distances):
        whole[at, :at] = whole[:at, at] = row
    return whole


def _between(far: Floats, leaves: list[_Leaf]) -> Floats:
    """Return the mean distances between groups, shape (G, G)."""
    member = np.zeros((len(leaves), len(far)))
    for at, leaf in enumerate(leaves):
        member[at, leaf.members] = 1.0 / len(leaf.members)
    return np.asarray(member @ far @ member.T)


def _joins(atlas: Atlas, leaves: list[_Leaf]) -> str:
    """Return the lines of the merges of the groups; the smaller the distance of a merge, the further to the right."""
    furthest = atlas.merges[-1].distance if atlas.merges else 0.0
    ends = {leaf.part: (float(TREE), CELL * (at + 0.5)) for at, leaf in enumerate(leaves)}
    lines = []
    for made, merge in enumerate(atlas.merges, start=len(atlas.demos)):
        if merge.one not in ends:
            continue  # a merge within a group
        (x1, y1), (x2, y2) = ends.pop(merge.one), ends.pop(merge.other)
        x = round(TREE * (1 - merge.distance / (furthest or 1.0)) + 1, 1)
        lines.append(f"M{x1:g} {y1:g}H{x:g}V{y2:g}H{x2:g}")
        ends[made] = x, (y1 + y2) / 2
    return "".join(lines)


def thirds(shares: Sequence[Sequence[float]]) -> Markup:
    """Draw where two surgeons differ: thirds of the path from left to right, axes from top to bottom."""
    top = max(map(max, shares)) or 1.0
    return draw("thirds", shades=[[_shade(1 - share / top) for share in row] for row in shares])
