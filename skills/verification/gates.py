"""The gates of a playback: its figures at every sample, and the first that breaks its limit.

    Playback, Trajectory --figures_of--> Figures --first_failure--> Failure, or None

The figures are arrays with one row per sample, which are gated and reported. A gate is one number per sample that must
not exceed its limit, or must not fall below it. NaN passes no gate. All of this is ours.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from skills import kinematics
from skills.arrays import Flags, Floats
from skills.fields import Count, Figure, schema
from skills.planning.handoff import HOLDING_RAD
from skills.planning.motion_laws import A2, PHASES, TRANSFER
from skills.planning.trajectory import PSM_A, PSM_M, Trajectory, joint_ratios, stands_from
from skills.verification import clearance
from skills.verification.bodies import BodiesClearance
from skills.verification.deviations import LIMITS, Deviations
from skills.verification.playback import PAD, Playback
from skills.verification.scene_clearance import SceneClearance

TOLERANCE = 1e-9  # in the unit of a figure: two processors differ by less, so both accept or one is too strict
ROUND_OFF = 2e-9  # rad and mm: a joint may be as far beyond its limit as `inverse` allows, 1e-9
# One count of the encoders of a PSM, rad and mm, from the gear ratios in the configuration generator of the dVRK's
# controller: 14400 x 56.5 counts a turn (yaw, pitch), 14400 x 336.6 for 360 x 17.4533 mm, 4000 x 11.71 a turn (wrist).
COUNT = np.array([7.72e-6, 7.72e-6, 1.296e-3, *[1.341e-4] * 3])
WAVE_S = 0.01  # ours: a wave of 50 Hz turns from one such step to the next
NEEDLE_TO_ARM = "distance of the needle from the other arm"
TIP_WAYS = ("path off the policy's cells", "path off the recording")  # of the deviations, those of the tip's way
SCENE = "clearance of the scene"  # the quantity of a failure beside tissue or an obstacle


@dataclass(frozen=True, eq=False)
class ArmSamples:
    """The joints of one arm, each array of shape (T, 6).

    `joints` are in rad and mm, `margins` are parts of the joints' ranges, `speed` and `acceleration` are parts of their
    limits; `jerk` is the change of acceleration in `WAVE_S`, as a part of the same limit. `vibration` is the amplitude
    of a wave of 50 Hz in five samples `WAVE_S` apart: a 16th of their fourth difference, which is 0 of every cubic,
    in counts of the encoder, at the last of the five.
    """

    name: str
    tool: kinematics.InstrumentConstants
    joints: Floats
    margins: Floats
    speed: Floats
    acceleration: Floats
    jerk: Floats
    vibration: Floats


@dataclass(frozen=True, eq=False)
class Figures:
    """The figures that are judged.

    Attributes:
        arms: PSM_A with its measured joints, and PSM_M with its commanded joints if it is in the scene.
        fk_mm: Distance of the simulator's tip from the closed form, PSM_A, shape (T,).
        fk_deg: The same for its rotation.
        psm_m_fk_mm: The same for PSM_M's tip, shape (T,); 0 where it was not measured or is not in the scene.
        ticks: Time since the previous sample, in sampling periods, shape (T,); 1 at the first.
        unit: How far quaternions of the motion are from length 1, shape (T,); that of PSM_M's base is at the first.
        apart: Lower bounds on the distances of each pair of links: measured, or bounded from measurements.
        needle_mm: Distance of the needle from the pad at the samples of `Playback.looked_at`, shape (C,).
    """

    arms: tuple[ArmSamples, ...]
    fk_mm: Floats
    fk_deg: Floats
    psm_m_fk_mm: Floats
    ticks: Floats
    unit: Floats
    apart: clearance.Bounds
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
        psm_m_fk_mm[looked_at] = np.linalg.norm(
            playback.psm_m_tip_mm - clearance.psm_m_poses(trajectory, looked_at)[0], axis=1
        )
    moving = {arm.name: (arm.joints, arm.instrument) for arm in trajectory.arms}
    return Figures(
        arms=tuple(arms),
        fk_mm=np.linalg.norm(playback.tip_mm - trajectory.tip_mm, axis=1),
        fk_deg=_rotation_error_deg(playback.rotation_xyzw, trajectory.rotation_xyzw),
        psm_m_fk_mm=psm_m_fk_mm,
        ticks=np.append(1.0, np.diff(trajectory.stamps_s) * trajectory.rate_hz),
        unit=_off_unit(trajectory),
        apart=replace(
            clearance.Bounds.of(moving, playback.link_pairs, looked_at, playback.clearances_mm),
            # the simulator's fingers hold a needle
            opened_mm=clearance.FINGER_REACH_MM * (clearance.openings(trajectory.arms[0]) - HOLDING_RAD),
        ),
        needle_mm=clearance.needle_to_pad_mm(trajectory, looked_at, playback.pad_mm),
    )


def _arm(name: str, joints: Floats, instrument: str, rate_hz: float) -> ArmSamples:
    """Return an arm's figures, all samples taken as one pass: the pose must not jump between passes either."""
    tool = kinematics.instrument_of(instrument)
    speed, acceleration = joint_ratios(joints, np.zeros(len(joints), np.int64), rate_hz, instrument)
    margins = kinematics.joint_margins(joints, instrument) / (tool.upper - tool.lower)
    step = max(1, round(WAVE_S * rate_hz))
    third, fourth = (_differences(joints, step, order) for order in (3, 4))
    jerk = third * (rate_hz / step) ** 3 * WAVE_S / tool.acceleration[:6]
    return ArmSamples(name, tool, joints, margins, speed, acceleration, jerk, fourth / 16 / COUNT)


def _differences(joints: Floats, step: int, order: int) -> Floats:
    """Return the absolute differences of joints so many samples apart, (T, 6), each at its last sample; 0 before."""
    found = joints
    for _ in range(order):
        found = found[step:] - found[:-step]
    return np.concatenate([np.zeros((len(joints) - len(found), 6)), np.abs(found)])


def _off_unit(trajectory: Trajectory) -> Floats:
    """Return how far the lengths of a motion's quaternions are from 1, shape (T,)."""
    off = np.abs(np.linalg.norm(trajectory.rotation_xyzw, axis=1) - 1.0)
    if trajectory.psm_m is not None:
        off[0] = np.maximum(off[0], abs(np.linalg.norm(trajectory.psm_m.base_xyzw[None], axis=1)[0] - 1.0))
    return np.asarray(off)


def _rotation_error_deg(measured: Floats, meant: Floats) -> Floats:
    """Return the angle between quaternions, shape (T,); NaN where the measured one is not a unit quaternion."""
    length = np.linalg.norm(measured, axis=1)
    sound = np.abs(length - 1.0) < 1e-6
    safe = np.where(sound[:, None], measured, meant)
    angle = np.degrees(kinematics.angle_between(kinematics.matrix_of(safe), kinematics.matrix_of(meant)))
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
        jerk_ratio: Greatest change of a joint's acceleration in 0.01 s, as a part of its limit. A hand that is averaged
            over a quarter of a second by a Hann window changes by 16 times its own acceleration per second, 0.16, and
            what is averaged may be twice what is left.
        vibration_counts: Greatest amplitude of a vibration of 50 Hz, in counts of the joint's encoder, of which an arm
            sees no part.
        alignment_deg: Greatest error of the jaw's rotation at the end of each pass.
        clearance_pad_mm: Least distance of either arm from the pad: the error of a calibrated arm (0.65 mm) and half as
            much again. Below 0 an arm may press into it, up to `contact_n`.
        clearance_psm_m_mm: Least distance between the arms; their fingers may be nearer at the hand-off itself.
        clearance_bodies_mm: Least distance between the arms' outer bodies, which are larger than the arms: a step of
            the registration between the two bases.
        contact_n: Greatest force of pad and PSM_M on PSM_A as it executes the motion: a light touch. The motors could
            press with twenty times as much.
    """

    fk_mm: float = 0.01
    fk_deg: float = 0.01
    joint_margin: float = 0.0
    insertion_mm: float = kinematics.CANNULA_MM
    speed_ratio: float = 1.000001
    acceleration_ratio: float = 1.000001
    jerk_ratio: float = 0.32
    vibration_counts: float = 1.0
    alignment_deg: float = 0.1
    clearance_pad_mm: float = 1.0
    clearance_psm_m_mm: float = 0.5
    clearance_bodies_mm: float = 2.0
    contact_n: float = 1.0


@schema
@dataclass(frozen=True)
class Failure:
    """The first sample that is not allowed, and the worst one of the same quantity.

    `quantity` names PSM_M if the sample fails because of it, and the links that are too near. `value` is that of the
    first sample, `worst` the furthest from the limit of all, at `worst_s`; null where one is no number.
    """

    sample: Count
    pass_index: Count
    phase: Count
    stamp_s: float
    quantity: str
    value: Figure
    limit: float
    unit: str
    worst: Figure
    worst_s: float

    def __str__(self) -> str:
        """Return the failure as a sentence, with its worst value if that is another."""
        value, worst = ("no number" if one is None else f"{one:.4g} {self.unit}" for one in (self.value, self.worst))
        at_worst = "" if worst == value else f"; at worst it is {worst}, at {self.worst_s:.3f} s"
        return (
            f"Pass {self.pass_index}, {PHASES[self.phase]}, sample {self.sample} ({self.stamp_s:.3f} s): "
            f"{self.quantity} is {value}, the limit is {self.limit:.4g}{at_worst}."
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
        """Return the index of the first sample that does not pass, or None; NaN, or within `TOLERANCE`, does not."""
        passes = self._beyond >= TOLERANCE
        return None if passes.all() else int(np.argmin(passes))

    def worst(self) -> int:
        """Return the index of the sample that is furthest from the limit; NaN before all."""
        return int(np.nan_to_num(self._beyond, nan=-np.inf).argmin())

    @property
    def _beyond(self) -> Floats:
        return self.values - self.limit if self.at_least else self.limit - self.values


def first_failure(
    figures: Figures,
    playback: Playback,
    trajectory: Trajectory,
    limits: Limits,
    beside: SceneClearance | None = None,
    outer: BodiesClearance | None = None,
    intent: Deviations | None = None,
    needle_mm: Floats | None = None,
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
        needle_mm: The needle's distance from the arm that does not hold it, shape (T,); None: it is no gate.

    Returns:
        The failure, or None if every sample passes every gate.
    """
    gates = [*_gates(figures, playback, trajectory, limits), *_gates_beside(beside, outer)]
    if needle_mm is not None:
        gates.append(_Gate(NEEDLE_TO_ARM, "mm", needle_mm, limits.clearance_psm_m_mm, at_least=True))
    if intent is not None:
        gates += [_Gate(kind, LIMITS[kind][0], values, LIMITS[kind][1]) for kind, values in intent.values.items()]
    return _earliest(gates, trajectory)


def first_executed_failure(
    joints: Floats,
    trajectory: Trajectory,
    limits: Limits,
    errors: Mapping[str, tuple[str, Floats, float]] | None = None,
    beside: SceneClearance | None = None,
    outer: BodiesClearance | None = None,
    intent: Deviations | None = None,
) -> Failure | None:
    """Return the earliest sample at which an executed motion is beyond a limit that allows for errors of an arm.

    These are the limits of joints, cannula and clearances, of the tip's way along cells and recording, and those that a
    laboratory sets. Limits for poses that a plan states exactly, 0.05 mm and 0.1 degrees, no arm keeps.

    Args:
        joints: The joints that PSM_A executes, rad and mm, shape (T, 6).
        trajectory: The planned motion.
        limits: The limits of the gates.
        errors: Further quantities by name: their unit, their values, shape (T,), and the greatest that is allowed.
        beside: The executed motion's distances from a scene; None: they are no gate.
        outer: The distances of the arms' outer bodies in it; None: they are no gate.
        intent: Its deviations from what was asked; None: they are no gate.

    Returns:
        The failure, or None if every sample passes every gate.
    """
    gates = [*_limit_gates(PSM_A, joints, kinematics.instrument_of(trajectory.instrument), limits)]
    gates += [_Gate(name, *one) for name, one in (errors or {}).items()]
    gates += _gates_beside(beside, outer)
    if intent is not None:
        gates += [_Gate(kind, LIMITS[kind][0], intent.values[kind], LIMITS[kind][1]) for kind in TIP_WAYS]
    return _earliest(gates, trajectory)


def _earliest(gates: list[_Gate], trajectory: Trajectory) -> Failure | None:
    """Return the earliest sample at which a gate is broken, with the first gate listed."""
    broken = [(sample, gate) for gate in gates if (sample := gate.broken()) is not None]
    if not broken:
        return None
    sample, gate = min(broken, key=lambda one: one[0])
    worst = gate.worst()
    return Failure(
        sample=sample,
        pass_index=int(trajectory.pass_index[sample]),
        phase=int(trajectory.phase[sample]),
        stamp_s=float(trajectory.stamps_s[sample]),
        quantity=gate.quantity,
        value=float(gate.values[sample]),
        limit=gate.limit,
        unit=gate.unit,
        worst=float(gate.values[worst]),
        worst_s=float(trajectory.stamps_s[worst]),
    )


def _gates_beside(beside: SceneClearance | None, outer: BodiesClearance | None) -> Iterator[_Gate]:
    """Yield the gates of distances that were found in closed form."""
    if outer is not None:
        pair = "outer bodies" if outer.first is None else str(outer.first)
        yield _Gate(f"clearance of {pair}", "mm", outer.at_least_mm, outer.report.limit_mm, at_least=True)
    if beside is not None:
        yield _Gate(SCENE, "mm", beside.at_least_mm, beside.report.limit_mm, at_least=True)
        yield _Gate("distance of the needle from the tissue", "mm", beside.needle_mm, 0.0, at_least=True)


def _gates(figures: Figures, playback: Playback, trajectory: Trajectory, limits: Limits) -> Iterator[_Gate]:
    """Yield the gates of a playback; of several that are broken at one sample, the first is reported."""
    yield _Gate("time since the sample before", "samples", figures.ticks, 1 - 1e-6, at_least=True)
    yield _Gate("length of a quaternion off 1", "", figures.unit, 1e-6)
    for arm in figures.arms:
        yield from _joint_gates(arm, limits)
    yield _Gate("tip off the closed form", "mm", figures.fk_mm, limits.fk_mm)
    yield _Gate("rotation off the closed form", "deg", figures.fk_deg, limits.fk_deg)
    yield _Gate("PSM_M's tip off the closed form", "mm", figures.psm_m_fk_mm, limits.fk_mm)
    shaft = np.zeros(len(trajectory))
    shaft[playback.looked_at] = playback.shaft_off_mm
    yield _Gate("shaft off the remote centre", "mm", shaft, limits.fk_mm)
    yield from _clearance_gates(figures, playback, trajectory, limits)
    if playback.contact_n is not None:
        yield _Gate("force of contact", "N", playback.contact_n, limits.contact_n)
    at_end = np.isin(np.arange(len(trajectory)), trajectory.last_samples)
    yield _Gate("alignment error", "deg", np.where(at_end, figures.fk_deg, 0.0), limits.alignment_deg)


def _joint_gates(arm: ArmSamples, limits: Limits) -> Iterator[_Gate]:
    """Yield the gates of one arm's joints."""
    yield from _limit_gates(arm.name, arm.joints, arm.tool, limits)
    prefix = _prefix(arm.name)
    for joint, name in enumerate(kinematics.JOINTS):
        yield _Gate(f"speed of {prefix}{name}", "of its limit", arm.speed[:, joint], limits.speed_ratio)
        accelerations = arm.acceleration[:, joint]
        yield _Gate(f"acceleration of {prefix}{name}", "of its limit", accelerations, limits.acceleration_ratio)
        yield _Gate(f"jerk of {prefix}{name}", "of the acceleration", arm.jerk[:, joint], limits.jerk_ratio)
        yield _Gate(f"vibration of {prefix}{name}", "encoder counts", arm.vibration[:, joint], limits.vibration_counts)


def _prefix(name: str) -> str:
    return "" if name == PSM_A else f"{name}'s "


def _limit_gates(name: str, joints: Floats, tool: kinematics.InstrumentConstants, limits: Limits) -> Iterator[_Gate]:
    """Yield the gates of one arm's joints against their limits and the cannula."""
    spare = limits.joint_margin * (tool.upper - tool.lower) - ROUND_OFF
    upper, lower, prefix = tool.upper - spare, tool.lower + spare, _prefix(name)
    for joint, called in enumerate(kinematics.JOINTS):
        values = joints[:, joint]
        yield _Gate(f"{prefix}{called}", kinematics.UNITS[joint], values, float(upper[joint]))
        yield _Gate(f"{prefix}{called}", kinematics.UNITS[joint], values, float(lower[joint]), at_least=True)
    least_mm = limits.insertion_mm + tool.cannula_mm - kinematics.CANNULA_MM
    yield _Gate(f"{prefix}insertion out of the cannula", "mm", joints[:, kinematics.INSERTION], least_mm, True)


def _clearance_gates(figures: Figures, playback: Playback, trajectory: Trajectory, limits: Limits) -> Iterator[_Gate]:
    """Yield the gates of the distances between links."""
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
