"""One pass of a played motion compared with what was requested of it; see `skills.verification.intent`.

RequestedMotion, PlayedMotion --PassComparison.compare--> the pass's part of Deviations
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import ceil, nan

import numpy as np

from skills.arrays import Flags, Floats, Ints
from skills.demonstration.movement import lengths_along
from skills.kinematics import instrument_of, matrix_of
from skills.learning.policy import rollout
from skills.planning.handoff import HELD_MM, JAW_CLOSED_RAD, JAW_OPEN_RAD, JAW_S, NEEDLE_RADIUS_MM, TAKEN_MM
from skills.planning.motion_laws import A1, A2, TRANSFER, Poses
from skills.planning.passes import STAND_OFF_MM
from skills.planning.trajectory import Trajectory, stands_from
from skills.verification.deviations import LIMITS, Deviations
from skills.verification.recorded_hand import REST_S, RecordedHand
from skills.verification.requested import RequestedMotion

STILL = 0.002  # of the greatest speed of a pass: an arm below it stands
STAND_S = 0.25  # ours: so long it may, where the hand did not: more than a stroke needs to turn round
BETWEEN_SHARE = 0.025  # of a phase: at both ends a minimum-jerk move is below `STILL` of its peak for 0.0113 of it
CELL_STEP = 0.1  # of a cell: between two places whose cells are compared
_LEAST_MM = 1e-4  # of a step: below it a pass has no greatest speed
_PAIRS = (("PSM_A", "PSM_M"), ("PSM_M", "PSM_A"))
_FLIPPED = np.diag([-1.0, -1.0, 1.0])  # jaws are symmetric about their approach


def _apart_deg(rotation: Floats, other: Floats) -> Floats:
    """Return the angles between rotations, (T, 3, 3), in degrees, (T,), by their chord; NaN where one is NaN."""
    chord = np.sqrt(((rotation - other) ** 2).sum(axis=(-2, -1)))
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(chord / np.sqrt(8.0), 1.0))))


def _off_line_mm(tip_mm: Floats, line: Floats) -> Floats:
    """Return how far places in order, (T, 3), are from a polyline, (K, 3), or how far they went back along it, (T,)."""
    begin, along = line[:-1], np.diff(line, axis=0)
    lengths = np.linalg.norm(along, axis=1)
    part = ((tip_mm[:, None] - begin) * along).sum(axis=2) / np.maximum(lengths**2, 1e-12)
    part = part.clip(0.0, 1.0)
    off = np.linalg.norm(tip_mm[:, None] - begin - part[..., None] * along, axis=2)
    nearest = off.min(axis=1)
    near, reached = off <= nearest[:, None] + 0.05, np.append(0.0, np.cumsum(lengths)[:-1]) + part * lengths
    gone = lengths_along(tip_mm)
    # Where the line crosses itself the first place counts at the beginning, and then the last one, so that going on is
    # never taken for going back.
    begun, come = np.where(near, reached, np.inf)[0].min(), np.where(near, reached, -np.inf).max(axis=1)
    return np.asarray(np.maximum(nearest, gone + begun - come))


def _shorter_deg(rotation: Floats, begin: Floats, end: Floats) -> Floats:
    """Return by how much turning from one rotation to another by way of others, (T, 3, 3), is the longer way."""
    by_way = _apart_deg(rotation, begin) + _apart_deg(rotation, end)
    return np.asarray(by_way - _apart_deg(end, begin))


@dataclass(frozen=True, eq=False)
class PlayedMotion:
    """A motion as it was played: its trajectory, and the poses of PSM_A and of PSM_M in PSM_A's base frame."""

    trajectory: Trajectory
    arm: Poses
    other: Poses | None


class PassComparison:
    """One pass of a motion beside what was requested of it; each method adds the deviations of one part."""

    def __init__(
        self,
        request: RequestedMotion,
        played: PlayedMotion,
        number: int,
        before: "PassComparison | None",
        found: Deviations,
    ) -> None:
        self.motion = motion = played.trajectory
        self.request, self.before, self.put = request, before, found.add
        self.arm, self.other, self.rate_hz = played.arm, played.other, motion.rate_hz
        mine = motion.pass_index == number
        self.rows = np.flatnonzero(mine)
        self.transfer, self.a1, self.a2 = (
            np.flatnonzero(mine & (motion.phase == phase)) for phase in (TRANSFER, A1, A2)
        )
        self.tempo = nan if motion.tempo is None or not 0 < motion.tempo <= 1 else motion.tempo
        point = request.points[number]
        self.turned = matrix_of(np.array([point.rotation_xyzw]))[0]
        self.last_rotation = self.turned @ request.last_rotation
        self.first_rotation = self.last_rotation  # unless the jaw turns
        self.place_mm = np.array(point.position_mm) - request.tip_offset_mm * self.last_rotation[:, 2]
        self.start_mm = request.starts_mm[number]
        self.begin_mm = self._entered()

    def _entered(self) -> Floats:
        """Return where A1 begins: at the start, or else at the nearest place between the outermost cells' centres."""
        grid = self.request.policy.path.grid
        start = self.in_grid(self.start_mm)
        if np.all(grid.holds(grid.cells_at(start))):
            return np.asarray(self.start_mm)
        low, high = grid.centres_of(np.zeros(3)), grid.centres_of(np.array(grid.shape) - 1)
        return self.in_arm(np.minimum(np.maximum(start, low), high))

    def in_grid(self, tip_mm: Floats) -> Floats:
        """Return places of the arm's frame in the learnt grid, both of shape (..., 3)."""
        return np.asarray((tip_mm - self.place_mm) @ self.turned + self.request.goal_mm)

    def in_arm(self, place_mm: Floats) -> Floats:
        """Return places of the learnt grid in the arm's frame, both of shape (..., 3)."""
        return np.asarray((place_mm - self.request.goal_mm) @ self.turned.T + self.place_mm)

    def compare(self) -> None:
        """Add all deviations of the pass."""
        if not len(self.a1) or (self.request.psm_m is not None) != (len(self.a2) > 0):
            self.put("number of passes off the suture points", self.rows[:1], nan)  # a phase is missing or too many
            return
        first, last = self.a1[:1], self.a1[-1:]
        self.put("start of A1 off the asked one", first, _far_mm(self.arm.tip_mm[first], self.begin_mm))
        offset_mm = self.request.tip_offset_mm * self.arm.rotation[last][:, :, 2]
        point_mm = self.place_mm + self.request.tip_offset_mm * self.last_rotation[:, 2]
        self.put("end of A1 off the suture point", last, _far_mm(self.arm.tip_mm[last] + offset_mm, point_mm))
        self.put("jaw off its stated rotation", last, _apart_deg(self.arm.rotation[last], self.last_rotation))
        self._speeds()
        followed = self._cells()
        if self.request.hand is None:
            self.put("jaw off its stated rotation", self.a1, _apart_deg(self.arm.rotation[self.a1], self.last_rotation))
            self._stands(np.full(len(self.a1), STAND_S))
        else:
            self._recording(followed, self.request.hand)
        if len(self.a2):
            self._a2()
        self._transfer()

    # ---- A1 --------------------------------------------------------------------------------------------------------

    def _speeds(self) -> None:
        """Compare the speeds of both tips with the greatest that was asked."""
        for arm in (self.arm, self.other):
            if arm is not None and self.request.demo is not None:
                speed = np.linalg.norm(np.diff(arm.tip_mm[self.rows], axis=0), axis=1) * self.rate_hz
                self.put("speed of the tip", self.rows[:-1], speed / self.request.speed_mm_s)

    def _cells(self) -> Ints:
        """Compare A1 with the cells of the rollout in their order, and return the rollout's states."""
        grid = self.request.policy.path.grid
        gone = rollout(self.request.policy, self.in_grid(self.begin_mm))
        places = self.in_grid(self.arm.tip_mm[self.a1])
        off, sound = np.full(len(places), nan), np.isfinite(places).all(axis=1)
        if gone.finished and sound.any():
            in_cells, reach = (places[sound] - grid.origin_mm) / grid.cell_mm, 0.5 + self.request.policy.path.hysteresis
            off[sound] = _off_cells(in_cells, grid.cells_of(gone.states), reach)
        self.put("path off the policy's cells", self.a1, off)
        return gone.states

    def _recording(self, states: Ints, hand: RecordedHand) -> None:
        """Compare A1 with the recording, from where it is followed."""
        a1, cell_mm = self.a1, self.request.policy.path.grid.cell_mm
        passed_s = self.motion.stamps_s[a1] - self.motion.stamps_s[a1[0]]
        clock_s, joined_s, firm_s = self._clock(states, passed_s)
        at, firm = hand.index(clock_s), ~(clock_s < firm_s)
        off_mm = _far_mm(self.in_grid(self.arm.tip_mm[a1]), hand.tip_mm[at]) - hand.tip_spread_mm[at]
        self.put("path off the recording", a1, np.where(firm, np.maximum(off_mm, 0.0) / cell_mm, 0.0))
        joining = hand.between(joined_s, firm_s)
        if self.request.turning:
            self._turning(hand, at, firm, joining)
        else:
            self.put("jaw off its stated rotation", a1, _apart_deg(self.arm.rotation[a1], self.last_rotation))
        self._opening(hand, at, firm, joining)
        slow_s = np.where(clock_s >= joined_s, (hand.calm_s if self.request.turning else hand.slow_s)[at], 0.0)
        rests_s = np.where(np.minimum(passed_s, passed_s[-1] - passed_s) < REST_S / self.tempo, 2 * REST_S, 0.0)
        self._stands(STAND_S + (slow_s + rests_s) / self.tempo)

    def _clock(self, states: Ints, passed_s: Floats) -> tuple[Floats, float, float]:
        """Return the demonstration's time at each sample of A1, and from when on it is followed, and has to be.

        A pass from the demonstrated start goes by the clock from its beginning on, and any other by that of its end.
        """
        kind, demo = "clock of A1 off the recording's", self.request.demo
        assert demo is not None
        self.put(kind, self.a1[:1], 0.0 * self.tempo)  # NaN without a tempo
        end_s, (joined_s, firm_s) = float(demo.stamps_s[-1]) + REST_S, self.request.joined_s(states)
        if joined_s > 0 or not _far_mm(self.start_mm, self.in_arm(self.request.first_mm)) < 0.01:
            return end_s - self.tempo * (passed_s[-1] - passed_s), joined_s, firm_s
        clock_s = self.tempo * passed_s - REST_S
        late_s = np.maximum(clock_s - end_s, 0.0)
        late_s[-1] = abs(clock_s[-1] - end_s)
        self.put(kind, self.a1, late_s)
        return clock_s, -np.inf, -np.inf

    def _turning(self, hand: RecordedHand, at: Ints, firm: Flags, joining: Ints) -> None:
        """Compare the jaw's rotation; before the recording is followed it is held as in one of the moments given."""
        recorded, spread_deg = hand.turned, hand.turned_spread_deg
        assert recorded is not None
        rotation = self.turned.T @ self.arm.rotation[self.a1]
        off = _apart_deg(rotation, recorded[at]) - spread_deg[at]
        off[~firm] = _nearest(lambda k: _apart_deg(rotation[~firm], recorded[k]) - spread_deg[k], joining)
        self.first_rotation = self.turned @ self.request.rotation if firm.all() else self.arm.rotation[self.a1[0]]
        self.put("jaw turned off the recording", self.a1, np.maximum(off, 0.0))

    def _opening(self, hand: RecordedHand, at: Ints, firm: Flags, joining: Ints) -> None:
        """Compare the jaw's opening: recorded in A1, as it was then in A2, and in between over a transfer."""
        opened, kind = self.motion.jaw_rad, "opening of the jaw off the recording"
        if opened is None or hand.opened is None:
            if (opened is None and hand.opened is not None) or (opened is not None and self.other is None):
                self.put(kind, self.a1[:1], nan)
            return
        recorded, spread, mine = hand.opened, hand.opened_spread, opened[self.a1]
        off = np.abs(mine - recorded[at]) - spread[at]
        off[~firm] = _nearest(lambda k: np.abs(mine[~firm] - recorded[k]) - spread[k], joining)
        self.put(kind, self.a1, np.maximum(off, 0.0))
        if self.other is not None:
            return  # the other phases are those of `_jaws`
        self.put(kind, self.a2, np.abs(opened[self.a2] - mine[-1]))
        if len(self.transfer):
            ends = np.array([opened[max(self.rows[0] - 1, 0)], mine[0]])
            between = opened[self.transfer]
            self.put(kind, self.transfer, np.maximum(between - ends.max(), ends.min() - between))

    def _stands(self, allowed_s: Floats) -> None:
        """Compare how long PSM_A stands in A1 with how long it may."""
        speed, rate = _rates(self.arm, self.a1)
        if speed.max(initial=0.0) < _LEAST_MM:
            return
        still = (speed <= STILL * speed.max()) & (rate <= STILL * rate.max())
        self.put("standing still", self.a1[:-1], _still_samples(still) / self.rate_hz / allowed_s[:-1])

    # ---- A2 and PSM_M ----------------------------------------------------------------------------------------------

    def _a2(self) -> None:
        """Compare A2: the tip held, the jaw's turn and its end, and PSM_M."""
        request, a2, end = self.request, self.a2, self.stood
        assert request.psm_m is not None
        self.put("tip leaves the hand-off", a2, _far_mm(self.arm.tip_mm[a2], self.place_mm))
        brought, turned = self.arm.rotation[self.a1[-1:]], self.arm.rotation[end]
        self.put("A2 leaves the shorter way", a2, _shorter_deg(self.arm.rotation[a2], brought, turned))
        if request.a2 == "recorded":
            recorded = None if request.demo is None else request.demo.rotation_xyzw
            seen = np.full((1, 3, 3), nan) if recorded is None else matrix_of(recorded[-1:])
            self.put("A2 off the recorded hand-off", end, _apart_deg(turned, self.turned @ seen))
        else:
            self._papers_a2(turned[0])
        self._between_stands(a2)
        if self.other is not None:
            self._psm_m()
            self._jaws()

    @cached_property
    def handed(self) -> Floats:
        """The jaw's [n o a] after the paper's A2, shape (3, 3): n along PSM_M's approach, by the smallest turn."""
        a_m = self.request.approach
        across = [column - a_m * (a_m @ column) for column in self.last_rotation.T[::-1]]  # of a, or else of o and n
        a = next(v for v in across if np.linalg.norm(v) >= 0.1)
        a = a / np.linalg.norm(a)
        return _nearer(self.last_rotation, np.stack([a_m, np.cross(a, a_m), a], axis=1))

    @cached_property
    def stood(self) -> Ints:
        """The first sample from which on both arms stand until the end of A2, shape (1,)."""
        return np.array([max(stands_from(self.motion, int(self.a2[-1])), int(self.a2[0]))])

    def _papers_a2(self, turned: Floats) -> None:
        """Compare the jaw, (3, 3), with the paper's hand-off."""
        end, n = self.stood, turned[:, 0]
        hinge = np.linalg.norm(np.cross(n, self.request.approach)), abs(n @ self.request.approach)
        self.put("A2's hinge off PSM_M's approach", end, np.degrees(np.arctan2(*hinge)))
        self.put("A2 off the paper's hand-off", end, _apart_deg(turned[None], self.handed))

    def taking(self) -> tuple[Floats, Floats]:
        """Return the pose in which PSM_M takes the needle in this pass, by the hand-off's definition."""
        request, psm_m = self.request, self.request.psm_m
        assert psm_m is not None
        if request.a2 == "recorded":
            taken_mm = np.full(3, nan) if psm_m.taken_mm is None else self.in_arm(np.array(psm_m.taken_mm))
            return taken_mm, self.turned @ matrix_of(np.array([psm_m.taken_xyzw]))[0]
        n, o, a = self.handed.T
        side = -np.sign(n @ request.approach)  # the needle's free end is on the side from which PSM_M comes
        quarter = self.place_mm + HELD_MM * a + NEEDLE_RADIUS_MM * side * (n + o)
        jaws = np.stack([o, np.cross(request.approach, o), request.approach], axis=1)
        return quarter - TAKEN_MM * request.approach, jaws

    def _psm_m(self) -> None:
        """Compare where PSM_M waits, how it comes and goes, and where it takes the needle."""
        other, a1, a2, end = self.other, self.a1, self.a2, self.stood
        assert other is not None and self.request.psm_m is not None
        taken_mm, jaws = self.taking()
        self.put("PSM_M off where it takes the needle", end, _far_mm(other.tip_mm[end], taken_mm))
        both = np.concatenate((a1, a2))
        turned = np.minimum(*(_apart_deg(other.rotation[both], one) for one in (jaws, jaws @ _FLIPPED)))
        self.put("PSM_M turned from how it takes the needle", both, turned)
        away_mm = taken_mm - STAND_OFF_MM * jaws[:, 2]
        waits_mm = taken_mm if self.request.psm_m.enters == "start" else away_mm
        self.put("PSM_M off where it waits", a1, _far_mm(other.tip_mm[a1], waits_mm))
        straight = "PSM_M off its straight way"
        self.put(straight, a2, _off_line_mm(other.tip_mm[a2], np.stack((waits_mm, taken_mm))))
        if self.before is None or not len(self.transfer):
            self.put("PSM_M off where it waits", self.transfer, _far_mm(other.tip_mm[self.transfer], waits_mm))
            return
        before_mm, before = self.before.taking()
        left_mm = before_mm - STAND_OFF_MM * before[:, 2]
        line = np.stack((before_mm, left_mm, away_mm, waits_mm))
        self.put(straight, self.transfer, _off_line_mm(other.tip_mm[self.transfer], line))
        left = np.maximum.accumulate(_far_mm(other.tip_mm[self.transfer], left_mm) <= 0.05)
        gone_mm = _far_mm(self.arm.tip_mm[self.transfer], self.arm.tip_mm[self.transfer[0] - 1])
        self.put("PSM_A leaves before PSM_M", self.transfer, np.where(left, 0.0, gone_mm))

    # ---- jaws ------------------------------------------------------------------------------------------------------

    def _jaws(self) -> None:
        """Compare the angles of both jaws with the order in which the needle changes hands."""
        motion, hand = self.motion, self.request.hand
        mine, theirs = motion.jaw_rad, None if motion.psm_m is None else motion.psm_m.jaw_rad
        changed, early, late = (
            "needle has not changed hands",
            *(f"{a}'s jaw opens before {b}'s holds" for a, b in _PAIRS),
        )
        if mine is None or theirs is None or motion.psm_m is None:
            self.put(changed, self.a2[-1:], nan)
            return
        for jaw, name in ((mine, motion.instrument), (theirs, motion.psm_m.instrument)):
            self._jaw_limits(jaw, name)
        a1, a2, transfer = self.a1, self.a2, self.transfer
        if hand is None or hand.opened is None:
            self.put(early, a1, np.abs(mine[a1] - JAW_CLOSED_RAD))
        begins, holds = mine[a1[0]], mine[a1[-1]]
        lets_go = max(JAW_OPEN_RAD, holds)
        # PSM_M comes in open, and closes while both stand
        moving = a2 < self.stood
        self.put("PSM_M's jaw not open as it comes in", a1, np.abs(theirs[a1] - JAW_OPEN_RAD))
        self.put("PSM_M's jaw not open as it comes in", a2[moving], np.abs(theirs[a2[moving]] - JAW_OPEN_RAD))
        closed = np.abs(theirs[a2] - JAW_CLOSED_RAD) <= LIMITS[early][1]
        self.put(early, a2, np.where(closed & ~moving, 0.0, np.abs(mine[a2] - holds)))
        self.put(changed, a2[-1:], max(abs(theirs[a2[-1]] - JAW_CLOSED_RAD), abs(mine[a2[-1]] - lets_go)))
        if not len(transfer):
            return
        if self.before is None:
            self.put(early, transfer, np.abs(mine[transfer] - begins))
            self.put("PSM_M's jaw not open as it comes in", transfer, np.abs(theirs[transfer] - JAW_OPEN_RAD))
            return
        # ... and keeps the needle until PSM_A stands at the beginning of A1 and has closed
        ends = np.append(transfer, a1[:1])
        moving = ends < stands_from(motion, int(a1[0]))
        was = mine[transfer[0] - 1]
        held = np.abs(mine[ends] - begins) <= LIMITS[late][1]
        self.put(late, ends, np.where(held & ~moving, 0.0, np.abs(theirs[ends] - JAW_CLOSED_RAD)))
        self.put("a jaw moves with an arm", ends[moving], np.abs(mine[ends[moving]] - was))

    def _jaw_limits(self, jaw_rad: Floats, instrument: str) -> None:
        """Compare a jaw's angle with its limits, and its speed with that of the motors of its two fingers."""
        tool, rows = instrument_of(instrument), self.rows
        low, high = tool.jaw_rad
        beyond = np.maximum(low - jaw_rad[rows], jaw_rad[rows] - high)
        self.put("a jaw beyond its limits", rows, np.maximum(beyond, 0.0))
        rate = np.abs(np.diff(jaw_rad[rows[0] : rows[-1] + 1], append=jaw_rad[rows[-1]])) / 2 * self.rate_hz
        self.put("speed of a jaw", rows, rate / tool.speed[-1])

    # ---- transfers -------------------------------------------------------------------------------------------------

    def _transfer(self) -> None:
        """Compare the start of the pass and the transfer to where A1 begins."""
        rows = self.transfer
        first = self.rows[:1]
        if self.before is None:
            self.put("start of the pass off the asked one", first, _far_mm(self.arm.tip_mm[first], self.start_mm))
        if not len(rows):
            return
        before_mm = self.start_mm if self.before is None else self.before.place_mm
        line = np.stack((before_mm, self.start_mm, self.begin_mm))
        self.put("PSM_A off the straight transfer", rows, _off_line_mm(self.arm.tip_mm[rows], line))
        begin = rows[0] if self.before is None else rows[0] - 1
        off = _shorter_deg(self.arm.rotation[rows], self.arm.rotation[[begin]], self.first_rotation)
        if self.other is not None:
            end = _nearer(self.other.rotation[self.a1[0]], self.taking()[1])
            off = np.maximum(off, _shorter_deg(self.other.rotation[rows], self.other.rotation[[begin]], end))
        self.put("transfer leaves the shorter way", rows, off)
        self._between_stands(rows)

    def _between_stands(self, rows: Ints) -> None:
        """Compare how long both arms stand in a transfer or A2 with what a minimum-jerk move needs at its ends."""
        # as parts of the greatest speeds, the moves of a phase have one peak, whichever arm and axis sets it
        active = np.zeros(len(rows) - 1)
        for arm in (self.arm, self.other):
            if arm is not None:
                speed, rate = _rates(arm, rows)
                # 45 degrees per second: the greatest rate of a jaw in A2 and transfers
                active = np.maximum(active, np.maximum(speed / self.request.speed_mm_s, rate / 45.0))
        allowed_s = STAND_S / 2 + BETWEEN_SHARE * len(rows) / self.rate_hz
        still = active <= STILL * active.max(initial=0.0)
        if self.other is not None:  # while both stand the needle changes hands
            begins = stands_from(self.motion, int(rows[-1]))
            still[(rows[:-1] >= begins) & (rows[:-1] < begins + 2 * ceil(JAW_S * self.rate_hz))] = False
        self.put("standing still", rows[:-1], _still_samples(still) / self.rate_hz / allowed_s)


def _far_mm(tip_mm: Floats, place_mm: Floats) -> Floats:
    """Return the distances of places, (..., 3), from one, (...,)."""
    return np.asarray(np.linalg.norm(tip_mm - place_mm, axis=-1))


def _nearer(rotation: Floats, jaws: Floats) -> Floats:
    """Return jaws, (3, 3), or the same with their hinge reversed, whichever are nearer to a rotation, (3, 3)."""
    either = [jaws, jaws @ _FLIPPED]
    return either[int(np.argmin([_apart_deg(rotation[None], one)[0] for one in either]))]


def _rates(arm: Poses, rows: Ints) -> tuple[Floats, Floats]:
    """Return the change of an arm's tip, mm, and of its jaw, degrees, from each of some samples to the next."""
    speed = np.linalg.norm(np.diff(arm.tip_mm[rows], axis=0), axis=1)
    return speed, _apart_deg(arm.rotation[rows[:-1]], arm.rotation[rows[1:]])


def _still_samples(still: Flags) -> Floats:
    """Return for each sample the number of samples that are still without a break up to it."""
    index = np.arange(1, len(still) + 1)
    return np.asarray(index - np.maximum.accumulate(np.where(still, 0, index)), np.float64)


def _nearest(off: Callable[[int], Floats], moments: Ints) -> Floats:
    """Return the least deviation from any of some moments."""
    return np.asarray(np.min([off(moment) for moment in moments.tolist()], axis=0))


def _off_cells(places: Floats, cells: Ints, reach: float) -> Floats:
    """Return how far places in order are outside of cells that are passed in order, as parts of a cell, shape (T,).

    A place may be in any cell that is reached from one of the place before by going on through cells that it is near
    to as well. If there is none it counts as far from the nearest of those of the place before.

    Args:
        places: In units of cells, shape (T, 3).
        cells: Shape (V, 3).
        reach: How far from its centre a cell reaches: half of it, and as far as hysteresis lets a recording leave it.
    """
    limit, number = LIMITS["path off the policy's cells"][1], np.arange(len(cells))
    moved = lengths_along(places)
    _, looked = np.unique((moved / CELL_STEP).astype(np.int64), return_index=True)
    looked = np.union1d(looked, [len(places) - 1])
    off = np.zeros(len(places))
    within = number == 0
    for sample in looked.tolist():
        away = np.linalg.norm(np.maximum(np.abs(places[sample] - cells) - reach, 0.0), axis=1)
        near = away <= limit
        seed = near & (within | np.append(False, within[:-1]))
        reached = near & (
            np.maximum.accumulate(np.where(seed, number, -1)) > np.maximum.accumulate(np.where(near, -1, number))
        )
        if reached.any():
            within = reached
        off[sample] = away[within].min()
    off[-1] = max(off[-1], float(len(cells) - 1 - np.flatnonzero(within)[-1]))
    return off
