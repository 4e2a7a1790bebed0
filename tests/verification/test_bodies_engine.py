"""The distances of the arms' bodies against a collision library, python-fcl, on the same bodies.

Two arms of either generation, their joints anywhere within the published limits, the second arm's base anywhere within
0.4 m and turned in any way up to 30 degrees from upright. In a third of the set-ups the second base is then brought,
along the line between the remote centres, to where the nearest parts are within 2 mm of contact.

Whole motions are planned ones, with PSM_M's base moved sideways to where the bodies meet or just miss each other.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from skills.kinematics import instrument_of, matrix_of
from skills.planning.trajectory import Trajectory
from skills.verification.bodies import between, bodies_clearance, distances_at, parts_of, radii_of
from skills.verification.clearance import Links
from tests.needs import need
from tests.verification.hands import sound_plans

need("fcl")

import fcl  # noqa: E402

TOOLS = ("400006", "420006")
IN_DOUBT_MM = 0.05
NEAR_MM = 2.0


@dataclass(frozen=True)
class SetUp:
    """Two arms in one pose each, in one frame, and the least distance between them in closed form."""

    parts: tuple[Links, Links]
    radii: tuple[np.ndarray, np.ndarray]
    least_mm: float


def set_up(number: int) -> SetUp:
    rng = np.random.default_rng(number)
    tools = [TOOLS[k] for k in rng.integers(0, 2, 2)]
    limits = [instrument_of(tool) for tool in tools]
    joints = [rng.uniform(one.lower, one.upper)[None] for one in limits]
    arms = [parts_of(q, tool) for q, tool in zip(joints, tools, strict=True)]
    radii = (radii_of(tools[0]), radii_of(tools[1]))
    turn, lean, towards = rng.uniform(0, 2 * np.pi), rng.uniform(0, np.radians(30)), rng.uniform(0, 2 * np.pi)
    about = np.array([np.cos(towards), np.sin(towards), 0.0]) * np.sin(lean / 2)
    upright = matrix_of(np.array([[0, 0, np.sin(turn / 2), np.cos(turn / 2)], [*about, np.cos(lean / 2)]]))
    base, way = upright[1] @ upright[0], rng.uniform(-400, 400, 3) * [1, 1, 0.5]

    def least(share: float) -> float:
        return float(between(arms[0], radii[0], arms[1].seen_from(base, share * way), radii[1]).min())

    share = 1.0
    if number % 3 == 0:
        wanted, far = rng.uniform(-NEAR_MM, NEAR_MM), 1.0
        while least(far) < wanted:
            far *= 1.5
        near = 0.0 if least(0.0) < wanted else None
        if near is not None:  # between a place that is nearer than wanted and one that is further
            for _ in range(40):
                share = (near + far) / 2
                near, far = (share, far) if least(share) < wanted else (near, share)
    return SetUp((arms[0], arms[1].seen_from(base, share * way)), radii, least(share))


def capsules(parts: Links, radii: np.ndarray) -> list[fcl.CollisionObject]:
    found = []
    for begin, end, radius in zip(parts.begin_mm[0], parts.end_mm[0], radii, strict=True):
        way = end - begin
        length = float(np.linalg.norm(way))
        z = way / length if length > 0 else np.array([0.0, 0.0, 1.0])
        x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
        x /= np.linalg.norm(x)
        place = fcl.Transform(np.stack([x, np.cross(z, x), z], axis=1), (begin + end) / 2)
        found.append(fcl.CollisionObject(fcl.Capsule(float(radius), length), place))
    return found


def touches(one: SetUp) -> bool:
    """Return whether the library finds any two parts in contact; the two tools alone are no pair of `between`."""
    first, second = (capsules(parts, radii) for parts, radii in zip(one.parts, one.radii, strict=True))
    tools = len(first) - 2, len(second) - 2
    return any(
        fcl.collide(a, b, fcl.CollisionRequest(), fcl.CollisionResult()) > 0
        for i, a in enumerate(first)
        for j, b in enumerate(second)
        if i < tools[0] or j < tools[1]
    )


def compare(numbers: range) -> tuple[int, int]:
    """Compare the set-ups with the library; return how many touch, and how many are within `NEAR_MM` of contact."""
    found = [set_up(number) for number in numbers]
    theirs = np.array([touches(one) for one in found])
    ours = np.array([one.least_mm for one in found])
    clear = np.abs(ours) > IN_DOUBT_MM
    called_free = np.flatnonzero(theirs & (ours > 1e-6))
    assert called_free.tolist() == []
    assert np.count_nonzero((theirs == (ours <= 0))[clear]) >= 0.999 * np.count_nonzero(clear)
    return int(np.count_nonzero(theirs)), int(np.count_nonzero(np.abs(ours) <= NEAR_MM))


def test_a_hundred_set_ups_collide_where_a_collision_library_says_so():
    collide, near = compare(range(100))
    assert collide >= 30
    assert near >= 15


@pytest.mark.nightly
def test_two_thousand_set_ups_collide_where_a_collision_library_says_so():
    collide, near = compare(range(2000))
    assert collide >= 600
    assert near >= 300


def planned_motions() -> Iterator[Trajectory]:
    """Yield planned motions of two arms; every other one comes within `NEAR_MM` of contact, on either side of it."""
    rng = np.random.default_rng(7)
    planned = (one.trajectory for one in sound_plans(seed=11, count=1000))
    for number, motion in enumerate(one for one in planned if one.psm_m is not None):
        wanted = rng.uniform(-NEAR_MM, NEAR_MM) if number % 2 else rng.uniform(-40.0, 60.0)
        some, near, far, moved = np.linspace(0, len(motion) - 1, 60).astype(int), 0.0, 4.0, motion
        for _ in range(25):
            share = (near + far) / 2
            base_mm = motion.psm_m.base_mm * [share, share, 1.0]
            moved = replace(motion, psm_m=replace(motion.psm_m, base_mm=base_mm))
            near, far = (share, far) if distances_at(moved, some).min() < wanted else (near, share)
        yield moved


def at_sample(motion: Trajectory, sample: int) -> SetUp:
    arm, other = motion, motion.psm_m
    parts = [parts_of(one.joints[[sample]], one.instrument) for one in (arm, other)]
    parts[1] = parts[1].seen_from(matrix_of(other.base_xyzw[None])[0], other.base_mm)
    least_mm = float(distances_at(motion, np.array([sample])).min())
    return SetUp((parts[0], parts[1]), (radii_of(arm.instrument), radii_of(other.instrument)), least_mm)


def compare_motions(count: int) -> tuple[int, int]:
    """Compare whole motions with the library; return how many touch, and how many come within `NEAR_MM` of contact.

    Samples all along a motion are compared, those about its nearest one, and the first at which the verdict has them
    collide.
    """
    collide = near = 0
    for _, motion in zip(range(count), planned_motions(), strict=False):
        verdict = bodies_clearance(motion, 0.0)
        every = np.linspace(0, len(motion) - 1, 60).astype(int)
        nearest = int(every[distances_at(motion, every).min(axis=(1, 2)).argmin()])
        looks = {*every.tolist(), *range(max(nearest - 5, 0), min(nearest + 6, len(motion)))}
        if verdict.first is not None:
            looks.add(verdict.first.sample)
        found = {look: at_sample(motion, look) for look in looks}
        theirs = {look for look, one in found.items() if touches(one)}
        assert {look for look in theirs if found[look].least_mm > 1e-6} == set()
        assert {look for look, one in found.items() if one.least_mm < -IN_DOUBT_MM} <= theirs
        assert verdict.first is not None or not theirs
        assert verdict.first is None or min(theirs, default=len(motion)) >= verdict.first.sample
        collide += bool(theirs)
        near += abs(min(one.least_mm for one in found.values())) <= NEAR_MM
    return collide, near


def test_planned_motions_collide_where_a_collision_library_says_so():
    collide, near = compare_motions(4)
    assert 1 <= collide <= 3
    assert near >= 1


@pytest.mark.nightly
def test_sixty_planned_motions_collide_where_a_collision_library_says_so():
    collide, near = compare_motions(60)
    assert 18 <= collide <= 42
    assert near >= 25
