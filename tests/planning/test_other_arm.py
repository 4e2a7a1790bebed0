"""PSM_M next to PSM_A: its waiting place, its approach, and the refusals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import BadInput, BadPlan, NoApproach, Unreachable
from skills.kinematics import POINTING_DOWN, angle_between, forward, matrix_of
from skills.planning.handoff import JAW_S, PsmM, hand_off, realign, unit_approach
from skills.planning.motion_laws import A1, A2, PEAK, TRANSFER
from skills.planning.passes import STAND_OFF_MM
from skills.planning.trajectory import PassPath, Trajectory, joint_ratios, time_parametrise
from tests.by_day import examples
from tests.planning.motions import HAND_OFF_MM, PSM_M
from tests.planning.motions import hand_off as one_pass
from tests.planning.test_transfers import BESIDE


def in_psm_a_frame(motion: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return PSM_M's tip and jaw by its joints, in the PSM_A base frame."""
    tip, rotation = forward(motion.psm_m.joints, motion.psm_m.instrument)
    base = matrix_of(motion.psm_m.base_xyzw[None])[0]
    return tip @ base.T + motion.psm_m.base_mm, base @ rotation


def taking(motion: Trajectory, number: int) -> tuple[np.ndarray, np.ndarray]:
    last = motion.last_samples[number]
    tip, jaws = hand_off(motion.tip_mm[[last]], matrix_of(motion.rotation_xyzw[[last]]), PSM_M)
    return tip[0], jaws[0]


def planned(count: int = 2, psm_m: PsmM = BESIDE, **how) -> Trajectory:
    return time_parametrise([one_pass(-8.0 * k) for k in range(count)], **{"rate_hz": 100.0, "psm_m": psm_m, **how})


def test_psm_m_waits_behind_the_hand_off_in_a1_and_is_there_at_a2s_end():
    motion = planned(3)
    tip, rotation = in_psm_a_frame(motion)
    for number in range(3):
        there, jaws = taking(motion, number)
        of_pass = motion.pass_index == number
        waiting = tip[of_pass & (motion.phase == A1)]
        assert np.abs(waiting - (there - STAND_OFF_MM * jaws[:, 2])).max() < 1e-9
        last = motion.last_samples[number]
        assert np.abs(tip[last] - there).max() < 1e-9
        # Its jaws may be taken either way round; only the approach and the hinge's line count.
        assert rotation[last][:, 2] == pytest.approx(jaws[:, 2], abs=1e-9)
        assert abs(rotation[last][:, 0] @ jaws[:, 0]) == pytest.approx(1.0, abs=1e-9)


def test_it_comes_in_along_its_approach_while_psm_a_turns():
    motion = planned(1)
    tip, rotation = in_psm_a_frame(motion)
    coming = tip[motion.phase == A2][: -2 * round(JAW_S * motion.rate_hz)]  # then the jaws move
    there, jaws = taking(motion, 0)
    behind = (there - coming) @ jaws[:, 2]
    assert np.abs(there - coming - behind[:, None] * jaws[:, 2]).max() < 1e-9
    assert (np.diff(behind) < 0).all()
    assert behind[-1] == pytest.approx(0.0, abs=1e-9)
    assert angle_between(rotation, np.broadcast_to(rotation[0], rotation.shape)).max() < 1e-9


def test_it_leaves_before_psm_a_comes_back():
    motion = planned(2)
    tip, _ = in_psm_a_frame(motion)
    at = np.flatnonzero((motion.pass_index == 1) & (motion.phase == TRANSFER))
    psm_a_moves = np.linalg.norm(motion.tip_mm[at] - motion.tip_mm[at[0]], axis=1) > 1e-9
    gone = np.linalg.norm(tip[at] - taking(motion, 0)[0], axis=1)
    assert gone[~psm_a_moves].min() == pytest.approx(0.0, abs=1e-9)
    assert gone[psm_a_moves].min() >= STAND_OFF_MM - 1e-6


def test_told_to_it_is_at_the_hand_off_from_the_start():
    motion = planned(2, PsmM(PSM_M, BESIDE.base_mm, BESIDE.base_xyzw, enters="start"))
    tip, _ = in_psm_a_frame(motion)
    for number in range(2):
        there, _ = taking(motion, number)
        here = (motion.pass_index == number) & (motion.phase != TRANSFER)
        assert np.abs(tip[here] - there).max() < 1e-9


@examples(20)
@given(st.floats(-15, 15), st.floats(-15, 15), st.floats(-15, 15), st.floats(-25, 25))  # within 20 not all are in reach
def test_wherever_its_base_is_its_tip_is_at_the_same_place(dx, dy, dz, tilt_deg):
    half = np.radians(35 + tilt_deg) / 2
    moved = PsmM(PSM_M, (160 + dx, 20 + dy, 20 + dz), (0.0, float(np.sin(half)), 0.0, float(np.cos(half))))
    one, other = planned(1, rate_hz=20.0), planned(1, moved, rate_hz=20.0)
    np.testing.assert_allclose(in_psm_a_frame(one)[0][-1], in_psm_a_frame(other)[0][-1], atol=1e-9)


def test_of_the_two_ways_round_it_takes_the_one_with_less_roll():
    # A base rotated by half a turn about its own axis needs the other way, and then rolls of the same size.
    x, y, z, w = BESIDE.base_xyzw
    turned = PsmM(PSM_M, BESIDE.base_mm, (y, -x, w, -z))
    one, other = planned(1), planned(1, turned)
    assert np.abs(one.psm_m.joints[:, 3]).max() <= np.pi / 2
    np.testing.assert_allclose(np.abs(one.psm_m.joints[:, 3]), np.abs(other.psm_m.joints[:, 3]), atol=1e-9)
    jaws = in_psm_a_frame(one)[1][-1], in_psm_a_frame(other)[1][-1]
    assert jaws[0][:, 2] == pytest.approx(jaws[1][:, 2], abs=1e-9)
    assert jaws[0][:, 0] == pytest.approx(-jaws[1][:, 0], abs=1e-9)


def test_where_its_base_is_not_known_the_trajectory_is_psm_as_alone():
    motion, alone = planned(2, PsmM(PSM_M)), planned(2, None)
    assert motion.psm_m is None
    assert motion.joints.tobytes() == alone.joints.tobytes()


def test_a2_without_a_turn_still_lasts_as_long_as_it_needs_to_come_in():
    ready = realign(POINTING_DOWN, PSM_M).rotation
    motion = time_parametrise([PassPath(HAND_OFF_MM, ready, ready)], rate_hz=100.0, psm_m=BESIDE)
    seconds = np.count_nonzero(motion.phase == A2) / 100.0
    assert seconds == pytest.approx(PEAK * STAND_OFF_MM / 20.0 + 2 * JAW_S, abs=0.02)
    still = time_parametrise([PassPath(HAND_OFF_MM, ready, ready)], rate_hz=100.0)
    assert np.count_nonzero(still.phase == A2) == 1


def test_a2_is_slowed_until_psm_ms_joints_are_within_their_limits_too():
    motion = planned(2, speed_mm_s=100.0)
    speed, acceleration = joint_ratios(motion.psm_m.joints, motion.pass_index, 100.0)
    assert speed.max() <= 1.0
    assert acceleration.max() <= 1.0
    alone = planned(2, None, speed_mm_s=100.0)
    assert np.count_nonzero(motion.phase == A2) > 0 and len(motion) > len(alone)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["along", "against"])
def test_an_approach_along_psm_as_own_is_met_across_it(sign):
    approach = tuple((sign * POINTING_DOWN[:, 2]).tolist())
    target = realign(POINTING_DOWN, approach).rotation
    tip, jaws = hand_off(HAND_OFF_MM[-1:], target[None], approach)
    assert np.isfinite(tip).all()
    assert jaws[0][:, 2] == pytest.approx(approach)
    assert target[:, 2] @ unit_approach(approach) == pytest.approx(0.0, abs=1e-12)


def test_a_jaw_that_is_not_turned_for_it_is_refused():
    with pytest.raises(BadPlan, match="realign"):
        hand_off(HAND_OFF_MM[-1:], POINTING_DOWN[None], POINTING_DOWN[:, 2])
    with pytest.raises(BadPlan, match="Pass 0 has no A2"):
        time_parametrise([one_pass(with_a2=False)], psm_m=BESIDE)


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"approach": (0.0, 0.0, 0.0)}, NoApproach),
        ({"approach": (np.nan, 0.0, 1.0)}, BadInput),
        ({"base_mm": (1.0, 2.0, 3.0)}, BadPlan),
        ({"base_xyzw": (0.0, 0.0, 0.0, 1.0)}, BadPlan),
        ({"base_mm": (np.inf, 2.0, 3.0), "base_xyzw": (0.0, 0.0, 0.0, 1.0)}, BadInput),
        ({"base_mm": (1.0, 2.0, 3.0), "base_xyzw": (0.0, 0.0, 0.0, 0.0)}, BadPlan),
        ({"instrument": "470006"}, BadPlan),
        ({"enters": "later"}, BadPlan),
    ],
)
def test_what_cannot_be_meant_of_psm_m_is_refused(wrong, error):
    with pytest.raises(error):
        PsmM(**{"approach": PSM_M, **wrong})


def test_a_place_beyond_psm_m_is_named_with_arm_pass_phase_and_joint():
    away = PsmM(PSM_M, (400.0, 20.0, 20.0), BESIDE.base_xyzw)
    with pytest.raises(Unreachable, match="Pass 0, A1, PSM_M: Sample 0") as caught:
        planned(2, away)
    numbers = caught.value.numbers
    assert (numbers["arm"], numbers["pass"], numbers["phase"], numbers["joint"]) == ("PSM_M", 0, A1, "insertion")
    assert float(numbers["value"]) > float(numbers["limit"]) == 240.0
    # Its own instrument counts: an Si arm reaches 50 mm further.
    near = PsmM(PSM_M, (225.0, 20.0, 20.0), BESIDE.base_xyzw, "400006")
    si = PsmM(PSM_M, (225.0, 20.0, 20.0), BESIDE.base_xyzw, "420006")
    with pytest.raises(Unreachable):
        planned(1, near)
    assert planned(1, si).psm_m.instrument == "420006"


def test_the_same_plan_gives_the_same_bytes_of_both_arms():
    one, other = planned(2), planned(2)
    assert one.psm_m.joints.tobytes() == other.psm_m.joints.tobytes()
    assert one.joints.tobytes() == other.joints.tobytes()
