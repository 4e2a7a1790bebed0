"""Errors of real arms: their sizes, each with its source.

    ArmErrors: CALIBRATED, UNCALIBRATED, or a laboratory's own (`skills.verification.arm_calibration`)

Five errors place the arms elsewhere than a plan says. All are normally distributed about zero, and their sizes are
standard deviations along or about each axis:

* Registration: PSM_M's base is offset, and turned about its remote centre. It is drawn once for a plan, because a base
  stays where it is from pass to pass.
* Wrist: each arm's jaws are turned about their hinge, the same over a pass. By how far the wrist's error displaces that
  hinge is a part of the tip's error, which is measured there.
* Tip bias: each arm as a whole is offset, the same over a pass.
* Tip noise: each arm as a whole is offset by a stationary noise (Ornstein-Uhlenbeck) that changes during a pass. Two
  moments correlate by exp(-seconds between them / correlation time).
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from math import isfinite, pi, sqrt
from types import MappingProxyType
from typing import Any

from skills.errors import BadSettings
from skills.fields import schema

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

    def describe(self) -> str:
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
