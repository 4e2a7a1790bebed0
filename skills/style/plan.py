"""Grid worlds stacked at successive suture points (Sec. IV, Fig. 7): one learnt policy, many passes.

A pass moves the whole grid world so that the policy's *goal* lies at the suture point, turned about it where the point
is turned. In the moved grid the policy is rolled out from the pass's start; what comes out is a path in the arm's
frame: through the centres of its cells, as in the paper, or, where the demonstration is given, fitted to what was
recorded within the same cells (`smooth`). Between passes the surgeon inserts and grasps the needle by hand (M1, M2).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from skills.errors import BadPlan, OutsideGrid
from skills.style._arrays import Floats, Ints, frozen
from skills.style.demo import Demo
from skills.style.kinematics import POINTING_DOWN, matrix_of, quaternion_of
from skills.style.policy import Policy, rollout
from skills.style.realign import realign
from skills.style.smooth import Trace, fit_to_demo, trace
from skills.style.trajectory import PassPath

MAX_PASSES = 200
UNTURNED = (0.0, 0.0, 0.0, 1.0)
NEGLIGIBLE_MM = 1e-9

Orientation = Literal["demonstrated", "assumed tool-down"]
PathKind = Literal["fitted", "cell centres"]


@dataclass(frozen=True)
class SuturePoint:
    """Where a pass ends, in mm of the arm's frame, and how its grid world is turned about that place."""

    position_mm: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float] = UNTURNED


@dataclass(frozen=True, eq=False)
class Pass:
    """One pass of a plan, in mm of the arm's frame.

    Attributes:
        point: The suture point.
        start_mm: Where A1 starts, shape (3,).
        states: The states of the grid world that it goes through, shape (T,).
        tip_mm: The path, from the start to the suture point, shape (K, 3). Fitted: about four points to a cell, each
            in one of those states, in their order. Else the start (where it is not a centre) and the states' centres.
        rotation: The jaw's [n o a] during A1, shape (3, 3).
        target_rotation: Where A2 turns it, shape (3, 3), or None where PSM_M's approach is not known.
    """

    point: SuturePoint
    start_mm: Floats
    states: Ints
    tip_mm: Floats
    rotation: Floats
    target_rotation: Floats | None

    def __post_init__(self) -> None:
        for name, dtype, shape in (
            ("start_mm", np.float64, (3,)),
            ("states", np.int64, (None,)),
            ("tip_mm", np.float64, (None, 3)),
            ("rotation", np.float64, (3, 3)),
        ):
            object.__setattr__(self, name, frozen(getattr(self, name), dtype, shape, name))
        if self.target_rotation is not None:
            target = frozen(self.target_rotation, np.float64, (3, 3), "target_rotation")
            object.__setattr__(self, "target_rotation", target)


@dataclass(frozen=True, eq=False)
class SuturePlan:
    """Passes in order, with all that a playback needs to know."""

    arm: str
    frame: str
    instrument: str
    speed_mm_s: float
    orientation: Orientation
    path: PathKind
    approach_m: tuple[float, float, float] | None  # PSM_M's approach in the arm's frame; None: A1 alone
    passes: tuple[Pass, ...]

    @property
    def pass_paths(self) -> tuple[PassPath, ...]:
        """The passes as what `time_parametrise` takes."""
        return tuple(PassPath(one.tip_mm, one.rotation, one.target_rotation) for one in self.passes)


def stack(
    policy: Policy,
    points: Sequence[SuturePoint],
    *,
    arm: str,
    frame: str,
    instrument: str,
    rotation: ArrayLike | None,
    demo: Demo | None = None,
    starts_mm: Sequence[ArrayLike | None] | None = None,
    approach_m: tuple[float, float, float] | None = None,
    speed_mm_s: float = 20.0,
) -> SuturePlan:
    """Stack a policy's grid world at suture points and roll it out in each (Fig. 7).

    Args:
        policy: What to follow; its frame is the arm's.
        points: Where each pass's goal is put, 1 to 200.
        arm: The arm that was demonstrated on.
        frame: The demonstration's frame.
        instrument: The instrument that was demonstrated with.
        rotation: The jaw's [n o a] at the demonstration, shape (3, 3), held during A1; None: straight down is assumed.
        demo: The demonstration that the policy was learnt from, to fit passes to; None: from centre to centre.
        starts_mm: Where each pass starts, in the arm's frame; None: the demonstrated start, moved with the grid.
        approach_m: PSM_M's approach in the arm's frame; None: no A2.
        speed_mm_s: Wanted speed of the tip during A1, where its way is straight.

    Raises:
        BadPlan: No points, too many, as many starts as points not given, a start from which the goal is not reached,
            or another demonstration than the policy's.
        OutsideGrid: A start lies outside its pass's grid world.
    """
    if not 1 <= len(points) <= MAX_PASSES:
        raise BadPlan(f"A plan has 1 to {MAX_PASSES} suture points.", points=len(points))
    starts = [None] * len(points) if starts_mm is None else list(starts_mm)
    if len(starts) != len(points):
        raise BadPlan("Give one start for each suture point, or none.", points=len(points), starts=len(starts))
    jaw = POINTING_DOWN if rotation is None else frozen(rotation, np.float64, (3, 3), "rotation")
    recorded = None if demo is None else trace(demo, policy.path)
    passes = tuple(
        _pass(policy, recorded, number, point, start, jaw, approach_m)
        for number, (point, start) in enumerate(zip(points, starts, strict=True))
    )
    seen: Orientation = "assumed tool-down" if rotation is None else "demonstrated"
    path: PathKind = "cell centres" if recorded is None else "fitted"
    return SuturePlan(arm, frame, instrument, speed_mm_s, seen, path, approach_m, passes)


def _pass(
    policy: Policy,
    recorded: Trace | None,
    number: int,
    point: SuturePoint,
    start_mm: ArrayLike | None,
    jaw: Floats,
    approach_m: tuple[float, float, float] | None,
) -> Pass:
    grid, goal = policy.path.grid, policy.path.grid.centres_mm(policy.path.goal)
    place = frozen(point.position_mm, np.float64, (3,), "position_mm")
    turned = matrix_of(np.array([point.rotation_xyzw]))[0]
    demonstrated = grid.centres_mm(policy.path.start)
    start = turned @ (demonstrated - goal) + place if start_mm is None else frozen(start_mm, np.float64, (3,), "start")
    unmoved = demonstrated if start_mm is None else turned.T @ (start - place) + goal
    try:
        followed = rollout(policy, unmoved)
    except OutsideGrid as error:
        raise OutsideGrid(
            f"Pass {number} starts outside its grid world; start it nearer to its suture point.", suture_pass=number
        ) from error
    if not followed.finished:
        raise BadPlan(f"From its start pass {number} does not reach the goal.", suture_pass=number)
    path = followed.tip_mm if recorded is None else fit_to_demo(followed, recorded, unmoved).tip_mm
    tip = (path - goal) @ turned.T + place
    if np.abs(tip[0] - start).max() > NEGLIGIBLE_MM:
        tip = np.concatenate((start[None], tip))
    held = turned @ jaw
    target = None if approach_m is None else realign(held, approach_m).rotation
    return Pass(point, start, followed.states, tip, held, target)


def rotation_of(rotation_xyzw: Floats | None) -> Floats | None:
    """Take the jaw's rotation at the start of a demonstration, (3, 3), from its quaternions, (T, 4)."""
    return None if rotation_xyzw is None else matrix_of(rotation_xyzw[:1])[0]


def pose_xyzw(rotation: Floats) -> tuple[float, float, float, float]:
    """Write one rotation, (3, 3), as a quaternion."""
    x, y, z, w = (float(v) for v in quaternion_of(rotation[None])[0])
    return x, y, z, w
