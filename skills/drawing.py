"""Pictures of styles, drawn from what the service answers."""

from collections.abc import Sequence
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from skills.api.schemas.given import DemoPath, Policy, Rollout

RECORDED, CELLS, ROLLOUT, GOAL = (
    "#8a8f98",
    "#0072b2",
    "#d55e00",
    "#009e73",
)  # told apart by the colour-blind (Okabe, Ito)


COLUMNS = 3


def draw_styles(styles: Sequence[tuple["DemoPath", "Policy", Sequence["Rollout"]]], to: Path) -> None:
    """Draw styles beside each other: a demonstration's path, its policy, and rollouts from several starts, each."""
    rows = ceil(len(styles) / COLUMNS)
    figure = Figure(figsize=(4.4 * min(COLUMNS, len(styles)), 4.3 * rows + 0.3), layout="constrained")
    FigureCanvasAgg(figure)
    for number, (path, policy, rollouts) in enumerate(styles, start=1):
        axes = figure.add_subplot(rows, COLUMNS, number, projection="3d")
        _draw_style(axes, path, policy, rollouts)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.savefig(to, dpi=90)


def _draw_style(axes: Any, path: "DemoPath", policy: "Policy", rollouts: "Sequence[Rollout]") -> None:
    recorded, cells = np.array(path.recorded_mm), np.array(path.path_mm)
    axes.plot(*recorded.T, color=RECORDED, linewidth=1.2, label="recorded")
    for number, one in enumerate(rollouts):
        label = "learnt, from other starts" if number == 0 else None
        axes.plot(*np.array(one.path_mm).T, color=ROLLOUT, linewidth=1.0, alpha=0.75, label=label)
        axes.scatter(*one.path_mm[0], color=ROLLOUT, s=14)
    axes.plot(*cells.T, color=CELLS, linewidth=1.8, marker="o", markersize=3, label="demonstration in the grid")
    axes.scatter(*policy.goal_mm, color=GOAL, s=60, marker="*", label="goal: hand-off", zorder=5)
    axes.set_title(f"{policy.surgeon}: {policy.suture}\n{len(cells)} states, DTW {policy.metrics.dtw_total_mm:g} mm")
    axes.set_xlabel("x (mm)")
    axes.set_ylabel("y (mm)")
    axes.set_zlabel("z (mm)")
    axes.tick_params(labelsize=7)
    spans = [abs(high - low) for low, high in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    axes.set_box_aspect(spans, zoom=0.92)  # one scale on all axes
