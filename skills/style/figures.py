"""What a playback and its trajectory say together, as arrays with a row a sample: what is gated and reported."""

from dataclasses import dataclass

import numpy as np

from skills.style._arrays import Floats
from skills.style.kinematics import Instrument, angle_between, instrument_of, joint_margins, matrix_of
from skills.style.needle import needle_to_pad_mm, psm_m_poses
from skills.style.playback import PSM_A, PSM_M, Playback
from skills.style.trajectory import Trajectory, joint_ratios
from skills.style.travel import Bounds


@dataclass(frozen=True, eq=False)
class ArmFigures:
    """One arm's joints, each of shape (T, 6): rad and mm, and as parts of their ranges and of their limits."""

    name: str
    tool: Instrument
    joints: Floats
    margins: Floats
    speed: Floats
    acceleration: Floats


@dataclass(frozen=True, eq=False)
class Figures:
    """All that is judged.

    Attributes:
        arms: PSM_A as it was measured, and PSM_M as it was told where it is in the scene.
        fk_mm: Simulator against closed form, PSM_A's tip, shape (T,).
        fk_deg: The same, its rotation.
        psm_m_fk_mm: The same, PSM_M's tip, shape (T,); 0 where it was not looked at or is not there.
        ticks: Time since the sample before, in samples, shape (T,); 1 at the first.
        effort: The largest of the motors' efforts, as a part of its limit, shape (T,).
        apart: How far the links of each pair are apart at least: as seen, or bounded.
        needle_mm: How far the needle is from the pad, shape (C,), where it was looked.
    """

    arms: tuple[ArmFigures, ...]
    fk_mm: Floats
    fk_deg: Floats
    psm_m_fk_mm: Floats
    ticks: Floats
    effort: Floats
    apart: Bounds
    needle_mm: Floats


def figures_of(playback: Playback, trajectory: Trajectory) -> Figures:
    """Work out all that is judged."""
    arms = [_arm(PSM_A, playback.joints, trajectory.instrument, trajectory.rate_hz)]
    m, looked_at, count = trajectory.psm_m, playback.looked_at, len(trajectory)
    psm_m_fk_mm = np.zeros(count)
    if m is not None and playback.psm_m_tip_mm is not None:
        arms.append(_arm(PSM_M, m.joints, m.instrument, trajectory.rate_hz))
        psm_m_fk_mm[looked_at] = np.linalg.norm(playback.psm_m_tip_mm - psm_m_poses(trajectory, looked_at)[0], axis=1)
    moving = {PSM_A: (trajectory.joints, trajectory.instrument)}
    if m is not None:
        moving[PSM_M] = (m.joints, m.instrument)
    return Figures(
        arms=tuple(arms),
        fk_mm=np.linalg.norm(playback.tip_mm - trajectory.tip_mm, axis=1),
        fk_deg=_rotation_error_deg(playback.rotation_xyzw, trajectory.rotation_xyzw),
        psm_m_fk_mm=psm_m_fk_mm,
        ticks=np.append(1.0, np.diff(trajectory.stamps_s) * trajectory.rate_hz),
        effort=(np.abs(playback.efforts) / np.array(instrument_of(trajectory.instrument).arm.effort)).max(axis=1),
        apart=Bounds.of(moving, playback.link_pairs, looked_at, playback.clearances_mm),
        needle_mm=needle_to_pad_mm(trajectory, looked_at, playback.pad_mm),
    )


def _arm(name: str, joints: Floats, instrument: str, rate_hz: float) -> ArmFigures:
    """Measure an arm's joints. It moves on between passes, so nothing leaps there either, whatever the stamps do."""
    tool = instrument_of(instrument)
    speed, acceleration = joint_ratios(joints, np.zeros(len(joints), np.int64), rate_hz, instrument)
    margins = joint_margins(joints, instrument) / (tool.upper - tool.lower)
    return ArmFigures(name, tool, joints, margins, speed, acceleration)


def _rotation_error_deg(measured: Floats, meant: Floats) -> Floats:
    """Measure the angle between quaternions, shape (T,); NaN where the measured one is none."""
    length = np.linalg.norm(measured, axis=1)
    sound = np.abs(length - 1.0) < 1e-6
    safe = np.where(sound[:, None], measured, meant)
    angle = np.degrees(angle_between(matrix_of(safe), matrix_of(meant)))
    return np.where(sound, angle, np.nan)
