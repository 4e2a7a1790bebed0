"""The verdict on a playback: feasible or not, with its figures as plain numbers.

    Playback, Trajectory --judge--> PlaybackReport
    SuturePlan, its policy and demonstration, Playback --judge_plan--> PlanVerdict, with the probability of success

`judge` compares the simulator's measurements (`Playback`) with the intended motion (`Trajectory`), and with what was
asked if its deviations from that are given (`skills.verification.intent`), by the gates of `skills.verification.gates`.
All of this is ours; the paper played its plans on the robot.

A feasible verdict means that the geometry is right and free, and, where a servo is stated, that the executed motion
touches no harder than lightly.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from skills import kinematics
from skills.arrays import Floats, frozen
from skills.demonstration.demonstration import Demo
from skills.dynamics import Servo
from skills.errors import BadInput
from skills.fields import Count, Figure, Sha256, schema
from skills.learning.policy import Policy
from skills.notebook import card
from skills.planning.motion_laws import A2, PHASES
from skills.planning.plan import SuturePlan
from skills.planning.trajectory import PSM_M, Trajectory
from skills.verification.arm_errors import UNCALIBRATED, ArmErrors
from skills.verification.bodies import BodiesReport, bodies_clearance
from skills.verification.clearance import psm_m_poses
from skills.verification.deviations import Deviations, Mismatch
from skills.verification.execution import ExecutionReport, PlannedMotion, execution_of
from skills.verification.gates import SCENE, ArmSamples, Failure, Figures, Limits, figures_of, first_failure
from skills.verification.intent import compare
from skills.verification.monte_carlo import estimate_success
from skills.verification.playback import CLEARANCE_SEEN_MM, MEANS, PAD, Playback
from skills.verification.probabilities import UPWARDS, SuccessEstimate
from skills.verification.requested import requested_motion
from skills.verification.scene_clearance import (
    NEEDLE,
    TISSUE,
    SceneClearance,
    SceneReport,
    clearance_of,
    flat_tissue,
    needle_from_arm,
)


@schema
@dataclass(frozen=True)
class JointFigures:
    """The range of one joint in its unit, with its limits."""

    name: str
    unit: str
    lowest: Figure
    highest: Figure
    lower_limit: float
    upper_limit: float
    margin: Figure
    peak_speed_ratio: Figure
    peak_acceleration_ratio: Figure


@schema
@dataclass(frozen=True)
class ArmFigures:
    """One arm: the constants of its instrument, and its joints."""

    name: str
    instrument: kinematics.InstrumentConstants
    joints: tuple[JointFigures, ...]


@schema
@dataclass(frozen=True)
class Clearance:
    """The least distance between two links in one phase of any pass.

    Attributes:
        phase: Name of the phase.
        body: The body of the link.
        link: Its name in the URDF.
        other: The other body.
        other_link: Its link.
        least_mm: The least measured distance; pairs that were never within `seen_within_mm` are not listed.
        sample: The sample of that measurement.
        at_least_mm: Lower bound on the distance at every sample, including those without a measurement.
    """

    phase: str
    body: str
    link: str
    other: str
    other_link: str
    least_mm: Figure
    sample: Count
    at_least_mm: Figure


@schema
@dataclass(frozen=True)
class PassEnd:
    """The end of a pass: the jaw's angles, and the errors there.

    Attributes:
        sample: Its index.
        turn_deg: Angle by which A2 turned the jaw.
        alignment_error_deg: Angle between the jaw's final and target rotations.
        n_to_a_m_deg: Angle between PSM_A's hinge axis n and PSM_M's approach a_M; None if that is not known.
        a_to_a_m_deg: Angle between PSM_A's approach and a_M: the paper wants a right angle.
    """

    sample: Count
    turn_deg: Figure
    alignment_error_deg: Figure
    n_to_a_m_deg: Figure
    a_to_a_m_deg: Figure


@schema
@dataclass(frozen=True)
class NeedleClearance:
    """Least distance of the needle from the pad in one phase of any pass, negative inside: reported, but not a gate."""

    phase: str
    to_pad_mm: Figure
    sample: Count


@schema
@dataclass(frozen=True)
class PlaybackReport:
    """The verdict and its figures: plain numbers, the same for the same trajectory on every machine.

    `least_margin` is the least distance of a joint of PSM_A, `least_margin_joint`, from its limit as a part of its
    range, and the peak ratios are PSM_A's; `arms` has every joint of both. `clearance_pad_mm` is of either arm. Between
    two measurements a pair of links can have come nearer by `moved_between_looks_mm`, which the gates take into
    account. `executed_off_mm` is the greatest distance of the executed tip from the planned one, `peak_contact_n` the
    greatest force on PSM_A then; null: no servo was stated. `bodies` compares the arms' outer bodies. `intent` has the
    greatest deviation of each kind from what was asked; null: not compared with it. `means` has for each check the
    means by which it is decided.
    """

    feasible: bool
    failure: Failure | None
    samples: Count
    passes: Count
    duration_s: float
    rate_hz: float
    unreachable_samples: Count
    least_margin: Figure
    least_margin_joint: str
    least_insertion_mm: Figure
    peak_speed_ratio: Figure
    peak_acceleration_ratio: Figure
    fk_error_mm: Figure
    fk_error_deg: Figure
    psm_m_fk_error_mm: Figure
    shaft_off_mm: Figure
    executed_off_mm: Figure
    peak_contact_n: Figure
    deviation_mm: Figure
    clearance_pad_mm: Figure
    clearance_psm_m_mm: Figure
    looks: Count
    moved_between_looks_mm: Figure
    seen_within_mm: float
    psm_m_in_scene: bool
    arms: tuple[ArmFigures, ...]
    clearances: tuple[Clearance, ...]
    needle: tuple[NeedleClearance, ...]
    ends: tuple[PassEnd, ...]
    pad_top_mm: Figure
    engine: str
    files: Mapping[str, Sha256]
    settings: Limits
    bodies: BodiesReport
    intent: tuple[Mismatch, ...] | None
    means: Mapping[str, str]

    def _repr_html_(self) -> str:
        beyond = [one.kind for one in self.intent or () if one.value is None or not one.value <= one.limit]
        asked = "not compared" if self.intent is None else ", ".join(beyond) or "within every limit"
        facts = {
            "first failure": self.failure,
            "motion": f"{self.passes} passes, {self.duration_s:.1f} s, {self.samples} samples",
            "least margin of a joint, as a part of its range": self.least_margin,
            "greatest speed, as a part of its limit": self.peak_speed_ratio,
            "greatest acceleration, as a part of its limit": self.peak_acceleration_ratio,
            "executed tip off the plan, mm": "no servo is stated"
            if self.executed_off_mm is None
            else self.executed_off_mm,
            "distance from the pad, mm": self.clearance_pad_mm,
            "distance from PSM_M, mm": self.clearance_psm_m_mm if self.psm_m_in_scene else "PSM_M is not in the scene",
            "deviation from what was asked": asked,
        }
        return card(f"Verdict: {'feasible' if self.feasible else 'not feasible'}", facts)


def judge(
    playback: Playback,
    trajectory: Trajectory,
    settings: Limits | None = None,
    *,
    approach_m: ArrayLike | None = None,
    beside: SceneClearance | None = None,
    pad_is_tissue: bool = True,
    intent: Deviations | None = None,
) -> PlaybackReport:
    """Compare the measurements with the intended motion, with what was asked, and with the limits.

    Args:
        playback: The measurements.
        trajectory: The trajectory that was played.
        settings: The limits; by default `Limits()`.
        approach_m: PSM_M's approach in the PSM_A base frame, shape (3,), if it is known and PSM_M is not in the scene;
            if PSM_M is in the scene, its own pose counts, and otherwise the recorded one of the trajectory.
        beside: The trajectory's distances from tissue and obstacles, as `clearance_of` computes them; None: nothing is
            compared with them.
        pad_is_tissue: Whether the simulator's pad is where tissue is. By default it lies below the motion, wherever
            that goes: then false, and its clearance is reported, but is no gate.
        intent: The deviations of the motion from what was asked, as `skills.verification.intent.compare` finds them;
            None: it is not compared with that.

    Returns:
        The verdict and its figures.

    Raises:
        BadInput: The playback has another number of samples than the trajectory, or only one of them has PSM_M.
    """
    _check_same(playback, trajectory)
    limits = settings or Limits()
    figures = figures_of(playback, trajectory)
    outer = bodies_clearance(trajectory, limits.clearance_bodies_mm)
    gated = limits if pad_is_tissue else replace(limits, clearance_pad_mm=-inf)
    failure = first_failure(
        figures,
        playback,
        trajectory,
        gated,
        beside,
        outer,
        intent,
        needle_from_arm(trajectory, limits.clearance_psm_m_mm),
    )
    psm_a = figures.arms[0]
    with_m = trajectory.psm_m is not None
    return PlaybackReport(
        feasible=failure is None,
        failure=failure,
        samples=len(trajectory),
        passes=trajectory.passes,
        duration_s=trajectory.duration_s,
        rate_hz=trajectory.rate_hz,
        # Negated, so that a NaN margin counts as unreachable.
        unreachable_samples=int(np.count_nonzero(~(psm_a.margins >= -1e-9).all(axis=1))),
        least_margin=float(psm_a.margins.min()),
        least_margin_joint=kinematics.JOINTS[int(np.nan_to_num(psm_a.margins, nan=-np.inf).min(axis=0).argmin())],
        least_insertion_mm=float(psm_a.joints[:, kinematics.INSERTION].min()),
        peak_speed_ratio=float(psm_a.speed.max()),
        peak_acceleration_ratio=float(psm_a.acceleration.max()),
        fk_error_mm=float(figures.fk_mm.max()),
        fk_error_deg=float(figures.fk_deg.max()),
        psm_m_fk_error_mm=float(figures.psm_m_fk_mm.max()) if with_m else None,
        shaft_off_mm=float(playback.shaft_off_mm.max()),
        executed_off_mm=None if playback.tracking_mm is None else float(playback.tracking_mm.max()),
        peak_contact_n=None if playback.contact_n is None else float(playback.contact_n.max()),
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
        bodies=outer.report,
        intent=None if intent is None else intent.greatest,
        means=dict(MEANS),
    )


@dataclass(frozen=True)
class PlanVerdict:
    """The verdict on a plan that was played: all that can be judged without a robot.

    Attributes:
        report: The motion as it was played, compared with the limits, with the scene, and with what was asked.
        scene: Its distances from the plan's scene; None if the plan has none.
        success: The probability of success when arms and world differ from the plan.
        executed: The motion that PSM_A is predicted to execute; None: the laboratory does not state how it is driven.
    """

    report: PlaybackReport
    scene: SceneReport | None
    success: SuccessEstimate
    executed: ExecutionReport | None

    @property
    def failure_sentence(self) -> str | None:
        """The reason why it is not feasible; one beside a scene also names the nearest parts."""
        failure = self.report.failure
        near = (
            []
            if self.scene is None
            else [one for one in self.scene.nearest if (one.body, one.part) != (NEEDLE, TISSUE)]
        )
        if failure is None:
            return None
        if self.executed is not None and failure is self.executed.failure:
            return f"As executed. {failure}"
        return f"{failure} Nearest: {near[0]}." if failure.quantity == SCENE and near else str(failure)


def judge_plan(
    plan: SuturePlan,
    trajectory: Trajectory,
    playback: Playback,
    *,
    policy: Policy,
    demo: Demo | None,
    errors: ArmErrors = UNCALIBRATED,
    servo: Servo | None = None,
) -> PlanVerdict:
    """Compare a plan as it was played with what was asked, its scene and the limits, and count how often it succeeds.

    Args:
        plan: The plan.
        trajectory: Its trajectory, with PSM_M's motion if the plan has PSM_M.
        playback: The measurements of that trajectory.
        policy: The policy that the plan follows.
        demo: The demonstration whose hand it follows, as `stack` was given it; None for a plan along cell centres.
        errors: The stated errors of the arms.
        servo: How PSM_A is driven; None: its executed motion is not predicted.

    Returns:
        The verdict, its distances from the scene, the probability of success, and the executed motion. A plan that is
        feasible as planned is not if PSM_A, in the middle of what is known of it, leaves a limit.

    Raises:
        BadInput: The playback is not of this trajectory.
    """
    approach_m = None if plan.psm_m is None else plan.psm_m.approach
    beside = None if plan.scene is None else clearance_of(trajectory, plan.scene)
    request = requested_motion(plan, policy, demo)
    intent = compare(request, trajectory, playback.joints)
    # The simulator's pad lies below the motion wherever that goes, so it is no tissue and no gate.
    report = judge(playback, trajectory, approach_m=approach_m, beside=beside, pad_is_tissue=False, intent=intent)
    executed = None
    if servo is not None:
        known = PlannedMotion(request, plan.scene, approach_m, intent, beside, report.bodies.at_least_mm)
        executed = execution_of(trajectory, servo, known).report(trajectory, servo)
        if report.feasible and executed.surely:
            report = replace(report, feasible=False, failure=executed.failure)
    tissue = None if plan.scene is None else plan.scene.tissue
    top = (None, UPWARDS) if tissue is None or beside is None else flat_tissue(trajectory, beside.report, tissue)
    success = estimate_success(
        trajectory,
        approach_m=approach_m,
        pad_top_mm=top[0],
        pad_normal=top[1],
        needle_mm=None if beside is None else beside.needle_mm,
        errors=errors,
    )
    return PlanVerdict(report, None if beside is None else beside.report, success, executed)


def _check_same(playback: Playback, trajectory: Trajectory) -> None:
    """Refuse a playback of another trajectory; raises as `judge`."""
    if len(playback) != len(trajectory):
        raise BadInput(
            f"The playback has {len(playback)} samples, the trajectory {len(trajectory)}; play this trajectory.",
            playback=len(playback),
            trajectory=len(trajectory),
        )
    if (playback.psm_m_tip_mm is None) != (trajectory.psm_m is None):
        raise BadInput("PSM_M is in only one of playback and trajectory; play this trajectory.")


def _arm_report(arm: ArmSamples) -> ArmFigures:
    """Return the ranges and peaks of an arm's joints."""
    rows = zip(
        kinematics.JOINTS,
        kinematics.UNITS,
        arm.joints.min(axis=0).tolist(),
        arm.joints.max(axis=0).tolist(),
        arm.tool.lower.tolist(),
        arm.tool.upper.tolist(),
        (arm.margins.min(axis=0) * (arm.tool.upper - arm.tool.lower)).tolist(),
        arm.speed.max(axis=0).tolist(),
        arm.acceleration.max(axis=0).tolist(),
        strict=True,
    )
    return ArmFigures(arm.name, arm.tool, tuple(JointFigures(*row) for row in rows))


def _clearances(playback: Playback, trajectory: Trajectory, figures: Figures) -> tuple[Clearance, ...]:
    """List every pair of links that came near in a phase, by phase and then by distance."""
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
            found.append((phase, Clearance(name, *links, float(seen[least]), sample, at_least)))
    return tuple(one for _, one in sorted(found, key=lambda one: (one[0], one[1].least_mm)))


def _needle(playback: Playback, trajectory: Trajectory, figures: Figures) -> tuple[NeedleClearance, ...]:
    """Return the least distance of the needle from the pad in each phase that was measured."""
    phase_seen = trajectory.phase[playback.looked_at]
    found = []
    for phase, name in enumerate(PHASES):
        if (phase_seen == phase).any():
            least = int(np.argmin(np.where(phase_seen == phase, figures.needle_mm, np.inf)))
            found.append(NeedleClearance(name, float(figures.needle_mm[least]), int(playback.looked_at[least])))
    return tuple(found)


def _ends(
    playback: Playback, trajectory: Trajectory, figures: Figures, approach_m: ArrayLike | None
) -> tuple[PassEnd, ...]:
    """Return the figures at the end of each pass."""
    last = trajectory.last_samples
    jaws = kinematics.matrix_of(trajectory.rotation_xyzw)
    approaches = _approaches(trajectory, approach_m)
    ends = []
    for number, end in enumerate(last.tolist()):
        mine = np.flatnonzero((trajectory.pass_index == number) & (trajectory.phase != A2))
        before = mine[-1] if len(mine) else end  # the jaw as it is held during A1
        to_n, to_a = (None, None) if approaches is None else _angles_deg(approaches[number], jaws[end])
        ends.append(
            PassEnd(
                sample=end,
                turn_deg=float(np.degrees(kinematics.angle_between(jaws[before][None], jaws[end][None])[0])),
                alignment_error_deg=float(figures.fk_deg[end]),
                n_to_a_m_deg=to_n,
                a_to_a_m_deg=to_a,
            )
        )
    return tuple(ends)


def _approaches(trajectory: Trajectory, approach_m: ArrayLike | None) -> Floats | None:
    """Return PSM_M's approach at the end of each pass, shape (passes, 3): its own, or else the given one."""
    if trajectory.psm_m is not None:
        return psm_m_poses(trajectory, trajectory.last_samples)[1][:, :, 2]
    if trajectory.taking is not None:
        return trajectory.taking.rotation[:, :, 2]
    if approach_m is None:
        return None
    return np.tile(frozen(approach_m, np.float64, (3,), "approach_m"), (trajectory.passes, 1))


def _angles_deg(approach: Floats, jaw: Floats) -> tuple[float, float]:
    """Return the angles between a direction and a jaw's n and a."""
    across = [float(np.linalg.norm(np.cross(axis, approach))) for axis in (jaw[:, 0], jaw[:, 2])]
    along = [float(axis @ approach) for axis in (jaw[:, 0], jaw[:, 2])]
    n, a = np.degrees(np.arctan2(across, along)).tolist()
    return n, a


def _least(playback: Playback, other: str) -> float:
    """Return the least measured distance from a body."""
    columns = [k for k, pair in enumerate(playback.link_pairs) if pair.other == other]
    return float(playback.clearances_mm[:, columns].min())
