"""The errors of a laboratory's own arm, estimated by comparing measured poses with setpoints.

    setpoints, measured poses --MeasuredArm--> errors per sample --calibrate_arm--> ArmCalibration, with ArmErrors

Samples of an arm follow one another closely, so an error hardly differs from the one before: many samples hold few
independent ones. With the autocorrelation rho the *effective number* of n samples is

    n / (1 + 2 (rho_1 + rho_2 + ...)),  summed up to the first negative rho.

Along each axis a *band* is stated that holds 90 % of future errors: mean and deviation of the samples, widened by
Student's quantile for the effective number, as the mean itself is uncertain by it. It is tested by *blocked
cross-validation*: the samples are cut into contiguous blocks, each block is left out in turn, and the band of the
others is compared with it. Neighbours of a sample are then left out with it, for the most part.

The measured poses come from the arm's encoders, which sit at its motors: they do not see that cables stretch or that
the arm bends. So this is the servo's error, a part of the tip's. With a tracker's positions of a marker on the tool the
tip's error is measured itself: marker and tracker are fitted by a rigid registration and the marker's place in the tool
frame, and the rest is the error. An error that a registration can explain is removed by it, so the rest is the least
that the error can be.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import exp, inf, log, sqrt
from typing import Any

import numpy as np

from skills.arrays import Floats, freeze
from skills.errors import BadInput
from skills.fields import Count, Fraction, schema
from skills.kinematics import check_rotation, quaternion_of
from skills.quaternions import vector_of
from skills.verification.arm_errors import CALIBRATED, MEAN_LENGTH, UNCALIBRATED, ArmErrors

BAND, _HALF_BAND = 0.9, 1.6449  # of a normal error, in deviations
BLOCKS = 6  # ours: with fewer the others are too few, with more a block is no longer than the errors last
LEAST_EFFECTIVE, LEAST_ALONG_AN_AXIS = 20.0, 4.0  # ours: with fewer a band's width is uncertain by more than a third
_STILL_MM = 1e-6  # round-off of kinematics
_FITS, _FITTED_MM = 10_000, 1e-9


@dataclass(frozen=True, eq=False)
class MeasuredArm:
    """Setpoints of an arm and its measured poses at N moments, in the frame of its base.

    Attributes:
        setpoint_mm: Commanded tips, mm, shape (N, 3).
        setpoint: Commanded rotations [n o a], shape (N, 3, 3).
        measured_mm: Tips as the encoders show them, mm, shape (N, 3).
        measured: Rotations as the encoders show them, shape (N, 3, 3).
        stamps_s: Times, ascending, shape (N,); None if they are not known.
        marker_mm: Positions of a marker on the tool in a tracker's frame, mm, shape (N, 3); None without a tracker.
    """

    setpoint_mm: Floats
    setpoint: Floats
    measured_mm: Floats
    measured: Floats
    stamps_s: Floats | None = None
    marker_mm: Floats | None = None

    def __post_init__(self) -> None:
        count = len(self.setpoint_mm)
        freeze(self, setpoint_mm=(count, 3), setpoint=(count, 3, 3), measured_mm=(count, 3), measured=(count, 3, 3))
        freeze(self, stamps_s=(count,), marker_mm=(count, 3))
        check_rotation(self.setpoint)
        check_rotation(self.measured)
        if self.stamps_s is not None and not (np.diff(self.stamps_s) > 0).all():
            raise BadInput("The times of a calibration must increase from sample to sample.")


@schema
@dataclass(frozen=True)
class AxisErrors:
    """The errors along or about one axis, and the band that holds 90 % of future ones.

    Attributes:
        axis: x, y or z of the arm's base frame.
        unit: mm or deg.
        mean: Their mean.
        deviation: Their standard deviation, for the effective number of samples.
        effective: The effective number of independent samples.
        band: Lower and upper end of the band.
        coverage: Part of the samples within the band of the other blocks, by blocked cross-validation.
        width: Mean width of these bands.
        assumed_coverage: Part of the samples within the band of a calibrated arm, `CALIBRATED`.
        assumed_width: Width of that band.
    """

    axis: str
    unit: str
    mean: float
    deviation: float
    effective: float
    band: tuple[float, float]
    coverage: Fraction
    width: float
    assumed_coverage: Fraction
    assumed_width: float


@schema
@dataclass(frozen=True)
class ArmCalibration:
    """The errors of a laboratory's arm as measured.

    Attributes:
        samples: Number of samples.
        effective: Effective number of independent ones, the three axes of the tip together, by the encoders.
        tip: Errors of the tip along the axes, by the encoders.
        wrist: Errors of the jaws' rotation about the axes, by the encoders.
        tracked: Errors of the tip along the axes, by the tracker, its own errors included; None without one.
        coverage: Mean coverage of the tip's bands, by the encoders.
        correlation_s: Correlation time of the encoders' error; None if the times are not known.
        errors: The errors to state. Sizes that were not measured are those of an uncalibrated arm.
    """

    samples: Count
    effective: float
    tip: tuple[AxisErrors, ...]
    wrist: tuple[AxisErrors, ...]
    tracked: tuple[AxisErrors, ...] | None
    coverage: Fraction
    correlation_s: float | None
    errors: ArmErrors

    def describe(self) -> str:
        """Return what was measured, and what was not, in sentences."""
        said = (
            f"{self.samples} samples count as {self.effective:.0f} independent ones, because errors last. "
            f"The bands of 90 % held {self.coverage:.1%} of the samples left out. "
            "This is the error of the encoders and not of the tip: they do not see that cables stretch. "
        )
        if self.tracked is None:
            return (
                f"{said}The tip's constant error is stated as an uncalibrated arm's; track the tip to state your own."
            )
        mean_mm = MEAN_LENGTH * self.errors.tip_bias_mm
        return (
            f"{said}The tracker shows the tip's: {mean_mm:.2f} mm on average, beyond what a registration removes. That "
            "is stated."
        )


def calibrate_arm(measured: MeasuredArm, *, name: str) -> ArmCalibration:
    """Estimate a laboratory's own errors from setpoints and measured poses of an arm.

    Args:
        measured: The poses.
        name: The name to state the errors by.

    Raises:
        BadInput: The samples hold too few independent ones.
        BadSettings: The name is not possible.
    """
    encoders_mm = encoder_errors_mm(measured)
    turns_deg = np.degrees(vector_of(quaternion_of(np.swapaxes(measured.setpoint, 1, 2) @ measured.measured)))
    assumed_mm = sqrt(CALIBRATED.tip_bias_mm**2 + CALIBRATED.tip_noise_mm**2)
    tip = _axes(encoders_mm, "mm", assumed_mm)
    tracked = None if measured.marker_mm is None else _axes(tracked_errors_mm(measured), "mm", assumed_mm)
    correlation_s = None if measured.stamps_s is None else _correlation_s(encoders_mm, measured.stamps_s)
    calibration = ArmCalibration(
        samples=len(encoders_mm),
        effective=sum(one.effective for one in tip),
        tip=tip,
        wrist=_axes(turns_deg, "deg", CALIBRATED.wrist_deg),
        tracked=tracked,
        coverage=float(np.mean([one.coverage for one in tip])),
        correlation_s=correlation_s,
        errors=UNCALIBRATED,
    )
    return replace(calibration, errors=_stated(calibration, encoders_mm, name))


def encoder_errors_mm(measured: MeasuredArm) -> Floats:
    """Return the errors of the tip in the base frame by the encoders: measured position minus setpoint.

    Args:
        measured: Setpoints and measured poses of N moments; at least four are needed for each block.

    Returns:
        Errors in mm, shape (N, 3).

    Raises:
        BadInput: The samples hold too few independent ones, or measured positions and setpoints differ by the same
            number throughout.
    """
    return _checked(np.asarray(measured.measured_mm - measured.setpoint_mm))


def tracked_errors_mm(measured: MeasuredArm) -> Floats:
    """Return the errors of the tip in the base frame by the tracker, beyond what a registration removes.

    They are where the tracker shows the tip, minus its setpoint. Registration and the marker's place in the tool frame
    are fitted in turn until they no longer change.

    Args:
        measured: Setpoints of N moments, and the marker's positions; at least four are needed for each block.

    Returns:
        Errors in mm, shape (N, 3).

    Raises:
        BadInput: There is no tracker, the samples hold too few independent ones, the marker's place does not settle, or
            the errors are the same throughout.
    """
    if measured.marker_mm is None:
        raise BadInput("The recording has no tracker.")
    tip, jaw, marker = measured.setpoint_mm, measured.setpoint, np.zeros(3)
    seen = measured.marker_mm - measured.marker_mm.mean(axis=0)
    for _ in range(_FITS):
        expected = tip + jaw @ marker
        centre = expected.mean(axis=0)
        u, _, vt = np.linalg.svd((expected - centre).T @ seen)
        turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt  # from the tracker's frame to the base's
        shown = seen @ turn.T + centre
        fitted = np.einsum("nji,nj->ni", jaw, shown - tip).mean(axis=0)
        done = np.abs(fitted - marker).max() < _FITTED_MM
        marker = fitted
        if done:
            break
    else:  # NaN comes here too
        raise BadInput("The marker's place in the tool frame cannot be found from these samples; turn the wrist more.")
    return _checked(np.asarray(shown - tip - jaw @ marker))


def _stated(found: ArmCalibration, encoders_mm: Floats, name: str) -> ArmErrors:
    """Return the errors to state: the measured ones, and those of an uncalibrated arm for the others."""
    counted = f"{found.samples} samples of this arm, {found.effective:.0f} of them independent"
    noise_mm = _size([_spread(encoders_mm[:, axis]) for axis in range(3)])
    changed: dict[str, Any] = {"tip_noise_mm": noise_mm}
    sources = {"tip_noise_mm": f"Encoders: deviation from the mean over {counted}."}
    if found.tracked is not None:
        changed["tip_bias_mm"] = _size([sqrt(one.mean**2 + one.deviation**2) for one in found.tracked])
        sources["tip_bias_mm"] = f"Tracker: the rest after registration over {counted}, taken as lasting over a pass."
    if found.correlation_s is not None:
        changed["tip_correlation_s"] = float(f"{found.correlation_s:.3g}")
        sources["tip_correlation_s"] = f"Encoders: autocorrelation over {counted}."
    left = {
        size: f"Not measured by this recording; of an uncalibrated arm: {said}"
        for size, said in UNCALIBRATED.sources.items()
        if size not in sources
    }
    return replace(UNCALIBRATED, name=name, sources=left | sources, **changed)


def _size(deviations: Sequence[float]) -> float:
    """Return one deviation for all axes, in three digits."""
    return float(f"{sqrt(sum(one**2 for one in deviations) / len(deviations)):.3g}")


def _checked(errors: Floats) -> Floats:
    """Return errors, shape (N, 3), unless they are no measurement of an arm, or hold too few independent samples."""
    if len(errors) and not (errors.std(axis=0) > _STILL_MM).all():
        raise BadInput(
            "Measured poses and setpoints differ by the same number throughout: the file has one of them twice, or is "
            "a simulator's. Record an arm."
        )
    effective = [effective_number(errors[:, axis]) for axis in range(3)] if len(errors) >= 4 * BLOCKS else [0.0]
    # negated, so that NaN fails
    if not (sum(effective) >= LEAST_EFFECTIVE and min(effective) >= LEAST_ALONG_AN_AXIS):
        raise BadInput(
            f"{len(errors)} samples hold {sum(effective):.0f} independent ones, {min(effective):.0f} along one axis; "
            f"at least {LEAST_EFFECTIVE:.0f} and {LEAST_ALONG_AN_AXIS:.0f} are needed. Record more and longer motions, "
            "to many places.",
            samples=len(errors),
            effective=sum(effective),
        )
    return errors


# ---- one axis ----------------------------------------------------------------------------------------------------


def _axes(errors: Floats, unit: str, assumed: float) -> tuple[AxisErrors, ...]:
    """Return the figures of errors along three axes, shape (N, 3), beside a normal error of the assumed deviation."""
    half = _HALF_BAND * assumed
    found = []
    for axis, values in zip("xyz", errors.T, strict=True):
        within, widths = _cross_validated(values)
        found.append(
            AxisErrors(
                axis=axis,
                unit=unit,
                mean=float(values.mean()),
                deviation=_spread(values),
                effective=effective_number(values),
                band=_band(values),
                coverage=within,
                width=widths,
                assumed_coverage=float(np.mean(np.abs(values) <= half)),
                assumed_width=2 * half,
            )
        )
    return tuple(found)


def _cross_validated(values: Floats) -> tuple[float, float]:
    """Return the part of the samples within the band of the other blocks, and the mean width of these bands."""
    within, widths = 0, []
    for block in np.array_split(np.arange(len(values)), BLOCKS):
        low, high = _band(np.delete(values, block))
        within += int(np.count_nonzero((values[block] >= low) & (values[block] <= high)))
        widths.append(high - low)
    return within / len(values), float(np.mean(widths))


def _band(values: Floats) -> tuple[float, float]:
    """Return the interval that holds a future error with the probability `BAND`."""
    from scipy.special import stdtrit  # here, because it is slow to import

    number = effective_number(values)
    half = float(stdtrit(number - 1, (1 + BAND) / 2)) * _spread(values) * sqrt(1 + 1 / number)
    return float(values.mean()) - half, float(values.mean()) + half


def _spread(values: Floats) -> float:
    """Return the standard deviation, for as many samples as are independent."""
    number = effective_number(values)
    return float(values.std()) * sqrt(number / (number - 1))


def effective_number(values: Floats) -> float:
    """Return the effective number of independent samples among errors along an axis.

    Args:
        values: The errors in the order of time, shape (N,), in any unit.

    Returns:
        The number, at least 2.
    """
    rho = _autocorrelation(_autocovariance(values))
    return max(2.0, len(values) / _lasting(rho))


def _autocovariance(values: Floats) -> Floats:
    """Return the sums of products of deviations from the mean at the distances 0, 1, ... N / 2."""
    off = values - values.mean()
    count = len(off)
    padded = np.fft.rfft(off, 2 * count)  # with as many zeros, so that the ends do not meet
    return np.asarray(np.fft.irfft(padded * padded.conj(), 2 * count)[: count // 2 + 1])


def _autocorrelation(covariance: Floats) -> Floats:
    """Return the autocorrelation; that of an error that never changes is 0 beyond the distance 0."""
    if covariance[0] > 0:
        return np.asarray(covariance / covariance[0])
    return np.asarray(np.arange(len(covariance)) == 0, np.float64)


def _lasting(rho: Floats) -> float:
    """Return the number of samples that count as one."""
    below = np.flatnonzero(rho < 0)
    return float(1 + 2 * rho[1 : below[0] if len(below) else len(rho)].sum())


def _correlation_s(errors: Floats, stamps_s: Floats) -> float:
    """Return the correlation time of a noise with exponential autocorrelation, of all axes together."""
    lasting = _lasting(_autocorrelation(np.sum([_autocovariance(axis) for axis in errors.T], axis=0)))
    step = float(np.median(np.diff(stamps_s)))
    keeps = (lasting - 1) / (lasting + 1)  # from 1 + 2 (r + r^2 + ...) = (1 + r) / (1 - r)
    return 0.0 if keeps <= exp(-700) else step / -log(keeps) if keeps < 1 else inf
