"""The executed motion: worked by hand, integrated a second time, in MuJoCo, and beside a published arm's encoders."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from skills import dynamics
from skills.dynamics import Servo, execute, levers_mm, loads, predict
from skills.errors import BadInput, BadSettings
from skills.kinematics import forward
from tests.formats.bags import sample_folder
from tests.learning.loops import run_both

MIDDLE = np.array([0.0, 0.0, 150.0, 0.0, 0.0, 0.0])
NONE = ((0.0,) * 6, (0.0,) * 6)
FREE = {"viscous": NONE, "coulomb": NONE, "play": NONE, "load": NONE}  # no friction, no load
FIT = {"inertia": (0.187, 0.203, 0.898), "viscous": (0.101, 0.204, 1.78), "coulomb": (0.056, 0.075, 0.411)}


def constant(name: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return a range without width: the fit, and for the wrist 0.001 of anything."""
    one = (*FIT[name], *[1e-3] * 3)
    return one, one


def moving(speed: float, joint: int, seconds: float = 2.0, rate_hz: float = 240.0) -> tuple[np.ndarray, np.ndarray]:
    """Return a joint that rests for a tenth of a second and then moves at a constant speed."""
    stamps = np.arange(round(seconds * rate_hz)) / rate_hz
    joints = np.tile(MIDDLE, (len(stamps), 1))
    joints[:, joint] += speed * np.maximum(stamps - 0.1, 0.0)
    return joints, stamps


def swaying(seed: int = 1, seconds: float = 3.0, rate_hz: float = 240.0) -> tuple[np.ndarray, np.ndarray]:
    """Return all joints in slow waves of their own, and at rest at the start."""
    rng, stamps = np.random.default_rng(seed), np.arange(round(seconds * rate_hz)) / rate_hz
    widths = np.array([0.3, 0.25, 25.0, 0.5, 0.4, 0.4])
    waves = np.sin(2 * np.pi * rng.uniform(0.2, 0.5, 6) * stamps[:, None]) ** 2
    return MIDDLE + [0.2, 0.1, 0, 0, 0, 0] + widths * waves, stamps


# ---- by hand --------------------------------------------------------------------------------------------------------


def test_the_droop_of_pitch_is_its_load_over_its_gain():
    held = np.tile(np.add(MIDDLE, [0.0, 0.3, 0.0, 0.0, 0.0, 0.0]), (240, 1))
    servo = Servo(coulomb=NONE, play=NONE)
    found = predict(held, np.arange(240) / 240.0, servo, ranged=False).executed
    # c0 + c2 + c3 sin 0.3 + c4 cos 0.3 + c6 0.15 sin 0.3 + c7 0.15, with sin 0.3 = 0.29552 and cos 0.3 = 0.95534
    load = -3.85 + 4.13 + 0.47 * 0.29552 - 0.59 * 0.95534 - 0.34 * 0.15 * 0.29552 - 0.02 * 0.15
    assert load == pytest.approx(-0.16282, abs=1e-4)
    assert found.joints[-1, 1] - 0.3 == pytest.approx(0.16282 / 120.0, rel=0.02)  # 0.00136 rad
    assert found.droop[-1, 1] == pytest.approx(0.16282 / 120.0, rel=0.02)
    assert np.abs(found.lag[-1]).max() < 1e-6
    compensated = predict(held, np.arange(240) / 240.0, replace(servo, gravity_compensated=True), ranged=False)
    assert compensated.off_mm.max() < 1e-9


def test_the_lag_of_yaw_is_its_speed_over_its_gain():
    joints, stamps = moving(0.2, 0)
    servo = Servo(
        velocities=False, rate_hz=1000.0, delay_s=0.0, step_s=1e-4, **{**FREE, "viscous": constant("viscous")}
    )
    found = predict(joints, stamps, servo, ranged=False).executed
    # (D + Fv) v / P, and a setpoint that is half a period of 1 ms old on average: (6 + 0.101) 0.2 / 120 + 0.2 0.0005
    assert joints[-1, 0] - found.joints[-1, 0] == pytest.approx(0.010168 + 0.0001, rel=0.02)
    assert found.lag[-1, 0] == pytest.approx(-0.010268, rel=0.02)
    sent = predict(joints, stamps, replace(servo, velocities=True), ranged=False).executed
    assert joints[-1, 0] - sent.joints[-1, 0] == pytest.approx(0.101 * 0.2 / 120.0 + 0.0001, rel=0.02)
    late = predict(joints, stamps, replace(servo, velocities=True, delay_s=0.05), ranged=False).executed
    assert joints[-1, 0] - late.joints[-1, 0] == pytest.approx(0.101 * 0.2 / 120.0 + 0.2 * 0.0505, rel=0.02)


def test_the_stick_of_insertion_is_its_dry_friction_over_its_gain():
    servo = Servo(rate_hz=1000.0, delay_s=0.0, **{**FREE, "coulomb": constant("coulomb")})
    for speed in (2.0, -2.0):
        joints, stamps = moving(speed, 2)
        found = predict(joints, stamps, servo, ranged=False).executed
        # Fc / P = 0.411 N / 6000 N/m = 0.0685 mm against the motion; the setpoint's age adds 2 mm/s 0.0005 s = 0.001 mm
        off_mm = np.sign(speed) * (joints[-1, 2] - found.joints[-1, 2])
        assert off_mm == pytest.approx(0.0685 + 0.001, rel=0.02)
        assert found.stick[-1, 2] == pytest.approx(-np.sign(speed) * 0.0685, rel=0.02)
        rested = np.concatenate([joints, np.tile(joints[-1], (480, 1))])
        later = predict(rested, np.arange(len(rested)) / 240.0, servo, ranged=False).executed
        assert np.ptp(later.joints[-240:, 2]) == 0.0  # it stays where it has stopped
        assert abs(later.joints[-1, 2] - rested[-1, 2]) <= 0.0686


def test_a_play_of_one_degree_shifts_the_link_by_it():
    joints, stamps = moving(0.2, 4)
    play = np.zeros(6)
    play[4] = np.radians(1.0)
    servo = Servo(rate_hz=1000.0, delay_s=0.0, **{**FREE, "play": (tuple(play), tuple(play))})
    found = predict(joints, stamps, servo, ranged=False)
    assert found.executed.stick[-1, 4] == pytest.approx(-np.radians(1.0), rel=1e-6)
    assert found.off_deg[0, -1] == pytest.approx(1.0, rel=0.02)
    assert found.off_mm[0, -1] == pytest.approx(9.1 * np.radians(1.0), rel=0.02)


def test_an_effort_at_its_limit_is_seen_and_is_no_droop():
    joints, stamps = moving(3.0, 0, seconds=0.5)
    found = predict(joints, stamps, Servo(stiffness=(1200.0, 120.0, 6000.0, 6.0, 6.0, 6.0)), ranged=False)
    assert found.effort.max() == found.effort[:, 0].max() == 1.0


# ---- laws -----------------------------------------------------------------------------------------------------------


def test_droop_lag_and_stick_are_the_whole_error_and_levers_its_size():
    joints, stamps = swaying()
    found = predict(joints, stamps, Servo(velocities=False)).executed
    assert np.allclose(found.droop + found.lag + found.stick, found.joints - joints, atol=1e-12)
    for joint in range(6):
        turned = joints.copy()
        turned[:, joint] += 1e-5
        moved = np.linalg.norm(forward(turned)[0] - forward(joints)[0], axis=1) / 1e-5
        assert np.allclose(moved, levers_mm(joints)[:, joint], atol=2e-3)


def test_the_range_has_its_middle_and_nine_tenths_of_the_arms_within_it():
    joints, stamps = swaying()
    servo, tip = Servo(), forward(joints)[0]
    found = predict(joints, stamps, servo)
    assert (found.off_mm[1] <= found.off_mm[0]).all() and (found.off_mm[0] <= found.off_mm[2]).all()
    rng, within = np.random.default_rng(5), []
    for _ in range(20):
        low, high = servo.arm(0.0, 0.0), servo.arm(1.0, 1.0)
        arm = low + rng.uniform(0.0, 1.0, (8, 6)) * (high - low)
        off = np.linalg.norm(forward(execute(joints, stamps, servo, arm, "400006").joints)[0] - tip, axis=1)
        within.append((off >= found.off_mm[1] - 0.01) & (off <= found.off_mm[2] + 0.01))
    assert np.mean(within) > 0.9


def test_the_loop_compiled_and_plain_agrees(monkeypatch):
    agreed = run_both(monkeypatch, dynamics, "_run")
    joints, stamps = swaying(seconds=0.5)
    predict(joints, stamps, Servo())
    assert agreed == ["_run"] * 5


def test_half_the_step_changes_the_error_by_less_than_a_hundredth():
    joints, stamps = swaying()
    for servo in (Servo(), Servo(velocities=False), Servo(gravity_compensated=True)):
        whole, half = (predict(joints, stamps, replace(servo, step_s=step), ranged=False) for step in (1e-3, 5e-4))
        change = np.sqrt(np.mean((whole.executed.joints - half.executed.joints) ** 2, axis=0))
        error = np.sqrt(np.mean((half.executed.joints - joints) ** 2, axis=0))
        assert (change < 0.01 * error).all(), change / error


def test_a_single_sample_is_the_resting_arm():
    found = predict(MIDDLE[None], [3.0], Servo())
    assert found.off_mm.shape == (3, 1) and found.executed.lag.max() < 1e-9


@pytest.mark.parametrize(
    ("joints", "stamps"),
    [(np.zeros((0, 6)), []), (np.tile(MIDDLE, (2, 1)), [0.0, 0.0]), (np.full((1, 6), np.nan), [0.0])],
)
def test_what_is_no_motion_is_refused(joints, stamps):
    with pytest.raises(BadInput):
        predict(joints, stamps, Servo())


@pytest.mark.parametrize(
    "wrong",
    [
        {"rate_hz": 0.0},
        {"rate_hz": float("nan")},
        {"delay_s": -0.001},
        {"step_s": float("inf")},
        {"stiffness": (0.0,) * 6},
        {"stiffness": (120.0, 120.0, 6000.0, 6.0, 6.0, 600.0)},
        {"load": ((1.0,) * 6, (0.9,) * 6)},
        {"play": ((0.0,) * 6, (float("nan"),) * 6)},
    ],
)
def test_a_servo_that_is_none_is_refused(wrong):
    with pytest.raises(BadSettings):
        Servo(**wrong)


# ---- the same equations a second time -------------------------------------------------------------------------------

C = np.array(
    [
        [-7.68, 0.79, 8.28, 0.22, -0.38, -10.92, -2.80, -1.25],
        [-3.85, -0.67, 4.13, 0.47, -0.59, -1.75, -0.34, -0.02],
        [-5.22, -1.54, 4.27, -0.13, 0.31, 0.16, -0.16, 3.45],
    ]
)


def held_load(q: np.ndarray) -> np.ndarray:
    """Return the fitted load of joints in rad and m."""
    s1, c1, s2, c2, q3 = np.sin(q[0]), np.cos(q[0]), np.sin(q[1]), np.cos(q[1]), q[2]
    terms = [1.0, s1, c1, s2 * c1, c2 * c1, q3 * s1, q3 * s2 * c1, q3]
    return np.append(C @ terms, [0.0, 0.0, 0.0])


def setpoints(joints: np.ndarray, stamps: np.ndarray, servo: Servo):
    """Yield each setpoint in force with the times between which it is: begin, end, joints in rad and m, speeds."""
    plan = joints * [1, 1, 1e-3, 1, 1, 1]
    speeds = np.gradient(plan, stamps, axis=0) * servo.velocities
    ticks = np.arange(0.0, stamps[-1], 1 / servo.rate_hz)
    edges = np.append(ticks + servo.delay_s, stamps[-1])
    edges[0] = 0.0
    for tick, begin, end in zip(ticks, edges[:-1], edges[1:], strict=True):
        if begin < stamps[-1]:
            at = [[np.interp(tick, stamps, column) for column in rows.T] for rows in (plan, speeds)]
            yield begin, min(end, stamps[-1]), *map(np.array, at)


@pytest.mark.parametrize("servo", [Servo(play=NONE), Servo(play=NONE, velocities=False, gravity_compensated=True)])
def test_an_independent_integration_has_the_same_motion(servo):
    joints, stamps = swaying(seconds=1.5)
    servo = replace(servo, step_s=2.5e-4, compensation=((0.7,) * 6, (0.7,) * 6))
    arm = servo.arm(0.5, 0.5)
    p, d, inertia, viscous, dry, _, load, compensated = arm
    ours = execute(joints, stamps, servo, arm, "400006")

    def moves(_, y, wanted, speed):
        q, v = y[:6], y[6:]
        acts = p * (wanted - q) + d * (speed - v) + (compensated - load) * held_load(q)
        # 1e-5 instead of a step: creeps by a part of it where the other stands
        return np.append(v, (acts - viscous * v - dry * np.tanh(v / 1e-5)) / inertia)

    y = np.append(ours.joints[0] * [1, 1, 1e-3, 1, 1, 1], np.zeros(6))
    theirs = np.tile(y[:6], (len(stamps), 1))
    for begin, end, wanted, speed in setpoints(joints, stamps, servo):
        inside = np.flatnonzero((stamps > begin + 1e-12) & (stamps <= end + 1e-12))
        found = solve_ivp(
            moves, (begin, end), y, "LSODA", np.clip(stamps[inside], begin, end), args=(wanted, speed), rtol=1e-6,
            atol=1e-9,
        )  # fmt: skip
        last = solve_ivp(moves, (begin, end), y, "LSODA", args=(wanted, speed), rtol=1e-6, atol=1e-9)
        if len(inside):
            theirs[inside] = found.y[:6].T
        y = last.y[:, -1]
    theirs /= [1, 1, 1e-3, 1, 1, 1]
    error = np.sqrt(np.mean((theirs - joints) ** 2, axis=0))
    apart = np.sqrt(np.mean((theirs - ours.joints) ** 2, axis=0))
    assert (apart < 0.01 * error).all(), apart / error
    tips = [forward(one)[0] for one in (joints, theirs, ours.joints)]
    assert np.linalg.norm(tips[1] - tips[2], axis=1).max() < 0.01 * np.linalg.norm(tips[1] - tips[0], axis=1).max()


def in_mujoco(joints: np.ndarray, stamps: np.ndarray, servo: Servo, begin: np.ndarray, rate_hz: float) -> np.ndarray:
    """Return the executed joints in rad and mm, the motors' without play, of six hinges with rotors in MuJoCo."""
    import mujoco

    p, d, inertia, viscous, dry, _, load, compensated = servo.arm(0.5, 0.5)
    bodies = "".join(
        f'<body><joint type="hinge" axis="0 0 1" armature="{inertia[j]}" '
        f'damping="{viscous[j]}" frictionloss="{dry[j]}" solimpfriction="0.9999 0.9999 0.001" '
        f'solreffriction="0.0005 1"/><inertial pos="0 0 0" mass="1e-9" diaginertia="1e-9 1e-9 1e-9"/></body>'
        for j in range(6)
    )
    text = f'<mujoco><option timestep="{1 / rate_hz}" gravity="0 0 0" integrator="implicitfast"/><worldbody>{bodies}'
    model = mujoco.MjModel.from_xml_string(text + "</worldbody></mujoco>")
    data = mujoco.MjData(model)
    data.qpos[:] = begin * [1, 1, 1e-3, 1, 1, 1]
    orders = list(setpoints(joints, stamps, servo))
    starts = np.array([one[0] for one in orders])
    found = np.tile(begin, (len(stamps), 1))
    for k in range(1, len(stamps)):
        for i in range(round((stamps[k] - stamps[k - 1]) * rate_hz)):
            now = stamps[k - 1] + i / rate_hz
            _, _, wanted, speed = orders[int(np.searchsorted(starts, now + 1e-9)) - 1]
            acts = p * (wanted - data.qpos) + d * (speed - data.qvel)
            data.qfrc_applied[:] = acts + (compensated - load) * held_load(data.qpos)
            mujoco.mj_step(model, data)
        found[k] = data.qpos / [1, 1, 1e-3, 1, 1, 1]
    return found


@pytest.mark.needs("mujoco")
@pytest.mark.parametrize("servo", [Servo(play=NONE), Servo(play=NONE, velocities=False, gravity_compensated=True)])
def test_mujoco_has_the_same_motion_within_a_hundredth(servo):
    joints, stamps = swaying(seconds=1.5)
    ours = execute(joints, stamps, servo, servo.arm(0.5, 0.5), "400006")
    theirs = in_mujoco(joints, stamps, servo, ours.joints[0], 9600.0)
    error = np.sqrt(np.mean((theirs - joints) ** 2, axis=0))
    apart = np.sqrt(np.mean((theirs - ours.joints) ** 2, axis=0))
    assert (apart < 0.01 * error).all(), apart / error


# ---- a published arm ------------------------------------------------------------------------------------------------


@pytest.mark.needs("recordings")
@pytest.mark.parametrize("left_out", [0, 1])
def test_on_a_published_arm_a_fitted_compensation_beats_a_constant(left_out):
    """Its loads are not those of the fit as it stands: without compensation the prediction is far worse than none."""
    with (sample_folder() / "calibration" / "raw_sensor_rosbag_09_traj3.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 507
    wanted, measured = (
        np.array([[float(row[f"{kind}_q{n}"]) for n in range(1, 7)] for row in rows]) * [1, 1, 1e3, 1, 1, 1]
        for kind in ("setpoint", "measured")
    )
    halves = np.array_split(np.arange(507), 2)
    known, test = halves[1 - left_out], halves[left_out]
    error, droop = measured - wanted, -loads(wanted) / np.array(Servo().stiffness) * [1, 1, 1e3, 1, 1, 1]
    left = (droop * error)[known].sum(axis=0)[:3] / (droop**2)[known].sum(axis=0)[:3]
    assert np.abs(left).max() < 0.15
    share = (*(1 - left), 1.0, 1.0, 1.0)
    fitted = Servo(play=NONE, load=((1.0,) * 6,) * 2, compensation=(share, share), gravity_compensated=True)

    def off_mm(joints: np.ndarray) -> float:
        return float(np.linalg.norm(forward(joints)[0] - forward(measured[test])[0], axis=1).mean())

    def resting(servo: Servo) -> np.ndarray:
        """Return where the arm rests at each setpoint, each on its own."""
        return np.concatenate([predict(one[None], [0.0], servo, ranged=False).executed.joints for one in wanted[test]])

    found = {
        "no error": off_mm(wanted[test]),
        "constant error": off_mm(wanted[test] + error[known].mean(axis=0)),
        "not compensated": off_mm(resting(replace(fitted, gravity_compensated=False))),
        "compensated": off_mm(resting(replace(fitted, compensation=((1.0,) * 6,) * 2))),
        "fitted compensation": off_mm(resting(fitted)),
    }
    print(found)
    assert found["fitted compensation"] < 0.9 * min(found["no error"], found["constant error"])
    assert found["compensated"] == pytest.approx(found["no error"], abs=0.001)
    assert found["not compensated"] > 4 * found["no error"]
