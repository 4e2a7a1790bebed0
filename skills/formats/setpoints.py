"""Setpoints in columns of tables and datasets: read beside the measured poses, and left out with a reason otherwise.

Such columns do not name their frame. Recorders take them from `setpoint_cp` beside `measured_cp`, so they are read in
the frame of the measured pose, if they are near it: setpoints in another frame or unit are further away than an arm
lags behind. No fault of a setpoint refuses a recording, because nothing is learnt from it.
"""

from dataclasses import dataclass, field

import numpy as np

from skills.arrays import Floats, Ints
from skills.demonstration.recording import Motion, Signal, recorded_motion, recorded_signal
from skills.errors import SkillsError

APART_MM = 30.0  # ours: an arm lags by some mm, and by a cell of the paper's grid, 5 mm, at 100 mm/s and 50 ms


@dataclass(frozen=True)
class ColumnSetpoints:
    """The setpoints in the columns of one file.

    Attributes:
        tips: Commanded poses of tips.
        jaws: Arm and the commanded angle of its jaw.
        left_out: Topics that were not usable, and the fault of each.
    """

    tips: list[Motion] = field(default_factory=list)
    jaws: list[tuple[str, Signal]] = field(default_factory=list)
    left_out: list[tuple[str, str]] = field(default_factory=list)

    def add_tip(self, topic: str, stamps_ns: Ints, tip_mm: Floats, rotation_xyzw: Floats, measured: Motion) -> None:
        """Add the commanded poses of a tip.

        Args:
            topic: The topic from which a recorder takes such columns.
            stamps_ns: Integer nanoseconds, shape (T,).
            tip_mm: Positions, shape (T, 3).
            rotation_xyzw: Orientations, shape (T, 4).
            measured: The measured motion of the arm, in the frame of the setpoints.
        """
        try:
            tip = recorded_motion(
                arm=measured.arm,
                topic=topic,
                frame=measured.frame,
                stamps_ns=stamps_ns,
                tip_mm=tip_mm,
                rotation_xyzw=rotation_xyzw,
            )
        except SkillsError as error:
            self.left_out.append((topic, str(error)))
            return
        _, here, there = np.intersect1d(tip.stamps_ns, measured.stamps_ns, assume_unique=True, return_indices=True)
        away_mm = np.linalg.norm(tip.tip_mm[here] - measured.tip_mm[there], axis=1)
        if not (len(away_mm) and np.median(away_mm) <= APART_MM):
            far_mm = float(np.median(away_mm)) if len(away_mm) else float("nan")
            why = f"Its median distance from the measured tip is {far_mm:.3g} mm, above {APART_MM:g} mm: another frame."
            self.left_out.append((topic, why))
        else:
            self.tips.append(tip)

    def add_jaw(self, arm: str, topic: str, stamps_ns: Ints, angles_rad: Floats) -> None:
        """Add the commanded angles of a jaw, shape (T,)."""
        try:
            self.jaws.append((arm, recorded_signal(stamps_ns, angles_rad, topic)))
        except SkillsError as error:
            self.left_out.append((topic, str(error)))
