"""Speed of checking plans, compared with PyBullet's own calls alone, and of two checks at once and in turn."""

import hashlib
import time
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from rich.table import Table

from skills.arrays import xyz
from skills.dynamics import Servo, predict
from skills.gridworld.scene import Scene, Tissue
from skills.library.plans.plans import trajectory_of
from skills.planning.handoff import PsmM
from skills.planning.plan import SuturePoint, stack
from skills.planning.trajectory import Trajectory, joint_ratios, time_parametrise
from skills.simulation import player, simulator
from skills.verification.bodies import bodies_clearance
from skills.verification.execution import PlannedMotion, execution_of
from skills.verification.intent import compare
from skills.verification.playback import CLEARANCE_SEEN_MM
from skills.verification.requested import requested_motion
from skills.verification.scene_clearance import clearance_of
from skills.verification.verdict import judge
from tests.bench.timing import gain, in_turn
from tests.planning.motions import PSM_M, hand_off
from tests.planning.test_hand import turning

PASSES, RATE_HZ = 20, 240.0
ROUNDS = 3
TURNED = np.radians(45.0)
BESIDE = PsmM(PSM_M, (160.0, 20.0, 20.0), (0.0, 0.0, float(np.sin(TURNED / 2)), float(np.cos(TURNED / 2))))


def stacked(passes: int = PASSES, rate_hz: float = RATE_HZ) -> Trajectory:
    """Stack passes two millimetres apart, with PSM_M."""
    return time_parametrise([hand_off(-2.0 * k) for k in range(passes)], rate_hz=rate_hz, psm_m=BESIDE)


def playing(table: Table) -> None:
    """Check twenty passes at 240 Hz with both arms: distances at every fourth sample."""
    trajectory = stacked()
    asked = player.request(trajectory, player.default_pad_top(trajectory))
    ours, bare, quick = in_turn(
        lambda: measure(asked), lambda: plain(asked), lambda: plain(asked, at_once=True), rounds=ROUNDS
    )
    samples = f"{len(trajectory)} samples, {len(asked.looks)} looks; no process start"
    table.add_row(f"{PASSES} passes checked, {RATE_HZ:.0f} Hz", f"{ours:.2f} s", samples)
    table.add_row("  PyBullet's calls alone", f"{bare:.2f} s", f"ours takes {ours / bare:.2f} of it")
    table.add_row("  with six joints in one call, too", f"{quick:.2f} s", f"ours takes {ours / quick:.2f} of it")
    began = time.perf_counter()
    playback = player.play(trajectory)
    played = time.perf_counter() - began
    table.add_row("  with process, picture and transport", f"{played:.2f} s", "by the clock")
    began = time.perf_counter()
    assert judge(playback, trajectory).feasible
    table.add_row("  the verdict", f"{time.perf_counter() - began:.2f} s", "")
    two_at_once(stacked(passes=PASSES // 4), table)


def verdicts(table: Table) -> None:
    """Judge twenty passes of a hand with both arms, their bodies, a scene, the needle and what was asked.

    All is processor time: what needs no simulator, and the whole verdict beside the bare calls of the simulation.
    """
    demo, policy = turning()
    points = [SuturePoint(xyz(demo.tip_mm[-1] - [0.0, 2.0 * k, 0.0])) for k in range(PASSES)]
    plan = stack(policy, points, demo=demo, psm_m=BESIDE)
    trajectory = trajectory_of(plan)
    scene_mm = Scene(plan.frame, tissue=Tissue.plane((0.0, 0.0, -165.0), (0.0, 0.0, 1.0)))
    given = requested_motion(plan, policy, demo)
    asked = player.request(trajectory, player.default_pad_top(trajectory))
    playback = player.play(trajectory)

    def closed_form() -> None:
        joint_ratios(trajectory.joints, trajectory.pass_index, trajectory.rate_hz)
        bodies_clearance(trajectory, 2.0)
        clearance_of(trajectory, scene_mm)
        compare(given, trajectory)

    def judged() -> None:
        measure(asked)
        beside, intent = clearance_of(trajectory, scene_mm), compare(given, trajectory, playback.joints)
        judge(playback, trajectory, beside=beside, pad_is_tissue=False, intent=intent)

    def executed(ranged: bool) -> None:
        predict(trajectory.joints, trajectory.stamps_s, Servo(), trajectory.instrument, ranged=ranged)

    outer, beside = bodies_clearance(trajectory, 2.0).report.at_least_mm, clearance_of(trajectory, scene_mm)
    known = PlannedMotion(given, scene_mm, None, compare(given, trajectory), beside, outer)
    servo = Servo(gravity_compensated=True)
    alone, one, five, answer, whole, bare = in_turn(
        closed_form,
        lambda: executed(False),
        lambda: executed(True),
        lambda: execution_of(trajectory, servo, known),
        judged,
        lambda: plain(asked),
        rounds=ROUNDS,
    )
    table.add_row(f"verdict without a simulator, {PASSES} passes", f"{alone:.2f} s", f"{len(trajectory)} samples")
    table.add_row("  the executed motion", f"{one:.2f} s", f"with it {1 + one / alone:.2f} of the verdict without")
    table.add_row("  the executed motion with its range", f"{five:.2f} s", f"with it {1 + five / alone:.2f} of that")
    table.add_row("  with causes, remedies and gates", f"{answer:.2f} s", f"with it {1 + answer / alone:.2f} of that")
    table.add_row("  with a simulator, but for process and picture", f"{whole:.2f} s", "")
    table.add_row("  PyBullet's calls alone", f"{bare:.2f} s", f"the verdict takes {whole / bare:.2f} of it")


def two_at_once(trajectory: Trajectory, table: Table) -> None:
    """Check the same plan twice, in turn and concurrently, completely: with process and picture.

    For comparison, hashing shows the possible gain of two threads: other processes may use the cores.
    """
    data = bytes(256 << 20)
    checking = gain(lambda: player.play(trajectory), 2, ROUNDS)
    hashing = gain(lambda: hashlib.sha256(data), 2, ROUNDS)
    table.add_row(f"two checks of {trajectory.passes} passes at once", "", f"{checking:.2f} x one after the other")
    table.add_row("  two hashes at once", "", f"{hashing:.2f} x one after the other")


def measure(asked: simulator.PlayRequest) -> None:
    """Do the work of a check in the simulator, except for the picture."""
    motion = asked.trajectory
    with simulator.opened(motion.instrument) as one:
        one.set_up(motion, asked.pad_top_mm)
        simulator.kinematic_pass(one, asked)


def plain(asked: simulator.PlayRequest, at_once: bool = False) -> None:
    """Make the same PyBullet calls and nothing else, and discard their results.

    `at_once` sets six joints in one call (`resetJointStatesMultiDof`), as `measure` does; the plain way is six calls.
    """
    motion = asked.trajectory
    assert motion.psm_m is not None
    arm_rows, m_rows = (simulator.in_metres(joints).tolist() for joints in (motion.joints, motion.psm_m.joints))
    with simulator.opened(motion.instrument) as one:
        one.set_up(motion, asked.pad_top_mm)
        _plain_kinematic(one, arm_rows, m_rows, set(asked.looks.tolist()), at_once)


def _plain_kinematic(
    one: simulator.Simulator, arm_rows: list[list[float]], m_rows: list[list[float]], due: set[int], at_once: bool
) -> None:
    bullet, arm, m, pad = one.bullet, one.arm, one.psm_m, one.pad
    assert m is not None
    seen_m = CLEARANCE_SEEN_MM * simulator.MM
    reset, together = bullet.resetJointState, bullet.resetJointStatesMultiDof

    def put(body: simulator.SceneBody, row: list[float]) -> None:
        if at_once:
            together(body.number, body.joints, [[value] for value in row])
        else:
            for joint, value in zip(body.joints, row, strict=True):
                reset(body.number, joint, value)

    for k, row in enumerate(arm_rows):
        put(arm, row)
        bullet.getJointStates(arm.number, arm.joints)
        bullet.getLinkState(arm.number, arm.tool, 0, 1)
        if k in due:
            put(m, m_rows[k])
            bullet.getLinkState(m.number, m.tool, 0, 1)
            bullet.getClosestPoints(arm.number, pad, seen_m)
            bullet.getClosestPoints(arm.number, m.number, seen_m)
            bullet.getClosestPoints(m.number, pad, seen_m)
            bullet.getLinkState(arm.number, arm.shaft, 0, 1)


def windows(table: Table) -> None:
    """Step through the windows of five passes by torques, and make the same calls alone; both in processor time."""
    motion, servo = stacked(passes=5), Servo()
    played, predicted = player.play(motion), predict(motion.joints, motion.stamps_s, servo, motion.instrument)
    stretches = simulator.windows_of(motion, predicted, played.looked_at, played.clearances_mm)
    seconds = float(np.diff(motion.stamps_s[stretches], axis=1).sum())
    for with_m, named in ((False, "PSM_A and the pad"), (True, "with PSM_M")):
        shown = motion if with_m else replace(motion, psm_m=None)
        with simulator.opened(shown.instrument) as one:
            one.set_up(shown, float(played.pad_mm[2]))
            step_through = partial(simulator.torque_pass, one, shown, servo, predicted.executed, stretches)
            step_through()  # compiled
            calls: list[partial[Any]] = []
            bullet = one.bullet
            one.bullet = _Recorded(bullet, calls)
            step_through()
            one.bullet = bullet
            ours, bare = in_turn(step_through, partial(_again, calls), rounds=ROUNDS)
        said = f"{ours / seconds:.3f} s of processor per second of motion, goal 0.15"
        table.add_row(f"{len(stretches)} windows by torques, {named}", f"{ours:.2f} s", said)
        table.add_row(
            "  the same calls of PyBullet alone", f"{bare:.2f} s", f"ours takes {ours / bare:.2f} of it, goal 1.3"
        )


class _Recorded:
    """PyBullet, with a list of all calls."""

    def __init__(self, bullet: Any, calls: list[partial[Any]]) -> None:
        self._bullet, self._calls = bullet, calls

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._bullet, name)
        return partial(self._call, found) if callable(found) else found

    def _call(self, function: Any, *given: Any, **named: Any) -> Any:
        self._calls.append(partial(function, *given, **named))
        return function(*given, **named)


def _again(calls: list[partial[Any]]) -> None:
    for call in calls:
        call()
