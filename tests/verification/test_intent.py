"""The judge compares a motion with what was asked: faults of the whole are named, and no sound plan is refused.

Faults of passes, jaws and transfers are in `test_pass_comparison`.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from skills.gridworld.grid import discretize
from skills.gridworld.reward import sparse_reward
from skills.gridworld.scene import Box, Scene, Tissue
from skills.kinematics import forward, instrument_of, joint_margins, matrix_of, quaternion_of
from skills.learning.policy import learn_tabular
from skills.learning.q_learning import PhaseQLearning
from skills.library.plans.headline import CHECK_VERSION
from skills.packing import canonical, sha256
from skills.planning.handoff import PsmM
from skills.planning.plan import SuturePoint, stack
from skills.planning.trajectory import A1, A2, TRANSFER, PassPath, Trajectory
from skills.verification import intent, pass_comparison
from skills.verification.arm_errors import UNCALIBRATED
from skills.verification.deviations import LIMITS
from skills.verification.intent import compare
from skills.verification.playback import Playback
from skills.verification.requested import requested_motion
from skills.verification.scene_clearance import clearance_of
from skills.verification.verdict import judge, judge_plan
from tests.planning.motions import PSM_M, ideal_playback
from tests.planning.test_hand import turning
from tests.verification.faults import BASE, RATE_HZ, X, Z, broken, bump, planned, poses, rising, shift, sound, timed
from tests.verification.hands import BASE_MM, BASE_XYZW, Planned, about, sound_plans


@pytest.mark.parametrize("orientation", [None, "constant"])
@pytest.mark.parametrize("a2", ["paper", "recorded"])
def test_a_sound_motion_deviates_nowhere(a2, orientation):
    asked, motion = sound(a2, orientation)
    assert broken(compare(asked, motion)) is None
    assert broken(compare(asked, poses(motion).built())) is None


def test_limits_stay_the_same_while_the_version_of_the_check_does():
    """A change of a limit changes verdicts: then `CHECK_VERSION` is raised, so that plans can be played again."""
    stated = sha256(canonical([[kind, unit, repr(limit)] for kind, (unit, limit) in LIMITS.items()]))
    assert (CHECK_VERSION, stated[:12]) == (1, "1470937fa67c")


def test_a_pass_without_its_a2_is_named_at_its_first_sample_alone():
    asked, motion = sound()
    changed = poses(motion)
    changed.repeat(np.flatnonzero((changed.passes != 1) | (changed.phase != A2)))
    values = compare(asked, changed.built()).values["number of passes off the suture points"]
    assert np.flatnonzero(~(values == 0)).tolist() == [int(np.argmax(changed.passes == 1))]


def test_a_pass_that_ends_with_a_place_beyond_the_hinge_does_not_deviate():
    demo, policy = turning()
    point, psm_m = SuturePoint(tuple((demo.tip_mm[-1] - [0.0, 0.0, 10.2]).tolist())), PsmM(PSM_M, BASE_MM, BASE_XYZW)
    plan = stack(policy, [point], demo=demo, psm_m=psm_m, rate_hz=RATE_HZ, speed_mm_s=20.0, tip_offset_mm=10.2)
    asked, motion = requested_motion(plan, policy, demo), timed(plan.passes, psm_m)
    assert broken(compare(asked, motion)) is None
    nearer = replace(asked, tip_offset_mm=10.0)
    assert broken(compare(nearer, motion)) is not None


def base_off(motion: Trajectory) -> Trajectory:
    return replace(motion, psm_m=replace(motion.psm_m, base_mm=motion.psm_m.base_mm + 10 * X))


def base_turned(motion: Trajectory) -> Trajectory:
    turned = quaternion_of((about(Z, np.radians(1)) @ BASE)[None])[0]
    return replace(motion, psm_m=replace(motion.psm_m, base_xyzw=turned))


def swapped(motion: Trajectory) -> Trajectory:
    """Each arm moves as the other should, with poses to match."""
    tip, turned = forward(motion.psm_m.joints)
    other = replace(motion.psm_m, joints=motion.joints)
    return replace(motion, joints=motion.psm_m.joints, tip_mm=tip, rotation_xyzw=quaternion_of(turned), psm_m=other)


WHOLE = {
    "PSM_M's base 10 mm off": (base_off, "PSM_M's base off the stated one"),
    "PSM_M's base turned by a degree": (base_turned, "PSM_M's base turned from the stated one"),
    "arms swapped": (swapped, "start of the pass off the asked one"),
    "PSM_M missing": (lambda motion: replace(motion, psm_m=None), "PSM_M's base off the stated one"),
    "no tempo": (lambda motion: replace(motion, tempo=None), "clock of A1 off the recording's"),
    "no jaw": (lambda motion: replace(motion, jaw_rad=None), "opening of the jaw off the recording"),
}


@pytest.mark.parametrize("name", WHOLE)
def test_a_fault_of_the_whole_motion_is_named_at_its_first_sample(name):
    plant, kind = WHOLE[name]
    asked, motion = sound()
    assert broken(compare(asked, plant(motion))) == (kind, 0)


def test_what_was_played_counts_and_not_what_the_trajectory_says():
    asked, motion = sound()
    played = np.array(motion.joints)
    played[700, 2] += 20.0
    kind, sample = broken(compare(asked, motion, played))
    assert (kind, sample) == ("speed of the tip", 699)
    played[700] = np.nan
    _, sample = broken(compare(asked, motion, played))
    assert sample in (699, 700)
    unknown = compare(asked, motion, np.full_like(played, np.nan))
    assert np.isnan(unknown.values["path off the recording"]).any()


# ---- the verdict ---------------------------------------------------------------------------------------------------


def ideal(trajectory: Trajectory) -> Playback:
    """Return the measurements of a simulator without any fault, both arms far from all else."""
    if trajectory.psm_m is None:
        return ideal_playback(trajectory)
    base = matrix_of(trajectory.psm_m.base_xyzw[None])[0]
    m_tip = forward(trajectory.psm_m.joints)[0] @ base.T + trajectory.psm_m.base_mm
    return replace(ideal_playback(trajectory), clearances_mm=np.full((len(trajectory), 24), 20.0), psm_m_tip_mm=m_tip)


def planned_wrongly(change: Callable[[PassPath], PassPath]) -> Trajectory:
    """Return the motion of the sound plan with its middle pass changed before it is timed, PSM_A's alone."""
    passes = [*planned().passes]
    passes[1] = change(passes[1])
    return timed(passes, PsmM(PSM_M))


def a2_beside(degrees: float) -> Trajectory:
    wrong = about(np.array(PSM_M), np.radians(degrees))
    return planned_wrongly(lambda one: replace(one, target_rotation=wrong @ one.target_rotation))


def goal_beside() -> Trajectory:
    """Return a motion whose middle pass is stretched smoothly, so that it ends 10 mm off."""

    def stretch(one: PassPath) -> PassPath:
        parts = rising(len(one.tip_mm)), rising(len(one.hand.tip_mm))
        tips = [tip + part[:, None] * 10 * X for tip, part in zip((one.tip_mm, one.hand.tip_mm), parts, strict=True)]
        return replace(one, tip_mm=tips[0], hand=replace(one.hand, tip_mm=tips[1]))

    return planned_wrongly(stretch)


def backwards() -> Trajectory:
    def reverse(one: PassPath) -> PassPath:
        hand = one.hand
        back = replace(hand, tip_mm=hand.tip_mm[::-1], rotation_xyzw=hand.rotation_xyzw[::-1])
        return replace(one, tip_mm=one.tip_mm[::-1], rotation=one.last_rotation, hand=back)

    return planned_wrongly(reverse)


def stalled() -> Trajectory:
    """Return a motion that comes to rest in A1 within the arms' limits, stands for half a second and goes on."""
    _, motion = sound()
    at = poses(motion).rows(A1)[300]
    ease = rising(40)
    slower = np.concatenate((1 - ease, np.zeros(50), ease))
    clock = np.append(0.0, np.cumsum(np.concatenate((np.ones(at), slower, np.ones(len(motion))))))
    clock = clock[: int(np.searchsorted(clock, len(motion) - 1)) + 1].clip(max=len(motion) - 1)
    nearest = np.rint(clock).astype(int)
    number = np.arange(len(motion))
    joints, other = (CubicSpline(number, q)(clock) for q in (motion.joints, motion.psm_m.joints))
    tip, turned = forward(joints)
    passes = motion.pass_index[nearest]
    return replace(
        motion,
        stamps_s=(np.arange(len(clock)) + passes * (RATE_HZ - 1)) / RATE_HZ,
        joints=joints,
        tip_mm=tip,
        rotation_xyzw=quaternion_of(turned),
        pass_index=passes,
        phase=motion.phase[nearest],
        jaw_rad=motion.jaw_rad[nearest],
        psm_m=replace(motion.psm_m, joints=other, jaw_rad=motion.psm_m.jaw_rad[nearest]),
    )


JUDGED: dict[str, tuple[Callable[[], Trajectory], str, int]] = {
    "A2 wrong by 30 degrees": (lambda: a2_beside(30.0), "A2 off the paper's hand-off", A2),
    "A2 wrong by 90 degrees": (lambda: a2_beside(90.0), "A2 off the paper's hand-off", A2),
    "goal 10 mm off": (goal_beside, "path off the recording", A1),
    "reversed": (backwards, "transfer leaves the shorter way", TRANSFER),
    "A1 stalls": (stalled, "jaw turned off the recording", A1),
    "arms swapped": (lambda: swapped(sound()[1]), "start of the pass off the asked one", A1),
    "PSM_M's base 10 mm off": (lambda: base_off(sound()[1]), "PSM_M's base off the stated one", A1),
}


@pytest.mark.parametrize("name", JUDGED)
def test_the_verdict_names_it_though_the_arms_did_as_the_trajectory_says(name):
    """Without the intent each of these is feasible."""
    faulty, kind, phase = JUDGED[name][0](), *JUDGED[name][1:]
    asked, _ = sound()
    if faulty.psm_m is None:
        asked = replace(asked, psm_m=PsmM(PSM_M))
    assert judge(ideal(faulty), faulty).feasible
    report = judge(ideal(faulty), faulty, intent=compare(asked, faulty))
    assert not report.feasible
    assert (report.failure.quantity, report.failure.unit, report.failure.phase) == (kind, LIMITS[kind][0], phase)
    assert f"the limit is {LIMITS[kind][1]:.4g}" in str(report.failure)
    assert {one.kind for one in report.intent} == set(LIMITS)


@pytest.mark.parametrize("hysteresis", [0.0, 0.25, 0.5])
def test_cells_reach_as_far_as_hysteresis_and_a_path_farther_out_is_named(hysteresis):
    """A path that is bent aside is as far off as from the nearest cell, widened by hysteresis on every side."""
    demo, straight = turning()
    grid, kind = straight.path.grid, "path off the policy's cells"
    policy = learn_tabular(sparse_reward(discretize(demo.tip_mm, grid, hysteresis)), PhaseQLearning(), seed=0)
    point = SuturePoint(tuple(demo.tip_mm[-1].tolist()))
    psm_m = PsmM(PSM_M, BASE_MM, BASE_XYZW)
    plan = stack(policy, [point], demo=demo, psm_m=psm_m, rate_hz=RATE_HZ, speed_mm_s=20.0)
    asked, sound_motion = requested_motion(plan, policy, demo), timed(plan.passes, plan.psm_m)
    assert compare(asked, sound_motion).values[kind].max() < 0.05  # bends are rounded off by the arm
    for bent_mm, named in ((4.0, False), (12.0, True)):
        motion = poses(sound_motion)
        rows = motion.rows(A1, 0)
        rows = rows[len(rows) // 2 - 110 : len(rows) // 2 + 110]
        shift(motion, rows, bump(220)[:, None] * bent_mm * Z)
        off = compare(asked, motion.built()).values[kind]
        places = (motion.tip[rows] - grid.origin_mm) / grid.cell_mm
        beyond = np.abs(places[:, None] - policy.path.cells) - 0.5 - hysteresis
        expected = np.linalg.norm(beyond.clip(min=0), axis=2).min(axis=1)
        assert off.max() == pytest.approx(expected.max(), abs=0.1)  # looked at every tenth of a cell
        assert (off.max() > LIMITS[kind][1]) == named


def test_a_path_that_ends_beside_its_last_cell_is_named_at_its_last_sample():
    cells = np.arange(4)[:, None] * [1, 0, 0]
    places = np.append(cells, [[3, 2, 0]], axis=0).astype(float)
    np.testing.assert_allclose(pass_comparison._off_cells(places, cells, 0.5), [0, 0, 0, 0, 1.5])
    np.testing.assert_allclose(pass_comparison._off_cells(places[:2], cells, 0.5), [0, 1])  # the last cell is not near


def test_a_start_beside_the_demonstrated_one_goes_by_the_clock_of_its_end():
    """From the demonstrated start the whole clock is compared: it would be an eighth of a second late."""
    demo, policy = turning()
    point, psm_m = SuturePoint(tuple(demo.tip_mm[-1].tolist())), PsmM(PSM_M, BASE_MM, BASE_XYZW)
    start = demo.tip_mm[0] + 0.1 * X
    plan = stack(policy, [point], demo=demo, psm_m=psm_m, starts_mm=[start], rate_hz=RATE_HZ, speed_mm_s=20.0)
    assert broken(compare(requested_motion(plan, policy, demo), timed(plan.passes, psm_m))) is None


def test_a_sound_motion_is_feasible_with_its_intent_and_without():
    asked, motion = sound()
    assert judge(ideal(motion), motion, intent=compare(asked, motion)).feasible
    assert judge(ideal(motion), motion).intent is None


def test_the_verdict_on_a_plan_has_its_request_scene_and_inexact_worlds():
    demo, policy = turning()
    point, psm_m = SuturePoint(tuple(demo.tip_mm[-1].tolist())), PsmM(PSM_M, BASE_MM, BASE_XYZW)
    plan = stack(policy, [point], demo=demo, psm_m=psm_m, rate_hz=RATE_HZ, speed_mm_s=20.0)
    motion = timed(plan.passes, psm_m)
    low_mm = float(motion.tip_mm[:, 2].min()) - 30.0
    plan = replace(plan, scene=Scene(plan.frame, tissue=Tissue.plane((0.0, 0.0, low_mm), (0.0, 0.0, 1.0))))
    verdict = judge_plan(plan, motion, ideal(motion), policy=policy, demo=demo)
    beside, apart = clearance_of(motion, plan.scene), compare(requested_motion(plan, policy, demo), motion)
    assert verdict.report == judge(ideal(motion), motion, beside=beside, pad_is_tissue=False, intent=apart)
    assert verdict.report.feasible and verdict.failure_sentence is None
    assert verdict.scene == beside.report
    assert (verdict.success.pad_top_mm, verdict.success.under[0].errors) == (low_mm, UNCALIBRATED)
    x, y, z = motion.tip_mm[len(motion) // 2].tolist()
    box = Box((x - 5.0, y - 5.0, z - 5.0), (x + 5.0, y + 5.0, z + 5.0))
    inside = replace(plan, scene=replace(plan.scene, boxes=(box,)))
    assert "Nearest: " in judge_plan(inside, motion, ideal(motion), policy=policy, demo=demo).failure_sentence


# ---- sound plans ---------------------------------------------------------------------------------------------------


def refused(one: Planned) -> str | None:
    """Return why a plan is refused, if it is."""
    report = judge(
        ideal(one.trajectory), one.trajectory, intent=compare(requested_motion(one.plan, *one[:2]), one.trajectory)
    )
    return None if report.failure is None else str(report.failure)


def passes_all_else(one: Planned) -> bool:
    """Return whether the arms keep apart and within their limits, so that only the intent could refuse the plan."""
    return judge(ideal(one.trajectory), one.trajectory).feasible


def near_a_limit(trajectory: Trajectory) -> bool:
    """Return whether a joint is within a tenth of a limit: of its range, its speed or its acceleration."""
    tool = instrument_of(trajectory.instrument)
    margins = joint_margins(trajectory.joints, trajectory.instrument) / (tool.upper - tool.lower)
    return max(trajectory.speed_ratio, trajectory.acceleration_ratio) >= 0.9 or float(margins.min()) <= 0.1


def test_no_sound_plan_is_refused():
    """A slice of the nightly test below."""
    plans = [one for one in sound_plans(seed=3, count=2) if passes_all_else(one)]
    assert plans
    assert [refused(one) for one in plans] == [None] * len(plans)


@pytest.mark.nightly
def test_of_200_sound_plans_half_near_a_limit_none_is_refused():
    drawn = [one for one in sound_plans(seed=20, count=320) if passes_all_else(one)]
    near = [one for one in drawn if near_a_limit(one.trajectory)][:100]
    plans = near + [one for one in drawn if not near_a_limit(one.trajectory)][:100]
    assert len(plans) == 200
    assert [(k, why) for k, one in enumerate(plans) if (why := refused(one))] == []
    assert {one.plan.a2 for one in plans} == {"recorded", "paper"}
    assert {one.plan.orientation for one in plans} == {"recorded", "demonstrated", "assumed tool-down"}


def test_a_joint_that_is_unknown_makes_the_whole_pose_unknown():
    """The last joint turns the jaws: where it is unknown, the place of the tip is not trusted either."""
    joints = np.tile([0.1, 0.2, 0.12, 0.3, 0.4, 0.5], (2, 1))
    joints[1, 5] = np.nan
    found = intent._poses(joints, "400006")
    tip, rotation = found.tip_mm, found.rotation
    assert np.isfinite(tip[0]).all() and np.isfinite(rotation[0]).all()
    assert np.isnan(tip[1]).all() and np.isnan(rotation[1]).all()
