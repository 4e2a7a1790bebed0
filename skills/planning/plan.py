"""Plans: a grid world stacked at suture points, and the joint-limit check of the pass that was demonstrated.

One learnt policy serves many passes (Sec. IV, Fig. 7).

    Policy, suture points --stack--> SuturePlan

A pass moves the complete grid world so that the policy's *goal* lies at the suture point, turned about it if the point
has a rotation. In the moved grid the policy is rolled out from the pass's start. The result is a path in the arm's
frame: through the centres of its cells, as in the paper, or, if the demonstration is given, fitted to the recording
within the same cells, with the surgeon's orientation, jaw and tempo along it (`skills.planning.path_fit`). What was
demonstrated at the policy's goal is then done at the suture point: the hand's last sample lies there, somewhere in the
cell of the goal. Between passes the surgeon inserts and grasps the needle by hand (M1, M2).

The orientation turns with the pass. It is held as at the first sample where that is requested, and the plan then states
its *departure* from the recorded one. A2 ends in the recorded hand-off, the poses of both arms moved with the pass, if
the demonstration has them, and otherwise as in the paper (`skills.planning.handoff`).

A start outside its grid world is connected to the nearest place inside by a straight transfer, which is ours; from
there the policy continues. A suture point is the target of the arm's tip, which is its hinge; with a `tip_offset_mm` it
is the target of the point that far along the jaw's approach, such as the finger tips, with the jaw as it is at the end
of A1; a given start is meant with the jaw as it is at the start of the demonstration.

The demonstrated pass, as an arm drives it, is checked against the arm's joint limits:

    Policy, Demo --driven_pass--> DrivenPass

A plan at the demonstrated place drives the *fitted path* (`skills.planning.path_fit`), sampled as
`skills.planning.trajectory` samples A1. Here the joints of every one of those samples are solved in closed form
(`skills.kinematics`), with the jaw as recorded, or pointing straight down. If no path can be fitted, the pass
goes through the centres of its cells, as in the paper. All of this is ours.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import dist
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from skills import kinematics
from skills.arithmetic import product
from skills.arrays import Floats, Ints, freeze, frozen, xyzw
from skills.demonstration.demonstration import Demo
from skills.errors import BadPlan, BadSpeed, OutsideGrid
from skills.fields import Count, schema
from skills.gridworld.grid import GridWorld
from skills.gridworld.scene import Scene
from skills.learning.policy import Policy, rollout
from skills.notebook import card
from skills.planning.handoff import PsmM, needle_tips_mm, realign
from skills.planning.motion_laws import Pose, followed
from skills.planning.passes import PassPath, Route, lay_out
from skills.planning.path_fit import SmoothedDemo, ends_of, fit_to_demo, hand_along, moved, trace
from skills.planning.trajectory import Trajectory, time_parametrise

MAX_PASSES = 200
RATE_HZ = (100.0, 200.0)  # of the plans that a robot's controller follows
MAX_OUTSIDE_MM = 50.0  # ours, as wide as the paper's grid: a start further away belongs to another place or frame
MAX_TIP_OFFSET_MM = 50.0  # ours: finger tips are 10.2 mm from the hinge, and no instrument has them a hand away
UNTURNED = (0.0, 0.0, 0.0, 1.0)
NEGLIGIBLE_MM = 1e-9
# Ours: by so much the needle may stand wrongly in the jaws in the estimate of success (`verification.monte_carlo`).
CONSTANT_TURN_DEG = 10.0

Orientation = Literal["recorded", "demonstrated", "assumed tool-down"]
Turning = Literal["recorded", "constant"]
A2Target = Literal["recorded", "paper"]
PathKind = Literal["fitted", "cell centres"]
STEP_MM = 0.1  # greatest distance between samples: that of a plan at the default 20 mm/s and 200 Hz


@dataclass(frozen=True)
class SuturePoint:
    """The end of a pass, in mm of the arm's frame, and the rotation of its grid world about that place."""

    position_mm: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float] = UNTURNED

    def __post_init__(self) -> None:
        for name in ("position_mm", "rotation_xyzw"):  # -0 is 0: it is the same point, with the same digest
            object.__setattr__(self, name, tuple(number + 0.0 for number in getattr(self, name)))


@dataclass(frozen=True, eq=False, kw_only=True)
class Pass(PassPath):
    """One pass of a plan, in mm of the arm's frame.

    Fitted, its path has about four points per cell, each in one of the states, in their order. Otherwise it has the
    beginning, if that is not a centre, and the states' centres. It begins at the start, or where it enters the grid
    world.

    Attributes:
        start_mm: Start of the tip, shape (3,).
        point: The suture point.
        states: The states of the grid world that the pass goes through, shape (T,).
    """

    start_mm: Floats
    point: SuturePoint
    states: Ints

    def __post_init__(self) -> None:
        super().__post_init__()
        freeze(self, np.int64, states=(None,))


@schema
@dataclass(frozen=True)
class Departure:
    """The difference of a constant orientation from the recorded one.

    `deg` and `needle_tip_mm` are the greatest of the demonstration: the angle, and the distance of the needle's free
    end from where it was. The others are those of its last sample, the hand-off.
    """

    deg: float
    needle_tip_mm: float
    handoff_deg: float
    handoff_needle_tip_mm: float


@dataclass(frozen=True, eq=False)
class SuturePlan:
    """Passes in order, with everything that a playback needs.

    Attributes:
        arm: The arm that performs the passes.
        frame: The arm's frame.
        instrument: Number of the instrument.
        speed_mm_s: Greatest speed of the tip.
        orientation: The jaw's rotation in A1: as recorded all along the pass, or constant as in the demonstration's
            first sample, or assumed to point straight down.
        path: The kind of path: fitted, or through the centres of the cells.
        psm_m: The arm that takes the needle; None if A1 alone is planned.
        passes: The passes in order.
        rate_hz: The one rate at which the plan is sampled.
        tip_offset_mm: Distance of a suture point from the tip, along the jaw's approach.
        a2: The end of A2: the recorded hand-off, or that of the paper.
        departure: The difference from the recorded orientation; None if there is none or it was not recorded.
        scene: Tissue and obstacles in the arm's frame, which do not move with the passes; None: not stated.
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
    a2: A2Target = "paper"
    departure: Departure | None = None
    scene: Scene | None = None

    def __post_init__(self) -> None:
        if self.scene is not None and self.scene.frame != self.frame:
            raise BadPlan(
                f"The scene is in the frame '{self.scene.frame}', the plan in '{self.frame}'; give the scene in that "
                "frame."
            )
        low, high = RATE_HZ
        if not low <= self.rate_hz <= high:
            raise BadSpeed(f"A plan must be sampled at {low:g} to {high:g} Hz.", rate_hz=self.rate_hz)
        if not 0 <= self.tip_offset_mm <= MAX_TIP_OFFSET_MM:
            raise BadPlan(f"The tip's offset must be 0 to {MAX_TIP_OFFSET_MM:g} mm.", tip_offset_mm=self.tip_offset_mm)

    @cached_property
    def trajectory(self) -> Trajectory:
        """The plan in time, for all who need it: planning, playback and export; computed once.

        Raises:
            BadSpeed, NoMotion, BadPlan, Unreachable: As for `time_parametrise`.
        """
        return time_parametrise(
            self.passes,
            speed_mm_s=self.speed_mm_s,
            rate_hz=self.rate_hz,
            instrument=self.instrument,
            psm_m=self.psm_m,
        )

    def _repr_html_(self) -> str:
        points = "; ".join(", ".join(f"{x:g}" for x in one.point.position_mm) for one in self.passes)
        facts = {
            "arm": f"{self.arm}, in {self.frame}",
            "instrument": self.instrument,
            "passes": len(self.passes),
            "suture points": f"{points} mm",
            "path": self.path,
            "orientation": self.orientation,
            "greatest speed": f"{self.speed_mm_s:g} mm/s",
            "hand-off": "none is planned" if self.psm_m is None else f"to PSM_M, {self.a2}",
            "tissue and obstacles": "none are stated" if self.scene is None else "stated",
            "checked": "not by itself: skills.judge decides",
        }
        return card("Plan", facts, {"passes": [one.tip_mm for one in self.passes]})


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
    orientation: Turning | None = None,
    a2: A2Target | None = None,
) -> SuturePlan:
    """Stack a policy's grid world at suture points and roll the policy out in each (Fig. 7).

    Args:
        policy: The policy to follow; its frame is the arm's.
        points: The suture points, 1 to 200; each is the goal of one pass.
        demo: The demonstration that the policy was learnt from: passes are fitted to it, with its orientation, jaw and
            tempo, and arm, frame and instrument are its own. None: passes go from cell centre to cell centre at an even
            tempo, and arm, frame and instrument are given.
        arm: The arm, such as "PSM2"; with a demonstration, none or the same.
        frame: The frame of the policy's grid; with a demonstration, none or the same.
        instrument: The instrument's number; with a demonstration, none or the same.
        rotation: The jaw's [n o a], shape (3, 3), held during A1; None: the demonstration's, or straight down where it
            recorded none.
        starts_mm: Start of each pass in the arm's frame; None: the demonstrated start, moved with the grid.
        psm_m: The arm that takes the needle; None: no A2.
        speed_mm_s: Greatest speed of the tip: the surgeon's tempo is slowed to it.
        rate_hz: Samples per second, 100 to 200.
        tip_offset_mm: Distance from the tip (the hinge), along the jaw's approach, at which suture points (the jaw as
            at the end of A1) and given starts (as in the demonstration's first sample) are meant; `JAW_TIP_MM` for the
            finger tips.
        orientation: "recorded": along the pass as demonstrated; "constant": held as in the first sample. None: recorded
            where the demonstration has it and no rotation is given.
        a2: "recorded": A2 ends in the demonstrated poses of both arms; "paper": PSM_A turns across PSM_M's approach.
            None: recorded where the demonstration's orientation and PSM_M's pose are known.

    Returns:
        The plan, with one pass per suture point.

    Raises:
        BadPlan: There are no points or too many, a point is not a `SuturePoint`, the number of starts differs from the
            number of points, the goal is not reached from a start, the demonstration is not the policy's, another arm
            is given beside it, the offset is not one of an instrument, or what was not recorded is requested.
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
    turning = _turns(demo, rotation, orientation)
    handing = _handing(demo, psm_m, a2)
    known = rotation is not None or (demo is not None and demo.rotation_xyzw is not None)
    if rotation is None and demo is not None:
        rotation = rotation_of(demo.rotation_xyzw)
    jaw = kinematics.POINTING_DOWN if rotation is None else frozen(rotation, np.float64, (3, 3), "rotation")
    recorded = None if demo is None else _Recorded(demo, trace(demo, policy.path), turning)
    plan = SuturePlan(
        arm,
        frame,
        instrument,
        speed_mm_s,
        "recorded" if turning else "demonstrated" if known else "assumed tool-down",
        "cell centres" if recorded is None else "fitted",
        psm_m,
        (),
        rate_hz,
        tip_offset_mm,
        handing,
        None if turning or demo is None else departure_of(demo, jaw),
    )
    passes = tuple(
        _pass(policy, recorded, number, point, start, jaw, plan)
        for number, (point, start) in enumerate(zip(points, starts, strict=True))
    )
    return replace(plan, passes=passes)


@dataclass(frozen=True, eq=False)
class _Recorded:
    """The demonstration of a plan, its trace in the grid, and whether the jaw turns as it did there."""

    demo: Demo
    trace: SmoothedDemo
    turning: bool

    @property
    def last_rotation(self) -> Floats | None:
        """The jaw's [n o a] at the recorded hand-off, shape (3, 3)."""
        return None if self.demo.rotation_xyzw is None else kinematics.matrix_of(self.demo.rotation_xyzw[-1:])[0]


def _turns(demo: Demo | None, rotation: ArrayLike | None, orientation: Turning | None) -> bool:
    """Return whether the jaw turns as it was recorded.

    Raises:
        BadPlan: That is requested, and there is no recorded orientation, or another one is given.
    """
    there = demo is not None and demo.rotation_xyzw is not None and rotation is None
    if orientation == "recorded" and not there:
        raise BadPlan(
            "The demonstration has no orientation, or another rotation is given, so that none along the pass is known; "
            "omit the orientation, or ask for a constant one."
        )
    return there and orientation != "constant"


def _handing(demo: Demo | None, psm_m: PsmM | None, a2: A2Target | None) -> A2Target:
    """Return the end of A2.

    Raises:
        BadPlan: The recorded hand-off is requested, and there is none.
    """
    there = demo is not None and demo.rotation_xyzw is not None and psm_m is not None and psm_m.taken_mm is not None
    if a2 == "recorded" and not there:
        raise BadPlan(
            "The hand-off was not recorded: that needs the orientation of PSM_A and the pose of PSM_M in the "
            "demonstration, and no other approach; omit a2, or ask for the paper's."
        )
    return a2 or ("recorded" if there else "paper")


def departure_of(demo: Demo, rotation: Floats | None = None) -> Departure | None:
    """Return the difference of a constant orientation from the recorded one; None if none was recorded.

    Args:
        demo: The demonstration.
        rotation: The constant [n o a], shape (3, 3); None: that of the first sample.
    """
    if demo.rotation_xyzw is None:
        return None
    seen = kinematics.matrix_of(demo.rotation_xyzw)
    rotation = seen[0] if rotation is None else rotation
    turn_deg = np.degrees(kinematics.angle_between(seen, np.broadcast_to(rotation, seen.shape)))
    # The free end is on either side of the jaws, so the further one counts.
    apart_mm = np.linalg.norm(product(seen - rotation, needle_tips_mm().T), axis=1).max(axis=1)
    return Departure(*(float(v) for v in (turn_deg.max(), apart_mm.max(), turn_deg[-1], apart_mm[-1])))


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
    recorded: _Recorded | None,
    number: int,
    point: SuturePoint,
    start_mm: ArrayLike | None,
    jaw: Floats,
    plan: SuturePlan,
) -> Pass:
    """Plan one pass at a suture point.

    Raises:
        BadPlan: From its start the goal is not reached.
        OutsideGrid: Its start is too far outside of its grid world.
    """
    grid = policy.path.grid
    goal = grid.centres_mm(policy.path.goal) if recorded is None else recorded.trace.ends_mm[1]
    turned = kinematics.matrix_of(np.array([point.rotation_xyzw]))[0]
    last = recorded.last_rotation if recorded is not None and recorded.turning else None
    # offsets from a given place to the tip, which is the hinge
    at_start, at_end = (
        -plan.tip_offset_mm * product(turned, one)[:, 2] for one in (jaw, jaw if last is None else last)
    )
    place = frozen(point.position_mm, np.float64, (3,), "position_mm") + at_end
    # `grid`, `goal` and `begin` are in the frame of the learnt grid; `place` and `start` are in the arm's frame.
    begin = grid.centres_mm(policy.path.start) if recorded is None else recorded.trace.ends_mm[0]
    start = product(turned, begin - goal) + place
    if start_mm is not None:
        start = frozen(start_mm, np.float64, (3,), "start") + at_start
        begin = _entered(grid, product(turned.T, start - place) + goal, number)
    followed = rollout(policy, begin)
    if not followed.finished:
        raise BadPlan(f"From its start pass {number} does not reach the goal.", **{"pass": number})
    hand, held = None, product(turned, jaw)
    if recorded is None:
        path = followed.tip_mm
    else:
        fit = fit_to_demo(followed, recorded.trace, None if start_mm is None else begin)
        path = fit.tip_mm
        hand = moved(hand_along(recorded.demo, fit, turning=recorded.turning), turned, goal, place)
        if hand.rotation_xyzw is not None:
            held = kinematics.matrix_of(hand.rotation_xyzw[:1])[0]
    if np.abs(path[0] - begin).max() > NEGLIGIBLE_MM:
        path = np.concatenate((begin[None], path))
    one = Pass(
        tip_mm=product(path - goal, turned.T) + place,
        rotation=held,
        start_mm=start,
        hand=hand,
        point=point,
        states=followed.states,
    )
    return _with_a2(one, plan, recorded, goal, turned)


def _with_a2(one: Pass, plan: SuturePlan, recorded: _Recorded | None, goal_mm: Floats, turned: Floats) -> Pass:
    """Add the end of A2 to a pass: the recorded hand-off, moved with the pass, or that of the paper."""
    psm_m = plan.psm_m
    if psm_m is None:
        return one
    brought = one.last_rotation
    if plan.a2 == "paper":
        return replace(one, target_rotation=realign(brought, psm_m.approach).rotation)
    assert recorded is not None and recorded.last_rotation is not None
    assert psm_m.taken_mm is not None and psm_m.taken_xyzw is not None
    target = brought if recorded.turning else product(turned, recorded.last_rotation)
    taken_mm = product(turned, np.array(psm_m.taken_mm) - goal_mm) + one.tip_mm[-1]
    return replace(
        one, target_rotation=target, taking=Pose(taken_mm, product(turned, kinematics.matrix_of([psm_m.taken_xyzw])[0]))
    )


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
    return None if rotation_xyzw is None else kinematics.matrix_of(rotation_xyzw[:1])[0]


def turn_deg(one: Pass) -> float:
    """Return the greatest angle between the jaw's rotation in A1 and that at its start, degrees.

    Args:
        one: The pass; the result is 0 if its jaw is held.
    """
    if one.hand is None or one.hand.rotation_xyzw is None:
        return 0.0
    turned = kinematics.matrix_of(one.hand.rotation_xyzw)
    return float(np.degrees(kinematics.angle_between(turned, np.broadcast_to(turned[0], turned.shape))).max())


def pose_xyzw(rotation: Floats) -> tuple[float, float, float, float]:
    """Return one rotation as a quaternion x, y, z, w.

    Args:
        rotation: The rotation, shape (3, 3).
    """
    return xyzw(kinematics.quaternion_of(rotation[None])[0])


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
        orientation: As in `SuturePlan`.
    """

    path: PathKind
    frame: str
    samples: Count
    beyond: Count
    nearest_limit: kinematics.NearestLimit
    cell_centres_beyond: Count
    orientation: Orientation


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
    (way,) = lay_out(plan.passes, None)
    line, rotation = _driven(way, only.rotation)
    nearest, beyond = kinematics.nearest_limit(line, rotation, demo.instrument)
    return DrivenPass(
        path=plan.path,
        frame=demo.frame,
        samples=len(line),
        beyond=beyond,
        nearest_limit=nearest,
        cell_centres_beyond=int(
            np.count_nonzero(~kinematics.reachable(policy.path.tip_mm, only.rotation, demo.instrument))
        ),
        orientation=plan.orientation,
    )


def _driven(way: Route, held: Floats) -> tuple[Floats, Floats]:
    """Return the places of A1, (N, 3) mm, and the jaw's rotation there: (N, 3, 3), or the (3, 3) that is held."""
    if way.hand is None:
        return followed(way.line, STEP_MM)[0], held
    # as densely as a plan at the surgeon's own tempo, also where the jaw turns and the tip rests
    tip, rotation, _ = way.hand.at(2 + int(max(way.hand.length_mm / STEP_MM, way.hand.duration_s * RATE_HZ[1])))
    return tip, held if rotation is None else rotation


def _at_its_own_place(policy: Policy, demo: Demo) -> SuturePlan:
    """Plan one pass at the demonstrated place, along the fitted path if one can be fitted."""

    def pass_along(recorded: Demo | None) -> SuturePlan:
        """Return the plan of one pass, fitted to a recording or through the centres of the cells."""
        goal_mm = policy.path.tip_mm[-1] if recorded is None else ends_of(recorded, policy.path)[1]
        x, y, z = goal_mm.tolist()
        return stack(
            policy,
            [SuturePoint((x, y, z))],
            arm=demo.arm,
            frame=demo.frame,
            instrument=demo.instrument,
            rotation=rotation_of(demo.rotation_xyzw) if recorded is None else None,
            demo=recorded,
        )

    try:
        return pass_along(demo)
    # Either the path was not made from these samples, and cell centres are the fallback; or the goal is not reached,
    # and then the second call fails for the same reason.
    except BadPlan:
        return pass_along(None)
