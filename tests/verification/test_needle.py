"""The needle in the jaws that hold it."""

from dataclasses import replace

import numpy as np
import pytest

from skills.kinematics import POINTING_DOWN, quaternion_of
from skills.planning.handoff import NEEDLE_RADIUS_MM
from skills.planning.trajectory import TRANSFER, PassPath, time_parametrise
from skills.verification.clearance import needle_poses, needle_to_pad_mm
from tests.bench.playing import stacked

PAD_MM = np.array([0.0, 55.0, -150.0])
LEVEL = time_parametrise([PassPath([[0, 55, -135], [0, 55, -130]], POINTING_DOWN)], rate_hz=60.0)


def test_a_downward_needle_lies_level_9_mm_below_the_hinge():
    found = needle_to_pad_mm(LEVEL, np.array([0, len(LEVEL) - 1]), PAD_MM)
    np.testing.assert_allclose(found, [15.0 - 9.0 - 0.33, 20.0 - 9.0 - 0.33], atol=1e-9)


@pytest.mark.parametrize(("centre", "lowest_mm"), [(1.0, 0.0), (-1.0, 1.5 * NEEDLE_RADIUS_MM)])
def test_on_its_edge_it_reaches_down_as_far_as_its_arc_does(centre, lowest_mm):
    """Held along x, the approach along -y, the arc's centre above or below; two thirds of it are on one side."""
    upright = np.array([[centre, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, centre, 0.0]])
    edge = replace(LEVEL, rotation_xyzw=np.tile(quaternion_of(upright[None]), (len(LEVEL), 1)))
    [found] = needle_to_pad_mm(edge, np.array([0]), PAD_MM)
    assert found == pytest.approx(15.0 - lowest_mm - 0.33, abs=1e-9)


def test_inside_the_pad_it_is_negative():
    level = time_parametrise([PassPath([[0, 55, -145], [0, 55, -140]], POINTING_DOWN)], rate_hz=60.0)
    assert needle_to_pad_mm(level, np.array([0]), PAD_MM)[0] == pytest.approx(-4.0 - 0.33, abs=1e-9)


def test_after_the_hand_off_the_needle_follows_psm_m_to_the_next_pass():
    trajectory = stacked(passes=2, rate_hz=60.0)
    end = int(trajectory.last_samples[0])
    place, rotation = needle_poses(trajectory, np.arange(len(trajectory)))
    away = np.flatnonzero((trajectory.phase == TRANSFER) & (trajectory.pass_index == 1))
    np.testing.assert_allclose(place[end + 1], place[end], atol=1e-6)  # the arms stand still there
    alone = needle_poses(replace(trajectory, psm_m=None), away)[0]
    assert np.linalg.norm(place[away] - alone, axis=1).max() > 10.0  # mm: PSM_M holds it
    turned = rotation @ np.swapaxes(rotation, 1, 2)
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-9)
