"""Numbers in columns of tables and datasets, as poses: frames, units, joints, orientations and setpoints.

Poses are mm in the base of the arm, whose origin is the remote centre, where the caller names no other frame; joints
alone become poses by forward kinematics with the stated instrument. Numbers in another unit are refused.

Setpoints in columns do not name their frame. Recorders take them from `setpoint_cp` beside `measured_cp`, so they are
read in the frame of the measured pose, if they are near it: setpoints in another frame or unit are further away than an
arm lags behind. No fault of a setpoint refuses a recording, because nothing is learnt from it.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from skills.arithmetic import cos, sin
from skills.arrays import Floats, Ints
from skills.demonstration.motion import COORDINATE_LIMIT_MM
from skills.demonstration.recording import Motion, Signal, recorded_motion, recorded_signal
from skills.errors import MixedFrames, NotAQuaternion, NotMetres, NoUsableTopic, SkillsError
from skills.kinematics import INSERTION, INSTRUMENTS, JOINTS, UNITS, forward, instrument_of, quaternion_of
from skills.quaternions import of_vector
from skills.remedies import Action, Remedy

BASE = "base"  # as a frame: the base of each arm
# The tip is further from the remote centre than the wrist, because the wrist bends by less than a right angle. A reach
# of 290 mm is 11.4 inches, so a path in inches never exceeds this limit.
OUTSIDE_MM = min(instrument.cannula_mm - instrument.wrist_offset_mm for instrument in INSTRUMENTS.values())
BEYOND_LIMIT = {"rad": 0.1, "mm": 10.0}  # ours: encoders overshoot a joint's limit by less; degrees and metres do not
POSE_PARTS = (*(f"position.{axis}" for axis in "xyz"), *(f"orientation.{part}" for part in "xyzw"))  # as in messages
TOPICS = {  # the quantities that recorders write as columns, and the topics from which they take them
    "local_pose": "/{}/local/measured_cp",
    "pose": "/{}/measured_cp",
    "joints": "/{}/measured_js",
    "jaw": "/{}/jaw/measured_js",
    "setpoint": "/{}/setpoint_cp",
    "local_setpoint": "/{}/local/setpoint_cp",
    "joint_setpoints": "/{}/setpoint_js",
    "jaw_setpoint": "/{}/jaw/setpoint_js",
}
SETPOINTS = ("setpoint", "local_setpoint", "joint_setpoints", "jaw_setpoint")
Quantity = tuple[str, str]  # an arm such as "PSM1", and a key of `TOPICS`
# The numbers of a quantity in rad and mm: of a pose positions (T, 3) and, where they are known, quaternions (T, 4); of
# any other one array (T, K). Apart, so that the recording's values need no copy of them.
Parts = tuple[Floats, ...]
_TURN_RAD = 2 * np.pi
_JOINT_RAD = 7.0  # ours: more than any joint turns, less than 8 degrees
APART_MM = 30.0  # ours: an arm lags by some mm, and by a cell of the paper's grid, 5 mm, at 100 mm/s and 50 ms
NEAR_SAMPLES = 10_000  # ours: enough for a median, however long the recording is


def scaled(values: Floats, factor: float) -> Floats:
    """Return values in mm or rad; infinite ones, where they overflow, are refused by the recording's values."""
    with np.errstate(over="ignore"):
        return values if factor == 1 else factor * values


def topic_of(arm: str, kind: str) -> str:
    """Return the topic of a quantity of an arm."""
    return TOPICS[kind].format(arm)


def pose_motion(arm: str, kind: str, frame: str, stamps_ns: Ints, pose: Parts) -> Motion:
    """Return the motion of an arm from its "pose" or "local_pose" in a frame, at stamps of shape (T,)."""
    tip_mm, *rotation = pose
    return recorded_motion(
        arm=arm,
        topic=topic_of(arm, kind),
        frame=frame,
        stamps_ns=stamps_ns,
        tip_mm=tip_mm,
        rotation_xyzw=rotation[0] if rotation else None,
    )


def in_mm(joints: Floats) -> Floats:
    """Return joints, shape (T, K), with the insertion in mm, from metres; infinite ones are refused as above."""
    converted = joints.astype(np.float64)
    with np.errstate(over="ignore"):
        converted[:, INSERTION] *= 1000.0
    return converted


def in_metres(joints: NDArray[np.floating]) -> Floats:
    """Return joints, shape (T, K), with the insertion in metres, from mm."""
    converted = joints.astype(np.float64)
    converted[:, INSERTION] /= 1000.0
    return converted


def base_of(arm: str, frame: str | None) -> str:
    """Return the frame of poses that follow from the joints: the base of the arm.

    Raises:
        MixedFrames: The caller names another frame.
    """
    base = f"{arm}_base"
    if frame not in (None, BASE, base):
        raise MixedFrames(
            f"The poses that follow from the joints are in {base}, not in {frame!r}; omit the frame.", frames=[base]
        )
    return base


def check_joints(topic: str, joints: Floats) -> None:
    """Refuse numbers that no joint of a PSM has in rad, and its insertion in mm.

    Raises:
        NotMetres: An insertion beyond 1 m, or an angle beyond `_JOINT_RAD`.
    """
    limits = np.where(np.array(UNITS) == "mm", COORDINATE_LIMIT_MM, _JOINT_RAD)
    six, limits = joints[:, : len(limits)], limits[: joints.shape[1]]  # a jaw may follow them
    wrong = np.abs(six) > limits  # NaN is refused by name elsewhere
    if wrong.any():
        row, joint = np.argwhere(wrong)[0].tolist()
        raise NotMetres(
            f"{topic}: {JOINTS[joint]} is {joints[row, joint]:g} {UNITS[joint]} in sample {row}; no joint of a PSM is. "
            "Give angles in rad and the insertion in m, or name the units of the columns.",
            sample=row,
            joint=JOINTS[joint],
        )


def posed(topic: str, joints: Floats, instrument: str | None) -> Parts:
    """Compute poses from joints by forward kinematics with a stated instrument.

    Args:
        topic: The source, for messages.
        joints: Shape (T, 6), rad and mm.
        instrument: Its number; None if none is stated.

    Returns:
        Positions in the arm's base frame in mm, shape (T, 3), and unit quaternions, shape (T, 4).

    Raises:
        NoUsableTopic: No instrument is stated.
        NotMetres: A joint is beyond its limits, so the instrument, the unit or the order is another.
    """
    if instrument is None:
        one, other, *_ = INSTRUMENTS
        raise NoUsableTopic(
            f"{topic} has joints and no poses; they become poses with the instrument that was on the arm.",
            Remedy(Action.NAME_INSTRUMENT, one=one, other=other),
            instruments=list(INSTRUMENTS),
        )
    tool = instrument_of(instrument)
    beyond = np.maximum(tool.lower - joints, joints - tool.upper) - [BEYOND_LIMIT[unit] for unit in UNITS]
    if (beyond > 0).any():
        row, joint = np.argwhere(beyond > 0)[0].tolist()
        raise NotMetres(
            f"{topic}: {JOINTS[joint]} is {joints[row, joint]:.5g} {UNITS[joint]} in sample {row}, beyond the limits "
            f"{tool.lower[joint]:.4g} to {tool.upper[joint]:.4g} of the {tool.arm.name} with {tool.name}; check the "
            "units, the order of the joints and the instrument.",
            sample=row,
            joint=JOINTS[joint],
        )
    return pose_of(joints, instrument)


def check_outside(motion: Motion) -> None:
    """Refuse a path that never leaves the cannula: its numbers are in another unit, or from another origin.

    Raises:
        NotMetres: The tip is never outside.
    """
    if not motion.frame.endswith("_base"):  # only there the origin is the remote centre
        return
    away_mm = np.sqrt(np.einsum("ij,ij->i", motion.tip_mm, motion.tip_mm))
    furthest = int(np.argmax(away_mm))
    if away_mm[furthest] < OUTSIDE_MM:
        at_s = (int(motion.stamps_ns[furthest]) - int(motion.stamps_ns[0])) / 1e9
        raise NotMetres(
            f"The tip is at most {away_mm[furthest]:.3g} mm from the remote centre (at {at_s:.3f} s); below "
            f"{OUTSIDE_MM:.3g} mm its wrist is inside the cannula. Give the positions in the unit of the column "
            "names, not in inches; or name the frame, if they are not relative to the remote centre.",
            sample=furthest,
            furthest_mm=float(away_mm[furthest]),
        )


def quaternion_of_rpy(topic: str, rpy_rad: Floats) -> Floats:
    """Return the unit quaternions x, y, z, w of R = Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        topic: The source, for the message.
        rpy_rad: Roll, pitch, yaw about the fixed axes x, y, z, shape (T, 3).

    Returns:
        Shape (T, 4).

    Raises:
        NotAQuaternion: An angle is more than a whole turn, so its unit is another.
    """
    _check_turn(topic, np.abs(rpy_rad).max(axis=1), "roll, pitch and yaw", "roll")
    (cr, cp, cy), (sr, sp, sy) = cos(rpy_rad.T / 2), sin(rpy_rad.T / 2)
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
    return np.stack([x, y, z, w], axis=1)


def quaternion_of_vector(topic: str, vector_rad: Floats) -> Floats:
    """Return the unit quaternions x, y, z, w of rotation vectors: the axis times the angle.

    Args:
        topic: The source, for the message.
        vector_rad: Shape (T, 3).

    Returns:
        Shape (T, 4).

    Raises:
        NotAQuaternion: A vector is longer than a whole turn, so its unit is another.
    """
    with np.errstate(over="ignore"):
        angle = np.linalg.norm(vector_rad, axis=1)
    _check_turn(topic, angle, "the rotation vector", "rx")
    return of_vector(vector_rad)


def _check_turn(topic: str, angle_rad: Floats, what: str, name: str) -> None:
    """Refuse angles, shape (T,), of more than a turn; NaN is refused as well."""
    if not (angle_rad <= _TURN_RAD).all():
        row = int(np.argmin(angle_rad <= _TURN_RAD))
        raise NotAQuaternion(
            f"{topic}: {what} of sample {row} have up to {angle_rad[row]:g} rad, more than a turn. Are they in "
            f"degrees? Name the columns with their unit, {name}_rad or {name}_deg.",
            sample=row,
        )


def setpoints_in(
    values: Mapping[Quantity, Parts], motions: Sequence[Motion], instruments: Mapping[str, str], stamps_ns: Ints
) -> tuple[list[Motion], list[tuple[str, Signal]], list[tuple[str, str]]]:
    """Return the setpoints beside measured poses in the same frame; those of joints in the base of their arm.

    Args:
        values: The numbers of each quantity; those of other quantities are not used.
        motions: The measured motions.
        instruments: The number of each arm's instrument, where it is known.
        stamps_ns: Integer nanoseconds, shape (T,).

    Returns:
        Commanded poses of tips; arms and the commanded angles of their jaws; and topics that were not usable, with the
        fault of each.
    """
    tips, jaws, left_out = list[Motion](), list[tuple[str, Signal]](), list[tuple[str, str]]()
    for (arm, kind), parts in values.items():
        if kind not in SETPOINTS:
            continue
        pose = parts
        if kind == "joint_setpoints":
            number = instruments.get(arm)
            if (arm, "local_setpoint") in values or number is None or not np.isfinite(parts[0]).all():
                why = "not used: the instrument is not known, a number is NaN or infinite, or poses are there too"
                left_out.append((topic_of(arm, kind), why))
                continue
            kind, pose = "local_setpoint", pose_of(parts[0], number)
        topic = topic_of(arm, kind)
        try:
            if kind == "jaw_setpoint":
                jaws.append((arm, recorded_signal(stamps_ns, parts[0][:, 0], topic)))
                continue
            beside = topic_of(arm, "pose" if kind == "setpoint" else "local_pose")
            measured = next((one for one in motions if one.topic == beside), None)
            if measured is None:
                raise NoUsableTopic(f"{arm} has no measured pose beside it in a known frame.")
            tip = pose_motion(arm, kind, measured.frame, stamps_ns, pose)
            _check_near(tip, measured)
            tips.append(tip)
        except SkillsError as error:
            left_out.append((topic, str(error)))
    return tips, jaws, left_out


def pose_of(joints: Floats, instrument: str) -> Parts:
    """Return the poses of the tip in the arm's base, from joints in rad and mm, shape (T, 6)."""
    tip_mm, turned = forward(joints, instrument)
    return tip_mm, quaternion_of(turned)


def _check_near(tip: Motion, measured: Motion) -> None:
    """Refuse setpoints that are far from the measured tip.

    Raises:
        MixedFrames: Their median distance is above `APART_MM`.
    """
    step = 1 + len(tip.stamps_ns) // NEAR_SAMPLES
    # samples may have been dropped from either
    _, here, there = np.intersect1d(tip.stamps_ns[::step], measured.stamps_ns, assume_unique=True, return_indices=True)
    away_mm = np.linalg.norm(tip.tip_mm[::step][here] - measured.tip_mm[there], axis=1)
    far_mm = float(np.median(away_mm)) if len(away_mm) else np.nan
    if not far_mm <= APART_MM:
        raise MixedFrames(
            f"Its median distance from the measured tip is {far_mm:.3g} mm, above {APART_MM:g} mm: another frame."
        )
