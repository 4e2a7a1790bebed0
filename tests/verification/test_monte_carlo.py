"""The estimate of success: laws, cases by hand, and a second method that repeats it world by world."""

import json
import subprocess
import sys
from dataclasses import asdict, replace
from math import cos, erf, nan, radians, sin, sqrt
from pathlib import Path

import numpy as np
import pytest

import skills
from skills.arithmetic import wilson
from skills.errors import BadInput, BadSettings
from skills.kinematics import JAW_TIP_MM, POINTING_DOWN, matrix_of
from skills.planning import handoff
from skills.planning.passes import PassPath
from skills.planning.trajectory import Trajectory, time_parametrise
from skills.verification import monte_carlo, probabilities
from skills.verification.arm_errors import CALIBRATED, MEAN_LENGTH, SIZES, UNCALIBRATED, ArmErrors
from skills.verification.clearance import (
    ARC_MM,
    FINGER_RADIUS_MM,
    NEEDLE_THICK_MM,
    WRIST_RADIUS_MM,
    clearance_to_pad,
    links_of,
)
from skills.verification.error_draws import Displaced, draw
from skills.verification.gates import Limits
from skills.verification.monte_carlo import estimate_success, in_tissue, looked_at, scene_of
from skills.verification.probabilities import JUDGE_VERSION, EstimateSettings, EstimateUnder, SuccessEstimate
from tests.arms import EXACT
from tests.by_day import some
from tests.verification import worlds
from tests.verification.test_clearance import APPROACH, OPENING_RAD, PLANNED

PAD_TOP_MM = -150.0  # 5 mm under the lowest finger tips
BASE_MM = (160.0, 20.0, 20.0)
BASE_XYZW = (0.0, 0.0, float(np.sin(np.radians(22.5))), float(np.cos(np.radians(22.5))))
PSM_M = handoff.PsmM(APPROACH, BASE_MM, BASE_XYZW)
PATH_MM = np.array([[-10, 55, -135], [-20, 60, -130], [-10, 55, -120], [5, 55, -125]], dtype=float)
NO_DOUBT = EstimateSettings(variations=40, suture_point_mm=0.0, needle_rad=0.0)
FEW = EstimateSettings(variations=100)


def pass_path(shift_mm: float = 0.0, with_a2: bool = True) -> PassPath:
    target = handoff.realign(POINTING_DOWN, APPROACH).rotation if with_a2 else None
    return PassPath(PATH_MM + np.array([shift_mm, 0.0, 0.0]), POINTING_DOWN, target)


def motion(passes: int = 1, psm_m: handoff.PsmM | None = None, with_a2: bool = True) -> Trajectory:
    paths = [pass_path(6.0 * k, with_a2) for k in range(passes)]
    return time_parametrise(paths, rate_hz=100.0, psm_m=psm_m)


ROOT = Path(skills.__file__).parents[1]
ALONE = motion(2)
BESIDE = motion(2, PSM_M)


def only(**sizes: float) -> ArmErrors:
    """Return the errors of an arm with these sizes and no others."""
    return replace(EXACT, **sizes)


def of_tips(mean_mm: float) -> ArmErrors:
    """Return constant errors of the tips of this mean length, and no others."""
    return only(tip_bias_mm=mean_mm / MEAN_LENGTH)


def judged(
    trajectory: Trajectory = ALONE, approach=APPROACH, pad_top_mm: float = PAD_TOP_MM, **given
) -> SuccessEstimate:
    given = {"settings": FEW, "errors": of_tips(0.65), **given}
    return estimate_success(trajectory, approach_m=approach, pad_top_mm=pad_top_mm, **given)


def under(found: SuccessEstimate) -> EstimateUnder:
    return found.under[0]


@pytest.mark.parametrize(
    "errors", some([of_tips(0.65), of_tips(3.0), only(registration_mm=1.5), only(tip_noise_mm=0.5)], 2)
)
def test_catching_is_as_likely_as_the_integral_over_all_offsets(errors):
    # Without any turn the place is y = e_y and z = 7 + e_z + r (1 - sin phi), where r cos phi = -e_x.
    sigma = sqrt(errors.registration_mm**2 + 2 * errors.tip_bias_mm**2 + 2 * errors.tip_noise_mm**2)
    e = np.linspace(-5, 5, 161)
    weight = np.exp(-(e**2) / 2)
    weight /= weight.sum()
    x, y, z = np.meshgrid(*[e * sigma] * 3, indexing="ij")
    phi = np.arccos(np.clip(-x / handoff.NEEDLE_RADIUS_MM, -1, 1))
    depth = 7.0 + z + handoff.NEEDLE_RADIUS_MM * (1 - np.sin(phi))
    rho, half = np.hypot(y, depth), NEEDLE_THICK_MM / 2
    beside = FINGER_RADIUS_MM / handoff.NEEDLE_RADIUS_MM
    good = (np.abs(x) < handoff.NEEDLE_RADIUS_MM) & (phi >= beside) & (phi <= handoff.NEEDLE_FREE_RAD - beside)
    good &= (rho >= WRIST_RADIUS_MM + half) & (rho <= JAW_TIP_MM - half)
    good &= np.abs(y) * np.cos(OPENING_RAD) + half <= depth * np.sin(OPENING_RAD)
    good &= np.abs(x) <= handoff.NEEDLE_RADIUS_MM * np.sin(radians(15))
    expected = np.einsum("ijk,i,j,k", good.astype(float), weight, weight, weight)
    settings = EstimateSettings(variations=2000, needle_rad=0.0)
    caught = under(judged(motion(1), settings=settings, errors=errors)).passes[0].caught
    assert caught.lower - 0.01 <= expected <= caught.upper + 0.01  # the grid's own error is a few thousandths


# ---- a whole plan ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("trajectory", [ALONE, BESIDE], ids=["alone", "beside PSM_M"])
def test_without_any_doubt_a_clear_plan_succeeds_for_certain(trajectory):
    found = judged(trajectory, settings=NO_DOUBT, errors=EXACT)
    assert [one.errors for one in found.under] == [EXACT, CALIBRATED, UNCALIBRATED]
    exact = under(found)
    assert (exact.plan.count, exact.plan.of, exact.plan.probability) == (40, 40, 1.0)
    assert exact.plan.lower == pytest.approx(1 / (1 + 1.959964**2 / 40))  # Wilson's bound of all of n, by hand
    assert all(one.caught.probability == 1.0 for one in exact.passes)
    assert (found.with_psm_m, found.hand_offs, found.version) == (trajectory is BESIDE, 2, JUDGE_VERSION)
    assert exact.passes[0].faults.arms == (0 if trajectory is BESIDE else None)


def test_a_plan_into_the_pad_never_succeeds_though_every_needle_is_caught():
    found = under(judged(pad_top_mm=-140.0, settings=NO_DOUBT, errors=EXACT))
    assert (found.plan.count, found.passes[0].clear.count, found.passes[0].caught.count) == (0, 0, 40)
    assert (found.passes[0].faults.pad, found.passes[0].faults.reach) == (40, 0)


def test_psm_m_in_the_way_is_found_in_every_variation():
    # It stands in PSM_A's place, 3 mm to its side, and moves as it does.
    same = handoff.OtherArm(np.array([3.0, 0.0, 0.0]), np.array([0.0, 0, 0, 1]), "400006", ALONE.joints)
    found = under(judged(replace(ALONE, psm_m=same), settings=NO_DOUBT, errors=EXACT))
    assert (found.passes[0].faults.arms, found.passes[0].faults.pad, found.plan.count) == (40, 0, 0)


def off(scene, a=(0, 0, 0), m=(0, 0, 0), base=(0, 0, 0)) -> Displaced:
    """Return the displacement of PSM_A, PSM_M and PSM_M's base by rows of offsets, or by one in each variation."""
    count, (a, m, base) = 4, (np.broadcast_to(np.array(one, float), (4, 3)) for one in (a, m, base))
    exact = draw(0, 0, count, len(scene.phase), suture_point_mm=0.0, needle_rad=0.0).under(EXACT, scene.stamps_s)
    tips = np.repeat(np.stack([a, m])[:, :, None], len(scene.phase), axis=2)
    return replace(exact, tip_mm=tips, base_mm=base)


def wrong(scene, shift_mm=(0, 0, 0), **given) -> dict[str, list[bool]]:
    """Return the failures in four variations, in which all but the given numbers are zero."""
    shift_mm = np.broadcast_to(np.array(shift_mm, float), (4, 3))
    found = monte_carlo.spoiled(scene, shift_mm, [off(scene, **given)], Limits())
    return {name: one[0].tolist() for name, one in found.items()}


def test_an_arm_offset_down_nears_the_pad_and_a_pass_shifted_down_does_not():
    scene = looked_at(scene_of(BESIDE, 0, PAD_TOP_MM, OPENING_RAD), 20)
    spare = float(clearance_to_pad(scene.arms[0].links(scene.arms[0].joints), PAD_TOP_MM).min()) - 1.0
    down = [[0, 0, -spare + 0.01], [0, 0, -spare - 0.01], [9, 9, 0], [0, 0, spare]]
    assert wrong(scene, a=down)["pad"] == [False, True, False, False]
    assert wrong(scene, shift_mm=down)["pad"] == [False] * 4
    other = float(clearance_to_pad(scene.arms[1].links(scene.arms[1].joints), PAD_TOP_MM).min()) - 1.0
    down = [[0, 0, -other + 0.01], [0, 0, -other - 0.01], [0, 0, 0], [0, 0, 9]]
    assert wrong(scene, m=down)["pad"] == [False, True, False, False]


def test_each_arm_comes_nearer_to_the_other_by_its_own_offset():
    # PSM_M moves as PSM_A does, 20 mm beside it along x: more than 8 mm of shafts and the limit.
    beside = handoff.OtherArm(np.array([20.0, 0.0, 0.0]), np.array([0.0, 0, 0, 1]), "400006", ALONE.joints)
    scene = looked_at(scene_of(replace(ALONE, psm_m=beside), 0, PAD_TOP_MM, 0.06), 20)
    along = [[0, 0, 0], [13, 0, 0], [-13, 0, 0], [0, 13, 0]]
    assert wrong(scene, a=along)["arms"] == [False, True, False, False]
    assert wrong(scene, m=along)["arms"] == wrong(scene, base=along)["arms"] == [False, False, True, False]
    assert wrong(scene, a=along, m=along)["arms"] == [False] * 4
    assert wrong(scene, shift_mm=along)["arms"] == [False] * 4


def test_elsewhere_is_the_same_way_for_both_arms_whatever_their_bases():
    shift = np.array([[3.0, -4.0, 5.0]])
    for arm in looked_at(scene_of(BESIDE, 0, PAD_TOP_MM, OPENING_RAD), 5).arms:
        moved, planned = arm.links(arm.shifted(shift)), arm.links(arm.joints)
        np.testing.assert_allclose(moved.end_mm[:, 1:] - planned.end_mm[:, 1:] - shift, 0, atol=1e-6)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8)])
def test_the_pad_is_cleared_as_often_as_the_error_function_says(normal):
    settings = EstimateSettings(variations=2000, suture_point_mm=5.0 if normal[2] < 1 else 0.0)  # the pad moves along
    arm = scene_of(ALONE, 0, 0.0, 0.06).arms[0]
    links = arm.links(arm.joints)
    ends = np.concatenate([links.begin_mm, links.end_mm], axis=1) @ normal - np.tile([4.0, 3.6, 1.1, 1.1], 2)
    spare, top_mm = 2.0, float(ends.min()) - 3.0
    for mean_mm in (0.65, 3.0):
        found = judged(pad_top_mm=top_mm, pad_normal=normal, settings=settings, errors=of_tips(mean_mm))
        clear, sigma = under(found).passes[0].clear, mean_mm / MEAN_LENGTH
        expected = (1 + erf(spare / sigma / sqrt(2))) / 2
        assert clear.lower - 0.005 <= expected <= clear.upper + 0.005


def test_only_fingers_may_touch_and_only_at_the_hand_off():
    scene = scene_of(BESIDE, 0, PAD_TOP_MM, OPENING_RAD)
    assert BESIDE.psm_m is not None and BESIDE.psm_m.jaw_rad is not None
    closing = int(np.argmax(BESIDE.psm_m.jaw_rad < handoff.JAW_OPEN_RAD))  # one tick after both arms have come to stand
    assert np.flatnonzero(scene.handing_over).tolist() == list(range(closing - 1, len(scene.phase)))
    thin = looked_at(scene, 8)
    assert np.array_equal(thin.handing_over, thin.stamps_s >= BESIDE.stamps_s[closing - 1])
    assert not scene_of(motion(1, with_a2=False), 0, PAD_TOP_MM, OPENING_RAD).handing_over.any()
    # Two arms 20 mm apart, the fingers of one drawn over to the other.
    arm = links_of(ALONE.joints[:1])
    other = arm.moved(np.array([[20.0, 0.0, 0.0]]))
    reached = arm.end_mm.copy()
    reached[:, 2:] = other.end_mm[:, 2:]
    over = replace(arm, end_mm=reached)
    assert monte_carlo._apart(over, other, np.array([False])) < 0 < monte_carlo._apart(over, other, np.array([True]))


def test_psm_ms_fingers_are_as_open_as_its_jaw_is_planned_to_be():
    """They come in open, hold the needle while PSM_A leaves, and let it go again; without a plan they stay open."""
    first, second = (scene_of(BESIDE, k, PAD_TOP_MM, OPENING_RAD).arms[1].opening_rad for k in (0, 1))
    assert (first[0], first[-1]) == (OPENING_RAD, handoff.HOLDING_RAD)
    assert (second[0], second.max(), second[-1]) == (handoff.HOLDING_RAD, OPENING_RAD, handoff.HOLDING_RAD)
    other = replace(BESIDE.psm_m, jaw_rad=None)
    unplanned = scene_of(replace(BESIDE, psm_m=other), 1, PAD_TOP_MM, OPENING_RAD).arms[1].opening_rad
    assert (unplanned == OPENING_RAD).all()


@pytest.mark.parametrize(("jaw_rad", "touch"), [(handoff.JAW_OPEN_RAD, True), (handoff.JAW_CLOSED_RAD, False)])
def test_arms_side_by_side_touch_unless_psm_ms_jaw_is_closed(jaw_rad, touch):
    """An open finger ends 10.2 sin 30 = 5.1 mm beside its hinge, a closed one 0.6 mm."""
    apart = 9.5 * matrix_of(ALONE.rotation_xyzw[:1])[0, :, 1]  # the side to which fingers open
    mine, theirs = (np.full(len(ALONE), angle) for angle in (handoff.JAW_OPEN_RAD, jaw_rad))
    same = handoff.OtherArm(apart, np.array([0.0, 0, 0, 1]), "400006", ALONE.joints, theirs)
    scene = scene_of(replace(ALONE, psm_m=same, jaw_rad=mine), 0, PAD_TOP_MM, OPENING_RAD)
    scene = replace(scene, arms=tuple(arm.at(np.array([0])) for arm in scene.arms))
    scene = replace(scene, phase=scene.phase[:1], stamps_s=scene.stamps_s[:1])
    assert wrong(scene)["arms"] == [touch] * 4


def test_a_pass_far_enough_elsewhere_is_out_of_reach():
    far = replace(FEW, suture_point_mm=150.0)
    faults = under(judged(settings=far)).passes[0].faults
    assert faults.reach > 10
    assert faults.limits >= faults.reach
    near = under(judged(settings=replace(FEW, suture_point_mm=5.0))).passes[0].faults
    assert (near.reach, near.limits) == (0, 0)


def test_stricter_limits_of_the_playback_are_kept():
    strict = judged(limits=Limits(joint_margin=0.3)).under[0].passes[0].faults
    assert (strict.reach, strict.limits) == (0, FEW.variations)
    deep = judged(limits=Limits(insertion_mm=200.0)).under[0].passes[0].faults
    assert (deep.reach, deep.limits) == (0, FEW.variations)


def test_a_jaw_that_was_not_realigned_hands_nothing_on():
    askew = handoff.realign(POINTING_DOWN, (-0.3, 0.9, -0.3)).rotation
    path = replace(pass_path(), target_rotation=askew)
    turned = time_parametrise([path], rate_hz=100.0)
    beside = motion(1, PSM_M)
    other = handoff.OtherArm(
        np.array(BASE_MM), np.array(BASE_XYZW), "400006", np.repeat(beside.psm_m.joints[-1:], len(turned), 0)
    )
    found = judged(replace(turned, psm_m=other), settings=NO_DOUBT, errors=EXACT)
    assert under(found).passes[0].caught.count == 0


def caught(scene, displaced: Displaced) -> bool:
    arms = monte_carlo.at_hand_off(scene, APPROACH, 200.0)
    turned = np.broadcast_to(np.eye(3), (4, 3, 3))
    place, angle = monte_carlo.caught_by(monte_carlo.crossed(arms, np.zeros((4, 3)), displaced, turned), NO_DOUBT)
    assert (place & angle).all() == (place & angle).any()
    return bool((place & angle)[0])


@pytest.mark.parametrize("trajectory", [ALONE, BESIDE], ids=["alone", "beside PSM_M"])
def test_it_counts_which_arm_is_off_which_way(trajectory):
    scene = scene_of(trajectory, 0, PAD_TOP_MM, OPENING_RAD)
    out = 3.0 * PLANNED.jaw_m[:, 2]  # there are 2.87 mm to the tips of PSM_M's fingers, and 3.07 to its wrist
    given = ({"a": out}, {"a": -out}, {"m": out}, {"m": -out}, {"base": -out}, {"a": out, "m": out})
    assert [caught(scene, off(scene, **one)) for one in given] == [False, True, True, False, False, True]


def test_jaws_that_are_turned_together_catch_as_planned():
    # All is turned by 20 degrees about the place where the needle is held, and PSM_M's hinge with it.
    scene = scene_of(BESIDE, 0, PAD_TOP_MM, OPENING_RAD)
    about = np.array([0.2, -0.5, 0.8]) / np.linalg.norm([0.2, -0.5, 0.8])
    turn = np.tile(rodrigues(radians(20) * about), (2, 4, 1, 1))
    grip = PLANNED.tip_a + 9.0 * PLANNED.jaw_a[:, 2]
    moved = [grip + turn[0, 0] @ (tip - grip) - tip for tip in (PLANNED.tip_a, PLANNED.tip_m)]
    together = replace(off(scene, *moved), jaw_turn=turn)
    assert caught(scene, together)
    assert not caught(scene, replace(off(scene), jaw_turn=turn))  # each about its own hinge


def rodrigues(vector) -> np.ndarray:
    """Rodrigues' formula, written anew."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def test_a_needle_that_is_nowhere_near_is_at_no_angle():
    faults = under(judged(errors=of_tips(1500.0))).passes[0].faults
    assert (faults.place, faults.angle) == (FEW.variations, FEW.variations)


def test_without_an_approach_success_means_only_being_clear():
    for found in (judged(approach=None), judged(motion(1, with_a2=False))):
        one = under(found).passes[0]
        assert (found.hand_offs, one.caught, one.faults.place, one.faults.angle) == (0, None, None, None)
        assert one.succeeds == one.clear


def test_psm_m_beside_catches_what_its_wanted_pose_alone_catches():
    for errors in (only(registration_mm=1.0, wrist_deg=3.0, tip_bias_mm=0.5), of_tips(3.0)):
        beside, alone = (judged(one, errors=errors) for one in (BESIDE, ALONE))
        assert [one.caught for one in under(beside).passes] == [one.caught for one in under(alone).passes]


@pytest.mark.parametrize(
    "size", some(["registration_mm", "registration_deg", "wrist_deg", "tip_bias_mm", "tip_noise_mm"], 3)
)
def test_more_error_never_helps_where_nothing_else_is_in_doubt(size):
    settings = EstimateSettings(variations=100, suture_point_mm=0.0, needle_rad=0.0)
    asked = {"settings": settings, "trajectory": motion(1, PSM_M)}
    counts = [under(judged(errors=only(**{size: value}), **asked)).plan.count for value in (0.0, 0.5, 2.0, 12.0)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] == 100 and counts[-1] < 33


def test_a_plan_of_two_passes_succeeds_about_as_often_as_both_of_them():
    found = under(judged(settings=EstimateSettings(variations=1000)))
    one, other = (each.succeeds.probability for each in found.passes)
    assert found.plan.probability == pytest.approx(one * other, abs=0.04)  # they are drawn independently
    assert found.plan.count <= min(each.succeeds.count for each in found.passes)


def test_a_fault_is_counted_in_every_variation_that_has_it():
    for one in under(judged(BESIDE, errors=of_tips(3.0), settings=FEW)).passes:
        faults = asdict(one.faults)
        missed, on_the_way = one.caught.of - one.caught.count, one.clear.of - one.clear.count
        assert max(faults["place"], faults["angle"]) <= missed <= faults["place"] + faults["angle"]
        way = [faults[name] for name in ("limits", "pad", "arms", "bodies")]
        assert max(way) <= on_the_way <= sum(way)


# ---- the choice of poses -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("enters", ["after_A1", "start"])
def test_between_the_poses_looked_at_nothing_comes_much_nearer(enters):
    whole = scene_of(motion(1, replace(PSM_M, enters=enters)), 0, PAD_TOP_MM, OPENING_RAD)
    thin = looked_at(whole, EstimateSettings().stretches)
    assert len(thin.phase) < 70 < len(whole.phase) / 5
    drawn = draw(5, 0, 20, 1, suture_point_mm=5.0, needle_rad=0.0)
    every, some = (nearest_mm(scene, drawn) for scene in (whole, thin))
    assert (some[:2] - every[:2]).max() < 0.01  # to the pad, of either arm
    assert (some[2] - every[2]).max() < 0.25  # between the arms, each up to 3 mm off


def test_the_lowest_pose_is_looked_at_wherever_on_the_way_it_is():
    dip = PassPath(PATH_MM - [[0, 0, 0], [0, 0, 9], [0, 0, 0], [0, 0, 0]], POINTING_DOWN)
    whole = scene_of(time_parametrise([dip], rate_hz=100.0), 0, PAD_TOP_MM, OPENING_RAD)
    thin = looked_at(whole, 1)
    assert len(thin.phase) < 8
    assert thin.arms[0].tip_mm[:, 2].min() == whole.arms[0].tip_mm[:, 2].min() < -138


def nearest_mm(scene, drawn) -> np.ndarray:
    count, links = len(drawn.shift_mm), [arm.links(arm.shifted(drawn.shift_mm)) for arm in scene.arms]
    top = PAD_TOP_MM + np.repeat(drawn.shift_mm[:, 2], len(scene.phase))
    apart = np.repeat(3.0 / MEAN_LENGTH * (drawn.tip_bias[0] - drawn.tip_bias[1]), len(scene.phase), axis=0)
    meets = np.tile(scene.handing_over, count)
    found = [*(clearance_to_pad(one, top) for one in links), monte_carlo._apart(links[0].moved(apart), links[1], meets)]
    return np.array([one.reshape(count, -1).min(axis=1) for one in found])


# ---- one seed, one answer ----------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_answer_and_another_another():
    assert judged(BESIDE) == judged(BESIDE)
    assert judged(BESIDE, seed=1) != judged(BESIDE)


def test_the_answer_does_not_depend_on_the_chunk_size(monkeypatch):
    before = judged(BESIDE)
    monkeypatch.setattr(monte_carlo, "_CHUNK", 7)
    assert judged(BESIDE) == before


@pytest.mark.nightly  # rarely breaks
def test_another_process_gives_the_same_bytes():
    script = (
        "from tests.verification.test_monte_carlo import *; print(json.dumps(asdict(judged(BESIDE)), allow_nan=False))"
    )
    ran = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == json.dumps(asdict(judged(BESIDE)), allow_nan=False)


def test_a_pass_draws_what_it_draws_whatever_passes_there_are_beside_it():
    assert under(judged(motion(1))).passes[0] == under(judged(motion(3))).passes[0]


def test_what_is_drawn_is_even_about_nothing_and_within_its_bounds():
    drawn = draw(0, 0, 50_000, 1, suture_point_mm=5.0, needle_rad=radians(10))
    assert np.abs(drawn.shift_mm).max() <= 5.0
    assert drawn.shift_mm.std(axis=0) == pytest.approx(5.0 / sqrt(3), abs=0.02)
    angle = np.arccos(np.clip((np.einsum("nii", drawn.turned) - 1) / 2, -1, 1))
    assert angle.max() <= radians(10) + 1e-9 and angle.mean() == pytest.approx(radians(5), abs=1e-3)
    axes = np.stack([drawn.turned[:, i, j] - drawn.turned[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))])
    assert np.abs(axes.mean(axis=1)).max() < 0.003
    every = [drawn.registration, drawn.registration_turn, *drawn.wrist, *drawn.tip_bias, *drawn.tip_noise[:, :, 0]]
    all_of_them = np.concatenate([*every, drawn.shift_mm / (5 / sqrt(3))], axis=1)
    np.testing.assert_allclose(np.cov(all_of_them.T), np.eye(27), atol=0.03)


def test_a_base_stays_from_pass_to_pass_and_all_else_is_drawn_anew():
    one, other, third = (
        draw(seed, k, 5, 3, suture_point_mm=5.0, needle_rad=0.1) for seed, k in ((0, 0), (0, 1), (1, 0))
    )
    for name, same in (
        ("registration", True),
        ("registration_turn", True),
        ("wrist", False),
        ("tip_bias", False),
        ("tip_noise", False),
        ("shift_mm", False),
        ("turned", False),
    ):
        assert np.array_equal(getattr(one, name), getattr(other, name)) == same, name
        assert not np.array_equal(getattr(one, name), getattr(third, name)), name


def test_noise_correlates_in_time_as_it_is_stated():
    stamps_s = np.array([0.0, 0.1, 0.4, 0.4, 2.4])
    drawn = draw(0, 0, 40_000, len(stamps_s), suture_point_mm=0.0, needle_rad=0.0)
    noise = drawn.under(only(tip_noise_mm=2.0, tip_correlation_s=0.5), stamps_s).tip_mm[1, :, :, 2]
    expected = 4.0 * np.exp(-np.abs(stamps_s[:, None] - stamps_s) / 0.5)
    np.testing.assert_allclose(np.cov(noise.T), expected, atol=0.1)
    still = drawn.under(only(tip_noise_mm=2.0), stamps_s).tip_mm[1, :, :, 2]
    np.testing.assert_allclose(np.cov(still.T), 4.0 * np.eye(5), atol=0.1)


# ---- which error costs the most ------------------------------------------------------------------------------------


def test_the_cost_of_an_error_is_the_plan_without_it_in_the_same_worlds():
    asked = {"settings": FEW, "trajectory": motion(1, PSM_M)}
    found = judged(errors=CALIBRATED, **asked)
    counts = [one.without.count for one in found.costs]
    assert counts == sorted(counts, reverse=True) and counts[0] > under(found).plan.count
    for one in found.costs:
        if one.error == "needle":
            alone = judged(errors=CALIBRATED, **asked | {"settings": replace(asked["settings"], needle_rad=0.0)})
        else:
            alone = judged(errors=CALIBRATED.without(one.error), **asked)
        assert one.without == under(alone).plan, one.error
    assert {one.error for one in found.costs} == {*SIZES, "needle"} - {"tip_correlation_s"}
    assert {one.error for one in judged(errors=of_tips(0.65)).costs} == {"tip_bias_mm", "needle"}


# ---- invalid numbers -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["joint_margin", "insertion_mm", "clearance_pad_mm", "clearance_psm_m_mm", "clearance_bodies_mm"]
)
def test_a_limit_that_is_not_a_number_is_kept_by_no_variation(name):
    found = judged(BESIDE, settings=NO_DOUBT, errors=EXACT, limits=Limits(**{name: nan}))
    assert (under(found).plan.count, under(found).passes[0].clear.count) == (0, 0)


def test_joints_that_are_not_numbers_go_wrong_everywhere():
    whole = scene_of(BESIDE, 0, PAD_TOP_MM, OPENING_RAD)
    found = wrong(looked_at(whole, 5), shift_mm=np.array([[0.0, 0, 0], [nan, 0, 0], [0, 0, 0], [0, 0, 0]]))
    assert list(found) == ["reach", "limits", "pad", "arms", "bodies"]
    assert list(found.values()) == [[False, True, False, False]] * 5
    found = wrong(looked_at(whole, 5), a=[[nan, nan, nan], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    assert list(found.values()) == [[False] * 4] * 2 + [[True, False, False, False]] * 3


def test_doubts_that_cannot_be_meant_are_refused():
    for wrong in ({"variations": 0}, {"stretches": 0}):
        with pytest.raises(BadSettings, match="1 to 1000 stretches"):
            EstimateSettings(**wrong)
    for wrong in ({"suture_point_mm": nan}, {"needle_rad": -0.1}, {"stated_rad": nan}):
        with pytest.raises(BadSettings, match="finite"):
            EstimateSettings(**wrong)
    with pytest.raises(BadInput, match="height"):
        judged(pad_top_mm=nan)
    for normal in ((0.0, 0.0, 2.0), (nan, 0.0, 1.0)):
        with pytest.raises(BadInput, match="length 1"):
            judged(pad_normal=normal)
    with pytest.raises(BadSettings, match="seed"):
        judged(seed=-1)


def test_worlds_are_counted_by_hand():
    """Of four worlds the first fails to reach, the second to place, both in the first pass; the third at the pad."""
    world = np.eye(4, dtype=bool)
    taken = [{"held": ~world[3], "straight": ~(world[3] | world[0])}, {"held": ~world[0], "straight": ~world[0]}]
    faults = [{"reach": world[0], "place": world[1]}, {"pad": world[2]}]
    without = probabilities.counted(faults, [taken[0], {}], EXACT)
    assert (without.held, without.straight, without.passes[1].held) == (None, None, None)
    counted = probabilities.counted(faults, taken, EXACT)
    assert (counted.held and counted.held.count, counted.straight and counted.straight.count) == (2, 2)
    assert [one.held and one.held.count for one in counted.passes] == [3, 3]
    assert [one.straight and one.straight.count for one in counted.passes] == [2, 3]
    first, second = counted.passes
    assert (counted.plan.count, counted.plan.of, counted.plan.probability) == (1, 4, 0.25)
    assert (first.succeeds.count, first.clear.count, first.caught and first.caught.count) == (2, 3, 3)
    assert (second.succeeds.count, second.clear.count, second.caught) == (3, 3, None)
    assert (first.faults.reach, first.faults.place, first.faults.pad, second.faults.pad) == (1, 1, None, 1)


Pad = tuple[float, tuple[float, float, float]]  # height along the normal, mm, and the normal
TIPS = ArmErrors("tips alone", 0, 0, 0, 0.65 / MEAN_LENGTH, 0, 0, dict.fromkeys(SIZES, "a test"))
# An independent Monte Carlo of the first judge's plan, with these errors added to a tip error of 0.65 mm on average.
FOUND_BEFORE = {
    "registration off by 1 mm": (replace(TIPS, registration_mm=1.0), 0.90),
    "registration off by 2 mm": (replace(TIPS, registration_mm=2.0), 0.48),
    "registration off by 1 degree": (replace(TIPS, registration_deg=1.0), 0.28),
    "wrists off by 3 degrees": (replace(TIPS, wrist_deg=3.0), 0.91),
    "wrists off by 5 degrees": (replace(TIPS, wrist_deg=5.0), 0.66),
}


def probability(
    trajectory: Trajectory,
    errors: ArmErrors,
    pad: Pad = (PAD_TOP_MM, (0.0, 0.0, 1.0)),
    variations: int = 1000,
    seed: int = 0,
) -> float:
    settings = EstimateSettings(variations=variations)
    tools = Limits(clearance_bodies_mm=-1e6)  # the other worlds have no outer bodies
    pad_top_mm, pad_normal = pad
    asked = {"errors": errors, "settings": settings, "limits": tools, "seed": seed}
    found = estimate_success(trajectory, approach_m=None, pad_top_mm=pad_top_mm, pad_normal=pad_normal, **asked)
    return found.under[0].plan.probability


@pytest.mark.parametrize(("errors", "found"), some(FOUND_BEFORE.values(), 3), ids=FOUND_BEFORE)
def test_errors_that_the_first_judge_left_out_cost_as_much_as_was_found(errors, found):
    assert probability(motion(1, PSM_M), errors) == pytest.approx(found, abs=0.04)


def some_plan(seed: int) -> tuple[Trajectory, ArmErrors, Pad]:
    """Return a plan of one pass with an approach, errors and a pad of its own; two of three pads slope."""
    rng = np.random.default_rng(seed)
    approach = np.array(PSM_M.approach) + rng.uniform(-0.15, 0.15, 3)
    path = PATH_MM + rng.uniform(-4, 4, 3) + np.append(np.zeros((1, 3)), rng.uniform(-2, 2, (3, 3)), axis=0)
    psm_m = replace(PSM_M, approach=tuple(approach.tolist()))
    one = PassPath(path, POINTING_DOWN, handoff.realign(POINTING_DOWN, approach).rotation)
    below_mm, slope, towards = rng.uniform(2.0, 6.0), radians(12.0 * (seed % 3)), float(seed)
    normal = (sin(slope) * cos(towards), sin(slope) * sin(towards), cos(slope))
    pad_top_mm = float((path @ normal).min()) - 10.2 - below_mm
    most = rng.uniform(0.2, 1.0)  # so that some plans have small errors alone
    errors = replace(
        TIPS,
        registration_mm=most * rng.uniform(0, 2.4),
        registration_deg=most * rng.uniform(0, 0.9),
        wrist_deg=most * rng.uniform(0, 3),
        tip_bias_mm=most * rng.uniform(0, 0.8),
        tip_noise_mm=most * rng.uniform(0, 0.5),
        tip_correlation_s=rng.choice([0.0, 0.3, 2.0]),
    )
    return time_parametrise([one], rate_hz=100.0, psm_m=psm_m), errors, (pad_top_mm, normal)


def compared(plans: int, variations: int, tried: int) -> tuple[list[float], int, list[float]]:
    """Compare plans from 0.2 to 0.99 with as many other worlds of each.

    Each plan has draws of its own: with the same ones for all, all closed forms are off to the same side.

    Returns:
        The closed form's probabilities, the number of those within the other worlds' Wilson interval, and the
        differences in standard deviations of both estimates.
    """
    found, agree, off, seed = [], 0, [], 0
    while len(found) < plans:
        trajectory, errors, pad = some_plan(seed)
        closed = probability(trajectory, errors, pad, variations, seed)
        if 0.2 <= closed <= 0.99:
            count = worlds.successes(trajectory, errors, *pad, tried, 2000 + seed)
            lower, upper = wilson(count, tried)
            found.append(closed)
            agree += lower <= closed <= upper
            both = (closed * variations + count) / (variations + tried)
            off.append((closed - count / tried) / sqrt(both * (1 - both) * (1 / variations + 1 / tried)))
        seed += 1
    return found, agree, off


def test_a_plan_succeeds_as_often_as_in_independent_worlds():
    # So many variations that the closed form's own error is a quarter of the worlds': Wilson's interval has that alone.
    found, agree, _ = compared(plans=1, variations=1500, tried=80)
    assert agree == 1, found  # the interval holds 95 %, and the seed is always the same


@pytest.mark.nightly
def test_50_plans_succeed_as_often_as_in_independent_worlds():
    found, agree, off = compared(plans=50, variations=4000, tried=300)
    bias = sum(off) / sqrt(len(off))  # of deviation 1 if there is none
    print(f"{agree} of 50 agree, {min(found):.2f} to {max(found):.2f}; all together off by {bias:.1f} deviations")
    assert agree >= 45, found
    assert abs(bias) < 3, off
    assert min(found) < 0.3 and max(found) > 0.95


# ---- the needle against tissue -------------------------------------------------------------------------------------


def test_the_needle_touches_as_a_point_by_point_computation_says():
    needle_mm = np.full(len(ALONE), 4.0)
    scene = looked_at(scene_of(ALONE, 0, PAD_TOP_MM, OPENING_RAD, needle_mm=needle_mm), 5)
    drawn = draw(3, 0, 60, len(scene.phase), suture_point_mm=5.0, needle_rad=radians(10))
    displaced = drawn.under(UNCALIBRATED, scene.stamps_s)
    (found,) = in_tissue(scene, [displaced], drawn.turned)
    assert 0 < found.sum() < len(found)
    for k in range(60):
        lowest = []
        for s in range(len(scene.phase)):
            grip = handoff.HELD_MM * scene.arms[0].rotation[s][:, 2]
            planned = grip + ARC_MM @ scene.needle[s].T
            jaw = displaced.jaw_turn[0, k]
            there = displaced.tip_mm[0, k, s] + jaw @ grip + ARC_MM @ (jaw @ drawn.turned[k] @ scene.needle[s]).T
            lowest.append(4.0 + there[:, 2].min() - planned[:, 2].min())
        assert found[k] == (min(lowest) < 0)


@pytest.mark.parametrize(("apart_mm", "touches"), [(2.0, 0), (-0.1, 40), (np.nan, 40), (np.inf, 0)])
def test_a_needle_that_is_planned_into_tissue_is_in_it_in_every_world(apart_mm: float, touches: int):
    needle_mm = np.full(len(ALONE), np.inf)
    needle_mm[30] = apart_mm
    found = judged(needle_mm=needle_mm, settings=NO_DOUBT, errors=EXACT)
    assert (under(found).passes[0].faults.needle, under(found).plan.count) == (touches, 40 - touches)


def test_errors_of_an_arm_that_is_not_planned_are_not_listed():
    alone = judged(motion(1, with_a2=False), approach=None, errors=UNCALIBRATED)
    assert {one.error for one in alone.costs} == {"wrist_deg", "tip_bias_mm", "tip_noise_mm", "needle"}
    beside = judged(motion(1, PSM_M), errors=UNCALIBRATED)
    assert {"registration_mm", "registration_deg"} < {one.error for one in beside.costs}
