"""Monte Carlo: the probability that a plan succeeds in the presence of errors, from seeded variations in closed form.

    Trajectory --doubt--> Doubt: how often each pass stays clear and its needle is caught

A *variation* of a pass draws three errors, independently of one another and of other passes:

* Tip error. Each arm is offset from the place that its joints give, by an offset that stays over the pass, as after a
  registration: even in all directions, normally distributed, of a mean length of 0.65 mm (a calibrated dVRK) or 3 mm
  (an uncalibrated one): Hwang et al., "Efficiently Calibrating Cable-Driven Surgical Robots With RGBD Fiducial Sensing
  and Recurrent Neural Networks" (arXiv:2003.08520), measured a mean tracking error of 2.96 mm, and of 0.65 mm once
  calibrated. The arms' offsets are independent, so between the jaws it is sqrt(2) of one. Joints stay as commanded; the
  complete arm is offset.
* Suture point. The pass, and all that belongs to it (pad, needle, hand-off), is shifted by up to 5 mm along each axis,
  drawn uniformly. The arms' bases stay, and the joints are solved again.
* Needle angle. The needle stands in PSM_A's jaws with an error of up to 10 degrees, drawn uniformly, about any axis
  through the grip.

A variation is *clear* if every checked pose of the pass keeps to the playback's limits: joints, cannula, pad, and the
other arm with its outer bodies, if its place is known; fingers may touch fingers at the hand-off itself. Speeds are not
judged: a plan made for the shifted point has its own.

The needle is *caught* if its arc crosses the plane in which PSM_M's fingers close, at the end of A2, within the sector
that they sweep, with needle to spare on both sides of them, and its tangent there is within the stated angle of their
hinge. That requires PSM_M's desired pose but not its base. Without PSM_M's approach there is no hand-off to judge.

Only a few samples of a pass are checked. That is enough for the pad: the jaws are turned as planned in every variation,
so fingers and hinge are translated without rotation, and the sample in which they are nearest to the pad stays the
same; wrist and shaft are behind them. With another offset the arms may be nearest to each other in another sample, so
some samples all along the path are checked.

The paper has its arms exactly in place; all of this is ours, except the two measured errors.
"""

from dataclasses import dataclass, field, replace
from math import inf, isfinite, pi, radians, sqrt

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Bytes, Flags, Floats, Ints
from skills.errors import BadInput, BadSettings
from skills.fields import Count, Figure, Fraction, schema
from skills.kinematics import CANNULA_MM, INSERTION, forward, instrument_of, joint_margins, matrix_of, solutions_of
from skills.learning.slip import wilson
from skills.planning.handoff import OPEN_RAD, hand_off
from skills.planning.motion_laws import Pose
from skills.planning.trajectory import A2, Trajectory
from skills.verification.bodies import too_near
from skills.verification.clearance import (
    FINGERS,
    HandOff,
    Links,
    catch,
    clearance_between,
    clearance_to_pad,
    links_of,
    openings,
    travel_mm,
)
from skills.verification.verdict import Limits

_MEAN_LENGTH = sqrt(8 / pi)  # of a vector of three standard normal numbers
_CHUNK = 64  # variations computed at once, so that they stay in the processor's cache; the results do not depend on it
_STILL_MM = 1e-6  # with less total travel, a pass is one stretch
_ROUND_OFF = 1e-9  # as in `kinematics`: a joint on its limit is within it


@dataclass(frozen=True, eq=False)
class Drawn:
    """Random errors, drawn from a seed, for N variations of a pass.

    Attributes:
        offset_a: PSM_A's offset at a tip error of 1 mm, shape (N, 3).
        offset_m: PSM_M's offset, the same.
        shift_mm: Shift of the pass from its planned place, shape (N, 3).
        turned: Rotation of the needle about PSM_A's grip, shape (N, 3, 3).
    """

    offset_a: Floats
    offset_m: Floats
    shift_mm: Floats
    turned: Floats

    def at(self, chunk: slice) -> "Drawn":
        """Return a slice of the variations."""
        return Drawn(self.offset_a[chunk], self.offset_m[chunk], self.shift_mm[chunk], self.turned[chunk])


def draw(seed: int, number: int, variations: int, suture_point_mm: float, needle_rad: float) -> Drawn:
    """Draw the variations of a pass; the same arguments give the same bytes.

    Args:
        seed: Seed of the random numbers, 0 or more.
        number: Number of the pass, which gives each pass its own random numbers.
        variations: Number of variations, N.
        suture_point_mm: Greatest shift of the pass along each axis.
        needle_rad: Greatest rotation of the needle.
    """
    # A stream for each pass, because passes are independent of one another.
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence((seed, number))))
    offsets = rng.standard_normal((2, variations, 3)) / _MEAN_LENGTH
    shift = rng.uniform(-suture_point_mm, suture_point_mm, (variations, 3))
    axis = rng.standard_normal((variations, 3))
    half = rng.uniform(-needle_rad, needle_rad, (variations, 1)) / 2
    turns = np.sin(half) * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    return Drawn(offsets[0], offsets[1], shift, matrix_of(np.concatenate([turns, np.cos(half)], axis=1)))


@dataclass(frozen=True, eq=False)
class Planned:
    """One arm as planned in S samples.

    Attributes:
        tip_mm: Its tip in its base frame, shape (S, 3).
        rotation: Its rotation [n o a] there, shape (S, 3, 3).
        joints: Its joints, rad and mm, shape (S, 6).
        instrument: Number of its instrument.
        base: Rotation of its base in PSM_A's base frame, shape (3, 3).
        base_mm: Its remote centre there, shape (3,).
        opening_rad: Opening of each of its fingers, shape (S,).
    """

    tip_mm: Floats
    rotation: Floats
    joints: Floats
    instrument: str
    base: Floats
    base_mm: Floats
    opening_rad: Floats

    def at(self, samples: Ints) -> "Planned":
        """Return the arm at some of the samples."""
        tip, rotation, joints = self.tip_mm[samples], self.rotation[samples], self.joints[samples]
        return replace(self, tip_mm=tip, rotation=rotation, joints=joints, opening_rad=self.opening_rad[samples])

    def shifted(self, shift_mm: Floats) -> Floats:
        """Solve the joints for the pass shifted by each of N shifts, in PSM_A's base frame: shape (N * S, 6).

        Each sample stays on the branch that was planned, within its limits or not; NaN if there is no solution.
        """
        tip = (self.tip_mm + (shift_mm @ self.base)[:, None]).reshape(-1, 3)
        rotation, planned = (np.concatenate([one] * len(shift_mm)) for one in (self.rotation, self.joints))
        tool = instrument_of(self.instrument)
        solutions = solutions_of(tip, rotation, tool)
        seconds = (np.abs(solutions - planned[:, None]) / tool.speed).sum(axis=2)
        nearest = np.where(np.isnan(seconds), np.inf, seconds).argmin(axis=1)
        return np.asarray(solutions[np.arange(len(tip)), nearest])

    def links(self, joints: Floats) -> Links:
        """Return the arm's links in PSM_A's base frame, for the samples' joints once or for each variation."""
        openings_rad = np.tile(self.opening_rad, len(joints) // len(self.opening_rad))
        return links_of(joints, self.instrument, openings_rad).seen_from(self.base, self.base_mm)

    def margins(self, joints: Floats) -> Floats:
        """Return each joint's distance from its nearer limit as a part of its range."""
        tool = instrument_of(self.instrument)
        return joint_margins(joints, self.instrument) / (tool.upper - tool.lower)

    def insertion_mm(self, joints: Floats) -> Floats:
        """Return the insertion at which a tool on an arm of its own generation has its wrist as deep, shape (T,)."""
        return np.asarray(joints[:, INSERTION] - (instrument_of(self.instrument).cannula_mm - CANNULA_MM))


@dataclass(frozen=True, eq=False)
class PlannedPass:
    """A pass as planned in S samples.

    Attributes:
        arms: PSM_A and, if its place is known, PSM_M.
        phase: Phase of each sample, shape (S,).
        pad_top_mm: Height of the pad's top in the PSM_A base frame; -inf: there is no pad.
        taking: The recorded pose in which PSM_M takes the needle, in that frame; None: that of the paper's A2.
    """

    arms: tuple[Planned, ...]
    phase: Bytes
    pad_top_mm: float
    taking: Pose | None = None

    @property
    def handing_over(self) -> Flags:
        """Samples, (S,), in which fingers may touch fingers: the last sample of A2."""
        return np.asarray((self.phase == A2) & (np.arange(len(self.phase)) == len(self.phase) - 1))


def scene_of(trajectory: Trajectory, number: int, pad_top_mm: float, opening_rad: float) -> PlannedPass:
    """Return a pass with all its samples.

    Args:
        trajectory: The planned motion.
        number: Number of the pass, from 0.
        pad_top_mm: Height of the pad's top in the PSM_A base frame.
        opening_rad: Opening of PSM_M's fingers as it comes for the needle.
    """
    samples = np.flatnonzero(trajectory.pass_index == number)
    rotation = matrix_of(trajectory.rotation_xyzw[samples])
    tip, joints, instrument = trajectory.tip_mm[samples], trajectory.joints[samples], trajectory.instrument
    arms = [Planned(tip, rotation, joints, instrument, np.eye(3), np.zeros(3), openings(trajectory)[samples])]
    other = trajectory.psm_m
    if other is not None:
        joints, base = other.joints[samples], matrix_of(other.base_xyzw[None])[0]
        opened = np.full(len(samples), opening_rad)
        arms.append(Planned(*forward(joints, other.instrument), joints, other.instrument, base, other.base_mm, opened))
    recorded = trajectory.taking
    taking = None if recorded is None else Pose(recorded.tip_mm[number], recorded.rotation[number])
    return PlannedPass(tuple(arms), trajectory.phase[samples], pad_top_mm, taking)


def looked_at(scene: PlannedPass, stretches: int) -> PlannedPass:
    """Return a pass reduced to the samples that matter.

    Its phases are divided into stretches of equal travel of both arms together. Each stretch contributes its ends and
    the samples in which, as planned, an arm is nearest to the pad, to a joint's limit and to the other arm.

    Args:
        scene: The pass with all its samples.
        stretches: Number of stretches per pass.
    """
    seen = [arm.links(arm.joints) for arm in scene.arms]
    margins = [clearance_to_pad(one, scene.pad_top_mm).min(axis=1) for one in seen]
    margins += [arm.margins(arm.joints).min(axis=1) for arm in scene.arms]
    if len(seen) == 2:
        margins.append(_apart(seen[0], seen[1], scene.handing_over))
    moved = sum(travel_mm(arm.joints, arm.instrument)[:, 1:].max(axis=1) for arm in scene.arms)
    travelled = np.append(0.0, np.cumsum(moved))
    stretch = np.floor(stretches * travelled / max(float(travelled[-1]), _STILL_MM))
    begins = np.flatnonzero(np.append(True, (np.diff(stretch) > 0) | (np.diff(scene.phase) != 0)))
    ends = np.append(begins[1:], len(stretch)) - 1
    spans = list(zip(begins.tolist(), ends.tolist(), strict=True))
    least = [begin + int(values[begin : end + 1].argmin()) for values in margins for begin, end in spans]
    samples = np.unique(np.concatenate([begins, ends, least]))
    return replace(scene, arms=tuple(arm.at(samples) for arm in scene.arms), phase=scene.phase[samples])


def spoiled(scene: PlannedPass, drawn: Drawn, tip_errors_mm: Floats, limits: Limits) -> dict[str, Flags]:
    """Return the faults of N variations along the pass under E tip errors; NaN is a fault.

    Args:
        scene: The pass in the samples to check.
        drawn: The N variations.
        tip_errors_mm: Mean length of each arm's offset, shape (E,).
        limits: The playback's limits, which are applied.

    Returns:
        For each of `ON_THE_WAY` whether it occurs, shape (E, N); without "arms" and "bodies" if PSM_M is not in the
        scene, and without "pad" if there is no pad.
    """
    chunks = [slice(k, k + _CHUNK) for k in range(0, len(drawn.shift_mm), _CHUNK)]
    found = [_spoiled(scene, drawn.at(chunk), tip_errors_mm[:, None], limits) for chunk in chunks]
    return {name: np.concatenate([one[name] for one in found], axis=1) for name in found[0]}


def _spoiled(scene: PlannedPass, drawn: Drawn, errors: Floats, limits: Limits) -> dict[str, Flags]:
    count, samples = len(drawn.shift_mm), len(scene.phase)
    joints = [arm.shifted(drawn.shift_mm) for arm in scene.arms]
    links = [arm.links(q) for arm, q in zip(scene.arms, joints, strict=True)]
    offsets = (drawn.offset_a, drawn.offset_m)
    # Joints stay as commanded, so these faults are the same under every tip error.
    margin = np.minimum.reduce([_least(arm.margins(q), count) for arm, q in zip(scene.arms, joints, strict=True)])
    insertion = np.minimum.reduce(
        [_least(arm.insertion_mm(q), count) for arm, q in zip(scene.arms, joints, strict=True)]
    )
    top = scene.pad_top_mm + np.repeat(drawn.shift_mm[:, 2], samples)  # the pad moves with the pass
    above = [_least(clearance_to_pad(one, top), count) for one in links]
    raised = [clear + errors * offset[:, 2] for clear, offset in zip(above, offsets, strict=False)]
    of_joints = {
        "reach": ~(margin >= -_ROUND_OFF),
        "limits": ~((margin >= limits.joint_margin - _ROUND_OFF) & (insertion >= limits.insertion_mm)),
    }
    found = {name: np.broadcast_to(wrong, (len(errors), count)) for name, wrong in of_joints.items()}
    if scene.pad_top_mm > -inf:
        found["pad"] = ~(np.minimum.reduce(raised) >= limits.clearance_pad_mm)
    if len(links) == 2:
        apart, handing_over = offsets[0] - offsets[1], np.concatenate([scene.handing_over] * count)
        # Only the difference of the offsets matters between the arms, so one of them is moved by it.
        moved = [links[0].moved(np.repeat(error * apart, samples, axis=0)) for error in errors]
        between = np.array([_least(_apart(one, links[1], handing_over), count) for one in moved])
        found["arms"] = ~(between >= limits.clearance_psm_m_mm)
        found["bodies"] = too_near(scene.arms, joints, apart, errors[:, 0], limits.clearance_bodies_mm)
    return found


def _apart(arm: Links, other: Links, handing_over: Flags) -> Floats:
    """Return the arms' clearance, shape (T,), without that between fingers where they may touch."""
    between = clearance_between(arm, other)
    between[handing_over, FINGERS, FINGERS] = np.inf
    return np.asarray(between.min(axis=(1, 2)))


def _least(values: Floats, count: int) -> Floats:
    """Return the least of each variation's values, (N * S,) or (N * S, K) to (N,); NaN is the least of all."""
    return np.asarray(values.reshape(count, -1).min(axis=1))


CALIBRATED_MM, UNCALIBRATED_MM = 0.65, 3.0
ON_THE_WAY, AT_THE_END = ("reach", "limits", "pad", "arms", "bodies"), ("place", "angle")


@schema
@dataclass(frozen=True)
class DoubtSettings:
    """The errors to draw, and the conditions of a catch. All but the tip errors are ours; each has its reason.

    Attributes:
        variations: Variations of each pass. With 1000 the bounds are 6 % apart at a probability of a half, 0.4 % at
            one.
        tip_errors_mm: Mean length of each arm's offset: a calibrated and an uncalibrated dVRK.
        suture_point_mm: Greatest error of the suture point along each axis.
        needle_rad: Greatest rotation of the needle in PSM_A's jaws.
        stated_rad: Greatest angle between the needle's tangent and PSM_M's hinge: the angle by which the needle itself
            bends within jaws that are 2.2 mm wide, so they close on it as on a straight one.
        opening_rad: Opening of each of PSM_M's fingers as it comes in.
        stretches: Number of stretches of equal travel into which a pass is divided; some poses of each are checked
            (`looked_at`). With 20, about 50 poses per pass, no other pose was nearer to the pad, nor by more than 0.2
            mm to the other arm.
    """

    variations: Count = 1000
    tip_errors_mm: tuple[float, ...] = (CALIBRATED_MM, UNCALIBRATED_MM)
    suture_point_mm: float = 5.0
    needle_rad: float = radians(10)
    stated_rad: float = radians(15)
    opening_rad: float = OPEN_RAD
    stretches: Count = 20

    def __post_init__(self) -> None:
        if not (1 <= self.variations <= 1_000_000 and 1 <= self.stretches <= 1000 and self.tip_errors_mm):
            raise BadSettings(
                "The repetition in inexact worlds needs 1 to 1000000 variations, 1 to 1000 stretches and at least "
                "one tip error."
            )
        for one in (*self.tip_errors_mm, self.suture_point_mm, self.needle_rad, self.stated_rad, self.opening_rad):
            if not (isfinite(one) and one >= 0):
                raise BadSettings("Every error size must be a finite number, 0 or more.", given=one)


@schema
@dataclass(frozen=True)
class Probability:
    """The number of successful variations, and the probability with its Wilson bounds, 95 %."""

    count: Count
    of: Count
    probability: Fraction
    lower: Fraction
    upper: Fraction


@schema
@dataclass(frozen=True)
class Faults:
    """The number of variations with each fault; one variation may have several. None: the fault was not judged.

    Attributes:
        reach: A joint of either arm beyond its limits.
        limits: The same, or nearer to the limits than the playback allows, or a wrist inside the cannula.
        pad: An arm too near the pad.
        arms: The arms' tools too near each other.
        bodies: Their outer bodies too near each other, or to the other arm's tool.
        place: The needle not between PSM_M's fingers.
        angle: The needle at a wrong angle there, or not there at all.
    """

    reach: Count | None = None
    limits: Count | None = None
    pad: Count | None = None
    arms: Count | None = None
    bodies: Count | None = None
    place: Count | None = None
    angle: Count | None = None


@schema
@dataclass(frozen=True)
class PassDoubt:
    """A pass under one tip error: it succeeds if it is clear and, if there is a hand-off, the needle is caught."""

    succeeds: Probability
    clear: Probability
    caught: Probability | None
    faults: Faults


@schema
@dataclass(frozen=True)
class TipDoubt:
    """A plan under one tip error: every pass, and all of them one after another."""

    tip_error_mm: float
    plan: Probability
    passes: tuple[PassDoubt, ...]


@schema
@dataclass(frozen=True)
class Doubt:
    """The result as plain numbers: the same for the same trajectory, pad, settings and seed on every machine.

    `with_psm_m` is true if PSM_M's arm was in the scene; `hand_offs` is the number of passes in which a catch was
    judged; `looked_at` has the number of checked poses of each pass.
    """

    seed: Count
    pad_top_mm: Figure
    with_psm_m: bool
    hand_offs: Count
    looked_at: tuple[int, ...]
    under: tuple[TipDoubt, ...]
    settings: DoubtSettings = field(default_factory=DoubtSettings)
    limits: Limits = field(default_factory=Limits)


def doubt(
    trajectory: Trajectory,
    *,
    approach_m: ArrayLike | None,
    pad_top_mm: float | None,
    seed: int = 0,
    settings: DoubtSettings | None = None,
    limits: Limits | None = None,
) -> Doubt:
    """Vary a plan and count how often its passes stay clear and its needles are caught.

    Args:
        trajectory: The planned motion, with PSM_M's if its place is known.
        approach_m: PSM_M's approach in the PSM_A base frame, shape (3,); None if it is not known. Not used if the
            trajectory has PSM_M or its recorded pose: then the last pose of that arm counts.
        pad_top_mm: Height of the pad's top in the PSM_A base frame; the pad is assumed to be infinite. None: there is
            no pad, and nothing is compared with one.
        seed: Seed of the random numbers.
        settings: The errors to draw, and the conditions of a catch.
        limits: The playback's limits.

    Returns:
        The counts and probabilities of every pass and of the plan, under each tip error.

    Raises:
        BadInput: The pad's height is not finite, or a jaw's last pose is not turned to `approach_m`.
        BadSettings: The seed is negative.
    """
    if pad_top_mm is not None and not isfinite(pad_top_mm):
        raise BadInput("The pad's height must be a number; give it in mm in the PSM base frame.", pad_top_mm=pad_top_mm)
    if seed < 0:
        raise BadSettings("A seed must be 0 or more.", seed=seed)
    varied, allowed = settings or DoubtSettings(), limits or Limits()
    top_mm = -inf if pad_top_mm is None else float(pad_top_mm)
    scenes = [scene_of(trajectory, k, top_mm, varied.opening_rad) for k in range(trajectory.passes)]
    thin = [looked_at(scene, varied.stretches) for scene in scenes]
    found = [_wrong(scene, number, approach_m, varied, allowed, seed) for number, scene in enumerate(thin)]
    return Doubt(
        seed=seed,
        pad_top_mm=None if pad_top_mm is None else top_mm,
        with_psm_m=trajectory.psm_m is not None,
        hand_offs=sum("place" in wrong for wrong in found),
        looked_at=tuple(len(scene.phase) for scene in thin),
        under=tuple(
            _under([{name: one[k] for name, one in wrong.items()} for wrong in found], error)
            for k, error in enumerate(varied.tip_errors_mm)
        ),
        settings=varied,
        limits=allowed,
    )


# ---- one pass --------------------------------------------------------------------------------------------------


def _wrong(
    scene: PlannedPass, number: int, approach_m: ArrayLike | None, varied: DoubtSettings, limits: Limits, seed: int
) -> dict[str, Flags]:
    """Vary a pass and return its faults: for each fault that was judged, shape (tip errors, variations)."""
    drawn = draw(seed, number, varied.variations, varied.suture_point_mm, varied.needle_rad)
    errors = np.array(varied.tip_errors_mm)
    found = spoiled(scene, drawn, errors, limits)
    planned = _hand_off(scene, approach_m)
    if planned is not None:
        apart = drawn.offset_a - drawn.offset_m
        caught = [catch(planned, drawn.turned, error * apart, varied.opening_rad) for error in errors]
        found["place"] = np.array([~between for between, _ in caught])
        found["angle"] = np.array([~(askew <= varied.stated_rad) for _, askew in caught])
    return found


def _hand_off(scene: PlannedPass, approach_m: ArrayLike | None) -> HandOff | None:
    """Return both arms at the end of A2, PSM_M in its actual or else its desired pose; None if neither is known."""
    if scene.phase[-1] != A2:
        return None
    tip, jaw = scene.arms[0].tip_mm[-1], scene.arms[0].rotation[-1]
    if len(scene.arms) == 2:
        other = scene.arms[1]
        return HandOff(tip, jaw, other.base @ other.tip_mm[-1] + other.base_mm, other.base @ other.rotation[-1])
    if scene.taking is not None:
        return HandOff(tip, jaw, scene.taking.tip_mm, scene.taking.rotation)
    if approach_m is None:
        return None
    (tip_m,), (jaw_m,) = hand_off(tip[None], jaw[None], approach_m)
    return HandOff(tip, jaw, tip_m, jaw_m)


# ---- counting --------------------------------------------------------------------------------------------------


def _under(found: list[dict[str, Flags]], tip_error_mm: float) -> TipDoubt:
    """Count the variations of each pass; variation k of a plan succeeds if variation k of all its passes does."""
    wrong = np.any([np.any(list(one.values()), axis=0) for one in found], axis=0)
    return TipDoubt(tip_error_mm, _share(wrong), tuple(_pass(one) for one in found))


def _pass(found: dict[str, Flags]) -> PassDoubt:
    on_the_way, at_the_end = ([found[name] for name in names if name in found] for names in (ON_THE_WAY, AT_THE_END))
    return PassDoubt(
        succeeds=_share(np.any(on_the_way + at_the_end, axis=0)),
        clear=_share(np.any(on_the_way, axis=0)),
        caught=_share(np.any(at_the_end, axis=0)) if at_the_end else None,
        faults=Faults(**{name: int(np.count_nonzero(wrong)) for name, wrong in found.items()}),
    )


def _share(wrong: Flags) -> Probability:
    """Count the variations without a fault."""
    count, of = int(np.count_nonzero(~wrong)), len(wrong)
    lower, upper = wilson(count, of)
    return Probability(count, of, count / of, lower, upper)
