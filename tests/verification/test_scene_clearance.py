"""Distances of a motion from a scene, against every sample and link one by one; and the verdict that they give."""

import numpy as np
import pytest

from skills.gridworld.scene import Box, Capsule, Scene, Tissue
from skills.kinematics import matrix_of
from skills.planning.handoff import HOLDING_RAD, OPEN_RAD
from skills.planning.trajectory import A1
from skills.verification.clearance import RADII_MM, links_of, openings, travel_mm
from skills.verification.playback import PSM_A, PSM_M
from skills.verification.scene_clearance import LOOK_MM, clearance_of
from skills.verification.verdict import SCENE, judge
from tests.planning.motions import ideal_playback
from tests.verification.test_playback import TRAJECTORY, beside, with_psm_m

ARM = links_of(TRAJECTORY.joints, TRAJECTORY.instrument, openings(TRAJECTORY))
LOWEST = (np.minimum(ARM.begin_mm[..., 2], ARM.end_mm[..., 2]) - RADII_MM).min(axis=1)  # of each sample

STEP_MM = float(travel_mm(TRAJECTORY.joints, TRAJECTORY.instrument).max())  # in one step, at only 60 Hz


def below(by_mm: float, **more) -> Scene:
    """Return flat tissue below the lowest place of the motion."""
    return Scene("PSM2_base", tissue=Tissue.plane((0.0, 0.0, float(LOWEST.min()) - by_mm), (0.0, 0.0, 1.0)), **more)


def test_the_distance_from_a_plane_is_that_of_the_lowest_link():
    report = clearance_of(TRAJECTORY, below(3.0)).report
    (nearest,) = report.nearest
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
    lost.__dict__.update(vars(TRAJECTORY) | {"joints": joints})
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
