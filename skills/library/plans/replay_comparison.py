"""The comparison of a recorded replay with a pass of its plan."""

import numpy as np
from sqlalchemy.orm import Session

from skills.arrays import Floats, xyz
from skills.errors import BadPlan
from skills.learning.evaluation import TIE_BREAK, dtw
from skills.library.operation.integrity import planned
from skills.library.plans.plans import followed_plan, trajectory_of
from skills.library.recordings.demos import shown_demo
from skills.planning.trajectory import rows_of_pass
from skills.schemas.playbacks import Comparison

POINTS = 1000  # ours, for either path: one every 0.25 mm of a long pass, and 24 MB to align the two


def compare_with_plan(session: Session, plan_sha256: str, demo_sha256: str, pass_index: int = 0) -> Comparison:
    """Align a recorded replay with a pass of its plan, and return the distances between the two tip paths, in mm.

    The paths are aligned as a whole (dynamic time warping), so the two clocks need not agree; the recording has to be
    cut to the replay itself. Each path is thinned to `POINTS` points at most, so differences below about 0.2 mm are not
    resolved.

    Args:
        session: The caller's transaction.
        plan_sha256: The plan's digest.
        demo_sha256: The digest of the demonstration that was cut out of the replay's recording.
        pass_index: The pass of the plan, counted from 0.

    Raises:
        NotFound: There is no such plan or demonstration.
        Conflict: The consent does not cover training, for the plan, or any use, for the demonstration.
        BadPlan: The plan has no such pass, or the recording is of another arm or in another frame.
    """
    of_plan, of_demo = followed_plan(session, plan_sha256), shown_demo(session, demo_sha256)
    plan, demo = planned(of_plan), of_demo.demo
    if (plan.arm, plan.frame) != (demo.arm, demo.frame):
        raise BadPlan(
            f"The plan is for {plan.arm} in the frame {plan.frame!r}, the recording is of {demo.arm} in "
            f"{demo.frame!r}; record the arm's local/measured_cp."
        )
    trajectory = trajectory_of(plan)
    meant = trajectory.tip_mm[rows_of_pass(trajectory, pass_index)]
    apart_mm = dtw(_thinned(demo.tip_mm), _thinned(meant)).differences_mm
    distance_mm = np.linalg.norm(apart_mm, axis=1)
    return Comparison.model_construct(  # by the names of the fields: `pass` is a keyword of Python
        plan=of_plan.sha256,
        demo=of_demo.sha256,
        pass_index=pass_index,
        mean_mm=float(distance_mm.mean()),
        max_mm=float(distance_mm.max()),
        start_mm=float(np.linalg.norm(demo.tip_mm[0] - meant[0])),
        end_mm=float(np.linalg.norm(demo.tip_mm[-1] - meant[-1])),
        dtw_mean_mm=xyz(apart_mm.mean(axis=0)),
        rmse_mm=xyz(np.sqrt((apart_mm**2).mean(axis=0))),
        planned_s=float(np.ptp(trajectory.stamps_s[trajectory.pass_index == pass_index])),
        recorded_s=float(demo.stamps_s[-1]),
        tie_break=TIE_BREAK,
    )


def _thinned(path_mm: Floats) -> Floats:
    """Return at most `POINTS` points of a path, shape (T, 3), evenly spaced by index, its ends included."""
    return path_mm[np.linspace(0, len(path_mm) - 1, min(len(path_mm), POINTS)).round().astype(np.int64)]
