"""Intent: a played motion compared with what was requested, independently of the code that planned it.

    RequestedMotion, Trajectory, joints that were played --compare--> Deviations: one number per sample and kind

`skills.verification.verdict.judge` finds whether the arms did what the trajectory says. Here the trajectory itself is
compared: of a plan only suture points, starts, PSM_M and rules are used, and never a path, a target or a hand that
planning computed (`skills.verification.requested`). The poses are those of the played joints, by forward kinematics.

* *Place.* The tip, moved back into the grid world of its suture point, goes through the cells of the policy's rollout
  in their order, from the start of the pass, and ends at the suture point.
* *Recording.* From where the rollout follows the demonstration, A1 repeats it on the demonstration's clock, slowed by
  one factor. The tip may be as far off the mean of a quarter of a second around a moment as the hand's own samples lie
  off a steady motion there, as far again as hysteresis let the recording's ends leave their cells, and a part of a cell
  further; jaw and opening likewise. Where the hand stood, an arm may stand; elsewhere it may not.
* *Hand-off.* At the end of A2 the needle is where the definition of the hand-off puts it: in the recorded poses of both
  arms, or with PSM_A's hinge along PSM_M's approach and PSM_M a quarter of the needle's circle further on.
* *Jaws.* The needle is always held. PSM_A's jaw is as recorded, or closed, from the start of A1 until both arms stand
  at the end of A2 and PSM_M's, open until then, has closed; then it opens. In a transfer to a further pass it is the
  other way round, once both arms stand where A1 begins. Otherwise no jaw moves.
* *Between.* A2 turns the jaw the shorter way with the tip held, transfers are straight, and PSM_M leaves before PSM_A.

All of this is ours. A deviation passes where it does not exceed its limit, so NaN never passes.
"""

from math import nan
from types import MappingProxyType

import numpy as np

from skills.arithmetic import arccos
from skills.arrays import Floats
from skills.kinematics import angle_between, forward, matrix_of
from skills.planning.motion_laws import Poses
from skills.planning.trajectory import Trajectory
from skills.verification.deviations import LIMITS, Deviations
from skills.verification.pass_comparison import PassComparison, PlayedMotion
from skills.verification.requested import RequestedMotion


def compare(request: RequestedMotion, trajectory: Trajectory, joints: Floats | None = None) -> Deviations:
    """Compare a motion with what was requested.

    Args:
        request: What was requested.
        trajectory: The motion: its stamps, phases, jaw and PSM_M.
        joints: The joints of PSM_A that were played, rad and mm, shape (T, 6); None: the trajectory's.
    """
    found = Deviations.none(len(trajectory))
    counted = np.maximum(trajectory.pass_index + 1 - len(request.points), 0).astype(np.float64)
    counted[-1] = abs(trajectory.passes - len(request.points))
    found.add("number of passes off the suture points", np.arange(len(trajectory)), counted)
    stated = [np.array(point.rotation_xyzw) for point in request.points]
    if (psm_m := request.psm_m) is not None:
        stated += [np.array(one) for one in (psm_m.base_xyzw, psm_m.taken_xyzw) if one is not None]
    first = np.zeros(1, np.int64)
    found.add("length of a stated quaternion off 1", first, np.abs(np.linalg.norm(stated, axis=1) - 1.0).max())
    found.add("PSM_M's approach off the demonstrated hand-off", first, _approach_deg(request))
    arm = _poses(trajectory.joints if joints is None else joints, trajectory.instrument)
    played = PlayedMotion(trajectory, arm, _place_psm_m(request, trajectory, found))
    before = None
    for number in range(min(trajectory.passes, len(request.points))):
        before = PassComparison(request, played, number, before, found)
        before.compare()
    return Deviations(MappingProxyType(found.values))


def _approach_deg(request: RequestedMotion) -> float:
    """Return the angle of PSM_M's approach from the demonstrated hand-off, if it fits that in PSM_M's frame; or else 0.

    It is compared with the recorded approach, or with the needle, which then runs along it in PSM_A's jaws, to and fro.
    """
    psm_m, demo = request.psm_m, request.demo
    if psm_m is None or psm_m.base_xyzw is None or demo is None or demo.rotation_xyzw is None:
        return 0.0
    known = demo.partner is not None
    seen = demo.partner.approach if demo.partner is not None else matrix_of(demo.rotation_xyzw[-1:])[0, :, 0]
    along = [one @ seen for one in (request.approach, matrix_of(np.array([psm_m.base_xyzw]))[0] @ request.approach)]
    as_stated, in_its_own = np.degrees(arccos(np.clip(along if known else np.abs(along), -1.0, 1.0))).tolist()
    return float(as_stated) if in_its_own <= LIMITS["PSM_M's approach off the demonstrated hand-off"][1] else 0.0


def _place_psm_m(request: RequestedMotion, trajectory: Trajectory, found: Deviations) -> Poses | None:
    """Place PSM_M's played joints at its stated base; None if it is not stated, or does not move."""
    psm_m, played = request.psm_m, trajectory.psm_m
    stated = psm_m is not None and psm_m.base_mm is not None
    first = np.zeros(1, np.int64)
    if not stated or played is None:
        # one of them alone is a motion of another plan
        found.add("PSM_M's base off the stated one", first, 0.0 if stated == (played is not None) else nan)
        return None
    assert psm_m is not None
    base_mm, base = np.array(psm_m.base_mm), matrix_of(np.array([psm_m.base_xyzw]))
    found.add("PSM_M's base off the stated one", first, np.linalg.norm(played.base_mm - base_mm))
    turned = angle_between(matrix_of(played.base_xyzw[None]), base)
    found.add("PSM_M's base turned from the stated one", first, np.degrees(turned))
    seen = _poses(played.joints, psm_m.instrument)
    return Poses(seen.tip_mm @ base[0].T + base_mm, base[0] @ seen.rotation)


def _poses(joints: Floats, instrument: str) -> Poses:
    """Return the poses of joints, NaN where a joint is NaN."""
    sound = np.asarray(np.isfinite(joints).all(axis=1))
    tip, rotation = forward(np.where(sound[:, None], joints, 0.0), instrument)
    tip[~sound], rotation[~sound] = nan, nan
    return Poses(tip, rotation)
