"""What a playback must hold at every sample, and the first sample at which it does not.

A gate is one number a sample that must not be above, or not below, its limit. NaN passes none.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from skills.style._arrays import Floats
from skills.style.figures import ArmFigures, Figures
from skills.style.kinematics import CANNULA_MM, INSERTION, JOINTS, UNITS, Bools
from skills.style.moves import A2, PHASES, TRANSFER
from skills.style.playback import PAD, PSM_A, Playback
from skills.style.trajectory import Trajectory


@dataclass(frozen=True)
class JudgeSettings:
    """What is allowed. All of it is ours; the reasons are beside each.

    Attributes:
        fk_mm: Simulator against closed form, position; they agree to 1e-4 mm when the URDF is right.
        fk_deg: The same, rotation.
        joint_margin: Least distance of every joint from its limits, as a part of its range.
        insertion_mm: Least insertion: with less the wrist is inside the cannula.
        speed_ratio: Greatest joint speed as a part of its limit; a millionth is left for round-off.
        acceleration_ratio: Greatest joint acceleration as a part of its limit; the same.
        tracking_mm: Servo error on the way; the simulator's own is under 0.001 mm, and in contact it is millimetres.
        goal_mm: Servo error at the end of each pass.
        alignment_deg: Error of the jaw's rotation at the end of each pass.
        clearance_pad_mm: Least distance of either arm from the pad, as far as a calibrated arm is off (0.65 mm) and
            half as much again. Below 0 an arm may press into it, as far as `contact_n` allows.
        clearance_psm_m_mm: Least distance between the arms; their fingers may be nearer at the hand-off itself.
        contact_n: Greatest force between arm and pad: a light touch. The motors could press with twenty times as much.
        contact_effort: Greatest effort of any motor while in contact, as a part of its limit: one at its limit no
            longer holds the arm where it shall be.
    """

    fk_mm: float = 0.01
    fk_deg: float = 0.01
    joint_margin: float = 0.0
    insertion_mm: float = CANNULA_MM
    speed_ratio: float = 1.000001
    acceleration_ratio: float = 1.000001
    tracking_mm: float = 0.1
    goal_mm: float = 0.05
    alignment_deg: float = 0.1
    clearance_pad_mm: float = 1.0
    clearance_psm_m_mm: float = 0.5
    contact_n: float = 1.0
    contact_effort: float = 0.95


@dataclass(frozen=True)
class Failure:
    """The first sample that is not allowed; `quantity` names PSM_M, where it is its fault, and links too near."""

    sample: int
    pass_index: int
    phase: int
    stamp_s: float
    quantity: str
    value: float
    limit: float
    unit: str

    def __str__(self) -> str:
        """Say it in a sentence."""
        return (
            f"Pass {self.pass_index}, {PHASES[self.phase]}, sample {self.sample} ({self.stamp_s:.3f} s): "
            f"{self.quantity} is {self.value:.4g} {self.unit}, the limit is {self.limit:.4g}."
        )


@dataclass(frozen=True, eq=False)
class _Gate:
    """One quantity along the trajectory and what it must be: at most, or at least, the limit."""

    quantity: str
    unit: str
    values: Floats
    limit: float
    at_least: bool = False

    def broken(self) -> int | None:
        """Find the first sample that does not pass; NaN does not."""
        passes = self.values >= self.limit if self.at_least else self.values <= self.limit
        return None if passes.all() else int(np.argmin(passes))


def first_failure(
    figures: Figures, playback: Playback, trajectory: Trajectory, limits: JudgeSettings
) -> Failure | None:
    """Name the earliest sample at which a gate is broken; of several broken there, the first listed."""
    gates = _gates(figures, playback, trajectory, limits)
    broken = [(sample, gate) for gate in gates if (sample := gate.broken()) is not None]
    if not broken:
        return None
    sample, gate = min(broken, key=lambda one: one[0])
    return Failure(
        sample=sample,
        pass_index=int(trajectory.pass_index[sample]),
        phase=int(trajectory.phase[sample]),
        stamp_s=float(trajectory.stamps_s[sample]),
        quantity=gate.quantity,
        value=float(gate.values[sample]),
        limit=gate.limit,
        unit=gate.unit,
    )


def _gates(figures: Figures, playback: Playback, trajectory: Trajectory, limits: JudgeSettings) -> Iterator[_Gate]:
    yield _Gate("time since the sample before", "samples", figures.ticks, 1 - 1e-6, at_least=True)
    for arm in figures.arms:
        yield from _joint_gates(arm, limits)
    yield _Gate("tip off the closed form", "mm", figures.fk_mm, limits.fk_mm)
    yield _Gate("rotation off the closed form", "deg", figures.fk_deg, limits.fk_deg)
    yield _Gate("PSM_M's tip off the closed form", "mm", figures.psm_m_fk_mm, limits.fk_mm)
    shaft = np.zeros(len(trajectory))
    shaft[playback.looked_at] = playback.shaft_off_mm
    yield _Gate("shaft off the remote centre", "mm", shaft, limits.fk_mm)
    yield from _clearance_gates(figures, playback, trajectory, limits)
    touches = ~(playback.contact_n <= 0)
    yield _Gate("force between arm and pad", "N", playback.contact_n, limits.contact_n)
    yield _Gate("effort in contact", "of its limit", np.where(touches, figures.effort, 0.0), limits.contact_effort)
    yield _Gate("effort", "of its limit", figures.effort, 1.000001)  # the simulator's motors give no more
    yield _Gate("servo error", "mm", playback.tracking_mm, limits.tracking_mm)
    at_end = np.isin(np.arange(len(trajectory)), trajectory.last_samples)
    yield _Gate("servo error at the goal", "mm", np.where(at_end, playback.tracking_mm, 0.0), limits.goal_mm)
    yield _Gate("alignment error", "deg", np.where(at_end, figures.fk_deg, 0.0), limits.alignment_deg)


def _joint_gates(arm: ArmFigures, limits: JudgeSettings) -> Iterator[_Gate]:
    whose = "" if arm.name == PSM_A else f"{arm.name}'s "
    spare = limits.joint_margin * (arm.tool.upper - arm.tool.lower)
    for joint, name in enumerate(JOINTS):
        values = arm.joints[:, joint]
        yield _Gate(f"{whose}{name}", UNITS[joint], values, float(arm.tool.upper[joint] - spare[joint]) + 1e-9)
        yield _Gate(f"{whose}{name}", UNITS[joint], values, float(arm.tool.lower[joint] + spare[joint]) - 1e-9, True)
    yield _Gate(f"{whose}insertion out of the cannula", "mm", arm.joints[:, INSERTION], limits.insertion_mm, True)
    for joint, name in enumerate(JOINTS):
        yield _Gate(f"speed of {whose}{name}", "of its limit", arm.speed[:, joint], limits.speed_ratio)
        accelerations = arm.acceleration[:, joint]
        yield _Gate(f"acceleration of {whose}{name}", "of its limit", accelerations, limits.acceleration_ratio)


def _clearance_gates(
    figures: Figures, playback: Playback, trajectory: Trajectory, limits: JudgeSettings
) -> Iterator[_Gate]:
    # The pair that was seen nearest first, for the first listed is what is reported; NaN before all.
    nearest = np.nan_to_num(playback.clearances_mm, nan=-np.inf).min(axis=0)
    for column in np.argsort(nearest, kind="stable").tolist():
        pair, apart = playback.link_pairs[column], figures.apart.at_least_mm(column)
        limit = limits.clearance_pad_mm if pair.other == PAD else limits.clearance_psm_m_mm
        if pair.may_touch:
            excused = _handing_over(trajectory, apart, limit) & ~np.isnan(apart)
            apart = np.where(excused, np.inf, apart)
        yield _Gate(f"clearance of {pair}", "mm", apart, limit, at_least=True)


def _handing_over(trajectory: Trajectory, apart: Floats, limit: float) -> Bools:
    """Mark where a finger of PSM_M may touch one of PSM_A, shape (T,): at the hand-off, and while they part after it.

    The hand-off is the last sample of A2. In the transfer that follows they may be near each other until they have
    been `limit` apart for the first time.
    """
    may = np.zeros(len(trajectory), dtype=bool)
    for end in trajectory.last_samples[trajectory.phase[trajectory.last_samples] == A2]:
        parted = (trajectory.phase[end + 1 :] != TRANSFER) | ~(apart[end + 1 :] < limit)
        may[end : end + 1 + int(np.argmax(np.append(parted, True)))] = True
    return may
