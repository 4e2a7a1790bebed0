"""A style at other wound lines: rotated, scaled and moved, compared with movement primitives to another start and goal.

Lines are drawn from a range (`line`), for the hand-off of each sample surgeon. All methods get the demonstration
without tremor, at 100 Hz. A dynamic movement primitive learns from that one. A probabilistic one needs several: it
gets twenty, which differ by one day's variation and by 5 mm in start and end, and is conditioned on start and goal.
"""

import io
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from movement_primitives.dmp import DMP
from movement_primitives.promp import ProMP
from rich.table import Table

from skills.comparison.combining import moved
from skills.comparison.distances import TREMOR_S, placed, resampled
from skills.demonstration.demonstration import Demo, cut_demo
from skills.demonstration.movement import smoothed_tip
from skills.formats import read_recording
from skills.gridworld.grid import choose_grid, discretize
from skills.kinematics import POINTING_DOWN, reachable
from skills.learning.evaluation import dtw
from skills.learning.slip_runs import replay
from skills.planning.path_fit import fit_to_demo, trace
from skills.seeds.recordings import sample_recordings

SEED = 2000
LINES = 50  # for each sample
GOALS_MM = ((-80.0, 80.0), (-20.0, 120.0), (-180.0, -60.0))  # the paper's grid and the same margin around it
SCALES, TURNS_RAD, TILTS_RAD = (0.5, 2.0), (-np.pi / 2, np.pi / 2), (-np.pi / 9, np.pi / 9)
SHOWN = 20  # demonstrations for a probabilistic primitive
DAY_MM, ENDS_MM = 1.5, 5.0
WEIGHTS = {"dmp": 50, "promp": 20}  # along each axis; more change little
SURE_MM2 = 1e-6  # variance of a position that a probabilistic primitive is conditioned on

Elsewhere = Callable[[np.ndarray, np.ndarray], Demo]  # to a start and a goal
Method = Callable[[Demo], Elsewhere]


def geometry(table: Table, lines: int = LINES) -> None:
    """Print the remaining shape error, the smoothness, and whether the arm reaches the path."""
    table.add_row("[bold]at other wound lines", "shape, mm at a state: at its own, mean, worst", "jerk, ends, in reach")
    for name, method in METHODS.items():
        figures = np.array(list(measured(method, lines))).reshape(-1, lines + 1, 4)
        shape, jerk, ends, within = np.moveaxis(figures[:, 1:], 2, 0)
        table.add_row(
            f"  {name}",
            f"{figures[:, 0, 0].mean():.2f}, {shape.mean():.2f}, {shape.max():.1f}",
            f"{jerk.mean():+.2f}, {ends.max():.2f} mm, {within.mean():.1%} of {within.size}",
        )


def measured(method: Method, lines: int) -> Iterator[tuple[float, float, float, bool]]:
    """Yield shape error, added jerk, end error and reachability of every hand-off, at its own and other lines."""
    for number, demo in enumerate(hand_offs()):
        elsewhere = method(demo)
        rng = np.random.default_rng([SEED, number])
        own = placed(resampled(demo.tip_mm), scaled=True)
        length_mm = float(np.linalg.norm(demo.tip_mm[-1] - demo.tip_mm[0]))
        for start_mm, goal_mm in [demo.tip_mm[[0, -1]], *(line(length_mm, rng) for _ in range(lines))]:
            there = elsewhere(start_mm, goal_mm)
            apart = dtw(placed(resampled(there.tip_mm), scaled=True), own).total_mm / len(own) * length_mm
            ends_mm = np.linalg.norm(there.tip_mm[[0, -1]] - [start_mm, goal_mm], axis=1).max()
            within = bool(reachable(there.tip_mm, POINTING_DOWN).all())
            yield apart, log_jerk(there) - log_jerk(demo), ends_mm, within


def line(length_mm: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw a start and a goal: the goal in `GOALS_MM`, the line as `SCALES`, `TURNS_RAD` and `TILTS_RAD` say.

    It is rotated from the diagonal of the paper's grid, along which the samples run.
    """
    goal_mm = rng.uniform(*np.transpose(GOALS_MM))
    turn, tilt = np.pi / 4 + rng.uniform(*TURNS_RAD), rng.uniform(*TILTS_RAD)
    way = np.array([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)])
    return goal_mm - length_mm * rng.uniform(*SCALES) * way, goal_mm


def hand_offs() -> list[Demo]:
    """Cut the hand-off of each sample surgeon, without tremor, at 100 Hz."""
    found = []
    for sample in sample_recordings():
        if len(sample.segments) == 1:
            ((start_s, end_s),) = sample.segments
            demo = cut_demo(read_recording(io.BytesIO(sample.data)), start_s=start_s, end_s=end_s)
            stamps_s, tip_mm = smoothed_tip(demo.stamps_s, demo.tip_mm, TREMOR_S)
            found.append(replace(demo, stamps_s=stamps_s, tip_mm=tip_mm, rotation_xyzw=None, jaw_rad=None, pauses=()))
    return found


def log_jerk(demo: Demo) -> float:
    """Return the logarithm of the dimensionless jerk (Hogan and Sternad, 2009), independent of size and speed."""
    step_s = demo.stamps_s[1]
    speed = np.gradient(demo.tip_mm, step_s, axis=0)
    jerk = np.gradient(np.gradient(speed, step_s, axis=0), step_s, axis=0)
    peak = np.linalg.norm(speed, axis=1).max()
    return float(np.log((jerk**2).sum() * step_s * demo.stamps_s[-1] ** 3 / peak**2))


# ---- methods -----------------------------------------------------------------------------------------------------


def ours(demo: Demo) -> Elsewhere:
    return lambda start_mm, goal_mm: moved(demo, start_mm, goal_mm)


def ours_fitted(demo: Demo) -> Elsewhere:
    """Discretise in a grid of 5 mm and drive through its cells as a plan does, at constant speed, to the goal."""

    def elsewhere(start_mm: np.ndarray, goal_mm: np.ndarray) -> Demo:
        there = moved(demo, start_mm, goal_mm)
        path = discretize(there.tip_mm, choose_grid(there.tip_mm, "fit"))
        fitted_mm = fit_to_demo(replay(path, path.start), trace(there, path)).tip_mm
        stamps_s = np.linspace(0.0, demo.stamps_s[-1], len(fitted_mm))
        return replace(there, stamps_s=stamps_s, tip_mm=fitted_mm - fitted_mm[-1] + goal_mm)

    return elsewhere


def dynamic(demo: Demo) -> Elsewhere:
    """Learn a primitive from the demonstration.

    Its spring is softened at the start, so that a far goal causes no jolt.
    """
    primitive = DMP(3, float(demo.stamps_s[-1]), float(demo.stamps_s[1]), WEIGHTS["dmp"], smooth_scaling=True)
    primitive.imitate(demo.stamps_s, demo.tip_mm)

    def elsewhere(start_mm: np.ndarray, goal_mm: np.ndarray) -> Demo:
        primitive.reset()
        primitive.configure(start_y=start_mm, goal_y=goal_mm)
        stamps_s, tip_mm = primitive.open_loop(step_function="rk4")
        return replace(demo, stamps_s=stamps_s, tip_mm=tip_mm)

    return elsewhere


def probabilistic(demo: Demo) -> Elsewhere:
    """Learn a primitive from demonstrations similar to this one, at places around it."""
    rng, share = np.random.default_rng(SEED), demo.stamps_s / demo.stamps_s[-1]
    waves = np.sin(np.pi * np.outer(share, [1, 2, 3]))
    ends = np.stack([1 - share, share], axis=1)
    varied = [waves @ rng.normal(0.0, DAY_MM, (3, 3)) + ends @ rng.normal(0.0, ENDS_MM, (2, 3)) for _ in range(SHOWN)]
    learnt = ProMP(3, WEIGHTS["promp"])
    learnt.imitate(np.tile(share, (SHOWN, 1)), demo.tip_mm + np.array(varied))

    def elsewhere(start_mm: np.ndarray, goal_mm: np.ndarray) -> Demo:
        conditioned = learnt.condition_position(start_mm, SURE_MM2 * np.eye(3), t=0.0)
        conditioned = conditioned.condition_position(goal_mm, SURE_MM2 * np.eye(3), t=1.0)
        return replace(demo, tip_mm=conditioned.mean_trajectory(share))

    return elsewhere


METHODS: dict[str, Method] = {
    "ours": ours,
    "ours, fitted to its cells of 5 mm": ours_fitted,
    "dynamic primitive": dynamic,
    "probabilistic primitive": probabilistic,
}
