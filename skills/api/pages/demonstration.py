"""Pages of a demonstration: drawings of its path and its speed, the report to the surgeon, and drawings of its score.

A score shows distance from the reference by colour and by line width, in steps of half, one, two and four cells of the
paper's grid.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from markupsafe import Markup

from skills.api.pages.page import standalone
from skills.api.pages.svg import Plot, box, dots, drawing, element, group, line, text
from skills.arrays import Floats
from skills.comparison.combining import Combined
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import smoothed_speed
from skills.demonstration.quality import pieces_of, times_in_words
from skills.gridworld import paper
from skills.gridworld.grid import GridPath
from skills.schemas.comparison import CurvePoint
from skills.scoring.deviation import Deviation

Report = Mapping[str, Any]
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


def _view_of(points: Floats, axes: tuple[int, int]) -> Plot:
    """Return the axes of a view of points, shape (T, 3); its scale is the same for all pairs of axes."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = float((high - low).max()) * 0.525 or 0.5
    (x, y) = ((low + high) / 2)[list(axes)].tolist()
    return Plot((x - half, y - half), (x + half, y + half), 34, 16, VIEW[0] - 8, VIEW[1] - 34)


def _course(end: float, top: float, start: float = 0.0) -> Plot:
    return Plot((start, 0.0), (end, top), 34, 14, COURSE[0] - 12, COURSE[1] - 34)


# ---- the report --------------------------------------------------------------------------------------------------


def report_page(about: Mapping[str, Any], report: Report, demo: Demo, path: GridPath) -> str:
    """Return the HTML of the quality report to the surgeon: advice, path, speed and figures.

    Args:
        about: The demonstration's JSON (`skills.api.written.demo_out`).
        report: The report (`skills.library.demos.full_report`).
        demo: The demonstration.
        path: Its path in its grid.
    """
    return standalone(
        "demo_report",
        about=about,
        report=report,
        views=path_views(demo, path),
        speed=speed(demo, report["a1_s"]),
        pauses=bool(demo.pauses),
        partner=None if demo.partner is None else demo.partner.arm,
        times=times_in_words,
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
