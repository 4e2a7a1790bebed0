"""Joining a path of poses without a phase: by the version's rule, and how much of the path is left."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import OutsideGrid
from skills.learning.certificate import NearLimits
from skills.learning.pose_step import near_share, next_pose
from skills.learning.pose_style import PHASES, PosePath
from skills.learning.tube import CertifiedPoses, certify_tube
from skills.learning.tube_certificate import TubeLimits
from skills.library.policies.gate import pose_refusals
from tests.by_day import examples
from tests.learning.test_tube import a_path

DOWN = np.tile([0.0, 0.0, 0.0, 1.0], (PHASES, 1))
NEAR = NearLimits()


def coming_back(beside_mm: float = 2.0) -> PosePath:
    """Return a loop of 40 mm that comes back beside its start after 70 of 100 phases, and goes on."""
    phase = np.linspace(0.0, 1.0, PHASES)
    angle = np.minimum(phase / 0.7, 1.0) * 2 * np.pi
    tip = np.stack(
        [20 * np.sin(angle), 20 - 20 * np.cos(angle), -150 + beside_mm * np.minimum(phase / 0.7, 1.0)], axis=1
    )
    tip[phase > 0.7] += np.outer(60 * (phase[phase > 0.7] - 0.7), [0.0, 0.0, 1.0])
    spread = np.zeros(PHASES)
    return replace(a_path(), tip_mm=tip, rotation_xyzw=DOWN, spread_mm=spread, spread_rad=spread)


def ball(count: int, radius_mm: float) -> np.ndarray:
    """Return places in a ball about 0, shape (count, 3)."""
    rng = np.random.default_rng(7)
    away = rng.normal(size=(count, 3))
    return away / np.linalg.norm(away, axis=1, keepdims=True) * radius_mm * rng.random((count, 1)) ** (1 / 3)


def joined(path: PosePath, tip_mm: np.ndarray, limits: TubeLimits) -> int:
    return next_pose(path, tip_mm, path.rotation_xyzw[0], None, replace(limits, step_mm=1.5)).phase


def test_the_rule_nearest_leaves_out_what_comes_before_the_nearest_pose():
    path, limits = coming_back(), TubeLimits()
    late = [k for k in (joined(path, path.tip_mm[0] + one, limits) for one in ball(300, 3.0)) if k > 50]
    assert late, "a defect that nobody sees is none"
    assert near_share(path, limits, 3.0) <= 1 - max(late) / 100 + 0.02


@pytest.mark.parametrize("share", [0.5, 0.8, 1.0])
def test_a_start_without_a_phase_joins_where_the_rule_allows(share: float):
    path, limits = coming_back(), TubeLimits(join_share=share)
    for one in ball(300, 20.0):
        step = next_pose(path, path.tip_mm[0] + one, path.rotation_xyzw[0], None, limits)
        assert step.phase <= round((1 - share) * 100) + 1
        assert step.share_left == pytest.approx(1 - step.phase / 100)
    assert near_share(path, limits, 3.0) >= share


@given(radius_mm=st.floats(0.5, 6.0), beside_mm=st.floats(0.0, 12.0), seed=st.integers(0, 99))
@examples(20)
def test_no_start_near_the_first_pose_follows_less_than_is_stated(radius_mm, beside_mm, seed):
    path, limits = coming_back(beside_mm), TubeLimits()
    stated = near_share(path, limits, radius_mm)
    places = np.random.default_rng(seed).permutation(ball(400, radius_mm))[:40]
    follows = [1 - joined(path, path.tip_mm[0] + one, limits) / 100 for one in places]
    assert min(follows) >= stated - 0.07  # a lattice of a sixth of the radius, and one tick


def test_the_gate_refuses_a_pose_style_that_is_joined_at_its_end():
    path = coming_back()
    for limits, refused in ((TubeLimits(), True), (TubeLimits(join_share=0.5), False)):
        reasons = pose_refusals(CertifiedPoses("PSM2", "PSM2_base", path, certify_tube(path, limits)), NEAR)
        assert [one.kind for one in reasons] == ["near starts"] * refused
    assert (
        pose_refusals(CertifiedPoses("PSM2", "PSM2_base", a_path(), certify_tube(a_path(), TubeLimits())), NEAR) == []
    )
    assert pose_refusals(None, NEAR) == []


def test_a_position_in_metres_is_not_followed():
    path = coming_back()
    with pytest.raises(OutsideGrid, match="metres"):
        next_pose(path, path.tip_mm[3] / 1000, path.rotation_xyzw[0], 3, TubeLimits())
