"""The hand along a pass: when the surgeon was where, how the jaw was turned, and how far it was open.

    Demo, FittedPath --hand_along--> Hand;   Demos, PoseStyle --styled--> Demo with the hand of the style

A fitted path (`skills.planning.path_fit`) has a clock: the times of the demonstration along it. So orientation, jaw and
tempo of a pass are those recorded at the same time, and not at the nearest place: where a path crosses itself, or the
hand turns at rest, nearness decides nothing. All of this is ours; the paper holds the orientation.

* The hand rests before its first sample and after its last. Tip, orientation and jaw are averaged by the Hann window
  that takes the tremor out of the path (`TREMOR_S`), over a time that is longer by half a window on both sides. The
  path has been averaged already, but without that the tip would change its speed from point to point, and jerk more
  than the surgeon's. So a pass begins and ends at rest, at the first and the last recorded pose exactly. In bends the
  tip leaves the path by `Hand.deviation_mm`.
* Before the demonstration is joined nothing was recorded: the tip goes along the path's approach at the mean speed of
  what follows, and the jaw is held as it was where the path joins.
* A pause of the hand remains one, also one in which the arm was not driven.

Of several demonstrations the pose style is the hand (`skills.learning.pose_style`): its motion between the ends of the
path that they were combined into, at equal shares of the lengths of both paths.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from skills.arrays import Floats, frozen
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import same_signs, smoothed_tip
from skills.errors import BadPlan
from skills.kinematics import instrument_of, matrix_of, quaternion_of
from skills.planning.path_fit import TREMOR_S, FittedPath

LEAST_MM_S = 1.0  # ours: of an approach, if what is followed after it hardly moves
NEAR = 8  # pieces of the path, to either side of the present one, whose distance is measured
LEAST_STEP_S = 1e-6
LONGEST_S = 3600.0  # ours: no hand-off takes an hour; a stamp that is years off would exhaust the memory


@dataclass(frozen=True, eq=False)
class Hand:
    """The hand along one pass, at the surgeon's own tempo.

    Attributes:
        seconds: Times from the start of the pass, shape (M,), evenly spaced from 0.
        tip_mm: The tip in the arm's frame, shape (M, 3).
        deviation_mm: Its greatest distance from the pass's path.
        rotation_xyzw: The jaw's rotation in the arm's frame, unit quaternions, shape (M, 4); None: held.
        jaw_rad: Angle of the jaw, shape (M,); None if it was not recorded.
    """

    seconds: Floats
    tip_mm: Floats
    deviation_mm: float
    rotation_xyzw: Floats | None = None
    jaw_rad: Floats | None = None

    def __post_init__(self) -> None:
        count = len(self.seconds)
        shapes: dict[str, tuple[int, ...]] = {"seconds": (count,), "tip_mm": (count, 3), "jaw_rad": (count,)}
        for name, shape in {**shapes, "rotation_xyzw": (count, 4)}.items():
            if getattr(self, name) is not None:
                object.__setattr__(self, name, frozen(getattr(self, name), np.float64, shape, name))
        if count < 2 or self.seconds[0] != 0 or (np.diff(self.seconds) <= 0).any():
            raise BadPlan("The times of a hand begin at 0 and increase; give at least two.")
        if self.rotation_xyzw is not None:
            matrix_of(self.rotation_xyzw)

    @property
    def duration_s(self) -> float:
        """Seconds from the first time to the last."""
        return float(self.seconds[-1])

    @property
    def peak_mm_s(self) -> float:
        """The greatest speed of the tip."""
        return float((np.linalg.norm(np.diff(self.tip_mm, axis=0), axis=1) / np.diff(self.seconds)).max())

    @property
    def length_mm(self) -> float:
        """The length of the tip's way."""
        return float(np.linalg.norm(np.diff(self.tip_mm, axis=0), axis=1).sum())

    def at(self, count: int) -> tuple[Floats, Floats | None, Floats | None]:
        """Return the hand at evenly spaced times from its first to its last, both exact.

        Args:
            count: The number of times, at least 2.

        Returns:
            Positions of the tip, mm, shape (count, 3); rotations [n o a], shape (count, 3, 3), or None; and angles of
            the jaw, shape (count,), or None.
        """
        turned = None
        if self.rotation_xyzw is not None:
            quaternions = self._between(same_signs(self.rotation_xyzw), count)
            turned = matrix_of(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))
        jaw = self.jaw_rad
        return (
            self._between(self.tip_mm, count),
            turned,
            None if jaw is None else self._between(jaw, count).clip(jaw.min(), jaw.max()),
        )

    def _between(self, values: Floats, count: int) -> Floats:
        from scipy.interpolate import CubicSpline  # here, because clients read plans without it

        # A cubic spline, because a step of the speed at every sample would be an acceleration without bound.
        found = CubicSpline(self.seconds, values)(np.linspace(0.0, self.duration_s, count))
        found[[0, -1]] = values[[0, -1]]
        return np.asarray(found)


def hand_along(demo: Demo, fitted: FittedPath, *, turning: bool) -> Hand:
    """Return the hand along a fitted path, in the demonstration's frame.

    Args:
        demo: The demonstration that the path is fitted to.
        fitted: The path.
        turning: Whether the jaw turns as it was recorded; otherwise it is held.

    Raises:
        BadPlan: The demonstration is longer than an hour.
    """
    if not demo.stamps_s[-1] <= LONGEST_S:
        raise BadPlan(f"The demonstration takes {demo.stamps_s[-1]:g} s; a pass of at most {LONGEST_S:g} s is planned.")
    joins_s, clock_s, places = _clock(fitted)
    times = np.unique(np.concatenate((clock_s, demo.stamps_s)))
    times = times[(times >= clock_s[0]) & (times <= clock_s[-1])]
    recorded_s = np.maximum(times, joins_s)  # during the approach the jaw is as where the path joins
    points = np.arange(len(fitted.tip_mm), dtype=np.float64)
    grid_s, tip_mm = _calm(times, _at(np.interp(times, clock_s, places), points, fitted.tip_mm), TREMOR_S)
    turned, opened = None, None
    if turning and demo.rotation_xyzw is not None:
        _, turned = _calm(times, _at(recorded_s, demo.stamps_s, same_signs(demo.rotation_xyzw)), TREMOR_S)
        turned = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    if (jaw := jaw_within(demo)) is not None:
        opened = _calm(times, np.interp(recorded_s, demo.stamps_s, jaw)[:, None], TREMOR_S)[1][:, 0]
    off_mm = _off_mm(tip_mm, fitted.tip_mm, np.interp(grid_s, clock_s, places))
    return Hand((grid_s - grid_s[0]).round(9), tip_mm, off_mm, turned, opened)


def _calm(seconds: Floats, values: Floats, window_s: float) -> tuple[Floats, Floats]:
    """Average values, (T, N), of a hand that rests before and after, at even times; first and last are exact."""
    half_s = TREMOR_S / 2
    rested_s = np.concatenate(([seconds[0] - half_s], seconds, [seconds[-1] + half_s]))
    grid_s, calm = smoothed_tip(rested_s, np.concatenate((values[:1], values, values[-1:])), window_s)
    calm[[0, -1]] = values[[0, -1]]  # without the window's round-off
    return grid_s, calm.round(9)  # so that every machine computes the same bytes


def _clock(fitted: FittedPath) -> tuple[float, Floats, Floats]:
    """Return when the demonstration is joined, and times and places of the path, its approach included.

    The approach has the mean speed of what is followed after it.
    """
    way_mm = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(fitted.tip_mm, axis=0), axis=1)))
    joins_s = float(fitted.clock_s[0])
    joined = int(np.flatnonzero(fitted.clock_s == joins_s)[-1])  # the approach is all at one time
    clock_s, places = fitted.clock_s[joined:], fitted.places[joined:]
    lead_mm = float(np.interp(places[0], np.arange(len(way_mm)), way_mm))
    followed_s = float(clock_s[-1]) - joins_s
    speed_mm_s = (way_mm[-1] - lead_mm) / followed_s if followed_s > 0 else 0.0
    lead_s = lead_mm / max(float(speed_mm_s), LEAST_MM_S)
    if lead_s:
        before = np.flatnonzero(way_mm < lead_mm)
        clock_s = np.concatenate((joins_s - lead_s * (1 - way_mm[before] / lead_mm), clock_s))
        places = np.concatenate((before, places))
    last = np.append(np.diff(clock_s) > 0, True)  # of equal times the last place counts
    return joins_s, clock_s[last], places[last]


def _off_mm(tip_mm: Floats, line: Floats, places: Floats) -> float:
    """Return the greatest distance, mm, of positions, (M, 3), from a line, (K, 3), near given places on it, (M,)."""
    if len(line) == 1:
        return float(np.linalg.norm(tip_mm - line[0], axis=1).max())
    moves, piece = np.diff(line, axis=0), places.astype(np.int64)
    near = (piece[:, None] + np.arange(-NEAR, NEAR + 1)).clip(0, len(moves) - 1)
    off, along = tip_mm[:, None] - line[near], moves[near]
    part = (off * along).sum(axis=2) / (along**2).sum(axis=2).clip(1e-12)
    apart = np.linalg.norm(off - part.clip(0.0, 1.0)[..., None] * along, axis=2)
    return float(apart.min(axis=1).max())


def moved(hand: Hand, rotation: Floats, about_mm: Floats, to_mm: Floats) -> Hand:
    """Return a hand that is moved rigidly.

    Args:
        hand: The hand.
        rotation: Rotation of its new frame relative to the old one, shape (3, 3).
        about_mm: A place in the old frame, shape (3,).
        to_mm: That place in the new frame.
    """
    turned = hand.rotation_xyzw
    if turned is not None:
        turned = same_signs(quaternion_of(rotation @ matrix_of(turned)))
    return replace(hand, tip_mm=(hand.tip_mm - about_mm) @ rotation.T + to_mm, rotation_xyzw=turned)


def jaw_recorded(hand: Hand | None) -> bool:
    """Return whether a pass has the angles of the surgeon's jaw."""
    return hand is not None and hand.jaw_rad is not None


def jaw_within(demo: Demo) -> Floats | None:
    """Return the demonstrated angles of the jaw, shape (T,), within the range of the instrument.

    None if there are none, or if their median is outside of the range: JIGSAWS has another zero.
    """
    if demo.jaw_rad is None:
        return None
    low, high = instrument_of(demo.instrument).jaw_rad
    return demo.jaw_rad.clip(low, high) if low <= float(np.median(demo.jaw_rad)) <= high else None


def _at(times: Floats, seconds: Floats, columns: Floats) -> Floats:
    return np.stack([np.interp(times, seconds, column) for column in columns.T], axis=1)


def styled(followed: Demo, demos: Sequence[Demo]) -> Demo:
    """Return the demonstration that several were combined into, with orientation, jaw and tempo of their pose style.

    Args:
        followed: Their combination, whose positions remain.
        demos: The demonstrations; without the orientation of every one, none is returned.
    """
    from skills.learning.pose_style import learn_pose_style, mean_rotation  # here, because of scipy

    if any(demo.rotation_xyzw is None for demo in demos):
        return replace(followed, rotation_xyzw=None)
    style = learn_pose_style(demos)
    even = np.full(len(demos), 1.0 / len(demos))
    start_xyzw, goal_xyzw = mean_rotation(style.rotation_xyzw[:, [0, -1]], even)
    path = style.between(followed.tip_mm[0], start_xyzw, followed.tip_mm[-1], goal_xyzw)
    elapsed_s = np.interp(_shares(followed.tip_mm), _shares(path.tip_mm), path.elapsed_s)
    quaternions = _at(elapsed_s, path.elapsed_s, same_signs(path.rotation_xyzw))
    steps_s = np.diff(elapsed_s).clip(LEAST_STEP_S)  # of samples at one place, the second is a moment later
    return replace(
        followed,
        stamps_s=np.append(0.0, np.cumsum(steps_s)),
        rotation_xyzw=quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        jaw_rad=None if path.jaw_rad is None else np.interp(elapsed_s, path.elapsed_s, path.jaw_rad),
    )


def _shares(tip_mm: Floats) -> Floats:
    """Return the part of a path's length up to each point, (T,), from 0 to 1."""
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(tip_mm, axis=0), axis=1)))
    return np.asarray(along / along[-1])
