"""Small faults that each gate must name at its place: needle, vibration, quaternions, bends, jaws, and an approach.

Each is planted in a motion that passes all gates without it. Those of bags are in `tests/formats/test_replay_check.py`.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from skills.demonstration.partner import Partner
from skills.gridworld.scene import Box, Capsule, Scene
from skills.kinematics import matrix_of, quaternion_of
from skills.planning.handoff import OtherArm
from skills.planning.motion_laws import A1, A2, TRANSFER
from skills.planning.trajectory import Trajectory
from skills.verification import clearance
from skills.verification.gates import NEEDLE_TO_ARM, SCENE, Failure, Limits
from skills.verification.intent import compare
from skills.verification.scene_clearance import clearance_of, needle_from_arm
from skills.verification.verdict import judge
from tests.verification import faults
from tests.verification.faults import X, Y, Z
from tests.verification.test_intent import ideal

PATH, JAW = "path off the recording", "jaw turned off the recording"
OPENING = "opening of the jaw off the recording"
OF_PATH = {PATH, "path off the policy's cells", "speed of the tip"}


def failure_of(motion: Trajectory, scene: Scene | None = None, asked=None) -> Failure | None:
    beside = None if scene is None else clearance_of(motion, scene)
    asked = faults.sound()[0] if asked is None else asked
    intent = compare(asked, motion)
    return judge(ideal(motion), motion, beside=beside, pad_is_tissue=False, intent=intent).failure


def test_the_motion_without_a_fault_is_feasible():
    assert failure_of(faults.sound()[1], Scene("PSM2_base", boxes=(Box((200, 200, 0), (202, 202, 2)),))) is None


# ---- within a cell, and by 2 degrees --------------------------------------------------------------------------------


def middle(motion: faults.Motion, number: int, part: float, half: int = 60, phase: int = A1) -> np.ndarray:
    rows = motion.rows(phase, number)
    at = int(part * len(rows))
    return rows[max(at - half, 0) : at + half]


def bent(number: int, part: float, by_mm: np.ndarray) -> faults.Fault:
    def plant(motion: faults.Motion) -> int:
        rows = middle(motion, number, part)
        faults.shift(motion, rows, faults.bump(len(rows))[:, None] * by_mm)
        return int(rows[0])

    return plant


def turned(number: int, part: float, axis: np.ndarray) -> faults.Fault:
    def plant(motion: faults.Motion) -> int:
        rows = middle(motion, number, part)
        faults.turn(motion.turned, rows, axis, 2.0 * faults.bump(len(rows)))
        return int(rows[0])

    return plant


def opened(number: int, part: float) -> faults.Fault:
    def plant(motion: faults.Motion) -> int:
        rows = middle(motion, number, part)
        motion.jaw[rows] += np.radians(2.0) * faults.bump(len(rows))
        return int(rows[0])

    return plant


WITHIN = {
    **{
        f"bent by 4 mm along {axis}, pass {n}, {part}": (bent(n, part, 4 * way), OF_PATH)
        for n, part, (axis, way) in product((1, 2), (0.5, 0.9), (("x", X), ("y", Y), ("z", Z)))
    },
    **{f"a dip of 4 mm, pass {n}, {part}": (bent(n, part, -4 * Z), OF_PATH) for n in (0, 2) for part in (0.3, 0.7)},
    **{f"bent by 3 mm, pass {n}": (bent(n, 0.5, 3 * way), OF_PATH) for n, way in ((0, X), (1, Y), (2, Z))},
    **{
        f"jaw turned by 2 degrees about {axis}, pass {n}": (turned(n, part, way), {JAW})
        for n, part, (axis, way) in ((0, 0.3, ("x", X)), (1, 0.5, ("y", Y)), (1, 0.7, ("z", Z)), (2, 0.8, ("x", X)))
    },
    **{
        f"jaw opened by 2 degrees, pass {n}": (opened(n, part), {OPENING}) for n, part in ((0, 0.4), (1, 0.7), (2, 0.8))
    },
}


@pytest.mark.parametrize("name", WITHIN)
def test_a_deviation_within_a_cell_is_named_where_it_is(name):
    plant, kinds = WITHIN[name]
    asked, motion = faults.sound()
    changed = faults.poses(motion)
    first = plant(changed)
    found = faults.broken(compare(asked, changed.built()))
    assert found is not None
    assert found[0] in kinds
    assert first <= found[1] + 1 <= first + 61  # the middle of the bump at the latest; a speed is of the step before


# ---- vibration and jerk ---------------------------------------------------------------------------------------------


def shaken(hz: float, by_mm: np.ndarray, phase: int, arm: str = "tip") -> faults.Fault:
    def plant(motion: faults.Motion) -> int:
        rows = motion.rows(phase)
        rows = rows[len(rows) // 3 : 2 * len(rows) // 3]
        wave = np.cos(2 * np.pi * hz * np.arange(len(rows)) / faults.RATE_HZ)
        getattr(motion, arm)[rows] += wave[:, None] * by_mm
        return int(rows[0])

    return plant


def shaken_wrist(motion: faults.Motion) -> int:
    rows = middle(motion, 1, 0.5)
    faults.turn(motion.turned, rows, X, 0.02 * np.cos(np.pi * np.arange(len(rows))))
    return int(rows[0])


def jerked(by_mm_s2: float) -> faults.Fault:
    """Return a fault: from one moment on the tip is accelerated, and later comes back, within the limits."""

    def plant(motion: faults.Motion) -> int:
        rows = middle(motion, 1, 0.5, half=20)
        part = np.linspace(0.0, 1.0, len(rows))
        seconds = part * len(rows) / faults.RATE_HZ
        faults.shift(motion, rows, (by_mm_s2 / 2 * seconds**2 * (1 - part) ** 2)[:, None] * Z)
        return int(rows[0])

    return plant


SHAKEN = {
    **{
        f"0.004 mm at 50 Hz along {axis}": (shaken(50.0, 0.004 * way, A1), "vibration of ")
        for axis, way in (("x", X), ("y", Y), ("z", Z))
    },
    "0.004 mm at 50 Hz in A2": (shaken(50.0, 0.004 * X, A2), "vibration of "),
    "0.004 mm at 50 Hz in a transfer": (shaken(50.0, 0.004 * Z, TRANSFER), "vibration of "),
    "0.01 mm at 25 Hz": (shaken(25.0, 0.01 * Z, A1), "vibration of "),
    "0.004 mm at 50 Hz of PSM_M": (shaken(50.0, 0.004 * Z, A1, "m_tip"), "vibration of PSM_M's "),
    "the wrist by 0.02 degrees at 50 Hz": (shaken_wrist, "vibration of "),
    "a jerk": (jerked(170.0), "jerk of "),
    "a jerk backwards": (jerked(-170.0), "jerk of "),
}


@pytest.mark.parametrize("name", SHAKEN)
def test_a_vibration_is_named_at_its_beginning(name):
    plant, quantity = SHAKEN[name]
    changed = faults.poses(faults.sound()[1])
    first = plant(changed)
    failure = failure_of(changed.built())
    assert failure is not None
    assert failure.quantity.startswith((quantity, quantity.replace("vibration", "jerk")))
    assert first <= failure.sample <= first + 14


# ---- quaternions ----------------------------------------------------------------------------------------------------


def stretched(motion: Trajectory, sample: int) -> Trajectory:
    rotation = motion.rotation_xyzw.copy()
    rotation[sample] *= 1.01
    return replace(motion, rotation_xyzw=rotation)


@pytest.mark.parametrize("sample", [0, 700, -1])
def test_a_quaternion_1_percent_too_long_is_named_at_its_sample(sample):
    failure = failure_of(stretched(faults.sound()[1], sample))
    assert failure.quantity == "length of a quaternion off 1"
    assert failure.sample == sample % len(faults.sound()[1])


def test_a_base_whose_quaternion_is_too_long_is_named():
    motion = faults.sound()[1]
    m = motion.psm_m
    longer = OtherArm(m.base_mm, 0.99 * m.base_xyzw, m.instrument, m.joints, m.jaw_rad)
    assert failure_of(replace(motion, psm_m=longer)).quantity == "length of a quaternion off 1"


@pytest.mark.parametrize("of", ["point", "base", "taken"])
def test_a_stated_quaternion_1_percent_too_long_is_named(of):
    asked, motion = faults.sound("recorded" if of == "taken" else "paper")
    longer = lambda xyzw: tuple(1.01 * one for one in xyzw)  # noqa: E731
    if of == "point":
        asked = replace(asked, points=(replace(asked.points[0], rotation_xyzw=(0, 0, 0, 1.01)), *asked.points[1:]))
    elif of == "base":
        asked = replace(asked, psm_m=replace(asked.psm_m, base_xyzw=longer(asked.psm_m.base_xyzw)))
    else:
        asked = replace(asked, psm_m=replace(asked.psm_m, taken_xyzw=longer(asked.psm_m.taken_xyzw)))
    assert failure_of(motion, asked=asked).quantity == "length of a stated quaternion off 1"


# ---- an approach in the other arm's frame ---------------------------------------------------------------------------


@pytest.mark.parametrize("by", ["needle", "recording"])
def test_an_approach_stated_in_the_other_arms_frame_is_named(by):
    """Along the recorded approach, or along the recorded needle: but in the frame of PSM_M's base."""
    asked, motion = faults.sound()
    base, kind = matrix_of(np.array([asked.psm_m.base_xyzw]))[0], "PSM_M's approach off the demonstrated hand-off"
    shown = (
        asked.last_rotation[:, 0]
        if by == "needle"
        else np.array([-0.94, 0.10, -0.33]) / np.linalg.norm([-0.94, 0.10, -0.33])
    )
    if by == "recording":
        n = np.cross(shown, Z) / np.linalg.norm(np.cross(shown, Z))
        pose = quaternion_of(np.stack([n, np.cross(shown, n), shown], axis=1)[None])[0]
        partner = Partner("PSM1", 0.0, (0.0, 0.0, 0.0), tuple(pose), None, None, "400006")
        asked = replace(asked, demo=replace(asked.demo, partner=partner))
    for stated, named in ((shown, False), (base.T @ shown, True)):
        wrong = replace(asked, psm_m=replace(asked.psm_m, approach=tuple(stated.tolist())))
        off = compare(wrong, motion).values[kind][0]
        assert (off > 15.0) == named
        if named:
            assert off == pytest.approx(45.0, abs=30.0)  # the base is turned by 45 degrees


# ---- the needle -----------------------------------------------------------------------------------------------------


def box_at(place: np.ndarray) -> Scene:
    return Scene("PSM2_base", boxes=(Box(tuple((place - 1.0).tolist()), tuple((place + 1.0).tolist())),))


def capsule_at(place: np.ndarray) -> Scene:
    x, y, z = place.tolist()
    return Scene("PSM2_base", capsules=(Capsule((x, y, z), (x, y, z + 0.1), 1.0),))


def at(number: int, phase: int, part: float) -> int:
    rows = np.flatnonzero((faults.sound()[1].pass_index == number) & (faults.sound()[1].phase == phase))
    return int(rows[int(part * (len(rows) - 1))])


NEEDLE: dict[str, tuple[Callable[[np.ndarray], Scene], int, int]] = {
    "a box of 2 mm at its free end": (box_at, at(0, A1, 0.5), -1),
    "a box at the beginning": (box_at, 0, -1),
    "a box at its other end": (box_at, at(1, A1, 0.5), 0),
    "a box in A2": (box_at, at(1, A2, 0.3), -1),
    "a box at a quarter of it": (box_at, at(2, A1, 0.6), 12),
    "a box in a transfer, in PSM_M's jaws": (box_at, at(1, TRANSFER, 0.4), 24),
    "another arm, as a capsule": (capsule_at, at(1, A1, 0.5), -1),
}


@pytest.mark.parametrize("name", NEEDLE)
def test_an_obstacle_at_the_needle_alone_is_named_where_that_comes(name):
    make, sample, point = NEEDLE[name]
    motion = faults.sound()[1]
    scene = make(clearance.needle_arc_mm(motion, np.array([sample]))[0, point])
    failure = failure_of(motion, scene)
    assert failure is not None
    assert failure.quantity == SCENE
    assert failure.sample <= sample
    nearest = clearance_of(motion, scene).report.nearest
    assert nearest[0].least_mm < 1.0
    assert any((one.body, one.link) == ("needle", "arc") and one.least_mm <= 0.0 for one in nearest)


def test_a_box_a_little_further_away_than_the_margin_is_free():
    motion = faults.sound()[1]
    every = np.arange(len(motion))
    arc = clearance.needle_arc_mm(motion, every)
    lowest = arc.reshape(-1, 3)[arc.reshape(-1, 3)[:, 2].argmin()]
    below = box_at(lowest - [0.0, 0.0, 1.0 + 0.33 + 1.0 + 3.0])
    assert failure_of(motion, below) is None


@pytest.mark.parametrize("number", [0, 1, 2])
def test_the_other_arm_at_the_needle_is_named(number):
    """PSM_M's wrist passes through the needle's free end in A1, its fingers turned aside."""
    motion = faults.sound()[1]
    sample = at(number, A1, 0.5)
    end = clearance.needle_arc_mm(motion, np.array([sample]))[0, -1]
    changed = faults.poses(motion)
    rows = middle(changed, number, 0.5)
    away = end + 5.0 * changed.m_turned[sample][:, 2] - changed.m_tip[sample]
    changed.m_tip[rows] += faults.bump(len(rows))[:, None] * away
    moved = changed.built()
    near = needle_from_arm(moved, 0.5)
    first = int(np.argmax(near < 0.5))
    assert rows[0] <= first <= sample
    loose = Limits(speed_ratio=1e9, acceleration_ratio=1e9, jerk_ratio=1e9, vibration_counts=1e9)
    failure = judge(ideal(moved), moved, loose, pad_is_tissue=False).failure
    assert (failure.quantity, failure.sample) == (NEEDLE_TO_ARM, first)
    assert (needle_from_arm(motion, 0.5) >= 0.5).all()


@pytest.mark.parametrize("number", [1, 2])
def test_psm_a_at_the_needle_that_psm_m_holds_is_named(number):
    """In the transfer PSM_A's wrist passes through the place where PSM_M holds the needle."""
    motion = faults.sound()[1]
    changed = faults.poses(motion)
    rows = changed.rows(TRANSFER, number)
    rows = rows[len(rows) // 4 : 3 * len(rows) // 4]
    sample = int(rows[len(rows) // 2])
    end = clearance.needle_arc_mm(motion, np.array([sample]))[0, -1]
    away = end + 5.0 * changed.turned[sample][:, 2] - changed.tip[sample]
    changed.tip[rows] += faults.bump(len(rows))[:, None] * away
    near = needle_from_arm(changed.built(), 0.5)
    assert rows[0] <= int(np.argmax(near < 0.5)) <= sample
