"""The torque pass: beside the compiled motion where nothing is touched, and by hand where something is."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from skills.dynamics import Servo, execute
from skills.kinematics import forward, instrument_of, quaternion_of
from skills.planning.trajectory import A1, Trajectory
from skills.sandbox.forked import call_alone
from skills.simulation import player, simulator
from skills.simulation.player import play
from skills.simulation.simulator import torque_pass
from skills.verification.clearance import FINGER_RADIUS_MM, links_of
from skills.verification.gates import Limits
from skills.verification.verdict import judge
from tests.bench.playing import stacked
from tests.planning.motions import small_trajectory
from tests.test_dynamics import in_mujoco
from tests.verification.hands import sound_plans

pytestmark = pytest.mark.needs("simulator")
SERVO, NONE = Servo(), ((0.0,) * 6,) * 2
# Ours: a thousandth of the error of an arm that is not calibrated. PyBullet has a term beyond the law, of speeds times
# speeds, in size up to half a hundredth of what the wrist's motors can give.
AGREED_MM, AGREED_EFFORT = 0.003, 0.01


class Stepped(NamedTuple):
    joints: np.ndarray
    efforts: np.ndarray
    contact_n: np.ndarray


def executed_of(motion: Trajectory, servo: Servo) -> np.ndarray:
    return execute(motion.joints, motion.stamps_s, servo, servo.arm(0.5, 0.5), motion.instrument)


def stepped(motion: Trajectory, servo: Servo, pad_top_mm: float = -400.0) -> Stepped:
    """Step through a whole motion, PSM_A alone with a pad."""
    whole, alone = np.array([[0, len(motion) - 1]]), replace(motion, psm_m=None)
    with simulator.opened(motion.instrument) as scene:
        scene.set_up(alone, pad_top_mm)
        return Stepped(*torque_pass(scene, alone, servo, executed_of(motion, servo), whole))


def apart_mm(motion: Trajectory, servo: Servo) -> tuple[float, float]:
    """Return how far PyBullet's tip is from the compiled one at most, and the compiled one from the plan."""
    found, executed = stepped(motion, servo), executed_of(motion, servo)
    limit = np.array(instrument_of(motion.instrument).arm.effort)
    assert (np.abs(found.efforts - executed.efforts) < AGREED_EFFORT * limit).all()
    assert found.contact_n.max() == 0.0
    tip_mm = forward(executed.joints, motion.instrument)[0]
    return greatest_mm(found.joints, tip_mm, motion), float(np.linalg.norm(tip_mm - motion.tip_mm, axis=1).max())


def greatest_mm(joints: np.ndarray, tip_mm: np.ndarray, motion: Trajectory) -> float:
    return float(np.linalg.norm(forward(joints, motion.instrument)[0] - tip_mm, axis=1).max())


@pytest.mark.parametrize("servo", [SERVO, Servo(velocities=False, gravity_compensated=True)])
def test_a_whole_plan_agrees_with_the_compiled_motion(servo):
    off_mm, error_mm = apart_mm(small_trajectory(passes=1), servo)
    assert off_mm < AGREED_MM < 0.02 * error_mm


@pytest.mark.nightly  # by day one plan
def test_ten_whole_plans_of_hands_agree_with_the_compiled_motion():
    for planned in sound_plans(7, 10):
        off_mm, error_mm = apart_mm(planned.trajectory, SERVO)
        assert off_mm < AGREED_MM < 0.02 * error_mm


@pytest.mark.needs("mujoco")
@pytest.mark.nightly  # by day test_dynamics compares the compiled motion with MuJoCo
def test_ten_whole_plans_of_hands_agree_with_mujoco():
    servo = replace(SERVO, play=NONE)
    for planned in sound_plans(7, 10):
        motion, begin = planned.trajectory, executed_of(planned.trajectory, servo).joints[0]
        theirs = in_mujoco(motion.joints, motion.stamps_s - motion.stamps_s[0], servo, begin, 4800.0)
        tip_mm = forward(theirs, motion.instrument)[0]
        assert greatest_mm(stepped(motion, servo).joints, tip_mm, motion) < AGREED_MM


# ---- in contact ----------------------------------------------------------------------------------------------------

DOWN = np.array([0.0, 0.0, 120.0, 0.0, 0.0, 0.0])
DEPTH_MM = 8.0


def lowering(rate_hz: float = 240.0, seconds: float = 4.0) -> Trajectory:
    """Return an arm that goes straight down by 8 mm in 1.5 s from 0.5 s on, rests, and goes up again."""
    stamps = np.arange(round(seconds * rate_hz)) / rate_hz
    way = np.clip((stamps - 0.5) / 1.0, 0, 1) - np.clip((stamps - 2.5) / 1.0, 0, 1)
    joints = np.tile(DOWN, (len(stamps), 1))
    joints[:, 2] += DEPTH_MM * (10 - 15 * way + 6 * way**2) * way**3
    tip_mm, rotation = forward(joints)
    zeros = np.zeros(len(stamps), int)
    return Trajectory(
        rate_hz, "400006", stamps, tip_mm, quaternion_of(rotation), joints, zeros, zeros + A1, 20.0, 1.0, 0.5, 0.5, 0.0
    )


@pytest.mark.parametrize("push_mm", [0.5, 1.0])
def test_a_pad_in_the_path_pushes_the_arm_off_by_hand(push_mm):
    """Nothing but stiffness is left: 6000 N/m against a rigid pad, and the damping of what does not move is none."""
    motion, servo = lowering(), Servo(load=NONE, coulomb=NONE, play=NONE)
    lowest_mm = (links_of(motion.joints).end_mm[:, 2:, 2] - FINGER_RADIUS_MM).min()
    found, executed = stepped(motion, servo, pad_top_mm=lowest_mm + push_mm), executed_of(motion, servo)
    pressed = np.flatnonzero(motion.joints[:, 2] >= DOWN[2] + DEPTH_MM - 1e-9)[-60:]
    off_mm = motion.joints[pressed, 2] - found.joints[pressed, 2]
    np.testing.assert_allclose(off_mm, push_mm, atol=0.015)  # PyBullet lets surfaces overlap by 0.01 mm
    np.testing.assert_allclose(found.contact_n[pressed], 6.0 * off_mm, rtol=1e-4)
    np.testing.assert_allclose(found.efforts[pressed, 2], 6.0 * off_mm, rtol=1e-4)
    assert np.abs(executed.joints - motion.joints)[pressed].max() < 1e-3  # the compiled motion knows nothing of it
    np.testing.assert_allclose(found.joints[-20:], executed.joints[-20:], atol=1e-6)  # free again


def test_a_contact_is_within_a_window_and_its_force_is_named():
    motion = lowering()
    lowest_mm = (links_of(motion.joints).end_mm[:, 2:, 2] - FINGER_RADIUS_MM).min()
    found = play(motion, servo=SERVO, pad_top_mm=lowest_mm + 1.0)
    touched = np.flatnonzero(found.contact_n > 0)
    assert found.contact_n.max() > 3.0
    assert any(first <= touched[0] and touched[-1] <= last for first, last in found.windows)
    whole = stepped(motion, SERVO, pad_top_mm=lowest_mm + 1.0)
    assert (np.flatnonzero(whole.contact_n > 0) == touched).all()  # windows miss nothing
    np.testing.assert_allclose(found.contact_n, whole.contact_n, atol=0.01)
    report = judge(found, motion, Limits(clearance_pad_mm=-10.0))
    assert report.failure.quantity == "force of contact"
    assert report.peak_contact_n == found.contact_n.max() and report.executed_off_mm == found.tracking_mm.max()
    free = play(motion, servo=SERVO, pad_top_mm=lowest_mm - 20.0)
    assert free.contact_n.max() == 0.0 and judge(free, motion).feasible
    assert abs(found.tracking_mm - free.tracking_mm)[touched].max() > 0.3
    outside = np.ones(len(motion), bool)
    for first, last in (*found.windows, *free.windows):
        outside[first : last + 1] = False
    assert outside.any() and (found.tracking_mm == free.tracking_mm)[outside].all()


def test_a_window_of_a_hand_over_has_both_arms_in_it():
    both = stacked(passes=2, rate_hz=100.0)
    found = play(both, servo=SERVO)
    for end in both.last_samples:
        assert any(first < end <= last for first, last in found.windows)
    assert found.contact_n.max() == 0.0
    off_mm = np.linalg.norm(forward(executed_of(both, SERVO).joints)[0] - both.tip_mm, axis=1)
    np.testing.assert_allclose(found.tracking_mm, off_mm, atol=AGREED_MM)
    for number in range(both.passes):
        worst = np.where(both.pass_index == number, off_mm, 0.0).argmax()
        assert any(first <= worst <= last for first, last in found.windows)
    joints = np.add(both.psm_m.joints, [0.0, -0.05, 6.0, 0.0, 0.0, 0.0])  # a finger 4.5 mm in the wrist of PSM_A
    touching = play(replace(both, psm_m=replace(both.psm_m, joints=joints)), servo=SERVO)
    assert touching.contact_n[both.last_samples] == pytest.approx([28.7, 28.7], abs=0.1)  # the same in either pass
    off_mm = (touching.tracking_mm - found.tracking_mm)[both.last_samples]
    assert (off_mm > 2.0).all() and np.ptp(off_mm) < 0.1


def test_without_a_servo_nothing_is_executed():
    motion = small_trajectory(passes=1, rate_hz=60.0)
    found = play(motion)
    assert (found.tracking_mm, found.efforts, found.contact_n, found.windows) == (None,) * 4
    report = judge(found, motion)
    assert report.feasible and (report.executed_off_mm, report.peak_contact_n) == (None, None)


def test_a_process_of_its_own_has_the_loops_and_the_same_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests' simulators are forks of one server; a command starts a new interpreter."""
    motion, servo = small_trajectory(), Servo()
    shared = player.play(motion, servo=servo)
    monkeypatch.setattr(player, "call_alone", call_alone)
    alone = player.play(motion, servo=servo)
    for name in ("tracking_mm", "efforts", "contact_n", "joints"):
        assert np.array_equal(getattr(alone, name), getattr(shared, name)), name
    assert shared.tracking_mm is not None and shared.tracking_mm.max() > 0.1
