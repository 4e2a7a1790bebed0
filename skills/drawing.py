"""Pictures of styles, drawn from responses of the service; and what other 3-D pictures share with them."""

from collections.abc import Sequence
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from skills.schemas.given import DemoPath, Policy, Rollout

# a palette for colour-blind readers (Okabe, Ito)
RECORDED, CELLS, ROLLOUT, GOAL = "#8a8f98", "#0072b2", "#d55e00", "#009e73"
COLUMNS = 3


def draw_styles(styles: Sequence[tuple["DemoPath", "Policy", Sequence["Rollout"]]], to: Path) -> None:
    """Draw styles side by side into a file: of each the demonstration, the path in the grid, and rollouts.

    Args:
        styles: For each style its demonstration's path, its policy, and rollouts from several starts.
        to: The file to write.
    """
    rows = ceil(len(styles) / COLUMNS)
    figure = Figure(figsize=(4.4 * min(COLUMNS, len(styles)), 4.3 * rows + 0.3), layout="constrained")
    FigureCanvasAgg(figure)
    for number, (path, policy, rollouts) in enumerate(styles, start=1):
        _draw_style(space(figure, (rows, COLUMNS, number)), path, policy, rollouts)
    add_legend(figure)
    figure.savefig(to, dpi=90)


def space(figure: Figure, place: tuple[int, int, int]) -> Any:
    """Add 3-D axes in mm at a place: rows, columns and number."""
    axes: Any = figure.add_subplot(*place, projection="3d")
    axes.set(xlabel="x (mm)", ylabel="y (mm)", zlabel="z (mm)")
    axes.tick_params(labelsize=7)
    return axes


def add_legend(figure: Figure) -> None:
    """Add a legend below the figure, with each label once."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=len(entries), frameon=False)


def _draw_style(axes: Any, path: "DemoPath", policy: "Policy", rollouts: "Sequence[Rollout]") -> None:
    recorded, cells = np.array(path.recorded_mm), np.array(path.path_mm)
    axes.plot(*recorded.T, color=RECORDED, linewidth=1.2, label="recorded")
    for one in rollouts:
        seen = np.array(one.path_mm).T
        axes.plot(*seen, color=ROLLOUT, linewidth=1.0, alpha=0.75, label="learnt, from other starts")
        axes.scatter(*one.path_mm[0], color=ROLLOUT, s=14)
    axes.plot(*cells.T, color=CELLS, linewidth=1.8, marker="o", markersize=3, label="demonstration in the grid")
    axes.scatter(*policy.goal_mm, color=GOAL, s=60, marker="*", label="goal: hand-off", zorder=5)
    axes.set_title(f"{policy.surgeon}: {policy.suture}\n{len(cells)} states, DTW {policy.metrics.dtw_total_mm:g} mm")
    spans = [abs(high - low) for low, high in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    axes.set_box_aspect(spans, zoom=0.92)  # the same scale on all axes
