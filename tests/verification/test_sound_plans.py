"""Plans that two independent engines find free, over random set-ups: the verdict refuses at most one in a hundred."""

from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np
import pytest

from skills.demonstration.demonstration import Demo
from skills.errors import SkillsError
from skills.gridworld.scene import Box, Scene, Tissue
from skills.kinematics import quaternion_of
from skills.learning.policy import Policy
from skills.planning.handoff import PsmM
from skills.planning.plan import SuturePlan, SuturePoint, stack
from skills.planning.trajectory import Trajectory, time_parametrise
from skills.simulation.player import play
from skills.verification.intent import compare
from skills.verification.requested import requested_motion
from skills.verification.scene_clearance import clearance_of
from skills.verification.verdict import judge
from tests.needs import need
from tests.verification.engine import meshes_keep_apart, tools_keep_apart
from tests.verification.hands import MIDDLE_MM, about, random_style

need("mujoco")
need("fcl")
pytestmark = [pytest.mark.needs("simulator"), pytest.mark.needs("meshes")]

# Of a sound plan: twice the largest limit of tools, needle and scene, and what bodies need not refuse.
APART_MM, MESHES_MM = 2.0, 13.0
INSIDE_MM = 0.1  # of a collision: beyond the engines' own errors
X, Y, Z = np.eye(3)


class SetUp(NamedTuple):
    """A plan with both arms in a scene, and its motion."""

    plan: SuturePlan
    trajectory: Trajectory
    scene: Scene
    policy: Policy
    demo: Demo


def set_ups(seed: int) -> Iterator[SetUp]:
    """Yield plans that can be planned: other hands, places and directions of both arms, tissue and boxes."""
    rng = np.random.default_rng(seed)
    while True:
        try:
            demo, policy = random_style(rng)
        except SkillsError:
            continue
        for _ in range(3):
            turn = about(Z, rng.choice([-1, 1]) * np.radians(rng.uniform(10, 90)))
            turn = turn @ about(rng.normal(size=3), np.radians(rng.uniform(0, 15)))
            there = MIDDLE_MM + rng.uniform([-30, -30, -15], [30, 30, 25])
            goal = demo.tip_mm[-1]
            comes = about(rng.normal(size=3), np.radians(rng.uniform(0, 50))) @ turn @ (there / np.linalg.norm(there))
            psm_m = PsmM(
                tuple(comes.tolist()),
                tuple((goal - turn @ there).tolist()),
                tuple(quaternion_of(turn[None])[0].tolist()),
                enters="start" if rng.random() < 0.2 else "after_A1",
            )
            points = []
            for _ in range(int(rng.integers(1, 4))):
                about_z = about(rng.normal(size=3), float(rng.uniform(0, 0.35)))
                place = tuple((goal + rng.normal(0.0, 5.0, 3)).tolist())
                points.append(SuturePoint(place, tuple(quaternion_of(about_z[None])[0].tolist())))
            speed = float(rng.choice([20.0, 50.0, 100.0]))
            rate = float(rng.choice([100.0, 200.0]))
            try:
                plan = stack(policy, points, demo=demo, psm_m=psm_m, speed_mm_s=speed, rate_hz=rate)
                motion = time_parametrise(plan.passes, speed_mm_s=speed, rate_hz=rate, psm_m=psm_m)
            except SkillsError:
                continue
            low = float(motion.tip_mm[:, 2].min()) - rng.uniform(12, 30)
            middle = goal + about(rng.normal(size=3), np.pi) @ [rng.uniform(20, 60), 0, 0]
            half = rng.uniform(1, 8, 3)
            box = Box(tuple((middle - half).tolist()), tuple((middle + half).tolist()))
            tissue = Tissue.plane((0.0, 0.0, low), (0.0, 0.0, 1.0))
            scene = Scene(plan.frame, (box,) * int(rng.integers(2)), tissue=tissue)
            yield SetUp(plan, motion, scene, policy, demo)


def refused(one: SetUp) -> str | None:
    """Return why the verdict refuses a plan as it is played in PyBullet; None if it does not."""
    report = judge(
        play(one.trajectory, timeout_s=600.0),
        one.trajectory,
        approach_m=one.plan.psm_m.approach,
        beside=clearance_of(one.trajectory, one.scene),
        pad_is_tissue=False,
        intent=compare(requested_motion(one.plan, one.policy, one.demo), one.trajectory),
    )
    return None if report.failure is None else str(report.failure)


def keep_apart(one: SetUp, tools_mm: float, meshes_mm: float) -> bool:
    waits = one.plan.psm_m.enters == "start"
    return tools_keep_apart(one.trajectory, one.scene, waits, tools_mm) and meshes_keep_apart(one.trajectory, meshes_mm)


@pytest.mark.nightly  # 17 minutes
def test_of_200_plans_that_other_engines_find_free_two_are_refused_at_most():
    """Seen: fingers 0.26 mm apart as PSM_M goes back, which are not measured here; insertion axis and carriage."""
    plans = islice((one for one in set_ups(40) if keep_apart(one, APART_MM, MESHES_MM)), 200)
    why = [(number, said) for number, one in enumerate(plans) if (said := refused(one)) is not None]
    assert len(why) <= 2, why


@pytest.mark.nightly
def test_every_plan_in_which_other_engines_find_a_collision_is_refused():
    plans = islice((one for one in set_ups(41) if not keep_apart(one, -INSIDE_MM, -INSIDE_MM)), 100)
    assert [number for number, one in enumerate(plans) if refused(one) is None] == []
