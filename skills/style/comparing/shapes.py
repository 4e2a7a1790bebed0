"""Lay motions on each other: where a hand-off is done, how fast, and if wanted how large, is not its style.

    Demo --shape_of--> points equally far apart along the way, in a frame of the hand-off itself

That frame has its origin at the start, x towards the goal, and z as far up the base's z axis as that allows; y then
points to the left. So two shapes begin together and go the same way; scaled, they end together too. Tempo is left out:
states are even along the way, as in the paper's grid, where standing still adds no state. Ours; the paper compares
paths only where they were recorded.
"""

import numpy as np

from skills.errors import BadPath
from skills.style._arrays import Floats, frozen
from skills.style.demo import Demo
from skills.style.movement import smoothed_tip

STATES = 100  # of a shape; the paper's demonstration has 28 states, our samples 20 to 60
TREMOR_S = 0.2  # a Hann window this wide stops 10 Hz, which would lengthen the way, and rounds no corner of a hand
LEAST_MM = 1.0  # between start and goal; a shorter way has no direction that tremor would not turn
STEEPEST = 0.99  # cosine between the way and the base's z axis; beyond it, y takes z's part


def shape_of(demo: Demo, *, scaled: bool = False) -> Floats:
    """Give a demonstration's way in its own frame, shape (STATES, 3), in mm; scaled, in lengths of start to goal.

    Raises:
        BadPath: It ends within `LEAST_MM` of where it began.
    """
    way_mm = resampled(smoothed_tip(demo.stamps_s, demo.tip_mm, TREMOR_S)[1])
    return placed(way_mm, scaled=scaled)


def in_lengths(shape_mm: Floats) -> Floats:
    """Write a shape, (T, 3) in mm, in lengths of start to goal: the scaled one of the same demonstration."""
    return np.asarray(shape_mm / shape_mm[-1, 0])


def resampled(tip_mm: Floats, states: int = STATES) -> Floats:
    """Take points equally far apart along a path, (T, 3) to (states, 3)."""
    along_mm = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(tip_mm, axis=0), axis=1)))
    at_mm = np.linspace(0.0, along_mm[-1], states)
    return np.stack([np.interp(at_mm, along_mm, axis) for axis in tip_mm.T], axis=1)


def placed(tip_mm: Floats, *, scaled: bool = False) -> Floats:
    """Write a path, (T, 3) in the arm's base frame, in the frame of its own start and goal.

    Raises:
        BadPath: It ends within `LEAST_MM` of where it began.
    """
    way_mm = tip_mm[-1] - tip_mm[0]
    length_mm = float(np.linalg.norm(way_mm))
    if not length_mm >= LEAST_MM:
        raise BadPath(
            f"It ends {length_mm:.2f} mm from where it began, so it has no direction to be compared along; "
            "cut the hand-off from its start to where the needle is taken.",
            length_mm=length_mm,
        )
    x = way_mm / length_mm
    up = np.array([0.0, 0.0, 1.0] if abs(x[2]) < STEEPEST else [0.0, 1.0, 0.0])
    z = up - (up @ x) * x
    z /= np.linalg.norm(z)
    axes = np.stack([x, np.cross(z, x), z])
    return frozen((tip_mm - tip_mm[0]) @ axes.T / (length_mm if scaled else 1.0), np.float64, (None, 3), "tip_mm")
