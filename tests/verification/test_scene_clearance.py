"""Distances of a motion from a scene, against every sample and link one by one; and the verdict that they give."""

from dataclasses import replace

import numpy as np
import pytest

from skills.gridworld.scene import Box, Capsule, Scene, Tissue
from skills.kinematics import matrix_of
from skills.planning.handoff import HOLDING_RAD, NEEDLE_RADIUS_MM, OPEN_RAD
from skills.planning.trajectory import A1, A2, PSM_A, PSM_M
from skills.verification.bodies import parts_of, radii_of
from skills.verification.clearance import (
    RADII_MM,
    RADIUS_MM,
    links_of,
    needle_arc_mm,
    needle_poses,
    needle_travel_mm,
    openings,
    travel_mm,
)
from skills.verification.gates import SCENE
from skills.verification.playback import CLEARANCE_SEEN_MM
from skills.verification.scene_clearance import LOOK_BODIES_MM, LOOK_MM, clearance_of, flat_tissue, needle_from_parts
from skills.verification.verdict import judge
from tests.planning.motions import ideal_playback
from tests.verification.test_verdict import TRAJECTORY, beside, with_psm_m

ARM = links_of(TRAJECTORY.joints, TRAJECTORY.instrument, openings(TRAJECTORY.arms[0]))
LOWEST = (np.minimum(ARM.begin_mm[..., 2], ARM.end_mm[..., 2]) - RADII_MM).min(axis=1)  # of each sample

STEP_MM = float(travel_mm(TRAJECTORY.joints, TRAJECTORY.instrument).max())  # in one step, at only 60 Hz


def below(by_mm: float, **more) -> Scene:
    """Return flat tissue below the lowest place of the motion."""
    return Scene("PSM2_base", tissue=Tissue.plane((0.0, 0.0, float(LOWEST.min()) - by_mm), (0.0, 0.0, 1.0)), **more)


def test_the_distance_from_a_plane_is_that_of_the_lowest_link():
    report = clearance_of(TRAJECTORY, below(3.0)).report
    nearest, needle = report.nearest
    assert (needle.body, needle.part) == ("needle", "tissue")
    arc = needle_arc_mm(TRAJECTORY, np.arange(len(TRAJECTORY)))
    assert needle.least_mm == pytest.approx(arc[..., 2].min() - RADIUS_MM - (LOWEST.min() - 3.0), abs=LOOK_MM)
    assert (nearest.body, nearest.part) == (PSM_A, "tissue")
    assert "finger" in nearest.link
    assert nearest.least_mm == pytest.approx(3.0, abs=LOOK_MM / 2)
    assert 3.0 - STEP_MM / 2 <= report.at_least_mm <= nearest.least_mm
    assert LOWEST[nearest.sample] == pytest.approx(LOWEST.min(), abs=LOOK_MM)
    assert nearest.tip_mm == pytest.approx(TRAJECTORY.tip_mm[nearest.sample])


@pytest.mark.parametrize(
    "part",
    [
        {"boxes": (Box((-30.0, 40.0, -160.0), (-8.0, 70.0, -120.0)),)},
        {"capsules": (Capsule((30.0, 40.0, -120.0), (25.0, 80.0, -140.0), 3.0),)},
        {"tissue": Tissue((-60.0, 0.0, -175.0), (0.0, 0.1, 1.0), (1.0, 0.0, 0.0), 20.0, ((0.0, 4.0, 1.0),) * 8)},
    ],
)
def test_no_sample_is_nearer_than_the_bound_says(part):
    """Links of every fifth sample are cut into points a tenth of a millimetre apart, the shaft into whole ones."""
    scene = Scene("PSM2_base", **part)
    report, nearest = clearance_of(TRAJECTORY, scene).report, []
    for sample in range(0, len(TRAJECTORY), 5):
        for link in range(4):
            a, b = ARM.begin_mm[sample, link], ARM.end_mm[sample, link]
            along = a + np.linspace(0, 1, 417 if link == 0 else 101)[:, None] * (b - a)
            nearest.append(scene.clearance_mm(along).min() - RADII_MM[link])
        if scene.tissue is None:
            nearest.append(scene.clearance_mm(needle_arc_mm(TRAJECTORY, np.array([sample]))).min() - RADIUS_MM)
    least = min(nearest)
    steep = 1.0 if scene.tissue is None else 1.05  # of slopes of 0.2, and a plane that leans by 6 degrees
    assert report.at_least_mm <= least + 1e-9
    assert report.at_least_mm >= least / steep - STEP_MM - 0.5
    assert report.looks < len(TRAJECTORY) + 1


@pytest.mark.parametrize(
    ("by_mm", "margin_mm", "feasible"), [(1.5, 0, True), (0.5, 0, False), (-4, 0, False), (1.5, 2, False)]
)
def test_a_motion_that_comes_too_near_is_not_feasible(by_mm, margin_mm, feasible):
    near = clearance_of(TRAJECTORY, below(by_mm, margin_mm=float(margin_mm)))
    report = judge(ideal_playback(TRAJECTORY), TRAJECTORY, beside=near)
    assert report.feasible == feasible
    assert near.report.limit_mm == max(1.0, margin_mm)
    if not feasible:
        assert (report.failure.quantity, report.failure.limit) == (SCENE, near.report.limit_mm)
        assert report.failure.sample <= near.report.nearest[0].sample


def test_touching_in_one_transfer_or_turn_alone_is_found():
    """A small box at the place of the fingers in the last sample of A2, and one where a transfer ends."""
    for sample in (int(TRAJECTORY.last_samples[0]), int(np.flatnonzero(TRAJECTORY.phase != A1)[5])):
        x, y, z = ARM.end_mm[sample, 2].tolist()
        scene = Scene("PSM2_base", boxes=(Box((x - 0.1, y - 0.1, z - 0.1), (x + 0.1, y + 0.1, z + 0.1)),))
        assert not judge(ideal_playback(TRAJECTORY), TRAJECTORY, beside=clearance_of(TRAJECTORY, scene)).feasible


def test_joints_that_are_not_numbers_are_not_free():
    joints = np.array(TRAJECTORY.joints)
    joints[7] = np.nan
    lost = object.__new__(type(TRAJECTORY))
    lost.__dict__.update({name: one for name, one in vars(TRAJECTORY).items() if name != "arms"} | {"joints": joints})
    near = clearance_of(lost, below(30.0))
    assert not judge(ideal_playback(TRAJECTORY), TRAJECTORY, beside=near).feasible


def test_psm_m_is_compared_with_boxes_and_tissue_but_not_with_itself():
    both, playback = beside(), with_psm_m()
    there = Box((140.0, -5.0, -140.0), (150.0, 5.0, -130.0))
    free = clearance_of(both, Scene("PSM2_base", capsules=(Capsule((145.0, 0.0, -100.0), (145.0, 0.0, -150.0), 4.0),)))
    assert judge(playback, both, beside=free).feasible
    hit = clearance_of(both, Scene("PSM2_base", boxes=(there,)))
    assert not judge(playback, both, beside=hit).feasible
    assert hit.report.nearest[0].body == PSM_M


@pytest.mark.parametrize("share", [0.0, 0.4, 0.5, 0.7, 1.0])
def test_psm_m_is_compared_with_its_jaw_closed_open_and_in_between(share):
    """A small box at the tip of a finger, which passes it while the jaw closes."""
    both = beside()
    m, opening = both.psm_m, HOLDING_RAD + share * (OPEN_RAD - HOLDING_RAD)
    there = links_of(m.joints[-1:], m.instrument, opening).seen_from(matrix_of(m.base_xyzw[None])[0], m.base_mm)
    tip = there.end_mm[0, 2]
    box = Box(tuple((tip - 0.01).tolist()), tuple((tip + 0.01).tolist()))
    assert clearance_of(both, Scene("PSM2_base", boxes=(box,))).report.at_least_mm < 0


def test_an_empty_scene_and_a_far_one_are_free():
    for scene in (Scene("PSM2_base"), below(200.0)):
        near = clearance_of(TRAJECTORY, scene)
        assert (near.report.nearest, near.report.at_least_mm) == ((), None)
        assert judge(ideal_playback(TRAJECTORY), TRAJECTORY, beside=near).feasible


# ---- the outer bodies and the needle -------------------------------------------------------------------------------


def test_a_box_beside_the_arm_outside_of_the_patient_is_found_and_named():
    """A stand next to the insertion axis, whose radius is 50 mm, 40 mm behind the tool; the tool is far from it."""
    stand = Scene("PSM2_base", boxes=(Box((62.0, -60.0, 200.0), (100.0, -20.0, 400.0)),))
    found = clearance_of(TRAJECTORY, stand)
    assert found.report.bodies
    nearest = found.report.nearest[0]
    assert (nearest.body, nearest.part) == (PSM_A, "box 0")
    assert nearest.link in ("insertion axis", "carriage", "lower bar", "upper bar", "cannula mount")
    every = parts_of(TRAJECTORY.joints, TRAJECTORY.instrument)
    radii = radii_of(TRAJECTORY.instrument)
    least = min(
        (stand.boxes[0].from_lines_mm(every.begin_mm[:, k], every.end_mm[:, k]) - radii[k]).min()
        for k in range(len(radii) - 2)
    )
    assert least - LOOK_BODIES_MM <= found.at_least_mm.min() <= least + 1e-9


def test_the_base_below_the_height_of_the_tissue_is_beside_the_table():
    high = Scene("PSM2_base", tissue=Tissue.plane((0.0, 0.0, float(LOWEST.min()) - 3.0), (0.0, 0.0, 1.0)))
    found = clearance_of(TRAJECTORY, high).report
    assert {one.link for one in found.nearest} <= {"finger_1", "finger_2", "wrist_pitch_link", "roll_link", "arc"}


def needle_into(by_mm: float, phases: tuple[int, ...], first: int = 0) -> Scene:
    """Return flat tissue that the needle enters by some depth at its lowest place in some phases."""
    at = np.flatnonzero(np.isin(TRAJECTORY.phase, phases))[first:]
    lowest = float(needle_arc_mm(TRAJECTORY, at)[..., 2].min()) - RADIUS_MM
    return Scene("PSM2_base", tissue=Tissue.plane((0.0, 0.0, lowest + by_mm), (0.0, 0.0, 1.0)))


def test_no_sample_of_the_needle_is_lower_than_the_bound_says():
    scene = needle_into(-2.0, (A1, A2))
    found = clearance_of(TRAJECTORY, scene)
    judged = np.isin(TRAJECTORY.phase, (A1, A2))
    every = scene.tissue.above_mm(needle_arc_mm(TRAJECTORY, np.arange(len(TRAJECTORY)))).min(axis=1) - RADIUS_MM
    assert found.report.needle_at_least_mm <= every[judged].min() == pytest.approx(2.0)
    assert found.report.needle_at_least_mm >= 2.0 - float(needle_travel_mm(TRAJECTORY).max()) - LOOK_MM
    steps = np.linalg.norm(np.diff(needle_arc_mm(TRAJECTORY, np.arange(len(TRAJECTORY))), axis=0), axis=2).max(axis=1)
    same = np.diff(TRAJECTORY.pass_index) == 0
    assert (steps[same] <= needle_travel_mm(TRAJECTORY)[same] + 1e-9).all()


def test_between_two_points_of_the_arc_nothing_is_nearer_than_the_bound():
    """Ridges 2 mm apart with slopes of 4: half a millimetre along the wire is up to 1 mm of height."""
    at = np.arange(0, len(TRAJECTORY), 7)
    at = at[np.isin(TRAJECTORY.phase[at], (A1, A2))]
    place, rotation = needle_poses(TRAJECTORY, at)
    turn = np.linspace(-np.pi / 3, 2 * np.pi / 3, 5001)
    arc = NEEDLE_RADIUS_MM * np.stack([np.sin(turn), 1 - np.cos(turn), np.zeros_like(turn)], axis=1)
    wire = place[:, None] + np.einsum("fij,kj->fki", rotation, arc)
    ridges = tuple((0.0, 4.0) * 60 for _ in range(2))
    for shift_mm in np.linspace(0.0, 2.0, 5):
        for normal in ((0.0, 0.0, 1.0), (0.3, 0.2, 1.0)):
            tissue = Tissue((-60.0 + shift_mm, -50.0, -170.0), normal, (1.0, -0.0, -normal[0]), 1.0, ridges)
            nearest = tissue.above_mm(wire).min(axis=1)
            assert (nearest > 0).any()
            exact = np.where(nearest > 0, nearest / tissue.steep, nearest) - RADIUS_MM
            bound = needle_from_parts(TRAJECTORY, Scene("PSM2_base", tissue=tissue), at)["tissue"][:, 0]
            seen = bound < CLEARANCE_SEEN_MM
            assert (bound[seen] <= exact[seen]).all()
            assert (bound[seen] >= exact[seen] - 0.7).all()
    level = Tissue.plane((0.0, 0.0, -170.0), (0.1, 0.0, 1.0))
    apart = level.above_mm(wire).min(axis=1) - RADIUS_MM
    bound = needle_from_parts(TRAJECTORY, Scene("PSM2_base", tissue=level), at)["tissue"][:, 0]
    assert (bound <= apart).all() and (bound >= apart - 0.01).all()


def test_a_needle_that_dips_into_the_tissue_while_it_is_carried_is_refused():
    """PSM_A rises at first, and dips 4 mm later on; the fingers are let into the tissue, the needle is not."""
    heights = needle_arc_mm(TRAJECTORY, np.arange(len(TRAJECTORY)))[..., 2].min(axis=1) - RADIUS_MM
    top = float(heights[TRAJECTORY.phase == A2].max()) + 0.5
    found = clearance_of(TRAJECTORY, Scene("PSM2_base", tissue=Tissue.plane((0.0, 0.0, top), (0.0, 0.0, 1.0))))
    apart = replace(found, at_least_mm=np.full(len(TRAJECTORY), 10.0))
    report = judge(ideal_playback(TRAJECTORY), TRAJECTORY, beside=apart)
    assert report.failure.quantity == "distance of the needle from the tissue"
    assert (report.failure.limit, report.failure.value < 0) == (0.0, True)


def test_as_a_pass_begins_the_needle_may_be_where_the_hand_left_it():
    heights = needle_arc_mm(TRAJECTORY, np.arange(len(TRAJECTORY)))[..., 2].min(axis=1) - RADIUS_MM
    a1 = np.flatnonzero((TRAJECTORY.phase == A1) & (TRAJECTORY.pass_index == 0))
    top = float(heights[a1[0]]) + 2.0
    inside = heights < top
    leaves = a1[np.argmax(~inside[a1])]
    assert inside[a1[0]]
    assert not inside[leaves]
    found = clearance_of(TRAJECTORY, Scene("PSM2_base", tissue=Tissue.plane((0.0, 0.0, top), (0.0, 0.0, 1.0))))
    assert np.isinf(found.needle_mm[a1[0] : leaves]).all()
    assert (found.needle_mm[: leaves + 1] >= 0).all()


@pytest.mark.parametrize("rows", [((0.5,),), ((0.5, 0.5), (0.5, 0.5))])
def test_sloping_tissue_is_flat_tissue_of_that_slope_for_the_estimate(rows):
    """As a plane it is itself; as a map of equal heights it is the same, as exactly as distances from a map are."""
    normal, along = np.array([0.0, 0.6, 0.8]), (1.0, 0.0, 0.0)
    lowest = float((np.minimum(ARM.begin_mm @ normal, ARM.end_mm @ normal) - RADII_MM).min())
    x, y, z = ((lowest - 3.5) * normal).tolist()
    tissue = Tissue((x, y, z), (0.0, 1.2, 1.6), along, 5.0, rows)
    report = clearance_of(TRAJECTORY, Scene("PSM2_base", tissue=tissue)).report
    height_mm, up = flat_tissue(TRAJECTORY, report, tissue)
    assert up == pytest.approx(tuple(normal))
    assert height_mm == pytest.approx(lowest - 3.0, abs=1e-9 if len(rows) == 1 else 0.5)
