"""One pass of a plan, varied: what is drawn, where the arms then are, and what goes wrong.

`skills.style.doubt` says what varies and why. A pass is looked at in a few of its samples. That is enough for the pad:
the jaws are turned as planned in every variation, so fingers and hinge are moved as they are, and the sample in which
they are nearest to it stays the same; wrist and shaft are behind them. Under another offset the arms may be nearest to
each other in another sample, so some all along the way are looked at.
"""

from dataclasses import dataclass, replace
from math import pi, sqrt

import numpy as np

from skills.style._arrays import Bytes, Floats, Ints
from skills.style.clearance import FINGERS, Links, clearance_between, clearance_to_pad, links_of
from skills.style.gates import JudgeSettings
from skills.style.handoff import HOLDING_RAD
from skills.style.kinematics import INSERTION, Bools, forward, instrument_of, joint_margins, matrix_of, solutions_of
from skills.style.trajectory import A2, Trajectory
from skills.style.travel import travel_mm

_MEAN_LENGTH = sqrt(8 / pi)  # of three standard normal numbers
_CHUNK = 64  # variations worked out at once, which stay in the processor's cache; each is worked out by itself
_STILL_MM = 1e-6  # with less travel in all, a pass is one stretch
_ROUND_OFF = 1e-9  # as in `kinematics`: a joint that stands on its limit is within it


@dataclass(frozen=True, eq=False)
class Drawn:
    """What a seed draws for N variations of a pass.

    Attributes:
        offset_a: PSM_A's offset at a tip error of 1 mm, shape (N, 3).
        offset_m: PSM_M's, the same.
        shift_mm: Where the pass is, from where it was planned, shape (N, 3).
        turned: How the needle is turned about PSM_A's grip, shape (N, 3, 3).
    """

    offset_a: Floats
    offset_m: Floats
    shift_mm: Floats
    turned: Floats

    def at(self, chunk: slice) -> "Drawn":
        """Take some of the variations."""
        return Drawn(self.offset_a[chunk], self.offset_m[chunk], self.shift_mm[chunk], self.turned[chunk])


def draw(seed: int, number: int, variations: int, suture_point_mm: float, needle_rad: float) -> Drawn:
    """Draw the variations of pass `number`; the same arguments give the same bytes."""
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
        tip_mm: Its tip in its own base frame, shape (S, 3).
        rotation: Its [n o a] there, shape (S, 3, 3).
        joints: Its joints, rad and mm, shape (S, 6).
        instrument: Number of its instrument.
        base: Rotation of its base in PSM_A's base frame, shape (3, 3).
        base_mm: Its remote centre there, shape (3,).
        opening_rad: How far each of its fingers is open.
    """

    tip_mm: Floats
    rotation: Floats
    joints: Floats
    instrument: str
    base: Floats
    base_mm: Floats
    opening_rad: float

    def at(self, samples: Ints) -> "Planned":
        """Take some of the samples."""
        tip, rotation, joints = self.tip_mm[samples], self.rotation[samples], self.joints[samples]
        return replace(self, tip_mm=tip, rotation=rotation, joints=joints)

    def shifted(self, shift_mm: Floats) -> Floats:
        """Solve the joints where the pass is elsewhere by each of N shifts, in PSM_A's base frame: shape (N * S, 6).

        Each stays on the branch that was planned, within its limits or not; NaN where the shaft has no way.
        """
        tip = (self.tip_mm + (shift_mm @ self.base)[:, None]).reshape(-1, 3)
        rotation, planned = (np.concatenate([one] * len(shift_mm)) for one in (self.rotation, self.joints))
        tool = instrument_of(self.instrument)
        solutions = solutions_of(tip, rotation, tool)
        seconds = (np.abs(solutions - planned[:, None]) / tool.speed).sum(axis=2)
        nearest = np.where(np.isnan(seconds), np.inf, seconds).argmin(axis=1)
        return np.asarray(solutions[np.arange(len(tip)), nearest])

    def links(self, joints: Floats) -> Links:
        """Find the arm's links in PSM_A's base frame."""
        return links_of(joints, self.instrument, self.opening_rad).seen_from(self.base, self.base_mm)

    def margins(self, joints: Floats) -> Floats:
        """Measure each joint's distance from its nearer limit as a part of its range."""
        tool = instrument_of(self.instrument)
        return joint_margins(joints, self.instrument) / (tool.upper - tool.lower)


@dataclass(frozen=True, eq=False)
class Scene:
    """A pass as planned in S samples: PSM_A and, where its place is known, PSM_M; the phase of each sample; the pad."""

    arms: tuple[Planned, ...]
    phase: Bytes
    pad_top_mm: float

    @property
    def handing_over(self) -> Bools:
        """Where fingers may touch fingers: in the last sample of A2."""
        return np.asarray((self.phase == A2) & (np.arange(len(self.phase)) == len(self.phase) - 1))


def scene_of(trajectory: Trajectory, number: int, pad_top_mm: float, opening_rad: float) -> Scene:
    """Take a pass with all its samples; PSM_M's fingers are as far open as when they come for the needle."""
    samples = np.flatnonzero(trajectory.pass_index == number)
    rotation = matrix_of(trajectory.rotation_xyzw[samples])
    tip, joints, instrument = trajectory.tip_mm[samples], trajectory.joints[samples], trajectory.instrument
    arms = [Planned(tip, rotation, joints, instrument, np.eye(3), np.zeros(3), HOLDING_RAD)]
    other = trajectory.psm_m
    if other is not None:
        joints, base = other.joints[samples], matrix_of(other.base_xyzw[None])[0]
        arms.append(
            Planned(*forward(joints, other.instrument), joints, other.instrument, base, other.base_mm, opening_rad)
        )
    return Scene(tuple(arms), trajectory.phase[samples], pad_top_mm)


def looked_at(scene: Scene, stretches: int) -> Scene:
    """Thin a pass out to the samples that matter.

    Its phases are divided into stretches of like travel of both arms together. Of each are taken its ends, and where,
    as planned, an arm is nearest to the pad, to a joint's limit and to the other arm.
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
    return Scene(tuple(arm.at(samples) for arm in scene.arms), scene.phase[samples], scene.pad_top_mm)


def spoiled(scene: Scene, drawn: Drawn, tip_errors_mm: Floats, limits: JudgeSettings) -> dict[str, Bools]:
    """Find what goes wrong on the way, in N variations under E tip errors, by the playback's limits; NaN goes wrong.

    Returns:
        For each of `doubt.ON_THE_WAY` whether it does, shape (E, N); without "arms" where PSM_M is not there.
    """
    chunks = [slice(k, k + _CHUNK) for k in range(0, len(drawn.shift_mm), _CHUNK)]
    found = [_spoiled(scene, drawn.at(chunk), tip_errors_mm[:, None], limits) for chunk in chunks]
    return {name: np.concatenate([one[name] for one in found], axis=1) for name in found[0]}


def _spoiled(scene: Scene, drawn: Drawn, errors: Floats, limits: JudgeSettings) -> dict[str, Bools]:
    count, samples = len(drawn.shift_mm), len(scene.phase)
    joints = [arm.shifted(drawn.shift_mm) for arm in scene.arms]
    links = [arm.links(q) for arm, q in zip(scene.arms, joints, strict=True)]
    offsets = (drawn.offset_a, drawn.offset_m)
    margin = np.minimum.reduce([_least(arm.margins(q), count) for arm, q in zip(scene.arms, joints, strict=True)])
    insertion = np.minimum.reduce([_least(q[:, INSERTION], count) for q in joints])
    top = scene.pad_top_mm + np.repeat(drawn.shift_mm[:, 2], samples)  # the pad is where the pass is
    above = [_least(clearance_to_pad(one, top), count) for one in links]
    raised = [clear + errors * offset[:, 2] for clear, offset in zip(above, offsets, strict=False)]
    of_joints = {
        "reach": ~(margin >= -_ROUND_OFF),
        "limits": ~((margin >= limits.joint_margin - _ROUND_OFF) & (insertion >= limits.insertion_mm)),
    }
    found = {name: np.broadcast_to(wrong, (len(errors), count)) for name, wrong in of_joints.items()}
    found["pad"] = ~(np.minimum.reduce(raised) >= limits.clearance_pad_mm)
    if len(links) == 2:
        apart, handing_over = offsets[0] - offsets[1], np.concatenate([scene.handing_over] * count)
        moved = [links[0].moved(np.repeat(error * apart, samples, axis=0)) for error in errors]
        between = np.array([_least(_apart(one, links[1], handing_over), count) for one in moved])
        found["arms"] = ~(between >= limits.clearance_psm_m_mm)
    return found


def _apart(arm: Links, other: Links, handing_over: Bools) -> Floats:
    """Measure the arms' clearance, shape (T,), but for fingers from fingers where they may touch."""
    between = clearance_between(arm, other)
    between[handing_over, FINGERS, FINGERS] = np.inf
    return np.asarray(between.min(axis=(1, 2)))


def _least(values: Floats, count: int) -> Floats:
    """Take the least of each variation's values, (N * S,) or (N * S, K) to (N,); NaN is the least of all."""
    return np.asarray(values.reshape(count, -1).min(axis=1))
