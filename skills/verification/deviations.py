"""The kinds of deviation of a motion from what was requested, their limits, and the greatest of each; all are ours.

`skills.verification.intent` finds them. A deviation passes where it does not exceed its limit, so NaN never passes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Floats, Ints
from skills.fields import Count, Figure, schema

# Every kind of deviation with its unit and its limit, all ours. Poses that are stated exactly have the limits of a
# servo error at the goal, quaternions that of three digits, an approach the angle at which jaws still hold a needle
# straight. Along a recording the limits begin beyond the spread of the hand and what hysteresis leaves outside of a
# cell: they are for bends, which a path rounds off over half a cell, and for the 240 moments that are compared. They
# were set with random plans at hand: 120 needed 0.27 and 0.06 cells, 0.01 s, and nothing of rotation and opening; one
# of 160 others 0.39 cells along the recording.
LIMITS: Mapping[str, tuple[str, float]] = MappingProxyType(
    {
        "number of passes off the suture points": ("passes", 0.5),
        "length of a stated quaternion off 1": ("", 1e-3),
        "PSM_M's approach off the demonstrated hand-off": ("deg", 15.0),
        "PSM_M's base off the stated one": ("mm", 0.05),
        "PSM_M's base turned from the stated one": ("deg", 0.05),
        "start of the pass off the asked one": ("mm", 0.05),
        "start of A1 off the asked one": ("mm", 0.05),
        "end of A1 off the suture point": ("mm", 0.05),
        "path off the policy's cells": ("cells", 0.35),
        "path off the recording": ("cells", 0.45),
        "clock of A1 off the recording's": ("s", 0.02),
        "speed of the tip": ("of the asked", 1.02),
        "standing still": ("of the allowed time", 1.0),
        "jaw turned off the recording": ("deg", 0.4),
        "jaw off its stated rotation": ("deg", 0.1),
        "opening of the jaw off the recording": ("rad", 0.006),
        "a jaw beyond its limits": ("rad", 1e-9),
        "speed of a jaw": ("of its limit", 1.000001),
        "a jaw moves with an arm": ("rad", 1e-6),
        "PSM_A's jaw opens before PSM_M's holds": ("rad", 1e-6),
        "PSM_M's jaw not open as it comes in": ("rad", 1e-6),
        "PSM_M's jaw opens before PSM_A's holds": ("rad", 1e-6),
        "needle has not changed hands": ("rad", 1e-6),
        "tip leaves the hand-off": ("mm", 0.05),
        "A2 leaves the shorter way": ("deg", 0.1),
        "A2 off the recorded hand-off": ("deg", 0.1),
        "A2's hinge off PSM_M's approach": ("deg", 0.1),
        "A2 off the paper's hand-off": ("deg", 0.1),
        "PSM_M off where it takes the needle": ("mm", 0.05),
        "PSM_M turned from how it takes the needle": ("deg", 0.1),
        "PSM_M off where it waits": ("mm", 0.05),
        "PSM_M off its straight way": ("mm", 0.05),
        "PSM_A off the straight transfer": ("mm", 0.05),
        "transfer leaves the shorter way": ("deg", 0.1),
        "PSM_A leaves before PSM_M": ("mm", 0.05),
    }
)


@schema
@dataclass(frozen=True)
class Mismatch:
    """The greatest deviation of one kind: its first sample, its value and its limit."""

    kind: str
    sample: Count
    value: Figure
    limit: float
    unit: str


@dataclass(frozen=True, eq=False)
class Deviations:
    """The deviations of a motion from what was requested: for each kind in `LIMITS` a number per sample, shape (T,)."""

    values: Mapping[str, Floats]

    @classmethod
    def none(cls, samples: int) -> "Deviations":
        """Return no deviations, of a motion of so many samples, to which `add` adds."""
        return cls({kind: np.zeros(samples) for kind in LIMITS})

    def add(self, kind: str, rows: Ints, values: ArrayLike) -> None:
        """Add the deviations of one kind at some samples; the greater of two remains, and NaN does."""
        self.values[kind][rows] = np.maximum(self.values[kind][rows], values)

    @property
    def greatest(self) -> tuple[Mismatch, ...]:
        """The greatest deviation of each kind, NaN counting as the greatest."""
        found = []
        for kind, values in self.values.items():
            unit, limit = LIMITS[kind]
            sample = int(np.argmax(np.where(np.isnan(values), np.inf, values)))
            found.append(Mismatch(kind, sample, float(values[sample]), limit, unit))
        return tuple(found)
