"""Faults planted in the poses of a sound motion, for the comparison of a motion with what was asked.

The joints of the changed poses are solved again, so that nothing but the intent is wrong with them: the arms do exactly
what the trajectory says.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from skills.kinematics import forward, inverse, matrix_of, quaternion_of
from skills.planning.handoff import JAW_S, OtherArm, PsmM
from skills.planning.plan import SuturePlan, SuturePoint, stack
from skills.planning.trajectory import A2, TRANSFER, PassPath, Trajectory, time_parametrise
from skills.verification.deviations import LIMITS, Deviations
from skills.verification.intent import compare
from skills.verification.requested import RequestedMotion, requested_motion
from tests.planning.motions import PSM_M
from tests.planning.test_hand import turning
from tests.verification.hands import BASE_MM, BASE_XYZW, about

RATE_HZ = 100.0
BASE = matrix_of(np.array([BASE_XYZW]))[0]
X, Y, Z = np.eye(3)


@dataclass
class Motion:
    """A motion as poses of both arms in PSM_A's base, to be changed in place."""

    of: Trajectory
    tip: np.ndarray
    turned: np.ndarray
    m_tip: np.ndarray
    m_turned: np.ndarray
    passes: np.ndarray
    phase: np.ndarray
    jaw: np.ndarray
    m_jaw: np.ndarray
    still: np.ndarray  # where only the jaws move

    def rows(self, phase: int, number: int = 1) -> np.ndarray:
        """Return the samples of a phase of a pass in which arms move."""
        return np.flatnonzero((self.passes == number) & (self.phase == phase) & ~self.still)

    def repeat(self, rows: np.ndarray) -> None:
        """Play only these samples, in this order."""
        for name in ("tip", "turned", "m_tip", "m_turned", "passes", "phase", "jaw", "m_jaw", "still"):
            setattr(self, name, getattr(self, name)[rows])

    def built(self, **more: object) -> Trajectory:
        """Solve the joints of both arms."""
        assert self.of.psm_m is not None
        count = len(self.tip)
        # both arms stand where A2 has brought them, and before A1 where it begins
        at, number = np.arange(count), np.flatnonzero(~self.still)
        after = number[np.searchsorted(number, at).clip(max=len(number) - 1)]
        before = number[(np.searchsorted(number, at, side="right") - 1).clip(0)]
        stands = np.where(self.still, np.where(self.phase == A2, before, after), at)
        for poses_of in (self.tip, self.turned, self.m_tip, self.m_turned):
            poses_of[:] = poses_of[stands]
        other = inverse((self.m_tip - BASE_MM) @ BASE, BASE.T @ self.m_turned)
        whole = {
            "stamps_s": (np.arange(count) + self.passes * (RATE_HZ - 1)) / RATE_HZ,
            "tip_mm": self.tip,
            "rotation_xyzw": quaternion_of(self.turned),
            "joints": inverse(self.tip, self.turned),
            "pass_index": self.passes,
            "phase": self.phase,
            "jaw_rad": self.jaw,
            "psm_m": OtherArm(np.array(BASE_MM), np.array(BASE_XYZW), "400006", other, self.m_jaw),
        }
        return replace(self.of, **(whole | more))


Fault = Callable[[Motion], int]  # it changes a motion, and returns the first sample that is wrong
Faults = Mapping[str, tuple[Fault, str, int]]  # by name: the fault, its kind, and how many samples later it is named


@cache
def sound(a2: str = "paper", orientation: str | None = None) -> tuple[RequestedMotion, Trajectory]:
    """Return a sound plan with both arms, and its motion."""
    plan = planned(a2, orientation)
    demo, policy = turning()
    return requested_motion(plan, policy, demo), timed(plan.passes, plan.psm_m)


@cache
def planned(a2: str = "paper", orientation: str | None = None) -> SuturePlan:
    """Return a plan of three passes: at the demonstrated place, turned beside it, and from a start of its own."""
    demo, policy = turning()
    taken = (tuple((demo.tip_mm[-1] + [14.0, 2.0, -4.0]).tolist()), seen_m()) if a2 == "recorded" else (None, None)
    psm_m = PsmM(PSM_M, BASE_MM, BASE_XYZW, taken_mm=taken[0], taken_xyzw=taken[1])
    places = [(0.0, 0.0, 0.0), (2.0, -3.0, 1.0), (-2.0, 2.0, 0.0)]
    points = [SuturePoint(tuple((demo.tip_mm[-1] + place).tolist())) for place in places]
    points[1] = replace(points[1], rotation_xyzw=tuple(quaternion_of(about(Z, 0.1)[None])[0].tolist()))
    starts = [None, None, demo.tip_mm[100] + [1.0, 0.0, 1.0]]
    return stack(
        policy,
        points,
        demo=demo,
        psm_m=psm_m,
        starts_mm=starts,
        rate_hz=RATE_HZ,
        speed_mm_s=20.0,
        orientation=orientation,
        a2=a2,
    )


def timed(passes: Sequence[PassPath], psm_m: PsmM) -> Trajectory:
    return time_parametrise(passes, speed_mm_s=20.0, rate_hz=RATE_HZ, psm_m=psm_m)


def seen_m() -> tuple[float, ...]:
    """Return the recorded rotation of PSM_M: it comes along `PSM_M`."""
    a = np.array(PSM_M) / np.linalg.norm(PSM_M)
    n = np.cross(a, Z) / np.linalg.norm(np.cross(a, Z))
    return tuple(quaternion_of(np.stack([n, np.cross(a, n), a], axis=1)[None])[0].tolist())


def poses(trajectory: Trajectory) -> Motion:
    assert trajectory.psm_m is not None
    m_tip, m_turned = forward(trajectory.psm_m.joints)
    return Motion(
        trajectory,
        trajectory.tip_mm.copy(),
        matrix_of(trajectory.rotation_xyzw),
        m_tip @ BASE.T + BASE_MM,
        BASE @ m_turned,
        trajectory.pass_index.copy(),
        trajectory.phase.copy(),
        np.array(trajectory.jaw_rad),
        np.array(trajectory.psm_m.jaw_rad),
        stands(trajectory),
    )


def stands(trajectory: Trajectory) -> np.ndarray:
    """Return the samples at the ends of A2 and of further transfers in which only the jaws move."""
    ticks = 2 * int(np.ceil(JAW_S * RATE_HZ))
    still = np.zeros(len(trajectory), bool)
    for number in range(trajectory.passes):
        for phase in (A2,) if number == 0 else (TRANSFER, A2):
            still[np.flatnonzero((trajectory.pass_index == number) & (trajectory.phase == phase))[-ticks:]] = True
    return still


def broken(comparison: Deviations) -> tuple[str, int] | None:
    """Return the kind and the sample of the earliest deviation beyond its limit."""
    found = []
    for kind, values in comparison.values.items():
        wrong = np.flatnonzero(~(values <= LIMITS[kind][1]))
        if len(wrong):
            found.append((int(wrong[0]), kind))
    return min(found, key=lambda one: one[0])[::-1] if found else None


def check_named(plant: Fault, kind: str, later: int) -> None:
    """Plant a fault in the sound motion, and check that its kind is named at most so many samples later."""
    asked, motion = sound()
    changed = poses(motion)
    first = plant(changed)
    found = broken(compare(asked, changed.built()))
    assert found is not None
    assert found[0] == kind, (found, first)
    assert first <= found[1] <= first + later, (found, first)


def rising(count: int) -> np.ndarray:
    """Return a smooth rise from 0 to 1, both ends at rest."""
    u = np.linspace(0.0, 1.0, count)
    return u**3 * (10 - 15 * u + 6 * u * u)


def bump(count: int) -> np.ndarray:
    return np.sin(np.pi * np.linspace(0.0, 1.0, count)) ** 2


def shift(motion: Motion, rows: np.ndarray, by_mm: np.ndarray) -> None:
    motion.tip[rows] += by_mm


def turn(turned: np.ndarray, rows: np.ndarray, axis: np.ndarray, degrees: np.ndarray) -> None:
    """Turn rotations about an axis of the base by an angle for each sample."""
    for row, angle in zip(rows, np.radians(degrees), strict=True):
        turned[row] = about(axis, float(angle)) @ turned[row]


def stall(phase: int, number: int, part: float) -> Fault:
    """Return a fault: half a second of standing within a phase."""

    def plant(motion: Motion) -> int:
        rows = motion.rows(phase, number)
        at = rows[int(part * len(rows))]
        motion.repeat(np.insert(np.arange(len(motion.tip)), at, np.full(50, at)))
        return at

    return plant


def jaw_off(degrees: float, phase: int, axis: np.ndarray) -> Fault:
    """Return a fault: the jaw is turned away in the middle of a phase and comes back."""

    def plant(motion: Motion) -> int:
        rows = motion.rows(phase)
        rows = rows[len(rows) // 4 : -len(rows) // 4]
        turn(motion.turned, rows, axis, degrees * bump(len(rows)))
        return rows[0]

    return plant
