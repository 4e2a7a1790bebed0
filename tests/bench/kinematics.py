"""Speed of kinematics and time parametrisation: a pose in a batch, and a plan of twenty passes with both arms."""

import numpy as np
from rich.table import Table

from skills.kinematics import CANNULA_MM, CLASSIC, POINTING_DOWN, angle_between, forward, inverse
from skills.planning.handoff import PsmM
from skills.planning.trajectory import PassPath, time_parametrise
from tests.bench.timing import best_s
from tests.planning.motions import PSM_M, hand_off

POSES = 12_000
ROUNDS = 9
TURN_RAD = np.radians(45.0)
BESIDE = PsmM(PSM_M, (160.0, 20.0, 20.0), (0.0, 0.0, float(np.sin(TURN_RAD / 2)), float(np.cos(TURN_RAD / 2))))
MOST_US = 2.0  # per pose, as the motion specification requires


def kinematics(table: Table) -> None:
    """Time both directions on poses within the joint limits and on the paper's grid; then complete plans."""
    rng = np.random.default_rng(7)
    joints = rng.uniform(CLASSIC.lower, CLASSIC.upper, (POSES, 6))
    joints[:, 2] = rng.uniform(CANNULA_MM, CLASSIC.upper[2], POSES)
    tips, rotations = forward(joints)
    again, turned = forward(inverse(tips, rotations))
    off_mm, off_rad = float(np.abs(again - tips).max()), float(angle_between(rotations, turned).max())
    held = rng.uniform((-30.0, 25.0, -140.0), (20.0, 75.0, -90.0), (POSES, 3))
    forth, back, in_grid = (
        best_s(work, ROUNDS) / POSES * 1e6
        for work in (
            lambda: forward(joints),
            lambda: inverse(tips, rotations),
            lambda: inverse(held, POINTING_DOWN),
        )
    )
    table.add_row(
        "inverse kinematics, a pose in batch", f"{back:.2f} us", f"at most {MOST_US:g} us; {off_mm:.0e} mm off"
    )
    table.add_row("  in the paper's grid, the jaw held", f"{in_grid:.2f} us", f"{off_rad:.0e} rad off")
    table.add_row("  forward", f"{forth:.2f} us", f"{back / forth:.1f} x as fast")
    _plans([hand_off(-2.0 * k) for k in range(20)], table)


def _plans(passes: list[PassPath], table: Table) -> None:
    motion = time_parametrise(passes, rate_hz=200.0, psm_m=BESIDE)
    alone = best_s(lambda: time_parametrise(passes, rate_hz=200.0), 3)
    both = best_s(lambda: time_parametrise(passes, rate_hz=200.0, psm_m=BESIDE), 3)
    table.add_row("20 passes put into time, PSM_A", f"{alone * 1e3:.0f} ms", "with transfers, at 200 Hz")
    table.add_row("  with PSM_M", f"{both * 1e3:.0f} ms", f"{both / alone:.1f} x; {len(motion)} samples")
