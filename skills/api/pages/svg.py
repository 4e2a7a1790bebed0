"""SVG drawings: elements, and a plot with its axes.

Drawings are `Markup`, which templates insert as it is; all other text in them is escaped. Colours and line styles are
in the style sheet of the page and chosen by class, so that a drawing follows the light or dark theme. Lengths are
pixels.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import ceil, floor, log10
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from skills.arrays import Floats


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
        drawn = [text(2, self.top - 4, name, "start")]
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
