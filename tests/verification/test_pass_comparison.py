"""One pass of a motion: every fault that is planted is named by its kind and its first sample."""

from dataclasses import replace

import numpy as np
import pytest

from skills.kinematics import instrument_of, quaternion_of
from skills.planning.handoff import JAW_CLOSED_RAD, JAW_OPEN_RAD, PsmM
from skills.planning.plan import SuturePoint, stack
from skills.planning.trajectory import A1, A2, TRANSFER, stands_from
from skills.verification.deviations import LIMITS
from skills.verification.intent import compare
from skills.verification.requested import RequestedMotion, requested_motion
from tests.planning.motions import PSM_M
from tests.planning.test_hand import turning
from tests.verification import faults
from tests.verification.hands import BASE_MM, BASE_XYZW, about

PATH = "path off the recording"


def goal_off(motion: faults.Motion) -> int:
    a1 = motion.rows(A1)
    faults.shift(motion, a1[-150:], faults.rising(150)[:, None] * 10 * faults.X)
    faults.shift(motion, motion.rows(A2), 10 * faults.X)
    return a1[-150]


def goal_a_little_off(motion: faults.Motion) -> int:
    a1 = motion.rows(A1)
    faults.shift(motion, a1[-100:], faults.rising(100)[:, None] * faults.Y)
    faults.shift(motion, motion.rows(A2), faults.Y)
    return a1[-1]


def start_off(motion: faults.Motion) -> int:
    a1 = motion.rows(A1, 0)
    faults.shift(motion, a1[:150], (1 - faults.rising(150))[:, None] * 10 * faults.Z)
    return a1[0]


def reversed_motion(motion: faults.Motion) -> int:
    a1 = motion.rows(A1, 0)
    motion.tip[a1], motion.turned[a1] = motion.tip[a1[::-1]], motion.turned[a1[::-1]]
    return a1[0]


def stalls_late(motion: faults.Motion) -> int:
    """A pass from a start of its own is judged by the clock of its end: a stall shows in all that was before it."""
    faults.stall(A1, 2, 0.7)(motion)
    return motion.rows(A1, 2)[0]


def bent(motion: faults.Motion) -> int:
    rows = motion.rows(A1)[540:760]  # where the hand rests, so that the arm is no faster than asked
    faults.shift(motion, rows, faults.bump(220)[:, None] * 10 * faults.Z)
    return rows[0]


def straightened(motion: faults.Motion) -> int:
    rows = motion.rows(A1)
    motion.tip[rows] = np.linspace(motion.tip[rows[0]], motion.tip[rows[-1]], len(rows))
    return rows[0]


def goes_back(motion: faults.Motion) -> int:
    rows = motion.rows(A1)
    at = rows[160]
    again = np.concatenate((np.arange(at), np.arange(at, at - 80, -1), np.arange(at - 80, len(motion.tip))))
    motion.repeat(again)
    return at


def too_slow(motion: faults.Motion) -> int:
    rows = motion.rows(A1)
    slower = np.rint(np.linspace(rows[0], rows[-1], int(1.2 * len(rows)))).astype(int)
    motion.repeat(np.concatenate((np.arange(rows[0]), slower, np.arange(rows[-1] + 1, len(motion.tip)))))
    return rows[0]


def too_fast(motion: faults.Motion) -> int:
    rows = motion.rows(A1)
    motion.repeat(np.setdiff1d(np.arange(len(motion.tip)), rows[1::2]))
    return rows[0]


def jaw_held(motion: faults.Motion) -> int:
    rows = motion.rows(A1)
    motion.turned[rows] = motion.turned[rows[0]]
    return rows[0]


def jaw_off_at_the_end(motion: faults.Motion) -> int:
    rows = motion.rows(A1)[-100:]
    faults.turn(motion.turned, rows, faults.X, faults.rising(100))
    return rows[-1]


def grid_not_turned(motion: faults.Motion) -> int:
    """The path of a pass is turned by 5 degrees about its goal."""
    rows = motion.rows(A1, 0)
    goal = motion.tip[rows[-1]].copy()
    motion.tip[rows] = (motion.tip[rows] - goal) @ about(faults.Z, np.radians(5)).T + goal
    return rows[0]


def pass_left_out(motion: faults.Motion) -> int:
    motion.repeat(np.flatnonzero(motion.passes < 2))
    return len(motion.tip) - 1


def a2_wrong(degrees: float, axis: np.ndarray | None = None) -> faults.Fault:
    """Return a fault: A2 ends with the jaw turned away, about PSM_M's approach if no axis is given."""

    def plant(motion: faults.Motion) -> int:
        rows = motion.rows(A2)
        before, end = motion.turned[rows[0] - 1], motion.turned[rows[-1]]
        wrong = about(np.array(PSM_M) if axis is None else end @ axis, np.radians(degrees)) @ end
        difference = wrong @ before.T
        x, y, z, w = quaternion_of(difference[None])[0] * np.sign(quaternion_of(difference[None])[0][3])
        angle, about_it = 2 * np.arccos(min(1.0, w)), np.array([x, y, z])
        for row, part in zip(rows, faults.rising(len(rows) + 1)[1:], strict=True):
            motion.turned[row] = about(about_it, part * angle) @ before
        return rows[-1]

    return plant


def a2_left_out(motion: faults.Motion) -> int:
    rows = motion.rows(A2)
    motion.turned[rows] = motion.turned[rows[0] - 1]
    return rows[-1]


def tip_moves_in_a2(motion: faults.Motion) -> int:
    rows = motion.rows(A2)
    faults.shift(motion, rows, faults.rising(len(rows))[:, None] * 2 * faults.X)
    return rows[0]


def m_takes_beside(motion: faults.Motion) -> int:
    rows = motion.rows(A2)
    motion.m_tip[rows] += faults.rising(len(rows))[:, None] * 3 * faults.Z
    return rows[0]


def m_stops_short(motion: faults.Motion) -> int:
    rows = motion.rows(A2)
    motion.m_tip[rows] -= faults.rising(len(rows))[:, None] * 3 * motion.m_turned[rows[0]][:, 2]
    return rows[-1]


def m_turned(motion: faults.Motion) -> int:
    rows = np.flatnonzero(motion.passes == 0)
    faults.turn(motion.m_turned, rows, np.array(PSM_M), np.full(len(rows), 10.0))
    return 0


def m_too_early(motion: faults.Motion) -> int:
    rows = motion.rows(A1, 0)
    motion.m_tip[: rows[-1] + 1] = motion.m_tip[motion.rows(A2, 0)[-1]]
    return 0


def m_too_near(motion: faults.Motion) -> int:
    rows = motion.rows(A1, 0)
    motion.m_tip[rows] += 5 * motion.m_turned[0][:, 2]
    return 0


PASS_FAULTS: faults.Faults = {
    "goal 10 mm off": (goal_off, PATH, 150),
    "goal 1 mm off": (goal_a_little_off, "end of A1 off the suture point", 0),
    "start 10 mm off": (start_off, "start of the pass off the asked one", 0),
    "reversed": (reversed_motion, "start of the pass off the asked one", 0),
    "A1 stalls": (faults.stall(A1, 1, 0.2), "standing still", 50),
    "A1 stalls after a start of its own": (stalls_late, "jaw turned off the recording", 1000),
    "path bent by 10 mm": (bent, "path off the policy's cells", 110),
    "path cut straight": (straightened, PATH, 300),
    "goes back": (goes_back, PATH, 80),
    "a fifth too slow": (too_slow, "jaw turned off the recording", 500),
    "twice as fast": (too_fast, "speed of the tip", 60),
    "grid turned by 5 degrees": (grid_not_turned, "start of the pass off the asked one", 0),
    "jaw does not turn": (jaw_held, "jaw turned off the recording", 300),
    "jaw 10 degrees off": (faults.jaw_off(10.0, A1, faults.X), "jaw turned off the recording", 150),
    "jaw 1 degree off at the hand-off": (jaw_off_at_the_end, "jaw off its stated rotation", 0),
    "A2 wrong by 30 degrees": (a2_wrong(30.0), "A2 off the paper's hand-off", 0),
    "A2 wrong by 90 degrees": (a2_wrong(90.0), "A2 off the paper's hand-off", 0),
    "A2 upside down": (a2_wrong(180.0, faults.Z), "A2 off the paper's hand-off", 0),
    "A2 not along PSM_M's approach": (a2_wrong(30.0, faults.Y), "A2's hinge off PSM_M's approach", 0),
    "A2 left out": (a2_left_out, "A2's hinge off PSM_M's approach", 0),
    "A2 takes a detour": (faults.jaw_off(20.0, A2, faults.X), "A2 leaves the shorter way", 20),
    "tip moves in A2": (tip_moves_in_a2, "tip leaves the hand-off", 50),
    "A2 stalls": (faults.stall(A2, 1, 0.5), "standing still", 50),
    "PSM_M takes beside the needle": (m_takes_beside, "PSM_M off its straight way", 60),
    "PSM_M stops short": (m_stops_short, "PSM_M off where it takes the needle", 0),
    "PSM_M turned": (m_turned, "PSM_M turned from how it takes the needle", 0),
    "PSM_M comes too early": (m_too_early, "PSM_M off where it waits", 0),
    "PSM_M waits too near": (m_too_near, "PSM_M off where it waits", 0),
    "a pass left out": (pass_left_out, "number of passes off the suture points", 0),
}


def test_the_recorded_hand_off_missed_by_a_third_of_a_degree_is_named():
    asked, motion = faults.sound("recorded")
    changed = faults.poses(motion)
    rows = changed.rows(A2)
    faults.turn(changed.turned, rows, faults.X, faults.rising(len(rows)) / 3)
    assert faults.broken(compare(asked, changed.built())) == ("A2 off the recorded hand-off", rows[-1])


def test_a_stall_makes_the_clock_late_by_the_recorded_time_that_it_takes():
    asked, motion = faults.sound()
    changed = faults.poses(motion)
    faults.stall(A1, 0, 0.2)(changed)
    late_s = compare(asked, changed.built()).values["clock of A1 off the recording's"]
    assert late_s[changed.rows(A1, 0)[-1]] == pytest.approx(0.5 * motion.tempo, abs=0.02)


def test_a_rollout_that_joins_later_goes_by_the_clock_of_its_end(monkeypatch):
    """As where a policy of several demonstrations leaves the start of this one on another's way."""
    asked, motion = faults.sound()
    changed = faults.poses(motion)
    faults.stall(A1, 0, 0.2)(changed)
    monkeypatch.setattr(RequestedMotion, "joined_s", lambda _asked, _states: (0.5, 0.9))
    assert not compare(asked, changed.built()).values["clock of A1 off the recording's"].any()


def test_standing_still_while_the_needle_changes_hands_is_not_counted():
    asked, motion = faults.sound()
    changed = faults.poses(motion)
    stood = compare(asked, motion).values["standing still"]
    for number, phase in ((0, A2), (1, TRANSFER), (1, A2)):
        last = np.flatnonzero((changed.passes == number) & (changed.phase == phase))[-1]
        begins = stands_from(motion, int(last))
        assert stood[begins - 1] > 0  # at the end of the move before
        assert not stood[begins:last].any()


@pytest.mark.parametrize(("phase", "part"), [(A1, 0.2), (TRANSFER, 0.5)])
@pytest.mark.parametrize(("share", "stands"), [(0.001, True), (0.004, False)])
def test_an_arm_stands_below_a_five_hundredth_of_its_greatest_speed(phase, part, share, stands):
    asked, motion = faults.sound()
    changed = faults.poses(motion)
    steps = np.diff(changed.tip[changed.rows(phase)], axis=0)
    step = steps[int(part * len(steps))]
    step = share * np.linalg.norm(steps, axis=1).max() * step / np.linalg.norm(step)
    at = faults.stall(phase, 1, part)(changed)
    changed.tip[at : at + 51] += np.arange(-50, 1)[:, None] * step
    stood = compare(asked, changed.built()).values["standing still"]
    assert (stood[at : at + 51].max() > 1) == stands


@pytest.mark.parametrize(("ticks", "named"), [(75, False), (90, True)])
def test_at_the_beginning_an_arm_may_stand_for_as_long_as_the_hand_did(ticks, named):
    """That is 0.8 s here, with the quarter of a second that it may stand anywhere."""
    asked, motion = faults.sound()
    changed = faults.poses(motion)
    at = changed.rows(A1, 0)[3]
    changed.repeat(np.insert(np.arange(len(changed.tip)), at, np.full(ticks, at)))
    stood = compare(asked, changed.built()).values["standing still"]
    assert (stood[: at + ticks + 50].max() > 1) == named


def test_a_held_jaw_that_turns_by_a_degree_is_named():
    asked, motion = faults.sound(orientation="constant")
    changed = faults.poses(motion)
    rows = changed.rows(A1)[200:400]
    faults.turn(changed.turned, rows, faults.X, faults.bump(200))
    kind, sample = faults.broken(compare(asked, changed.built()))
    assert kind == "jaw off its stated rotation"
    assert rows[0] <= sample <= rows[40]


A_LETS_GO = "PSM_A's jaw opens before PSM_M's holds"


def opens(phase: int) -> faults.Fault:
    """Return a fault: the jaw opens in the middle of a phase, and drops the needle."""

    def plant(motion: faults.Motion) -> int:
        rows = motion.rows(phase)
        rows = rows[len(rows) // 2 :]
        motion.jaw[rows] += 0.3
        return rows[0]

    return plant


def changes(motion: faults.Motion, phase: int = A2) -> np.ndarray:
    """Return the samples at the end of a phase in which the jaws move."""
    return np.flatnonzero((motion.passes == 1) & (motion.phase == phase) & motion.still)


def lets_go_early(motion: faults.Motion) -> int:
    rows = changes(motion)
    opened = motion.jaw[rows]
    motion.jaw[rows] = np.append(opened[40:], np.full(40, opened[-1]))
    return rows[40]


def m_never_closes(motion: faults.Motion) -> int:
    rows = changes(motion)
    motion.m_jaw[rows] = JAW_OPEN_RAD
    return rows[len(rows) // 2]


def m_closes_halfway(motion: faults.Motion) -> int:
    rows = changes(motion)
    motion.m_jaw[rows] = (motion.m_jaw[rows] + JAW_OPEN_RAD) / 2
    return rows[len(rows) // 2]


def stuck(motion: faults.Motion) -> int:
    rows = changes(motion)
    motion.jaw[rows] = motion.jaw[rows[0] - 1]
    return rows[-1]


def both_stuck(motion: faults.Motion) -> int:
    m_never_closes(motion)
    return stuck(motion)


def jaws_swapped(motion: faults.Motion) -> int:
    motion.jaw, motion.m_jaw = motion.m_jaw, motion.jaw
    return 0


def m_comes_closed(motion: faults.Motion) -> int:
    rows = motion.rows(A2)[50:]
    motion.m_jaw[rows] = JAW_CLOSED_RAD
    motion.m_jaw[rows[:40]] = np.linspace(JAW_OPEN_RAD, JAW_CLOSED_RAD, 40)
    return rows[1]


def m_snaps(motion: faults.Motion) -> int:
    rows = changes(motion)
    motion.m_jaw[rows[1:]] = JAW_CLOSED_RAD
    return rows[0]


def m_too_far(motion: faults.Motion) -> int:
    rows = changes(motion)
    motion.m_jaw[rows] = np.where(motion.m_jaw[rows] < 0, motion.m_jaw[rows] * 3, motion.m_jaw[rows])
    return rows[np.flatnonzero(motion.m_jaw[rows] < instrument_of("400006").jaw_rad[0])[0]]


def m_drops(motion: faults.Motion) -> int:
    rows = motion.rows(TRANSFER)[30:60]
    motion.m_jaw[rows] += 0.3
    return rows[0]


def not_taken_back(motion: faults.Motion) -> int:
    rows = changes(motion, TRANSFER)
    motion.jaw[rows] = motion.jaw[rows[0] - 1]
    return rows[len(rows) // 2]


def closes_on_the_way(motion: faults.Motion) -> int:
    rows = motion.rows(TRANSFER)[30:60]
    motion.jaw[rows] -= 0.3
    return rows[0]


JAW_FAULTS: faults.Faults = {
    "jaw opens in A1": (opens(A1), "opening of the jaw off the recording", 0),
    "jaw opens in A2": (opens(A2), A_LETS_GO, 0),
    "jaw opens 0.4 s too early": (lets_go_early, A_LETS_GO, 5),
    "PSM_M's jaw never closes": (m_never_closes, A_LETS_GO, 5),
    "PSM_M's jaw closes halfway": (m_closes_halfway, A_LETS_GO, 5),
    "both jaws stuck": (both_stuck, "needle has not changed hands", 0),
    "PSM_A's jaw stuck": (stuck, "needle has not changed hands", 0),
    "jaws swapped": (jaws_swapped, "opening of the jaw off the recording", 0),
    "PSM_M comes in closed": (m_comes_closed, "PSM_M's jaw not open as it comes in", 0),
    "PSM_M's jaw closes in one tick": (m_snaps, "speed of a jaw", 0),
    "PSM_M's jaw closes too far": (m_too_far, "a jaw beyond its limits", 0),
    "PSM_M drops the needle in the transfer": (m_drops, "PSM_M's jaw opens before PSM_A's holds", 0),
    "PSM_A does not take it again": (not_taken_back, "PSM_M's jaw opens before PSM_A's holds", 5),
    "PSM_A's jaw closes on the way": (closes_on_the_way, "a jaw moves with an arm", 0),
}


def test_a_jaw_that_was_not_recorded_stays_closed_in_a1():
    demo, policy = turning()
    bare, psm_m = replace(demo, jaw_rad=None), PsmM(PSM_M, BASE_MM, BASE_XYZW)
    point = SuturePoint(tuple(demo.tip_mm[-1].tolist()))
    plan = stack(policy, [point], demo=bare, psm_m=psm_m, rate_hz=faults.RATE_HZ, speed_mm_s=20.0)
    asked, motion = requested_motion(plan, policy, bare), faults.poses(faults.timed(plan.passes, psm_m))
    assert faults.broken(compare(asked, motion.built())) is None
    rows = motion.rows(A1, 0)[300:]
    motion.jaw[rows] += 0.01
    assert faults.broken(compare(asked, motion.built())) == (A_LETS_GO, rows[0])


def test_an_arm_that_slips_at_the_last_moment_was_not_standing_still():
    asked, motion = faults.sound()
    changed = faults.poses(motion)
    closing = changes(changed)
    changed.still[closing[-1]] = False
    changed.m_tip[closing[-1]] += 0.01 * faults.Z
    assert faults.broken(compare(asked, changed.built())) == ("PSM_M's jaw not open as it comes in", closing[0])


def test_a_jaw_without_psm_m_stays_between_its_angles_around_a_transfer():
    asked, psm_m = replace(faults.sound()[0], psm_m=PsmM(PSM_M)), PsmM(PSM_M)
    motion = faults.timed(faults.planned().passes, psm_m)
    assert faults.broken(compare(asked, motion)) is None
    opened, rows = np.array(motion.jaw_rad), np.flatnonzero((motion.pass_index == 1) & (motion.phase == TRANSFER))
    opened[rows] = min(opened[rows[0] - 1], opened[rows[-1] + 1]) - 0.1
    assert faults.broken(compare(asked, replace(motion, jaw_rad=opened))) == (
        "opening of the jaw off the recording",
        rows[0],
    )


def own_start_ignored(motion: faults.Motion) -> int:
    """A transfer leads 3 mm beside the start that was given."""
    transfer, rows = motion.rows(TRANSFER, 2), motion.rows(A1, 2)
    motion.tip[transfer[-100:]] += faults.rising(100)[:, None] * 3 * faults.Y
    motion.tip[rows[:200]] += (1 - faults.rising(200))[:, None] * 3 * faults.Y
    return transfer[-100]


def m_stays(motion: faults.Motion) -> int:
    """PSM_M leaves late, and PSM_A moves off while PSM_M still holds the needle."""
    rows = motion.rows(TRANSFER)
    moves = rows[np.linalg.norm(motion.tip[rows] - motion.tip[rows[0]], axis=1) > 0.05][0]
    late = np.linspace(0.0, 1.0, len(rows)) ** 1.5 * (len(rows) - 1)
    number = np.arange(len(rows))
    motion.m_tip[rows] = np.stack([np.interp(late, number, axis) for axis in motion.m_tip[rows].T], axis=1)
    return moves


def transfer_bulges(motion: faults.Motion) -> int:
    rows = motion.rows(TRANSFER)
    rows = rows[len(rows) // 2 :]
    faults.shift(motion, rows, faults.bump(len(rows))[:, None] * 5 * faults.X)
    return rows[0]


def transfer_goes_back(motion: faults.Motion) -> int:
    rows = motion.rows(TRANSFER)
    far = np.linalg.norm(motion.tip[rows] - motion.tip[rows[0]], axis=1)
    at = rows[int(np.argmax(far > 0.5 * far[-1]))]
    motion.repeat(np.concatenate((np.arange(at), np.arange(at, at - 20, -1), np.arange(at - 20, len(motion.tip)))))
    return at


TRANSFER_FAULTS: faults.Faults = {
    "a start of its own is ignored": (own_start_ignored, "PSM_A off the straight transfer", 50),
    "PSM_A leaves before PSM_M": (m_stays, "PSM_A leaves before PSM_M", 1),
    "transfer bulges": (transfer_bulges, "PSM_A off the straight transfer", 20),
    "transfer goes back": (transfer_goes_back, "PSM_A off the straight transfer", 100),
    "transfer's jaw takes a detour": (faults.jaw_off(20.0, TRANSFER, faults.X), "transfer leaves the shorter way", 50),
    "transfer's jaw takes a small detour": (
        faults.jaw_off(0.3, TRANSFER, faults.X),
        "transfer leaves the shorter way",
        100,
    ),
    "transfer stalls": (faults.stall(TRANSFER, 1, 0.5), "standing still", 50),
}


def test_in_the_first_transfer_the_jaw_may_turn_evenly():
    """A pass whose start is outside of the grid begins with a transfer; its jaw turns to where A1 has it."""
    demo, policy = turning()
    point, psm_m = SuturePoint(tuple(demo.tip_mm[-1].tolist())), PsmM(PSM_M, BASE_MM, BASE_XYZW)
    start = np.array(policy.path.grid.origin_mm) - 10.0
    plan = stack(policy, [point], demo=demo, psm_m=psm_m, starts_mm=[start], rate_hz=faults.RATE_HZ, speed_mm_s=20.0)
    asked, motion = requested_motion(plan, policy, demo), faults.poses(faults.timed(plan.passes, psm_m))
    rows = motion.rows(TRANSFER, 0)
    faults.turn(motion.turned, rows, faults.X, np.linspace(10.0, 0.0, len(rows) + 1)[:-1])
    assert 10.0 / len(rows) > LIMITS["transfer leaves the shorter way"][1] / 2
    assert faults.broken(compare(asked, motion.built())) is None


def test_a_jaw_that_turns_while_the_tip_stands_is_not_standing_still():
    asked, motion = faults.sound()
    changed = faults.poses(motion)
    at = faults.stall(TRANSFER, 1, 0.5)(changed)
    faults.turn(changed.turned, np.arange(at, at + 50), faults.X, np.linspace(0.0, 5.0, 50))
    stood = compare(asked, changed.built()).values["standing still"]
    assert stood[at : at + 50].max() < 1


FAULTS = PASS_FAULTS | JAW_FAULTS | TRANSFER_FAULTS


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_by_its_kind_and_its_first_sample(name):
    faults.check_named(*FAULTS[name])
