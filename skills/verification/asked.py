"""The motion that was asked for: policy, recording, suture points, starts and rules, without what planning computed.

    SuturePlan, Policy, Demo --asked_of--> Asked

`skills.verification.intent` compares a motion with it.

`Moments` is the recorded hand, moment by moment: its mean over a short time, and its samples' spread about that.

    Demo --Moments.of--> Moments

A motion that repeats a hand may average it over a quarter of a second, to leave out its tremor. So it is compared not
with a sample but with those of `HALF_S` before and after: they lie within some distance, the spread, of their mean. All
of this is ours, and nothing of it is used in planning.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from skills.arrays import Flags, Floats, Ints
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import same_signs
from skills.kinematics import POINTING_DOWN, angle_between, instrument_of, matrix_of
from skills.learning.policy import Policy
from skills.planning.handoff import PsmM
from skills.planning.plan import A2Target, SuturePlan, SuturePoint

# Ours: planning averages a hand over a quarter of a second, and its tip twice.
HALF_S = 0.25
REST_S = 0.125  # a hand rests for so long before its first sample and after its last
SLOW = 0.1  # of the hand's greatest speed: where it was slower, an arm may stand
MOMENTS = 60  # at most so many of an interval are compared
_STEP_S = 0.02


@dataclass(frozen=True, eq=False)
class Moments:
    """A recorded hand at even times, N of them: means over `HALF_S` to either side, and the samples' spread about them.

    Attributes:
        seconds: The times, from before its first sample to after its last.
        tip_mm: Mean of the tip, shape (N, 3).
        tip_spread_mm: Greatest distance from it, shape (N,).
        turned: Mean rotation, shape (N, 3, 3), and `turned_spread_deg`; None if not recorded.
        opened: Mean angle of the jaw, shape (N,), and `opened_spread`; None if it was not recorded or has another zero.
        slow_s: Seconds for which the tip was slow, without a break, around each time, shape (N,).
        calm_s: The same of tip and jaw.
    """

    seconds: Floats
    tip_mm: Floats
    tip_spread_mm: Floats
    turned: Floats | None
    turned_spread_deg: Floats
    opened: Floats | None
    opened_spread: Floats
    slow_s: Floats
    calm_s: Floats

    @classmethod
    def of(cls, demo: Demo) -> "Moments":
        """Return the moments of a demonstration."""
        half, before = round(HALF_S / _STEP_S), np.ceil((HALF_S + 2 * REST_S) / _STEP_S)
        count = int(np.ceil(demo.stamps_s[-1] / _STEP_S) + 2 * before + 1)
        fine_s = (np.arange(count) - before) * _STEP_S
        seconds = fine_s[half:-half]
        tip, tip_spread = _spread(_at(fine_s, demo.stamps_s, demo.tip_mm), half)
        speed = np.linalg.norm(np.gradient(tip, axis=0), axis=1)
        slow = speed <= SLOW * speed.max()
        calm, turned, turned_spread = slow, None, np.zeros(len(seconds))
        if demo.rotation_xyzw is not None:
            near = _at(fine_s, demo.stamps_s, same_signs(demo.rotation_xyzw))
            mean, apart = _spread(near / np.linalg.norm(near, axis=1, keepdims=True), half)
            turned = matrix_of(mean / np.linalg.norm(mean, axis=1, keepdims=True))
            turned_spread = np.degrees(2 * apart)  # a unit quaternion moves by half of the angle
            rate = np.append(0.0, angle_between(turned[:-1], turned[1:]))
            calm = slow & (rate <= SLOW * rate.max())
        low, high = instrument_of(demo.instrument).jaw_rad
        opened, opened_spread = None, np.zeros(len(seconds))
        if demo.jaw_rad is not None and low <= float(np.median(demo.jaw_rad)) <= high:
            opened, opened_spread = _spread(
                np.interp(fine_s, demo.stamps_s, demo.jaw_rad.clip(low, high))[:, None], half
            )
            opened = opened[:, 0]
        return cls(
            seconds, tip, tip_spread, turned, turned_spread, opened, opened_spread, _unbroken_s(slow), _unbroken_s(calm)
        )

    def index(self, seconds: Floats) -> Ints:
        """Return the nearest moments, shape (T,); NaN and times beyond the ends give an end."""
        steps = (seconds - self.seconds[0]) / _STEP_S
        return np.asarray(np.nan_to_num(np.rint(steps)).clip(0, len(self.seconds) - 1), np.int64)

    def between(self, begin_s: float, end_s: float) -> Ints:
        """Return moments from one time to another and `HALF_S` around them, 1 to `MOMENTS`."""
        edges = np.array([begin_s - HALF_S, end_s + HALF_S]).clip(self.seconds[0], self.seconds[-1])
        first, last = self.index(edges).tolist()
        return np.linspace(first, last, min(last - first + 1, MOMENTS)).astype(np.int64)


def _at(times: Floats, seconds: Floats, columns: Floats) -> Floats:
    return np.stack([np.interp(times, seconds, column) for column in columns.T], axis=1)


def _spread(values: Floats, half: int) -> tuple[Floats, Floats]:
    """Return the mean of rows, (N, D), over a window, and the greatest distance from it within the window."""
    windows = sliding_window_view(values, 2 * half + 1, axis=0)
    mean = windows.mean(axis=2)
    return mean, np.linalg.norm(windows - mean[:, :, None], axis=1).max(axis=1)


def _unbroken_s(slow: Flags) -> Floats:
    """Return the length of the run of slow moments around each, within `HALF_S` of it, shape (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], slow, [False])).astype(np.int8)))
    runs = np.zeros(len(slow))
    for begin, end in edges.reshape(-1, 2).tolist():
        runs[begin:end] = (end - begin) * _STEP_S
    half = 2 * round(HALF_S / _STEP_S)
    return np.asarray(sliding_window_view(np.pad(runs, half), 2 * half + 1).max(axis=1))


JOIN_CELLS = 3  # over which a path goes over from the centre of a cell to the recorded place in it


@dataclass(frozen=True, eq=False)
class Asked:
    """The motion that was asked for.

    Attributes:
        policy: The policy to follow.
        demo: The demonstration whose hand is followed; None: the jaw is held, at an even tempo.
        points: The suture points, one for each pass.
        starts_mm: The start of each pass in the arm's frame, shape (passes, 3).
        psm_m: The arm that takes the needle; None: no A2.
        turning: Whether the jaw turns as it was recorded.
        a2: The end of A2.
        rotation: The jaw's [n o a] that is held otherwise, before a suture point turns it, shape (3, 3).
        tip_offset_mm: Distance of a suture point from the tip, along the jaw's approach.
        speed_mm_s: The greatest speed of the tip.
    """

    policy: Policy
    demo: Demo | None
    points: tuple[SuturePoint, ...]
    starts_mm: Floats
    psm_m: PsmM | None
    turning: bool
    a2: A2Target
    rotation: Floats
    tip_offset_mm: float
    speed_mm_s: float

    @cached_property
    def goal_mm(self) -> Floats:
        """The place in the learnt grid that lies at a suture point, shape (3,)."""
        path = self.policy.path
        return path.grid.centres_mm(path.goal) if self.demo is None else self._sampled(-1, path.goal)

    @cached_property
    def first_mm(self) -> Floats:
        """The demonstrated start in the learnt grid, shape (3,)."""
        path = self.policy.path
        return path.grid.centres_mm(path.start) if self.demo is None else self._sampled(0, path.start)

    def _sampled(self, sample: int, state: int) -> Floats:
        """Return a sample of the demonstration, moved into its cell, which hysteresis lets it leave."""
        assert self.demo is not None
        centre, half_mm = self.policy.path.grid.centres_mm(state), 0.499 * self.policy.path.grid.cell_mm
        return np.asarray(self.demo.tip_mm[sample].clip(centre - half_mm, centre + half_mm))

    @cached_property
    def last_rotation(self) -> Floats:
        """The jaw's [n o a] at the end of A1, before a suture point turns it, shape (3, 3)."""
        if self.turning and self.demo is not None and self.demo.rotation_xyzw is not None:
            return np.asarray(matrix_of(self.demo.rotation_xyzw[-1:])[0])
        return self.rotation

    @cached_property
    def approach(self) -> Floats:
        """PSM_M's approach, a unit vector, shape (3,)."""
        assert self.psm_m is not None
        approach = np.array(self.psm_m.approach)
        return np.asarray(approach / np.linalg.norm(approach))

    @cached_property
    def _waypoints(self) -> Ints:
        """The waypoint of the learnt path in which each sample of the demonstration is, shape (T,)."""
        assert self.demo is not None
        path = self.policy.path
        cells = path.grid.cells_along(self.demo.tip_mm, path.hysteresis)
        return np.append(0, np.cumsum(np.abs(np.diff(cells, axis=0)).max(axis=1)))

    def joined_s(self, states: Ints) -> tuple[float, float]:
        """Return when a rollout begins to follow the demonstration, and from when on it has to, in its seconds.

        Both are in the tail of states that are the demonstration's last ones. In between, over `JOIN_CELLS`, a path
        goes over from the centre of a cell to the recorded place in it. Without such a part the second is infinite.
        """
        assert self.demo is not None
        known = self.policy.path.states
        both = min(len(states), len(known))
        differ = np.flatnonzero(states[-both:] != known[-both:])
        joined = len(known) - both + (int(differ[-1]) + 1 if len(differ) else 0)
        after = np.flatnonzero(self._waypoints >= min(joined, len(known) - 1))
        firm = np.flatnonzero(self._waypoints >= joined + JOIN_CELLS)
        seconds = self.demo.stamps_s
        return float(seconds[after[0]]), float(seconds[firm[0]]) if len(firm) else np.inf

    @cached_property
    def hand(self) -> Moments | None:
        """The recorded hand, moment by moment."""
        return None if self.demo is None else Moments.of(self.demo)


def asked_of(plan: SuturePlan, policy: Policy, demo: Demo | None, rotation: ArrayLike | None = None) -> Asked:
    """Return what a plan asks for, without the paths and targets that it computed.

    Args:
        plan: The plan.
        policy: Its policy.
        demo: The demonstration whose hand it follows, as `stack` was given it.
        rotation: The rotation that `stack` was given, shape (3, 3), if any.
    """
    if rotation is None:
        seen = None if demo is None else demo.rotation_xyzw
        rotation = POINTING_DOWN if seen is None else matrix_of(seen[:1])[0]
    return Asked(
        policy=policy,
        demo=demo,
        points=tuple(one.point for one in plan.passes),
        starts_mm=np.array([one.start_mm for one in plan.passes]),
        psm_m=plan.psm_m,
        turning=plan.orientation == "recorded",
        a2=plan.a2,
        rotation=np.asarray(rotation, np.float64),
        tip_offset_mm=plan.tip_offset_mm,
        speed_mm_s=plan.speed_mm_s,
    )
