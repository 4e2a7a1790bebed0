"""The other arm at the hand-off: PSM_M, which takes the needle from PSM_A (Sec. III-D), and where it takes it.

Two arms have different base frames. The other arm's pose can be expressed in this arm's frame only if the recording has
both poses in one frame: the same pose topic for both arms (such as `measured_cp` in the camera's frame), or this arm's
pose both in its own base and in the other's frame, from which the position of its base follows (`base_frames`). If the
base did not stay in one place, because the camera moved, no partner is returned. If the other arm's base stood still in
that frame as well, its pose in this arm's base is returned too, so that a plan can move both arms.

In a *transfer* the jaws of one arm give a needle to those of another; it is found in both jaws and both tips.

    Recording --find_transfers--> Transfers: who gives and who takes, when the jaws close and open, and a confidence

A jaw holds something from where it closes to where it opens; its opening has a lower and an upper threshold, so that a
jaw that trembles on one of them neither grips nor releases. In a transfer the taker's jaw closes while the giver's is
closed, and stays closed while the giver's opens. Between the two both hold one needle, which is rigid, so that their
tips keep their distance: a grip elsewhere, on tissue or on nothing, does not bind them. Before its jaw closes again the
giver moves away: one that stays has only taken a new grip. And in one recording all transfers are made at about the
same distance between the tips, which need not be the true one: the frames of the two arms may be registered badly, or
not at all, and then only the lengths of their movements are compared. The longer the giver has held and the taker
keeps, the likelier it is a transfer and no reach or regrip. The needle has left the giver's jaw, which opens before,
when the tips have moved against each other.

The confidence is the logistic function of a sum over these observations. Its weights were fitted to synthetic
sessions with known transfers (`tests/demonstration/test_partner.py`), beside an arm that stays and tips that slide past
each other, and not to surgeons; the terms, the limits in seconds, `LIKELY` and `FREE_MM` were chosen with the motion
primitives of real trials at hand (docs/recordings.md). All of this is ours.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp

import numpy as np

from skills.arrays import Flags, Floats, freeze, interpolated, nearest, xyz, xyzw
from skills.demonstration.movement import Span, bridged, same_signs, spans_of
from skills.demonstration.recording import BaseFrame, Motion, Recording, Signal
from skills.fields import Point, Quaternion, computed_field, schema
from skills.kinematics import INSTRUMENTS, matrix_of

NEAR_MM = 40.0  # between tips that hold one needle: 26 mm along its arc, 17 mm across, plus the width of the jaws
APART_S = 0.1  # a pose further away in time is not used


@schema
@dataclass(frozen=True)
class Partner:
    """The pose of the other arm when it takes the needle, in the demonstration's frame.

    Attributes:
        arm: The other arm's name.
        at_s: Time of the pose, in seconds since the recording's `origin_ns`.
        position_mm: Position of its tip.
        rotation_xyzw: Orientation of its tip, a unit quaternion.
        base_mm: Position of its remote centre; None unless the demonstration's frame is this arm's own base and both
            bases stood still in one common frame.
        base_xyzw: Orientation of its base; None if `base_mm` is None.
        instrument: Its instrument's number; None if it was not recorded or no constants are known for it.
    """

    arm: str
    at_s: float
    position_mm: Point
    rotation_xyzw: Quaternion
    base_mm: Point | None = None
    base_xyzw: Quaternion | None = None
    instrument: str | None = None

    @computed_field  # type: ignore[prop-decorator]
    @property
    def approach(self) -> Point:
        """The direction in which the other arm approaches, of length 1: the third column of its rotation matrix."""
        x, y, z = (float(v) for v in matrix_of(np.array([self.rotation_xyzw]))[0][:, 2])
        return x, y, z


@dataclass(frozen=True, eq=False)
class PartnerMotion:
    """The other arm all along a demonstration or a path, in its frame.

    Attributes:
        arm: The other arm's name.
        tip_mm: Positions of its tip at each stamp or phase, shape (T, 3).
        rotation_xyzw: Its orientations there, unit quaternions, shape (T, 4).
        jaw_rad: Angles of its jaw there, shape (T,); None if they were not recorded.
    """

    arm: str
    tip_mm: Floats
    rotation_xyzw: Floats
    jaw_rad: Floats | None = None

    def __post_init__(self) -> None:
        count = len(self.tip_mm)
        freeze(self, tip_mm=(count, 3), rotation_xyzw=(count, 4), jaw_rad=(count,))


def partner_at(
    recording: Recording, motion: Motion, second: float, bases: Sequence[BaseFrame], arm: str | None = None
) -> Partner | None:
    """Find the nearest other arm to this arm's tip at one time of a recording, with its pose in this arm's frame.

    Args:
        recording: A recording of both arms.
        motion: The motion of this arm.
        second: The time, in seconds since the recording's `origin_ns`.
        bases: Result of `base_frames` for the recording.
        arm: Name of the other arm; None for the nearest one.

    Returns:
        The other arm; None if no other arm, or not the one named, is within `NEAR_MM`, if its orientation is not known,
        or if its pose cannot be expressed in this arm's frame.
    """
    here, base = pose_at(recording, motion, second), _base_of(motion, bases)
    if here is None:
        return None
    near: list[tuple[float, Partner]] = []
    for other in recording.motions:
        if other.arm == motion.arm or arm not in (None, other.arm) or other.is_local or other.rotation_xyzw is None:
            continue
        there = pose_at(recording, other, second)
        if there is None:
            continue
        seen = _in_frame_of(motion, base, other, other.tip_mm[[there]], other.rotation_xyzw[[there]])
        if seen is None:
            continue
        (position,), (rotation,) = seen
        apart_mm = float(np.linalg.norm(position - motion.tip_mm[here], axis=-1))
        if apart_mm <= NEAR_MM:
            base_mm, base_xyzw = (None, None) if base is None else _other_base(base, other.arm, bases)
            tool = _instrument_of(recording, other.arm)
            pose = xyz(position), xyzw(rotation)
            near.append((apart_mm, Partner(other.arm, round(second, 6), *pose, base_mm, base_xyzw, tool)))
    return min(near, key=lambda one: one[0])[1] if near else None


def partner_along(
    recording: Recording, motion: Motion, seconds: Floats, bases: Sequence[BaseFrame], arm: str
) -> PartnerMotion | None:
    """Return the other arm at each time of a demonstration, in the frame of this arm's motion.

    Args:
        recording: A recording of both arms.
        motion: The motion of this arm.
        seconds: Times since the recording's `origin_ns`, increasing, shape (T,).
        bases: Result of `base_frames` for the recording.
        arm: Name of the other arm.

    Returns:
        The other arm's motion; None if its orientation is not known, if its poses cannot be expressed in this arm's
        frame, or if there is none of them within `APART_S` of each time.
    """
    base = _base_of(motion, bases)
    for other in recording.motions:
        if other.arm != arm or other.is_local or other.rotation_xyzw is None:
            continue
        stamps_s = recording.seconds(other.stamps_ns)
        near = np.abs(stamps_s[nearest(stamps_s, seconds)] - seconds) <= APART_S
        seen = _in_frame_of(motion, base, other, other.tip_mm, other.rotation_xyzw)
        if seen is None or not near.all():
            continue
        tip_mm, turned = (interpolated(seconds, stamps_s, rows) for rows in (seen[0], same_signs(seen[1])))
        return PartnerMotion(arm, tip_mm, turned / np.linalg.norm(turned, axis=1, keepdims=True))
    return None


def in_base(partner: Partner, base: BaseFrame, bases: Sequence[BaseFrame]) -> Partner:
    """Transform the other arm's pose into this arm's base.

    Args:
        partner: The other arm in the frame in which this arm's base stands.
        base: This arm's base.
        bases: Result of `base_frames` for the recording.
    """
    position, rotation = _seen_from(base, np.array(partner.position_mm), np.array(partner.rotation_xyzw))
    base_mm, base_xyzw = _other_base(base, partner.arm, bases) if base.is_steady else (None, None)
    position_mm, rotation_xyzw = xyz(position), xyzw(rotation)
    return replace(partner, position_mm=position_mm, rotation_xyzw=rotation_xyzw, base_mm=base_mm, base_xyzw=base_xyzw)


def pose_at(recording: Recording, motion: Motion, second: float) -> int | None:
    """Find the sample of a motion that is nearest to a time.

    Args:
        recording: The recording, for its `origin_ns`.
        motion: A motion of the recording.
        second: The time, in seconds since `origin_ns`.

    Returns:
        Index of the sample; None if no sample is within `APART_S`.
    """
    stamp_ns = recording.origin_ns + round(second * 1e9)
    index = int(nearest(motion.stamps_ns, np.array([stamp_ns]))[0])
    return index if abs(int(motion.stamps_ns[index]) - stamp_ns) <= APART_S * 1e9 else None


def _base_of(motion: Motion, bases: Sequence[BaseFrame]) -> BaseFrame | None:
    """Return the base of a local motion's arm in the frame of its other poses; None unless it stood still there."""
    for one in bases:
        if (one.arm, one.local_frame) == (motion.arm, motion.frame) and motion.is_local and one.is_steady:
            return one
    return None


def _other_base(base: BaseFrame, arm: str, bases: Sequence[BaseFrame]) -> tuple[Point, Quaternion] | tuple[None, None]:
    """Return the pose of another arm's base in this arm's base; None unless both stood still in one common frame."""
    for one in bases:
        if (one.arm, one.frame) == (arm, base.frame) and one.is_steady:
            position, rotation = _seen_from(base, np.array(one.position_mm), np.array(one.rotation_xyzw))
            return xyz(position), xyzw(rotation)
    return None, None


def _instrument_of(recording: Recording, arm: str) -> str | None:
    """Return the instrument of an arm, such as 400006; None if it is not known, or its constants are not."""
    number = recording.instrument_on(arm)
    return number if number in INSTRUMENTS else None


def _in_frame_of(
    motion: Motion, base: BaseFrame | None, other: Motion, position_mm: Floats, rotation_xyzw: Floats
) -> tuple[Floats, Floats] | None:
    """Return another arm's poses, (T, 3) and (T, 4), in the frame of a motion; None if they share none."""
    if base is not None and other.frame == base.frame:
        return base.seen_from(position_mm, rotation_xyzw)
    # A local pose and another arm's pose share no frame, even if a recorder gave both frames the same name.
    if motion.is_local or not motion.frame or other.frame != motion.frame:
        return None
    return position_mm, rotation_xyzw


def _seen_from(base: BaseFrame, position_mm: Floats, rotation_xyzw: Floats) -> tuple[Floats, Floats]:
    """Transform one pose from the frame in which a base stands into the base's own frame."""
    position, rotation = base.seen_from(position_mm[None], rotation_xyzw[None])
    return position[0], rotation[0]


JAW_RANGE_RAD = 0.2  # a jaw that moves less never opened
CLOSED_SHARE, OPEN_SHARE = 0.3, 0.45  # of the jaw's range: closed below the first, open above the second
EXTREME = 0.02  # quantiles at the ends of the range, so that one value far outside does not stretch it
REGRIP_S = 0.3  # a shorter opening of the jaw is a new grip, not a release
HOLD_S = 0.4  # the giver's jaw was closed at least so long before the taker's, and the taker's stays closed so long
BOTH_S = 5.0  # longest time in which both hold the needle
LATE_S = 0.2  # the taker's jaw may close so much later: it holds before it is counted as closed
LONG_S = 4.0  # longer holds, of the giver before and of the taker after, prove no more
LOOKS = 20  # samples of the time in which both hold
AFTER_S = 3.0  # time after the release in which the giver moves away
AFTER_LOOKS = 91  # samples of it, thirty per second as in JIGSAWS
FREE_MM = 5.0  # the needle has left the giver when the tips have moved so far against each other since its jaw opened
PARTED_MM = 15.0  # further away proves no more
CLEAR_SLIP_MM, CLEAR_PARTED_MM = 2.0, 8.0  # of the transfers that show the usual distance

# Weights of the confidence, see above: of a constant, of each mm of slip, of each mm that the giver moves away, of each
# mm between the distance and the usual one, and of each second for which the giver and the taker hold.
WEIGHTS = (-13.7, -0.65, 0.77, -0.41, 2.5, 0.52)
WITHOUT_FRAME = (-19.5, -0.48, 0.47, 0.0, 3.4, 1.2)  # if the poses of the two arms share no frame
LIKELY = 0.3  # below a half: a wrong proposal is rejected in a moment, and a missing one has to be cut by hand
ODDS = 30.0  # beyond these the exponential is of no use


@dataclass(frozen=True)
class NeedleTransfer:
    """One transfer of a needle; times are in seconds since the recording's `origin_ns`.

    Attributes:
        giver: The arm that held the needle.
        taker: The arm that takes it.
        held_s: The giver's jaw closed.
        taken_s: The taker's jaw closes.
        released_s: The giver's jaw opens.
        freed_s: The needle has left the giver's jaw: the tips have parted by `FREE_MM`.
        slip_mm: Change of the distance between the two tips while both hold.
        confidence: Probability that it is one, 0 to 1.
    """

    giver: str
    taker: str
    held_s: float
    taken_s: float
    released_s: float
    freed_s: float
    slip_mm: float
    confidence: float


def closed_jaw(recording: Recording, arm: str) -> list[Span] | None:
    """Return the intervals in which the jaw of an arm is closed, in s; None if it was not recorded or never moved.

    Args:
        recording: The recording.
        arm: Name of the arm.
    """
    jaw = recording.jaw_of(arm)
    if jaw is None or len(jaw.values) == 0:
        return None
    least, most = np.quantile(jaw.values, (EXTREME, 1.0 - EXTREME)).tolist()
    if most - least < JAW_RANGE_RAD:
        return None
    return bridged(spans_of(recording.seconds(jaw.stamps_ns), _closed(jaw, least, most)), REGRIP_S)


def _closed(jaw: Signal, least: float, most: float) -> Flags:
    """Return for each sample whether the jaw is closed; between the two thresholds it is as it was before."""
    share = (jaw.values - least) / (most - least)
    decided = np.flatnonzero((share < CLOSED_SHARE) | (share > OPEN_SHARE))
    last = np.searchsorted(decided, np.arange(len(share)), side="right") - 1
    return np.asarray((share < CLOSED_SHARE)[decided[np.maximum(last, 0)]])


def find_transfers(
    recording: Recording, closed: Mapping[str, Sequence[Span] | None], bases: Sequence[BaseFrame]
) -> tuple[NeedleTransfer, ...]:
    """Find the transfers between any two arms of a recording.

    Args:
        recording: The recording.
        closed: The result of `closed_jaw` for each arm.
        bases: The result of `base_frames` for the recording.

    Returns:
        The transfers with a confidence of at least `LIKELY`, in the order of their releases; each release is of one.
    """
    found = []
    for giver in recording.arms:
        for taker in recording.arms:
            holds, grips = closed[giver], closed[taker]
            if giver != taker and holds and grips:
                found += _overlaps(giver, taker, holds, grips)
    seen = [_observed(recording, one, bases) for one in found]
    usual_mm = {pair: _usual_mm([one for one in seen if one.pair == pair]) for pair in {one.pair for one in seen}}
    likely: dict[tuple[str, float], NeedleTransfer] = {}
    for one in seen:
        transfer = one.judged(usual_mm[one.pair])
        key = transfer.giver, transfer.released_s
        if transfer.confidence >= max(LIKELY, likely[key].confidence if key in likely else 0.0):
            likely[key] = transfer
    return tuple(sorted(likely.values(), key=lambda one: one.released_s))


@dataclass(frozen=True)
class _Overlap:
    """A hold of the giver's jaw in which the taker's closes and which it outlasts; times in s since `origin_ns`."""

    giver: str
    taker: str
    held_s: float
    taken_s: float
    released_s: float
    again_s: float  # the giver's jaw closes again
    keeps_s: float  # the taker's jaw opens


@dataclass(frozen=True)
class _Observed:
    """The motion of both tips around an overlap.

    Attributes:
        overlap: The overlap.
        slip_mm: Change of the distance between the tips while both jaws are closed.
        parted_mm: Greatest distance of the giver's tip from where it was at the release, in the time after it.
        apart_mm: Mean distance between the tips while both jaws are closed; None if the arms share no frame.
    """

    overlap: _Overlap
    freed_s: float
    slip_mm: float
    parted_mm: float
    apart_mm: float | None

    @property
    def pair(self) -> tuple[str, ...]:
        """The names of both arms, sorted: the usual distance is that of a pair, whichever of them gives."""
        return tuple(sorted((self.overlap.giver, self.overlap.taker)))

    def judged(self, usual_mm: float | None) -> NeedleTransfer:
        """Return it as a transfer with its confidence, given the usual distance between the tips of this pair."""
        one = self.overlap
        deviation_mm = 0.0 if self.apart_mm is None or usual_mm is None else abs(self.apart_mm - usual_mm)
        holds_s = min(one.taken_s - one.held_s, LONG_S), min(one.keeps_s - one.released_s, LONG_S)
        seen = (1.0, self.slip_mm, min(self.parted_mm, PARTED_MM), deviation_mm, *holds_s)
        weights = WITHOUT_FRAME if self.apart_mm is None else WEIGHTS
        odds = sum(weight * value for weight, value in zip(weights, seen, strict=True))
        confidence = 1.0 / (1.0 + exp(-max(odds, -ODDS)))
        spans_s = one.held_s, one.taken_s, one.released_s, self.freed_s
        return NeedleTransfer(one.giver, one.taker, *spans_s, self.slip_mm, confidence)


def _overlaps(giver: str, taker: str, holds: Sequence[Span], grips: Sequence[Span]) -> list[_Overlap]:
    """Find where the taker's jaw closes within a hold of the giver's, and outlasts it."""
    starts = np.array([start for start, _ in grips])
    found = []
    for number, (held_s, released_s) in enumerate(holds):
        again_s = holds[number + 1][0] if number + 1 < len(holds) else np.inf
        first, last = np.searchsorted(starts, (max(held_s + HOLD_S, released_s - BOTH_S), released_s + LATE_S))
        for taken_s, until_s in grips[first:last]:
            if until_s > released_s + HOLD_S:
                found.append(_Overlap(giver, taker, held_s, taken_s, released_s, again_s, until_s))
    return found


def _observed(recording: Recording, one: _Overlap, bases: Sequence[BaseFrame]) -> _Observed:
    """Observe the two tips while both arms hold, and after the release."""
    giver, taker = (recording.motion_of(arm=arm) for arm in (one.giver, one.taker))
    here_s, there_s = recording.seconds(giver.stamps_ns), recording.seconds(taker.stamps_ns)
    last_s = max(one.released_s, min(one.again_s, one.keeps_s, one.released_s + AFTER_S, here_s[-1], there_s[-1]))
    both_s = np.linspace(min(one.taken_s, one.released_s), max(one.taken_s, one.released_s), LOOKS)
    after_s = np.linspace(one.released_s, last_s, AFTER_LOOKS)
    seconds = np.concatenate([both_s, after_s])
    here_mm = interpolated(seconds, here_s, giver.tip_mm)
    other = partner_along(recording, giver, seconds, bases, one.taker)
    if other is not None:
        between_mm = here_mm - other.tip_mm
        apart_mm = np.linalg.norm(between_mm[:LOOKS], axis=1)
        slip_mm, usual_mm = float(np.ptp(apart_mm)), float(apart_mm.mean())
    else:
        between_mm, there_mm = here_mm, interpolated(both_s, there_s, taker.tip_mm)
        ways_mm = [np.linalg.norm(tip_mm - tip_mm[0], axis=1) for tip_mm in (here_mm[:LOOKS], there_mm)]
        slip_mm, usual_mm = float(np.abs(ways_mm[0] - ways_mm[1]).max()), None
    parted_mm, free_mm = (np.linalg.norm(way[LOOKS:] - way[LOOKS], axis=1) for way in (here_mm, between_mm))
    free = np.append(np.flatnonzero(free_mm > FREE_MM), AFTER_LOOKS - 1)[0]
    return _Observed(one, float(after_s[free]), slip_mm, float(parted_mm.max()), usual_mm)


def _usual_mm(seen: Sequence[_Observed]) -> float | None:
    """Return the median distance of the tips over the clearest transfers of two arms; None if there is none."""
    clear = [one.apart_mm for one in seen if one.slip_mm < CLEAR_SLIP_MM and one.parted_mm > CLEAR_PARTED_MM]
    known = [apart_mm for apart_mm in clear if apart_mm is not None]
    return float(np.median(known)) if known else None
