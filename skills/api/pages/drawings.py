"""SVG drawings of the pages, and the two standalone pages made of them: the report to the surgeon and the policy card.

Drawings are `Markup`, which templates insert as it is; all other text in them is escaped. Colours and line styles are
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
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from math import ceil, floor, hypot, log10
from typing import Any

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from skills.api.pages import standalone
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
COLOURS = 6
MARKS = (  # centred at the origin, about 10 units wide
    "M-5 0a5 5 0 1 0 10 0a5 5 0 1 0-10 0z",  # circle
    "M-4.5-4.5h9v9h-9z",  # square
    "M0-5.8 5.4 4h-10.8z",  # triangle
    "M0-6 6 0 0 6-6 0z",  # diamond
    "M-2-6h4v4h4v4h-4v4h-4v-4h-4v-4h4z",  # cross
    "M0 5.8 5.4-4h-10.8z",  # triangle, upside down
    "M0-6.2 1.8-2h4.4l-3.5 2.8 1.3 4.4-4-2.6-4 2.6 1.3-4.4-3.5-2.8h4.4z",  # star
)
WIDE, HIGH, MARGIN = 640, 440, 34  # of the chart
TREE, CELL, MOST_GROUPS = 150, 11, 48  # width of the dendrogram, side of a cell, and largest number of rows
SHADES = 9  # of distance: the eye distinguishes no more


def element(tag: str, *inside: str, kind: str | None = None, **attributes: str | float) -> Markup:
    """Return an SVG element.

    Args:
        tag: Name of the element.
        inside: Its content: elements, or text, which is escaped.
        kind: Its class.
        attributes: Other attributes, with `_` for `-`; numbers are rounded to 0.01.
    """
    said = "" if kind is None else f' class="{escape(kind)}"'
    for name, value in attributes.items():
        shown = escape(value) if isinstance(value, str) else f"{round(value, 2):g}"
        said += f' {name.replace("_", "-")}="{shown}"'
    body = "".join(one if isinstance(one, Markup) else escape(one) for one in inside)
    return Markup(f"<{tag}{said}>{body}</{tag}>" if body else f"<{tag}{said}/>")  # noqa: S704 - all of it is escaped


def group(parts: Iterable[str]) -> Markup:
    """Join elements."""
    return Markup().join(parts)


def drawing(
    label: str | None, corner: tuple[float, float], size: tuple[float, float], *inside: str, **attributes: Any
) -> Markup:
    """Return a drawing of elements with its upper left corner and its size; without a label it is decoration."""
    name: dict[str, Any] = {"aria_hidden": "true"} if label is None else {"role": "img", "aria_label": label}
    view = " ".join(f"{number:g}" for number in (*corner, *size))
    return element("svg", *inside, viewBox=view, **attributes, **name)


def line(kind: str, points: Floats) -> Markup:
    """Draw a polyline through points, shape (T, 2)."""
    return element("polyline", kind=kind, points=" ".join(f"{x:.1f},{y:.1f}" for x, y in points.tolist()))


def dots(kind: str | None, points: Floats, radius: float = 5.0) -> Markup:
    """Draw a dot at each of some points, shape (T, 2)."""
    return group(element("circle", kind=kind, cx=x, cy=y, r=radius) for x, y in points.tolist())


def box(kind: str, x: float, y: float, width: float, height: float, *inside: str) -> Markup:
    """Draw a rectangle by its upper left corner and its size; a title inside is shown by the browser."""
    return element("rect", *inside, kind=kind, x=x, y=y, width=width, height=height)


def text(x: float, y: float, words: str, anchor: str) -> Markup:
    """Draw a text whose start, middle or end is at a point."""
    return element("text", words, x=x, y=y, text_anchor=anchor)


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Return round numbers between two limits, at steps of at least a `most`-th of the range."""
    rough = (high - low) / most
    power = 10.0 ** floor(log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough)
    return [round(number * step, 9) for number in range(ceil(low / step), floor(high / step) + 1)]


@dataclass(frozen=True)
class Plot:
    """Axes: the limits of the data, `low` and `high` as (x, y), and the edges between which they are drawn."""

    low: tuple[float, float]
    high: tuple[float, float]
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

    def along_x(self, name: str, most: int = 6, *, ruled: bool = True) -> Markup:
        """Draw the axis of x: its name, at most so many numbers, and their rules."""
        drawn = [text(self.right, self.bottom + 30, name, "end")]
        for value in ticks(self.low[0], self.high[0], most):
            drawn += [self.rule(value)] * ruled + [self.below(value, f"{value:g}")]
        return group(drawn)

    def along_y(self, name: str) -> Markup:
        """Draw the axis of y: its name, its numbers and their rules."""
        drawn = [text(2, self.top - 6, name, "start")]
        for value in ticks(self.low[1], self.high[1]):
            y = float(self.place(np.array([[self.low[0], value]]))[0, 1])
            drawn.append(element("line", kind="axis", x1=self.left, y1=y, x2=self.right, y2=y))
            drawn.append(text(self.left - 4, y + 4, f"{value:g}", "end"))
        return group(drawn)

    def rule(self, value: float, kind: str = "axis") -> Markup:
        """Draw a line through the plot at a value of x."""
        x = self.x(value)
        return element("line", kind=kind, x1=x, y1=self.top, x2=x, y2=self.bottom)

    def below(self, value: float, words: str) -> Markup:
        """Write words below the axis at a value of x."""
        return text(self.x(value), self.bottom + 14, words, "middle")


def _view_of(points: Floats, axes: tuple[int, int]) -> Plot:
    """Return the axes of a view of points, shape (T, 3); its scale is the same for all pairs of axes."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = float((high - low).max()) * 0.525 or 0.5
    (x, y) = ((low + high) / 2)[list(axes)].tolist()
    return Plot((x - half, y - half), (x + half, y + half), 34, 16, VIEW[0] - 8, VIEW[1] - 34)


def _course(end: float, top: float, start: float = 0.0) -> Plot:
    return Plot((start, 0.0), (end, top), 34, 14, COURSE[0] - 12, COURSE[1] - 34)


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

    right, up = (AXES[axis] for axis in axes)
    cell = path.grid.cell_mm * plot.scale
    drawn = [plot.along_x(f"{right} in mm"), plot.along_y(up)]
    drawn += [
        box("cell", x - cell / 2, y - cell / 2, cell, cell)
        for x, y in np.unique(place(path.tip_mm).round(2), axis=0).tolist()
    ]
    if combined is not None:
        drawn.append(_corridor(place(combined.tip_mm), combined.width_mm * plot.scale))
    drawn.append(line("grid", place(path.tip_mm)))
    pieces = pieces_of(demo)
    drawn += [line("pause", place(demo.tip_mm[[one.stop - 1, other.start]])) for one, other in pairwise(pieces)]
    drawn += [line("raw", place(_thinned(demo.tip_mm[piece]))) for piece in pieces]
    drawn += [dots("start", place(demo.tip_mm[0])), dots("goal", place(demo.tip_mm[-1]))]
    if demo.partner is not None:
        drawn.append(dots("partner", place(demo.partner.position_mm)))
    return _sized(f"The path in {right} and {up}", VIEW, drawn)


def _corridor(points: Floats, radii: Floats) -> Markup:
    """Draw a corridor as a union of discs at points of shape (T, 2), with radii of shape (T,)."""
    discs = (dots(None, point[None], radius) for point, radius in zip(points, radii.tolist(), strict=True))
    return element("g", *discs, kind="corridor")


def _thinned(points: Floats) -> Floats:
    """Return every n-th point, shape (T, 2 or 3), at most about `MOST_POINTS`; the last one is always included."""
    every = -(-len(points) // MOST_POINTS)
    return np.concatenate((points[:-1:every], points[-1:]))


def _sized(label: str, size: tuple[int, int], drawn: Sequence[str]) -> Markup:
    return drawing(label, (0, 0), size, *drawn, width=size[0], height=size[1])


def speed(demo: Demo, a1_s: float) -> Markup:
    """Draw the smoothed speed over time, with pauses shaded, and the time at which A1 ends and A2 begins."""
    end_s = float(demo.stamps_s[-1])
    moving = [piece for piece in pieces_of(demo) if piece.stop - piece.start > 1]
    speeds = [smoothed_speed(demo.stamps_s[piece], demo.tip_mm[piece]) for piece in moving]
    plot = _course(end_s, max([float(one.max()) for _, one in speeds], default=0.0) * 1.08 or 1.0)
    drawn = [
        box(
            "paused",
            plot.x(pause.start_s),
            plot.top,
            plot.x(pause.end_s) - plot.x(pause.start_s),
            plot.bottom - plot.top,
        )
        for pause in demo.pauses
    ]
    drawn += [plot.along_x("seconds", 10, ruled=False), plot.along_y("mm/s")]
    drawn += [plot.rule(a1_s, "pause"), text(plot.x(a1_s) - 5, plot.top + 10, "A1", "end")]
    if end_s - a1_s > 0.02 * end_s:
        drawn.append(text(plot.x(a1_s) + 5, plot.top + 10, "A2", "start"))
    drawn += [
        line("raw", _thinned(plot.place(np.stack([seconds - demo.stamps_s[0], one], axis=1))))
        for seconds, one in speeds
    ]
    return _sized("The speed over time", COURSE, drawn)


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
        parts = (
            plot.along_x(f"{right}, mm") + plot.along_y(up) + line("reference", plot.place(reference[:, (a, b)])),
            _steps(placed, np.array(deviation.apart_mm)),
            dots("start", placed[:1]) + dots("goal", placed[-1:]),
        )
        drawn.append((name, drawing(f"The path and the reference: {right}, {up}", (0, 0), VIEW, *parts)))
    return drawn


def deviation_along(deviation: Deviation) -> Markup:
    """Draw the distance from the reference along the path, divided into its thirds."""
    apart = np.array(deviation.apart_mm)
    plot = _distances(apart, 1.1)
    drawn = [plot.along_y("mm")]
    for third, words in enumerate(("first third", "middle third", "last third")):
        begin, middle = (part / 3 * (len(apart) - 1) for part in (third, third + 0.5))
        drawn += [plot.rule(begin), plot.below(middle, words)]
    drawn.append(_steps(plot.place(np.stack([np.arange(len(apart)), apart], axis=1)), apart))
    return drawing("Distance from the reference along the path", (0, 0), COURSE, *drawn)


def score_curve(curve: Sequence[CurvePoint], scored: str) -> Markup:
    """Draw the distances of a surgeon's demonstrations in recording order; `scored` is the digest of the scored one."""
    apart = np.array([one.distance_mm for one in curve])
    plot = _distances(apart, 1.15)
    spots = plot.place(np.stack([np.arange(len(apart)), apart], axis=1))
    is_scored = np.array([one.demo == scored for one in curve])
    shown = np.unique(np.linspace(0, len(apart) - 1, min(len(apart), 10)).round().astype(int)).tolist()
    drawn = [plot.along_y("mm"), line("course", spots), dots("before", spots[~is_scored])]
    drawn += [dots("scored", spots[is_scored]), *(plot.below(number, f"{number + 1}") for number in shown)]
    return drawing("Distance from the reference, demonstration by demonstration", (0, 0), COURSE, *drawn)


def _distances(apart_mm: Floats, room: float) -> Plot:
    """Return the axes of distances in a row, shape (T,), with some room at the sides and above."""
    last = max(1, len(apart_mm) - 1)
    return _course(1.006 * last, max(float(apart_mm.max()) * room, STEPS_MM[0]), start=-0.006 * last)


def _steps(spots: Floats, apart_mm: Floats) -> Markup:
    """Draw a path, pixels of shape (T, 2), each of its segments in the step of the larger distance at its ends."""
    steps = np.searchsorted(STEPS_MM, apart_mm)
    return group(line(f"apart-{max(steps[i], steps[i + 1])}", spots[i : i + 2]) for i in range(len(spots) - 1))


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
        parts = (*_runs(kinds[:, :, number]), box("edge", 0, 0, wide, high), *_cells_of_path(path, first, last, block))
        drawn.append((name, drawing(f"The starts at {name}", (-2, -2), (wide + 4, high + 4), *parts, kind="layer")))
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


def _runs(kinds: NDArray[np.int8]) -> Iterator[Markup]:
    """Draw the tiles of a layer, adjacent ones of a kind as one rectangle; y increases upwards."""
    for down, row in enumerate(kinds.T[::-1].tolist()):
        right = 0
        for kind, run in groupby(row):
            wide = len(list(run))
            yield box(KINDS[kind], TILE * right, TILE * down, TILE * wide, TILE)
            right += wide


def _cells_of_path(path: GridPath, first: int, last: int, block: int) -> Iterator[Markup]:
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


# ---- the atlas: markers and chart ----------------------------------------------------------------------------------


def marks(atlas: Atlas) -> dict[str, Markup]:
    """Return the marker of each surgeon as an SVG path centred at the origin."""
    return {
        one.surgeon: element("path", kind=f"mark c{number % COLOURS}", d=MARKS[number % len(MARKS)])
        for number, one in enumerate(atlas.surgeons)
    }


def key(mark: Markup) -> Markup:
    """Return a marker as a drawing of its own, to stand next to a name."""
    return drawing(None, (-7, -7), (14, 14), mark, kind="of")


def chart(atlas: Atlas) -> Markup:
    """Draw every demonstration at its position on the chart; the medoid of each surgeon has a ring and a name."""
    places = np.array([one.at for one in atlas.demos])
    low, high = places.min(axis=0), places.max(axis=0)
    room = np.array([WIDE - 3 * MARGIN, HIGH - 3.5 * MARGIN]) / np.maximum(high - low, 1e-9)
    scale = float(min(*room, 1e3))  # pixels per unit along both axes; limited, for the case that all points coincide
    seen = (places - (low + high) / 2) * [scale, -scale] + [WIDE / 2, (HIGH - MARGIN) / 2]
    drawn, of = marks(atlas), {one.medoid: one.surgeon for one in atlas.surgeons}
    asked = None if atlas.recognised is None else atlas.recognised.demo
    spots, rings = [], []
    for one, (x, y) in zip(atlas.demos, seen.round(1).tolist(), strict=True):
        about = element("title", f"{one.surgeon}, session {one.session or 'not named'}, cluster {one.cluster}")
        ring = element("circle", kind="asked", r=14) if one.id == asked else Markup()
        spots.append(element("g", about, drawn[one.surgeon], ring, transform=f"translate({x:g} {y:g})"))
        if one.id in of:
            rings.append(element("circle", kind="medoid", cx=x, cy=y, r=9.5) + _name(x, y - 13, of[one.id]))
    label = f"{len(spots)} demonstrations as points: closer points are more similar"
    return drawing(label, (0, 0), (WIDE, HIGH), *spots, *rings, _ruler(scale, atlas.scaled), kind="atlas-chart")


def _name(x: float, y: float, name: str) -> Markup:
    """Draw a name, shifted so that it is not cut off at the edge."""
    half = 3.6 * len(name)
    return text(min(max(x, half + 2), WIDE - half - 2), y, name, "middle")


def _ruler(scale: float, scaled: bool) -> Markup:
    """Draw a scale bar: the axes of the chart have no meaning, its distances do."""
    long = 10.0 ** np.floor(np.log10(WIDE / 4 / scale))
    long = next(long * factor for factor in (5, 2, 1) if long * factor * scale <= WIDE / 3)
    end, y = MARGIN + long * scale, HIGH - 14
    said = f"{100 * long:g} % of the length" if scaled else f"{long:g} mm"
    bar = element("path", kind="ruler", d=f"M{MARGIN} {y - 4}v8m0-4H{end:.1f}m0-4v8")
    return bar + text(end + 7, y + 4, f"{said} at a place", "start")


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
    top, drawn = float(far.max()) or 1.0, marks(atlas)
    cells, sides = [], []
    for down, (leaf, row) in enumerate(zip(leaves, far.tolist(), strict=True)):
        place = f"translate({TREE + 8} {CELL * (down + 0.5):g}) scale(.8)"
        sides.append(element("g", drawn[leaf.surgeon], transform=place))
        for right, (other, distance) in enumerate(zip(leaves, row, strict=True)):
            title = element("title", f"{leaf.said} – {other.said}: {distance:.3g}")
            cells.append(box(_shade(distance / top), CELL * right, CELL * down, CELL, CELL, title))
    what = "demonstrations" if len(leaves) == len(atlas.demos) else "groups of demonstrations"
    label = f"The distances between {len(leaves)} {what} in the order of the dendrogram to the left"
    square = element("g", *cells, transform=f"translate({TREE + 18} 0)")
    side = CELL * len(leaves)
    size = TREE + side + 24, side + 8
    return drawing(label, (-4, -4), size, _joins(atlas, leaves), *sides, square, kind="atlas-matrix")


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


def _joins(atlas: Atlas, leaves: list[_Leaf]) -> Markup:
    """Draw the merges of the groups; the smaller the distance of a merge, the further to the right."""
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
    return element("path", kind="tree", d="".join(lines))


def thirds(shares: Sequence[Sequence[float]]) -> Markup:
    """Draw where two surgeons differ: thirds of the path from left to right, axes from top to bottom."""
    top = max(map(max, shares)) or 1.0
    cells = (
        box(_shade(1 - share / top), 12 * part, 8 * axis, 11, 7)
        for part, row in enumerate(shares)
        for axis, share in enumerate(row)
    )
    return drawing(None, (0, 0), (35, 23), *cells, kind="thirds")
