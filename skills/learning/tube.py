"""Following a pose path from where the hand is, and a tube that the motion provably stays in.

    PosePath, pose, phase --next_pose--> the next pose and phase
    PosePath, TubeLimits --certify_tube--> TubeCertificate
    CertifiedPoses, Scene --clear_tube--> CertifiedPoses whose tube touches nothing

Phase k is the index of a pose of the path. In each tick the farthest pose of the next `ahead` phases that one step can
reach, in mm and in rad, becomes the phase, and is where the hand is sent; if not even the present phase's pose can be
reached, a whole step is made towards it, and the phase waits. So time does not run away from a hand that is held.

*The bound.* Let s be the longest step, e the largest disturbance of a tick, m the path's largest move over the window,
and r the distance from the pose of the phase, each in mm and each in rad.

1. If r <= e and e + m <= s, all of the window can be reached, so the hand is sent to phase k + `ahead` exactly, and
   after the disturbance r <= e again. The rest of the path takes one tick for each window.
2. Otherwise, if the pose of the phase is beyond s, r becomes at most r - s + e, which is smaller as s > e; if it is
   within s, the hand is sent to a pose of the path, and r <= e afterwards.

So a start at most r0 from the path comes within e of it in finite time, and the distance is never above the larger of
r0 and e: the radius of the tube. Between two ticks the hand moves on the straight line, and with a window of several
phases the path may bulge from it; that bulge is added. Distances of poses are Euclidean, those of orientations the
angle of the rotation between them; both obey the triangle inequality, which is all that is used.

The premises are checked, not assumed: `certify_tube` measures m and the bulge on the path, and calls the update itself
at every phase, at the distances at which its branches meet. It does not prove anything of the arm that executes it,
and nothing of the other arm beside the path (`PosePath.partner`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from skills.arrays import Flags, Floats
from skills.demonstration.demonstration import Demo
from skills.demonstration.partner import Partner, PartnerMotion
from skills.errors import BadSettings
from skills.gridworld.grid import MOVES
from skills.gridworld.hazards import STAY
from skills.gridworld.scene import Scene
from skills.learning.pose_step import ROUNDING, Hands, advance
from skills.learning.pose_style import PosePath, learn_pose_style
from skills.learning.tube_certificate import TubeCertificate, TubeClearance, TubeLimits
from skills.quaternions import INVERSE, angle_of, between, multiplied, of_vector

DIRECTIONS = 26  # towards which the update is tried: along the axes, and the diagonals between them

Update = Callable[[PosePath, Hands, TubeLimits], Hands]


@dataclass(frozen=True, eq=False)
class CertifiedPoses:
    """The motion that a style's demonstrations give at their own place, with the certificate of its tube.

    Attributes:
        arm: The arm that was demonstrated.
        frame: The frame of all poses.
        path: The motion from the start pose to the goal pose of the demonstration whose place it has.
        tube: The certificate; a motion whose certificate does not hold is not served.
        partner: The other arm as it took the needle in that demonstration; None if it was not recorded.
        scene: How near the path comes to the scene for which the tube was narrowed; None for no scene, and where it
            is stored.
        partner_scene: How near the other arm's motion comes to that scene; None for no scene or no such motion, and
            where it is stored. No tube is around that motion, so nothing is narrowed or refused for it.
    """

    arm: str
    frame: str
    path: PosePath
    tube: TubeCertificate
    partner: Partner | None = None
    scene: TubeClearance | None = None
    partner_scene: TubeClearance | None = None

    @property
    def tick_s(self) -> float:
        """The time of a phase: a tick that advances by one takes as long as in the demonstrations."""
        return float(self.path.elapsed_s[-1]) / (len(self.path.elapsed_s) - 1)


def certified_poses(
    demos: Sequence[Demo],
    at: int = 0,
    partners: Sequence[PartnerMotion | None] | None = None,
    join_share: float = 0.0,
) -> CertifiedPoses | None:
    """Learn the poses of a style, and certify the tube around them with the default limits.

    Args:
        demos: Demonstrations of one arm in one frame.
        at: The index of the one at whose start and goal pose the motion lies.
        partners: The other arm along each demonstration; it is in the motion if every one has it, of the same arm. It
            has no part in the certificate.
        join_share: The joining rule, as that of a learner: least share of the motion that a start is led to follow.

    Returns:
        The motion, whether its certificate holds or not; None if a demonstration has no orientation.

    Raises:
        BadInput: There is no demonstration.
        MixedFrames: They are in different frames.
    """
    place = demos[at] if demos else None
    if place is not None and (place.rotation_xyzw is None or any(one.rotation_xyzw is None for one in demos)):
        return None
    arms = {None if one is None else one.arm for one in partners or ()}
    style = learn_pose_style(demos, partners if len(arms) == 1 and None not in arms else None)
    assert place is not None and place.rotation_xyzw is not None, "checked above, and by `learn_pose_style`"
    path = style.between(place.tip_mm[0], place.rotation_xyzw[0], place.tip_mm[-1], place.rotation_xyzw[-1])
    return CertifiedPoses(
        place.arm, style.frame, path, certify_tube(path, TubeLimits(join_share=join_share)), place.partner
    )


def certify_tube(path: PosePath, limits: TubeLimits, update: Update = advance) -> TubeCertificate:
    """Certify that runs from all starts near a path stay in a tube around it and reach its end.

    Args:
        path: The motion to follow.
        limits: The assumptions.
        update: The update of one tick.

    Returns:
        The certificate, with the premises that do not hold.

    Raises:
        BadSettings: The window is not shorter than the path.
    """
    if limits.ahead >= len(path.tip_mm):
        raise BadSettings(
            "The window of a tube must be shorter than its path.", ahead=limits.ahead, phases=len(path.tip_mm)
        )
    moves = [_moves(path, ahead) for ahead in range(1, limits.ahead + 1)]
    move_mm, move_rad = (float(max(move[k] for move in moves)) for k in (0, 1))
    faults = []
    for unit, step, disturbance, move in (
        ("mm", limits.step_mm, limits.disturbance_mm, move_mm),
        ("rad", limits.step_rad, limits.disturbance_rad, move_rad),
    ):
        if not disturbance + move <= step:  # written so that NaN fails
            faults.append(
                f"A step of {step:g} {unit} is not as long as the disturbance of {disturbance:g} {unit} and the path's "
                f"move of {move:.3g} {unit} together"
            )
    if not (np.abs(np.linalg.norm(path.rotation_xyzw, axis=1) - 1.0) <= ROUNDING).all():
        faults.append("The path has quaternions that are not of length one")
    tried, wrong = _try_update(path, limits, update)
    bulge_mm, bulge_rad = _bulge(path, limits.ahead)
    approach = max(
        (limits.start_mm - limits.disturbance_mm) / (limits.step_mm - limits.disturbance_mm),
        (limits.start_rad - limits.disturbance_rad) / (limits.step_rad - limits.disturbance_rad),
        0.0,
    )
    return TubeCertificate(
        limits,
        move_mm,
        move_rad,
        max(limits.start_mm, limits.disturbance_mm) + bulge_mm,
        max(limits.start_rad, limits.disturbance_rad) + bulge_rad,
        ceil(approach) + 1 + ceil((len(path.tip_mm) - 1) / limits.ahead),
        tried,
        (*faults, *wrong),
    )


def clear_tube(poses: CertifiedPoses, scene: Scene) -> CertifiedPoses:
    """Narrow a tube, if necessary, until no run in it touches a scene.

    A run stays within the tube's radius of the path, so it touches nothing if the path is further than that from every
    part of the scene. The radius follows from how far off a start may be: starts that are too far off are excluded.
    The tip is a point, as in the grid world: fingers and shaft belong into the scene's margin.

    Args:
        poses: The motion, with the certificate of its tube.
        scene: What must not be touched, in the frame of the motion.

    Returns:
        The motion with the distance of its path from the scene, and a tube of that radius at most. If not even a run
        from the path itself is clear of the scene, the certificate has that as a fault, and does not hold. The distance
        of the other arm's motion is stated, and decides nothing: a part of the scene may be that arm itself.

    Raises:
        BadSettings: The scene is in another frame.
    """
    if scene.frame != poses.frame:
        raise BadSettings(f"The scene is in the frame '{scene.frame}', the motion in '{poses.frame}'.")
    tube, path = poses.tube, poses.path
    limits = tube.limits
    near = _nearest(scene, path.tip_mm)
    if near is None:
        return poses
    bulge_mm = tube.radius_mm - max(limits.start_mm, limits.disturbance_mm)
    start_mm = float(np.minimum(limits.start_mm, near.least_mm - bulge_mm - ROUNDING))
    if not start_mm >= limits.disturbance_mm:  # written so that NaN fails
        needed_mm = limits.disturbance_mm + bulge_mm
        tube = replace(
            tube,
            faults=(
                *tube.faults,
                f"The path comes within {near.least_mm:.1f} mm of {near.part} of the scene after phase {near.phase}, "
                f"and a run that starts on it may be {needed_mm:.1f} mm off",
            ),
        )
    elif start_mm < limits.start_mm:
        tube = certify_tube(path, replace(limits, start_mm=start_mm))
    beside = None if path.partner is None else _nearest(scene, path.partner.tip_mm)
    return replace(poses, tube=tube, scene=near, partner_scene=beside)


def _nearest(scene: Scene, tip_mm: Floats) -> TubeClearance | None:
    """Return how near positions, (N, 3), and the straight lines between them come to a scene; None for an empty one."""
    apart_mm = scene.from_lines_mm(tip_mm[:-1], tip_mm[1:])
    if not apart_mm:
        return None
    part = min(apart_mm, key=lambda name: float(apart_mm[name].min()))
    return TubeClearance(float(apart_mm[part].min()), part, int(apart_mm[part].argmin()))


def _moves(path: PosePath, ahead: int) -> tuple[float, float]:
    """Return the largest distance and angle between two poses of a path that are some phases apart."""
    turns = path.rotation_xyzw
    moved = np.linalg.norm(path.tip_mm[ahead:] - path.tip_mm[:-ahead], axis=1)
    turned = _angles(turns[:-ahead], turns[ahead:])
    return float(moved.max(initial=0.0)), float(turned.max(initial=0.0))


def _bulge(path: PosePath, ahead: int) -> tuple[float, float]:
    """Return how far a path is at most from the straight way between two poses of it within the window, mm and rad."""
    furthest_mm, furthest_rad = 0.0, 0.0
    turns = path.rotation_xyzw
    for window in range(2, ahead + 1):
        for inside in range(1, window):
            share = inside / window
            chord = (1 - share) * path.tip_mm[:-window] + share * path.tip_mm[window:]
            off = np.linalg.norm(path.tip_mm[inside : inside - window] - chord, axis=1)
            way = between(turns[:-window], turns[window:], np.full(len(off), share))
            angle = _angles(way, turns[inside : inside - window])
            furthest_mm, furthest_rad = max(furthest_mm, off.max()), max(furthest_rad, angle.max())
    return float(furthest_mm), float(furthest_rad)


def _try_update(path: PosePath, limits: TubeLimits, update: Update) -> tuple[int, list[str]]:
    """Check what the bound assumes of the update, at every phase, at all pairs of the distances that decide.

    The directions alternate: every phase and every pair of distances is tried towards all of them, but not each pair at
    each phase, so that a batch does not spend more time on certificates than on learning.

    Returns:
        The number of updates checked, and the assumptions that do not hold.
    """
    sides = np.delete(MOVES, STAY, axis=0)
    sides = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    far_mm, far_rad = (
        _deciding(step, disturbance, start)
        for step, disturbance, start in (
            (limits.step_mm, limits.disturbance_mm, limits.start_mm),
            (limits.step_rad, limits.disturbance_rad, limits.start_rad),
        )
    )
    apart = np.stack(np.meshgrid(far_mm, far_rad, indexing="ij"), axis=-1).reshape(-1, 2)
    phases = np.repeat(np.arange(len(path.tip_mm)), len(apart))
    off = np.tile(apart, (len(path.tip_mm), 1))
    side = (phases + 7 * np.tile(np.arange(len(apart)), len(path.tip_mm))) % DIRECTIONS  # 7 has no divisor with 26
    before = Hands(
        path.tip_mm[phases] + sides[side] * off[:, :1],
        multiplied(path.rotation_xyzw[phases], of_vector(sides[side[::-1]] * off[:, 1:])),
        phases,
    )
    after = update(path, before, limits)
    stepped = np.linalg.norm(after.tip_mm - before.tip_mm, axis=1)
    turned = _angles(before.rotation_xyzw, after.rotation_xyzw)
    off_mm = np.linalg.norm(after.tip_mm - path.tip_mm[after.phases], axis=1)
    off_rad = _angles(after.rotation_xyzw, path.rotation_xyzw[after.phases])
    waits = after.phases == before.phases
    wanted_mm = np.where(waits, np.maximum(off[:, 0] - limits.step_mm, 0.0), 0.0)
    wanted_rad = np.where(waits, np.maximum(off[:, 1] - limits.step_rad, 0.0), 0.0)
    inside = (off[:, 0] <= limits.disturbance_mm) & (off[:, 1] <= limits.disturbance_rad)
    due = np.minimum(before.phases + limits.ahead, len(path.tip_mm) - 1)
    checks: dict[str, Flags] = {
        "An orientation is not a unit quaternion": (
            np.abs(np.linalg.norm(after.rotation_xyzw, axis=1) - 1.0) <= ROUNDING
        ),
        "A step is longer than the longest": stepped <= limits.step_mm + ROUNDING,
        "A turn is larger than the largest": turned <= limits.step_rad + ROUNDING,
        "The phase advances by more than the window, or goes back": (
            (after.phases >= before.phases) & (after.phases <= due)
        ),
        "The phase advances to a position that is not reached": waits | (off_mm <= ROUNDING),
        "The phase advances to an orientation that is not reached": waits | (off_rad <= ROUNDING),
        "A step does not come nearer to the position by its whole length": off_mm <= wanted_mm + ROUNDING,
        "A turn does not come nearer to the orientation by its whole size": off_rad <= wanted_rad + ROUNDING,
        "The phase does not advance by the window within the disturbance": ~inside | (after.phases == due),
    }
    return len(off), [
        f"{name} at {int((~held).sum())} of {len(off)} poses" for name, held in checks.items() if not held.all()
    ]


def _angles(one_xyzw: Floats, other_xyzw: Floats) -> Floats:
    """Return the angles between orientations, unit quaternions (R, 4), exact also near 0."""
    return angle_of(multiplied(one_xyzw * INVERSE, other_xyzw))


def _deciding(step: float, disturbance: float, start: float) -> Floats:
    """Return the distances at which the branches of the update meet, and some between them."""
    return np.unique(
        [0.0, disturbance / 2, disturbance, (disturbance + step) / 2, step, 1.001 * step, (step + start) / 2, start]
    )
