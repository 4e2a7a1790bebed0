"""The executed motion of a plan: how far an arm is off, why, what would help, and whether it stays within the limits.

    Trajectory, Servo --execution_of--> Execution: errors with ranges, efforts, reasons in words, the first failure

It is a prediction (`skills.dynamics`) of PSM_A; PSM_M is taken to move as planned. All of this is ours.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Floats, Ints
from skills.dynamics import NOT_VALIDATED, Executed, Prediction, Servo, levers_mm, predict, remedied
from skills.fields import Figure, schema
from skills.gridworld.scene import Scene
from skills.kinematics import INSERTION, JOINTS, forward, instrument_of, quaternion_of
from skills.notebook import card
from skills.planning.handoff import HELD_MM, NEEDLE_RADIUS_MM
from skills.planning.trajectory import Trajectory
from skills.verification.bodies import bodies_clearance
from skills.verification.bodies import moved_mm as moved_mm_of
from skills.verification.clearance import HandOff, crossing
from skills.verification.deviations import LIMITS, Deviations
from skills.verification.gates import TIP_WAYS, Failure, Limits, first_executed_failure
from skills.verification.intent import compare
from skills.verification.monte_carlo import at_hand_off, caught_by, scene_of
from skills.verification.probabilities import EstimateSettings
from skills.verification.requested import RequestedMotion
from skills.verification.scene_clearance import SceneClearance, clearance_of

CAUSES = ("droop", "lag", "stick")
NAMED_PART = 0.25  # ours: of the greatest cause; lesser ones are not named
_NAMED = 3  # ours: a sentence for more would not be read


@dataclass(frozen=True, eq=False)
class Execution:
    """The prediction for a plan, with its reasons.

    Attributes:
        predicted: Error of the tip in mm and degrees with its range, and efforts as parts of their limits, per sample.
        causes_mm: How far droop, lag and stick of each joint move the tip, shape (T, 6, 3); they add up as vectors.
        causes_deg: How far they turn the jaws, shape (T, 6, 3).
        dominant: Index of the joint, and of the cause in `CAUSES`, that moves the tip most, shape (T, 2).
        mean_mm: Mean error of the tip in the pass with the greatest error.
        remedies_mm: The same with each remedy that the servo lacks, in that pass alone.
        failure: The first sample beyond a limit; None if there is none.
        surely: Whether the arm in the middle of the ranges fails, and not only one at their ends.
        reasons: All of this in sentences.
    """

    predicted: Prediction
    causes_mm: Floats
    causes_deg: Floats
    dominant: Ints
    mean_mm: float
    remedies_mm: Mapping[str, float]
    failure: Failure | None
    surely: bool
    reasons: tuple[str, ...]

    def report(self, trajectory: Trajectory, servo: Servo) -> "ExecutionReport":
        """Return the figures that are stored."""
        mm, deg = self.predicted.off_mm, self.predicted.off_deg
        at = int(mm[0].argmax())
        return ExecutionReport(
            servo=servo,
            mean_mm=self.mean_mm,
            worst_mm=tuple(mm[:, at].tolist()),
            worst_s=float(trajectory.stamps_s[at]),
            worst_deg=tuple(deg[:, deg[0].argmax()].tolist()),
            effort=float(self.predicted.effort.max()),
            remedies_mm=self.remedies_mm,
            failure=self.failure,
            surely=self.surely,
            reasons=self.reasons,
        )


@schema
@dataclass(frozen=True)
class ExecutionReport:
    """The predicted execution of a plan by PSM_A; PSM_M is taken to move as planned.

    Attributes:
        servo: The arm and how it is driven, as the laboratory states.
        mean_mm: Mean error of the tip in the pass with the greatest error.
        worst_mm: Its greatest error, and the least and the greatest of all arms of the ranges at that moment.
        worst_s: That moment.
        worst_deg: The greatest error of the jaws' rotation likewise.
        effort: The greatest effort of any of the arms, as a part of its limit.
        remedies_mm: The mean error in that pass with each remedy that the servo lacks.
        failure: The first sample beyond a limit; null if there is none.
        surely: Whether the arm in the middle of the ranges fails, and not only one at their ends.
        reasons: All of this in sentences.
    """

    servo: Servo
    mean_mm: Figure
    worst_mm: tuple[float, float, float]
    worst_s: float
    worst_deg: tuple[float, float, float]
    effort: Figure
    remedies_mm: Mapping[str, float]
    failure: Failure | None
    surely: bool
    reasons: tuple[str, ...]

    def _repr_html_(self) -> str:
        first, *more, worth = self.reasons
        facts = {"error": first, "causes, remedies and limits": " ".join(more), "worth": worth}
        return card("As PSM_A is predicted to execute it", facts)


@dataclass(frozen=True, eq=False)
class PlannedMotion:
    """What is known of a plan's motion, and what is needed to find the same of the executed one.

    Attributes:
        request: What was asked, from which the tip's way must not be too far off; None: it is not compared.
        scene: The tissue and obstacles, in the frame of PSM_A's base; None: they are not compared.
        approach_m: PSM_M's approach in that frame, shape (3,), if it is known and PSM_M is not in the scene.
        intent: The planned motion's deviations from what was asked; None: not known.
        beside: Its distances from the scene; None: not known.
        bodies_mm: The least distance between the arms' outer bodies in it; None: not known, or one arm is alone.
    """

    request: RequestedMotion | None = None
    scene: Scene | None = None
    approach_m: ArrayLike | None = None
    intent: Deviations | None = None
    beside: SceneClearance | None = None
    bodies_mm: float | None = None


def execution_of(
    trajectory: Trajectory, servo: Servo, planned: PlannedMotion | None = None, *, limits: Limits | None = None
) -> Execution:
    """Predict how an arm executes a plan.

    Args:
        trajectory: The plan's motion.
        servo: The arm and how it is driven.
        planned: What is known of it; by default nothing, and it is compared with nothing but its own limits.
        limits: The limits of the gates; by default those of the verdict.
    """
    known, allowed = planned or PlannedMotion(), limits or Limits()
    found = predict(trajectory.joints, trajectory.stamps_s, servo, trajectory.instrument)
    one, sizes = found.executed, levers_mm(trajectory.joints, trajectory.instrument)
    causes = np.abs(np.stack([one.droop, one.lag, one.stick], axis=2))
    causes_mm, causes_deg = causes * sizes[:, :, None], np.degrees(causes)
    causes_deg[:, INSERTION] = 0.0
    dominant = np.stack(np.divmod(causes_mm.reshape(-1, 18).argmax(axis=1), 3), axis=1)
    worst = trajectory.pass_index == trajectory.pass_index[int(found.off_mm[0].argmax())]
    mean_mm, helped = float(found.off_mm[0, worst].mean()), {}
    for name, other in remedied(servo).items():
        again = predict(
            trajectory.joints[worst], trajectory.stamps_s[worst], other, trajectory.instrument, ranged=False
        )
        helped[name] = float(again.off_mm[0].mean())
    clear, hand_offs = _surely_clear(trajectory, found, known, allowed), _hand_offs(trajectory, known.approach_m)
    failure = _failure(trajectory, servo, found, one, known, allowed, clear, hand_offs)
    surely = failure is not None
    for arm in found.others:
        failure = failure or _failure(trajectory, servo, found, arm, known, allowed, clear, hand_offs)
    answer = Execution(found, causes_mm, causes_deg, dominant, mean_mm, helped, failure, surely, ())
    return replace(answer, reasons=tuple(_reasons(answer, trajectory, servo)))


def _surely_clear(
    trajectory: Trajectory, found: Prediction, known: PlannedMotion, limits: Limits
) -> tuple[bool, bool, bool]:
    """Return whether no arm can be beyond a limit of the outer bodies, the scene and the tip's way, by bounds alone.

    Each point of a link is moved by no more than the greatest errors of all joints together can move it.
    """
    turned = np.max([np.abs(arm.joints - trajectory.joints) for arm in (found.executed, *found.others)], axis=0)
    moved_mm = moved_mm_of(trajectory.joints, trajectory.joints + turned, trajectory.instrument)
    held_mm = found.off_mm[2] + np.radians(found.off_deg[2]) * (HELD_MM + 2 * NEEDLE_RADIUS_MM)  # jaws and needle
    ways_mm = np.maximum(moved_mm.max(axis=1), held_mm)
    bodies = known.bodies_mm is not None and known.bodies_mm - moved_mm.max() >= limits.clearance_bodies_mm
    beside, intent, request = known.beside, known.intent, known.request
    if (clear := beside is not None) and beside is not None:
        near_mm = np.minimum(beside.at_least_mm - beside.report.limit_mm, beside.needle_mm)
        clear = bool((near_mm >= ways_mm).all())
    if intent is None or request is None:
        return bodies, clear, False
    cells = found.off_mm[2] / request.policy.path.grid.cell_mm
    return bodies, clear, all((intent.values[kind] + cells <= LIMITS[kind][1]).all() for kind in TIP_WAYS)


def _failure(
    trajectory: Trajectory,
    servo: Servo,
    found: Prediction,
    arm: Executed,
    known: PlannedMotion,
    limits: Limits,
    clear: tuple[bool, bool, bool],
    hand_offs: Mapping[int, HandOff],
) -> Failure | None:
    """Return the first failure of one arm's motion."""
    row, missed, ends = 0 if arm is found.executed else 2, np.zeros(len(trajectory)), [*hand_offs]
    for end, tip_mm, jaw in zip(ends, *forward(arm.joints[ends], trajectory.instrument), strict=True):
        missed[end] = not _caught(hand_offs[end], tip_mm, jaw)
    moved = None if all(clear) else _moved(trajectory, arm.joints)
    tool = instrument_of(trajectory.instrument)
    errors = {
        "error of the tip": ("mm", found.off_mm[row], servo.most_mm),
        "error of the jaws' rotation": ("deg", found.off_deg[row], servo.most_deg),
        "effort": ("of its limit", (np.abs(arm.efforts) / np.array(tool.arm.effort)).max(axis=1), servo.most_effort),
        "needles that PSM_M misses": ("", missed, 0.5),
    }
    return first_executed_failure(
        arm.joints,
        trajectory,
        limits,
        errors,
        beside=None if moved is None or known.scene is None or clear[1] else clearance_of(moved, known.scene),
        outer=None if moved is None or clear[0] else bodies_clearance(moved, limits.clearance_bodies_mm),
        intent=None if known.request is None or clear[2] else compare(known.request, trajectory, arm.joints),
    )


def _moved(trajectory: Trajectory, joints: Floats) -> Trajectory:
    """Return a motion with other joints of PSM_A."""
    tip_mm, rotation = forward(joints, trajectory.instrument)
    return replace(trajectory, joints=joints, tip_mm=tip_mm, rotation_xyzw=quaternion_of(rotation))


def _hand_offs(trajectory: Trajectory, approach_m: ArrayLike | None) -> dict[int, HandOff]:
    """Return the hand-offs at which the needle is caught as planned, by the sample at which they are."""
    found, varied = {}, EstimateSettings()
    for number, end in enumerate(trajectory.last_samples.tolist()):
        planned_end = scene_of(trajectory, number, -inf, varied.opening_rad, last=True)
        arms = at_hand_off(planned_end, approach_m, varied.unknown_depth_mm)
        if arms is not None:
            (tip_a, jaw_a), (tip_m, jaw_m) = (arm.poses_of(arm.joints) for arm in arms)
            planned = HandOff(tip_a[0], jaw_a[0], tip_m[0], jaw_m[0])
            if _caught(planned, tip_a[0], jaw_a[0]):
                found[end] = planned
    return found


def _caught(planned: HandOff, tip_mm: Floats, jaw: Floats) -> bool:
    """Return whether PSM_M catches the needle if PSM_A has this tip, (3,), and jaw, (3, 3), instead of the planned."""
    apart_mm = tip_mm - planned.tip_a + HELD_MM * (jaw - planned.jaw_a)[:, 2]
    at = crossing(planned, (jaw @ planned.jaw_a.T)[None], apart_mm[None])
    return bool(np.logical_and(*caught_by(at, EstimateSettings()))[0])


def _reasons(found: Execution, trajectory: Trajectory, servo: Servo) -> list[str]:
    """Return the prediction in sentences: errors, causes and remedies, efforts, limits, and what it is worth."""
    mm, deg, effort = found.predicted.off_mm, found.predicted.off_deg, found.predicted.effort
    worst, turned = int(mm[0].argmax()), int(deg[0].argmax())
    lines = [
        f"The tip is predicted {mm[0].mean():.2f} mm off the plan on average and {mm[0, worst]:.2f} mm at worst "
        f"({mm[1, worst]:.2f} to {mm[2, worst]:.2f}), at {trajectory.stamps_s[worst]:.3f} s; the jaws are turned by "
        f"{deg[0, turned]:.1f} degrees at worst ({deg[1, turned]:.1f} to {deg[2, turned]:.1f})."
    ]
    for unit, causes in (("mm", found.causes_mm[worst]), ("degrees", found.causes_deg[turned])):
        order = np.argsort(-causes, axis=None, kind="stable")[:_NAMED].tolist()
        for joint, cause in (divmod(place, 3) for place in order):
            if causes[joint, cause] > NAMED_PART * causes.max():
                size = f"{causes[joint, cause]:.2f} {unit}"
                lines.append(f"{CAUSES[cause].capitalize()} of {JOINTS[joint]} {size}: {_advice(cause, servo)}.")
    lines += [
        f"With {name} the mean error of that pass is {after:.2f} mm instead of {found.mean_mm:.2f} mm."
        for name, after in found.remedies_mm.items()
    ]
    at, joint = np.unravel_index(int(effort.argmax()), effort.shape)
    lines.append(f"The greatest effort is {effort[at, joint]:.0%} of its limit, of {JOINTS[joint]}.")
    if found.failure is not None:
        lines.append(f"{'Executed' if found.surely else 'At an end of the ranges, executed'}: {found.failure}")
    return [*lines, NOT_VALIDATED]


def _advice(cause: int, servo: Servo) -> str:
    """Return what helps against a cause."""
    if CAUSES[cause] == "droop":
        return "fit the compensation to this arm" if servo.gravity_compensated else "compensate gravity"
    if CAUSES[cause] == "lag":
        return "send setpoints earlier and more often, or plan slower" if servo.velocities else "send velocities"
    return "only less friction and play, or stiffer gains, help"
