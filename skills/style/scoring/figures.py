"""What is told of a motion beside a reference: figures with their units, none of which depends on where it was done.

    Demo --measure--> Numbers;   Numbers, Numbers --compare--> Figures

All are of `skills.style.quality`, but for the size. `MODELLED` are those that a model of skill is a sum of
(`skills.style.scoring.model`): they are recorded by every laboratory, other than the clutch.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from skills.style._arrays import Floats
from skills.style.demo import Demo
from skills.style.quality import describe

Numbers = Mapping[str, float | None]


@dataclass(frozen=True)
class Kind:
    """A figure that there is: its name in reports, its unit and what it is called."""

    name: str
    unit: str
    label: str
    meaning: str


KINDS = (
    Kind("duration_s", "s", "Duration", "from the first sample to the last, pauses included"),
    Kind("path_length_mm", "mm", "Path length", "the tip's way from sample to sample, tremor included, pauses not"),
    Kind("size_mm", "mm", "Start to goal", "the distance in a straight line: the size of the hand-off"),
    Kind("spectral_arc_length", "", "Smoothness of speed", "spectral arc length: the nearer to 0 the smoother"),
    Kind("log_dimensionless_jerk", "", "Smoothness of path", "log dimensionless jerk: the nearer to 0 the smoother"),
    Kind("clutch_presses", "", "Clutch", "how often the pedal went down"),
    Kind("idle_share", "", "Idle", "share of the driven time slower than 1 mm/s and without a turn"),
    Kind("orientation_change_rad", "rad", "Orientation drift", "largest angle from the first orientation"),
)
MODELLED = (
    "duration_s",
    "path_length_mm",
    "spectral_arc_length",
    "log_dimensionless_jerk",
    "idle_share",
    "orientation_change_rad",
)
KIND_OF = {kind.name: kind for kind in KINDS}


@dataclass(frozen=True)
class Figure:
    """One figure of a motion beside the reference's; None where one of them was not recorded."""

    kind: Kind
    value: float | None
    reference: float | None

    @property
    def ratio(self) -> float | None:
        """How many times the reference's it is; None where that is 0 or one is missing."""
        return self.value / self.reference if self.value is not None and self.reference else None


def measure(demo: Demo) -> Numbers:
    """Measure a motion: the value of each of `KINDS`."""
    report = describe(demo)
    size_mm = float(np.linalg.norm(demo.tip_mm[-1] - demo.tip_mm[0]))
    return {kind.name: size_mm if kind.name == "size_mm" else getattr(report, kind.name) for kind in KINDS}


def compare(measured: Numbers, reference: Numbers) -> tuple[Figure, ...]:
    """Put the figures of a motion beside those of a reference."""
    return tuple(Figure(kind, measured[kind.name], reference[kind.name]) for kind in KINDS)


def modelled(measured: Numbers, names: tuple[str, ...] = MODELLED) -> Floats | None:
    """Take the figures that a model is a sum of, shape (F,); None where one of them was not recorded."""
    values = [measured[name] for name in names]
    return None if None in values else np.array(values, dtype=np.float64)
