"""Joint limits of the demonstrated pass in closed form, compared with a search for joints that does not use it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares

from skills.demonstration.demonstration import Demo
from skills.errors import BadPlan
from skills.gridworld.grid import discretize, fit_grid
from skills.gridworld.reward import sparse_reward
from skills.kinematics import (
    CLASSIC,
    POINTING_DOWN,
    _nearest_limit,
    forward,
    instrument_of,
    quaternion_of,
    solutions_of,
)
from skills.learning.certificate import certify
from skills.learning.policy import Policy, learn_tabular
from skills.learning.q_learning import PhaseQLearning
from skills.planning.plan import driven_pass

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
        rotation_xyzw=np.tile(quaternion_of(POINTING_DOWN[None]), (len(tip), 1)),
    )


def learnt(demo: Demo) -> Policy:
    policy = learn_tabular(sparse_reward(discretize(demo.tip_mm, fit_grid(demo.tip_mm))), PhaseQLearning())
    assert certify(policy)[0].demonstration_reproduced
    return policy


def searched_mm(tip_mm: np.ndarray) -> float:
    """Search joints within the limits for the pose with the jaw down; return the best error found, mm and 10 mrad."""
    lower, upper = np.array(CLASSIC.lower), np.array(CLASSIC.upper)

    def off(joints: np.ndarray) -> np.ndarray:
        tip, rotation = forward(joints[None])
        return np.concatenate([tip[0] - tip_mm, 100 * (rotation[0] - POINTING_DOWN).ravel()])

    begin = np.array([0.0, -0.8, 150.0, 0.0, 0.8, 0.0])
    return float(np.linalg.norm(least_squares(off, begin, bounds=(lower, upper), x_scale=upper - lower).fun))


@pytest.mark.parametrize(("y_mm", "within"), [(135.0, True), (138.5, False)])
def test_a_search_for_joints_agrees_at_the_place_that_is_named(y_mm: float, within: bool):
    demo = demonstrated(y_mm)
    driven = driven_pass(learnt(demo), demo)
    assert (driven.beyond == 0) == within
    assert (searched_mm(np.array(driven.nearest_limit.tip_mm)) < 1e-3) == within
    assert (driven.nearest_limit.margin > 0) == within


def test_driven_places_lie_near_the_demo_and_the_ends_are_the_policys():
    demo = demonstrated(135.0)
    policy = learnt(demo)
    driven = driven_pass(policy, demo)
    length_mm = np.linalg.norm(np.diff(policy.path.tip_mm, axis=0), axis=1).sum()
    assert driven.path == "fitted"
    assert driven.samples > length_mm / 0.2  # some 0.1 mm apart; a little shorter than through the centres
    off_mm = np.linalg.norm(demo.tip_mm - np.array(driven.nearest_limit.tip_mm), axis=1).min()
    assert off_mm < 5 * 3**0.5 / 2  # half a cell's diagonal


def test_a_path_of_other_samples_is_driven_through_its_centres_and_says_so():
    demo = demonstrated(135.0)
    policy = learnt(demo)
    other = replace(demo, tip_mm=demo.tip_mm + np.array([0.0, 0.0, -5.0]))
    driven = driven_pass(policy, other)
    assert driven.path == "cell centres"
    assert driven.beyond >= driven.cell_centres_beyond > 0  # and places between the centres are checked as well


def test_a_pass_that_does_not_reach_its_goal_cannot_be_driven():
    demo = demonstrated(135.0)
    policy = learnt(demo)
    lost = Policy(policy.path, policy.levels, policy.learner, 0, policy.training, np.zeros_like(policy.q))
    with pytest.raises(BadPlan, match="does not reach the goal"):
        driven_pass(lost, demo)


def test_a_place_without_joints_is_beyond_all_others():
    tip_mm = np.array([[0.0, 0.0, -400.0], [0.0, 50.0, -120.0]])
    solutions = solutions_of(tip_mm, np.stack([POINTING_DOWN] * 2), instrument_of("400006"))
    assert _nearest_limit(tip_mm, solutions, instrument_of("400006")).tip_mm == (0.0, 0.0, -400.0)
    solutions[1] = np.nan
    nearest = _nearest_limit(tip_mm, solutions, instrument_of("400006"))
    assert nearest.tip_mm == (0.0, 50.0, -120.0)
    assert nearest.value is nearest.margin is None
