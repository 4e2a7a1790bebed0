"""The map of reach against plans: each place planned, timed and judged by itself, at every sample."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from skills.errors import BadSpeed, SkillsError, Unreachable
from skills.gridworld.scene import Box, Scene, Tissue
from skills.kinematics import instrument_of, matrix_of, quaternion_of
from skills.planning.handoff import HOLDING_RAD
from skills.planning.plan import SuturePlan, SuturePoint, stack
from skills.planning.trajectory import Trajectory, time_parametrise
from skills.verification.bodies import bodies_clearance
from skills.verification.clearance import FINGER_REACH_MM, FINGERS, clearance_between, links_of, openings
from skills.verification.gates import Limits
from skills.verification.reach import map_reach
from skills.verification.scene_clearance import clearance_of
from tests.verification.hands import BASE_MM, about, random_psm_m, random_style

CELLS = 200
OF_ONE = 10  # places of a style


@dataclass(frozen=True)
class Asked:
    """A style with PSM_M and a scene, at one rotation, and how its plans are asked for."""

    plan: SuturePlan
    again: dict[str, object]

    def at(self, position_mm: tuple[float, float, float]) -> SuturePlan:
        point = replace(self.plan.passes[0].point, position_mm=position_mm)
        return replace(stack(**self.again, points=[point]), scene=self.plan.scene)


def styles(seed: int) -> Iterator[tuple[Asked, np.random.Generator]]:
    """Yield styles, half of them beside a box and all above tissue."""
    rng = np.random.default_rng(seed)
    while True:
        try:
            demo, policy = random_style(rng)
            psm_m = random_psm_m(rng, demo.partner)
            if psm_m is not None and psm_m.base_mm is not None:
                x, y, z = np.array(BASE_MM) + rng.uniform(-1, 1, 3) * [60, 60, 30]
                psm_m = replace(psm_m, base_mm=(x, y, z))
            again = {"policy": policy, "demo": demo, "psm_m": psm_m, "tip_offset_mm": float(rng.choice([0.0, 10.2]))}
            turn = about(rng.normal(size=3), float(rng.uniform(0, 0.5)))
            goal = demo.tip_mm[-1]
            point = SuturePoint(tuple(goal.tolist()), tuple(quaternion_of(turn[None])[0].tolist()))
            plan = stack(points=[point], **again)
        except SkillsError:
            continue
        level = float(demo.tip_mm[:, 2].min() - rng.uniform(10, 40))
        tissue = Tissue.plane((0.0, 0.0, level), (float(rng.normal(0, 0.1)), 0.0, 1.0))
        low = goal + rng.uniform(-60, 60, 3)
        boxes = (Box(tuple(low.tolist()), tuple((low + 15).tolist())),) if rng.random() < 0.5 else ()
        yield Asked(replace(plan, scene=Scene(plan.frame, tissue=tissue, boxes=boxes)), again), rng


def planned(plan: SuturePlan) -> Trajectory | None:
    """Return the motion of a plan; None where planning refuses it."""
    try:
        return time_parametrise(plan.passes, psm_m=plan.psm_m, rate_hz=200.0, instrument=plan.instrument)
    except (Unreachable, BadSpeed):
        return None


def refused(plan: SuturePlan) -> str | None:
    """Return why a plan is refused, by planning or by the verdict's closed form; None: it is not."""
    limits, motion = Limits(), planned(plan)
    if motion is None:
        return "planning"
    arms = [(motion.joints, motion.instrument)]
    arms += [] if motion.psm_m is None else [(motion.psm_m.joints, motion.psm_m.instrument)]
    for joints, name in arms:
        tool = instrument_of(name)
        if not ((joints >= tool.lower - 1e-9) & (joints <= tool.upper + 1e-9)).all():
            return "limits"
        if not (joints[:, 2] >= tool.cannula_mm).all():
            return "cannula"
    if not (bodies_clearance(motion, limits.clearance_bodies_mm).at_least_mm >= limits.clearance_bodies_mm).all():
        return "bodies"
    if motion.psm_m is not None:
        m = motion.psm_m
        other = links_of(m.joints, m.instrument).seen_from(matrix_of(m.base_xyzw[None])[0], m.base_mm)
        apart = clearance_between(links_of(motion.joints, motion.instrument), other)
        apart[:, FINGERS] -= FINGER_REACH_MM * (openings(motion.arms[0])[:, None, None] - HOLDING_RAD)
        still = (np.abs(np.diff(motion.tip_mm, axis=0)) < 1e-9).all(axis=1) & (np.diff(m.joints, axis=0) == 0).all(
            axis=1
        )
        at_the_end = len(motion) - 1 - int(np.argmin(still[::-1]))
        apart[at_the_end:, FINGERS, FINGERS] = np.inf  # at the hand-off itself
        if not (apart >= limits.clearance_psm_m_mm).all():
            return "tools"
    assert plan.scene is not None
    beside = clearance_of(motion, plan.scene)
    if not (beside.at_least_mm >= beside.report.limit_mm).all():
        return "scene"
    return None if (beside.needle_mm >= 0).all() else "needle"


def compared(seed: int, count: int) -> Counter[tuple[str, str | None]]:
    """Compare places of random styles with their plans; return how often each answer met which refusal."""
    found: Counter[tuple[str, str | None]] = Counter()
    for asked, rng in styles(seed):
        goal = np.array(asked.plan.passes[0].point.position_mm)
        positions = goal + rng.uniform(-1, 1, (OF_ONE, 3)) * [60, 60, 40]
        for place in map_reach(asked.plan, positions):
            why = refused(asked.at(place.position_mm))
            found[place.reach, why] += 1
            assert (place.reach, why is None) not in (("yes", False), ("no", True)), (seed, place, why)
        if found.total() >= count:
            return found
    raise AssertionError


def test_no_place_is_reached_where_its_plan_is_refused():
    met = compared(seed=5, count=20)
    assert met["yes", None] >= 4
    assert sum(n for (answer, _), n in met.items() if answer == "in doubt") <= 4


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(4))
def test_no_place_is_reached_where_its_plan_is_refused_widely(seed):
    met = compared(100 + seed, CELLS)
    print(met)
    assert met["yes", None] >= CELLS // 6
    assert sum(n for (answer, _), n in met.items() if answer == "in doubt") <= CELLS // 16  # 3 to 6 in 100
    assert {"planning", "bodies", "scene"} <= {why for _, why in met}
