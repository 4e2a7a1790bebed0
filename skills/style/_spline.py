"""The spline of A1: through every point of a polyline, at rest at both ends, never far from the straight moves.

A clamped cubic spline whose clock is the way along the moves, in whole ticks, so that each point falls on a tick. The
clock slows down in bends and towards the ends (`_ticks`): with an even speed the tightest bend, or the first of many
short moves, would decide how slow all of the path has to be. The spline swings out of corners in proportion to the
length of the moves; dividing them evenly bounds that.
"""

from itertools import pairwise
from math import ceil, sqrt

import numpy as np

from skills.errors import BadSpeed
from skills.style._arrays import Floats, Ints

MAX_DEVIATION_MM = 1.25  # a quarter of the paper's cell
PIECES_MM = (10.0, 5.0, 2.5, 1.25)
EASE_MM = 5.0  # ours, one of the paper's cells: the way to full speed, and the radius of a bend that allows it
MAX_SAMPLES = 1_000_000  # 200 passes at 240 Hz have three quarters of it; more is a slip of the units


def check_length(ticks: float) -> None:
    """Refuse motions of too many samples.

    Raises:
        BadSpeed: More than `MAX_SAMPLES`.
    """
    if ticks > MAX_SAMPLES:
        raise BadSpeed(
            f"This needs {ticks} samples, over {MAX_SAMPLES}; give a higher speed or less to do.", ticks=ticks
        )


def followed(line: Floats, mm_per_tick: float) -> tuple[Floats, float]:
    """Sample a polyline, mm, shape (K, 3), at a full speed, in moves as long as the deviation allows.

    Returns:
        One position per tick, shape (T, 3), and how far at most one is from the straight move it belongs to, mm.
    """
    check_length(float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) / mm_per_tick)
    tip, deviation_mm = line, 0.0
    for piece_mm in PIECES_MM:
        tip, deviation_mm = _run(_divided(line, piece_mm), mm_per_tick)
        if deviation_mm <= MAX_DEVIATION_MM:
            break
    return tip, deviation_mm


def _divided(line: Floats, piece_mm: float) -> Floats:
    """Divide the moves of a polyline evenly into pieces of at most this length, shape (K, 3)."""
    pieces = [line[:1]]
    for start, end in pairwise(line):
        count = ceil(float(np.linalg.norm(end - start)) / piece_mm)
        pieces.append(start + (end - start) * (np.arange(1, count + 1) / count)[:, None])
        pieces[-1][-1] = end
    return np.concatenate(pieces)


def _run(line: Floats, mm_per_tick: float) -> tuple[Floats, float]:
    """Sample the clamped cubic spline through a polyline, and measure its deviation; every point falls on a tick."""
    if len(line) == 1:
        return line.copy(), 0.0
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    ticks = _ticks(line, lengths, mm_per_tick)
    check_length(float(ticks.sum()))
    slope = _slopes(line, ticks.astype(np.float64))
    piece = np.repeat(np.arange(len(ticks)), ticks)
    h = ticks[piece].astype(np.float64)
    u = ((np.arange(len(piece)) - np.repeat(np.cumsum(ticks) - ticks, ticks)) / h)[:, None]
    h = h[:, None]
    # Hermite's form: it gives each point exactly at u = 0.
    tip = (
        line[piece] * ((1 + 2 * u) * (1 - u) ** 2)
        + line[piece + 1] * (u * u * (3 - 2 * u))
        + slope[piece] * h * (u * (1 - u) ** 2)
        - slope[piece + 1] * h * (u * u * (1 - u))
    )
    along = np.diff(line, axis=0)[piece]
    part = np.clip(np.einsum("ti,ti->t", tip - line[piece], along) / lengths[piece] ** 2, 0.0, 1.0)
    away = np.linalg.norm(tip - line[piece] - part[:, None] * along, axis=1)
    return np.concatenate([tip, line[-1:]]), float(away.max())


def _ticks(line: Floats, lengths: Floats, mm_per_tick: float) -> Ints:
    """Give each move whole ticks, (K - 1,), for a speed that is full where the way is straight.

    The square of the speed, as a part of the full one's, is 0 at the ends, at most radius / `EASE_MM` in a bend, and
    changes by at most length / `EASE_MM` in a move: so accelerations across and along the way have one bound each.
    """
    along = np.diff(line, axis=0) / lengths[:, None]
    turn = np.arccos(np.einsum("ki,ki->k", along[:-1], along[1:]).clip(-1.0, 1.0))
    radius = (lengths[:-1] + lengths[1:]) / 2 / np.maximum(turn, 1e-9)
    square = [0.0, *(radius / EASE_MM).clip(max=1.0).tolist(), 0.0]
    gain = (lengths / EASE_MM).tolist()
    for i, more in enumerate(gain):
        square[i + 1] = min(square[i + 1], square[i] + more)
    for i in reversed(range(len(gain))):
        square[i] = min(square[i], square[i + 1] + gain[i])
    speed = np.sqrt(square)
    if len(gain) == 1:  # from rest to rest: as fast as it may be half-way
        speed += sqrt(min(gain[0] / 2, 1.0)) / 2
    when = np.append(0.0, np.cumsum(2 * lengths / (speed[:-1] + speed[1:]))) / mm_per_tick
    check_length(float(when[-1]))
    ticks: Ints = np.maximum(1, np.diff(np.ceil(when - 1e-9))).astype(np.int64)
    return ticks


def _slopes(line: Floats, h: Floats) -> Floats:
    """Solve the tridiagonal equations of a cubic spline at rest at both ends, in mm per tick, shape (K, 3)."""
    count = len(line)
    slope = np.zeros((count, 3))
    if count < 3:
        return slope
    chord = np.diff(line, axis=0) / h[:, None]
    right = 3 * (h[1:, None] * chord[:-1] + h[:-1, None] * chord[1:])
    main = 2 * (h[:-1] + h[1:])
    upper, lower = h[:-1], h[1:]
    # Thomas's algorithm: the matrix is diagonally dominant, so no pivot is needed.
    for i in range(1, count - 2):
        factor = lower[i] / main[i - 1]
        main[i] -= factor * upper[i - 1]
        right[i] -= factor * right[i - 1]
    slope[-2] = right[-1] / main[-1]
    for i in range(count - 3, 0, -1):
        slope[i] = (right[i - 1] - upper[i - 1] * slope[i + 1]) / main[i - 1]
    return slope
