"""The needle: its pose in the jaws that hold it, its distance from the pad, and its catch by PSM_M's jaws.

    Trajectory --needle_poses--> pose of the needle --needle_to_pad_mm--> mm
    HandOff, errors --catch--> between the fingers or not, angle to their hinge

PSM_A holds the needle from the first sample to the hand-off. If PSM_M's place is known, it holds the needle from there
until PSM_A is where the next pass begins. M1 and M2, where the needle goes through tissue, are done by hand by a
surgeon. So the needle's distance from the pad is reported but is not a gate of any verdict.

The catch is computed in closed form and for many slightly wrong hand-offs at once. Symbols: the needle is an arc of
radius r that leaves PSM_A's grip in direction u and bends towards t, so after the angle phi it is at r (t (1 - cos phi)
+ u sin phi) from the grip, where it runs along t sin phi + u cos phi. In the frame of PSM_M's jaws x lies along their
hinge n, y from finger to finger, z along the approach. The fingers close in the plane x = 0; the arc crosses it at the
phi with

    t_x cos phi - u_x sin phi = t_x + g_x / r     with the grip at g.

When the fingers close they sweep a sector of that plane about the hinge and bring everything within it to its middle.
All of this is ours.
"""

from dataclasses import dataclass
from math import cos, pi, sin

import numpy as np

from skills.arrays import Flags, Floats, Ints
from skills.kinematics import JAW_TIP_MM, forward, matrix_of
from skills.planning.handoff import HELD_MM, NEEDLE_RADIUS_MM
from skills.planning.trajectory import TRANSFER, Trajectory
from skills.verification.clearance import FINGER_RADIUS_MM, WRIST_RADIUS_MM
from skills.verification.playback import PAD_SIZE_MM, pad_scale

RADIUS_MM = 0.33  # of the needle's wire
# The arc from the place where it is held, two thirds from the tip: x along the needle, y towards the arc's centre.
_TURN = np.linspace(-pi / 3, 2 * pi / 3, 49)
_ARC_MM: Floats = NEEDLE_RADIUS_MM * np.stack([np.sin(_TURN), 1 - np.cos(_TURN), np.zeros_like(_TURN)], axis=1)


def needle_poses(trajectory: Trajectory, at: Ints) -> tuple[Floats, Floats]:
    """Return the poses of the needle at some samples.

    Args:
        trajectory: The trajectory.
        at: The samples, shape (F,).

    Returns:
        The place where it is held, mm in the PSM_A base frame, shape (F, 3), and the rotation of its frame, shape (F,
        3, 3).
    """
    place, rotation = _in_jaws_of_psm_a(trajectory, at)
    away = (trajectory.phase[at] == TRANSFER) & (trajectory.pass_index[at] > 0)
    if trajectory.psm_m is None or not away.any():
        return place, rotation
    taken = trajectory.last_samples[trajectory.pass_index[at[away]] - 1]
    (tip, jaws), (tip_then, jaws_then) = psm_m_poses(trajectory, at[away]), psm_m_poses(trajectory, taken)
    place_then, rotation_then = _in_jaws_of_psm_a(trajectory, taken)
    turned = jaws @ np.swapaxes(jaws_then, 1, 2)
    place[away] = tip + np.einsum("fij,fj->fi", turned, place_then - tip_then)
    rotation[away] = turned @ rotation_then
    return place, rotation


def needle_to_pad_mm(trajectory: Trajectory, at: Ints, pad_mm: Floats) -> Floats:
    """Return the distance of the needle from the pad at some samples, negative inside, shape (F,).

    Args:
        trajectory: The trajectory.
        at: The samples, shape (F,).
        pad_mm: The middle of the pad's top in the PSM_A base frame, shape (3,).
    """
    place, rotation = needle_poses(trajectory, at)
    arc = place[:, None] + np.einsum("fij,kj->fki", rotation, _ARC_MM)
    half = pad_scale(trajectory.tip_mm) * np.array(PAD_SIZE_MM) / 2
    beyond = np.abs(arc - pad_mm + [0.0, 0.0, half[2]]) - half  # signed distance from each pair of the pad's faces
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=2)
    inside = np.minimum(beyond.max(axis=2), 0.0)
    return np.asarray((outside + inside).min(axis=1) - RADIUS_MM)


def psm_m_poses(trajectory: Trajectory, at: Ints) -> tuple[Floats, Floats]:
    """Return the poses of PSM_M at some samples, in the PSM_A base frame.

    Args:
        trajectory: A trajectory with PSM_M.
        at: The samples, shape (F,).

    Returns:
        PSM_M's tip, mm, shape (F, 3), and its rotation [n o a], shape (F, 3, 3).
    """
    psm_m = trajectory.psm_m
    assert psm_m is not None
    tip_mm, rotation = forward(psm_m.joints[at], psm_m.instrument)
    base = matrix_of(psm_m.base_xyzw[None])[0]
    return tip_mm @ base.T + psm_m.base_mm, base @ rotation


def _in_jaws_of_psm_a(trajectory: Trajectory, at: Ints) -> tuple[Floats, Floats]:
    """Return the needle's pose along the hinge of PSM_A's jaws, its free end on PSM_M's side, as in `hand_off`."""
    jaws = matrix_of(trajectory.rotation_xyzw[at])
    place = trajectory.tip_mm[at] + HELD_MM * jaws[:, :, 2]
    if trajectory.psm_m is not None:
        ends = trajectory.last_samples[trajectory.pass_index[at]]
        n_a = matrix_of(trajectory.rotation_xyzw[ends])[:, :, 0]
        a_m = psm_m_poses(trajectory, ends)[1][:, :, 2]
        # Half a turn about the approach, so that the free end points to PSM_M.
        jaws[np.einsum("fi,fi->f", n_a, a_m) > 0] *= [-1.0, -1.0, 1.0]
    return place, jaws


NEEDLE_FREE_RAD = 2 * pi / 3  # of the arc beyond PSM_A's grip: two thirds of a half circle, as in urdf/needle.urdf
NEEDLE_THICK_MM = 0.66  # the same file
_HALF_WIDTH_RAD = FINGER_RADIUS_MM / NEEDLE_RADIUS_MM  # of the arc, from the middle of the fingers to their side


@dataclass(frozen=True, eq=False)
class HandOff:
    """Both arms as planned at the end of A2, in one frame: tips in mm, shape (3,), and jaws [n o a], shape (3, 3)."""

    tip_a: Floats
    jaw_a: Floats
    tip_m: Floats
    jaw_m: Floats


def catch(planned: HandOff, turned: Floats, apart_mm: Floats, opening_rad: float) -> tuple[Flags, Floats]:
    """Compute the place and the direction of the needle in PSM_M's open jaws.

    Args:
        planned: The hand-off. The needle stands across PSM_A's jaws, its free end against PSM_M's approach.
        turned: Rotation of the needle about the grip, in the same frame, shape (N, 3, 3).
        apart_mm: Error of PSM_A's position relative to PSM_M's, in the same frame, shape (N, 3).
        opening_rad: Opening of each of PSM_M's fingers.

    Returns:
        Whether the needle is between the fingers, with needle to spare on both sides of them, shape (N,), and the angle
        between its tangent there and their hinge, rad, shape (N,); NaN if it does not cross their plane.
    """
    n, a = planned.jaw_a[:, 0], planned.jaw_a[:, 2]
    free = n if n @ planned.jaw_m[:, 2] < 0 else -n
    inwards = np.cross(a, free)
    # The jaws are symmetric about their approach, so take the one of n and -n along which the needle runs.
    n_m, o_m, a_m = planned.jaw_m.T
    jaws = np.stack([n_m, o_m, a_m] if n_m @ inwards >= 0 else [-n_m, -o_m, a_m], axis=1)
    grip = (planned.tip_a + HELD_MM * a - planned.tip_m + apart_mm) @ jaws
    t, u = turned @ inwards @ jaws, turned @ free @ jaws
    amplitude = np.hypot(t[:, 0], u[:, 0])
    level = (t[:, 0] + grip[:, 0] / NEEDLE_RADIUS_MM) / np.maximum(amplitude, 1e-12)
    crosses = np.abs(level) <= 1.0  # NaN does not
    phi = np.where(crosses, np.arccos(np.where(crosses, level, 0.0)), np.nan) - np.arctan2(u[:, 0], t[:, 0])
    sine, cosine = np.sin(phi)[:, None], np.cos(phi)[:, None]
    at, along = grip + NEEDLE_RADIUS_MM * (t * (1 - cosine) + u * sine), t * sine + u * cosine
    to_spare = (phi >= _HALF_WIDTH_RAD) & (phi <= NEEDLE_FREE_RAD - _HALF_WIDTH_RAD)
    return to_spare & _swept(at[:, 1], at[:, 2], opening_rad), np.arccos(np.clip(np.abs(along[:, 0]), 0.0, 1.0))


def _swept(y_mm: Floats, z_mm: Floats, opening_rad: float) -> Flags:
    """Return whether a needle that crosses the jaws' plane there lies entirely in the fingers' sector; NaN does not."""
    half = NEEDLE_THICK_MM / 2
    depth = np.hypot(y_mm, z_mm)
    within = (depth >= WRIST_RADIUS_MM + half) & (depth <= JAW_TIP_MM - half)
    return np.asarray(within & (np.abs(y_mm) * cos(opening_rad) + half <= z_mm * sin(opening_rad)))
