"""Figures of a motion with their units, next to those of a reference; none depends on the place of the motion.

    Demo --measure--> Numbers;   Numbers, Numbers --compare--> ScoreFigures

All come from `skills.demonstration.quality`, except the size. They describe one hand-off of one arm; the figures of a
model of skill are those of a whole trial (`skills.scoring.trials`).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from skills.demonstration.demonstration import Demo
from skills.demonstration.quality import describe
from skills.fields import Figure, schema

Numbers = Mapping[str, float | None]


@dataclass(frozen=True)
class FigureKind:
    """A kind of figure: its name in reports, its unit, its label and its meaning."""

    name: str
    unit: str
    label: str
    meaning: str


KINDS = (
    FigureKind("duration_s", "s", "Duration", "from the first sample to the last, pauses included"),
    FigureKind(
        "path_length_mm", "mm", "Path length", "the tip's path from sample to sample, tremor included, pauses not"
    ),
    FigureKind("size_mm", "mm", "Start to goal", "the distance in a straight line: the size of the hand-off"),
    FigureKind("spectral_arc_length", "", "Smoothness of speed", "spectral arc length: closer to 0 is smoother"),
    FigureKind("log_dimensionless_jerk", "", "Smoothness of path", "log dimensionless jerk: closer to 0 is smoother"),
    FigureKind("clutch_presses", "", "Clutch", "number of presses of the pedal"),
    FigureKind("idle_share", "", "Idle", "share of the driven time slower than 1 mm/s and without a turn"),
    FigureKind("orientation_change_rad", "rad", "Orientation drift", "largest angle from the first orientation"),
)


@schema
@dataclass(frozen=True)
class ScoreFigure(FigureKind):
    """One figure of a motion with that of the reference; null if it was not recorded.

    Attributes:
        unit: Empty for a number without a unit.
        ratio: Value divided by the reference's; null if that is 0 or one is missing.
    """

    value: Figure
    reference: Figure
    ratio: Figure


def measure(demo: Demo) -> Numbers:
    """Return the value of each of `KINDS` for a motion.

    Args:
        demo: The motion.
    """
    report = describe(demo)
    size_mm = float(np.linalg.norm(demo.tip_mm[-1] - demo.tip_mm[0]))
    return {kind.name: size_mm if kind.name == "size_mm" else getattr(report, kind.name) for kind in KINDS}


def compare(measured: Numbers, reference: Numbers) -> tuple[ScoreFigure, ...]:
    """Combine the figures of a motion with those of a reference.

    Args:
        measured: The motion's, as `measure` returns them.
        reference: The reference's.
    """
    return tuple(_compare(kind, measured[kind.name], reference[kind.name]) for kind in KINDS)


def _compare(kind: FigureKind, value: float | None, reference: float | None) -> ScoreFigure:
    ratio = value / reference if value is not None and reference else None
    return ScoreFigure(**vars(kind), value=value, reference=reference, ratio=ratio)
