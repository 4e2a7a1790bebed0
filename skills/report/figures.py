"""Drawings of learnt styles, of the paper's Figures 5 to 9, and of the rivals, in one set of colours."""

from collections.abc import Callable, Sequence
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from skills.arithmetic import wilson
from skills.arrays import Floats
from skills.gridworld.grid import GridPath
from skills.learning.evaluation import dtw
from skills.report.numbers import LearntStyle, Numbers

if TYPE_CHECKING:
    from skills.schemas.demos import DemoPath
    from skills.schemas.policies import Policy, Rollout

# a palette for colour-blind readers (Okabe, Ito)
RECORDED, CELLS, ROLLOUT, GOAL = "#8a8f98", "#0072b2", "#d55e00", "#009e73"
COLUMNS = 3
DPI = 110
TICK_MM = 10.0
BOX = (4, 4, 3)  # width, width, height as in the paper: flat paths are stretched to be visible; the axes show the scale
BLACK, FAILED = "#000000", "#cc79a7"
REWARDS = "PuOr"  # orange is negative, purple positive; a palette for colour-blind readers
NAME_ABOVE_MM = 6.0
PASSES = ("#0072b2", "#56b4e9", "#009e73", "#e69f00", "#d55e00")  # a palette for colour-blind readers (Okabe, Ito)

LINES = (  # of the policies and their rivals, distinguished by colour, marker and dashes at once
    (ROLLOUT, "o", "-"),
    ("#56b4e9", "P", "-."),
    ("#e69f00", "D", "--"),
    (BLACK, "x", ":"),
    (FAILED, "v", "-"),
    (CELLS, "s", "-"),
    (GOAL, "^", "--"),
)


def draw_styles(styles: Sequence[tuple["DemoPath", "Policy", Sequence["Rollout"]]], to: Path) -> None:
    """Draw styles side by side into a file: of each the demonstration, the path in the grid, and rollouts.

    Args:
        styles: For each style its demonstration's path, its policy, and rollouts from several starts.
        to: The file to write.
    """
    rows = ceil(len(styles) / COLUMNS)
    figure = Figure(figsize=(4.4 * min(COLUMNS, len(styles)), 4.3 * rows + 0.3), layout="constrained")
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


# ---- the paper's figures and the rivals ----------------------------------------------------------------------------


def draw_all(numbers: Numbers, folder: Path) -> dict[str, Path]:
    """Draw every figure of one source into a folder; returns the files by figure name."""
    files = {}
    for name, draw in DRAWINGS.items():
        files[name] = folder / f"{name}-{numbers.source.name}.png"
        figure = draw(numbers)
        figure.savefig(files[name], dpi=DPI)
    return files


def draw_fig_5(numbers: Numbers) -> Figure:
    """Draw the recovered reward (left) and the sparse one (right); size and colour show the reward of a state."""
    both, path = numbers.fig_5, numbers.source.path
    figure = _figure(11.5, 5.2)
    titles = (
        f"Maximum entropy IRL, {both.iterations} iterations\n{both.found} of its {both.visited} highest rewards "
        "are on the path",
        f"Sparse reward, Algorithm 1\n10 at the goal, 1 at {both.visited - 1} visited states, 0 elsewhere",
    )
    for place, (rewards, title) in enumerate(zip((both.recovered, both.sparse), titles, strict=True), start=1):
        axes = _space(figure, (1, 2, place), title)
        _scale(figure, axes, _dots(axes, path, rewards), rewards)
    for end, name in ((path.tip_mm[0], "start"), (path.tip_mm[-1], "goal")):
        axes.text(end[0], end[1], end[2] + NAME_ABOVE_MM, name, fontsize=9, ha="center", zorder=9)
    return _titled(figure, f"Fig. 5: reward functions of {numbers.source.title}")


def _dots(axes: Any, path: GridPath, rewards: Floats) -> Any:
    """Draw a dot for every state, the largest rewards last; scaled by the root, so that 1 is visible next to 10."""
    most = np.abs(rewards).max()
    states = np.argsort(np.abs(rewards), kind="stable")
    root = np.sign(rewards) * np.sqrt(np.abs(rewards) / most)
    # small, so that negative rewards do not hide positive ones
    sizes = (1.5 + 80 * root**2 + 40 * np.abs(root)) * np.where(root < 0, 0.3, 1.0)
    edges = np.where(root > 0.25, 0.6, 0.0)
    return axes.scatter(
        *path.grid.centres_mm(states).T,
        c=root[states],
        s=sizes[states],
        linewidths=edges[states],
        edgecolors=BLACK,
        cmap=REWARDS,
        vmin=-1,
        vmax=1,
        depthshade=False,
    )


def _scale(figure: Figure, axes: Any, dots: Any, rewards: Floats) -> None:
    most, least = float(np.abs(rewards).max()), min(float(rewards.min()), 0.0)
    bar = figure.colorbar(dots, ax=axes, shrink=0.6, pad=0.1, label="reward for entering the state")
    ticks = [value for value in (-10, -3, -1, 0, 1, 3, 10) if least <= value <= most]
    bar.set_ticks([float(np.sign(v) * np.sqrt(abs(v) / most)) for v in ticks], labels=[str(v) for v in ticks])
    bar.ax.set_ylim(-float(np.sqrt(-least / most)), 1.0)


def draw_fig_6(numbers: Numbers) -> Figure:
    """Draw a recorded motion and its path, and the paper's path, whose own recording was not published."""
    source, recorded = numbers.source, numbers.source.recorded
    panels = 2 if source.recorded_elsewhere else 1
    figure = _figure(6.2 * panels, 5.0)
    rmse = ", ".join(f"{value:.2f}" for value in recorded.rmse_mm)
    title = "a raw recording of the study, of another motion" if source.recorded_elsewhere else source.title
    counts = f"{len(recorded.tip_mm)} samples, {len(recorded.path.states)} states"
    axes = _space(figure, (1, panels, 1), f"{title}\n{counts}, RMSE {rmse} mm")
    axes.plot(*recorded.tip_mm.T, color=RECORDED, linewidth=1.4, label="raw")
    _path(axes, recorded.path, label=f"discretised, {recorded.path.grid.cell_mm:g} mm")
    _mark_ends(axes, recorded.path)
    if source.recorded_elsewhere:
        states, revisits = len(source.path.states), source.path.revisits
        axes = _space(
            figure, (1, 2, 2), f"{source.title}: published discretised\n{states} states, {revisits} visited twice"
        )
        _path(axes, source.path)
        _mark_ends(axes, source.path)
    return _titled(figure, "Fig. 6: raw and discretised trajectory", legend=True)


def draw_fig_7(numbers: Numbers) -> Figure:
    """Draw five passes, each ending at its suture point."""
    stacked = numbers.fig_7
    figure = _figure(8.6, 6.6)
    axes = _space(figure, (1, 1, 1), f"goals moved to {len(stacked.points_mm)} suture points")
    for number, (tip_mm, color) in enumerate(zip(stacked.passes_mm, PASSES, strict=True), start=1):
        axes.plot(*tip_mm.T, color=color, linewidth=1.8, marker="o", markersize=2.5, label=f"pass {number}")
        axes.scatter(*tip_mm[0], color=color, s=45, marker="s", depthshade=False)
    axes.scatter(*stacked.points_mm.T, color=BLACK, s=80, marker="*", label="suture point", zorder=9, depthshade=False)
    return _titled(figure, f"Fig. 7: one policy of {numbers.source.title}, successive passes", legend=True)


def draw_fig_8(numbers: Numbers) -> Figure:
    """Draw three policies of each learner, one learner per row, with DTW's lines to the demonstration."""
    learners = list(dict.fromkeys(one.by for one in numbers.fig_8))
    figure = _figure(12.5, 3.9 * len(learners) + 0.9)
    for row, by in enumerate(learners):
        mine = [one for one in numbers.fig_8 if one.by == by]
        for column, one in enumerate(mine, start=1):
            states, end = len(one.rollout.states), "" if one.rollout.finished else ", never arrives"
            counts = f"{states} states for {len(one.rollout.path.states)}, DTW {one.metrics.dtw_total_mm:g} mm"
            title = f"{one.by}\n{one.which}: {counts}{end}"
            _draw_learnt(_space(figure, (len(learners), 3, 3 * row + column), title), one)
    return _titled(figure, f"Fig. 8: three policies of {numbers.source.title}, with DTW", legend=True)


def _draw_learnt(axes: Any, one: LearntStyle) -> None:
    path_mm, tip_mm = one.rollout.path.tip_mm, one.rollout.tip_mm
    for i, j in dtw(tip_mm, path_mm).pairs.tolist():
        axes.plot(*np.stack((tip_mm[i], path_mm[j])).T, color=BLACK, linewidth=0.8, linestyle="--", label="DTW")
    _path(axes, one.rollout.path, width=3.6)
    axes.plot(*tip_mm.T, color=ROLLOUT, linewidth=1.6, marker="o", markersize=2.5, label="learnt")
    _mark_ends(axes, one.rollout.path)


def draw_fig_9(numbers: Numbers) -> Figure:
    """Draw ours from ten other starts, and the first published policy, which fails from some of the same starts."""
    theirs = len(numbers.fig_9[0].published) > 0
    figure = _figure(6.4 * (1 + theirs), 5.2)
    arrived = sum(one.ours.finished for one in numbers.fig_9)
    axes = _space(figure, (1, 1 + theirs, 1), f"ours, seed 0: {arrived} of {len(numbers.fig_9)} arrive")
    _draw_starts(axes, numbers, [one.ours for one in numbers.fig_9])
    if theirs:
        first = [one.published[0] for one in numbers.fig_9]
        arrived = sum(one.finished for one in first)
        axes = _space(figure, (1, 2, 2), f"published policy 1: {arrived} of {len(first)} arrive")
        _draw_starts(axes, numbers, first)
    return _titled(figure, f"Fig. 9: other starts, {numbers.source.title}", legend=True)


def _draw_starts(axes: Any, numbers: Numbers, rollouts: Sequence[Any]) -> None:
    _path(axes, numbers.source.path, width=3.2)
    for one in sorted(rollouts, key=lambda one: not one.finished):
        color, label = (ROLLOUT, "from other starts") if one.finished else (FAILED, "goes round, never arrives")
        axes.plot(*one.tip_mm.T, color=color, linewidth=1.3 if one.finished else 3.0, label=label)
        axes.scatter(*one.tip_mm[0], color=color, s=26 if one.finished else 70, depthshade=False)
    _mark_ends(axes, numbers.source.path)


def draw_rivals(numbers: Numbers) -> Figure:
    """Draw success, extra moves and DTW distance of policies and rivals against the probability of a slip."""
    figure = _figure(13.5, 5.0)
    follow, extra, off = figure.subplots(1, 3)
    for by, (color, marker, line) in zip(dict.fromkeys(one.by for one in numbers.disturbed), LINES, strict=True):
        mine = [one for one in numbers.disturbed if one.by == by]
        slips, outcomes = [one.slip for one in mine], [one.outcome for one in mine]
        style: dict[str, Any] = {"color": color, "marker": marker, "linestyle": line, "linewidth": 1.6, "markersize": 6}
        share = np.array([one.followed / one.runs for one in outcomes])
        ends = np.array([wilson(one.followed, one.runs) for one in outcomes]).T
        follow.errorbar(slips, share, yerr=np.abs(ends - share), capsize=2, label=by, **style)
        costs = [np.nan if one.extra_moves is None else one.extra_moves for one in outcomes]
        extra.plot(slips, costs, **style)
        off.plot(slips, [one.dtw_total_mm for one in outcomes], **style)
    _against_slips(follow, "follow all of the demonstration", "share of runs, with 95 % intervals")
    _against_slips(extra, "extra moves of those that follow", "moves")
    _against_slips(off, "DTW to the demonstration, all runs", "mm")
    figure.legend(*follow.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return _titled(figure, f"Rivals under slips: {numbers.source.title}, {numbers.disturbed[0].outcome.runs} runs each")


def _against_slips(axes: Any, title: str, what: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.set(xlabel="probability of a slip in each move", ylabel=what, ylim=(0, None))
    axes.grid(alpha=0.3)


def _figure(wide_inch: float, high_inch: float) -> Figure:
    figure = Figure((wide_inch, high_inch))
    figure.set_layout_engine("constrained", rect=(0.01, 0, 0.96, 1))  # the label of a z axis is outside its box
    return figure


def _space(figure: Figure, place: tuple[int, int, int], title: str) -> Any:
    """Add 3-D axes in mm with a title; their limits follow the data."""
    axes = space(figure, place)
    axes.set_title(title, fontsize=10)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(TICK_MM))
    axes.set_box_aspect(BOX, zoom=0.95)
    return axes


def _path(axes: Any, path: GridPath, *, width: float = 1.8, label: str = "demonstration in the grid") -> None:
    alpha = 0.55 if width > 2 else 1.0
    axes.plot(
        *path.tip_mm.T, color=CELLS, linewidth=width, alpha=alpha, marker="o", markersize=width + 1.5, label=label
    )


def _mark_ends(axes: Any, path: GridPath) -> None:
    axes.scatter(*path.tip_mm[0], color=CELLS, s=70, marker="s", label="start", zorder=8, depthshade=False)
    axes.scatter(*path.tip_mm[-1], color=GOAL, s=130, marker="*", label="goal", zorder=9, depthshade=False)


def _titled(figure: Figure, title: str, *, legend: bool = False) -> Figure:
    figure.suptitle(title, fontsize=13)
    if legend:
        add_legend(figure)
    return figure


DRAWINGS: dict[str, Callable[[Numbers], Figure]] = {
    "fig-5": draw_fig_5,
    "fig-6": draw_fig_6,
    "fig-7": draw_fig_7,
    "fig-8": draw_fig_8,
    "fig-9": draw_fig_9,
    "rivals": draw_rivals,
}
