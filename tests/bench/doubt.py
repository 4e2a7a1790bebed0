"""Duration of 1000 variations of a pass, compared with one closed-form inverse of the same poses."""

import numpy as np
from rich.table import Table

from skills.kinematics import POINTING_DOWN, inverse, matrix_of
from skills.planning.handoff import PsmM, realign
from skills.planning.trajectory import PassPath, Trajectory, time_parametrise
from skills.verification.clearance import clearance_between, clearance_to_pad, links_of
from skills.verification.monte_carlo import estimate_success
from skills.verification.probabilities import EstimateSettings
from tests.bench.timing import best_s, in_turn

ROUNDS = 3
ALLOWED_S = 60.0
PAD_TOP_MM = -150.0
TURN_RAD = np.radians(45)
PSM_M = PsmM(
    (-0.94, 0.10, -0.33), (160.0, 20.0, 20.0), (0.0, 0.0, float(np.sin(TURN_RAD / 2)), float(np.cos(TURN_RAD / 2)))
)
PATH_MM = np.array([[-10, 55, -135], [-20, 60, -130], [-15, 60, -125], [-10, 55, -120], [0, 55, -120], [5, 55, -125]])


def doubting(table: Table) -> None:
    """Vary a pass, alone and with PSM_M."""
    settings = EstimateSettings()
    for name, psm_m in (("alone", None), ("beside PSM_M", PSM_M)):
        one = _motion(psm_m)
        poses = (
            settings.variations * estimate_success(one, approach_m=PSM_M.approach, pad_top_mm=PAD_TOP_MM).looked_at[0]
        )
        samples = np.resize(np.arange(len(one)), poses)
        tip, turned = one.tip_mm[samples], matrix_of(one.rotation_xyzw)[samples]
        took, solving = in_turn(
            lambda: estimate_success(one, approach_m=PSM_M.approach, pad_top_mm=PAD_TOP_MM),  # noqa: B023
            lambda: inverse(tip, turned),  # noqa: B023
            rounds=ROUNDS,
        )
        table.add_row(f"doubt, {settings.variations} variations of a pass {name}", f"{took:.2f} s", f"{poses} poses")
        table.add_row(
            "  a pose, two sizes of errors and six costs",
            f"{took / poses * 1e6:.1f} us",
            f"{took / solving:.1f} x one inverse",
        )
        table.add_row("  of what it may take", "", f"{took / ALLOWED_S:.1%}")
    _clearances(table)


def _clearances(table: Table) -> None:
    joints = np.resize(_motion(None).joints, (20_000, 6))
    arm = links_of(joints)
    took = best_s(lambda: links_of(joints)), best_s(lambda: clearance_to_pad(arm, PAD_TOP_MM))
    between = best_s(lambda: clearance_between(arm, arm))
    for what, seconds in (("an arm's links", took[0]), ("their way to the pad", took[1]), ("to another arm", between)):
        table.add_row(f"  {what}, a pose", f"{seconds / len(joints) * 1e6:.2f} us", "")


def _motion(psm_m: PsmM | None) -> Trajectory:
    path = PassPath(PATH_MM, POINTING_DOWN, realign(POINTING_DOWN, PSM_M.approach).rotation)
    return time_parametrise([path], rate_hz=200.0, psm_m=psm_m)
