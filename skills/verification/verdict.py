"""The verdict on a playback: feasible or not, by gates on its figures at every sample.

    Playback, Trajectory --figures_of--> Figures --first_failure--> Failure, or None
    Playback, Trajectory --judge--> PlaybackReport

The figures are arrays with one row per sample, which are gated and reported. A gate is one number per sample that must
not exceed its limit, or must not fall below it. NaN passes no gate.

`judge` compares the simulator's measurements (`Playback`) with the intended motion (`Trajectory`), and with what was
asked if its deviations from that are given (`skills.verification.intent`). All of this is ours; the paper played its
plans on the robot.

A feasible verdict means that the geometry is right and free. In free space the servo's error and efforts depend on the
simulator's gains and masses, not on the robot's, so they guard against mistakes of ours and in contact; they are no
evidence of the hardware's accuracy. PSM_M is in the kinematic pass alone.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Flags, Floats, frozen
from skills.errors import BadInput
from skills.fields import Count, Figure, Sha256, schema
from skills.kinematics import (
    CANNULA_MM,
    INSERTION,
    JOINTS,
    UNITS,
    InstrumentConstants,
    angle_between,
    instrument_of,
    joint_margins,
    matrix_of,
)
from skills.planning.handoff import HOLDING_RAD
from skills.planning.motion_laws import A2, PHASES, TRANSFER
from skills.planning.trajectory import Trajectory, joint_ratios
from skills.verification.bodies import BodiesClearance, BodiesReport, bodies_clearance
from skills.verification.clearance import (
    FINGER_REACH_MM,
    Bounds,
    needle_to_pad_mm,
    openings,
    psm_m_poses,
    stands_from,
)
from skills.verification.intent import LIMITS, Comparison, Mismatch
from skills.verification.playback import CLEARANCE_SEEN_MM, MEANS, PAD, PSM_A, PSM_M, Playback
from skills.verification.scene_clearance import SceneClearance

SCENE = "clearance of the scene"  # the quantity of a failure beside tissue or an obstacle


@dataclass(frozen=True, eq=False)
class ArmSamples:
    """The joints of one arm, each array of shape (T, 6).

    `joints` are in rad and mm, `margins` are parts of the joints' ranges, `speed` and `acceleration` are parts of their
    limits.
    """

    name: str
    tool: InstrumentConstants
    joints: Floats
    margins: Floats
    speed: Floats
    acceleration: Floats


@dataclass(frozen=True, eq=False)
class Figures:
    """The figures that are judged.

    Attributes:
        arms: PSM_A with its measured joints, and PSM_M with its commanded joints if it is in the scene.
        fk_mm: Distance of the simulator's tip from the closed form, PSM_A, shape (T,).
        fk_deg: The same for its rotation.
        psm_m_fk_mm: The same for PSM_M's tip, shape (T,); 0 where it was not measured or is not in the scene.
        ticks: Time since the previous sample, in sampling periods, shape (T,); 1 at the first.
        effort: The largest of the motors' efforts, as a part of its limit, shape (T,).
        apart: Lower bounds on the distances of each pair of links: measured, or bounded from measurements.
        needle_mm: Distance of the needle from the pad at the samples of `Playback.looked_at`, shape (C,).
    """

    arms: tuple[ArmSamples, ...]
    fk_mm: Floats
    fk_deg: Floats
    psm_m_fk_mm: Floats
    ticks: Floats
    effort: Floats
    apart: Bounds
    needle_mm: Floats


def figures_of(playback: Playback, trajectory: Trajectory) -> Figures:
    """Return the figures of a playback.

    Args:
        playback: The measurements.
        trajectory: The trajectory that was played, with as many samples.
    """
    arms = [_arm(PSM_A, playback.joints, trajectory.instrument, trajectory.rate_hz)]
    m, looked_at, count = trajectory.psm_m, playback.looked_at, len(trajectory)
    psm_m_fk_mm = np.zeros(count)
    if m is not None and playback.psm_m_tip_mm is not None:
        arms.append(_arm(PSM_M, m.joints, m.instrument, trajectory.rate_hz))
        psm_m_fk_mm[looked_at] = np.linalg.norm(playback.psm_m_tip_mm - psm_m_poses(trajectory, looked_at)[0], axis=1)
    moving = {PSM_A: (trajectory.joints, trajectory.instrument)}
    if m is not None:
        moving[PSM_M] = (m.joints, m.instrument)
    return Figures(
        arms=tuple(arms),
        fk_mm=np.linalg.norm(playback.tip_mm - trajectory.tip_mm, axis=1),
        fk_deg=_rotation_error_deg(playback.rotation_xyzw, trajectory.rotation_xyzw),
        psm_m_fk_mm=psm_m_fk_mm,
        ticks=np.append(1.0, np.diff(trajectory.stamps_s) * trajectory.rate_hz),
        effort=(np.abs(playback.efforts) / np.array(instrument_of(trajectory.instrument).arm.effort)).max(axis=1),
        apart=replace(
            Bounds.of(moving, playback.link_pairs, looked_at, playback.clearances_mm),
            opened_mm=FINGER_REACH_MM * (openings(trajectory) - HOLDING_RAD),  # the simulator's fingers hold a needle
        ),
        needle_mm=needle_to_pad_mm(trajectory, looked_at, playback.pad_mm),
    )


def _arm(name: str, joints: Floats, instrument: str, rate_hz: float) -> ArmSamples:
    """Return an arm's figures, all samples taken as one pass: the pose must not jump between passes either."""
    tool = instrument_of(instrument)
    speed, acceleration = joint_ratios(joints, np.zeros(len(joints), np.int64), rate_hz, instrument)
    margins = joint_margins(joints, instrument) / (tool.upper - tool.lower)
    return ArmSamples(name, tool, joints, margins, speed, acceleration)


def _rotation_error_deg(measured: Floats, meant: Floats) -> Floats:
    """Return the angle between quaternions, shape (T,); NaN where the measured one is not a unit quaternion."""
    length = np.linalg.norm(measured, axis=1)
    sound = np.abs(length - 1.0) < 1e-6
    safe = np.where(sound[:, None], measured, meant)
    angle = np.degrees(angle_between(matrix_of(safe), matrix_of(meant)))
    return np.where(sound, angle, np.nan)


@schema
@dataclass(frozen=True)
class Limits:
    """The limits of the verdict. All of them are ours; each has its reason.

    Attributes:
        fk_mm: Greatest distance of the simulator's tip from the closed form; they agree to 1e-4 mm when the URDF is
            right.
        fk_deg: The same for the rotation.
        joint_margin: Least distance of every joint from its limits, as a part of its range.
        insertion_mm: Least insertion: with less the wrist is inside the cannula. On an arm of the other generation than
            the tool's the insertion that puts the wrist at the same depth counts.
        speed_ratio: Greatest joint speed as a part of its limit; a millionth is left for round-off.
        acceleration_ratio: Greatest joint acceleration as a part of its limit; the same.
        tracking_mm: Greatest servo error; the simulator's own is under 0.001 mm, and in contact it is millimetres.
        goal_mm: Greatest servo error at the end of each pass.
        alignment_deg: Greatest error of the jaw's rotation at the end of each pass.
        clearance_pad_mm: Least distance of either arm from the pad: the error of a calibrated arm (0.65 mm) and half as
            much again. Below 0 an arm may press into it, up to `contact_n`.
        clearance_psm_m_mm: Least distance between the arms; their fingers may be nearer at the hand-off itself.
        clearance_bodies_mm: Least distance between the arms' outer bodies, which are larger than the arms: a step of
            the registration between the two bases.
        contact_n: Greatest force between arm and pad: a light touch. The motors could press with twenty times as much.
        contact_effort: Greatest effort of any motor while in contact, as a part of its limit: a motor at its limit no
            longer holds the arm in its commanded place.
    """

    fk_mm: float = 0.01
    fk_deg: float = 0.01
    joint_margin: float = 0.0
    insertion_mm: float = CANNULA_MM
    speed_ratio: float = 1.000001
    acceleration_ratio: float = 1.000001
    tracking_mm: float = 0.1
    goal_mm: float = 0.05
    alignment_deg: float = 0.1
    clearance_pad_mm: float = 1.0
    clearance_psm_m_mm: float = 0.5
    clearance_bodies_mm: float = 2.0
    contact_n: float = 1.0
    contact_effort: float = 0.95


@schema
@dataclass(frozen=True)
class Failure:
    """The first sample that is not allowed.

    `quantity` names PSM_M if the sample fails because of it, and the links that are too near.
    """

    sample: Count
    pass_index: Count
    phase: Count
    stamp_s: float
    quantity: str
    value: Figure
    limit: float
    unit: str

    def __str__(self) -> str:
        """Return the failure as a sentence."""
        return (
            f"Pass {self.pass_index}, {PHASES[self.phase]}, sample {self.sample} ({self.stamp_s:.3f} s): "
            f"{self.quantity} is {self.value:.4g} {self.unit}, the limit is {self.limit:.4g}."
        )


@dataclass(frozen=True, eq=False)
class _Gate:
    """One quantity along the trajectory and its limit: the greatest value allowed, or with `at_least` the least."""

    quantity: str
    unit: str
    values: Floats
    limit: float
    at_least: bool = False

    def broken(self) -> int | None:
        """Return the index of the first sample that does not pass, or None; NaN does not pass."""
        passes = self.values >= self.limit if self.at_least else self.values <= self.limit
        return None if passes.all() else int(np.argmin(passes))


def first_failure(
    figures: Figures,
    playback: Playback,
    trajectory: Trajectory,
    limits: Limits,
    beside: SceneClearance | None = None,
    outer: BodiesClearance | None = None,
    intent: Comparison | None = None,
) -> Failure | None:
    """Return the earliest sample at which a gate is broken; of several gates broken there, the first listed.

    Args:
        figures: The figures of the playback.
        playback: The measurements.
        trajectory: The trajectory that was played.
        limits: The limits of the gates.
        beside: The motion's distances from a scene; None: they are no gate.
        outer: The distances of the arms' outer bodies; None: they are no gate.
        intent: The motion's deviations from what was asked; None: they are no gate.

    Returns:
        The failure, or None if every sample passes every gate.
    """
    gates = [*_gates(figures, playback, trajectory, limits)]
    if outer is not None:
        pair = "outer bodies" if outer.first is None else str(outer.first)
        gates.append(_Gate(f"clearance of {pair}", "mm", outer.at_least_mm, outer.report.limit_mm, at_least=True))
    if beside is not None:
        gates.append(_Gate(SCENE, "mm", beside.at_least_mm, beside.report.limit_mm, at_least=True))
        gates.append(_Gate("distance of the needle from the tissue", "mm", beside.needle_mm, 0.0, at_least=True))
    if intent is not None:
        gates += [_Gate(kind, LIMITS[kind][0], values, LIMITS[kind][1]) for kind, values in intent.values.items()]
    broken = [(sample, gate) for gate in gates if (sample := gate.broken()) is not None]
    if not broken:
        return None
    sample, gate = min(broken, key=lambda one: one[0])
    return Failure(
        sample=sample,
        pass_index=int(trajectory.pass_index[sample]),
        phase=int(trajectory.phase[sample]),
        stamp_s=float(trajectory.stamps_s[sample]),
        quantity=gate.quantity,
        value=float(gate.values[sample]),
        limit=gate.limit,
        unit=gate.unit,
    )


def _gates(figures: Figures, playback: Playback, trajectory: Trajectory, limits: Limits) -> Iterator[_Gate]:
    yield _Gate("time since the sample before", "samples", figures.ticks, 1 - 1e-6, at_least=True)
    for arm in figures.arms:
        yield from _joint_gates(arm, limits)
    yield _Gate("tip off the closed form", "mm", figures.fk_mm, limits.fk_mm)
    yield _Gate("rotation off the closed form", "deg", figures.fk_deg, limits.fk_deg)
    yield _Gate("PSM_M's tip off the closed form", "mm", figures.psm_m_fk_mm, limits.fk_mm)
    shaft = np.zeros(len(trajectory))
    shaft[playback.looked_at] = playback.shaft_off_mm
    yield _Gate("shaft off the remote centre", "mm", shaft, limits.fk_mm)
    yield from _clearance_gates(figures, playback, trajectory, limits)
    touches = ~(playback.contact_n <= 0)  # negated, so that NaN counts as contact
    yield _Gate("force between arm and pad", "N", playback.contact_n, limits.contact_n)
    yield _Gate("effort in contact", "of its limit", np.where(touches, figures.effort, 0.0), limits.contact_effort)
    # The simulator's motors give no more than their limit, so more points to a mistake of ours.
    yield _Gate("effort", "of its limit", figures.effort, 1.000001)
    yield _Gate("servo error", "mm", playback.tracking_mm, limits.tracking_mm)
    at_end = np.isin(np.arange(len(trajectory)), trajectory.last_samples)
    yield _Gate("servo error at the goal", "mm", np.where(at_end, playback.tracking_mm, 0.0), limits.goal_mm)
    yield _Gate("alignment error", "deg", np.where(at_end, figures.fk_deg, 0.0), limits.alignment_deg)


def _joint_gates(arm: ArmSamples, limits: Limits) -> Iterator[_Gate]:
    whose = "" if arm.name == PSM_A else f"{arm.name}'s "
    spare = limits.joint_margin * (arm.tool.upper - arm.tool.lower)
    for joint, name in enumerate(JOINTS):
        values = arm.joints[:, joint]
        yield _Gate(f"{whose}{name}", UNITS[joint], values, float(arm.tool.upper[joint] - spare[joint]) + 1e-9)
        yield _Gate(f"{whose}{name}", UNITS[joint], values, float(arm.tool.lower[joint] + spare[joint]) - 1e-9, True)
    least_mm = limits.insertion_mm + arm.tool.cannula_mm - CANNULA_MM
    yield _Gate(f"{whose}insertion out of the cannula", "mm", arm.joints[:, INSERTION], least_mm, True)
    for joint, name in enumerate(JOINTS):
        yield _Gate(f"speed of {whose}{name}", "of its limit", arm.speed[:, joint], limits.speed_ratio)
        accelerations = arm.acceleration[:, joint]
        yield _Gate(f"acceleration of {whose}{name}", "of its limit", accelerations, limits.acceleration_ratio)


def _clearance_gates(figures: Figures, playback: Playback, trajectory: Trajectory, limits: Limits) -> Iterator[_Gate]:
    # The pair with the least measured distance comes first, because the first gate listed is reported; NaN before all.
    nearest = np.nan_to_num(playback.clearances_mm, nan=-np.inf).min(axis=0)
    for column in np.argsort(nearest, kind="stable").tolist():
        pair, apart = playback.link_pairs[column], figures.apart.at_least_mm(column)
        limit = limits.clearance_pad_mm if pair.other == PAD else limits.clearance_psm_m_mm
        if pair.may_touch:
            excused = _handing_over(trajectory, apart, limit) & ~np.isnan(apart)
            apart = np.where(excused, np.inf, apart)
        yield _Gate(f"clearance of {pair}", "mm", apart, limit, at_least=True)


def _handing_over(trajectory: Trajectory, apart: Floats, limit: float) -> Flags:
    """Mark the samples, shape (T,), at which fingers of both arms may touch: the hand-off, and until they part.

    The hand-off is the end of A2, where both arms stand and only the jaws move. In the transfer after it the fingers
    may be near each other until they are `limit` apart for the first time.
    """
    may = np.zeros(len(trajectory), dtype=bool)
    for end in trajectory.last_samples[trajectory.phase[trajectory.last_samples] == A2]:
        may[stands_from(trajectory, int(end)) : end + 1] = True
        parted = (trajectory.phase[end + 1 :] != TRANSFER) | ~(apart[end + 1 :] < limit)
        may[end : end + 1 + int(np.argmax(np.append(parted, True)))] = True
    return may


# ---- the verdict ---------------------------------------------------------------------------------------------------


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
    instrument: InstrumentConstants
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
        goal_error_mm: Distance of the servo's tip from the target.
        n_to_a_m_deg: Angle between PSM_A's hinge axis n and PSM_M's approach a_M; None if that is not known.
        a_to_a_m_deg: Angle between PSM_A's approach and a_M: the paper wants a right angle.
    """

    sample: Count
    turn_deg: Figure
    alignment_error_deg: Figure
    goal_error_mm: Figure
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
    account. `peak_effort_ratio` is over the complete servo pass, `peak_contact_effort_ratio` over the samples in which
    the arm touches the pad. `bodies` compares the arms' outer bodies; null: not judged, as in older verdicts. `intent`
    has the greatest deviation of each kind from what was asked; null: not compared with it, as in those. `means` has
    for each check the means by which it is decided; null in older verdicts.
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
    tracking_max_mm: Figure
    tracking_rms_mm: Figure
    goal_error_mm: Figure
    peak_contact_n: Figure
    peak_effort_ratio: Figure
    peak_contact_effort_ratio: Figure
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
    bodies: BodiesReport | None = field(default=None, kw_only=True)
    intent: tuple[Mismatch, ...] | None = field(default=None, kw_only=True)
    means: Mapping[str, str] | None = field(default=None, kw_only=True)


def judge(
    playback: Playback,
    trajectory: Trajectory,
    settings: Limits | None = None,
    *,
    approach_m: ArrayLike | None = None,
    beside: SceneClearance | None = None,
    pad_is_tissue: bool = True,
    intent: Comparison | None = None,
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
    failure = first_failure(figures, playback, trajectory, gated, beside, outer, intent)
    psm_a = figures.arms[0]
    with_m = trajectory.psm_m is not None
    touching = figures.effort[~(playback.contact_n <= 0)]  # negated, so that NaN counts as contact
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
        bodies=outer.report,
        intent=None if intent is None else intent.deviations,
        means=dict(MEANS),
    )


def _check_same(playback: Playback, trajectory: Trajectory) -> None:
    if len(playback) != len(trajectory):
        raise BadInput(
            f"The playback has {len(playback)} samples, the trajectory {len(trajectory)}; play this trajectory.",
            playback=len(playback),
            trajectory=len(trajectory),
        )
    if (playback.psm_m_tip_mm is None) != (trajectory.psm_m is None):
        raise BadInput("PSM_M is in only one of playback and trajectory; play this trajectory.")


def _arm_report(arm: ArmSamples) -> ArmFigures:
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
    last = trajectory.last_samples
    jaws = matrix_of(trajectory.rotation_xyzw)
    approaches = _approaches(trajectory, approach_m)
    ends = []
    for number, end in enumerate(last.tolist()):
        mine = np.flatnonzero((trajectory.pass_index == number) & (trajectory.phase != A2))
        before = mine[-1] if len(mine) else end  # the jaw as it is held during A1
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
    columns = [k for k, pair in enumerate(playback.link_pairs) if pair.other == other]
    return float(playback.clearances_mm[:, columns].min())


def _lowest(margins: Floats) -> Floats:
    """Return each joint's least margin, with NaN as the least of all."""
    return np.asarray(np.where(np.isnan(margins), -np.inf, margins).min(axis=0))
