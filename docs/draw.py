"""Draw the pictures of docs/concepts.md from shipped samples: `python docs/draw.py [FOLDER]`, by default beside it.

Everything drawn is computed by the functions that the page explains, with stated seeds; nothing is drawn by hand.
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import skills
from skills.learning.pose_step import Hands, advance
from skills.learning.tube import certified_poses
from skills.planning.handoff import PsmM
from skills.report.figures import CELLS, GOAL, RECORDED, ROLLOUT
from skills.seeds.recordings import sample_recordings
from skills.verification.arm_errors import CALIBRATED, CALLED
from skills.verification.monte_carlo import estimate_success
from skills.verification.probabilities import EstimateSettings

SEED = 0
RUNS = 200
SCALES = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
APPROACH, BASE_MM, BASE_XYZW = (-0.94, 0.10, -0.33), (160.0, 20.0, 20.0), (0.0, 0.0, 0.382683, 0.92388)
TISSUE_MM = -165.0
GATE = 0.95  # of an export: the default of SKILLS_REPLAY_LOWER_BOUND


def demonstration(surgeon: str) -> skills.Demo:
    """Return the hand-off of a shipped sample."""
    sample = next(one for one in sample_recordings() if one.surgeon == surgeon and len(one.segments) == 1)
    start_s, end_s = sample.segments[0]
    return skills.cut_demo(skills.read_recording(BytesIO(sample.data)), start_s=start_s, end_s=end_s)


def figure(columns: int, title: str) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels side by side, and the panels."""
    made = Figure(figsize=(4.6 * columns, 4.2), layout="constrained")
    FigureCanvasAgg(made)
    made.suptitle(title, fontsize=11)
    return made, [made.add_subplot(1, columns, k + 1) for k in range(columns)]


def flat(positions_mm: Any) -> tuple[Any, Any]:
    """Return x and z of positions, shape (N, 3), in mm: seen from the side."""
    positions = np.asarray(positions_mm)
    return positions[:, 0], positions[:, 2]


def ruled(axes: Axes, title: str, upwards: str = "z") -> None:
    """Label the axes of a panel in mm, at one scale."""
    axes.set(xlabel="x (mm)", ylabel=f"{upwards} (mm)", aspect="equal")
    axes.set_title(title, fontsize=9)


def draw_phase() -> Figure:
    """Draw a path that crosses itself, and what is learnt of it without and with the phase."""
    demo = demonstration("wren")
    path = skills.discretize(demo.tip_mm, skills.PAPER_GRID)
    made, panels = figure(2, "A path that crosses itself: wren's sample in cells of 5 mm, seen from above")
    for axes, learner, name in (
        (panels[0], skills.CellQLearning(), "State: the cell, as in the paper"),
        (panels[1], skills.PhaseQLearning(), "State: the cell and the phase"),
    ):
        policy = skills.learn_policy(skills.sparse_reward(path), learner, seed=SEED)
        walk = skills.rollout(policy, demo.tip_mm[0])
        cells, centres = path.grid.centres_mm(path.states), path.grid.centres_mm(walk.states)
        axes.plot(demo.tip_mm[:, 0], demo.tip_mm[:, 1], color=RECORDED, lw=1, label="recorded")
        axes.plot(cells[:, 0], cells[:, 1], "s", color=CELLS, ms=9, mfc="none", label="cells of the path")
        axes.plot(centres[:, 0], centres[:, 1], color=ROLLOUT, lw=2, label="followed by the policy")
        axes.plot(*centres[-1, :2], "*", color=GOAL, ms=13, label="goal")
        ruled(axes, f"{name}: {len(walk.states)} of {len(path.states)} states", "y")
    panels[0].legend(fontsize=8, loc="lower left")
    return made


def draw_certificate() -> Figure:
    """Draw the share of the demonstration that a start follows, in the layer of the demonstrated start."""
    demo = demonstration("wren")
    path = skills.discretize(demo.tip_mm, skills.PAPER_GRID)
    grid = path.grid
    made, panels = figure(2, "The certificate: every start of wren's policy, in one layer of the grid")
    for axes, learner, name in (
        (panels[0], skills.PhaseQLearning(), "Joins at the nearest waypoint"),
        (panels[1], skills.PhaseQLearning(join_share=0.5), "Joins with half of the path left"),
    ):
        policy = skills.learn_policy(skills.sparse_reward(path), learner, seed=SEED)
        certificate, coverage = skills.certify(policy)
        assert coverage.share is not None, "a coverage that is computed has shares"
        states = np.arange(grid.n_states)
        centres = grid.centres_mm(states)
        layer = centres[:, 1] == grid.centres_mm(path.states[:1])[0, 1]
        x, z = flat(centres[layer])
        order = np.lexsort((x, z))  # row by row, from below
        across, upwards = np.unique(x), np.unique(z)
        shares = coverage.share[layer][order].reshape(len(upwards), len(across))
        shown = axes.pcolormesh(across, upwards, shares, cmap="viridis", vmin=0.0, vmax=1.0)
        axes.plot(*flat(grid.centres_mm(path.states)), color=ROLLOUT, lw=1.5)
        axes.plot(*flat(grid.centres_mm(path.states[:1])), "o", color=ROLLOUT, ms=8, label="demonstrated start")
        axes.plot(*flat(grid.centres_mm(path.states[-1:])), "*", color="white", mec="black", ms=13, label="goal")
        optimal = f"{certificate.checked - certificate.suboptimal} of {certificate.checked} actions optimal"
        reaching = f"{certificate.starts_reaching} of {certificate.starts} starts reach the goal"
        ruled(axes, f"{name}\n{optimal}\n{reaching}")
    panels[0].legend(fontsize=8, loc="upper right")
    made.colorbar(shown, ax=panels, label="share of the demonstration that a start follows")
    return made


def draw_tube() -> Figure:
    """Draw runs that start beside the path and are disturbed at each tick, and the radius that is proven."""
    poses = certified_poses([demonstration("kestrel")])
    assert poses is not None and poses.tube.holds, "the sample has orientations"
    path, tube, rng = poses.path, poses.tube, np.random.default_rng(SEED)
    hands = Hands(
        path.tip_mm[0] + tube.limits.start_mm * directions(rng) * rng.random((RUNS, 1)) ** (1 / 3),
        np.tile(path.rotation_xyzw[0], (RUNS, 1)),
        np.zeros(RUNS, np.int64),
    )
    reached, off = [hands.tip_mm], [np.linalg.norm(hands.tip_mm - path.tip_mm[0], axis=1)]
    for _ in range(tube.ticks):
        told = advance(path, hands, tube.limits)
        hands = replace(told, tip_mm=told.tip_mm + tube.limits.disturbance_mm * directions(rng) * rng.random((RUNS, 1)))
        reached.append(hands.tip_mm)
        off.append(np.linalg.norm(hands.tip_mm - path.tip_mm[hands.phases], axis=1))
    assert max(distance.max() for distance in off) <= tube.radius_mm, "the certificate is wrong"
    moved = f"each displaced by up to {tube.limits.disturbance_mm:g} mm at every tick"
    made, (seen, away) = figure(2, f"The tube of kestrel's hand: {RUNS} runs, {moved}")
    for run in range(RUNS):
        seen.plot(*flat(np.array(reached)[:, run]), color=CELLS, lw=0.3, alpha=0.4)
    seen.plot(*flat(path.tip_mm), color=ROLLOUT, lw=1.5, label="learnt motion")
    seen.legend(fontsize=8)
    ruled(seen, "seen from the side")
    away.plot(np.array(off), color=CELLS, lw=0.3, alpha=0.4)
    away.axhline(tube.radius_mm, color=ROLLOUT, label=f"proven: at most {tube.radius_mm:.1f} mm")
    away.axvline(tube.ticks, color=GOAL, ls="--", label=f"proven: at the end after {tube.ticks} ticks")
    away.set(
        xlabel="tick",
        ylabel="distance from the motion at its phase (mm)",
        ylim=(0.0, tube.radius_mm * 1.15),
    )
    away.legend(fontsize=8, loc="center")
    return made


def directions(rng: np.random.Generator) -> Any:
    """Return a random direction for each run, shape (RUNS, 3)."""
    drawn = rng.normal(size=(RUNS, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def draw_probability() -> Figure:
    """Draw how often a plan succeeds where arms are off: by the size of the errors, and without each of them."""
    demo = demonstration("kestrel")
    policy = skills.learn_policy(
        skills.sparse_reward(skills.discretize(demo.tip_mm, skills.PAPER_GRID)), skills.PhaseQLearning(), seed=SEED
    )
    points = [skills.SuturePoint((0.0, 55.0, -125.0)), skills.SuturePoint((6.0, 55.0, -125.0))]
    plan = skills.stack(policy, points, demo=demo, psm_m=PsmM(APPROACH, BASE_MM, BASE_XYZW, base_from="stated"))
    trajectory = skills.time_parametrise(plan.passes, psm_m=plan.psm_m)

    def judged(scale: float) -> Any:
        sizes = {size: scale * getattr(CALIBRATED, size) for size in CALLED}
        errors = replace(CALIBRATED, **sizes) if scale != 1.0 else CALIBRATED
        return estimate_success(
            trajectory,
            approach_m=APPROACH,
            pad_top_mm=TISSUE_MM,
            errors=errors,
            seed=SEED,
            settings=EstimateSettings(),
        )

    found = [judged(scale) for scale in SCALES]
    shares = np.array(
        [(one.under[0].plan.lower, one.under[0].plan.probability, one.under[0].plan.upper) for one in found]
    )
    made, (by_size, without) = figure(2, "A plan of two passes with hand-offs, kestrel's sample, in 1000 worlds each")
    by_size.errorbar(
        SCALES, shares[:, 1], [shares[:, 1] - shares[:, 0], shares[:, 2] - shares[:, 1]], color=CELLS, marker="o"
    )
    by_size.axhline(GATE, color=GOAL, ls="--", label="lower bound that an export needs of each pass")
    by_size.set(
        xlabel="errors of both arms, 1: a calibrated arm", ylabel="probability that the plan succeeds", ylim=(0, 1.02)
    )
    by_size.legend(fontsize=8)
    costs = found[SCALES.index(1.0)].costs
    names = [CALLED.get(cost.error, "the needle's angle") for cost in costs]
    without.barh(names[::-1], [cost.without.probability for cost in costs][::-1], color=CELLS)
    without.axvline(shares[SCALES.index(1.0), 1], color=ROLLOUT, label="with all errors")
    without.set(xlabel="probability without this error", xlim=(0, 1))
    without.legend(fontsize=8, loc="lower left")
    return made


PICTURES: dict[str, Callable[[], Figure]] = {
    "phase": draw_phase,
    "certificate": draw_certificate,
    "tube": draw_tube,
    "probability": draw_probability,
}


def main(folder: Path) -> None:
    """Draw every picture into a folder."""
    for name, draw in PICTURES.items():
        draw().savefig(folder / f"concept-{name}.png", dpi=100)
        print(folder / f"concept-{name}.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
