"""Signatures: a demonstration as numbers by which its surgeon may be recognised.

    Demo --signature_of--> numbers in families: shape, tempo, jaw, turning, orientation, place

A curve over the phase (time from 0 at the start to 1 at the end) is described by its first cosine coefficients: its
mean, and its slow changes. Lengths, speeds and durations enter as logarithms. All is computed on the path without
tremor, on evenly spaced times, so it depends little on the recorder's sampling rate.

    shape        the path in the hand-off's own frame, along the path (`skills.comparison.distances.shape_of`)
    tempo        duration, path length, speeds, rests, peaks and smoothness
    jaw          the angle of the jaw: its quantiles, its changes, its curve
    turning      the rotation since the start, in the tool's own axes, and the angular speed
    orientation  the tool's direction in the frame of the poses
    place        the position in the frame of the poses

The last two depend on the set-up: on where arm and tissue stand. The last identifies it. All of it is ours.
"""

import numpy as np

from skills.arrays import Floats
from skills.comparison.distances import STATES, TREMOR_S, placed, resampled
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import same_signs, smoothed_tip
from skills.errors import BadPath
from skills.kinematics import matrix_of

PHASES = 16  # of a curve
RESTING_MM_S = 5.0  # a slow hand, rather than one at rest
LEAST_MM, LEAST_MM_S, LEAST_RAD_S, LEAST_RAD = 1.0, 1.0, 0.01, 0.01  # added before a logarithm

_SIZES = {"shape": 15, "tempo": 11, "jaw": 13, "turning": 15, "orientation": 24, "place": 12}
_ENDS = np.cumsum([0, *_SIZES.values()]).tolist()
FAMILIES = {name: slice(*_ENDS[at : at + 2]) for at, name in enumerate(_SIZES)}
FRAMED = ("orientation", "place")  # comparable only within one frame of the poses
NUMBERS = _ENDS[-1]


def signature_of(demo: Demo) -> Floats:
    """Return the signature of a demonstration, shape (NUMBERS,); NaN in the families that it does not have.

    `jaw`, `turning` and `orientation` need a recorded jaw or orientation, `shape` a direction.

    Args:
        demo: The demonstration.
    """
    seconds, tip_mm = smoothed_tip(demo.stamps_s, demo.tip_mm, TREMOR_S)
    found = {
        "shape": _shape(tip_mm),
        "tempo": _tempo(seconds, tip_mm),
        "jaw": None if demo.jaw_rad is None else _jaw(demo.stamps_s, demo.jaw_rad),
        "place": _coefficients(_at_phases(seconds, tip_mm), 4),
    }
    if demo.rotation_xyzw is not None:
        turned = smoothed_tip(demo.stamps_s, same_signs(demo.rotation_xyzw), TREMOR_S)[1]
        found |= _turning(seconds, turned / np.linalg.norm(turned, axis=1, keepdims=True).clip(1e-12), tip_mm)
    numbers = np.full(NUMBERS, np.nan)
    for name, values in found.items():
        if values is not None:
            numbers[FAMILIES[name]] = values
    numbers.setflags(write=False)
    return numbers


def _shape(tip_mm: Floats) -> Floats | None:
    try:
        shape_mm = placed(resampled(tip_mm))
    except BadPath:
        return None
    return _coefficients(_at_phases(np.arange(float(STATES)), shape_mm), 5)


def _tempo(seconds: Floats, tip_mm: Floats) -> Floats:
    duration_s, step_s = float(seconds[-1]), float(seconds[1] - seconds[0])
    velocity = np.gradient(tip_mm, step_s, axis=0)
    acceleration = np.gradient(velocity, step_s, axis=0)
    jerk = np.gradient(acceleration, step_s, axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    length_mm = float(np.linalg.norm(np.diff(tip_mm, axis=0), axis=1).sum())
    way_mm = float(np.linalg.norm(tip_mm[-1] - tip_mm[0]))
    peaks = int(((speed[1:-1] > speed[:-2]) & (speed[1:-1] >= speed[2:])).sum())
    mean, strongest = float(speed.mean()) + LEAST_MM_S, float(speed.max()) + LEAST_MM_S
    jerkiness = float(np.sqrt((jerk**2).sum(axis=1).mean())) + LEAST_MM_S
    return np.array(
        [
            np.log(duration_s),
            np.log(length_mm + LEAST_MM),
            np.log(way_mm + LEAST_MM),
            np.log((length_mm + LEAST_MM) / (way_mm + LEAST_MM)),
            np.log(mean),
            np.log(np.quantile(speed, 0.95) + LEAST_MM_S),
            np.log((speed.std() + LEAST_MM_S) / mean),
            (speed < RESTING_MM_S).mean(),
            np.log((peaks + 1) / duration_s),
            np.log(jerkiness / mean),
            np.log(jerkiness * duration_s**2 / strongest),
        ]
    )


def _jaw(stamps_s: Floats, jaw_rad: Floats) -> Floats:
    seconds, smooth = smoothed_tip(stamps_s, jaw_rad[:, None], TREMOR_S)
    angle = smooth[:, 0]
    changes = float(np.abs(np.diff(angle)).sum()) / float(seconds[-1])
    quantiles = np.quantile(angle, [0.0, 0.1, 0.5, 0.9, 1.0])
    curve = _coefficients(_at_phases(seconds, smooth), 5)
    return np.array([*quantiles, angle.mean(), angle.std(), np.log(changes + LEAST_RAD_S), *curve])


def _turning(seconds: Floats, rotation_xyzw: Floats, tip_mm: Floats) -> dict[str, Floats]:
    """Return the numbers of `turning` and of `orientation`."""
    steps = np.linalg.norm(np.diff(rotation_xyzw, axis=0), axis=1) * 2.0  # rad, for the small angles of 10 ms
    rate = steps / float(seconds[1] - seconds[0])
    length_mm = float(np.linalg.norm(np.diff(tip_mm, axis=0), axis=1).sum())
    speeds = np.log(np.array([rate.mean(), np.quantile(rate, 0.95)]) + LEAST_RAD_S)
    ratio = np.log((steps.sum() + LEAST_RAD) / (length_mm + LEAST_MM))
    at = _at_phases(seconds, rotation_xyzw)
    at = at / np.linalg.norm(at, axis=1, keepdims=True).clip(1e-12)
    matrices = matrix_of(at)
    since = _rotation_vectors(matrices[0].T @ matrices)
    return {
        "turning": np.concatenate([_coefficients(since, 4), speeds, [ratio]]),
        "orientation": _coefficients(matrices[:, :, :2].reshape(-1, 6), 4),
    }


def _rotation_vectors(matrices: Floats) -> Floats:
    """Return rotations as axis times angle in rad, shape (T, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(matrices).as_rotvec())


_PHASE = np.linspace(0.0, 1.0, PHASES)
_COSINES = np.cos(np.pi * np.arange(5)[:, None] * (np.arange(PHASES) + 0.5) / PHASES) / PHASES


def _at_phases(seconds: Floats, values: Floats) -> Floats:
    """Return the rows of a curve at even phases, shape (PHASES, K)."""
    return np.stack([np.interp(_PHASE * seconds[-1], seconds, axis) for axis in values.T], axis=1)


def _coefficients(curve: Floats, count: int) -> Floats:
    """Return the first cosine coefficients of each column of a curve, (PHASES, K): shape (count * K,)."""
    return np.asarray(_COSINES[:count] @ curve).ravel()
