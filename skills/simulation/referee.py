"""Contact referee: hand-offs by friction in MuJoCo, beside the closed form that decides whether a needle is caught.

    Trajectory, ArmErrors --referee--> Refereed: hand-offs held, and the closed form in the same worlds
    Physics: friction, grip and stiffness, each of which is also halved and doubled

One trial is one world of `skills.verification.arm_errors`: PSM_M's base, both wrists, both tips and the needle are off
by the same draws as in the closed form. What happens then is decided by forces alone:

1. PSM_A closes on the needle, and gravity begins.
2. Both arms follow the planned motion from where PSM_M's fingers cannot have touched anything yet, until both stand.
3. Both jaws follow the plan at its own times: PSM_M's closes, then PSM_A's opens. PSM_M goes straight back with the
   needle, from rest to rest and no faster than the plan, as plans do.

The needle is *held* if at the end both of PSM_M's fingers touch it, and neither of PSM_A's. A trial is lost "before" if
PSM_A has lost the needle when PSM_M begins to close, "missed" if PSM_M has closed without it between its fingers, and
"dropped" if it is lost afterwards.

**Bodies.** The needle is the rigid arc of `urdf/needle.urdf` as round pieces. A finger is the box of `urdf/psm.urdf`
that is seen there, hinged as there, and the hinge is within a ball as thick as the wrist. These are convex shapes of
our own. Shafts are left out, and the links before the jaws are not simulated: the jaws follow the planned poses on
springs, which stand for servos and cables. Both fingers of a jaw are closed by the same limited torque, and a spring
keeps their middle. Nothing else is in the scene: no tissue, no thread, no cable that stretches.

**Units** inside the process are mm, kg and s, so forces are in mN: a needle of 0.07 g is no tiny number there. The
needle has fifty times its inertia, and its own weight: motions are slow, and the grip is ten thousand times that
weight. `docs/contact.md` has the sources of the numbers, and the comparison.

This is the only module that imports mujoco, in a confined process, of which nothing is trusted but numbers. All of
this is ours.
"""

import importlib.util
import os
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from math import isfinite, pi, sqrt
from typing import Any, BinaryIO

import numpy as np

from skills import packing
from skills.arrays import Flags, Floats, Ints, frozen
from skills.errors import BadInput, BadSettings, SimulationFailed
from skills.kinematics import JAW_TIP_MM, matrix_of, quaternion_of
from skills.planning.handoff import HELD_MM, JAW_CLOSED_RAD, NEEDLE_RADIUS_MM, OPEN_RAD
from skills.planning.motion_laws import A2, PEAK
from skills.planning.trajectory import Trajectory, stands_from
from skills.quaternions import vector_of
from skills.sandbox import ProcessLimits
from skills.simulation.player import simulated
from skills.verification.arm_errors import ArmErrors
from skills.verification.clearance import (
    ASIDE_MM,
    FINGER_RADIUS_MM,
    FINGER_REACH_MM,
    RADIUS_MM,
    WRIST_RADIUS_MM,
    needle_arc_mm,
    needle_poses,
    psm_m_poses,
)
from skills.verification.error_draws import Displaced, Drawn, draw
from skills.verification.monte_carlo import at_hand_off, caught_by, crossed, scene_of
from skills.verification.probabilities import EstimateSettings, Probability, share

TRIALS = "skills.simulation.referee:trials"
LOST = ("before", "missed", "dropped")
QUANTITIES = ("friction", "grip", "arm", "contact")  # the last two are stiffnesses: of arm and wrist, and of contacts
FACTORS = (0.5, 2.0)
_FREE_MM = 6.0  # beyond the fingers' reach: so much nearer may errors bring the arms before the trial begins
_TRIAL_S = 5.0  # of the timeout for each trial; it takes about 0.3 s


@dataclass(frozen=True)
class Physics:
    """The numbers of the contacts; `docs/contact.md` has their sources.

    Attributes:
        friction: Coefficient of friction between needle and jaws, and between the jaws of both arms.
        grip_nmm: Greatest torque with which each finger closes, N mm: half of the dVRK's limit of 160.
        arm_n_mm: Stiffness of each arm at the hinge of its jaws, N/mm.
        wrist_nmm_rad: Stiffness of each wrist, N mm/rad.
        contact_s: Time constant of a contact, s; its stiffness is proportional to 1 / contact_s^2.
        step_s: Time step, s, at most 0.0005: with longer ones contacts bounce, and needles are missed that are held.
    """

    friction: float = 0.3
    grip_nmm: float = 80.0
    arm_n_mm: float = 1.0
    wrist_nmm_rad: float = 1000.0
    contact_s: float = 0.002
    step_s: float = 0.0005

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (isfinite(value) and 0 <= value <= 1e6 and (value > 0 or field.name == "friction")):
                least = "at least" if field.name == "friction" else "more than"
                raise BadSettings(f"{field.name} of the contacts must be {least} 0, at most 1e6.", given=value)
        if not (self.step_s <= 0.0005 and self.contact_s >= 2.5 * self.step_s):
            raise BadSettings(
                "step_s must be at most 0.0005, and contact_s at least 2.5 times as long; make step_s smaller.",
                step_s=self.step_s,
                contact_s=self.contact_s,
            )

    def times(self, quantity: str, factor: float) -> "Physics":
        """Return the same with one of `QUANTITIES` multiplied by a factor."""
        changed = {
            "friction": {"friction": self.friction * factor},
            "grip": {"grip_nmm": self.grip_nmm * factor},
            "arm": {"arm_n_mm": self.arm_n_mm * factor, "wrist_nmm_rad": self.wrist_nmm_rad * factor},
            "contact": {"contact_s": self.contact_s / sqrt(factor)},
        }
        return replace(self, **changed[quantity])


@dataclass(frozen=True)
class Sensitivity:
    """The trials with one of `QUANTITIES` multiplied by a factor; `changed` is the number of other outcomes."""

    quantity: str
    factor: float
    held: Probability
    changed: int


@dataclass(frozen=True)
class Refereed:
    """The hand-off of one pass, refereed.

    Attributes:
        seed: Seed of the random numbers.
        pass_index: The pass.
        held: The trials in which PSM_M holds the needle at the end.
        straight: Those in which it does, and within the angle of its hinge at which the closed form calls it caught.
        lost: Number of trials lost in each of the ways of `LOST`.
        closed_form: The same event in closed form, in as many worlds as its settings have variations.
        agree: Trials in which the closed form says the same of the same world.
        only_closed_form: Trials in which the closed form says "caught" and the needle is not held.
        only_held: Trials in which the needle is held and the closed form says "not caught".
        slipped_mm: Distance by which a held needle slips in PSM_M's jaws once they have closed: median, and greatest.
        turned_deg: The same for its rotation.
        sensitivity: The same trials, or the first of them, with other physics.
        physics: The numbers of the contacts.
        errors: The errors of the arms.
        engine: Name and version of the simulator.
    """

    seed: int
    pass_index: int
    held: Probability
    straight: Probability
    lost: dict[str, int]
    closed_form: Probability
    agree: int
    only_closed_form: int
    only_held: int
    slipped_mm: tuple[float, float]
    turned_deg: tuple[float, float]
    sensitivity: tuple[Sensitivity, ...]
    physics: Physics
    errors: ArmErrors
    engine: str

    @property
    def gap(self) -> float:
        """Return the closed form's probability minus the referee's: above 0, the closed form hopes for more."""
        return self.closed_form.probability - self.held.probability

    @property
    def too_hopeful(self) -> bool:
        """Return whether the closed form's probability is above the upper end of the referee's Wilson interval."""
        return not self.closed_form.probability <= self.held.upper


@dataclass(frozen=True, eq=False)
class TrialsRequest:
    """The trials to make: N worlds at W samples, with the physics of each run and the number of worlds to try in it.

    Attributes:
        stamps_s: Times of the samples, from the first one, shape (W,).
        tip_mm: The hinges of both arms' jaws in PSM_A's base frame, shape (N, 2, W, 3).
        jaw: The rotations of both jaws, shape (N, 2, W, 3, 3).
        needle_mm: The needle at the first sample, shape (N, 3).
        needle: Its rotation, shape (N, 3, 3).
        jaws_s: Times of the jaws' angles, from where both arms stand, shape (J,).
        jaws_rad: The planned angles of both jaws, shape (2, J).
        back_s: The time in which PSM_M goes back.
        physics: Of each run.
        counts: Of each run, the number of worlds, the first ones.
    """

    stamps_s: Floats
    tip_mm: Floats
    jaw: Floats
    needle_mm: Floats
    needle: Floats
    jaws_s: Floats
    jaws_rad: Floats
    back_s: float
    physics: tuple[Physics, ...]
    counts: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Outcomes:
    """How trials ended, as 0 (held) or 1 + index in `LOST`; slip, turn and angle to the hinge; and the engine."""

    ended: Ints
    motion: Floats
    engine: str

    def __post_init__(self) -> None:
        frozen(self.motion, np.float64, (len(frozen(self.ended, np.int64, (None,), "ended")), 3), "motion")
        known = ((self.ended >= 0) & (self.ended <= len(LOST))).all()
        if not (known and isinstance(self.engine, str) and 0 < len(self.engine) <= 100):
            raise BadInput("These are no outcomes of trials.")


CLASSES = packing.known(TrialsRequest, Physics, Outcomes)


# ---- outside the process ---------------------------------------------------------------------------------------


def require_mujoco() -> None:
    """Raise an error early, and without the import, if MuJoCo is missing.

    Raises:
        SimulationFailed: It is not installed; the message states how to install it.
    """
    if importlib.util.find_spec("mujoco") is None:
        raise SimulationFailed(
            "MuJoCo is not installed, so no hand-off can be refereed. Install it with `pip install 'mujoco>=4,<5'`.",
            cause="not installed",
        )


def referee(
    trajectory: Trajectory,
    *,
    errors: ArmErrors,
    number: int = 0,
    trials: int = 100,
    varied: int = 0,
    seed: int = 0,
    physics: Physics | None = None,
    settings: EstimateSettings | None = None,
    memory_bytes: int = 1 << 30,
    target: str = TRIALS,
) -> Refereed:
    """Let friction decide how often the needle of a pass is handed over, and compare that with the closed form.

    The same arguments give the same result on the same machine.

    Args:
        trajectory: The planned motion, with PSM_M.
        errors: The errors of the arms.
        number: The pass, from 0.
        trials: Number of trials.
        varied: Number of trials, the first ones, to repeat with each quantity halved and doubled.
        seed: Seed of the random numbers.
        physics: The numbers of the contacts.
        settings: The errors beside those of the arms, and the closed form's conditions of a catch.
        memory_bytes: Memory limit of the simulator.
        target: The simulator, as `module:function`.

    Raises:
        BadInput: The trajectory has no PSM_M, or the pass no hand-off.
        BadSettings: The number of trials or the seed is out of range.
        SimulationFailed: MuJoCo is missing, or it crashed, hung, ran out of memory or returned invalid data.
    """
    if not (1 <= trials <= 100_000 and 0 <= varied <= trials and seed >= 0):
        raise BadSettings("A referee needs 1 to 100000 trials, no more varied ones than these, and a seed from 0 on.")
    if target == TRIALS:
        require_mujoco()
    plain, conditions = physics or Physics(), settings or EstimateSettings()
    watched = _watched(trajectory, number)
    sizes = {"suture_point_mm": conditions.suture_point_mm, "needle_rad": conditions.needle_rad}
    drawn = draw(seed, number, trials, len(watched), **sizes)
    displaced = drawn.under(errors, trajectory.stamps_s[watched])
    says = _closed_form(trajectory, number, drawn, displaced, conditions)
    others = [(quantity, factor) for quantity in QUANTITIES for factor in FACTORS if varied]
    counts = (trials, *(varied for _ in others))
    runs = (plain, *(plain.times(*one) for one in others))
    request = _request(trajectory, number, watched, drawn, displaced, runs, counts)
    limits = ProcessLimits(memory_bytes, 60.0 + _TRIAL_S * sum(counts))
    outcomes = simulated(target, request, Outcomes, CLASSES, limits)
    ended, motion = outcomes.ended, outcomes.motion
    if len(ended) != sum(counts):
        raise SimulationFailed("The referee returned invalid data; run it again.", cause="nonsense")
    held, again = ended[:trials] == 0, (ended[trials:] == 0).reshape(len(others), varied)
    slipped, turned, askew = motion[:trials].T
    drawn = draw(seed, number, conditions.variations, 1, **sizes)
    displaced = drawn.under(errors, trajectory.stamps_s[watched[-1:]])
    return Refereed(
        seed=seed,
        pass_index=number,
        held=share(~held),
        straight=share(~(held & (askew <= np.degrees(conditions.stated_rad)))),
        lost={how: int(np.count_nonzero(ended[:trials] == code)) for code, how in enumerate(LOST, start=1)},
        closed_form=share(~_closed_form(trajectory, number, drawn, displaced, conditions)),
        agree=int(np.count_nonzero(says == held)),
        only_closed_form=int(np.count_nonzero(says & ~held)),
        only_held=int(np.count_nonzero(held & ~says)),
        slipped_mm=_median_and_most(slipped[held]),
        turned_deg=_median_and_most(turned[held]),
        sensitivity=tuple(
            Sensitivity(*one, share(~good), int(np.count_nonzero(good != held[:varied])))
            for one, good in zip(others, again, strict=True)
        ),
        physics=plain,
        errors=errors,
        engine=outcomes.engine,
    )


def _median_and_most(values: Floats) -> tuple[float, float]:
    return (float(np.median(values)), float(values.max())) if len(values) else (0.0, 0.0)


def _watched(trajectory: Trajectory, number: int) -> Ints:
    """Return the samples of a pass from where PSM_M's fingers can have touched nothing, to where both arms stand."""
    samples = np.flatnonzero(trajectory.pass_index == number)
    if trajectory.psm_m is None or not len(samples) or trajectory.phase[samples[-1]] != A2:
        raise BadInput(
            "Only a hand-off can be refereed: give a pass with A2, and PSM_M's base with the plan.", pass_index=number
        )
    hinge, _ = psm_m_poses(trajectory, samples)
    needle = np.linalg.norm(needle_arc_mm(trajectory, samples) - hinge[:, None], axis=2).min(axis=1)
    fingers = np.linalg.norm(trajectory.tip_mm[samples] - hinge, axis=1) - FINGER_REACH_MM
    free = np.flatnonzero(np.minimum(needle, fingers) > FINGER_REACH_MM + _FREE_MM)
    stand = stands_from(trajectory, int(samples[-1])) - int(samples[0])  # the first sample; then only the jaws move
    begin = int(free[-1]) if len(free) else int(np.argmax(trajectory.phase[samples] == A2))
    return samples[min(begin, stand) : stand + 1]


def _closed_form(
    trajectory: Trajectory, number: int, drawn: Drawn, displaced: Displaced, conditions: EstimateSettings
) -> Flags:
    """Return whether the closed form calls the needle caught, shape (N,)."""
    scene = scene_of(trajectory, number, -np.inf, conditions.opening_rad)
    arms = at_hand_off(scene, None, conditions.unknown_depth_mm)
    assert arms is not None
    return np.asarray(np.logical_and(*caught_by(crossed(arms, drawn.shift_mm, displaced, drawn.turned), conditions)))


def _request(
    trajectory: Trajectory,
    number: int,
    watched: Ints,
    drawn: Drawn,
    displaced: Displaced,
    physics: tuple[Physics, ...],
    counts: tuple[int, ...],
) -> TrialsRequest:
    """Return the request for the trials of a pass, with poses in PSM_A's base frame.

    PSM_A holds the needle with all its grip until its jaw is planned to move.
    """
    psm_m = trajectory.psm_m
    assert psm_m is not None
    if trajectory.jaw_rad is None or psm_m.jaw_rad is None:
        raise BadInput("A motion without angles of both jaws hands nothing over; plan it again.", pass_index=number)
    stand = int(watched[-1])
    jaws = slice(stand, int(trajectory.last_samples[number]) + 1)
    mine, theirs = trajectory.jaw_rad[jaws], psm_m.jaw_rad[jaws]
    holds = np.logical_and.accumulate(mine == mine[0])
    jaw_a = matrix_of(trajectory.rotation_xyzw[watched])
    hinge_m, jaw_m = psm_m_poses(trajectory, watched)
    _, needle = needle_poses(trajectory, watched[:1])
    shift = drawn.shift_mm[:, None]
    base_turn, turn_a, turn_m = displaced.base_turn, displaced.jaw_turn[0], displaced.jaw_turn[1]
    tip_a = trajectory.tip_mm[watched] + shift + displaced.tip_mm[0]
    away = (hinge_m + shift - psm_m.base_mm) @ np.swapaxes(base_turn, 1, 2)
    tip_m = away + psm_m.base_mm + displaced.base_mm[:, None] + displaced.tip_mm[1]
    turns_a = turn_a[:, None] @ jaw_a
    # The needle's turn is drawn where it is handed over, and stays the same within PSM_A's jaws.
    within = jaw_a[-1].T @ drawn.turned @ jaw_a[-1]
    return TrialsRequest(
        stamps_s=trajectory.stamps_s[watched] - trajectory.stamps_s[watched[0]],
        tip_mm=np.stack([tip_a, tip_m], axis=1),
        jaw=np.stack([turns_a, (base_turn @ turn_m)[:, None] @ jaw_m], axis=1),
        needle_mm=tip_a[:, 0] + HELD_MM * turns_a[:, 0, :, 2],
        needle=turns_a[:, 0] @ within @ jaw_a[0].T @ needle[0],
        jaws_s=trajectory.stamps_s[jaws] - trajectory.stamps_s[stand],
        jaws_rad=np.stack([np.where(holds, JAW_CLOSED_RAD, mine), theirs]),
        back_s=PEAK * _BACK_MM / trajectory.speed_mm_s,
        physics=physics,
        counts=counts,
    )


# ---- inside the process: mm, kg, s, mN ---------------------------------------------------------------------------

_AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
_SEGMENTS = 24  # of the needle: the arc bends by 0.02 mm within one
_STEEL_KG_MM3 = 7.9e-6
_INERTIA = 50.0  # times the needle's own; its weight stays
_FALL = -9810.0
_JAW_KG, _FINGER_KG_MM2 = 0.05, 2.0  # half of what moves at an arm's hinge; inertia of a finger with its motor
_SATURATED_RAD = 0.05  # error of a jaw's opening at which its motor gives its greatest torque
_FIRST_RAD = 0.15  # opening of each of PSM_A's fingers as it begins to close on the needle
# Durations in s: PSM_A closes, [the planned motion, the planned jaws, PSM_M goes back,] rest.
_GRIP_S, _END_S = 0.12, 0.08
_BACK_MM = 18.0  # the needle's circle is 16.6 mm across
_ARM_CONTROLS, _OPENING = 7, 6  # controls of an arm: three of its place, three of its rotation, its jaw's opening


def trials(given: BinaryIO, answer: BinaryIO) -> None:
    """Make the trials that `referee` requests."""
    os.environ["MUJOCO_GL"] = "disable"  # else the import starts a program that looks for a display, and is stopped
    import mujoco

    asked = packing.read(given, CLASSES)
    assert isinstance(asked, TrialsRequest)
    ended: list[int] = []
    motion: list[tuple[float, float, float]] = []
    for physics, count in zip(asked.physics, asked.counts, strict=True):
        model = mujoco.MjModel.from_xml_string(_scene(physics))
        for world in range(count):
            how, moved = _Trial(mujoco, model, asked, world).run(physics.step_s)
            ended.append(how)
            motion.append(moved)
    found = Outcomes(np.array(ended, np.int64), np.array(motion, np.float64), f"MuJoCo {mujoco.__version__}")
    packing.write(answer, found, CLASSES)


def _scene(physics: Physics) -> str:
    """Return the model of both jaws and the needle."""
    arms = [_arm(name, 1 << k, physics) for k, name in enumerate("am")]
    bodies, tendons, motors = ("".join(parts) for parts in zip(*arms, strict=True))
    return f"""
    <mujoco>
      <option timestep="{physics.step_s}" integrator="implicitfast" cone="elliptic" impratio="50" tolerance="1e-10"/>
      <default>
        <geom friction="{physics.friction} 0 0" solref="{physics.contact_s} 1" solimp="0.999 0.999 0.001 0.5 2"/>
      </default>
      <worldbody>{bodies}{_needle()}</worldbody>
      <tendon>{tendons}</tendon>
      <actuator>{motors}</actuator>
    </mujoco>"""


def _needle() -> str:
    """Return the needle's body: round pieces along its arc."""
    turn = np.linspace(-pi / 3, 2 * pi / 3, _SEGMENTS + 1)
    ends = NEEDLE_RADIUS_MM * np.stack([np.sin(turn), 1 - np.cos(turn), np.zeros_like(turn)], axis=1)
    middles = (ends[1:] + ends[:-1]) / 2
    mass = _INERTIA * _STEEL_KG_MM3 * pi * RADIUS_MM**2 * NEEDLE_RADIUS_MM * pi
    centre = middles.mean(axis=0)
    away = middles - centre
    inertia = mass * (np.mean(away**2) * 3 * np.eye(3) - away.T @ away / len(away) + RADIUS_MM**2 / 4 * np.eye(3))
    pieces = "".join(
        f'<geom type="capsule" size="{RADIUS_MM}" fromto="{_text(begin)} {_text(end)}" contype="4" conaffinity="3"/>'
        for begin, end in pairwise(ends)
    )
    six = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return f"""
      <body name="needle" gravcomp="{1 - 1 / _INERTIA}">
        <freejoint/><inertial pos="{_text(centre)}" mass="{mass:.9g}" fullinertia="{_text(six)}"/>{pieces}
      </body>"""


def _arm(name: str, bit: int, physics: Physics) -> tuple[str, str, str]:
    """Return the bodies, tendons and motors of an arm from the hinge of its jaws on, all critically damped."""
    arm, wrist, torque = 1e3 * physics.arm_n_mm, 1e3 * physics.wrist_nmm_rad, 1e3 * physics.grip_nmm
    jaw = torque / _SATURATED_RAD
    touches = f'contype="{bit}" conaffinity="{7 - bit}"'  # not its own parts
    half = JAW_TIP_MM / 2
    fingers = "".join(
        f"""
          <body gravcomp="1">
            <joint name="{name}{side}" axis="{-sign} 0 0" armature="{_FINGER_KG_MM2}" damping="50"/>
            <inertial pos="0 0 {half}" mass="0.005" diaginertia="0.2 0.2 0.2"/>
            <geom name="{name}{side}" type="box" size="{FINGER_RADIUS_MM} {ASIDE_MM} {half}"
                  pos="0 {sign * ASIDE_MM} {half}" {touches}/>
          </body>"""
        for side, sign in (("1", 1), ("2", -1))
    )
    slides = "".join(f'<joint name="{name}{k}" type="slide" axis="{axis}"/>' for k, axis in _AXES.items())
    body = f"""
      <body gravcomp="1">{slides}<inertial pos="0 0 0" mass="{_JAW_KG}" diaginertia="5 5 5"/>
        <body name="{name}" gravcomp="1">
          <joint name="{name}" type="ball"/><inertial pos="0 0 0" mass="{_JAW_KG}" diaginertia="10 10 10"/>
          <geom type="sphere" size="{WRIST_RADIUS_MM}" {touches}/>{fingers}
        </body>
      </body>"""
    both = [f'<joint joint="{name}1" coef="1"/><joint joint="{name}2" coef="{sign}"/>' for sign in (1, -1)]
    tendons = f"""
      <fixed name="{name}">{both[0]}</fixed>
      <fixed stiffness="{wrist}" damping="{2 * sqrt(wrist * _FINGER_KG_MM2 / 2)}" springlength="0">{both[1]}</fixed>"""
    place, turn = f'kp="{arm}" kv="{2 * sqrt(arm * 2.2 * _JAW_KG)}"', f'kp="{wrist}" kv="{2 * sqrt(wrist * 11)}"'
    motors = "".join(f'<position joint="{name}{k}" {place}/>' for k in _AXES)
    motors += "".join(f'<position joint="{name}" gear="{axis} 0 0 0" {turn}/>' for axis in _AXES.values())
    grip = f'kp="{jaw}" kv="{2 * sqrt(jaw * _FINGER_KG_MM2 / 2)}" forcerange="{-torque} {torque}"'
    motors += f'<position tendon="{name}" {grip}/>'
    return body, tendons, motors


def _text(numbers: Floats) -> str:
    return " ".join(f"{one:.9g}" for one in numbers)


class _Trial:
    """One trial in a model, of one world."""

    def __init__(self, mujoco: Any, model: Any, asked: TrialsRequest, world: int) -> None:
        self.mujoco, self.model, self.data = mujoco, model, mujoco.MjData(model)
        self.stamps_s, self.tip_mm = asked.stamps_s, asked.tip_mm[world]
        self.jaws_s, self.jaws_rad, self.back_s = asked.jaws_s, asked.jaws_rad, asked.back_s
        tip_mm, jaw, needle_mm, needle = self.tip_mm, asked.jaw[world], asked.needle_mm[world], asked.needle[world]
        jaws_s, jaws_rad = self.jaws_s, self.jaws_rad
        self.closed_s = float(jaws_s[np.argmin(jaws_rad[1])])  # then PSM_M's jaw has closed
        self.last = jaw[:, -1]  # the rotation at the hand-off, from which all others are counted
        self.turn = [vector_of(quaternion_of(last.T @ one)) for last, one in zip(self.last, jaw, strict=True)]
        self.arms = [model.body(name).id for name in "am"]
        self.needle = model.body("needle").id
        self.fingers = [[model.geom(f"{name}{side}").id for side in "12"] for name in "am"]
        model.body_quat[self.arms] = _wxyz(self.last)
        first = _wxyz(np.swapaxes(self.last, 1, 2) @ jaw[:, 0])
        openings = (_FIRST_RAD, OPEN_RAD)
        arms = [np.concatenate([tip_mm[k, 0], first[k], [openings[k]] * 2]) for k in range(2)]
        self.data.qpos[:] = np.concatenate([*arms, needle_mm, _wxyz(needle[None])[0]])

    def run(self, step_s: float) -> tuple[int, tuple[float, float, float]]:
        """Return how it ended, as 0 or 1 + index in `LOST`, and slip, turn and angle to the hinge of a held needle."""
        lasts = [_GRIP_S, float(self.stamps_s[-1]), self.closed_s, self.jaws_s[-1] - self.closed_s, self.back_s, _END_S]
        ends = np.cumsum(lasts)
        gripped, stand, closed, _, _, last = np.round(ends / step_s).astype(int).tolist()
        controls = self._controls((np.arange(last) + 1) * step_s, ends)
        self.model.opt.gravity[:] = 0.0
        self._through(controls[:gripped])
        self.model.opt.gravity[2] = _FALL
        self._through(controls[gripped:stand])
        kept = all(self._touched()[0])
        self._through(controls[stand:closed])
        caught = all(self._touched()[1])
        place, rotation = self._in_jaws()
        if not (kept and caught):
            return (2 if kept else 1), (0.0, 0.0, 0.0)
        self._through(controls[closed:])
        touched = self._touched()
        if not all(touched[1]) or any(touched[0]):
            return 3, (0.0, 0.0, 0.0)
        after, turned = self._in_jaws()
        angle = float(np.degrees(np.linalg.norm(vector_of(quaternion_of((turned @ rotation.T)[None])))))
        return 0, (float(np.linalg.norm(after - place)), angle, _askew_deg(after, turned))

    def _controls(self, at_s: Floats, ends: Floats) -> Floats:
        """Return the commands of both arms at every step."""
        along = np.clip(at_s - ends[0], 0.0, self.stamps_s[-1])
        controls = np.empty((len(at_s), 2 * _ARM_CONTROLS))
        for arm in range(2):
            wanted = np.concatenate([self.tip_mm[arm], self.turn[arm]], axis=1)
            for k in range(_OPENING):
                controls[:, arm * _ARM_CONTROLS + k] = np.interp(along, self.stamps_s, wanted[:, k])
        u = np.clip((at_s - ends[3]) / self.back_s, 0.0, 1.0)
        back = _BACK_MM * u**3 * (10 - 15 * u + 6 * u * u)
        controls[:, _ARM_CONTROLS : _ARM_CONTROLS + 3] -= back[:, None] * self.last[1, :, 2]
        first = np.interp(at_s, [0.0, ends[0] / 2], [2 * _FIRST_RAD, self.jaws_rad[0, 0]])
        planned = [np.interp(at_s - ends[1], self.jaws_s, angles) for angles in self.jaws_rad]
        controls[:, _OPENING] = np.where(at_s < ends[1], first, planned[0])
        controls[:, _ARM_CONTROLS + _OPENING] = planned[1]
        return controls

    def _through(self, controls: Floats) -> None:
        """Make a time step with each of some commands."""
        step, model, data, control = self.mujoco.mj_step, self.model, self.data, self.data.ctrl
        for one in controls:
            control[:] = one
            step(model, data)

    def _touched(self) -> list[list[bool]]:
        """Return which fingers of each arm touch the needle."""
        pairs = np.array(self.data.contact.geom).reshape(-1, 2)
        with_needle = pairs[(self.model.geom_bodyid[pairs] == self.needle).any(axis=1)]
        return [[bool((with_needle == finger).any()) for finger in fingers] for fingers in self.fingers]

    def _in_jaws(self) -> tuple[Floats, Floats]:
        """Return the pose of the needle in PSM_M's jaws, whose middle is that of its fingers."""
        arm, rotation = self.arms[1], self.data.xmat.reshape(-1, 3, 3)
        place = rotation[arm].T @ (self.data.xpos[self.needle] - self.data.xpos[arm])
        return place, rotation[arm].T @ rotation[self.needle]


def _askew_deg(place: Floats, rotation: Floats) -> float:
    """Return the angle between PSM_M's hinge and the needle where it is nearest to the middle of the fingers."""
    turn = np.linspace(-pi / 3, 2 * pi / 3, 361)
    arc = NEEDLE_RADIUS_MM * np.stack([np.sin(turn), 1 - np.cos(turn), np.zeros_like(turn)], axis=1)
    x, y, z = (arc @ rotation.T + place).T
    beside = np.maximum(0.0, np.abs(z - JAW_TIP_MM / 2) - JAW_TIP_MM / 2)  # past the fingers' ends
    nearest = int(np.argmin(x * x + y * y + beside * beside))
    along = rotation @ np.array([np.cos(turn[nearest]), np.sin(turn[nearest]), 0.0])
    return float(np.degrees(np.arccos(np.clip(abs(along[0]), 0.0, 1.0))))


def _wxyz(rotations: Floats) -> Floats:
    """Return rotations (N, 3, 3) as MuJoCo's quaternions, w first, (N, 4)."""
    return np.asarray(np.roll(quaternion_of(rotations), 1, axis=1))
