"""Measure a demonstration, and advise the surgeon on what would make it a better teacher.

    Demo --describe--> DemoReport;   Demo, GridPath --describe_path--> PathReport

Speeds are of the smoothed tip (`skills.style.movement`), and only of the time in which the arm was driven. How smooth a
motion is says the log dimensionless jerk, after Hogan and Sternad (2009) and Balasubramanian et al. (2015):

    LDLJ = -ln( D^3 / v_peak^2 * integral of |jerk|^2 dt )

with D the driven time, v_peak the greatest speed and the jerk the third derivative of the position, a vector. It has no
unit and does not depend on how far or how fast the hand went; one minimum-jerk stroke has -5.3, every hesitation takes
something off. Half a smoothing window at the ends of each stretch is left out, where there is nothing to smooth with.
The spectral arc length (`skills.style.spectral`) says the same with less trust in the third derivative of a recording;
it is of the smoothed speed, in which the time of pauses is closed up. Thresholds are ours.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from skills.style import paper
from skills.style._arrays import Floats
from skills.style.demo import Demo
from skills.style.evaluation import discretisation_rmse
from skills.style.grid import PAPER_GRID, GridPath, discretize
from skills.style.movement import GRID_STEP_S, SMOOTHING_S, TURNING_RAD_S, Movement, movement_of
from skills.style.segments import arrival
from skills.style.spectral import spectral_arc_length

IDLE_MM_S = 1.0
SHORTEST_S = 0.1  # of a stretch between two pauses: a shorter one has no speed to speak of
IDLE_SHARE = 0.25
CALM_LDLJ = -12.0  # of our synthetic surgeons the even ones have -5 to -11, the hesitant one -15
CALMING_HYSTERESIS = 0.25  # cells
CALMED_SHARE = 0.8  # of the states: where hysteresis leaves no more, the path trembles across faces
# What moves the tip of a half-circle needle of 26 mm, held at a third, by 5 mm: one cell of the paper's grid.
NEGLIGIBLE_RAD = 0.35


@dataclass(frozen=True)
class DemoReport:
    """What kind of demonstration it is, in plain numbers, with advice in words.

    Attributes:
        duration_s: From the first sample to the last.
        samples: How many.
        rate_hz: Samples per second, from the median step between stamps.
        longest_gap_s: The longest time without a sample while the arm was driven.
        path_length_mm: The tip's way from sample to sample, tremor included, pauses not.
        extent_mm: Size of the box around the path along x, y, z.
        speed_median_mm_s: Median of the smoothed speed over the driven time.
        speed_peak_mm_s: Greatest smoothed speed.
        jerk_rms_mm_s3: Root mean square of the smoothed tip's jerk; None where it is too short.
        log_dimensionless_jerk: How smooth: the nearer to 0 the smoother; None where it is too short.
        spectral_arc_length: The same of the speed's spectrum; None where nothing moved.
        clutch_presses: How often the clutch pedal went down.
        clutched_s: How long it was down between the first sample and the last.
        undriven_s: How long the arm was not driven, by clutch or because teleoperation did not follow; left out.
        idle_share: Share of the driven time slower than 1 mm/s and without a turn, 0 to 1.
        a1_s: When the tip comes to rest at its goal, from the first sample: A1 ends.
        a1_orientation_change_rad: Largest angle from the first orientation until then; None where not recorded.
        a1_turn_negligible: Whether that is below 0.35 rad, as the paper found it; None where not recorded.
        orientation_change_rad: Largest angle from the first orientation in all; None where not recorded.
        advice: Sentences to the surgeon; empty where nothing stands out.
    """

    duration_s: float
    samples: int
    rate_hz: float
    longest_gap_s: float
    path_length_mm: float
    extent_mm: tuple[float, float, float]
    speed_median_mm_s: float
    speed_peak_mm_s: float
    jerk_rms_mm_s3: float | None
    log_dimensionless_jerk: float | None
    spectral_arc_length: float | None
    clutch_presses: int
    clutched_s: float
    undriven_s: float
    idle_share: float
    a1_s: float
    a1_orientation_change_rad: float | None
    a1_turn_negligible: bool | None
    orientation_change_rad: float | None
    advice: tuple[str, ...]


@dataclass(frozen=True)
class PathReport:
    """What its grid world makes of a demonstration.

    Attributes:
        path_states: How many states it visits.
        revisits: How many of them it had visited before: 0 where it never crosses itself.
        bridged_cells: How many no sample lies in.
        returns: How often it goes back into the cell that it has just left.
        discretisation_rmse_mm: What the grid loses along x, y and z.
        discretisation_rmse_3d_mm: The same as one length.
        outside_paper_grid_share: Share of the samples outside the paper's grid, 0 to 1.
        advised_hysteresis: Cells of hysteresis that would calm it; None where it is calm.
        advice: Sentences to the surgeon.
    """

    path_states: int
    revisits: int
    bridged_cells: int
    returns: int
    discretisation_rmse_mm: tuple[float, float, float]
    discretisation_rmse_3d_mm: float
    outside_paper_grid_share: float
    advised_hysteresis: float | None
    advice: tuple[str, ...]


def describe(demo: Demo) -> DemoReport:
    """Measure a demonstration, and advise on what would make it a better teacher."""
    pieces = pieces_of(demo)
    steps_s = np.concatenate([np.diff(demo.stamps_s[piece]) for piece in pieces])
    whole = slice(0, len(demo.stamps_s))
    long = [piece for piece in pieces if demo.stamps_s[piece.stop - 1] - demo.stamps_s[piece.start] >= SHORTEST_S]
    moved = [_movement(demo, piece) for piece in long or [whole]]
    speed = np.concatenate([one.speed_mm_s for one in moved])
    turning = np.concatenate([one.turning_rad_s for one in moved])
    driven_s = float(demo.stamps_s[-1]) - sum(pause.end_s - pause.start_s for pause in demo.pauses)
    jerk_rms, smoothness = _jerk(moved, driven_s, float(speed.max()))
    a1_s = arrival(_movement(demo, whole), 0.0, float(demo.stamps_s[-1]))
    a1_turn = _orientation_change(demo, a1_s)
    extent = np.ptp(demo.tip_mm, axis=0)
    numbers = DemoReport(
        duration_s=float(demo.stamps_s[-1]),
        samples=len(demo.stamps_s),
        rate_hz=float(1.0 / np.median(steps_s)) if len(steps_s) else 0.0,
        longest_gap_s=float(steps_s.max(initial=0.0)),
        path_length_mm=float(sum(np.linalg.norm(np.diff(demo.tip_mm[p], axis=0), axis=1).sum() for p in pieces)),
        extent_mm=(float(extent[0]), float(extent[1]), float(extent[2])),
        speed_median_mm_s=float(np.median(speed)),
        speed_peak_mm_s=float(speed.max()),
        jerk_rms_mm_s3=jerk_rms,
        log_dimensionless_jerk=smoothness,
        spectral_arc_length=_spectral(moved),
        clutch_presses=demo.clutch_presses,
        clutched_s=sum(pause.end_s - pause.start_s for pause in demo.pauses if pause.cause == "clutch"),
        undriven_s=sum(pause.end_s - pause.start_s for pause in demo.pauses),
        idle_share=float(((speed < IDLE_MM_S) & (turning < TURNING_RAD_S)).mean()),
        a1_s=a1_s,
        a1_orientation_change_rad=a1_turn,
        a1_turn_negligible=None if a1_turn is None else a1_turn < NEGLIGIBLE_RAD,
        orientation_change_rad=_orientation_change(demo, float(demo.stamps_s[-1])),
        advice=(),
    )
    return replace(numbers, advice=_advice(numbers, has_jaw=demo.jaw_rad is not None))


def describe_path(demo: Demo, path: GridPath) -> PathReport:
    """Measure what the grid makes of a demonstration, and what it loses."""
    lost_mm = discretisation_rmse(demo.tip_mm, path.grid, path.hysteresis)
    outside = float((~PAPER_GRID.holds(PAPER_GRID.cells_at(demo.tip_mm))).mean())
    returns = int((path.states[2:] == path.states[:-2]).sum())
    advised, advice = _calming(demo, path, returns, lost_mm)
    if outside > 0:
        advice += _about_the_papers_grid(outside, path)
    return PathReport(
        path_states=len(path.states),
        revisits=path.revisits,
        bridged_cells=path.bridged,
        returns=returns,
        discretisation_rmse_mm=lost_mm,
        discretisation_rmse_3d_mm=float(np.linalg.norm(lost_mm)),
        outside_paper_grid_share=outside,
        advised_hysteresis=advised,
        advice=advice,
    )


def pieces_of(demo: Demo) -> list[slice]:
    """Divide the samples of a demonstration at its pauses."""
    cuts = sorted({int(np.searchsorted(demo.stamps_s, pause.start_s)) for pause in demo.pauses})
    edges = [0, *(cut for cut in cuts if 0 < cut < len(demo.stamps_s)), len(demo.stamps_s)]
    return [slice(a, b) for a, b in pairwise(edges)]


def _movement(demo: Demo, piece: slice) -> Movement:
    rotation = None if demo.rotation_xyzw is None else demo.rotation_xyzw[piece]
    return movement_of(demo.stamps_s[piece], demo.tip_mm[piece], rotation)


def _jerk(moved: list[Movement], driven_s: float, peak_mm_s: float) -> tuple[float | None, float | None]:
    """Measure the jerk's root mean square in mm/s^3, and the log dimensionless jerk."""
    squared, counted_s = 0.0, 0.0
    for one in moved:
        step_s = float(one.seconds[-1] - one.seconds[0]) / (len(one.seconds) - 1)
        edge = round(SMOOTHING_S / 2 / GRID_STEP_S) + 3
        if len(one.seconds) <= 2 * edge or step_s > 2 * GRID_STEP_S:
            continue
        jerk = one.tip_mm
        for _ in range(3):
            jerk = np.gradient(jerk, step_s, axis=0)
        inner = jerk[edge:-edge]
        squared += float((inner**2).sum()) * step_s
        counted_s += len(inner) * step_s
    if counted_s == 0.0 or squared == 0.0 or peak_mm_s == 0.0:
        return None, None
    return float(np.sqrt(squared / counted_s)), float(-np.log(driven_s**3 / peak_mm_s**2 * squared))


def _spectral(moved: list[Movement]) -> float | None:
    """Measure the spectral arc length of stretches as if each followed the one before at once."""
    steps = sum(len(one.seconds) - 1 for one in moved)
    lasted_s = sum(float(one.seconds[-1] - one.seconds[0]) for one in moved)
    return spectral_arc_length(np.concatenate([one.speed_mm_s for one in moved]), lasted_s / steps)


def _orientation_change(demo: Demo, until_s: float) -> float | None:
    """Return the largest angle between the first orientation and any other; q and -q are the same orientation."""
    if demo.rotation_xyzw is None:
        return None
    rotation: Floats = demo.rotation_xyzw[demo.stamps_s <= until_s]
    unit = rotation / np.linalg.norm(rotation, axis=1, keepdims=True)
    cosine = np.abs(unit @ unit[0]).min()
    return float(2.0 * np.arccos(min(1.0, cosine)))


def _advice(report: DemoReport, *, has_jaw: bool) -> tuple[str, ...]:
    said = []
    if report.idle_share > IDLE_SHARE:
        said.append(f"The needle rests for {report.idle_share:.0%} of the time: cut the idle start and end away.")
    if report.clutch_presses > 0:
        times = times_in_words(report.clutch_presses)
        said.append(f"You clutched {times}: set up the masters so that the hand-off fits into one sweep.")
    if report.undriven_s > report.clutched_s:
        seconds = report.undriven_s - report.clutched_s
        said.append(f"Teleoperation did not follow for {seconds:.1f} s: engage the masters before the hand-off.")
    if report.longest_gap_s > max(0.1, 5.0 / max(report.rate_hz, 1e-9)):
        said.append(f"The recorder lost {report.longest_gap_s:.2f} s: the path is guessed there, so record again.")
    if report.rate_hz < 20.0:
        said.append(f"Only {report.rate_hz:.0f} poses per second: quick turns are lost; record at 100 or more.")
    if report.log_dimensionless_jerk is not None and report.log_dimensionless_jerk < CALM_LDLJ:
        said.append(
            f"The motion starts and stops often (smoothness {report.log_dimensionless_jerk:.1f}; one even stroke has "
            "-5.3): rehearse it once, then record it in one go."
        )
    if report.a1_orientation_change_rad is None:
        said.append("The wrist was not recorded: the path can be learnt, the turn of the needle cannot be checked.")
    elif not report.a1_turn_negligible:
        degrees = np.degrees(report.a1_orientation_change_rad)
        said.append(
            f"The needle turns by {degrees:.0f} degrees before the tip arrives, and a plan holds it still until then "
            "(20 degrees move its tip by one cell of 5 mm): bring it there first, then turn it."
        )
    if not has_jaw:
        said.append("The jaw was not recorded: grasp and release are not known.")
    return tuple(said)


def times_in_words(count: int) -> str:
    """Say how often."""
    return {0: "never", 1: "once", 2: "twice"}.get(count, f"{count} times")


def _calming(
    demo: Demo, path: GridPath, returns: int, lost_mm: tuple[float, float, float]
) -> tuple[float | None, tuple[str, ...]]:
    """Advise hysteresis where the path trembles across the faces of its cells."""
    if path.hysteresis >= CALMING_HYSTERESIS or returns == 0:
        return None, ()
    calm = discretize(demo.tip_mm, path.grid, CALMING_HYSTERESIS)
    if len(calm.states) > CALMED_SHARE * len(path.states):
        return None, ()
    calm_mm = discretisation_rmse(demo.tip_mm, path.grid, CALMING_HYSTERESIS)
    return CALMING_HYSTERESIS, (
        f"The path goes back into the cell it has just left {times_in_words(returns)}, as a "
        f"tremor does across a face. Ask for hysteresis {CALMING_HYSTERESIS}: {len(calm.states)} states instead of "
        f"{len(path.states)}, at {np.linalg.norm(calm_mm):.1f} instead of {np.linalg.norm(lost_mm):.1f} mm.",
    )


def _about_the_papers_grid(outside: float, path: GridPath) -> tuple[str, ...]:
    size = " x ".join(f"{count}" for count in path.grid.shape)
    share = "all" if outside == 1 else f"{outside:.0%}"
    return (
        f"{share.capitalize()} of the samples lie outside the paper's grid "
        f"({' x '.join(str(n) for n in paper.GRID_SHAPE)} cells of {paper.CELL_MM:g} mm), so a grid of {size} was "
        "fitted: it learns as well, but is not the paper's.",
    )
