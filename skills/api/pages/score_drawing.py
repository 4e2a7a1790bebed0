"""A score as SVG: the way coloured by how far it lies from the reference's, that distance along it, and over time.

How far is told by colour and by width, in steps of a cell of the paper's grid and its halves and doubles.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skills.api.pages.drawing import HIGH, MARGIN, SIDE, WIDE, dot, label, line, rule, ticks
from skills.style import paper

Points = NDArray[np.float64]
Deviation = Mapping[str, Any]

STEPS_MM = tuple(paper.CELL_MM * times for times in (0.5, 1.0, 2.0, 4.0))  # between five widths and colours
VIEWS = ((0, 2, "along", "up", "from the side"), (0, 1, "along", "left", "from above"), (1, 2, "left", "up", "head on"))


def key() -> list[tuple[str, str]]:
    """Name the five steps: (class, words)."""
    bounds = [f"{step:g}" for step in STEPS_MM]
    words = [f"up to {bounds[0]} mm", *(f"to {bound} mm" for bound in bounds[1:]), "more"]
    return [(f"apart-{number}", one) for number, one in enumerate(words)]


def views(deviation: Deviation) -> list[tuple[str, str]]:
    """Draw the way and the reference's, laid on each other, seen along each axis, to one scale: (its name, its SVG)."""
    path, reference = (np.array(deviation[name]) for name in ("path_mm", "reference_mm"))
    seen = np.concatenate([path, reference])
    low, high = seen.min(axis=0), seen.max(axis=0)
    width = float((high - low).max()) * 1.06 or 1.0
    corner = (low + high) / 2 - width / 2
    steps = np.searchsorted(STEPS_MM, np.array(deviation["apart_mm"]))
    return [
        (name, _view(path, reference, steps, (a, b), (right, up), corner, width)) for a, b, right, up, name in VIEWS
    ]


def _view(
    path: Points,
    reference: Points,
    steps: NDArray[np.int64],
    axes: tuple[int, int],
    names: tuple[str, str],
    corner: Points,
    width: float,
) -> str:
    scale = (SIDE - MARGIN - 8) / width

    def place(points: Points) -> Points:
        right, up = ((points[:, axis] - corner[axis]) * scale for axis in axes)
        return np.stack([MARGIN + right, SIDE - MARGIN - up], axis=1)

    drawn = []
    for value in ticks(float(corner[axes[0]]), float(corner[axes[0]]) + width):
        x = MARGIN + (value - corner[axes[0]]) * scale
        drawn.append(rule(x, 8, x, SIDE - MARGIN) + label(x, SIDE - MARGIN + 14, f"{value:g}", "middle"))
    for value in ticks(float(corner[axes[1]]), float(corner[axes[1]]) + width):
        y = SIDE - MARGIN - (value - corner[axes[1]]) * scale
        drawn.append(rule(MARGIN, y, SIDE - 8, y) + label(MARGIN - 4, y + 4, f"{value:g}", "end"))
    drawn.append(label(SIDE - 8, SIDE - 4, f"{names[0]}, mm", "end") + label(2, 12, names[1], "start"))
    placed = place(path)
    drawn.append(line("reference", place(reference)))
    drawn += [line(f"apart-{max(steps[i], steps[j])}", placed[[i, j]]) for i, j in pairwise(range(len(placed)))]
    drawn.append(dot("start", placed[:1]) + dot("goal", placed[-1:]))
    return (
        f'<svg viewBox="0 0 {SIDE} {SIDE}" role="img" aria-label="The way and the reference: {names[0]}, {names[1]}">'
        f"{''.join(drawn)}</svg>"
    )


def along(deviation: Deviation) -> str:
    """Draw how far the way lies from the reference's, along its length, its thirds set apart."""
    apart = np.array(deviation["apart_mm"])
    top = max(float(apart.max()) * 1.1, STEPS_MM[0])
    place = _placing(len(apart) - 1, top)
    drawn = _heights(top, place)
    for third, words in ((0, "first third"), (1, "middle third"), (2, "last third")):
        (left, up), (middle, down) = place(
            np.array([third / 3, (third + 0.5) / 3]) * (len(apart) - 1), np.array([top, 0.0])
        ).tolist()
        drawn += [rule(left, up, left, down), label(middle, down + 16, words, "middle")]
    spots = place(np.arange(len(apart), dtype=float), apart)
    steps = np.searchsorted(STEPS_MM, apart)
    drawn += [line(f"apart-{max(steps[i], steps[j])}", spots[[i, j]]) for i, j in pairwise(range(len(spots)))]
    return _wide("How far the way lies from the reference's, along its length", drawn, "mm")


def over_time(curve: Sequence[Mapping[str, Any]], scored: str) -> str:
    """Draw the distance of a surgeon's demonstrations in the order of recording; `scored` is one of their digests."""
    apart = np.array([one["distance_mm"] for one in curve])
    top = max(float(apart.max()) * 1.15, STEPS_MM[0])
    place = _placing(max(1, len(apart) - 1), top)
    spots = place(np.arange(len(apart), dtype=float), apart)
    is_scored = np.array([one["demo"] == scored for one in curve])
    drawn = [*_heights(top, place), line("course", spots), dot("before", spots[~is_scored])]
    drawn.append(dot("scored", spots[is_scored]))
    shown = np.unique(np.linspace(0, len(apart) - 1, min(len(apart), 10)).round().astype(int))
    drawn += [label(spots[number, 0], HIGH - MARGIN + 16, f"{number + 1}", "middle") for number in shown]
    return _wide("Distance from the reference, demonstration by demonstration", drawn, "mm")


def _placing(last: int, top: float) -> Any:
    def place(right: Points, up: Points) -> Points:
        x = MARGIN + right / last * (WIDE - MARGIN - 24) + 6
        return np.stack([x, HIGH - MARGIN - up / top * (HIGH - MARGIN - 14)], axis=1)

    return place


def _heights(top: float, place: Any) -> list[str]:
    drawn = []
    for value in ticks(0.0, top):
        ((_, y),) = place(np.zeros(1), np.array([value])).tolist()
        drawn.append(rule(MARGIN, y, WIDE - 12, y) + label(MARGIN - 4, y + 4, f"{value:g}", "end"))
    return drawn


def _wide(words: str, drawn: Sequence[str], unit: str) -> str:
    return (
        f'<svg viewBox="0 0 {WIDE} {HIGH}" role="img" aria-label="{words}">{"".join(drawn)}'
        f"{label(2, 10, unit, 'start')}</svg>"
    )
