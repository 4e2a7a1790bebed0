"""Plans: grid worlds stacked at suture points, and the joint limits of the demonstrated pass."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from skills import kinematics
from skills.db.packed import digest
from skills.demonstration.demonstration import Demo
from skills.errors import BadInput, BadPlan, BadSpeed, ImproperRotation, NoApproach, OutsideGrid
from skills.gridworld.grid import discretize, fit_grid
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import certify
from skills.learning.policy import Policy, learn_tabular, rollout, rollout_from
from skills.learning.q_learning import PhaseQLearning
from skills.planning.handoff import PsmM
from skills.planning.path_fit import fit_to_demo, trace
from skills.planning.plan import MAX_OUTSIDE_MM, MAX_PASSES, SuturePoint, driven_pass, pose_xyzw, rotation_of, stack
from skills.planning.trajectory import time_parametrise
from tests.by_day import examples
from tests.gridworld.paths import learnt, named_path

NAME = "through its goal"
EXACT_MM = 1e-9
QUARTER_ABOUT_Z = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))

places_mm = st.tuples(*[st.floats(-150, 150)] * 3)
turns_xyzw = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)


def stacked(points, **given_):
    of_arm = {} if "demo" in given_ else {"arm": "PSM2", "frame": "PSM2_base", "instrument": "LND_400006"}
    settings_ = of_arm | given_
    return stack(
        given_.pop("policy", None) or learnt(NAME), points, **{k: v for k, v in settings_.items() if k != "policy"}
    )


@settings(deadline=None)
@given(places_mm, turns_xyzw)
def test_a_pass_is_the_demo_moved_rigidly_with_its_goal_on_the_point(place_mm, turn_xyzw):
    path = named_path(NAME)
    (one,) = stacked([SuturePoint(place_mm, turn_xyzw)]).passes
    turned = kinematics.matrix_of([turn_xyzw])[0]
    expected = np.array([turned @ (tip - path.tip_mm[-1]) + place_mm for tip in path.tip_mm])
    assert one.tip_mm == pytest.approx(expected, abs=EXACT_MM)
    assert one.tip_mm[-1] == pytest.approx(place_mm, abs=EXACT_MM)
    assert one.start_mm == pytest.approx(expected[0], abs=EXACT_MM)
    assert one.states.tolist() == path.states.tolist()
    assert one.rotation == pytest.approx(turned @ kinematics.POINTING_DOWN, abs=1e-12)


@settings(deadline=None)
@given(places_mm, turns_xyzw, st.integers(0, 1000), st.tuples(*[st.floats(-2.4, 2.4)] * 3))
def test_from_any_start_of_the_moved_grid_a_pass_is_the_moved_rollout(place_mm, turn_xyzw, start, off_mm):
    policy, grid = learnt(NAME), named_path(NAME).grid
    start %= grid.n_states
    turned, goal_mm = kinematics.matrix_of([turn_xyzw])[0], grid.centres_mm(policy.path.goal)
    start_mm = turned @ (grid.centres_mm(start) + off_mm - goal_mm) + place_mm
    (one,) = stacked([SuturePoint(place_mm, turn_xyzw)], starts_mm=[start_mm]).passes
    moved = (rollout_from(policy, start).tip_mm - goal_mm) @ turned.T + place_mm
    assert one.tip_mm[0] == pytest.approx(start_mm, abs=EXACT_MM)
    assert one.tip_mm[-len(moved) :] == pytest.approx(moved, abs=EXACT_MM)
    assert len(one.tip_mm) <= len(moved) + 1


def test_a_quarter_turn_about_z_by_hand():
    path = named_path("an angle")  # along x, then along y, to its goal
    (one,) = stacked([SuturePoint((100, 200, 300), QUARTER_ABOUT_Z)], policy=learnt("an angle")).passes
    assert one.start_mm == pytest.approx((100 + 15, 200 - 15, 300), abs=EXACT_MM)
    assert one.tip_mm[3] == pytest.approx((100 + 15, 200, 300), abs=EXACT_MM)  # x became y
    assert len(one.tip_mm) == len(path.states)


def test_negative_zeros_are_the_same_point_and_start():
    plans = [
        stacked([SuturePoint((zero, 60.0, -160.0), (zero, zero, zero, 1.0))], starts_mm=[(zero, 55.0, -160.0)])
        for zero in (0.0, -0.0)
    ]
    assert digest(plans[0]) == digest(plans[1])


def test_every_pass_has_its_own_suture_point_and_start():
    path = named_path(NAME)
    points = [SuturePoint((10.0 * k, 0, -120)) for k in range(3)]
    goal_mm, far_mm = path.tip_mm[-1], path.grid.centres_mm(0)
    there = far_mm - goal_mm + points[1].position_mm
    plan = stacked(points, starts_mm=[None, there, None])
    assert [tuple(one.tip_mm[-1]) for one in plan.passes] == [
        pytest.approx(point.position_mm, abs=EXACT_MM) for point in points
    ]
    assert plan.passes[1].states[0] == 0
    assert plan.passes[0].states[0] == plan.passes[2].states[0] == path.start
    assert (plan.arm, plan.frame, plan.instrument, plan.speed_mm_s) == ("PSM2", "PSM2_base", "LND_400006", 20.0)


def test_a_start_that_is_the_centre_of_its_cell_is_not_given_twice():
    path = named_path(NAME)
    given_ = stacked([SuturePoint(tuple(path.tip_mm[-1]))], starts_mm=[path.tip_mm[0]])
    assert len(given_.passes[0].tip_mm) == len(path.states)
    beside = stacked([SuturePoint(tuple(path.tip_mm[-1]))], starts_mm=[path.tip_mm[0] + 1])
    assert len(beside.passes[0].tip_mm) == len(path.states) + 1


def test_the_jaw_is_the_demonstrated_one_where_it_is_known():
    known = kinematics.matrix_of([QUARTER_ABOUT_Z])[0] @ kinematics.POINTING_DOWN
    assert stacked([SuturePoint((0, 0, -120))]).orientation == "assumed tool-down"
    plan = stacked([SuturePoint((0, 0, -120))], rotation=known)
    assert plan.orientation == "demonstrated"
    assert plan.passes[0].rotation == pytest.approx(known, abs=1e-12)


def test_with_psm_ms_approach_the_jaws_normal_ends_parallel_to_it():
    approach_m = (0.6, 0.0, -0.8)
    plan = stacked([SuturePoint((0, 0, -120), QUARTER_ABOUT_Z)], psm_m=PsmM(approach_m))
    normal = plan.passes[0].target_rotation[:, 0]
    assert abs(normal @ approach_m) == pytest.approx(1, abs=1e-9)
    assert plan.passes[0].target_rotation[:, 2] @ approach_m == pytest.approx(0, abs=1e-9)
    assert stacked([SuturePoint((0, 0, -120))]).passes[0].target_rotation is None


def test_a_plan_is_timed_once_with_its_own_speed_and_rate():
    plan = stacked(
        [SuturePoint((0, 0, -120)), SuturePoint((8, 0, -120))],
        psm_m=PsmM((1.0, 0, 0)),
        rate_hz=100.0,
        instrument="400006",
    )
    asked = {"speed_mm_s": plan.speed_mm_s, "rate_hz": 100.0, "instrument": plan.instrument, "psm_m": plan.psm_m}
    assert plan.trajectory.joints.tobytes() == time_parametrise(plan.passes, **asked).joints.tobytes()
    assert plan.trajectory is plan.trajectory


# ---- fitted to the demonstration --------------------------------------------------------------------------------


def hand_along(name):
    """Return a hand that moves through the cells of a path, 1 mm from their centres, in 0.25 s each."""
    path = named_path(name)
    tip_mm = np.repeat(path.tip_mm + np.array([1.0, -1.0, 1.0]), 25, axis=0)
    stamps = np.arange(len(tip_mm)) / 100
    return Demo("PSM2", "/t", "PSM2_base", 0.0, float(stamps[-1]), stamps, tip_mm)


@examples(30)
@given(places_mm, turns_xyzw, st.integers(0, 1000), st.tuples(*[st.floats(-2.4, 2.4)] * 3))
def test_with_its_demonstration_a_pass_is_the_fitted_path_moved(place_mm, turn_xyzw, start, off_mm):
    policy, grid, demo = learnt(NAME), named_path(NAME).grid, hand_along(NAME)
    turned, goal_mm = kinematics.matrix_of([turn_xyzw])[0], demo.tip_mm[-1]
    here_mm = grid.centres_mm(start % grid.n_states) + off_mm
    start_mm = turned @ (here_mm - goal_mm) + place_mm
    plan = stacked([SuturePoint(place_mm, turn_xyzw)] * 2, starts_mm=[None, start_mm], demo=demo)
    for one, from_mm in zip(plan.passes, (None, here_mm), strict=True):
        followed = rollout(policy, demo.tip_mm[0] if from_mm is None else from_mm)
        fit = fit_to_demo(followed, trace(demo, policy.path), from_mm)
        assert one.tip_mm == pytest.approx((fit.tip_mm - goal_mm) @ turned.T + place_mm, abs=1e-5)
        assert one.states.tolist() == followed.states.tolist()
        assert one.tip_mm[-1] == pytest.approx(place_mm, abs=EXACT_MM)
        assert one.tip_mm[0] == pytest.approx(one.start_mm, abs=EXACT_MM)


# ---- starts outside, and the place of the tip -------------------------------------------------------------------


@examples(40)
@given(places_mm, turns_xyzw, st.tuples(*[st.floats(-75, 75)] * 3))
def test_a_pass_from_outside_its_grid_enters_at_the_nearest_place(place, turn, off_mm):
    policy, grid = learnt(NAME), named_path(NAME).grid
    low, high = grid.centres_mm(0), grid.centres_mm(grid.n_states - 1)
    here = (low + high) / 2 + off_mm
    entered = np.clip(here, low, high)
    outside_mm = np.linalg.norm(here - entered)
    turned, goal_mm = kinematics.matrix_of([turn])[0], policy.path.tip_mm[-1]
    start_mm = turned @ (here - goal_mm) + place
    if outside_mm > MAX_OUTSIDE_MM + 1e-6:
        with pytest.raises(OutsideGrid, match="Pass 0 starts outside"):
            stacked([SuturePoint(place, turn)], starts_mm=[start_mm])
        return
    if outside_mm > MAX_OUTSIDE_MM - 1e-6:
        return
    (one,) = stacked([SuturePoint(place, turn)], starts_mm=[start_mm]).passes
    inside = np.abs(here - entered).max() < grid.cell_mm / 2 - 1e-6
    assert one.start_mm == pytest.approx(start_mm, abs=1e-9)
    if inside or outside_mm > grid.cell_mm:
        begin = here if inside else entered
        assert one.tip_mm[0] == pytest.approx(turned @ (begin - goal_mm) + place, abs=1e-9)
        assert one.states.tolist() == rollout(policy, begin).states.tolist()


def test_the_nearest_place_is_worked_by_hand():
    grid = named_path(NAME).grid  # its centres end at `high`
    high = grid.centres_mm(grid.n_states - 1)
    off = np.array([30.0, 0.0, 40.0])
    at_home = [SuturePoint(tuple(named_path(NAME).tip_mm[-1]))]
    plan = stacked(at_home, starts_mm=[high + off])
    assert plan.passes[0].tip_mm[0] == pytest.approx(high)
    assert plan.passes[0].start_mm == pytest.approx(high + off)
    with pytest.raises(OutsideGrid, match=r"50\.1 mm from it") as refused:
        stacked(at_home, starts_mm=[high + 1.002 * off])
    assert refused.value.numbers["outside_mm"] == pytest.approx(50.1)


def test_a_suture_point_may_be_where_the_finger_tips_go():
    point, start = SuturePoint((0.0, 50.0, -130.0), QUARTER_ABOUT_Z), (5.0, 50.0, -130.0)
    hinge = stacked([point], starts_mm=[start])
    fingers = stacked([point], starts_mm=[start], tip_offset_mm=kinematics.JAW_TIP_MM)
    up = np.array([0.0, 0.0, kinematics.JAW_TIP_MM])  # the tool points down, so the hinge is above the requested point
    for one, other in zip(hinge.passes, fingers.passes, strict=True):
        assert other.tip_mm == pytest.approx(one.tip_mm + up, abs=1e-9)
        assert other.start_mm == pytest.approx(one.start_mm + up, abs=1e-9)
        assert other.point == one.point
        assert other.tip_mm[-1] + kinematics.JAW_TIP_MM * other.rotation[:, 2] == pytest.approx(
            point.position_mm, abs=1e-9
        )
    assert (hinge.tip_offset_mm, fingers.tip_offset_mm) == (0.0, kinematics.JAW_TIP_MM)


@pytest.mark.parametrize("wrong", [{"tip_offset_mm": -1.0}, {"tip_offset_mm": 51.0}, {"tip_offset_mm": np.nan}])
def test_an_offset_that_no_instrument_has_is_refused(wrong):
    with pytest.raises(BadPlan, match="offset"):
        stacked([SuturePoint((0, 0, -120))], **wrong)


@pytest.mark.parametrize("rate_hz", [99.0, 201.0, np.nan, np.inf])
def test_a_plan_is_sampled_at_100_to_200_hz(rate_hz):
    with pytest.raises(BadSpeed, match="100 to 200"):
        stacked([SuturePoint((0, 0, -120))], rate_hz=rate_hz)


def test_a_plan_says_which_path_it_has():
    assert stacked([SuturePoint((0, 0, -120))]).path == "cell centres"
    assert stacked([SuturePoint((0, 0, -120))], demo=hand_along(NAME)).path == "fitted"


def test_arm_frame_instrument_and_rotation_are_the_demonstrations():
    policy, without = learnt(NAME), hand_along(NAME)
    demo = replace(without, rotation_xyzw=np.tile(QUARTER_ABOUT_Z, (len(without.tip_mm), 1)))
    point = SuturePoint((0.0, 55.0, -120.0))
    short = stack(policy, [point], demo=demo)
    long = stack(
        policy,
        [point],
        demo=demo,
        arm=demo.arm,
        frame=demo.frame,
        instrument=demo.instrument,
        rotation=rotation_of(demo.rotation_xyzw),
    )
    assert digest(replace(short, orientation="demonstrated", departure=long.departure, passes=())) == digest(
        replace(long, passes=())
    )
    assert [digest(replace(one.hand, rotation_xyzw=None)) for one in short.passes] == [
        digest(one.hand) for one in long.passes
    ]
    assert (short.orientation, long.orientation) == ("recorded", "demonstrated")
    assert (short.arm, short.frame, short.instrument) == (demo.arm, demo.frame, demo.instrument)


@pytest.mark.parametrize("other", [{"arm": "PSM9"}, {"frame": "ECM"}, {"instrument": "1"}])
def test_another_arm_frame_or_instrument_beside_a_demo_is_refused(other):
    with pytest.raises(BadPlan, match="Omit it"):
        stack(learnt(NAME), [SuturePoint((0.0, 55.0, -120.0))], demo=hand_along(NAME), **other)


def test_without_a_demonstration_the_arm_has_to_be_given():
    with pytest.raises(BadPlan, match="demo="):
        stack(learnt(NAME), [SuturePoint((0.0, 55.0, -120.0))])


def test_a_suture_point_that_is_a_tuple_is_refused_in_words():
    with pytest.raises(BadPlan, match=r"SuturePoint\(\(x, y, z\)\)"):
        stacked([(0.0, 55.0, -120.0)])


def test_a_plan_with_anothers_demonstration_is_refused():
    with pytest.raises(BadPlan, match="not learnt from this demonstration"):
        stacked([SuturePoint((0, 0, -120))], demo=hand_along("an angle"))


# ---- refused ----------------------------------------------------------------------------------------------------


def test_a_start_outside_its_grid_is_refused_with_the_pass_number():
    points = [SuturePoint((0, 0, -120)), SuturePoint((8, 0, -120))]
    with pytest.raises(OutsideGrid, match="Pass 1 starts outside its grid world") as refusal:
        stacked(points, starts_mm=[None, (500, 0, 0)])
    assert (refusal.value.numbers["pass"], refusal.value.numbers["limit_mm"]) == (1, 50.0)


@pytest.mark.parametrize("starts_mm", [[], [None], [None, None, None]])
def test_as_many_starts_as_points_are_wanted(starts_mm):
    with pytest.raises(BadPlan, match="one start for each suture point"):
        stacked([SuturePoint((0, 0, -120)), SuturePoint((8, 0, -120))], starts_mm=starts_mm)


@pytest.mark.parametrize("count", [0, MAX_PASSES + 1])
def test_a_plan_has_1_to_200_points(count):
    with pytest.raises(BadPlan, match="1 to 200"):
        stacked([SuturePoint((0, 0, -120))] * count)


def test_a_start_from_which_the_policy_does_not_arrive_is_refused():
    policy = learnt(NAME)
    q = policy.q.copy()
    q[policy.row(1, policy.path.start), 13] = 100  # it stands still at its start
    with pytest.raises(BadPlan, match="pass 0 does not reach the goal"):
        stacked([SuturePoint((0, 0, -120))], policy=replace(policy, q=q))


@pytest.mark.parametrize("wrong", [(np.nan, 0, 0), (0, np.inf, 0), (0, 0)])
def test_places_that_are_none_are_refused(wrong):
    with pytest.raises(BadInput):
        stacked([SuturePoint(wrong)])
    with pytest.raises(BadInput):
        stacked([SuturePoint((0, 0, -120))], starts_mm=[wrong])


def test_a_turn_that_is_none_is_refused():
    with pytest.raises(ImproperRotation):
        stacked([SuturePoint((0, 0, -120), (0, 0, 0, 0))])
    with pytest.raises(NoApproach):
        stacked([SuturePoint((0, 0, -120))], psm_m=PsmM((0, 0, 0)))


# ---- rotations --------------------------------------------------------------------------------------------------


@given(turns_xyzw)
def test_a_rotation_written_as_a_quaternion_is_the_same_rotation(turn_xyzw):
    rotation = rotation_of(np.array([turn_xyzw, (0, 0, 0, 1)]))
    assert kinematics.matrix_of([pose_xyzw(rotation)])[0] == pytest.approx(rotation, abs=1e-12)


def test_a_demonstration_without_orientations_has_no_rotation():
    assert rotation_of(None) is None


def test_the_unturned_rollout_is_where_it_was_learnt():
    path = named_path(NAME)
    (one,) = stacked([SuturePoint(tuple(path.tip_mm[-1]))]).passes
    assert one.tip_mm == pytest.approx(rollout(learnt(NAME), path.tip_mm[0]).tip_mm, abs=EXACT_MM)


Z_MM = -112.4


def demonstrated(y_mm: float) -> Demo:
    """Record a walk out to y and then down, in the plane x = 0, with the jaw straight down."""
    corners = np.array([[0, 100, Z_MM], [0, y_mm, Z_MM], [0, y_mm, -140]], dtype=float)
    legs = [np.linspace(a, b, round(np.linalg.norm(b - a) * 5)) for a, b in pairwise(corners)]
    tip = np.concatenate(legs)
    return Demo(
        arm="PSM2",
        topic="/PSM2/local/measured_cp",
        frame="PSM2_base",
        instrument="400006",
        start_s=0.0,
        end_s=(len(tip) - 1) / 50,
        stamps_s=np.arange(len(tip)) / 50,
        tip_mm=tip,
        rotation_xyzw=np.tile(kinematics.quaternion_of(kinematics.POINTING_DOWN[None]), (len(tip), 1)),
    )


def learnt_from(demo: Demo) -> Policy:
    policy = learn_tabular(sparse_reward(discretize(demo.tip_mm, fit_grid(demo.tip_mm))), PhaseQLearning())
    assert certify(policy)[0].demonstration_reproduced
    return policy


def searched_mm(tip_mm: np.ndarray) -> float:
    """Search joints within the limits for the pose with the jaw down; return the best error found, mm and 10 mrad."""
    lower, upper = np.array(kinematics.CLASSIC.lower), np.array(kinematics.CLASSIC.upper)

    def off(joints: np.ndarray) -> np.ndarray:
        tip, rotation = kinematics.forward(joints[None])
        return np.concatenate([tip[0] - tip_mm, 100 * (rotation[0] - kinematics.POINTING_DOWN).ravel()])

    begin = np.array([0.0, -0.8, 150.0, 0.0, 0.8, 0.0])
    return float(np.linalg.norm(least_squares(off, begin, bounds=(lower, upper), x_scale=upper - lower).fun))


@pytest.mark.parametrize(("y_mm", "within"), [(135.0, True), (138.5, False)])
def test_a_search_for_joints_agrees_at_the_place_that_is_named(y_mm: float, within: bool):
    demo = demonstrated(y_mm)
    driven = driven_pass(learnt_from(demo), demo)
    assert (driven.beyond == 0) == within
    assert (searched_mm(np.array(driven.nearest_limit.tip_mm)) < 1e-3) == within
    assert (driven.nearest_limit.margin > 0) == within


def test_driven_places_lie_near_the_demo_and_the_ends_are_the_policys():
    demo = demonstrated(135.0)
    policy = learnt_from(demo)
    driven = driven_pass(policy, demo)
    length_mm = np.linalg.norm(np.diff(policy.path.tip_mm, axis=0), axis=1).sum()
    assert driven.path == "fitted"
    assert driven.samples > length_mm / 0.2  # some 0.1 mm apart; a little shorter than through the centres
    off_mm = np.linalg.norm(demo.tip_mm - np.array(driven.nearest_limit.tip_mm), axis=1).min()
    assert off_mm < 5 * 3**0.5 / 2  # half a cell's diagonal


def test_a_path_of_other_samples_is_driven_through_its_centres_and_says_so():
    demo = demonstrated(135.0)
    policy = learnt_from(demo)
    other = replace(demo, tip_mm=demo.tip_mm + np.array([0.0, 0.0, -5.0]))
    driven = driven_pass(policy, other)
    assert driven.path == "cell centres"
    assert driven.beyond >= driven.cell_centres_beyond > 0  # and places between the centres are checked as well


def test_a_pass_that_does_not_reach_its_goal_cannot_be_driven():
    demo = demonstrated(135.0)
    policy = learnt_from(demo)
    lost = Policy(policy.path, policy.levels, policy.learner, 0, policy.training, np.zeros_like(policy.q))
    with pytest.raises(BadPlan, match="does not reach the goal"):
        driven_pass(lost, demo)


def test_a_place_without_joints_is_beyond_all_others():
    tip_mm = np.array([[0.0, 0.0, -400.0], [0.0, 50.0, -120.0]])
    solutions = kinematics.solutions_of(
        tip_mm, np.stack([kinematics.POINTING_DOWN] * 2), kinematics.instrument_of("400006")
    )
    assert kinematics._nearest_limit(tip_mm, solutions, kinematics.instrument_of("400006")).tip_mm == (0.0, 0.0, -400.0)
    solutions[1] = np.nan
    nearest = kinematics._nearest_limit(tip_mm, solutions, kinematics.instrument_of("400006"))
    assert nearest.tip_mm == (0.0, 50.0, -120.0)
    assert nearest.value is nearest.margin is None
