"""How often an arm is in another cell of a grid than it was sent to: the slip of the grid world, measured.

    MeasuredArm, cell size --measure_slip--> MeasuredSlip

A policy commands centres of cells. Where the error of the tip is more than half a cell along an axis, the arm is in
another cell than it was sent to, at whatever centre. Slip is the grid world's: with this probability one of the 27
moves is made, each as likely, which may be the intended one (`skills.gridworld.slip`). So a share w of moves that end
elsewhere is a slip of 27/26 w. Errors last from sample to sample: the interval is that of as many samples as are
independent along the axis with the fewest.

The error is that of the encoders, because a policy reads from them in which cell it is. Where the tip is besides, as a
tracker shows it, moves with the arm and is no slip: it belongs into the margin of a scene.
"""

from dataclasses import dataclass
from math import isfinite

import numpy as np

from skills.arithmetic import wilson
from skills.arrays import Floats
from skills.errors import BadInput, BadSettings
from skills.fields import Count, Fraction, percent, schema
from skills.gridworld.slip import slip_of_elsewhere
from skills.verification.arm_calibration import MeasuredArm, effective_number, encoder_errors_mm, tracked_errors_mm

MOST_SLIP = 0.9  # ours: with more, the intended move is hardly more likely than another


@schema
@dataclass(frozen=True)
class MeasuredSlip:
    """The slip of an arm on a grid.

    Attributes:
        cell_mm: Size of a cell, mm.
        samples: Number of samples.
        effective: Effective number of independent ones.
        elsewhere: Part of the samples at which the tip is in another cell than it was sent to, by the encoders.
        slip: The probability of a slip that this is.
        interval: Its interval at 95 % (Wilson).
        tip_elsewhere: The same part by the tracker; None without one.
    """

    cell_mm: float
    samples: Count
    effective: float
    elsewhere: Fraction
    slip: Fraction
    interval: tuple[Fraction, Fraction]
    tip_elsewhere: Fraction | None

    def describe(self) -> str:
        """Return the slip, what to state, and what was not seen, in sentences."""
        low, high = self.interval
        tip = (
            "The tip was not tracked."
            if self.tip_elsewhere is None
            else f"By the tracker the tip was elsewhere at {self.tip_elsewhere:.1%}: that is for the scene's margin."
        )
        return (
            f"In cells of {self.cell_mm:g} mm the arm was in another cell than it was sent to at {self.elsewhere:.1%} "
            f"of {self.samples} samples ({self.effective:.0f} independent ones), by its encoders: a slip of "
            f"{self.slip:.3f} ({low:.3f} to {high:.3f}). State it, or to be careful the upper end: "
            f"`--setting slip={self.slip:.2g}` of "
            f"`skills train --scene`. {tip}"
        )


def measure_slip(measured: MeasuredArm, cell_mm: float) -> MeasuredSlip:
    """Measure how often an arm is in another cell of a grid than it was sent to.

    Args:
        measured: Setpoints and measured poses, of motions as in use.
        cell_mm: Size of a cell, mm.

    Raises:
        BadSettings: The size is not a positive number.
        BadInput: The samples hold too few independent ones, or so many are elsewhere that cells of this size cannot
            be commanded.
    """
    if not (isfinite(cell_mm) and cell_mm > 0):
        raise BadSettings("The size of a cell must be a number of mm above 0.", cell_mm=cell_mm)
    errors_mm = encoder_errors_mm(measured)
    elsewhere = _beyond(errors_mm, cell_mm)
    effective = min(effective_number(axis) for axis in errors_mm.T)
    low, high = (min(1.0, slip_of_elsewhere(end)) for end in wilson(elsewhere * effective, effective))
    slip = slip_of_elsewhere(elsewhere)
    if not slip <= MOST_SLIP:
        raise BadInput(
            f"In cells of {cell_mm:g} mm the arm was in another cell than it was sent to at "
            f"{percent(elsewhere)}% of the "
            "samples; such cells cannot be commanded. Measure larger ones.",
            cell_mm=cell_mm,
            elsewhere=elsewhere,
        )
    return MeasuredSlip(
        cell_mm=cell_mm,
        samples=len(errors_mm),
        effective=effective,
        elsewhere=elsewhere,
        slip=slip,
        interval=(low, high),
        tip_elsewhere=None if measured.marker_mm is None else _beyond(tracked_errors_mm(measured), cell_mm),
    )


def _beyond(errors_mm: Floats, cell_mm: float) -> float:
    """Return the part of errors, (N, 3), of more than half a cell along an axis; NaN counts as more."""
    return float((~(np.abs(errors_mm) <= cell_mm / 2).all(axis=1)).mean())
