"""Plans: a grid world stacked at suture points, and the joint-limit check of the pass that was demonstrated.

One learnt policy serves many passes (Sec. IV, Fig. 7).

    Policy, suture points --stack--> SuturePlan

A pass moves the complete grid world so that the policy's *goal* lies at the suture point, turned about it if the point
has a rotation. In the moved grid the policy is rolled out from the pass's start. The result is a path in the arm's
frame: through the centres of its cells, as in the paper, or, if the demonstration is given, fitted to the recording
within the same cells (`skills.planning.path_fit`). Between passes the surgeon inserts and grasps the needle by hand
(M1, M2).

A start outside its grid world is connected to the nearest place inside by a straight transfer, which is ours; from
there the policy continues. A suture point is the target of the arm's tip, which is its hinge; with a `tip_offset_mm` it
is the target of the point that far along the jaw's approach, such as the finger tips, with the jaw as it is held during
A1.

The demonstrated pass, as an arm drives it, is checked against the arm's joint limits:

    Policy, Demo --driven_pass--> DrivenPass

A plan at the demonstrated place drives the *fitted path* (`skills.planning.path_fit`), sampled as
`skills.planning.trajectory` samples A1. Here the joints of every one of those samples are solved in closed form
(`skills.kinematics`), with the jaw held as it was at the start of the demonstration. If no path can be fitted, the pass
goes through the centres of its cells, as in the paper. All of this is ours.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import dist
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Floats, Ints, frozen
from skills.demonstration.demonstration import Demo
from skills.errors import BadPlan, BadSpeed, OutsideGrid
from skills.fields import Count, schema
from skills.gridworld.grid import GridWorld
from skills.kinematics import POINTING_DOWN, NearestLimit, matrix_of, nearest_limit, quaternion_of, reachable
from skills.learning.policy import Policy, rollout
from skills.planning.handoff import PsmM, realign
from skills.planning.motion_laws import followed
from skills.planning.passes import ways
from skills.planning.path_fit import Trace, fit_to_demo, trace
from skills.planning.trajectory import PassPath

MAX_PASSES = 200
RATE_HZ = (100.0, 200.0)  # of the plans that a robot's controller follows
MAX_OUTSIDE_MM = 50.0  # ours, as wide as the paper's grid: a start further away belongs to another place or frame
MAX_TIP_OFFSET_MM = 50.0  # ours: finger tips are 10.2 mm from the hinge, and no instrument has them a hand away
UNTURNED = (0.0, 0.0, 0.0, 1.0)
NEGLIGIBLE_MM = 1e-9

Orientation = Literal["demonstrated", "assumed tool-down"]
PathKind = Literal["fitted", "cell centres"]


STEP_MM = 0.1  # greatest distance between samples: that of a plan at the default 20 mm/s and 200 Hz


@dataclass(frozen=True)
class SuturePoint:
    """The end of a pass, in mm of the arm's frame, and the rotation of its grid world about that place."""

    position_mm: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float] = UNTURNED


@dataclass(frozen=True, eq=False)
class Pass:
    """One pass of a plan, in mm of the arm's frame.

    Attributes:
        point: The suture point.
        start_mm: Start of the tip, shape (3,); if the path begins elsewhere, a transfer leads there.
        states: The states of the grid world that the pass goes through, shape (T,).
        tip_mm: The tip's path to the suture point, from the start or from where it enters the grid world, shape (K, 3).
            Fitted: about four points per cell, each in one of those states, in their order. Otherwise: the beginning,
            if that is not a centre, and the states' centres.
        rotation: The jaw's [n o a] during A1, shape (3, 3).
        target_rotation: Target of the turn in A2, shape (3, 3), or None if PSM_M's approach is not known.
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
    """Passes in order, with everything that a playback needs.

    Attributes:
        arm: The arm that performs the passes.
        frame: The arm's frame.
        instrument: Number of the instrument.
        speed_mm_s: Speed of the tip during A1 where the path is straight.
        orientation: Source of the jaw's rotation: demonstrated, or assumed to point straight down.
        path: The kind of path: fitted, or through the centres of the cells.
        psm_m: The arm that takes the needle; None if A1 alone is planned.
        passes: The passes in order.
        rate_hz: The one rate at which the plan is sampled.
        tip_offset_mm: Distance of a suture point from the tip, along the jaw's approach.
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
            raise BadSpeed(f"A plan must be sampled at {low:g} to {high:g} Hz.", rate_hz=self.rate_hz)
        if not 0 <= self.tip_offset_mm <= MAX_TIP_OFFSET_MM:
            raise BadPlan(f"The tip's offset must be 0 to {MAX_TIP_OFFSET_MM:g} mm.", tip_offset_mm=self.tip_offset_mm)

    @property
    def pass_paths(self) -> tuple[PassPath, ...]:
        """The passes as input for `time_parametrise`."""
        return tuple(PassPath(one.tip_mm, one.rotation, one.target_rotation, one.start_mm) for one in self.passes)


def stack(
    policy: Policy,
    points: Sequence[SuturePoint],
    *,
    demo: Demo | None = None,
    arm: str | None = None,
    frame: str | None = None,
    instrument: str | None = None,
    rotation: ArrayLike | None = None,
    starts_mm: Sequence[ArrayLike | None] | None = None,
    psm_m: PsmM | None = None,
    speed_mm_s: float = 20.0,
    rate_hz: float = 200.0,
    tip_offset_mm: float = 0.0,
) -> SuturePlan:
    """Stack a policy's grid world at suture points and roll the policy out in each (Fig. 7).

    Args:
        policy: The policy to follow; its frame is the arm's.
        points: The suture points, 1 to 200; each is the goal of one pass.
        demo: The demonstration that the policy was learnt from: passes are fitted to it, and arm, frame, instrument and
            rotation are its own. None: passes go from cell centre to cell centre, and arm, frame and instrument are
            given.
        arm: The arm, such as "PSM2"; with a demonstration, none or the same.
        frame: The frame of the policy's grid; with a demonstration, none or the same.
        instrument: The instrument's number; with a demonstration, none or the same.
        rotation: The jaw's [n o a], shape (3, 3), held during A1; None: the demonstration's first, or straight down
            where it recorded none.
        starts_mm: Start of each pass in the arm's frame; None: the demonstrated start, moved with the grid.
        psm_m: The arm that takes the needle; None: no A2.
        speed_mm_s: Desired speed of the tip during A1 where the path is straight.
        rate_hz: Samples per second, 100 to 200.
        tip_offset_mm: Distance from the tip (the hinge), along the jaw's approach as it is held during A1, at which
            suture points and given starts are meant; `JAW_TIP_MM` for the finger tips.

    Returns:
        The plan, with one pass per suture point.

    Raises:
        BadPlan: There are no points or too many, a point is not a `SuturePoint`, the number of starts differs from the
            number of points, the goal is not reached from a start, the demonstration is not the policy's, another arm
            is given beside it, or the offset is not one of an instrument.
        BadSpeed: The rate is not one of a plan.
        OutsideGrid: A start lies more than `MAX_OUTSIDE_MM` outside its pass's grid world.
    """
    if not 1 <= len(points) <= MAX_PASSES:
        raise BadPlan(f"A plan must have 1 to {MAX_PASSES} suture points.", points=len(points))
    for point in points:
        if not isinstance(point, SuturePoint):
            raise BadPlan(f"A suture point must be SuturePoint((x, y, z)), in mm; {point!r} was given.")
    starts = [None] * len(points) if starts_mm is None else list(starts_mm)
    if len(starts) != len(points):
        raise BadPlan("Give one start for each suture point, or none.", points=len(points), starts=len(starts))
    arm, frame, instrument = (
        _of_demonstration(demo, name, value)
        for name, value in (("arm", arm), ("frame", frame), ("instrument", instrument))
    )
    if rotation is None and demo is not None:
        rotation = rotation_of(demo.rotation_xyzw)
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


def _of_demonstration(demo: Demo | None, name: str, given: str | None) -> str:
    """Return the arm, frame or instrument of a demonstration; one that is given must be the same.

    Raises:
        BadPlan: Another is given, or neither it nor a demonstration.
    """
    if demo is None:
        if given is None:
            raise BadPlan(f"Give the demonstration (demo=), or arm, frame and instrument; {name} is missing.")
        return given
    have = str(getattr(demo, name))
    if given not in (None, have):
        raise BadPlan(f"The demonstration has {name} '{have}'; '{given}' was given. Omit it.")
    return have


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
    hinge = -plan.tip_offset_mm * held[:, 2]  # offset from a given place to the tip, which is the hinge
    place = frozen(point.position_mm, np.float64, (3,), "position_mm") + hinge
    # `grid`, `goal` and `begin` are in the frame of the learnt grid; `place` and `start` are in the arm's frame.
    begin = grid.centres_mm(policy.path.start)
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
    """Return a start that lies in its grid, or else the nearest place between the centres of the outermost cells.

    Raises:
        OutsideGrid: It is more than `MAX_OUTSIDE_MM` away.
    """
    entered = np.clip(start_mm, grid.centres_mm(0), grid.centres_mm(grid.n_states - 1))
    outside_mm = dist(start_mm, entered)
    if not outside_mm <= MAX_OUTSIDE_MM:
        raise OutsideGrid(
            f"Pass {number} starts outside its grid world, {outside_mm:.1f} mm from it; {MAX_OUTSIDE_MM:g} mm can "
            "be bridged, so start it closer to its suture point.",
            **{"pass": number, "outside_mm": outside_mm, "limit_mm": MAX_OUTSIDE_MM},
        )
    return start_mm if grid.holds(grid.cells_at(start_mm)).all() else entered


def rotation_of(rotation_xyzw: Floats | None) -> Floats | None:
    """Return the jaw's rotation at the start of a demonstration, shape (3, 3).

    Args:
        rotation_xyzw: The demonstration's quaternions, shape (T, 4), or None, which is returned.
    """
    return None if rotation_xyzw is None else matrix_of(rotation_xyzw[:1])[0]


def pose_xyzw(rotation: Floats) -> tuple[float, float, float, float]:
    """Return one rotation as a quaternion x, y, z, w.

    Args:
        rotation: The rotation, shape (3, 3).
    """
    x, y, z, w = (float(v) for v in quaternion_of(rotation[None])[0])
    return x, y, z, w


@schema
@dataclass(frozen=True)
class DrivenPass:
    """The demonstrated pass as it is driven, and its least distance from the arm's joint limits.

    Attributes:
        path: The kind of path: the fitted path, or the centres of the cells.
        frame: The frame of `nearest_limit.tip_mm`: the arm's base.
        samples: Number of places on the path whose joints were solved.
        beyond: Number of these places that no joints within the limits reach; a place without any solution counts.
        nearest_limit: The joint that comes nearest to its limit on the path, or goes furthest beyond it.
        cell_centres_beyond: Number of centres of the path's cells that are beyond the limits: a rollout contains those
            centres, but a plan does not drive them if its path is fitted.
    """

    path: PathKind
    frame: str
    samples: Count
    beyond: Count
    nearest_limit: NearestLimit
    cell_centres_beyond: Count


def driven_pass(policy: Policy, demo: Demo) -> DrivenPass:
    """Solve the joints along the demonstrated pass at the place where it was demonstrated.

    Args:
        policy: The policy to follow.
        demo: The demonstration that the policy was learnt from, in the frame of the arm's base.

    Returns:
        The driven pass with the sample that is nearest to a joint limit.

    Raises:
        BadPlan: From the demonstrated start the policy does not reach the goal, so nothing can be driven.
    """
    plan = _at_its_own_place(policy, demo)
    (only,) = plan.passes
    (way,) = ways(plan.pass_paths, None)
    line, _ = followed(way.line, STEP_MM)
    nearest, beyond = nearest_limit(line, only.rotation, demo.instrument)
    return DrivenPass(
        path=plan.path,
        frame=demo.frame,
        samples=len(line),
        beyond=beyond,
        nearest_limit=nearest,
        cell_centres_beyond=int(np.count_nonzero(~reachable(policy.path.tip_mm, only.rotation, demo.instrument))),
    )


def _at_its_own_place(policy: Policy, demo: Demo) -> SuturePlan:
    """Plan one pass at the demonstrated place, along the fitted path if one can be fitted."""
    x, y, z = policy.path.tip_mm[-1].tolist()

    def pass_along(recorded: Demo | None) -> SuturePlan:
        return stack(
            policy,
            [SuturePoint((x, y, z))],
            arm=demo.arm,
            frame=demo.frame,
            instrument=demo.instrument,
            rotation=rotation_of(demo.rotation_xyzw),
            demo=recorded,
        )

    try:
        return pass_along(demo)
    # Either the path was not made from these samples, and cell centres are the fallback; or the goal is not reached,
    # and then the second call fails for the same reason.
    except BadPlan:
        return pass_along(None)
