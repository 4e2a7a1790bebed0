"""The other arm at the hand-off, reported only if it can be determined."""

from dataclasses import replace

import numpy as np
import pytest

from skills.demonstration.demonstration import cut_demo, partner_motion
from skills.demonstration.segments import propose_segments
from skills.kinematics import angle_between, matrix_of
from tests.demonstration import sessions
from tests.demonstration.sessions import A, Kind, M, session


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


def test_the_bases_of_two_arms_are_never_taken_as_a_common_frame(recorded):
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
    turn, shift = sessions.BASES[M]  # as written, although the recording does not contain them
    np.testing.assert_allclose(demo.partner.position_mm, turn @ other.tip_mm[at] + shift, atol=1e-6)
    np.testing.assert_allclose(demo.partner.approach, turn @ matrix_of(other.rotation_xyzw[[at]])[0][:, 2], atol=1e-9)


# ---- its motion -------------------------------------------------------------------------------------------------


def test_its_motion_is_the_recorded_one_at_the_stamps_of_this_arm(recorded):
    value, _ = recorded
    demo = cut(value, f"/{A}/measured_cp")
    other, seconds = value.motion_of(topic=f"/{M}/measured_cp"), demo.start_s + demo.stamps_s
    found = partner_motion(value, demo)
    assert found.arm == M
    for axis in range(3):
        wanted = np.interp(seconds, value.seconds(other.stamps_ns), other.tip_mm[:, axis])
        np.testing.assert_allclose(found.tip_mm[:, axis], wanted, atol=1e-9)
    nearest = np.abs(value.seconds(other.stamps_ns)[None] - seconds[:, None]).argmin(axis=1)
    off = angle_between(matrix_of(found.rotation_xyzw), matrix_of(other.rotation_xyzw[nearest]))
    assert off.max() < 0.02
    jaw = value.jaw_of(M)
    np.testing.assert_array_equal(found.jaw_rad, np.interp(seconds, value.seconds(jaw.stamps_ns), jaw.values))
    without = replace(value, jaws=tuple((arm, one) for arm, one in value.jaws if arm != M))
    assert partner_motion(without, demo).jaw_rad is None


def test_its_motion_in_this_arms_own_frame_is_found_through_the_camera(recorded):
    value, _ = recorded
    demo = cut(value)
    found, other = partner_motion(value, demo), value.motion_of(topic=f"/{M}/local/measured_cp")
    turn, shift = sessions.BASES[M]
    seconds = demo.start_s + demo.stamps_s
    local = np.stack([np.interp(seconds, value.seconds(other.stamps_ns), axis) for axis in other.tip_mm.T], axis=1)
    np.testing.assert_allclose(found.tip_mm, local @ turn.T + shift, atol=1e-6)
    assert np.linalg.norm(found.tip_mm[-1] - demo.partner.position_mm) < 0.5


def test_a_motion_that_was_not_recorded_all_along_is_none(recorded):
    value, _ = recorded
    demo = cut(value, f"/{A}/measured_cp")
    assert partner_motion(value, replace(demo, partner=None)) is None
    other = value.motion_of(topic=f"/{M}/measured_cp")
    late = value.seconds(other.stamps_ns) > demo.start_s + demo.stamps_s[-1] / 2
    cut_off = replace(
        other, stamps_ns=other.stamps_ns[late], tip_mm=other.tip_mm[late], rotation_xyzw=other.rotation_xyzw[late]
    )
    motions = tuple(cut_off if m is other else m for m in value.motions)
    assert partner_motion(replace(value, motions=motions), demo) is None


def test_a_demonstration_cut_in_another_frame_than_today_has_none(recorded):
    value, _ = recorded
    demo = cut(value)
    assert partner_motion(value, demo) is not None
    assert partner_motion(value, replace(demo, frame="ECM")) is None


# ---- its base ---------------------------------------------------------------------------------------------------


def test_the_partners_base_is_given_in_this_arms_frame_if_they_share_one(recorded):
    value, _ = recorded
    partner = cut(value).partner
    turn, shift = sessions.BASES[M]  # of its base in this arm's base frame, as written
    np.testing.assert_allclose(partner.base_mm, shift, atol=1e-6)
    np.testing.assert_allclose(matrix_of([partner.base_xyzw])[0], turn, atol=1e-9)


def test_psm_m_planned_with_that_base_stands_where_it_was_recorded(recorded):
    value, _ = recorded
    demo = cut(value)
    here = value.motion_of(topic=f"/{M}/local/measured_cp")
    at = int(np.abs(value.seconds(here.stamps_ns) - demo.partner.at_s).argmin())
    base = matrix_of([demo.partner.base_xyzw])[0]
    np.testing.assert_allclose(base @ here.tip_mm[at] + demo.partner.base_mm, demo.partner.position_mm, atol=1e-6)


def test_in_the_cameras_frame_no_base_is_told(recorded):
    value, _ = recorded
    partner = cut(value, f"/{A}/measured_cp").partner
    assert (partner.base_mm, partner.base_xyzw) == (None, None)


def test_a_base_that_moved_is_not_told(recorded):
    value, _ = recorded
    local = f"/{M}/local/measured_cp"
    drift = np.linspace(0, 10, len(value.motion_of(topic=local).tip_mm))[:, None]
    moved = tuple(replace(m, tip_mm=m.tip_mm + drift) if m.topic == local else m for m in value.motions)
    partner = cut(replace(value, motions=moved)).partner
    assert partner.arm == M
    assert (partner.base_mm, partner.base_xyzw) == (None, None)


@pytest.mark.parametrize(
    ("named", "number"), [("LARGE_NEEDLE_DRIVER:400006", "400006"), ("MEGA_NEEDLE_DRIVER:400309", None), ("", None)]
)
def test_its_instrument_is_told_where_its_constants_are_known(recorded, named, number):
    value, _ = recorded
    partner = cut(replace(value, tools=((A, "LARGE_NEEDLE_DRIVER:420006"), (M, named)))).partner
    assert partner.instrument == number
