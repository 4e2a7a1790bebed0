"""Faults of the transfers, from one pass to the start of the next."""

import numpy as np
import pytest

from skills.planning.handoff import PsmM
from skills.planning.plan import SuturePoint, stack
from skills.planning.trajectory import A1, TRANSFER
from skills.verification.deviations import LIMITS
from skills.verification.intent import compare
from skills.verification.requested import requested_motion
from tests.planning.motions import PSM_M
from tests.planning.test_hand import turning
from tests.verification.faults import (
    RATE_HZ,
    Faults,
    Motion,
    X,
    Y,
    broken,
    bump,
    check_named,
    jaw_off,
    poses,
    rising,
    shift,
    sound,
    stall,
    timed,
    turn,
)
from tests.verification.hands import BASE_MM, BASE_XYZW


def own_start_ignored(motion: Motion) -> int:
    """A transfer leads 3 mm beside the start that was given."""
    transfer, rows = motion.rows(TRANSFER, 2), motion.rows(A1, 2)
    motion.tip[transfer[-100:]] += rising(100)[:, None] * 3 * Y
    motion.tip[rows[:200]] += (1 - rising(200))[:, None] * 3 * Y
    return transfer[-100]


def m_stays(motion: Motion) -> int:
    """PSM_M leaves late, and PSM_A moves off while PSM_M still holds the needle."""
    rows = motion.rows(TRANSFER)
    moves = rows[np.linalg.norm(motion.tip[rows] - motion.tip[rows[0]], axis=1) > 0.05][0]
    late = np.linspace(0.0, 1.0, len(rows)) ** 1.5 * (len(rows) - 1)
    number = np.arange(len(rows))
    motion.m_tip[rows] = np.stack([np.interp(late, number, axis) for axis in motion.m_tip[rows].T], axis=1)
    return moves


def transfer_bulges(motion: Motion) -> int:
    rows = motion.rows(TRANSFER)
    rows = rows[len(rows) // 2 :]
    shift(motion, rows, bump(len(rows))[:, None] * 5 * X)
    return rows[0]


def transfer_goes_back(motion: Motion) -> int:
    rows = motion.rows(TRANSFER)
    far = np.linalg.norm(motion.tip[rows] - motion.tip[rows[0]], axis=1)
    at = rows[int(np.argmax(far > 0.5 * far[-1]))]
    motion.repeat(np.concatenate((np.arange(at), np.arange(at, at - 20, -1), np.arange(at - 20, len(motion.tip)))))
    return at


FAULTS: Faults = {
    "a start of its own is ignored": (own_start_ignored, "PSM_A off the straight transfer", 50),
    "PSM_A leaves before PSM_M": (m_stays, "PSM_A leaves before PSM_M", 1),
    "transfer bulges": (transfer_bulges, "PSM_A off the straight transfer", 20),
    "transfer goes back": (transfer_goes_back, "PSM_A off the straight transfer", 100),
    "transfer's jaw takes a detour": (jaw_off(20.0, TRANSFER, X), "transfer leaves the shorter way", 50),
    "transfer's jaw takes a small detour": (jaw_off(0.3, TRANSFER, X), "transfer leaves the shorter way", 100),
    "transfer stalls": (stall(TRANSFER, 1, 0.5), "standing still", 50),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_a_transfer_is_named_by_its_kind_and_its_first_sample(name):
    check_named(*FAULTS[name])


def test_in_the_first_transfer_the_jaw_may_turn_evenly():
    """A pass whose start is outside of the grid begins with a transfer; its jaw turns to where A1 has it."""
    demo, policy = turning()
    point, psm_m = SuturePoint(tuple(demo.tip_mm[-1].tolist())), PsmM(PSM_M, BASE_MM, BASE_XYZW)
    start = np.array(policy.path.grid.origin_mm) - 10.0
    plan = stack(policy, [point], demo=demo, psm_m=psm_m, starts_mm=[start], rate_hz=RATE_HZ, speed_mm_s=20.0)
    asked, motion = requested_motion(plan, policy, demo), poses(timed(plan.passes, psm_m))
    rows = motion.rows(TRANSFER, 0)
    turn(motion.turned, rows, X, np.linspace(10.0, 0.0, len(rows) + 1)[:-1])
    assert 10.0 / len(rows) > LIMITS["transfer leaves the shorter way"][1] / 2
    assert broken(compare(asked, motion.built())) is None


def test_a_jaw_that_turns_while_the_tip_stands_is_not_standing_still():
    asked, motion = sound()
    changed = poses(motion)
    at = stall(TRANSFER, 1, 0.5)(changed)
    turn(changed.turned, np.arange(at, at + 50), X, np.linspace(0.0, 5.0, 50))
    stood = compare(asked, changed.built()).values["standing still"]
    assert stood[at : at + 50].max() < 1
