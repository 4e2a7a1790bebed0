"""Dynamics of a PSM's joints: the motion that an arm executes of a planned one, as a range.

    planned joints, stamps, Servo --predict--> Prediction: executed joints, efforts, error of the tip with its range

A joint has a motor with effort e, limited, and the controller holds each setpoint q_s, v_s until the next one arrives:

    I a = e - Fv v - f - load(q)        e = P (q_s - q) + D (v_s - v) + compensation

f is dry friction: it holds the joint while less than Fc is needed for that, and is Fc against the motion otherwise. The
link follows its motor with a play. So the error of a joint is the sum of its *droop* -(load - compensation) / P, its
*stick* -f / P and the play, and its *lag*, the rest: inertia, viscous friction, setpoints that are old or without a
speed, an effort at its limit.

Lengths are metres inside of this module, so that gains have their published units. The default loads, inertias and
frictions are a linear fit of ours to one published data set. In a published recording of another arm in motion they
tell little more than no prediction does, where a servo that is fitted to that arm tells much (docs/execution.md).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import isfinite, radians
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from skills.arithmetic import arcsin, cos, sin
from skills.arrays import Floats, Ints, frozen
from skills.compiled import compiled, inner
from skills.errors import BadInput, BadSettings
from skills.fields import Six, exact, schema
from skills.kinematics import DEFAULT_INSTRUMENT, INSERTION, WRIST_MM, axes_of, forward, instrument_of

NOT_VALIDATED = (
    "Not validated on hardware: what is not stated of gains, loads and frictions is published, of other arms."
)
_UNITS = np.array([1.0, 1.0, 1e-3, 1.0, 1.0, 1.0])  # rad and m of rad and mm
# Loads of yaw, pitch and insertion (Nm, Nm, N) as factors of 1, sin q1, cos q1, sin q2 cos q1, cos q2 cos q1,
# q3 sin q1, q3 sin q2 cos q1 and q3: least squares of ours on the measured efforts of dvrk_dynamics_identification
# (WPI-AIM, 5999 rows at 200 Hz), together with the inertias and frictions of these joints.
_LOADS = np.array(
    [
        [-7.68, 0.79, 8.28, 0.22, -0.38, -10.92, -2.80, -1.25],
        [-3.85, -0.67, 4.13, 0.47, -0.59, -1.75, -0.34, -0.02],
        [-5.22, -1.54, 4.27, -0.13, 0.31, 0.16, -0.16, 3.45],
    ]
)
Ends = tuple[Six, Six]  # the lower and the upper end of a range, for each joint


@exact
@schema
@dataclass(frozen=True)
class Servo:
    """How a laboratory drives its arm, what is known of the arm, and what error it allows; per joint rad, m, Nm, N.

    The ranges of yaw, pitch and insertion are the fit and a fifth either way (ours: of one arm): 0.187, 0.203, 0.898
    for I, 0.101, 0.204, 1.78 for Fv and 0.056, 0.075, 0.411 for Fc.

    Attributes:
        velocities: Whether setpoints have velocities (`servo_jp`); without, as by `servo_cp`, D brakes all motion.
        gravity_compensated: Whether the controller adds the load that it expects.
        rate_hz: Setpoints per second; the dVRK's topics have 100 to 200 by default.
        delay_s: Age of a setpoint as it arrives. Ours: one period at 200 Hz.
        stiffness: P. Source: share/ of sawIntuitiveResearchKit, like D.
        damping: D.
        inertia: I. Wrist: ours, a rotor of 3e-7 to 3e-6 kg m2 and a gear of 30.
        viscous: Fv. Wrist: ours, up to a ninth of D, as none is published.
        coulomb: Fc. Wrist: ours, 2 to 25 % of the greatest effort of wrist yaw, as none is published.
        play: Half of the play between motor and link. Ours: none to 1 degree in roll and wrist, a third of the wrist
            error that is taken for an arm that is not calibrated.
        load: The load as a part of the fitted one. Ours: a fifth either way, as the fit is of one arm.
        compensation: The part of its load that is compensated, where it is. Ours: a tenth either way; setpoints beside
            measured joints of a published arm show 0.92 to 1.12 (KinematicCalibDVRK).
        step_s: Longest step of the integration. The controllers' own loop has 0.67 to 1 ms.
        most_mm: Greatest error of the tip that the laboratory allows. Ours: the mean error of an uncalibrated arm, as
            with more than that the stated errors of the arms (`skills.verification.arm_errors`) are no longer true.
        most_deg: The same of the jaws' rotation. Ours: two standard deviations of an uncalibrated arm's wrist.
        most_effort: The greatest effort, as a part of its limit; at the limit an arm no longer follows.
    """

    velocities: bool = True
    gravity_compensated: bool = False
    rate_hz: float = 200.0
    delay_s: float = 0.005
    stiffness: Six = (120.0, 120.0, 6000.0, 6.0, 6.0, 6.0)
    damping: Six = (6.0, 5.0, 200.0, 0.09, 0.09, 0.09)
    inertia: Ends = ((0.150, 0.162, 0.718, *[3e-4] * 3), (0.224, 0.244, 1.078, *[3e-3] * 3))
    viscous: Ends = ((0.081, 0.163, 1.42, *[0.001] * 3), (0.121, 0.245, 2.14, *[0.01] * 3))
    coulomb: Ends = ((0.045, 0.060, 0.329, *[0.005] * 3), (0.067, 0.090, 0.493, *[0.05] * 3))
    play: Ends = ((0.0,) * 6, (0.0, 0.0, 0.0, *[radians(1)] * 3))
    load: Ends = ((0.8,) * 6, (1.2,) * 6)
    compensation: Ends = ((0.9,) * 6, (1.1,) * 6)
    step_s: float = 0.001
    most_mm: float = 2.96
    most_deg: float = 6.0
    most_effort: float = 0.95

    def __post_init__(self) -> None:
        for name in ("rate_hz", "step_s", "most_mm", "most_deg", "most_effort"):
            if not (isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise BadSettings(f"{name} of a servo must be above 0.", given=getattr(self, name))
        if not (isfinite(self.delay_s) and self.delay_s >= 0):
            raise BadSettings("delay_s of a servo must not be negative.", given=self.delay_s)
        for name in ("inertia", "viscous", "coulomb", "play", "load", "compensation"):
            low, high = np.array(getattr(self, name))
            if not (np.isfinite(high) & (low >= 0) & (low <= high)).all():
                raise BadSettings(f"{name} of a servo must be a range: lower ends from 0 up to the upper ends.")
        gains, inertia = np.array([self.stiffness, self.damping]), np.array(self.inertia[0])
        if not ((gains > 0) & np.isfinite(gains)).all():
            raise BadSettings("The gains of a servo must be above 0.")
        if not (self.step_s**2 * gains[0] < inertia).all():  # the leaps are stable up to four times as much
            raise BadSettings("The steps are too long for these gains and inertias; give a shorter step_s.")

    def arm(self, loaded: float, rubbing: float) -> Floats:
        """Return one arm of the ranges, at a part of the way from their lower to their upper ends, 0 to 1.

        Args:
            loaded: The part for load and compensation.
            rubbing: The part for inertia, friction and play.

        Returns:
            P, D, I, Fv, Fc, play, and the parts of the load that act and that are compensated, shape (8, 6).
        """

        def at(ends: Ends, part: float) -> Floats:
            low, high = np.array(ends)
            return np.asarray(low + part * (high - low))

        rows = [at(ends, rubbing) for ends in (self.inertia, self.viscous, self.coulomb, self.play)]
        load = at(self.load, loaded)
        # What is compensated too much is what is loaded too little.
        rows += [load, self.gravity_compensated * load * at(self.compensation, 1.0 - loaded)]
        return np.array([self.stiffness, self.damping, *rows])


@dataclass(frozen=True, eq=False)
class Executed:
    """The motion of one arm, each of shape (T, 6), rad, mm, Nm and N.

    Attributes:
        joints: The links' joints, behind the play.
        efforts: The motors' efforts.
        motors: Places and speeds of the motors, rad and m, shape (T, 2, 6).
        friction: The dry friction that they feel.
        planned: The planned joints.
        arm: The arm, as by `Servo.arm`.
    """

    joints: Floats
    efforts: Floats
    motors: Floats
    friction: Floats
    planned: Floats
    arm: Floats

    @cached_property
    def droop(self) -> Floats:
        """The part of the joints' error by their load."""
        share = self.arm[6] - self.arm[7]
        return np.asarray(-share * loads(self.motors[:, 0] / _UNITS) / self.arm[0] / _UNITS)

    @cached_property
    def stick(self) -> Floats:
        """The part by dry friction and play."""
        return np.asarray(self.joints - (self.motors[:, 0] + self.friction / self.arm[0]) / _UNITS)

    @property
    def lag(self) -> Floats:
        """The part by speed, delay, inertia and a limit of effort."""
        return self.joints - self.planned - self.droop - self.stick


@dataclass(frozen=True, eq=False)
class Prediction:
    """The predicted motion: of the arm in the middle of all ranges, and the errors of those at their ends.

    Attributes:
        executed: The arm in the middle.
        off_mm: Distance of its tip from the planned one at the same time, and the least and the greatest of all arms,
            shape (3, T).
        off_deg: The same for the rotation of the jaws.
        effort: The greatest effort of any of the arms as a part of its limit, shape (T, 6).
        others: The arms at the ends of the ranges.
    """

    executed: Executed
    off_mm: Floats
    off_deg: Floats
    effort: Floats
    others: tuple[Executed, ...]


def predict(
    joints: ArrayLike, stamps_s: ArrayLike, servo: Servo, instrument: str = DEFAULT_INSTRUMENT, *, ranged: bool = True
) -> Prediction:
    """Predict the motion that an arm executes, which rests where the plan begins until that begins.

    Args:
        joints: The planned rows of `kinematics.JOINTS`, rad and mm, shape (T, 6).
        stamps_s: Their times in s, increasing, shape (T,).
        servo: The arm and how it is driven.
        instrument: Number of the instrument.
        ranged: Whether the ends of the ranges are tried; without, the arm in their middle stands for all.

    Returns:
        The motion; errors are those of the tip against the planned one at the same time.

    Raises:
        BadInput: There is no sample, shapes do not agree, a number is not finite, or the stamps do not increase.
    """
    planned = frozen(joints, np.float64, (None, 6), "joints")
    stamps = frozen(stamps_s, np.float64, (len(planned),), "stamps_s")
    if not len(stamps) or not (np.diff(stamps) > 0).all():
        raise BadInput("A motion to be executed needs a sample, and stamps that increase.")
    # Loads and frictions can add up or cancel.
    ends = [servo.arm(*parts) for parts in product((0.0, 1.0), repeat=2)] if ranged else []
    middle = servo.arm(0.5, 0.5)
    drive = drive_of(planned, stamps, servo, middle, instrument)
    arms = [_executed(drive, planned, arm) for arm in (middle, *ends)]
    tip_mm, rotation = forward(planned, instrument)
    off = []
    for arm in arms:
        there_mm, turned = forward(arm.joints, instrument)
        off.append((np.linalg.norm(there_mm - tip_mm, axis=1), _apart_deg(rotation, turned)))
    limit = np.array(instrument_of(instrument).arm.effort)
    off_mm, off_deg = (np.array([one[0], np.min(one, axis=0), np.max(one, axis=0)]) for one in zip(*off, strict=True))
    effort = np.max([np.abs(arm.efforts) / limit for arm in arms], axis=0)
    return Prediction(arms[0], off_mm, off_deg, effort, tuple(arms[1:]))


def _apart_deg(rotation: Floats, other: Floats) -> Floats:
    """Return the angles between rotations, (T, 3, 3), from the distance between their axes, shape (T,)."""
    chords = (other - rotation).reshape(-1, 9).T
    return np.asarray(np.degrees(2 * arcsin(np.minimum(np.sqrt(sum(one * one for one in chords) / 8), 1.0))))


def loads(joints: Floats) -> Floats:
    """Return the fitted loads that the motors hold, Nm and N, 0 of roll and wrist.

    Args:
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6).

    Returns:
        Shape (T, 6).
    """
    (s1, s2), (c1, c2), depth = *(f(joints[:, :2]).T for f in (sin, cos)), joints[:, INSERTION] * _UNITS[INSERTION]
    terms = (np.ones_like(s1), s1, c1, s2 * c1, c2 * c1, depth * s1, depth * s2 * c1, depth)
    found = np.zeros((len(joints), 6))
    for number, term in enumerate(terms):
        found[:, :3] += term[:, None] * _LOADS[:, number]
    return found


class Drive(NamedTuple):
    """A plan and the arm that executes it, as arrays for compiled loops: rad, m, s.

    Attributes:
        stamps: Times of the samples from the first on, shape (T,).
        plan: Planned joints, shape (T, 6).
        speeds: The speeds that are sent, shape (T, 6).
        waves: Sines of yaw and pitch, then their cosines, shape (T, 4).
        factors: Those of the loads.
        parts: The arm, as by `Servo.arm`, and its greatest efforts, shape (9, 6).
        stream: Longest step, setpoints per second, and their age.
        known: The sample before the setpoint in force, which loops move on, shape (1,).
    """

    stamps: Floats
    plan: Floats
    speeds: Floats
    waves: Floats
    factors: Floats
    parts: Floats
    stream: Floats
    known: Ints


def drive_of(joints: Floats, stamps_s: Floats, servo: Servo, arm: Floats, instrument: str) -> Drive:
    """Return the plan and the arm for compiled loops; the arguments are those of `execute`."""
    plan, stamps = joints * _UNITS, stamps_s - stamps_s[0]
    speeds = np.gradient(plan, stamps, axis=0) if servo.velocities and len(plan) > 1 else np.zeros_like(plan)
    waves = np.concatenate([sin(plan[:, :2]), cos(plan[:, :2])], axis=1)
    parts = np.concatenate([arm, [instrument_of(instrument).arm.effort]])
    stream = np.array([servo.step_s, servo.rate_hz, servo.delay_s])
    return Drive(stamps, plan, speeds, waves, _LOADS.copy(), parts, stream, np.zeros(1, np.int64))


def execute(joints: Floats, stamps_s: Floats, servo: Servo, arm: Floats, instrument: str) -> Executed:
    """Return the motion of one arm.

    Args:
        joints: The planned joints, rad and mm, shape (T, 6).
        stamps_s: Their times, increasing, shape (T,).
        servo: How the arm is driven.
        arm: The arm, as by `Servo.arm`.
        instrument: Number of the instrument, whose greatest efforts count.
    """
    return _executed(drive_of(joints, stamps_s, servo, arm, instrument), joints, arm)


def _executed(drive: Drive, joints: Floats, arm: Floats) -> Executed:
    """Return the motion of an arm, (8, 6), along a plan, which is given as `joints` too, rad and mm."""
    drive = drive._replace(parts=np.concatenate([arm, drive.parts[8:]]), known=np.zeros(1, np.int64))
    plan, share, stiffness = drive.plan, arm[6] - arm[7], arm[0]
    motor, (link, effort, friction) = np.zeros((len(plan), 2, 6)), np.zeros((3, *plan.shape))
    rest = plan[:1].copy()
    for _ in range(5):  # a fixed point: the load changes with the droop by less than a tenth of it
        rest = plan[:1] - share * loads(rest / _UNITS) / stiffness
    motor[0, 0], link[0], effort[0] = rest[0], rest[0], arm[6] * loads(rest / _UNITS)[0]
    _run(drive, motor[0].copy(), np.zeros((3, 6)), motor, link, effort, friction)
    return Executed(link / _UNITS, effort, motor, friction, joints, arm)


@inner
def _push(drive: Drive, k: int, now: float, h: float, state: Floats, put: Floats) -> None:
    """Fill in speeds after a step, efforts and dry friction, (3, 6), from places and speeds in its middle, (2, 6).

    The step ends at or before sample `k`, its middle is at `now`, it has the length `h`; `now` never decreases.
    """
    rate, delay, known = drive.stream[1], drive.stream[2], int(drive.known[0])
    stamps, plan, speeds, parts = drive.stamps, drive.plan, drive.speeds, drive.parts
    # The setpoint that is in force, of the last tick of its stream that has arrived.
    sent = max(np.floor((now - delay) * rate + 1e-6) / rate, 0.0)
    while known < len(stamps) - 2 and stamps[known + 1] <= sent:
        known += 1
    drive.known[0] = known
    way = min((sent - stamps[known]) / (stamps[known + 1] - stamps[known]), 1.0)
    # Sines and cosines of the posture, from those of the plan and a small turn.
    a = min(max(state[0, 0] - plan[k, 0], -1.0), 1.0)
    b = min(max(state[0, 1] - plan[k, 1], -1.0), 1.0)
    sin_a, cos_a = a - a * a * a / 6, 1 - a * a / 2 + a * a * a * a / 24
    sin_b, cos_b = b - b * b * b / 6, 1 - b * b / 2 + b * b * b * b / 24
    waves, factors = drive.waves, drive.factors
    s1, c1 = waves[k, 0] * cos_a + waves[k, 2] * sin_a, waves[k, 2] * cos_a - waves[k, 0] * sin_a
    s2, c2 = waves[k, 1] * cos_b + waves[k, 3] * sin_b, waves[k, 3] * cos_b - waves[k, 1] * sin_b
    depth = state[0, 2]
    for j in range(6):
        load = 0.0
        if j < 3:
            load = factors[j, 0] + factors[j, 1] * s1 + factors[j, 2] * c1 + factors[j, 3] * s2 * c1
            load += factors[j, 4] * c2 * c1 + factors[j, 5] * depth * s1
            load += factors[j, 6] * depth * s2 * c1 + factors[j, 7] * depth
        x, v, limit = state[0, j], state[1, j], parts[8, j]
        wanted = plan[known, j] + way * (plan[known + 1, j] - plan[known, j])
        speed = speeds[known, j] + way * (speeds[known + 1, j] - speeds[known, j])
        e = parts[0, j] * (wanted - x) + parts[1, j] * speed + parts[7, j] * load
        brake, rubs = parts[1, j] + parts[3, j], parts[4, j]
        for again in range(2):
            # From the effort at mean speed. Dry friction takes away what speed it can, and turns none round.
            mass = parts[2, j] + h * brake / 2
            free = ((parts[2, j] - h * brake / 2) * v + h * (e - parts[6, j] * load)) / mass
            taken = min(max(free, -h * rubs / mass), h * rubs / mass)
            if again == 0:
                e -= parts[1, j] * (v + free - taken) / 2
                if abs(e) <= limit:
                    break
                e, brake = min(max(e, -limit), limit), parts[3, j]
        put[0, j], put[1, j], put[2, j] = free - taken, e, taken * mass / h


@compiled
def torques(k: int, now: float, h: float, masses: Floats, state: Floats, put: Floats, *known: Any) -> None:
    """Fill in forces that move bodies of a mass matrix (6, 6) by the law, Nm and N, then as `_push`, and the speeds.

    Who pushes a body off leaves it with other speeds than those, (4, 6), for which it was braked: that is given back.
    """
    drive = Drive(*known)  # known to numba as arrays, which it takes in half the time
    for j in range(6):
        put[3, j] -= state[1, j]
    _push(drive, k, now, h, state, put)
    for j in range(6):
        lost, put[3, j] = put[3, j] / 2, put[0, j]
        put[0, j] = (put[0, j] - state[1, j]) / h + (drive.parts[1, j] + drive.parts[3, j]) * lost / drive.parts[2, j]
        put[1, j] += drive.parts[1, j] * lost
    for j in range(6):
        state[0, j] = 0.0
        for i in range(6):
            state[0, j] += masses[j, i] * put[0, i]
    for j in range(6):
        put[0, j] = state[0, j]


class MovingArm:
    """An arm that is driven step by step, as a stand-in for one on a bus.

    Attributes:
        joints: Its links' joints, rad and mm, shape (6,).
        speeds: Their speeds, per second.
        efforts: Its motors' efforts, Nm and N.
    """

    def __init__(self, joints: ArrayLike, servo: Servo, instrument: str = DEFAULT_INSTRUMENT) -> None:
        """Place an arm, the middle of a servo's ranges, at rest; rate and delay of its setpoints are the bus's own."""
        self.joints = frozen(joints, np.float64, (6,), "joints")
        self.speeds, self.efforts = np.zeros(6), np.zeros(6)
        self._servo, self._arm, self._instrument = servo, servo.arm(0.5, 0.5), instrument
        self._state = np.array([self.joints * _UNITS, np.zeros(6)])

    def move(self, wanted: Floats, speeds: Floats, seconds: float) -> None:
        """Move for some seconds under one setpoint.

        Args:
            wanted: Joints, rad and mm, shape (6,).
            speeds: Their speeds, per second; 0 where none are sent.
            seconds: How long, above 0.
        """
        drive = drive_of(
            np.tile(wanted, (2, 1)), np.array([0.0, seconds]), self._servo, self._arm, self._instrument
        )._replace(speeds=np.tile(speeds * _UNITS, (2, 1)), stream=np.array([self._servo.step_s, 1.0 / seconds, 0.0]))
        motor, (link, effort, friction) = np.zeros((2, 2, 6)), np.zeros((3, 2, 6))
        link[0] = self.joints * _UNITS
        _run(drive, self._state, np.zeros((3, 6)), motor, link, effort, friction)
        self.joints, self.speeds, self.efforts = link[1] / _UNITS, motor[1, 1] / _UNITS, effort[1]


@compiled
def _run(
    drive: Drive, state: Floats, put: Floats, motor: Floats, link: Floats, effort: Floats, friction: Floats
) -> None:
    """Fill in motors (T, 2, 6), links, efforts and dry friction, (T, 6), from their first rows; `state`: (2, 6)."""
    for k in range(1, len(link)):
        gap = drive.stamps[k] - drive.stamps[k - 1]
        steps = int(np.ceil(gap / drive.stream[0] - 1e-6))
        h = gap / steps
        for i in range(steps):
            for j in range(6):
                state[0, j] += h / 2 * state[1, j]  # to the middle of the step
            _push(drive, k, drive.stamps[k - 1] + (i + 0.5) * h, h, state, put)
            for j in range(6):
                state[1, j] = put[0, j]
                state[0, j] += h / 2 * state[1, j]
        for j in range(6):
            motor[k, 0, j], motor[k, 1, j] = state[0, j], state[1, j]
            effort[k, j], friction[k, j] = put[1, j], put[2, j]
            link[k, j] = min(max(link[k - 1, j], state[0, j] - drive.parts[5, j]), state[0, j] + drive.parts[5, j])


def levers_mm(joints: Floats, instrument: str = DEFAULT_INSTRUMENT) -> Floats:
    """Return how far the tip moves with each joint: mm for a rad, and for a mm of insertion.

    Args:
        joints: Rows of `kinematics.JOINTS`, rad and mm, shape (T, 6).
        instrument: Number of the instrument.

    Returns:
        Shape (T, 6); 0 for wrist yaw, whose hinge is the tip.
    """
    shaft, wrist, _ = axes_of(joints)
    tip = (joints[:, INSERTION, None] - instrument_of(instrument).wrist_offset_mm) * shaft + WRIST_MM * wrist
    s1, c1 = sin(joints[:, 0]), cos(joints[:, 0])
    along_mm, away = c1 * tip[:, 0] + s1 * tip[:, 2], wrist - (wrist * shaft).sum(axis=1)[:, None] * shaft
    found = np.zeros((len(joints), 6))
    found[:, 0] = np.linalg.norm(tip[:, (0, 2)], axis=1)
    found[:, 1] = np.sqrt((tip * tip).sum(axis=1) - along_mm * along_mm)
    found[:, 2], found[:, 3], found[:, 4] = 1.0, WRIST_MM * np.linalg.norm(away, axis=1), WRIST_MM
    return found


def remedied(servo: Servo) -> dict[str, Servo]:
    """Return the remedies that a servo lacks, by their names, each as the servo with it.

    Args:
        servo: How the arm is driven now.
    """
    faster = replace(servo, rate_hz=2 * servo.rate_hz, delay_s=servo.delay_s / 2)
    better = {"a rate of setpoints twice as high": faster}
    if not servo.velocities:
        better["velocities sent"] = replace(servo, velocities=True)
    if not servo.gravity_compensated:
        better["gravity compensated"] = replace(servo, gravity_compensated=True)
    return better
