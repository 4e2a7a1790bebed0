"""A recorded replay beside its plan: how far the tip was from where it was told to be, all along the way."""

from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from skills.errors import BadPlan
from skills.library.demos import find_demo
from skills.library.plans import find_plan, trajectory_of
from skills.library.verified import planned
from skills.recordings.replay import rows_of_pass
from skills.style._arrays import Floats
from skills.style.evaluation import TIE_BREAK, dtw

POINTS = 1000  # ours, of either path: one every 0.25 mm of a long pass, and 24 MB to align them


def compare_with_plan(session: Session, plan_sha256: str, demo_sha256: str, pass_index: int = 0) -> dict[str, Any]:
    """Align what was recorded of a replay with a pass of its plan, and measure how far apart they are.

    The paths are aligned as wholes (dynamic time warping), so the clocks need not agree; the recording has to be cut to
    the replay itself. Both are taken at `POINTS` at most, so what is nearer than about 0.2 mm is not told apart.

    Raises:
        NotFound: There is no such plan or demonstration.
        BadPlan: The plan has no such pass, or the recording is of another arm or in another frame.
    """
    plan, demo = planned(find_plan(session, plan_sha256)), find_demo(session, demo_sha256).demo
    if (plan.arm, plan.frame) != (demo.arm, demo.frame):
        raise BadPlan(
            f"The plan is one of {plan.arm} in the frame {plan.frame!r}, the recording of {demo.arm} in "
            f"{demo.frame!r}; record the arm's local/measured_cp."
        )
    trajectory = trajectory_of(plan)
    meant = trajectory.tip_mm[rows_of_pass(trajectory, pass_index)]
    apart_mm = dtw(_thinned(demo.tip_mm), _thinned(meant)).differences_mm
    distance_mm = np.linalg.norm(apart_mm, axis=1)
    return {
        "plan": plan_sha256,
        "demo": demo_sha256,
        "pass": pass_index,
        "mean_mm": float(distance_mm.mean()),
        "max_mm": float(distance_mm.max()),
        "start_mm": float(np.linalg.norm(demo.tip_mm[0] - meant[0])),
        "end_mm": float(np.linalg.norm(demo.tip_mm[-1] - meant[-1])),
        "dtw_mean_mm": apart_mm.mean(axis=0).tolist(),
        "rmse_mm": np.sqrt((apart_mm**2).mean(axis=0)).tolist(),
        "planned_s": float(np.ptp(trajectory.stamps_s[trajectory.pass_index == pass_index])),
        "recorded_s": float(demo.stamps_s[-1]),
        "tie_break": TIE_BREAK,
    }


def _thinned(path_mm: Floats) -> Floats:
    """Take at most `POINTS` of a path, evenly, its ends among them."""
    return path_mm[np.linspace(0, len(path_mm) - 1, min(len(path_mm), POINTS)).round().astype(np.int64)]
