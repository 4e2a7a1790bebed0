"""Poses of the arms' bases in the frames of their poses, from two poses of an arm or from its joints.

Motion, Motion --paired_bases--> BaseFrame            one in the base's own frame, the other in another
Motion, Joints --identified_arms--> ArmIdentification  arm, instrument and base that both show together
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from skills.arrays import Floats, Ints
from skills.demonstration.identification import MOST_SAMPLES, ArmIdentification, identify
from skills.demonstration.motion import Joints, Motion
from skills.fields import Point, Quaternion, schema
from skills.kinematics import matrix_of, quaternion_of

BASES_LIMIT = 64  # ours: pairs of motions of one arm in two frames; a dVRK's recording has one or two per arm
PAIR_NS = 2_000_000  # ours: between two poses so near in time a tip at 100 mm/s moves by 0.2 mm
PAIRS_LEAST = 10  # ours: from fewer pairs it cannot be concluded that a base stood still
IDENTIFIED_LIMIT = 16  # ours: pairs of joints and poses that are compared, each for 0.1 s; a dVRK has two per arm
JOINT_GAP_NS = 50_000_000  # ours: joints further apart in time are not interpolated
WIDE_MM = 2.0  # ours: a rotation cannot be fitted to tips that move less than this in a second direction

_INVERSE = np.array([-1.0, -1.0, -1.0, 1.0])  # a unit quaternion x, y, z, w times this is its inverse


@schema
@dataclass(frozen=True)
class BaseFrame:
    """The pose of an arm's base: a point p of `local_frame` is at `position_mm` + R p in `frame`.

    Attributes:
        arm: The arm's name.
        frame: Frame of the arm's other pose, such as "ECM".
        local_frame: The arm's base, the frame of its `local/measured_cp`.
        position_mm: Position of the base in `frame`.
        rotation_xyzw: Its rotation R as a unit quaternion.
        spread_mm: Greatest distance from `position_mm` among the positions that single pairs of poses give. A large
            value means that the base moved, because the camera or the set-up joints did.
        spread_rad: Greatest angle from R among the rotations that single pairs give.
    """

    arm: str
    frame: str
    local_frame: str
    position_mm: Point
    rotation_xyzw: Quaternion
    spread_mm: float
    spread_rad: float

    def is_of(self, motion: Motion) -> bool:
        """Return whether it is the base of a motion's arm in the frame of that motion."""
        return (self.arm, self.frame) == (motion.arm, motion.frame)

    def seen_from(self, position_mm: Floats, rotation_xyzw: Floats) -> tuple[Floats, Floats]:
        """Transform poses from `frame` into the base's own frame.

        Args:
            position_mm: Positions in `frame`, shape (T, 3).
            rotation_xyzw: Unit quaternions in `frame`, shape (T, 4).

        Returns:
            The same in `local_frame`.
        """
        turn = matrix_of(np.array([self.rotation_xyzw]))[0]
        rotation = quaternion_of(turn.T @ matrix_of(rotation_xyzw))
        return (position_mm - np.asarray(self.position_mm)) @ turn, rotation


def identified_arms(
    motions: Sequence[Motion], joints: Sequence[Joints], tools: Mapping[str, str], *, timed: bool
) -> Iterator[ArmIdentification]:
    """Yield the arms and instruments that joints and poses show together.

    Args:
        motions: Poses; those that were computed from joints are left out.
        joints: Measured joints. Of more than `IDENTIFIED_LIMIT` pairs of an arm only the first are compared.
        tools: Arm and its stated instrument.
        timed: Whether the stamps are times that were recorded, so that speeds can be computed from them.
    """
    measured = [motion for motion in motions if not motion.from_joints]
    pairs = ((one, motion) for one in joints for motion in measured if one.arm == motion.arm)
    # Limited, because each pair costs some hypotheses for some thousand samples.
    for one, motion in islice(pairs, IDENTIFIED_LIMIT):
        at, values, speeds = _joints_at(one, motion.stamps_ns)
        if len(at) == 0:
            continue
        rotation = None if motion.rotation_xyzw is None else matrix_of(motion.rotation_xyzw[at])
        found = identify(
            values,
            motion.tip_mm[at],
            rotation,
            speeds=speeds if timed else None,
            in_base=motion.states_base,
            stated=tools.get(motion.arm),
        )
        if found is not None:
            yield ArmIdentification(motion.arm, one.topic, motion.topic, motion.frame, found)


def _joints_at(joints: Joints, stamps_ns: Ints) -> tuple[Ints, Floats, Floats]:
    """Return indices of stamps, at most `MOST_SAMPLES`, between two samples of the joints; joints and speeds there."""
    at = np.linspace(0, len(stamps_ns) - 1, min(len(stamps_ns), MOST_SAMPLES)).round().astype(np.int64)
    if len(joints.stamps_ns) < 2:
        return at[:0], joints.positions[:0], joints.positions[:0]
    wanted_ns, known_ns = stamps_ns[at], joints.stamps_ns
    after = np.clip(np.searchsorted(known_ns, wanted_ns), 1, len(known_ns) - 1)
    before = after - 1
    gap_ns = known_ns[after] - known_ns[before]
    same = (wanted_ns == known_ns[before]) | (wanted_ns == known_ns[after])  # nothing is interpolated
    near = (wanted_ns >= known_ns[before]) & (wanted_ns <= known_ns[after]) & (same | (gap_ns <= JOINT_GAP_NS))
    at, after, before, wanted_ns, gap_ns = at[near], after[near], before[near], wanted_ns[near], gap_ns[near]
    share = ((wanted_ns - known_ns[before]) / np.maximum(1, gap_ns))[:, None]
    # Speeds over some samples, because the difference of two is mostly the noise of the encoders.
    first, last = np.maximum(before - 2, 0), np.minimum(after + 2, len(known_ns) - 1)
    seconds = np.maximum(1, known_ns[last] - known_ns[first])[:, None] / 1e9
    speeds = (joints.positions[last] - joints.positions[first]) / seconds
    return at, (1.0 - share) * joints.positions[before] + share * joints.positions[after], speeds


def shown_bases(identifications: Sequence[ArmIdentification], motions: Sequence[Motion]) -> Iterator[BaseFrame]:
    """Yield the bases that joints show in the frame of poses which are not stated to be in the base."""
    stated = {(motion.arm, motion.topic) for motion in motions if motion.states_base}
    for one in identifications:
        if one.found.verdict == "identified" and (one.arm, one.topic) not in stated:
            yield BaseFrame(
                arm=one.arm,
                frame=one.frame,
                local_frame=f"{one.arm}_base",
                position_mm=one.found.position_mm,
                rotation_xyzw=one.found.rotation_xyzw,
                spread_mm=one.found.greatest_mm,
                spread_rad=one.found.residual_rad or 0.0,
            )


def paired_bases(motions: Sequence[Motion]) -> tuple[BaseFrame, ...]:
    """Find the poses of the bases of arms whose pose was recorded both in the base's frame and in another.

    A base is the pose in the other frame times the inverse of the pose in its own, from samples of equal stamps or the
    nearest within `PAIR_NS`. The result is the median over all pairs of samples, component by component. If the
    orientations do not agree with the tips, the rotation is fitted to the tips, and `spread_rad` is the deviation of
    the orientations from it. Of more than `BASES_LIMIT` pairs of motions only the first are compared.

    Returns:
        One frame for each pair of motions of an arm, in mm; none for pairs with fewer than `PAIRS_LEAST` common
        samples.
    """
    whole = [motion for motion in motions if motion.rotation_xyzw is not None]
    pairs = (
        (local, other)
        for local in whole
        if local.is_local
        for other in whole
        if not other.is_local and local.arm == other.arm and local.frame != other.frame
    )
    # Limited, because each pair of motions costs a pass over its samples.
    found = [_base_frame(local, other) for local, other in islice(pairs, BASES_LIMIT)]
    return tuple(base for base in found if base is not None)


def _base_frame(local: Motion, other: Motion) -> BaseFrame | None:
    """Compute the pose of a base; None if too few samples of the two motions have a counterpart in time."""
    here, there = _pairs(local.stamps_ns, other.stamps_ns)
    if len(here) < PAIRS_LEAST:
        return None
    assert local.rotation_xyzw is not None and other.rotation_xyzw is not None
    turns = _unit(_product(other.rotation_xyzw[there], local.rotation_xyzw[here] * _INVERSE))
    turns *= np.where(turns @ turns[0] < 0, -1.0, 1.0)[:, None]  # q and -q are the same turn
    # The smaller misfit of the tips decides, because recorded orientations may disagree with the tips.
    turn = min(_candidates(turns, local.tip_mm[here], other.tip_mm[there]), key=lambda one: one[0])[1]
    places = other.tip_mm[there] - _turned(turn, local.tip_mm[here])
    place = np.median(places, axis=0)
    sine = np.linalg.norm(_product(turns, turn * _INVERSE)[:, :3], axis=1).max()
    x, y, z = place.tolist()
    qx, qy, qz, qw = turn.tolist()
    return BaseFrame(
        arm=local.arm,
        frame=other.frame,
        local_frame=local.frame,
        position_mm=(x, y, z),
        rotation_xyzw=(qx, qy, qz, qw),
        spread_mm=float(np.linalg.norm(places - place, axis=1).max()),
        spread_rad=float(2.0 * np.arcsin(min(1.0, sine))),
    )


def _candidates(turns: Floats, here_mm: Floats, there_mm: Floats) -> Iterator[tuple[float, Floats]]:
    """Yield candidates for the rotation, each with its misfit in mm: the median of the turns, and a fit to the tips.

    The fit (Kabsch) is determined only if the tips move in more than one direction.
    """
    found = [_unit(np.median(turns, axis=0))]
    one, other = here_mm - here_mm.mean(axis=0), there_mm - there_mm.mean(axis=0)
    left, size, right = np.linalg.svd(other.T @ one)
    if size[1] > len(one) * WIDE_MM**2:
        # The last sign makes it a rotation: the best fit of flat or noisy points may be a reflection.
        proper = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
        found.append(quaternion_of((left @ proper @ right)[None])[0])
    for turn in found:
        places = there_mm - _turned(turn, here_mm)
        yield float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1))), turn


def _pairs(stamps_ns: Ints, others_ns: Ints) -> tuple[Ints, Ints]:
    """Return the indices of samples that belong together: each with the nearest of the others, if near enough."""
    if np.array_equal(stamps_ns, others_ns):  # columns of one table
        every = np.arange(len(stamps_ns))
        return every, every
    after = np.clip(np.searchsorted(others_ns, stamps_ns), 1, max(1, len(others_ns) - 1))
    before = after - 1
    after = np.minimum(after, len(others_ns) - 1)
    nearer = np.where(stamps_ns - others_ns[before] <= others_ns[after] - stamps_ns, before, after)
    near = np.flatnonzero(np.abs(others_ns[nearer] - stamps_ns) <= PAIR_NS)
    return near, nearer[near]


def _product(one: Floats, other: Floats) -> Floats:
    """Multiply quaternions x, y, z, w."""
    v, w = one[..., :3], one[..., 3:]
    u, t = other[..., :3], other[..., 3:]
    vector = w * u + t * v + np.cross(v, u)
    return np.concatenate([vector, w * t - (v * u).sum(axis=-1, keepdims=True)], axis=-1)


def _turned(turn: Floats, points_mm: Floats) -> Floats:
    """Rotate points, shape (N, 3), by one unit quaternion."""
    across = 2.0 * np.cross(turn[:3], points_mm)
    turned: Floats = points_mm + turn[3] * across + np.cross(turn[:3], across)
    return turned


def _unit(quaternions: Floats) -> Floats:
    unit: Floats = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return unit
