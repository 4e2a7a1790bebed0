"""The verdict on a playback: feasible or not, and the figures that it rests on.

`judge` compares what the simulator measured (`Playback`) with what was meant (`Trajectory`). All of this is ours; the
paper played its plans on the robot.

What the verdict says: the geometry is right and free. In free space the servo's error and efforts show the simulator's
gains and masses, not the robot's, so they guard against mistakes of ours and in contact; they are no evidence of the
hardware's accuracy. PSM_M is in the kinematic pass alone.
"""

import numpy as np
from numpy.typing import ArrayLike

from skills.errors import BadInput
from skills.style._arrays import Floats, frozen
from skills.style.figures import ArmFigures, Figures, figures_of
from skills.style.gates import JudgeSettings, first_failure
from skills.style.kinematics import INSERTION, JOINTS, UNITS, angle_between, matrix_of
from skills.style.moves import A2, PHASES
from skills.style.needle import psm_m_poses
from skills.style.playback import CLEARANCE_SEEN_MM, PAD, PSM_M, Playback
from skills.style.playback_report import (
    ArmReport,
    ClearanceReport,
    JointReport,
    NeedleReport,
    PassEnd,
    PlaybackReport,
)
from skills.style.trajectory import Trajectory


def judge(
    playback: Playback,
    trajectory: Trajectory,
    settings: JudgeSettings | None = None,
    *,
    approach_m: ArrayLike | None = None,
) -> PlaybackReport:
    """Compare what was measured with what was meant and allowed.

    Args:
        playback: What was measured.
        trajectory: What was played.
        settings: What is allowed.
        approach_m: PSM_M's approach in the PSM_A base frame, shape (3,), where it is known and PSM_M is not in the
            scene; where it is, its own pose counts.

    Raises:
        BadInput: The playback has another number of samples than the trajectory, or only one of them has PSM_M.
    """
    _check_same(playback, trajectory)
    limits = settings or JudgeSettings()
    figures = figures_of(playback, trajectory)
    failure = first_failure(figures, playback, trajectory, limits)
    psm_a = figures.arms[0]
    with_m = trajectory.psm_m is not None
    touching = figures.effort[~(playback.contact_n <= 0)]
    return PlaybackReport(
        feasible=failure is None,
        failure=failure,
        samples=len(trajectory),
        passes=trajectory.passes,
        duration_s=trajectory.duration_s,
        rate_hz=trajectory.rate_hz,
        # Counted so that a NaN margin is unreachable.
        unreachable_samples=int(np.count_nonzero(~(psm_a.margins >= -1e-9).all(axis=1))),
        least_margin=float(psm_a.margins.min()),
        least_margin_joint=JOINTS[int(np.argmin(_lowest(psm_a.margins)))],
        least_insertion_mm=float(psm_a.joints[:, INSERTION].min()),
        peak_speed_ratio=float(psm_a.speed.max()),
        peak_acceleration_ratio=float(psm_a.acceleration.max()),
        fk_error_mm=float(figures.fk_mm.max()),
        fk_error_deg=float(figures.fk_deg.max()),
        psm_m_fk_error_mm=float(figures.psm_m_fk_mm.max()) if with_m else None,
        shaft_off_mm=float(playback.shaft_off_mm.max()),
        tracking_max_mm=float(playback.tracking_mm.max()),
        tracking_rms_mm=float(np.sqrt(np.mean(playback.tracking_mm**2))),
        goal_error_mm=float(playback.tracking_mm[trajectory.last_samples].max()),
        peak_contact_n=float(playback.contact_n.max()),
        peak_effort_ratio=float(figures.effort.max()),
        peak_contact_effort_ratio=float(touching.max(initial=0.0)),
        deviation_mm=trajectory.deviation_mm,
        clearance_pad_mm=_least(playback, PAD),
        clearance_psm_m_mm=_least(playback, PSM_M) if with_m else None,
        looks=len(playback.looked_at),
        moved_between_looks_mm=figures.apart.moved_mm(),
        seen_within_mm=CLEARANCE_SEEN_MM,
        psm_m_in_scene=with_m,
        arms=tuple(_arm_report(arm) for arm in figures.arms),
        clearances=_clearances(playback, trajectory, figures),
        needle=_needle(playback, trajectory, figures),
        ends=_ends(playback, trajectory, figures, approach_m),
        pad_top_mm=float(playback.pad_mm[2]),
        engine=playback.engine,
        files=dict(playback.files),
        settings=limits,
    )


def _check_same(playback: Playback, trajectory: Trajectory) -> None:
    if len(playback) != len(trajectory):
        raise BadInput(
            f"The playback has {len(playback)} samples, the trajectory {len(trajectory)}; play this trajectory.",
            playback=len(playback),
            trajectory=len(trajectory),
        )
    if (playback.psm_m_tip_mm is None) != (trajectory.psm_m is None):
        raise BadInput("PSM_M is in the playback or in the trajectory, and not in both; play this trajectory.")


def _arm_report(arm: ArmFigures) -> ArmReport:
    rows = zip(
        JOINTS,
        UNITS,
        arm.joints.min(axis=0).tolist(),
        arm.joints.max(axis=0).tolist(),
        arm.tool.lower.tolist(),
        arm.tool.upper.tolist(),
        (arm.margins.min(axis=0) * (arm.tool.upper - arm.tool.lower)).tolist(),
        arm.speed.max(axis=0).tolist(),
        arm.acceleration.max(axis=0).tolist(),
        strict=True,
    )
    return ArmReport(arm.name, arm.tool, tuple(JointReport(*row) for row in rows))


def _clearances(playback: Playback, trajectory: Trajectory, figures: Figures) -> tuple[ClearanceReport, ...]:
    """List every pair of links that came near in a phase, by phases and the nearest first."""
    found = []
    phase_seen = trajectory.phase[playback.looked_at]
    for column, pair in enumerate(playback.link_pairs):
        links = (pair.body, pair.link, pair.other, pair.other_link)
        apart = figures.apart.at_least_mm(column)
        for phase, name in enumerate(PHASES):
            seen = np.where(phase_seen == phase, playback.clearances_mm[:, column], np.inf)
            least = int(np.argmin(seen))
            if seen[least] >= CLEARANCE_SEEN_MM:
                continue
            at_least, sample = float(apart[trajectory.phase == phase].min()), int(playback.looked_at[least])
            found.append((phase, ClearanceReport(name, *links, float(seen[least]), sample, at_least)))
    return tuple(one for _, one in sorted(found, key=lambda one: (one[0], one[1].least_mm)))


def _needle(playback: Playback, trajectory: Trajectory, figures: Figures) -> tuple[NeedleReport, ...]:
    phase_seen = trajectory.phase[playback.looked_at]
    found = []
    for phase, name in enumerate(PHASES):
        if (phase_seen == phase).any():
            least = int(np.argmin(np.where(phase_seen == phase, figures.needle_mm, np.inf)))
            found.append(NeedleReport(name, float(figures.needle_mm[least]), int(playback.looked_at[least])))
    return tuple(found)


def _ends(
    playback: Playback, trajectory: Trajectory, figures: Figures, approach_m: ArrayLike | None
) -> tuple[PassEnd, ...]:
    last = trajectory.last_samples
    jaws = matrix_of(trajectory.rotation_xyzw)
    approaches = _approaches(trajectory, approach_m)
    ends = []
    for number, end in enumerate(last.tolist()):
        mine = np.flatnonzero((trajectory.pass_index == number) & (trajectory.phase != A2))
        before = mine[-1] if len(mine) else end
        to_n, to_a = (None, None) if approaches is None else _angles_deg(approaches[number], jaws[end])
        ends.append(
            PassEnd(
                sample=end,
                turn_deg=float(np.degrees(angle_between(jaws[before][None], jaws[end][None])[0])),
                alignment_error_deg=float(figures.fk_deg[end]),
                goal_error_mm=float(playback.tracking_mm[end]),
                n_to_a_m_deg=to_n,
                a_to_a_m_deg=to_a,
            )
        )
    return tuple(ends)


def _approaches(trajectory: Trajectory, approach_m: ArrayLike | None) -> Floats | None:
    """Take PSM_M's approach at the end of each pass, shape (passes, 3): its own, else the given one."""
    if trajectory.psm_m is not None:
        return psm_m_poses(trajectory, trajectory.last_samples)[1][:, :, 2]
    if approach_m is None:
        return None
    return np.tile(frozen(approach_m, np.float64, (3,), "approach_m"), (trajectory.passes, 1))


def _angles_deg(approach: Floats, jaw: Floats) -> tuple[float, float]:
    """Measure the angles between a direction and a jaw's n and a."""
    across = [float(np.linalg.norm(np.cross(axis, approach))) for axis in (jaw[:, 0], jaw[:, 2])]
    along = [float(axis @ approach) for axis in (jaw[:, 0], jaw[:, 2])]
    n, a = np.degrees(np.arctan2(across, along)).tolist()
    return n, a


def _least(playback: Playback, other: str) -> float:
    columns = [k for k, pair in enumerate(playback.link_pairs) if pair.other == other]
    return float(playback.clearances_mm[:, columns].min())


def _lowest(margins: Floats) -> Floats:
    """Take each joint's least margin, NaN as the least of all."""
    return np.asarray(np.where(np.isnan(margins), -np.inf, margins).min(axis=0))
