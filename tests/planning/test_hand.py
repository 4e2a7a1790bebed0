"""Plans with the surgeon's hand: orientation, jaw and tempo along a pass, and the hand-off at its end.

The hand is synthetic: it moves 60 mm in 5 s with two strokes and turns its jaw by 60 degrees, half of it while the tip
rests. Its policy is learnt as the service learns it.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import smoothed_tip
from skills.errors import BadPlan, Unreachable
from skills.gridworld.grid import PAPER_GRID, choose_grid, discretize
from skills.gridworld.reward import sparse_reward
from skills.kinematics import POINTING_DOWN, angle_between, matrix_of, quaternion_of
from skills.learning.policy import Policy, Rollout, learn_tabular
from skills.learning.pose_style import learn_pose_style
from skills.learning.q_learning import PhaseQLearning
from skills.learning.slip_runs import replay
from skills.planning.handoff import HELD_MM, NEEDLE_RADIUS_MM, PsmM, needle_tips_mm, turn
from skills.planning.path_fit import TREMOR_S, Hand, fit_to_demo, hand_along, styled, trace
from skills.planning.plan import SuturePoint, departure_of, driven_pass, stack
from skills.planning.trajectory import A1, A2, Trajectory, time_parametrise
from skills.verification.clearance import openings
from skills.verification.monte_carlo import estimate_success
from skills.verification.probabilities import EstimateSettings
from tests.planning.test_path_fit import shipped

TURN_RAD = np.radians(60)
QUARTER_ABOUT_Z = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
RATE_HZ = 200.0


def stroke(seconds, begin, end):
    """Return the part of a minimum-jerk stroke that is done at each time."""
    u = ((seconds - begin) / (end - begin)).clip(0, 1)
    return u**3 * (10 - 15 * u + 6 * u * u)


@cache
def turning() -> tuple[Demo, Policy]:
    """Return a hand that turns by 60 degrees, 3 mm from any centre of a cell, and its policy."""
    seconds = np.arange(0, 5.0001, 0.01)
    way = 0.6 * stroke(seconds, 0, 2) + 0.4 * stroke(seconds, 3, 5)
    tip = (
        np.array([-18.0, 36.0, -128.0]) + way[:, None] * [38.0, 28.0, 14.0] + np.sin(np.pi * way)[:, None] * [4, -6, 3]
    )
    turned = 0.25 * stroke(seconds, 0, 2) + 0.5 * stroke(seconds, 2, 3) + 0.25 * stroke(seconds, 3, 5)
    target = matrix_of([[np.sin(TURN_RAD / 2), 0.0, 0.0, np.cos(TURN_RAD / 2)]])[0] @ POINTING_DOWN
    rotation = quaternion_of(turn(POINTING_DOWN, target, turned))
    jaw = 0.1 + 0.3 * stroke(seconds, 4, 5)
    demo = Demo("PSM2", "/t", "PSM2_base", 0.0, 5.0, seconds, tip, rotation, jaw)
    policy = learn_tabular(sparse_reward(discretize(tip, PAPER_GRID)), PhaseQLearning(), seed=0)
    return demo, policy


def at_home(**given) -> tuple[Trajectory, object]:
    """Return the motion of one pass where the hand was, and its plan."""
    demo, policy = turning()
    plan = stack(policy, [SuturePoint(tuple(demo.tip_mm[-1].tolist()))], demo=demo, **given)
    motion = time_parametrise(plan.passes, speed_mm_s=plan.speed_mm_s, rate_hz=plan.rate_hz, psm_m=plan.psm_m)
    return motion, plan


def needle_tips(tip_mm, rotation_xyzw):
    return tip_mm[:, None] + np.einsum("tij,kj->tki", matrix_of(rotation_xyzw), needle_tips_mm())


def alike(one, other):
    """Return the correlation of two profiles, each at equal shares of its own length."""
    even = np.linspace(0, 1, 401)
    values = [np.interp(even, np.linspace(0, 1, len(v)), v) for v in (one, other)]
    return float(np.corrcoef(*values)[0, 1])


def speeds(tip_mm):
    return np.linalg.norm(np.diff(tip_mm, axis=0), axis=1)


def test_at_the_hand_off_the_needles_tip_is_where_it_was():
    demo, _ = turning()
    motion, plan = at_home()
    apart_mm = np.linalg.norm(
        needle_tips(motion.tip_mm[-1:], motion.rotation_xyzw[-1:])[0]
        - needle_tips(demo.tip_mm[-1:], demo.rotation_xyzw[-1:])[0],
        axis=1,
    )
    off_deg = np.degrees(angle_between(matrix_of(motion.rotation_xyzw[-1:]), matrix_of(demo.rotation_xyzw[-1:])))[0]
    assert (plan.orientation, plan.departure) == ("recorded", None)
    assert apart_mm.max() < 0.001
    assert off_deg < 0.001


def test_all_along_the_pass_the_pose_is_the_recorded_one():
    demo, _ = turning()
    motion, _ = at_home(speed_mm_s=100.0)
    ours = needle_tips(motion.tip_mm, motion.rotation_xyzw)[:, 0]
    theirs = needle_tips(demo.tip_mm, demo.rotation_xyzw)[:, 0]
    # the same clock: the hand rests half a window longer at either end
    seconds = motion.stamps_s * motion.tempo - 0.125
    then = np.stack([np.interp(seconds, demo.stamps_s, axis) for axis in theirs.T], axis=1)
    assert np.linalg.norm(ours - then, axis=1).max() < 1.0  # mm


@pytest.mark.parametrize("speed_mm_s", [5.0, 20.0, 100.0])
def test_its_speed_profile_is_the_surgeons_at_any_speed(speed_mm_s):
    demo, _ = turning()
    motion, _ = at_home(speed_mm_s=speed_mm_s)
    at_rest = np.zeros(12)  # 0.12 s before and after
    assert alike(speeds(motion.tip_mm), np.concatenate((at_rest, speeds(demo.tip_mm), at_rest))) > 0.99
    assert speeds(motion.tip_mm).max() * motion.rate_hz <= speed_mm_s * 1.001
    assert motion.speed_mm_s <= speed_mm_s
    assert 0 < motion.tempo <= 1
    assert motion.duration_s * motion.tempo == pytest.approx(5.25, abs=0.02)


def test_a_hand_that_is_slow_enough_keeps_its_own_tempo():
    motion, _ = at_home(speed_mm_s=100.0)
    assert motion.tempo == 1.0 or motion.acceleration_ratio > 0.9
    assert (motion.speed_ratio, motion.acceleration_ratio) <= (1.0, 1.0)


def test_it_turns_while_the_tip_rests_and_opens_its_jaw_as_it_did():
    demo, _ = turning()
    motion, _ = at_home()
    rested = (motion.stamps_s * motion.tempo - 0.125 > 2.2) & (motion.stamps_s * motion.tempo - 0.125 < 2.8)
    turned = matrix_of(motion.rotation_xyzw[rested])
    assert np.degrees(angle_between(turned[:1], turned[-1:]))[0] == pytest.approx(26, abs=3)
    assert speeds(motion.tip_mm[rested]).sum() < 0.3  # mm
    assert motion.jaw_rad[[0, -1]] == pytest.approx(demo.jaw_rad[[0, -1]])
    assert alike(motion.jaw_rad, demo.jaw_rad) > 0.99


def test_a_constant_orientation_states_its_departure():
    demo, _ = turning()
    motion, plan = at_home(orientation="constant")
    turned = np.degrees(
        angle_between(matrix_of(motion.rotation_xyzw), matrix_of(demo.rotation_xyzw[:1]).repeat(len(motion), 0))
    )
    assert turned.max() < 1e-5
    assert plan.orientation == "demonstrated"
    assert plan.departure.deg == pytest.approx(60)
    assert plan.departure.handoff_deg == pytest.approx(60)
    apart = needle_tips(demo.tip_mm[-1:], demo.rotation_xyzw[:1]) - needle_tips(
        demo.tip_mm[-1:], demo.rotation_xyzw[-1:]
    )
    assert plan.departure.handoff_needle_tip_mm == pytest.approx(np.linalg.norm(apart, axis=2).max())
    assert 10 < plan.departure.needle_tip_mm < 17
    assert departure_of(replace(demo, rotation_xyzw=None)) is None


def test_the_needles_free_end_by_hand():
    # a third of a circle from the grip: r sin 120 along n, r (1 - cos 120) towards the centre, 9 mm down the jaw
    there = [NEEDLE_RADIUS_MM * np.sqrt(0.75), 1.5 * NEEDLE_RADIUS_MM, HELD_MM]
    assert needle_tips_mm()[0] == pytest.approx(there)
    assert needle_tips_mm()[1] == pytest.approx([-there[0], -there[1], HELD_MM])


def test_orientation_turns_with_its_suture_point():
    demo, policy = turning()
    point = SuturePoint((10.0, 60.0, -120.0), QUARTER_ABOUT_Z)
    one, other = (stack(policy, [p], demo=demo).passes[0] for p in (SuturePoint(point.position_mm), point))
    turned = matrix_of([QUARTER_ABOUT_Z])[0]
    assert matrix_of(other.hand.rotation_xyzw) == pytest.approx(turned @ matrix_of(one.hand.rotation_xyzw), abs=1e-9)
    assert other.hand.tip_mm - point.position_mm == pytest.approx(
        (one.hand.tip_mm - point.position_mm) @ turned.T, abs=1e-9
    )
    assert other.tip_mm[-1] == pytest.approx(point.position_mm)


def log_dimensionless_jerk(seconds, tip_mm):
    """Return the smoothness of a motion at 100 samples a second: 0 is none, and a greater number is smoother."""
    even = np.linspace(seconds[0], seconds[-1], int((seconds[-1] - seconds[0]) * 100))
    tip = np.stack([np.interp(even, seconds, axis) for axis in tip_mm.T], axis=1)
    step = even[1] - even[0]
    peak = np.linalg.norm(np.diff(tip, axis=0), axis=1).max() / step
    jerk = np.diff(tip, 3, axis=0) / step**3
    return -np.log((jerk**2).sum() * step * (even[-1] - even[0]) ** 3 / peak**2)


@pytest.mark.parametrize("name", ["kestrel-simple-running", "heron-simple-running", "wren-simple-running"])
def test_it_is_no_less_smooth_than_the_surgeons_motion_without_tremor(name):
    demo, policy = shipped(name, 0)
    (only,) = stack(policy, [SuturePoint(tuple(demo.tip_mm[-1].tolist()))], demo=demo).passes
    calm = smoothed_tip(demo.stamps_s, demo.tip_mm, TREMOR_S)
    assert log_dimensionless_jerk(only.hand.seconds, only.hand.tip_mm) >= log_dimensionless_jerk(*calm)


def test_a_rollout_that_leaves_out_a_loop_loses_no_time_for_it():
    """The hand goes 5 mm out and back in 4 s, then 20 mm up in 2 s; the rollout goes up at once."""
    seconds = np.arange(0, 6.001, 0.02)
    out = stroke(seconds, 0, 2) - stroke(seconds, 2, 4)
    tip = np.array([0.0, 50.0, -140.0]) + np.stack((5 * out, 0 * out, 20 * stroke(seconds, 4, 6)), axis=1)
    demo = Demo("PSM2", "/t", "PSM2_base", 0.0, 6.0, seconds, tip)
    path = discretize(tip, PAPER_GRID)
    assert path.states[0] == path.states[2]
    directly = path.states[2:]
    fitted = fit_to_demo(Rollout(path, directly, np.zeros(len(directly), np.int64), True), trace(demo, path))
    hand = hand_along(demo, fitted, turning=False)
    assert hand.duration_s < 2.5
    slow = speeds(hand.tip_mm) / np.diff(hand.seconds) < 0.5  # mm/s
    assert np.diff(hand.seconds)[slow].sum() < 0.6


def test_a_start_off_the_path_approaches_with_the_jaw_it_joins_with():
    demo, policy = turning()
    start = demo.tip_mm[0] + [-4.0, 14.0, 6.0]
    plan = stack(policy, [SuturePoint(tuple(demo.tip_mm[-1].tolist()))], demo=demo, starts_mm=[start])
    (one,) = plan.passes
    assert one.hand.tip_mm[0] == pytest.approx(start)
    assert one.hand.tip_mm[-1] == pytest.approx(demo.tip_mm[-1])
    held = matrix_of(one.hand.rotation_xyzw[:40])
    assert np.degrees(angle_between(held, held[:1].repeat(40, 0))).max() < 3
    assert matrix_of(one.hand.rotation_xyzw[-1:])[0] == pytest.approx(matrix_of(demo.rotation_xyzw[-1:])[0], abs=1e-8)
    motion = time_parametrise(plan.passes, rate_hz=RATE_HZ)
    assert motion.speed_ratio <= 1 and motion.acceleration_ratio <= 1


def test_positions_alone_keep_the_jaw_and_say_so():
    demo, policy = turning()
    bare = replace(demo, rotation_xyzw=None, jaw_rad=None)
    plan = stack(policy, [SuturePoint(tuple(demo.tip_mm[-1].tolist()))], demo=bare)
    motion = time_parametrise(plan.passes, rate_hz=RATE_HZ)
    assert (plan.orientation, plan.departure, motion.jaw_rad) == ("assumed tool-down", None, None)
    assert matrix_of(motion.rotation_xyzw) == pytest.approx(np.tile(POINTING_DOWN, (len(motion), 1, 1)), abs=1e-9)
    with pytest.raises(BadPlan, match="no orientation"):
        stack(policy, [SuturePoint((5.0, 55.0, -120.0))], demo=bare, orientation="recorded")


def test_an_orientation_out_of_reach_is_refused_with_place_and_joint():
    demo, policy = turning()
    over = matrix_of([[np.sin(1.3), 0.0, 0.0, np.cos(1.3)]])[0] @ POINTING_DOWN  # the wrist cannot turn by 149 degrees
    part = stroke(demo.stamps_s, 0, 5)
    beyond = replace(demo, rotation_xyzw=quaternion_of(turn(POINTING_DOWN, over, part)))
    plan = stack(policy, [SuturePoint(tuple(demo.tip_mm[-1].tolist()))], demo=beyond)
    with pytest.raises(Unreachable, match=r"Pass 0, A1: Sample \d+ at \(.*\) mm") as refused:
        time_parametrise(plan.passes, rate_hz=RATE_HZ)
    assert refused.value.numbers["joint"]
    assert driven_pass(policy, beyond).beyond > 0
    assert driven_pass(policy, demo).beyond == 0
    assert driven_pass(policy, demo).orientation == "recorded"


# ---- A2 ---------------------------------------------------------------------------------------------------------


def recorded_psm_m() -> PsmM:
    """Return PSM_M 12 mm beside the hand-off, as a recording shows it."""
    demo, _ = turning()
    x, y, z = (demo.tip_mm[-1] + [12.0, 3.0, -6.0]).tolist()
    towards = matrix_of([[0.0, np.sin(-np.pi / 3), 0.0, np.cos(-np.pi / 3)]])
    q = tuple(quaternion_of(towards)[0].tolist())
    return PsmM(tuple(towards[0][:, 2].tolist()), taken_mm=(x, y, z), taken_xyzw=q)


def test_a2_ends_in_the_recorded_hand_off_where_it_was_recorded():
    demo, policy = turning()
    psm_m = recorded_psm_m()
    motion, plan = at_home(psm_m=psm_m)
    assert plan.a2 == "recorded"
    assert matrix_of(motion.rotation_xyzw[-1:]) == pytest.approx(matrix_of(demo.rotation_xyzw[-1:]), abs=1e-8)
    assert motion.taking.tip_mm[0] == pytest.approx(psm_m.taken_mm, abs=1e-6)
    point = SuturePoint((10.0, 60.0, -120.0), QUARTER_ABOUT_Z)
    (moved,) = stack(policy, [point], demo=demo, psm_m=psm_m).passes
    turned = matrix_of([QUARTER_ABOUT_Z])[0]
    apart = turned @ (np.array(psm_m.taken_mm) - demo.tip_mm[-1])
    assert moved.taking.tip_mm - moved.tip_mm[-1] == pytest.approx(apart, abs=1e-6)


def test_a2_of_the_paper_turns_from_the_recorded_end():
    motion, plan = at_home(psm_m=recorded_psm_m(), a2="paper")
    assert plan.a2 == "paper"
    assert abs(matrix_of(motion.rotation_xyzw[-1:])[0][:, 0] @ plan.psm_m.approach) == pytest.approx(1, abs=1e-6)
    assert (motion.phase == A2).any()
    begin = np.flatnonzero(motion.phase == A1)[-1]
    demo, _ = turning()
    assert matrix_of(motion.rotation_xyzw[[begin]]) == pytest.approx(matrix_of(demo.rotation_xyzw[-1:]), abs=1e-8)


def test_held_until_a2_the_jaw_then_turns_to_the_recorded_hand_off():
    demo, _ = turning()
    motion, plan = at_home(psm_m=recorded_psm_m(), orientation="constant")
    assert (plan.a2, plan.orientation) == ("recorded", "demonstrated")
    assert matrix_of(motion.rotation_xyzw[-1:]) == pytest.approx(matrix_of(demo.rotation_xyzw[-1:]), abs=1e-8)


def test_a_hand_off_that_was_not_recorded_is_the_papers():
    _, plan = at_home(psm_m=PsmM((0.6, 0.0, -0.8)))
    assert plan.a2 == "paper"
    with pytest.raises(BadPlan, match="was not recorded"):
        at_home(psm_m=PsmM((0.6, 0.0, -0.8)), a2="recorded")
    with pytest.raises(BadPlan, match="position and a rotation"):
        PsmM((0.6, 0.0, -0.8), taken_mm=(0.0, 0.0, 0.0))


def test_the_estimate_of_success_judges_the_recorded_hand_off():
    motion, _ = at_home(psm_m=recorded_psm_m())
    few = EstimateSettings(variations=20)
    found = estimate_success(motion, approach_m=None, pad_top_mm=-170.0, settings=few)
    assert found.hand_offs == 1
    assert found.under[0].passes[0].caught is not None
    assert openings(motion.arms[0]).max() == pytest.approx(0.2)  # half of the jaw's 0.4 rad


# ---- several demonstrations, and values -------------------------------------------------------------------------


@pytest.mark.nightly
@pytest.mark.needs("recordings")
@pytest.mark.needs("jigsaws")
def test_real_hands_are_fitted_as_nearly_and_moved_as_they_were() -> None:
    from tests.bench import hands  # here, because it takes the longest to import

    demos = dict(hands.hand_offs())
    assert len(demos) >= 23  # as docs/results.md lists them
    for name, demo in demos.items():
        path = discretize(demo.tip_mm, choose_grid(demo.tip_mm))
        fit = fit_to_demo(replay(path, path.start), trace(demo, path))
        averaged = smoothed_tip(demo.stamps_s, demo.tip_mm, TREMOR_S)[1]
        assert hands.rmse_mm(fit.tip_mm, demo.tip_mm) <= hands.rmse_mm(averaged, demo.tip_mm) + 0.05, name
        hand = hand_along(demo, fit, turning=True)
        at_time, _ = hands.profile(hand.at(int(hand.duration_s * RATE_HZ) + 2)[0], demo)
        assert at_time >= 0.9, name


def test_several_demonstrations_have_the_hand_of_their_pose_style():
    demo, _ = turning()
    slower = replace(demo, stamps_s=demo.stamps_s * 1.5, end_s=7.5)
    found = styled(demo, [demo, slower])
    style = learn_pose_style([demo, slower])
    assert found.tip_mm is demo.tip_mm or (found.tip_mm == demo.tip_mm).all()
    assert found.stamps_s[-1] == pytest.approx(style.duration_s.mean(), rel=0.05)
    assert matrix_of(found.rotation_xyzw[[0, -1]]) == pytest.approx(matrix_of(demo.rotation_xyzw[[0, -1]]), abs=1e-6)
    assert styled(demo, [demo, replace(demo, rotation_xyzw=None)]).rotation_xyzw is None


def test_a_hand_is_checked():
    with pytest.raises(BadPlan, match="begin at 0"):
        Hand(np.array([0.0, 0.0]), np.zeros((2, 3)), 0.0)


def test_some_passes_with_a_hand_and_some_without_are_refused():
    _, plan = at_home()
    (one,) = plan.passes
    with pytest.raises(BadPlan, match="all passes"):
        time_parametrise([one, replace(one, hand=None)], rate_hz=RATE_HZ)
