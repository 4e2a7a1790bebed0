"""What a trajectory spends its time on, and what its seams are: measured on the samples, not taken from the plan.

A seam is where one pass ends and the next begins. Time goes by there, and nothing may move.
"""

from dataclasses import dataclass

import numpy as np

from skills.style.kinematics import angle_between, instrument_of, matrix_of
from skills.style.moves import PHASES, TRANSFER
from skills.style.trajectory import Trajectory


@dataclass(frozen=True)
class Transfer:
    """How PSM_A comes to where A1 begins: its tip's way and the time, which is PSM_M's too."""

    length_mm: float
    duration_s: float


@dataclass(frozen=True)
class Seam:
    """What happens between the last sample of a pass and the first of the next.

    `joint_leap` is the greatest leap of a joint of either arm, as a part of what it may move in one tick.
    """

    after_pass: int
    pause_s: float
    leap_mm: float
    leap_deg: float
    joint_leap: float


def seconds_by_phase(trajectory: Trajectory) -> dict[str, float]:
    """Count the seconds of each phase over all passes, pauses left out."""
    return {
        name: float(np.count_nonzero(trajectory.phase == phase) / trajectory.rate_hz)
        for phase, name in enumerate(PHASES)
    }


def transfers(trajectory: Trajectory) -> list[Transfer | None]:
    """Measure the transfer of each pass; None where A1 begins at once."""
    steps = np.linalg.norm(np.diff(trajectory.tip_mm, axis=0), axis=1)
    found: list[Transfer | None] = []
    for number in range(trajectory.passes):
        # The step after a transfer's last sample leads to A1's first one.
        at = np.flatnonzero((trajectory.pass_index == number) & (trajectory.phase == TRANSFER))
        found.append(Transfer(float(steps[at].sum()), len(at) / trajectory.rate_hz) if len(at) else None)
    return found


def seams(trajectory: Trajectory) -> list[Seam]:
    """Measure every seam."""
    before = trajectory.last_samples[:-1]
    after = before + 1
    rotation = matrix_of(trajectory.rotation_xyzw)
    turned = np.degrees(angle_between(rotation[before], rotation[after]))
    moving = [(trajectory.joints, trajectory.instrument)]
    if trajectory.psm_m is not None:
        moving.append((trajectory.psm_m.joints, trajectory.psm_m.instrument))
    leaps = [np.abs(q[after] - q[before]) / instrument_of(tool).speed * trajectory.rate_hz for q, tool in moving]
    return [
        Seam(
            after_pass=number,
            pause_s=float(trajectory.stamps_s[after[number]] - trajectory.stamps_s[last]),
            leap_mm=float(np.linalg.norm(trajectory.tip_mm[after[number]] - trajectory.tip_mm[last])),
            leap_deg=float(turned[number]),
            joint_leap=max(float(leap[number].max()) for leap in leaps),
        )
        for number, last in enumerate(before.tolist())
    ]
