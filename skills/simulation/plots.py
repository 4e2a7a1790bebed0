"""Plots of a playback over time: the joints with their limits, and the distances between surfaces.

They are drawn without matplotlib's global state; the same playback gives the same bytes if the versions are the same.
The colours are distinguishable for the colour-blind (Okabe and Ito), and where lines of two kinds cross their dashes
differ too. The simulator's processes do not import this module: matplotlib would be half of their start.
"""

import io
from collections.abc import Mapping
from math import ceil
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from skills.arrays import Floats, Ints
from skills.kinematics import JOINTS, UNITS, instrument_of
from skills.planning.motion_laws import A2, PHASES, TRANSFER
from skills.planning.trajectory import Trajectory
from skills.verification.playback import CLEARANCE_SEEN_MM, PAD, PSM_A, PSM_M, LinkPair, Playback

Report = Mapping[str, Any]  # the report on the playback, as a client receives it

DPI = 110
WIDE_INCH = 11.5
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


def draw_joints(trajectory: Trajectory, playback: Playback, report: Report) -> Figure:
    """Plot the joints of both arms with their limits, a panel for each joint, angles in degrees.

    PSM_A's joints are those read back from the simulator, PSM_M's the commanded ones.
    """
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


def draw_clearance(trajectory: Trajectory, playback: Playback, report: Report) -> Figure:
    """Plot the distances between the nearest surfaces at the measured samples: from the pad, and between the arms."""
    shown = DISTANCES[: 1 if trajectory.psm_m is None else 2]
    figure = Figure((WIDE_INCH, 1.2 + 2.6 * len(shown)), layout="constrained")
    panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False)
    kinds = [_kind(pair) for pair in playback.link_pairs]
    for axes, (name, allowed, labels) in zip(panels.flat, shown, strict=True):
        for label in labels:
            mine = [column for column, kind in enumerate(kinds) if kind == label]
            if mine:
                _plot(axes, label, trajectory, playback.looked_at, playback.clearances_mm[:, mine].min(axis=1))
        axes.axhline(float(report["settings"][allowed]), label="limit", **LINES["limit"])
        axes.set_ylabel(f"{name} (mm)")
    title = f"Distances between the nearest surfaces, as far as {CLEARANCE_SEEN_MM:g} mm"
    return _finished(figure, title, trajectory, report)


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG."""
    FigureCanvasAgg(figure)
    out = io.BytesIO()
    figure.savefig(out, dpi=DPI, format="png", metadata={"Software": None})
    return out.getvalue()


def _kind(pair: LinkPair) -> str:
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


def _finished(figure: Figure, title: str, trajectory: Trajectory, report: Report) -> Figure:
    """Add the phases, the passes, the verdict with the first sample that fails, and the legend."""
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
    verdict = report["failure_in_words"] or "Feasible in an exact simulation."
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
