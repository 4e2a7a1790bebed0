"""Identification: which arm and instrument made a motion, and where the arm's base stood, from joints beside poses.

    joints, poses --identify--> Identification

A recording rarely says which arm generation it is of, with which instrument, and where the base was in the frame of its
poses. Joints and poses together do: forward kinematics q -> f(q) of the right arm and instrument is the recorded pose,
up to one rigid transform from the base to the frame of the poses, and that of a wrong one is not.

*Hypotheses.* Arms with instruments that can be told apart by their poses (`skills.demonstration.hypotheses`). Among
those with equal lengths what the file states decides, else the range of the joints, else the large needle driver of the
Classic is named, with all others in `candidates`.

*Fit.* For each hypothesis the transform is fitted to positions and orientations together (Kabsch), an orientation with
the weight of a lever of `LEVER_MM`. Where the recording states that its poses are in the arm's base, no transform is
fitted, and the base must be there.

*Time.* Joints and poses are rarely of the same moment. If the best fit leaves more than `FLOOR_MM` and the speeds of
the joints are known, the delay of the joints that fits best is found, and all hypotheses are fitted again without it.

*Decision.* A hypothesis fits with a residual of at most `FIT_MM` and `FIT_RAD`. Another one that fits nearly as well
(`MARGIN`, `PIECES`, `FLOOR_MM`) is not told apart: if their lengths differ by more than `SAME_MM`, the motion was too
small, and nothing is identified. If nothing fits as a whole, but each piece by itself, the frame of the poses moved.

Thresholds and decision are ours.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isfinite
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from skills.arithmetic import arccos, arcsin, product
from skills.arrays import Floats, frozen, xyz, xyzw
from skills.demonstration import hypotheses
from skills.fields import Count, Point, Quaternion, schema
from skills.kinematics import INSERTION, JAW_TIP_MM, axes_of, check_rotation, matrix_of, quaternion_of
from skills.quaternions import best_turn

FIT_MM = 1.0  # a recorder that writes the last joints it has at 30 Hz is off by 0.5 mm at 50 mm/s
FIT_RAD = 0.03  # the same of a wrist that turns at 3 rad/s
# A hypothesis is told apart if its residual is three times the best one's: an error of the recorder, as large as the
# best residual and in the direction of the difference, could otherwise exchange the two. Or if it is larger in each
# eighth of the recording: errors of stamps go with the speed of the joints, which has another sign and size in each.
MARGIN, PIECES = 3.0, 8
FLOOR_MM = 0.02  # and by as much more: the residual of sound recordings with stamps of their own is 0.02 mm
SAME_MM = 0.5  # hypotheses nearer to each other than this need not be told apart: the tip is known to as much
LEVER_MM = 30.0
LATEST_S = 0.05  # a larger delay is no delay; and the joints are moved by it along their speeds, not along their path
DELAYED_MM = 5.0  # at 100 mm/s the largest delay is this far; with a larger residual no delay is sought
MOST_SAMPLES = 6000  # evenly spread; more samples of one motion do not change the fit
TRIED_SAMPLES = 1500  # all hypotheses are fitted to so many of them, the best one to all
FEWEST_SAMPLES = 10
STILL_SHARE = 0.05  # of a piece's own extent: a piece that hardly moves fits everything
BEYOND_RAD, BEYOND_MM = 0.05, 5.0  # a measured joint may be this far beyond the limits with which its arm is driven
_WILD = 1e6  # rad or mm: no joint's value; the sine of it would be meaningless

Verdict = Literal["identified", "undetermined", "wrong instrument", "wrong frame", "moved frame", "contradiction"]


@schema
@dataclass(frozen=True, kw_only=True)
class Identification:
    """The arm and the instrument that joints and poses together show, and the place of the arm's base.

    Attributes:
        verdict: "identified": one arm with one instrument explains poses and joints, or several of equal lengths;
            "undetermined": the motion is too small, or joints and poses agree too little, to tell several apart;
            "wrong instrument": the stated one does not fit, and another one does;
            "wrong frame": the poses are not relative to the arm's base, as the recording states;
            "moved frame": each part fits by itself: the camera or the set-up joints moved;
            "contradiction": no known arm and instrument explains both.
        instrument: The instrument, such as "400006", or "420006-Classic" on an arm of the other generation; null if
            nothing is identified.
        generation: The arm's generation; null if nothing is identified.
        candidates: All instruments whose poses cannot be told from these, the named one first.
        stated: The instrument that the recording states; null if it states none.
        in_base: Whether the poses are relative to the arm's base.
        position_mm: Position of the arm's base in the frame of the poses.
        rotation_xyzw: Its rotation, a unit quaternion.
        residual_mm: Root mean square of the distances between the recorded positions and those of the joints.
        greatest_mm: The greatest of these distances.
        residual_rad: Root mean square of the angles between the orientations; null if they were not recorded.
        delay_s: Time by which the joints' stamps are later than those of the poses; 0 where it was not sought.
        next_mm: `residual_mm` of the best arm and instrument that is told apart from these; null if there is none.
        samples: Number of samples that were compared.
        reason: The verdict in words.
    """

    verdict: Verdict
    instrument: str | None = None
    generation: hypotheses.Generation | None = None
    candidates: tuple[str, ...] = ()
    stated: str | None
    in_base: bool
    position_mm: Point = (0.0, 0.0, 0.0)
    rotation_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)
    residual_mm: float
    greatest_mm: float
    residual_rad: float | None = None
    delay_s: float = 0.0
    next_mm: float | None = None
    samples: Count
    reason: str


@schema
@dataclass(frozen=True)
class ArmIdentification:
    """The arm, the instrument and the base that the joints of one topic and the poses of another show together.

    Attributes:
        arm: The arm's name.
        joints: The topic of the joints.
        topic: The topic of the poses.
        frame: The frame of the poses.
        found: What they show.
    """

    arm: str
    joints: str
    topic: str
    frame: str
    found: Identification

    def is_of(self, arm: str, topic: str) -> bool:
        """Return whether it is of the poses of an arm on a topic."""
        return (self.arm, self.topic) == (arm, topic)


@dataclass(frozen=True, eq=False)
class _Poses:
    """Joints as directions, and poses: what all hypotheses are compared with.

    Attributes:
        joints: Rad and mm, shape (T, 6).
        shaft: Direction of the shaft in the base, shape (T, 3).
        wrist: Direction from the wrist's pitch axis to the hinge in the base, shape (T, 3).
        turned: Rotation of the tip in the base, shape (T, 3, 3).
        tip_mm: Recorded positions in the frame of the poses, shape (T, 3).
        rotation: Recorded rotations in that frame, shape (T, 3, 3), or None.
        in_base: Whether that frame is stated to be the base.
        speeds: Speeds of the joints, rad/s and mm/s, shape (T, 6); None if they are not known.
        delay_s: The delay of the joints that was taken out of them.
        beyond_mm: Distance along the approach of the point that the positions are of from the hinge.
    """

    joints: Floats
    shaft: Floats
    wrist: Floats
    turned: Floats
    tip_mm: Floats
    rotation: Floats | None
    in_base: bool
    speeds: Floats | None = None
    delay_s: float = 0.0
    beyond_mm: float = 0.0

    def moved(self, joints: Floats) -> "_Poses":
        """Return the same poses with other joints."""
        shaft, wrist, turned = axes_of(joints)
        return replace(self, joints=joints, shaft=shaft, wrist=wrist, turned=turned)

    def tips_of(self, one: hypotheses.Hypothesis) -> Floats:
        """Return the positions in the base that a hypothesis predicts, mm, shape (T, 3)."""
        depth = self.joints[:, INSERTION : INSERTION + 1] - one.offset_mm
        tip: Floats = depth * self.shaft + one.wrist_mm * self.wrist
        return tip + self.beyond_mm * self.turned[:, :, 2] if self.beyond_mm else tip

    def part(self, samples: slice) -> "_Poses":
        """Return some of the samples."""
        rotation, speeds = (None if one is None else one[samples] for one in (self.rotation, self.speeds))
        return replace(self.moved(self.joints[samples]), tip_mm=self.tip_mm[samples], rotation=rotation, speeds=speeds)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A hypothesis with the best transform: position and rotation of the base in the frame of the poses."""

    of: hypotheses.Hypothesis
    position_mm: Floats
    rotation: Floats
    away_mm: Floats  # distance of each sample, shape (T,)
    residual_rad: float

    @property
    def residual_mm(self) -> float:
        """Root mean square of the distances."""
        return float(np.sqrt((self.away_mm**2).mean()))

    @property
    def is_good(self) -> bool:
        """Whether the hypothesis explains positions and orientations."""
        # NaN is not good.
        return self.residual_mm <= FIT_MM and self.residual_rad <= FIT_RAD


def identify(
    joints: ArrayLike,
    tip_mm: ArrayLike,
    rotation: ArrayLike | None = None,
    *,
    speeds: ArrayLike | None = None,
    in_base: bool = False,
    stated: str | None = None,
) -> Identification | None:
    """Find the arm, the instrument and the place of the arm's base that explain both joints and poses.

    Args:
        joints: Measured joints at the times of the poses, rad, the insertion in mm, shape (T, 6) or wider; a jaw after
            them is not used.
        tip_mm: Recorded positions of the tip in the frame of the poses, mm, shape (T, 3).
        rotation: Recorded rotations [n o a] in that frame, shape (T, 3, 3); None if they were not recorded.
        speeds: Speeds of the joints, of their shape, rad/s and mm/s; with them a delay of the joints is found.
        in_base: Whether that frame is stated to be the arm's base.
        stated: The instrument that the recording states: a number, or a name as in `stated_instrument`.

    Returns:
        The identification; None with fewer than `FEWEST_SAMPLES` samples or six joints.

    Raises:
        BadInput: A number is NaN or infinite, or the shapes do not agree.
        ImproperRotation: A rotation is not orthonormal with determinant 1.
    """
    q = frozen(joints, np.float64, (None, None), "joints")
    tip = frozen(tip_mm, np.float64, (len(q), 3), "tip_mm")
    turned = None if rotation is None else frozen(rotation, np.float64, (len(q), 3, 3), "rotation")
    speed = None if speeds is None else frozen(speeds, np.float64, q.shape, "speeds")
    if len(q) < FEWEST_SAMPLES or q.shape[1] < 6:
        return None
    chosen = np.linspace(0, len(q) - 1, min(len(q), MOST_SAMPLES)).round().astype(np.int64)
    q, tip, turned = q[chosen, :6], tip[chosen], None if turned is None else turned[chosen]
    speed = None if speed is None else speed[chosen, :6]
    if turned is not None:
        check_rotation(turned)
    number = None if stated is None else hypotheses.stated_instrument(stated)
    if not (np.abs(q) <= _WILD).all() or not (speed is None or (np.abs(speed) <= _WILD).all()):
        reason = "a joint's value or speed is beyond a million rad or mm"
        return Identification(
            verdict="contradiction",
            stated=number,
            in_base=in_base,
            residual_mm=_WILD,
            greatest_mm=_WILD,
            samples=len(q),
            reason=reason,
        )
    poses = _Poses(q, *axes_of(q), tip, turned, in_base, speed)
    few = poses.part(slice(None, None, -(-len(q) // TRIED_SAMPLES)))
    fits = sorted(_fits(few), key=_misfit)
    if speed is not None and FLOOR_MM < fits[0].residual_mm <= DELAYED_MM:
        few = _without_delay(few, fits[0].of)
        fits = sorted(_fits(few), key=_misfit)
        if few.delay_s:
            poses = replace(poses.moved(q + few.delay_s * speed), delay_s=few.delay_s)
    best = _fit(poses, fits[0].of)
    if not (fits[0].is_good and best.is_good):
        return _not_explained(few, fits[0], number)
    return _decided(poses, best, fits, number)


def _fits(poses: _Poses) -> Iterator[_Fit]:
    """Yield every hypothesis with the transform that fits it best."""
    for one in hypotheses.HYPOTHESES:
        yield _fit(poses, one)


def _without_delay(poses: _Poses, one: hypotheses.Hypothesis) -> _Poses:
    """Take the delay that fits a hypothesis best out of the joints; nothing changes if none up to `LATEST_S` does."""
    assert poses.speeds is not None
    now, step_s = poses, 1e-3
    for _ in range(3):
        fit, tip = _fit(now, one), now.tips_of(one)
        shift = (poses.moved(now.joints + step_s * poses.speeds).tips_of(one) - tip) / step_s
        off = product(now.tip_mm - fit.position_mm, fit.rotation) - tip
        way = float((shift**2).sum())
        if not way > 0.0:
            return poses
        delay_s = now.delay_s + float((off * shift).sum()) / way
        if not abs(delay_s) <= LATEST_S:
            return poses
        # Late joints are those of an earlier moment, and were further on at the moment of the pose.
        now = replace(poses.moved(poses.joints + delay_s * poses.speeds), delay_s=delay_s)
    return now


def _misfit(fit: _Fit) -> float:
    """Return by how much a hypothesis is off; NaN counts as infinite."""
    misfit = fit.residual_mm + LEVER_MM * fit.residual_rad
    return misfit if isfinite(misfit) else np.inf


def _fit(poses: _Poses, one: hypotheses.Hypothesis) -> _Fit:
    """Fit the transform from the base to the frame of the poses; none if that frame is stated to be the base."""
    tip = poses.tips_of(one)
    if poses.in_base:
        return _Fit(one, np.zeros(3), np.eye(3), np.linalg.norm(poses.tip_mm - tip, axis=1), _turn(poses, np.eye(3)))
    middle, recorded = tip.mean(axis=0), poses.tip_mm.mean(axis=0)
    covariance = np.einsum("ni,nj->ij", poses.tip_mm - recorded, tip - middle) / len(tip)
    if poses.rotation is not None:
        # The sum of R_recorded R_predicted^T; both sums are largest for the same rotation if the hypothesis is right.
        covariance += LEVER_MM**2 * np.einsum("nik,njk->ij", poses.rotation, poses.turned) / len(tip)
    rotation = matrix_of(best_turn(covariance)[None])[0]
    position = recorded - product(rotation, middle)
    away = np.linalg.norm(poses.tip_mm - position - product(tip, rotation.T), axis=1)
    return _Fit(one, position, rotation, away, _turn(poses, rotation))


def _turn(poses: _Poses, rotation: Floats) -> float:
    """Return the root mean square of the angles between recorded and predicted orientations; 0 if none are recorded."""
    if poses.rotation is None:
        return 0.0
    chord = np.sqrt(((poses.rotation - product(rotation, poses.turned)) ** 2).sum(axis=(1, 2)) / 8.0)
    return float(np.sqrt(((2.0 * arcsin(np.minimum(1.0, chord))) ** 2).mean()))


# ---- the decision -----------------------------------------------------------------------------------------------


def _decided(poses: _Poses, best: _Fit, fits: list[_Fit], stated: str | None) -> Identification:
    """Decide among the hypotheses, fitted to some samples, of which the first fits; `best` is fitted to all."""
    near = [fit for fit in fits if not _is_distinguishable(fit, fits[0])]
    others = [fit for fit in fits if fit not in near]
    if poses.in_base and (moved := _beside_the_base(poses, best, stated)) is not None:
        return moved
    stood = [name for fit in near for name in fit.of.names if _reaches(poses.joints, name)]
    found = _identified(
        poses, best, "identified", stood, stated, min((fit.residual_mm for fit in others), default=None)
    )
    names = _describe_candidates(found)
    if stated in hypotheses.OTHER_WRISTS or (stated in hypotheses.KNOWN and not hypotheses.matching(stood, stated)):
        reason = f"the recording states {stated}, but its joints and poses fit {names}"
        return replace(found, verdict="wrong instrument", reason=reason)
    lengths = np.array([(fit.of.offset_mm, fit.of.wrist_mm) for fit in near])
    if not stood or not (np.ptp(lengths, axis=0) <= SAME_MM).all():
        reason = f"the motion is too small to tell {len(found.candidates)} instruments apart ({names})"
        if best.residual_mm > MARGIN * FLOOR_MM:
            reason = (
                f"joints and poses agree to {best.residual_mm:.2f} mm (root mean square), those of sound recordings to "
                f"{FLOOR_MM} mm, so {len(found.candidates)} instruments fit ({names}): the zero of a joint, as of the "
                "insertion, is off, the frame of the poses moved, or their stamps are not those of the joints"
            )
        return replace(found, verdict="undetermined", instrument=None, generation=None, reason=reason)
    return replace(found, reason=f"joints and poses fit {names}")


def _is_distinguishable(other: _Fit, best: _Fit) -> bool:
    """Return whether a hypothesis explains the poses so much worse than the best one that it is not the right one."""
    if not other.is_good:
        return True
    worse_mm = other.residual_mm - best.residual_mm
    if worse_mm < FLOOR_MM:
        return False
    pieces = np.array_split(other.away_mm**2 - best.away_mm**2, PIECES)
    return other.residual_mm >= MARGIN * best.residual_mm or all(piece.mean() > 0.0 for piece in pieces)


def _reaches(joints: Floats, name: str) -> bool:
    """Return whether the arm of an instrument can have these joints."""
    arm = hypotheses.ARMS[hypotheses.generation_of(name)]
    beyond = np.array([BEYOND_RAD, BEYOND_RAD, BEYOND_MM])
    low, high = np.array(arm.lower[:3]) - beyond, np.array(arm.upper[:3]) + beyond
    return bool(((joints[:, :3] >= low) & (joints[:, :3] <= high)).all())


def _beside_the_base(poses: _Poses, best: _Fit, stated: str | None) -> Identification | None:
    """Return the verdict that poses stated to be in the base are up to `FIT_MM` off it; None if they are in it."""
    free = _fit(replace(poses, in_base=False), best.of)
    within = max(MARGIN * free.residual_mm, free.residual_mm + 0.1)
    return None if best.residual_mm <= within else _wrong_frame(poses, free, stated)


def _wrong_frame(poses: _Poses, free: _Fit, stated: str | None) -> Identification:
    """Return the verdict that poses stated to be in the base are in another frame, to which `free` leads from it."""
    x, y, z = free.position_mm.tolist()
    turn = np.degrees(arccos(np.clip((np.trace(free.rotation) - 1.0) / 2.0, -1.0, 1.0)))
    reason = (
        f"the poses are stated to be relative to the arm's base, but the joints put the base at ({x:.1f}, {y:.1f}, "
        f"{z:.1f}) mm in their frame, turned by {turn:.1f} degrees"
    )
    return _identified(replace(poses, in_base=False), free, "wrong frame", [], stated, reason=reason)


def _identified(
    poses: _Poses,
    fit: _Fit,
    verdict: Verdict,
    names: list[str],
    stated: str | None,
    next_mm: float | None = None,
    reason: str = "",
) -> Identification:
    """Return a verdict with the numbers of a fit; of some instruments the stated one is named first."""
    preferred = hypotheses.matching(names, stated) if stated is not None else []
    candidates = tuple(dict.fromkeys(preferred + names))
    first = candidates[0] if candidates else None
    return Identification(
        verdict=verdict,
        instrument=first,
        generation=None if first is None else hypotheses.generation_of(first),
        candidates=candidates,
        stated=stated,
        in_base=poses.in_base or _is_identity(fit),
        position_mm=xyz(fit.position_mm),
        rotation_xyzw=xyzw(quaternion_of(fit.rotation[None])[0]),
        residual_mm=fit.residual_mm,
        greatest_mm=float(fit.away_mm.max()),
        residual_rad=None if poses.rotation is None else fit.residual_rad,
        delay_s=poses.delay_s,
        next_mm=next_mm,
        samples=len(poses.tip_mm),
        reason=reason,
    )


def _is_identity(fit: _Fit) -> bool:
    """Return whether the fitted transform moves nothing, within the residual."""
    # A turn moves the tip, which is up to about 200 mm from the remote centre.
    away = np.linalg.norm(fit.position_mm, axis=-1) + 200.0 * np.abs(fit.rotation - np.eye(3)).max()
    return bool(away <= max(MARGIN * fit.residual_mm, 0.1))


def _describe_candidates(found: Identification) -> str:
    """Return the first four candidates and the number of the others, in words."""
    shown = ", ".join(found.candidates[:4])
    more = len(found.candidates) - 4
    return f"{shown} and {more} more" if more > 0 else shown or "no arm whose joints reach so far"


# ---- if nothing fits --------------------------------------------------------------------------------------------


def _not_explained(poses: _Poses, best: _Fit, stated: str | None) -> Identification:
    """Return the verdict if no hypothesis fits the poses as they are stated to be, explained if possible."""
    if poses.in_base:
        free = min(_fits(replace(poses, in_base=False)), key=_misfit)
        if free.is_good:
            return _wrong_frame(poses, free, stated)
    elif _fits_in_pieces(poses):
        reason = "each part of the recording fits by itself, but not all together: the frame of the poses moved"
        return _identified(poses, best, "moved frame", [], stated, reason=reason)
    turn = "" if poses.rotation is None else f" and {np.degrees(best.residual_rad):.1f} degrees"
    reason = (
        "no known arm and instrument puts the tip where the poses have it: the best is off by "
        f"{best.residual_mm:.2f} mm{turn} (root mean square)"
    )
    hint = next((words for words, tried in _explanations(poses) if min(map(_misfit, _fits(tried))) < _BETTER), None)
    reason = reason if hint is None else f"{reason}; they would agree {hint}"
    return _identified(poses, best, "contradiction", [], stated, reason=reason)


_BETTER = FIT_MM + LEVER_MM * FIT_RAD  # the `_misfit` of a hypothesis that just fits


def _fits_in_pieces(poses: _Poses) -> bool:
    """Return whether one hypothesis fits every eighth of the recording, each with a transform of its own."""
    edges = np.linspace(0, len(poses.tip_mm), PIECES + 1).round().astype(np.int64)
    pieces = [poses.part(slice(a, b)) for a, b in pairwise(edges.tolist())]
    if min(len(piece.tip_mm) for piece in pieces) < FEWEST_SAMPLES:
        return False
    extent = np.concatenate([piece.tip_mm - piece.tip_mm.mean(axis=0) for piece in pieces])
    least_mm = STILL_SHARE * float(np.sqrt((extent**2).sum(axis=1).mean()))
    for one in hypotheses.HYPOTHESES:
        fits = [_fit(piece, one) for piece in pieces]
        away_mm = float(np.sqrt((np.concatenate([fit.away_mm for fit in fits]) ** 2).mean()))
        # A frame that moves during a piece spoils this piece alone.
        if (
            sum(fit.is_good for fit in fits) >= PIECES - 2
            and float(np.median([f.residual_mm for f in fits])) <= least_mm
        ):
            return away_mm <= 20.0 * FIT_MM
    return False


def _explanations(poses: _Poses) -> Iterator[tuple[str, _Poses]]:
    """Yield mistakes that recorders make, in words, with the poses as they are without the mistake."""
    angles = np.array([0, 1, 3, 4, 5])
    for words, factor in (("degrees", np.pi / 180.0), ("radians", 180.0 / np.pi)):
        joints = poses.joints.copy()
        joints[:, angles] *= factor
        yield f"if the joints were in {words}", poses.moved(joints)
    for words, factor in (("millimetres", 1e-3), ("metres", 1e3)):
        joints = poses.joints.copy()
        joints[:, INSERTION] *= factor
        yield f"if the insertion were in {words}", poses.moved(joints)
        yield f"if the positions were in {words}", replace(poses, tip_mm=poses.tip_mm * factor)
    for axis, name in enumerate("xyz"):
        mirror = np.where(np.arange(3) == axis, -1.0, 1.0)
        yield (
            f"with {name} reversed (the frame is left-handed)",
            replace(
                poses,
                tip_mm=poses.tip_mm * mirror,
                rotation=None if poses.rotation is None else mirror[:, None] * poses.rotation * mirror,
            ),
        )
        yield f"with {name} of the positions reversed", replace(poses, tip_mm=poses.tip_mm * mirror)
    yield "if the positions were those of the finger tips", replace(poses, beyond_mm=JAW_TIP_MM)
    if poses.rotation is not None:
        yield "if the orientations were inverted", replace(poses, rotation=poses.rotation.swapaxes(1, 2))
        yield "without the orientations", replace(poses, rotation=None)
