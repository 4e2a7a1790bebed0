"""Reach: where a pass can be planned, for many positions and rotations at once, in closed form.

    SuturePlan with a pass for each rotation, positions --map_reach--> Reach: a `ReachPlace` for each of both

A pass at another suture point of the same rotation is the same motion moved in a straight line: so its poses are
computed once for each rotation, and its joints, distances and margins for all positions together. A place is one of

    yes        a plan of this pass alone is within the limits of the joints, and everything keeps its distance
    no         it is not
    in doubt   it is so near to a limit that this cannot say, or a joint leaps: make the plan and play it

*Between poses.* A joint is taken to go beyond its value at a pose by no more than to the next one, and a distance to be
smaller than at both poses by no more than half of the way between them. A verdict's own lower bounds are smaller than
the distances, too: by half of the step at which it looks (`skills.verification.scene_clearance`). `yes` is on the safe
side of all of this, `no` on the other side.

*Not judged.* Several passes in one plan need transfers between them; a start of one's own; how often a pass succeeds
with inexact arms; and a speed above the default. A NaN is never `yes`. All of this is ours.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import isfinite, pi
from typing import Literal

import numpy as np

from skills import kinematics
from skills.arrays import Flags, Floats, Ints, xyz
from skills.errors import BadPlan
from skills.fields import Figure, Point, Quaternion, schema
from skills.planning.handoff import HOLDING_RAD, OtherArm
from skills.planning.motion_laws import Poses
from skills.planning.passes import HINGE_REVERSED
from skills.planning.plan import Pass, SuturePlan
from skills.planning.trajectory import PSM_A, PSM_M, PassPoses, Trajectory, poses_along
from skills.verification import clearance
from skills.verification.bodies import distances_at, moved_mm
from skills.verification.gates import Limits
from skills.verification.scene_clearance import LOOK_MM, TISSUE, from_parts, groups_of, limit_of, needle_from_parts

MAX_PLACES = 1000
STEP_MM = 1.0  # ours: of both tips together, or two degrees of a jaw
TICK = 0.2  # of that, and more than a plan moves from one sample to the next at its default speed and rate
SPARSE = (8, 2, 1)  # distances are computed at every so many poses, then at more where that does not decide
LEAP_RAD, LEAP_MM = 0.5, 20.0  # ours: a joint that moves further from one pose to the next goes by another way
BEYOND = 0.01  # of a joint's range: further beyond its limit than between two samples of a plan
AT_ONCE = 4000  # poses

Answer = Literal["yes", "no", "in doubt"]


@schema
@dataclass(frozen=True)
class ReachPlace:
    """One suture point with a rotation.

    Attributes:
        position_mm: The suture point.
        rotation_xyzw: The rotation of the grid world about it.
        reach: Whether a plan of this pass alone is possible.
        limited_by: What refuses it or leaves it in doubt: a joint, "bodies", "tools", "scene" or "needle"; null where
            it is reached.
        turn_margin_deg: Least distance of a rotary joint of either arm from its limit, negative beyond it.
        insertion_margin_mm: The same of the insertion; also from where the wrist is in the cannula.
        bodies_mm: Least distance of the arms' outer bodies from each other; null: one arm, or not computed, because a
            joint is beyond its limits.
        tools_mm: Least distance of the two tools from each other; null likewise.
        scene_mm: Least distance of both arms from tissue and obstacles; null likewise, and without a scene.
        needle_mm: Least distance of the needle from the tissue, negative inside; null likewise, and without tissue.
    """

    position_mm: Point
    rotation_xyzw: Quaternion
    reach: Answer
    limited_by: str | None
    turn_margin_deg: Figure
    insertion_margin_mm: Figure
    bodies_mm: Figure
    tools_mm: Figure
    scene_mm: Figure
    needle_mm: Figure


def map_reach(plan: SuturePlan, positions_mm: Floats) -> list[ReachPlace]:
    """Return where each pass of a plan could be planned by itself.

    Args:
        plan: A plan with one pass for each rotation, all at one suture point.
        positions_mm: Suture points in the arm's frame, shape (P, 3).

    Returns:
        The places of the first pass's rotation in the order of the positions, then those of the second, and so on.

    Raises:
        BadPlan: There are too many places, or none.
    """
    count = len(plan.passes) * len(positions_mm)
    if not 1 <= count <= MAX_PLACES:
        raise BadPlan(f"A map must have 1 to {MAX_PLACES} places: positions times rotations.", places=count)
    found: list[ReachPlace] = []
    for one in plan.passes:
        found += _Moved(plan, one, poses_along(one, plan.psm_m, STEP_MM), positions_mm).places()
    return found


@dataclass(frozen=True, eq=False)
class _Check:
    """One check at some positions, (N,): its name, which pass surely, which fail surely, and its least figure."""

    name: str
    yes: Flags
    no: Flags
    figure: str
    least: Floats


class _Moved:
    """One pass at P positions: the joints of both arms in S poses each, and what limits them."""

    def __init__(self, plan: SuturePlan, one: Pass, poses: PassPoses, positions_mm: Floats) -> None:
        self.plan, self.one, self.poses, self.positions, self.limits = plan, one, poses, positions_mm, Limits()
        by, count = positions_mm - np.array(one.point.position_mm), len(positions_mm)
        self.yes, self.no = np.ones(count, bool), np.zeros(count, bool)
        self.because: list[str | None] = [None] * count
        self.figures = {f"{name}_mm": np.full(count, np.nan) for name in ("bodies", "tools", "scene", "needle")}
        self.figures |= {name: np.full(count, np.inf) for name in ("turn_margin_deg", "insertion_margin_mm")}
        self.joints = self._solved(poses.arms[0], by, PSM_A, plan.instrument)
        self.other, psm_m = None, plan.psm_m
        if len(poses.arms) == 2 and psm_m is not None:
            base = kinematics.matrix_of(np.array([psm_m.base_xyzw]))[0]
            seen = Poses((poses.arms[1].tip_mm - np.array(psm_m.base_mm)) @ base, base.T @ poses.arms[1].rotation)
            either = [
                self._solved(way, by @ base, PSM_M, psm_m.instrument)
                for way in (seen, Poses(seen.tip_mm, seen.rotation @ HINGE_REVERSED))
            ]
            rolls = [np.abs(q[:, :, kinematics.ROLL]).max(axis=1) for q in either]
            self.other = np.where((rolls[0] <= rolls[1])[:, None, None], *either)

    def places(self) -> list[ReachPlace]:
        """Return the answers at all positions."""
        rows = np.flatnonzero(~self.no)
        for every in SPARSE:
            vague = [self._compare(some, every) for some in self._portions(rows)]
            rows = np.concatenate([np.empty(0, np.int64), *vague])
        answers = np.where(self.no, "no", np.where(self.yes, "yes", "in doubt")).tolist()
        found, turned = [], self.one.point.rotation_xyzw
        for k, position in enumerate(self.positions):
            figures = {name: float(one[k]) if isfinite(one[k]) else None for name, one in self.figures.items()}
            found.append(ReachPlace(xyz(position), turned, answers[k], self.because[k], **figures))
        return found

    # ---- joints ----------------------------------------------------------------------------------------------------

    def _solved(self, poses: Poses, by_mm: Floats, arm: str, instrument: str) -> Floats:
        """Return the joints at all positions, (P, S, 6), after comparing them with their limits."""
        tool = kinematics.instrument_of(instrument)
        q, beyond = _joints(poses, by_mm, tool)
        steps = np.abs(np.diff(q, axis=1))
        step = np.concatenate([steps[:, :1], np.maximum(steps[:, :-1], steps[:, 1:]), steps[:, -1:]], axis=1)
        step = np.concatenate([step[:, :1], np.maximum(step[:, :-1], step[:, 1:])], axis=1)
        step[:, :-1] = np.maximum(step[:, :-1], step[:, 1:])
        lower = tool.lower.copy()
        lower[kinematics.INSERTION] = max(
            lower[kinematics.INSERTION], self.limits.insertion_mm + tool.cannula_mm - kinematics.CANNULA_MM
        )
        margin = np.minimum(q - lower, tool.upper - q)
        furthest = np.where(np.arange(6) == kinematics.INSERTION, LEAP_MM, LEAP_RAD)
        smooth: Flags = np.all(steps <= furthest, axis=1)
        for joint, name in enumerate(kinematics.JOINTS):
            mine, spare = margin[:, :, joint], step[:, :, joint]
            no = ~(mine + np.where(beyond[:, None], 0.0, spare) >= 0).all(axis=1) & (smooth[:, joint] | beyond)
            yes = (mine - spare >= 0).all(axis=1) & smooth[:, joint]
            turns = joint != kinematics.INSERTION
            figure, unit = ("turn_margin_deg", 180 / pi) if turns else ("insertion_margin_mm", 1.0)
            least = np.minimum(self.figures[figure], mine.min(axis=1) * unit)
            self._judge(np.arange(len(q)), _Check(f"{arm}'s {name}", yes, no, figure, least))
        self.no |= beyond
        return q

    def _judge(self, rows: Ints, check: _Check) -> None:
        """Add the answers of one check at some positions."""
        for row, yes, no in zip(rows.tolist(), check.yes.tolist(), check.no.tolist(), strict=True):
            if not yes and (self.because[row] is None or (no and not self.no[row])):
                self.because[row] = check.name
        self.yes[rows] &= check.yes
        self.no[rows] |= check.no
        self.figures[check.figure][rows] = check.least

    # ---- distances -------------------------------------------------------------------------------------------------

    def _portions(self, rows: Ints) -> list[Ints]:
        """Divide positions into parts that are computed at once."""
        most = max(1, AT_ONCE // len(self.poses.phase))
        return [rows[k : k + most] for k in range(0, len(rows), most)]

    def _compare(self, rows: Ints, every: int) -> Ints:
        """Judge the distances at some positions; return those that more poses have to decide."""
        samples = len(self.poses.phase)
        looks = np.union1d(np.arange(0, samples, every), [samples - 1])
        checks = list(self._checks(self._motion(rows), _Looks(len(rows), samples, looks)))
        vague = np.zeros(len(rows), bool)
        if every > 1:
            vague = np.any([~one.yes & ~one.no for one in checks], axis=0) if checks else vague
            vague &= ~np.any([one.no for one in checks], axis=0) if checks else vague
        for one in checks:
            sure = replace(one, yes=one.yes[~vague], no=one.no[~vague], least=one.least[~vague])
            self._judge(rows[~vague], sure)
        return rows[vague]

    def _motion(self, rows: Ints) -> Trajectory:
        """Return the pass at some positions as one trajectory, a pass for each; it leaps from one to the next."""
        count, samples = len(rows), len(self.poses.phase)
        arm, psm_m, jaw = self.poses.arms[0], self.plan.psm_m, self.poses.jaw_rad
        by = self.positions[rows] - np.array(self.one.point.position_mm)
        other = None
        if self.other is not None and psm_m is not None:
            base_mm, base_xyzw = np.array(psm_m.base_mm), np.array(psm_m.base_xyzw)
            base_xyzw = base_xyzw / np.linalg.norm(base_xyzw)
            other = OtherArm(base_mm, base_xyzw, psm_m.instrument, self.other[rows].reshape(-1, 6))
        return Trajectory(
            rate_hz=self.plan.rate_hz,
            instrument=self.plan.instrument,
            stamps_s=np.arange(count * samples, dtype=np.float64),
            tip_mm=(arm.tip_mm + by[:, None]).reshape(-1, 3),
            rotation_xyzw=np.tile(kinematics.quaternion_of(arm.rotation), (count, 1)),
            joints=self.joints[rows].reshape(-1, 6),
            pass_index=np.repeat(np.arange(count), samples),
            phase=np.tile(self.poses.phase, count),
            speed_mm_s=self.plan.speed_mm_s,
            turn_rad_s=0.0,
            speed_ratio=0.0,
            acceleration_ratio=0.0,
            deviation_mm=0.0,
            psm_m=other,
            jaw_rad=None if jaw is None else np.tile(jaw, count),
        )

    def _checks(self, motion: Trajectory, looks: "_Looks") -> Iterator[_Check]:
        """Yield the checks of distances at some positions and poses."""
        scene, arms = self.plan.scene, motion.arms
        if len(arms) == 2:
            ways = [moved_mm(arm.joints, np.roll(arm.joints, -1, axis=0), arm.instrument) for arm in arms]
            apart = distances_at(motion, looks.rows)
            yield looks.check("bodies", apart, looks.of_both(ways), self.limits.clearance_bodies_mm)
            links = [
                clearance.links_of(arm.joints[looks.rows], arm.instrument).seen_from(arm.base, arm.base_mm)
                for arm in arms
            ]
            apart = clearance.clearance_between(*links)
            apart[:, clearance.FINGERS] -= clearance.FINGER_REACH_MM * (
                clearance.openings(arms[0])[looks.rows, None, None] - HOLDING_RAD
            )
            looks.per_place(apart)[:, -1, clearance.FINGERS, clearance.FINGERS] = np.inf  # the needle changes hands
            ways = [_with_last(clearance.travel_mm(arm.joints, arm.instrument)) for arm in arms]
            yield looks.check("tools", apart, looks.of_both(ways), self.limits.clearance_psm_m_mm)
        if scene is None:
            return
        needle = needle_from_parts(motion, scene, looks.rows)
        needle_way = looks.split(_with_last(clearance.needle_travel_mm(motion)[:, None]))
        found = [
            looks.check("scene", apart, needle_way, limit_of(scene), LOOK_MM / 2)
            for part, apart in needle.items()
            if part != TISSUE
        ]
        for arm, group in groups_of(motion):
            way = looks.split(_with_last(np.diff(group.way_mm, axis=0)))
            found += [
                looks.check("scene", apart, way, limit_of(scene), group.look_mm / 2)
                for apart in from_parts(group, scene, arm.name, looks.rows).values()
            ]
        if found:
            yield _Check(
                "scene",
                np.all([one.yes for one in found], axis=0),
                np.any([one.no for one in found], axis=0),
                "scene_mm",
                np.min([one.least for one in found], axis=0),
            )
        if scene.tissue is not None:
            apart = needle[TISSUE]
            check = looks.check("needle", apart, needle_way, 0.0, LOOK_MM / 2)
            # One that begins in the tissue comes out first, by hand; until when, a few poses do not tell.
            begins = looks.per_place(apart)[:, 0, 0]
            yield replace(check, no=check.no & (begins >= 0))


class _Looks:
    """Some of the S poses of N positions, in one trajectory of all: what distances there say of those in between."""

    def __init__(self, count: int, samples: int, looks: Ints) -> None:
        self.count, self.samples, self.looks = count, samples, looks
        self.rows = (np.arange(count)[:, None] * samples + looks).ravel()

    def per_place(self, values: Floats) -> Floats:
        """Return values of all looks, (N * L, ...), by place, (N, L, ...)."""
        return values.reshape(self.count, len(self.looks), *values.shape[1:])

    def split(self, steps: Floats) -> Floats:
        """Return the ways from each pose to the next, (N * S, B), by place, (N, S - 1, B)."""
        return steps.reshape(self.count, self.samples, -1)[:, :-1]

    def of_both(self, steps: list[Floats]) -> Floats:
        """Return how far each part of one arm and each of the other can approach, (N, S - 1, B, B')."""
        one, other = map(self.split, steps)
        return one[:, :, :, None] + other[:, :, None]

    def check(self, name: str, apart: Floats, way: Floats, limit_mm: float, look_mm: float = 0.0) -> _Check:
        """Compare distances with a limit.

        Args:
            name: Of the check.
            apart: Distances at all looks, (N * L, ...).
            way: How far things approach at most from each pose to the next, (N, S - 1, ...).
            limit_mm: The distance to keep.
            look_mm: How far a verdict's own bound may be below the distance; by the way of one sample otherwise.
        """
        seen = self.per_place(apart)
        gone = np.concatenate([np.zeros_like(way[:, :1]), np.cumsum(way, axis=1)], axis=1)[:, self.looks]
        axes = tuple(range(1, seen.ndim))
        least = seen.min(axis=axes)
        lower = ((seen[:, :-1] + seen[:, 1:] - np.diff(gone, axis=1)) / 2).min(axis=axes)
        slack = np.maximum(look_mm, TICK * way.max(axis=axes))
        yes, no = np.minimum(lower, least) - slack >= limit_mm, ~(least + slack >= limit_mm)
        return _Check(name, yes, no, f"{name}_mm", least)


def _with_last(steps: Floats) -> Floats:
    """Return steps, (T - 1, B), with one more row, so that there is one for each sample."""
    return np.concatenate([steps, np.zeros_like(steps[:1])])


def _joints(poses: Poses, by_mm: Floats, tool: kinematics.InstrumentConstants) -> tuple[Floats, Flags]:
    """Solve S poses moved to P places as `skills.planning.passes.solve` does.

    Returns:
        Joints, (P, S, 6); where no solution is within the limits, the one that stays nearest to them. And where one of
        them is beyond its limits by more than `BEYOND` of its range, or there are no joints at all, (P,).
    """
    count, samples = len(by_mm), len(poses)
    tip = (poses.tip_mm + by_mm[:, None]).reshape(-1, 3)
    rotation = np.broadcast_to(poses.rotation, (count, samples, 3, 3)).reshape(-1, 3, 3)
    solutions = kinematics.solutions_of(tip, rotation, tool).reshape(count, samples, 6, 6)
    parts = np.minimum(solutions - tool.lower, tool.upper - solutions) / (tool.upper - tool.lower)
    worst = np.nan_to_num(parts.min(axis=3), nan=-np.inf)
    allowed = worst >= -1e-9
    before, every = np.zeros((count, 6)), np.arange(count)
    chosen = np.empty((count, samples, 6))
    for sample in range(samples):
        here = solutions[:, sample]
        way = (np.abs(here - before[:, None]) / tool.speed).sum(axis=2)
        way = np.where(allowed[:, sample], way, np.inf)
        reached = allowed[:, sample].any(axis=1)
        best = np.where(reached, way.argmin(axis=1), worst[:, sample].argmax(axis=1))
        before = chosen[:, sample] = here[every, best]
    roll = np.unwrap(chosen[:, :, kinematics.ROLL], axis=1)
    middle = (roll.max(axis=1) + roll.min(axis=1)) / (4 * pi)
    chosen[:, :, kinematics.ROLL] = roll - 2 * pi * np.round(middle)[:, None]
    return chosen, ~(worst.max(axis=2) >= -BEYOND).all(axis=1)
