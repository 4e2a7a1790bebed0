"""Grid worlds stacked at successive suture points (Sec. IV, Fig. 7): one learnt policy, many passes.

A pass moves the whole grid world so that the policy's *goal* lies at the suture point, turned about it where the point
is turned. In the moved grid the policy is rolled out from the pass's start; what comes out is a path in the arm's
frame: through the centres of its cells, as in the paper, or, where the demonstration is given, fitted to what was
recorded within the same cells (`smooth`). Between passes the surgeon inserts and grasps the needle by hand (M1, M2).

A start outside its grid world is brought to the nearest place in it by a straight transfer, which is ours; from there
the policy goes on. A suture point is where the arm's tip goes, its hinge; with a `tip_offset_mm` it is where the point
that far down the jaw's approach goes, such as the finger tips, as the jaw is held during A1.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import dist
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from skills.errors import BadPlan, BadSpeed, OutsideGrid
from skills.style._arrays import Floats, Ints, frozen
from skills.style.demo import Demo
from skills.style.grid import GridWorld
from skills.style.handoff import PsmM
from skills.style.kinematics import POINTING_DOWN, matrix_of, quaternion_of
from skills.style.policy import Policy, rollout
from skills.style.realign import realign
from skills.style.smooth import Trace, fit_to_demo, trace
from skills.style.trajectory import PassPath

MAX_PASSES = 200
RATE_HZ = (100.0, 200.0)  # of the plans that a robot's controller follows
MAX_OUTSIDE_MM = 50.0  # ours, as wide as the paper's grid: what starts further away is of another place or frame
MAX_TIP_OFFSET_MM = 50.0  # ours: finger tips are 10.2 mm from the hinge, and no instrument's are a hand away
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
        start_mm: Where the tip starts, shape (3,); a transfer leads from there to the path where that begins elsewhere.
        states: The states of the grid world that it goes through, shape (T,).
        tip_mm: The tip's path, from the start, or where it enters the grid world, to the suture point, shape (K, 3).
            Fitted: about four points to a cell, each in one of those states, in their order. Else where it begins
            (where that is not a centre) and the states' centres.
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
    """Passes in order, with all that a playback needs to know.

    `psm_m` is None where A1 alone is planned; `rate_hz` is the one rate at which the plan is sampled; a suture point is
    `tip_offset_mm` from the tip, down the jaw's approach.
    """

    arm: str
    frame: str
    instrument: str
    speed_mm_s: float
    orientation: Orientation
    path: PathKind
    psm_m: PsmM | None
    passes: tuple[Pass, ...]
    rate_hz: float = 200.0
    tip_offset_mm: float = 0.0

    def __post_init__(self) -> None:
        low, high = RATE_HZ
        if not low <= self.rate_hz <= high:
            raise BadSpeed(f"A plan is sampled at {low:g} to {high:g} Hz.", rate_hz=self.rate_hz)
        if not 0 <= self.tip_offset_mm <= MAX_TIP_OFFSET_MM:
            raise BadPlan(f"The tip's offset is 0 to {MAX_TIP_OFFSET_MM:g} mm.", tip_offset_mm=self.tip_offset_mm)

    @property
    def pass_paths(self) -> tuple[PassPath, ...]:
        """The passes as what `time_parametrise` takes."""
        return tuple(PassPath(one.tip_mm, one.rotation, one.target_rotation, one.start_mm) for one in self.passes)


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
    psm_m: PsmM | None = None,
    speed_mm_s: float = 20.0,
    rate_hz: float = 200.0,
    tip_offset_mm: float = 0.0,
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
        psm_m: The arm that takes the needle; None: no A2.
        speed_mm_s: Wanted speed of the tip during A1, where its way is straight.
        rate_hz: Samples per second, 100 to 200.
        tip_offset_mm: How far down the jaw's approach from the tip, the hinge, suture points and given starts are
            meant, as the jaw is held during A1; `JAW_TIP_MM` for the finger tips.

    Raises:
        BadPlan: No points, too many, as many starts as points not given, a start from which the goal is not reached,
            another demonstration than the policy's, or an offset that no instrument has.
        BadSpeed: The rate is not one of a plan.
        OutsideGrid: A start lies more than `MAX_OUTSIDE_MM` outside its pass's grid world.
    """
    if not 1 <= len(points) <= MAX_PASSES:
        raise BadPlan(f"A plan has 1 to {MAX_PASSES} suture points.", points=len(points))
    starts = [None] * len(points) if starts_mm is None else list(starts_mm)
    if len(starts) != len(points):
        raise BadPlan("Give one start for each suture point, or none.", points=len(points), starts=len(starts))
    jaw = POINTING_DOWN if rotation is None else frozen(rotation, np.float64, (3, 3), "rotation")
    recorded = None if demo is None else trace(demo, policy.path)
    seen: Orientation = "assumed tool-down" if rotation is None else "demonstrated"
    path: PathKind = "cell centres" if recorded is None else "fitted"
    plan = SuturePlan(arm, frame, instrument, speed_mm_s, seen, path, psm_m, (), rate_hz, tip_offset_mm)
    passes = tuple(
        _pass(policy, recorded, number, point, start, jaw, plan)
        for number, (point, start) in enumerate(zip(points, starts, strict=True))
    )
    return replace(plan, passes=passes)


def _pass(
    policy: Policy,
    recorded: Trace | None,
    number: int,
    point: SuturePoint,
    start_mm: ArrayLike | None,
    jaw: Floats,
    plan: SuturePlan,
) -> Pass:
    grid, goal = policy.path.grid, policy.path.grid.centres_mm(policy.path.goal)
    turned = matrix_of(np.array([point.rotation_xyzw]))[0]
    held = turned @ jaw
    hinge = -plan.tip_offset_mm * held[:, 2]  # from a place that is meant to where the tip is then
    place = frozen(point.position_mm, np.float64, (3,), "position_mm") + hinge
    begin = grid.centres_mm(policy.path.start)  # in the grid as it was learnt, like all that is not of the arm's frame
    start = turned @ (begin - goal) + place
    if start_mm is not None:
        start = frozen(start_mm, np.float64, (3,), "start") + hinge
        begin = _entered(grid, turned.T @ (start - place) + goal, number)
    followed = rollout(policy, begin)
    if not followed.finished:
        raise BadPlan(f"From its start pass {number} does not reach the goal.", **{"pass": number})
    path = followed.tip_mm if recorded is None else fit_to_demo(followed, recorded, begin).tip_mm
    if np.abs(path[0] - begin).max() > NEGLIGIBLE_MM:
        path = np.concatenate((begin[None], path))
    tip = (path - goal) @ turned.T + place
    target = None if plan.psm_m is None else realign(held, plan.psm_m.approach).rotation
    return Pass(point, start, followed.states, tip, held, target)


def _entered(grid: GridWorld, start_mm: Floats, number: int) -> Floats:
    """Take a start where it lies in its grid, else the nearest place between the outermost cells' centres.

    Raises:
        OutsideGrid: It is more than `MAX_OUTSIDE_MM` away.
    """
    entered = np.clip(start_mm, grid.centres_mm(0), grid.centres_mm(grid.n_states - 1))
    outside_mm = dist(start_mm, entered)
    if not outside_mm <= MAX_OUTSIDE_MM:
        raise OutsideGrid(
            f"Pass {number} starts outside its grid world, {outside_mm:.1f} mm from it; {MAX_OUTSIDE_MM:g} mm are "
            "bridged, so start it nearer to its suture point.",
            **{"pass": number, "outside_mm": outside_mm, "limit_mm": MAX_OUTSIDE_MM},
        )
    return start_mm if grid.holds(grid.cells_at(start_mm)).all() else entered


def rotation_of(rotation_xyzw: Floats | None) -> Floats | None:
    """Take the jaw's rotation at the start of a demonstration, (3, 3), from its quaternions, (T, 4)."""
    return None if rotation_xyzw is None else matrix_of(rotation_xyzw[:1])[0]


def pose_xyzw(rotation: Floats) -> tuple[float, float, float, float]:
    """Write one rotation, (3, 3), as a quaternion."""
    x, y, z, w = (float(v) for v in quaternion_of(rotation[None])[0])
    return x, y, z, w
