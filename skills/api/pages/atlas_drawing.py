"""An atlas as SVG: the chart, and the distances in the order of the dendrogram beside it.

Surgeons are told apart by a mark, and only then by its colour: six colours and seven marks, so 42 surgeons have one of
their own. More demonstrations than can be seen are drawn in groups, as the dendrogram joins them.
"""

from collections import Counter
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from skills.library.atlas_parts import Atlas

COLOURS = 6
MARKS = (  # around 0, about 10 units wide
    "M-5 0a5 5 0 1 0 10 0a5 5 0 1 0-10 0z",  # circle
    "M-4.5-4.5h9v9h-9z",  # square
    "M0-5.8 5.4 4h-10.8z",  # triangle
    "M0-6 6 0 0 6-6 0z",  # diamond
    "M-2-6h4v4h4v4h-4v4h-4v-4h-4v-4h4z",  # cross
    "M0 5.8 5.4-4h-10.8z",  # triangle, upside down
    "M0-6.2 1.8-2h4.4l-3.5 2.8 1.3 4.4-4-2.6-4 2.6 1.3-4.4-3.5-2.8h4.4z",  # star
)
WIDE, HIGH, MARGIN = 640, 440, 34  # of the chart
TREE, CELL, MOST_GROUPS = 150, 11, 48  # width of the dendrogram, side of a cell, and how many there are at most
SHADES = 9  # of distance: the eye tells no more apart

Drawn = NDArray[np.float64]


def marks(atlas: Atlas) -> dict[str, str]:
    """Draw each surgeon's mark, to be put where it is shifted to."""
    return {one.surgeon: _mark(number) for number, one in enumerate(atlas.surgeons)}


def _mark(number: int) -> str:
    return f'<path class="mark c{number % COLOURS}" d="{MARKS[number % len(MARKS)]}"/>'


def key(mark: str) -> str:
    """Draw a mark alone, beside a name."""
    return f'<svg class="of" viewBox="-7 -7 14 14" aria-hidden="true">{mark}</svg>'


# ---- the chart ---------------------------------------------------------------------------------------------------


def chart(atlas: Atlas) -> str:
    """Draw every demonstration where it lies on the chart; medoids of surgeons have a ring and a name."""
    places = np.array([one.at for one in atlas.demos])
    scale = _scale(places)
    seen = (places - _middle(places)) * [scale, -scale] + [WIDE / 2, (HIGH - MARGIN) / 2]
    drawn, of = marks(atlas), {one.medoid: one.surgeon for one in atlas.surgeons}
    asked = None if atlas.whose is None else atlas.whose.demo
    dots, rings = [], []
    for one, (x, y) in zip(atlas.demos, seen.round(1).tolist(), strict=True):
        about = f"{one.surgeon}, session {one.session or 'not named'}, cluster {one.cluster}"
        ring = '<circle class="asked" r="14"/>' if one.id == asked else ""
        dots.append(
            f'<g transform="translate({x:g} {y:g})"><title>{escape(about)}</title>{drawn[one.surgeon]}{ring}</g>'
        )
        if one.id in of:
            rings.append((x, y, of[one.id]))
    names = "".join(
        f'<circle class="medoid" cx="{x:g}" cy="{y:g}" r="9.5"/>'
        f'<text x="{_inside(x, len(name)):g}" y="{y - 13:g}" text-anchor="middle">{escape(name)}</text>'
        for x, y, name in rings
    )
    return (
        f'<svg class="atlas-chart" viewBox="0 0 {WIDE} {HIGH}" role="img" aria-label="{len(dots)} demonstrations as '
        f'points: the nearer, the more alike">{"".join(dots)}{names}{_ruler(scale, atlas.scaled)}</svg>'
    )


def _middle(places: Drawn) -> Drawn:
    return np.asarray((places.min(axis=0) + places.max(axis=0)) / 2)


def _scale(places: Drawn) -> float:
    """Choose the pixels of a unit, the same along both axes."""
    across, up = np.ptp(places, axis=0).tolist()
    room = (WIDE - 3 * MARGIN) / max(across, 1e-9), (HIGH - 3.5 * MARGIN) / max(up, 1e-9)
    return float(min(*room, 1e3))  # where all are one there is nothing to enlarge


def _inside(x: float, letters: int) -> float:
    """Shift a name so far that none of it is cut off."""
    half = 3.6 * letters
    return min(max(x, half + 2), WIDE - half - 2)


def _ruler(scale: float, scaled: bool) -> str:
    """Draw a length with its number: the axes of a chart mean nothing, its distances do."""
    long = 10.0 ** np.floor(np.log10(WIDE / 4 / scale))
    long = next(long * factor for factor in (5, 2, 1) if long * factor * scale <= WIDE / 3)
    end, y = MARGIN + long * scale, HIGH - 14
    said = f"{100 * long:g} % of the way" if scaled else f"{long:g} mm"
    return (
        f'<path class="ruler" d="M{MARGIN} {y - 4}v8m0-4H{end:.1f}m0-4v8"/>'
        f'<text x="{end + 7:.1f}" y="{y + 4}">{said} at a place</text>'
    )


# ---- distances and dendrogram ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Leaf:
    """A group of demonstrations that are drawn as one line of cells; `part` is its number in the dendrogram."""

    part: int
    members: list[int]
    surgeon: str
    said: str


def matrix(atlas: Atlas) -> str:
    """Draw the distances between all, the nearest the darkest, and how the dendrogram joins them."""
    leaves = _leaves(atlas)
    far = _between(_whole(atlas), leaves)
    side = CELL * len(leaves)
    top = float(far.max()) or 1.0
    cells = []
    for down, row in enumerate(far.tolist()):
        for right, distance in enumerate(row):
            shade = min(int(distance / top * SHADES), SHADES - 1)
            cells.append(
                f'<rect class="s{shade}" x="{CELL * right}" y="{CELL * down}" width="{CELL}" height="{CELL}"><title>'
                f"{escape(leaves[down].said)} – {escape(leaves[right].said)}: {distance:.3g}</title></rect>"
            )
    drawn = marks(atlas)
    sides = "".join(
        f'<g transform="translate({TREE + 8} {CELL * (at + 0.5):g}) scale(.8)">{drawn[leaf.surgeon]}</g>'
        for at, leaf in enumerate(leaves)
    )
    lines = _joins(atlas, leaves)
    what = "demonstrations" if len(leaves) == len(atlas.demos) else "groups of demonstrations"
    return (
        f'<svg class="atlas-matrix" viewBox="-4 -4 {TREE + side + 24} {side + 8}" role="img" aria-label="The distances '
        f"between {len(leaves)} {what} in "
        f'the order of the dendrogram, which stands to the left">{lines}{sides}'
        f'<g transform="translate({TREE + 18} 0)">{"".join(cells)}</g></svg>'
    )


def _leaves(atlas: Atlas) -> list[_Leaf]:
    """Group the demonstrations, in order, as the dendrogram joins them first, until they can be seen."""
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


def _whole(atlas: Atlas) -> Drawn:
    whole = np.zeros((len(atlas.demos),) * 2)
    for at, row in enumerate(atlas.distances):
        whole[at, :at] = whole[:at, at] = row
    return whole


def _between(far: Drawn, leaves: list[_Leaf]) -> Drawn:
    """Average the distances between groups, (G, G)."""
    member = np.zeros((len(leaves), len(far)))
    for at, leaf in enumerate(leaves):
        member[at, leaf.members] = 1.0 / len(leaf.members)
    return np.asarray(member @ far @ member.T)


def _joins(atlas: Atlas, leaves: list[_Leaf]) -> str:
    """Draw the merges of the groups: each where its two are joined, the nearer the further right."""
    furthest = atlas.merges[-1].distance if atlas.merges else 0.0
    ends = {leaf.part: (float(TREE), CELL * (at + 0.5)) for at, leaf in enumerate(leaves)}
    lines = []
    for made, merge in enumerate(atlas.merges, start=len(atlas.demos)):
        if merge.one not in ends:
            continue  # within a group
        (x1, y1), (x2, y2) = ends.pop(merge.one), ends.pop(merge.other)
        x = round(TREE * (1 - merge.distance / (furthest or 1.0)) + 1, 1)
        lines.append(f"M{x1:g} {y1:g}H{x:g}V{y2:g}H{x2:g}")
        ends[made] = x, (y1 + y2) / 2
    return f'<path class="tree" d="{"".join(lines)}"/>'


def thirds(shares: list[list[float]]) -> str:
    """Draw where two surgeons differ: thirds of the way from left to right, axes from top to bottom."""
    top = max(map(max, shares)) or 1.0
    cells = "".join(
        f'<rect class="s{SHADES - 1 - min(int(share / top * SHADES), SHADES - 1)}" x="{12 * part}" y="{8 * axis}" '
        f'width="11" height="7"/>'
        for part, row in enumerate(shares)
        for axis, share in enumerate(row)
    )
    return f'<svg class="thirds" viewBox="0 0 35 23" aria-hidden="true">{cells}</svg>'
