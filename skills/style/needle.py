"""The needle, attached to the jaws that hold it, and how far it is from the pad.

PSM_A has it from the first sample to the hand-off. Where PSM_M's place is known, it has the needle from there until
PSM_A is where the next pass begins: M1 and M2, which a surgeon does by hand, and where the needle goes through tissue.
So its distance from the pad is told and no gate of any verdict.
"""

from math import pi

import numpy as np

from skills.style._arrays import Floats, Ints
from skills.style.handoff import HELD_MM, NEEDLE_RADIUS_MM
from skills.style.kinematics import forward, matrix_of
from skills.style.playback import PAD_SIZE_MM, pad_scale
from skills.style.trajectory import TRANSFER, Trajectory

RADIUS_MM = 0.33  # of its wire
# The arc from where it is held, two thirds from the tip: x along the needle, y towards the arc's centre.
_TURN = np.linspace(-pi / 3, 2 * pi / 3, 49)
_ARC_MM: Floats = NEEDLE_RADIUS_MM * np.stack([np.sin(_TURN), 1 - np.cos(_TURN), np.zeros_like(_TURN)], axis=1)


def needle_poses(trajectory: Trajectory, at: Ints) -> tuple[Floats, Floats]:
    """Find where the needle is at some samples, shape (F,).

    Returns:
        Where it is held, mm in the PSM_A base frame, shape (F, 3), and the rotation of its frame, shape (F, 3, 3).
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
    """Measure how far the needle is from the pad at some samples, negative inside, shape (F,)."""
    place, rotation = needle_poses(trajectory, at)
    arc = place[:, None] + np.einsum("fij,kj->fki", rotation, _ARC_MM)
    half = pad_scale(trajectory.tip_mm) * np.array(PAD_SIZE_MM) / 2
    beyond = np.abs(arc - pad_mm + [0.0, 0.0, half[2]]) - half  # of each pair of faces
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=2)
    inside = np.minimum(beyond.max(axis=2), 0.0)
    return np.asarray((outside + inside).min(axis=1) - RADIUS_MM)


def psm_m_poses(trajectory: Trajectory, at: Ints) -> tuple[Floats, Floats]:
    """Compute PSM_M's tip, mm, shape (F, 3), and its [n o a], shape (F, 3, 3), in the PSM_A base frame."""
    psm_m = trajectory.psm_m
    assert psm_m is not None
    tip_mm, rotation = forward(psm_m.joints[at], psm_m.instrument)
    base = matrix_of(psm_m.base_xyzw[None])[0]
    return tip_mm @ base.T + psm_m.base_mm, base @ rotation


def _in_jaws_of_psm_a(trajectory: Trajectory, at: Ints) -> tuple[Floats, Floats]:
    """Put the needle along the hinge of PSM_A's jaws, its free end towards where PSM_M comes from, as in `hand_off`."""
    jaws = matrix_of(trajectory.rotation_xyzw[at])
    place = trajectory.tip_mm[at] + HELD_MM * jaws[:, :, 2]
    if trajectory.psm_m is not None:
        ends = trajectory.last_samples[trajectory.pass_index[at]]
        n_a = matrix_of(trajectory.rotation_xyzw[ends])[:, :, 0]
        a_m = psm_m_poses(trajectory, ends)[1][:, :, 2]
        jaws[np.einsum("fi,fi->f", n_a, a_m) > 0] *= [-1.0, -1.0, 1.0]  # half a turn: held the other way round
    return place, jaws
