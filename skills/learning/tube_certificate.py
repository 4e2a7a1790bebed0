"""The assumptions and the result of the certificate of a tube, as values: `skills.learning.tube` computes it."""

from dataclasses import astuple, dataclass
from math import degrees

import numpy as np

from skills.errors import BadSettings
from skills.fields import computed_field, schema
from skills.gridworld.domain import check_join_share


@schema
@dataclass(frozen=True)
class TubeLimits:
    """The assumptions of a tube.

    Attributes:
        step_mm: Longest step of the position in a tick.
        step_rad: Largest turn in a tick.
        disturbance_mm: Largest distance between the commanded position and the one that is reached in a tick.
        disturbance_rad: Largest angle between the commanded orientation and the one that is reached.
        start_mm: Largest distance of a start from the path.
        start_rad: Largest angle of a start from the path's orientation there.
        ahead: Phases that one tick may advance.
        join_share: The joining rule: least share of the phases that is left where a start joins the path.
    """

    step_mm: float = 6.0  # with 101 phases of a hand-off of 60 mm a phase is 0.6 mm on average, 2 mm where it is fast
    step_rad: float = 0.2
    disturbance_mm: float = 1.0  # a calibrated dVRK arm is within 1 mm of its command
    disturbance_rad: float = 0.02
    start_mm: float = 20.0
    start_rad: float = 0.5
    ahead: int = 1
    join_share: float = 0.0

    def __post_init__(self) -> None:
        *numbers, ahead, join_share = astuple(self)
        check_join_share(join_share)
        if not (np.isfinite(numbers).all() and min(numbers) >= 0 and 1 <= ahead <= 100):
            raise BadSettings("The limits of a tube are finite and not negative, and it looks 1 to 100 phases ahead.")
        if not (self.disturbance_mm < self.step_mm and self.disturbance_rad < self.step_rad):
            raise BadSettings(
                "The disturbance of a tick must be smaller than its step, or the hand need never arrive; "
                "make the step longer.",
                step_mm=self.step_mm,
                disturbance_mm=self.disturbance_mm,
                step_rad=self.step_rad,
                disturbance_rad=self.disturbance_rad,
            )


@schema
@dataclass(frozen=True)
class TubeClearance:
    """How near the path of a tube comes to a scene; the tube is inside if its radius is not larger.

    Attributes:
        least_mm: Least distance of the path's positions, and of the straight lines between them, from a part of the
            scene with its margin; a lower bound for a height map, negative inside tissue or a capsule.
        part: That part: tissue, or box or capsule with its index, such as "box 0".
        phase: The phase after which it is nearest.
    """

    least_mm: float
    part: str
    phase: int


@schema
@dataclass(frozen=True)
class TubeCertificate:
    """The proof that a motion stays in a tube around a path and reaches its end, under the limits that it states.

    Attributes:
        limits: The assumptions.
        move_mm: The path's largest move within the window.
        move_rad: Its largest turn within the window.
        radius_mm: No position is further from the path.
        radius_rad: No orientation is further from the path's at the phase.
        ticks: After so many ticks every run has reached the end.
        checked: Updates that were checked.
        faults: Premises that do not hold; the certificate holds if there are none.
    """

    limits: TubeLimits
    move_mm: float
    move_rad: float
    radius_mm: float
    radius_rad: float
    ticks: int
    checked: int
    faults: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether every premise holds, and something was checked."""
        return not self.faults and self.checked > 0

    @computed_field  # type: ignore[prop-decorator]
    @property
    def radius_deg(self) -> float:
        """`radius_rad` in degrees."""
        return degrees(self.radius_rad)

    def contains(self, off_mm: float, off_rad: float) -> bool:
        """Return whether a pose that is so far from that of its phase lies in the tube; NaN does not."""
        return off_mm <= self.radius_mm and off_rad <= self.radius_rad
