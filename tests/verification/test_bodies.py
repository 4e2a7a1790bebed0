"""The arms' outer bodies: where they are, how far apart, and the verdict and the probability that contain them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.kinematics import instrument_of, matrix_of
from skills.planning.handoff import OtherArm, PsmM
from skills.planning.trajectory import A1, Trajectory, time_parametrise
from skills.verification.arm_errors import CALIBRATED, UNCALIBRATED
from skills.verification.bodies import (
    BODIES,
    LOOK_MM,
    between,
    bodies_clearance,
    moved_mm,
    names_of,
    parts_of,
    radii_of,
    segments_apart,
    too_near,
)
from skills.verification.clearance import links_of
from skills.verification.error_draws import draw
from skills.verification.gates import Limits
from skills.verification.monte_carlo import doubt, scene_of
from skills.verification.probabilities import DoubtSettings
from skills.verification.verdict import judge
from tests.arms import EXACT
from tests.planning.motions import PSM_M, hand_off, ideal_playback
from tests.planning.test_transfers import BESIDE

TOOLS = ("400006", "420006", "400006-Si", "420006-Classic")
LIMIT_MM = Limits().clearance_bodies_mm
SIDE_BY_SIDE = (0.0, float(np.sin(np.radians(17.5))), 0.0, float(np.cos(np.radians(17.5))))  # its back is PSM_A's


def motion(psm_m: PsmM = BESIDE) -> Trajectory:
    return time_parametrise([hand_off(), hand_off(-8.0)], rate_hz=60.0, psm_m=psm_m)


FREE = motion()
# As the first README had it: the bodies of both arms in the same place. Tools and needle are clear of each other.
JAMMED = motion(PsmM(PSM_M, (160.0, 20.0, 20.0), SIDE_BY_SIDE))


def anywhere(tool: str, count: int, seed: int) -> np.ndarray:
    of = instrument_of(tool)
    return np.random.default_rng(seed).uniform(of.lower, of.upper, (count, 6))


def apart(one: Trajectory, sample: slice | np.ndarray = np.s_[:]) -> np.ndarray:
    m = one.psm_m
    other = parts_of(m.joints[sample], m.instrument).seen_from(matrix_of(m.base_xyzw[None])[0], m.base_mm)
    arm = parts_of(one.joints[sample], one.instrument)
    return between(arm, radii_of(one.instrument), other, radii_of(m.instrument))


# ---- where the bodies are ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tool", TOOLS)
def test_shaft_and_hand_are_those_of_the_tool(tool):
    joints = anywhere(tool, 200, seed=1)
    parts, links = parts_of(joints, tool), links_of(joints, tool)
    np.testing.assert_allclose(parts.begin_mm[:, -2:], links.begin_mm[:, :2], atol=1e-9)
    np.testing.assert_allclose(parts.end_mm[:, -2:], links.end_mm[:, :2], atol=1e-9)


@pytest.mark.parametrize(
    ("yaw", "pitch", "insertion", "low", "high"),
    [
        (0.0, 0.0, 0.0, (0.0, -40.0, 10.0), (0.0, -10.0, 481.8)),
        (0.0, 0.0, 100.0, (0.0, -40.0, 10.0), (0.0, -10.0, 381.8)),
        # Half a right angle of yaw: up points to -x. A right angle of pitch: up points forward, away from the base.
        (np.pi / 4, 0.0, 0.0, (-10 / np.sqrt(2), -40.0, 10 / np.sqrt(2)), (-481.8 / 2**0.5, -10.0, 481.8 / 2**0.5)),
        (0.0, np.pi / 2, 0.0, (0.0, 10.0, 40.0), (0.0, 481.8, 10.0)),
    ],
)
def test_the_insertion_axis_and_its_carriage_turn_and_slide_by_hand(yaw, pitch, insertion, low, high):
    parts, names = parts_of(np.array([[yaw, pitch, insertion, 0, 0, 0]]), "400006"), names_of("400006")
    np.testing.assert_allclose(parts.begin_mm[0, names.index("insertion axis")], low, atol=1e-9)
    np.testing.assert_allclose(parts.begin_mm[0, names.index("carriage")], high, atol=1e-9)


@pytest.mark.parametrize("tool", TOOLS[:2])
def test_the_bars_keep_their_direction_and_what_is_mounted_stands_still(tool):
    joints, names = anywhere(tool, 100, seed=2), names_of(tool)
    parts = parts_of(joints, tool)
    bars = names.index("bars")
    for still in ("setup joint end", "base"):
        assert np.ptp(parts.begin_mm[:, names.index(still)], axis=0).max() == 0.0
    # The bars turn with the yaw alone: their direction along the yaw's axis is the same in every pose.
    way = parts.end_mm[:, bars] - parts.begin_mm[:, bars]
    np.testing.assert_allclose(way[:, 1], way[0, 1], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(way, axis=1), np.linalg.norm(way[0]), atol=1e-9)


@given(seed=st.integers(0, 10_000), size=st.floats(1e-3, 1.0), tool=st.sampled_from(TOOLS))
def test_no_two_parts_approach_by_more_than_the_bound_of_their_movements(seed, size, tool):
    """A second arm, with the same tool, stands somewhere; both move."""
    rng = np.random.default_rng(seed)
    poses = [anywhere(tool, 20, seed), anywhere(tool, 20, seed + 1)]
    others = [q + size * rng.uniform(-1, 1, q.shape) * [1, 1, 100, 1, 1, 1] for q in poses]
    base = matrix_of(rng.normal(size=(1, 4)))[0]
    at_mm, radii = rng.uniform(-400, 400, 3), radii_of(tool)
    of = instrument_of(tool)
    others = [np.clip(q, of.lower, of.upper) for q in others]
    seen = [
        between(parts_of(one, tool), radii, parts_of(two, tool).seen_from(base, at_mm), radii)
        for one, two in (poses, others)
    ]
    moved = [moved_mm(one, two, tool) for one, two in zip(poses, others, strict=True)]
    way = moved[0][:, :, None] + moved[1][:, None]
    between_tools = np.isinf(seen[0])
    first, second = (np.where(between_tools, 0.0, one) for one in seen)
    assert (np.abs(first - second) <= way + 1e-9).all()


def test_distances_of_segments_are_those_of_their_points():
    """Against a grid of 201 x 201 points on both; parallel, crossing and pointlike ones are among them."""
    rng = np.random.default_rng(3)
    p, u, q, v = rng.normal(size=(4, 60, 3)) * 100.0
    u[:10], v[5:15], q[20:25] = v[:10], 0.0, p[20:25]
    share = np.linspace(0, 1, 201)[:, None]
    points = [(a[:, None] + share * b[:, None]) for a, b in ((p, u), (q, v))]
    grid = np.linalg.norm(points[0][:, :, None] - points[1][:, None], axis=-1).min(axis=(1, 2))
    ours = segments_apart(p, u, q, v)
    assert (ours <= grid + 1e-9).all()
    np.testing.assert_allclose(ours, grid, atol=3.0)
    assert np.isnan(segments_apart(np.full((1, 3), np.nan), u[:1], q[:1], v[:1])).all()


# ---- along a motion ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("further_mm", "free"), [(0.0, False), (60.0, False), (80.0, False), (100.0, True)])
def test_two_arms_side_by_side_are_free_where_they_were_measured_to_be(further_mm, free):
    """The manufacturer's bodies overlap at 160 and 240 mm, and are 11 mm apart at 260; ours are never further apart."""
    arm = parts_of(np.zeros((1, 6)), "400006")
    other = arm.seen_from(matrix_of(np.array([SIDE_BY_SIDE]))[0], np.array([160.0 + further_mm, 20.0, 20.0]))
    least = between(arm, radii_of("400006"), other, radii_of("400006")).min()
    assert (least > 0) == free
    assert least < 11.0


@pytest.mark.parametrize("one", [FREE, JAMMED], ids=["free", "jammed"])
def test_the_bound_holds_at_every_sample_and_the_first_pair_is_the_first(one):
    found, every = bodies_clearance(one, LIMIT_MM), apart(one).min(axis=(1, 2))
    assert found.report.at_least_mm <= every.min()
    assert found.report.at_least_mm >= every.min() - LOOK_MM
    assert (found.first is None) == bool((every >= LIMIT_MM).all())
    assert found.report.looks < len(one)
    for near in found.report.nearest:
        pair = names_of("400006").index(near.part), names_of("400006").index(near.other)
        assert near.least_mm == pytest.approx(apart(one, np.array([near.sample]))[0][pair])


def test_a_single_sample_that_is_too_near_is_found_and_named():
    """Where PSM_M waits, its yaw swings it over to PSM_A and back, from one sample to the next."""
    m = FREE.psm_m
    sample = int(np.flatnonzero(FREE.phase == A1)[40])
    joints = np.array(m.joints)
    joints[sample, 0] -= np.radians(45)
    swung = replace(FREE, psm_m=OtherArm(m.base_mm, m.base_xyzw, m.instrument, joints))
    every = apart(swung).min(axis=(1, 2))
    assert np.flatnonzero(~(every >= LIMIT_MM)).tolist() == [sample]
    found = bodies_clearance(swung, LIMIT_MM)
    assert int(np.argmax(~(found.at_least_mm >= LIMIT_MM))) in (sample - 1, sample)
    pair = np.unravel_index(apart(swung)[sample].argmin(), (12, 12))
    assert str(found.first) == f"PSM_A's {names_of('400006')[pair[0]]} and PSM_M's {names_of('400006')[pair[1]]}"


def playback(one: Trajectory):
    """Return the measurements of a simulator in which tools and pad are well apart."""
    m, count = one.psm_m, len(one)
    links = links_of(m.joints, m.instrument).seen_from(matrix_of(m.base_xyzw[None])[0], m.base_mm)
    alone = ideal_playback(one)
    return replace(alone, clearances_mm=np.full((count, 24), 20.0), psm_m_tip_mm=links.end_mm[:, 1])


def test_the_judge_refuses_arms_whose_bodies_meet_at_the_first_sample():
    assert judge(playback(FREE), FREE).feasible
    report = judge(playback(JAMMED), JAMMED)
    assert (report.feasible, report.failure.sample) == (False, 0)
    assert report.failure.quantity == "clearance of PSM_A's yaw link and PSM_M's yaw link"
    assert report.failure.value == pytest.approx(report.bodies.at_least_mm, abs=LOOK_MM)
    assert report.bodies.arms == ("PSM Classic", "PSM Classic")


def test_an_arm_alone_runs_into_nothing_and_its_verdict_says_so():
    alone = time_parametrise([hand_off()], rate_hz=60.0)
    report = judge(ideal_playback(alone), alone).bodies
    assert (report.arms, report.at_least_mm, report.nearest) == (("PSM Classic",), None, ())


def test_joints_that_are_not_numbers_are_too_near():
    m, joints = FREE.psm_m, np.array(FREE.psm_m.joints)
    joints[7, 1] = np.nan
    unknown = replace(FREE, psm_m=OtherArm(m.base_mm, m.base_xyzw, m.instrument, FREE.psm_m.joints))
    object.__setattr__(unknown.psm_m, "joints", joints)
    found = bodies_clearance(unknown, LIMIT_MM)
    assert int(np.argmax(~(found.at_least_mm >= LIMIT_MM))) in (6, 7)


def test_the_bodies_of_both_generations_have_names_of_their_own():
    assert set(BODIES) == {"PSM Classic", "PSM Si"}
    for tool in TOOLS:
        assert len(set(names_of(tool))) == len(names_of(tool)) == len(radii_of(tool))


# ---- in inexact worlds ---------------------------------------------------------------------------------------------


def test_a_plan_whose_bodies_meet_fails_though_every_needle_is_caught():
    few = DoubtSettings(variations=40, suture_point_mm=0.0, needle_rad=0.0)
    asked = {"approach_m": PSM_M, "pad_top_mm": -170.0, "settings": few, "errors": EXACT}
    only = doubt(JAMMED, **asked).under[0]
    assert only.plan.count == 0
    assert (only.passes[0].faults.bodies, only.passes[0].faults.arms, only.passes[0].caught.count) == (40, 0, 40)
    only = doubt(FREE, **asked).under[0]
    assert (only.passes[0].faults.bodies, only.plan.count) == (0, 40)


@pytest.mark.parametrize("limit_mm", [57.0, 60.0, 62.0, 70.0])
def test_a_variation_is_too_near_where_its_own_distances_say_so(limit_mm):
    """Against the distances of every variation and sample; at these limits some are too near and some are not."""
    scene = scene_of(FREE, 0, -170.0, 0.5)
    scene = replace(scene, arms=tuple(arm.at(np.arange(0, len(scene.phase), 25)) for arm in scene.arms))
    stamps_s = np.arange(len(scene.arms[0].joints)) / 4
    drawn = draw(1, 0, 40, len(stamps_s), suture_point_mm=5.0, needle_rad=0.0)
    displaced = [drawn.under(errors, stamps_s) for errors in (EXACT, CALIBRATED, UNCALIBRATED)]
    joints = [arm.shifted(drawn.shift_mm) for arm in scene.arms]
    expected = []
    for errors in displaced:
        a, m = (
            parts_of(q, arm.instrument).seen_from(arm.base, arm.base_mm)
            for q, arm in zip(joints, scene.arms, strict=True)
        )
        by_a, by_m = (one.reshape(-1, 1, 3) for one in errors.tip_mm)
        turn = np.repeat(errors.base_turn, len(stamps_s), axis=0)
        by_m = by_m + np.repeat(errors.base_mm, len(stamps_s), axis=0)[:, None]
        centre = scene.arms[1].base_mm
        a = replace(a, begin_mm=a.begin_mm + by_a, end_mm=a.end_mm + by_a)
        begin, end = (np.einsum("tij,tkj->tki", turn, one - centre) + centre + by_m for one in (m.begin_mm, m.end_mm))
        moved = replace(m, begin_mm=begin, end_mm=end)
        least = between(a, radii_of("400006"), moved, radii_of("400006")).reshape(40, -1).min(axis=1)
        expected.append(least < limit_mm)
    every = np.ones((3, 40), dtype=bool)
    found = too_near(scene.arms, joints, displaced, limit_mm, every)
    np.testing.assert_array_equal(found, expected)
    some = np.random.default_rng(0).random((3, 40)) < 0.5
    np.testing.assert_array_equal(too_near(scene.arms, joints, displaced, limit_mm, some), found & some)
