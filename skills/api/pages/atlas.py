"""Drawings of an atlas: the chart, and the distance matrix in the order of the dendrogram to its left.

Surgeons differ by marker first and by colour second: with six colours and seven markers, 42 surgeons have one of their
own. If there are more demonstrations than can be seen, they are drawn in groups, as the dendrogram joins them.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from skills.api.pages.svg import box, drawing, element, text
from skills.arrays import Floats
from skills.schemas.given import Atlas

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


def marks(atlas: Atlas) -> dict[str, Markup]:
    """Return the marker of each surgeon as an SVG path centred at the origin."""
    return {
        one.surgeon: element("path", kind=f"mark c{number % COLOURS}", d=MARKS[number % len(MARKS)])
        for number, one in enumerate(atlas.surgeons)
    }


def key(mark: Markup) -> Markup:
    """Return a marker as a drawing of its own, to stand next to a name."""
    return drawing(None, (-7, -7), (14, 14), mark, kind="of")


# ---- the chart ---------------------------------------------------------------------------------------------------


def chart(atlas: Atlas) -> Markup:
    """Draw every demonstration at its position on the chart; the medoid of each surgeon has a ring and a name."""
    places = np.array([one.at for one in atlas.demos])
    low, high = places.min(axis=0), places.max(axis=0)
    room = np.array([WIDE - 3 * MARGIN, HIGH - 3.5 * MARGIN]) / np.maximum(high - low, 1e-9)
    scale = float(min(*room, 1e3))  # pixels per unit along both axes; limited, for the case that all points coincide
    seen = (places - (low + high) / 2) * [scale, -scale] + [WIDE / 2, (HIGH - MARGIN) / 2]
    drawn, of = marks(atlas), {one.medoid: one.surgeon for one in atlas.surgeons}
    asked = None if atlas.whose is None else atlas.whose.demo
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


# ---- distances and dendrogram ------------------------------------------------------------------------------------


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
