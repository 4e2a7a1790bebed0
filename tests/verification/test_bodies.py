"""The arms' outer bodies: by hand, by laws, and by the simulator's own distances."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import fcl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from skills.kinematics import instrument_of, matrix_of
from skills.planning.handoff import OtherArm, PsmM
from skills.planning.trajectory import A1, Trajectory, time_parametrise
from skills.verification import bodies
from skills.verification.arm_errors import CALIBRATED, UNCALIBRATED
from skills.verification.clearance import links_of
from skills.verification.error_draws import draw
from skills.verification.gates import Limits
from skills.verification.monte_carlo import estimate_success, scene_of
from skills.verification.probabilities import EstimateSettings
from skills.verification.verdict import judge
from tests.arms import EXACT
from tests.by_day import some
from tests.needs import need
from tests.planning.motions import PSM_M, hand_off, ideal_playback
from tests.planning.test_trajectory import BESIDE
from tests.verification.hands import sound_plans

TOOLS = ("400006", "420006", "400006-Si", "420006-Classic")
LIMIT_MM = Limits().clearance_bodies_mm
SIDE_BY_SIDE = (0.0, float(np.sin(np.radians(17.5))), 0.0, float(np.cos(np.radians(17.5))))  # its back is PSM_A's


def motion(psm_m: PsmM = BESIDE) -> Trajectory:
    return time_parametrise([hand_off(), hand_off(-8.0)], rate_hz=60.0, psm_m=psm_m)


FREE = motion()
# As the first README had it: the bodies of both arms in the same place. Tools and needle are clear of each other.
JAMMED = motion(PsmM(PSM_M, (160.0, 20.0, 20.0), SIDE_BY_SIDE))


def anywhere(tool: str, count: int, seed: int) -> np.ndarray:
    of = instrument_of(tool)
    return np.random.default_rng(seed).uniform(of.lower, of.upper, (count, 6))


def apart(one: Trajectory, sample: slice | np.ndarray = np.s_[:]) -> np.ndarray:
    m = one.psm_m
    other = bodies.parts_of(m.joints[sample], m.instrument).seen_from(matrix_of(m.base_xyzw[None])[0], m.base_mm)
    arm = bodies.parts_of(one.joints[sample], one.instrument)
    return bodies.between(arm, other)


# ---- where the bodies are ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tool", TOOLS)
def test_shaft_and_hand_are_those_of_the_tool(tool):
    joints = anywhere(tool, 200, seed=1)
    parts, links = bodies.parts_of(joints, tool), links_of(joints, tool)
    np.testing.assert_allclose(parts.begin_mm[:, -2:], links.begin_mm[:, :2], atol=1e-9)
    np.testing.assert_allclose(parts.end_mm[:, -2:], links.end_mm[:, :2], atol=1e-9)


@pytest.mark.parametrize(
    ("yaw", "pitch", "insertion", "low", "high"),
    [
        (0.0, 0.0, 0.0, (3.0, -41.0, 142.0), (0.0, -5.0, 354.0)),
        (0.0, 0.0, 100.0, (3.0, -41.0, 142.0), (0.0, -5.0, 254.0)),
        # Half a right angle of yaw: up points to -x. A right angle of pitch: up points forward, away from the base.
        (np.pi / 4, 0.0, 0.0, (-139 / 2**0.5, -41.0, 145 / 2**0.5), (-354 / 2**0.5, -5.0, 354 / 2**0.5)),
        (0.0, np.pi / 2, 0.0, (3.0, 142.0, 41.0), (0.0, 354.0, 5.0)),
    ],
)
def test_the_insertion_axis_and_its_carriage_turn_and_slide_by_hand(yaw, pitch, insertion, low, high):
    parts, names = bodies.parts_of(np.array([[yaw, pitch, insertion, 0, 0, 0]]), "400006"), bodies.names_of("400006")
    np.testing.assert_allclose(parts.begin_mm[0, names.index("insertion axis")], low, atol=1e-9)
    np.testing.assert_allclose(parts.begin_mm[0, names.index("carriage")], high, atol=1e-9)


@pytest.mark.parametrize("tool", TOOLS[:2])
def test_the_bars_keep_their_direction_and_what_is_mounted_stands_still(tool):
    joints, names = anywhere(tool, 100, seed=2), bodies.names_of(tool)
    parts = bodies.parts_of(joints, tool)
    bars = names.index("rear bar")
    for still in ("setup joint end", "base"):
        assert np.ptp(parts.begin_mm[:, names.index(still)], axis=0).max() == 0.0
    # The bars turn with the yaw alone: their direction along the yaw's axis is the same in every pose.
    way = parts.end_mm[:, bars] - parts.begin_mm[:, bars]
    np.testing.assert_allclose(way[:, 1], way[0, 1], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(way, axis=1), np.linalg.norm(way[0]), atol=1e-9)


@given(seed=st.integers(0, 10_000), size=st.floats(1e-3, 1.0), tool=st.sampled_from(TOOLS))
def test_no_two_parts_approach_by_more_than_the_bound_of_their_movements(seed, size, tool):
    """A second arm, with the same tool, stands somewhere; both move."""
    rng = np.random.default_rng(seed)
    poses = [anywhere(tool, 20, seed), anywhere(tool, 20, seed + 1)]
    others = [q + size * rng.uniform(-1, 1, q.shape) * [1, 1, 100, 1, 1, 1] for q in poses]
    base = matrix_of(rng.normal(size=(1, 4)))[0]
    at_mm = rng.uniform(-400, 400, 3)
    of = instrument_of(tool)
    others = [np.clip(q, of.lower, of.upper) for q in others]
    seen = [
        bodies.between(bodies.parts_of(one, tool), bodies.parts_of(two, tool).seen_from(base, at_mm), np.inf)
        for one, two in (poses, others)
    ]
    moved = [bodies.moved_mm(one, two, tool) for one, two in zip(poses, others, strict=True)]
    way = moved[0][:, :, None] + moved[1][:, None]
    between_tools = np.isinf(seen[0])
    first, second = (np.where(between_tools, 0.0, one).clip(min=0.0) for one in seen)  # deeper, bounds are less close
    assert (np.abs(first - second) <= way + 0.1).all()  # as precise as the distances of outlines


def test_distances_of_segments_are_those_of_their_points():
    """Against a grid of 201 x 201 points on both; parallel, crossing and pointlike ones are among them."""
    rng = np.random.default_rng(3)
    p, u, q, v = rng.normal(size=(4, 60, 3)) * 100.0
    u[:10], v[5:15], q[20:25] = v[:10], 0.0, p[20:25]
    share = np.linspace(0, 1, 201)[:, None]
    points = [(a[:, None] + share * b[:, None]) for a, b in ((p, u), (q, v))]
    grid = np.linalg.norm(points[0][:, :, None] - points[1][:, None], axis=-1).min(axis=(1, 2))
    ours = bodies.segments_apart(p, u, q, v)
    assert (ours <= grid + 1e-9).all()
    np.testing.assert_allclose(ours, grid, atol=3.0)
    assert np.isnan(bodies.segments_apart(np.full((1, 3), np.nan), u[:1], q[:1], v[:1])).all()


# ---- along a motion ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("further_mm", "free"), [(0.0, False), (60.0, False), (80.0, False), (100.0, True)])
def test_two_arms_side_by_side_are_free_where_they_were_measured_to_be(further_mm, free):
    """The manufacturer's bodies overlap at 160 and 240 mm, and are 11 mm apart at 260; ours are never further apart."""
    arm = bodies.parts_of(np.zeros((1, 6)), "400006")
    other = arm.seen_from(matrix_of(np.array([SIDE_BY_SIDE]))[0], np.array([160.0 + further_mm, 20.0, 20.0]))
    least = bodies.between(arm, other).min()
    assert (least > 0) == free
    assert least < 11.0


@pytest.mark.parametrize("one", [FREE, JAMMED], ids=["free", "jammed"])
def test_the_bound_holds_at_every_sample_and_the_first_pair_is_the_first(one):
    found, every = bodies.bodies_clearance(one, LIMIT_MM), apart(one).min(axis=(1, 2))
    assert found.report.at_least_mm <= every.min()
    assert found.report.at_least_mm >= every.min() - bodies.LOOK_MM
    assert (found.first is None) == bool((every >= LIMIT_MM).all())
    assert found.report.looks < len(one)
    for near in found.report.nearest:
        pair = bodies.names_of("400006").index(near.part), bodies.names_of("400006").index(near.other)
        assert near.least_mm == pytest.approx(apart(one, np.array([near.sample]))[0][pair])


def test_a_single_sample_that_is_too_near_is_found_and_named():
    """Where PSM_M waits, its yaw swings it over to PSM_A and back, from one sample to the next."""
    m = FREE.psm_m
    sample = int(np.flatnonzero(FREE.phase == A1)[40])
    joints = np.array(m.joints)
    joints[sample, 0] -= np.radians(75)
    swung = replace(FREE, psm_m=OtherArm(m.base_mm, m.base_xyzw, m.instrument, joints))
    every = apart(swung).min(axis=(1, 2))
    assert np.flatnonzero(~(every >= LIMIT_MM)).tolist() == [sample]
    found = bodies.bodies_clearance(swung, LIMIT_MM)
    assert int(np.argmax(~(found.at_least_mm >= LIMIT_MM))) in (sample - 1, sample)
    pair = np.unravel_index(apart(swung)[sample].argmin(), apart(swung).shape[1:])
    assert (
        str(found.first)
        == f"PSM_A's {bodies.names_of('400006')[pair[0]]} and PSM_M's {bodies.names_of('400006')[pair[1]]}"
    )


def playback(one: Trajectory):
    """Return the measurements of a simulator in which tools and pad are well apart."""
    m, count = one.psm_m, len(one)
    links = links_of(m.joints, m.instrument).seen_from(matrix_of(m.base_xyzw[None])[0], m.base_mm)
    alone = ideal_playback(one)
    return replace(alone, clearances_mm=np.full((count, 24), 20.0), psm_m_tip_mm=links.end_mm[:, 1])


def test_the_judge_refuses_arms_whose_bodies_meet_at_the_first_sample():
    assert judge(playback(FREE), FREE).feasible
    report = judge(playback(JAMMED), JAMMED)
    assert (report.feasible, report.failure.sample) == (False, 0)
    assert report.failure.quantity == "clearance of PSM_A's base and PSM_M's base"
    assert report.failure.value == pytest.approx(report.bodies.at_least_mm, abs=bodies.LOOK_MM)
    assert report.bodies.arms == ("PSM Classic", "PSM Classic")


def test_an_arm_alone_runs_into_nothing_and_its_verdict_says_so():
    alone = time_parametrise([hand_off()], rate_hz=60.0)
    report = judge(ideal_playback(alone), alone).bodies
    assert (report.arms, report.at_least_mm, report.nearest) == (("PSM Classic",), None, ())


def test_joints_that_are_not_numbers_are_too_near():
    m, joints = FREE.psm_m, np.array(FREE.psm_m.joints)
    joints[7, 1] = np.nan
    unknown = replace(FREE, psm_m=OtherArm(m.base_mm, m.base_xyzw, m.instrument, FREE.psm_m.joints))
    object.__setattr__(unknown.psm_m, "joints", joints)
    found = bodies.bodies_clearance(unknown, LIMIT_MM)
    assert int(np.argmax(~(found.at_least_mm >= LIMIT_MM))) in (6, 7)


def test_the_bodies_of_both_generations_have_names_of_their_own():
    assert set(bodies.BODIES) == {"PSM Classic", "PSM Si"}
    for tool in TOOLS:
        assert len(set(bodies.names_of(tool))) == len(bodies.names_of(tool)) == len(bodies.radii_of(tool))


# ---- in inexact worlds ---------------------------------------------------------------------------------------------


def test_a_plan_whose_bodies_meet_fails_though_every_needle_is_caught():
    few = EstimateSettings(variations=40, suture_point_mm=0.0, needle_rad=0.0)
    asked = {"approach_m": PSM_M, "pad_top_mm": -170.0, "settings": few, "errors": EXACT}
    only = estimate_success(JAMMED, **asked).under[0]
    assert only.plan.count == 0
    assert (only.passes[0].faults.bodies, only.passes[0].faults.arms, only.passes[0].caught.count) == (40, 0, 40)
    only = estimate_success(FREE, **asked).under[0]
    assert (only.passes[0].faults.bodies, only.plan.count) == (0, 40)


@pytest.mark.parametrize("limit_mm", [80.0, 84.0, 86.0, 90.0])
def test_a_variation_is_too_near_where_its_own_distances_say_so(limit_mm):
    """Against the distances of every variation and sample; at these limits some are too near and some are not."""
    scene = scene_of(FREE, 0, -170.0, 0.5)
    scene = replace(scene, arms=tuple(arm.at(np.arange(0, len(scene.phase), 25)) for arm in scene.arms))
    stamps_s = np.arange(len(scene.arms[0].joints)) / 4
    drawn = draw(1, 0, 40, len(stamps_s), suture_point_mm=5.0, needle_rad=0.0)
    displaced = [drawn.under(errors, stamps_s) for errors in (EXACT, CALIBRATED, UNCALIBRATED)]
    joints = [arm.shifted(drawn.shift_mm) for arm in scene.arms]
    expected, centre, names = [], scene.arms[1].base_mm, len(bodies.names_of("400006"))
    for errors in displaced:
        every = [bodies.placed(arm, q) for q, arm in zip(joints, scene.arms, strict=True)]
        by_a, by_m = (one.reshape(-1, 1, 3) for one in errors.tip_mm)
        turn = np.repeat(errors.base_turn, len(stamps_s), axis=0)
        by_m = by_m + np.repeat(errors.base_mm, len(stamps_s), axis=0)[:, None]
        least = np.full(len(by_a), np.inf)
        for i, j in np.ndindex(names, names):
            if i < names - 2 or j < names - 2:
                rows = np.arange(len(by_a))
                (a, r), (m, s) = (
                    one.corners(rows, np.full(len(rows), k)) for one, k in zip(every, (i, j), strict=True)
                )
                m = np.einsum("tij,tkj->tki", turn, m - centre) + centre + by_m
                least = np.minimum(least, bodies.hulls_apart(a + by_a, m, limit_mm + 200.0) - r - s)
        expected.append(least.reshape(40, -1).min(axis=1) < limit_mm)
    every = np.ones((3, 40), dtype=bool)
    found = bodies.too_near(scene.arms, joints, displaced, limit_mm, every)
    np.testing.assert_array_equal(found, expected)
    some = np.random.default_rng(0).random((3, 40)) < 0.5
    np.testing.assert_array_equal(bodies.too_near(scene.arms, joints, displaced, limit_mm, some), found & some)


need("fcl")


ENGINE_TOOLS = ("400006", "420006")
IN_DOUBT_MM = 0.05
NEAR_MM = 2.0


@dataclass(frozen=True)
class SetUp:
    """Two arms in one pose each, in one frame, and the least distance between them in closed form."""

    parts: tuple[bodies.Parts, bodies.Parts]
    least_mm: float


def set_up(number: int) -> SetUp:
    rng = np.random.default_rng(number)
    tools = [ENGINE_TOOLS[k] for k in rng.integers(0, 2, 2)]
    limits = [instrument_of(tool) for tool in tools]
    joints = [rng.uniform(one.lower, one.upper)[None] for one in limits]
    arms = [bodies.parts_of(q, tool) for q, tool in zip(joints, tools, strict=True)]
    turn, lean, towards = rng.uniform(0, 2 * np.pi), rng.uniform(0, np.radians(30)), rng.uniform(0, 2 * np.pi)
    about = np.array([np.cos(towards), np.sin(towards), 0.0]) * np.sin(lean / 2)
    upright = matrix_of(np.array([[0, 0, np.sin(turn / 2), np.cos(turn / 2)], [*about, np.cos(lean / 2)]]))
    base, way = upright[1] @ upright[0], rng.uniform(-400, 400, 3) * [1, 1, 0.5]

    def least(share: float) -> float:
        return float(bodies.between(arms[0], arms[1].seen_from(base, share * way)).min())

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
    return SetUp((arms[0], arms[1].seen_from(base, share * way)), least(share))


def shapes(parts: bodies.Parts) -> list[tuple[fcl.CollisionObject, float]]:
    """Return each part for the library, with its radius: a convex body of its corners, or its axis alone."""
    found = []
    for number in range(len(bodies.names_of(parts.instrument))):
        corners, radius = parts.corners(np.array([0]), np.array([number]))
        points = np.unique(corners[0], axis=0)
        if len(points) > 2:
            faces = ConvexHull(points).simplices
            shape = fcl.Convex(points, len(faces), np.insert(faces, 0, 3, axis=1).ravel())
        else:
            shape, points = fcl.Convex(*_axis(points)), points
        found.append((fcl.CollisionObject(shape, fcl.Transform()), float(radius[0])))
    return found


def _axis(ends: np.ndarray) -> tuple[np.ndarray, int, np.ndarray]:
    """Return an axis as a needle of a body, a thousandth of a millimetre thick."""
    points = np.concatenate([ends[:1] + 1e-3 * np.eye(3), ends[-1:]])
    return points, 4, np.array([3, 0, 1, 2, 3, 0, 1, 3, 3, 1, 2, 3, 3, 0, 2, 3])


def touches(one: SetUp) -> bool:
    """Return whether the library finds any two parts in contact; the two tools alone are no pair of `between`."""
    first, second = (shapes(parts) for parts in one.parts)
    tools = len(first) - 2, len(second) - 2
    return any(
        fcl.distance(a, b, fcl.DistanceRequest(), fcl.DistanceResult()) <= r + s
        for i, (a, r) in enumerate(first)
        for j, (b, s) in enumerate(second)
        if i < tools[0] or j < tools[1]
    )


def compare(numbers: range) -> tuple[int, int]:
    """Compare the set-ups with the library; return how many touch, and how many are within `NEAR_MM` of contact."""
    found = [set_up(number) for number in numbers]
    theirs = np.array([touches(one) for one in found])
    ours = np.array([one.least_mm for one in found])
    clear = np.abs(ours) > IN_DOUBT_MM
    called_free = np.flatnonzero(theirs & (ours > IN_DOUBT_MM))
    assert called_free.tolist() == []
    assert np.count_nonzero((theirs == (ours <= 0))[clear]) >= 0.999 * np.count_nonzero(clear)
    return int(np.count_nonzero(theirs)), int(np.count_nonzero(np.abs(ours) <= NEAR_MM))


@pytest.mark.parametrize("set_ups", some([100, 2000], 2))
def test_set_ups_collide_where_a_collision_library_says_so(set_ups):
    collide, near = compare(range(set_ups))
    assert collide >= 0.3 * set_ups
    assert near >= 0.15 * set_ups


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
            near, far = (share, far) if bodies.distances_at(moved, some).min() < wanted else (near, share)
        yield moved


def at_sample(motion: Trajectory, sample: int) -> SetUp:
    arm, other = motion, motion.psm_m
    parts = [bodies.parts_of(one.joints[[sample]], one.instrument) for one in (arm, other)]
    parts[1] = parts[1].seen_from(matrix_of(other.base_xyzw[None])[0], other.base_mm)
    least_mm = float(bodies.distances_at(motion, np.array([sample])).min())
    return SetUp((parts[0], parts[1]), least_mm)


def compare_motions(count: int) -> tuple[int, int]:
    """Compare whole motions with the library; return how many touch, and how many come within `NEAR_MM` of contact.

    Samples all along a motion are compared, those about its nearest one, and the first at which the verdict has them
    collide.
    """
    collide = near = 0
    for _, motion in zip(range(count), planned_motions(), strict=False):
        verdict = bodies.bodies_clearance(motion, 0.0)
        every = np.linspace(0, len(motion) - 1, 60).astype(int)
        nearest = int(every[bodies.distances_at(motion, every).min(axis=(1, 2)).argmin()])
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


@pytest.mark.parametrize(("motions", "least", "least_near"), some([(4, 1, 1), (60, 18, 25)], 2))
def test_planned_motions_collide_where_a_collision_library_says_so(motions, least, least_near):
    collide, near = compare_motions(motions)
    assert least <= collide <= motions - least
    assert near >= least_near
