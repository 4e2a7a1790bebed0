"""Errors of real arms: their sizes, each with its source, seeded draws of them, and the measured ones of a laboratory.

    ArmErrors: CALIBRATED, UNCALIBRATED, or a laboratory's own
    seed --draw--> Drawn: random numbers of size 1 --Drawn.under(ArmErrors)--> Displaced: in mm and rad

Five errors place the arms elsewhere than a plan says. All are normally distributed about zero, and their sizes are
standard deviations along or about each axis:

* Registration: PSM_M's base is offset, and turned about its remote centre. It is drawn once for a plan, because a base
  stays where it is from pass to pass.
* Wrist: each arm's jaws are turned about their hinge, the same over a pass. By how far the wrist's error displaces that
  hinge is a part of the tip's error, which is measured there.
* Tip bias: each arm as a whole is offset, the same over a pass.
* Tip noise: each arm as a whole is offset by a stationary noise (Ornstein-Uhlenbeck) that changes during a pass. Two
  moments correlate by exp(-seconds between them / correlation time).

Two more errors belong to the pass and not to the arms, and are drawn uniformly: the shift of the suture point along
each axis, and the needle's rotation in PSM_A's jaws, about any axis.

Each error has its own stream of random numbers, decided by the seed, the error and the pass. So if one error is set to
zero, all others are drawn as before, and the difference is the effect of that error.

A laboratory measures its own errors by comparing measured poses of an arm with its setpoints:

    setpoints, measured poses --Measured--> errors per sample --calibrate_arm--> ArmCalibration, with ArmErrors

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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from math import exp, inf, isfinite, log, pi, radians, sqrt
from types import MappingProxyType
from typing import Any

import numpy as np

from skills.arrays import Floats, freeze
from skills.errors import BadInput, BadSettings
from skills.fields import Count, Fraction, schema
from skills.kinematics import check_rotation, matrix_of, quaternion_of
from skills.quaternions import of_vector, vector_of

MEAN_LENGTH = sqrt(8 / pi)  # of a vector of three standard normal numbers
CALIBRATED_MM, UNCALIBRATED_MM = 0.65, 2.96  # mean tracking errors of a dVRK (Hwang et al., arXiv:2003.08520)
_MOST = 1000.0  # mm, degrees or s; a greater one has a mistaken unit
_NAME_LENGTH, _SOURCE_LENGTH = 60, 600


@schema
@dataclass(frozen=True)
class ArmErrors:
    """The errors of two arms, as standard deviations along or about each axis.

    Attributes:
        name: "calibrated", "uncalibrated", or a laboratory's name for its own arms.
        registration_mm: Offset of PSM_M's base from its stated place in PSM_A's base frame, mm.
        registration_deg: Rotation of that base about its remote centre, degrees.
        wrist_deg: Rotation of either arm's jaws about their hinge, degrees.
        tip_bias_mm: Offset of either arm that stays over a pass, mm; its mean length is 1.6 times as much.
        tip_noise_mm: Offset of either arm that varies during a pass, mm.
        tip_correlation_s: Correlation time of that noise, s; 0: every checked sample has its own.
        sources: For each of these six sizes its source, and the reason for its value.
    """

    name: str
    registration_mm: float
    registration_deg: float
    wrist_deg: float
    tip_bias_mm: float
    tip_noise_mm: float
    tip_correlation_s: float
    sources: Mapping[str, str]

    def __post_init__(self) -> None:
        if not (self.name.strip() and len(self.name) <= _NAME_LENGTH and self.name.isprintable()):
            raise BadSettings(f"Errors of an arm need a name of 1 to {_NAME_LENGTH} characters on one line.")
        for size in SIZES:
            value = getattr(self, size)
            if not (isfinite(value) and 0 <= value <= _MOST):
                raise BadSettings(f"{size} must be a number from 0 to {_MOST:g}.", given=value)
            if not 0 < len(self.sources.get(size, "").strip()) <= _SOURCE_LENGTH:
                raise BadSettings(f"{size} needs its source: give sources.{size} in 1 to {_SOURCE_LENGTH} characters.")
        if unknown := set(self.sources) - set(SIZES):
            raise BadSettings(f"sources has {sorted(unknown)[0]}, which is none of {', '.join(SIZES)}.")
        object.__setattr__(self, "sources", dict(self.sources))

    def without(self, size: str) -> "ArmErrors":
        """Return the same errors with one of `SIZES` set to zero."""
        changed: dict[str, Any] = {size: 0.0}
        return replace(self, **changed)

    @property
    def in_words(self) -> str:
        """Return the sizes as a phrase."""
        return (
            f"registration {self.registration_mm:g} mm and {self.registration_deg:g} degrees, wrist {self.wrist_deg:g} "
            f"degrees, tip {self.tip_bias_mm:g} mm constant and {self.tip_noise_mm:g} mm varying in "
            f"{self.tip_correlation_s:g} s"
        )


SIZES = tuple(field.name for field in fields(ArmErrors) if field.name not in ("name", "sources"))
# What a size is called in sentences. The correlation time is not an error by itself.
CALLED = MappingProxyType(
    {
        "registration_mm": "the offset of PSM_M's base",
        "registration_deg": "the rotation of PSM_M's base",
        "wrist_deg": "the wrists' error",
        "tip_bias_mm": "the tips' constant error",
        "tip_noise_mm": "the tips' varying error",
    }
)

_ENCODERS = (
    "Setpoints and encoders of a Classic PSM in a published recording (KinematicCalibDVRK, raw_sensor_rosbag_09_traj3) "
    "differ by 0.12 to 0.21 mm along an axis; that is the servo's part, without the cables'."
)
_STROKE = "Ours: the servo's error follows speed and friction, which change within a stroke of about half a second."
_TRACKING = (
    "Hwang et al., arXiv:2003.08520, measured a mean tracking error of {} mm of a dVRK {} calibration; a normal offset "
    "of this mean length deviates by 0.63 times as much along each axis."
)
CALIBRATED = ArmErrors(
    name="calibrated",
    registration_mm=0.7,
    registration_deg=0.25,
    wrist_deg=1.0,
    tip_bias_mm=round(CALIBRATED_MM / MEAN_LENGTH, 2),
    tip_noise_mm=0.2,
    tip_correlation_s=0.5,
    sources={
        "registration_mm": "The dVRK's documentation of the setup joints: once registered with an external sensor, "
        "arms are within a couple of millimetres. 2 mm is taken as the length that 95 % of the offsets keep.",
        "registration_deg": "Ours, no published value is known: 150 mm from the remote centre it moves the tip by 0.65 "
        "mm, about as much as the offset.",
        "wrist_deg": "Ours, no published value is known: a third of the uncalibrated one. The calibration cited for "
        "the tip reduces its error to less than a quarter.",
        "tip_bias_mm": _TRACKING.format(CALIBRATED_MM, "after"),
        "tip_noise_mm": _ENCODERS,
        "tip_correlation_s": _STROKE,
    },
)
UNCALIBRATED = ArmErrors(
    name="uncalibrated",
    registration_mm=14.4,
    registration_deg=3.0,
    wrist_deg=3.0,
    tip_bias_mm=round(UNCALIBRATED_MM / MEAN_LENGTH, 2),
    tip_noise_mm=0.2,
    tip_correlation_s=0.5,
    sources={
        "registration_mm": "The dVRK's documentation of the setup joints: their potentiometers place an instrument "
        "within a cube of 50 mm. Evenly distributed over it, it deviates by 14.4 mm along each axis.",
        "registration_deg": "Ours, no published value is known: the same potentiometers measure the base's rotation, "
        "through six joints.",
        "wrist_deg": "Ours, no published value is known: the wrist's cables stretch, and its encoders sit at the "
        "motors. 3 degrees move the finger tips by half a millimetre.",
        "tip_bias_mm": _TRACKING.format(UNCALIBRATED_MM, "before"),
        "tip_noise_mm": _ENCODERS,
        "tip_correlation_s": _STROKE,
    },
)
NAMED = MappingProxyType({one.name: one for one in (CALIBRATED, UNCALIBRATED)})


def checked_own(own: ArmErrors) -> ArmErrors:
    """Return a laboratory's own errors.

    Args:
        own: The errors.

    Returns:
        The same errors.

    Raises:
        BadSettings: They have the name of a default, and differ from it.
    """
    if own.name in NAMED and own != NAMED[own.name]:
        raise BadSettings(f"Errors named {own.name} are those of this version; give your own another name.")
    return own


# ---- draws -------------------------------------------------------------------------------------------------------

_STREAMS = ("registration", "registration_turn", "wrist", "tip_bias", "tip_noise", "suture_point", "needle")


@dataclass(frozen=True, eq=False)
class Drawn:
    """Random errors for N variations of a pass that is checked in S samples; arms are PSM_A and PSM_M.

    Attributes:
        registration: Offset of PSM_M's base, of size 1, shape (N, 3).
        registration_turn: Rotation vector of that base, of size 1, shape (N, 3).
        wrist: Rotation vector of each arm's jaws, of size 1, shape (2, N, 3).
        tip_bias: Constant offset of each arm, of size 1, shape (2, N, 3).
        tip_noise: Independent numbers of size 1 of which each arm's noise is made, shape (2, N, S, 3).
        shift_mm: Shift of the pass from its planned place, shape (N, 3).
        turned: Rotation of the needle about PSM_A's grip, shape (N, 3, 3).
    """

    registration: Floats
    registration_turn: Floats
    wrist: Floats
    tip_bias: Floats
    tip_noise: Floats
    shift_mm: Floats
    turned: Floats

    def under(self, errors: ArmErrors, stamps_s: Floats) -> "Displaced":
        """Return the displacements of both arms.

        Args:
            errors: The sizes of the errors.
            stamps_s: Times of the checked samples, ascending, shape (S,).
        """
        base = radians(errors.registration_deg) * self.registration_turn
        jaws = radians(errors.wrist_deg) * self.wrist
        noise = errors.tip_noise_mm * _correlated(self.tip_noise, stamps_s, errors.tip_correlation_s)
        return Displaced(
            base_mm=errors.registration_mm * self.registration,
            base_turn=rotation_of(base),
            base_rad=np.linalg.norm(base, axis=1),
            jaw_turn=rotation_of(jaws.reshape(-1, 3)).reshape(2, -1, 3, 3),
            jaw_rad=np.linalg.norm(jaws, axis=2),
            tip_mm=errors.tip_bias_mm * self.tip_bias[:, :, None] + noise,
        )


@dataclass(frozen=True, eq=False)
class Displaced:
    """The displacements of both arms in N variations of a pass, in S samples.

    Attributes:
        base_mm: Offset of PSM_M's base in PSM_A's base frame, shape (N, 3).
        base_turn: Rotation of that base about its remote centre, in the same frame, shape (N, 3, 3).
        base_rad: The angle of this rotation, shape (N,).
        jaw_turn: Rotation of each arm's jaws about their hinge, in the same frame, shape (2, N, 3, 3).
        jaw_rad: The angles of these rotations, shape (2, N).
        tip_mm: Offset of each arm as a whole in PSM_A's base frame, shape (2, N, S, 3).
    """

    base_mm: Floats
    base_turn: Floats
    base_rad: Floats
    jaw_turn: Floats
    jaw_rad: Floats
    tip_mm: Floats

    def at(self, chunk: slice) -> "Displaced":
        """Return a slice of the variations."""
        return Displaced(
            self.base_mm[chunk],
            self.base_turn[chunk],
            self.base_rad[chunk],
            self.jaw_turn[:, chunk],
            self.jaw_rad[:, chunk],
            self.tip_mm[:, chunk],
        )


def draw(seed: int, number: int, variations: int, samples: int, *, suture_point_mm: float, needle_rad: float) -> Drawn:
    """Draw the variations of a pass; the same arguments give the same bytes.

    Args:
        seed: Seed of the random numbers, 0 or more.
        number: Number of the pass, which gives each pass its own random numbers; all passes have the same registration.
        variations: Number of variations, N.
        samples: Number of checked samples of the pass, S.
        suture_point_mm: Greatest shift of the pass along each axis.
        needle_rad: Greatest rotation of the needle.
    """
    one_base = _stream(seed, "registration", 0), _stream(seed, "registration_turn", 0)
    needle = _stream(seed, "needle", number)
    axis = needle.standard_normal((variations, 3))
    angle = needle.uniform(-needle_rad, needle_rad, (variations, 1))
    return Drawn(
        registration=one_base[0].standard_normal((variations, 3)),
        registration_turn=one_base[1].standard_normal((variations, 3)),
        wrist=_stream(seed, "wrist", number).standard_normal((2, variations, 3)),
        tip_bias=_stream(seed, "tip_bias", number).standard_normal((2, variations, 3)),
        tip_noise=_stream(seed, "tip_noise", number).standard_normal((2, variations, samples, 3)),
        shift_mm=_stream(seed, "suture_point", number).uniform(-suture_point_mm, suture_point_mm, (variations, 3)),
        turned=rotation_of(angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)),
    )


def _stream(seed: int, error: str, number: int) -> np.random.Generator:
    key = (_STREAMS.index(error), number)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


def rotation_of(vectors: Floats) -> Floats:
    """Return the rotations about axes, by their lengths in rad.

    Args:
        vectors: Rotation vectors, shape (N, 3).

    Returns:
        Rotation matrices, shape (N, 3, 3).
    """
    return matrix_of(of_vector(vectors))


def _correlated(normal: Floats, stamps_s: Floats, correlation_s: float) -> Floats:
    """Return noise of size 1 with this correlation time, made of independent numbers, both of shape (2, N, S, 3)."""
    if correlation_s == 0:
        return normal
    made = normal.copy()
    keeps = np.exp(-np.diff(stamps_s) / correlation_s)
    for k, kept in enumerate(keeps.tolist(), start=1):
        made[:, :, k] = kept * made[:, :, k - 1] + sqrt(max(0.0, 1 - kept * kept)) * normal[:, :, k]
    return made


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

    @property
    def in_words(self) -> str:
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


def calibrate_arm(measured: MeasuredArm, *, name: str, blocks: int = BLOCKS) -> ArmCalibration:
    """Estimate a laboratory's own errors from setpoints and measured poses of an arm.

    Args:
        measured: The poses.
        name: The name to state the errors by.
        blocks: Number of contiguous blocks of the cross-validation, at least 2.

    Raises:
        BadInput: The samples hold too few independent ones.
        BadSettings: The name is not possible.
    """
    encoders_mm = encoder_errors_mm(measured, blocks)
    turns_deg = np.degrees(vector_of(quaternion_of(np.swapaxes(measured.setpoint, 1, 2) @ measured.measured)))
    assumed_mm = sqrt(CALIBRATED.tip_bias_mm**2 + CALIBRATED.tip_noise_mm**2)
    tip = _axes(encoders_mm, "mm", blocks, assumed_mm)
    tracked = None
    if measured.marker_mm is not None:
        tracked = _axes(tracked_errors_mm(measured, blocks), "mm", blocks, assumed_mm)
    correlation_s = None if measured.stamps_s is None else _correlation_s(encoders_mm, measured.stamps_s)
    calibration = ArmCalibration(
        samples=len(encoders_mm),
        effective=sum(one.effective for one in tip),
        tip=tip,
        wrist=_axes(turns_deg, "deg", blocks, CALIBRATED.wrist_deg),
        tracked=tracked,
        coverage=float(np.mean([one.coverage for one in tip])),
        correlation_s=correlation_s,
        errors=UNCALIBRATED,
    )
    return replace(calibration, errors=_stated(calibration, encoders_mm, name))


def encoder_errors_mm(measured: MeasuredArm, blocks: int = BLOCKS) -> Floats:
    """Return the errors of the tip in the base frame by the encoders: measured position minus setpoint.

    Args:
        measured: Setpoints and measured poses of N moments.
        blocks: Number of blocks of the cross-validation; at least four samples are needed for each.

    Returns:
        Errors in mm, shape (N, 3).

    Raises:
        BadInput: The samples hold too few independent ones, or measured positions and setpoints differ by the same
            number throughout.
    """
    errors_mm = np.asarray(measured.measured_mm - measured.setpoint_mm)
    _check_number(errors_mm, blocks)
    return errors_mm


def tracked_errors_mm(measured: MeasuredArm, blocks: int = BLOCKS) -> Floats:
    """Return the errors of the tip in the base frame by the tracker, beyond what a registration removes.

    Args:
        measured: Setpoints of N moments, and the marker's positions.
        blocks: Number of blocks of the cross-validation; at least four samples are needed for each.

    Returns:
        Errors in mm, shape (N, 3).

    Raises:
        BadInput: There is no tracker, the samples hold too few independent ones, or the errors are the same throughout.
    """
    if measured.marker_mm is None:
        raise BadInput("The recording has no tracker.")
    errors_mm = _tracked_mm(measured, measured.marker_mm)
    _check_number(errors_mm, blocks)
    return errors_mm


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


def _check_number(errors: Floats, blocks: int) -> None:
    """Refuse errors, shape (N, 3), that are no measurement of an arm, or hold too few independent samples."""
    if len(errors) and not (errors.std(axis=0) > _STILL_MM).all():
        raise BadInput(
            "Measured poses and setpoints differ by the same number throughout: the file has one of them twice, or is "
            "a simulator's. Record an arm."
        )
    effective = [effective_number(errors[:, axis]) for axis in range(3)] if len(errors) >= 4 * blocks else [0.0]
    # negated, so that NaN fails
    if not (sum(effective) >= LEAST_EFFECTIVE and min(effective) >= LEAST_ALONG_AN_AXIS):
        raise BadInput(
            f"{len(errors)} samples hold {sum(effective):.0f} independent ones, {min(effective):.0f} along one axis; "
            f"at least {LEAST_EFFECTIVE:.0f} and {LEAST_ALONG_AN_AXIS:.0f} are needed. Record more and longer motions, "
            "to many places.",
            samples=len(errors),
            effective=sum(effective),
        )


# ---- one axis ----------------------------------------------------------------------------------------------------


def _axes(errors: Floats, unit: str, blocks: int, assumed: float) -> tuple[AxisErrors, ...]:
    """Return the figures of errors along three axes, shape (N, 3), beside a normal error of the assumed deviation."""
    half = _HALF_BAND * assumed
    found = []
    for axis, values in zip("xyz", errors.T, strict=True):
        within, widths = _cross_validated(values, blocks)
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


def _cross_validated(values: Floats, blocks: int) -> tuple[float, float]:
    """Return the part of the samples within the band of the other blocks, and the mean width of these bands."""
    within, widths = 0, []
    for block in np.array_split(np.arange(len(values)), blocks):
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


# ---- rotations and the tracker ---------------------------------------------------------------------------------------


def _tracked_mm(measured: MeasuredArm, marker_mm: Floats) -> Floats:
    """Return the tip's error in the base frame, shape (N, 3): where the tracker shows it, minus its setpoint.

    Registration and the marker's place in the tool frame are fitted in turn until they no longer change.
    """
    tip, jaw, marker = measured.setpoint_mm, measured.setpoint, np.zeros(3)
    seen = marker_mm - marker_mm.mean(axis=0)
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
    return np.asarray(shown - tip - jaw @ marker)
