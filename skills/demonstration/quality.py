"""Quality of a demonstration: its measures, and advice to the surgeon for a better one.

    Demo --describe--> MotionReport

Speeds are those of the smoothed tip (`skills.demonstration.movement`), and only of the time in which the arm was
driven. Smoothness is measured by the log dimensionless jerk, after Hogan and Sternad (2009) and Balasubramanian et al.
(2015):

    LDLJ = -ln( D^3 / v_peak^2 * integral of |jerk|^2 dt )

with D the driven time, v_peak the greatest speed, and jerk the third derivative of the position, a vector. It has no
unit and does not depend on the distance or the speed of the movement; one minimum-jerk stroke has -5.3, and every
hesitation lowers the value. Half a smoothing window at both ends of each stretch is left out, because the window has
too few samples there.

The spectral arc length (`skills.demonstration.movement`) measures the same without the third derivative of a recording.
It is computed from the smoothed speed, with the stretches between pauses joined without gaps. The thresholds are ours.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from skills.arrays import Floats
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import (
    GRID_STEP_S,
    SMOOTHING_S,
    TURNING_RAD_S,
    Movement,
    movement_of,
    spectral_arc_length,
)
from skills.demonstration.segments import arrival
from skills.fields import Count, Fraction, Point, percent, schema
from skills.quaternions import INVERSE, angle_of, multiplied, unit

IDLE_MM_S = 1.0
SHORTEST_S = 0.1  # of a stretch between two pauses: from a shorter one no meaningful speed can be computed
IDLE_SHARE = 0.25
CALM_LDLJ = -12.0  # our even synthetic surgeons have -5 to -11, the hesitant one -15
# This turn moves the tip of a half-circle needle of 26 mm, held at a third, by 5 mm: one cell of the paper's grid.
NEGLIGIBLE_RAD = 0.35


@schema
@dataclass(frozen=True, kw_only=True)
class MotionReport:
    """The measures of a demonstration's motion, and advice in words.

    Attributes:
        duration_s: Time from the first sample to the last.
        samples: Number of samples.
        rate_hz: Samples per second, from the median step between stamps.
        longest_gap_s: The longest time without a sample while the arm was driven.
        path_length_mm: Length of the tip's path from sample to sample, including tremor, without pauses.
        extent_mm: Size of the box around the path along x, y, z.
        speed_median_mm_s: Median of the smoothed speed over the driven time.
        speed_peak_mm_s: Greatest smoothed speed.
        jerk_rms_mm_s3: Root mean square of the smoothed tip's jerk; None if the motion is too short.
        log_dimensionless_jerk: Smoothness without unit, the nearer to 0 the smoother; None if the motion is too short.
        spectral_arc_length: Smoothness of the speed's spectrum, the nearer to 0 the smoother; None if nothing moved.
        clutch_presses: Number of presses of the clutch pedal.
        clutched_s: Time between the first sample and the last in which the pedal was down.
        undriven_s: Time in which the arm was not driven, because of the clutch or because teleoperation did not follow;
            it is excluded from the measures.
        idle_share: Share of the driven time slower than 1 mm/s and without a turn, 0 to 1.
        a1_s: End of A1, when the tip comes to rest at its goal, in seconds from the first sample.
        a1_orientation_change_rad: Largest angle from the first orientation until then; None if not recorded.
        a1_turn_negligible: Whether that angle is below 0.35 rad, as the paper found it; None if not recorded.
        orientation_change_rad: Largest angle from the first orientation in the demonstration; None if not recorded.
        advice: Sentences to the surgeon; empty if no measure is out of range.
    """

    duration_s: float
    samples: Count
    rate_hz: float
    longest_gap_s: float
    path_length_mm: float
    extent_mm: Point
    speed_median_mm_s: float
    speed_peak_mm_s: float
    jerk_rms_mm_s3: float | None
    log_dimensionless_jerk: float | None
    spectral_arc_length: float | None
    clutch_presses: Count
    clutched_s: float
    undriven_s: float
    idle_share: Fraction
    a1_s: float
    a1_orientation_change_rad: float | None
    a1_turn_negligible: bool | None
    orientation_change_rad: float | None
    advice: tuple[str, ...]


def describe(demo: Demo) -> MotionReport:
    """Measure a demonstration, and advise the surgeon on a better one.

    Args:
        demo: The demonstration.

    Returns:
        Its measures in mm, s and rad, and the advice in words.
    """
    pieces = pieces_of(demo)
    steps_s = np.concatenate([np.diff(demo.stamps_s[piece]) for piece in pieces])
    whole = slice(0, len(demo.stamps_s))
    long = [piece for piece in pieces if demo.stamps_s[piece.stop - 1] - demo.stamps_s[piece.start] >= SHORTEST_S]
    # If every stretch is too short, the motion is measured as one stretch.
    moved = [_movement(demo, piece) for piece in long or [whole]]
    speed = np.concatenate([one.speed_mm_s for one in moved])
    turning = np.concatenate([one.turning_rad_s for one in moved])
    driven_s = float(demo.stamps_s[-1]) - sum(pause.end_s - pause.start_s for pause in demo.pauses)
    jerk_rms, smoothness = _jerk(moved, driven_s, float(speed.max()))
    # The arrival is found in the motion without its divisions, because a pause may lie in A1.
    a1_s = arrival(_movement(demo, whole), 0.0, float(demo.stamps_s[-1]))
    a1_turn = _orientation_change(demo, a1_s)
    extent = np.ptp(demo.tip_mm, axis=0)
    numbers = MotionReport(
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


def pieces_of(demo: Demo) -> list[slice]:
    """Divide the samples of a demonstration at its pauses.

    Args:
        demo: The demonstration.

    Returns:
        Consecutive slices that together cover all samples.
    """
    cuts = sorted({int(np.searchsorted(demo.stamps_s, pause.start_s)) for pause in demo.pauses})
    edges = [0, *(cut for cut in cuts if 0 < cut < len(demo.stamps_s)), len(demo.stamps_s)]
    return [slice(a, b) for a, b in pairwise(edges)]


def _movement(demo: Demo, piece: slice) -> Movement:
    """Return the smoothed motion of some of the samples."""
    rotation = None if demo.rotation_xyzw is None else demo.rotation_xyzw[piece]
    return movement_of(demo.stamps_s[piece], demo.tip_mm[piece], rotation)


def _jerk(moved: list[Movement], driven_s: float, peak_mm_s: float) -> tuple[float | None, float | None]:
    """Return the root mean square of the jerk in mm/s^3, and the log dimensionless jerk."""
    squared, counted_s = 0.0, 0.0
    for one in moved:
        step_s = float(one.seconds[-1] - one.seconds[0]) / (len(one.seconds) - 1)
        edge = round(SMOOTHING_S / 2 / GRID_STEP_S) + 3  # three more, one for each difference quotient
        # Too short for the window, or longer than GRID_LIMIT samples and then too coarse for a third derivative.
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
    """Return the spectral arc length of stretches, as if each followed the previous one without a gap."""
    steps = sum(len(one.seconds) - 1 for one in moved)
    lasted_s = sum(float(one.seconds[-1] - one.seconds[0]) for one in moved)
    return spectral_arc_length(np.concatenate([one.speed_mm_s for one in moved]), lasted_s / steps)


def _orientation_change(demo: Demo, until_s: float) -> float | None:
    """Return the largest angle between the first orientation and any other; q and -q are the same orientation."""
    if demo.rotation_xyzw is None:
        return None
    rotation: Floats = demo.rotation_xyzw[demo.stamps_s <= until_s]
    turned = unit(rotation)
    return float(angle_of(multiplied(turned[0] * INVERSE, turned)).max())


def _advice(report: MotionReport, *, has_jaw: bool) -> tuple[str, ...]:
    """Return a sentence for each measure that is out of range."""
    said = []
    if report.idle_share > IDLE_SHARE:
        said.append(f"The needle rests for {percent(report.idle_share)}% of the time: cut away the idle start and end.")
    if report.clutch_presses > 0:
        times = describe_count(report.clutch_presses)
        said.append(f"You clutched {times}: set up the masters so that the hand-off fits into one sweep.")
    if (seconds := report.undriven_s - report.clutched_s) > 0:
        said.append(f"Teleoperation did not follow for {seconds:.1f} s: engage the masters before the hand-off.")
    if report.longest_gap_s > max(0.1, 5.0 / max(report.rate_hz, 1e-9)):
        said.append(f"The recorder lost {report.longest_gap_s:.2f} s: the path is interpolated there, so record again.")
    if report.rate_hz < 20.0:
        said.append(f"Only {report.rate_hz:.0f} poses per second: fast motion is lost; record at 100 or more.")
    if report.log_dimensionless_jerk is not None and report.log_dimensionless_jerk < CALM_LDLJ:
        said.append(
            f"The motion starts and stops often (smoothness {report.log_dimensionless_jerk:.1f}; one smooth "
            "stroke has -5.3): rehearse it once, then record it in one go."
        )
    if report.a1_orientation_change_rad is None:
        said.append("The wrist was not recorded: the path can be learnt, the turn of the needle cannot be checked.")
    elif not report.a1_turn_negligible:
        degrees = np.degrees(report.a1_orientation_change_rad)
        said.append(
            f"The needle turns by {degrees:.0f} degrees before the tip arrives (20 degrees move its tip by one cell of "
            "5 mm). A plan turns it as you did, unless it is to keep its orientation; the grid's policy knows no turn. "
            "If it is not your style, bring the needle there first, then turn it."
        )
    if not has_jaw:
        said.append("The jaw was not recorded: grasp and release are not known.")
    return tuple(said)


def describe_count(count: int) -> str:
    """Return a count in words.

    Args:
        count: A number of times, 0 or more.

    Returns:
        "never", "once", "twice", or the number with "times".
    """
    return {0: "never", 1: "once", 2: "twice"}.get(count, f"{count} times")
