"""Small pictures of a demonstration as SVG: its path seen along each axis, and its speed over time."""

from collections.abc import Sequence
from html import escape
from itertools import pairwise
from math import floor, log10

import numpy as np
from numpy.typing import NDArray

from skills.style.combining import Combined
from skills.style.demo import Demo
from skills.style.grid import GridPath
from skills.style.movement import smoothed_speed
from skills.style.quality import pieces_of

Points = NDArray[np.float64]

SIDE, MARGIN = 320, 34  # pixels of a view, and left and below for its numbers
WIDE, HIGH = 1000, 190
MOST_POINTS = 1500  # of a line: more cannot be seen
VIEWS = ((0, 1), (0, 2), (1, 2))
AXES = "xyz"


def views(demo: Demo, path: GridPath, combined: Combined | None = None) -> str:
    """Draw the path as it was recorded and in its grid, seen along z, y and x, all to one scale.

    Of several demonstrations, behind the way that was made of them, how wide it is.
    """
    seen = np.concatenate((demo.tip_mm, path.tip_mm - path.grid.cell_mm / 2, path.tip_mm + path.grid.cell_mm / 2))
    if demo.partner is not None:
        seen = np.concatenate((seen, [demo.partner.position_mm]))
    low, high = seen.min(axis=0), seen.max(axis=0)
    middle, width = (low + high) / 2, float((high - low).max()) * 1.04
    return "".join(_view(demo, path, combined, axes, middle - width / 2, width) for axes in VIEWS)


def _view(
    demo: Demo, path: GridPath, combined: Combined | None, axes: tuple[int, int], low: Points, width: float
) -> str:
    scale = (SIDE - MARGIN - 8) / width

    def place(points: Points) -> Points:
        right = MARGIN + (points[:, axes[0]] - low[axes[0]]) * scale
        down = SIDE - MARGIN - (points[:, axes[1]] - low[axes[1]]) * scale
        return np.stack([right, down], axis=1)

    cell = path.grid.cell_mm * scale
    cells = np.unique(place(path.tip_mm).round(2), axis=0)
    squares = "".join(
        f'<rect class="cell" x="{x - cell / 2:.1f}" y="{y - cell / 2:.1f}" width="{cell:.1f}" height="{cell:.1f}"/>'
        for x, y in cells.tolist()
    )
    wide = "" if combined is None else _corridor(place(combined.tip_mm), combined.width_mm * scale)
    pieces = pieces_of(demo)
    recorded = "".join(line("raw", place(_thinned(demo.tip_mm[piece]))) for piece in pieces)
    gaps = "".join(
        line("pause", place(demo.tip_mm[[before.stop - 1, after.start]])) for before, after in pairwise(pieces)
    )
    ends = dot("start", place(demo.tip_mm[:1])) + dot("goal", place(demo.tip_mm[-1:]))
    if demo.partner is not None:
        ends += dot("partner", place(np.array([demo.partner.position_mm])))
    a, b = AXES[axes[0]], AXES[axes[1]]
    return (
        f'<figure><svg viewBox="0 0 {SIDE} {SIDE}" width="{SIDE}" height="{SIDE}" role="img" '
        f'aria-label="The path in {a} and {b}">{_rulers(low[list(axes)], width, scale, (a, b))}{squares}{wide}'
        f"{line('grid', place(path.tip_mm))}{gaps}{recorded}{ends}</svg></figure>"
    )


def _corridor(points: Points, radii: Points) -> str:
    """Draw how wide a way is, (T,) pixels at each of its points, (T, 2): a disc at each, all as one."""
    discs = "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}"/>'
        for (x, y), radius in zip(points.tolist(), radii.tolist(), strict=True)
    )
    return f'<g class="corridor">{discs}</g>'


def _rulers(low: Points, width: float, scale: float, names: tuple[str, str]) -> str:
    drawn = []
    for value in ticks(float(low[0]), float(low[0]) + width):
        x = MARGIN + (value - low[0]) * scale
        drawn.append(rule(x, 8, x, SIDE - MARGIN) + label(x, SIDE - MARGIN + 14, f"{value:g}", "middle"))
    for value in ticks(float(low[1]), float(low[1]) + width):
        y = SIDE - MARGIN - (value - low[1]) * scale
        drawn.append(rule(MARGIN, y, SIDE - 8, y) + label(MARGIN - 4, y + 4, f"{value:g}", "end"))
    drawn.append(label(SIDE - 8, SIDE - 4, f"{names[0]} in mm", "end") + label(2, 12, names[1], "start"))
    return "".join(drawn)


def speed(demo: Demo, a1_s: float) -> str:
    """Draw the smoothed speed over time, the pauses shaded, and where A1 gives way to A2."""
    end_s = float(demo.stamps_s[-1])
    drawn = [
        smoothed_speed(demo.stamps_s[piece], demo.tip_mm[piece])
        for piece in pieces_of(demo)
        if piece.stop - piece.start > 1
    ]
    top = max([float(one.max()) for _, one in drawn], default=0.0) * 1.08 or 1.0

    def place(seconds: Points, speeds: Points) -> Points:
        right = MARGIN + seconds / end_s * (WIDE - MARGIN - 12)
        return np.stack([right, HIGH - MARGIN - speeds / top * (HIGH - MARGIN - 14)], axis=1)

    parts = []
    for pause in demo.pauses:
        (left, up), (right, _) = place(np.array([pause.start_s, pause.end_s]), np.array([top, top])).tolist()
        parts.append(
            f'<rect class="paused" x="{left:.1f}" y="{up:.1f}" width="{right - left:.1f}" '
            f'height="{HIGH - MARGIN - up:.1f}"/>'
        )
    for value in ticks(0.0, top):
        (_, y), *_ = place(np.zeros(1), np.array([value])).tolist()
        parts.append(rule(MARGIN, y, WIDE - 12, y) + label(MARGIN - 4, y + 4, f"{value:g}", "end"))
    for value in ticks(0.0, end_s, 10):
        (x, _), *_ = place(np.array([value]), np.zeros(1)).tolist()
        parts.append(label(x, HIGH - MARGIN + 14, f"{value:g}", "middle"))
    (x, up), (_, down) = place(np.array([a1_s, a1_s]), np.array([top, 0.0])).tolist()
    parts.append(f'<line class="pause" x1="{x:.1f}" y1="{up:.1f}" x2="{x:.1f}" y2="{down:.1f}"/>')
    parts.append(label(x - 5, up + 10, "A1", "end"))
    if end_s - a1_s > 0.02 * end_s:
        parts.append(label(x + 5, up + 10, "A2", "start"))
    lines = "".join(line("raw", _thinned(place(seconds - demo.stamps_s[0], one))) for seconds, one in drawn)
    labels = label(WIDE - 12, HIGH - 4, "seconds", "end") + label(2, 10, "mm/s", "start")
    return (
        f'<figure><svg viewBox="0 0 {WIDE} {HIGH}" width="{WIDE}" height="{HIGH}" role="img" '
        f'aria-label="The speed over time">{"".join(parts)}{lines}{labels}</svg></figure>'
    )


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Choose round numbers between two, six or fewer."""
    rough = (high - low) / most
    power = 10.0 ** floor(log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough)
    first = int(np.ceil(low / step))
    return [round(number * step, 9) for number in range(first, int(np.floor(high / step)) + 1)]


def _thinned(points: Points) -> Points:
    """Leave out points that cannot be seen, (T, 2 or 3); the last one stays."""
    every = -(-len(points) // MOST_POINTS)
    return np.concatenate((points[:-1:every], points[-1:]))


def line(kind: str, points: Points) -> str:
    """Draw a line through points, (T, 2)."""
    places: Sequence[str] = [f"{x:.1f},{y:.1f}" for x, y in points.tolist()]
    return f'<polyline class="{escape(kind)}" points="{" ".join(places)}"/>'


def dot(kind: str, points: Points) -> str:
    """Draw a dot at each of some points, (T, 2)."""
    return "".join(f'<circle class="{escape(kind)}" cx="{x:.1f}" cy="{y:.1f}" r="5"/>' for x, y in points.tolist())


def rule(x: float, y: float, to_x: float, to_y: float) -> str:
    """Draw a line of a scale."""
    return f'<line class="axis" x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}"/>'


def label(x: float, y: float, words: str, anchor: str) -> str:
    """Write words."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(words)}</text>'
