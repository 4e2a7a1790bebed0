"""The tube around a pose path: runs that try to leave it, defects of the update, and a replay by the clock."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from skills.arrays import xyz
from skills.demonstration.partner import PartnerMotion
from skills.errors import BadInput, BadSettings
from skills.gridworld.scene import Box, Capsule, Scene, Tissue
from skills.learning import pose_step
from skills.learning.pose_step import Hands, advance, next_pose
from skills.learning.pose_style import PHASES, PosePath
from skills.learning.tube import CertifiedPoses, Update, certify_tube, clear_tube
from skills.learning.tube_certificate import TubeClearance, TubeLimits
from tests.by_day import some
from tests.learning.loops import run_both

LIMITS = TubeLimits(step_mm=6.0, step_rad=0.2, disturbance_mm=1.0, disturbance_rad=0.02, start_mm=20.0, start_rad=0.5)


def a_path(turn_deg: float = 60.0) -> PosePath:
    """Return a hand-off of 60 mm with a turn, fast in the middle."""
    phase = np.linspace(0.0, 1.0, PHASES)
    share = phase * phase * (3 - 2 * phase)
    tip = np.stack([60 * share, 12 * np.sin(np.pi * share), -120 - 8 * np.sin(2 * np.pi * share)], axis=1)
    turned = Slerp([0, 1], Rotation.from_euler("xyz", [(10, 20, 30), (10 + turn_deg, 20, 30)], degrees=True))(share)
    nothing = np.zeros(PHASES)
    return PosePath(tip, turned.as_quat(), 4 * phase, nothing, nothing, nothing)


def unit(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return directions, (count, 3)."""
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def excursions(path: PosePath, limits: TubeLimits, runs: int, seed: int) -> tuple[float, float, int]:
    """Follow a path from starts on the edge, disturbed each tick; a third of the runs always away from the path.

    Returns:
        The largest distance from the pose of the phase, in mm and in rad, and the ticks until all have arrived.
    """
    rng = np.random.default_rng(seed)
    poses = Rotation.from_quat(path.rotation_xyzw)
    phases = rng.integers(0, PHASES, runs)
    tip = path.tip_mm[phases] + limits.start_mm * unit(rng, runs)
    rotation = poses[phases] * Rotation.from_rotvec(limits.start_rad * unit(rng, runs))
    hands, furthest = Hands(tip, rotation.as_quat(), phases), np.array([limits.start_mm, limits.start_rad])
    hostile, tick = np.arange(runs) % 3 == 0, 0
    while (hands.phases < PHASES - 1).any():
        tick += 1
        assert tick < 1000, "the runs do not arrive"
        sent = advance(path, hands, limits)
        away = sent.tip_mm - path.tip_mm[sent.phases]
        far = np.linalg.norm(away, axis=1, keepdims=True)
        push = np.where(hostile[:, None] & (far > 1e-9), away / np.maximum(far, 1e-12), unit(rng, runs))
        size = np.where(hostile, 1.0, rng.random(runs))[:, None]
        twist = (poses[sent.phases].inv() * turns(sent)).as_rotvec()
        angle = np.linalg.norm(twist, axis=1, keepdims=True)
        spin = np.where(hostile[:, None] & (angle > 1e-9), twist / np.maximum(angle, 1e-12), unit(rng, runs))
        reached = turns(sent) * Rotation.from_rotvec(limits.disturbance_rad * size * spin)
        hands = Hands(sent.tip_mm + limits.disturbance_mm * size * push, reached.as_quat(), sent.phases)
        off_rad = (turns(hands).inv() * poses[hands.phases]).magnitude().max()
        off_mm = np.linalg.norm(hands.tip_mm - path.tip_mm[hands.phases], axis=1).max()
        furthest = np.maximum(furthest, [off_mm, off_rad])
    return float(furthest[0]), float(furthest[1]), tick


def held_in_the_tube(runs: int, seed: int) -> None:
    """Compare runs with the certificate."""
    for limits in (LIMITS, replace(LIMITS, ahead=3), replace(LIMITS, start_mm=0.0, start_rad=0.0)):
        path = a_path()
        proven = certify_tube(path, limits)
        assert proven.holds, proven.faults
        off_mm, off_rad, ticks = excursions(path, limits, runs, seed)
        assert off_mm <= proven.radius_mm + 1e-9 and off_rad <= proven.radius_rad + 1e-9
        assert ticks <= proven.ticks
        assert proven.radius_mm <= 2 * off_mm and proven.radius_rad <= 2 * off_rad


def turns(hands: Hands) -> Rotation:
    return Rotation.from_quat(hands.rotation_xyzw)


@pytest.mark.parametrize(("runs", "seed"), some([(300, 1), *((10_000, seed) for seed in range(34))], 35))
def test_no_run_leaves_the_tube_and_all_arrive_in_time(runs: int, seed: int) -> None:
    held_in_the_tube(runs, seed)  # under each of three limits, so at night a million


def too_long(path: PosePath, hands: Hands, limits: TubeLimits) -> Hands:
    """Take steps a tenth too long."""
    return advance(path, hands, replace(limits, step_mm=1.1 * limits.step_mm))


def unnormalised(path: PosePath, hands: Hands, limits: TubeLimits) -> Hands:
    """Return quaternions a thousandth too long."""
    after = advance(path, hands, limits)
    return replace(after, rotation_xyzw=1.001 * after.rotation_xyzw)


def by_the_clock(path: PosePath, hands: Hands, limits: TubeLimits) -> Hands:
    """Advance the phase in each tick, wherever the hand is, and make a step towards its pose."""
    later = np.minimum(hands.phases + 1, len(path.tip_mm) - 1)
    return replace(advance(path, replace(hands, phases=later), replace(limits, ahead=1)), phases=later)


def jumping(path: PosePath, hands: Hands, limits: TubeLimits) -> Hands:
    """Skip a phase at one place."""
    after = advance(path, hands, limits)
    return replace(after, phases=np.where(after.phases == 50, 52, after.phases))


def backwards(path: PosePath, hands: Hands, limits: TubeLimits) -> Hands:
    """Fall back at one place."""
    after = advance(path, hands, limits)
    return replace(after, phases=np.where(after.phases == 70, 60, after.phases))


def lazy(path: PosePath, hands: Hands, limits: TubeLimits) -> Hands:
    """Make only half of each step."""
    return advance(path, hands, replace(limits, step_mm=limits.step_mm / 2))


@pytest.mark.parametrize(
    ("update", "fault"),
    [
        (too_long, "A step is longer"),
        (unnormalised, "not a unit quaternion"),
        (by_the_clock, "advances to a position that is not reached"),
        (jumping, "The phase advances by more"),
        (backwards, "goes back"),
        (lazy, "does not come nearer to the position"),
    ],
)
def test_a_defect_of_the_update_fails_the_certificate(update: Update, fault: str) -> None:
    found = certify_tube(a_path(), LIMITS, update)
    assert not found.holds and any(fault in one for one in found.faults), found.faults


def test_a_step_shorter_than_move_and_disturbance_is_named() -> None:
    path = a_path()
    quick = float(np.linalg.norm(np.diff(path.tip_mm, axis=0), axis=1).max())
    assert certify_tube(path, replace(LIMITS, step_mm=1.0 + 1.001 * quick)).holds
    short = certify_tube(path, replace(LIMITS, step_mm=1.0 + 0.999 * quick))
    assert not short.holds and "is not as long as the disturbance of 1 mm" in short.faults[0]


def test_a_replay_by_the_clock_leaves_the_tube() -> None:
    path, limits = a_path(), LIMITS
    tip, phase, worst = path.tip_mm[0] + (0.0, 0.0, 15.0), 0, 0.0
    held = Hands(tip[None], path.rotation_xyzw[:1], np.array([phase]))
    for tick in range(PHASES - 1):
        if 30 <= tick < 60:  # something holds the hand
            held = replace(held, phases=np.minimum(held.phases + 1, PHASES - 1))
        else:
            held = by_the_clock(path, held, limits)
        worst = max(worst, float(np.linalg.norm(held.tip_mm - path.tip_mm[held.phases], axis=1)[0]))
    assert worst > certify_tube(path, limits).radius_mm


def by_scipy(path: PosePath, hands: Hands, limits: TubeLimits) -> tuple[Hands, np.ndarray]:
    """Compute a tick with scipy's rotations, for all hands at once; return also distance and angle before it."""
    poses, last = Rotation.from_quat(path.rotation_xyzw), len(path.tip_mm) - 1
    back = turns(hands).inv()
    phases, reached = hands.phases.copy(), np.zeros(len(hands.phases), bool)
    for ahead in range(limits.ahead, -1, -1):
        there = np.minimum(hands.phases + ahead, last)
        off_mm = np.linalg.norm(path.tip_mm[there] - hands.tip_mm, axis=1)
        off_rad = (back * poses[there]).magnitude()
        now = ~reached & (off_mm <= limits.step_mm) & (off_rad <= limits.step_rad)
        phases[now], reached = there[now], reached | now
    to_mm, turn = path.tip_mm[phases] - hands.tip_mm, (back * poses[phases]).as_rotvec()
    far_mm, far_rad = np.linalg.norm(to_mm, axis=1), np.linalg.norm(turn, axis=1)
    tip = hands.tip_mm + to_mm * (limits.step_mm / np.maximum(far_mm, limits.step_mm))[:, None]
    shorter = Rotation.from_rotvec(turn * (limits.step_rad / np.maximum(far_rad, limits.step_rad))[:, None])
    tip[reached] = path.tip_mm[phases[reached]]
    rotation = np.where(reached[:, None], path.rotation_xyzw[phases], (turns(hands) * shorter).as_quat())
    return Hands(tip, rotation, phases), np.stack([off_mm, off_rad], axis=1)


@pytest.mark.parametrize("ahead", [1, 3])
def test_the_compiled_tick_equals_that_of_scipy(ahead: int) -> None:
    path, limits, rng, runs = a_path(), replace(LIMITS, ahead=ahead), np.random.default_rng(3), 5000
    phases = rng.integers(0, PHASES, runs)
    turned = Rotation.from_rotvec(unit(rng, runs) * rng.choice([0.0, 1e-9, 0.1, 0.5, 3.1], (runs, 1)))
    rotation = (Rotation.from_quat(path.rotation_xyzw[phases]) * turned).as_quat() * rng.choice([-1.0, 1.0], (runs, 1))
    far = rng.choice([0.0, 1e-12, 2.0, 15.0, 500.0], (runs, 1))
    hands = Hands(path.tip_mm[phases] + far * unit(rng, runs), rotation, phases)
    ours, (theirs, off) = advance(path, hands, limits), by_scipy(path, hands, limits)
    assert (ours.phases == theirs.phases).all()
    assert np.abs(ours.tip_mm - theirs.tip_mm).max() < 1e-9
    assert (turns(ours).inv() * turns(theirs)).magnitude().max() < 1e-9
    for run in range(0, runs, 100):
        step = next_pose(path, hands.tip_mm[run], hands.rotation_xyzw[run], int(phases[run]), limits)
        assert np.abs(np.array(step.position_mm) - theirs.tip_mm[run]).max() < 1e-9
        assert (step.phase, step.elapsed_s) == (theirs.phases[run], path.elapsed_s[theirs.phases[run]])
        assert (step.off_mm, step.off_rad) == pytest.approx(tuple(off[run]), abs=1e-8)


def test_the_compiled_and_the_plain_ticks_agree_to_the_last_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    agreed = run_both(monkeypatch, pose_step, "step_along", "nearest_pose")
    certify_tube(a_path(), LIMITS)
    next_pose(a_path(), (10.0, 3.0, -118.0), (0.0, 0.0, 0.0, 1.0), None, LIMITS)
    assert set(agreed) == {"step_along", "nearest_pose"}


def test_a_motion_is_finished_once_its_last_pose_was_reached() -> None:
    path, phase, finished = a_path(), 90, []
    hand = path.tip_mm[90], path.rotation_xyzw[90]
    while not any(finished):
        step = next_pose(path, *hand, phase, LIMITS)
        finished.append(step.finished)
        hand, phase = (np.array(step.position_mm), np.array(step.rotation_xyzw)), step.phase
    assert len(finished) == 11 and phase == PHASES - 1


def test_a_hand_that_is_held_is_waited_for() -> None:
    path = a_path()
    held = path.tip_mm[20] + (0.0, 0.0, 12.0)
    phase: int | None = 20
    for _ in range(30):
        step = next_pose(path, held, path.rotation_xyzw[20], phase, LIMITS)
        phase = step.phase
    assert phase == 20 and np.linalg.norm(step.position_mm - held) == pytest.approx(LIMITS.step_mm)
    assert (step.off_mm, step.finished) == (pytest.approx(12.0), False)


def test_a_start_joins_at_the_nearest_pose_and_not_the_nearest_position() -> None:
    path = a_path()
    assert next_pose(path, path.tip_mm[30], path.rotation_xyzw[30], None, LIMITS).phase == 31
    turned = next_pose(path, path.tip_mm[30], path.rotation_xyzw[60], None, LIMITS).phase
    assert 30 < turned < 60


def test_what_is_not_a_pose_or_a_phase_is_refused() -> None:
    path = a_path()
    with pytest.raises(BadInput):
        next_pose(path, (0, 0, np.nan), (0, 0, 0, 1), None, LIMITS)
    with pytest.raises(BadInput):
        next_pose(path, (0, 0, 0), (0, 0, 0, 2), None, LIMITS)
    with pytest.raises(BadSettings):
        next_pose(path, (0, 0, 0), (0, 0, 0, 1), PHASES, LIMITS)
    with pytest.raises(BadSettings):
        TubeLimits(step_mm=1.0, disturbance_mm=1.0)
    with pytest.raises(BadSettings):
        TubeLimits(step_mm=float("nan"))


STRAIGHT = np.stack([np.linspace(0.0, 60.0, PHASES), np.zeros(PHASES), np.full(PHASES, -120.0)], axis=1)
BESIDE = Box((20.0, 10.0, -140.0), (40.0, 30.0, -100.0))  # 10 mm from the straight path


def in_scene(
    scene: Scene,
    tip_mm: np.ndarray = STRAIGHT,
    limits: TubeLimits = LIMITS,
    other: PartnerMotion | None = None,
) -> CertifiedPoses:
    """Return a motion without a turn, with its tube narrowed for a scene."""
    nothing, upright = np.zeros(PHASES), np.tile([0.0, 0.0, 0.0, 1.0], (PHASES, 1))
    path = PosePath(tip_mm, upright, np.linspace(0.0, 4.0, PHASES), nothing, nothing, nothing, partner=other)
    return clear_tube(CertifiedPoses("PSM2", "PSM2_base", path, certify_tube(path, limits)), scene)


@pytest.mark.parametrize(
    ("scene", "near"),
    [
        (Scene("PSM2_base", boxes=(BESIDE,)), TubeClearance(10.0, "box 0", 33)),
        (Scene("PSM2_base", boxes=(BESIDE,), margin_mm=1.5), TubeClearance(8.5, "box 0", 30)),
        (
            Scene("PSM2_base", capsules=(Capsule((30.0, 3.0, -110.0), (30.0, 3.0, -90.0), 2.0),)),
            TubeClearance(109**0.5 - 2, "capsule 0", 49),
        ),
        (
            Scene("PSM2_base", boxes=(BESIDE,), tissue=Tissue.plane((0.0, 0.0, -125.0), (0.0, 0.0, 2.0))),
            TubeClearance(5.0, "tissue", 0),
        ),
    ],
    ids=["box", "margin", "capsule", "tissue is nearer than the box"],
)
def test_a_tube_is_narrowed_to_the_distance_of_the_scene(scene: Scene, near: TubeClearance):
    poses = in_scene(scene)
    assert poses.scene is not None and poses.tube.holds
    assert (poses.scene.part, poses.scene.phase) == (near.part, near.phase)
    assert poses.scene.least_mm == pytest.approx(near.least_mm)
    assert poses.tube.radius_mm == pytest.approx(near.least_mm) and poses.tube.radius_mm <= poses.scene.least_mm
    assert poses.tube.limits == replace(LIMITS, start_mm=poses.tube.limits.start_mm)


def test_a_scene_far_from_the_tube_leaves_it_as_it_is():
    far = Scene("PSM2_base", tissue=Tissue((0.0, 0.0, -150.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), 5.0, ((0.0, 1.0),)))
    poses = in_scene(far)
    assert (poses.tube.radius_mm, poses.tube.limits) == (20.0, LIMITS)
    assert poses.scene is not None and 20.0 < poses.scene.least_mm <= 30.0
    nothing = in_scene(Scene("PSM2_base"))
    assert (nothing.tube.limits, nothing.scene) == (LIMITS, None)
    with pytest.raises(BadSettings, match="frame 'PSM1_base'"):
        in_scene(replace(far, frame="PSM1_base"))


def test_the_distance_of_the_other_arm_is_stated_and_decides_nothing():
    """By hand: the edge at (20, 10) is 400 / sqrt(3625) mm from its line, and the capsule's axis crosses it."""
    scene = Scene("PSM2_base", boxes=(Box((20.0, 10.0, -80.0), (40.0, 30.0, -60.0)),))
    along = np.linspace((60.0, 0.0, -70.0), (0.0, 5.0, -70.0), PHASES)
    other = PartnerMotion("PSM1", along, np.tile([0.0, 1.0, 0.0, 0.0], (PHASES, 1)))
    poses = in_scene(scene, other=other)
    assert poses.partner_scene == TubeClearance(pytest.approx(400 / 3625**0.5), "box 0", 67)
    assert (poses.tube, poses.scene) == (in_scene(scene).tube, in_scene(scene).scene)
    itself = replace(scene, capsules=(Capsule((30.0, 2.5, -90.0), (30.0, 2.5, -50.0), 4.0),))
    inside = in_scene(itself, other=other)
    assert inside.tube.holds and inside.partner_scene is not None
    assert (inside.partner_scene.least_mm, inside.partner_scene.part) == (pytest.approx(-4.0), "capsule 0")
    assert in_scene(scene).partner_scene is None


def test_a_path_too_near_to_a_scene_is_not_certified():
    poses = in_scene(Scene("PSM2_base", boxes=(BESIDE,), margin_mm=9.5))
    assert not poses.tube.holds
    (fault,) = poses.tube.faults
    assert fault.startswith("The path comes within 0.5 mm of box 0 of the scene after phase 17, and a run that starts")


def pushed(poses: CertifiedPoses, limits: TubeLimits, scene: Scene, towards_mm: np.ndarray) -> bool:
    """Return whether one of 300 runs that are pushed towards a point at each tick touches the scene."""
    rng = np.random.default_rng(5)
    path, phases = poses.path, rng.integers(0, PHASES, 300)
    way = towards_mm - path.tip_mm[phases]
    way = way / np.linalg.norm(way, axis=1, keepdims=True) + 0.3 * unit(rng, 300)
    tip = path.tip_mm[phases] + limits.start_mm * way / np.linalg.norm(way, axis=1, keepdims=True)
    hands, touched = Hands(tip, path.rotation_xyzw[phases], phases), bool(scene.touches(tip, tip).any())
    for _ in range(poses.tube.ticks):
        sent = advance(path, hands, limits)
        way = towards_mm - sent.tip_mm
        length = np.linalg.norm(way, axis=1, keepdims=True)
        reached = sent.tip_mm + limits.disturbance_mm * way / np.maximum(length, 1e-9)
        touched |= bool(scene.touches(hands.tip_mm, reached).any())
        hands = Hands(reached, sent.rotation_xyzw, sent.phases)
    return touched


@given(
    places=st.lists(st.tuples(*[st.floats(-40, 40)] * 3), min_size=1, max_size=3),
    size_mm=st.floats(0.5, 15),
    margin_mm=st.sampled_from([0.0, 1.0]),
)
def test_no_run_in_a_narrowed_tube_touches_the_scene(
    places: list[tuple[float, float, float]], size_mm: float, margin_mm: float
):
    middle = a_path().tip_mm.mean(axis=0)
    corners = [middle + place for place in places]
    boxes = tuple(Box(xyz(at), xyz(at + size_mm)) for at in corners)
    scene = Scene("PSM2_base", boxes=boxes, margin_mm=margin_mm)
    poses = in_scene(scene, a_path().tip_mm)
    assert poses.scene is not None
    assert poses.tube.holds == (poses.scene.least_mm >= LIMITS.disturbance_mm + 1e-9)
    if poses.tube.holds:
        assert not any(pushed(poses, poses.tube.limits, scene, at + size_mm / 2) for at in corners)


def test_in_the_tube_that_is_not_narrowed_a_pushed_run_touches():
    scene = Scene("PSM2_base", boxes=(BESIDE,))
    poses, middle = in_scene(scene), np.array([30.0, 20.0, -120.0])
    assert pushed(poses, LIMITS, scene, middle) and not pushed(poses, poses.tube.limits, scene, middle)


@pytest.mark.parametrize("ahead", [2, 3, 100])
def test_a_window_that_is_not_shorter_than_the_path_is_refused(ahead: int):
    path = a_path()
    short = replace(path, **{name: value[:2] for name, value in vars(path).items() if np.shape(value)[:1] == (PHASES,)})
    assert certify_tube(short, replace(LIMITS, start_mm=0.0)).move_mm > 0
    with pytest.raises(BadSettings, match="window"):
        certify_tube(short, replace(LIMITS, ahead=ahead))
