"""The pictures of a playback: the still image with the passes drawn into it, and plots over time.

The still image is the simulator's image, in metres; no simulator is used here. Parts behind a surface of the image are
drawn pale. Everything is drawn at a larger scale and then shrunk, which smooths the edges of the simulator's renderer.
`skills.simulation.film` draws its frames with the same `Sheet`.

The plots show the joints with their limits, and the distances between surfaces. They are drawn without matplotlib's
global state; the same playback gives the same bytes if the versions are the same. Where lines of two kinds cross their
dashes differ too. matplotlib is imported where it is used: it would be half of the start of the simulator's processes.

All colours are distinguishable for the colour-blind (Okabe and Ito).
"""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, radians, tan
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from skills.arrays import Flags, Floats, Ints
from skills.demonstration.movement import lengths_along
from skills.kinematics import JOINTS, UNITS, instrument_of, matrix_of
from skills.planning.motion_laws import A2, PHASES, TRANSFER
from skills.planning.trajectory import PSM_A, PSM_M, Trajectory
from skills.verification.bodies import distances_at, names_of, parts_of, radii_of
from skills.verification.playback import CLEARANCE_SEEN_MM, PAD, LinkPair, Playback

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 640, 480
_SCALE = 2.0
_DOT_EVERY_M = 0.005  # the paper's cell
_BEHIND_M = 0.001
Colour = tuple[int, int, int]
PASS_COLOURS: tuple[Colour, ...] = (
    (213, 94, 0),
    (0, 114, 178),
    (204, 121, 167),
    (230, 159, 0),
    (86, 180, 233),
    (0, 0, 0),
)
GOAL_COLOUR: Colour = (0, 158, 115)
WHITE: Colour = (255, 255, 255)
Report = Mapping[str, Any]  # the report on the playback, as a client receives it

DPI = 110
WIDE_INCH = 11.5
BODIES_INCH = 5.2
VIEWS = (("The arms' outer bodies from the side:\n{}", 1, 2), ("from above", 0, 1))
FAILS = "#d55e00"
DASHED: Any = (0, (4, 1.5))
FINGERS_OF_BOTH, OTHERS = "fingers, which may touch at the hand-off", "all other links of both"
LINES: dict[str, dict[str, Any]] = {
    "PSM_A": {"color": "#0072b2"},
    "PSM_M": {"color": "#009e73", "linestyle": DASHED},
    "PSM_A to the pad": {"color": "#0072b2"},
    "PSM_M to the pad": {"color": "#009e73", "linestyle": DASHED},
    FINGERS_OF_BOTH: {"color": "#cc79a7", "linestyle": DASHED},
    OTHERS: {"color": "#56b4e9"},
    "limit": {"color": "#d55e00", "linestyle": "--"},
    "first sample that fails": {"color": "#000000", "linestyle": ":"},
}
DISTANCES = (  # a panel each: its title, the setting that limits it, its lines
    ("distance to the pad", "clearance_pad_mm", ("PSM_A to the pad", "PSM_M to the pad")),
    ("distance between the arms", "clearance_psm_m_mm", (OTHERS, FINGERS_OF_BOTH)),
)
SHADES = {TRANSFER: "#e2e2e2", A2: "#fbe9b7"}  # A1 stays white
_FAINT = "#777777"
_NUMBERED = 20  # passes: more numbers than these would overlap
_ABREAST = 6  # entries in a row of the legend
_ROOM = 0.08  # margin above and below the limits, as a part of their range


@dataclass(frozen=True)
class Camera:
    """A camera around and above a target, z up; its image is `scale` times as large as the finished picture."""

    target_m: tuple[float, float, float]
    distance_m: float
    yaw_deg: float = 40.0
    pitch_deg: float = -20.0
    field_deg: float = 45.0
    near_m: float = 0.01
    far_m: float = 2.0
    width: int = int(WIDTH * _SCALE)
    height: int = int(HEIGHT * _SCALE)
    scale: float = _SCALE


@dataclass(frozen=True, eq=False)
class Photograph:
    """The camera's image: colours (H, W, 3), depth buffer (H, W) of 0 to 1, and the two matrices (4, 4)."""

    rgb: NDArray[np.uint8]
    depth: Floats
    view: Floats
    projection: Floats


class Sheet:
    """An image to draw into. Positions are metres in the camera's world, sizes pixels of the finished picture."""

    def __init__(self, taken: Photograph, camera: Camera) -> None:
        self._taken = taken
        self._camera = camera
        self._image = Image.fromarray(taken.rgb)
        self._pen = ImageDraw.Draw(self._image, "RGBA")

    def line(self, path: Floats, colour: Colour, width: float = 1.5, strength: float = 0.9) -> None:
        """Draw a line along a path, shape (K, 3), pale behind surfaces."""
        pixels, hidden = self._project(path)
        where = [tuple(pixel) for pixel in pixels.tolist()]
        for begin, end in _runs(hidden[:-1]):
            alpha = strength * (0.3 if hidden[begin] else 1.0)
            fill = (*colour, round(255 * alpha))
            self._pen.line(where[begin : end + 1], fill=fill, width=round(width * self._camera.scale), joint="curve")

    def dots(self, places: Floats, colour: Colour) -> None:
        """Draw dots at places, shape (K, 3), pale behind surfaces."""
        pixels, hidden = self._project(places)
        for pixel, pale in zip(pixels, hidden.tolist(), strict=True):
            self._dot(pixel, 2.6, (*colour, round(255 * (0.35 if pale else 1.0))))

    def label(self, place: Floats, colour: Colour, text: str, size: float = 10.0) -> None:
        """Draw a short text on a disc with a white rim, in front of everything."""
        pixels, _ = self._project(place[None])
        self._dot(pixels[0], size * 0.8, (*WHITE, 255))
        self._dot(pixels[0], size * 0.7, (*colour, 255))
        font = ImageFont.load_default(size=size * self._camera.scale)
        self._pen.text(tuple(pixels[0].tolist()), text, fill=(*WHITE, 255), font=font, anchor="mm")

    def finished(self) -> Image.Image:
        """Return the drawing, shrunk to the size of the finished picture."""
        size = round(self._camera.width / self._camera.scale), round(self._camera.height / self._camera.scale)
        return self._image.resize(size, Image.Resampling.LANCZOS)

    def _dot(self, centre: Floats, radius: float, fill: tuple[int, int, int, int]) -> None:
        x, y, r = float(centre[0]), float(centre[1]), radius * self._camera.scale
        self._pen.ellipse((x - r, y - r, x + r, y + r), fill=fill)

    def _project(self, points: Floats) -> tuple[Floats, Flags]:
        """Return the pixels of points, shape (K, 2), and whether they are behind the visible surface, shape (K,)."""
        taken, camera = self._taken, self._camera
        ahead = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ taken.view.T
        clip = ahead @ taken.projection.T
        ndc = clip[:, :3] / clip[:, 3:]
        height, width = taken.depth.shape
        pixels = np.stack([(ndc[:, 0] + 1) / 2 * width, (1 - ndc[:, 1]) / 2 * height], axis=1)
        column = np.clip(pixels[:, 0].astype(int), 0, width - 1)
        row = np.clip(pixels[:, 1].astype(int), 0, height - 1)
        near, far = camera.near_m, camera.far_m
        surface = far * near / (far - (far - near) * taken.depth[row, column])
        return pixels, -ahead[:, 2] - surface >= _BEHIND_M


def draw(photograph: Callable[[Camera], Photograph], paths: Sequence[Floats]) -> bytes:
    """Return a PNG of 640 x 480 that shows all passes, numbered from 0.

    Args:
        photograph: Callback that returns the image of a camera.
        paths: The tip's path in each pass, metres in the camera's world, each of shape (K, 3).
    """
    camera = facing(np.concatenate(paths))
    sheet = Sheet(photograph(camera), camera)
    for number, path in enumerate(paths):
        colour = colour_of(number)
        sheet.line(thinned(path), colour)
        sheet.dots(stepping_stones(path), colour)
    for number, path in enumerate(paths):
        sheet.label(path[-1], GOAL_COLOUR, str(number))
    out = io.BytesIO()
    sheet.finished().save(out, "PNG", optimize=True)
    return out.getvalue()


def facing(points: Floats) -> Camera:
    """Return a camera so far away that all points are in the middle two thirds of the picture."""
    low, high = points.min(axis=0), points.max(axis=0)
    x, y, z = ((low + high) / 2).tolist()
    radius = max(float(np.linalg.norm(high - low)) / 2, 0.015)
    distance = radius / tan(radians(45.0) / 2) * 1.35
    return Camera(target_m=(x, y, z), distance_m=distance)


def colour_of(number: int) -> Colour:
    """Return the colour of a pass."""
    return PASS_COLOURS[number % len(PASS_COLOURS)]


def thinned(path: Floats) -> Floats:
    """Return at most 400 points of a path, shape (K, 3), its ends among them."""
    kept = np.unique(np.linspace(0, len(path) - 1, min(len(path), 400)).round().astype(int))
    return np.asarray(path[kept])


def stepping_stones(path: Floats) -> Floats:
    """Return a point of a path every 5 mm of its length."""
    walked = lengths_along(path)
    at = np.searchsorted(walked, np.arange(0.0, walked[-1] + 1e-9, _DOT_EVERY_M))
    return np.asarray(path[np.unique(np.minimum(at, len(path) - 1))])


def _runs(marks: Flags) -> list[tuple[int, int]]:
    """Split marks into runs of equal ones, as (begin, end)."""
    cuts = [0, *(np.flatnonzero(np.diff(marks)) + 1).tolist(), len(marks)]
    return [(begin, end) for begin, end in pairwise(cuts) if end > begin]


# ---- plots over time -----------------------------------------------------------------------------------------------


def draw_joints(trajectory: Trajectory, playback: Playback, report: Report) -> "Figure":
    """Plot the joints of both arms with their limits, a panel for each joint, angles in degrees.

    PSM_A's joints are those read back from the simulator, PSM_M's the commanded ones.
    """
    from matplotlib.figure import Figure

    arms = [(PSM_A, instrument_of(trajectory.instrument), playback.joints)]
    if (m := trajectory.psm_m) is not None:
        arms.append((PSM_M, instrument_of(m.instrument), m.joints))
    figure = Figure((WIDE_INCH, 6.4), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True)
    for joint, axes in enumerate(panels.flat):
        unit, scale = ("mm", 1.0) if UNITS[joint] == "mm" else ("deg", float(np.degrees(1.0)))
        for name, _, joints in arms:
            _plot(axes, name, trajectory, np.arange(len(trajectory)), joints[:, joint] * scale)
        limits = {float(bound[joint]) * scale for _, tool, _ in arms for bound in (tool.lower, tool.upper)}
        for limit in sorted(limits):
            axes.axhline(limit, label="limit", **LINES["limit"])
        room = _ROOM * (max(limits) - min(limits))
        axes.set_ylim(min(limits) - room, max(limits) + room)
        axes.set_ylabel(f"{JOINTS[joint].replace('_', ' ')} ({unit})")
    return _finished(figure, "Joints and their limits", trajectory, report)


def draw_clearance(trajectory: Trajectory, playback: Playback, report: Report) -> "Figure":
    """Plot the distances between the nearest surfaces at the measured samples: from the pad, and between the arms.

    Below are the outer bodies of both arms where they are nearest to each other, from the side and from above.
    """
    from matplotlib.figure import Figure

    shown = DISTANCES[: 1 if trajectory.psm_m is None else 2]
    nearest = None if trajectory.psm_m is None else _nearest_bodies(trajectory, report)
    height = 1.2 + 2.6 * len(shown)
    figure = Figure((WIDE_INCH, height + (BODIES_INCH if nearest else 0.0)), layout="constrained")
    upper: Any = figure
    lower: Any = None
    if nearest:
        both: Any = figure.subfigures(2, 1, height_ratios=(height, BODIES_INCH))
        upper, lower = both
    panels = upper.subplots(len(shown), 1, sharex=True, squeeze=False)
    kinds = [_kind(pair) for pair in playback.link_pairs]
    for axes, (name, allowed, labels) in zip(panels.flat, shown, strict=True):
        for label in labels:
            mine = [column for column, kind in enumerate(kinds) if kind == label]
            if mine:
                _plot(axes, label, trajectory, playback.looked_at, playback.clearances_mm[:, mine].min(axis=1))
        axes.axhline(float(report["settings"][allowed]), label="limit", **LINES["limit"])
        axes.set_ylabel(f"{name} (mm)")
    title = f"Distances between the nearest surfaces, as far as {CLEARANCE_SEEN_MM:g} mm"
    _finished(figure, title, trajectory, report)
    if lower is not None and nearest is not None:
        for axes, view in zip(lower.subplots(1, 2), VIEWS, strict=True):
            _draw_bodies(axes, view, trajectory, nearest)
    return figure


def _nearest_bodies(trajectory: Trajectory, report: Report) -> Mapping[str, Any] | None:
    """Return the nearest two outer bodies of a report; where all are far, those at the ends of the passes."""
    bodies = report.get("bodies")
    if bodies is None or trajectory.psm_m is None:
        return None
    if bodies["nearest"]:
        return dict(bodies["nearest"][0])
    ends = trajectory.last_samples
    apart = distances_at(trajectory, ends)
    end, part, other = np.unravel_index(int(apart.argmin()), apart.shape)
    return {
        "part": names_of(trajectory.instrument)[part],
        "other": names_of(trajectory.psm_m.instrument)[other],
        "least_mm": float(apart[end, part, other]),
        "sample": int(ends[end]),
        "stamp_s": float(trajectory.stamps_s[ends[end]]),
    }


def _draw_bodies(axes: Any, view: tuple[str, int, int], trajectory: Trajectory, nearest: Mapping[str, Any]) -> None:
    """Draw the outer bodies of both arms at the sample where two are nearest, seen along one axis."""
    from matplotlib.patches import Polygon

    (title, across, up), m, at = view, trajectory.psm_m, [nearest["sample"]]
    assert m is not None
    parts = parts_of(trajectory.joints[at], trajectory.instrument)
    other = parts_of(m.joints[at], m.instrument).seen_from(matrix_of(m.base_xyzw[None])[0], m.base_mm)
    ends = []
    for name, one, tool, part in (
        (PSM_A, parts, trajectory.instrument, nearest["part"]),
        (PSM_M, other, m.instrument, nearest["other"]),
    ):
        colour = LINES[name]["color"]
        drawn = zip(names_of(tool), one.begin_mm[0], one.end_mm[0], radii_of(tool), strict=True)
        for body, begin, end, radius in drawn:
            outline = _outline(begin[[across, up]], end[[across, up]], float(radius))
            axes.add_patch(Polygon(outline, facecolor=colour, alpha=0.18))
            heavy = body == part
            axes.add_patch(Polygon(outline, fill=False, edgecolor=colour, linewidth=2.4 if heavy else 0.7))
            if heavy:
                ends.append((begin, end, float(radius)))
        centre = np.zeros(3) if name == PSM_A else m.base_mm
        axes.plot(*centre[[across, up]], marker="+", color=colour, markersize=9)
        axes.annotate(name, one.begin_mm[0, 0, [across, up]], color=colour, ha="center", va="center", fontsize=9)
    first, second = _between_axes(*ends)
    line = np.stack([first, second])[:, [across, up]]
    axes.plot(*line.T, color=FAILS, linewidth=3, marker=".", zorder=5)
    apart = f"{nearest['part']} and {nearest['other']}, {nearest['least_mm']:.1f} mm at {nearest['stamp_s']:.2f} s"
    axes.set_title(title.format(apart), fontsize=9, loc="left")
    axes.set_xlabel(f"{'xyz'[across]} (mm, base of PSM_A)")
    axes.set_ylabel(f"{'xyz'[up]} (mm)")
    axes.autoscale_view()
    axes.set_aspect("equal")


def _outline(begin: Floats, end: Floats, radius: float) -> Floats:
    """Return the outline of a capsule seen along an axis, shape (N, 2)."""
    way = end - begin
    towards = np.arctan2(way[1], way[0])
    half = np.linspace(-np.pi / 2, np.pi / 2, 24)
    turned = np.concatenate((towards + half, towards + np.pi + half))
    round_ends = radius * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    return np.concatenate((end + round_ends[:24], begin + round_ends[24:]))


def _between_axes(one: tuple[Floats, Floats, float], other: tuple[Floats, Floats, float]) -> tuple[Floats, Floats]:
    """Return the nearest points of two capsules' surfaces, as exactly as a line is drawn."""
    share = np.linspace(0.0, 1.0, 201)[:, None]
    p, q = (begin + share * (end - begin) for begin, end, _ in (one, other))
    apart = np.linalg.norm(p[:, None] - q, axis=2)
    i, j = np.unravel_index(int(apart.argmin()), apart.shape)
    way = (q[j] - p[i]) / max(float(apart[i, j]), 1e-9)
    return p[i] + one[2] * way, q[j] - other[2] * way


def png(figure: "Figure") -> bytes:
    """Return a figure as a PNG."""
    out = io.BytesIO()
    figure.savefig(out, dpi=DPI, format="png", metadata={"Software": None})
    return out.getvalue()


def _kind(pair: LinkPair) -> str:
    """Return the label of the line in which a pair's distance is plotted."""
    if pair.other == PAD:
        return f"{pair.body} to the pad"
    return FINGERS_OF_BOTH if pair.may_touch else OTHERS


def _plot(axes: Any, label: str, trajectory: Trajectory, at: Ints, values: Floats) -> None:
    """Plot values at some samples over time, with a gap between passes."""
    times, seams = _times(trajectory)[at], np.flatnonzero(np.diff(trajectory.pass_index[at])) + 1
    broken = np.insert(times, seams, times[seams]), np.insert(values, seams, np.nan)
    axes.plot(*broken, label=label, linewidth=1.6, **LINES[label])


def _times(trajectory: Trajectory) -> Floats:
    return np.asarray(trajectory.stamps_s - trajectory.stamps_s[0])


def _finished(figure: "Figure", title: str, trajectory: Trajectory, report: Report) -> "Figure":
    """Add the phases, the passes, the verdict with the first sample that fails, and the legend."""
    from matplotlib.patches import Patch

    axes: Any
    shown: dict[str, Any] = {}
    for axes in figure.axes:
        _shade(axes, trajectory)
        if report["failure"] is not None:
            failed_s = _times(trajectory)[report["failure"]["sample"]]
            axes.axvline(failed_s, label="first sample that fails", **LINES["first sample that fails"])
        axes.grid(axis="y", alpha=0.3)
        if axes.get_subplotspec().is_last_row():
            axes.set_xlabel("time (s)")
        handles, labels = axes.get_legend_handles_labels()
        shown |= dict(zip(labels, handles, strict=True))
    shown |= {PHASES[phase]: Patch(color=shade) for phase, shade in SHADES.items()}
    columns = ceil(len(shown) / ceil(len(shown) / _ABREAST))
    figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
    verdict = report["failure_sentence"] or "Feasible in an exact simulation."
    figure.suptitle(f"{title}\n{verdict}", fontsize=11, x=0.01, ha="left", linespacing=1.5)
    figure.text(0.995, 0.99, "research use only", ha="right", va="top", fontsize=8, color=_FAINT)
    return figure


def _shade(axes: Any, trajectory: Trajectory) -> None:
    """Shade the phases, and number the passes from 0 as in reports."""
    times, above = _times(trajectory), axes.get_xaxis_transform()
    parts = np.flatnonzero(np.diff(trajectory.pass_index * len(PHASES) + trajectory.phase)) + 1
    begins, ends = np.append(0, parts), np.append(parts, len(times)) - 1
    for phase, shade in SHADES.items():
        mine = trajectory.phase[begins] == phase
        spans = np.stack([times[begins[mine]], times[ends[mine]] - times[begins[mine]]], axis=1)
        axes.broken_barh(spans.tolist(), (0, 1), transform=above, color=shade, zorder=0)
    if trajectory.passes <= _NUMBERED:
        lasts = trajectory.last_samples
        middles = (times[np.append(0, lasts[:-1] + 1)] + times[lasts]) / 2
        for number, middle in enumerate(middles.tolist()):
            axes.text(middle, 1.01, str(number), transform=above, ha="center", fontsize=8, color=_FAINT)
    axes.set_xlim(times[0], max(times[-1], times[0] + 1e-3))
