"""HTML of values for notebooks: facts in a table, and paths seen from two sides.

`_repr_html_` of a value returns it, which Jupyter, VS Code and others show in place of the value's name. It is one
element without scripts, style sheets and addresses. Its lines and texts have the colour of the notebook's own text, so
that it can be read on light and on dark ground; paths differ by their widths, not by colour.
"""

from collections.abc import Mapping, Sequence
from html import escape
from math import isnan

import numpy as np

from skills.arrays import Floats

SIDE = 220  # of a view, in pixels
VIEWS = ((0, 1), (0, 2))  # seen along z, and along y
MOST_POINTS = 500  # of a line: more cannot be seen
BEHIND, FRONT = "stroke-width:6;opacity:.3", "stroke-width:1.4"


def card(title: str, facts: Mapping[str, object], paths: Mapping[str, Sequence[Floats]] | None = None) -> str:
    """Return a value as HTML.

    Args:
        title: The class of the value, and its name if it has one.
        facts: Words and values; a number is rounded to four digits, and None left out.
        paths: By its name each kind of path, one or two, in mm of one frame, each of shape (T, 3), T at least 1; the
            start of the first one is a dot, the end of the last one of its kind a ring.

    Returns:
        One element; every text in it is escaped.
    """
    rows = "".join(
        f'<tr><th style="text-align:left;font-weight:normal;opacity:.75">{escape(name)}</th>'
        f'<td style="text-align:left">{escape(_worded(value))}</td></tr>'
        for name, value in facts.items()
        if value is not None
    )
    drawn = "" if paths is None else _views(paths)
    return (
        '<div style="display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start;color:inherit">'
        f'<table style="color:inherit;background:none"><caption style="text-align:left;color:inherit;font-weight:bold">'
        f"{escape(title)}</caption><tbody>{rows}</tbody></table>{drawn}</div>"
    )


def _worded(value: object) -> str:
    if not isinstance(value, float):
        return str(value)
    return "not measured" if isnan(value) else f"{value:.4g}"


def _views(paths: Mapping[str, Sequence[Floats]]) -> str:
    """Draw the paths along z and y at one scale, with their names below."""
    everything = np.concatenate([points for same in paths.values() for points in same])
    middle = (everything.min(axis=0) + everything.max(axis=0)) / 2
    half = float(np.ptp(everything, axis=0).max()) * 0.54 or 0.5
    styles = (BEHIND, FRONT)[-len(paths) :]
    views = []
    for axes in VIEWS:
        right, up = ("xyz"[axis] for axis in axes)
        low, high = (f"{middle[axes[0]] + sign * half:.0f}" for sign in (-1, 1))
        inside = [
            f'<rect width="{SIDE}" height="{SIDE}" style="fill:none;stroke:currentColor;opacity:.3"/>',
            f'<text x="2" y="{SIDE + 14}" style="{TEXT}">{low}</text>',
            f'<text x="{SIDE / 2:g}" y="{SIDE + 14}" text-anchor="middle" style="{TEXT}">{right} in mm</text>',
            f'<text x="{SIDE - 2}" y="{SIDE + 14}" text-anchor="end" style="{TEXT}">{high}</text>',
            f'<text x="4" y="14" style="{TEXT}">{up}</text>',
        ]
        for style, same in zip(styles, paths.values(), strict=True):
            inside += [_line(_placed(points, middle, half, axes), style) for points in same]
        first = next(iter(paths.values()))
        (x, y), (end_x, end_y) = (_placed(points, middle, half, axes)[0] for points in (first[0], first[-1][::-1]))
        inside.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" style="fill:currentColor"/>')
        inside.append(f'<circle cx="{end_x:.1f}" cy="{end_y:.1f}" r="4" style="fill:none;stroke:currentColor"/>')
        views.append(
            f'<svg role="img" aria-label="{escape(", ".join(paths))}: {right} and {up}" width="{SIDE}" '
            f'height="{SIDE + 18}" viewBox="-1 -1 {SIDE + 2} {SIDE + 20}">{"".join(inside)}</svg>'
        )
    named = "".join(
        f'<span style="margin-right:1em"><svg aria-hidden="true" width="28" height="8">{_line(KEY, style)}</svg> '
        f"{escape(name)}</span>"
        for name, style in zip(paths, styles, strict=True)
    )
    return f"<div>{''.join(views)}<div>{named}</div></div>"


TEXT = "fill:currentColor;font:11px sans-serif"
KEY = np.array([[1.0, 4.0], [27.0, 4.0]])


def _placed(points: Floats, middle: Floats, half: float, axes: tuple[int, int]) -> Floats:
    """Return points in pixels of a view, (K, 2), thinned; the last one stays."""
    every = -(-len(points) // MOST_POINTS)
    thinned = np.concatenate((points[:-1:every], points[-1:]))[:, axes]
    share = (thinned - middle[list(axes)]) / (2 * half) + 0.5
    return np.asarray(np.stack((share[:, 0], 1 - share[:, 1]), axis=1) * SIDE)


def _line(points: Floats, style: str) -> str:
    places = " ".join(f"{x:.1f},{y:.1f}" for x, y in points.tolist())
    return f'<polyline points="{places}" style="fill:none;stroke:currentColor;{style}"/>'
