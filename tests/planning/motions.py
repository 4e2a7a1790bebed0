"""Small plans for the tests of motion: a hand-off in the paper's grid, from its start to its goal."""

import numpy as np

from skills.kinematics import POINTING_DOWN
from skills.planning.handoff import realign
from skills.planning.trajectory import PassPath, Trajectory, time_parametrise
from skills.verification.playback import Playback

PSM_M = (-0.94, 0.10, -0.33)
HAND_OFF_MM = np.array(
    [[-10, 55, -135], [-15, 60, -135], [-20, 60, -130], [-15, 60, -125], [-10, 55, -120], [0, 55, -120], [5, 55, -125]],
    dtype=float,
)


def hand_off(shift_mm: float = 0.0, with_a2: bool = True) -> PassPath:
    """Return one pass of seven points, moved along y."""
    target = realign(POINTING_DOWN, PSM_M).rotation if with_a2 else None
    return PassPath(HAND_OFF_MM + np.array([0.0, shift_mm, 0.0]), POINTING_DOWN, target)


def small_trajectory(passes: int = 2, rate_hz: float = 120.0) -> Trajectory:
    """Return two passes with A2, at half the usual rate."""
    return time_parametrise([hand_off(-8.0 * k) for k in range(passes)], rate_hz=rate_hz)


def ideal_playback(trajectory: Trajectory) -> Playback:
    """Return the measurements of a simulator without any fault."""
    count = len(trajectory)
    return Playback(
        trajectory=trajectory,
        tip_mm=trajectory.tip_mm,
        rotation_xyzw=trajectory.rotation_xyzw,
        joints=trajectory.joints,
        tracking_mm=np.zeros(count),
        efforts=np.zeros((count, 6)),
        contact_n=np.zeros(count),
        windows=np.zeros((0, 2), np.int64),
        looked_at=np.arange(count),
        clearances_mm=np.full((count, 4), 5.0),
        shaft_off_mm=np.zeros(count),
        psm_m_tip_mm=None,
        pad_mm=np.array([0.0, 55.0, -150.0]),
        picture_png=b"",
        engine="none",
        files={},
    )
