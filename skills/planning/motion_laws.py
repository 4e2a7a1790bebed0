"""Laws of motion: the spline of A1, and straight minimum-jerk moves from rest to rest.

    polyline --followed--> one position per tick
    start and end poses of the arms --move--> poses per tick
    angles of two jaws before and after --Jaws.between--> angles per tick

The spline of A1 goes through every point of a polyline, rests at both ends, and stays near the straight moves between
the points. It is a clamped cubic spline whose parameter is the length along the moves, in whole ticks, so that each
point falls on a tick. Its speed decreases in bends and towards the ends (`_ticks`): with an even speed the tightest
bend, or the first of many short moves, would determine the speed of the complete path. At corners the spline deviates
in proportion to the length of the moves; dividing the moves evenly bounds the deviation.

A move from rest to rest takes each tip along a straight line and turns each jaw about one axis, all by one minimum-jerk
law: u^3 (10 - 15 u + 6 u^2) of the fraction u of the time, whose greatest rate is `PEAK` times its mean. A2, transfers
to where A1 begins, and all motion of PSM_M are such moves. The paper only asks for no jerky movements; the law is ours.

The poses of both arms are in one frame, PSM_A's base. The arms move together: the one that needs longer sets the time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, sqrt

import numpy as np

from skills.arithmetic import arccos
from skills.arrays import Floats, Ints, freeze
from skills.errors import BadSpeed
from skills.kinematics import angle_between
from skills.planning.handoff import JAW_S, turn

MAX_DEVIATION_MM = 1.25  # a quarter of the paper's cell
PIECES_MM = (10.0, 5.0, 2.5, 1.25)
EASE_MM = 5.0  # ours, one of the paper's cells: the length to reach full speed, and the bend radius that allows it
MAX_SAMPLES = 1_000_000  # 200 passes at 240 Hz have three quarters of it; more points to a mistake in the units


def check_length(ticks: float) -> None:
    """Refuse motions of too many samples.

    Args:
        ticks: Number of samples.

    Raises:
        BadSpeed: More than `MAX_SAMPLES`.
    """
    if ticks > MAX_SAMPLES:
        raise BadSpeed(
            f"This needs {ticks} samples, over {MAX_SAMPLES}; give a higher speed or less to do.", ticks=ticks
        )


def followed(line: Floats, mm_per_tick: float) -> tuple[Floats, float]:
    """Sample a polyline at a full speed, with moves divided until the deviation is allowed.

    Args:
        line: Points, mm, shape (K, 3), no two neighbours equal.
        mm_per_tick: The full speed, reached where the path is straight.

    Returns:
        One position per tick, shape (T, 3), and the greatest distance of any position from its straight move, mm.

    Raises:
        BadSpeed: More than `MAX_SAMPLES` ticks.
    """
    check_length(float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) / mm_per_tick)
    tip, deviation_mm = line, 0.0
    for piece_mm in PIECES_MM:  # longest first, so that moves are divided only as far as the deviation requires
        tip, deviation_mm = _run(_divided(line, piece_mm), mm_per_tick)
        if deviation_mm <= MAX_DEVIATION_MM:
            break
    return tip, deviation_mm


def _divided(line: Floats, piece_mm: float) -> Floats:
    """Divide the moves of a polyline evenly into pieces of at most this length, shape (K, 3)."""
    along = np.diff(line, axis=0)
    counts = np.ceil(np.linalg.norm(along, axis=1) / piece_mm).astype(np.int64)
    last = np.cumsum(counts)
    move = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(1, len(move) + 1) - (last - counts)[move]
    divided = np.concatenate([line[:1], line[move] + along[move] * (number / counts[move])[:, None]])
    divided[last] = line[1:]  # exactly, as every given point falls on a tick
    return divided


def _run(line: Floats, mm_per_tick: float) -> tuple[Floats, float]:
    """Sample the clamped cubic spline through a polyline and measure its deviation; every point falls on a tick."""
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
    # Hermite's form, because it gives each point exactly at u = 0.
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
    """Return the whole number of ticks of each move, (K - 1,), for a speed that is full where the path is straight.

    The square of the speed, as a fraction of that of the full speed, is 0 at the ends, at most radius / `EASE_MM` in a
    bend, and changes by at most length / `EASE_MM` in a move. So accelerations across and along the path have one bound
    each.
    """
    along = np.diff(line, axis=0) / lengths[:, None]
    turn = arccos(np.einsum("ki,ki->k", along[:-1], along[1:]).clip(-1.0, 1.0))
    radius = (lengths[:-1] + lengths[1:]) / 2 / np.maximum(turn, 1e-9)
    square = [0.0, *(radius / EASE_MM).clip(max=1.0).tolist(), 0.0]
    gain = (lengths / EASE_MM).tolist()
    for i, more in enumerate(gain):
        square[i + 1] = min(square[i + 1], square[i] + more)
    for i in reversed(range(len(gain))):
        square[i] = min(square[i], square[i + 1] + gain[i])
    speed = np.sqrt(square)
    # Both ends rest, so the formula below would divide by 0; take the speed that is allowed half-way.
    if len(gain) == 1:
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


TRANSFER, A1, A2 = 0, 1, 2  # the phases of a pass, in order (`skills.planning.passes`)
PHASES = ("transfer", "A1", "A2")
PEAK = 1.875
SAME_POINT_MM = 1e-6
_SAME_TURN_RAD = 1e-9


@dataclass(frozen=True, eq=False)
class Pose:
    """A pose of a tip: its position in mm, shape (3,), and its rotation [n o a], shape (3, 3)."""

    tip_mm: Floats
    rotation: Floats

    def __post_init__(self) -> None:
        freeze(self, tip_mm=(3,), rotation=(3, 3))


Arms = tuple[Pose, ...]  # PSM_A, and PSM_M if it moves too


@dataclass(frozen=True, eq=False)
class Poses:
    """The poses of one arm, tick by tick: tips in mm, shape (T, 3), and rotations [n o a], shape (T, 3, 3)."""

    tip_mm: Floats
    rotation: Floats

    def __len__(self) -> int:
        """The number of ticks."""
        return len(self.tip_mm)

    def __getitem__(self, ticks: slice) -> "Poses":
        """Return a slice of the ticks."""
        return Poses(self.tip_mm[ticks], self.rotation[ticks])


@dataclass(frozen=True)
class Pace:
    """The greatest speed of a tip, the greatest rate of a jaw, the sampling rate, and the part of a hand's tempo."""

    speed_mm_s: float
    turn_rad_s: float
    rate_hz: float
    tempo: float = 1.0

    def slowed(self, part: float) -> "Pace":
        """Return the pace with all speeds multiplied by a factor."""
        speed_mm_s, turn_rad_s, tempo = (value * part for value in (self.speed_mm_s, self.turn_rad_s, self.tempo))
        return replace(self, speed_mm_s=speed_mm_s, turn_rad_s=turn_rad_s, tempo=tempo)


def minimum_jerk(u: Floats) -> Floats:
    """Return the part of a move that is done at parts of its time.

    Args:
        u: Parts of the time, 0 to 1.
    """
    return u * u * u * (10 - 15 * u + 6 * u * u)


def move(start: Arms, end: Arms, pace: Pace, least_ticks: int = 0) -> tuple[Poses, ...]:
    """Move the arms from one set of poses to another, by the minimum-jerk law.

    Args:
        start: The pose of each arm at the start.
        end: The pose of each arm at the end.
        pace: Speed limits and sampling rate.
        least_ticks: Least number of ticks, even if nothing moves.

    Returns:
        The poses of each arm after 0, 1, ... ticks, with start and end exact. If nothing moves it is the start alone,
        unless `least_ticks` is larger than 0.

    Raises:
        BadSpeed: More than `MAX_SAMPLES` ticks.
    """
    ticks = max(least_ticks, *(_ticks_of_moves(a, b, pace) for a, b in zip(start, end, strict=True)))
    done = minimum_jerk(np.arange(ticks + 1) / max(1, ticks))
    return tuple(_between(a, b, done) for a, b in zip(start, end, strict=True))


@dataclass(frozen=True, eq=False)
class Jaws:
    """The angles of both jaws while both arms stand and the needle changes hands, shape (2 * ticks,) each.

    First the one that takes the needle closes, then the one that gave it opens; each by a minimum-jerk move.
    """

    takes_rad: Floats
    gives_rad: Floats

    @classmethod
    def between(cls, taker_rad: tuple[float, float], giver_rad: tuple[float, float], rate_hz: float) -> "Jaws":
        """Return the angles after each tick.

        Args:
            taker_rad: The jaw that takes the needle, before and after.
            giver_rad: The jaw that gives it.
            rate_hz: Samples per second.
        """
        ticks = ceil(JAW_S * rate_hz)
        done = minimum_jerk(np.arange(1, ticks + 1) / ticks)
        (open_rad, held_rad), (holds_rad, lets_rad) = taker_rad, giver_rad
        still = np.ones(ticks)
        closing, opening = open_rad + (held_rad - open_rad) * done, holds_rad + (lets_rad - holds_rad) * done
        closing[-1], opening[-1] = held_rad, lets_rad  # without round-off
        return cls(np.concatenate((closing, held_rad * still)), np.concatenate((holds_rad * still, opening)))

    def __len__(self) -> int:
        """The number of ticks."""
        return len(self.takes_rad)


def held(pose: Pose, ticks: int) -> Poses:
    """Repeat a pose for a number of ticks.

    Args:
        pose: The pose to hold.
        ticks: Number of copies.
    """
    return Poses(np.tile(pose.tip_mm, (ticks, 1)), np.tile(pose.rotation, (ticks, 1, 1)))


def joined(parts: Sequence[Poses]) -> Poses:
    """Concatenate poses.

    Args:
        parts: At least one, in order.
    """
    return Poses(np.concatenate([one.tip_mm for one in parts]), np.concatenate([one.rotation for one in parts]))


def _ticks_of_moves(start: Pose, end: Pose, pace: Pace) -> int:
    """Count the ticks that one arm needs, 0 if it does not move."""
    way_mm = float(np.linalg.norm(end.tip_mm - start.tip_mm, axis=-1))
    angle = float(angle_between(start.rotation[None], end.rotation[None])[0])
    if way_mm <= SAME_POINT_MM and angle <= _SAME_TURN_RAD:
        return 0
    ticks = ceil(PEAK * max(way_mm / pace.speed_mm_s, angle / pace.turn_rad_s) * pace.rate_hz)
    check_length(ticks)
    return ticks


def _between(start: Pose, end: Pose, done: Floats) -> Poses:
    """Return poses on the way from one to another, at parts of it that are done, (T,)."""
    tip = start.tip_mm + done[:, None] * (end.tip_mm - start.tip_mm)
    rotation = turn(start.rotation, end.rotation, done)
    if len(done) > 1:  # without round-off, because the next part begins exactly at the end pose
        tip[-1], rotation[-1] = end.tip_mm, end.rotation
    return Poses(tip, rotation)
