"""The executed motion of a plan: how far an arm is off, why, what would help, and whether it stays within the limits.

    Trajectory, Servo --execution_of--> Execution: errors with ranges, efforts, reasons in words, the first failure

It is a prediction (`skills.dynamics`) of PSM_A; PSM_M is taken to move as planned. All of this is ours.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from skills.arrays import Floats, Ints
from skills.dynamics import NOT_VALIDATED, Prediction, Servo, levers_mm, predict, remedied
from skills.gridworld.scene import Scene
from skills.kinematics import INSERTION, JOINTS, forward, quaternion_of
from skills.planning.trajectory import Trajectory
from skills.verification.bodies import bodies_clearance
from skills.verification.gates import Failure, Limits, first_executed_failure
from skills.verification.intent import compare
from skills.verification.requested import RequestedMotion
from skills.verification.scene_clearance import clearance_of

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
        mean_mm: Mean error of the tip.
        remedies_mm: The same with each remedy that the servo lacks.
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


def execution_of(
    trajectory: Trajectory,
    servo: Servo,
    *,
    request: RequestedMotion | None = None,
    scene: Scene | None = None,
    limits: Limits | None = None,
) -> Execution:
    """Predict how an arm executes a plan.

    Args:
        trajectory: The plan's motion.
        servo: The arm and how it is driven.
        request: What was asked, from which the tip's way must not be too far off; None: it is not compared.
        scene: The tissue and obstacles, in the frame of PSM_A's base; None: they are not compared.
        limits: The limits of the gates; by default those of the verdict.
    """
    found = predict(trajectory.joints, trajectory.stamps_s, servo, trajectory.instrument)
    one, sizes = found.executed, levers_mm(trajectory.joints, trajectory.instrument)
    causes = np.abs(np.stack([one.droop, one.lag, one.stick], axis=2))
    causes_mm, causes_deg = causes * sizes[:, :, None], np.degrees(causes)
    causes_deg[:, INSERTION] = 0.0
    dominant = np.stack(np.divmod(causes_mm.reshape(-1, 18).argmax(axis=1), 3), axis=1)
    mean_mm, helped = float(found.off_mm[0].mean()), {}
    for name, other in remedied(servo).items():
        again = predict(trajectory.joints, trajectory.stamps_s, other, trajectory.instrument, ranged=False)
        helped[name] = float(again.off_mm[0].mean())
    failure = _failure(trajectory, one.joints, request, scene, limits or Limits())
    surely = failure is not None
    for arm in found.others:
        failure = failure or _failure(trajectory, arm.joints, request, scene, limits or Limits())
    answer = Execution(found, causes_mm, causes_deg, dominant, mean_mm, helped, failure, surely, ())
    return replace(answer, reasons=tuple(_reasons(answer, trajectory, servo)))


def _failure(
    trajectory: Trajectory, joints: Floats, request: RequestedMotion | None, scene: Scene | None, limits: Limits
) -> Failure | None:
    """Return the first failure of one arm's motion."""
    tip_mm, rotation = forward(joints, trajectory.instrument)
    moved = replace(trajectory, joints=joints, tip_mm=tip_mm, rotation_xyzw=quaternion_of(rotation))
    return first_executed_failure(
        joints,
        trajectory,
        limits,
        beside=None if scene is None else clearance_of(moved, scene),
        outer=bodies_clearance(moved, limits.clearance_bodies_mm),
        intent=None if request is None else compare(request, trajectory, joints),
    )


def _reasons(found: Execution, trajectory: Trajectory, servo: Servo) -> list[str]:
    """Return the prediction in sentences: errors, causes and remedies, efforts, limits, and what it is worth."""
    mm, deg, effort = found.predicted.off_mm, found.predicted.off_deg, found.predicted.effort
    worst, turned = int(mm[0].argmax()), int(deg[0].argmax())
    lines = [
        f"The tip is predicted {found.mean_mm:.2f} mm off the plan on average and {mm[0, worst]:.2f} mm at worst "
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
        f"With {name} the mean error is {after:.2f} mm instead of {found.mean_mm:.2f} mm."
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
