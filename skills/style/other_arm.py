"""PSM_M beside a plan: where it waits, where it takes the needle, and the joints that bring it there.

    base of PSM_M, hand-off pose of each pass --solve--> OtherArm

It waits at a stand-off, straight back along its approach, and comes in while PSM_A turns its jaw (A2). Told to be there
from the start, it waits at the hand-off itself. The paper has PSM_M waiting; how it comes is ours.

Its jaws are the same either way round, so of a pose and that pose with the hinge reversed it takes the one that needs
less roll; all other joints but the sign of the wrist's are the same.
"""

from dataclasses import dataclass

import numpy as np

from skills.style._arrays import Floats
from skills.style.handoff import OtherArm, PsmM, hand_off
from skills.style.kinematics import ROLL, matrix_of
from skills.style.moves import Pose, Poses
from skills.style.solving import Ticks, solve

STAND_OFF_MM = 30.0  # ours: the needle's circle, 16.6 mm across, and a finger of 10.2 mm beyond it, and a little more
_HINGE_REVERSED = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Meeting:
    """Where PSM_M is about one hand-off, in the PSM_A base frame.

    `stand_off` is out of PSM_A's way, `taking` holds the needle; `waiting` is the one of them in which it is during A1.
    """

    stand_off: Pose
    taking: Pose
    waiting: Pose


def meeting(handed: Pose, psm_m: PsmM) -> Meeting:
    """Find where PSM_M is about a hand-off: the pose of PSM_A after A2."""
    tip_mm, rotation = hand_off(handed.tip_mm[None], handed.rotation[None], psm_m.approach)
    taking = Pose(tip_mm[0], rotation[0])
    stand_off = Pose(taking.tip_mm - STAND_OFF_MM * taking.rotation[:, 2], taking.rotation)
    return Meeting(stand_off, taking, taking if psm_m.enters == "start" else stand_off)


def other_arm(poses: Poses, ticks: Ticks, psm_m: PsmM) -> OtherArm:
    """Solve the joints of PSM_M for a whole motion, whose poses are in the PSM_A base frame.

    Raises:
        Unreachable: The first sample that it cannot take; `numbers` names PSM_M, pass, phase, joint, value and limit.
    """
    assert psm_m.base_mm is not None and psm_m.base_xyzw is not None
    base_mm, base_xyzw = np.array(psm_m.base_mm), np.array(psm_m.base_xyzw)
    base = matrix_of(base_xyzw[None])[0]
    seen = Poses((poses.tip_mm - base_mm) @ base, base.T @ poses.rotation)
    reversed_ = Poses(seen.tip_mm, seen.rotation @ _HINGE_REVERSED)
    either = [solve(one, ticks, psm_m.instrument, "PSM_M") for one in (seen, reversed_)]
    joints = min(either, key=_most_roll)
    return OtherArm(base_mm, base_xyzw / np.linalg.norm(base_xyzw), psm_m.instrument, joints)


def _most_roll(joints: Floats) -> float:
    return float(np.abs(joints[:, ROLL]).max())
