"""Seeded draws of the errors of real arms, of the suture point and of the needle.

    seed --draw--> Drawn: random numbers of size 1 --Drawn.under(ArmErrors)--> Displaced: in mm and rad

Beside the five errors of the arms (`skills.verification.arm_errors`) two belong to the pass, and are drawn uniformly:
the shift of the suture point along each axis, and the needle's rotation in PSM_A's jaws, about any axis.

Each error has its own stream of random numbers, decided by the seed, the error and the pass. So if one error is set to
zero, all others are drawn as before, and the difference is the effect of that error.
"""

from dataclasses import dataclass
from math import radians, sqrt

import numpy as np

from skills.arrays import Floats
from skills.kinematics import matrix_of
from skills.quaternions import of_vector
from skills.verification.arm_errors import ArmErrors

_STREAMS = ("registration", "registration_turn", "wrist", "tip_bias", "tip_noise", "suture_point", "needle")


@dataclass(frozen=True, eq=False)
class Drawn:
    """Random errors for N variations of a pass that is checked in S samples; arms are PSM_A and PSM_M.

    Attributes:
        registration: Offset of PSM_M's base, of size 1, shape (N, 3).
        registration_turn: Rotation vector of that base, of size 1, shape (N, 3).
        wrist: Rotation vector of each arm's jaws, of size 1, shape (2, N, 3).
        tip_bias: Constant offset of each arm, of size 1, shape (2, N, 3).
        tip_noise: Independent numbers of size 1 of which each arm's noise is made, shape (2, N, S, 3).
        shift_mm: Shift of the pass from its planned place, shape (N, 3).
        turned: Rotation of the needle about PSM_A's grip, shape (N, 3, 3).
    """

    registration: Floats
    registration_turn: Floats
    wrist: Floats
    tip_bias: Floats
    tip_noise: Floats
    shift_mm: Floats
    turned: Floats

    def under(self, errors: ArmErrors, stamps_s: Floats) -> "Displaced":
        """Return the displacements of both arms.

        Args:
            errors: The sizes of the errors.
            stamps_s: Times of the checked samples, ascending, shape (S,).
        """
        base = radians(errors.registration_deg) * self.registration_turn
        jaws = radians(errors.wrist_deg) * self.wrist
        noise = errors.tip_noise_mm * _correlated(self.tip_noise, stamps_s, errors.tip_correlation_s)
        return Displaced(
            base_mm=errors.registration_mm * self.registration,
            base_turn=rotation_of(base),
            base_rad=np.linalg.norm(base, axis=1),
            jaw_turn=rotation_of(jaws.reshape(-1, 3)).reshape(2, -1, 3, 3),
            jaw_rad=np.linalg.norm(jaws, axis=2),
            tip_mm=errors.tip_bias_mm * self.tip_bias[:, :, None] + noise,
        )


@dataclass(frozen=True, eq=False)
class Displaced:
    """The displacements of both arms in N variations of a pass, in S samples.

    Attributes:
        base_mm: Offset of PSM_M's base in PSM_A's base frame, shape (N, 3).
        base_turn: Rotation of that base about its remote centre, in the same frame, shape (N, 3, 3).
        base_rad: The angle of this rotation, shape (N,).
        jaw_turn: Rotation of each arm's jaws about their hinge, in the same frame, shape (2, N, 3, 3).
        jaw_rad: The angles of these rotations, shape (2, N).
        tip_mm: Offset of each arm as a whole in PSM_A's base frame, shape (2, N, S, 3).
    """

    base_mm: Floats
    base_turn: Floats
    base_rad: Floats
    jaw_turn: Floats
    jaw_rad: Floats
    tip_mm: Floats

    def at(self, chunk: slice) -> "Displaced":
        """Return a slice of the variations."""
        return Displaced(
            self.base_mm[chunk],
            self.base_turn[chunk],
            self.base_rad[chunk],
            self.jaw_turn[:, chunk],
            self.jaw_rad[:, chunk],
            self.tip_mm[:, chunk],
        )


def draw(seed: int, number: int, variations: int, samples: int, *, suture_point_mm: float, needle_rad: float) -> Drawn:
    """Draw the variations of a pass; the same arguments give the same bytes.

    Args:
        seed: Seed of the random numbers, 0 or more.
        number: Number of the pass, which gives each pass its own random numbers; all passes have the same registration.
        variations: Number of variations, N.
        samples: Number of checked samples of the pass, S.
        suture_point_mm: Greatest shift of the pass along each axis.
        needle_rad: Greatest rotation of the needle.
    """
    one_base = _stream(seed, "registration", 0), _stream(seed, "registration_turn", 0)
    needle = _stream(seed, "needle", number)
    axis = needle.standard_normal((variations, 3))
    angle = needle.uniform(-needle_rad, needle_rad, (variations, 1))
    return Drawn(
        registration=one_base[0].standard_normal((variations, 3)),
        registration_turn=one_base[1].standard_normal((variations, 3)),
        wrist=_stream(seed, "wrist", number).standard_normal((2, variations, 3)),
        tip_bias=_stream(seed, "tip_bias", number).standard_normal((2, variations, 3)),
        tip_noise=_stream(seed, "tip_noise", number).standard_normal((2, variations, samples, 3)),
        shift_mm=_stream(seed, "suture_point", number).uniform(-suture_point_mm, suture_point_mm, (variations, 3)),
        turned=rotation_of(angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)),
    )


def _stream(seed: int, error: str, number: int) -> np.random.Generator:
    """Return the random numbers of one error in one pass."""
    key = (_STREAMS.index(error), number)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


def rotation_of(vectors: Floats) -> Floats:
    """Return the rotations about axes, by their lengths in rad.

    Args:
        vectors: Rotation vectors, shape (N, 3).

    Returns:
        Rotation matrices, shape (N, 3, 3).
    """
    return matrix_of(of_vector(vectors))


def _correlated(normal: Floats, stamps_s: Floats, correlation_s: float) -> Floats:
    """Return noise of size 1 with this correlation time, made of independent numbers, both of shape (2, N, S, 3)."""
    if correlation_s == 0:
        return normal
    made = normal.copy()
    keeps = np.exp(-np.diff(stamps_s) / correlation_s)
    for k, kept in enumerate(keeps.tolist(), start=1):
        made[:, :, k] = kept * made[:, :, k - 1] + sqrt(max(0.0, 1 - kept * kept)) * normal[:, :, k]
    return made
