"""How likely a plan is to succeed when the world is not exact: seeded variations, judged in closed form.

    trajectory --doubt--> Doubt: how often each pass stays clear and its needle is caught

A *variation* of a pass draws three things, independently of one another and of other passes:

* Tip error. Each arm is not where its joints say, by an offset that stays over the pass, as after a registration: even
  in all directions, normally distributed, of a mean length of 0.65 mm (a calibrated dVRK) or 3 mm (one that is not):
  Hwang et al., "Efficiently Calibrating Cable-Driven Surgical Robots With RGBD Fiducial Sensing and Recurrent Neural
  Networks" (arXiv:2003.08520), measured a mean tracking error of 2.96 mm, and of 0.65 mm once calibrated. The arms'
  offsets are independent, so between the jaws it is sqrt(2) of one. Joints stay as commanded; the whole arm is offset.
* Suture point. The pass, and all that belongs to it (pad, needle, hand-off), is up to 5 mm elsewhere along each axis,
  evenly drawn. The arms' bases stay, and the joints are solved anew.
* Needle angle. The needle stands in PSM_A's jaws up to 10 degrees off, evenly drawn, about any axis through the grip.

A variation is *clear* where every looked-at pose of the pass keeps to the playback's limits: joints, cannula, pad, and
the other arm, where its place is known; fingers may touch fingers at the hand-off itself. Speeds are not judged: a
plan that is made elsewhere has its own.

The needle is *caught* where its arc crosses the plane in which PSM_M's fingers close, at the end of A2, within the
sector that they sweep, with needle to spare on both sides of them, and its tangent there is within the stated angle of
their hinge. That needs PSM_M's wanted pose and not its base. Without PSM_M's approach there is no hand-off to judge.

The paper has its arms where they should be; all of this is ours but the two errors.
"""

from dataclasses import dataclass, field
from math import isfinite, radians

import numpy as np
from numpy.typing import ArrayLike

from skills.errors import BadInput, BadSettings
from skills.style.catch import HandOff, catch
from skills.style.disturbance import wilson
from skills.style.gates import JudgeSettings
from skills.style.handoff import OPEN_RAD, hand_off
from skills.style.kinematics import Bools
from skills.style.trajectory import A2, Trajectory
from skills.style.variation import Scene, draw, looked_at, scene_of, spoiled

CALIBRATED_MM, UNCALIBRATED_MM = 0.65, 3.0
ON_THE_WAY, AT_THE_END = ("reach", "limits", "pad", "arms"), ("place", "angle")


@dataclass(frozen=True)
class DoubtSettings:
    """What varies, and when the needle is caught. All of it but the tip errors is ours; the reasons are beside each.

    Attributes:
        variations: Of each pass. With 1000 the bounds are 6 % apart at a probability of a half, 0.4 % at one.
        tip_errors_mm: Mean length of each arm's offset: a calibrated and an uncalibrated dVRK.
        suture_point_mm: Most that the suture point is off along each axis.
        needle_rad: Most that the needle is turned in PSM_A's jaws.
        stated_rad: Most between the needle's tangent and PSM_M's hinge: what the needle itself bends within jaws that
            are 2.2 mm wide, so they close on it as on one that is straight.
        opening_rad: How far each of PSM_M's fingers is open when it comes.
        stretches: Into so many of like travel a pass is divided; of each some poses are looked at (`looked_at`). With
            20, about 50 a pass, no other was nearer to the pad, nor by more than 0.2 mm to the other arm.
    """

    variations: int = 1000
    tip_errors_mm: tuple[float, ...] = (CALIBRATED_MM, UNCALIBRATED_MM)
    suture_point_mm: float = 5.0
    needle_rad: float = radians(10)
    stated_rad: float = radians(15)
    opening_rad: float = OPEN_RAD
    stretches: int = 20

    def __post_init__(self) -> None:
        if not (1 <= self.variations <= 1_000_000 and 1 <= self.stretches <= 1000 and self.tip_errors_mm):
            raise BadSettings("Doubt needs 1 to 1000000 variations, 1 to 1000 stretches and at least one tip error.")
        for one in (*self.tip_errors_mm, self.suture_point_mm, self.needle_rad, self.stated_rad, self.opening_rad):
            if not (isfinite(one) and one >= 0):
                raise BadSettings("Every doubt is a finite number, 0 or more.", given=one)


@dataclass(frozen=True)
class Share:
    """How many of the variations, and the probability with its Wilson bounds, 95 %."""

    count: int
    of: int
    probability: float
    lower: float
    upper: float


@dataclass(frozen=True)
class Faults:
    """In how many variations what goes wrong; one variation may have several. None: it was not judged.

    Attributes:
        reach: A joint of either arm beyond its limits.
        limits: The same, or nearer to them than the playback allows, or a wrist inside the cannula.
        pad: An arm too near the pad.
        arms: The arms too near each other.
        place: The needle not between PSM_M's fingers.
        angle: The needle askew there, or not there at all.
    """

    reach: int | None = None
    limits: int | None = None
    pad: int | None = None
    arms: int | None = None
    place: int | None = None
    angle: int | None = None


@dataclass(frozen=True)
class PassDoubt:
    """A pass under one tip error: it succeeds where it is clear and, if there is a hand-off, the needle is caught."""

    succeeds: Share
    clear: Share
    caught: Share | None
    faults: Faults


@dataclass(frozen=True)
class TipDoubt:
    """A plan under one tip error: every pass, and all of them one after another."""

    tip_error_mm: float
    plan: Share
    passes: tuple[PassDoubt, ...]


@dataclass(frozen=True)
class Doubt:
    """What was found, as plain numbers: the same for the same trajectory, pad, settings and seed, wherever it ran.

    `with_psm_m` is whether PSM_M's arm was there to be met; `hand_offs` in how many passes a catch was judged;
    `looked_at` how many poses of each pass.
    """

    seed: int
    pad_top_mm: float
    with_psm_m: bool
    hand_offs: int
    looked_at: tuple[int, ...]
    under: tuple[TipDoubt, ...]
    settings: DoubtSettings = field(default_factory=DoubtSettings)
    limits: JudgeSettings = field(default_factory=JudgeSettings)


def doubt(
    trajectory: Trajectory,
    *,
    approach_m: ArrayLike | None,
    pad_top_mm: float,
    seed: int = 0,
    settings: DoubtSettings | None = None,
    limits: JudgeSettings | None = None,
) -> Doubt:
    """Vary a plan and count how often its passes stay clear and its needles are caught.

    Args:
        trajectory: What shall be played, with PSM_M beside it where its place is known.
        approach_m: PSM_M's approach in the PSM_A base frame, shape (3,); None where it is not known. Not used where
            PSM_M is beside the trajectory: then its own last pose counts.
        pad_top_mm: Height of the pad's top in the PSM_A base frame; the pad is taken to be endless.
        seed: Of what is drawn.
        settings: What varies, and when the needle is caught.
        limits: What the playback allows.

    Raises:
        BadInput: The pad's height is not finite, or a jaw's last pose is not turned to `approach_m`.
        BadSettings: The seed is negative.
    """
    if not isfinite(pad_top_mm):
        raise BadInput("The pad's height must be a number; give it in mm in the PSM base frame.", pad_top_mm=pad_top_mm)
    if seed < 0:
        raise BadSettings("A seed is 0 or more.", seed=seed)
    varied, allowed = settings or DoubtSettings(), limits or JudgeSettings()
    scenes = [scene_of(trajectory, k, float(pad_top_mm), varied.opening_rad) for k in range(trajectory.passes)]
    thin = [looked_at(scene, varied.stretches) for scene in scenes]
    found = [_wrong(scene, number, approach_m, varied, allowed, seed) for number, scene in enumerate(thin)]
    return Doubt(
        seed=seed,
        pad_top_mm=float(pad_top_mm),
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
    scene: Scene, number: int, approach_m: ArrayLike | None, varied: DoubtSettings, limits: JudgeSettings, seed: int
) -> dict[str, Bools]:
    """Vary a pass and find what goes wrong: for each fault that was judged, shape (tip errors, variations)."""
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


def _hand_off(scene: Scene, approach_m: ArrayLike | None) -> HandOff | None:
    """Take both arms at the end of A2, PSM_M where it is or else where it should be; None where that is not known."""
    if scene.phase[-1] != A2:
        return None
    tip, jaw = scene.arms[0].tip_mm[-1], scene.arms[0].rotation[-1]
    if len(scene.arms) == 2:
        other = scene.arms[1]
        return HandOff(tip, jaw, other.base @ other.tip_mm[-1] + other.base_mm, other.base @ other.rotation[-1])
    if approach_m is None:
        return None
    (tip_m,), (jaw_m,) = hand_off(tip[None], jaw[None], approach_m)
    return HandOff(tip, jaw, tip_m, jaw_m)


# ---- counting --------------------------------------------------------------------------------------------------


def _under(found: list[dict[str, Bools]], tip_error_mm: float) -> TipDoubt:
    """Count the variations of each pass; a plan succeeds where all its passes do in variations of one number."""
    wrong = np.any([np.any(list(one.values()), axis=0) for one in found], axis=0)
    return TipDoubt(tip_error_mm, _share(wrong), tuple(_pass(one) for one in found))


def _pass(found: dict[str, Bools]) -> PassDoubt:
    on_the_way, at_the_end = ([found[name] for name in names if name in found] for names in (ON_THE_WAY, AT_THE_END))
    return PassDoubt(
        succeeds=_share(np.any(on_the_way + at_the_end, axis=0)),
        clear=_share(np.any(on_the_way, axis=0)),
        caught=_share(np.any(at_the_end, axis=0)) if at_the_end else None,
        faults=Faults(**{name: int(np.count_nonzero(wrong)) for name, wrong in found.items()}),
    )


def _share(wrong: Bools) -> Share:
    """Count where nothing is wrong."""
    count, of = int(np.count_nonzero(~wrong)), len(wrong)
    lower, upper = wilson(count, of)
    return Share(count, of, count / of, lower, upper)
