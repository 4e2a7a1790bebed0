"""The fit of a servo: simulated arms are recovered, and a published recording's halves are predicted."""

import csv
from dataclasses import dataclass, replace

import numpy as np
import pytest

from skills.dynamics import Servo, execute, loads, predict
from skills.errors import BadInput
from skills.kinematics import forward
from skills.library.plans.arm_errors import read_states
from skills.verification.servo_fit import FittedQuantity, fit_servo
from tests.formats.bags import sample_folder

UNITS = np.array([1.0, 1.0, 1e-3, 1.0, 1.0, 1.0])  # rad and m of rad and mm
COUNTS = np.array([7.7e-6, 7.7e-6, 1.3e-6, 2.1e-4, 1.4e-4, 1.4e-4])  # smallest steps in KinematicCalibDVRK
NOISE = np.array([0.05, 0.05, 0.2, 0.01, 0.01, 0.01])  # Nm and N: 0.5 to 5 % of the greatest efforts
ROWS = ("stiffness", "damping", "inertia", "viscous", "coulomb", "play", "load", "compensation")  # of an arm
OWN = {"rate_hz": 1000.0, "delay_s": 0.001}  # setpoints of the controller's own loop


@dataclass
class Simulated:
    """A simulated recording: times, measured states and setpoints, (T, 3, 6), and the arm, (8, 6)."""

    stamps_s: np.ndarray
    measured: np.ndarray
    setpoints: np.ndarray
    arm: np.ndarray


def simulated(seed: int, every: int, *, efforts: bool = True, commanded: bool = False, **servo) -> Simulated:
    """Return an arm drawn from the ranges, its gains up to a third off, which moves all joints in slow waves."""
    made = Servo(compensation=((0.7,) * 6, (1.1,) * 6), **servo)
    rng, stamps = np.random.default_rng(seed), np.arange(60_000) / 1000.0
    arm = made.arm(0.0, 0.0) + rng.uniform(0.0, 1.0, (8, 6)) * (made.arm(1.0, 1.0) - made.arm(0.0, 0.0))
    arm[:2] *= rng.uniform(0.7, 1.4, (2, 6))
    arm[5] = 0.0  # encoders sit before the play
    waves = [np.sin(2 * np.pi * rng.uniform(0.1, 0.6, 6) * stamps[:, None] + rng.uniform(0, 6, 6)) for _ in range(3)]
    plan = [0.1, 0.05, 150.0, 0.0, 0.0, 0.0] + np.array([0.4, 0.3, 40.0, 0.8, 0.5, 0.5]) / 3 * sum(waves)
    ran = execute(plan, stamps, made, arm, "400006")
    # The setpoint that is in force in the middle of the last step, in which the effort acts.
    sent = np.floor((stamps - made.step_s / 2 - made.delay_s) * made.rate_hz + 1e-6) / made.rate_hz
    speeds = np.gradient(plan * UNITS, stamps, axis=0) * made.velocities
    setpoints = np.full((len(stamps), 3, 6), np.nan)
    for row, values in enumerate((plan * UNITS, speeds)):
        setpoints[:, row] = np.stack([np.interp(np.maximum(sent, 0.0), stamps, one) for one in values.T], axis=1)
    measured = np.full_like(setpoints, np.nan)
    measured[:, 0] = np.round(ran.joints * UNITS / COUNTS) * COUNTS
    if efforts:
        measured[:, 2] = ran.efforts + rng.normal(0.0, 1.0, ran.efforts.shape) * NOISE
    if commanded:
        setpoints[:, 2] = ran.efforts
    return Simulated(stamps[::every], measured[::every], setpoints[::every], arm)


def fitted(made: Simulated) -> tuple[list[FittedQuantity], Servo, list[str]]:
    return fit_servo(made.stamps_s, made.measured, made.setpoints)


def truth(made: Simulated, one: FittedQuantity) -> float:
    """Return the number of the simulated arm; a compensation is a part of the load."""
    j = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw").index(one.joint)
    found = made.arm[ROWS.index(one.quantity), j]
    return float(found / made.arm[6, j] if one.quantity == "compensation" else found)


def held(servo, every: int, seeds: int) -> dict[str, float]:
    """Return the share of intervals that have their number, of each quantity and of all."""
    inside: dict[str, list[bool]] = {}
    for seed in range(seeds):
        made = simulated(seed, every, **servo)
        for one in fitted(made)[0]:
            found = one.low <= truth(made, one) <= one.high
            inside.setdefault(one.quantity, []).append(found)
            inside.setdefault("all", []).append(found)
    return {name: float(np.mean(values)) for name, values in inside.items()}


# ---- simulated arms -------------------------------------------------------------------------------------------------


def test_nine_tenths_of_the_intervals_have_the_simulated_arms_numbers():
    found = held(OWN, 5, 12)
    print(found)
    assert found["all"] >= 0.9
    assert min(found.values()) >= 0.8


@pytest.mark.parametrize(
    ("servo", "every", "least"),
    [({}, 6, 0.85), ({**OWN, "velocities": False, "gravity_compensated": True}, 5, 0.8)],
)
def test_streamed_setpoints_and_those_without_speeds_have_fewer(servo, every, least):
    found = held(servo, every, 8)
    print(found)
    assert found["all"] >= least


@pytest.mark.parametrize("compensated", [False, True])
def test_the_written_servo_is_nearer_to_the_arm_than_the_published(compensated):
    made = simulated(3, 5, gravity_compensated=compensated, **OWN)
    found, servo, notes = fitted(made)
    assert (servo.gravity_compensated, servo.velocities) == (compensated, True)
    written = [one for one in found if one.written]
    assert len(written) > 20
    off = [(abs(one.fitted - truth(made, one)), abs(one.published - truth(made, one))) for one in written]
    assert np.mean([ours < published for ours, published in off]) > 0.9
    for one in found:
        j = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw").index(one.joint)
        stated, default = (np.array(getattr(each, one.quantity))[..., j] for each in (servo, Servo()))
        if one.written:
            assert np.array_equal(stated, one.fitted if stated.ndim == 0 else np.maximum([one.low, one.high], 0.0))
        elif one.quantity != "compensation":
            assert np.array_equal(stated, default) and f"{one.joint} {one.quantity}" in notes[-1]
    assert "differences" in notes[0]


def test_setpoints_without_velocities_are_stated():
    made = simulated(1, 5, velocities=False, **OWN)
    found, servo, _ = fitted(made)
    made.setpoints[:, 1] = np.nan  # as the dVRK leaves them
    assert not servo.velocities and fitted(made)[:2] == (found, servo)


def test_commanded_efforts_show_the_gains_better_than_measured_ones():
    gains = [
        [one for one in fitted(simulated(2, 5, commanded=commanded, **OWN))[0] if one.quantity == "stiffness"]
        for commanded in (False, True)
    ]
    for measured, commanded in zip(*gains, strict=True):
        assert commanded.left_out < 0.5 * measured.left_out
        assert abs(commanded.fitted / truth(simulated(2, 5, **OWN), commanded) - 1) < 0.01


def test_what_is_published_is_not_written_again():
    """An arm as published is left as by default, but for the few numbers by chance."""
    made = simulated(2, 5, **OWN)
    made.measured[:, 2] = np.nan
    made.setpoints[:, 0] = made.measured[:, 0]  # no droop at all: compensated as published
    found, servo, _ = fitted(made)
    assert [one.published for one in found] == [1.0] * 3 and not any(one.written for one in found)
    assert servo == Servo(gravity_compensated=True)


def test_efforts_in_step_with_setpoints_are_seen_and_not_written():
    made = simulated(1, 5)  # both at 200 Hz, so that each effort is of the end of a setpoint's period
    found, servo, notes = fitted(made)
    assert not any(one.written for one in found if one.quantity in ("inertia", "viscous", "coulomb", "load"))
    assert servo.inertia == Servo().inertia and "record at another rate" in " ".join(notes)
    assert "record at another rate" not in " ".join(fitted(simulated(1, 6))[2])


@pytest.mark.parametrize("compensated", [False, True])
def test_without_efforts_the_compensated_part_alone_is_fitted(compensated):
    made = simulated(4, 5, efforts=False, gravity_compensated=compensated, stiffness=Servo().stiffness, **OWN)
    found, servo, notes = fitted(made)
    assert [(one.joint, one.quantity) for one in found] == [(j, "compensation") for j in ("yaw", "pitch", "insertion")]
    assert "no efforts" in notes[1] and "ros2 bag record" in notes[1]
    # What droops is (load - compensated) / P of this arm, as a part of the published load over the published P.
    droop = (made.arm[6] - made.arm[7]) * np.array(Servo().stiffness) / made.arm[0]
    for j, one in enumerate(found):
        assert one.low - 0.05 <= 1 - droop[j] <= one.high + 0.05
    assert servo.gravity_compensated == (max(1 - droop[:3]) > 0.5 or any(one.written for one in found))
    assert servo.stiffness == Servo().stiffness and servo.inertia == Servo().inertia


def test_a_load_by_hand_is_found_exactly():
    """Resting samples whose droop is a tenth of the published load over the published gain."""
    rng = np.random.default_rng(7)
    states = np.full((2, 200, 3, 6), np.nan)
    states[:, :, 0] = [0.0, 0.0, 0.15, 0.0, 0.0, 0.0] + rng.uniform(-0.3, 0.3, (200, 6)) * [1, 1, 0.1, 1, 1, 1]
    states[0, :, 1] = 0.0
    states[1, :, 0] += 0.1 * loads(states[0, :, 0] / UNITS) / np.array(Servo().stiffness)
    found, servo, _ = fit_servo(np.arange(200.0), states[0], states[1])
    assert [one.fitted for one in found] == pytest.approx([0.9] * 3, abs=1e-3)
    assert all(one.written and one.left_out < 1e-9 for one in found)
    assert servo.compensation[0][:3] == pytest.approx((0.9,) * 3, abs=1e-3)


def test_a_joint_that_rests_or_moves_once_is_listed_and_not_written():
    made = simulated(5, 5, **OWN)
    for states in (made.measured, made.setpoints):
        states[:, :2, 3] = 0.0
        states[:, 0, 4] = np.where(np.arange(len(states)) == 40, 0.1, 0.0)
    found, servo, notes = fitted(made)
    assert len(found) == 3 * 7 + 3 * 5
    rested = [one for one in found if one.joint == "roll"]
    assert len(rested) == 5 and not any(one.written for one in rested)
    assert "roll stiffness, roll damping" in notes[-1]
    assert servo.stiffness[3] == Servo().stiffness[3]


@pytest.mark.parametrize("wrong", ["few", "backward", "nan", "none"])
def test_states_that_cannot_be_fitted_are_refused(wrong):
    stamps, states = np.arange(100) / 10.0, np.full((100, 3, 6), 0.1)
    if wrong == "backward":
        stamps[50] = 0.0
    if wrong == "nan":
        states[3, 0, 2] = np.nan
    count = {"few": 20, "none": 0}.get(wrong, 100)
    with pytest.raises(BadInput, match="ros2 bag record"):
        fit_servo(stamps[:count], states[:count], states[:count])


# ---- a published arm ------------------------------------------------------------------------------------------------


@pytest.mark.needs("recordings")
def test_on_a_published_arm_left_out_halves_are_predicted_better():
    with (sample_folder() / "calibration" / "raw_sensor_rosbag_09_traj3.csv").open() as file:
        rows = list(csv.DictReader(file))
    states = np.full((2, 507, 3, 6), np.nan)
    for k, kind in enumerate(("measured", "setpoint")):
        states[k, :, 0] = [[float(row[f"{kind}_q{n}"]) for n in range(1, 7)] for row in rows]
    states[0, :, 1] = 0.0
    found, servo, _ = fit_servo(np.arange(507.0), states[0], states[1])
    yaw, pitch, insertion = found
    shown = [[1000 * x for x in (one.left_out, one.no_error, one.constant)] for one in found]  # mrad and mm
    assert shown[0] == pytest.approx([0.715, 1.259, 1.396], abs=0.001)
    assert shown[1] == pytest.approx([1.033, 1.149, 1.037], abs=0.001)
    assert shown[2] == pytest.approx([0.0976, 0.0966, 0.0987], abs=0.0001)
    assert (yaw.low, yaw.fitted, yaw.high) == pytest.approx((1.055, 1.096, 1.136), abs=0.001)
    assert (yaw.written, pitch.written, insertion.written) == (True, True, False)
    assert servo.gravity_compensated and servo.compensation[0][2] == 0.9 and servo.compensation[1][0] == yaw.high


@pytest.mark.needs("recordings")
def test_a_published_arms_gains_are_round_numbers():
    """Its commanded efforts leave no doubt: P 200, 200, 8000, 7, 7, D 9, 9, 300, and no load is compensated."""
    bag = sample_folder() / "calibration" / "pitch_exp_traj_02_test_cropped.bag"
    found, servo, _ = fit_servo(*read_states(bag))
    of = {(one.joint, one.quantity): one for one in found}
    for joint, p, d in (("yaw", 200.0, 9.0), ("pitch", 200.0, 9.0), ("insertion", 8000.0, 300.0)):
        assert of[joint, "stiffness"].fitted == pytest.approx(p, rel=0.002)
        assert of[joint, "damping"].fitted == pytest.approx(d, rel=0.002)
        assert of[joint, "compensation"].low < 0.0 < of[joint, "compensation"].high < 0.04
        assert of[joint, "stiffness"].left_out < 0.02 * of[joint, "stiffness"].constant
    for joint in ("wrist_pitch", "wrist_yaw"):
        assert of[joint, "stiffness"].low < 7.0 < of[joint, "stiffness"].high
    assert not servo.velocities and not servo.gravity_compensated
    assert not of["roll", "stiffness"].written and servo.stiffness[3] == Servo().stiffness[3]  # no gain explains it
    # The loads are others than published: much less of them is left, and the law of insertion is none of this arm.
    assert [of[joint, "load"].fitted for joint in ("yaw", "pitch")] == pytest.approx([-0.27, 0.13], abs=0.01)
    assert (servo.load[0][0], servo.load[1][0]) == (0.0, 0.0)
    assert of["insertion", "inertia"].high < 0 and servo.coulomb[0][2] == Servo().coulomb[0][2]


@pytest.mark.needs("recordings")
@pytest.mark.parametrize("left_out", [0, 1])
def test_a_servo_of_one_half_predicts_a_published_arms_other_half(left_out):
    """Mean error of the tip that the arm executes of its setpoints, in mm: of motion at up to 1 rad/s."""
    states = read_states(sample_folder() / "calibration" / "pitch_exp_traj_02_test_cropped.bag")
    halves = np.array_split(np.arange(len(states[0])), 2)
    known, test = ([one[halves[k]] for one in states] for k in (1 - left_out, left_out))
    wanted, real = test[2][:, 0] / UNITS, test[1][:, 0] / UNITS
    off = (known[1][:, 0] - known[2][:, 0]).mean(axis=0) / UNITS
    still = Servo(velocities=False)

    def off_mm(joints: np.ndarray) -> float:
        return float(np.linalg.norm(forward(joints)[0] - forward(real)[0], axis=1).mean())

    found = {"no error": off_mm(wanted), "constant error": off_mm(wanted + off)}
    for name, servo in (
        ("published", Servo()),
        ("published, without velocities", still),
        ("and compensated", replace(still, gravity_compensated=True)),
        ("fitted", fit_servo(*known)[1]),
    ):
        servo = replace(servo, play=((0.0,) * 6,) * 2)  # encoders sit before it
        found[name] = off_mm(predict(wanted, test[0], servo, ranged=False).executed.joints)
    print(found)
    expected = ([3.44, 3.47, 2.93, 1.11, 0.82, 0.59], [3.55, 3.55, 3.32, 1.70, 0.77, 0.64])[left_out]
    assert list(found.values()) == pytest.approx(expected, abs=0.01)
