"""Pose styles: the motion of a hand as position, orientation, jaw and tempo along one phase.

    Demos --learn_pose_style--> PoseStyle --between--> PosePath   at a start and a goal pose that were not demonstrated

The policies of the grid know positions only. A pose style keeps what a hand does: phase is the share of the time of a
demonstration, and every demonstration is resampled at `PHASES` of them. The paper has no orientation; all of this is
ours.

A demonstration is *laid* between another start and goal by adding what its ends lack, blended over the phase by a
smoothstep, which moves neither end's velocity: to the position a vector, to the orientation a rotation. The path at a
start and a goal is the weighted mean of all laid demonstrations. Those that were shown in a situation more like this
one count more (`_weights`), so that a style which is performed differently at different places is not averaged away.
Before the mean is taken they are warped onto each other in time (DTW, as in `skills.learning.evaluation`), since a mean
of motions that are not in step is smoother than each; afterwards the mean tempo is restored.

Orientations are averaged as by Markley et al. (Averaging Quaternions, J. Guid. Control Dyn. 30, 2007): the mean is the
eigenvector of the largest eigenvalue of the sum of the quaternions' outer products.

Where demonstrations turn the jaw in unlike ways, their mean is further from another one than the shortest turn from
start to goal. So the orientations are only a share of the way from that turn to the mean: the share that is best for
each demonstration predicted from the others (`_turn_share`). It is 1 where they agree, and for a single one.

The other arm, PSM_M, is learnt as it moves relative to this arm's pose at the hand-off, where both hold the needle; so
it moves with the goal, and in step with this arm.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from skills.arithmetic import product
from skills.arrays import Floats, freeze, frozen
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import same_signs
from skills.demonstration.partner import PartnerMotion
from skills.errors import BadInput, MixedFrames
from skills.learning.evaluation import dtw
from skills.quaternions import INVERSE, angle_of, between, mean_rotation, multiplied, of_vector, turned, unit, vector_of

PHASES = 101  # ours: a hundredth of a hand-off of 5 s is a twentieth of a second, in which a hand does not turn back
# Ours: the steps of a DTW path are no tempo, so it is smoothed by a Gaussian window of standard deviation 3 phases.
_POWERS = np.cumprod([1.0, *[0.9459594689067654] * 144])  # of exp(-1 / 18)
WARP_SMOOTHING = _POWERS[np.square(np.arange(-12, 13))] / _POWERS[np.square(np.arange(-12, 13))].sum()
UNIT_TOLERANCE = 1e-3  # of a quaternion's length; three printed decimals pass
LIKE_FLOOR = 1e-6  # of squared distances between situations; several demonstrations may share one
SHARES = np.linspace(1.0, 0.0, 21)  # of the demonstrations' turn; of equally good ones the first is chosen
TRIED = 5  # every fifth phase is enough to choose it
FAR_RAD = 0.9 * np.pi  # at half a turn from the shortest turn, the side on which the mean lies changes suddenly


@dataclass(frozen=True, eq=False)
class PosePath:
    """One motion of a hand.

    Attributes:
        tip_mm: Positions of the tip, shape (N, 3), in the frame of the style.
        rotation_xyzw: Orientations in that frame, unit quaternions, shape (N, 4).
        elapsed_s: Time from the start, shape (N,), increasing from 0.
        jaw_rad: Angle of the jaw, shape (N,); None if not every demonstration has it.
        spread_mm: Standard deviation of the demonstrations' positions about the path, shape (N,); 0 for a single one.
        spread_rad: Standard deviation of their orientations about the path, shape (N,).
        turn_share: Where the orientations are between the shortest turn from start to goal, 0, and the mean of the
            demonstrations, 1.
        partner: The other arm at the same phases, in the same frame; None if the style has none.
    """

    tip_mm: Floats
    rotation_xyzw: Floats
    elapsed_s: Floats
    jaw_rad: Floats | None
    spread_mm: Floats
    spread_rad: Floats
    turn_share: float = 1.0
    partner: PartnerMotion | None = None

    def __post_init__(self) -> None:
        count = len(self.tip_mm)
        freeze(self, tip_mm=(count, 3), rotation_xyzw=(count, 4), elapsed_s=(count,), jaw_rad=(count,))
        freeze(self, spread_mm=(count,), spread_rad=(count,))
        if self.partner is not None and len(self.partner.tip_mm) != count:
            raise BadInput(f"The other arm has {len(self.partner.tip_mm)} poses, and the path {count}.")


@dataclass(frozen=True, eq=False)
class PoseStyle:
    """The demonstrations of one style, resampled along their phase.

    Attributes:
        frame: The frame of all poses.
        tip_mm: Positions, shape (K, PHASES, 3).
        rotation_xyzw: Orientations, unit quaternions, shape (K, PHASES, 4).
        duration_s: Duration of each demonstration, shape (K,).
        jaw_rad: Angles of the jaw, shape (K, PHASES); None if not every demonstration has it.
        turn_share: The share of their mean turn in a motion, 0 to 1; the rest is the shortest turn.
        partners: The other arm at each phase of each demonstration, as seen from this arm's pose at the hand-off; None
            if it is not learnt.
    """

    frame: str
    tip_mm: Floats
    rotation_xyzw: Floats
    duration_s: Floats
    jaw_rad: Floats | None = None
    turn_share: float = 1.0
    partners: tuple[PartnerMotion, ...] | None = None

    def __post_init__(self) -> None:
        count = len(self.tip_mm)
        freeze(self, tip_mm=(count, PHASES, 3), rotation_xyzw=(count, PHASES, 4))
        freeze(self, duration_s=(count,), jaw_rad=(count, PHASES))

    def between(self, start_mm: ArrayLike, start_xyzw: ArrayLike, goal_mm: ArrayLike, goal_xyzw: ArrayLike) -> PosePath:
        """Return the style's motion from a start pose to a goal pose; it begins and ends in them exactly.

        Args:
            start_mm: Position of the start in `frame`, shape (3,).
            start_xyzw: Its orientation, a unit quaternion, shape (4,).
            goal_mm: Position of the goal, shape (3,).
            goal_xyzw: Its orientation, shape (4,).

        Returns:
            The motion at `PHASES` phases.

        Raises:
            BadInput: A number is not finite, or a quaternion is not a unit quaternion.
        """
        ends = np.stack([frozen(start_mm, np.float64, (3,), "start_mm"), frozen(goal_mm, np.float64, (3,), "goal_mm")])
        turns = unit(np.stack([unit_quaternion(start_xyzw, "start_xyzw"), unit_quaternion(goal_xyzw, "goal_xyzw")]))
        tips = np.stack([laid_tip(tip, ends) for tip in self.tip_mm])
        rotations = laid_rotations(self.rotation_xyzw, turns)
        weights = self._weights(ends, turns)
        jaws = np.zeros(tips.shape[:2]) if self.jaw_rad is None else self.jaw_rad
        elapsed, warps = np.linspace(0.0, 1.0, PHASES), np.tile(np.arange(float(PHASES)), (len(tips), 1))
        if len(tips) > 1:
            mean = np.einsum("k,kpi->pi", weights, tips)
            warps = np.stack([_warp(tip, mean) for tip in tips])
            tips = np.stack([_at(tip, warp) for tip, warp in zip(tips, warps, strict=True)])
            rotations = np.stack([_turn_at(one, warp) for one, warp in zip(rotations, warps, strict=True)])
            jaws = np.stack([_at(jaw, warp) for jaw, warp in zip(jaws, warps, strict=True)])
            elapsed = product(weights, warps) / (PHASES - 1)
        tip_mm, rotation = np.einsum("k,kpi->pi", weights, tips), mean_rotation(rotations, weights)
        apart = _apart(_shortest(turns, elapsed), rotation)
        turn_share = self.turn_share if np.linalg.norm(apart, axis=1).max() < FAR_RAD else 1.0
        if turn_share < 1.0:
            rotation = multiplied(_shortest(turns, elapsed), of_vector(turn_share * apart))
        off_mm = np.linalg.norm(tips - tip_mm, axis=2)
        off_rad = angle_of(multiplied(rotations * INVERSE, rotation))
        spread_mm, spread_rad = (np.sqrt(product(weights, off * off)) for off in (off_mm, off_rad))
        # The phase of the result is the share of its own time again: the mean tempo of the demonstrations.
        again = np.interp(np.linspace(0.0, 1.0, PHASES), elapsed, np.arange(PHASES))
        return PosePath(
            _at(tip_mm, again),
            same_signs(_turn_at(rotation, again)),
            np.linspace(0.0, 1.0, PHASES) * float(product(weights, self.duration_s)),
            None if self.jaw_rad is None else _at(product(weights, jaws), again),
            _at(spread_mm, again),
            _at(spread_rad, again),
            turn_share,
            self._partner(ends[1], turns[1], weights, warps, again),
        )

    def _partner(
        self, goal_mm: Floats, goal: Floats, weights: Floats, warps: Floats, again: Floats
    ) -> PartnerMotion | None:
        """Return the other arm beside a motion: the weighted mean as seen from the goal, in step with this arm."""
        if self.partners is None:
            return None
        tips = np.stack([_at(one.tip_mm, warp) for one, warp in zip(self.partners, warps, strict=True)])
        turns = np.stack([_turn_at(one.rotation_xyzw, warp) for one, warp in zip(self.partners, warps, strict=True)])
        seen = _turn_at(mean_rotation(turns, weights), again)
        tip_mm = goal_mm + turned(goal, _at(np.einsum("k,kpi->pi", weights, tips), again))
        jaws = [one.jaw_rad for one in self.partners if one.jaw_rad is not None]
        jaw_rad = None
        if len(jaws) == len(self.partners):
            jaw_rad = _at(product(weights, np.stack([_at(*one) for one in zip(jaws, warps, strict=True)])), again)
        return PartnerMotion(self.partners[0].arm, tip_mm, same_signs(multiplied(goal, seen)), jaw_rad)

    def _weights(self, ends: Floats, turns: Floats) -> Floats:
        """Return the weight of each demonstration between two poses, (K,), with sum 1.

        Situations differ by the vector from start to goal and by the start's position, both in units of the mean
        distance from start to goal, and by the orientations of start and goal in rad. The weight is 1 / (1 + d^2 / n),
        where d is the distance to this situation, and n the median of each demonstration's d^2 to its nearest other.
        """
        if len(self.tip_mm) == 1:
            return np.ones(1)
        shown = [
            _Situation(tip[[0, -1]], rotation[[0, -1]])
            for tip, rotation in zip(self.tip_mm, self.rotation_xyzw, strict=True)
        ]
        length = float(np.mean([np.linalg.norm(one.ends[1] - one.ends[0], axis=-1) for one in shown]))
        length = max(length, np.finfo(float).tiny)
        among = np.array([[one.apart(other, length) for other in shown] for one in shown])
        np.fill_diagonal(among, np.inf)
        usual = max(float(np.median(among.min(axis=1))), LIKE_FLOOR)
        here = _Situation(ends, turns)
        weights = 1.0 / (1.0 + np.array([one.apart(here, length) for one in shown]) / usual)
        return np.asarray(weights / weights.sum())


@dataclass(frozen=True, eq=False)
class _Situation:
    """Start and goal of a motion: positions (2, 3) and orientations (2, 4)."""

    ends: Floats
    turns: Floats

    def apart(self, other: "_Situation", length_mm: float) -> float:
        """Return the squared distance of two situations."""
        line = (self.ends[1] - self.ends[0]) - (other.ends[1] - other.ends[0])
        moved = np.concatenate([line, self.ends[0] - other.ends[0]]) / length_mm
        turned = angle_of(multiplied(self.turns * INVERSE, other.turns))
        return float((moved * moved).sum() + (turned * turned).sum())


def learn_pose_style(demos: Sequence[Demo], partners: Sequence[PartnerMotion | None] | None = None) -> PoseStyle:
    """Learn a pose style from demonstrations of one surgeon and suture type.

    Args:
        demos: At least one, all in one frame and with orientation.
        partners: The other arm along each demonstration (`skills.demonstration.demonstration.partner_motion`). It is
            learnt if every demonstration has one, and None leaves it out.

    Returns:
        The style.

    Raises:
        BadInput: There is no demonstration, or one has no orientation; or the partners are not those of the
            demonstrations, or of several arms.
        MixedFrames: They are in different frames.
    """
    if not demos:
        raise BadInput("A pose style needs at least one demonstration.")
    frames = sorted({demo.frame for demo in demos})
    if len(frames) > 1:
        raise MixedFrames(f"The demonstrations are in the frames {', '.join(frames)}; choose those in one frame.")
    tips, rotations, jaws = [], [], []
    for demo in demos:
        if demo.rotation_xyzw is None:
            raise BadInput(
                f"The demonstration of {demo.arm} at {demo.start_s:g} s has no orientation, which a pose style needs; "
                "leave it out."
            )
        places = _places(demo)
        tips.append(_at(demo.tip_mm, places))
        rotations.append(_turn_at(demo.rotation_xyzw, places))
        if demo.jaw_rad is not None:
            jaws.append(_at(demo.jaw_rad, places))
    return PoseStyle(
        frames[0],
        np.stack(tips),
        np.stack(rotations),
        np.array([demo.stamps_s[-1] for demo in demos]),
        np.stack(jaws) if len(jaws) == len(demos) else None,
        _turn_share(np.stack(rotations)),
        None if partners is None else _partners(demos, partners),
    )


def _places(demo: Demo) -> Floats:
    """Return the place of each phase among a demonstration's samples, an index with fraction, (PHASES,)."""
    seconds = np.linspace(0.0, demo.stamps_s[-1], PHASES)
    return np.interp(seconds, demo.stamps_s, np.arange(len(demo.stamps_s)))


def _partners(demos: Sequence[Demo], partners: Sequence[PartnerMotion | None]) -> tuple[PartnerMotion, ...] | None:
    """Return the other arm at each phase of each demonstration, seen from this arm's last pose; None if one has none.

    Raises:
        BadInput: They are not along the demonstrations, or of several arms.
    """
    known = [one for one in partners if one is not None]
    if len(partners) != len(demos) or len({one.arm for one in known}) > 1:
        raise BadInput("Give the other arm's motion of each demonstration, all of one arm, or None where it has none.")
    if len(known) < len(partners):
        return None
    found = []
    for demo, other in zip(demos, known, strict=True):
        if len(other.tip_mm) != len(demo.stamps_s):
            raise BadInput(
                f"The other arm's motion has {len(other.tip_mm)} samples, and its demonstration {len(demo.stamps_s)}; "
                "take it from the recording at the demonstration's stamps."
            )
        assert demo.rotation_xyzw is not None, "checked by the caller"
        last = unit(demo.rotation_xyzw[-1]) * INVERSE
        at = _places(demo)
        seen = multiplied(last, _turn_at(other.rotation_xyzw, at))
        seen_mm, jaw_rad = turned(last, _at(other.tip_mm, at) - demo.tip_mm[-1]), other.jaw_rad
        jaw_rad = None if jaw_rad is None else _at(jaw_rad, at)
        found.append(PartnerMotion(other.arm, seen_mm, seen, jaw_rad))
    return tuple(found)


def _turn_share(rotation_xyzw: Floats) -> float:
    """Return the share of the demonstrations' mean turn that is best for one which is not among them.

    Each demonstration is predicted from the others, between its own start and goal, with every one of `SHARES`. The
    best share has the least mean angle. It is chosen once without the error of each demonstration, and the median of
    these choices is returned, so that no single demonstration decides.

    Args:
        rotation_xyzw: The orientations of the demonstrations, unit quaternions, shape (K, PHASES, 4).
    """
    shown = rotation_xyzw[:, ::TRIED]
    if len(shown) == 1:
        return 1.0
    errors, even = [], np.full(len(shown) - 1, 1.0 / (len(shown) - 1))
    phase = np.linspace(0.0, 1.0, shown.shape[1])
    for left_out, own in enumerate(shown):
        ends = own[[0, -1]]
        shortest = _shortest(ends, phase)
        mean = mean_rotation(laid_rotations(np.delete(shown, left_out, axis=0), ends), even)
        wanted, apart = multiplied(shortest * INVERSE, own), _apart(shortest, mean)
        back = of_vector(-SHARES[:, None, None] * apart)
        errors.append(angle_of(multiplied(back, wanted)).mean(axis=1))
    total = np.sum(errors, axis=0) - errors
    return float(np.median(SHARES[total.round(9).argmin(axis=1)]))


def _shortest(ends: Floats, shares: Floats) -> Floats:
    """Return the shortest turn from one orientation to another, at shares of it, (N,)."""
    return between(ends[0], ends[1], shares.clip(0.0, 1.0))  # rounding may leave the range


def _apart(base: Floats, rotation_xyzw: Floats) -> Floats:
    """Return the rotations, as vectors in rad, (N, 3), that lead from a base to orientations, (N, 4)."""
    return vector_of(multiplied(base * INVERSE, rotation_xyzw))


def unit_quaternion(values: ArrayLike, name: str) -> Floats:
    """Return a unit quaternion x, y, z, w, shape (4,).

    Args:
        values: The four numbers.
        name: Their name, for the message.

    Returns:
        The same numbers, read-only; a length within `UNIT_TOLERANCE` of 1 is not corrected.

    Raises:
        BadInput: It has another shape, a number is NaN or infinite, or its length is not 1.
    """
    quaternion = frozen(values, np.float64, (4,), name)
    length = float(np.linalg.norm(quaternion, axis=-1))
    if not abs(length - 1.0) <= UNIT_TOLERANCE:
        raise BadInput(f"{name} must be a unit quaternion x, y, z, w; it has length {length:g}.")
    return quaternion


def _blend(count: int) -> Floats:
    """Return the share of the goal's correction at each phase, (count,): a smoothstep."""
    phase = np.linspace(0.0, 1.0, count)
    return np.asarray(phase * phase * (3.0 - 2.0 * phase))


def laid_tip(tip_mm: Floats, ends_mm: Floats) -> Floats:
    """Return positions laid between two ends.

    The corrections of both ends are blended along the phases with a smoothstep.

    Args:
        tip_mm: Positions of one motion, shape (P, 3).
        ends_mm: The new first and last position in the same frame, shape (2, 3).

    Returns:
        The positions, shape (P, 3); the first and the last are the ends.
    """
    share = _blend(len(tip_mm))[:, None]
    return np.asarray(tip_mm + (1.0 - share) * (ends_mm[0] - tip_mm[0]) + share * (ends_mm[1] - tip_mm[-1]))


def laid_rotations(rotation_xyzw: Floats, ends: Floats) -> Floats:
    """Return the orientations of each demonstration laid between two ends.

    As for `laid_tip`, the corrections of both ends are blended along the phases.

    Args:
        rotation_xyzw: Orientations of K demonstrations, unit quaternions, shape (K, P, 4).
        ends: The new first and last orientation in the same frame, unit quaternions, shape (2, 4).

    Returns:
        Unit quaternions, shape (K, P, 4); the first and the last orientation of each demonstration are the ends.
    """
    first, last = (multiplied(ends[k], rotation_xyzw[:, k] * INVERSE)[:, None] for k in (0, -1))
    over = vector_of(multiplied(last, first * INVERSE)) * _blend(rotation_xyzw.shape[1])[:, None]
    return multiplied(of_vector(over), multiplied(first, rotation_xyzw))


def _warp(tip_mm: Floats, mean_mm: Floats) -> Floats:
    """Return the place in a motion, an index with fraction, that corresponds to each phase of the mean, (PHASES,)."""
    from scipy.ndimage import correlate1d  # here: a fifth of a second that only learning needs

    pairs = dtw(mean_mm, tip_mm).pairs
    places = np.bincount(pairs[:, 0], pairs[:, 1]) / np.bincount(pairs[:, 0])
    smooth = np.maximum.accumulate(correlate1d(places, WARP_SMOOTHING, mode="nearest"))
    smooth[0], smooth[-1] = 0.0, PHASES - 1.0
    return np.asarray(smooth)


def _at(values: Floats, places: Floats) -> Floats:
    """Return values at places, indices with fractions."""
    before = np.minimum(places.astype(np.int64), len(values) - 2)
    share = (places - before).reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray((1.0 - share) * values[before] + share * values[before + 1])


def _turn_at(rotation_xyzw: Floats, places: Floats) -> Floats:
    """Return orientations at places, along the shorter way between two neighbours."""
    before = np.minimum(places.astype(np.int64), len(rotation_xyzw) - 2)
    turns = unit(rotation_xyzw)
    return between(turns[before], turns[before + 1], places - before)
