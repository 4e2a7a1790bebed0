"""The motion that a plan requests: policy, recording, suture points, starts and rules, without what planning computed.

    SuturePlan, Policy, Demo --requested_motion--> RequestedMotion

`skills.verification.intent` compares a motion with it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Floats, Ints
from skills.demonstration.demonstration import Demo
from skills.kinematics import POINTING_DOWN, matrix_of
from skills.learning.policy import Policy
from skills.planning.handoff import PsmM
from skills.planning.plan import A2Target, SuturePlan, SuturePoint
from skills.verification.recorded_hand import RecordedHand

JOIN_CELLS = 3  # over which a path goes over from the centre of a cell to the recorded place in it


@dataclass(frozen=True, eq=False)
class RequestedMotion:
    """The motion that was requested.

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
    def hand(self) -> RecordedHand | None:
        """The recorded hand, moment by moment."""
        return None if self.demo is None else RecordedHand.of(self.demo)


def requested_motion(
    plan: SuturePlan, policy: Policy, demo: Demo | None, rotation: ArrayLike | None = None
) -> RequestedMotion:
    """Return the motion that a plan requests, without the paths and targets that it computed.

    Args:
        plan: The plan.
        policy: Its policy.
        demo: The demonstration whose hand it follows, as `stack` was given it.
        rotation: The rotation that `stack` was given, shape (3, 3), if any.
    """
    if rotation is None:
        seen = None if demo is None else demo.rotation_xyzw
        rotation = POINTING_DOWN if seen is None else matrix_of(seen[:1])[0]
    return RequestedMotion(
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
