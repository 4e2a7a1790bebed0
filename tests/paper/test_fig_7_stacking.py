"""Fig. 7: one learnt policy, its grid world stacked at successive suture points."""

import numpy as np
import pytest

from skills.errors import OutsideGrid
from skills.learning.policy import learn_tabular
from skills.learning.q_learning import PhaseQLearning
from skills.planning.plan import SuturePoint, stack

SPACING_MM = np.array([0.0, -8.0, 1.5])
EXACT_MM = 1e-9


@pytest.fixture(scope="module")
def policy(user_reward):
    return learn_tabular(user_reward, PhaseQLearning())


@pytest.fixture(scope="module")
def plan(policy):
    points = [SuturePoint(tuple(np.array([5.0, 55, -125]) + k * SPACING_MM)) for k in range(5)]
    return stack(policy, points, arm="PSM2", frame="PSM2_base", instrument="LND_400006", rotation=None)


def test_five_passes_end_at_their_five_suture_points(plan):
    for one in plan.passes:
        assert one.tip_mm[-1] == pytest.approx(one.point.position_mm, abs=EXACT_MM)


def test_every_pass_is_the_users_whole_path_moved(plan, user_path):
    for k, one in enumerate(plan.passes):
        assert one.tip_mm == pytest.approx(user_path.tip_mm + k * SPACING_MM, abs=EXACT_MM)
        assert one.states.tolist() == user_path.states.tolist()


def test_the_user_may_present_the_needle_elsewhere_on_every_pass(policy, plan, user_path):
    rng = np.random.default_rng(7)
    points = [one.point for one in plan.passes]
    starts_mm = [one.start_mm + rng.uniform(-10, 10, 3) for one in plan.passes]
    moved = stack(
        policy, points, arm="PSM2", frame="PSM2_base", instrument="LND_400006", rotation=None, starts_mm=starts_mm
    )
    for one, start_mm in zip(moved.passes, starts_mm, strict=True):
        assert one.tip_mm[0] == pytest.approx(start_mm, abs=EXACT_MM)
        assert one.tip_mm[-1] == pytest.approx(one.point.position_mm, abs=EXACT_MM)
        assert np.abs(np.diff(one.tip_mm, axis=0)).max() <= 5 + EXACT_MM  # by single cells, and to the first centre


def test_a_start_outside_its_moved_grid_is_refused_with_the_pass_number(policy, plan):
    starts_mm = [None, None, (100.0, 55.0, -125.0), None, None]
    points = [one.point for one in plan.passes]
    with pytest.raises(OutsideGrid, match="Pass 2"):
        stack(policy, points, arm="PSM2", frame="f", instrument="i", rotation=None, starts_mm=starts_mm)
