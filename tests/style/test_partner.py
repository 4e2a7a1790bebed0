"""The other arm at the hand-off, told only where it can be."""

from dataclasses import replace

import numpy as np
import pytest

from skills.style.demo import cut_demo, propose_segments
from skills.style.kinematics import matrix_of
from tests.style import sessions
from tests.style.sessions import A, Kind, M, session


@pytest.fixture(scope="module")
def recorded():
    return session(Kind(seed=4, passes=2))


def cut(value, topic=None):
    segment = propose_segments(value, A)[0]
    return cut_demo(value, arm=A, topic=topic, start_s=segment.start_s, end_s=segment.end_s)


def test_where_both_arms_are_in_one_frame_the_other_ones_pose_is_kept(recorded):
    value, _ = recorded
    demo = cut(value, f"/{A}/measured_cp")
    assert demo.frame == "ECM"
    assert demo.partner.arm == M
    other = value.motion_of(topic=f"/{M}/measured_cp")
    at = int(np.abs(value.seconds(other.stamps_ns) - demo.end_s).argmin())
    np.testing.assert_array_equal(demo.partner.position_mm, other.tip_mm[at])
    assert demo.partner.approach == pytest.approx(matrix_of(other.rotation_xyzw[at : at + 1])[0][:, 2])


def test_the_bases_of_two_arms_are_no_common_frame_whatever_they_are_called(recorded):
    value, _ = recorded
    local = tuple(replace(m, frame="world") for m in value.motions if "/local/" in m.topic)
    assert cut(replace(value, motions=local)).partner is None


def test_an_arm_that_is_not_near_is_not_the_one_that_takes_the_needle(recorded):
    value, _ = recorded
    away = tuple(replace(m, tip_mm=m.tip_mm + 100.0) if m.arm == M else m for m in value.motions)
    assert cut(replace(value, motions=away), f"/{A}/measured_cp").partner is None


def test_without_its_orientation_it_has_no_approach(recorded):
    value, _ = recorded
    blind = tuple(replace(m, rotation_xyzw=None) if m.arm == M else m for m in value.motions)
    assert cut(replace(value, motions=blind), f"/{A}/measured_cp").partner is None


def test_one_arm_alone_has_no_partner():
    value, _ = session(Kind(seed=4, passes=2, both_arms=False))
    assert cut(value, f"/{A}/measured_cp").partner is None


def test_in_the_arms_own_frame_it_is_found_through_the_camera(recorded):
    value, _ = recorded
    demo = cut(value)
    assert demo.frame == f"{A}_base"
    assert demo.partner.arm == M
    other = value.motion_of(topic=f"/{M}/local/measured_cp")
    at = int(np.abs(value.seconds(other.stamps_ns) - demo.end_s).argmin())
    turn, shift = sessions.BASES[M]  # as they were written, which the recording does not say
    np.testing.assert_allclose(demo.partner.position_mm, turn @ other.tip_mm[at] + shift, atol=1e-6)
    np.testing.assert_allclose(demo.partner.approach, turn @ matrix_of(other.rotation_xyzw[[at]])[0][:, 2], atol=1e-9)
