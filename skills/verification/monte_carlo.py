"""Monte Carlo: the probability that a plan succeeds in the presence of errors, from seeded variations in closed form.

    Trajectory --estimate_success--> SuccessEstimate: how often each pass stays clear and its needle is caught

A *variation* of a pass draws the errors of `skills.verification.arm_errors`, independently of one another:

* Arms. PSM_M's base, both wrists and both tips are off by errors of stated sizes (`ArmErrors`). Joints stay as
  commanded; the arms are elsewhere than those joints say.
* Suture point. The pass, and all that belongs to it (pad, needle, hand-off), is shifted by up to 5 mm along each axis,
  drawn uniformly. The arms' bases stay, and the joints are solved again.
* Needle angle. The needle stands in PSM_A's jaws with an error of up to 10 degrees, drawn uniformly, about any axis
  through the grip.

A variation is *clear* if every checked pose of the pass keeps to the playback's limits: joints, cannula, pad, and the
other arm with its outer bodies, if its place is known; and if the needle stays out of tissue once it has come out. The
tissue beside each pose is taken to be even, as far from the needle as in the scene. Fingers may touch fingers at the
hand-off itself, where both arms stand and only the jaws move. Speeds are not judged: a plan made for the shifted point
has its own.

The needle is *caught* if its arc crosses the plane in which PSM_M's fingers close, at the end of A2, within the sector
that they sweep, with needle to spare on both sides of them, and its tangent there is within the stated angle of their
hinge. Where PSM_M's base is not known, its remote centre is taken to be behind its desired pose, at a usual depth.
Without PSM_M's approach there is no hand-off to judge.

Only a few samples of a pass are checked: those in which, as planned, an arm is nearest to the pad and to the other one,
and some all along the path. In a variation another sample may be the nearest, by a small part of the errors.

*Sensitivity*: the same variations are evaluated again with each error of the arms set to zero, all others drawn as
before. The error without which most variations succeed costs the most.

A pose is evaluated only where its distance in the variation without errors of the arms is less than the limit plus the
most that these errors can move the links; elsewhere it is clear by that bound.

The paper has its arms exactly in place; all of this is ours, except the sources that the errors name.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite

import numpy as np
from numpy.typing import ArrayLike

from skills import kinematics
from skills.arrays import Bytes, Flags, Floats, Ints
from skills.errors import BadInput, BadSettings
from skills.fields import Point
from skills.planning.handoff import HELD_MM, HOLDING_RAD, hand_off
from skills.planning.motion_laws import Pose
from skills.planning.trajectory import A2, PSM_M, STANDS, PlannedArm, Trajectory
from skills.verification import clearance
from skills.verification.arm_errors import CALIBRATED, CALLED, UNCALIBRATED, ArmErrors
from skills.verification.bodies import too_near
from skills.verification.error_draws import Displaced, Drawn, draw
from skills.verification.gates import Limits
from skills.verification.probabilities import (
    AT_THE_END,
    JUDGE_VERSION,
    NEEDLE,
    UPWARDS,
    Cost,
    EstimateSettings,
    SuccessEstimate,
    counted,
    share,
)

_CHUNK = 64  # variations computed at once, so that they stay in the processor's cache; the results do not depend on it
_STILL_MM = 1e-6  # with less total travel, a pass is one stretch
_ROUND_OFF = 1e-9  # as in `kinematics`: a joint on its limit is within it


@dataclass(frozen=True, eq=False, kw_only=True)
class Planned(PlannedArm):
    """One arm as planned in S samples.

    Attributes:
        tip_mm: Its tip in its base frame, shape (S, 3).
        rotation: Its rotation [n o a] there, shape (S, 3, 3).
        opening_rad: Opening of each of its fingers, shape (S,).
    """

    tip_mm: Floats
    rotation: Floats
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
        tool = kinematics.instrument_of(self.instrument)
        solutions = kinematics.solutions_of(tip, rotation, tool)
        seconds = (np.abs(solutions - planned[:, None]) / tool.speed).sum(axis=2)
        nearest = np.where(np.isnan(seconds), np.inf, seconds).argmin(axis=1)
        return np.asarray(solutions[np.arange(len(tip)), nearest])

    def links(self, joints: Floats) -> clearance.Links:
        """Return the arm's links in PSM_A's base frame, for the samples' joints once or for each variation."""
        openings_rad = np.tile(self.opening_rad, len(joints) // len(self.opening_rad))
        return clearance.links_of(joints, self.instrument, openings_rad).seen_from(self.base, self.base_mm)

    def poses_of(self, joints: Floats) -> tuple[Floats, Floats]:
        """Return the tips, (T, 3), and rotations [n o a], (T, 3, 3), of joints in PSM_A's base frame; NaN stays NaN."""
        shaft, wrist, rotation = kinematics.axes_of(joints)
        depth_mm = joints[:, kinematics.INSERTION] - kinematics.instrument_of(self.instrument).wrist_offset_mm
        tip = depth_mm[:, None] * shaft + kinematics.WRIST_MM * wrist
        return tip @ self.base.T + self.base_mm, self.base @ rotation

    def margins(self, joints: Floats) -> Floats:
        """Return each joint's distance from its nearer limit as a part of its range."""
        tool = kinematics.instrument_of(self.instrument)
        return kinematics.joint_margins(joints, self.instrument) / (tool.upper - tool.lower)

    def insertion_mm(self, joints: Floats) -> Floats:
        """Return the insertion at which a tool on an arm of its own generation has its wrist as deep, shape (T,)."""
        return np.asarray(
            joints[:, kinematics.INSERTION]
            - (kinematics.instrument_of(self.instrument).cannula_mm - kinematics.CANNULA_MM)
        )


@dataclass(frozen=True, eq=False)
class PlannedPass:
    """A pass as planned in S samples.

    Attributes:
        arms: PSM_A and, if its place is known, PSM_M.
        phase: Phase of each sample, shape (S,).
        pad_top_mm: Height of the pad's top along its normal in the PSM_A base frame; -inf: there is no pad.
        stamps_s: Time of each sample, shape (S,).
        needle: The needle's rotation in PSM_A's jaws, as planned, shape (S, 3, 3).
        needle_mm: Its distance from tissue there, shape (S,); infinite where it is not judged.
        taking: The recorded pose in which PSM_M takes the needle, in that frame; None: that of the paper's A2.
        pad_normal: Unit direction out of the pad in that frame.
    """

    arms: tuple[Planned, ...]
    phase: Bytes
    pad_top_mm: float
    stamps_s: Floats
    needle: Floats
    needle_mm: Floats
    taking: Pose | None = None
    pad_normal: Point = UPWARDS

    @property
    def handing_over(self) -> Flags:
        """Samples, (S,), in which fingers may touch fingers: the end of A2, where all arms stand as in the last one."""
        stands = [(np.abs(arm.joints - arm.joints[-1]) <= STANDS).all(axis=1) for arm in self.arms]
        there = np.logical_and.reduce([self.phase == A2, *stands])
        return np.asarray(np.logical_and.accumulate(there[::-1])[::-1])


def scene_of(
    trajectory: Trajectory,
    number: int,
    pad_top_mm: float,
    opening_rad: float,
    pad_normal: Point = UPWARDS,
    needle_mm: Floats | None = None,
    *,
    last: bool = False,
) -> PlannedPass:
    """Return a pass with all its samples, or the last one alone.

    Args:
        trajectory: The planned motion.
        number: Number of the pass, from 0.
        pad_top_mm: Height of the pad's top along its normal in the PSM_A base frame.
        opening_rad: Opening of each of PSM_M's fingers if the motion states no angle of its jaw.
        pad_normal: Unit direction out of the pad.
        needle_mm: The needle's distance from tissue in each sample of the trajectory, shape (T,), infinite where it is
            not judged; None: nowhere.
        last: Whether only the last sample is wanted, at which the needle is handed over.
    """
    samples = np.flatnonzero(trajectory.pass_index == number)[-1 if last else 0 :]
    arms = []
    for arm, unplanned_rad in zip(trajectory.arms, (HOLDING_RAD, opening_rad), strict=False):
        joints, opened = arm.joints[samples], clearance.openings(arm, unplanned_rad)[samples]
        tip_mm, rotation = kinematics.forward(joints, arm.instrument)
        planned = vars(arm) | {"joints": joints, "jaw_rad": None}
        arms.append(Planned(tip_mm=tip_mm, rotation=rotation, opening_rad=opened, **planned))
    recorded = trajectory.taking
    taking = None if recorded is None else Pose(recorded.tip_mm[number], recorded.rotation[number])
    phase, stamps_s = trajectory.phase[samples], trajectory.stamps_s[samples]
    rotation = clearance.needle_in_psm_a(trajectory, samples)[1]
    apart_mm = np.full(len(samples), inf) if needle_mm is None else needle_mm[samples]
    return PlannedPass(tuple(arms), phase, pad_top_mm, stamps_s, rotation, apart_mm, taking, pad_normal)


def looked_at(scene: PlannedPass, stretches: int) -> PlannedPass:
    """Return a pass reduced to the samples that matter.

    Its phases are divided into stretches of equal travel of both arms together. Each stretch contributes its ends and
    the samples in which, as planned, an arm is nearest to the pad, to a joint's limit and to the other arm.

    Args:
        scene: The pass with all its samples.
        stretches: Number of stretches per pass.
    """
    seen = [arm.links(arm.joints) for arm in scene.arms]
    margins = [clearance.clearance_to_pad(one, scene.pad_top_mm, scene.pad_normal).min(axis=1) for one in seen]
    margins += [scene.needle_mm, *(arm.margins(arm.joints).min(axis=1) for arm in scene.arms)]
    if len(seen) == 2:
        margins.append(_apart(seen[0], seen[1], scene.handing_over))
    moved = sum(clearance.travel_mm(arm.joints, arm.instrument)[:, 1:].max(axis=1) for arm in scene.arms)
    travelled = np.append(0.0, np.cumsum(moved))
    stretch = np.floor(stretches * travelled / max(float(travelled[-1]), _STILL_MM))
    begins = np.flatnonzero(np.append(True, (np.diff(stretch) > 0) | (np.diff(scene.phase) != 0)))
    ends = np.append(begins[1:], len(stretch)) - 1
    spans = list(zip(begins.tolist(), ends.tolist(), strict=True))
    least = [begin + int(values[begin : end + 1].argmin()) for values in margins for begin, end in spans]
    samples = np.unique(np.concatenate([begins, ends, least]))
    arms = tuple(arm.at(samples) for arm in scene.arms)
    some = {name: getattr(scene, name)[samples] for name in ("phase", "stamps_s", "needle", "needle_mm")}
    return replace(scene, arms=arms, **some)


def spoiled(
    scene: PlannedPass,
    shift_mm: Floats,
    displaced: Sequence[Displaced],
    limits: Limits,
    wanted: Flags | None = None,
) -> dict[str, Flags]:
    """Return the faults of N variations along the pass, each with E displacements of the arms; NaN is a fault.

    Args:
        scene: The pass in the samples to check.
        shift_mm: Shift of the pass in each variation, shape (N, 3).
        displaced: The E displacements of the N variations.
        limits: The playback's limits, which are applied.
        wanted: The variations to judge, shape (E, N), the others have no faults; None: all.

    Returns:
        For each of `ON_THE_WAY` whether it occurs, shape (E, N); without "arms" and "bodies" if PSM_M is not in
        the scene, and without "pad" if there is no pad.
    """
    count = len(shift_mm)
    judged = np.ones((len(displaced), count), dtype=bool) if wanted is None else wanted
    chunks = [slice(k, k + _CHUNK) for k in range(0, count, _CHUNK)]
    found = [
        _spoiled(scene, shift_mm[chunk], [one.at(chunk) for one in displaced], limits, judged[:, chunk])
        for chunk in chunks
    ]
    return {name: np.concatenate([one[name] for one in found], axis=1) for name in found[0]}


def _spoiled(
    scene: PlannedPass, shift_mm: Floats, displaced: Sequence[Displaced], limits: Limits, wanted: Flags
) -> dict[str, Flags]:
    """Return the faults of some variations, computed at once; as `spoiled`."""
    count, samples = len(shift_mm), len(scene.phase)
    joints = [arm.shifted(shift_mm) for arm in scene.arms]
    # Joints stay as commanded, so these faults are the same under every displacement of the arms.
    margin = np.minimum.reduce([_least(arm.margins(q), count) for arm, q in zip(scene.arms, joints, strict=True)])
    insertion = np.minimum.reduce(
        [_least(arm.insertion_mm(q), count) for arm, q in zip(scene.arms, joints, strict=True)]
    )
    kept = {
        "reach": margin >= -_ROUND_OFF,
        "limits": (margin >= limits.joint_margin - _ROUND_OFF) & (insertion >= limits.insertion_mm),
    }
    found = {name: ~good & wanted for name, good in kept.items()}
    top = scene.pad_top_mm + np.repeat(shift_mm @ scene.pad_normal, samples)  # the pad moves with the pass
    handing_over = np.concatenate([scene.handing_over] * count)
    links = [arm.links(q) for arm, q in zip(scene.arms, joints, strict=True)]
    above = [clearance.clearance_to_pad(one, top, scene.pad_normal).min(axis=1) for one in links]
    between = _apart(links[0], links[1], handing_over) if len(links) == 2 else np.full(count * samples, np.inf)
    levers = [_lever_mm(arm, one) for arm, one in zip(scene.arms, links, strict=True)]
    if scene.pad_top_mm > -inf:
        found["pad"] = np.zeros_like(wanted)
    if len(links) == 2:
        found["arms"] = np.zeros_like(wanted)
        found["bodies"] = too_near(scene.arms, joints, displaced, limits.clearance_bodies_mm, wanted)
    for number, errors in enumerate(displaced):
        ways = [_at_most_mm(errors, arm, lever).ravel() for arm, lever in enumerate(levers)]
        clear = np.minimum.reduce([one - way for one, way in zip(above, ways, strict=True)]) >= limits.clearance_pad_mm
        clear &= between - sum(ways) >= limits.clearance_psm_m_mm
        rows = np.flatnonzero(~clear & np.repeat(wanted[number], samples))
        variations, at = np.divmod(rows, samples)
        moved = [
            _displaced(arm, clearance.Links(links[k].begin_mm[rows], links[k].end_mm[rows]), errors, k, variations, at)
            for k, arm in enumerate(scene.arms)
        ]
        if "pad" in found:
            over = [clearance.clearance_to_pad(one, top[rows], scene.pad_normal).min(axis=1) for one in moved]
            near = np.minimum.reduce(over)
            found["pad"][number, variations[~(near >= limits.clearance_pad_mm)]] = True
        if len(moved) == 2:
            near = _apart(moved[0], moved[1], handing_over[rows])
            found["arms"][number, variations[~(near >= limits.clearance_psm_m_mm)]] = True
    return found


def _lever_mm(arm: Planned, links: clearance.Links) -> Floats:
    """Return the greatest distance of the links' axes from the arm's remote centre, shape (T,)."""
    ends = np.concatenate([links.begin_mm, links.end_mm], axis=1) - arm.base_mm
    return np.asarray(np.linalg.norm(ends, axis=2).max(axis=1))


def _at_most_mm(errors: Displaced, arm: int, lever_mm: Floats) -> Floats:
    """Return upper bounds on the distance by which errors move any point of an arm's links, shape (N, S)."""
    turned = errors.jaw_rad[arm] * clearance.FINGER_REACH_MM
    moved = np.linalg.norm(errors.tip_mm[arm], axis=2) + turned[:, None]
    if arm == 0:
        return np.asarray(moved)
    lever = lever_mm.reshape(moved.shape) + turned[:, None]
    return np.asarray(moved + np.linalg.norm(errors.base_mm, axis=1)[:, None] + errors.base_rad[:, None] * lever)


def _displaced(
    arm: Planned, links: clearance.Links, errors: Displaced, number: int, variations: Ints, at: Ints
) -> clearance.Links:
    """Return the links of an arm where errors place it.

    Args:
        arm: The arm; `number` is 0 for PSM_A and 1 for PSM_M, whose base alone is displaced.
        links: Its links in R poses, without errors.
        errors: The displacements.
        variations: The variation of each pose, shape (R,).
        at: The sample of each pose, shape (R,).
    """
    begin, end, hinge = links.begin_mm.copy(), links.end_mm.copy(), links.end_mm[:, clearance.FINGERS.start - 1, None]
    for ends in (begin, end):
        ends[:, clearance.FINGERS] = hinge + _turned(
            errors.jaw_turn[number, variations], ends[:, clearance.FINGERS] - hinge
        )
    by_mm = errors.tip_mm[number, variations, at]
    if number == 1:
        by_mm = by_mm + errors.base_mm[variations] + arm.base_mm
        begin, end = (_turned(errors.base_turn[variations], ends - arm.base_mm) for ends in (begin, end))
    return clearance.Links(begin, end).moved(by_mm)


def _turned(turn: Floats, points: Floats) -> Floats:
    """Rotate points, (T, K, 3), of each pose by a rotation, (T, 3, 3)."""
    return np.asarray(points @ np.swapaxes(turn, 1, 2))


def _apart(arm: clearance.Links, other: clearance.Links, handing_over: Flags) -> Floats:
    """Return the arms' clearance, shape (T,), without that between fingers where they may touch."""
    between = clearance.clearance_between(arm, other)
    between[handing_over, clearance.FINGERS, clearance.FINGERS] = np.inf
    return np.asarray(between.min(axis=(1, 2)))


def _least(values: Floats, count: int) -> Floats:
    """Return the least of each variation's values, (N * S,) or (N * S, K) to (N,); NaN is the least of all."""
    return np.asarray(values.reshape(count, -1).min(axis=1))


def estimate_success(
    trajectory: Trajectory,
    *,
    approach_m: ArrayLike | None,
    pad_top_mm: float | None,
    pad_normal: Point = UPWARDS,
    needle_mm: Floats | None = None,
    errors: ArmErrors = UNCALIBRATED,
    seed: int = 0,
    settings: EstimateSettings | None = None,
    limits: Limits | None = None,
) -> SuccessEstimate:
    """Vary a plan and count how often its passes stay clear and its needles are caught.

    Args:
        trajectory: The planned motion, with PSM_M's if its place is known.
        approach_m: PSM_M's approach in the PSM_A base frame, shape (3,); None if it is not known. Not used if the
            trajectory has PSM_M or its recorded pose: then the last pose of that arm counts.
        pad_top_mm: Height of the pad's top along its normal in the PSM_A base frame; the pad is assumed to be infinite.
            None: there is no pad, and nothing is compared with one.
        pad_normal: Unit direction out of the pad, such as that of sloping tissue.
        needle_mm: The needle's distance from tissue in each sample, shape (T,), infinite where it is not judged, as
            `skills.verification.scene_clearance` has it; None: it is compared with none.
        errors: The stated errors of the arms. Those of both defaults are judged beside them.
        seed: Seed of the random numbers.
        settings: The other errors to draw, and the conditions of a catch.
        limits: The playback's limits.

    Returns:
        The counts and probabilities of every pass and of the plan, and the cost of each of the stated errors.

    Raises:
        BadInput: The pad's height is not finite, its normal is no unit direction, or a jaw's last pose is not turned to
            `approach_m`.
        BadSettings: The seed is negative.
    """
    if pad_top_mm is not None and not isfinite(pad_top_mm):
        raise BadInput("The pad's height must be a number; give it in mm in the PSM base frame.", pad_top_mm=pad_top_mm)
    if not abs(np.linalg.norm(pad_normal) - 1.0) <= _ROUND_OFF:
        raise BadInput("The pad's normal must be a direction of length 1.", pad_normal=list(pad_normal))
    if seed < 0:
        raise BadSettings("A seed must be 0 or more.", seed=seed)
    varied, allowed = settings or EstimateSettings(), limits or Limits()
    top_mm = -inf if pad_top_mm is None else float(pad_top_mm)
    scenes = [
        scene_of(trajectory, k, top_mm, varied.opening_rad, pad_normal, needle_mm) for k in range(trajectory.passes)
    ]
    thin = [looked_at(scene, varied.stretches) for scene in scenes]
    under = [errors, *(one for one in (CALIBRATED, UNCALIBRATED) if one != errors)]
    one_arm = trajectory.psm_m is None and trajectory.taking is None and approach_m is None
    spared = [
        size for size in CALLED if getattr(errors, size) > 0 and not (one_arm and size.startswith("registration"))
    ]
    sizes = {"suture_point_mm": varied.suture_point_mm, "needle_rad": varied.needle_rad}
    draws = [draw(seed, k, varied.variations, len(scene.phase), **sizes) for k, scene in enumerate(thin)]
    without = [errors.without(size) for size in spared]
    faults, succeeds, taken = zip(
        *(_judged(*one, approach_m, under, without, varied, allowed) for one in zip(thin, draws, strict=True)),
        strict=True,
    )
    whole = np.logical_and.reduce(succeeds)
    # The needle's angle costs nothing where nothing is judged of the needle.
    judged = {name for one in faults for name in one} & {"needle", *AT_THE_END}
    costs = [
        Cost(size, share(~good))
        for size, good in zip([*spared, NEEDLE][: len(spared) + bool(judged)], whole, strict=False)
    ]
    return SuccessEstimate(
        seed=seed,
        pad_top_mm=None if pad_top_mm is None else top_mm,
        with_psm_m=trajectory.psm_m is not None,
        hand_offs=sum("place" in one for one in faults),
        looked_at=tuple(len(scene.phase) for scene in thin),
        under=tuple(counted(_of(faults, k), _of(taken, k), one) for k, one in enumerate(under)),
        settings=varied,
        limits=allowed,
        costs=tuple(sorted(costs, key=lambda one: -one.without.count)),
        version=JUDGE_VERSION,
        pad_normal=pad_normal,
    )


def _of(passes: Sequence[dict[str, Flags]], k: int) -> list[dict[str, Flags]]:
    """Return what was found of each pass under the k-th errors."""
    return [{name: found[k] for name, found in each.items()} for each in passes]


# ---- one pass --------------------------------------------------------------------------------------------------


def _judged(
    scene: PlannedPass,
    drawn: Drawn,
    approach_m: ArrayLike | None,
    under: Sequence[ArmErrors],
    spared: Sequence[ArmErrors],
    varied: EstimateSettings,
    limits: Limits,
) -> tuple[dict[str, Flags], Flags, dict[str, Flags]]:
    """Judge a pass in N variations under some errors, and whether it succeeds under the `spared` ones.

    Returns:
        For each judged fault whether it occurs under each of E errors, shape (E, N); the success without one size
        of the stated errors each, and last with a needle that stands as planned, shape (C, N); and, where there is a
        hand-off, whether friction would take the needle in each of `clearance.GRASPS`, shape (E, N).
    """
    displaced = [drawn.under(one, scene.stamps_s) for one in [*under, *spared]]
    arms = at_hand_off(scene, approach_m, varied.unknown_depth_mm)
    missed: dict[str, Flags] = {}
    unturned = np.broadcast_to(np.eye(3), drawn.turned.shape)
    upright = np.zeros(len(drawn.shift_mm), dtype=bool)  # the stated errors, with a needle that stands as planned
    if scene.pad_top_mm > -inf:
        missed["needle"] = in_tissue(scene, displaced, drawn.turned)
        (upright,) = in_tissue(scene, displaced[:1], unturned)
    taken: dict[str, Flags] = {}
    if arms is not None:
        crossings = [crossed(arms, drawn.shift_mm, one, drawn.turned) for one in displaced]
        caught = [caught_by(one, varied) for one in crossings]
        missed |= {name: ~np.array(one) for name, one in zip(AT_THE_END, zip(*caught, strict=True), strict=True)}
        upright |= ~np.logical_and(*caught_by(crossed(arms, drawn.shift_mm, displaced[0], unturned), varied))
        for name, grasp in clearance.GRASPS.items():
            taken[name] = np.array([grasp.takes(one) for one in crossings[: len(under)]])
    lost = np.logical_or.reduce([np.zeros((len(displaced), len(upright)), dtype=bool), *missed.values()])
    wanted = ~lost
    wanted[: len(under)] = True  # of these every fault is counted; of the others success alone
    found = spoiled(scene, drawn.shift_mm, displaced, limits, wanted)
    spoilt = np.logical_or.reduce(list(found.values()))
    good = ~(lost | spoilt)[len(under) :]
    faults = {name: one[: len(under)] for name, one in (found | missed).items()}
    return faults, np.concatenate([good, ~(upright | spoilt[0])[None]]), taken


def in_tissue(scene: PlannedPass, displaced: Sequence[Displaced], turned: Floats) -> Flags:
    """Return whether the needle is in tissue in N variations, each with E displacements of the arms; NaN is.

    The shift of the suture point moves tissue and needle alike. A pose is evaluated only where the errors could take
    the needle as far as the tissue.

    Args:
        scene: The pass in the samples to check.
        displaced: The E displacements of the N variations.
        turned: Rotation of the needle about PSM_A's grip, shape (N, 3, 3).

    Returns:
        Shape (E, N).
    """
    found = np.zeros((len(displaced), len(turned)), bool)
    judged = np.flatnonzero(~(scene.needle_mm == inf))
    apart_mm, needle, normal = scene.needle_mm[judged], scene.needle[judged], np.array(scene.pad_normal)
    held_mm = HELD_MM * scene.arms[0].rotation[judged][:, :, 2]
    low_mm = (normal @ needle @ clearance.ARC_MM.T).min(axis=1)
    reach_mm = float(np.linalg.norm(clearance.ARC_MM, axis=1).max())
    askew_mm = reach_mm * np.linalg.norm(turned - np.eye(3), axis=(1, 2))
    for one, errors in zip(found, displaced, strict=True):
        tip_mm, jaw_rad = errors.tip_mm[0][:, judged], errors.jaw_rad[0]
        most_mm = np.linalg.norm(tip_mm, axis=2) + (askew_mm + jaw_rad * (HELD_MM + reach_mm))[:, None]
        variation, at = np.nonzero(~(apart_mm - most_mm >= 0))
        jaw = errors.jaw_turn[0, variation]
        moved_mm = (tip_mm[variation, at] + np.einsum("rij,rj->ri", jaw, held_mm[at]) - held_mm[at]) @ normal
        there = jaw @ turned[variation] @ needle[at]
        lowest_mm = (normal @ there @ clearance.ARC_MM.T).min(axis=1) - low_mm[at]
        one[variation[~(apart_mm[at] + moved_mm + lowest_mm >= 0)]] = True
    return found


def at_hand_off(scene: PlannedPass, approach_m: ArrayLike | None, depth_mm: float) -> tuple[Planned, Planned] | None:
    """Return both arms at the end of A2, PSM_M in its actual or else its desired pose; None if neither is known.

    Args:
        scene: The pass.
        approach_m: PSM_M's approach, shape (3,), for a scene without PSM_M; None if it is not known.
        depth_mm: Distance of PSM_M's hinge from its remote centre where its base is not known.
    """
    if scene.phase[-1] != A2:
        return None
    last = np.array([len(scene.phase) - 1])
    arm = scene.arms[0].at(last)
    if len(scene.arms) == 2:
        return arm, scene.arms[1].at(last)
    if scene.taking is not None:
        tip, jaw = scene.taking.tip_mm, scene.taking.rotation
    elif approach_m is not None:
        (tip,), (jaw,) = hand_off(arm.tip_mm, arm.rotation, approach_m)
    else:
        return None
    # An arm of which the base is not known: straight, and as deep as arms usually are.
    joints = np.zeros((1, 6))
    joints[:, kinematics.INSERTION] = (
        depth_mm + kinematics.instrument_of(kinematics.DEFAULT_INSTRUMENT).wrist_offset_mm - kinematics.WRIST_MM
    )
    (own_tip,), (own_jaw,) = kinematics.forward(joints)
    base = jaw @ own_jaw.T
    return arm, Planned(
        name=PSM_M,
        instrument=kinematics.DEFAULT_INSTRUMENT,
        joints=joints,
        jaw_rad=None,
        base=base,
        base_mm=tip - base @ own_tip,
        tip_mm=own_tip[None],
        rotation=own_jaw[None],
        opening_rad=np.zeros(1),
    )


def crossed(arms: tuple[Planned, Planned], shift_mm: Floats, errors: Displaced, turned: Floats) -> clearance.Crossing:
    """Return where the needle crosses PSM_M's jaws in N variations.

    Args:
        arms: Both arms at the hand-off, as `at_hand_off` returns them.
        shift_mm: Shift of the pass in each variation, shape (N, 3).
        errors: The displacements; the last of their samples counts.
        turned: Rotation of the needle about PSM_A's grip, shape (N, 3, 3).

    `clearance.crossing` has PSM_M's jaws as planned, so PSM_A is taken to where it is relative to them.
    """
    (tip_a, jaw_a), (tip_m, jaw_m) = (arm.poses_of(arm.joints) for arm in arms)
    planned = clearance.HandOff(tip_a[0], jaw_a[0], tip_m[0], jaw_m[0])
    (tip_a, jaw_a), (tip_m, jaw_m) = (arm.poses_of(arm.shifted(shift_mm)) for arm in arms)
    jaw_a, jaw_m, centre = errors.jaw_turn[0] @ jaw_a, errors.jaw_turn[1] @ jaw_m, arms[1].base_mm
    tip_m = np.einsum("nij,nj->ni", errors.base_turn, tip_m - centre) + centre + errors.base_mm
    back = planned.jaw_m @ np.swapaxes(errors.base_turn @ jaw_m, 1, 2)  # from PSM_M's jaws as they are to the planned
    askew = jaw_a @ planned.jaw_a.T
    grip = tip_a + errors.tip_mm[0, :, -1] + HELD_MM * jaw_a[:, :, 2] - tip_m - errors.tip_mm[1, :, -1]
    apart = np.einsum("nij,nj->ni", back, grip) - (planned.tip_a + HELD_MM * planned.jaw_a[:, 2] - planned.tip_m)
    return clearance.crossing(planned, back @ askew @ turned, apart)


def caught_by(at: clearance.Crossing, varied: EstimateSettings) -> tuple[Flags, Flags]:
    """Return whether the needle is between PSM_M's fingers, and at a right angle, each of shape (N,)."""
    return clearance.caught(varied.opening_rad).takes(at), at.askew_rad <= varied.stated_rad
