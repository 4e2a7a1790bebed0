"""Random hands, policies and plans, for the judge of a motion against what was meant."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from skills.demonstration.demonstration import Demo
from skills.demonstration.partner import Partner
from skills.errors import SkillsError
from skills.gridworld.grid import choose_grid, discretize
from skills.gridworld.reward import sparse_reward
from skills.kinematics import POINTING_DOWN, quaternion_of
from skills.learning.policy import Policy, learn_tabular
from skills.learning.q_learning import CellQLearning, PhaseQLearning
from skills.planning.handoff import PsmM
from skills.planning.plan import SuturePlan, SuturePoint, stack
from skills.planning.trajectory import Trajectory, time_parametrise
from tests.planning.motions import PSM_M

MIDDLE_MM = np.array([0.0, 50.0, -135.0])
# PSM_M's base, as in the benchmark: beside PSM_A, turned away by 45 degrees about the vertical
BASE_MM, BASE_XYZW = (160.0, 20.0, 20.0), (0.0, 0.0, float(np.sin(np.pi / 8)), float(np.cos(np.pi / 8)))


class Planned(NamedTuple):
    """A plan, its motion, and what both were made from."""

    policy: Policy
    demo: Demo
    plan: SuturePlan
    trajectory: Trajectory


def about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation about an axis of any length, by Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def random_hand(rng: np.random.Generator) -> Demo:
    """Return a hand that wanders through 20 to 60 mm, turns its jaw, trembles and may rest on the way."""
    seconds = np.arange(0.0, rng.uniform(3.0, 9.0), 1.0 / rng.choice([30.0, 50.0, 100.0, 200.0]))
    knots = np.cumsum(rng.normal(0.0, rng.uniform(4.0, 9.0), (rng.integers(4, 9), 3)), axis=0)
    knots += MIDDLE_MM - knots.mean(axis=0)
    pace = rng.uniform(0.0, 1.0, len(knots) - 1) ** 2 + 0.15  # hurries here, dawdles there
    at = np.append(0.0, np.cumsum(pace) / pace.sum()) * seconds[-1]
    rested = seconds
    if rng.random() < 0.4:
        rest = rng.uniform(0.2, 0.8) * seconds[-1]
        rested = np.where(seconds < rest, seconds, np.maximum(rest, seconds - 1.0))
    tip = CubicSpline(at, knots, bc_type="clamped")(rested)
    tip = tip + rng.choice([0.0, 0.1, 0.25]) * np.sin(2 * np.pi * 9.5 * seconds)[:, None] * rng.normal(size=3)
    turned = None
    if rng.random() < 0.8:
        turns = rng.normal(0.0, np.radians(rng.uniform(0, 20)), (len(knots), 3))
        angles = CubicSpline(at, turns, bc_type="clamped")(seconds) + 1e-12
        rotations = np.stack([about(axis, float(np.linalg.norm(axis))) @ POINTING_DOWN for axis in angles])
        turned = quaternion_of(rotations)
    jaw = None if rng.random() < 0.3 else 0.2 + 0.15 * np.sin(seconds)
    demo = Demo("PSM2", "/PSM2/local/measured_cp", "PSM2_base", 0.0, float(seconds[-1]), seconds, tip, turned, jaw)
    return demo if turned is None or rng.random() < 0.5 else replace(demo, partner=random_partner(rng, tip[-1]))


def random_partner(rng: np.random.Generator, goal_mm: np.ndarray) -> Partner:
    """Return PSM_M as it takes the needle: about where the paper's A2 would let it."""
    a = about(rng.normal(size=3), rng.uniform(0, 0.3)) @ np.array([-0.94, 0.10, -0.33])
    a /= np.linalg.norm(a)
    n = np.cross(a, [0.0, 0.0, 1.0])
    n /= np.linalg.norm(n)
    x, y, z = (goal_mm - 16.0 * a + rng.normal(0, 2, 3)).tolist()
    pose = tuple(quaternion_of(np.stack([n, np.cross(a, n), a], axis=1)[None])[0].tolist())
    return Partner("PSM1", 0.0, (x, y, z), pose, BASE_MM, BASE_XYZW, "400006")


def random_style(rng: np.random.Generator) -> tuple[Demo, Policy]:
    """Return a hand and the policy that is learnt from it."""
    demo = random_hand(rng)
    grid = choose_grid(demo.tip_mm, "fit", float(rng.choice([3.0, 5.0, 5.0, 7.0])))
    path = discretize(demo.tip_mm, grid, float(rng.choice([0.0, 0.25])))
    learner = PhaseQLearning() if rng.random() < 0.8 else CellQLearning.published()
    return demo, learn_tabular(sparse_reward(path), learner, seed=int(rng.integers(1000)))


def random_plan(rng: np.random.Generator, demo: Demo, policy: Policy) -> Planned:
    """Return a plan of one to four passes near the demonstrated place, most of them as fast as the joints allow.

    Raises:
        SkillsError: The policy does not reach its goal, or an arm does not reach a pose.
    """
    points, starts = [], []
    for _ in range(int(rng.integers(1, 5))):
        turn = about(rng.normal(size=3), float(rng.uniform(0, 0.35)))
        x, y, z = (demo.tip_mm[-1] + rng.normal(0.0, 5.0, 3)).tolist()
        points.append(SuturePoint((x, y, z), tuple(quaternion_of(turn[None])[0].tolist())))
        before = demo.tip_mm[int(rng.integers(len(demo.tip_mm) * 2 // 3))] - demo.tip_mm[-1]
        starts.append(None if rng.random() < 0.6 else turn @ before + (x, y, z) + rng.normal(0, 4, 3))
    plan = stack(
        policy,
        points,
        demo=demo,
        starts_mm=starts,
        psm_m=random_psm_m(rng, demo.partner),
        speed_mm_s=float(rng.choice([5.0, 20.0, 100.0, 100.0, 100.0])),
        rate_hz=float(rng.choice([100.0, 200.0])),
        tip_offset_mm=float(rng.choice([0.0, 0.0, 10.2])),
        orientation="constant" if rng.random() < 0.3 else None,
        a2="paper" if rng.random() < 0.3 else None,
    )
    asked = {"speed_mm_s": plan.speed_mm_s, "rate_hz": plan.rate_hz, "instrument": plan.instrument}
    return Planned(policy, demo, plan, time_parametrise(plan.passes, psm_m=plan.psm_m, **asked))


def random_psm_m(rng: np.random.Generator, seen: Partner | None) -> PsmM | None:
    """Return PSM_M as it was recorded, or as a request states it, with its base or without; or none."""
    if seen is not None and rng.random() < 0.7:
        enters = "start" if rng.random() < 0.2 else "after_A1"
        recorded = {"taken_mm": seen.position_mm, "taken_xyzw": seen.rotation_xyzw}
        return PsmM(seen.approach, seen.base_mm, seen.base_xyzw, "400006", enters, **recorded)
    if rng.random() < 0.2:
        return None
    return PsmM(PSM_M, BASE_MM, BASE_XYZW) if rng.random() < 0.8 else PsmM(PSM_M)


def sound_plans(seed: int, count: int) -> Iterator[Planned]:
    """Yield sound plans, two of a style; set-ups that planning refuses are left out."""
    rng = np.random.default_rng(seed)
    found = 0
    while found < count:
        try:
            demo, policy = random_style(rng)
        except SkillsError:
            continue
        for _ in range(min(2, count - found)):
            try:
                plan = random_plan(rng, demo, policy)
            except SkillsError:
                continue
            found += 1
            yield plan
