"""Faults of the jaws: the needle is dropped, or does not change hands."""

from dataclasses import replace

import numpy as np
import pytest

from skills.kinematics import instrument_of
from skills.planning.handoff import JAW_CLOSED_RAD, JAW_OPEN_RAD, PsmM
from skills.planning.plan import SuturePoint, stack
from skills.planning.trajectory import A1, A2, TRANSFER
from skills.verification.intent import compare
from skills.verification.requested import requested_motion
from tests.planning.motions import PSM_M
from tests.planning.test_hand import turning
from tests.verification.faults import (
    RATE_HZ,
    Fault,
    Faults,
    Motion,
    Z,
    broken,
    check_named,
    planned,
    poses,
    sound,
    timed,
)
from tests.verification.hands import BASE_MM, BASE_XYZW

A_LETS_GO = "PSM_A's jaw opens before PSM_M's holds"


def opens(phase: int) -> Fault:
    """Return a fault: the jaw opens in the middle of a phase, and drops the needle."""

    def plant(motion: Motion) -> int:
        rows = motion.rows(phase)
        rows = rows[len(rows) // 2 :]
        motion.jaw[rows] += 0.3
        return rows[0]

    return plant


def changes(motion: Motion, phase: int = A2) -> np.ndarray:
    """Return the samples at the end of a phase in which the jaws move."""
    return np.flatnonzero((motion.passes == 1) & (motion.phase == phase) & motion.still)


def lets_go_early(motion: Motion) -> int:
    rows = changes(motion)
    opened = motion.jaw[rows]
    motion.jaw[rows] = np.append(opened[40:], np.full(40, opened[-1]))
    return rows[40]


def m_never_closes(motion: Motion) -> int:
    rows = changes(motion)
    motion.m_jaw[rows] = JAW_OPEN_RAD
    return rows[len(rows) // 2]


def m_closes_halfway(motion: Motion) -> int:
    rows = changes(motion)
    motion.m_jaw[rows] = (motion.m_jaw[rows] + JAW_OPEN_RAD) / 2
    return rows[len(rows) // 2]


def stuck(motion: Motion) -> int:
    rows = changes(motion)
    motion.jaw[rows] = motion.jaw[rows[0] - 1]
    return rows[-1]


def both_stuck(motion: Motion) -> int:
    m_never_closes(motion)
    return stuck(motion)


def jaws_swapped(motion: Motion) -> int:
    motion.jaw, motion.m_jaw = motion.m_jaw, motion.jaw
    return 0


def m_comes_closed(motion: Motion) -> int:
    rows = motion.rows(A2)[50:]
    motion.m_jaw[rows] = JAW_CLOSED_RAD
    motion.m_jaw[rows[:40]] = np.linspace(JAW_OPEN_RAD, JAW_CLOSED_RAD, 40)
    return rows[1]


def m_snaps(motion: Motion) -> int:
    rows = changes(motion)
    motion.m_jaw[rows[1:]] = JAW_CLOSED_RAD
    return rows[0]


def m_too_far(motion: Motion) -> int:
    rows = changes(motion)
    motion.m_jaw[rows] = np.where(motion.m_jaw[rows] < 0, motion.m_jaw[rows] * 3, motion.m_jaw[rows])
    return rows[np.flatnonzero(motion.m_jaw[rows] < instrument_of("400006").jaw_rad[0])[0]]


def m_drops(motion: Motion) -> int:
    rows = motion.rows(TRANSFER)[30:60]
    motion.m_jaw[rows] += 0.3
    return rows[0]


def not_taken_back(motion: Motion) -> int:
    rows = changes(motion, TRANSFER)
    motion.jaw[rows] = motion.jaw[rows[0] - 1]
    return rows[len(rows) // 2]


def closes_on_the_way(motion: Motion) -> int:
    rows = motion.rows(TRANSFER)[30:60]
    motion.jaw[rows] -= 0.3
    return rows[0]


FAULTS: Faults = {
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


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_the_jaws_is_named_by_its_kind_and_its_first_sample(name):
    check_named(*FAULTS[name])


def test_a_jaw_that_was_not_recorded_stays_closed_in_a1():
    demo, policy = turning()
    bare, psm_m = replace(demo, jaw_rad=None), PsmM(PSM_M, BASE_MM, BASE_XYZW)
    point = SuturePoint(tuple(demo.tip_mm[-1].tolist()))
    plan = stack(policy, [point], demo=bare, psm_m=psm_m, rate_hz=RATE_HZ, speed_mm_s=20.0)
    asked, motion = requested_motion(plan, policy, bare), poses(timed(plan.passes, psm_m))
    assert broken(compare(asked, motion.built())) is None
    rows = motion.rows(A1, 0)[300:]
    motion.jaw[rows] += 0.01
    assert broken(compare(asked, motion.built())) == (A_LETS_GO, rows[0])


def test_an_arm_that_slips_at_the_last_moment_was_not_standing_still():
    asked, motion = sound()
    changed = poses(motion)
    closing = changes(changed)
    changed.still[closing[-1]] = False
    changed.m_tip[closing[-1]] += 0.01 * Z
    assert broken(compare(asked, changed.built())) == ("PSM_M's jaw not open as it comes in", closing[0])


def test_a_jaw_without_psm_m_stays_between_its_angles_around_a_transfer():
    asked, psm_m = replace(sound()[0], psm_m=PsmM(PSM_M)), PsmM(PSM_M)
    motion = timed(planned().passes, psm_m)
    assert broken(compare(asked, motion)) is None
    opened, rows = np.array(motion.jaw_rad), np.flatnonzero((motion.pass_index == 1) & (motion.phase == TRANSFER))
    opened[rows] = min(opened[rows[0] - 1], opened[rows[-1] + 1]) - 0.1
    assert broken(compare(asked, replace(motion, jaw_rad=opened))) == ("opening of the jaw off the recording", rows[0])
